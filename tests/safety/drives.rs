//! Whole drives under watch.

use apexd::plan::Policy;
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
        ]);
    }
    trials.par_iter().for_each(|trial| drop(drive_checked(trial)));
}
