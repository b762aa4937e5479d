use std::f64::consts::{FRAC_PI_2, PI};

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::frames::{Point, heading_vector};
use crate::map::{Cell, CellIndex, CellRect};
use crate::plan::Path;
use crate::plan::speed::{End, SpeedLimits, SpeedProfiler, SpeedTask};
use crate::plan::test_paths::{from_curvature, hairpins, random, straight};
use crate::time::Instant;

const RADIUS: f64 = 0.25;

fn limits() -> Limits {
    Limits::new(&CertifyParams::default(), &VehicleParams::default(), &SpeedParams::default())
}

fn driven(path: &Path) -> Trajectory {
    ending(path, End::Rest)
}

fn ending(path: &Path, end: End) -> Trajectory {
    let limits = SpeedLimits::new(&SpeedParams::default(), &VehicleParams::default());
    let task = SpeedTask { start_speed_mps: 0.0, end, caps_mps: None };
    let mut points = Vec::new();
    SpeedProfiler::new().profile(&path.points, &limits, &task, &mut points).unwrap();
    Trajectory { start: Instant::ZERO, points }
}

/// A room of free cells from corner to corner (metres).
fn room(resolution: f64, low: (f64, f64), high: (f64, f64)) -> Grid {
    let mut grid = Grid::new(resolution);
    fill(&mut grid, low, high, Cell::Free);
    grid
}

fn fill(grid: &mut Grid, low: (f64, f64), high: (f64, f64), cell: Cell) {
    let index = |v: f64| (v / grid.resolution_m()).round() as i32;
    let rect =
        CellRect { x0: index(low.0), y0: index(low.1), x1: index(high.0), y1: index(high.1) };
    for iy in rect.y0..rect.y1 {
        for ix in rect.x0..rect.x1 {
            grid.set(CellIndex::new(ix, iy), cell);
        }
    }
}

fn hall() -> Grid {
    room(0.1, (-20.0, -20.0), (20.0, 20.0))
}

/// Distance from a point to the nearest quarter of a cell that has not been seen to be free, looking at
/// every one within a metre.
fn brute_clearance(grid: &Grid, p: Point) -> f64 {
    let res = 0.5 * grid.resolution_m();
    let (cx, cy) = ((p.x / res).floor() as i32, (p.y / res).floor() as i32);
    let reach = (1.0 / res) as i32;
    let mut least = 1.0_f64;
    for iy in cy - reach..=cy + reach {
        for ix in cx - reach..=cx + reach {
            let middle = Point::new((f64::from(ix) + 0.5) * res, (f64::from(iy) + 0.5) * res);
            if grid.state_at(middle) == Cell::Free {
                continue;
            }
            let (x, y) = (f64::from(ix) * res, f64::from(iy) * res);
            let dx = (x - p.x).max(p.x - x - res).max(0.0);
            let dy = (y - p.y).max(p.y - y - res).max(0.0);
            least = least.min(dx.hypot(dy));
        }
    }
    least
}

/// Least clearance over points a millimetre apart along the trajectory's own curve.
fn brute_swept(grid: &Grid, trajectory: &Trajectory) -> f64 {
    let length = trajectory.last().path.s_m;
    let n = (length / 1e-3).ceil().max(1.0) as usize;
    (0..=n)
        .map(|i| trajectory.at_distance(length * i as f64 / n as f64).path.position)
        .map(|p| brute_clearance(grid, p))
        .fold(f64::INFINITY, f64::min)
}

#[test]
fn a_sound_plan_passes_and_its_figures_are_right() {
    let path = hairpins(Pose::new(0.0, 0.0, 0.4), 8.0, 2.0, 0.05);
    let t = driven(&path);
    let found = certify(&t, &hall(), &limits()).unwrap();
    assert!((found.length_m - 8.0).abs() < 1e-9);
    assert_eq!(found.duration_s, t.duration_s());
    assert!(found.friction_use > 0.9 && found.friction_use <= 0.96, "{}", found.friction_use);
    assert!((found.curvature_max_pm - 2.0).abs() < 1e-12);
    check_start(&t, Pose::new(0.0, 0.0, 0.4), 0.0, &StartTolerance::default()).unwrap();
}

