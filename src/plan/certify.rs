//! The safety proof of a plan: it knows the grid and the plan, never a prediction, and computes
//! everything anew from the samples that will be driven.
//!
//! A trajectory that passes ends at rest, its disc never leaves space that has been seen to be free, and the tyres and
//! the steering can do what it asks. Then standing still at its end is always the last resort, and
//! from every point on the way the rest of the trajectory itself is the way to stop: that the stop
//! is within reach from everywhere needs no check of its own beside friction and final rest.
//!
//! The smoothing need not be trusted: positions, headings and curvatures must agree with each other
//! to the tolerances below, and what they may disagree by is added where it counts (the bulge of
//! the curve over its chord, the curvature of the friction check).

mod clearance;
mod escape;
#[cfg(test)]
mod tests;
mod violation;

use super::path::{PathPoint, Trajectory, TrajectoryPoint, between};
use crate::frames::{Pose, wrap_angle};
use crate::map::Grid;
use crate::plan::speed::SpeedParams;
use crate::tunables;
use crate::vehicle::VehicleParams;

pub use clearance::Surfaces;
pub use escape::{Arc, EscapeRule, escapes, has_escape, last_stop, leads_on};
pub use violation::Violation;

use clearance::{Contact, contact, edge_contact, open_around};

tunables! {
    /// What the safety proof of a plan adds to the car.
    pub struct CertifyParams in "certify" {
        /// Added to the car's radius: 0.02 m for tracking, 0.02 m for localisation, 0.01 m for the
        /// map.
        margin_m: f64 = 0.05, at_rest, in 0.0..=0.5, "m";
    }
}

/// What a plan must keep to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Radius of the disc that must stay in known-free space (car and margin), metres.
    pub radius_m: f64,
    /// Largest curvature, 1/m.
    pub curvature_max_pm: f64,
    /// What the tyres hold, m/s^2: all of it, not the share that plans are made with.
    pub accel_limit_mps2: f64,
    /// Largest speed, m/s.
    pub speed_max_mps: f64,
}

impl Limits {
    /// The limits of a car.
    pub fn new(certify: &CertifyParams, vehicle: &VehicleParams, speed: &SpeedParams) -> Self {
        Self {
            radius_m: vehicle.radius_m + certify.margin_m,
            curvature_max_pm: vehicle.curvature_limit_pm(),
            accel_limit_mps2: vehicle.acceleration_limit_mps2(),
            speed_max_mps: speed.speed_max_mps,
        }
    }
}

/// How far positions may be from the curve that headings and curvatures describe, metres.
const POSITION_TOLERANCE_M: f64 = 1e-5;
/// How far a heading may be from what its neighbours' positions allow, radians. What it bends the
/// curve by is added to the radius.
const HEADING_TOLERANCE_RAD: f64 = 5e-3;
/// Tolerance of curvatures measured on positions and headings, relative to the largest allowed.
const MEASURED_CURVATURE_TOLERANCE: f64 = 0.01;
/// Largest difference between the turn of the headings and the curvatures given, relative to the
/// largest curvature. The friction check uses the sum.
const CURVATURE_MISMATCH: f64 = 0.05;
/// Edges looked at together first; most stretches are open.
const GROUP: usize = 4;
/// Relative tolerance of quantities that are only rounded.
const ROUNDING: f64 = 1e-6;

/// A proof that has been carried out, with the figures it found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Certificate {
    /// Length of the trajectory, metres.
    pub length_m: f64,
    /// Seconds until rest.
    pub duration_s: f64,
    /// Largest speed, m/s.
    pub speed_max_mps: f64,
    /// Largest share of the tyres' force, between the samples too.
    pub friction_use: f64,
    /// Largest curvature without sign, 1/m.
    pub curvature_max_pm: f64,
}

/// How exactly a plan must continue the state it takes over.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StartTolerance {
    /// Position, metres.
    pub offset_m: f64,
    /// Heading, radians.
    pub turn_rad: f64,
    /// Speed, m/s.
    pub speed_mps: f64,
}

impl Default for StartTolerance {
    /// Rounding only: the plan is computed from the very state it is to continue.
    fn default() -> Self {
        Self { offset_m: ROUNDING, turn_rad: ROUNDING, speed_mps: ROUNDING }
    }
}

