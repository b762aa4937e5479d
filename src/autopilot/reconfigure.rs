//! New parameters for a running core, and jobs that will never come back.

use super::{Autopilot, CoreParams, Fault, Happening, Mode};
use crate::control::Tracker;
use crate::time::{Duration, Instant};

impl Autopilot {
    /// Takes new values of the parameters. The caller keeps to their change classes: those that
    /// take effect at the next start must be as before, those that wait for rest as before unless
    /// the car [is at rest](Self::is_at_rest).
    pub fn set_params(&mut self, params: CoreParams) {
        self.tracker = Tracker::new(&params.vehicle, &params.control, params.autopilot.tick_s());
        self.guard.set_params(&params.vehicle, &params.guard);
        if self.mode != Mode::Drive {
            // What comes back was made for another car.
            self.void_job();
        }
        self.params = params;
    }

    /// Whether the car stands and is not about to drive.
    pub fn is_at_rest(&self, now: Instant) -> bool {
        let standing = self.state(now).is_none_or(|(_, speed)| speed.abs() < super::REST_SPEED_MPS);
        standing && self.mode != Mode::Drive
    }

    /// A planning job that was asked for will never be answered.
    pub fn handle_job_lost(&mut self, now: Instant, number: u32) {
        self.testimony.note_at(now, Happening::JobLost { number });
        if self.in_flight.take_if(|job| job.number == number).is_some() {
            self.raise(now, Fault::PlannerLate);
        }
    }

    /// Hands out the ages of the plans driven since the last call, oldest first: one for each tick
    /// in motion.
    pub fn take_plan_ages(&mut self) -> impl Iterator<Item = Duration> + '_ {
        self.statistics.plan_ages.drain(..)
    }
}
