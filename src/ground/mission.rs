//! The mission protocol: lists of goals and of fences come in, are handed out, kept and driven.
//!
//! A list replaces the former one only when its last item has come and all of it is acceptable. A
//! new list of goals ends the drive along the old one. Rally points are refused.

mod driving;
mod lists;

use std::sync::Arc;

use super::core::{CoreEvent, CoreMode, CoreRequest, CoreView, Refusal};
use super::mission_items::{Item, Kind, fence_of, items_of, opaque_id};
use super::mission_run::{Run, State};
use super::mission_upload::Upload;
use super::modes::Mode;
use super::outbox::{Outbox, Peer, RequestId, To};
use super::service::{Keeper, Service};
use super::wanted::{Denial, Step, Wanted};
use crate::fence::Fence;
use crate::params::Params;
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::{
    self as c, MavCmd, MavMessage, MavMissionResult as Code, MavMissionType, MavProtocolCapability,
    MavSeverity, MissionState,
};
use crate::wire::mavlink::{MessageData, Origin, RawBody};
use lists::acknowledge;

/// Items of a list.
const ITEMS_MAX: u16 = 500;
/// Between two words about where the mission stands.
const PERIOD: Duration = Duration::from_secs(1);
/// A goal that the core took must be followed by its mode within this.
const SETTLE: Duration = Duration::from_secs(2);
/// A car at a goal may be this much outside its radius, by rounding, metres.
const REACH_SLACK_M: f64 = 0.05;
/// What an acknowledgement of nonsense says.
pub(super) const INVALID: Code = Code::MAV_MISSION_INVALID;
/// Name of the failsafe for a goal that cannot be reached.
const UNREACHABLE: &str = "goal unreachable";
/// The most texts about refusals in a second.
const TEXTS_PER_S: u32 = 5;

/// What lists are kept under.
const fn kept_name(kind: Kind) -> &'static str {
    match kind {
        Kind::Mission => "mission.txt",
        Kind::Fence => "fence.txt",
    }
}

/// What an answer of the core will be to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asked {
    /// The next goal, or the speed on the way to it.
    Goal,
    Fence,
    Hold,
}

/// The mission service.
pub struct Mission {
    /// Number of this system.
    system: u8,
    goals: Vec<Item>,
    fence: Vec<Item>,
    run: Run,
    upload: Option<Upload>,
    /// The answer to the last list, for a sender that did not hear it.
    answered: Option<(Peer, Kind, u16, Code)>,
    origin: Option<Origin>,
    keeper: Option<Box<dyn Keeper>>,
    asked: Vec<(RequestId, Asked)>,
    /// When the core was asked by a command, whose answer is not ours to hear.
    starting: Option<Instant>,
    /// The fence has to be told to the core.
    untold: bool,
    seen: bool,
    speed_max_mps: f64,
    goal_radius_m: f64,
    mode: Option<Mode>,
    wish: Option<Mode>,
    next_word: Instant,
    shown: Option<c::MISSION_CURRENT_DATA>,
    texts: (Instant, u32),
}

impl Mission {
    /// The service of system `system`, with what was kept before (as [`kept`](Self::kept) names it).
    pub fn new(
        system: u8,
        keeper: Option<Box<dyn Keeper>>,
        kept: impl Fn(&str) -> Option<String>,
    ) -> Self {
        let read = |kind| kept(kept_name(kind)).and_then(|text| items_of(&text));
        let take = |kind| read(kind).filter(|items| items.len() <= ITEMS_MAX.into());
        let goals: Vec<Item> = take(Kind::Mission).unwrap_or_default();
        let fence: Vec<Item> = take(Kind::Fence).unwrap_or_default();
        Self {
            system,
            run: Run::new(goals.len()),
            untold: !fence.is_empty(),
            goals,
            fence,
            upload: None,
            answered: None,
            origin: None,
            keeper,
            asked: Vec::new(),
            starting: None,
            seen: false,
            speed_max_mps: f64::INFINITY,
            goal_radius_m: Params::default().autopilot.goal_radius_m,
            mode: None,
            wish: None,
            next_word: Instant::ZERO,
            shown: None,
            texts: (Instant::ZERO, 0),
        }
    }

    const fn items(&self, kind: Kind) -> &Vec<Item> {
        match kind {
            Kind::Mission => &self.goals,
            Kind::Fence => &self.fence,
        }
    }

    fn id(&self, kind: Kind) -> u32 {
        opaque_id(self.items(kind))
    }

    fn say(&mut self, now: Instant, severity: MavSeverity, text: &str, out: &mut Outbox) {
        if now.since(self.texts.0) >= Duration::from_secs(1) {
            self.texts = (now, 0);
        }
        self.texts.1 += 1;
        if self.texts.1 <= TEXTS_PER_S {
            out.say(severity, text);
        }
    }

    // ---- the fence

