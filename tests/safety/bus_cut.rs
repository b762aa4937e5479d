//! The bus is cut at any moment (I11): the car stops on its braking tail.

use std::sync::LazyLock;

use apexd::sim::faults::Harm;
use apexd::sim::maze::Family;
use apexd::sim::rig::Rig;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::cases;
use super::replay::Recording;
use super::trial::{CAR, DAEMON, Trial};

/// Drives whose beginnings are driven again, up to a disturbance.
pub static RECORDINGS: LazyLock<Vec<Recording>> = LazyLock::new(|| {
    let mut trials = Vec::new();
    for seed in 0..cases(1, 8) {
        trials.extend([
            Trial::maze(Family::Thin, 40 + seed).for_s(10.0),
            Trial::maze(Family::Solid, 60 + seed).for_s(10.0),
            Trial::maze(Family::Branching, 80 + seed).fast().for_s(8.0),
            Trial::maze(Family::Thin, 100 + seed).fast().for_s(8.0),
        ]);
    }
    trials.into_par_iter().map(Recording::of).collect()
});

#[test]
fn the_drives_before_the_disturbance_keep_every_rule() {
    for recording in RECORDINGS.iter() {
        recording.findings.assert_none(&recording.trial().label());
    }
}

/// How long a stop may take after the last setpoint: the car notices after 0.1 s and needs no more
/// than 0.92 s from 8 m/s.
const STOP_S: f64 = 1.3;

/// Lets a drive go on for some time.
pub fn run_on(rig: &mut Rig, seconds: f64) {
    let until = rig.now().offset_by(seconds);
    while rig.now() < until {
        rig.step();
    }
}

/// Fails unless the car stands in space that was shown to be free and has touched nothing.
#[track_caller]
pub fn assert_safe_at_rest(rig: &Rig, what: &str) {
    let judge = rig.judge();
    assert_eq!(rig.car().speed_mps, 0.0, "{what}: still moving at {:?}", rig.car());
    assert_eq!(judge.collisions(), 0, "{what}: contact at {:?}", rig.car());
    assert_eq!(judge.unknown_entries(), 0, "{what}: unknown entry at {:?}", rig.car());
}

/// How a connection is lost.
#[derive(Clone, Copy, Debug)]
enum Loss {
    /// The daemon is off the bus: nothing either way.
    Both,
    /// The car hears nothing any more, the daemon still sees.
    ToCar,
    /// The daemon sees nothing any more, the car still hears.
    ToDaemon,
}

#[test]
fn wherever_the_bus_is_cut_the_car_stops_in_free_space_without_contact() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut cuts = Vec::new();
    let mut in_bends = 0;
    for recording in RECORDINGS.iter() {
        for k in 0..14 {
            let at_s = rng.random_range(0.3..recording.ended_s);
            let loss = [Loss::Both, Loss::ToCar, Loss::ToDaemon][(k % 7usize).saturating_sub(4)];
            let (speed, curvature) = recording.course[(at_s * 1e3) as usize - 1];
            in_bends += u32::from(speed > 1.5 && curvature.abs() > 0.2);
            cuts.push((recording, at_s, loss));
        }
    }
    assert!(cuts.len() >= 40 && in_bends >= 8, "{} cuts, {in_bends} in bends", cuts.len());
    cuts.par_iter().for_each(|(recording, at_s, loss)| {
        let trial = recording.trial().clone();
        let nothing = |receiver| {
            let trial = trial.clone();
            trial.harm(Harm::Loss, 1.0, Some(receiver), None, *at_s, f64::INFINITY)
        };
        let trial = match loss {
            Loss::Both => trial.clone().cut(DAEMON, *at_s),
            Loss::ToCar => nothing(CAR),
            Loss::ToDaemon => nothing(DAEMON),
        };
        let mut rig = trial.rig_with(recording.replay());
        run_on(&mut rig, *at_s);
        let before = rig.car().speed_mps;
        run_on(&mut rig, STOP_S);
        let what = format!("{}, {loss:?} lost at {at_s:.3} s, {before:.2} m/s", trial.label());
        assert_safe_at_rest(&rig, &what);
    });
}

#[test]
fn a_link_that_comes_back_after_a_stop_leads_to_no_contact_and_no_unknown_entry() {
    RECORDINGS.par_iter().for_each(|recording| {
        let mut trial = recording.trial().clone().cut(DAEMON, 3.0);
        trial.faults.cuts[0].until_s = 5.0;
        let what = format!("{}, cut from 3 s to 5 s", trial.label());
        let mut rig = trial.rig_with(recording.replay());
        run_on(&mut rig, 5.0);
        assert_safe_at_rest(&rig, &what);
        run_on(&mut rig, 2.0);
        let judge = rig.judge();
        assert_eq!((judge.collisions(), judge.unknown_entries()), (0, 0), "{what}");
    });
}
