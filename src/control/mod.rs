//! From the trajectory being driven and the estimated state to forces, and to the braking tail that
//! travels with them.

mod braking;
mod tracker;
#[cfg(test)]
pub(crate) mod trial;

pub use braking::braking_tail;
pub use tracker::{Tracker, Tracking, TrackingError};

use crate::tunables;

tunables! {
    /// How the trajectory is followed.
    pub struct ControlParams in "control" {
        /// Time from the calculation of a setpoint until the car acts on it.
        transport_delay_s: f64 = 0.001, at_rest, in 0.0..=0.1, "s";
        /// Time in which a lateral error is taken back (times the speed: a distance).
        lateral_settle_s: f64 = 0.08, at_rest, in 0.02..=1.0, "s";
        /// Shortest distance in which a lateral error is taken back.
        lateral_settle_min_m: f64 = 0.15, at_rest, in 0.02..=2.0, "m";
        /// Time in which an error along the path is taken back.
        along_settle_s: f64 = 0.12, at_rest, in 0.02..=2.0, "s";
        /// Share of the tyres' grip that feedback may use up.
        grip_share: f64 = 0.998, at_rest, in 0.5..=1.0, "";
        /// How much faster than the plan at its place the car may go to catch up.
        overspeed_mps: f64 = 0.05, at_rest, in 0.0..=1.0, "m/s";
        /// Closer to the end than this the car brakes and stays.
        stop_tolerance_m: f64 = 0.008, at_rest, in 0.001..=0.1, "m";
        /// Spacing of the braking tail's samples.
        tail_spacing_m: f64 = 0.1, restart, in 0.02..=0.5, "m";
        /// Share of the tyres' grip with which a braking tail brakes; more where the plan itself
        /// uses more.
        tail_grip_share: f64 = 0.9, at_rest, in 0.2..=1.0, "";
        /// Longest time from making a tail to the car's braking on it: the loss time-out of the
        /// car's controller plus the time between tails.
        tail_hold_s: f64 = 0.16, at_rest, in 0.0..=1.0, "s";
    }
}
