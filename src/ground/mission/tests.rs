//! Missions and fences in conversation with a ground station, over a link that loses some of it.

use std::collections::BTreeMap;
use std::sync::Mutex;

use proptest::prelude::*;

use super::*;
use crate::frames::{Point, Pose};
use crate::ground::lossy::{Lossy, STATION, at, station};
use crate::ground::mission_items::text_of;
use crate::ground::{CoreCounts, CoreFault, FaultAction, Fresh, RefusalKind};
use crate::wire::mavlink::Geodetic;
use crate::wire::mavlink::common::{MavFrame, MavResult};

#[derive(Clone, Default)]
struct Memory(Arc<Mutex<BTreeMap<String, String>>>);

impl Keeper for Memory {
    fn keep(&mut self, name: &str, text: &str) -> Result<(), String> {
        self.0.lock().unwrap().insert(name.to_owned(), text.to_owned());
        Ok(())
    }
}

struct Talk {
    service: Mission,
    memory: Memory,
    out: Outbox,
    now: Instant,
    mode: Mode,
    refusal: Option<Refusal>,
    asked: Vec<CoreRequest>,
}

fn view(now: Instant) -> CoreView {
    CoreView {
        at: now,
        mode: CoreMode::Standby,
        pose: Some(Pose::new(0.0, 0.0, 0.0)),
        speed_mps: 0.0,
        yaw_rate_rps: 0.0,
        start: Pose::new(0.0, 0.0, 0.0),
        goal: None,
        faults: Vec::new(),
        not_ready: Vec::new(),
        target: None,
        plan: Vec::new(),
        cross_track_m: 0.0,
        scan: None,
        battery_v: None,
        fresh: Fresh::default(),
        load: 0.0,
        counts: CoreCounts::default(),
        speed_max_mps: 4.0,
    }
}

impl Talk {
    fn new() -> Self {
        let memory = Memory::default();
        let service = Mission::new(1, Some(Box::new(memory.clone())), |_| None);
        let mut talk = Self {
            service,
            memory,
            out: Outbox::default(),
            now: at(0.0),
            mode: Mode::Hold,
            refusal: None,
            asked: Vec::new(),
        };
        talk.look();
        talk
    }

    fn look(&mut self) -> Vec<MavMessage> {
        let mut view = view(self.now);
        view.mode = if self.mode == Mode::Auto { CoreMode::Drive } else { CoreMode::Standby };
        self.service.handle_core(self.now, &view, self.mode, &mut self.out);
        self.drain()
    }

    /// What is sent, with the core's answers to what is asked.
    fn drain(&mut self) -> Vec<MavMessage> {
        while let Some((id, request)) = self.out.poll_request() {
            self.asked.push(request);
            let answer = self.refusal.clone().map_or(Ok(()), Err);
            self.service.handle_reply(self.now, id, &answer, &mut self.out);
        }
        if let Some(mode) = self.service.poll_mode() {
            self.mode = mode;
        }
        station(&mut self.out)
    }

    fn hear(&mut self, message: &MavMessage) -> Vec<MavMessage> {
        self.service.handle(self.now, STATION, message, &mut self.out);
        self.drain()
    }

    /// Uploads a list; the last answer.
    fn upload(&mut self, kind: Kind, items: &[Item]) -> Code {
        let mut sent = self.hear(&count(kind, items.len() as u16));
        loop {
            if let Some(code) = ack(&sent) {
                return code;
            }
            let seq = request(&sent).expect("an item is asked for");
            sent = self.hear(&item_message(items[usize::from(seq)], seq, kind));
        }
    }

    fn start(&mut self, first: f32) -> Result<(), Denial> {
        self.start_to(first, 0.0)
    }

