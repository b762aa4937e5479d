//! Parameters in conversation with a ground station, over a link that loses some of it.

use std::sync::Mutex;

use proptest::prelude::*;

use super::*;
use crate::ground::lossy::{Lossy, STATION, at, station};

/// Remembers what is kept.
#[derive(Clone, Default)]
struct Memory(Arc<Mutex<Option<String>>>, bool);

impl Keeper for Memory {
    fn keep(&mut self, name: &str, text: &str) -> Result<(), String> {
        assert_eq!(name, KEPT);
        if self.1 {
            return Err("the disk is full".into());
        }
        *self.0.lock().unwrap() = Some(text.to_owned());
        Ok(())
    }
}

struct Talk {
    service: Parameters,
    memory: Memory,
    out: Outbox,
    now: Instant,
    at_rest: bool,
}

impl Talk {
    fn new() -> Self {
        Self::with(Memory::default())
    }

    fn with(memory: Memory) -> Self {
        let keeper = Some(Box::new(memory.clone()) as Box<dyn Keeper>);
        let service = Parameters::new(&Params::default(), BTreeMap::new(), keeper);
        Self { service, memory, out: Outbox::default(), now: at(0.0), at_rest: true }
    }

    /// What is sent, with the core's answers to what is asked.
    fn drain(&mut self) -> Vec<MavMessage> {
        while let Some((id, request)) = self.out.poll_request() {
            let CoreRequest::SetParameter { key, value } = request else { panic!("{request:?}") };
            let row = params::row(&key).unwrap();
            assert_eq!(row.check(&value), Ok(value), "only what is allowed is asked for");
            let answer = if row.change == Change::AtRest && !self.at_rest {
                Err(Refusal::failed("the car moves"))
            } else {
                Ok(())
            };
            assert!(self.service.handle_reply(self.now, id, &answer, &mut self.out));
        }
        station(&mut self.out)
    }

    fn hear(&mut self, message: &MavMessage) -> Vec<MavMessage> {
        self.service.handle(self.now, STATION, message, &mut self.out);
        self.drain()
    }

    fn set(&mut self, id: &str, kind: MavParamType, raw: f32) -> Vec<MavMessage> {
        self.now = self.now.offset_by(2.0);
        self.hear(&set(id, kind, raw))
    }

    fn value(&self, key: &str) -> Value {
        let at = self.service.entries.iter().position(|entry| entry.key == key).unwrap();
        self.service.value(at)
    }
}

const REAL: MavParamType = MavParamType::MAV_PARAM_TYPE_REAL32;
const INT: MavParamType = MavParamType::MAV_PARAM_TYPE_INT32;

fn set(id: &str, param_type: MavParamType, param_value: f32) -> MavMessage {
    MavMessage::PARAM_SET(c::PARAM_SET_DATA {
        param_value,
        target_system: 1,
        target_component: 1,
        param_id: CharArray::from(id),
        param_type,
    })
}

fn read(id: &str, param_index: i16) -> MavMessage {
    MavMessage::PARAM_REQUEST_READ(c::PARAM_REQUEST_READ_DATA {
        param_index,
        target_system: 1,
        target_component: 1,
        param_id: CharArray::from(id),
    })
}

fn list() -> MavMessage {
    MavMessage::PARAM_REQUEST_LIST(c::PARAM_REQUEST_LIST_DATA {
        target_system: 1,
        target_component: 1,
    })
}

fn whole(v: i32) -> f32 {
    f32::from_bits(v.cast_unsigned())
}

fn values(sent: &[MavMessage]) -> Vec<(String, f32)> {
    let value = |message: &MavMessage| match message {
        MavMessage::PARAM_VALUE(data) => {
            let id = data.param_id.to_str().unwrap().trim_end_matches('\0').to_owned();
            Some((id, data.param_value))
        }
        _ => None,
    };
    sent.iter().filter_map(value).collect()
}

fn errors(sent: &[MavMessage]) -> Vec<MavParamError> {
    let error = |message: &MavMessage| match message {
        MavMessage::PARAM_ERROR(data) => Some(data.error),
        _ => None,
    };
    sent.iter().filter_map(error).collect()
}

