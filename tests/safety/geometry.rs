//! Distances and accelerations, by brute force.

use apexd::frames::Point;
use apexd::map::{Cell, CellIndex, Grid};
use apexd::plan::Trajectory;
use apexd::sim::world::World;

/// Distance from a point to the closed square of a cell of side `side_m` whose lower left corner is
/// `(ix, iy)` cells from the origin, metres.
fn to_square(p: Point, ix: i64, iy: i64, side_m: f64) -> f64 {
    let beyond = |v: f64, i: i64| {
        let low = i as f64 * side_m;
        if v < low { low - v } else { (v - low - side_m).max(0.0) }
    };
    beyond(p.x, ix).hypot(beyond(p.y, iy))
}

/// Smallest distance to a cell that `counts`, at most `reach_m`.
fn nearest(p: Point, side_m: f64, reach_m: f64, mut counts: impl FnMut(i64, i64) -> bool) -> f64 {
    let cells = |v: f64| (v / side_m).floor() as i64;
    let mut least = reach_m;
    for iy in cells(p.y - reach_m)..=cells(p.y + reach_m) {
        for ix in cells(p.x - reach_m)..=cells(p.x + reach_m) {
            let distance = to_square(p, ix, iy, side_m);
            if distance < least && counts(ix, iy) {
                least = distance;
            }
        }
    }
    least
}

/// Distance to the nearest quarter of a cell that is not known to be free, metres, at most
/// `reach_m`.
pub fn to_blocked_m(grid: &Grid, p: Point, reach_m: f64) -> f64 {
    nearest(p, 0.5 * grid.resolution_m(), reach_m, |ix, iy| {
        let cell = CellIndex::new(ix.div_euclid(2) as i32, iy.div_euclid(2) as i32);
        let quarter = ix.rem_euclid(2) + 2 * iy.rem_euclid(2);
        grid.get(cell) != Cell::Free && grid.seen_quarters(cell) & (1 << quarter) == 0
    })
}

/// True distance to the nearest solid cell, metres, at most `reach_m`. The world's raster must lie
/// along the axes of the map frame.
pub fn to_solid_m(world: &World, p: Point, reach_m: f64) -> f64 {
    let origin = world.origin();
    assert_eq!(origin.heading_rad, 0.0, "the raster lies along the map's axes");
    let local = Point::from(p - origin.position);
    nearest(local, world.resolution_m(), reach_m, |ix, iy| world.is_cell_solid(ix, iy))
}

/// Arc lengths from `from_m` to the trajectory's end, at most `step_m` apart, both ends included.
pub fn stations(trajectory: &Trajectory, from_m: f64, step_m: f64) -> impl Iterator<Item = f64> {
    let length = (trajectory.last().path.s_m - from_m).max(0.0);
    let parts = (length / step_m).ceil().max(1.0);
    (0..=parts as usize).map(move |i| from_m + length * i as f64 / parts)
}

/// Smallest distance to a cell not known to be free along a trajectory, and where: the disc is
/// tested every centimetre, between which a disc of 0.2 m sinks in by less than 0.1 mm.
pub fn least_clearance_m(
    trajectory: &Trajectory,
    from_m: f64,
    grid: &Grid,
    reach_m: f64,
) -> (f64, f64) {
    stations(trajectory, from_m, 0.01)
        .map(|s| (to_blocked_m(grid, trajectory.at_distance(s).path.position, reach_m), s))
        .fold((reach_m, 0.0), |least, found| if found.0 < least.0 { found } else { least })
}

/// Largest acceleration of a trajectory, m/s^2, from second differences of positions about 20 points
/// of every edge, over a control period: what the car can be asked for. (Over less, the wiggles of
/// cubics through positions that are exact to 0.01 mm count, which nobody drives.)
pub fn peak_acceleration_mps2(trajectory: &Trajectory) -> f64 {
    const PARTS: usize = 20;
    const H_S: f64 = 0.005;
    let duration = trajectory.duration_s();
    let at = |t: f64| trajectory.at_time(t).path.position;
    let mut peak = 0.0f64;
    for edge in trajectory.points.windows(2) {
        for k in 0..PARTS {
            let t = edge[0].t_s + (edge[1].t_s - edge[0].t_s) * k as f64 / PARTS as f64;
            if t >= H_S && t + H_S <= duration {
                let second = (at(t + H_S) - at(t)) - (at(t) - at(t - H_S));
                peak = peak.max(second.norm() / (H_S * H_S));
            }
        }
    }
    peak
}

/// The squared speed from which full braking on the friction circle along the rest of a trajectory
/// still ends at rest at its end, at stations a centimetre apart: pairs of arc length and squared
/// speed, from the end to the start.
pub fn stop_profile(trajectory: &Trajectory, from_m: f64, accel_mps2: f64) -> Vec<(f64, f64)> {
    let mut stations: Vec<f64> = stations(trajectory, from_m, 0.01).collect();
    stations.reverse();
    let mut squared = 0.0f64;
    let mut profile = vec![(stations[0], 0.0)];
    for pair in stations.windows(2) {
        let curvature = |s: f64| trajectory.at_distance(s).path.curvature_pm.abs();
        let middle = curvature(0.5 * (pair[0] + pair[1]));
        let room = |b: f64| (accel_mps2.powi(2) - (middle * b).powi(2)).max(0.0).sqrt();
        let ds = pair[0] - pair[1];
        // The midpoint rule of second order.
        let half = squared + ds * room(squared);
        squared += 2.0 * ds * room(half);
        squared = squared.min(accel_mps2 / curvature(pair[1]).max(1e-9));
        profile.push((pair[1], squared));
    }
    profile
}

/// Arc length at which a car stops that brakes with all its grip along a trajectory from `s_m` on;
/// infinite if it does not stop on it.
pub fn stop_on_m(trajectory: &Trajectory, mut s_m: f64, speed_mps: f64, accel_mps2: f64) -> f64 {
    const DS: f64 = 0.005;
    let mut squared = speed_mps * speed_mps;
    let end = trajectory.last().path.s_m;
    // A little beyond the end the path is carried on, so that a small overrun has a size.
    while s_m < end + 1.0 {
        let curvature = trajectory.at_distance(s_m).path.curvature_pm;
        let brake = (accel_mps2.powi(2) - (curvature * squared).powi(2)).max(0.0).sqrt();
        if squared <= 2.0 * brake * DS {
            return s_m + squared / (2.0 * brake).max(1e-12);
        }
        squared -= 2.0 * brake * DS;
        s_m += DS;
    }
    f64::INFINITY
}
