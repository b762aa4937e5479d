//! Planners and predictors that fail when told to.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use apexd::frames::{Point, heading_vector};
use apexd::plan::{
    PathPoint, PlanRequest, Planner, Planning, Rejection, StepReport, Trajectory, TrajectoryPoint,
    Verdict,
};
use apexd::predict::{OccupancyView, Predictor, Scene};

/// Finds no plan while the switch is on.
pub struct Barren {
    pub planner: Planner,
    pub switch: Arc<AtomicBool>,
}

impl Planning for Barren {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let mut report = self.planner.step(request);
        if self.switch.load(Ordering::Relaxed) {
            report.verdict = Verdict::Rejected(Rejection::NothingToGain);
        }
        report
    }
}

/// Drives straight on from where the car is, with no regard for anything, while the switch is on.
pub struct Reckless {
    pub planner: Planner,
    pub switch: Arc<AtomicBool>,
}

impl Planning for Reckless {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let mut report = self.planner.step(request);
        if let Verdict::Plan(plan) = &mut report.verdict
            && self.switch.load(Ordering::Relaxed)
        {
            plan.trajectory = straight_on(request);
        }
        report
    }
}

/// 60 m ahead at the speed of the committed plan, without an end at rest.
fn straight_on(request: &PlanRequest) -> Trajectory {
    let from = request.committed.trajectory.at(request.takes_over);
    let speed_mps = from.speed_mps.max(1.0);
    let points = (0..=1200)
        .map(|i| {
            let s_m = 0.05 * f64::from(i);
            let position = from.path.position + heading_vector(from.path.heading_rad) * s_m;
            TrajectoryPoint {
                path: PathPoint { s_m, position, curvature_pm: 0.0, ..from.path },
                t_s: s_m / speed_mps,
                speed_mps,
                accel_mps2: 0.0,
            }
        })
        .collect();
    Trajectory { start: request.takes_over, points }
}

/// Answers with what is no probability while the switch is on.
pub struct Babbler {
    pub switch: Arc<AtomicBool>,
}

impl OccupancyView for Babbler {
    fn occupied(&mut self, _points: &[Point], out: &mut [f32]) {
        out.fill(if self.switch.load(Ordering::Relaxed) { f32::NAN } else { 0.5 });
    }
}

impl Predictor for Babbler {
    fn observe(&mut self, _scene: &Scene<'_>) {}
}
