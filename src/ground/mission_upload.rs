//! A list on its way in: asked for item by item, complete or not at all.

use super::mission_items::{Fault, Item, Kind};
use super::outbox::{Outbox, Peer};
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::{self as c, MavMessage, MavMissionResult as Code};

/// An item that has not come is asked for again after this long.
const ASK_AGAIN: Duration = Duration::from_millis(250);
/// An item is asked for so many times without an answer.
const TRIES: u32 = 12;

/// What became of an item.
#[derive(Debug)]
pub enum Progress {
    /// More are to come.
    Going,
    /// That was the last one.
    Complete(Vec<Item>),
}

/// A list being received.
#[derive(Debug)]
pub struct Upload {
    /// From whom.
    pub from: Peer,
    /// Which list.
    pub kind: Kind,
    /// How many items it will have.
    pub count: u16,
    items: Vec<Item>,
    asked: Instant,
    tries: u32,
}

impl Upload {
    /// Begins, by asking for the first item.
    pub fn begin(now: Instant, from: Peer, kind: Kind, count: u16, out: &mut Outbox) -> Self {
        let mut upload = Self { from, kind, count, items: Vec::new(), asked: now, tries: 0 };
        upload.ask(now, out);
        upload
    }

    /// The number of the item that is waited for.
    pub fn next(&self) -> u16 {
        self.items.len() as u16
    }

    /// Asks for that item.
    pub fn ask(&mut self, now: Instant, out: &mut Outbox) {
        (self.asked, self.tries) = (now, self.tries + 1);
        let request = c::MISSION_REQUEST_INT_DATA {
            seq: self.next(),
            target_system: self.from.system,
            target_component: self.from.component,
            mission_type: self.kind.number(),
        };
        out.send(self.from, MavMessage::MISSION_REQUEST_INT(request));
    }

    /// An item came. One that came before is passed over, one that is too early asked for later.
    ///
    /// # Errors
    /// Hands on what `check` finds wrong with it.
    pub fn take(
        &mut self,
        now: Instant,
        seq: u16,
        item: Option<Item>,
        check: impl FnOnce(&Item) -> Result<(), Fault>,
        out: &mut Outbox,
    ) -> Result<Progress, Fault> {
        if seq != self.next() {
            return Ok(Progress::Going);
        }
        let Some(item) = item else {
            let reason = "its position is no number";
            return Err(Fault::new(Code::MAV_MISSION_INVALID_PARAM5_X, reason));
        };
        check(&item)?;
        self.items.push(item);
        self.tries = 0;
        if self.next() == self.count {
            return Ok(Progress::Complete(std::mem::take(&mut self.items)));
        }
        self.ask(now, out);
        Ok(Progress::Going)
    }

    /// Time has passed: asks again, or says that it is no use.
    pub fn handle_time(&mut self, now: Instant, out: &mut Outbox) -> bool {
        if now.since(self.asked) < ASK_AGAIN {
            return true;
        }
        if self.tries >= TRIES {
            return false;
        }
        self.ask(now, out);
        true
    }

    /// When it asks again.
    pub fn poll_at(&self) -> Instant {
        self.asked + ASK_AGAIN
    }
}
