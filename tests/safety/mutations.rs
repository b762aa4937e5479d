//! Planners with a mistake in them: each must break the rule that guards against it, and the
//! product's planner in the same place must not.
//!
//! Where the product's own certificate would reject a mistaken plan before it is driven (plan or
//! keep), the mistake is made behind the certificate, as if it were switched off.

use std::sync::Arc;

use apexd::frames::{Point, Pose, heading_vector, wrap_angle};
use apexd::map::{Cell, CellIndex, CellRect, Grid};
use apexd::plan::certify::{Limits as CertifyLimits, Violation, certify};
use apexd::plan::{
    PathPoint, Plan, PlanRequest, Planner, PlannerParams, Planning, StepReport, StopRule,
    Trajectory, TrajectoryPoint, Verdict,
};
use apexd::predict::NoPrediction;
use apexd::sim::faults::Harm;
use apexd::sim::maze::Family;
use apexd::sim::rig::Rig;
use apexd::sim::world::World;
use apexd::time::Duration;
use rayon::prelude::*;

use super::geometry::least_clearance_m;
use super::trial::{DAEMON, Trial};
use super::watch::Watch;

/// A planner whose requests and answers pass through a mistake.
struct Mistaken<Q, A> {
    planner: Planner,
    question: Q,
    answer: A,
}

impl<Q, A> Planning for Mistaken<Q, A>
where
    Q: FnMut(PlanRequest) -> PlanRequest + Send,
    A: FnMut(&PlanRequest, Plan) -> Plan + Send,
{
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let mut report = self.planner.step(&(self.question)(request.clone()));
        // The core drops answers to other questions; here they are to be driven.
        report.takes_over = request.takes_over;
        report.base = request.committed.number;
        if let Verdict::Plan(plan) = &mut report.verdict {
            **plan = (self.answer)(request, (**plan).clone());
        }
        report
    }
}

fn same_question(request: PlanRequest) -> PlanRequest {
    request
}

fn same_answer(_request: &PlanRequest, plan: Plan) -> Plan {
    plan
}

/// What a drive under a planner came to.
struct Driven {
    watch: Watch,
    rig: Rig,
}

impl Driven {
    fn violations(&self, rule: &str) -> u64 {
        self.watch.findings.count(rule)
    }
}

fn drive(trial: &Trial, planning: Box<dyn Planning>) -> Driven {
    let mut rig = trial.rig_with(planning);
    let mut watch = Watch::new(trial);
    rig.drive(|rig| watch.look(rig));
    Driven { watch, rig }
}

/// Drives with the mistake, which must break the rule, and without it, which must break none.
fn assert_killed<Q, A>(
    trial: &Trial,
    rule: &str,
    planner: Planner,
    question: Q,
    answer: A,
) -> Driven
where
    Q: FnMut(PlanRequest) -> PlanRequest + Send + 'static,
    A: FnMut(&PlanRequest, Plan) -> Plan + Send + 'static,
{
    let sound = drive(trial, Box::new(trial.planner()));
    sound.watch.findings.assert_none(&trial.label());
    assert!(sound.rig.core().statistics().plans_adopted > 20, "{}: hardly driven", trial.label());
    let mistaken = drive(trial, Box::new(Mistaken { planner, question, answer }));
    assert!(mistaken.violations(rule) > 0, "{rule} does not notice: {:?}", mistaken.watch.findings);
    mistaken
}

fn corridor() -> Trial {
    Trial::maze(Family::Solid, 21).for_s(5.0)
}

/// The request with every unknown cell called free, over a margin wide enough to plan in.
fn all_known(mut request: PlanRequest) -> PlanRequest {
    let mut grid = Grid::clone(&request.grid);
    let cells: Vec<CellIndex> = {
        let b = grid.bounds();
        (b.y0..b.y1).flat_map(|iy| (b.x0..b.x1).map(move |ix| CellIndex::new(ix, iy))).collect()
    };
    for cell in cells {
        if grid.get(cell) == Cell::Unknown {
            grid.set(cell, Cell::Free);
        }
    }
    request.changed = grid.bounds();
    request.grid = Arc::new(grid);
    request
}

