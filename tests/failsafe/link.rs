//! A link that is cut while the car drives, and comes back.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use apexd::autopilot::{Fault, Mode};
use apexd::frames::Point;
use apexd::sim::maze::Family;
use rayon::prelude::*;

use super::play::{Play, hall};
use super::trial::{DAEMON, Trial};

/// The daemon's own setpoints clear the car's latch when the link comes back, whichever frame is
/// first. A person is asked all the same.
#[test]
fn however_short_the_cut_a_car_that_lost_its_setpoints_asks_to_be_armed() {
    // From a little over the car's own time-out, in steps that meet every phase of the frames.
    let cuts: Vec<f64> = (0..12).map(|k| 0.13 + 0.0057 * f64::from(k)).collect();
    cuts.par_iter().for_each(|seconds| {
        let mut trial = hall().cut(DAEMON, 1.5);
        trial.faults.cuts[0].until_s = 1.5 + seconds;
        let switch = Arc::new(AtomicBool::new(false));
        let mut play = Play::new(trial.rig(), Fault::SetpointLost, false, switch);
        play.get_going(1.0).unwrap();
        play.until(2.0, |rig| rig.now().as_secs_f64() >= 1.5).unwrap();
        play.until(3.0, |rig| rig.car().speed_mps == 0.0).unwrap();
        play.run(2.5).unwrap();
        let faults: Vec<Fault> = play.rig.core().faults().iter().collect();
        assert!(faults.contains(&Fault::SetpointLost), "cut for {seconds} s: {faults:?}");
        assert_eq!((play.rig.core().mode(), play.rig.car().speed_mps), (Mode::Stop, 0.0));
        play.arm().unwrap();
        play.expect_drive().unwrap();
    });
}

/// What a cut shorter than the car's time-out does: nothing, or a stop.
#[test]
fn a_cut_that_the_car_does_not_notice_is_driven_through_or_stopped_for() {
    for seconds in [0.02, 0.035, 0.05, 0.065] {
        let mut trial = hall().cut(DAEMON, 1.5);
        trial.faults.cuts[0].until_s = 1.5 + seconds;
        let switch = Arc::new(AtomicBool::new(false));
        let mut play = Play::new(trial.rig(), Fault::SetpointLost, false, switch);
        play.get_going(1.0).unwrap();
        play.run(5.0).unwrap();
        let faults: Vec<Fault> = play.rig.core().faults().iter().collect();
        assert_eq!(faults, [], "cut for {seconds} s");
        assert_eq!(play.rig.core().mode(), Mode::Drive, "cut for {seconds} s");
    }
}

/// After a cut in the bends of a maze the daemon does not know where the car is to the centimetre.
/// What it knew of the map is forgotten, and the drive goes on in what is seen anew.
#[test]
fn after_a_cut_in_bends_the_drive_goes_on_without_touching_anything() {
    let trials: Vec<(u64, f64)> = (0..4).map(|seed| (seed, 2.0 + 0.37 * seed as f64)).collect();
    let lost: u32 = trials
        .par_iter()
        .map(|(seed, from_s)| {
            let mut trial = Trial::maze(Family::Thin, 500 + seed).cut(DAEMON, *from_s);
            trial.faults.cuts[0].until_s = from_s + 0.7;
            let goal = trial.goal;
            let switch = Arc::new(AtomicBool::new(false));
            let mut play = Play::new(trial.rig(), Fault::PoseLost, false, switch);
            play.run(from_s + 2.5).unwrap();
            assert_eq!(play.rig.car().speed_mps, 0.0, "{}", trial.label());
            let lost = play.rig.core().faults().contains(Fault::PoseLost);
            if lost {
                assert!(play.rig.core().goal().is_none());
            }
            play.arm().unwrap();
            play.goto(Point::new(goal.x, goal.y)).unwrap();
            let before = play.rig.distance_m();
            play.run(4.0).unwrap();
            assert!(play.rig.distance_m() > before + 0.5, "{}", trial.label());
            u32::from(lost)
        })
        .sum();
    assert!(lost >= 2, "the pose was lost in {lost} of {} drives only", trials.len());
}
