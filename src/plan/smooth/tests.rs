use super::corridors::*;
use super::*;
use crate::frames::{Point, Pose, Vector, heading_vector, wrap_angle};
use crate::plan::Path;
use crate::plan::bubbles::ClearanceField;
use std::f64::consts::PI;

const GRIP: f64 = 0.9 * 9.81;
const RADIUS_M: f64 = 0.25;

fn request<'a>(guide: &'a [Point], start: Pose) -> SmoothRequest<'a> {
    SmoothRequest {
        guide,
        warm: false,
        start,
        start_curvature_pm: None,
        held: &[],
        start_speed_mps: 0.0,
        end_radius_m: 0.0,
        radius_m: RADIUS_M,
        curvature_limit_pm: 2.0,
        acceleration_limit_mps2: GRIP,
        speed_max_mps: 4.0,
    }
}

struct Maze {
    field: Rectangles,
    /// At the first cell's centre, along the corridor.
    start: Pose,
    goal: Point,
}

impl Maze {
    fn new(seed: u64, cells: usize) -> Self {
        let route = random_route(seed, cells);
        let from = cell_centre(route[0]);
        let along = cell_centre(route[1]) - from;
        Self {
            field: corridor(&route),
            start: Pose { position: from, heading_rad: along.y.atan2(along.x) },
            goal: cell_centre(route[cells - 1]),
        }
    }

    fn guide(&self, from: Point) -> Vec<Point> {
        let cell = |v: f64| (v * 10.0).floor() / 10.0 + 0.05;
        let snapped = Point::new(cell(from.x), cell(from.y));
        let mut guide = guide_on_cells(&self.field, snapped, self.goal, RADIUS_M - 0.05);
        guide[0] = from;
        guide
    }
}

fn length_m(points: &[Point]) -> f64 {
    points.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}

/// Every promise of a path.
fn check_path(path: &Path, field: &impl ClearanceField, r: &SmoothRequest<'_>, what: &str) {
    let p = &path.points;
    assert!((p[0].position - r.start.position).norm() < 1e-9, "{what}");
    assert!(wrap_angle(p[0].heading_rad - r.start.heading_rad).abs() < 1e-9, "{what}");
    assert_eq!(p[0].s_m, 0.0);
    let limit = r.curvature_limit_pm;
    let deficit = (r.radius_m - field.clearance_m(r.start.position)).max(0.0);
    for (i, w) in p.windows(2).enumerate() {
        let (ds, chord) = (w[1].s_m - w[0].s_m, w[1].position - w[0].position);
        assert!(ds > 0.0 && ds <= 0.05 + 1e-9, "{what}: step {ds}");
        assert!(chord.norm() <= ds + 1e-9 && ds - chord.norm() < 2.5e-5, "{what}");
        let turn = wrap_angle(w[1].heading_rad - w[0].heading_rad);
        assert!(turn.abs() <= ds * limit * (1.0 + 1e-6), "{what}: heading jumps at {i}");
        let mean = 0.5 * (w[0].curvature_pm + w[1].curvature_pm) * ds;
        assert!((turn - mean).abs() < 1e-3, "{what}: curvature and heading disagree at {i}");
        let middle = w[0].heading_rad + 0.5 * turn;
        // a clothoid's chord is off the mean heading by a twelfth of the change of curvature
        let change = (w[1].curvature_pm - w[0].curvature_pm).abs() * ds;
        let off = (chord / chord.norm() - heading_vector(middle)).norm();
        assert!(off < 1e-3 + change / 8.0, "{what}: chord off by {off} at {i}");
    }
    for w in p.windows(3) {
        let (a, b, c) = (w[0].position, w[1].position, w[2].position);
        let area = (b - a).perp(&(c - a)).abs();
        let three_point = 2.0 * area / ((b - a).norm() * (c - b).norm() * (c - a).norm());
        assert!(three_point <= limit * (1.0 + 1e-3), "{what}: {three_point} at {}", w[1].s_m);
        assert!(w[1].curvature_pm.abs() <= limit * (1.0 + 1e-6), "{what}");
    }
    for q in p {
        let keep = r.radius_m - deficit - 2e-5;
        assert!(field.clearance_m(q.position) >= keep, "{what}: too near at {}", q.s_m);
    }
}

