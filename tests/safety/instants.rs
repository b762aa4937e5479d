//! What must hold at every simulated millisecond, by the true state of the car.

use apexd::frames::{Vector, heading_vector, wrap_angle};
use apexd::plan::Trajectory;
use apexd::sim::car::CarState;
use apexd::sim::rig::Rig;

use super::findings::Findings;
use super::geometry::{stop_on_m, to_blocked_m, to_solid_m};
use super::plans::Limits;

/// The largest errors of a drive.
#[derive(Clone, Copy, Debug, Default)]
pub struct Worst {
    /// Distance of the true position to the path of the committed plan, metres.
    pub lateral_m: f64,
    /// Distance along it from where the car should be, metres.
    pub along_m: f64,
    /// Speed above the plan's at the same place, m/s.
    pub faster_mps: f64,
    /// How far beyond the committed plan's end a stop would have ended, metres.
    pub overrun_m: f64,
    /// Speed above the limit, m/s.
    pub overspeed_mps: f64,
    /// Age of the plan's scan beyond what misses explain, seconds.
    pub late_s: f64,
}

/// Speed by which feedback may exceed the limit for a moment, m/s: the tracker's own tolerance is
/// `overspeed_mps` of its parameters, the rest is quantisation.
const OVERSPEED_MPS: f64 = 0.1;
/// I8: the tracking error that the certified margin provides for, metres.
const TRACKING_M: f64 = 0.02;
/// I1 to I6 over one millisecond, from `a` to `b`.
pub fn motion(
    rig: &Rig,
    a: &CarState,
    b: &CarState,
    before: Option<Vector>,
    limits: &Limits,
    worst: &mut Worst,
    findings: &mut Findings,
) -> Vector {
    const DT_S: f64 = 1e-3;
    let t = rig.now().as_secs_f64();
    let r = limits.radius_m;
    let step = b.pose.position - a.pose.position;
    let moved = step.norm();

    // Distances are 1-Lipschitz: between two instants the disc comes nearer by half the way.
    let solid = to_solid_m(rig.world(), b.pose.position, r + 0.05);
    findings.check(solid >= r + (0.5 * moved).min(0.002), "I1", || {
        format!("{t:.3} s: {solid:.4} m to a wall at {:?}", b.pose)
    });
    let blocked = to_blocked_m(rig.core().grid(), b.pose.position, r + 0.05);
    findings.check(blocked >= r + (0.5 * moved).min(0.002), "I2", || {
        format!("{t:.3} s: {blocked:.4} m to a cell not known free at {:?}", b.pose)
    });

    let velocity = step / DT_S;
    if let Some(before) = before {
        let accel = (velocity - before).norm() / DT_S;
        // A millisecond in which the wheels jump to the other side mixes two arcs.
        let jump = 0.5 * (a.curvature_pm - b.curvature_pm).abs() * b.speed_mps.powi(2);
        findings.check(accel <= limits.accel_mps2 * 1.001 + jump + 0.01, "I3", || {
            format!("{t:.3} s: {accel:.3} m/s^2")
        });
    }
    let turn = wrap_angle(b.pose.heading_rad - a.pose.heading_rad);
    findings.check(turn.abs() <= limits.curvature_max_pm * moved * 1.001 + 1e-9, "I4", || {
        format!("{t:.3} s: turned by {turn:.6} rad over {moved:.6} m")
    });
    let speed = moved / DT_S;
    worst.overspeed_mps = worst.overspeed_mps.max(speed - limits.speed_max_mps);
    findings.check(
        speed <= limits.speed_max_mps + OVERSPEED_MPS && b.speed_mps >= 0.0,
        "I5",
        || format!("{t:.3} s: {speed:.3} m/s"),
    );
    let forward = heading_vector(a.pose.heading_rad + 0.5 * turn);
    let sideways = (forward.x * step.y - forward.y * step.x).abs();
    let backward = -(forward.x * step.x + forward.y * step.y);
    let kept = moved > 0.0 || turn == 0.0;
    findings.check(kept && sideways <= 1e-9 && backward <= 0.0, "I6", || {
        format!("{t:.3} s: {sideways:.2e} m sideways, {backward:.2e} m backward, turned {turn}")
    });
    velocity
}

/// Where along a trajectory the car is (nearest point, searched around where it should be; before
/// its start and beyond its end, along its direction there), and how far beside it.
fn foot(trajectory: &Trajectory, car: &CarState, s_should_m: f64) -> (f64, f64) {
    let away = |s: f64| (trajectory.at_distance(s).path.position - car.pose.position).norm();
    let mut best = s_should_m;
    for step in [0.05, 0.005, 0.0005] {
        let middle = best;
        for k in -10..=10 {
            let s = (middle + step * f64::from(k)).clamp(0.0, trajectory.last().path.s_m);
            if away(s) < away(best) {
                best = s;
            }
        }
    }
    let at = trajectory.at_distance(best).path;
    let forward = heading_vector(at.heading_rad);
    let off = car.pose.position - at.position;
    (best + forward.dot(&off), (forward.x * off.y - forward.y * off.x).abs())
}

/// I8: the car is where the committed plan says.
pub fn tracking(rig: &Rig, worst: &mut Worst, findings: &mut Findings) {
    let trajectory = &rig.core().committed().current().trajectory;
    let should = trajectory.at(rig.now());
    let (s, lateral) = foot(trajectory, rig.car(), should.path.s_m);
    let along = (s - should.path.s_m).abs();
    worst.lateral_m = worst.lateral_m.max(lateral);
    worst.along_m = worst.along_m.max(along);
    worst.faster_mps =
        worst.faster_mps.max(rig.car().speed_mps - trajectory.at_distance(s).speed_mps);
    findings.check(lateral <= TRACKING_M, "I8", || {
        format!(
            "{}: {lateral:.4} m beside the plan ({s:.3} m along, should be {should:?}), {:?}",
            rig.now(),
            rig.car()
        )
    });
}

/// I7: full braking from here along the committed plan. The stop may end beyond the plan's own by
/// what its margin allows: the footprint stays in known free cells and off the walls.
pub fn can_stop(rig: &Rig, limits: &Limits, worst: &mut Worst, findings: &mut Findings) {
    let trajectory = &rig.core().committed().current().trajectory;
    let should = trajectory.at(rig.now());
    let (s, _) = foot(trajectory, rig.car(), should.path.s_m);
    let last = trajectory.last().path;
    let stop = stop_on_m(trajectory, s, rig.car().speed_mps, limits.accel_mps2);
    worst.overrun_m = worst.overrun_m.max(stop - last.s_m);
    let beyond = heading_vector(last.heading_rad);
    let place = |station: f64| {
        trajectory.at_distance(station).path.position + beyond * (station - last.s_m).max(0.0)
    };
    let r = limits.radius_m;
    let parts = ((stop - s).clamp(0.0, 20.0) / 0.02).ceil().max(1.0) as u32;
    let touched =
        (0..=parts).map(|k| s + (stop - s) * f64::from(k) / f64::from(parts)).find(|at| {
            let p = place(*at);
            !(to_solid_m(rig.world(), p, r) >= r && to_blocked_m(rig.core().grid(), p, r) >= r)
        });
    findings.check(touched.is_none(), "I7", || {
        format!(
            "{}: a stop touches what is not free at {touched:?} m; it begins at {s:.3} m with \
             {:.3} m/s (should be at {:.3} m with {:.3} m/s) and ends {:.3} m beyond the plan",
            rig.now(),
            rig.car().speed_mps,
            should.path.s_m,
            should.speed_mps,
            stop - last.s_m
        )
    });
}
