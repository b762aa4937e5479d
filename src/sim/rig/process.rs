//! What can fail on either side of the bus: on the core's computer a process that is stopped and
//! goes on, one that comes too late, a planner that never answers; on the car its controller, its
//! clock, its battery. What happens on the bus itself is in `sim::faults`.

use super::Rig;
use crate::time::{Duration, Instant};

/// Frames that waited in a socket carry the time of their arrival, but no more than this long ago:
/// what `shell::can` makes of the kernel's stamps.
const STAMP_AGE_MAX_S: f64 = 0.2;

/// What is wrong with the computer.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Process {
    /// Stopped until then.
    stopped_until: Option<Instant>,
    /// How late it wakes up for each control tick, seconds.
    tick_delay_s: f64,
    /// The planner's answers never come.
    pub(super) planner_hangs: bool,
}

impl Process {
    /// Whether nothing of it runs at `now`.
    pub(super) fn is_stopped(&self, now: Instant) -> bool {
        self.stopped_until.is_some_and(|until| now < until)
    }

    /// When it next does something that was due at `at`.
    pub(super) fn wakes_at(&self, at: Instant) -> Instant {
        self.stopped_until.map_or(at, |until| until.max(at))
    }

    /// When it gets to a control tick that was due at `at`.
    pub(super) fn ticks_at(&self, at: Instant) -> Instant {
        self.wakes_at(at.offset_by(self.tick_delay_s))
    }

    /// The stamp of a frame that arrived at `at` and is read at `now`.
    pub(super) fn stamp(now: Instant, at: Instant) -> Instant {
        at.max(now.offset_by(-STAMP_AGE_MAX_S))
    }
}

impl Rig {
    /// Stops the core's process for some time: frames wait in its socket, ticks are missed. Then it
    /// goes on as if nothing had been.
    pub fn stop_process(&mut self, seconds: f64) {
        self.process.stopped_until = Some(self.now.offset_by(seconds));
    }

    /// From now on the process wakes up so late for every control tick.
    pub fn delay_ticks(&mut self, seconds: f64) {
        self.process.tick_delay_s = seconds;
    }

    /// From now on planning steps do not come back; what has waited comes when that is over.
    pub fn hang_planner(&mut self, hangs: bool) {
        self.process.planner_hangs = hangs;
        if let Some((at, _)) = self.job.as_mut().filter(|_| !hangs) {
            *at = self.now;
        }
    }

    /// Sets the car's battery, volts.
    pub fn set_battery_v(&mut self, battery_v: f64) {
        self.car.set_battery_v(battery_v);
    }

    /// From now on scans leave the car this long after they were measured.
    pub fn set_scan_delay(&mut self, delay: Duration) {
        self.car.set_scan_delay(delay);
    }

    /// Restarts the car's controller: clock and totals begin anew, tail and setpoint are forgotten.
    pub fn restart_controller(&mut self) {
        self.car.restart(self.now);
    }

    /// Sets the clock of the car's controller ahead (or back) by so many seconds.
    pub fn shift_car_clock(&mut self, seconds: f64) {
        self.car.shift_clock(seconds);
    }

    /// Lets the car's controller claim another version of the CAN interface.
    pub fn set_interface_version(&mut self, version: u8) {
        self.car.set_interface_version(version);
    }
}