    fn start_to(&mut self, first: f32, last: f32) -> Result<(), Denial> {
        let wanted = Wanted {
            command: MavCmd::MAV_CMD_MISSION_START,
            params: [first, last, 0.0, 0.0, 0.0, 0.0, 0.0],
            place: None,
            confirmation: 0,
        };
        match self.service.handle_command(self.now, &wanted, &mut self.out).unwrap()? {
            Step::Ask(requests, Some(mode)) => {
                self.asked.extend(requests);
                self.mode = mode;
                self.look();
                Ok(())
            }
            other => panic!("{other:?}"),
        }
    }

    fn arrive(&mut self) -> Vec<MavMessage> {
        let position = self.service.run.goal().unwrap();
        self.event(&CoreEvent::GoalReached { position })
    }

    fn event(&mut self, event: &CoreEvent) -> Vec<MavMessage> {
        let mode = self.mode;
        self.service.handle_event(self.now, event, mode, &mut self.out);
        self.drain()
    }

    fn goals(&mut self) -> Vec<f64> {
        let goal = |request: CoreRequest| match request {
            CoreRequest::Goto { point, .. } => Some(point.x),
            _ => None,
        };
        std::mem::take(&mut self.asked).into_iter().filter_map(goal).collect()
    }
}

fn goal(x: i32) -> Item {
    Item {
        command: MavCmd::MAV_CMD_NAV_WAYPOINT,
        frame: MavFrame::MAV_FRAME_LOCAL_ENU,
        params: [0.0; 4],
        x: x * 10_000,
        y: 0,
        z: 0.0,
        goes_on: true,
    }
}

fn corner(x: i32, y: i32) -> Item {
    Item {
        command: MavCmd::MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION,
        params: [4.0, 0.0, 0.0, 0.0],
        y: y * 10_000,
        ..goal(x)
    }
}

fn square() -> [Item; 4] {
    [corner(1, 1), corner(2, 1), corner(2, 2), corner(1, 2)]
}

fn count(kind: Kind, count: u16) -> MavMessage {
    MavMessage::MISSION_COUNT(c::MISSION_COUNT_DATA {
        count,
        target_system: 1,
        target_component: 1,
        mission_type: kind.number(),
        opaque_id: 0,
    })
}

fn item_message(item: Item, seq: u16, kind: Kind) -> MavMessage {
    let mut data = item.message(seq, kind, false);
    (data.target_system, data.target_component) = (1, 1);
    MavMessage::MISSION_ITEM_INT(data)
}

fn ask_list(kind: MavMissionType) -> MavMessage {
    MavMessage::MISSION_REQUEST_LIST(c::MISSION_REQUEST_LIST_DATA {
        target_system: 1,
        target_component: 1,
        mission_type: kind,
    })
}

fn ask_item(seq: u16, kind: Kind) -> MavMessage {
    MavMessage::MISSION_REQUEST_INT(c::MISSION_REQUEST_INT_DATA {
        seq,
        target_system: 1,
        target_component: 1,
        mission_type: kind.number(),
    })
}

fn clear(kind: MavMissionType) -> MavMessage {
    MavMessage::MISSION_CLEAR_ALL(c::MISSION_CLEAR_ALL_DATA {
        target_system: 1,
        target_component: 1,
        mission_type: kind,
    })
}

fn ack(sent: &[MavMessage]) -> Option<Code> {
    sent.iter().find_map(|message| match message {
        MavMessage::MISSION_ACK(data) => Some(data.mavtype),
        _ => None,
    })
}

fn request(sent: &[MavMessage]) -> Option<u16> {
    sent.iter().find_map(|message| match message {
        MavMessage::MISSION_REQUEST_INT(data) => Some(data.seq),
        _ => None,
    })
}

