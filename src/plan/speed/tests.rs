use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::frames::Pose;
use crate::plan::test_paths::{hairpins, random, straight};
use crate::plan::{Path, Trajectory};
use crate::time::Instant;

const TYRES: f64 = 8.829;

fn limits(speed_max_mps: f64) -> SpeedLimits {
    let speed = SpeedParams { speed_max_mps, ..SpeedParams::default() };
    SpeedLimits::new(&speed, &VehicleParams::default())
}

fn task(start_speed_mps: f64) -> SpeedTask<'static> {
    SpeedTask { start_speed_mps, end: End::Rest, caps_mps: None }
}

fn origin() -> Pose {
    Pose::new(0.0, 0.0, 0.3)
}

fn drive(path: &Path, limits: &SpeedLimits, task: &SpeedTask<'_>) -> Vec<TrajectoryPoint> {
    let mut out = Vec::new();
    SpeedProfiler::new().profile(&path.points, limits, task, &mut out).unwrap();
    out
}

fn squares(points: &[TrajectoryPoint]) -> Vec<f64> {
    points.iter().map(|p| p.speed_mps * p.speed_mps).collect()
}

fn curvy_paths(ds: f64) -> Vec<Path> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    vec![
        hairpins(origin(), 9.0, 2.0, ds),
        hairpins(origin(), 8.0, 1.6, ds),
        random(&mut rng, origin(), 9.0, 1.9, ds),
        random(&mut rng, origin(), 9.0, 2.0, ds),
    ]
}

/// Largest friction use relative to the tyres at 25 points of every edge, accelerations taken by
/// central differences of the trajectory's own headings, speeds and times.
fn friction_use(points: &[TrajectoryPoint]) -> f64 {
    let t = Trajectory { start: Instant::ZERO, points: points.to_vec() };
    let mut worst = 0.0_f64;
    for edge in points.windows(2) {
        let dt = edge[1].t_s - edge[0].t_s;
        for j in 0..25 {
            let at = edge[0].t_s + dt * (f64::from(j) + 0.5) / 25.0;
            let h = dt * 1e-3;
            let (a, m, b) = (t.at_time(at - h), t.at_time(at), t.at_time(at + h));
            let along = (b.speed_mps - a.speed_mps) / (2.0 * h);
            let turn = crate::frames::wrap_angle(b.path.heading_rad - a.path.heading_rad);
            worst = worst.max(along.hypot(m.speed_mps * turn / (2.0 * h)) / TYRES);
        }
    }
    worst
}

/// Caps under which the feasible profiles are closed under the pointwise maximum, so that the two
/// passes give the exact optimum: on every edge all four bounds must be increasing.
fn monotone_caps(path: &Path, circle: f64) -> Vec<f64> {
    let mut caps = vec![f64::INFINITY; path.points.len()];
    for (i, edge) in path.points.windows(2).enumerate() {
        let (k0, k1, d) = edge_numbers(edge);
        for (node, own, other) in [(i, k0, k1), (i + 1, k1, k0)] {
            let cap = (circle / (own * (own * d).hypot(1.0))).min(circle / other);
            caps[node] = caps[node].min(cap.sqrt());
        }
    }
    caps
}

