//! The parameter protocol: every number of the one table, for ground stations to read and set.
//!
//! Real numbers go as `FLOAT`, everything else as `INT32` (bytewise): truth values as 0 and 1,
//! choices by their place in the list. Texts do not fit and are not shown. What is set is kept over
//! a restart; it ranks above the configuration file and below the command line.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::core::{CoreRequest, Refusal};
use super::outbox::{ChannelId, Outbox, Peer, RequestId, To};
use super::service::{Keeper, Service};
use super::wanted::{Denial, Step, Wanted};
use crate::params::{self, Params, kept_text};
use crate::time::{Duration, Instant};
use crate::tunable::{Allowed, Change, Tunable, Value};
use crate::wire::mavlink::CharArray;
use crate::wire::mavlink::MessageData;
use crate::wire::mavlink::RawBody;
use crate::wire::mavlink::common::{
    self as c, MavCmd, MavMessage, MavParamError, MavParamType, MavProtocolCapability, MavSeverity,
};

/// What the kept values are kept under.
pub const KEPT: &str = "parameters.toml";
/// Bytes of one value on the wire.
const VALUE_BYTES: f64 = 37.0;
/// Room that a list leaves in the queue of messages.
const ROOM_LEFT: usize = 256;
/// Time between two looks at lists under way.
const TICK: Duration = Duration::from_millis(20);
/// Settings that wait for the core.
const PENDING_MAX: usize = 32;
/// The core answers within a control period; this long means that it will not.
const SILENCE: Duration = Duration::from_secs(1);
/// Lists under way.
const LISTS_MAX: usize = super::CHANNELS_MAX;
/// The same words are not said again sooner than this.
const ECHO: Duration = Duration::from_secs(1);

/// One parameter as ground stations know it.
struct Entry {
    id: String,
    key: String,
    row: Tunable,
}

/// A list on its way to a channel.
struct List {
    channel: ChannelId,
    next: usize,
    /// Values that may be sent now; grows with time.
    credit: f64,
    filled: Instant,
}

/// A setting that the core has been asked for.
struct Pending {
    id: RequestId,
    index: usize,
    value: Value,
    since: Instant,
    from: Peer,
}

/// The parameter service.
pub struct Parameters {
    entries: Vec<Entry>,
    by_id: BTreeMap<String, usize>,
    values: Params,
    /// The newest set in force that was taken over.
    seen: Option<Arc<Params>>,
    /// Values that wait for the next start, by index.
    waiting: BTreeMap<usize, Value>,
    kept: BTreeMap<String, Value>,
    keeper: Option<Box<dyn Keeper>>,
    lists: Vec<List>,
    pending: VecDeque<Pending>,
    said: Option<(Instant, String)>,
}

impl Parameters {
    /// All parameters with their values in force; `kept` is what the keeper has kept before.
    pub fn new(
        values: &Params,
        kept: BTreeMap<String, Value>,
        keeper: Option<Box<dyn Keeper>>,
    ) -> Self {
        let entries: Vec<Entry> = params::ids()
            .into_iter()
            .filter_map(|(id, key)| Some(Entry { row: params::row(&key)?, id, key }))
            .collect();
        let by_id = entries.iter().enumerate().map(|(i, entry)| (entry.id.clone(), i)).collect();
        Self {
            entries,
            by_id,
            values: values.clone(),
            seen: None,
            waiting: BTreeMap::new(),
            kept,
            keeper,
            lists: Vec::new(),
            pending: VecDeque::new(),
            said: None,
        }
    }

    /// The value that is shown: what waits for the next start, or what is in force.
    fn value(&self, index: usize) -> Value {
        let entry = &self.entries[index];
        let in_force = || self.values.get(&entry.key).unwrap_or_else(|| entry.row.default.clone());
        self.waiting.get(&index).cloned().unwrap_or_else(in_force)
    }

    fn value_message(&self, index: usize) -> MavMessage {
        let entry = &self.entries[index];
        MavMessage::PARAM_VALUE(c::PARAM_VALUE_DATA {
            param_value: encode(&entry.row, &self.value(index)),
            param_count: self.entries.len() as u16,
            param_index: index as u16,
            param_id: CharArray::from(entry.id.as_str()),
            param_type: type_of(&entry.row),
        })
    }