fn reached(sent: &[MavMessage]) -> Option<u16> {
    sent.iter().find_map(|message| match message {
        MavMessage::MISSION_ITEM_REACHED(data) => Some(data.seq),
        _ => None,
    })
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

const DONE: Code = Code::MAV_MISSION_ACCEPTED;

#[test]
fn a_mission_goes_up_comes_down_is_kept_and_cleared() {
    let mut talk = Talk::new();
    let items = [goal(1), goal(2), goal(3)];
    assert_eq!(talk.upload(Kind::Mission, &items), DONE);
    let sent = talk.hear(&ask_list(MavMissionType::MAV_MISSION_TYPE_MISSION));
    let MavMessage::MISSION_COUNT(data) = &sent[0] else { panic!("a count") };
    assert_eq!((data.count, data.opaque_id), (3, opaque_id(&items)));
    for seq in 0..3 {
        let sent = talk.hear(&ask_item(seq, Kind::Mission));
        let MavMessage::MISSION_ITEM_INT(data) = &sent[0] else { panic!("an item") };
        assert_eq!(Item::of_int(data), items[usize::from(seq)]);
        assert_eq!(data.target_system, STATION.system);
    }
    let sent = talk.hear(&ask_item(3, Kind::Mission));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_INVALID_SEQUENCE));

    let kept = talk.memory.0.lock().unwrap().clone();
    let again = Mission::new(1, None, |name| kept.get(name).cloned());
    assert_eq!(again.goals, items);

    let sent = talk.hear(&clear(MavMissionType::MAV_MISSION_TYPE_ALL));
    assert_eq!(ack(&sent), Some(DONE));
    assert!(talk.service.goals.is_empty());
    assert_eq!(items_of(&talk.memory.0.lock().unwrap()["mission.txt"]), Some(Vec::new()));
    assert_eq!(talk.upload(Kind::Mission, &items), DONE);
    assert_eq!(talk.upload(Kind::Mission, &[]), DONE, "no items: cleared");
    assert!(talk.service.goals.is_empty());
}

#[test]
fn a_list_replaces_the_old_one_only_when_all_of_it_is_there_and_good() {
    let mut talk = Talk::new();
    assert_eq!(talk.upload(Kind::Mission, &[goal(1)]), DONE);
    talk.hear(&count(Kind::Mission, 3));
    talk.hear(&item_message(goal(7), 0, Kind::Mission));
    talk.hear(&item_message(goal(8), 1, Kind::Mission));
    assert_eq!(talk.service.goals, [goal(1)]);
    // What cannot be done ends the upload, with the number of the item in words.
    let takeoff = Item { command: MavCmd::MAV_CMD_NAV_TAKEOFF, ..goal(9) };
    let sent = talk.hear(&item_message(takeoff, 2, Kind::Mission));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    assert!(texts(&sent).contains("item 2: NAV_TAKEOFF"), "{}", texts(&sent));
    assert_eq!(talk.service.goals, [goal(1)]);
    let body = Item { frame: MavFrame::MAV_FRAME_BODY_FRD, ..goal(1) };
    assert_eq!(talk.upload(Kind::Mission, &[body]), Code::MAV_MISSION_UNSUPPORTED_FRAME);
    let global = Item { frame: MavFrame::MAV_FRAME_GLOBAL_INT, ..goal(1) };
    assert_eq!(talk.upload(Kind::Mission, &[global]), Code::MAV_MISSION_UNSUPPORTED_FRAME);
    let place = Geodetic { latitude_deg: 0.0, longitude_deg: 0.0 };
    let origin = Origin { place, altitude_m: 0.0 };
    talk.service.handle_origin(talk.now, &origin, &mut talk.out);
    assert_eq!(talk.upload(Kind::Mission, &[global]), DONE, "now it is known where that is");
    let sent = talk.hear(&count(Kind::Mission, ITEMS_MAX + 1));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_NO_SPACE));
}

