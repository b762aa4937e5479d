//! Cutting the braking tail out of the trajectory being driven.

use super::ControlParams;
use super::tracker::foot_of;
use crate::command::{BrakingTail, TailSample};
use crate::frames::{Pose, Vector, heading_vector, wrap_angle};
use crate::plan::{PathPoint, Trajectory};
use crate::scan::Odometry;
use crate::vehicle::VehicleParams;

/// Room left behind the computed stop, metres.
const MARGIN_M: f64 = 0.1;
/// Step of the forward braking calculation, metres.
const STEP_M: f64 = 0.05;
/// The sample spacing is a multiple of this (rounded down), so that a frame carries it exactly and
/// the last sample lies at the plan's stop, not beyond it.
const SPACING_QUANTUM_M: f64 = 1e-5;

/// The braking tail of a trajectory for a car that stood at `pose` (map frame) when `odometry` was
/// measured: the plan's path and speed limit from there on, as far as a stop needs that begins
/// `tail_hold_s` later. It never ends beyond the plan's own stop.
pub fn braking_tail(
    plan: u16,
    trajectory: &Trajectory,
    odometry: &Odometry,
    pose: Pose,
    vehicle: &VehicleParams,
    params: &ControlParams,
) -> BrakingTail {
    let wanted = trajectory.at(odometry.stamp);
    let foot = foot_of(trajectory, pose, wanted.path.s_m);
    let at_foot = trajectory.at_distance(foot).path;
    // Before the first sample (a plan that begins a moment later) the path is carried back.
    let ahead = (pose.position - at_foot.position).dot(&heading_vector(at_foot.heading_rad));
    let s0 = if foot <= 0.0 { ahead.min(0.0) } else { foot };
    let start = on_path(trajectory, s0);
    let off: Vector = pose.position - start.position;
    let forward = heading_vector(start.heading_rad);

    let stop = trajectory.last().path.s_m;
    let limit = vehicle.acceleration_limit_mps2();
    let accel = limit * params.tail_grip_share;
    let braked = braked_by(trajectory, s0, accel, params.tail_hold_s);
    let cut_short = braked < stop;
    let length = braked.min(stop) - s0;
    let parts = (length / params.tail_spacing_m).ceil();
    let (parts, spacing) = if parts >= 1.0 {
        let spacing = (length / parts / SPACING_QUANTUM_M + 1e-6).floor() * SPACING_QUANTUM_M;
        if spacing > 0.0 { (parts as usize, spacing) } else { (0, params.tail_spacing_m) }
    } else {
        (0, params.tail_spacing_m)
    };

    let mut samples: Vec<TailSample> = (0..=parts)
        .map(|i| {
            let s = s0 + i as f64 * spacing;
            // Mean curvature about the sample (the first and last: of the half step inside): the
            // headings of the piecewise linear curve then keep to the path's, whatever happens
            // between the samples.
            let from = if i == 0 { s } else { s - 0.5 * spacing };
            let to = if i == parts && parts > 0 { s } else { s + 0.5 * spacing };
            let turn = on_path(trajectory, to).heading_rad - on_path(trajectory, from).heading_rad;
            let width = to.min(stop) - from;
            TailSample {
                curvature_pm: if width > 1e-4 {
                    wrap_angle(turn) / width
                } else {
                    on_path(trajectory, s).curvature_pm
                },
                speed_mps: trajectory.at_distance(s).speed_mps,
            }
        })
        .collect();
    if cut_short {
        stop_at_last(&mut samples, spacing, accel, limit);
    } else {
        samples[parts].speed_mps = 0.0;
    }
    BrakingTail {
        plan,
        anchor_travelled_m: odometry.travelled_m,
        anchor_turned_rad: odometry.turned_rad - wrap_angle(pose.heading_rad - start.heading_rad),
        anchor_offset_m: forward.x * off.y - forward.y * off.x,
        spacing_m: spacing,
        samples,
    }
}

/// The path at `s_m`, carried back in the direction of its first sample for negative distances.
fn on_path(trajectory: &Trajectory, s_m: f64) -> PathPoint {
    let point = trajectory.at_distance(s_m).path;
    if s_m >= 0.0 {
        return point;
    }
    let back = Pose { position: point.position, heading_rad: point.heading_rad }
        .along_arc(s_m, s_m * point.curvature_pm);
    PathPoint { s_m, position: back.position, heading_rad: back.heading_rad, ..point }
}

/// Where a car stops that follows the trajectory for `hold_s` from `s0_m` and then brakes with
/// `accel` on the friction circle, never faster than the trajectory.
fn braked_by(trajectory: &Trajectory, s0_m: f64, accel: f64, hold_s: f64) -> f64 {
    let here = trajectory.at_distance(s0_m);
    let late = s0_m.min(0.0) / here.speed_mps.max(0.1);
    let begin = trajectory.at_time(here.t_s + late + hold_s);
    let stop = trajectory.last().path.s_m;
    let mut s = begin.path.s_m;
    // The car may be ahead of the plan's speed by the tracker's tolerance.
    let mut b = begin.speed_mps * begin.speed_mps;
    while s < stop {
        let at = trajectory.at_distance(s);
        b = b.min(at.speed_mps * at.speed_mps);
        let lateral = at.path.curvature_pm * b;
        let brake = (accel * accel - lateral * lateral).max(0.0).sqrt();
        if b <= 2.0 * brake * STEP_M {
            s += if brake > 0.0 { b / (2.0 * brake) } else { 0.0 };
            break;
        }
        b -= 2.0 * brake * STEP_M;
        s += STEP_M;
    }
    s + MARGIN_M
}

/// Lowers the speeds to a stop at the last sample: each one can be braked down to the next within
/// the friction circle at both ends of the stretch between them (squared speed linear in distance).
/// Where the plan itself takes more than `accel`, as much is there for the tail, up to `limit`: a car
/// on its plan is not too fast for its tail.
fn stop_at_last(samples: &mut [TailSample], spacing_m: f64, accel: f64, limit: f64) {
    let p = 1.0 / (4.0 * spacing_m * spacing_m);
    let last = samples.len() - 1;
    let mut planned_ahead = samples[last].speed_mps.powi(2);
    samples[last].speed_mps = 0.0;
    for i in (0..last).rev() {
        let (k0, k1) = (samples[i].curvature_pm, samples[i + 1].curvature_pm);
        let planned = samples[i].speed_mps.powi(2);
        let planned_brake = ((planned - planned_ahead) / (2.0 * spacing_m)).max(0.0);
        let planned_lateral = (k0 * planned).abs().max((k1 * planned_ahead).abs());
        let grip = planned_brake.hypot(planned_lateral).clamp(accel, limit);
        planned_ahead = planned;

        let c = samples[i + 1].speed_mps.powi(2);
        let room = (grip * grip - (k1 * c).powi(2)).max(0.0).sqrt();
        let far_end = c + 2.0 * spacing_m * room;
        // p (b - c)^2 + k0^2 b^2 = grip^2, the larger root; without one, no braking is left.
        let q = p + k0 * k0;
        let discriminant = (p * c).powi(2) - q * (p * c * c - grip * grip);
        let near_end = (p * c + discriminant.max(0.0).sqrt()) / q;
        samples[i].speed_mps = far_end.min(near_end).clamp(0.0, planned).sqrt();
    }
}

#[cfg(test)]
#[path = "braking_tests.rs"]
mod tests;
