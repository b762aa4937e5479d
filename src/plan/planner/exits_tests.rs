use std::sync::Arc;

use proptest::prelude::*;

use super::super::janson::Weighed;
use super::*;
use crate::frames::{Point, Pose};
use crate::map::{Cell, Grid};
use crate::plan::request::{Goal, Plan, Planning, StepReport, Verdict};
use crate::plan::search::Penalty;
use crate::plan::{PlannerParams, Trajectory};
use crate::predict::{NoPrediction, Predictor, RandomPredictor};
use crate::time::{Duration, Instant};

pub(in crate::plan::planner) fn fill(
    grid: &mut Grid,
    x: std::ops::Range<i32>,
    y: std::ops::Range<i32>,
    cell: Cell,
) {
    for iy in y {
        for ix in x.clone() {
            grid.set(CellIndex::new(ix, iy), cell);
        }
    }
}

/// A hall of 8 m by 8 m, seen from its lower half: free, walled in but for what lies above 4 m,
/// where pillars, of which only the lower sides have been seen, hide more or less.
fn hall(pillars: &[(i32, i32)]) -> Grid {
    let mut grid = Grid::new(0.1);
    fill(&mut grid, -1..81, -1..55, Cell::Occupied);
    fill(&mut grid, 0..80, 0..40, Cell::Free);
    fill(&mut grid, 0..80, 40..55, Cell::Unknown);
    for (x, y) in pillars {
        fill(&mut grid, *x..*x + 14, *y..*y + 1, Cell::Occupied);
        fill(&mut grid, *x + 1..*x + 13, *y + 1..55, Cell::Unknown);
    }
    grid
}

pub(in crate::plan::planner) fn planner(policy: Policy, predictor: Box<dyn Predictor>) -> Planner {
    planner_with(policy, predictor, |_| {})
}

fn planner_with(
    policy: Policy,
    predictor: Box<dyn Predictor>,
    change: impl Fn(&mut PlannerParams),
) -> Planner {
    let mut params = PlannerParams::default();
    params.plan.policy = policy;
    change(&mut params);
    Planner::new(params, predictor, Box::new(|| Duration::ZERO))
}

pub(in crate::plan::planner) fn request(grid: Grid, start: Pose, goal: Point) -> PlanRequest {
    let now = Instant::from_nanos(1_000_000_000);
    PlanRequest {
        number: 1,
        changed: grid.bounds(),
        grid: Arc::new(grid),
        scan_stamp: now,
        scan_pose: start,
        committed: Arc::new(Plan::standing(now, start)),
        takes_over: Instant::from_nanos(1_020_000_000),
        goal: Goal { position: goal, radius_m: 0.5 },
        speed_cap_mps: f64::INFINITY,
        through_known: false,
        fence: Default::default(),
    }
}

fn plan_of(report: StepReport) -> Plan {
    match report.verdict {
        Verdict::Plan(plan) => *plan,
        other => panic!("no plan: {other:?}"),
    }
}

/// Everything of a trajectory that is driven, for comparisons.
fn shape(trajectory: &Trajectory) -> Vec<(Point, f64)> {
    trajectory.points.iter().map(|p| (p.path.position, p.speed_mps)).collect()
}

/// Takes in the map as the first part of a step does, and proposes a guide.
fn propose(planner: &mut Planner, request: &PlanRequest) -> (Guide, u32) {
    planner.impasses.begin(request.goal.position);
    planner.tracks.follow(request);
    planner.update_fields(request, request.grid.bounds());
    let scene = crate::predict::Scene {
        grid: &request.grid,
        pose: request.scan_pose,
        goal: request.goal.position,
        changed: request.changed,
    };
    planner.predictor.observe(&scene, &planner.clock);
    let branches = planner.branches(request);
    let mut candidates = 0;
    let guide = planner
        .propose(request, &branches, &mut StepTimes::default(), &mut candidates)
        .unwrap_or_else(|_| panic!("no guide"));
    (guide, candidates)
}

const START: (f64, f64) = (4.05, 1.05);

