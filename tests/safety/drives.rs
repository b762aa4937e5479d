//! Whole drives under watch.

use apexd::autopilot::Event;
use apexd::frames::{Point, Pose};
use apexd::plan::{ForeseenParams, Policy, Reading};
use apexd::predict::PredictorKind;
use apexd::sim::drive::Outcome;
use apexd::sim::maze::Family;
use rayon::prelude::*;

use super::cases;
use super::trial::Trial;
use super::watch::Watch;

/// Drives to the end and fails on anything found.
pub fn drive_checked(trial: &Trial) -> (Outcome, Watch) {
    let mut rig = trial.rig();
    let mut watch = Watch::new(trial);
    let outcome = rig.drive(|rig| watch.look(rig));
    watch.look_back(&rig, trial);
    println!("{}: {outcome:?} after {}, {:?}", trial.label(), rig.now(), watch.worst);
    watch.findings.assert_none(&trial.label());
    (outcome, watch)
}

#[test]
fn whole_drives_keep_every_rule_at_every_step() {
    let mut trials = Vec::new();
    for seed in 0..cases(1, 20) {
        let seed = 900 + 10 * seed;
        trials.extend([
            Trial::maze(Family::Thin, seed),
            Trial::maze(Family::Thin, seed + 1).policy(Policy::Frontier),
            Trial::maze(Family::Solid, seed + 2).predictor(PredictorKind::Oracle),
            Trial::maze(Family::Branching, seed + 3),
            Trial::maze(Family::Solid, seed + 4).predictor(PredictorKind::Random),
            Trial::maze(Family::Solid, seed + 5).predictor(PredictorKind::Inverted).for_s(15.0),
            Trial::maze(Family::Solid, seed + 6).fast(),
            Trial::maze(Family::Solid, seed + 7).latency(0.045).for_s(15.0),
            Trial::maze(Family::Thin, seed + 8).policy(Policy::Janson).for_s(8.0),
            Trial::maze(Family::Thin, seed).classic().for_s(8.0),
            Trial::maze(Family::Branching, seed + 9).policy(Policy::JansonLite).for_s(8.0),
        ]);
    }
    trials.par_iter().for_each(|trial| drop(drive_checked(trial)));
}

/// Two reversals of all the grip there is, a scan's period apart, left this car 0.1 m/s too fast for
/// the bend that came then and tightened: it only steered, got no slower, and hit the wall.
#[test]
fn a_car_that_is_too_fast_for_its_bend_brakes_in_it() {
    let mut trial = Trial::maze(Family::Branching, 1_448_258).predictor(PredictorKind::Cnp);
    (trial.speed_mps, trial.lidar_hz, trial.seed) = (6.0, 10.0, 1_061_254_799);
    trial.foreseen = ForeseenParams::default();
    let (_, watch) = drive_checked(&trial.for_s(13.0));
    assert!(!watch.events.iter().any(|(_, event)| matches!(event, Event::FaultRaised { .. })));
}

#[test]
fn of_two_ways_that_are_as_good_one_is_kept() {
    // A block in the middle between start and goal, the same on either side.
    let mut trial = Trial::hall(13.0, 9.0, Pose::new(1.25, 4.5, 0.0), Point::new(11.75, 4.5));
    trial.world.fill_rect(Pose::new(6.5, 4.5, 0.0), 4.0, 4.0);
    trial = trial.for_s(30.0);
    let direct = trial.clone();
    let mut via_frontier = trial.clone();
    via_frontier.reading = Reading::ViaFrontier;
    let janson = trial.clone().policy(Policy::Janson);
    let lite = trial.policy(Policy::JansonLite);
    let lengths_m = [direct, via_frontier, janson, lite].map(|trial| {
        let mut rig = trial.rig();
        let mut watch = Watch::new(&trial);
        let outcome = rig.drive(|rig| watch.look(rig));
        watch.look_back(&rig, &trial);
        watch.findings.assert_none(&trial.label());
        assert_eq!(outcome, Outcome::Goal, "{}", trial.label());
        rig.summary(0.0).path_m
    });
    println!("{lengths_m:?} m");
    for length_m in lengths_m {
        assert!(length_m < 1.1 * lengths_m[0], "{lengths_m:?} m");
    }
}
