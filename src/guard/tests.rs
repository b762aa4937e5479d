//! The guard in the loop, in worlds of line segments with a ray caster of their own.

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::control::{ControlParams, Tracker, braking_tail, trial};
use crate::frames::{Point, Vector, heading_vector, wrap_angle};
use crate::localize::Localizer;
use crate::plan::Trajectory;
use crate::sim::car::{Car, CarParams};
use crate::sim::controller::{Controller, ControllerParams};

const ACCEL: f64 = 8.829;
const RADIUS_M: f64 = 0.20;

/// A world of walls without thickness.
#[derive(Clone, Default)]
struct Walls(Vec<(Point, Point)>);

impl Walls {
    fn line(&mut self, points: &[Point]) {
        self.0.extend(points.windows(2).map(|w| (w[0], w[1])));
    }

    fn rectangle(&mut self, x: f64, y: f64, width: f64, height: f64, turn: f64) {
        let pose = Pose::new(x, y, turn);
        let (w, h) = (0.5 * width, 0.5 * height);
        let corners = [(-w, -h), (w, -h), (w, h), (-w, h), (-w, -h)];
        self.line(&corners.map(|(x, y)| pose.to_map(Point::new(x, y))));
    }

    fn distance(&self, p: Point) -> f64 {
        let one = |(a, b): &(Point, Point)| {
            let d = b - a;
            let u = ((p - a).dot(&d) / d.norm_squared()).clamp(0.0, 1.0);
            (p - (a + d * u)).norm_squared()
        };
        self.0.iter().map(one).fold(f64::INFINITY, f64::min).sqrt()
    }

    fn scan(&self, pose: Pose, stamp: Instant, sequence: u16) -> Scan {
        const N: usize = 1080;
        let range_max_m: f64 = 7.5;
        let step = std::f64::consts::TAU / N as f64;
        let mut ranges = vec![range_max_m; N];
        for (a, b) in &self.0 {
            let (a, d) = (a - pose.position, b - a);
            // The beams between the wall's ends, and one on either side for rounding.
            let from = (a.y.atan2(a.x) - pose.heading_rad) / step;
            let e = a + d;
            let span = wrap_angle(e.y.atan2(e.x) - a.y.atan2(a.x)) / step;
            let (low, high) = if span < 0.0 { (from + span, from) } else { (from, from + span) };
            for i in low.floor() as i64 - 1..=high.ceil() as i64 + 1 {
                let i = i.rem_euclid(N as i64) as usize;
                let e = heading_vector(pose.heading_rad + step * i as f64);
                let cross = e.x * d.y - e.y * d.x;
                let t = (a.x * d.y - a.y * d.x) / cross;
                let u = (a.x * e.y - a.y * e.x) / cross;
                if t > 0.0 && (0.0..=1.0).contains(&u) {
                    ranges[i] = ranges[i].min(t);
                }
            }
        }
        let ranges_m = ranges.iter().map(|r| *r as f32).collect();
        Scan { stamp, sequence, angle_first_rad: 0.0, angle_step_rad: step, range_max_m, ranges_m }
    }
}

/// Everything between the one who wishes and the wheels; odometry arrives 10 ms late, scans 15 ms.
struct Loop {
    walls: Walls,
    car: Car,
    controller: Controller,
    guard: Guard,
    localizer: Localizer,
    ms: u64,
    scan_period_ms: u64,
    setpoint: Option<ForceSetpoint>,
    odometry: Option<Odometry>,
    scan: Option<Scan>,
    clearance_m: f64,
}

impl Loop {
    fn new(walls: Walls, start: Pose, speed: f64, scan_period_ms: u64) -> Self {
        let vehicle = VehicleParams::default();
        Self {
            walls,
            car: Car::new(&vehicle, &CarParams::default(), start).with_speed(speed),
            controller: Controller::new(&vehicle, &ControllerParams::default()),
            guard: Guard::new(&vehicle, &GuardParams::default(), 0.01),
            localizer: Localizer::new(start),
            ms: 0,
            scan_period_ms,
            setpoint: None,
            odometry: None,
            scan: None,
            clearance_m: f64::INFINITY,
        }
    }

