//! What smoothing is asked and what it answers.

use super::program::SolveError;
use crate::frames::{Point, Pose};
use crate::plan::Path;
use crate::{choices, tunables};

choices! {
    /// Which solver shapes the path.
    pub enum Solver {
        /// The interior-point method made for this program, linear in the number of points.
        Banded = "banded",
        /// Clarabel, a general conic solver; the reference.
        Clarabel = "clarabel",
    }
}

tunables! {
    /// Convex elastic smoothing of the guide path.
    pub struct SmoothParams in "smooth" {
        /// Distance between the control points of the path.
        spacing_m: f64 = 0.095, live, in 0.03..=0.5, "m";
        /// How often the shape is solved, each time about the last result.
        passes: u32 = 4, live, in 1..=10, "";
        /// The same when the guide is the last plan's shape.
        passes_warm: u32 = 2, live, in 1..=10, "";
        /// Weight of length against squared curvature, in units of the squared curvature at which the
        /// tyres begin to limit the speed (bends wider than that cost length only).
        length_weight: f64 = 1.3, live, in 0.0..=20.0, "";
        /// How far along the guide the path is shaped.
        horizon_m: f64 = 20.0, live, in 2.0..=200.0, "m";
        /// Bubbles smaller than this move away from the obstacle until this radius fits.
        bubble_wanted_m: f64 = 0.6, live, in 0.0..=5.0, "m";
        /// No bubble is larger than this.
        bubble_radius_max_m: f64 = 1.2, live, in 0.05..=10.0, "m";
        /// Share of the tightest curvature that paths use beyond the first metres.
        curvature_share: f64 = 0.96, live, in 0.5..=1.0, "";
        /// Clearance that paths keep beyond what is asked, rising from nothing at the start over
        /// the first metre, so that a path can be planned again from any of its points.
        margin_m: f64 = 0.006, live, in 0.0..=0.5, "m";
        /// Which solver shapes the path.
        solver: Solver = Solver::Banded, live, one of;
    }
}

/// One smoothing task.
#[derive(Clone, Copy, Debug)]
pub struct SmoothRequest<'a> {
    /// The way to follow, map frame; it begins at (or within a cell of) the start and has no
    /// jumps. Corners are welcome.
    pub guide: &'a [Point],
    /// Whether the guide is the last plan's shape rather than a polyline on cells.
    pub warm: bool,
    /// Where the path begins, exactly.
    pub start: Pose,
    /// Curvature of the path that the car is on there, 1/m; `None` when it is free (at rest).
    pub start_curvature_pm: Option<f64>,
    /// The way that the car is on from there: arc length, metres, growing, and curvature, 1/m.
    /// What bends as that does at the same arc length is never held to be too tight for the speed.
    pub held: &'a [(f64, f64)],
    /// Speed at the start, m/s.
    pub start_speed_mps: f64,
    /// How far from the guide's last point the path may end, metres; 0 for exactly there.
    pub end_radius_m: f64,
    /// Clearance that the car's centre keeps, metres.
    pub radius_m: f64,
    /// Tightest curvature, 1/m.
    pub curvature_limit_pm: f64,
    /// Friction circle, m/s^2.
    pub acceleration_limit_mps2: f64,
    /// Fastest speed wished on this path, m/s (decides how much length matters).
    pub speed_max_mps: f64,
}

/// A shaped path.
#[derive(Clone, Debug, PartialEq)]
pub struct Smoothed {
    /// Samples at most 5 cm apart.
    pub path: Path,
    /// Whether it reaches the guide's end; otherwise it ends at the horizon.
    pub complete: bool,
    /// What it took.
    pub stats: SmoothStats,
}

/// What shaping a path took, and how close it came to its limits.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SmoothStats {
    /// Control points of the last program.
    pub points: usize,
    /// Programs solved.
    pub solves: u32,
    /// Interior-point iterations of all of them.
    pub iterations: u32,
    /// Programs that only had a solution with the turning radius relaxed (their result served as
    /// the next reference only).
    pub relaxed: u32,
    /// Programs solved again because the finished curve broke a limit.
    pub repairs: u32,
    /// Tightest curvature of the path, 1/m.
    pub curvature_max_pm: f64,
    /// Least clearance of any sample beyond what it must keep, metres.
    pub clearance_slack_m: f64,
}

/// Why there is no path; the caller keeps the one it has.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SmoothError {
    /// Something asked is not a number or out of its range.
    #[error("{what} is {value}, must be {allowed}")]
    BadRequest {
        /// Which quantity.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The guide leads nowhere.
    #[error("the guide is {length_m:.3} m long, shorter than {least_m} m")]
    GuideTooShort {
        /// Its length.
        length_m: f64,
        /// The least length.
        least_m: f64,
    },
    /// No bubble fits around the guide.
    #[error("no room {s_m:.2} m along the guide: clearance {clearance_m:.3} m, needs {keep_m:.3}")]
    Blocked {
        /// Arc length along the guide.
        s_m: f64,
        /// Clearance there.
        clearance_m: f64,
        /// Clearance needed.
        keep_m: f64,
    },
    /// No shape within the bubbles keeps the turning radius.
    #[error("no drivable shape: {0}")]
    Infeasible(SolveError),
    /// The curve still bends too tightly after all repairs.
    #[error("curvature {curvature_pm:.3} 1/m at {s_m:.2} m, allowed {limit_pm:.3}")]
    TooTight {
        /// Where.
        s_m: f64,
        /// Curvature there.
        curvature_pm: f64,
        /// The limit.
        limit_pm: f64,
    },
    /// The curve still comes too near an obstacle after all repairs.
    #[error("clearance {clearance_m:.4} m at {s_m:.2} m, must be {keep_m:.4}")]
    TooNear {
        /// Where.
        s_m: f64,
        /// Clearance there.
        clearance_m: f64,
        /// What it must be.
        keep_m: f64,
    },
    /// The car cannot brake down to what a bend allows.
    #[error("the bend at {s_m:.2} m cannot be entered: {speed_mps:.2} m/s at the least")]
    TooFast {
        /// Where.
        s_m: f64,
        /// Least speed there under full braking.
        speed_mps: f64,
    },
}