#[test]
fn items_out_of_turn_are_asked_for_and_silence_ends_an_upload() {
    let mut talk = Talk::new();
    let sent = talk.hear(&count(Kind::Mission, 3));
    assert_eq!(request(&sent), Some(0));
    assert!(talk.hear(&item_message(goal(2), 1, Kind::Mission)).is_empty(), "too early");
    let sent = talk.hear(&item_message(goal(1), 0, Kind::Mission));
    assert_eq!(request(&sent), Some(1));
    assert!(talk.hear(&item_message(goal(1), 0, Kind::Mission)).is_empty(), "once more");
    let mut asked = 0;
    let end = loop {
        talk.now = talk.now.offset_by(0.05);
        talk.service.handle_time(talk.now, &mut talk.out);
        let sent = talk.drain();
        asked += usize::from(request(&sent) == Some(1));
        if let Some(code) = ack(&sent) {
            break code;
        }
        assert!(talk.now < at(60.0));
    };
    assert_eq!(end, Code::MAV_MISSION_OPERATION_CANCELLED);
    assert!(asked >= 5, "{asked}");
    assert!(talk.service.upload.is_none() && talk.service.goals.is_empty());
}

#[test]
fn another_station_does_not_cut_in() {
    let mut talk = Talk::new();
    talk.hear(&count(Kind::Mission, 2));
    let other = Peer { system: 254, ..STATION };
    talk.service.handle(talk.now, other, &count(Kind::Mission, 1), &mut talk.out);
    assert_eq!(ack(&talk.drain()), Some(Code::MAV_MISSION_DENIED));
    talk.service.handle(talk.now, other, &item_message(goal(9), 0, Kind::Mission), &mut talk.out);
    assert!(talk.drain().is_empty());
    let sent = talk.hear(&item_message(goal(1), 0, Kind::Mission));
    assert_eq!(request(&sent), Some(1));
}

#[test]
fn rally_points_and_pieces_of_lists_are_refused_cleanly() {
    let mut talk = Talk::new();
    let rally = MavMissionType::MAV_MISSION_TYPE_RALLY;
    let sent = talk.hear(&ask_list(rally));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    let sent = talk.hear(&MavMessage::MISSION_COUNT(c::MISSION_COUNT_DATA {
        count: 2,
        target_system: 1,
        target_component: 1,
        mission_type: rally,
        opaque_id: 0,
    }));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    assert_eq!(ack(&talk.hear(&clear(rally))), Some(Code::MAV_MISSION_UNSUPPORTED));
    // A kind that the dialect does not know.
    let raw = RawBody { id: c::MISSION_COUNT_DATA::ID, payload: vec![1, 0, 1, 1, 77] };
    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
    let Some((_, crate::wire::mavlink::Body::Raw(sent))) = talk.out.poll_message() else {
        panic!("an answer")
    };
    assert_eq!(sent.payload, [255, 190, Code::MAV_MISSION_UNSUPPORTED as u8, 77]);
    // An unknown command in an item.
    talk.hear(&count(Kind::Mission, 1));
    let mut payload = vec![0; 38];
    payload[30..34].copy_from_slice(&[0xFF, 0x7F, 1, 1]);
    payload[34] = MavFrame::MAV_FRAME_LOCAL_ENU as u8;
    let raw = RawBody { id: c::MISSION_ITEM_INT_DATA::ID, payload };
    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
    assert_eq!(ack(&talk.drain()), Some(Code::MAV_MISSION_UNSUPPORTED));
}

#[test]
fn goals_are_driven_to_in_turn() {
    let mut talk = Talk::new();
    assert!(talk.start(0.0).is_err(), "there is no mission");
    let speed =
        Item { command: MavCmd::MAV_CMD_DO_CHANGE_SPEED, params: [1.0, 1.5, 0.0, 0.0], ..goal(0) };
    let waits = Item { params: [2.0, 0.0, 0.0, 0.0], ..goal(2) };
    talk.upload(Kind::Mission, &[goal(1), speed, waits, goal(3)]);
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [1.0]);
    assert_eq!(talk.service.current_message().mission_state, MissionState::MISSION_STATE_ACTIVE);
    // The word of an arrival elsewhere is about another goal.
    assert_eq!(
        reached(&talk.event(&CoreEvent::GoalReached { position: Point::new(9.0, 9.0) })),
        None
    );
    assert_eq!(reached(&talk.arrive()), Some(0));
    assert_eq!(talk.asked[0], CoreRequest::SpeedLimit(Some(1.5)));
    assert_eq!(talk.goals(), [2.0]);
    assert_eq!(reached(&talk.arrive()), Some(2));
    assert!(talk.goals().is_empty(), "it waits");
    assert_eq!(talk.service.poll_at().unwrap(), talk.service.next_word);
    talk.now = talk.now.offset_by(1.9);
    talk.service.handle_time(talk.now, &mut talk.out);
    talk.drain();
    assert!(talk.goals().is_empty());
    talk.now = talk.now.offset_by(0.2);
    talk.service.handle_time(talk.now, &mut talk.out);
    talk.drain();
    assert_eq!(talk.goals(), [3.0]);
    let sent = talk.arrive();
    assert_eq!(reached(&sent), Some(3));
    assert!(texts(&sent).contains("Mission complete"));
    assert_eq!((talk.mode, talk.asked.pop()), (Mode::Hold, Some(CoreRequest::Hold)));
    assert_eq!(talk.service.run.state, State::Complete);
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [1.0], "from the beginning again");
}