    fn now(&self) -> Instant {
        Instant::from_nanos(1_000_000_000 + self.ms * 1_000_000)
    }

    /// One millisecond; `wish` is asked every 10 ms for a setpoint and perhaps a tail.
    fn step(&mut self, wish: &mut dyn FnMut(&Self) -> (ForceSetpoint, Option<BrakingTail>)) {
        let now = self.now();
        let reading = self.car.odometry(self.ms * 1000);
        if self.ms.is_multiple_of(10)
            && let Some(odometry) = self.odometry.replace(reading.stamped(now))
        {
            self.localizer.handle_odometry(&odometry);
            self.guard.handle_odometry(&odometry);
        }
        if self.ms.is_multiple_of(self.scan_period_ms) {
            self.scan = Some(self.walls.scan(self.car.state().pose, now, 0));
        }
        if self.ms % self.scan_period_ms == 15
            && let Some(scan) = self.scan.take()
        {
            self.guard.handle_scan(&scan);
        }
        let own_now = Instant::from_nanos(self.ms * 1_000_000);
        if self.ms.is_multiple_of(10) && self.guard.track.newest().is_some() {
            let (wished, tail) = wish(self);
            if let Some(tail) = tail {
                self.guard.handle_tail(&tail).unwrap();
                self.controller.handle_tail(&tail).unwrap();
            }
            self.setpoint = Some(self.guard.check(now, wished).setpoint);
        }
        if self.ms % 10 == 1
            && let Some(setpoint) = self.setpoint.take()
        {
            self.controller.handle_setpoint(own_now, setpoint);
        }
        let out = self.controller.step(own_now, &reading);
        self.car.step(1e-3, &out);
        self.ms += 1;
        let clearance = self.walls.distance(self.car.state().pose.position) - RADIUS_M;
        self.clearance_m = self.clearance_m.min(clearance);
    }
}

/// Full throttle at the goal, whatever is in between.
fn full_throttle(pose: Pose, speed: f64, goal: Point) -> ForceSetpoint {
    let to_goal = goal - pose.position;
    let bearing = wrap_angle(to_goal.y.atan2(to_goal.x) - pose.heading_rad);
    let limit = (0.95 * ACCEL / (speed * speed).max(1e-6)).min(2.0);
    let curvature = (3.0 * bearing).clamp(-limit, limit);
    let lateral = curvature * speed * speed;
    let accel = (ACCEL * ACCEL * 0.99 - lateral * lateral).max(0.0).sqrt();
    ForceSetpoint {
        longitudinal_n: 2.5 * accel,
        lateral_n: 2.5 * lateral,
        curvature_pm: curvature,
        drive: true,
    }
}

#[test]
fn with_full_throttle_at_the_goal_the_guard_alone_prevents_every_collision() {
    let mut closest = f64::INFINITY;
    let (mut travelled, mut stops, mut fastest) = (0.0, 0, 0.0_f64);
    for seed in 0..120 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut walls = Walls::default();
        walls.rectangle(0.0, 0.0, 16.0, 12.0, 0.0);
        for _ in 0..rng.random_range(2..10) {
            walls.rectangle(
                rng.random_range(-7.0..7.0),
                rng.random_range(-5.0..5.0),
                rng.random_range(0.05..1.5),
                rng.random_range(0.05..1.5),
                rng.random_range(0.0..3.0),
            );
        }
        let start = Pose::new(
            rng.random_range(-7.0..7.0),
            rng.random_range(-5.0..5.0),
            rng.random_range(-3.0..3.0),
        );
        // Any speed from which the car can stop straight ahead at all, with 20 ms of surprise.
        let ahead = (0..400)
            .map(|i| f64::from(i) * 0.02)
            .find(|s| walls.distance(start.along_arc(*s, 0.0).position) < RADIUS_M + 0.03);
        let ahead = ahead.unwrap_or(8.0);
        if ahead == 0.0 {
            continue;
        }
        let speed = (2.0 * 0.9 * ACCEL * (ahead - 0.6).max(0.0)).sqrt().min(8.0);
        let speed = speed * rng.random_range(0.0..1.0);
        let period = if seed % 2 == 0 { 50 } else { 25 };
        let mut drive = Loop::new(walls, start, speed, period);
        let mut goal = Point::new(0.0, 0.0);
        for ms in 0..5000 {
            if ms % 1500 == 0 {
                goal = Point::new(rng.random_range(-9.0..9.0), rng.random_range(-7.0..7.0));
            }
            let waiting = ms < 30; // straight on until the first scan is in
            drive.step(&mut |drive| {
                let now = drive.now();
                let pose = drive.localizer.pose_at(now).unwrap();
                let mut set = full_throttle(pose, drive.localizer.speed_at(now), goal);
                if waiting {
                    set = ForceSetpoint { drive: true, ..ForceSetpoint::default() };
                }
                (set, None)
            });
            fastest = fastest.max(drive.car.state().speed_mps);
        }
        travelled += drive.car.travelled_m();
        stops += drive.guard.counts().stops;
        closest = closest.min(drive.clearance_m);
        assert!(drive.clearance_m > 0.0, "seed {seed}: {}", drive.clearance_m);
    }
    eprintln!(
        "alone: {travelled:.0} m, up to {fastest:.1} m/s, {stops} stops, closest {closest:.4}"
    );
    // Most of the margin is kept for what the simulation leaves out.
    assert!(closest > 0.01, "{closest}");
    assert!(travelled > 300.0 && stops > 100 && fastest > 6.0);
}

