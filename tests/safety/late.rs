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