    fn read(&self, from: Peer, data: &c::PARAM_REQUEST_READ_DATA, out: &mut Outbox) {
        let index = match usize::try_from(data.param_index) {
            Ok(index) => Some(index).filter(|index| *index < self.entries.len()),
            Err(_) => self.index_of(&data.param_id),
        };
        match index {
            Some(index) => out.send(from, self.value_message(index)),
            None => {
                let fault = MavParamError::MAV_PARAM_ERROR_DOES_NOT_EXIST;
                send_error(from, data.param_id, data.param_index, fault, out);
            }
        }
    }

    fn index_of(&self, id: &CharArray<16>) -> Option<usize> {
        let id = id.to_str().ok()?;
        self.by_id.get(id.trim_end_matches('\0')).copied()
    }

    fn begin_list(&mut self, now: Instant, from: Peer) {
        self.lists.retain(|list| list.channel != from.channel);
        if self.lists.len() < LISTS_MAX {
            let channel = from.channel;
            self.lists.push(List { channel, next: 0, credit: 1.0, filled: now });
        }
    }

    fn set(&mut self, now: Instant, from: Peer, data: &c::PARAM_SET_DATA, out: &mut Outbox) {
        let Some(index) = self.index_of(&data.param_id) else {
            let name = data.param_id.to_str().unwrap_or("").trim_end_matches('\0').to_owned();
            let fault = MavParamError::MAV_PARAM_ERROR_DOES_NOT_EXIST;
            self.say(now, format!("Parameter {name:?} is not known"), out);
            send_error(from, data.param_id, -1, fault, out);
            return;
        };
        let entry = &self.entries[index];
        if data.param_type != type_of(&entry.row) {
            let (given, wanted) = (data.param_type, type_of(&entry.row));
            let fault = MavParamError::MAV_PARAM_ERROR_TYPE_MISMATCH;
            let why = format!("is a {}, not a {}", type_name(wanted), type_name(given));
            return self.refuse(now, from, index, fault, &why, out);
        }
        let value = match decode(&entry.row, data.param_value)
            .ok_or_else(|| "must be a number".to_owned())
            .and_then(|value| entry.row.check(&value).map_err(|error| error.to_string()))
        {
            Ok(value) => value,
            Err(why) => {
                let fault = MavParamError::MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE;
                return self.refuse(now, from, index, fault, &why, out);
            }
        };
        if value == self.value(index) {
            out.send(To::Everyone, self.value_message(index));
            return;
        }
        if entry.row.change == Change::Restart {
            return self.set_at_next_start(now, from, index, value, out);
        }
        let request = CoreRequest::SetParameter { key: entry.key.clone(), value: value.clone() };
        let asked = (self.pending.len() < PENDING_MAX).then(|| out.request(request)).flatten();
        match asked {
            Some(id) => {
                self.pending.push_back(Pending { id, index, value, since: now, from });
            }
            None => {
                let fault = MavParamError::MAV_PARAM_ERROR_PERMISSION_DENIED;
                self.refuse(now, from, index, fault, "cannot be set now: too much at once", out);
            }
        }
    }

    fn set_at_next_start(
        &mut self,
        now: Instant,
        from: Peer,
        index: usize,
        value: Value,
        out: &mut Outbox,
    ) {
        match self.keep(index, &value) {
            Ok(()) => {
                let in_force = self.values.get(&self.entries[index].key);
                if in_force.as_ref() == Some(&value) {
                    self.waiting.remove(&index);
                } else {
                    self.waiting.insert(index, value);
                    let text = format!("{} takes effect at the next start", self.entries[index].id);
                    out.say(MavSeverity::MAV_SEVERITY_NOTICE, &text);
                }
                out.send(To::Everyone, self.value_message(index));
            }
            Err(why) => {
                let fault = MavParamError::MAV_PARAM_ERROR_PERMISSION_DENIED;
                let why = format!("takes effect only at the next start, but {why}");
                self.refuse(now, from, index, fault, &why, out);
            }
        }
    }

    /// Keeps a value over a restart.
    fn keep(&mut self, index: usize, value: &Value) -> Result<(), String> {
        let Some(keeper) = &mut self.keeper else {
            return Err("nothing is kept: there is no state directory".into());
        };
        let key = self.entries[index].key.clone();
        let before = self.kept.insert(key.clone(), value.clone());
        keeper.keep(KEPT, &kept_text(&self.kept)).inspect_err(|_| {
            match before {
                Some(before) => self.kept.insert(key, before),
                None => self.kept.remove(&key),
            };
        })
    }