    /// Tells the core where it may drive.
    fn tell_fence(&mut self, now: Instant, out: &mut Outbox) {
        if !self.untold || !self.seen {
            return;
        }
        let fence = match fence_of(&self.fence, self.origin.as_ref()) {
            Ok(fence) => fence,
            Err((at, fault)) => {
                // Nobody has said where the map lies: better nowhere than anywhere.
                let text = format!("Fence: the car stays where it is, item {at}: {}", fault.reason);
                self.say(now, MavSeverity::MAV_SEVERITY_ERROR, &text, out);
                Fence { inside: vec![vec![Vec::new()]], outside: Vec::new() }
            }
        };
        if let Some(id) = out.request(CoreRequest::SetFence(Arc::new(fence))) {
            self.untold = false;
            self.remember(id, Asked::Fence);
        }
    }

    fn remember(&mut self, id: RequestId, what: Asked) {
        // Answers come soon; what has none by then gets none.
        if self.asked.len() >= 32 {
            self.asked.remove(0);
        }
        self.asked.push((id, what));
    }

    // ---- telling

    fn current_message(&self) -> c::MISSION_CURRENT_DATA {
        let state = match self.run.state {
            _ if self.goals.is_empty() => MissionState::MISSION_STATE_NO_MISSION,
            State::NotStarted => MissionState::MISSION_STATE_NOT_STARTED,
            State::Asked | State::Driving | State::Waiting(_) => MissionState::MISSION_STATE_ACTIVE,
            State::Paused => MissionState::MISSION_STATE_PAUSED,
            State::Complete => MissionState::MISSION_STATE_COMPLETE,
        };
        c::MISSION_CURRENT_DATA {
            seq: self.run.current as u16,
            total: self.goals.len() as u16,
            mission_state: state,
            // 1: in mission mode; 2: the mission is suspended.
            mission_mode: if self.mode == Some(Mode::Auto) { 1 } else { 2 },
            mission_id: self.id(Kind::Mission),
            fence_id: self.id(Kind::Fence),
            rally_points_id: 0,
        }
    }

    /// Says where the mission stands when that is news, or due.
    fn show(&mut self, now: Instant, out: &mut Outbox) {
        let data = self.current_message();
        if self.shown.as_ref() != Some(&data) || now >= self.next_word {
            self.next_word = now + PERIOD;
            out.send(To::Everyone, MavMessage::MISSION_CURRENT(data.clone()));
            self.shown = Some(data);
        }
    }
}

