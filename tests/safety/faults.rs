//! Everything else that can go wrong on the bus: what ends at rest, how soon it is named, and what
//! the drive goes on through.

use apexd::autopilot::{Command, CoreParams, Event, Fault, Mode};
use apexd::sim::drive::Outcome;
use apexd::sim::faults::Harm;
use apexd::sim::maze::Family;
use apexd::sim::rig::Rig;
use rayon::prelude::*;

use super::bus_cut::{RECORDINGS, assert_safe_at_rest, run_on};
use super::cases;
use super::trial::{CAR, DAEMON, Trial};

/// Identifiers of the car's frames (`docs/can-interface.md`).
const STATUS: (u16, u16) = (0x020, 0x021);
const SETPOINT: (u16, u16) = (0x040, 0x041);
const ODOMETRY: (u16, u16) = (0x050, 0x051);
const SCAN: (u16, u16) = (0x100, 0x101);

/// When a fault was raised first, seconds.
fn raised_s(rig: &mut Rig, wanted: Fault) -> Option<f64> {
    let mut first = None;
    while let Some(event) = rig.poll_event() {
        if let Event::FaultRaised { at, fault } = event
            && fault == wanted
        {
            first = first.or(Some(at.as_secs_f64()));
        }
    }
    first
}

/// One kind of frame stops coming at `from_s`: at rest in free space, and named in time. The frames
/// came every `period_s`, so the last one may have been that old.
#[track_caller]
fn assert_loss_is_named(ids: (u16, u16), receiver: usize, fault: Fault, period_s: f64) {
    let cases: Vec<_> =
        RECORDINGS.iter().flat_map(|r| [1.3, 2.17, 4.41, 6.0].map(|from_s| (r, from_s))).collect();
    let driving = cases
        .par_iter()
        .map(|(recording, from_s)| {
            let trial = recording.trial().clone();
            let trial =
                trial.harm(Harm::Loss, 1.0, Some(receiver), Some(ids), *from_s, f64::INFINITY);
            let what = format!("{}, {fault:?} from {from_s} s", trial.label());
            let mut rig = trial.rig_with(recording.replay());
            run_on(&mut rig, *from_s);
            let moving = rig.car().speed_mps > 1.0;
            assert_eq!(rig.core().mode(), Mode::Drive, "{what}");
            run_on(&mut rig, 3.0);
            let raised_s = raised_s(&mut rig, fault);
            let within_s = fault.row().within_s(&CoreParams::default()) + period_s + 0.002;
            assert!(
                raised_s.is_some_and(|t| t >= *from_s && t <= from_s + within_s),
                "{what}: raised at {raised_s:?}, due within {within_s} s"
            );
            assert_safe_at_rest(&rig, &what);
            assert_eq!(rig.core().mode(), Mode::Stop, "{what}");
            u32::from(moving)
        })
        .sum::<u32>();
    assert!(driving >= 4, "{driving} of {} were moving", cases.len());
}

#[test]
fn lost_scans_end_at_rest_and_are_named_in_time() {
    assert_loss_is_named(SCAN, DAEMON, Fault::ScanLate, 0.05 + 0.01);
}

#[test]
fn lost_odometry_ends_at_rest_and_is_named_in_time() {
    assert_loss_is_named(ODOMETRY, DAEMON, Fault::OdometryLate, 0.01);
}

#[test]
fn a_lost_car_status_ends_at_rest_and_is_named_in_time() {
    assert_loss_is_named(STATUS, DAEMON, Fault::StatusLost, 0.02);
}

#[test]
fn lost_setpoints_end_at_rest_and_are_named_in_time() {
    // The row counts with the car's own 0.1 s; it says so in its next status frame.
    assert_loss_is_named(SETPOINT, CAR, Fault::SetpointLost, 0.01);
}

#[test]
fn a_scan_stream_that_comes_back_lets_the_drive_go_on() {
    let recording = &RECORDINGS[1];
    let trial = recording.trial().clone();
    let trial = trial.harm(Harm::Loss, 1.0, Some(DAEMON), Some(SCAN), 2.0, 4.0);
    let mut rig = trial.rig_with(recording.replay());
    run_on(&mut rig, 4.0);
    assert_safe_at_rest(&rig, "scans lost");
    let before = rig.distance_m();
    run_on(&mut rig, 2.0);
    assert_eq!(rig.core().mode(), Mode::Drive);
    assert!(rig.distance_m() > before + 0.5, "{} m", rig.distance_m() - before);
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
}