/// Whether a trajectory continues a state: same place, same heading, same speed.
pub fn check_start(
    trajectory: &Trajectory,
    pose: Pose,
    speed_mps: f64,
    tolerance: &StartTolerance,
) -> Result<(), Violation> {
    let Some(first) = trajectory.points.first() else { return Err(Violation::Empty) };
    let offset_m = (first.path.position - pose.position).norm();
    let turn_rad = wrap_angle(first.path.heading_rad - pose.heading_rad).abs();
    let speed_off = (first.speed_mps - speed_mps).abs();
    let within = offset_m <= tolerance.offset_m
        && turn_rad <= tolerance.turn_rad
        && speed_off <= tolerance.speed_mps;
    if within { Ok(()) } else { Err(Violation::Start { offset_m, turn_rad, speed_mps: speed_off }) }
}

/// Checks everything that makes a trajectory safe to drive to its end: the swept disc in known-free
/// space, rest at the end, smoothness, curvature, friction (exactly, between samples too), speed
/// and time.
pub fn certify(
    trajectory: &Trajectory,
    grid: &Grid,
    limits: &Limits,
) -> Result<Certificate, Violation> {
    let points = &trajectory.points;
    let Some(last) = points.last() else { return Err(Violation::Empty) };
    let mut found = Certificate {
        length_m: last.path.s_m - points[0].path.s_m,
        duration_s: last.t_s,
        speed_max_mps: 0.0,
        friction_use: 0.0,
        curvature_max_pm: 0.0,
    };
    if points[0].t_s != 0.0 {
        let value = points[0].t_s;
        return Err(Violation::NotIncreasing { sample: 0, what: "time", value, before: 0.0 });
    }
    for (sample, p) in points.iter().enumerate() {
        check_sample(sample, p, limits)?;
        found.speed_max_mps = found.speed_max_mps.max(p.speed_mps);
        found.curvature_max_pm = found.curvature_max_pm.max(p.path.curvature_pm.abs());
    }
    for (sample, edge) in points.windows(2).enumerate() {
        check_shape(sample, &edge[0].path, &edge[1].path, limits)?;
        let accel = check_motion(sample, &edge[0], &edge[1], limits)?;
        found.friction_use = found.friction_use.max(accel / limits.accel_limit_mps2);
    }
    for (i, corner) in points.windows(3).enumerate() {
        check_bend(i + 1, &corner[0].path, &corner[1].path, &corner[2].path, limits)?;
    }
    if last.speed_mps != 0.0 {
        return Err(Violation::NotAtRest { speed_mps: last.speed_mps });
    }
    check_swept(points[0].path, points, grid, limits.radius_m)?;
    Ok(found)
}

/// Checks again that the rest of a certified trajectory, from `from_time_s` seconds after its start
/// on, lies in known-free space: for when the map has changed under it.
pub fn recertify(
    trajectory: &Trajectory,
    from_time_s: f64,
    grid: &Grid,
    radius_m: f64,
) -> Result<(), Violation> {
    let points = &trajectory.points;
    if points.is_empty() {
        return Err(Violation::Empty);
    }
    let next = points.partition_point(|p| p.t_s <= from_time_s).max(1);
    check_swept(trajectory.at_time(from_time_s).path, &points[next - 1..], grid, radius_m)
}

/// Arc length of the longest start of a path along which a disc stays clear of surfaces, to within a
/// thirtieth of an edge, never too long. Zero if not even the first sample is clear. Unless unknown
/// space was hoped to be free, a path cut there ([`Path::cut`](super::Path::cut)) passes the
/// swept-disc check.
pub fn clear_length_m(grid: &Grid, path: &[PathPoint], radius_m: f64, surfaces: Surfaces) -> f64 {
    // So that the rounding of cutting and interpolating again cannot turn the answer round.
    let radius = radius_m + ROUNDING;
    let blocked =
        |a: &PathPoint, b: &PathPoint| edge_contact(grid, a, b, radius, surfaces).is_some();
    let Some(first) = path.first() else { return 0.0 };
    if blocked(first, first) {
        return 0.0;
    }
    for start in (0..path.len() - 1).step_by(GROUP) {
        let group = &path[start..(start + GROUP + 1).min(path.len())];
        if open_around(grid, group.iter(), radius) {
            continue;
        }
        let Some(edge) = group.windows(2).find(|edge| blocked(&edge[0], &edge[1])) else {
            continue;
        };
        let (mut clear, mut contact) = (0.0, 1.0);
        for _ in 0..5 {
            let middle = 0.5 * (clear + contact);
            if blocked(&edge[0], &between(&edge[0], &edge[1], middle)) {
                contact = middle;
            } else {
                clear = middle;
            }
        }
        return edge[0].s_m + clear * (edge[1].s_m - edge[0].s_m);
    }
    path.last().map_or(0.0, |p| p.s_m)
}

