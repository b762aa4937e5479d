//! Closed-loop tests: trajectory, tracker, setpoints every 10 ms, car at 1 kHz, odometry 10 ms old.

use proptest::prelude::*;

use super::*;
use crate::control::trial;
use crate::localize::Localizer;
use crate::sim::car::{Car, CarParams};

const ACCEL: f64 = 8.829;

/// Worst errors of one drive, and where it ended.
#[derive(Debug, Default, Clone, Copy)]
struct Worst {
    lateral_m: f64,
    along_m: f64,
    end_m: f64,
    slides: u64,
    restarts: u32,
}

fn drive(trajectory: &Trajectory, offset: Pose, odometry_age_ms: u64) -> Worst {
    let vehicle = VehicleParams::default();
    let first = trajectory.points[0].path;
    let start = Pose { position: first.position, heading_rad: first.heading_rad };
    let start = Pose {
        position: start.to_map(offset.position),
        heading_rad: start.heading_rad + offset.heading_rad,
    };
    let tracker = Tracker::new(&vehicle, &ControlParams::default(), 0.01);
    let mut car = Car::new(&vehicle, &CarParams::default(), start);
    let mut localizer = Localizer::new(start);
    let mut waiting = std::collections::VecDeque::new();
    let mut worst = Worst::default();
    let mut setpoint = ForceSetpoint::default();
    let mut next = setpoint;
    let total_ms = (trajectory.duration_s() * 1000.0) as u64 + 1500;
    let mut stood = 0;
    for ms in 0..total_ms {
        let now = trajectory.start.offset_by(ms as f64 * 1e-3);
        if ms % 10 == 0 {
            waiting.push_back((ms + odometry_age_ms, car.odometry(ms * 1000).stamped(now)));
        }
        while waiting.front().is_some_and(|(due, _)| *due <= ms) {
            localizer.handle_odometry(&waiting.pop_front().unwrap().1);
        }
        if ms % 10 == 0 {
            let pose = localizer.pose_at(now).unwrap();
            next = tracker.track(trajectory, now, pose, localizer.speed_at(now)).setpoint;
        }
        if ms % 10 == 1 {
            setpoint = next; // 1 ms on the bus
        }
        let before = car.state().speed_mps;
        car.step(1e-3, &setpoint);
        // True errors, at every step.
        let now = trajectory.start.offset_by((ms + 1) as f64 * 1e-3);
        let truth = tracker.track(trajectory, now, car.state().pose, car.state().speed_mps).error;
        worst.lateral_m = worst.lateral_m.max(truth.lateral_m.abs());
        worst.along_m = worst.along_m.max(truth.along_m.abs());
        if before > 0.0 && car.state().speed_mps == 0.0 {
            stood += 1;
        }
    }
    assert_eq!(car.state().speed_mps, 0.0);
    worst.slides = car.slides();
    worst.restarts = stood - 1;
    worst.end_m = (car.state().pose.position - trajectory.last().path.position).norm();
    worst
}

fn level() -> Pose {
    Pose::new(0.0, 0.0, 0.0)
}

#[test]
fn friction_limited_trajectories_are_followed_within_centimetres_to_their_end() {
    let mut all = Worst::default();
    for (speed, seeds) in [(2.0, 0..8), (4.0, 0..16), (8.0, 0..16)] {
        let mut worst = Worst::default();
        for seed in seeds {
            let start = Pose::new(3.0, -1.0, 0.7 * seed as f64);
            let at = Instant::from_nanos(2_000_000_000);
            let t = trial::trajectory(seed, start, at, 30.0, speed, 0.95 * ACCEL);
            let w = drive(&t, level(), 10);
            worst.lateral_m = worst.lateral_m.max(w.lateral_m);
            worst.along_m = worst.along_m.max(w.along_m);
            worst.end_m = worst.end_m.max(w.end_m);
            worst.slides += w.slides;
            worst.restarts = worst.restarts.max(w.restarts);
        }
        eprintln!("{speed} m/s: {worst:?}");
        all.lateral_m = all.lateral_m.max(worst.lateral_m);
        all.along_m = all.along_m.max(worst.along_m);
        all.end_m = all.end_m.max(worst.end_m);
        all.slides += worst.slides;
        all.restarts = all.restarts.max(worst.restarts);
    }
    assert!(all.lateral_m <= 0.015, "{all:?}");
    assert!(all.along_m <= 0.03, "{all:?}");
    assert!(all.end_m <= 0.01, "{all:?}");
    assert_eq!(all.slides, 0);
    assert!(all.restarts == 0, "{all:?}");
}

#[test]
fn a_car_that_starts_off_the_path_comes_back_to_it() {
    let t = trial::trajectory(3, level(), Instant::from_nanos(0), 20.0, 3.0, 0.7 * ACCEL);
    let w = drive(&t, Pose::new(-0.03, 0.04, 0.05), 10);
    assert!(w.lateral_m < 0.05 && w.end_m < 0.01, "{w:?}");
}

