//! Where a car that only drives forward may stop without being caught.
//!
//! A stop in known-free space is safe, but nose-on to a wall it may be the last: without reverse
//! gear a turn by a quarter needs the turning radius plus the disc's radius ahead. The escape rule
//! keeps stops away from such places. It is about getting on, not about safety: nothing here may
//! be used to prove a plan safe, and nothing needs to.
//!
//! What each part gives, for a car at rest at the pose:
//!
//! - *A quarter arc*, left or right, at the turning radius. Facing a wall, its end is parallel to
//!   the wall: the car can go on along it.
//! - *A run straight ahead* as long as the turning radius: in a passage too narrow for the arcs
//!   (a door, a corridor) the car may stop as long as the passage is seen to go on.
//! - *A turn-round*: a chain of arcs to the same axis, facing back, or to a
//!   parallel one. After the former the car is never worse off than before, for the way that it came
//!   is known free in either direction; after the latter it may face the next wall. Where plans stop
//!   by default the car can turn back onto its very tracks ([`retreat`](crate::plan::search::retreat)).
//!
//! With [`Surfaces::OccupiedAndUnknown`] and [`Surfaces::Unseen`] the arcs lie in space already seen:
//! what they promise is kept whatever the unknown holds. With [`Surfaces::Occupied`] the unknown counts as free: stops
//! may lie right at the frontier, and a wall just behind it can still catch the car.

use std::f64::consts::FRAC_PI_2;

use super::CertifyParams;
use super::clearance::{Surfaces, contact};
use crate::frames::Pose;
use crate::map::Grid;
use crate::plan::PathPoint;
use crate::plan::path::at_distance;
use crate::vehicle::VehicleParams;

/// What a stop pose must leave open.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EscapeRule {
    /// Radius of the disc that must stay clear (car and margin), metres.
    pub radius_m: f64,
    /// Radius of the tightest turn, metres.
    pub turn_radius_m: f64,
    /// What the disc must stay clear of.
    pub surfaces: Surfaces,
}

/// A piece of constant curvature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Arc {
    /// Length, metres.
    pub length_m: f64,
    /// Curvature, 1/m, positive to the left.
    pub curvature_pm: f64,
}

impl EscapeRule {
    /// The rule for a car, with the radius that its plans are certified with.
    pub fn new(certify: &CertifyParams, vehicle: &VehicleParams, surfaces: Surfaces) -> Self {
        Self {
            radius_m: vehicle.radius_m + certify.margin_m,
            turn_radius_m: vehicle.turn_radius_m,
            surfaces,
        }
    }

    /// The arc at the turning radius that turns by `turn_rad` (positive to the left).
    fn arc(&self, turn_rad: f64) -> Arc {
        Arc {
            length_m: self.turn_radius_m * turn_rad.abs(),
            curvature_pm: turn_rad.signum() / self.turn_radius_m,
        }
    }
}

/// The ways on of a car at rest at a pose, and where they end: a run straight ahead as long as the
/// turning radius, a quarter arc to the left, one to the right.
pub fn escapes(grid: &Grid, pose: Pose, rule: &EscapeRule) -> impl Iterator<Item = (Arc, Pose)> {
    let ahead = Arc { length_m: rule.turn_radius_m, curvature_pm: 0.0 };
    [ahead, rule.arc(FRAC_PI_2), rule.arc(-FRAC_PI_2)]
        .into_iter()
        .filter_map(move |arc| arc_clear(grid, pose, &arc, rule).map(|end| (arc, end)))
}

/// Whether a car at rest at a pose has a way on.
pub fn has_escape(grid: &Grid, pose: Pose, rule: &EscapeRule) -> bool {
    leads_on(grid, pose, rule, 1)
}

/// Whether a car at rest at a pose has so many ways on, one after the other: fewer may lead into a
/// nook.
pub fn leads_on(grid: &Grid, pose: Pose, rule: &EscapeRule, ways: u32) -> bool {
    ways == 0 || escapes(grid, pose, rule).any(|(_, end)| leads_on(grid, end, rule, ways - 1))
}

/// The largest arc length, not above `s_max_m`, at which a stop is good: `s_max_m` itself or a
/// sample of the path before it. `None` if there is none, not even at the path's start.
pub fn last_stop(path: &[PathPoint], s_max_m: f64, is_good: impl Fn(Pose) -> bool) -> Option<f64> {
    let is_good =
        |p: &PathPoint| is_good(Pose { position: p.position, heading_rad: p.heading_rad });
    let end = at_distance(path, s_max_m)?;
    if is_good(&end) {
        return Some(end.s_m);
    }
    let before = path.partition_point(|p| p.s_m < s_max_m);
    path[..before].iter().rev().find(|p| is_good(p)).map(|p| p.s_m)
}

/// The pose at the end of an arc if the disc is clear all along it.
fn arc_clear(grid: &Grid, start: Pose, arc: &Arc, rule: &EscapeRule) -> Option<Pose> {
    const STEP_RAD: f64 = 0.1;
    let turn = arc.length_m * arc.curvature_pm;
    // Straight runs are one segment.
    let pieces = (turn.abs() / STEP_RAD).ceil().max(1.0);
    let (length, turn) = (arc.length_m / pieces, turn / pieces);
    // Sagitta of a piece over its chord: R (1 - cos(turn / 2)).
    let sagitta = 0.125 * length * turn.abs();
    let mut pose = start;
    for _ in 0..pieces as usize {
        let next = pose.along_arc(length, turn);
        let reach = rule.radius_m + sagitta;
        if contact(grid, pose.position, next.position, reach, rule.surfaces).is_some() {
            return None;
        }
        pose = next;
    }
    Some(pose)
}
