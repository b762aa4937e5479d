//! The mission protocol: lists of goals and of fences come in, are handed out, kept and driven.
//!
//! A list replaces the former one only when its last item has come and all of it is acceptable. A
//! new list of goals ends the drive along the old one. Rally points are refused.

use std::sync::Arc;

use super::core::{CoreEvent, CoreMode, CoreRequest, CoreView, Refusal};
use super::mission_items::{Fault, Item, Kind, fence_of, items_of, opaque_id, text_of};
use super::mission_run::{Next, Run, State};
use super::mission_upload::{Progress, Upload};
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

    // ---- lists out

    fn send_count(&self, to: Peer, kind: Kind, out: &mut Outbox) {
        let data = c::MISSION_COUNT_DATA {
            count: self.items(kind).len() as u16,
            target_system: to.system,
            target_component: to.component,
            mission_type: kind.number(),
            opaque_id: self.id(kind),
        };
        out.send(to, MavMessage::MISSION_COUNT(data));
    }

    fn send_item(&self, to: Peer, kind: MavMissionType, seq: u16, out: &mut Outbox) {
        let Some(own) = Kind::of(kind) else {
            return acknowledge(to, kind, Code::MAV_MISSION_UNSUPPORTED, 0, out);
        };
        let Some(item) = self.items(own).get(usize::from(seq)) else {
            return acknowledge(to, kind, Code::MAV_MISSION_INVALID_SEQUENCE, 0, out);
        };
        let current = own == Kind::Mission && self.run.current == usize::from(seq);
        let mut data = item.message(seq, own, current);
        (data.target_system, data.target_component) = (to.system, to.component);
        out.send(to, MavMessage::MISSION_ITEM_INT(data));
    }

    // ---- lists in

    fn begin_upload(
        &mut self,
        now: Instant,
        from: Peer,
        data: &c::MISSION_COUNT_DATA,
        out: &mut Outbox,
    ) {
        let Some(kind) = Kind::of(data.mission_type) else {
            return acknowledge(from, data.mission_type, Code::MAV_MISSION_UNSUPPORTED, 0, out);
        };
        if let Some(upload) = &mut self.upload {
            if upload.from == from && upload.kind == kind && upload.count == data.count {
                // The same word again: nothing that has come is lost.
                return upload.ask(now, out);
            }
            if upload.from != from {
                let text = "Another ground station is sending a list";
                self.say(now, MavSeverity::MAV_SEVERITY_WARNING, text, out);
                return acknowledge(from, data.mission_type, Code::MAV_MISSION_DENIED, 0, out);
            }
            self.upload = None;
        }
        if data.count > ITEMS_MAX {
            let text = format!("{} of {} items, at most {ITEMS_MAX}", kind.name(), data.count);
            self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
            return acknowledge(from, data.mission_type, Code::MAV_MISSION_NO_SPACE, 0, out);
        }
        self.answered = None;
        if data.count == 0 {
            return self.complete(now, from, kind, Vec::new(), out);
        }
        self.upload = Some(Upload::begin(now, from, kind, data.count, out));
    }

    fn take_item(
        &mut self,
        now: Instant,
        from: Peer,
        kind: MavMissionType,
        seq: u16,
        item: Option<Item>,
        out: &mut Outbox,
    ) {
        let ours = |upload: &Upload| upload.from == from && upload.kind.number() == kind;
        let Some(mut upload) = self.upload.take_if(|upload| ours(upload)) else {
            // The sender did not hear how the list ended.
            if let Some((peer, own, last, code)) = self.answered
                && peer == from
                && own.number() == kind
                && seq == last
            {
                acknowledge(from, kind, code, self.id(own), out);
            }
            return;
        };
        let (own, count) = (upload.kind, upload.count);
        let (speed_max_mps, origin) = (self.speed_max_mps, self.origin);
        let check = |item: &Item| item.check(own, count, speed_max_mps, origin.as_ref());
        match upload.take(now, seq, item, check, out) {
            Ok(Progress::Going) => self.upload = Some(upload),
            Ok(Progress::Complete(items)) => self.complete(now, from, own, items, out),
            Err(fault) => self.refuse(now, from, own, seq, &fault, out),
        }
    }

    fn refuse(
        &mut self,
        now: Instant,
        from: Peer,
        kind: Kind,
        seq: u16,
        fault: &Fault,
        out: &mut Outbox,
    ) {
        let text = format!("{} refused at item {seq}: {}", kind.name(), fault.reason);
        self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
        acknowledge(from, kind.number(), fault.code, 0, out);
        self.answered = Some((from, kind, seq, fault.code));
    }

    /// All of a list has come.
    fn complete(
        &mut self,
        now: Instant,
        from: Peer,
        kind: Kind,
        items: Vec<Item>,
        out: &mut Outbox,
    ) {
        if kind == Kind::Fence
            && let Err((at, fault)) = fence_of(&items, self.origin.as_ref())
        {
            return self.refuse(now, from, kind, at as u16, &fault, out);
        }
        let last = items.len().saturating_sub(1) as u16;
        self.replace(now, kind, items, out);
        let code = Code::MAV_MISSION_ACCEPTED;
        acknowledge(from, kind.number(), code, self.id(kind), out);
        self.answered = Some((from, kind, last, code));
    }

    fn replace(&mut self, now: Instant, kind: Kind, items: Vec<Item>, out: &mut Outbox) {
        if let Some(keeper) = &mut self.keeper
            && let Err(why) = keeper.keep(kept_name(kind), &text_of(&items))
        {
            let text = format!("{} is in force, but not kept: {why}", kind.name());
            self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
        }
        match kind {
            Kind::Mission => {
                let going = self.run.is_going();
                self.run = Run::new(items.len());
                self.goals = items;
                if going {
                    self.hold(now, "the mission was replaced", out);
                }
            }
            Kind::Fence => {
                self.fence = items;
                self.untold = true;
                self.tell_fence(now, out);
            }
        }
        self.show(now, out);
    }

    fn clear(&mut self, now: Instant, from: Peer, kind: MavMissionType, out: &mut Outbox) {
        let all = kind == MavMissionType::MAV_MISSION_TYPE_ALL;
        let kinds: Vec<Kind> = if all {
            vec![Kind::Mission, Kind::Fence]
        } else {
            match Kind::of(kind) {
                Some(one) => vec![one],
                None => {
                    return acknowledge(from, kind, Code::MAV_MISSION_UNSUPPORTED, 0, out);
                }
            }
        };
        for one in kinds {
            if self.upload.as_ref().is_some_and(|upload| upload.kind == one) {
                self.upload = None;
            }
            if !self.items(one).is_empty() {
                self.replace(now, one, Vec::new(), out);
            }
        }
        acknowledge(from, kind, Code::MAV_MISSION_ACCEPTED, 0, out);
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

    // ---- driving

    /// Stops on the way, with a word about it.
    fn hold(&mut self, now: Instant, why: &str, out: &mut Outbox) {
        let text = format!("Mission stopped: {why}");
        self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
        if self.run.is_going() {
            self.run.state = State::Paused;
        }
        self.rest(out);
    }

    fn rest(&mut self, out: &mut Outbox) {
        if let Some(id) = out.request(CoreRequest::Hold) {
            self.remember(id, Asked::Hold);
        }
        self.wish = Some(Mode::Hold);
    }

    /// What is to be asked of the core to start or go on.
    fn start(&mut self, now: Instant, first: Option<usize>) -> Result<Vec<CoreRequest>, Denial> {
        if self.goals.is_empty() {
            return Err(Denial::failed("there is no mission"));
        }
        let from = match first {
            Some(first) => {
                self.run.forget_jumps();
                first
            }
            None if self.run.state == State::Complete => {
                self.run.forget_jumps();
                0
            }
            None => self.run.current,
        };
        let before = self.run.clone();
        let failed =
            |(at, fault): (usize, Fault)| Denial::failed(format!("item {at}: {}", fault.reason));
        match self.run.seek(&self.goals, from, self.origin.as_ref()) {
            Ok(Next::Ask(requests)) => {
                self.starting = Some(now);
                Ok(requests)
            }
            Ok(Next::End) => {
                self.run = before;
                Err(Denial::failed("the mission has no goal from there on"))
            }
            Err(fault) => {
                self.run = before;
                Err(failed(fault))
            }
        }
    }

    /// Goes on with an item while driving.
    fn go_on(&mut self, now: Instant, from: usize, out: &mut Outbox) {
        match self.run.seek(&self.goals, from, self.origin.as_ref()) {
            Ok(Next::Ask(requests)) => {
                for request in requests {
                    match out.request(request) {
                        Some(id) => self.remember(id, Asked::Goal),
                        None => return self.hold(now, "the autopilot takes no goal", out),
                    }
                }
            }
            Ok(Next::End) => {
                self.say(now, MavSeverity::MAV_SEVERITY_INFO, "Mission complete", out);
                self.rest(out);
            }
            Err((at, fault)) => {
                self.hold(now, &format!("item {at}: {}", fault.reason), out);
            }
        }
        self.show(now, out);
    }

    fn reached(&mut self, now: Instant, out: &mut Outbox) {
        let seq = self.run.current as u16;
        out.send(
            To::Everyone,
            MavMessage::MISSION_ITEM_REACHED(c::MISSION_ITEM_REACHED_DATA { seq }),
        );
        let Some(item) = self.goals.get(self.run.current).copied() else { return };
        if !item.goes_on {
            // The next start goes on with the one behind it.
            let next = self.run.current + 1;
            if next < self.goals.len() {
                self.run.current = next;
                return self.hold(now, &format!("item {seq} says so"), out);
            }
        }
        self.run.state = State::Waiting(now + Run::wait(&item));
        self.go_on_after_wait(now, out);
    }

    fn go_on_after_wait(&mut self, now: Instant, out: &mut Outbox) {
        if let State::Waiting(until) = self.run.state
            && now >= until
        {
            self.go_on(now, self.run.current + 1, out);
        }
    }

    /// Another item is to be the present one.
    fn set_current(&mut self, now: Instant, seq: u32, out: &mut Outbox) -> Result<(), String> {
        let at = seq as usize;
        if at >= self.goals.len() {
            return Err(format!("item {seq} of a mission of {}", self.goals.len()));
        }
        let going = self.run.is_going();
        self.run.current = at;
        if going {
            self.go_on(now, at, out);
        } else if self.run.state == State::Complete {
            self.run.state = State::Paused;
        }
        self.next_word = now;
        self.show(now, out);
        Ok(())
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

    /// The mode that was chosen is another one.
    fn follow_mode(&mut self, now: Instant, mode: Mode) {
        self.mode = Some(mode);
        if mode == Mode::Auto {
            self.starting = None;
            match self.run.state {
                State::Asked => self.run.state = State::Driving,
                // Continued after a pause, with the same goal.
                State::Paused if self.run.goal().is_some() => self.run.state = State::Driving,
                _ => {}
            }
        } else if self.starting.is_none_or(|since| now.since(since) >= SETTLE) {
            self.starting = None;
            if self.run.is_going() {
                self.run.state = State::Paused;
            }
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
        // Where system, component and kind of list are in each message.
        let (target, kind) = match raw.id {
            c::MISSION_ITEM_INT_DATA::ID | c::MISSION_ITEM_DATA::ID => (32, 37),
            c::MISSION_COUNT_DATA::ID
            | c::MISSION_REQUEST_DATA::ID
            | c::MISSION_REQUEST_INT_DATA::ID => (2, 4),
            c::MISSION_REQUEST_LIST_DATA::ID | c::MISSION_CLEAR_ALL_DATA::ID => (0, 2),
            _ => return,
        };
        let [system, component] = raw.bytes(target);
        let ours = (system == 0 || system == self.system)
            && (component == 0 || component == super::COMPONENT);
        if !ours {
            return;
        }
        let [kind] = raw.bytes(kind);
        if target == 32
            && let Some(upload) = &self.upload
            && upload.from == from
            && upload.kind.number() as u8 == kind
        {
            // An item with a command or a frame that the dialect does not know.
            let seq = u16::from_le_bytes(raw.bytes(28));
            if seq != upload.next() {
                return;
            }
            let [frame] = raw.bytes(34);
            let command = u16::from_le_bytes(raw.bytes(30));
            let own = upload.kind;
            self.upload = None;
            let fault = if is_known_frame(frame) {
                Fault::new(Code::MAV_MISSION_UNSUPPORTED, format!("command {command} is unknown"))
            } else {
                let reason = format!("frame {frame} is unknown");
                Fault::new(Code::MAV_MISSION_UNSUPPORTED_FRAME, reason)
            };
            self.refuse(now, from, own, seq, &fault, out);
        } else if target != 32 {
            // A kind of list that nobody knows.
            let code = Code::MAV_MISSION_UNSUPPORTED as u8;
            let payload = vec![from.system, from.component, code, kind];
            out.send(from, RawBody { id: c::MISSION_ACK_DATA::ID, payload });
        }
    }

    fn handle_command(
        &mut self,
        now: Instant,
        wanted: &Wanted,
        out: &mut Outbox,
    ) -> Option<Result<Step, Denial>> {
        match wanted.command {
            MavCmd::MAV_CMD_MISSION_START => {
                Some(wanted.whole(1, u16::MAX.into()).and_then(|first| {
                    let at = first as usize;
                    if at > 0 && at >= self.goals.len() {
                        let count = self.goals.len();
                        return Err(Denial::denied(format!("item {first} of {count}")));
                    }
                    let requests = self.start(now, (first > 0).then_some(at))?;
                    Ok(Step::Ask(requests, Some(Mode::Auto)))
                }))
            }
            MavCmd::MAV_CMD_DO_SET_MISSION_CURRENT => {
                // -1 keeps the present item.
                let keep = wanted.params[0] == -1.0;
                let seq = if keep {
                    Ok(self.run.current as u32)
                } else {
                    wanted.whole(1, u16::MAX.into())
                };
                let reset = wanted.params[1] == 1.0;
                Some(seq.and_then(|seq| {
                    if reset {
                        self.run.forget_jumps();
                    }
                    self.set_current(now, seq, out).map_err(Denial::denied)?;
                    Ok(Step::Done)
                }))
            }
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

fn acknowledge(to: Peer, kind: MavMissionType, code: Code, opaque_id: u32, out: &mut Outbox) {
    let data = c::MISSION_ACK_DATA {
        target_system: to.system,
        target_component: to.component,
        mavtype: code,
        mission_type: kind,
        opaque_id,
    };
    out.send(to, MavMessage::MISSION_ACK(data));
}

/// Whether the dialect has a frame of that number.
fn is_known_frame(frame: u8) -> bool {
    let mut payload = [0; 38];
    payload[34] = frame;
    payload[30] = MavCmd::MAV_CMD_NAV_WAYPOINT as u8;
    c::MISSION_ITEM_INT_DATA::deser(crate::wire::mavlink::MavlinkVersion::V2, &payload).is_ok()
}

#[cfg(test)]
mod tests;