#[test]
fn standing_still_is_a_plan_if_the_car_stands_in_the_open() {
    let mut grid = hall();
    let t = Trajectory::at_rest(Instant::ZERO, Pose::new(1.0, 1.0, 0.0));
    assert!(certify(&t, &grid, &limits()).is_ok());
    grid.set(CellIndex::new(12, 10), Cell::Occupied);
    let error = certify(&t, &grid, &limits()).unwrap_err();
    assert!(matches!(error, Violation::Swept { state: Cell::Occupied, .. }), "{error}");
    assert!(certify(&t, &Grid::new(0.1), &limits()).is_err());
}

#[test]
fn no_plan_may_enter_the_unknown() {
    let mut grid = hall();
    fill(&mut grid, (2.0, -1.0), (2.2, 1.0), Cell::Unknown);
    let t = driven(&straight(Pose::new(0.0, 0.0, 0.0), 3.0, 0.05));
    let error = certify(&t, &grid, &limits()).unwrap_err();
    assert!(matches!(error, Violation::Swept { state: Cell::Unknown, .. }), "{error}");
    fill(&mut grid, (2.0, -1.0), (2.2, 1.0), Cell::Free);
    assert!(certify(&t, &grid, &limits()).is_ok());
    // Off the stored cells all is unknown: here every stored cell is free.
    let room = room(0.1, (0.0, 0.0), (6.4, 6.4));
    assert!(room.cells().iter().all(|c| *c == Cell::Free));
    for (end, clear) in [(6.1, true), (6.2, false)] {
        for heading in [0.0, FRAC_PI_2, PI, -FRAC_PI_2] {
            let middle = Point::new(3.2, 3.2);
            let start = middle + heading_vector(heading) * (end - 3.2 - 2.0);
            let pose = Pose { position: start, heading_rad: heading };
            let t = driven(&straight(pose, 2.0, 0.05));
            let error = certify(&t, &room, &limits());
            assert_eq!(error.is_ok(), clear, "{heading} {error:?}");
        }
    }
}

#[test]
fn a_plan_that_does_not_end_at_rest_is_refused() {
    let t = ending(&straight(Pose::new(0.0, 0.0, 0.0), 3.0, 0.05), End::Speed(1.0));
    assert_eq!(certify(&t, &hall(), &limits()), Err(Violation::NotAtRest { speed_mps: 1.0 }));
}

#[test]
fn a_path_three_centimetres_into_the_wall_is_refused() {
    let mut grid = hall();
    fill(&mut grid, (-1.0, 0.3), (5.0, 0.4), Cell::Occupied);
    let t = driven(&straight(Pose::new(0.0, 0.04, 0.0), 3.0, 0.05));
    assert!(certify(&t, &grid, &limits()).is_ok());
    let shifted = driven(&straight(Pose::new(0.0, 0.07, 0.0), 3.0, 0.05));
    let error = certify(&shifted, &grid, &limits()).unwrap_err();
    let Violation::Swept { distance_m, needed_m, .. } = error else { panic!("{error}") };
    assert!((distance_m - 0.23).abs() < 1e-9 && (needed_m - RADIUS).abs() < 1e-9);
    assert!(error.to_string().contains("0.2300 m to Occupied cell (-1, 3)"), "{error}");
}

