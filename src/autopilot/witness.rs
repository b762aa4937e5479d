//! What goes into the core and what comes out of it, told to a witness in the very order in which it
//! happens. Fed the same again, a core does the same again: a log of this is a replay.

use super::{Autopilot, BusHealth, Command, Event, HostHealth, Mode};
use crate::fence::Fence;
use crate::frames::Pose;
use crate::plan::StepReport;
use crate::time::Instant;
use crate::wire::can::CanFrame;

/// Something that went into the core or came out of it.
///
/// New parameters are not among it: they go to core and planner together, and who hands them out
/// notes them.
#[derive(Debug)]
pub enum Happening<'a> {
    /// In: a frame.
    Frame(&'a CanFrame),
    /// In: the passing of time.
    Time,
    /// In: a planning job came back.
    JobDone(&'a StepReport),
    /// In: a planning job never will.
    JobLost {
        /// Number of its request.
        number: u32,
    },
    /// In: a wish.
    Command(&'a Command),
    /// In: what the driver of the bus says.
    Bus(&'a BusHealth),
    /// In: what the computer says about itself.
    Host(&'a HostHealth),
    /// In: where the car may drive.
    Fence(&'a Fence),
    /// Out: a frame was fetched.
    Sent(&'a CanFrame),
    /// Out: a planning job was fetched.
    JobAsked {
        /// Number of the request.
        number: u32,
    },
    /// Out: an event was fetched.
    Event(&'a Event),
    /// What the core believes after a tick, for reading: pose (map frame) and speed (m/s).
    State {
        /// Where the car is, and how fast.
        state: Option<(Pose, f64)>,
        /// What the core is doing.
        mode: Mode,
    },
}

/// Is told everything that happens to the core.
pub trait Witness: Send {
    /// Something happened. What comes out has the time of what went in last.
    fn note(&mut self, at: Instant, happening: Happening<'_>);
}

/// The witness, if there is one.
#[derive(Default)]
pub(super) struct Testimony {
    witness: Option<Box<dyn Witness>>,
    newest: Instant,
}

impl Testimony {
    /// Something goes in.
    pub(super) fn note_at(&mut self, now: Instant, happening: Happening<'_>) {
        self.newest = now;
        self.note(happening);
    }

    /// Something comes out.
    pub(super) fn note(&mut self, happening: Happening<'_>) {
        if let Some(witness) = &mut self.witness {
            witness.note(self.newest, happening);
        }
    }
}

impl Autopilot {
    /// From now on everything that happens is told to a witness. One that is to repeat a drive from
    /// its beginning is set before anything else is handed in.
    pub fn set_witness(&mut self, witness: Box<dyn Witness>) {
        self.testimony.witness = Some(witness);
    }

    pub(super) fn testify_state(&mut self, now: Instant) {
        if self.testimony.witness.is_some() {
            let (state, mode) = (self.state(now), self.mode);
            self.testimony.note(Happening::State { state, mode });
        }
    }
}
