//! Safety does not depend on what is foreseen (P13), and a drive is a function of its setup (P15).

use apexd::frames::Point;
use apexd::plan::Policy;
use apexd::predict::{OccupancyView, Predictor, PredictorKind, Scene};
use apexd::sim::maze::Family;
use apexd::sim::rig::Rig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::cases;
use super::trial::Trial;
use super::watch::Watch;

/// What a predictor says that cannot be trusted.
#[derive(Clone, Copy, Debug)]
enum Nonsense {
    Nan,
    AllFree,
    AllOccupied,
    /// Another number in [0, 1] at every question.
    Random,
    /// Numbers that are no probabilities.
    OutOfRange,
}

struct Babbler(Nonsense, ChaCha8Rng);

impl OccupancyView for Babbler {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        assert_eq!(points.len(), out.len());
        for answer in out {
            *answer = match self.0 {
                Nonsense::Nan => f32::NAN,
                Nonsense::AllFree => 0.0,
                Nonsense::AllOccupied => 1.0,
                Nonsense::Random => self.1.random(),
                Nonsense::OutOfRange => self.1.random_range(-1e30..1e30),
            };
        }
    }
}

impl Predictor for Babbler {
    fn observe(&mut self, _scene: &Scene<'_>) {}
}

#[test]
fn nonsense_from_the_predictor_breaks_no_rule() {
    use Nonsense::{AllFree, AllOccupied, Nan, OutOfRange, Random};
    let kinds = [Nan, AllFree, AllOccupied, Random, OutOfRange];
    let mut cases: Vec<(u64, Nonsense)> =
        (0..cases(1, 12)).flat_map(|seed| kinds.map(|kind| (seed, kind))).collect();
    cases.par_iter_mut().for_each(|(seed, kind)| {
        let family = if *seed % 2 == 0 { Family::Branching } else { Family::Thin };
        let mut trial = Trial::maze(family, 70 + *seed).for_s(8.0);
        trial.name = format!("{}, predictor {kind:?}", trial.name);
        let babbler = Babbler(*kind, ChaCha8Rng::seed_from_u64(*seed));
        let mut rig = trial.rig_with(Box::new(trial.planner_with(Box::new(babbler))));
        let mut watch = Watch::new(&trial);
        rig.drive(|rig| watch.look(rig));
        watch.look_back(&rig, &trial);
        watch.findings.assert_none(&trial.label());
        assert!(rig.distance_m() > 5.0, "{}: {} m driven", trial.label(), rig.distance_m());
    });
}

#[test]
fn no_rule_is_broken_with_the_network_random_numbers_or_the_inverted_truth() {
    use PredictorKind::{Cnp, Inverted, Random};
    let mut trials = Vec::new();
    for seed in 0..cases(1, 10) {
        let families = [Family::Thin, Family::Solid, Family::Branching];
        for (family, kind) in
            families.into_iter().flat_map(|f| [Cnp, Random, Inverted].map(|k| (f, k)))
        {
            let trial = Trial::maze(family, 1_000_070 + seed).predictor(kind).for_s(8.0);
            trials.push(if seed % 2 == 1 { trial.fast() } else { trial });
        }
        trials.push(Trial::maze(Family::Thin, 1_000_070 + seed).predictor(Cnp).fast().for_s(8.0));
    }
    trials.par_iter().for_each(|trial| {
        let mut rig = trial.rig();
        let mut watch = Watch::new(trial);
        rig.drive(|rig| watch.look(rig));
        watch.look_back(&rig, trial);
        watch.findings.assert_none(&trial.label());
        let summary = rig.summary(0.0);
        assert_eq!((summary.collisions, summary.unknown_entries), (0, 0), "{}", trial.label());
        assert_eq!(summary.prediction_faults, 0, "{}", trial.label());
        assert_eq!(trial.predictor == Cnp, summary.predict_decoded > 0.0, "{}", trial.label());
        assert!(rig.distance_m() > 5.0, "{}: {} m driven", trial.label(), rig.distance_m());
    });
}

#[test]
fn a_drive_depends_on_its_setup_alone_and_not_on_threads() {
    let trials = [
        Trial::maze(Family::Thin, 33).predictor(PredictorKind::Cnp).for_s(4.0),
        Trial::maze(Family::Thin, 31).for_s(5.0),
        Trial::maze(Family::Branching, 32).policy(Policy::Frontier).for_s(5.0),
    ];
    let digest = |trial: &Trial| {
        let mut rig: Rig = trial.rig();
        rig.drive(|_| {});
        (rig.summary(0.0).digest, rig.distance_m().to_bits())
    };
    for trial in &trials {
        let alone = digest(trial);
        let (a, b) = rayon::join(|| digest(trial), || digest(trial));
        assert_eq!((&alone, &alone), (&a, &b), "{}", trial.label());
        let other = Trial {
            start: apexd::frames::Pose {
                heading_rad: trial.start.heading_rad + 0.1,
                ..trial.start
            },
            ..trial.clone()
        };
        assert_ne!(alone, digest(&other), "the digest tells drives apart");
    }
}