#[test]
fn stopping_where_the_car_cannot_turn_off_is_found() {
    // The unknown is taken for room to turn in.
    let trial = Trial::maze(Family::Thin, 23).for_s(12.0);
    let mut params = trial.planner_params();
    params.plan.stop_rule = StopRule::Optimistic;
    let clock = Box::new(|| Duration::ZERO);
    let planner = Planner::new(params, Box::new(NoPrediction), clock);
    assert_killed(&trial, "P14", planner, same_question, same_answer);
}

#[test]
fn treating_the_unknown_as_free_is_found_by_the_certificate_and_by_the_judge() {
    // The scans stop coming, and a guard that minds that late lets the committed plan be driven to
    // its end: a sound one ends in known free space.
    let trials: Vec<Trial> = (22..28)
        .map(|seed| {
            let family = if seed % 2 == 0 { Family::Branching } else { Family::Thin };
            let mut trial = Trial::maze(family, seed).for_s(5.0);
            trial.guard.scan_age_max_s = 2.0;
            let from_s = 1.6 + 0.2 * (seed % 5) as f64;
            let scan = Some((0x100, 0x101));
            trial.harm(Harm::Loss, 1.0, Some(DAEMON), scan, from_s, f64::INFINITY)
        })
        .collect();
    let entered: Vec<u64> = trials
        .par_iter()
        .map(|trial| {
            let mistaken = assert_killed(trial, "P4", trial.planner(), all_known, same_answer);
            assert!(mistaken.violations("P11") > 0, "the committed plan leaves the known");
            mistaken.rig.judge().unknown_entries()
        })
        .collect();
    println!("unknown entries of a planner that takes the unknown for free: {entered:?}");
    let drives = entered.iter().filter(|entries| **entries > 0).count();
    assert!(drives >= 3, "the judge noticed {entered:?}");
}

#[test]
fn a_plan_that_does_not_end_at_rest_is_found() {
    let trial = corridor();
    let cut = |_: &PlanRequest, mut plan: Plan| {
        let keep = (plan.trajectory.points.len() * 2 / 3).max(2);
        plan.trajectory.points.truncate(keep);
        plan
    };
    assert_killed(&trial, "P5", trial.planner(), same_question, cut);
}

/// A planner whose distances are too long by half a diagonal of a cell at either end: it keeps that
/// much less room, in its search, its shape and its certificate.
#[test]
fn a_distance_between_cell_centres_taken_for_one_between_squares_is_found() {
    let trial = corridor();
    let mut params: PlannerParams = trial.planner_params();
    params.vehicle.radius_m -= std::f64::consts::SQRT_2 * 0.1;
    let planner = Planner::new(params, Box::new(NoPrediction), Box::new(|| Duration::ZERO));
    assert_killed(&trial, "P4", planner, same_question, same_answer);
}

/// A profile with the friction circle kept at the middle of edges 0.4 m long only.
fn midpoint_profile(request: &PlanRequest, mut plan: Plan) -> Plan {
    const DS_M: f64 = 0.4;
    let whole = plan.trajectory.clone();
    let length = whole.last().path.s_m;
    let parts = (length / DS_M).ceil().max(1.0) as usize;
    let ds = length / parts as f64;
    let accel = 8.829;
    let v_max = whole.points.iter().map(|p| p.speed_mps).fold(0.0, f64::max).max(4.0);
    let curvature = |i: usize| whole.at_distance((i as f64 + 0.5) * ds).path.curvature_pm.abs();
    // Largest b next to c with the circle kept at the middle of the edge, by bisection.
    let neighbour = |c: f64, k: f64| {
        let fits = |b: f64| ((b - c) / (2.0 * ds)).hypot(k * 0.5 * (b + c)) <= accel;
        let (mut low, mut high) = (0.0, v_max * v_max);
        if fits(high) {
            return high;
        }
        for _ in 0..50 {
            let middle = 0.5 * (low + high);
            if fits(middle) || middle < c && k * c <= accel {
                low = middle;
            } else {
                high = middle;
            }
        }
        low
    };
    let mut b = vec![0.0; parts + 1];
    for i in (0..parts).rev() {
        b[i] = neighbour(b[i + 1], curvature(i));
    }
    b[0] = whole.points[0].speed_mps.powi(2).min(b[0]);
    for i in 0..parts {
        b[i + 1] = neighbour(b[i], curvature(i)).min(b[i + 1]);
    }
    // The same path and samples, with squared speeds linear over the long edges.
    let squared = |s: f64| {
        let i = ((s / ds) as usize).min(parts - 1);
        b[i] + (b[i + 1] - b[i]) * ((s - i as f64 * ds) / ds).clamp(0.0, 1.0)
    };
    let points = &mut plan.trajectory.points;
    let last = points.len() - 1;
    points[0].speed_mps = b[0].sqrt();
    for i in 0..last {
        let (s0, s1) = (points[i].path.s_m, points[i + 1].path.s_m);
        let next = if i + 1 == last { 0.0 } else { squared(s1).max(1e-4) };
        let now = points[i].speed_mps.powi(2);
        points[i].accel_mps2 = (next - now) / (2.0 * (s1 - s0));
        points[i + 1].speed_mps = next.sqrt();
        points[i + 1].t_s = points[i].t_s + 2.0 * (s1 - s0) / (now.sqrt() + next.sqrt());
    }
    plan.trajectory.start = request.takes_over;
    plan
}