#[test]
fn a_pause_keeps_the_item_and_a_new_start_goes_on_with_it() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    talk.start(0.0).unwrap();
    talk.arrive();
    talk.mode = Mode::Hold;
    talk.now = talk.now.offset_by(5.0);
    talk.look();
    assert_eq!(talk.service.current_message().mission_state, MissionState::MISSION_STATE_PAUSED);
    talk.mode = Mode::Auto;
    talk.look();
    assert_eq!(talk.service.run.state, State::Driving, "continued");
    talk.mode = Mode::Hold;
    talk.look();
    talk.goals();
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [2.0]);
    assert!(talk.start(3.0).is_err());
    talk.start(2.0).unwrap();
    assert_eq!(talk.goals(), [3.0]);
}

#[test]
fn a_mission_is_started_from_any_item_but_not_to_one_before_its_end() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    for last in [1.0, 0.5, -1.0, f32::INFINITY] {
        let denial = talk.start_to(0.0, last).unwrap_err();
        assert_eq!(denial.result, MavResult::MAV_RESULT_DENIED, "{last}: {}", denial.reason);
        assert!(!talk.service.run.is_going());
    }
    // None is meant by zero, by not-a-number, and by the end.
    for last in [0.0, f32::NAN, 2.0, 7.0] {
        talk.start_to(1.0, last).unwrap();
        assert_eq!(talk.goals(), [2.0], "{last}");
    }
    talk.start_to(f32::NAN, f32::NAN).unwrap();
    assert_eq!(talk.goals(), [2.0], "goes on with the present item");
}

#[test]
fn another_item_can_be_chosen_under_way() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    talk.start(0.0).unwrap();
    talk.goals();
    let choose = |seq| {
        MavMessage::MISSION_SET_CURRENT(c::MISSION_SET_CURRENT_DATA {
            seq,
            target_system: 1,
            target_component: 1,
        })
    };
    let sent = talk.hear(&choose(2));
    assert_eq!(talk.goals(), [3.0]);
    assert!(sent.iter().any(|m| matches!(m, MavMessage::MISSION_CURRENT(data) if data.seq == 2)));
    let sent = talk.hear(&choose(3));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_INVALID_SEQUENCE));
    assert_eq!(talk.service.run.current, 2);
}

#[test]
fn what_cannot_be_reached_or_is_refused_is_told_and_ends_the_drive() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2)]);
    talk.start(0.0).unwrap();
    let fault = CoreFault { name: UNREACHABLE, detection: "", action: FaultAction::FinishesPlan };
    assert_eq!(crate::autopilot::Fault::GoalUnreachable.name(), UNREACHABLE);
    let sent = talk.event(&CoreEvent::FaultRaised(fault));
    assert!(texts(&sent).contains("item 0 cannot be reached"), "{}", texts(&sent));
    assert_eq!((talk.mode, talk.service.run.state), (Mode::Hold, State::Paused));

    talk.start(0.0).unwrap();
    talk.refusal = Some(Refusal::new(RefusalKind::Failed, "the car is not armed"));
    let sent = talk.arrive();
    assert!(texts(&sent).contains("item 1: the car is not armed"), "{}", texts(&sent));
    assert_eq!((talk.mode, talk.service.run.state), (Mode::Hold, State::Paused));
}