/// Walls `distance_m` to either side of a trajectory, closed at both ends; `None` if a stretch of it
/// comes too close to another.
fn corridor(trajectory: &Trajectory, distance_m: f64) -> Option<Walls> {
    let points = &trajectory.points;
    for (i, a) in points.iter().enumerate().step_by(3) {
        for b in points[i..].iter().step_by(3) {
            let apart = b.path.s_m - a.path.s_m;
            if apart > 1.8 && (b.path.position - a.path.position).norm() < 2.0 * distance_m + 0.1 {
                return None;
            }
        }
    }
    let side = |sign: f64| -> Vec<Point> {
        let beside = |p: &crate::plan::PathPoint, along: f64| {
            let forward = heading_vector(p.heading_rad);
            p.position + forward * along + Vector::new(-forward.y, forward.x) * (sign * distance_m)
        };
        let mut line = vec![beside(&points[0].path, -0.3)];
        line.extend(points.iter().map(|p| beside(&p.path, 0.0)));
        line.push(beside(&trajectory.last().path, distance_m));
        line
    };
    let mut left = side(1.0);
    left.extend(side(-1.0).iter().rev());
    left.push(left[0]);
    let mut walls = Walls::default();
    walls.line(&left);
    Some(walls)
}

/// Drives a trajectory with tails every 50 ms; returns the loop at rest.
fn planned(
    walls: Walls,
    trajectory: &Trajectory,
    scan_period_ms: u64,
    at_ms: impl Fn(&mut Loop),
) -> Loop {
    let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
    let first = trajectory.points[0].path;
    let start = Pose { position: first.position, heading_rad: first.heading_rad };
    let mut drive = Loop::new(walls, start, 0.0, scan_period_ms);
    let tracker = Tracker::new(&vehicle, &params, 0.01);
    let begin = trajectory.start.seconds_after(drive.now());
    for _ in 0..((begin + trajectory.duration_s()) * 1e3) as u64 + 500 {
        at_ms(&mut drive);
        drive.step(&mut |drive| {
            let now = drive.now();
            let pose = drive.localizer.pose_at(now).unwrap();
            let speed = drive.localizer.speed_at(now);
            let set = tracker.track(trajectory, now, pose, speed).setpoint;
            let (odometry, pose) = drive.localizer.newest().unwrap();
            let tail = (drive.ms % 50 == 0)
                .then(|| braking_tail(1, trajectory, &odometry, pose, &vehicle, &params));
            (set, tail)
        });
    }
    drive
}