proptest! {
    #![proptest_config(ProptestConfig::with_cases(6))]
    #[test]
    fn the_exit_with_the_least_reported_cost_wins_and_is_reached_through_known_space(
        pillars in prop::collection::vec((0_i32..66, 20_i32..38), 0..4),
        goal_x in 0.5..7.5,
        heading in -0.4..0.4,
        random in any::<bool>(),
        lite in any::<bool>(),
    ) {
        let grid = hall(&pillars);
        let start = Pose::new(START.0, START.1, std::f64::consts::FRAC_PI_2 + heading);
        let request = request(grid.clone(), start, Point::new(goal_x, 12.0));
        let policy = if lite { Policy::JansonLite } else { Policy::Janson };
        let predictor: Box<dyn Predictor> =
            if random { Box::new(RandomPredictor::new(3)) } else { Box::new(NoPrediction) };
        let mut planner = planner(policy, predictor);
        let (guide, candidates) = propose(&mut planner, &request);
        let weighed = planner.weigher.weighed.clone();
        prop_assert!(weighed.len() >= 2, "{weighed:?}");
        prop_assert!(candidates as usize >= weighed.len());
        let cost = |w: &Weighed| w.cost_s;
        let least = weighed.iter().map(cost).fold(f64::INFINITY, f64::min);
        let own = weighed.iter().find(|w| w.aim == planner.aim).map(cost);
        prop_assert_eq!(own, Some(least));
        let Aim::Through(exit) = planner.aim else {
            panic!("the goal lies in unknown space: {:?}", planner.aim)
        };
        prop_assert_eq!(grid.get(exit), Cell::Free);
        let exit = grid.centre(exit);
        let at = guide.points.iter().position(|p| (p - exit).norm() < 0.15);
        prop_assert!(at.is_some_and(|at| at < guide.known_until), "{exit} is not on the way");
        for p in &guide.points[..at.unwrap_or(0)] {
            prop_assert_eq!(grid.get(grid.cell_at(*p)), Cell::Free);
        }
        let end = guide.points.last().copied();
        let missed_m = end.map(|end| (end - request.goal.position).norm());
        prop_assert!(missed_m.is_some_and(|m| m < 1e-9), "{end:?}");
    }

    #[test]
    fn through_the_frontiers_the_least_sum_of_two_searches_wins(
        pillars in prop::collection::vec((0_i32..66, 20_i32..38), 1..4),
        goal_x in 0.5..7.5,
        literal in any::<bool>(),
        random in any::<bool>(),
    ) {
        let start = Pose::new(START.0, START.1, std::f64::consts::FRAC_PI_2);
        let request = request(hall(&pillars), start, Point::new(goal_x, 12.0));
        let predictor: Box<dyn Predictor> =
            if random { Box::new(RandomPredictor::new(3)) } else { Box::new(NoPrediction) };
        let mut planner = planner_with(Policy::MapPredictive, predictor, |params| {
            params.plan.reading = Reading::ViaFrontier;
            params.search.penalty = if literal { Penalty::Literal } else { Penalty::Edge };
        });
        let (guide, _) = propose(&mut planner, &request);
        let here = planner.branches(&request)[0];
        let mut times = StepTimes::default();
        let ways = planner.ways_out(&request, &here, Sampling::Middles, &mut times);
        prop_assert!(!ways.is_empty());
        prop_assert!(ways.iter().any(|way| way.aim == planner.aim));
        for way in &ways {
            prop_assert!(guide.cost_s <= way.guide.cost_s + 1e-9, "{:?}", way.aim);
        }
        // A plan that passes every check is found, whatever is foreseen: at once, or by another way
        // where the first guide has no shape.
        let mut verdicts = (0..20).map(|_| planner.step(&request).verdict);
        prop_assert!(verdicts.any(|verdict| matches!(verdict, Verdict::Plan(_))));
    }
}