#[test]
fn the_curve_counts_where_its_chord_would_pass() {
    // The corner of a cell lies outward of the middle of an edge of the tightest turn, whose arc
    // comes 0.6 mm nearer than its chord.
    let mut grid = hall();
    grid.set(CellIndex::new(10, 10), Cell::Occupied);
    let passes = |distance: f64| {
        let outward = heading_vector(FRAC_PI_2 / 2.0);
        let centre = Point::new(1.0, 1.0) - outward * (0.5 + distance);
        let first = FRAC_PI_2 / 2.0 - 5.5 * 0.05 / 0.5;
        let start =
            Pose { position: centre + heading_vector(first) * 0.5, heading_rad: first + FRAC_PI_2 };
        let t = driven(&from_curvature(start, &[2.0; 12], 0.05));
        assert!((brute_swept(&grid, &t) - distance).abs() < 1e-5);
        certify(&t, &grid, &limits()).is_ok()
    };
    assert!(!passes(RADIUS - 3e-4));
    assert!(passes(RADIUS + 1e-4));
}

#[test]
fn a_curve_five_percent_too_tight_is_refused_whatever_it_claims() {
    let path = hairpins(Pose::new(0.0, 0.0, 0.0), 6.0, 2.1, 0.05);
    let error = certify(&driven(&path), &hall(), &limits()).unwrap_err();
    assert!(matches!(error, Violation::Curvature { how: "given", .. }), "{error}");
    // Claiming less: positions and headings tell.
    let mut lie = path.clone();
    lie.points.iter_mut().for_each(|p| p.curvature_pm /= 1.05);
    let error = certify(&driven(&lie), &hall(), &limits()).unwrap_err();
    let told = matches!(error, Violation::Curvature { how: "measured", .. })
        || matches!(error, Violation::CurvatureMismatch { .. });
    assert!(told, "{error}");
    // Claiming to be straight: the friction would be out by everything.
    lie.points.iter_mut().for_each(|p| p.curvature_pm = 0.0);
    let error = certify(&driven(&lie), &hall(), &limits()).unwrap_err();
    assert!(matches!(error, Violation::CurvatureMismatch { .. }), "{error}");
    // Positions alone: a circle 5 % smaller under headings and arc lengths that are in order.
    let mut squeezed = from_curvature(Pose::new(0.0, 0.0, 0.0), &[2.0; 40], 0.05);
    squeezed.points.iter_mut().for_each(|p| p.position.coords /= 1.05);
    assert!(certify(&driven(&squeezed), &hall(), &limits()).is_err());
}

#[test]
fn a_tightest_turn_within_tolerance_passes_at_any_sampling() {
    for ds in [0.01, 0.02, 0.05, 0.1, 0.2] {
        let path = hairpins(Pose::new(0.0, 0.0, 2.0), 7.0, 2.0, ds);
        let slow = SpeedLimits {
            accel_limit_mps2: 7.0,
            ..SpeedLimits::new(&SpeedParams::default(), &VehicleParams::default())
        };
        let task = SpeedTask { start_speed_mps: 0.0, end: End::Rest, caps_mps: None };
        let mut points = Vec::new();
        SpeedProfiler::new().profile(&path.points, &slow, &task, &mut points).unwrap();
        let t = Trajectory { start: Instant::ZERO, points };
        let result = certify(&t, &hall(), &limits());
        assert!(result.is_ok(), "{ds}: {result:?}");
    }
}

#[test]
fn a_kink_is_refused() {
    let first = straight(Pose::new(0.0, 0.0, 0.0), 1.0, 0.05);
    let mut path = first.clone();
    let corner = first.points.last().unwrap();
    // Twelve degrees; 0.05 m at the turning radius explain six.
    let second = straight(Pose { position: corner.position, heading_rad: 0.21 }, 1.0, 0.05);
    path.points.pop();
    path.points.extend(second.points.iter().map(|p| PathPoint { s_m: p.s_m + 1.0, ..*p }));
    let error = certify(&driven(&path), &hall(), &limits()).unwrap_err();
    let seen = matches!(error, Violation::CurvatureMismatch { .. } | Violation::Tangent { .. });
    assert!(seen, "{error}");
    // A first heading that is not the way the path leads.
    let mut path = first;
    path.points[0].heading_rad = 0.08;
    let error = certify(&driven(&path), &hall(), &limits()).unwrap_err();
    let seen = matches!(error, Violation::CurvatureMismatch { .. } | Violation::Tangent { .. });
    assert!(seen, "{error}");
}