fn texts(sent: &[MavMessage]) -> String {
    let text = |message: &MavMessage| match message {
        MavMessage::STATUSTEXT(data) => {
            Some(data.text.to_str().unwrap().trim_end_matches('\0').to_owned())
        }
        _ => None,
    };
    sent.iter().filter_map(text).collect()
}

#[test]
fn a_value_is_read_by_name_and_by_number() {
    let mut talk = Talk::new();
    let by_name = talk.hear(&read("SPD_SPEED_MAX", -1));
    assert_eq!(values(&by_name), [("SPD_SPEED_MAX".to_owned(), 4.0)]);
    let MavMessage::PARAM_VALUE(data) = &by_name[0] else { panic!("a value") };
    assert_eq!(usize::from(data.param_count), params::ids().len());
    assert_eq!(talk.hear(&read("", data.param_index as i16)), by_name);
    let integer = talk.hear(&read("SMO_PASSES", -1));
    let MavMessage::PARAM_VALUE(data) = &integer[0] else { panic!("a value") };
    let passes = i64::from(Params::default().smooth.passes);
    assert_eq!((data.param_type, i64::from(data.param_value.to_bits())), (INT, passes));
    for unknown in [read("NO_SUCH_THING", -1), read("", 9999), read("SPD_SPEED_MA", -1)] {
        let sent = talk.hear(&unknown);
        assert_eq!(errors(&sent), [MavParamError::MAV_PARAM_ERROR_DOES_NOT_EXIST]);
    }
}

#[test]
fn what_is_set_is_in_force_answered_to_all_and_kept() {
    let mut talk = Talk::new();
    let sent = talk.set("SPD_SPEED_MAX", REAL, 2.3);
    assert_eq!(values(&sent), [("SPD_SPEED_MAX".to_owned(), 2.3)]);
    assert_eq!(talk.value("speed.speed_max_mps"), Value::Real(2.3), "the decimal number");
    let sent = talk.set("PLAN_POLICY", INT, whole(1));
    assert_eq!(values(&sent).len(), 1);
    assert_eq!(talk.value("plan.policy"), Value::Text("frontier".into()));
    let text = talk.memory.0.lock().unwrap().clone().unwrap();
    let mut layers = crate::params::Layers::new();
    let (kept, faults) = layers.kept(KEPT, &text);
    assert!(faults.0.is_empty());
    assert_eq!(kept.len(), 2);
    let params = layers.build().unwrap();
    assert_eq!(params.speed.speed_max_mps, 2.3);
    assert_eq!(params.plan.policy.name(), "frontier");
}

#[test]
fn what_is_refused_is_answered_with_the_value_that_stays_and_a_reason() {
    let mut talk = Talk::new();
    let speed = "SPD_SPEED_MAX";
    for (id, kind, raw, error, reason, stays) in [
        (speed, REAL, 99.0, 2, "allowed is 0.1 to 20", Some(4.0)),
        (speed, REAL, -1.0, 2, "allowed is", Some(4.0)),
        (speed, REAL, f32::NAN, 2, "must be a number", Some(4.0)),
        (speed, REAL, f32::INFINITY, 2, "must be a number", Some(4.0)),
        (speed, INT, whole(2), 7, "is a REAL32, not a INT32", Some(4.0)),
        ("SMO_PASSES", REAL, 2.0, 7, "is a INT32, not a REAL32", None),
        ("SMO_PASSES", INT, whole(-3), 2, "allowed is", None),
        ("PLAN_POLICY", INT, whole(77), 2, "must be one of", None),
        ("NO_SUCH_THING", REAL, 1.0, 1, "is not known", None),
    ] {
        let before = talk.service.values.clone();
        let sent = talk.set(id, kind, raw);
        assert_eq!(errors(&sent).iter().map(|e| *e as u8).collect::<Vec<_>>(), [error], "{id}");
        assert!(texts(&sent).contains(reason), "{id}: {}", texts(&sent));
        if let Some(stays) = stays {
            assert_eq!(values(&sent), [(id.to_owned(), stays)]);
        }
        assert_eq!(talk.service.values, before);
    }
    assert_eq!(*talk.memory.0.lock().unwrap(), None, "nothing is kept");
}