    /// Says why a value stays, and which it is.
    fn refuse(
        &mut self,
        now: Instant,
        from: Peer,
        index: usize,
        fault: MavParamError,
        why: &str,
        out: &mut Outbox,
    ) {
        let id = self.entries[index].id.clone();
        out.send(To::Everyone, self.value_message(index));
        send_error(from, CharArray::from(id.as_str()), index as i16, fault, out);
        self.say(now, format!("{id} {why}"), out);
    }

    fn say(&mut self, now: Instant, text: String, out: &mut Outbox) {
        let echo = |(at, said): &(Instant, String)| now.since(*at) < ECHO && *said == text;
        if !self.said.as_ref().is_some_and(echo) && out.room() > ROOM_LEFT {
            out.say(MavSeverity::MAV_SEVERITY_WARNING, &text);
            self.said = Some((now, text));
        }
    }

    /// All that was kept is forgotten.
    fn reset(&mut self) -> Result<Step, Denial> {
        let Some(keeper) = &mut self.keeper else {
            return Err(Denial::failed("nothing is kept: there is no state directory"));
        };
        keeper.keep(KEPT, &kept_text(&BTreeMap::new())).map_err(Denial::failed)?;
        self.kept.clear();
        self.waiting.clear();
        Ok(Step::Done)
    }
}

impl Service for Parameters {
    fn handle(&mut self, now: Instant, from: Peer, message: &MavMessage, out: &mut Outbox) {
        match message {
            MavMessage::PARAM_REQUEST_LIST(_) => self.begin_list(now, from),
            MavMessage::PARAM_REQUEST_READ(data) => self.read(from, data, out),
            MavMessage::PARAM_SET(data) => self.set(now, from, data, out),
            _ => {}
        }
    }

    fn handle_raw(&mut self, now: Instant, from: Peer, raw: &RawBody, out: &mut Outbox) {
        let [system, component] = raw.bytes(4);
        let ours = (system == 0 || u32::from(system) == self.values.mavlink.system_id)
            && (component == 0 || component == super::COMPONENT);
        if !ours {
            return;
        }
        // A value of a type that does not exist: the present one is the answer.
        let name: [u8; 16] = raw.bytes(6);
        let id = CharArray::from(name);
        if raw.id == c::PARAM_SET_DATA::ID
            && let Some(index) = self.index_of(&id)
        {
            let fault = MavParamError::MAV_PARAM_ERROR_TYPE_UNSUPPORTED;
            self.refuse(now, from, index, fault, "has no such type", out);
        }
    }

    fn handle_command(
        &mut self,
        _now: Instant,
        wanted: &Wanted,
        out: &mut Outbox,
    ) -> Option<Result<Step, Denial>> {
        if wanted.command != MavCmd::MAV_CMD_PREFLIGHT_STORAGE {
            return None;
        }
        Some(wanted.whole(1, 4).and_then(|action| match action {
            // Everything is kept as soon as it is set.
            0 | 1 => Ok(Step::Done),
            2 | 4 => {
                let done = self.reset()?;
                let text = "Parameters are as configured again at the next start";
                out.say(MavSeverity::MAV_SEVERITY_NOTICE, text);
                Ok(done)
            }
            other => Err(Denial::denied(format!("action {other} on parameters is not known"))),
        }))
    }

    fn handle_params(&mut self, params: &Arc<Params>) {
        if !self.seen.as_ref().is_some_and(|seen| Arc::ptr_eq(seen, params)) {
            self.values = Params::clone(params);
            self.seen = Some(Arc::clone(params));
        }
    }

    fn handle_reply(
        &mut self,
        now: Instant,
        id: RequestId,
        result: &Result<(), Refusal>,
        out: &mut Outbox,
    ) -> bool {
        let Some(at) = self.pending.iter().position(|pending| pending.id == id) else {
            return false;
        };
        let Some(pending) = self.pending.remove(at) else { return true };
        let Pending { index, value, from, .. } = pending;
        match result {
            Ok(()) => {
                let set = self.values.set(&self.entries[index].key, &value);
                debug_assert!(set.is_ok(), "the value was checked");
                if let Err(why) = self.keep(index, &value) {
                    self.say(now, format!("{} is set, but {why}", self.entries[index].id), out);
                }
                out.send(To::Everyone, self.value_message(index));
            }
            Err(refusal) => {
                let fault = MavParamError::MAV_PARAM_ERROR_PERMISSION_DENIED;
                self.refuse(now, from, index, fault, &format!("not set: {}", refusal.reason), out);
            }
        }
        true
    }