/// A forward-backward profile with friction at the middle of the edges, as the paper has it.
fn midpoint_profile(path: &Path, circle: f64, speed_max: f64) -> Trajectory {
    let n = path.points.len();
    let numbers = |i: usize| {
        let (a, b) = (&path.points[i], &path.points[i + 1]);
        let (d, k) = (2.0 * (b.s_m - a.s_m), 0.5 * (a.curvature_pm + b.curvature_pm));
        (1.0 / (d * d), 0.25 * k * k)
    };
    let other = |c: f64, (p, q): (f64, f64)| {
        let s = p + q;
        ((p - q) * c + (circle * circle * s - 4.0 * p * q * c * c).max(0.0).sqrt()) / s
    };
    let mut squares = vec![0.0_f64; n];
    for i in (0..n - 1).rev() {
        let (p, q) = numbers(i);
        let tip = circle * (p - q) / (2.0 * (p * q * (p + q)).sqrt());
        let own = circle / path.points[i].curvature_pm.abs();
        squares[i] = other(squares[i + 1].min(tip), (p, q)).min(own).min(speed_max * speed_max);
    }
    squares[0] = 0.0;
    for i in 0..n - 1 {
        squares[i + 1] = squares[i + 1].min(other(squares[i], numbers(i)));
    }
    let mut t_s = 0.0;
    let points = (0..n)
        .map(|i| {
            let speed_mps = squares[i].sqrt();
            let mut point =
                TrajectoryPoint { path: path.points[i], t_s, speed_mps, accel_mps2: 0.0 };
            if i + 1 < n {
                let ds = path.points[i + 1].s_m - path.points[i].s_m;
                point.accel_mps2 = (squares[i + 1] - squares[i]) / (2.0 * ds);
                t_s += 2.0 * ds / (speed_mps + squares[i + 1].sqrt());
            }
            point
        })
        .collect();
    Trajectory { start: Instant::ZERO, points }
}

#[test]
fn friction_between_coarse_samples_is_seen() {
    let path = hairpins(Pose::new(0.0, 0.0, 0.0), 12.0, 1.6, 0.4);
    let coarse = midpoint_profile(&path, 0.98 * limits().accel_limit_mps2, 4.0);
    let error = certify(&coarse, &hall(), &limits()).unwrap_err();
    let Violation::Friction { accel_mps2, .. } = error else { panic!("{error}") };
    assert!(accel_mps2 > 1.03 * limits().accel_limit_mps2, "{accel_mps2}");
    // The same rule with fine samples passes, so it is the sampling that was refused.
    let path = hairpins(Pose::new(0.0, 0.0, 0.0), 12.0, 1.6, 0.01);
    certify(&midpoint_profile(&path, 0.95 * 8.829, 4.0), &hall(), &limits()).unwrap();
}

#[test]
fn the_largest_friction_between_samples_is_exact() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let hall = room(0.1, (-30.0, -30.0), (30.0, 30.0));
    for _ in 0..30 {
        let path = random(&mut rng, Pose::new(0.0, 0.0, 0.0), 6.0, 2.0, 0.1);
        let t = driven(&path);
        // Generous, to get the figure of profiles that are out of bounds too.
        let wide = Limits { accel_limit_mps2: 20.0, ..limits() };
        let found = certify(&t, &hall, &wide).unwrap().friction_use * 20.0;
        let mut brute = 0.0_f64;
        for edge in t.points.windows(2) {
            for j in 0..=40 {
                let s =
                    edge[0].path.s_m + (edge[1].path.s_m - edge[0].path.s_m) * f64::from(j) / 40.0;
                let p = t.at_distance(s);
                let lateral = p.path.curvature_pm * p.speed_mps * p.speed_mps;
                brute = brute.max(edge[0].accel_mps2.hypot(lateral));
            }
        }
        assert!(found >= brute - 1e-6 && found < brute * 1.001, "{found} {brute}");
    }
}

