//! What keeps the car from being armed, each reason by its own cause on the bus or in the computer.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use apexd::autopilot::{BusHealth, BusState, Command, Fault, HostHealth, Mode, Refusal};
use apexd::sim::faults::Harm;
use apexd::sim::rig::Rig;
use apexd::wire::can::INTERFACE_VERSION;

use super::play::{Play, hall};
use super::rows::{HEARTBEAT, ODOMETRY, SCAN, STATUS, TAIL};
use super::trial::{CAR, DAEMON};

/// A car that stands and is not told to go anywhere, after a second.
fn standing(lost: Option<((u16, u16), usize)>, prepare: impl FnOnce(&mut Rig)) -> Rig {
    let trial = match lost {
        Some((ids, receiver)) => {
            hall().harm(Harm::Loss, 1.0, Some(receiver), Some(ids), 0.0, f64::INFINITY)
        }
        None => hall(),
    };
    let mut rig = trial.idle_rig();
    prepare(&mut rig);
    while rig.now().as_secs_f64() < 1.0 {
        rig.step();
    }
    rig
}

#[track_caller]
fn assert_refused(rig: &mut Rig, reason: Refusal) {
    let now = rig.now();
    assert_eq!(rig.core().pre_arm(now), [reason], "all reasons");
    assert_eq!(rig.core_mut().handle_command(now, Command::Arm), Err(reason));
    assert_eq!(rig.core().mode(), Mode::Disarmed);
}

#[test]
fn a_sound_car_can_be_armed() {
    let mut rig = standing(None, |_| {});
    let now = rig.now();
    assert_eq!(rig.core().pre_arm(now), []);
    assert_eq!(rig.core_mut().handle_command(now, Command::Arm), Ok(()));
    assert_eq!(rig.core().mode(), Mode::Standby);
}

#[test]
fn what_does_not_come_from_the_car_is_named() {
    for (ids, reason) in
        [(HEARTBEAT, Refusal::NoHeartbeat), (STATUS, Refusal::NoStatus), (SCAN, Refusal::NoScan)]
    {
        let mut rig = standing(Some((ids, DAEMON)), |_| {});
        let now = rig.now();
        let reasons = rig.core().pre_arm(now);
        assert_eq!(reasons.first(), Some(&reason), "{reasons:?}");
        // Without its status nobody knows which tail the car holds.
        let also = |refusal: &Refusal| *refusal == reason || *refusal == Refusal::TailNotHeld;
        assert!(reasons.iter().all(also), "{reasons:?}");
        assert_eq!(rig.core_mut().handle_command(now, Command::Arm), Err(reason));
    }
    let mut rig = standing(Some((ODOMETRY, DAEMON)), |_| {});
    let now = rig.now();
    assert_eq!(rig.core_mut().handle_command(now, Command::Arm), Err(Refusal::NoOdometry));
}

#[test]
fn another_version_of_the_interface_is_refused() {
    for theirs in [INTERFACE_VERSION - 1, INTERFACE_VERSION + 1, 255] {
        let mut rig = standing(None, |rig| rig.set_interface_version(theirs));
        assert_refused(&mut rig, Refusal::WrongVersion { theirs, ours: INTERFACE_VERSION });
    }
}

#[test]
fn the_state_of_the_car_is_looked_at() {
    let mut rig = standing(None, |rig| rig.set_emergency_stop(true));
    assert_refused(&mut rig, Refusal::EmergencyStop);
    let mut rig = standing(None, |rig| rig.set_battery_v(9.0));
    assert_refused(&mut rig, Refusal::BatteryLow { battery_v: 9.0, low_v: 9.6 });
    let mut rig = standing(Some((TAIL, CAR)), |_| {});
    assert_refused(&mut rig, Refusal::TailNotHeld);
}