#[test]
fn a_value_of_a_type_that_does_not_exist_is_answered_if_it_was_meant_for_this_car() {
    let mut talk = Talk::new();
    let mut raw = |system: u8, component: u8| {
        let mut payload = vec![0; 23];
        payload[..4].copy_from_slice(&2.0_f32.to_le_bytes());
        (payload[4], payload[5]) = (system, component);
        payload[6..19].copy_from_slice(b"SPD_SPEED_MAX");
        payload[22] = 99;
        let raw = RawBody { id: c::PARAM_SET_DATA::ID, payload };
        talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
        talk.drain()
    };
    for (system, component) in [(2, 1), (1, 100), (255, 0)] {
        assert_eq!(raw(system, component).len(), 0, "for {system}/{component}");
    }
    for (system, component) in [(1, 1), (0, 0), (1, 0)] {
        assert_eq!(values(&raw(system, component)), [("SPD_SPEED_MAX".to_owned(), 4.0)]);
    }
}

#[test]
fn each_value_waits_for_its_time() {
    let mut talk = Talk::new();
    talk.at_rest = false;
    let sent = talk.set("VEH_FRICTION", REAL, 0.5);
    assert_eq!(values(&sent), [("VEH_FRICTION".to_owned(), 0.9)]);
    assert!(texts(&sent).contains("not set: the car moves"), "{}", texts(&sent));
    talk.at_rest = true;
    assert_eq!(values(&talk.set("VEH_FRICTION", REAL, 0.5))[0].1, 0.5);
    let sent = talk.set("VEH_MASS", REAL, 3.0);
    assert_eq!(values(&sent), [("VEH_MASS".to_owned(), 3.0)]);
    assert!(texts(&sent).contains("takes effect at the next start"));
    assert_eq!(talk.service.values.vehicle.mass_kg, 2.5, "not before");
    assert!(talk.memory.0.lock().unwrap().clone().unwrap().contains("mass_kg = 3.0"));
    // Back again: nothing waits any more.
    assert_eq!(values(&talk.set("VEH_MASS", REAL, 2.5))[0].1, 2.5);
    assert!(talk.service.waiting.is_empty());
}

#[test]
fn a_full_disk_is_told() {
    let mut talk = Talk::with(Memory(Arc::default(), true));
    let sent = talk.set("SPD_SPEED_MAX", REAL, 2.0);
    assert_eq!(values(&sent), [("SPD_SPEED_MAX".to_owned(), 2.0)], "it is in force all the same");
    assert!(texts(&sent).contains("but the disk is full"), "{}", texts(&sent));
    let sent = talk.set("VEH_MASS", REAL, 3.0);
    assert_eq!(values(&sent), [("VEH_MASS".to_owned(), 2.5)]);
    assert!(texts(&sent).contains("the disk is full"), "{}", texts(&sent));
}

#[test]
fn a_core_that_does_not_answer_leaves_the_old_value() {
    let mut talk = Talk::new();
    talk.service.handle(talk.now, STATION, &set("SPD_SPEED_MAX", REAL, 2.0), &mut talk.out);
    assert!(talk.out.poll_request().is_some());
    assert_eq!(talk.service.poll_at(), Some(talk.now + SILENCE));
    talk.service.handle_time(talk.now.offset_by(1.1), &mut talk.out);
    let sent = station(&mut talk.out);
    assert_eq!(values(&sent), [("SPD_SPEED_MAX".to_owned(), 4.0)]);
    assert!(texts(&sent).contains("does not answer"));
}