#[test]
fn anything_that_is_no_number_is_refused_wherever_it_is() {
    let good = driven(&straight(Pose::new(0.0, 0.0, 0.0), 1.0, 0.05));
    let edits: [fn(&mut TrajectoryPoint, f64); 8] = [
        |p, v| p.path.s_m = v,
        |p, v| p.path.position.x = v,
        |p, v| p.path.position.y = v,
        |p, v| p.path.heading_rad = v,
        |p, v| p.path.curvature_pm = v,
        |p, v| p.t_s = v,
        |p, v| p.speed_mps = v,
        |p, v| p.accel_mps2 = v,
    ];
    for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e300] {
        for edit in edits {
            for sample in 0..good.points.len() {
                let mut bad = good.clone();
                edit(&mut bad.points[sample], value);
                // What lies after the last sample has no acceleration to be wrong.
                let ignored = value == 1e300
                    && bad.points[sample].accel_mps2 == value
                    && sample + 1 == good.points.len();
                let refused = certify(&bad, &hall(), &limits()).is_err();
                assert!(refused || ignored, "sample {sample}, {value}");
            }
        }
    }
    let none = Trajectory { start: Instant::ZERO, points: vec![] };
    assert_eq!(certify(&none, &hall(), &limits()), Err(Violation::Empty));
    assert_eq!(recertify(&none, 0.0, &hall(), RADIUS), Err(Violation::Empty));
}

#[test]
fn time_speed_and_acceleration_must_tell_one_story() {
    let good = driven(&straight(Pose::new(0.0, 0.0, 0.0), 2.0, 0.05));
    let refused = |edit: &dyn Fn(&mut Vec<TrajectoryPoint>)| {
        let mut bad = good.clone();
        edit(&mut bad.points);
        certify(&bad, &hall(), &limits()).unwrap_err()
    };
    let error = refused(&|p| p[5].t_s = p[4].t_s);
    assert!(matches!(error, Violation::NotIncreasing { sample: 5, what: "time", .. }), "{error}");
    let error = refused(&|p| p[5].path.s_m = p[4].path.s_m);
    assert!(matches!(error, Violation::NotIncreasing { sample: 5, .. }), "{error}");
    let error = refused(&|p| p.iter_mut().for_each(|p| p.t_s += 1.0));
    assert!(matches!(error, Violation::NotIncreasing { sample: 0, .. }), "{error}");
    let error = refused(&|p| p[10..].iter_mut().for_each(|p| p.t_s += 0.01));
    assert!(matches!(error, Violation::Motion { sample: 9, what: "duration", .. }), "{error}");
    let error = refused(&|p| p[7].accel_mps2 *= 1.01);
    assert!(matches!(error, Violation::Motion { sample: 7, what: "acceleration", .. }), "{error}");
    let error = refused(&|p| p[7].speed_mps = -0.1);
    assert!(matches!(error, Violation::Speed { sample: 7, .. }), "{error}");
    let error = refused(&|p| (p[7].speed_mps, p[8].speed_mps) = (0.0, 0.0));
    assert!(matches!(error, Violation::Motion { .. }), "{error}");
    let error = refused(&|p| p[9].path.position.x += 0.02);
    assert!(matches!(error, Violation::Chord { sample: 9, .. }), "{error}");
    let slow = Limits { speed_max_mps: 1.0, ..limits() };
    assert!(matches!(certify(&good, &hall(), &slow), Err(Violation::Speed { .. })));
    let icy = Limits { accel_limit_mps2: 4.0, ..limits() };
    assert!(matches!(certify(&good, &hall(), &icy), Err(Violation::Friction { .. })));
}