/// The cone program with friction at both ends of every edge, by an interior point solver. Returns
/// the speed squares and the duration.
fn cone_program(
    path: &Path,
    limits: &SpeedLimits,
    start: f64,
    caps: Option<&[f64]>,
) -> (Vec<f64>, f64) {
    let n = path.points.len();
    let edges = n - 1;
    // Columns: b (n), y <= sqrt(b) (n), t >= 1/(y0 + y1) (edges).
    let (b, y, t) = (0, n, 2 * n);
    let mut entries: Vec<(usize, usize, f64)> = Vec::new();
    let mut rhs: Vec<f64> = Vec::new();
    let mut cones = Vec::new();
    // Equalities first: start and end.
    for (node, value) in [(0, start * start), (n - 1, 0.0)] {
        entries.push((rhs.len(), b + node, 1.0));
        rhs.push(value);
    }
    cones.push(SupportedConeT::ZeroConeT(2));
    // b <= cap.
    for i in 0..n {
        let own = caps.map_or(f64::INFINITY, |c| c[i]).min(limits.speed_max_mps);
        entries.push((rhs.len(), b + i, 1.0));
        rhs.push(own * own);
    }
    cones.push(SupportedConeT::NonnegativeConeT(n));
    // |(b - 1, 2 y)| <= b + 1.
    for i in 0..n {
        let row = rhs.len();
        entries.extend([(row, b + i, -1.0), (row + 1, b + i, -1.0), (row + 2, y + i, -2.0)]);
        rhs.extend([1.0, -1.0, 0.0]);
        cones.push(SupportedConeT::SecondOrderConeT(3));
    }
    let mut cost = vec![0.0; 2 * n + edges];
    for (e, pair) in path.points.windows(2).enumerate() {
        let ds = pair[1].s_m - pair[0].s_m;
        cost[t + e] = 2.0 * ds;
        // |(t - w, 2)| <= t + w with w = y0 + y1.
        let row = rhs.len();
        entries.extend([(row, t + e, -1.0), (row, y + e, -1.0), (row, y + e + 1, -1.0)]);
        entries.extend([(row + 1, t + e, -1.0), (row + 1, y + e, 1.0), (row + 1, y + e + 1, 1.0)]);
        rhs.extend([0.0, 0.0, 2.0]);
        cones.push(SupportedConeT::SecondOrderConeT(3));
        // |(a, k b)| <= A at both ends.
        for (end, point) in pair.iter().enumerate() {
            let row = rhs.len();
            entries.extend([
                (row + 1, b + e, 0.5 / ds),
                (row + 1, b + e + 1, -0.5 / ds),
                (row + 2, b + e + end, -point.curvature_pm.abs()),
            ]);
            rhs.extend([limits.accel_limit_mps2, 0.0, 0.0]);
            cones.push(SupportedConeT::SecondOrderConeT(3));
        }
    }
    let (rows, columns) = (rhs.len(), cost.len());
    let (mut i, mut j, mut v) = (Vec::new(), Vec::new(), Vec::new());
    for (row, column, value) in entries {
        i.push(row);
        j.push(column);
        v.push(value);
    }
    let a = CscMatrix::new_from_triplets(rows, columns, i, j, v);
    let p = CscMatrix::zeros((columns, columns));
    let settings = DefaultSettingsBuilder::default().verbose(false).build().unwrap();
    let mut solver = DefaultSolver::new(&p, &cost, &a, &rhs, &cones, settings).unwrap();
    solver.solve();
    let status = solver.solution.status;
    assert!(
        matches!(status, SolverStatus::Solved | SolverStatus::AlmostSolved),
        "reference solver: {status:?}"
    );
    (solver.solution.x[..n].to_vec(), solver.solution.obj_val)
}

#[test]
fn a_straight_is_driven_at_full_force_up_and_down() {
    let path = straight(origin(), 4.0, 0.05);
    let limits = limits(10.0);
    let out = drive(&path, &limits, &task(0.0));
    // 2 m up, 2 m down: T = 2 sqrt(2 * 2 m / a).
    let expected = 2.0 * (4.0 / limits.accel_limit_mps2).sqrt();
    assert!((out.last().unwrap().t_s - expected).abs() < 1e-9);
    assert_eq!(out[0].speed_mps, 0.0);
    assert_eq!(out.last().unwrap().speed_mps, 0.0);
}

#[test]
fn drive_and_brake_limits_bind_where_they_are_tighter_than_the_tyres() {
    let path = straight(origin(), 6.0, 0.05);
    let limits = SpeedLimits { accel_max_mps2: 2.0, brake_max_mps2: 4.0, ..limits(20.0) };
    let out = drive(&path, &limits, &task(0.0));
    // Up at 2, down at 4: the top is two thirds along, v^2 = 2 * 2 * 4.
    let expected = 4.0 / 2.0 + 4.0 / 4.0;
    assert!((out.last().unwrap().t_s - expected).abs() < 1e-9);
    let curvy = hairpins(origin(), 9.0, 2.0, 0.05);
    for p in drive(&curvy, &limits, &task(0.0)) {
        assert!(p.accel_mps2 < 2.0 + 1e-9 && p.accel_mps2 > -4.0 - 1e-9);
    }
}