#[test]
fn a_friction_circle_kept_only_in_the_middle_of_long_edges_is_found() {
    let trial = corridor();
    let mistaken = assert_killed(&trial, "P6", trial.planner(), same_question, midpoint_profile);
    assert_eq!(mistaken.rig.judge().collisions(), 0);
}

#[test]
fn a_start_heading_that_is_ignored_is_found() {
    let trial = corridor();
    // The question says that the car points elsewhere.
    let turned = |mut request: PlanRequest| {
        let mut committed = Plan::clone(&request.committed);
        for point in &mut committed.trajectory.points {
            point.path.heading_rad = wrap_angle(point.path.heading_rad + 0.3);
        }
        request.committed = Arc::new(committed);
        request
    };
    assert_killed(&trial, "P1", trial.planner(), turned, same_answer);
}

#[test]
fn a_plan_from_where_the_car_is_now_that_takes_over_later_is_found() {
    let trial = corridor();
    let latency = trial.latency_s;
    let without_shift = move |mut request: PlanRequest| {
        request.takes_over = request.takes_over.offset_by(-latency);
        request
    };
    let late = move |request: &PlanRequest, mut plan: Plan| {
        plan.trajectory.start = request.takes_over;
        plan
    };
    let mistaken = assert_killed(&trial, "P1", trial.planner(), without_shift, late);
    assert_eq!(mistaken.rig.judge().collisions(), 0, "the guard still prevents contact");
}

/// The remainder of a plan from a moment on, as a plan of its own.
fn remainder(old: &Trajectory, request: &PlanRequest) -> Trajectory {
    let first = old.at(request.takes_over);
    let (s0, t0) = (first.path.s_m, first.t_s);
    let mut points = vec![first];
    points.extend(old.points.iter().filter(|p| p.path.s_m > s0 + 1e-3));
    for point in &mut points {
        point.path.s_m -= s0;
        point.t_s -= t0;
    }
    for i in 1..points.len() {
        let (a, b) = (points[i - 1], points[i]);
        let ds = b.path.s_m - a.path.s_m;
        points[i - 1].accel_mps2 = (b.speed_mps.powi(2) - a.speed_mps.powi(2)) / (2.0 * ds);
        points[i].t_s = a.t_s + 2.0 * ds / (a.speed_mps + b.speed_mps);
    }
    Trajectory { start: request.takes_over, points }
}

#[test]
fn the_rest_of_an_old_plan_reused_after_the_map_has_changed_is_found() {
    let start = Pose::new(1.0, 2.0, 0.0);
    let trial = Trial::hall(16.0, 4.0, start, Point::new(14.0, 2.0)).for_s(4.0);
    // The way that was planned before anything stood there, over and over.
    let run = |stale: bool| {
        let mut seen: Option<Trajectory> = None;
        let reuse = move |request: &PlanRequest, mut plan: Plan| {
            let blocked = request.grid.get(request.grid.cell_at(Point::new(7.0, 2.0)));
            if stale && let Some(old) = seen.as_ref().filter(|_| blocked == Cell::Occupied) {
                plan.trajectory = remainder(old, request);
            } else {
                seen = Some(plan.trajectory.clone());
            }
            plan
        };
        let planner = trial.planner();
        let mistaken = Mistaken { planner, question: same_question, answer: reuse };
        let mut rig = trial.rig_with(Box::new(mistaken));
        let mut watch = Watch::new(&trial);
        let mut down = false;
        rig.drive(|rig| {
            if !down && rig.car().speed_mps > 3.0 {
                down = true;
                watch.world_changes();
                // Its near side is where a beam ends.
                rig.world_mut().fill_rect(Pose::new(7.05, 2.0, 0.0), 0.1, 1.0);
            }
            watch.look(rig);
        });
        assert!(down, "the car was never fast enough");
        Driven { watch, rig }
    };
    let sound = run(false);
    sound.watch.findings.assert_none(&trial.label());
    let stale = run(true);
    assert!(stale.violations("P4") > 0, "{:?}", stale.watch.findings);
    assert_eq!(stale.rig.judge().collisions(), 0, "the guard still prevents contact");
}

