//! Lists on their way: handed out item by item, taken item by item, and what becomes of a whole one.

use super::super::mission_items::{Fault, Item, Kind, fence_of, text_of};
use super::super::mission_run::Run;
use super::super::mission_upload::{Progress, Upload};
use super::super::outbox::{Outbox, Peer};
use super::{ITEMS_MAX, Mission, kept_name};
use crate::time::Instant;
use crate::wire::mavlink::common::{
    self as c, MavCmd, MavMessage, MavMissionResult as Code, MavMissionType, MavSeverity,
};
use crate::wire::mavlink::{MessageData, RawBody};

impl Mission {
    // ---- out

    pub(super) fn send_count(&self, to: Peer, kind: Kind, out: &mut Outbox) {
        let data = c::MISSION_COUNT_DATA {
            count: self.items(kind).len() as u16,
            target_system: to.system,
            target_component: to.component,
            mission_type: kind.number(),
            opaque_id: self.id(kind),
        };
        out.send(to, MavMessage::MISSION_COUNT(data));
    }

    pub(super) fn send_item(&self, to: Peer, kind: MavMissionType, seq: u16, out: &mut Outbox) {
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

    // ---- in

    pub(super) fn begin_upload(
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

    pub(super) fn take_item(
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

    pub(super) fn clear(
        &mut self,
        now: Instant,
        from: Peer,
        kind: MavMissionType,
        out: &mut Outbox,
    ) {
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

    /// A message with a value in it that the dialect does not name.
    pub(super) fn take_raw(&mut self, now: Instant, from: Peer, raw: &RawBody, out: &mut Outbox) {
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
            && (component == 0 || component == super::super::COMPONENT);
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
}

/// Answers a list.
pub(super) fn acknowledge(
    to: Peer,
    kind: MavMissionType,
    code: Code,
    opaque_id: u32,
    out: &mut Outbox,
) {
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
