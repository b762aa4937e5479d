//! Convex elastic smoothing: from a guide polyline to a smooth, drivable path.
//!
//! After Zhu, Schmerling, Pavone (2015, arXiv 1506.01085), with these changes, each measured:
//! the curve is a B-spline, so that the turning-radius bound holds between points too; the
//! program is solved several times, each time about the last result (resampled to equal steps),
//! because the bound and the bubbles are exact only there; a small weight on length brings the
//! shape of least bending near the shape of least time; the friction limit enters only near the
//! start, where the car has a speed that it cannot shed at once.

mod banded;
mod banded_socp;
mod cones;
#[cfg(test)]
mod corridors;
mod program;
mod reference;
mod request;
mod shape;
mod spline;
#[cfg(test)]
mod tests;

pub use banded_socp::{BandedSolver, Tolerances};
pub use program::{Bend, Disc, Program, SolveError, Stencil, Stretch};
pub use reference::solve as solve_with_clarabel;
pub use request::{SmoothError, SmoothParams, SmoothRequest, SmoothStats, Smoothed, Solver};
pub use shape::Smoother;