#[test]
fn with_monotone_caps_the_profile_is_the_optimum_of_the_cone_program() {
    for path in curvy_paths(0.05) {
        for speed_max in [4.0, 8.0] {
            let limits = limits(speed_max);
            let caps = monotone_caps(&path, limits.accel_limit_mps2);
            let task = SpeedTask { caps_mps: Some(&caps), ..task(0.0) };
            let out = drive(&path, &limits, &task);
            let (b, time) = cone_program(&path, &limits, 0.0, Some(&caps));
            let own = out.last().unwrap().t_s;
            assert!((own / time - 1.0).abs() < 1e-4, "{own} {time}");
            for (own, reference) in squares(&out).iter().zip(b) {
                assert!(*own > reference - 1e-3, "{own} {reference}");
            }
        }
    }
}

#[test]
fn with_plain_caps_it_is_within_two_thousandths_of_the_cone_program() {
    for path in curvy_paths(0.05) {
        for speed_max in [4.0, 8.0] {
            let limits = limits(speed_max);
            let own = drive(&path, &limits, &task(1.0)).last().unwrap().t_s;
            let (_, time) = cone_program(&path, &limits, 1.0, None);
            let gap = own / time - 1.0;
            assert!((-1e-5..2e-3).contains(&gap), "{gap:e}");
        }
    }
}

#[test]
fn a_backward_step_finds_the_largest_speed_that_brute_force_finds() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for _ in 0..2000 {
        let (k0, k1) = (rng.random_range(0.0..2.0), rng.random_range(0.0..2.0));
        let d = rng.random_range(0.002..0.2);
        let limits = SpeedLimits {
            brake_max_mps2: rng.random_range(1.0..15.0),
            accel_max_mps2: rng.random_range(1.0..15.0),
            ..limits(20.0)
        };
        let circle = Circle::new(8.0, &limits);
        let next: f64 = rng.random_range(0.0..1.0) * (8.0_f64 / k1).min(30.0);
        let own = circle.before(next, k0, k1, d);
        let feasible = |b: f64, c: f64| {
            let a = (c - b) / d;
            let inside = a.hypot(k0 * b).max(a.hypot(k1 * c)) <= 8.0 * (1.0 + 1e-9);
            inside && a <= circle.accel + 1e-9 && -a <= circle.brake + 1e-9
        };
        let reachable = |b: f64| {
            let (lo, hi) = ((b - 8.0 * d).max(0.0), next.min(b + 8.0 * d));
            (0..=4000).any(|j| feasible(b, lo + (hi - lo) * f64::from(j) / 4000.0))
        };
        let case = format!("{own}: {k0} {k1} {d} {next} {limits:?}");
        assert!(reachable(own * (1.0 - 1e-3)), "too fast, {case}");
        assert!(!reachable(own * 1.0001 + 1e-6), "not the fastest, {case}");
    }
}

#[test]
fn a_backward_step_from_where_the_tyres_just_bind_is_no_accident() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let circle = Circle::new(8.0, &limits(20.0));
    for _ in 0..20_000 {
        let k1: f64 = rng.random_range(0.1..2.0);
        let k0 = k1 * rng.random_range(0.0..1.0);
        let d: f64 = rng.random_range(0.002..0.2);
        let top = 8.0 / (k1 * (1.0 + (k1 * d) * (k1 * d)).sqrt());
        for next in [top.next_down().next_down(), top.next_down(), top, top.next_up()] {
            let own = circle.before(next, k0, k1, d);
            assert!(own >= next && own <= next + 8.0 * d, "{own}: {k0} {k1} {d} {next}");
        }
    }
}

