//! Feedforward from the trajectory, feedback on the errors, all inside the friction circle.

use super::ControlParams;
use crate::command::ForceSetpoint;
use crate::frames::{Pose, Vector, heading_vector, wrap_angle};
use crate::plan::Trajectory;
use crate::tail::BEND_SHARE_MIN;
use crate::time::Instant;
use crate::vehicle::VehicleParams;

/// Below this speed and within the stop tolerance the car is made to stand.
const STANDING_MPS: f64 = 0.15;
/// Errors along the path count at most this much, metres: a car held up does not storm after its
/// plan.
const ALONG_ERROR_MAX_M: f64 = 0.1;
/// Lateral errors count at most this much, metres.
const LATERAL_ERROR_MAX_M: f64 = 0.1;
/// Share of the grip with which a standing car is held.
const HOLD_SHARE: f64 = 0.1;
/// Share of the planned speed by which a car may be faster before a bend no longer gets all the grip
/// that it asks for (half the reserve that plans leave), and by which it is where it gets the least.
const HASTE_FROM: f64 = 0.015;
const HASTE_TO: f64 = 0.06;

/// How far the car is from its trajectory.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct TrackingError {
    /// To the left of the path, metres.
    pub lateral_m: f64,
    /// Ahead of where it should be by now, metres.
    pub along_m: f64,
    /// Heading less the path's, radians.
    pub heading_rad: f64,
    /// Speed less the trajectory's, m/s.
    pub speed_mps: f64,
}

/// One step of the tracker.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tracking {
    /// What to tell the car.
    pub setpoint: ForceSetpoint,
    /// How far off it is.
    pub error: TrackingError,
    /// Distance along the trajectory at which the car is, metres.
    pub s_m: f64,
}

/// Follows trajectories. Carries nothing from step to step, so a new plan can take over at any time.
#[derive(Clone, Debug)]
pub struct Tracker {
    params: ControlParams,
    period_s: f64,
    mass_kg: f64,
    accel_limit_mps2: f64,
    curvature_limit_pm: f64,
}

impl Tracker {
    /// A tracker for a car that gets a setpoint every `period_s` seconds; each one is made for the
    /// middle of its period.
    pub fn new(vehicle: &VehicleParams, params: &ControlParams, period_s: f64) -> Self {
        Self {
            params: params.clone(),
            period_s,
            mass_kg: vehicle.mass_kg,
            accel_limit_mps2: vehicle.acceleration_limit_mps2(),
            curvature_limit_pm: vehicle.curvature_limit_pm(),
        }
    }

    /// The setpoint for the period that begins at `now` (plus the transport delay). `pose` and
    /// `speed_mps` are the estimates for `now`.
    pub fn track(
        &self,
        trajectory: &Trajectory,
        now: Instant,
        pose: Pose,
        speed_mps: f64,
    ) -> Tracking {
        let p = &self.params;
        let t = now.seconds_after(trajectory.start);
        let wanted = trajectory.at_time(t);
        let s = foot_of(trajectory, pose, wanted.path.s_m);
        let foot = trajectory.at_distance(s).path;
        let forward = heading_vector(foot.heading_rad);
        let off: Vector = pose.position - foot.position;
        // Beyond an end of the path the along error goes on growing.
        let s_free = s + off.dot(&forward);
        let error = TrackingError {
            lateral_m: forward.x * off.y - forward.y * off.x,
            along_m: s_free - wanted.path.s_m,
            heading_rad: wrap_angle(pose.heading_rad - foot.heading_rad),
            speed_mps: speed_mps - wanted.speed_mps,
        };

        let start = t + p.transport_delay_s;
        let end = start + self.period_s;
        let finished = end >= trajectory.duration_s();
        let to_go = trajectory.last().path.s_m - s_free;
        let setpoint = if finished && to_go <= p.stop_tolerance_m && speed_mps <= STANDING_MPS {
            self.stand(foot.curvature_pm, speed_mps)
        } else {
            let feedforward = (trajectory.at_time(end).speed_mps
                - trajectory.at_time(start).speed_mps)
                / self.period_s;
            let accel = self.along(trajectory, feedforward, &error, s_free, speed_mps);
            let curvature = self.curvature(trajectory, &error, s_free, speed_mps, accel);
            let planned_mps = trajectory.at_distance(s_free).speed_mps;
            self.forces(accel, curvature, speed_mps, planned_mps)
        };
        Tracking { setpoint, error, s_m: s }
    }

    /// Acceleration wished for, m/s^2.
    fn along(
        &self,
        trajectory: &Trajectory,
        feedforward: f64,
        error: &TrackingError,
        s: f64,
        speed: f64,
    ) -> f64 {
        let p = &self.params;
        let tau = p.along_settle_s;
        let along = error.along_m.clamp(-ALONG_ERROR_MAX_M, ALONG_ERROR_MAX_M);
        let wished = feedforward - along / (tau * tau) - 2.0 * error.speed_mps / tau;
        // Catching up must not exceed the certified speed of the place: the faster one of here and
        // a few centimetres on (from which a car at rest can start).
        let horizon = p.transport_delay_s + self.period_s;
        let next = s + speed * horizon;
        let limit = trajectory
            .at_distance(next)
            .speed_mps
            .max(trajectory.at_distance(next + 0.03).speed_mps)
            + p.overspeed_mps;
        wished.min((limit - speed) / horizon)
    }