#[test]
fn paths_through_random_mazes_keep_every_promise() {
    let mut smoother = Smoother::default();
    for seed in 0..24 {
        let maze = Maze::new(seed, 14);
        let guide = maze.guide(maze.start.position);
        // headings up to 0.6 rad off the guide
        let off = 0.6 * (seed % 5) as f64 / 2.0 - 0.6;
        let heading_rad = maze.start.heading_rad + off;
        let r = request(&guide, Pose { heading_rad, ..maze.start });
        let params = SmoothParams { horizon_m: 100.0, ..SmoothParams::default() };
        let answer = smoother.smooth(&params, &maze.field, &r);
        let answer = answer.unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        check_path(&answer.path, &maze.field, &r, &format!("seed {seed}"));
        assert!(answer.complete);
        let end = answer.path.points.last().unwrap();
        assert!((end.position - maze.goal).norm() < 1e-9);
        let (long, guided) = (answer.path.length_m(), length_m(&guide));
        assert!(long <= 1.02 * guided + 0.4, "seed {seed}: {long} m for a guide of {guided} m");
        assert!(answer.stats.clearance_slack_m >= -1e-5);
        assert!(answer.stats.curvature_max_pm <= 2.0 * (1.0 + 1e-6));
    }
}

#[test]
fn the_horizon_cuts_the_path_where_there_is_room() {
    let maze = Maze::new(3, 30);
    let guide = maze.guide(maze.start.position);
    let r = request(&guide, maze.start);
    let answer = Smoother::default().smooth(&SmoothParams::default(), &maze.field, &r).unwrap();
    check_path(&answer.path, &maze.field, &r, "horizon");
    assert!(!answer.complete);
    assert!((17.0..20.5).contains(&answer.path.length_m()), "{}", answer.path.length_m());
}

/// Arcs of a turn round to the left in a straight corridor, then back along it.
fn u_turn(start: Pose, radius: f64) -> Vec<Point> {
    let forward = heading_vector(start.heading_rad);
    let left = Vector::new(-forward.y, forward.x);
    let centre = start.position + left * radius;
    let mut guide: Vec<Point> = (0..=18)
        .map(|i| f64::from(i) * PI / 18.0)
        .map(|a| centre + forward * (radius * a.sin()) - left * (radius * a.cos()))
        .collect();
    let end = guide[18];
    guide.extend((1..=30).map(|i| end - forward * (0.1 * f64::from(i))));
    guide
}

#[test]
fn a_turn_round_in_a_corridor_is_found() {
    // 2.4 m between the walls, 1.9 m for the centre
    let field = Rectangles(vec![[-6.0, -0.1, 6.0, 0.0], [-6.0, 2.4, 6.0, 2.5]]);
    let mut smoother = Smoother::default();
    for radius in [0.5, 0.55, 0.6] {
        for y in [0.3, 0.5, 0.8, 1.0] {
            if y + 2.0 * radius > 2.1 {
                continue;
            }
            let start = Pose::new(0.0, y, 0.0);
            let guide = u_turn(start, radius);
            let r = request(&guide, start);
            let answer = smoother.smooth(&SmoothParams::default(), &field, &r);
            let answer = answer.unwrap_or_else(|e| panic!("radius {radius}, y {y}: {e}"));
            check_path(&answer.path, &field, &r, "turn round");
            let end = answer.path.points.last().unwrap().heading_rad;
            assert!(wrap_angle(end - PI).abs() < 0.8, "heads back: {end}");
        }
    }
}

#[test]
fn a_turn_round_that_does_not_fit_is_refused() {
    // 1.4 m between the walls: 0.9 m for the centre, less than twice the turning radius
    let field = Rectangles(vec![[-6.0, -0.1, 6.0, 0.0], [-6.0, 1.4, 6.0, 1.5]]);
    let start = Pose::new(0.0, 0.3, 0.0);
    let guide = u_turn(start, 0.4);
    let r = request(&guide, start);
    let error = Smoother::default().smooth(&SmoothParams::default(), &field, &r).unwrap_err();
    assert!(matches!(error, SmoothError::Infeasible(_) | SmoothError::TooTight { .. }), "{error}");
}