#[test]
fn the_emergency_stop_brakes_at_once_and_asks_to_be_armed_anew() {
    RECORDINGS.par_iter().for_each(|recording| {
        let trial = recording.trial();
        let what = format!("{}, emergency stop", trial.label());
        let mut rig = trial.rig_with(recording.replay());
        run_on(&mut rig, 2.6);
        let speed = rig.car().speed_mps;
        let pressed_s = rig.now().as_secs_f64();
        rig.set_emergency_stop(true);
        // From 8 m/s with all the grip there is; bends take their share.
        run_on(&mut rig, speed / (0.7 * 8.829) + 0.05);
        assert_safe_at_rest(&rig, &what);
        let raised_s = raised_s(&mut rig, Fault::EmergencyStop).expect("it is named");
        let within_s = Fault::EmergencyStop.row().within_s(&CoreParams::default());
        assert!(raised_s - pressed_s <= within_s, "{what}: named after {}", raised_s - pressed_s);

        let place = rig.car().pose;
        let now = rig.now();
        assert!(rig.core_mut().handle_command(now, Command::Arm).is_err(), "{what}: armed");
        rig.set_emergency_stop(false);
        run_on(&mut rig, 1.0);
        assert_eq!(rig.car().pose, place, "{what}: moves on without being armed");
        assert_eq!(rig.core().mode(), Mode::Stop, "{what}");
        let now = rig.now();
        rig.core_mut().handle_command(now, Command::Arm).expect("the button is released");
        rig.core_mut().handle_command(now, Command::Continue).expect("the goal was kept");
        run_on(&mut rig, 1.5);
        assert!((rig.car().pose.position - place.position).norm() > 0.3, "{what}: stays");
        assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0), "{what}");
    });
}

/// Random harm to all frames in both directions.
fn harmed(harm: Harm, probability: f64, seed: u64) -> Trial {
    let mut trial = Trial::maze(Family::Solid, 300 + seed);
    trial.seed = seed;
    trial.name = format!("{}, {harm:?} of {probability}", trial.name);
    trial.harm(harm, probability, None, None, 0.0, f64::INFINITY)
}

#[test]
fn rare_faults_of_frames_do_not_keep_the_car_from_its_goal() {
    let kinds = [
        (Harm::Loss, 0.001),
        (Harm::Flip { bits: 3 }, 0.001),
        (Harm::Duplicate, 0.05),
        (Harm::Delay { up_to_s: 0.001 }, 0.01),
    ];
    let trials: Vec<Trial> = (0..cases(1, 10))
        .flat_map(|seed| kinds.map(|(harm, probability)| harmed(harm, probability, seed)))
        .collect();
    trials.par_iter().for_each(|trial| {
        let mut rig = trial.rig();
        let outcome = rig.drive(|_| {});
        let judge = rig.judge();
        let what = trial.label();
        assert_eq!(judge.collisions(), 0, "{what}: contact at {:?}", rig.car());
        assert_eq!(judge.unknown_entries(), 0, "{what}: unknown entry");
        assert_eq!(outcome, Outcome::Goal, "{what} at {}", rig.now());
    });
}

#[test]
fn heavy_faults_of_frames_are_never_worse_than_a_stop() {
    let kinds = [
        (Harm::Loss, 0.05),
        (Harm::Loss, 0.5),
        (Harm::Flip { bits: 1 }, 0.1),
        (Harm::Flip { bits: 40 }, 0.1),
        (Harm::Duplicate, 0.9),
        (Harm::Delay { up_to_s: 0.05 }, 0.2),
        (Harm::Delay { up_to_s: 0.5 }, 0.05),
    ];
    let trials: Vec<Trial> = (0..cases(1, 10))
        .flat_map(|seed| {
            kinds.map(|(harm, probability)| {
                let mut trial = harmed(harm, probability, 50 + seed).for_s(6.0);
                // A clean beginning, so that the car is at speed when it starts.
                trial.faults.frames[0].from_s = 1.5;
                trial
            })
        })
        .collect();
    trials.par_iter().for_each(|trial| {
        let mut rig = trial.rig();
        run_on(&mut rig, 1.5);
        assert!(rig.car().speed_mps > 0.5, "{}: {:?}", trial.label(), rig.car());
        run_on(&mut rig, 4.0);
        let what = trial.label();
        let judge = rig.judge();
        assert_eq!(judge.collisions(), 0, "{what}: contact at {:?}", rig.car());
        assert_eq!(judge.unknown_entries(), 0, "{what}: unknown entry at {:?}", rig.car());
    });
}

#[test]
fn a_bus_full_of_foreign_frames_ends_in_a_stop() {
    let recording = &RECORDINGS[0];
    let mut trial = recording.trial().clone();
    trial.faults.floods.push(apexd::sim::faults::Flood {
        id: 0x001,
        fd: false,
        period_s: 0.0,
        from_s: 3.0,
        until_s: f64::INFINITY,
    });
    let mut rig = trial.rig_with(recording.replay());
    run_on(&mut rig, 4.5);
    assert_safe_at_rest(&rig, "flooded");
}

/// Ahead of the scans in priority, and behind them: two thirds of the bus, beside our own traffic.
#[test]
fn of_five_thousand_foreign_frames_a_second_nothing_of_ours_is_lost() {
    for id in [0x0F0, 0x321] {
        let mut trial = Trial::maze(Family::Thin, 3).for_s(5.0);
        trial.faults.floods.push(apexd::sim::faults::Flood {
            id,
            fd: false,
            period_s: 2e-4,
            from_s: 1.0,
            until_s: f64::INFINITY,
        });
        let mut rig = trial.rig();
        run_on(&mut rig, 5.0);
        let wire = rig.core().wire_statistics();
        assert!(wire.foreign > 19_000, "{wire:?}");
        assert_eq!((wire.lost, wire.incomplete, wire.wrong_crc), (0, 0, 0), "{wire:?}");
        assert!(rig.core().faults().iter().next().is_none(), "{:?}", rig.core().faults());
        assert!(rig.car().speed_mps > 0.5, "{:?}", rig.car());
    }
}