#[test]
fn the_state_of_the_computer_is_looked_at() {
    for state in [BusState::Passive, BusState::Off] {
        let mut rig = standing(None, |_| {});
        let now = rig.now();
        rig.core_mut().handle_bus_health(now, BusHealth { state, ..BusHealth::default() });
        assert_refused(&mut rig, Refusal::BusNotActive(state));
    }
    let mut rig = standing(None, |_| {});
    let now = rig.now();
    let full = HostHealth { disk_full: true, ..HostHealth::default() };
    rig.core_mut().handle_host_health(now, full);
    assert_refused(&mut rig, Refusal::DiskFull);
    let mut rig = standing(None, |rig| rig.delay_ticks(0.007));
    assert_refused(&mut rig, Refusal::Overload);
    let mut rig = standing(None, |_| {});
    rig.shift_car_clock(20.0);
    while rig.now().as_secs_f64() < 1.1 {
        rig.step();
    }
    assert_refused(&mut rig, Refusal::Unsettled(Fault::ClockJump));
}

#[test]
fn a_missing_network_is_reported_and_no_reason_to_stay() {
    let mut rig = standing(None, |_| {});
    let now = rig.now();
    let missing = HostHealth { predictor_missing: true, ..HostHealth::default() };
    rig.core_mut().handle_host_health(now, missing);
    while rig.now().as_secs_f64() < 1.1 {
        rig.step();
    }
    assert!(rig.core().faults().contains(Fault::NoPrediction));
    let now = rig.now();
    assert_eq!(rig.core_mut().handle_command(now, Command::Arm), Ok(()));
}

#[test]
fn a_car_that_still_moves_is_not_armed() {
    let switch = Arc::new(AtomicBool::new(false));
    let mut play = Play::new(hall().rig(), Fault::EmergencyStop, false, switch);
    play.get_going(3.0).unwrap();
    play.rig.set_emergency_stop(true);
    play.run(0.1).unwrap();
    play.rig.set_emergency_stop(false);
    play.run(0.05).unwrap();
    assert!(play.rig.car().speed_mps > 0.5, "{:?}", play.rig.car());
    assert_eq!(play.arm(), Err(Refusal::Moving));
}

/// A button pressed and released while the car waits for a goal is latched too.
#[test]
fn a_fault_in_standby_is_cleared_by_arming_and_not_by_a_goal() {
    let mut rig = standing(None, |_| {});
    let now = rig.now();
    rig.core_mut().handle_command(now, Command::Arm).unwrap();
    rig.set_emergency_stop(true);
    for _ in 0..100 {
        rig.step();
    }
    rig.set_emergency_stop(false);
    for _ in 0..1000 {
        rig.step();
    }
    assert!(rig.core().faults().contains(Fault::EmergencyStop));
    let place = rig.car().pose;
    let goal = hall().goal;
    let now = rig.now();
    rig.core_mut().handle_command(now, Command::Goto(goal)).unwrap();
    for _ in 0..1000 {
        rig.step();
    }
    assert_eq!((rig.core().mode(), rig.car().pose), (Mode::Stop, place));
    let now = rig.now();
    rig.core_mut().handle_command(now, Command::Arm).unwrap();
    assert_eq!(rig.core().mode(), Mode::Hold);
    rig.core_mut().handle_command(now, Command::Continue).unwrap();
    for _ in 0..1000 {
        rig.step();
    }
    assert!(rig.distance_m() > 0.3);
}

#[test]
fn a_car_that_was_told_to_wait_waits_after_a_fault_too() {
    let switch = Arc::new(AtomicBool::new(false));
    let trial = hall().harm(Harm::Loss, 1.0, Some(DAEMON), Some(SCAN), 2.0, 3.0);
    let mut play = Play::new(trial.rig(), Fault::ScanLate, false, switch);
    play.get_going(2.0).unwrap();
    let now = play.rig.now();
    play.rig.core_mut().handle_command(now, Command::Pause).unwrap();
    play.run(5.0).unwrap();
    assert!(play.rig.core().faults().iter().next().is_none());
    assert_eq!(play.rig.core().mode(), Mode::Hold);
    assert_eq!(play.rig.car().speed_mps, 0.0);
    play.expect_drive().unwrap();
}