/// A random profile that is feasible by construction: walks back from rest, each step a random
/// feasible one; where there is none, everything behind is scaled down (the feasible set is convex
/// and holds standstill).
fn random_profile(rng: &mut ChaCha8Rng, path: &Path, circle: f64, caps: &[f64]) -> Vec<f64> {
    let n = path.points.len();
    let mut b = vec![0.0; n];
    let mut i = n - 1;
    while i > 0 {
        let (k0, k1, d) = edge_numbers(&path.points[i - 1..=i]);
        let next = b[i];
        let feasible = |v: f64| {
            let a = (next - v) / d;
            v <= caps[i - 1].powi(2) && a.hypot(k0 * v).max(a.hypot(k1 * next)) <= circle
        };
        let lowest = (next - circle * d).max(0.0);
        let wanted = (0..20)
            .map(|_| rng.random_range(lowest..=next + circle * d))
            .filter(|v| feasible(*v))
            .fold(None, |best: Option<f64>, v| Some(best.map_or(v, |b| b.max(v))));
        if let Some(v) = wanted {
            b[i - 1] = v;
            i -= 1;
        } else {
            b[i..].iter_mut().for_each(|v| *v *= 0.9);
        }
    }
    b
}

#[test]
fn no_feasible_profile_is_faster_anywhere_under_monotone_caps() {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for path in curvy_paths(0.05) {
        let limits = limits(4.0);
        let mut caps = monotone_caps(&path, limits.accel_limit_mps2);
        caps.iter_mut().for_each(|c| *c = c.min(4.0));
        for _ in 0..20 {
            let b = random_profile(&mut rng, &path, limits.accel_limit_mps2, &caps);
            let task = SpeedTask { caps_mps: Some(&caps), ..task(b[0].sqrt()) };
            let own = squares(&drive(&path, &limits, &task));
            for (own, other) in own.iter().zip(&b) {
                assert!(*own >= other - 1e-9, "{own} {other}");
            }
            assert!(b.iter().any(|v| *v > 1.0), "the random profile hardly moves");
        }
    }
}

#[test]
fn between_samples_the_circle_is_left_by_at_most_one_percent() {
    // Edges of 0.05 m at curvatures up to 2 per metre, driven at the limit of both ends.
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let circle = Circle::new(8.0, &limits(20.0));
    let d = 0.1;
    let mut worst = 0.0_f64;
    for _ in 0..200_000 {
        let (k0, k1) = (rng.random_range(0.0..2.0_f64), rng.random_range(-2.0..2.0_f64));
        let b = rng.random_range(0.0..1.0_f64) * (8.0 / k0).min(16.0);
        for end in
            [circle.fastest_after(b, k0, k1.abs(), d), circle.slowest_after(b, k0, k1.abs(), d)]
        {
            let along = (end - b) / d;
            if along.hypot(k0 * b).max(along.hypot(k1 * end)) > 8.0 * (1.0 + 1e-9) {
                continue; // too fast for the curvature at the end: no profile gets here
            }
            for j in 1..20 {
                let u = f64::from(j) / 20.0;
                let lateral = (k0 + (k1 - k0) * u) * (b + (end - b) * u);
                worst = worst.max(along.hypot(lateral) / 8.0);
            }
        }
    }
    assert!(worst > 1.003 && worst < 1.0105, "{worst}");
}

#[test]
fn a_start_that_cannot_stop_in_time_is_refused_with_the_speed_that_could() {
    let path = straight(origin(), 0.5, 0.05);
    let limits = limits(8.0);
    let mut profiler = SpeedProfiler::new();
    let mut out = Vec::new();
    let error = profiler.profile(&path.points, &limits, &task(4.0), &mut out).unwrap_err();
    let SpeedError::StartTooFast { allowed_mps, given_mps } = error else { panic!("{error}") };
    assert_eq!(given_mps, 4.0);
    let expected = (2.0 * limits.hard_limit_mps2 * 0.5).sqrt();
    assert!((allowed_mps - expected).abs() < 1e-9, "{allowed_mps} {expected}");
    profiler.profile(&path.points, &limits, &task(allowed_mps), &mut out).unwrap();
    assert!(friction_use(&out) <= HARD_USE + 1e-6);
    let error = profiler.profile(&path.points, &limits, &task(allowed_mps + 1e-3), &mut out);
    assert!(error.is_err() && out.is_empty());
}