#[test]
fn a_trajectory_at_rest_holds_the_car() {
    let vehicle = VehicleParams::default();
    let tracker = Tracker::new(&vehicle, &ControlParams::default(), 0.01);
    let t = Trajectory::at_rest(Instant::ZERO, level());
    let step = tracker.track(&t, Instant::from_nanos(5_000_000_000), level(), 0.0);
    assert!(step.setpoint.longitudinal_n < 0.0 && step.setpoint.drive);
    assert_eq!(step.error, TrackingError::default());
}

#[test]
fn a_car_held_up_does_not_exceed_the_plans_speed_to_catch_up() {
    // 2 m straight on at 1 m/s at most; the car stands at the start although 1.5 s have passed.
    let t = trial::profile(&[0.0; 201], level(), Instant::ZERO, 1.0, 5.0);
    let vehicle = VehicleParams::default();
    let params = ControlParams::default();
    let tracker = Tracker::new(&vehicle, &params, 0.01);
    let mut car = Car::new(&vehicle, &CarParams::default(), level());
    for tick in 150..900_u64 {
        let now = Instant::from_nanos(tick * 10_000_000);
        let state = *car.state();
        let setpoint = tracker.track(&t, now, state.pose, state.speed_mps).setpoint;
        for _ in 0..10 {
            car.step(1e-3, &setpoint);
            let here = t.at_distance(car.travelled_m() + 0.03).speed_mps;
            let limit = here.max(t.at_distance(car.travelled_m()).speed_mps);
            assert!(car.state().speed_mps <= limit + params.overspeed_mps + 0.06);
        }
    }
    assert_eq!(car.state().speed_mps, 0.0);
    assert!((car.travelled_m() - 2.0).abs() < 0.01, "{}", car.travelled_m());
}

/// Four metres that tighten from 0.4 to 1.8 1/m, a piece of circle, and a straight run.
fn tightening_bend() -> Trajectory {
    let tightens = (0..400).map(|i| 0.4 + 1.4 * f64::from(i) / 400.0);
    let curvature = tightens.chain(vec![1.8; 80]).chain(vec![0.0; 321]);
    let mut t =
        trial::profile(&curvature.collect::<Vec<_>>(), level(), Instant::ZERO, 8.0, 0.95 * ACCEL);
    t.start = Instant::ZERO;
    t
}

#[test]
fn a_car_that_is_too_fast_for_a_bend_that_tightens_gets_slower_in_it() {
    let t = tightening_bend();
    let tracker = Tracker::new(&VehicleParams::default(), &ControlParams::default(), 0.01);
    // Where all the grip is needed.
    for (from_m, haste_mps) in [(1.6, 0.2), (1.6, 0.3), (2.0, 0.3), (2.4, 0.3)] {
        let here = t.at_distance(from_m);
        let pose = Pose { position: here.path.position, heading_rad: here.path.heading_rad };
        let mut car = Car::new(&VehicleParams::default(), &CarParams::default(), pose)
            .with_speed(here.speed_mps + haste_mps);
        let (mut wide_m, mut haste) = (0.0_f64, Vec::new());
        for tick in 0..60 {
            let now = t.start.offset_by(here.t_s + 0.01 * f64::from(tick));
            let state = *car.state();
            let step = tracker.track(&t, now, state.pose, state.speed_mps);
            wide_m = wide_m.max(step.error.lateral_m.abs());
            haste.push(state.speed_mps - t.at_distance(step.s_m).speed_mps);
            for _ in 0..10 {
                car.step(1e-3, &step.setpoint);
            }
        }
        assert!(wide_m < 0.035, "{from_m} m, {haste_mps} m/s: {wide_m} m wide, {haste:?}");
        assert!(haste[30..].iter().all(|haste| *haste < 0.08), "{from_m} m: {haste:?}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(128))]
    #[test]
    fn no_state_makes_the_tracker_leave_the_friction_circle(
        seed in 0..50_u64, share in -0.2..1.3f64, x in -1.0..1.0f64, y in -1.0..1.0f64,
        turn in -3.0..3.0f64, speed in 0.0..9.0f64,
    ) {
        let vehicle = VehicleParams::default();
        let tracker = Tracker::new(&vehicle, &ControlParams::default(), 0.01);
        let t = trial::trajectory(seed, level(), Instant::from_nanos(10_000_000_000), 8.0, 6.0, ACCEL);
        let now = t.start.offset_by(share * t.duration_s());
        let at = t.at(now).path;
        let pose = Pose::new(at.position.x + x, at.position.y + y, at.heading_rad + turn);
        let set = tracker.track(&t, now, pose, speed).setpoint;
        let norm = set.longitudinal_n.hypot(set.lateral_n);
        prop_assert!(norm <= 2.5 * ACCEL * (1.0 - 1e-4), "{set:?}");
        prop_assert!(set.curvature_pm.abs() <= 2.0);
    }
}
