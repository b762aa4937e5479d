//! How likely an unseen point is occupied.
//!
//! A prediction may change the path and the wished speed, never the stop: `guard` and
//! `plan::certify` have no access to it.

use crate::frames::Point;

/// The planner's view of the unknown during one step.
pub trait OccupancyView {
    /// Writes the probability that each map-frame point is occupied into `out` (same length).
    /// Answers are in `[0, 1]`; an answer that is not (NaN included) is treated by the planner as
    /// "nothing is known" (0.5).
    fn occupied(&mut self, points: &[Point], out: &mut [f32]);
}