impl Service for Mission {
    fn handle(&mut self, now: Instant, from: Peer, message: &MavMessage, out: &mut Outbox) {
        match message {
            MavMessage::MISSION_COUNT(data) => self.begin_upload(now, from, data, out),
            MavMessage::MISSION_ITEM_INT(data) => {
                let item = Some(Item::of_int(data));
                self.take_item(now, from, data.mission_type, data.seq, item, out);
            }
            MavMessage::MISSION_ITEM(data) => {
                let item = Item::of_float(data);
                self.take_item(now, from, data.mission_type, data.seq, item, out);
            }
            MavMessage::MISSION_REQUEST_LIST(data) => match Kind::of(data.mission_type) {
                Some(kind) => self.send_count(from, kind, out),
                None => {
                    let code = Code::MAV_MISSION_UNSUPPORTED;
                    acknowledge(from, data.mission_type, code, 0, out);
                }
            },
            MavMessage::MISSION_REQUEST_INT(data) => {
                self.send_item(from, data.mission_type, data.seq, out);
            }
            MavMessage::MISSION_REQUEST(data) => {
                self.send_item(from, data.mission_type, data.seq, out);
            }
            MavMessage::MISSION_CLEAR_ALL(data) => self.clear(now, from, data.mission_type, out),
            MavMessage::MISSION_SET_CURRENT(data) => {
                if let Err(why) = self.set_current(now, data.seq.into(), out) {
                    self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &why, out);
                    let kind = MavMissionType::MAV_MISSION_TYPE_MISSION;
                    acknowledge(from, kind, Code::MAV_MISSION_INVALID_SEQUENCE, 0, out);
                }
            }
            MavMessage::MISSION_ACK(data) => {
                // Only whoever is sending can call that off.
                let own = Kind::of(data.mission_type);
                let cancelled = data.mavtype == Code::MAV_MISSION_OPERATION_CANCELLED;
                if cancelled {
                    self.upload.take_if(|upload| upload.from == from && Some(upload.kind) == own);
                }
            }
            MavMessage::MISSION_WRITE_PARTIAL_LIST(data) => {
                let code = Code::MAV_MISSION_UNSUPPORTED;
                acknowledge(from, data.mission_type, code, 0, out);
            }
            MavMessage::MISSION_REQUEST_PARTIAL_LIST(data) => {
                let code = Code::MAV_MISSION_UNSUPPORTED;
                acknowledge(from, data.mission_type, code, 0, out);
            }
            _ => {}
        }
    }

    fn handle_raw(&mut self, now: Instant, from: Peer, raw: &RawBody, out: &mut Outbox) {
        self.take_raw(now, from, raw, out);
    }

    fn handle_command(
        &mut self,
        now: Instant,
        wanted: &Wanted,
        out: &mut Outbox,
    ) -> Option<Result<Step, Denial>> {
        match wanted.command {
            MavCmd::MAV_CMD_MISSION_START => Some(self.start_as(now, wanted)),
            MavCmd::MAV_CMD_DO_SET_MISSION_CURRENT => Some(self.choose(now, wanted, out)),
            _ => None,
        }
    }

    fn handle_core(&mut self, now: Instant, view: &CoreView, mode: Mode, out: &mut Outbox) {
        self.speed_max_mps = view.speed_max_mps;
        self.seen = true;
        self.tell_fence(now, out);
        self.follow_mode(now, mode);
        let ended = matches!(view.mode, CoreMode::Disarmed | CoreMode::Terminated);
        if ended && self.run.is_going() && self.starting.is_none() {
            self.run.state = State::Paused;
            self.wish = Some(Mode::Hold);
        }
        self.show(now, out);
    }

    fn handle_params(&mut self, params: &Arc<Params>) {
        self.goal_radius_m = params.autopilot.goal_radius_m;
    }

    fn handle_origin(&mut self, now: Instant, origin: &Origin, out: &mut Outbox) {
        if self.origin != Some(*origin) {
            self.origin = Some(*origin);
            self.untold = !self.fence.is_empty();
            self.tell_fence(now, out);
        }
    }

    fn handle_event(&mut self, now: Instant, event: &CoreEvent, mode: Mode, out: &mut Outbox) {
        self.follow_mode(now, mode);
        // The word of an arrival may overtake the answer to the question for the goal.
        if !matches!(self.run.state, State::Driving | State::Asked) {
            return;
        }
        match event {
            CoreEvent::GoalReached { position } => {
                // The word may be about the goal before.
                let reach_m = self.goal_radius_m + REACH_SLACK_M;
                if self.run.goal().is_some_and(|goal| (goal - *position).norm() <= reach_m) {
                    self.reached(now, out);
                }
            }
            CoreEvent::FaultRaised(fault) if fault.name == UNREACHABLE => {
                let why = format!("item {} cannot be reached", self.run.current);
                self.hold(now, &why, out);
            }
            _ => {}
        }
        self.show(now, out);
    }

    fn handle_reply(
        &mut self,
        now: Instant,
        id: RequestId,
        result: &Result<(), Refusal>,
        out: &mut Outbox,
    ) -> bool {
        let Some(at) = self.asked.iter().position(|(asked, _)| *asked == id) else {
            return false;
        };
        let (_, what) = self.asked.remove(at);
        match (what, result) {
            (Asked::Goal, Ok(())) => {
                let left = self.asked.iter().any(|(_, what)| *what == Asked::Goal);
                if !left && self.run.state == State::Asked {
                    self.run.state = State::Driving;
                }
            }
            (Asked::Goal, Err(refusal)) => {
                self.hold(now, &format!("item {}: {}", self.run.current, refusal.reason), out);
            }
            (Asked::Fence, Err(refusal)) => {
                self.untold = true;
                let text = format!("The fence is not in force: {}", refusal.reason);
                self.say(now, MavSeverity::MAV_SEVERITY_ERROR, &text, out);
            }
            (Asked::Fence | Asked::Hold, _) => {}
        }
        self.show(now, out);
        true
    }

    fn handle_time(&mut self, now: Instant, out: &mut Outbox) {
        if let Some(mut upload) = self.upload.take() {
            if upload.handle_time(now, out) {
                self.upload = Some(upload);
            } else {
                let text = format!("{} not received: the sender fell silent", upload.kind.name());
                self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
                let code = Code::MAV_MISSION_OPERATION_CANCELLED;
                acknowledge(upload.from, upload.kind.number(), code, 0, out);
            }
        }
        self.go_on_after_wait(now, out);
        self.show(now, out);
    }

    fn poll_at(&self) -> Option<Instant> {
        let wait = match self.run.state {
            State::Waiting(until) => Some(until),
            _ => None,
        };
        let upload = self.upload.as_ref().map(Upload::poll_at);
        wait.into_iter().chain(upload).chain([self.next_word]).min()
    }

    fn poll_mode(&mut self) -> Option<Mode> {
        let wish = self.wish.take();
        if wish.is_some() {
            self.mode = wish;
        }
        wish
    }

    fn capabilities(&self) -> MavProtocolCapability {
        MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_MISSION_INT
            | MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
    }

    fn message(&self, id: u32) -> Option<MavMessage> {
        (id == c::MISSION_CURRENT_DATA::ID)
            .then(|| MavMessage::MISSION_CURRENT(self.current_message()))
    }
}

#[cfg(test)]
mod tests;