    /// Curvature to be driven during the period, 1/m.
    fn curvature(
        &self,
        trajectory: &Trajectory,
        error: &TrackingError,
        s: f64,
        speed: f64,
        accel: f64,
    ) -> f64 {
        let p = &self.params;
        // The stretch that the setpoint will be held on, at least a centimetre long.
        let v0 = (speed + accel * p.transport_delay_s).max(0.0);
        let v1 = (v0 + accel * self.period_s).max(0.0);
        let from = s + speed * p.transport_delay_s;
        let length = (0.5 * (v0 + v1) * self.period_s).max(0.01);
        let (a, b) =
            (trajectory.at_distance(from).path, trajectory.at_distance(from + length).path);
        let inside = b.s_m - a.s_m;
        let feedforward = if inside > 1e-6 {
            wrap_angle(b.heading_rad - a.heading_rad) / inside
        } else {
            b.curvature_pm
        };
        let settle = (p.lateral_settle_s * speed).max(p.lateral_settle_min_m);
        let lateral = error.lateral_m.clamp(-LATERAL_ERROR_MAX_M, LATERAL_ERROR_MAX_M);
        // Parallel to the path at distance e the curvature is kappa / (1 - kappa e).
        let parallel = feedforward / (1.0 - feedforward * lateral).max(0.5);
        parallel - lateral / (settle * settle) - 2.0 * error.heading_rad / settle
    }

    /// Forces inside the friction circle. The bend comes first, but for a car that is faster than
    /// planned there: where a bend tightens, one that only steers gets ever less of what it
    /// needs. The few millimetres that it runs wide while it brakes are taken back afterwards.
    fn forces(&self, accel: f64, curvature: f64, speed: f64, planned_mps: f64) -> ForceSetpoint {
        let p = &self.params;
        let grip = self.accel_limit_mps2 * p.grip_share;
        let from_mps = (1.0 + HASTE_FROM) * planned_mps;
        let to_mps = (1.0 + HASTE_TO) * planned_mps;
        let haste = if speed > from_mps { (speed - from_mps) / (to_mps - from_mps) } else { 0.0 };
        let bend = grip * (1.0 - haste.min(1.0) * (1.0 - BEND_SHARE_MIN));
        let curvature = curvature.clamp(-self.curvature_limit_pm, self.curvature_limit_pm);
        let lateral_at = |accel: f64| {
            // Mean speed of the period, for which the lateral force is to give the curvature.
            let v0 = (speed + accel * p.transport_delay_s).max(0.0);
            let v = 0.5 * (v0 + (v0 + accel * self.period_s).max(0.0));
            (curvature * v * v).clamp(-bend, bend)
        };
        let room = |lateral: f64| (grip * grip - lateral * lateral).max(0.0).sqrt();
        let first = lateral_at(accel);
        let accel = accel.clamp(-room(first), room(first));
        let lateral = lateral_at(accel);
        let accel = accel.clamp(-room(lateral), room(lateral));
        ForceSetpoint {
            longitudinal_n: self.mass_kg * accel,
            lateral_n: self.mass_kg * lateral,
            curvature_pm: curvature,
            drive: true,
        }
    }

    /// The last centimetre, and standing: a braking force, which never reverses the car.
    fn stand(&self, curvature: f64, speed: f64) -> ForceSetpoint {
        let grip = self.accel_limit_mps2 * self.params.grip_share;
        let accel = if speed > 0.0 { -0.5 * grip } else { -HOLD_SHARE * grip };
        let curvature = curvature.clamp(-self.curvature_limit_pm, self.curvature_limit_pm);
        ForceSetpoint {
            longitudinal_n: self.mass_kg * accel,
            lateral_n: self.mass_kg * curvature * speed * speed,
            curvature_pm: curvature,
            drive: true,
        }
    }
}

/// Distance along the trajectory abreast of the car, found from `guess_m` on.
pub(super) fn foot_of(trajectory: &Trajectory, pose: Pose, guess_m: f64) -> f64 {
    let last = trajectory.last().path.s_m;
    let mut s = guess_m.clamp(0.0, last);
    for _ in 0..8 {
        let foot = trajectory.at_distance(s).path;
        let off: Vector = pose.position - foot.position;
        let forward = heading_vector(foot.heading_rad);
        let lateral = forward.x * off.y - forward.y * off.x;
        let step = off.dot(&forward) / (1.0 - foot.curvature_pm * lateral).max(0.5);
        let next = (s + step).clamp(0.0, last);
        let moved = (next - s).abs();
        s = next;
        if moved < 1e-6 {
            break;
        }
    }
    s
}

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