/// Drives a maze, planning again every 50 ms from where the last plan is then, with the rest of
/// the last path as the guide. Speeds are planned with 95 % of the grip. Returns plans, failures,
/// solves and the time taken.
fn drive(maze: &Maze, speed_max: f64) -> (u32, u32, u32, f64) {
    let (params, mut smoother) = (SmoothParams::default(), Smoother::default());
    let (mut pose, mut speed, mut curvature) = (maze.start, 0.0, None);
    let mut now: Option<(Path, Vec<f64>, f64)> = None;
    let (mut plans, mut failures, mut solves, mut time_s) = (0, 0, 0, 0.0);
    loop {
        let mut guide = Vec::new();
        if let Some((path, _, s)) = &now {
            guide.extend(path.points.iter().filter(|p| p.s_m >= *s).map(|p| p.position));
            let end = path.points.last().unwrap().position;
            if (end - maze.goal).norm() > 0.1 {
                guide.extend(maze.guide(end).into_iter().skip(1));
            }
        } else {
            guide.extend(maze.guide(pose.position));
        }
        let mut r = request(&guide, pose);
        r.warm = now.is_some();
        r.speed_max_mps = speed_max;
        r.start_speed_mps = speed;
        r.start_curvature_pm = curvature;
        plans += 1;
        let shaped = smoother.smooth(&params, &maze.field, &r);
        let at_rest = shaped.as_ref().err().copied();
        let shaped = shaped.ok();
        let planned = shaped.and_then(|s| {
            check_path(&s.path, &maze.field, &r, "underway");
            solves += s.stats.solves;
            let speeds = fastest(&s.path, 0.95 * GRIP, speed_max, speed)
                .or_else(|| fastest(&s.path, GRIP, speed_max, speed))?;
            Some((s.path, speeds, 0.0))
        });
        match planned {
            Some(plan) => now = Some(plan),
            None => failures += 1,
        }
        let (path, speeds, s) = now.as_mut().unwrap_or_else(|| panic!("at rest: {at_rest:?}"));
        let mut i = path.points.partition_point(|p| p.s_m < *s + 1e-9).max(1) - 1;
        let mut step_s = 0.0;
        while step_s < 0.05 && i + 1 < path.points.len() {
            let ds = path.points[i + 1].s_m - path.points[i].s_m;
            step_s += 2.0 * ds / (speeds[i].sqrt() + speeds[i + 1].sqrt());
            i += 1;
        }
        time_s += step_s;
        let p = path.points[i];
        *s = p.s_m;
        pose = Pose { position: p.position, heading_rad: p.heading_rad };
        (speed, curvature) = (speeds[i].sqrt(), Some(p.curvature_pm));
        if i + 1 == path.points.len() || (p.position - maze.goal).norm() < 0.3 {
            return (plans, failures, solves, time_s);
        }
    }
}

#[test]
fn a_drive_can_plan_again_from_where_it_is() {
    for (seed, speed_max) in [(0, 2.0), (1, 4.0), (3, 8.0)] {
        let maze = Maze::new(seed, 14);
        let (plans, failures, solves, _) = drive(&maze, speed_max);
        assert!(plans > 40, "{plans}");
        assert!(failures * 50 <= plans, "seed {seed}: {failures} of {plans} failed");
        assert!(solves <= 3 * plans, "seed {seed}: {solves} solves for {plans} plans");
    }
}

/// Mean travel time over mazes, and how many there were.
fn mean_time_s(params: &SmoothParams, speed_max: f64) -> f64 {
    let mut smoother = Smoother::default();
    let mazes = 0..6;
    let times = mazes.clone().map(|seed| {
        let maze = Maze::new(seed, 24);
        let guide = maze.guide(maze.start.position);
        let mut r = request(&guide, maze.start);
        r.speed_max_mps = speed_max;
        let path = smoother.smooth(params, &maze.field, &r).expect("mazes have room").path;
        travel_time_s(&path, &fastest(&path, GRIP, speed_max, 0.0).expect("from rest"))
    });
    times.sum::<f64>() / mazes.count() as f64
}