#[test]
fn planned_drives_five_centimetres_from_the_walls_are_not_disturbed() {
    for (speed, period) in [(4.0, 50), (8.0, 25)] {
        let (mut drives, mut fastest) = (0, 0.0_f64);
        for seed in 0..400 {
            let at = Instant::from_nanos(1_200_000_000);
            let t =
                trial::trajectory(seed, Pose::new(0.0, 0.0, 0.3), at, 14.0, speed, 0.95 * ACCEL);
            let Some(walls) = corridor(&t, RADIUS_M + 0.05) else { continue };
            let drive = planned(walls, &t, period, |_| ());
            drives += 1;
            fastest = t.points.iter().map(|p| p.speed_mps).fold(fastest, f64::max);
            assert_eq!(drive.guard.counts(), &GuardCounts::default(), "seed {seed}, {speed} m/s");
            let end = drive.car.state().pose.position - t.last().path.position;
            assert!(drive.car.state().speed_mps == 0.0 && end.norm() < 0.01, "seed {seed}");
            assert!(drive.clearance_m > 0.04, "seed {seed}: {}", drive.clearance_m);
            assert_eq!(drive.car.slides(), 0);
            if drives == 12 {
                break;
            }
        }
        eprintln!("{drives} corridors at {speed} m/s, fastest {fastest:.2} m/s");
        assert!(drives >= 10);
    }
}

#[test]
fn a_box_set_down_ahead_of_a_planned_drive_is_not_hit() {
    for (speed, ahead) in [(4.0, 1.4), (8.0, 4.8)] {
        let at = Instant::from_nanos(1_200_000_000);
        let t = trial::profile(&[0.0; 2001], Pose::new(0.0, 0.0, 0.0), at, speed, 0.95 * ACCEL);
        let mut walls = Walls::default();
        walls.rectangle(10.0, 0.0, 30.0, 3.0, 0.0);
        let drive = planned(walls, &t, 25, |drive| {
            let x = drive.car.state().pose.position.x;
            if x > 8.0 && drive.walls.0.len() == 4 {
                drive.walls.rectangle(x + RADIUS_M + ahead + 0.1, 0.05, 0.2, 0.2, 0.4);
            }
        });
        assert!(drive.clearance_m > 0.0, "{speed}: {}", drive.clearance_m);
        assert_eq!(drive.car.state().speed_mps, 0.0);
        assert!(drive.guard.counts().stops >= 1);
        assert_eq!(drive.guard.stopping(), Some(Reason::Obstacle));
    }
}

#[test]
#[ignore = "a measurement: cargo test --release -- --ignored --nocapture cost_of"]
#[expect(clippy::disallowed_methods, reason = "measures wall time")]
fn cost_of_a_period_and_of_a_scan() {
    for (speed, bend) in [(4.0, 0.4), (8.0, 0.12)] {
        let at = Instant::from_nanos(1_200_000_000);
        let t = trial::profile(&[bend; 1401], Pose::new(0.0, 0.0, 0.0), at, speed, 0.95 * ACCEL);
        let walls = corridor(&t, RADIUS_M + 0.05).unwrap();
        let (vehicle, params) = (VehicleParams::default(), ControlParams::default());
        let middle = t.at_distance(5.0);
        let now = t.start.offset_by(middle.t_s);
        let pose = Pose { position: middle.path.position, heading_rad: middle.path.heading_rad };
        let mut guard = Guard::new(&vehicle, &GuardParams::default(), 0.01);
        let reading = Odometry {
            turned_rad: pose.heading_rad,
            yaw_rate_rps: middle.speed_mps * bend,
            ..odometry(now, middle.speed_mps)
        };
        guard.handle_odometry(&reading);
        let scan = walls.scan(pose, now, 0);
        let begin = std::time::Instant::now();
        for i in 0..1000 {
            let stamp = now.offset_by(1e-6 * f64::from(i));
            guard.handle_scan(&Scan { stamp, ..scan.clone() });
        }
        let scan_us = begin.elapsed().as_secs_f64() * 1e3;
        guard.handle_tail(&braking_tail(1, &t, &reading, pose, &vehicle, &params)).unwrap();
        let tracker = Tracker::new(&vehicle, &params, 0.01);
        let set = tracker.track(&t, now, pose, middle.speed_mps).setpoint;
        let begin = std::time::Instant::now();
        for _ in 0..1000 {
            assert_eq!(guard.check(now, set).intervened, None);
        }
        let check_us = begin.elapsed().as_secs_f64() * 1e3;
        eprintln!("{:.2} m/s: scan {scan_us:.1} us, check {check_us:.1} us", middle.speed_mps);
    }
}