/// The swept disc from `start`, which lies on the edge after `points[0]`, to the end.
fn check_swept(
    start: PathPoint,
    points: &[TrajectoryPoint],
    grid: &Grid,
    radius_m: f64,
) -> Result<(), Violation> {
    let violation = |a: &PathPoint, b: &PathPoint, c: Contact| Violation::Swept {
        s_m: a.s_m,
        distance_m: c.distance_m,
        needed_m: radius_m + clearance::bulge_m(a, b),
        cell: c.cell,
        state: c.state,
    };
    let mut a = start;
    for group in points[1..].chunks(GROUP) {
        let ends = group.iter().map(|p| &p.path);
        if open_around(grid, std::iter::once(&a).chain(ends), radius_m) {
            a = group[group.len() - 1].path;
            continue;
        }
        for p in group {
            let found = edge_contact(grid, &a, &p.path, radius_m, Surfaces::Unseen);
            if let Some(c) = found {
                return Err(violation(&a, &p.path, c));
            }
            a = p.path;
        }
    }
    // Of a trajectory of one sample there is no edge.
    match contact(grid, a.position, a.position, radius_m, Surfaces::Unseen) {
        Some(c) => Err(violation(&a, &a, c)),
        None => Ok(()),
    }
}

/// Finite numbers, speed and curvature of one sample.
fn check_sample(sample: usize, p: &TrajectoryPoint, limits: &Limits) -> Result<(), Violation> {
    let numbers = [
        ("arc length", p.path.s_m),
        ("x", p.path.position.x),
        ("y", p.path.position.y),
        ("heading", p.path.heading_rad),
        ("curvature", p.path.curvature_pm),
        ("time", p.t_s),
        ("speed", p.speed_mps),
        ("acceleration", p.accel_mps2),
    ];
    for (what, value) in numbers {
        if !value.is_finite() {
            return Err(Violation::NotFinite { sample, what, value });
        }
    }
    if p.speed_mps < 0.0 || p.speed_mps > limits.speed_max_mps * (1.0 + ROUNDING) {
        let allowed_mps = limits.speed_max_mps;
        return Err(Violation::Speed { sample, speed_mps: p.speed_mps, allowed_mps });
    }
    let allowed_pm = limits.curvature_max_pm * (1.0 + ROUNDING);
    if p.path.curvature_pm.abs() > allowed_pm {
        let curvature_pm = p.path.curvature_pm.abs();
        return Err(Violation::Curvature { sample, how: "given", curvature_pm, allowed_pm });
    }
    Ok(())
}

/// The turn from one direction to another, radians.
#[inline]
fn turn(from_rad: f64, to_rad: f64) -> f64 {
    let difference = to_rad - from_rad;
    // Mostly small already, and the remainder that wrapping takes is slow.
    if difference.abs() < 3.0 { difference } else { wrap_angle(difference) }
}

/// Positions, arc length, headings and curvatures of one edge describe one curve.
fn check_shape(
    sample: usize,
    a: &PathPoint,
    b: &PathPoint,
    limits: &Limits,
) -> Result<(), Violation> {
    let arc_m = b.s_m - a.s_m;
    if arc_m <= 0.0 {
        let (value, before) = (b.s_m, a.s_m);
        return Err(Violation::NotIncreasing {
            sample: sample + 1,
            what: "arc length",
            value,
            before,
        });
    }
    let chord = b.position - a.position;
    let chord_m = chord.norm();
    // An arc of angle phi is longer than its chord by phi^2 / 24.
    let tightest = limits.curvature_max_pm * arc_m;
    let shortest = arc_m * (1.0 - tightest * tightest / 20.0) - 2.0 * POSITION_TOLERANCE_M;
    if chord_m > arc_m + 2.0 * POSITION_TOLERANCE_M || chord_m < shortest {
        return Err(Violation::Chord { sample: sample + 1, chord_m, arc_m });
    }
    let direction = chord.y.atan2(chord.x);
    let allowed_rad = 0.5 * tightest * (1.0 + MEASURED_CURVATURE_TOLERANCE)
        + HEADING_TOLERANCE_RAD
        + 2.0 * POSITION_TOLERANCE_M / arc_m;
    for (sample, heading) in [(sample, a.heading_rad), (sample + 1, b.heading_rad)] {
        let angle_rad = turn(direction, heading).abs();
        if angle_rad > allowed_rad {
            return Err(Violation::Tangent { sample, angle_rad, allowed_rad });
        }
    }
    let given_pm = 0.5 * (a.curvature_pm + b.curvature_pm);
    let turned_pm = turn(a.heading_rad, b.heading_rad) / arc_m;
    let rounding = ROUNDING * ROUNDING / arc_m;
    if (turned_pm - given_pm).abs() > CURVATURE_MISMATCH * limits.curvature_max_pm + rounding {
        return Err(Violation::CurvatureMismatch { sample, turned_pm, given_pm });
    }
    Ok(())
}