#[test]
fn more_passes_make_faster_paths_and_the_default_is_near_the_best() {
    let shape = |passes| SmoothParams { passes, horizon_m: 100.0, ..SmoothParams::default() };
    for speed_max in [4.0, 8.0] {
        let [one, four, ten] = [1, 4, 10].map(|n| mean_time_s(&shape(n), speed_max));
        assert!(four <= one, "{speed_max} m/s: {one} {four} {ten}");
        assert!((four / ten - 1.0).abs() < 0.002, "{speed_max} m/s: {one} {four} {ten}");
    }
}

#[test]
fn the_length_weight_pays() {
    let shape =
        |length_weight| SmoothParams { length_weight, horizon_m: 100.0, ..SmoothParams::default() };
    for (speed_max, gain) in [(2.0, 0.02), (4.0, 0.003)] {
        let (without, with) =
            (mean_time_s(&shape(0.0), speed_max), mean_time_s(&shape(1.3), speed_max));
        assert!(with < without * (1.0 - gain), "{speed_max} m/s: {without} {with}");
    }
}

#[test]
fn both_solvers_shape_the_same_path() {
    let maze = Maze::new(5, 8);
    let guide = maze.guide(maze.start.position);
    let r = request(&guide, maze.start);
    let paths = [Solver::Banded, Solver::Clarabel].map(|solver| {
        let params = SmoothParams { solver, ..SmoothParams::default() };
        Smoother::default().smooth(&params, &maze.field, &r).unwrap().path
    });
    assert!((paths[0].length_m() / paths[1].length_m() - 1.0).abs() < 1e-3);
    for a in &paths[0].points {
        let gaps = paths[1].points.iter().map(|b| (a.position - b.position).norm());
        let nearest = gaps.fold(f64::INFINITY, f64::min);
        assert!(nearest < 0.04, "{nearest} at {}", a.s_m);
    }
}

#[test]
fn the_same_request_gives_the_same_path_whatever_came_before() {
    let (first, second) = (Maze::new(1, 12), Maze::new(2, 16));
    let guides = [&first, &second].map(|m| m.guide(m.start.position));
    let params = SmoothParams::default();
    let mut smoother = Smoother::default();
    let run = |smoother: &mut Smoother, i: usize| {
        let maze = [&first, &second][i];
        smoother.smooth(&params, &maze.field, &request(&guides[i], maze.start)).unwrap()
    };
    let fresh = run(&mut smoother, 0);
    run(&mut smoother, 1);
    assert_eq!(run(&mut smoother, 0), fresh);
    assert_eq!(run(&mut Smoother::default(), 0), fresh);
}

#[test]
fn an_end_disc_lets_the_path_end_short_of_its_centre() {
    let maze = Maze::new(4, 6);
    let guide = maze.guide(maze.start.position);
    let mut r = request(&guide, maze.start);
    let params = SmoothParams::default();
    let exact = Smoother::default().smooth(&params, &maze.field, &r).unwrap().path;
    r.end_radius_m = 0.4;
    let free = Smoother::default().smooth(&params, &maze.field, &r).unwrap().path;
    check_path(&free, &maze.field, &r, "end disc");
    let end = free.points.last().unwrap().position;
    assert!((end - maze.goal).norm() <= 0.4 + 1e-6);
    assert!(free.length_m() < exact.length_m() - 0.2);
}