fn odometry(now: Instant, speed: f64) -> Odometry {
    Odometry {
        stamp: now,
        travelled_m: 1.0,
        turned_rad: 0.5,
        speed_mps: speed,
        yaw_rate_rps: 0.0,
        steering_curvature_pm: 0.0,
    }
}

fn open_space(now: Instant) -> Scan {
    Walls::default().scan(Pose::new(0.0, 0.0, 0.0), now, 0)
}

fn ready(speed: f64) -> (Guard, Instant) {
    let now = Instant::from_nanos(5_000_000_000);
    let mut guard = Guard::new(&VehicleParams::default(), &GuardParams::default(), 0.01);
    guard.handle_odometry(&odometry(now, speed));
    guard.handle_scan(&open_space(now));
    (guard, now)
}

fn gentle() -> ForceSetpoint {
    ForceSetpoint { longitudinal_n: 2.0, lateral_n: 1.0, curvature_pm: 0.1, drive: true }
}

#[test]
fn old_inputs_stop_the_car() {
    let (mut guard, now) = ready(2.0);
    let decision = guard.check(now, gentle());
    assert_eq!(decision, GuardDecision { setpoint: gentle(), intervened: None });
    let later = now.offset_by(0.07);
    let decision = guard.check(later, gentle());
    assert_eq!(decision.intervened, Some(Reason::OdometryStale));
    assert!(!decision.setpoint.drive);
    guard.handle_odometry(&Odometry { travelled_m: 1.6, ..odometry(now.offset_by(0.3), 2.0) });
    let decision = guard.check(now.offset_by(0.3), gentle());
    assert_eq!(decision.intervened, Some(Reason::ScanStale));
    assert!(decision.setpoint.drive && decision.setpoint.longitudinal_n < -20.0);
    assert_eq!(guard.counts().stops, 1, "one stop, two reasons");
}

#[test]
fn without_any_scan_or_odometry_nothing_moves() {
    let mut guard = Guard::new(&VehicleParams::default(), &GuardParams::default(), 0.01);
    let now = Instant::from_nanos(1);
    assert_eq!(guard.check(now, gentle()).intervened, Some(Reason::OdometryStale));
    guard.handle_odometry(&odometry(now, 0.0));
    let decision = guard.check(now, gentle());
    assert_eq!(decision.intervened, Some(Reason::ScanStale));
    assert!(decision.setpoint.longitudinal_n < 0.0);
    let standing = ForceSetpoint { longitudinal_n: -1.0, ..gentle() };
    assert_eq!(guard.check(now, standing).intervened, None);
}

#[test]
fn numbers_that_are_none_are_stopped_and_too_much_force_is_trimmed() {
    let (mut guard, now) = ready(2.0);
    let broken = ForceSetpoint { lateral_n: f64::NAN, ..gentle() };
    let decision = guard.check(now, broken);
    assert_eq!(decision.intervened, Some(Reason::NotFinite));
    assert!(decision.setpoint.lateral_n.is_finite() && decision.setpoint.longitudinal_n < 0.0);

    let (mut guard, now) = ready(2.0);
    let strong = ForceSetpoint { longitudinal_n: 30.0, lateral_n: 15.0, ..gentle() };
    let decision = guard.check(now, strong);
    assert_eq!(decision.intervened, Some(Reason::Force));
    let norm = decision.setpoint.longitudinal_n.hypot(decision.setpoint.lateral_n);
    assert!((norm - 2.5 * ACCEL).abs() < 1e-9 && decision.setpoint.lateral_n == 15.0);
    let tight = ForceSetpoint { curvature_pm: 7.0, ..gentle() };
    let (mut guard, now) = ready(2.0);
    assert_eq!(guard.check(now, tight).setpoint.curvature_pm, 2.0);
}

