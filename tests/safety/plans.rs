//! What must hold for every plan that a planning step gives, by the request it answers.

use std::f64::consts::PI;

use apexd::frames::{Pose, wrap_angle};
use apexd::plan::{Plan, PlanRequest, Trajectory};

use super::findings::Findings;
use super::geometry::{least_clearance_m, peak_acceleration_mps2, stop_profile, to_blocked_m};

/// What the car can do and must keep to.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Radius of the car's disc, metres.
    pub radius_m: f64,
    /// Radius that plans are certified with, metres.
    pub certified_m: f64,
    pub curvature_max_pm: f64,
    pub accel_mps2: f64,
    pub speed_max_mps: f64,
}

/// Rounding of positions and states that are the same number computed in two ways.
const SAME: f64 = 1e-6;
/// Relative tolerance of curvatures and accelerations taken from positions: the curve between the
/// samples is a cubic, whose derivatives differ from the arc's by less than this.
const MEASURED: f64 = 0.01;
/// Positions are exact to this, metres; on short chords it is noise of their directions.
const POSITION_M: f64 = 1e-5;

/// Holds a plan against its request.
pub fn inspect(request: &PlanRequest, plan: &Plan, limits: &Limits) -> Findings {
    let mut findings = Findings::default();
    let number = plan.number;
    let trajectory = &plan.trajectory;
    continues(request, trajectory, &mut findings);
    shape(trajectory, limits, &mut findings);

    let (clear, at) = least_clearance_m(trajectory, 0.0, &request.grid, limits.certified_m);
    findings.check(clear >= limits.certified_m - 1e-4, "P4", || {
        format!("plan {number}: {clear:.4} m to a cell not known free, {at:.3} m along")
    });
    motion(trajectory, limits, &mut findings);

    let last = trajectory.last();
    findings.check(last.speed_mps == 0.0, "P5", || {
        format!("plan {number} ends at {} m/s", last.speed_mps)
    });
    let in_goal = (last.path.position - request.goal.position).norm() <= request.goal.radius_m;
    // A car that stands may be out of better ways (`plan::impasse`).
    let stands = trajectory.points[0].speed_mps == 0.0;
    findings.check(in_goal || stands || escapes(request, plan, limits), "P14", || {
        let at = last.path.position;
        format!("plan {number} stops at ({:.2}, {:.2}) m, no way out of there", at.x, at.y)
    });
    let executed = |p| trajectory.points.iter().any(|q| q.path.position == p);
    // The first point beyond may be the one at which the executed part ends.
    let beyond = plan.beyond.points.iter().skip(1).map(|p| p.position);
    findings.check(!beyond.into_iter().any(executed), "P10", || {
        format!("plan {number} executes a part of what it only imagines")
    });
    findings
}

/// P14: from where the plan stops, the car can turn off by a quarter circle to one side; or turn back,
/// if it swings out to the other side first, by a quarter circle at most.
fn escapes(request: &PlanRequest, plan: &Plan, limits: &Limits) -> bool {
    const STEP_RAD: f64 = 0.5 * PI / 40.0;
    let is_clear = |pose: &Pose| {
        to_blocked_m(&request.grid, pose.position, limits.certified_m) >= limits.certified_m - 1e-4
    };
    // The poses after each step of a turn as tight as can be, as long as they are clear.
    let turn = |from: Pose, side: f64, steps: u32| {
        let turned = move |i| f64::from(i) * STEP_RAD;
        (0..=steps)
            .map(move |i| from.along_arc(turned(i) / limits.curvature_max_pm, side * turned(i)))
            .take_while(is_clear)
    };
    let is_whole =
        |from: Pose, side: f64, steps: u32| turn(from, side, steps).count() > steps as usize;
    let stop = plan.trajectory.last().path;
    let stop = Pose { position: stop.position, heading_rad: stop.heading_rad };
    [1.0, -1.0].into_iter().any(|side| {
        is_whole(stop, side, 40)
            || (0..)
                .zip(turn(stop, -side, 40))
                .any(|(swung, from)| is_whole(from, side, 80 + swung))
    })
}

