//! The tail as the car's controller receives it: same path, feasible speeds, and a stop inside it.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::control::{Tracker, trial};
use crate::localize::Localizer;
use crate::sim::car::{Car, CarParams};
use crate::sim::controller::{Controller, ControllerParams};
use crate::tail::TailCurve;
use crate::time::Instant;

const ACCEL: f64 = 8.829;

fn odometry_at(stamp: Instant) -> Odometry {
    Odometry {
        stamp,
        travelled_m: 12.0,
        turned_rad: -4.0,
        speed_mps: 0.0,
        yaw_rate_rps: 0.0,
        steering_curvature_pm: 0.0,
    }
}

#[test]
fn the_tail_lies_on_the_path_and_its_speeds_can_be_braked() {
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let mut worst = 0.0_f64;
    for seed in 0..12 {
        let start = Pose::new(1.0, 2.0, seed as f64);
        let t = trial::trajectory(seed, start, Instant::ZERO, 15.0, 6.0, 0.95 * ACCEL);
        for i in 0..40 {
            let now = Instant::ZERO.offset_by(t.duration_s() * f64::from(i) / 38.0);
            let at = t.at(now);
            let pose = Pose { position: at.path.position, heading_rad: at.path.heading_rad };
            // The car stands 2 cm beside and 0.03 rad across its path.
            let car = Pose {
                position: pose.to_map(crate::frames::Point::new(0.0, 0.02)),
                heading_rad: pose.heading_rad + 0.03,
            };
            let tail = braking_tail(9, &t, &odometry_at(now), car, &vehicle, &params);
            assert_eq!((tail.plan, tail.anchor_travelled_m), (9, 12.0));
            assert!((tail.anchor_offset_m - 0.02).abs() < 1e-4, "{}", tail.anchor_offset_m);
            assert!((tail.anchor_turned_rad + 4.03).abs() < 2e-3, "{}", tail.anchor_turned_rad);
            assert!(tail.samples.len() <= 80 && tail.spacing_m <= 0.1);
            let foot = foot_of(&t, car, at.path.s_m);
            let first = t.at_distance(foot).path;
            let start = Pose { position: first.position, heading_rad: first.heading_rad };
            let curve = TailCurve::laid_out(&tail, start).unwrap();
            assert!(foot + curve.length_m() <= t.last().path.s_m + 1e-9);
            for j in 0..=100 {
                let s = curve.length_m() * f64::from(j) / 100.0;
                let off = curve.pose_at(s).position - t.at_distance(foot + s).path.position;
                worst = worst.max(off.norm());
            }
            for (j, pair) in tail.samples.windows(2).enumerate() {
                let plan = t.at_distance(foot + j as f64 * tail.spacing_m).speed_mps;
                assert!(pair[0].speed_mps <= plan + 1e-9);
                let (b, c) = (pair[0].speed_mps.powi(2), pair[1].speed_mps.powi(2));
                let brake = (b - c) / (2.0 * tail.spacing_m);
                let lateral = b.min(c) * pair[0].curvature_pm.abs().min(pair[1].curvature_pm.abs());
                assert!(brake.hypot(lateral) <= ACCEL, "{seed} {i} {j} {brake} {lateral}");
            }
            assert_eq!(tail.samples.last().unwrap().speed_mps, 0.0);
        }
    }
    eprintln!("tail off its path by at most {worst:.5} m");
    // Curvature changes by up to 1.9 1/m a sample spacing here.
    assert!(worst < 0.006, "{worst}");
}

#[test]
fn a_car_on_its_plan_is_not_too_fast_for_its_tail() {
    // The guard takes a car that is 0.3 m/s faster than its tail for one that has left it. Plans
    // brake, and take bends, with more grip than tails do.
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let mut worst = 0.0_f64;
    for seed in 0..40 {
        let t = trial::trajectory(
            seed,
            Pose::new(1.0, 2.0, seed as f64),
            Instant::ZERO,
            25.0,
            8.0,
            0.985 * ACCEL,
        );
        for i in 1..100 {
            let now = Instant::ZERO.offset_by(t.duration_s() * f64::from(i) / 100.0);
            let at = t.at(now).path;
            let pose = Pose { position: at.position, heading_rad: at.heading_rad };
            let tail = braking_tail(9, &t, &odometry_at(now), pose, &vehicle, &params);
            let curve = TailCurve::laid_out(&tail, pose).unwrap();
            // As long as a tail is driven on before the next one comes.
            for ms in (0..=60).step_by(5) {
                let plan = t.at_time(now.seconds_after(t.start) + f64::from(ms) * 1e-3);
                let excess = plan.speed_mps - curve.speed_at(plan.path.s_m - at.s_m);
                worst = worst.max(excess);
            }
        }
    }
    eprintln!("faster than its tail by up to {worst:.3} m/s");
    assert!(worst < 0.2, "{worst}");
}

#[test]
fn a_plan_that_begins_a_moment_later_has_a_tail_from_here_on() {
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let t = trial::trajectory(5, Pose::new(0.0, 0.0, 0.0), Instant::ZERO, 10.0, 4.0, 8.0);
    let moving = Trajectory {
        start: Instant::from_nanos(1_000_000_000),
        points: {
            // cut the start off, so that the plan begins in motion
            let cut = t.points.iter().position(|p| p.speed_mps > 2.0).unwrap();
            let (s, at) = (t.points[cut].path.s_m, t.points[cut].t_s);
            let shift = |p: &crate::plan::TrajectoryPoint| crate::plan::TrajectoryPoint {
                path: PathPoint { s_m: p.path.s_m - s, ..p.path },
                t_s: p.t_s - at,
                ..*p
            };
            t.points[cut..].iter().map(shift).collect()
        },
    };
    let first = moving.points[0].path;
    let begin = Pose { position: first.position, heading_rad: first.heading_rad };
    let car = begin.along_arc(-0.05, -0.05 * first.curvature_pm);
    let now = moving.start.offset_by(-0.02);
    let tail = braking_tail(1, &moving, &odometry_at(now), car, &vehicle, &params);
    let curve = TailCurve::laid_out(&tail, car).unwrap();
    let meets = curve.pose_at(0.05);
    assert!((meets.position - begin.position).norm() < 1e-3, "{meets:?} {begin:?}");
    assert!(tail.samples[0].speed_mps > 1.9);
}