#[test]
fn a_start_above_the_speed_cap_brakes_down_to_it() {
    let path = straight(origin(), 5.0, 0.05);
    let out = drive(&path, &limits(2.0), &task(3.0));
    let slowed = out.iter().find(|p| p.speed_mps <= 2.0).unwrap();
    let expected = (9.0 - 4.0) / (2.0 * HARD_USE * TYRES);
    assert!((slowed.path.s_m - expected).abs() < 0.06, "{}", slowed.path.s_m);
    assert!(out.iter().skip_while(|p| p.speed_mps > 2.0).all(|p| p.speed_mps <= 2.0));
    assert!(friction_use(&out) <= HARD_USE + 1e-6);
}

#[test]
fn a_plan_can_start_anywhere_on_an_earlier_one() {
    // The samples of the new plan lie elsewhere, so its envelope differs a little from the state
    // the car is in; that must not be called too fast.
    for path in curvy_paths(0.05) {
        let limits = limits(8.0);
        let first = Trajectory { start: Instant::ZERO, points: drive(&path, &limits, &task(0.0)) };
        let mut profiler = SpeedProfiler::new();
        let mut out = Vec::new();
        for i in 0..400 {
            let s = path.length_m() * f64::from(i) / 400.0;
            let state = first.at_distance(s);
            let rest = (path.length_m() - s) / 0.05;
            let n = rest.ceil().max(2.0) as usize;
            let points: Vec<PathPoint> = (0..=n)
                .map(|j| s + (path.length_m() - s) * j as f64 / n as f64)
                .map(|s| path.at_distance(s).unwrap())
                .collect();
            profiler.profile(&points, &limits, &task(state.speed_mps), &mut out).unwrap();
            assert!((out[0].speed_mps - state.speed_mps).abs() < 1e-9);
            assert!(friction_use(&out) <= 1.0, "{}", friction_use(&out));
            let remaining = first.duration_s() - state.t_s;
            assert!(out.last().unwrap().t_s < remaining + 0.02);
        }
    }
}

#[test]
fn stop_points_can_be_passed_at_speed_for_costs() {
    let path = straight(origin(), 3.0, 0.05);
    let mut profiler = SpeedProfiler::new();
    let free = SpeedTask { end: End::Speed(4.0), ..task(4.0) };
    let time = profiler.travel_time_s(&path.points, &limits(4.0), &free).unwrap();
    assert!((time - 0.75).abs() < 1e-12);
    let stop = profiler.travel_time_s(&path.points, &limits(4.0), &task(4.0)).unwrap();
    assert_eq!(stop, drive(&path, &limits(4.0), &task(4.0)).last().unwrap().t_s);
    assert!(stop > time);
}

#[test]
fn bad_input_is_named() {
    let path = straight(origin(), 1.0, 0.05);
    let mut out = Vec::new();
    let mut run = |points: &[PathPoint], limits: SpeedLimits, task: SpeedTask<'_>| {
        SpeedProfiler::new().profile(points, &limits, &task, &mut out).unwrap_err()
    };
    let good = limits(4.0);
    assert_eq!(run(&[], good, task(0.0)), SpeedError::Empty);
    let two = &path.points[..2];
    assert_eq!(run(two, good, task(0.0)), SpeedError::TooFewSamples { samples: 2 });
    let mut bad = path.clone();
    bad.points[3].curvature_pm = f64::NAN;
    assert!(matches!(run(&bad.points, good, task(0.0)), SpeedError::BadSample { sample: 3, .. }));
    bad = path.clone();
    bad.points[7].s_m = bad.points[6].s_m;
    assert!(matches!(run(&bad.points, good, task(0.0)), SpeedError::BadSample { sample: 7, .. }));
    let caps = [1.0; 3];
    let with_caps = SpeedTask { caps_mps: Some(&caps), ..task(0.0) };
    let wrong = SpeedError::CapCount { caps: 3, samples: 21 };
    assert_eq!(run(&path.points, good, with_caps), wrong);
    for value in [f64::NAN, -1.0, f64::INFINITY] {
        let error = run(&path.points, good, task(value));
        assert!(matches!(error, SpeedError::BadNumber { what: "start speed", .. }), "{error}");
        let limits = SpeedLimits { accel_limit_mps2: value, ..good };
        assert!(matches!(run(&path.points, limits, task(0.0)), SpeedError::BadNumber { .. }));
    }
    let mut caps = vec![1.0; 21];
    caps[5] = 0.0;
    let with_caps = SpeedTask { caps_mps: Some(&caps), ..task(0.0) };
    let error = run(&path.points, good, with_caps);
    assert!(matches!(error, SpeedError::BadNumber { what: "speed cap", .. }), "{error}");
}