#[test]
fn storage_forgets_on_request() {
    let mut talk = Talk::new();
    talk.set("SPD_SPEED_MAX", REAL, 2.0);
    let storage = |action: f32| Wanted {
        command: MavCmd::MAV_CMD_PREFLIGHT_STORAGE,
        params: [action, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        place: None,
        confirmation: 0,
    };
    let now = talk.now;
    let mut order = |action| talk.service.handle_command(now, &storage(action), &mut talk.out);
    assert_eq!(order(1.0), Some(Ok(Step::Done)));
    assert!(order(3.0).unwrap().is_err() && order(f32::NAN).unwrap().is_err());
    assert_eq!(order(2.0), Some(Ok(Step::Done)));
    assert!(!talk.memory.0.lock().unwrap().clone().unwrap().contains("speed"));
}

#[test]
fn a_list_leaves_gaps_on_a_slow_link() {
    let mut talk = Talk::new();
    talk.out.note_rate(STATION.channel, Some(5760.0));
    talk.service.handle(talk.now, STATION, &list(), &mut talk.out);
    let mut received = 0;
    let mut seconds = 0.0;
    while received < params::ids().len() {
        seconds += 0.02;
        assert!(seconds < 10.0);
        talk.service.handle_time(talk.now.offset_by(seconds), &mut talk.out);
        received += station(&mut talk.out).len();
        let bytes = received as f64 * VALUE_BYTES;
        assert!(bytes <= 0.5 * 5760.0 * (seconds + 0.2) + 2.0 * VALUE_BYTES, "{bytes} {seconds}");
    }
    assert!(talk.service.lists.is_empty() && talk.service.poll_at().is_none());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    /// As ground stations do: the whole list, then whatever is missing by its number.
    #[test]
    fn a_list_comes_whole_over_a_link_that_loses_repeats_and_mixes(seed in any::<u64>()) {
        let mut talk = Talk::new();
        let mut link = Lossy::new(seed);
        let count = params::ids().len();
        let mut got: BTreeMap<u16, String> = BTreeMap::new();
        let mut next_ask = 0.0;
        let mut step = 0;
        while got.len() < count {
            let seconds = f64::from(step) * 0.02;
            step += 1;
            prop_assert!(seconds < 60.0, "{} of {count} after {seconds} s", got.len());
            talk.now = at(seconds);
            if seconds >= next_ask {
                next_ask = seconds + 1.0;
                if got.is_empty() {
                    link.up(list());
                } else {
                    let missing = (0..count as u16).filter(|i| !got.contains_key(i));
                    missing.take(20).for_each(|i| link.up(read("", i as i16)));
                }
            }
            for message in link.arrived_up() {
                talk.service.handle(talk.now, STATION, &message, &mut talk.out);
            }
            talk.service.handle_time(talk.now, &mut talk.out);
            talk.drain().into_iter().for_each(|message| link.down(message));
            for message in link.arrived_down() {
                if let MavMessage::PARAM_VALUE(data) = message {
                    let id = data.param_id.to_str().unwrap().trim_end_matches('\0').to_owned();
                    got.insert(data.param_index, id);
                }
            }
        }
        let wanted: Vec<String> = params::ids().into_iter().map(|(id, _)| id).collect();
        prop_assert_eq!(got.into_values().collect::<Vec<_>>(), wanted);
    }

    /// Whatever comes: nothing panics, nothing but an allowed value is asked for (see `drain`), and
    /// what is remembered stays bounded.
    #[test]
    fn nonsense_changes_nothing(
        messages in prop::collection::vec(
            (any::<[u8; 16]>(), any::<u32>(), any::<i16>(), 1u8..=10, 0u8..4),
            1..200,
        ),
    ) {
        let mut talk = Talk::new();
        for (name, bits, index, kind, which) in messages {
            let param_id = CharArray::from(name);
            let message = match which {
                0 => list(),
                1 => MavMessage::PARAM_REQUEST_READ(c::PARAM_REQUEST_READ_DATA {
                    param_index: index, target_system: 1, target_component: 1, param_id,
                }),
                _ => set("SPD_SPEED_MAX", if kind < 5 { REAL } else { INT }, f32::from_bits(bits)),
            };
            let before = talk.value("speed.speed_max_mps");
            talk.hear(&message);
            let after = talk.value("speed.speed_max_mps");
            if before != after {
                let Value::Real(speed) = after else { panic!("a speed") };
                prop_assert!((0.1..=20.0).contains(&speed));
            }
            let mut raw = name.to_vec();
            raw.extend(bits.to_le_bytes());
            talk.service.handle_raw(
                talk.now, STATION, &RawBody { id: c::PARAM_SET_DATA::ID, payload: raw }, &mut talk.out,
            );
            talk.drain();
            prop_assert!(talk.service.lists.len() <= 1 && talk.service.pending.is_empty());
        }
    }
}