#[test]
fn more_exits_are_tried_on_a_wide_frontier_half_a_metre_apart() {
    let grid = hall(&[]);
    let start = Pose::new(START.0, START.1, 1.5);
    let request = request(grid.clone(), start, Point::new(4.0, 12.0));
    let mut planner = planner(Policy::Janson, Box::new(NoPrediction));
    propose(&mut planner, &request);
    let here = planner.branches(&request)[0];
    let middles = planner.exits(&request, &here, Sampling::Middles);
    assert_eq!(middles.len(), 1);
    let spread = planner.exits(&request, &here, Sampling::Spread);
    assert_eq!(spread[0].0, middles[0].0);
    let (middle, farthest_m) = (grid.centre(middles[0].0), middles[0].1);
    assert!((farthest_m - 3.7).abs() < 0.2, "{middle}: {farthest_m}");
    // Seven and a half metres without what is too near to the walls.
    assert!((12..=16).contains(&spread.len()), "{}", spread.len());
    for (i, (a, _)) in spread.iter().enumerate() {
        for (b, _) in &spread[..i] {
            assert!((grid.centre(*a) - grid.centre(*b)).norm() >= 0.5 - 1e-9);
        }
    }
}

#[test]
fn a_goal_in_known_space_is_driven_to_as_by_the_direct_policy() {
    let mut grid = Grid::new(0.1);
    fill(&mut grid, -1..61, -1..41, Cell::Occupied);
    fill(&mut grid, 0..60, 0..40, Cell::Free);
    fill(&mut grid, 28..32, 15..40, Cell::Occupied);
    let request = request(grid, Pose::new(1.05, 2.05, 0.0), Point::new(5.05, 3.05));
    let direct = plan_of(planner(Policy::MapPredictive, Box::new(NoPrediction)).step(&request));
    for policy in [Policy::Janson, Policy::JansonLite] {
        let mut planner = planner(policy, Box::new(NoPrediction));
        let plan = plan_of(planner.step(&request));
        assert_eq!(planner.aim, Aim::Known);
        assert_eq!(shape(&plan.trajectory), shape(&direct.trajectory));
    }
}

#[test]
fn with_a_single_exit_the_plan_is_that_of_the_direct_policy() {
    // A corridor whose end is too narrow for a second exit, seen as far as 6 m.
    let mut grid = Grid::new(0.1);
    fill(&mut grid, -1..61, -1..10, Cell::Occupied);
    fill(&mut grid, 0..60, 0..9, Cell::Free);
    fill(&mut grid, 60..61, 0..9, Cell::Unknown);
    let request = request(grid, Pose::new(0.65, 0.45, 0.0), Point::new(12.05, 0.45));
    let plans = [
        (Policy::MapPredictive, Reading::Direct),
        (Policy::MapPredictive, Reading::ViaFrontier),
        (Policy::Janson, Reading::Direct),
        (Policy::JansonLite, Reading::Direct),
    ]
    .map(|(policy, reading)| {
        let mut planner = planner_with(policy, Box::new(NoPrediction), |params| {
            params.plan.reading = reading;
            params.plan.stop_rule = super::super::StopRule::Optimistic;
        });
        let plan = plan_of(planner.step(&request)).trajectory;
        if policy != Policy::MapPredictive {
            assert_eq!(planner.weigher.weighed.len(), 1, "{policy:?}");
        }
        plan
    });
    for plan in &plans[1..] {
        let (a, b) = (plan.last(), plans[0].last());
        assert!((a.path.s_m - b.path.s_m).abs() < 0.02, "{} {}", a.path.s_m, b.path.s_m);
        for i in 0..=40 {
            let s_m = a.path.s_m * f64::from(i) / 40.0;
            let (a, b) = (plan.at_distance(s_m).path, plans[0].at_distance(s_m).path);
            assert!((a.position - b.position).norm() < 0.02, "{s_m}: {a:?} {b:?}");
        }
    }
}