#[test]
fn a_plan_must_start_where_the_old_one_will_be() {
    let t = driven(&straight(Pose::new(1.0, 2.0, 0.5), 2.0, 0.05));
    let tolerance = StartTolerance::default();
    assert!(check_start(&t, Pose::new(1.0, 2.0, 0.5 + 2.0 * PI), 0.0, &tolerance).is_ok());
    assert!(check_start(&t, Pose::new(1.0, 2.001, 0.5), 0.0, &tolerance).is_err());
    assert!(check_start(&t, Pose::new(1.0, 2.0, 0.501), 0.0, &tolerance).is_err());
    assert!(check_start(&t, Pose::new(1.0, 2.0, 0.5), 0.01, &tolerance).is_err());
    assert!(check_start(&t, Pose::new(f64::NAN, 2.0, 0.5), 0.0, &tolerance).is_err());
}

#[test]
fn an_obstacle_set_down_ahead_is_noticed_one_behind_is_not() {
    let mut grid = hall();
    let t = driven(&straight(Pose::new(0.0, 0.05, 0.0), 4.0, 0.05));
    let at = t.at_distance(2.0).t_s;
    recertify(&t, at, &grid, RADIUS).unwrap();
    // Behind: 1.7 m, its near side 0.25 m and a little from the car.
    grid.set(CellIndex::new(16, 0), Cell::Occupied);
    recertify(&t, at, &grid, RADIUS).unwrap();
    assert!(recertify(&t, t.at_distance(1.9).t_s, &grid, RADIUS).is_err());
    grid.set(CellIndex::new(30, 2), Cell::Occupied);
    let error = recertify(&t, at, &grid, RADIUS).unwrap_err();
    assert!(matches!(error, Violation::Swept { cell: CellIndex { ix: 30, iy: 2 }, .. }));
    // At rest at the end, beyond it all.
    recertify(&t, t.duration_s() + 1.0, &grid, RADIUS).unwrap();
    grid.set(CellIndex::new(41, 2), Cell::Occupied);
    assert!(recertify(&t, t.duration_s() + 1.0, &grid, RADIUS).is_err());
}

#[test]
fn a_segment_through_a_square_touches_it() {
    let mut grid = hall();
    grid.set(CellIndex::new(0, 0), Cell::Occupied);
    let through = |ax: f64, ay: f64, bx: f64, by: f64, reach: f64| {
        let (a, b) = (Point::new(ax, ay), Point::new(bx, by));
        contact(&grid, a, b, reach, Surfaces::Occupied).map(|c| c.distance_m)
    };
    // Both ends and all corners far off.
    assert_eq!(through(-1.0, 0.05, 1.0, 0.05, 0.01), Some(0.0));
    assert_eq!(through(0.05, -3.0, 0.06, 2.0, 0.01), Some(0.0));
    // Past a corner.
    let d = through(-0.1, 0.1, 0.1, 0.3, 0.2).unwrap();
    assert!((d - 0.1 / 2.0_f64.sqrt()).abs() < 1e-12);
    assert_eq!(through(-0.1, 0.1, 0.1, 0.3, 0.07), None);
    // Far away, or not numbers.
    assert_eq!(through(1e12, 1e12, 1e12, 1e12, 1.0), None);
    assert!(through(f64::NAN, 0.0, 1.0, 1.0, 0.2).is_some());
    let far = Point::new(1e12, -1e12);
    assert!(contact(&grid, far, far, 0.2, Surfaces::OccupiedAndUnknown).is_some());
}

fn rule(surfaces: Surfaces) -> EscapeRule {
    EscapeRule { radius_m: RADIUS, turn_radius_m: 0.5, surfaces }
}

#[test]
fn nose_on_to_a_wall_there_is_a_way_on_only_from_far_enough() {
    let mut grid = hall();
    fill(&mut grid, (3.0, -5.0), (3.1, 5.0), Cell::Occupied);
    for surfaces in [Surfaces::OccupiedAndUnknown, Surfaces::Occupied] {
        let at = |x: f64| has_escape(&grid, Pose::new(x, 0.0, 0.0), &rule(surfaces));
        assert!(at(2.24) && !at(2.26));
        // Along the wall there always is.
        assert!(has_escape(&grid, Pose::new(2.7, 0.0, FRAC_PI_2), &rule(surfaces)));
    }
}