/// Curvature of the circle through three positions.
fn check_bend(
    sample: usize,
    a: &PathPoint,
    b: &PathPoint,
    c: &PathPoint,
    limits: &Limits,
) -> Result<(), Violation> {
    let (before, after) = (b.position - a.position, c.position - b.position);
    let (l0, l1, whole) = (before.norm(), after.norm(), (c.position - a.position).norm());
    let cross = (before.x * after.y - before.y * after.x).abs();
    // A turn by more than a right angle from one edge to the next is no sampling of a path.
    let sharp = before.dot(&after) <= 0.0;
    let curvature_pm = if sharp { f64::INFINITY } else { 2.0 * cross / (l0 * l1 * whole) };
    let noise = 4.0 * POSITION_TOLERANCE_M * (1.0 / l0 + 1.0 / l1) / (l0 + l1);
    let allowed_pm = limits.curvature_max_pm * (1.0 + MEASURED_CURVATURE_TOLERANCE) + noise;
    if curvature_pm > allowed_pm {
        return Err(Violation::Curvature { sample, how: "measured", curvature_pm, allowed_pm });
    }
    Ok(())
}

/// Time, speed and acceleration of one edge describe one motion that the tyres hold. Returns its
/// largest acceleration: along the path it is constant; across, the product of a linear curvature
/// and a linear squared speed, largest at an end or where its derivative vanishes.
fn check_motion(
    sample: usize,
    a: &TrajectoryPoint,
    b: &TrajectoryPoint,
    limits: &Limits,
) -> Result<f64, Violation> {
    let ds = b.path.s_m - a.path.s_m;
    if b.t_s <= a.t_s {
        let (value, before) = (b.t_s, a.t_s);
        return Err(Violation::NotIncreasing { sample: sample + 1, what: "time", value, before });
    }
    let mean_speed = 0.5 * (a.speed_mps + b.speed_mps);
    // Two zero speeds in a row get nowhere: the expected duration is infinite then.
    let (value, expected) = (b.t_s - a.t_s, ds / mean_speed);
    let differ = (value * mean_speed - ds).abs() > ROUNDING * (ds + ROUNDING);
    if differ || mean_speed == 0.0 {
        return Err(Violation::Motion { sample, what: "duration", value, expected });
    }
    let (b0, b1) = (a.speed_mps * a.speed_mps, b.speed_mps * b.speed_mps);
    let along = (b1 - b0) / (2.0 * ds);
    if (along - a.accel_mps2).abs() > ROUNDING * (limits.accel_limit_mps2 + along.abs()) {
        let (value, expected) = (a.accel_mps2, along);
        return Err(Violation::Motion { sample, what: "acceleration", value, expected });
    }
    let given = 0.5 * (a.path.curvature_pm + b.path.curvature_pm);
    let turned = turn(a.path.heading_rad, b.path.heading_rad) / ds;
    let k0 = a.path.curvature_pm + (turned - given);
    let (dk, db) = (b.path.curvature_pm - a.path.curvature_pm, b1 - b0);
    let across = |u: f64| ((k0 + dk * u) * (b0 + db * u)).abs();
    let mut largest = across(0.0).max(across(1.0));
    let top = -(k0 * db + dk * b0) / (2.0 * dk * db);
    if top > 0.0 && top < 1.0 {
        largest = largest.max(across(top));
    }
    let accel_mps2 = along.hypot(largest);
    let allowed_mps2 = limits.accel_limit_mps2;
    if accel_mps2 > allowed_mps2 * (1.0 + ROUNDING) {
        return Err(Violation::Friction { sample, accel_mps2, allowed_mps2 });
    }
    Ok(accel_mps2)
}