#[test]
fn a_moving_car_begins_with_its_curvature_and_can_brake_for_the_bend() {
    // a right-angled bend 1.25 m ahead
    let field = corridor(&[(0, 0), (1, 0), (1, 1), (1, 2), (1, 3)]);
    let from = Point::new(2.0, 1.25);
    let start = Pose { position: from, heading_rad: 0.0 };
    let guide = guide_on_cells(&field, Point::new(2.05, 1.25), cell_centre((1, 3)), RADIUS_M);
    let mut refused = 0;
    for tenths in 0..=80 {
        let mut r = request(&guide, start);
        r.start_speed_mps = f64::from(tenths) / 10.0;
        r.start_curvature_pm = Some(0.05);
        match Smoother::default().smooth(&SmoothParams::default(), &field, &r) {
            Ok(answer) => {
                check_path(&answer.path, &field, &r, "bend ahead");
                assert!((answer.path.points[0].curvature_pm - 0.05).abs() < 1e-9);
                let speeds = fastest(&answer.path, 1.05 * GRIP, 8.0, r.start_speed_mps);
                assert!(speeds.is_some(), "at {} m/s", r.start_speed_mps);
                assert!(refused <= 1, "{} m/s: slower is not harder", r.start_speed_mps);
            }
            Err(SmoothError::TooFast { .. } | SmoothError::Infeasible(_)) => refused += 1,
            Err(error) => panic!("{error}"),
        }
    }
    // stopping before the wall opposite takes 1.8 m at most: 5.6 m/s
    assert!((20..=45).contains(&refused), "{refused} speeds refused");
}

/// Time from one sample on, with squared speeds.
fn time_from_s(path: &Path, speeds: &[f64], from: usize) -> f64 {
    let edges = from..path.points.len() - 1;
    let time = |i: usize| {
        let ds = path.points[i + 1].s_m - path.points[i].s_m;
        2.0 * ds / (speeds[i].sqrt() + speeds[i + 1].sqrt())
    };
    edges.map(time).sum()
}

#[test]
fn planning_again_in_a_bend_does_not_put_the_bend_off() {
    // a turn by 180 degrees, which full speed cannot take: the car brakes while it turns in
    let route = [(0, 0), (1, 0), (2, 0), (2, 1), (1, 1), (0, 1)];
    let (field, goal) = (corridor(&route), cell_centre((0, 1)));
    let start = Pose { position: cell_centre((0, 0)), heading_rad: 0.0 };
    let guide = guide_on_cells(&field, Point::new(1.25, 1.25), goal, RADIUS_M - 0.05);
    let params = SmoothParams::default();
    let smooth = |r: &SmoothRequest<'_>| Smoother::default().smooth(&params, &field, r);
    let first = smooth(&request(&guide, start)).unwrap().path;
    let speeds = fastest(&first, 0.95 * GRIP, 4.0, 0.0).unwrap();
    let whole_s = time_from_s(&first, &speeds, 0);
    let (mut path, mut speeds, mut i) = (first, speeds, 0);
    let (mut driven_s, mut plans, mut refused) = (0.0, 0, 0);
    while i + 30 < path.points.len() {
        driven_s += time_from_s(&path, &speeds, i) - time_from_s(&path, &speeds, i + 4);
        i += 4;
        let p = path.points[i];
        let cell = |v: f64| (v * 10.0).floor() / 10.0 + 0.05;
        let snapped = Point::new(cell(p.position.x), cell(p.position.y));
        let mut guide = guide_on_cells(&field, snapped, goal, RADIUS_M - 0.05);
        guide[0] = p.position;
        let held: Vec<_> = path.points.iter().map(|q| (q.s_m - p.s_m, q.curvature_pm)).collect();
        let mut r = request(&guide, Pose { position: p.position, heading_rad: p.heading_rad });
        r.start_speed_mps = speeds[i].sqrt();
        r.start_curvature_pm = Some(p.curvature_pm);
        r.held = &held;
        r.acceleration_limit_mps2 = 0.95 * GRIP;
        plans += 1;
        let planned = smooth(&r).ok().and_then(|answer| {
            let speed = r.start_speed_mps;
            let speeds = fastest(&answer.path, 0.95 * GRIP, 4.0, speed)
                .or_else(|| fastest(&answer.path, 0.98 * GRIP, 4.0, speed))?;
            Some((answer.path, speeds))
        });
        match planned {
            Some(plan) => ((path, speeds), i) = (plan, 0),
            // No answer is no harm: the old path goes on.
            None => refused += 1,
        }
    }
    driven_s += time_from_s(&path, &speeds, i);
    assert!(plans > 20 && 4 * refused < plans, "{refused} of {plans} refused");
    assert!(driven_s < 1.01 * whole_s, "{driven_s:.3} s instead of {whole_s:.3} s");
}