#[test]
fn at_the_end_of_the_plan_the_tail_is_a_place_to_stand() {
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let pose = Pose::new(1.0, 1.0, 1.0);
    let t = Trajectory::at_rest(Instant::ZERO, pose);
    let tail = braking_tail(1, &t, &odometry_at(Instant::ZERO), pose, &vehicle, &params);
    assert_eq!(tail.samples.len(), 1);
    assert!(TailCurve::laid_out(&tail, pose).is_ok());
}

/// What became of a car whose setpoints were cut off.
#[derive(Debug, Default)]
struct Cut {
    lateral_m: f64,
    /// Beyond the end of the newest tail (negative: before it).
    beyond_m: f64,
    slides: u64,
}

/// Drives with odometry, setpoints and tails in transit, cuts everything off at `cut_s`, and follows
/// the car to rest. Tails are made every 50 ms and arrive 5 ms later.
fn cut_off(trajectory: &Trajectory, cut_s: f64) -> Cut {
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let first = trajectory.points[0].path;
    let start = Pose { position: first.position, heading_rad: first.heading_rad };
    let tracker = Tracker::new(&vehicle, &params, 0.01);
    let mut car = Car::new(&vehicle, &CarParams::default(), start);
    let mut controller = Controller::new(&vehicle, &ControllerParams::default());
    let mut localizer = Localizer::new(start);
    let (mut late, mut set, mut tail) = (None, None, None);
    let mut tail_end = trajectory.last().path.s_m;
    let mut cut = Cut { beyond_m: f64::NEG_INFINITY, ..Cut::default() };
    let cut_ms = (cut_s * 1e3) as u64;
    let mut ms = 0;
    loop {
        let now = trajectory.start.offset_by(ms as f64 * 1e-3);
        let reading = car.odometry(ms * 1000);
        if ms % 10 == 0
            && let Some(odometry) = late.replace(reading.stamped(now))
        {
            localizer.handle_odometry(&odometry);
        }
        let linked = ms < cut_ms;
        if linked && ms % 10 == 1 {
            let pose = localizer.pose_at(now).unwrap();
            let step = tracker.track(trajectory, now, pose, localizer.speed_at(now));
            set = Some(step.setpoint);
            if ms % 50 == 1
                && let Some((odometry, pose)) = localizer.newest()
            {
                let new = braking_tail(1, trajectory, &odometry, pose, &vehicle, &params);
                let s0 = foot_of(trajectory, pose, trajectory.at(odometry.stamp).path.s_m);
                tail = Some((ms + 5, s0 + new.spacing_m * (new.samples.len() - 1) as f64, new));
            }
        }
        let own_now = Instant::from_nanos(ms * 1_000_000);
        if linked && let Some(setpoint) = set.take_if(|_| ms % 10 == 2) {
            controller.handle_setpoint(own_now, setpoint);
        }
        if linked && let Some((_, end, new)) = tail.take_if(|(due, ..)| *due <= ms) {
            controller.handle_tail(&new).unwrap();
            tail_end = end;
        }
        let out = controller.step(own_now, &reading);
        car.step(1e-3, &out);
        ms += 1;
        let state = car.state();
        let s = foot_of(trajectory, state.pose, car.travelled_m());
        let at = trajectory.at_distance(s).path;
        let off = state.pose.position - at.position;
        let forward = heading_vector(at.heading_rad);
        cut.lateral_m = cut.lateral_m.max((forward.x * off.y - forward.y * off.x).abs());
        if ms > cut_ms + 150 && state.speed_mps == 0.0 {
            cut.beyond_m = s + off.dot(&forward) - tail_end;
            cut.slides = car.slides();
            return cut;
        }
    }
}

#[test]
fn a_car_cut_off_at_any_moment_stops_on_its_path_before_the_tails_end() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for speed in [4.0, 8.0] {
        let mut worst = Cut { beyond_m: f64::NEG_INFINITY, ..Cut::default() };
        for seed in 0..60 {
            let start = Pose::new(0.0, 0.0, 0.1 * seed as f64);
            let at = Instant::from_nanos(3_000_000_000);
            let t = trial::trajectory(seed, start, at, 20.0, speed, 0.95 * ACCEL);
            let cut = cut_off(&t, rng.random_range(0.1..t.duration_s()));
            worst.lateral_m = worst.lateral_m.max(cut.lateral_m);
            worst.beyond_m = worst.beyond_m.max(cut.beyond_m);
            worst.slides += cut.slides;
        }
        eprintln!("cut off at {speed} m/s: {worst:?}");
        assert!(worst.lateral_m < 0.02, "{worst:?}");
        assert!(worst.beyond_m < 0.005, "{worst:?}");
    }
}

#[test]
fn a_setpoint_keeps_the_shape_of_the_tail_out_of_play_while_it_is_fresh() {
    // The tail is cut short of the plan; a connected car still drives the whole plan.
    let t = trial::trajectory(2, Pose::new(0.0, 0.0, 0.0), Instant::ZERO, 12.0, 4.0, 8.0);
    let cut = cut_off(&t, t.duration_s() + 1.0);
    assert!(cut.beyond_m.abs() < 0.02, "{cut:?}");
}
