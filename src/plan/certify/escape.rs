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
//! - *A turn-round* ([`turn_round`]): a chain of arcs to the same axis, facing back, or to a
//!   parallel one. After the former the car is never worse off than before, for the way that it came
//!   is known free in either direction; after the latter it may face the next wall. Where plans stop
//!   by default the car can turn back onto its very tracks ([`retreat`](crate::plan::search::retreat)).
//!
//! With [`Surfaces::OccupiedAndUnknown`] the arcs lie in space already seen: what they promise is
//! kept whatever the unknown holds. With [`Surfaces::Occupied`] the unknown counts as free: stops
//! may lie right at the frontier, and a wall just behind it can still catch the car.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, PI};

use super::CertifyParams;
use super::clearance::{Surfaces, contact};
use crate::frames::Pose;
use crate::map::Grid;
use crate::plan::path::at_distance;
use crate::plan::{Path, PathPoint};
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

/// Whether a car at rest at a pose has a way on: a quarter arc to the left or to the right, or a
/// run straight ahead as long as the turning radius.
pub fn has_escape(grid: &Grid, pose: Pose, rule: &EscapeRule) -> bool {
    let ahead = Arc { length_m: rule.turn_radius_m, curvature_pm: 0.0 };
    [ahead, rule.arc(FRAC_PI_2), rule.arc(-FRAC_PI_2)]
        .iter()
        .any(|arc| arc_clear(grid, pose, arc, rule).is_some())
}

/// The largest arc length, not above `s_max_m`, at which a stop leaves a way on: `s_max_m` itself
/// or a sample of the path before it. `None` if there is none, not even at the path's start.
pub fn last_escapable(
    grid: &Grid,
    path: &[PathPoint],
    s_max_m: f64,
    rule: &EscapeRule,
) -> Option<f64> {
    let escapes = |p: &PathPoint| {
        let pose = Pose { position: p.position, heading_rad: p.heading_rad };
        has_escape(grid, pose, rule)
    };
    let end = at_distance(path, s_max_m)?;
    if escapes(&end) {
        return Some(end.s_m);
    }
    let before = path.partition_point(|p| p.s_m < s_max_m);
    path[..before].iter().rev().find(|p| escapes(p)).map(|p| p.s_m)
}

/// Arcs that turn the car round without reverse gear, the whole way clear: onto the same axis
/// facing back where that is possible (a sixth of a turn out, five sixths of a circle, a sixth
/// back), or to a parallel one. `None` if none of them is clear from this pose.
pub fn turn_round(grid: &Grid, pose: Pose, rule: &EscapeRule) -> Option<Vec<Arc>> {
    // Swinging out first by `swing` moves the axis of the way back from twice the turning radius
    // to the side, at zero, to none at a sixth of a turn.
    const SWINGS: [f64; 3] = [0.0, FRAC_PI_3 / 3.0, FRAC_PI_3 * 2.0 / 3.0];
    let mut candidates = Vec::with_capacity(8);
    for side in [1.0, -1.0] {
        let out = rule.arc(-side * FRAC_PI_3);
        candidates.push(vec![out, rule.arc(side * (PI + 2.0 * FRAC_PI_3)), out]);
    }
    for swing in SWINGS {
        for side in [1.0, -1.0] {
            let mut arcs = vec![rule.arc(side * (PI + swing))];
            if swing > 0.0 {
                arcs.insert(0, rule.arc(-side * swing));
            }
            candidates.push(arcs);
        }
    }
    candidates.into_iter().find(|arcs| {
        arcs.iter().try_fold(pose, |pose, arc| arc_clear(grid, pose, arc, rule)).is_some()
    })
}

/// A chain of arcs as a path with samples at most `spacing_m` (no less than a millimetre) apart. Where one arc meets the next
/// the curvature changes linearly within two millimetres: too short to matter for where the path
/// leads, long enough to be a path like any other.
pub fn arcs_path(start: Pose, arcs: &[Arc], spacing_m: f64) -> Path {
    const HALF_JOIN_M: f64 = 1e-3;
    let mut pose = start;
    let mut path = Path::default();
    let mut push = |pose: &Pose, s_m: f64, curvature_pm: f64| {
        path.points.push(PathPoint {
            s_m,
            position: pose.position,
            heading_rad: pose.heading_rad,
            curvature_pm,
        });
    };
    let mut s = 0.0;
    // Curvature and half length of the join that leads to the next arc.
    let mut join = None::<(f64, f64)>;
    let driven = arcs.iter().filter(|a| a.length_m > 0.0);
    let mut driven = driven.peekable();
    while let Some(arc) = driven.next() {
        let k = arc.curvature_pm;
        let mut length = arc.length_m;
        if let Some((before, half)) = join {
            pose = pose.along_arc(2.0 * half, (before + k) * half);
            s += 2.0 * half;
            length -= half;
        }
        push(&pose, s, k);
        join = driven.peek().map(|next| {
            let half = HALF_JOIN_M.min(0.25 * arc.length_m).min(0.25 * next.length_m);
            length -= half;
            (k, half)
        });
        let pieces = (length / spacing_m.max(HALF_JOIN_M)).ceil().max(1.0);
        let ds = length / pieces;
        for _ in 0..pieces as usize {
            pose = pose.along_arc(ds, k * ds);
            s += ds;
            push(&pose, s, k);
        }
    }
    path
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
