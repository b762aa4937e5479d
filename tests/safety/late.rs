//! Planning that takes longer than it is granted.

use apexd::plan::{PlanRequest, Planner, Planning, StepReport};
use apexd::sim::drive::Outcome;
use apexd::sim::maze::Family;
use apexd::sim::rig::{Latency, Rig};
use apexd::time::Duration;

use super::trial::Trial;
use super::watch::Watch;

/// The product's planner on a slow computer.
struct Slow(Planner);

impl Planning for Slow {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let mut report = self.0.step(request);
        report.times.total = Duration::from_millis(180);
        report
    }
}

#[test]
fn a_planner_that_is_always_late_still_gets_the_car_there_from_stop_to_stop() {
    let trial = Trial::maze(Family::Thin, 3);
    let mut setup = trial.setup_with(Box::new(Slow(trial.planner())));
    setup.latency = Latency::Measured;
    let mut rig = Rig::new(setup).expect("start and goal are free");
    rig.keep_reports();
    let mut watch = Watch::new(&trial);
    let outcome = rig.drive(|rig| watch.look(rig));
    let statistics = rig.core().statistics();
    assert_eq!(outcome, Outcome::Goal);
    assert!(statistics.plans_late > 10 && statistics.plans_adopted > 10, "{statistics:?}");
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
}

/// A long step now and then: the one after it is granted much and needs little, so that its plan is
/// still pending when the next one, which is granted little again, is asked for.
struct Fitful {
    planner: Planner,
    steps: u32,
}

impl Planning for Fitful {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let mut report = self.planner.step(request);
        self.steps += 1;
        let slow = self.steps.is_multiple_of(40);
        report.times.total = Duration::from_millis(if slow { 190 } else { 4 });
        report
    }
}

#[test]
fn no_plan_takes_over_before_the_one_that_it_starts_on() {
    let trial = Trial::maze(Family::Thin, 3);
    let planner = Fitful { planner: trial.planner(), steps: 0 };
    let mut setup = trial.setup_with(Box::new(planner));
    setup.core.autopilot.plan_budget_s = 0.4;
    setup.latency = Latency::Measured;
    let mut rig = Rig::new(setup).expect("start and goal are free");
    rig.keep_reports();
    let mut watch = Watch::new(&trial);
    let mut newest = None;
    let outcome = rig.drive(|rig| {
        watch.look(rig);
        let begins = rig.core().committed().pending_from();
        if let (Some(before), Some(now)) = (newest, begins) {
            assert!(before <= now, "{now} replaces {before}");
        }
        newest = begins;
    });
    assert_eq!(outcome, Outcome::Goal);
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
    assert!(rig.core().statistics().plans_adopted > 50);
}