/// P1.
fn continues(request: &PlanRequest, trajectory: &Trajectory, findings: &mut Findings) {
    let before = request.committed.trajectory.at(request.takes_over);
    let first = &trajectory.points[0];
    let offset = (first.path.position - before.path.position).norm();
    let turn = wrap_angle(first.path.heading_rad - before.path.heading_rad).abs();
    let jump = (first.speed_mps - before.speed_mps).abs();
    let at = trajectory.start == request.takes_over;
    findings.check(at && offset <= SAME && turn <= SAME && jump <= SAME, "P1", || {
        format!(
            "plan {}: {offset:.4} m, {turn:.4} rad, {jump:.4} m/s off what it continues",
            request.number
        )
    });
}

/// P2 and P3.
fn shape(trajectory: &Trajectory, limits: &Limits, findings: &mut Findings) {
    let positions: Vec<_> = trajectory.points.iter().map(|p| p.path.position).collect();
    let Some(first) = positions.get(1) else { return };
    let along = trajectory.points[0].path.heading_rad;
    let chord = first - positions[0];
    let off = wrap_angle(chord.y.atan2(chord.x) - along).abs();
    let allowed = 0.5 * limits.curvature_max_pm * chord.norm() * (1.0 + MEASURED)
        + 2.0 * POSITION_M / chord.norm();
    findings.check(off <= allowed, "P2", || {
        format!("the first chord is {off:.4} rad off the heading, allowed {allowed:.4} rad")
    });
    for (i, corner) in positions.windows(3).enumerate() {
        let (u, v) = (corner[1] - corner[0], corner[2] - corner[1]);
        let (a, b, c) = (u.norm(), v.norm(), (corner[2] - corner[0]).norm());
        let noise = 2.0 * POSITION_M * (1.0 / a + 1.0 / b);
        let turn = wrap_angle(v.y.atan2(v.x) - u.y.atan2(u.x)).abs();
        let allowed =
            0.5 * (a + b) * limits.curvature_max_pm * (1.0 + MEASURED) * (1.0 + MEASURED) + noise;
        findings.check(turn <= allowed && turn < 0.5 * PI, "P2", || {
            format!("chords turn by {turn:.4} rad at sample {}, allowed {allowed:.4}", i + 1)
        });
        // Curvature of the circle through the three: four times the triangle's area over the
        // product of its sides.
        let circle = 2.0 * (u.x * v.y - u.y * v.x).abs() / (a * b * c);
        let allowed = limits.curvature_max_pm * (1.0 + MEASURED) + 2.0 * noise / (a + b);
        findings.check(circle <= allowed, "P3", || {
            format!("curvature {circle:.4}/m at sample {}, allowed {allowed:.4}/m", i + 1)
        });
    }
}

/// P6, P7 and P8.
fn motion(trajectory: &Trajectory, limits: &Limits, findings: &mut Findings) {
    let in_range = |v: f64| v >= 0.0 && v <= limits.speed_max_mps * (1.0 + SAME);
    let speeds = trajectory.points.iter().map(|p| p.speed_mps);
    let times = trajectory.points.windows(2);
    let ordered = times.into_iter().all(|w| w[1].t_s > w[0].t_s && w[1].t_s.is_finite());
    let moving = trajectory.points[1..].split_last().is_none_or(|(_, inner)| {
        // Rest in the middle would take no time in a profile of constant accelerations.
        inner.iter().zip(&trajectory.points).all(|(b, a)| a.speed_mps + b.speed_mps > 0.0)
    });
    let fine = speeds.clone().all(in_range) && ordered && moving;
    findings.check(fine && trajectory.points[0].t_s == 0.0, "P7", || {
        format!("speeds up to {:?}, times ordered: {ordered}", speeds.fold(0.0, f64::max))
    });
    if !ordered {
        return; // nothing below means anything then
    }
    let peak = peak_acceleration_mps2(trajectory);
    findings.check(peak <= limits.accel_mps2 * (1.0 + MEASURED), "P6", || {
        format!("{peak:.3} m/s^2 asked of tyres that hold {:.3} m/s^2", limits.accel_mps2)
    });
    for (s, most) in stop_profile(trajectory, 0.0, limits.accel_mps2) {
        let squared = trajectory.at_distance(s).speed_mps.powi(2);
        // Half a station of braking is what the numerical profile may be off by.
        let allowed = most * (1.0 + MEASURED) + 0.01 * limits.accel_mps2;
        findings.check(squared <= allowed, "P8", || {
            format!("at {s:.2} m {:.3} m/s, can stop from {:.3} m/s", squared.sqrt(), most.sqrt())
        });
    }
}