#[test]
fn a_start_that_the_core_refuses_is_no_start() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1)]);
    talk.start(0.0).unwrap();
    // The commander keeps the mode as it was.
    talk.mode = Mode::Hold;
    talk.service.run.state = State::Asked;
    talk.service.starting = Some(talk.now);
    talk.look();
    assert_eq!(talk.service.run.state, State::Asked, "the answer may still come");
    talk.now = talk.now.offset_by(3.0);
    talk.look();
    assert_eq!(talk.service.run.state, State::Paused);
}

#[test]
fn a_new_mission_stops_the_car_on_the_old_one() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2)]);
    talk.start(0.0).unwrap();
    talk.asked.clear();
    assert_eq!(talk.upload(Kind::Mission, &[goal(5)]), DONE);
    assert_eq!((talk.mode, &talk.asked[..]), (Mode::Hold, &[CoreRequest::Hold][..]));
    assert_eq!(talk.service.current_message().seq, 0);
}

#[test]
fn a_fence_reaches_the_core_also_after_a_restart() {
    let mut talk = Talk::new();
    assert_eq!(talk.upload(Kind::Fence, &square()), DONE);
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(!fence.allows(Point::new(1.5, 1.5)) && fence.allows(Point::new(0.0, 0.0)));
    assert_eq!(talk.upload(Kind::Fence, &square()[..3]), Code::MAV_MISSION_INVALID_PARAM1);
    assert!(talk.asked.is_empty());

    let kept = talk.memory.0.lock().unwrap().clone();
    let mut again = Talk::new();
    again.service = Mission::new(1, None, |name| kept.get(name).cloned());
    again.look();
    assert!(matches!(&again.asked[..], [CoreRequest::SetFence(same)] if *same == fence));
    again.hear(&clear(MavMissionType::MAV_MISSION_TYPE_FENCE));
    assert!(matches!(&again.asked[1..], [CoreRequest::SetFence(none)] if none.is_empty()));
}

#[test]
fn a_fence_on_the_earth_keeps_the_car_where_it_is_until_the_map_has_a_place() {
    let place = Geodetic { latitude_deg: 0.0, longitude_deg: 0.0 };
    let global = square().map(|item| Item { frame: MavFrame::MAV_FRAME_GLOBAL_INT, ..item });
    let mut talk = Talk::new();
    talk.service = Mission::new(1, None, |name| (name == "fence.txt").then(|| text_of(&global)));
    let sent = talk.look();
    assert!(texts(&sent).contains("Fence: the car stays"), "{}", texts(&sent));
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(!fence.allows(Point::new(0.0, 0.0)));
    let origin = Origin { place, altitude_m: 0.0 };
    talk.service.handle_origin(talk.now, &origin, &mut talk.out);
    talk.drain();
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(fence.allows(Point::new(50.0, 0.0)));
}

