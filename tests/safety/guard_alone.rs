//! The planner replaced by full throttle at the goal: the guard alone has to prevent contact.

use apexd::autopilot::{Event, Fault};
use apexd::frames::wrap_angle;
use apexd::plan::{
    Path, PathPoint, Plan, PlanRequest, Planning, StepReport, StepTimes, Trajectory,
    TrajectoryPoint, Verdict,
};
use apexd::predict::PredictReport;
use apexd::sim::drive::Outcome;
use apexd::sim::maze::Family;
use rayon::prelude::*;

use super::cases;
use super::trial::Trial;

/// Straight from where the car will be to the goal, with all the acceleration that the tyres give,
/// to the top speed and no braking; nothing is certified.
struct FullThrottle {
    speed_max_mps: f64,
}

impl Planning for FullThrottle {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        const ACCEL_MPS2: f64 = 8.0;
        const SPACING_M: f64 = 0.05;
        let from = request.committed.trajectory.at(request.takes_over);
        let way = request.goal.position - from.path.position;
        let heading_rad = wrap_angle(way.y.atan2(way.x));
        let parts = (way.norm() / SPACING_M).ceil().max(1.0);
        let ds = way.norm() / parts;
        let mut points: Vec<TrajectoryPoint> = Vec::new();
        let mut speed = from.speed_mps.min(self.speed_max_mps);
        let mut t_s = 0.0;
        for i in 0..=parts as usize {
            let next = (speed * speed + 2.0 * ACCEL_MPS2 * ds).sqrt().min(self.speed_max_mps);
            points.push(TrajectoryPoint {
                path: PathPoint {
                    s_m: ds * i as f64,
                    position: from.path.position + way * (i as f64 / parts),
                    heading_rad,
                    curvature_pm: 0.0,
                },
                t_s,
                speed_mps: speed,
                accel_mps2: (next * next - speed * speed) / (2.0 * ds),
            });
            t_s += 2.0 * ds / (speed + next).max(1e-9);
            speed = next;
        }
        let plan = Plan {
            number: request.number,
            scan_stamp: request.scan_stamp,
            trajectory: Trajectory { start: request.takes_over, points },
            beyond: Path::default(),
        };
        StepReport {
            number: request.number,
            base: request.committed.number,
            takes_over: request.takes_over,
            verdict: Verdict::Plan(Box::new(plan)),
            candidates: 1,
            times: StepTimes::default(),
            prediction: PredictReport::default(),
        }
    }
}

#[test]
fn with_full_throttle_at_the_goal_the_guard_alone_prevents_every_contact() {
    let mut trials = Vec::new();
    for seed in 0..cases(8, 100) {
        for family in [Family::Thin, Family::Solid, Family::Branching] {
            let trial = Trial::maze(family, 200 + seed).for_s(5.0);
            // Every other one at 8 m/s, and started in another direction.
            let mut trial = if seed % 2 == 1 { trial.fast() } else { trial };
            trial.start.heading_rad += 0.4 * seed as f64;
            trials.push(trial);
        }
    }
    let drives: Vec<(f64, u64)> = trials
        .par_iter()
        .map(|trial| {
            let planner = FullThrottle { speed_max_mps: trial.speed_mps };
            let mut rig = trial.rig_with(Box::new(planner));
            // The guard alone: what the core would notice before is switched off.
            rig.core_mut().suppress(Fault::TrackingError);
            rig.core_mut().suppress(Fault::TailNotHeld);
            let mut adopted = 0;
            let outcome = rig.drive(|rig| {
                while let Some(event) = rig.poll_event() {
                    adopted += u32::from(matches!(event, Event::PlanAdopted { .. }));
                }
            });
            let what = trial.label();
            assert_ne!(outcome, Outcome::Goal, "{what}");
            assert_eq!(rig.judge().collisions(), 0, "{what}: contact at {:?}", rig.car());
            assert!(adopted > 0, "{what}: nothing was asked of the guard");
            (rig.distance_m(), rig.core().statistics().guard_stops)
        })
        .collect();
    let moved: f64 = drives.iter().map(|(moved, _)| moved).sum();
    let stopped = drives.iter().filter(|(_, stops)| *stops > 0).count();
    println!("{moved:.1} m in {} drives, the guard stopped {stopped} of them", drives.len());
    assert!(2 * stopped > drives.len(), "the guard stopped only {stopped} of {}", drives.len());
    // It is no guard that lets nothing move at all.
    assert!(moved > 0.5 * drives.len() as f64, "{moved} m in {} drives", drives.len());
}