#[test]
fn a_start_a_little_too_near_a_wall_gets_clear_of_it() {
    let field = Rectangles(vec![[-6.0, -0.1, 6.0, 0.0]]);
    let guide = [Point::new(0.0, 0.21), Point::new(4.0, 0.6)];
    let start = Pose { position: guide[0], heading_rad: 0.0 };
    let r = request(&guide, start);
    let answer = Smoother::default().smooth(&SmoothParams::default(), &field, &r).unwrap();
    check_path(&answer.path, &field, &r, "near start");
    for p in answer.path.points.iter().filter(|p| p.s_m > 1.0) {
        assert!(field.clearance_m(p.position) >= RADIUS_M);
    }
    let guide = [Point::new(0.0, 0.1), Point::new(4.0, 0.6)];
    let r = request(&guide, Pose { position: guide[0], heading_rad: 0.0 });
    let error = Smoother::default().smooth(&SmoothParams::default(), &field, &r).unwrap_err();
    assert!(matches!(error, SmoothError::Blocked { .. }), "{error}");
}

#[test]
fn nonsense_is_refused_by_name() {
    let field = Rectangles(Vec::new());
    let start = Pose::new(0.0, 0.0, 0.0);
    let params = SmoothParams::default();
    let ask = |r: &SmoothRequest<'_>| Smoother::default().smooth(&params, &field, r).unwrap_err();
    for guide in [vec![], vec![Point::origin()], vec![Point::origin(), Point::new(0.01, 0.0)]] {
        assert!(matches!(ask(&request(&guide, start)), SmoothError::GuideTooShort { .. }));
    }
    let guide = [Point::origin(), Point::new(f64::NAN, 1.0)];
    assert!(matches!(ask(&request(&guide, start)), SmoothError::BadRequest { .. }));
    let guide = [Point::origin(), Point::new(3.0, 0.0)];
    let mut r = request(&guide, start);
    r.curvature_limit_pm = 0.0;
    assert_eq!(ask(&r).to_string(), "the curvature limit is 0, must be finite and positive");
    let mut r = request(&guide, start);
    r.start_speed_mps = f64::NAN;
    assert!(matches!(ask(&r), SmoothError::BadRequest { .. }));
    r.start_speed_mps = 0.0;
    r.start.heading_rad = f64::INFINITY;
    assert!(matches!(ask(&r), SmoothError::BadRequest { .. }));
}

#[test]
fn short_guides_work_too() {
    let field = Rectangles(Vec::new());
    for length in [0.06, 0.1, 0.3, 0.7, 1.5] {
        let guide = [Point::origin(), Point::new(length, 0.0)];
        let r = request(&guide, Pose::new(0.0, 0.0, 0.0));
        let answer = Smoother::default().smooth(&SmoothParams::default(), &field, &r).unwrap();
        check_path(&answer.path, &field, &r, "short");
        assert!((answer.path.length_m() - length).abs() < 1e-6);
    }
}

/// How good and how reliable: run with `--ignored --nocapture` for the figures.
#[test]
#[ignore = "prints figures"]
fn figures() {
    for speed_max in [1.0, 2.0, 4.0, 8.0] {
        let times = [1, 2, 3, 4, 10].map(|passes| {
            let params = SmoothParams { passes, horizon_m: 100.0, ..SmoothParams::default() };
            mean_time_s(&params, speed_max)
        });
        println!("{speed_max} m/s: 1, 2, 3, 4, 10 passes {times:.4?} s");
        let mut total = (0, 0, 0, 0.0);
        for seed in 0..4 {
            let one = drive(&Maze::new(seed, 24), speed_max);
            total = (total.0 + one.0, total.1 + one.1, total.2 + one.2, total.3 + one.3);
        }
        println!("  driven: plans, failures, solves, seconds {total:?}");
    }
}
