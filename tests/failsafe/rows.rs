//! Every row of the table: what is done to bring the fault about, and what must come of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use apexd::autopilot::{BusHealth, BusState, Command, Fault, HostHealth, Refusal};
use apexd::frames::{Point, Pose};
use apexd::plan::Verdict;
use apexd::sim::faults::Harm;
use apexd::sim::rig::Rig;
use apexd::sim::world::World;
use apexd::time::Duration;
use rayon::prelude::*;

use super::planners::{Babbler, Barren, Reckless};
use super::play::{Outcome, Play, hall, must};
use super::trial::{CAR, DAEMON, Trial};

/// Identifiers of the frames (`docs/can-interface.md`).
pub const STATUS: (u16, u16) = (0x020, 0x021);
pub const SETPOINT: (u16, u16) = (0x040, 0x041);
pub const ODOMETRY: (u16, u16) = (0x050, 0x051);
pub const TAIL: (u16, u16) = (0x060, 0x061);
pub const HEARTBEAT: (u16, u16) = (0x070, 0x071);
pub const SCAN: (u16, u16) = (0x100, 0x101);

/// When the bus begins to fail in the scenarios that have it in their fault plan, seconds: the car
/// is under way.
const FROM_S: f64 = 1.5;
/// Periods of the car's frames, with their way over the bus, seconds.
const STATUS_S: f64 = 0.021;
const ODOMETRY_S: f64 = 0.011;
const SCAN_S: f64 = 0.06;

/// A scenario.
pub struct Scenario {
    pub name: &'static str,
    pub fault: Fault,
    rig: fn(&Arc<AtomicBool>) -> Rig,
    script: fn(&mut Play) -> Outcome,
}

impl Scenario {
    pub fn play(&self, suppressed: bool) -> Outcome {
        let switch = Arc::new(AtomicBool::new(false));
        let rig = (self.rig)(&switch);
        (self.script)(&mut Play::new(rig, self.fault, suppressed, switch))
    }
}

fn plain(_: &Arc<AtomicBool>) -> Rig {
    hall().rig()
}

/// Frames with these identifiers do not reach `receiver` for some time.
fn without(ids: (u16, u16), receiver: usize, seconds: f64) -> Rig {
    hall().harm(Harm::Loss, 1.0, Some(receiver), Some(ids), FROM_S, FROM_S + seconds).rig()
}

/// Up to the moment at which the bus begins to fail.
fn to_failure(play: &mut Play) -> Outcome {
    play.get_going(1.0)?;
    let wait_s = FROM_S - play.now_s();
    must!(wait_s > 0.0, "the car gets going too late");
    play.run(wait_s)
}

/// Something that does not come for a second, and then comes again.
fn silence(play: &mut Play, source_s: f64, goes_on: bool) -> Outcome {
    to_failure(play)?;
    let raised = play.expect_raised(source_s)?;
    play.expect_action(raised)?;
    play.expect_rest(FROM_S + 1.0 - play.now_s() - 0.001)?;
    play.expect_cleared(SCAN_S)?;
    if goes_on { play.expect_drive() } else { Ok(()) }
}