/// A wall of cells that touch at their corners only, right across a hall.
fn staircase() -> Trial {
    let (columns, rows) = (120, 60);
    let solid: Vec<bool> = (0..columns * rows)
        .map(|i| {
            let (x, y) = (i % columns, i / columns);
            x == 0 || y == 0 || x + 1 == columns || y + 1 == rows || x == y + 30
        })
        .collect();
    let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), columns, rows, &solid);
    let start = Pose::new(1.0, 3.04, 0.0);
    Trial::in_world("staircase".into(), world, start, Point::new(10.5, 3.0)).for_s(5.0)
}

/// Straight through the corner that two cells of the staircase share, as a search that allows
/// diagonal steps between them proposes; slow, so that nothing else is wrong with it.
fn through_the_corner() -> Trajectory {
    let corner = Point::new(6.0, 3.0);
    let heading_rad = -std::f64::consts::FRAC_PI_4;
    let direction = heading_vector(heading_rad);
    let (length, ds, accel) = (2.0, 0.05, 1.0);
    let n = 40;
    let mut points: Vec<TrajectoryPoint> = Vec::new();
    for i in 0..=n {
        let s_m = ds * f64::from(i);
        let speed_mps = (2.0 * accel * s_m.min(length - s_m)).max(0.0).sqrt();
        let before = points.last().map(|p| (p.t_s, p.speed_mps));
        let t_s = before.map_or(0.0, |(t, v)| t + 2.0 * ds / (v + speed_mps));
        points.push(TrajectoryPoint {
            path: PathPoint {
                s_m,
                position: corner + direction * (s_m - 0.5 * length),
                heading_rad,
                curvature_pm: 0.0,
            },
            t_s,
            speed_mps,
            accel_mps2: if i < n / 2 { accel } else { -accel },
        });
    }
    Trajectory { start: apexd::time::Instant::ZERO, points }
}

#[test]
fn a_step_between_two_diagonal_cells_is_found_and_never_planned() {
    let trial = staircase();
    // The whole world as a grid: with everything known only the two cells speak against it.
    let grid = apexd::sim::rig::grid_of(&trial.world, 0.1);
    let trajectory = through_the_corner();
    let params = trial.planner_params();
    let limits = CertifyLimits::new(&params.certify, &params.vehicle, &params.speed);
    let (clear, _) = least_clearance_m(&trajectory, 0.0, &grid, 0.25);
    assert!(clear < 0.01, "P4: {clear} m from the corner");
    let found = certify(&trajectory, &grid, &limits);
    assert!(matches!(found, Err(Violation::Swept { .. })), "{found:?}");
    // Without the two cells nothing is wrong with it.
    let mut open = grid.clone();
    let bounds = CellRect { x0: 50, y0: 20, x1: 71, y1: 41 };
    for iy in bounds.y0..bounds.y1 {
        for ix in bounds.x0..bounds.x1 {
            open.set(CellIndex::new(ix, iy), Cell::Free);
        }
    }
    certify(&trajectory, &open, &limits).expect("only the cells were in the way");

    // Nobody gets through, and the product's planner does not try.
    let driven = drive(&trial, Box::new(trial.planner()));
    driven.watch.findings.assert_none(&trial.label());
    let at = driven.rig.car().pose.position;
    assert!(at.x < at.y + 3.0, "the car went through the wall: {at}");
    assert!(driven.rig.distance_m() > 0.5);
}
