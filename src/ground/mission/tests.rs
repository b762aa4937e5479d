//! Missions and fences in conversation with a ground station.

mod driving;
mod lists;

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