#[test]
fn forces_may_not_jump_but_brakes_may() {
    let (mut guard, now) = ready(2.0);
    guard.check(now, ForceSetpoint { lateral_n: -20.0, ..gentle() });
    let next = now.offset_by(0.01);
    guard.handle_odometry(&odometry(next, 2.0));
    let decision = guard.check(next, ForceSetpoint { lateral_n: 20.0, ..gentle() });
    assert_eq!(decision.intervened, Some(Reason::Rate));
    assert!((decision.setpoint.lateral_n - 10.0).abs() < 1e-6);
    let third = now.offset_by(0.02);
    guard.handle_odometry(&odometry(third, 2.0));
    let brake = ForceSetpoint { longitudinal_n: -18.0, lateral_n: 9.0, ..gentle() };
    assert_eq!(guard.check(third, brake).intervened, None);
}

#[test]
fn a_restarted_controller_makes_the_guard_forget_its_frame() {
    let (mut guard, now) = ready(1.0);
    let next = now.offset_by(0.01);
    guard.handle_odometry(&Odometry { travelled_m: 0.0, ..odometry(next, 1.0) });
    assert_eq!(guard.check(next, gentle()).intervened, Some(Reason::ScanStale));
}

#[test]
fn the_stopping_arc_is_the_integral_of_the_friction_circle() {
    for (v, k) in [(4.0, 0.0), (4.0, 0.3), (2.0, 1.9), (8.0, -0.12), (0.3, 2.0)] {
        let (mut w, mut s) = (v * v, 0.0);
        while w > 0.0 {
            let lateral: f64 = k * w;
            w -= 2.0 * (8.0_f64 * 8.0 - lateral * lateral).sqrt() * 1e-5;
            s += 1e-5;
        }
        assert!((arc_stop_m(v, k, 8.0) - s).abs() < 1e-3, "{v} {k}: {s}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]
    #[test]
    fn whatever_comes_in_what_goes_out_is_finite_and_within_the_circle(
        forces in prop::collection::vec(
            (prop::num::f64::ANY, prop::num::f64::ANY, prop::num::f64::ANY, any::<bool>()), 1..6),
        speed in 0.0..9.0f64,
        range in prop::sample::select(vec![f32::NAN, 0.1, 0.5, 2.0, 9.0]),
    ) {
        let (mut guard, now) = ready(speed);
        let mut scan = open_space(now.offset_by(0.001));
        scan.ranges_m.fill(range);
        guard.handle_scan(&scan);
        for (i, (longitudinal_n, lateral_n, curvature_pm, drive)) in forces.into_iter().enumerate() {
            let now = now.offset_by(0.01 * i as f64);
            let set = ForceSetpoint { longitudinal_n, lateral_n, curvature_pm, drive };
            let out = guard.check(now, set).setpoint;
            prop_assert!(out.longitudinal_n.hypot(out.lateral_n) <= 2.5 * ACCEL * (1.0 + 1e-9));
            prop_assert!(out.curvature_pm.abs() <= 2.0);
            if range == 0.1 && speed > 0.01 && out.drive {
                prop_assert!(out.longitudinal_n <= 0.0);
            }
        }
    }
}

#[test]
fn a_car_too_fast_for_its_way_to_stop_still_brakes_in_the_bend() {
    let broken = ForceSetpoint { lateral_n: f64::NAN, ..gentle() };
    let braking = |curvature_pm: f64| {
        let (mut guard, now) = ready(4.0);
        let pose = guard.track.pose_at(now).unwrap();
        guard.escape =
            Some(Escape { curve: TailCurve::arc(pose, curvature_pm, 3.0, 4.0), s_m: 0.0 });
        let setpoint = guard.check(now, broken).setpoint;
        let grip_n = guard.mass_kg * ACCEL;
        (setpoint.longitudinal_n / grip_n, setpoint.lateral_n / grip_n)
    };
    // What the tyres hold is steered in full, ...
    let (along, across) = braking(0.5);
    assert!((0.86..0.91).contains(&across) && along < -0.4, "{along}, {across}");
    // ... and of what they do not, enough is left for braking.
    let (along, across) = braking(-1.5);
    assert!((across + 0.8).abs() < 0.01 && along < -0.59, "{along}, {across}");
}