#[test]
fn the_same_requests_get_the_same_plans() {
    let grid = hall(&[(10, 30), (45, 25)]);
    let start = Pose::new(START.0, START.1, 1.5);
    let request = request(grid, start, Point::new(2.0, 12.0));
    for policy in [Policy::Janson, Policy::JansonLite] {
        let step = || {
            let mut planner = planner(policy, Box::new(RandomPredictor::new(5)));
            let report = planner.step(&request);
            (report.candidates, shape(&plan_of(report).trajectory), planner.weigher.weighed)
        };
        assert_eq!(step(), step());
    }
}

#[test]
fn the_exit_of_the_plan_under_way_is_kept_unless_another_is_clearly_better() {
    let way = |x: i32| WayOut {
        aim: Aim::Through(CellIndex::new(x, 39)),
        guide: Guide {
            points: Vec::new(),
            known_until: 0,
            length_m: 0.0,
            cost_s: 0.0,
            expanded: 0,
            asked: 0,
        },
        doubt_m: 0.5,
    };
    let ways = [way(5), way(40), way(75)];
    let planner = planner(Policy::Janson, Box::new(NoPrediction));
    let mut request = request(hall(&[]), Pose::new(START.0, START.1, 1.5), Point::new(4.0, 12.0));
    let choose = |request: &PlanRequest, costs: [f64; 3]| {
        let costs: Vec<(usize, f64)> = costs.into_iter().enumerate().collect();
        planner.choose(request, &ways, &costs)
    };
    // Standing, nothing is under way.
    assert_eq!(choose(&request, [5.0, 5.1, 4.9]), Some(2));
    assert_eq!(choose(&request, [5.0, 5.0, 5.0]), Some(0));
    // Under way through the middle one; 0.5 m at 4 m/s is 0.125 s.
    let mut plan = Plan::clone(&request.committed);
    plan.beyond.points = (1..60)
        .map(|i| crate::plan::PathPoint {
            s_m: 0.1 * f64::from(i),
            position: Point::new(START.0, START.1 + 0.1 * f64::from(i)),
            heading_rad: std::f64::consts::FRAC_PI_2,
            curvature_pm: 0.0,
        })
        .collect();
    request.committed = Arc::new(plan);
    assert_eq!(choose(&request, [5.0, 5.1, 4.99]), Some(1));
    assert_eq!(choose(&request, [5.0, 5.2, 4.99]), Some(2));
    assert_eq!(planner.choose(&request, &ways, &[(0, 3.0), (2, 2.9)]), Some(2));
    assert_eq!(planner.choose(&request, &ways, &[]), None);
}

#[test]
fn joined_guides_know_where_the_unknown_begins() {
    let line = |xs: &[f64], known_until: usize| Guide {
        points: xs.iter().map(|x| Point::new(*x, 0.0)).collect(),
        known_until,
        length_m: xs[xs.len() - 1] - xs[0],
        cost_s: 1.0,
        expanded: 2,
        asked: 3,
    };
    let both = joined(line(&[0.0, 1.0, 2.0], 3), line(&[2.0, 3.0, 4.0], 1));
    assert_eq!(both.points, line(&[0.0, 1.0, 2.0, 3.0, 4.0], 0).points);
    assert_eq!((both.known_until, both.length_m, both.cost_s), (3, 4.0, 2.0));
    let all_known = joined(line(&[0.0, 1.0], 2), line(&[1.0, 2.0], 2));
    assert_eq!(all_known.known_until, all_known.points.len());
}

#[test]
fn an_exit_that_cannot_be_reached_gives_no_way() {
    let mut grid = hall(&[]);
    fill(&mut grid, 0..80, 20..21, Cell::Occupied);
    let start = Pose::new(START.0, START.1, 1.5);
    let request = request(grid, start, Point::new(4.0, 12.0));
    let mut planner = planner(Policy::Janson, Box::new(NoPrediction));
    planner.update_fields(&request, request.grid.bounds());
    let here = planner.branches(&request)[0];
    let beyond = Aim::Through(CellIndex::new(40, 39));
    let found = planner.guide(&request, &here, beyond, &mut StepTimes::default());
    assert!(matches!(found, Err(GuideFailure::Nothing)));
    assert!(matches!(planner.step(&request).verdict, Verdict::Unreachable));
}