    fn handle_time(&mut self, now: Instant, out: &mut Outbox) {
        while self.pending.front().is_some_and(|pending| now.since(pending.since) >= SILENCE) {
            let Some(Pending { index, from, .. }) = self.pending.pop_front() else { break };
            let fault = MavParamError::MAV_PARAM_ERROR_PERMISSION_DENIED;
            self.refuse(now, from, index, fault, "not set: the autopilot does not answer", out);
        }
        let mut lists = std::mem::take(&mut self.lists);
        for list in &mut lists {
            let rate = out.transfer_rate(list.channel) / VALUE_BYTES;
            list.credit += now.seconds_after(list.filled).max(0.0) * rate;
            // What was not sent in time is not sent all at once later.
            list.credit = list.credit.min((rate * 0.1).max(1.0));
            list.filled = now;
            while list.credit >= 1.0 && list.next < self.entries.len() && out.room() > ROOM_LEFT {
                out.send(To::Channel(list.channel), self.value_message(list.next));
                list.next += 1;
                list.credit -= 1.0;
            }
        }
        lists.retain(|list| list.next < self.entries.len());
        self.lists = lists;
    }

    fn poll_at(&self) -> Option<Instant> {
        let lists = self.lists.iter().map(|list| list.filled + TICK);
        let pending = self.pending.iter().map(|pending| pending.since + SILENCE);
        lists.chain(pending).min()
    }

    fn capabilities(&self) -> MavProtocolCapability {
        MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    }
}

fn send_error(
    to: Peer,
    param_id: CharArray<16>,
    param_index: i16,
    error: MavParamError,
    out: &mut Outbox,
) {
    let data = c::PARAM_ERROR_DATA {
        param_index,
        target_system: to.system,
        target_component: to.component,
        param_id,
        error,
    };
    out.send(to, MavMessage::PARAM_ERROR(data));
}

/// How a parameter's value is written.
pub(super) const fn type_of(row: &Tunable) -> MavParamType {
    match row.allowed {
        Allowed::Real(..) => MavParamType::MAV_PARAM_TYPE_REAL32,
        _ => MavParamType::MAV_PARAM_TYPE_INT32,
    }
}

fn type_name(kind: MavParamType) -> String {
    let name = format!("{kind:?}");
    name.strip_prefix("MAV_PARAM_TYPE_").map_or(name.clone(), str::to_owned)
}

/// A value as the message has it.
fn encode(row: &Tunable, value: &Value) -> f32 {
    let whole = |v: i64| f32::from_bits((v as i32).cast_unsigned());
    match (row.allowed, value) {
        (_, Value::Real(v)) => *v as f32,
        (_, Value::Integer(v)) => whole(*v),
        (_, Value::Bool(v)) => whole(i64::from(*v)),
        (Allowed::Choice(names), Value::Text(v)) => {
            whole(names.iter().position(|name| name == v).map_or(-1, |at| at as i64))
        }
        (_, Value::Text(_)) => whole(0),
    }
}

/// A value from the message; `None` if it is none that the parameter could have.
fn decode(row: &Tunable, raw: f32) -> Option<Value> {
    let whole = i64::from(raw.to_bits().cast_signed());
    match row.allowed {
        Allowed::Real(..) => {
            // The decimal number that was meant, not its nearest neighbour in single precision.
            raw.is_finite().then(|| format!("{raw}").parse().ok().map(Value::Real)).flatten()
        }
        Allowed::Integer(..) => Some(Value::Integer(whole)),
        Allowed::Bool => match whole {
            0 => Some(Value::Bool(false)),
            1 => Some(Value::Bool(true)),
            // Refused by the row, which says what is allowed.
            other => Some(Value::Integer(other)),
        },
        Allowed::Choice(names) => {
            let name = usize::try_from(whole).ok().and_then(|at| names.get(at));
            Some(name.map_or(Value::Integer(whole), |name| Value::Text((*name).to_owned())))
        }
        Allowed::Text => None,
    }
}

#[cfg(test)]
mod tests;