#[test]
fn unknown_ahead_counts_only_where_asked() {
    let mut grid = hall();
    fill(&mut grid, (3.0, -5.0), (5.0, 5.0), Cell::Unknown);
    let pose = Pose::new(2.6, 0.0, 0.0);
    assert!(!has_escape(&grid, pose, &rule(Surfaces::OccupiedAndUnknown)));
    assert!(has_escape(&grid, pose, &rule(Surfaces::Occupied)));
}

#[test]
fn in_a_narrow_passage_the_car_may_stop_while_it_is_seen_to_go_on() {
    let mut grid = Grid::new(0.1);
    fill(&mut grid, (0.0, -0.4), (6.0, 0.4), Cell::Free);
    let strict = rule(Surfaces::OccupiedAndUnknown);
    assert!(has_escape(&grid, Pose::new(5.2, 0.0, 0.0), &strict));
    assert!(!has_escape(&grid, Pose::new(5.3, 0.0, 0.0), &strict));
    let path = straight(Pose::new(1.0, 0.0, 0.0), 5.0, 0.05);
    let last = |path: &[PathPoint], s_max_m| {
        last_stop(path, s_max_m, |pose| has_escape(&grid, pose, &strict))
    };
    let s = last(&path.points, 4.7).unwrap();
    assert!((s - 4.25).abs() < 0.051, "{s}");
    assert_eq!(last(&path.points, 2.013), Some(2.013));
    let caught = straight(Pose::new(5.4, 0.0, 0.0), 0.3, 0.05);
    assert_eq!(last(&caught.points, 0.3), None);
    assert_eq!(last(&[], 0.3), None);
}

