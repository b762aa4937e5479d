//! Where nothing is wrong, nothing is found.

use apexd::autopilot::{Event, Fault};
use apexd::sim::drive::Outcome;
use apexd::sim::maze::Family;
use rayon::prelude::*;

use super::trial::Trial;

/// Drives to the end and returns the faults that were raised.
fn faults_of(trial: &Trial) -> (Outcome, Vec<Fault>) {
    let mut rig = trial.rig();
    let mut faults = Vec::new();
    let outcome = rig.drive(|rig| {
        while let Some(event) = rig.poll_event() {
            if let Event::FaultRaised { fault, .. } = event {
                faults.push(fault);
            }
        }
    });
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
    (outcome, faults)
}

#[test]
fn a_sound_drive_raises_no_fault_that_acts_at_any_rate_and_in_either_layout() {
    let mut trials = vec![
        Trial::maze(Family::Thin, 700),
        Trial::maze(Family::Branching, 701).fast(),
        Trial::maze(Family::Solid, 702).classic(),
    ];
    let mut quick = Trial::maze(Family::Thin, 703).for_s(12.0);
    quick.control_rate_hz = 1000.0;
    trials.push(quick);
    trials.par_iter().for_each(|trial| {
        let (outcome, faults) = faults_of(trial);
        let what = format!("{} {:?} {} Hz", trial.label(), trial.layout, trial.control_rate_hz);
        // A step without a plan for half a second is reported in tight places.
        let acting: Vec<Fault> =
            faults.into_iter().filter(|fault| !matches!(fault, Fault::NoPlan)).collect();
        assert_eq!(acting, [], "{what}");
        let ended = [Outcome::Goal, Outcome::Timeout].contains(&outcome);
        assert!(ended, "{what}: {outcome:?}");
    });
}

/// The slowest rate sends setpoints less often than the car takes them for fresh: between two it
/// follows its tail. That is slow, and safe.
#[test]
fn the_slowest_control_rate_is_safe() {
    let mut trial = Trial::maze(Family::Thin, 704).for_s(10.0);
    trial.control_rate_hz = 20.0;
    let (_, faults) = faults_of(&trial);
    assert!(!faults.contains(&Fault::Overload), "{faults:?}");
}