#[test]
fn a_single_sample_is_standing_still() {
    let path = straight(origin(), 0.0, 0.05);
    let out = drive(&path, &limits(4.0), &task(0.0));
    assert_eq!((out.len(), out[0].speed_mps, out[0].t_s), (1, 0.0, 0.0));
    let error = SpeedProfiler::new().travel_time_s(&path.points, &limits(4.0), &task(0.5));
    assert_eq!(error, Err(SpeedError::StartTooFast { allowed_mps: 0.0, given_mps: 0.5 }));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// P6, P7 and P8 on random paths, start speeds, caps and limits.
    #[test]
    fn random_profiles_keep_to_every_limit(
        seed in any::<u64>(),
        length in 0.3..14.0_f64,
        peak in 0.0..2.0_f64,
        ds in 0.02..0.05_f64,
        speed_max in 0.5..10.0_f64,
        start_share in 0.0..1.0_f64,
        friction_use_planned in 0.3..0.98_f64,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let path = if rng.random() {
            random(&mut rng, origin(), length, peak, ds)
        } else {
            hairpins(origin(), length, peak.max(0.2), ds)
        };
        let speed = SpeedParams {
            speed_max_mps: speed_max,
            friction_use: friction_use_planned,
            ..SpeedParams::default()
        };
        let limits = SpeedLimits::new(&speed, &VehicleParams::default());
        let caps: Vec<f64> = path.points.iter().map(|_| rng.random_range(0.3..10.0)).collect();
        let caps = rng.random::<bool>().then_some(caps);
        let mut profiler = SpeedProfiler::new();
        let mut out = Vec::new();
        let free = SpeedTask { caps_mps: caps.as_deref(), ..task(0.0) };
        profiler.profile(&path.points, &limits, &free, &mut out).unwrap();
        let start = start_share * profiler.envelope_squared()[0].sqrt();
        let task = SpeedTask { start_speed_mps: start, ..free };
        profiler.profile(&path.points, &limits, &task, &mut out).unwrap();

        prop_assert!((out[0].speed_mps - start).abs() < 1e-9);
        prop_assert_eq!(out.last().unwrap().speed_mps, 0.0);
        // What lies between the samples costs at most 1 % (see the head of the file).
        prop_assert!(friction_use(&out) <= friction_use_planned * 1.012, "{}", friction_use(&out));
        for (i, p) in out.iter().enumerate() {
            let cap = caps.as_ref().map_or(speed_max, |c| c[i].min(speed_max));
            prop_assert!(p.speed_mps >= 0.0 && p.speed_mps <= cap + 1e-12);
            prop_assert!(p.t_s.is_finite() && p.accel_mps2.is_finite());
            prop_assert!(i == 0 || p.t_s > out[i - 1].t_s);
            prop_assert!(i == 0 || i + 1 == out.len() || p.speed_mps > 0.0);
        }
        // P8: from every sample at its speed, the rest of the path can still be driven to rest.
        for i in (0..out.len().saturating_sub(2)).step_by(7) {
            let rest = SpeedTask { start_speed_mps: out[i].speed_mps, end: End::Rest, caps_mps: None };
            prop_assert!(SpeedProfiler::new().travel_time_s(&path.points[i..], &limits, &rest).is_ok());
        }
    }
}