#[test]
fn a_way_on_that_ends_before_a_wall_leads_nowhere() {
    let mut grid = Grid::new(0.1);
    fill(&mut grid, (0.0, -0.4), (6.0, 0.4), Cell::Free);
    let strict = rule(Surfaces::OccupiedAndUnknown);
    let at = |x: f64| {
        let pose = Pose::new(x, 0.0, 0.0);
        [1, 2, 4].map(|ways| leads_on(&grid, pose, &strict, ways))
    };
    // The passage ends at 6 m; a run ahead is as long as the turning radius.
    assert_eq!(at(3.7), [true, true, true]);
    assert_eq!(at(3.8), [true, true, false]);
    assert_eq!(at(4.8), [true, false, false]);
    assert_eq!(at(5.3), [false, false, false]);
    // In the open the way on is along the wall.
    let mut hall = hall();
    fill(&mut hall, (3.0, -5.0), (3.1, 5.0), Cell::Occupied);
    assert!(leads_on(&hall, Pose::new(2.2, 0.0, 0.0), &strict, 4));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// P4 against brute force on random worlds: never passes a plan whose disc touches anything,
    /// and never fails one that is clear by more than the bulge of the curve over its chords.
    #[test]
    fn the_swept_disc_is_judged_as_dense_sampling_judges_it(
        seed in any::<u64>(),
        fine in any::<bool>(),
        peak in 0.0..2.0_f64,
        heading in -3.0..3.0_f64,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let resolution = if fine { 0.05 } else { 0.1 };
        let mut grid = room(resolution, (-4.0, -4.0), (4.0, 4.0));
        let start = Pose::new(rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0), heading);
        let path = random(&mut rng, start, 2.0, peak, 0.05);
        for _ in 0..rng.random_range(0..25) {
            let far = (3.9 / resolution) as i32;
            let cell = CellIndex::new(rng.random_range(-far..far), rng.random_range(-far..far));
            grid.set(cell, if rng.random() { Cell::Occupied } else { Cell::Unknown });
            grid.see_quarters(cell, rng.random_range(0..16));
        }
        let t = driven(&path);
        let clearance = brute_swept(&grid, &t);
        let verdict = certify(&t, &grid, &limits());
        if verdict.is_ok() {
            prop_assert!(clearance >= RADIUS, "{clearance}");
        } else {
            let swept = matches!(verdict, Err(Violation::Swept { .. }));
            prop_assert!(swept, "{verdict:?}");
            prop_assert!(clearance < RADIUS + 1.3e-3, "{clearance}");
        }

        // The clear length: a plan cut there passes, half an edge more does not.
        let clear = clear_length_m(&grid, &path.points, RADIUS, Surfaces::Unseen);
        let whole = clear_length_m(&grid, &path.points, RADIUS, Surfaces::OccupiedAndUnknown);
        prop_assert!(whole <= clear, "{whole} {clear}");
        prop_assert_eq!(verdict.is_ok(), clear == path.length_m());
        if clear > 0.15 && clear < path.length_m() {
            let mut cut = path.clone();
            cut.cut(clear);
            prop_assert!(cut.length_m() > clear - 1e-3);
            let certified = certify(&driven(&cut), &grid, &limits());
            prop_assert!(certified.is_ok(), "{certified:?}");
            let mut long = path.clone();
            long.cut(clear + 0.025);
            prop_assert!(certify(&driven(&long), &grid, &limits()).is_err());
        }
    }

    /// Every stop that the rule allows has an arc or a run that brute force finds clear too.
    #[test]
    fn an_escape_is_clear_by_dense_sampling(seed in any::<u64>(), heading in -3.0..3.0_f64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut grid = room(0.1, (-3.0, -3.0), (3.0, 3.0));
        for _ in 0..40 {
            let cell = CellIndex::new(rng.random_range(-15..15), rng.random_range(-15..15));
            grid.set(cell, if rng.random() { Cell::Occupied } else { Cell::Unknown });
        }
        let pose = Pose::new(0.0, 0.0, heading);
        let clear = |curvature: f64, length: f64| {
            (0..=500)
                .map(|i| length * f64::from(i) / 500.0)
                .map(|s| pose.along_arc(s, s * curvature).position)
                .map(|p| brute_clearance(&grid, p))
                .fold(f64::INFINITY, f64::min)
        };
        let quarter = 0.5 * FRAC_PI_2;
        let best = clear(0.0, 0.5).max(clear(2.0, quarter)).max(clear(-2.0, quarter));
        if has_escape(&grid, pose, &rule(Surfaces::OccupiedAndUnknown)) {
            prop_assert!(best >= RADIUS - 1e-9);
        } else {
            prop_assert!(best < RADIUS + 1e-3);
        }
    }

    /// One number of one sample changed by a hundredth or more, anywhere: never accepted if it
    /// changes what is driven.
    #[test]
    fn a_plan_with_one_wrong_number_is_refused(
        seed in any::<u64>(),
        sample in 1_usize..59,
        field in 0_usize..7,
        sign in prop::bool::ANY,
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let path = random(&mut rng, Pose::new(0.0, 0.0, 0.0), 3.0, 1.5, 0.05);
        let mut t = driven(&path);
        prop_assert!(certify(&t, &hall(), &limits()).is_ok());
        let sign = if sign { 1.0 } else { -1.0 };
        let p = &mut t.points[sample];
        let side = heading_vector(p.path.heading_rad + FRAC_PI_2);
        match field {
            0 => p.path.s_m += 0.01 * sign,
            1 => p.path.position += side * (0.01 * sign),
            2 => p.path.heading_rad += 0.1 * sign,
            3 => p.path.curvature_pm += 0.5 * sign,
            4 => p.t_s += 0.01 * sign,
            5 => p.speed_mps += 0.01 * sign,
            _ => p.accel_mps2 += 0.01 * sign,
        }
        prop_assert!(certify(&t, &hall(), &limits()).is_err());
    }
}