fn emergency_stop(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.set_emergency_stop(true);
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.expect_rest(0.5)?;
    must!(play.arm() == Err(Refusal::EmergencyStop), "armed with the button pressed");
    play.rig.set_emergency_stop(false);
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

/// The car notices first, and says so in its next status.
fn setpoint_lost(play: &mut Play) -> Outcome {
    to_failure(play)?;
    let raised = play.expect_raised(0.011)?;
    play.expect_action(raised)?;
    play.expect_rest(FROM_S + 1.0 - play.now_s() - 0.001)?;
    must!(play.arm() == Err(Refusal::SetpointLost), "armed although the car takes no setpoints");
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

/// The controller has lost its tail with all the rest: nothing but full braking is left.
fn restarted_controller(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.restart_controller();
    let raised = play.expect_raised(ODOMETRY_S)?;
    play.expect_action(raised)?;
    must!(play.rig.core().goal().is_none(), "a goal on a map that is forgotten");
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

/// The daemon is off the bus for half a second; its pose is uncertain when it comes back.
fn unseen_way(play: &mut Play) -> Outcome {
    to_failure(play)?;
    let before = play.rig.distance_m();
    // The row counts from the end of the gap: before there is nothing to see.
    play.run(0.5)?;
    must!(play.rig.distance_m() - before > 0.3, "hardly moved unseen");
    let raised = play.expect_raised(ODOMETRY_S)?;
    play.expect_action(raised)?;
    must!(play.rig.core().goal().is_none(), "a goal on a map that is forgotten");
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

fn bus_off(play: &mut Play) -> Outcome {
    to_failure(play)?;
    let off = BusHealth { state: BusState::Off, ..BusHealth::default() };
    let now = play.rig.now();
    play.rig.core_mut().handle_bus_health(now, off);
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.run(FROM_S + 1.0 - play.now_s())?;
    play.expect_rest(1.0)?;
    must!(play.arm() == Err(Refusal::BusNotActive(BusState::Off)), "armed off the bus");
    let now = play.rig.now();
    play.rig.core_mut().handle_bus_health(now, BusHealth::default());
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

/// The process is stopped for a second and goes on: the car has stopped by itself meanwhile, and
/// what the core believed is out of date.
fn stopped_process(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.stop_process(1.0);
    play.run(0.999)?;
    must!(play.rig.car().speed_mps == 0.0, "does not stop by itself");
    play.expect_raised(0.001)?;
    play.expect_cleared(0.02)?;
    // The car says that setpoints were lost: a person is asked.
    must!(play.rig.core().faults().contains(Fault::SetpointLost), "drives on by itself");
    play.expect_standing(1.0)?;
    play.arm().map_err(|refusal| format!("cannot be armed: {refusal}"))?;
    play.expect_drive()
}

fn car_clock_ahead(play: &mut Play) -> Outcome {
    car_clock(play, 10.0)
}

fn car_clock_back(play: &mut Play) -> Outcome {
    car_clock(play, -0.4)
}

fn car_clock(play: &mut Play, seconds: f64) -> Outcome {
    play.get_going(3.0)?;
    play.rig.shift_car_clock(seconds);
    let raised = play.expect_raised(ODOMETRY_S)?;
    play.expect_action(raised)?;
    play.until(2.0, |rig| !rig.core().faults().contains(Fault::ClockJump))?;
    play.expect_drive()
}

fn odometry_late(play: &mut Play) -> Outcome {
    // The way to rest was not seen: the pose is lost too, and a person is asked.
    silence(play, ODOMETRY_S, false)?;
    must!(play.rig.core().faults().contains(Fault::PoseLost), "the pose is trusted");
    play.arm().map_err(|refusal| format!("cannot be armed: {refusal}"))?;
    play.expect_drive()
}

/// A car whose steering answers late strays from its path in bends.
fn sluggish(_: &Arc<AtomicBool>) -> Rig {
    let mut trial = Trial::hall(14.0, 14.0, Pose::new(3.0, 3.0, 0.0), Point::new(11.0, 9.0));
    trial.car.steering_lag_s = 0.17;
    trial.rig()
}

fn tracking_error(play: &mut Play) -> Outcome {
    let limit_m = 0.04;
    play.until(8.0, |rig| rig.core().tracking_error().lateral_m.abs() > limit_m)?;
    let raised = play.expect_raised_just_now()?;
    // The wheels go on turning late while it brakes.
    play.expect_action_with(raised, 0.6)?;
    play.expect_cleared(0.0)?;
    play.run(1.0)
}

/// A hall whose world is finer than the map.
fn fine_hall(_: &Arc<AtomicBool>) -> Rig {
    let (columns, rows) = (700, 200);
    let solid: Vec<bool> = (0..columns * rows)
        .map(|i| {
            let (x, y) = (i % columns, i / columns);
            x == 0 || y == 0 || x + 1 == columns || y + 1 == rows
        })
        .collect();
    let world = World::new(0.02, Pose::new(0.0, 0.0, 0.0), columns, rows, &solid);
    let start = Pose::new(1.5, 2.0, 0.0);
    Trial::in_world("fine hall".into(), world, start, Point::new(12.0, 2.0)).rig()
}

/// Something appears beside the way, nearer to it than the certificate allows and further than the
/// car is wide, too near to stop before it.
fn path_blocked(play: &mut Play) -> Outcome {
    play.get_going(3.5)?;
    let pose = play.rig.car().pose;
    let place = Pose::new(pose.position.x + 0.7, 2.25, 0.0);
    must!((pose.position.y - 2.0).abs() < 0.005, "not on the middle line: {pose:?}");
    must!(play.rig.world_mut().fill_rect(place, 0.06, 0.04) > 0, "nothing was set down");
    let raised = play.expect_raised(SCAN_S)?;
    play.expect_action(raised)?;
    play.expect_cleared(0.0)?;
    play.run(1.0)
}

/// The lidar delivers its scans 115 ms late: too old before the next one comes, but not missing.
fn scan_late(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.set_scan_delay(Duration::from_millis(115));
    let raised = play.expect_raised(SCAN_S)?;
    play.expect_action(raised)?;
    play.expect_rest(1.0)?;
    let missing = play.rig.core().faults().contains(Fault::ScanMissing);
    must!(!missing, "more than late: another row's scenario");
    play.rig.set_scan_delay(Duration::ZERO);
    play.expect_cleared(0.2)?;
    play.expect_drive()
}

fn scan_missing(play: &mut Play) -> Outcome {
    silence(play, SCAN_S, true)
}

fn tail_not_held(play: &mut Play) -> Outcome {
    to_failure(play)?;
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.run(FROM_S + 3.0 - play.now_s())?;
    play.expect_cleared(0.1)?;
    play.expect_drive()
}

fn damaged(_: &Arc<AtomicBool>) -> Rig {
    let ids = (STATUS.0, ODOMETRY.1);
    let flip = Harm::Flip { bits: 3 };
    hall().harm(flip, 0.15, Some(DAEMON), Some(ids), FROM_S, FROM_S + 1.5).rig()
}

fn repeated(_: &Arc<AtomicBool>) -> Rig {
    let twice = Harm::Duplicate;
    hall().harm(twice, 0.5, Some(DAEMON), Some(SCAN), FROM_S, FROM_S + 1.5).rig()
}

fn corrupt_frames(play: &mut Play) -> Outcome {
    to_failure(play)?;
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.run((FROM_S + 1.5 - play.now_s()).max(0.0))?;
    play.until(1.7, |rig| !rig.core().faults().contains(Fault::CorruptFrames))?;
    play.expect_drive()
}

/// The driver reports, ten times a second.
fn bus_reports(play: &mut Play, times: u32, mut next: impl FnMut(u64) -> BusHealth) -> Outcome {
    for k in 1..=times {
        let now = play.rig.now();
        play.rig.core_mut().handle_bus_health(now, next(u64::from(k)));
        play.run(0.1)?;
        if play.rig.core().faults().contains(Fault::BusErrors) {
            break;
        }
    }
    Ok(())
}

fn bus_errors(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    let health = |k| BusHealth { error_frames: 8 * k, ..BusHealth::default() };
    let (begin, plans) = (play.now_s(), play.rig.core().statistics().plans_adopted);
    bus_reports(play, 9, health)?;
    must!(play.rig.core().faults().contains(Fault::BusErrors), "not raised");
    must!(play.now_s() - begin < 0.8, "raised only after {} s", play.now_s() - begin);
    play.until(5.0, |rig| rig.car().speed_mps == 0.0)?;
    must!(play.rig.core().statistics().plans_adopted < plans + 18, "plans are still adopted");
    play.until(2.0, |rig| !rig.core().faults().contains(Fault::BusErrors))?;
    play.expect_drive()
}

fn bus_passive(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    let now = play.rig.now();
    let health = BusHealth { state: BusState::Passive, ..BusHealth::default() };
    play.rig.core_mut().handle_bus_health(now, health);
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.expect_rest(1.0)?;
    let now = play.rig.now();
    play.rig.core_mut().handle_bus_health(now, BusHealth::default());
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

fn frames_unsent(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    let health = |k| BusHealth { frames_unsent: 3 * k, ..BusHealth::default() };
    bus_reports(play, 9, health)?;
    must!(play.rig.core().faults().contains(Fault::BusErrors), "not raised");
    play.until(5.0, |rig| rig.car().speed_mps == 0.0)?;
    play.until(2.0, |rig| !rig.core().faults().contains(Fault::BusErrors))?;
    play.expect_drive()
}

fn overload(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.delay_ticks(0.006);
    let raised = play.expect_raised(0.006)?;
    play.expect_action(raised)?;
    play.expect_rest(1.0)?;
    must!(play.rig.core().mode() == apexd::autopilot::Mode::Stop, "drives on");
    play.rig.delay_ticks(0.0);
    play.expect_cleared(1.0)?;
    play.expect_drive()
}

fn battery_low(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    // A dip of less than a second, as when speeding up, is none.
    play.rig.set_battery_v(9.0);
    play.run(0.9)?;
    play.rig.set_battery_v(11.0);
    play.run(0.5)?;
    must!(!play.rig.core().faults().contains(Fault::BatteryLow), "a dip ends the drive");
    play.rig.set_battery_v(9.0);
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    let refused = matches!(play.arm(), Err(Refusal::BatteryLow { .. }));
    must!(refused, "armed with an empty battery");
    play.rig.set_battery_v(10.5);
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

/// A hall with a wall right across, out of sight at first, the goal behind it.
fn divided(_: &Arc<AtomicBool>) -> Rig {
    let (columns, rows) = (280, 40);
    let solid: Vec<bool> = (0..columns * rows)
        .map(|i| {
            let (x, y) = (i % columns, i / columns);
            x == 0 || y == 0 || x + 1 == columns || y + 1 == rows || x == 220 || x == 221
        })
        .collect();
    let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), columns, rows, &solid);
    let start = Pose::new(2.0, 2.0, 0.0);
    Trial::in_world("divided hall".into(), world, start, Point::new(26.0, 2.0)).rig()
}

fn goal_unreachable(play: &mut Play) -> Outcome {
    play.get_going(1.0)?;
    // Up to the planning step that finds it out.
    let mut found = false;
    for _ in 0..20_000 {
        play.run(0.001)?;
        found = play
            .rig
            .take_reports()
            .iter()
            .any(|(_, report)| matches!(report.verdict, Verdict::Unreachable));
        if found {
            break;
        }
    }
    must!(found, "the planner never gives up");
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.expect_cleared_by(Point::new(6.0, 2.0))?;
    Ok(())
}

fn reckless(switch: &Arc<AtomicBool>) -> Rig {
    let trial = hall();
    let planner = trial.planner();
    trial.rig_with(Box::new(Reckless { planner, switch: Arc::clone(switch) }))
}

fn guard_stop(play: &mut Play) -> Outcome {
    play.get_going(2.0)?;
    play.switch.store(true, Ordering::Relaxed);
    play.until(15.0, |rig| rig.core().guard_counts().stops > 0)?;
    play.expect_raised_just_now()?;
    play.switch.store(false, Ordering::Relaxed);
    play.until(3.0, |rig| !rig.core().faults().contains(Fault::GuardStop))
}

fn planner_late(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.rig.hang_planner(true);
    let raised = play.expect_raised(SCAN_S + 0.02)?;
    play.expect_action(raised)?;
    play.until(6.0, |rig| rig.car().speed_mps == 0.0)?;
    play.expect_rest(1.0)?;
    play.rig.hang_planner(false);
    play.expect_cleared(0.1)?;
    play.expect_drive()
}

fn barren(switch: &Arc<AtomicBool>) -> Rig {
    let trial = hall();
    let planner = trial.planner();
    trial.rig_with(Box::new(Barren { planner, switch: Arc::clone(switch) }))
}

fn no_plan(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    play.switch.store(true, Ordering::Relaxed);
    let raised = play.expect_raised(SCAN_S + 0.02)?;
    play.expect_action(raised)?;
    play.until(6.0, |rig| rig.car().speed_mps == 0.0)?;
    play.expect_rest(1.0)?;
    play.switch.store(false, Ordering::Relaxed);
    play.expect_cleared(0.1)?;
    play.expect_drive()
}

fn babbling(switch: &Arc<AtomicBool>) -> Rig {
    let trial = hall();
    let babbler = Babbler { switch: Arc::clone(switch) };
    trial.rig_with(Box::new(trial.planner_with(Box::new(babbler))))
}

fn no_prediction(play: &mut Play) -> Outcome {
    play.get_going(2.0)?;
    play.switch.store(true, Ordering::Relaxed);
    let raised = play.expect_raised(0.0)?;
    play.switch.store(false, Ordering::Relaxed);
    play.expect_action(raised)?;
    // The predictor is left alone for 20 steps, a second.
    play.until(2.5, |rig| !rig.core().faults().contains(Fault::NoPrediction))
}

fn predictor_missing(play: &mut Play) -> Outcome {
    play.get_going(2.0)?;
    let now = play.rig.now();
    let missing = HostHealth { predictor_missing: true, ..HostHealth::default() };
    play.rig.core_mut().handle_host_health(now, missing);
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.run(1.0)?;
    must!(play.rig.core().faults().contains(Fault::NoPrediction), "cleared by a step without one");
    let now = play.rig.now();
    play.rig.core_mut().handle_host_health(now, HostHealth::default());
    play.expect_cleared(0.0)
}

/// A command ends the drive for good.
fn terminated(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    let now = play.rig.now();
    let ordered = play.rig.core_mut().handle_command(now, Command::Terminate);
    must!(ordered.is_ok(), "refused: {ordered:?}");
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.expect_rest(1.0)?;
    must!(play.arm() == Err(Refusal::Terminated), "armed all the same");
    play.expect_rest(0.5)
}

/// What the ground-station service finds out comes as a command.
fn station_lost(play: &mut Play) -> Outcome {
    play.get_going(3.0)?;
    let now = play.rig.now();
    let told = play.rig.core_mut().handle_command(now, Command::StationLost(true));
    must!(told.is_ok(), "refused: {told:?}");
    let raised = play.expect_raised(0.0)?;
    play.expect_action(raised)?;
    play.expect_rest(1.0)?;
    let now = play.rig.now();
    let told = play.rig.core_mut().handle_command(now, Command::StationLost(false));
    must!(told.is_ok(), "refused: {told:?}");
    play.expect_cleared(0.0)?;
    play.expect_drive()
}

fn disk_full(play: &mut Play) -> Outcome {
    play.get_going(2.0)?;
    let now = play.rig.now();
    let full = HostHealth { disk_full: true, ..HostHealth::default() };
    play.rig.core_mut().handle_host_health(now, full);
    // The table's second is how often the program looks; here it is told.
    let raised = play.expect_raised(-1.0)?;
    play.expect_action(raised)?;
    let now = play.rig.now();
    must!(play.rig.core().pre_arm(now).contains(&Refusal::DiskFull), "no reason not to arm");
    play.rig.core_mut().handle_host_health(now, HostHealth::default());
    play.expect_cleared(0.0)
}

#[rustfmt::skip]
pub const SCENARIOS: &[Scenario] = &[
    Scenario { name: "a ground station ends it", fault: Fault::Terminated, rig: plain, script: terminated },
    Scenario { name: "the button is pressed", fault: Fault::EmergencyStop, rig: plain, script: emergency_stop },
    Scenario { name: "setpoints do not reach the car", fault: Fault::SetpointLost, rig: |_| without(SETPOINT, CAR, 1.0), script: setpoint_lost },
    Scenario { name: "the controller restarts", fault: Fault::PoseLost, rig: plain, script: restarted_controller },
    Scenario { name: "the link is cut and comes back", fault: Fault::PoseLost, rig: |_| off_the_bus(0.5), script: unseen_way },
    Scenario { name: "the computer is bus-off", fault: Fault::BusOff, rig: |_| off_the_bus(1.0), script: bus_off },
    Scenario { name: "the process is stopped", fault: Fault::ClockJump, rig: plain, script: stopped_process },
    Scenario { name: "the car's clock leaps ahead", fault: Fault::ClockJump, rig: plain, script: car_clock_ahead },
    Scenario { name: "the car's clock falls back", fault: Fault::ClockJump, rig: plain, script: car_clock_back },
    Scenario { name: "odometry stops coming", fault: Fault::OdometryLate, rig: |_| without(ODOMETRY, DAEMON, 1.0), script: odometry_late },
    Scenario { name: "the steering answers late", fault: Fault::TrackingError, rig: sluggish, script: tracking_error },
    Scenario { name: "something appears beside the way", fault: Fault::PathBlocked, rig: fine_hall, script: path_blocked },
    Scenario { name: "status stops coming", fault: Fault::StatusLost, rig: |_| without(STATUS, DAEMON, 1.0), script: |play| silence(play, STATUS_S, true) },
    Scenario { name: "scans stop coming", fault: Fault::ScanMissing, rig: |_| without(SCAN, DAEMON, 1.0), script: scan_missing },
    Scenario { name: "scans come late", fault: Fault::ScanLate, rig: plain, script: scan_late },
    Scenario { name: "tails do not reach the car", fault: Fault::TailNotHeld, rig: |_| without(TAIL, CAR, 3.0), script: tail_not_held },
    Scenario { name: "frames are damaged", fault: Fault::CorruptFrames, rig: damaged, script: corrupt_frames },
    Scenario { name: "frames are repeated", fault: Fault::CorruptFrames, rig: repeated, script: corrupt_frames },
    Scenario { name: "error frames on the bus", fault: Fault::BusErrors, rig: plain, script: bus_errors },
    Scenario { name: "the computer is error-passive", fault: Fault::BusErrors, rig: plain, script: bus_passive },
    Scenario { name: "frames cannot be sent", fault: Fault::BusErrors, rig: plain, script: frames_unsent },
    Scenario { name: "ticks are late", fault: Fault::Overload, rig: plain, script: overload },
    Scenario { name: "the battery runs low", fault: Fault::BatteryLow, rig: plain, script: battery_low },
    Scenario { name: "no ground station is heard", fault: Fault::StationLost, rig: plain, script: station_lost },
    Scenario { name: "a wall right across", fault: Fault::GoalUnreachable, rig: divided, script: goal_unreachable },
    Scenario { name: "a planner without regard", fault: Fault::GuardStop, rig: reckless, script: guard_stop },
    Scenario { name: "the planner hangs", fault: Fault::PlannerLate, rig: plain, script: planner_late },
    Scenario { name: "the planner finds nothing", fault: Fault::NoPlan, rig: barren, script: no_plan },
    Scenario { name: "the predictor babbles", fault: Fault::NoPrediction, rig: babbling, script: no_prediction },
    Scenario { name: "there is no network", fault: Fault::NoPrediction, rig: plain, script: predictor_missing },
    Scenario { name: "the disk is full", fault: Fault::DiskFull, rig: plain, script: disk_full },
];

/// The computer is off the bus for some time.
pub fn off_the_bus(seconds: f64) -> Rig {
    let mut trial = hall().cut(DAEMON, FROM_S);
    trial.faults.cuts[0].until_s = FROM_S + seconds;
    trial.rig()
}

/// Plays all scenarios and gathers those that do not end as `wanted`.
fn failures(suppressed: bool, wanted: fn(&Outcome) -> bool) -> Vec<String> {
    SCENARIOS
        .par_iter()
        .filter_map(|scenario| {
            let outcome = scenario.play(suppressed);
            let what = format!("{:?}, {}: {outcome:?}", scenario.fault, scenario.name);
            println!("{what}");
            (!wanted(&outcome)).then_some(what)
        })
        .collect()
}

#[test]
fn every_row_is_noticed_in_time_acted_upon_and_cleared_as_the_table_says() {
    let wrong = failures(false, Result::is_ok);
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn without_its_detector_no_row_passes() {
    let wrong = failures(true, Result::is_err);
    assert!(wrong.is_empty(), "these notice nothing: {wrong:#?}");
}

#[test]
fn no_row_is_without_a_scenario() {
    for fault in Fault::ALL {
        assert!(SCENARIOS.iter().any(|scenario| scenario.fault == fault), "{fault:?}");
    }
}
