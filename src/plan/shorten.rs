//! Cutting a plan under way short when something has been set down on it.

use super::certify::{Surfaces, clear_length_m};
use super::speed::{End, SpeedLimits, SpeedProfiler, SpeedTask};
use super::{Path, Trajectory};
use crate::map::Grid;
use crate::time::Instant;

/// The rest of a trajectory from `now` on, ending at rest before the first place where a disc of
/// `radius_m` would leave known-free space. `None` if the car cannot stop before it.
pub fn shorten(
    trajectory: &Trajectory,
    now: Instant,
    grid: &Grid,
    radius_m: f64,
    limits: &SpeedLimits,
) -> Option<Trajectory> {
    const SHORTEST_EDGE_M: f64 = 1e-3;
    let state = trajectory.at(now);
    let mut points = vec![state.path];
    points.extend(
        trajectory
            .points
            .iter()
            .map(|p| p.path)
            .filter(|p| p.s_m > state.path.s_m + SHORTEST_EDGE_M),
    );
    for point in &mut points {
        point.s_m -= state.path.s_m;
    }
    let mut path = Path { points };
    let clear_m = clear_length_m(grid, &path.points, radius_m, Surfaces::Unseen);
    path.cut(clear_m);
    let task = SpeedTask { start_speed_mps: state.speed_mps, end: End::Rest, caps_mps: None };
    let mut points = Vec::new();
    SpeedProfiler::new().profile(&path.points, limits, &task, &mut points).ok()?;
    Some(Trajectory { start: now, points })
}