/// Uploads as a ground station does: says the count again while nothing comes, answers what is
/// asked for; then reads it back, asking again for what does not come.
fn transfer(seed: u64, items: &[Item], kind: Kind) -> (Mission, Vec<Item>) {
    let mut talk = Talk::new();
    let mut link = Lossy::new(seed);
    let (mut accepted, mut heard) = (false, 0.0);
    let mut got: Vec<Item> = Vec::new();
    let mut wanted = None;
    link.up(count(kind, items.len() as u16));
    let mut asked_any = false;
    for step in 0.. {
        let seconds = f64::from(step) * 0.02;
        assert!(seconds < 120.0, "accepted: {accepted}, read: {}", got.len());
        talk.now = at(seconds);
        for message in link.arrived_up() {
            talk.service.handle(talk.now, STATION, &message, &mut talk.out);
        }
        talk.service.handle_time(talk.now, &mut talk.out);
        talk.drain().into_iter().for_each(|message| link.down(message));
        for message in link.arrived_down() {
            match message {
                MavMessage::MISSION_REQUEST_INT(data) if !accepted => {
                    (heard, asked_any) = (seconds, true);
                    let item = items[usize::from(data.seq)];
                    link.up(item_message(item, data.seq, kind));
                }
                MavMessage::MISSION_ACK(data) if data.mavtype == DONE => {
                    (accepted, heard) = (true, seconds);
                }
                MavMessage::MISSION_COUNT(data) => wanted = Some(usize::from(data.count)),
                MavMessage::MISSION_ITEM_INT(data) if usize::from(data.seq) == got.len() => {
                    (got, heard) = ([&got[..], &[Item::of_int(&data)]].concat(), 0.0);
                }
                _ => {}
            }
        }
        if accepted && wanted == Some(got.len()) {
            return (talk.service, got);
        }
        if seconds - heard >= 0.3 {
            heard = seconds;
            match (accepted, wanted) {
                (false, _) if !asked_any => link.up(count(kind, items.len() as u16)),
                // The answer to the last item was lost: once more.
                (false, _) => {
                    let last = items.len() as u16 - 1;
                    link.up(item_message(items[usize::from(last)], last, kind));
                }
                (true, None) => link.up(ask_list(kind.number())),
                (true, Some(_)) => link.up(ask_item(got.len() as u16, kind)),
            }
        }
    }
    unreachable!("the loop has no end")
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_list_goes_both_ways_whole_over_a_link_that_loses_repeats_and_mixes(
        seed in any::<u64>(),
        length in 1usize..40,
        fence in any::<bool>(),
    ) {
        let (items, kind) = if fence {
            (square().repeat(length.div_ceil(4)), Kind::Fence)
        } else {
            ((0..length as i32).map(goal).collect(), Kind::Mission)
        };
        let (service, got) = transfer(seed, &items, kind);
        prop_assert_eq!(service.items(kind), &items);
        prop_assert_eq!(got, items);
    }

    /// Whatever comes: nothing panics, nothing is taken that was not sent whole, nobody is driven
    /// anywhere, and what is remembered stays bounded.
    #[test]
    fn nonsense_changes_nothing(
        payloads in prop::collection::vec((0usize..12, any::<[u8; 38]>()), 1..300),
    ) {
        let mut talk = Talk::new();
        talk.upload(Kind::Mission, &[goal(1)]);
        talk.asked.clear();
        let ids = [
            c::MISSION_ITEM_INT_DATA::ID, c::MISSION_ITEM_DATA::ID, c::MISSION_REQUEST_DATA::ID,
            c::MISSION_REQUEST_INT_DATA::ID, c::MISSION_REQUEST_LIST_DATA::ID,
            c::MISSION_ACK_DATA::ID, c::MISSION_SET_CURRENT_DATA::ID,
            c::MISSION_WRITE_PARTIAL_LIST_DATA::ID, c::MISSION_REQUEST_PARTIAL_LIST_DATA::ID,
            c::MISSION_CURRENT_DATA::ID, c::MISSION_ITEM_REACHED_DATA::ID, c::COMMAND_ACK_DATA::ID,
        ];
        for (which, payload) in payloads {
            talk.now = talk.now.offset_by(0.01);
            match crate::wire::mavlink::Body::decode(
                crate::wire::mavlink::MavlinkVersion::V2, ids[which], &payload,
            ) {
                crate::wire::mavlink::Body::Message(message) => {
                    talk.hear(&message);
                }
                crate::wire::mavlink::Body::Raw(raw) => {
                    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
                    talk.drain();
                }
            }
            talk.service.handle_time(talk.now, &mut talk.out);
            talk.drain();
        }
        prop_assert_eq!(&talk.service.goals, &[goal(1)]);
        prop_assert_eq!(&talk.asked, &[]);
        prop_assert!(talk.service.upload.is_none());
    }
}
