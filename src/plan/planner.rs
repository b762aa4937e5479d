//! One planning step: distance transform, search, start manoeuvre, smoothing, stop placing, speed
//! profile, certificate.
//!
//! The planner runs beside the core, on a worker in the daemon and in line in the simulator. It
//! keeps distance fields and scratch memory between steps, but its answers depend on the requests
//! alone.
//!
//! A new plan must leave the committed one smoothly. At speed, with the way leading behind the car,
//! it cannot do so at once. So a step tries up to three branch points along the committed plan:
//! where the new plan takes over, where the car can have slowed down to turning speed, and where
//! the committed plan stops. The first branch whose plan passes every check is taken.

use super::bubbles::ClearanceField;
use super::certify::{
    CertifyParams, EscapeRule, Limits, StartTolerance, Surfaces, certify, check_start,
    clear_length_m, last_escapable,
};
use super::request::{Plan, PlanRequest, Planning, Rejection, StepReport, StepTimes, Verdict};
use super::search::{
    Guide, GuideSearch, ManoeuvreParams, ManoeuvreQuery, ManoeuvreSearch, MaskRoom, SearchError,
    SearchParams, SearchQuery, Terrain,
};
use super::smooth::{SmoothParams, SmoothRequest, Smoother};
use super::speed::{End, SpeedLimits, SpeedParams, SpeedProfiler, SpeedTask};
use super::{Path, PathPoint, Trajectory};
use crate::frames::{Point, Pose};
use crate::map::{Blocking, Clearance, DistanceField, FrontierFinder};
use crate::predict::{OccupancyView, Predictor, Scene};
use crate::time::Duration;
use crate::vehicle::VehicleParams;
use crate::{choices, tunables};

choices! {
    /// How the way is chosen.
    pub enum Policy {
        /// All the way to the goal over known and predicted map (the paper's method).
        MapPredictive = "map-predictive",
        /// To the frontier whose centroid is nearest to the goal (the paper's naive baseline).
        Frontier = "frontier",
        /// All the way over a map that is known from the start (the reference).
        KnownMap = "known-map",
    }
}

tunables! {
    /// How a planning step is put together.
    pub struct PlanParams in "plan" {
        /// How the way is chosen.
        policy: Policy = Policy::MapPredictive, at_rest, one of;
        /// Clearance granted to the path's shape beside unknown space, beyond what the certificate
        /// asks for; the certificate then ends the executable part before it.
        unknown_room_m: f64 = 0.3, live, in 0.0..=2.0, "m";
        /// Whether a stop must leave room to turn even if all unknown space were walls (true), or
        /// only from the walls that are known.
        strict_escape: bool = false, live;
        /// Plans end this far inside the goal disc.
        goal_depth_m: f64 = 0.1, live, in 0.0..=1.0, "m";
    }
}

/// Everything that a planner is made of.
#[derive(Clone, Debug, Default)]
pub struct PlannerParams {
    /// The car.
    pub vehicle: VehicleParams,
    /// Composition.
    pub plan: PlanParams,
    /// Guide search.
    pub search: SearchParams,
    /// Start manoeuvres.
    pub manoeuvre: ManoeuvreParams,
    /// Smoothing.
    pub smooth: SmoothParams,
    /// Speed profile.
    pub speed: SpeedParams,
    /// Certificate.
    pub certify: CertifyParams,
}

/// Reads the wall clock, for statistics only; a constant makes the planner a pure function.
pub type Stopwatch = Box<dyn Fn() -> Duration + Send>;

/// Distances beyond this need not be told apart: larger than the largest bubble and the car.
const FIELD_CAP_M: f64 = 1.5;
/// Below this speed a car with the default tyres takes any bend the steering can.
const TURN_SPEED_SHARE: f64 = 0.9;
/// A plan whose executable part is shorter than this is no progress.
pub const SHORTEST_PLAN_M: f64 = 0.02;

/// Turns maps into certified plans.
pub struct Planner {
    params: PlannerParams,
    predictor: Box<dyn Predictor>,
    clock: Stopwatch,
    occupied: DistanceField,
    blocked: DistanceField,
    lethal: Vec<bool>,
    tight: Vec<bool>,
    guide: GuideSearch,
    manoeuvre: ManoeuvreSearch,
    frontiers: FrontierFinder,
    smoother: Smoother,
    profiler: SpeedProfiler,
    first: bool,
}

/// Clearance to occupied cells, and to unknown ones as far as that leaves some room.
struct ShapeField<'a> {
    occupied: Clearance<'a>,
    blocked: Clearance<'a>,
    unknown_floor_m: f64,
}

impl ClearanceField for ShapeField<'_> {
    fn clearance_m(&self, p: Point) -> f64 {
        let blocked = self.blocked.at(p);
        if blocked >= self.unknown_floor_m {
            return blocked;
        }
        self.occupied.at(p).min(self.unknown_floor_m)
    }
}

/// Counts the time that the predictor takes while the search asks it.
struct TimedView<'a> {
    view: &'a mut dyn Predictor,
    clock: &'a Stopwatch,
    spent: Duration,
}

impl OccupancyView for TimedView<'_> {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        let before = (self.clock)();
        self.view.occupied(points, out);
        self.spent += (self.clock)().saturating_sub(before);
    }

    fn silent(&self, low: Point, high: Point) -> bool {
        self.view.silent(low, high)
    }
}

impl Planning for Planner {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        self.answer(request)
    }
}

/// Where a new path leaves the committed one.
#[derive(Clone, Copy, Debug)]
struct Branch {
    /// Arc length on the committed path.
    s_m: f64,
    point: PathPoint,
    /// Speed of the committed plan, or what full braking leaves of it.
    speed_mps: f64,
}

impl Planner {
    /// A planner; `clock` feeds the figures in [`StepTimes`].
    pub fn new(params: PlannerParams, predictor: Box<dyn Predictor>, clock: Stopwatch) -> Self {
        Self {
            params,
            predictor,
            clock,
            occupied: DistanceField::new(Blocking::Occupied, FIELD_CAP_M),
            blocked: DistanceField::new(Blocking::OccupiedOrUnknown, FIELD_CAP_M),
            lethal: Vec::new(),
            tight: Vec::new(),
            guide: GuideSearch::new(),
            manoeuvre: ManoeuvreSearch::new(),
            frontiers: FrontierFinder::default(),
            smoother: Smoother::default(),
            profiler: SpeedProfiler::new(),
            first: true,
        }
    }

    fn answer(&mut self, request: &PlanRequest) -> StepReport {
        let mut times = StepTimes::default();
        let started = (self.clock)();
        let mut candidates = 0;
        let verdict = self.verdict(request, &mut times, &mut candidates);
        times.total = (self.clock)().saturating_sub(started);
        StepReport {
            number: request.number,
            base: request.committed.number,
            takes_over: request.takes_over,
            verdict,
            candidates,
            times,
        }
    }

    fn verdict(
        &mut self,
        request: &PlanRequest,
        times: &mut StepTimes,
        candidates: &mut u32,
    ) -> Verdict {
        let mut lap = Lap::new(&self.clock);
        self.update_fields(request);
        times.field = lap.take(&self.clock);
        self.predictor.observe(&Scene {
            grid: &request.grid,
            pose: request.scan_pose,
            goal: request.goal.position,
            changed: request.changed,
        });
        times.predict = lap.take(&self.clock);

        let mut rejection = Rejection::NothingToGain;
        for branch in self.branches(request) {
            *candidates += 1;
            let guide = match self.guide(request, &branch, times) {
                Ok(guide) => guide,
                Err(GuideFailure::Unreachable) => return Verdict::Unreachable,
                Err(GuideFailure::Nothing) => continue,
            };
            match self.along(request, &branch, &guide, times) {
                Ok(plan) => return Verdict::Plan(Box::new(plan)),
                // What keeps the first branch from working says most.
                Err(reason) if *candidates == 1 => rejection = reason,
                Err(_) => {}
            }
        }
        Verdict::Rejected(rejection)
    }

    fn update_fields(&mut self, request: &PlanRequest) {
        let changed = if self.first { request.grid.bounds() } else { request.changed };
        self.first = false;
        self.occupied.update(&request.grid, changed);
        self.blocked.update(&request.grid, changed);
        // From a cell's centre to the nearest square is half a cell less than to its centre along
        // the axes (and up to 0.7 diagonally, which smoothing finds out).
        let resolution = request.grid.resolution_m();
        let least = (self.keep_m() + 0.5 * resolution) as f32;
        self.lethal.clear();
        self.lethal.extend(self.occupied.values().iter().map(|d| *d < least));
        self.tight.clear();
        self.tight.extend(self.blocked.values().iter().map(|d| *d < least));
    }

    /// Clearance that the certificate asks for, metres.
    fn keep_m(&self) -> f64 {
        self.params.vehicle.radius_m + self.params.certify.margin_m
    }

    /// Branch points in order of preference.
    fn branches(&self, request: &PlanRequest) -> Vec<Branch> {
        let committed = &request.committed.trajectory;
        let start = committed.at(request.takes_over);
        let stop = committed.last();
        let at = |s_m: f64, speed_mps: f64| Branch {
            s_m,
            point: committed.at_distance(s_m).path,
            speed_mps,
        };
        let mut branches =
            vec![Branch { s_m: start.path.s_m, point: start.path, speed_mps: start.speed_mps }];
        let accel = self.params.vehicle.acceleration_limit_mps2();
        let turn_speed = TURN_SPEED_SHARE * (accel * self.params.vehicle.turn_radius_m).sqrt();
        if start.speed_mps > turn_speed {
            let braking = start.speed_mps * start.speed_mps - turn_speed * turn_speed;
            // Half of the tyres' force is kept for the bends of the committed plan.
            let s_m = start.path.s_m + braking / (2.0 * 0.8 * accel);
            if s_m < stop.path.s_m - 0.1 {
                branches.push(at(s_m, turn_speed.min(committed.at_distance(s_m).speed_mps)));
            }
        }
        if stop.path.s_m > start.path.s_m + SHORTEST_PLAN_M {
            branches.push(at(stop.path.s_m, 0.0));
        }
        branches
    }

    fn guide(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        times: &mut StepTimes,
    ) -> Result<Guide, GuideFailure> {
        let grid = &request.grid;
        let terrain = Terrain {
            resolution_m: grid.resolution_m(),
            bounds: grid.bounds(),
            cells: grid.cells(),
            lethal: &self.lethal,
        };
        let mut query = SearchQuery {
            start: branch.point.position,
            goal: request.goal.position,
            goal_radius_m: 0.0,
            v_ref_mps: self.params.speed.speed_max_mps,
            through_unknown: true,
        };
        let mut lap = Lap::new(&self.clock);
        let params = &self.params.search;
        let (found, predict) = if self.params.plan.policy == Policy::Frontier {
            query.through_unknown = false;
            let tight = Terrain { lethal: &self.tight, ..terrain };
            let found = self.guide.find(&tight, &query, &mut *self.predictor, params);
            let found = match found {
                Err(SearchError::Unreachable { .. } | SearchError::GoalBlocked { .. }) => {
                    self.frontier_guide(request, &mut query)
                }
                found => found,
            };
            (found, Duration::ZERO)
        } else {
            let view = &mut *self.predictor;
            let mut view = TimedView { view, clock: &self.clock, spent: Duration::ZERO };
            (self.guide.find(&terrain, &query, &mut view, params), view.spent)
        };
        times.predict += predict;
        times.search += lap.take(&self.clock).saturating_sub(predict);
        found.map_err(|error| match error {
            SearchError::Unreachable { .. } | SearchError::GoalBlocked { .. }
                if self.params.plan.policy != Policy::Frontier =>
            {
                GuideFailure::Unreachable
            }
            _ => GuideFailure::Nothing,
        })
    }
}

impl Planner {
    /// The naive baseline: to the frontier whose centroid is nearest to the goal, through known
    /// space alone.
    fn frontier_guide(
        &mut self,
        request: &PlanRequest,
        query: &mut SearchQuery,
    ) -> Result<Guide, SearchError> {
        let grid = &request.grid;
        let start = grid.cell_at(query.start);
        let mut frontiers = self.frontiers.find(grid, &self.occupied, start, self.keep_m());
        let to_goal = |p: Point| (p - request.goal.position).norm();
        frontiers.sort_by(|a, b| to_goal(a.centroid).total_cmp(&to_goal(b.centroid)));
        let terrain = Terrain {
            resolution_m: grid.resolution_m(),
            bounds: grid.bounds(),
            cells: grid.cells(),
            lethal: &self.tight,
        };
        let mut last = SearchError::Unreachable { expanded: 0 };
        for frontier in &frontiers {
            query.goal = grid.centre(frontier.representative);
            // The disc cannot stand on the frontier itself.
            query.goal_radius_m = self.keep_m() + 2.0 * grid.resolution_m();
            let found = self.guide.find(&terrain, query, &mut *self.predictor, &self.params.search);
            match found {
                Ok(guide) if guide.length_m > SHORTEST_PLAN_M => return Ok(guide),
                Ok(_) => {}
                Err(error) => last = error,
            }
        }
        Err(last)
    }

    /// A certified plan that leaves the committed one at `branch` and follows `guide`.
    fn along(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let way = self.drivable_way(request, branch, guide);
        times.manoeuvre += lap.take(&self.clock);
        let way = way?;
        let shaped = self.shape(request, branch, &way);
        times.smooth += lap.take(&self.clock);
        let (mut path, complete) = shaped?;
        let committed = &request.committed.trajectory;
        let takes_over = committed.at(request.takes_over);
        if branch.s_m > takes_over.path.s_m {
            path = join(committed, takes_over.path, branch, &path);
        }
        let reaches_goal = complete && way.reaches_goal && self.end_at_goal(request, &mut path);

        let keep_m = self.keep_m();
        let clear_m = clear_length_m(&request.grid, &path.points, keep_m);
        let stop_m = if reaches_goal && clear_m >= path.length_m() {
            clear_m
        } else {
            let surfaces = if self.params.plan.strict_escape {
                Surfaces::OccupiedAndUnknown
            } else {
                Surfaces::Occupied
            };
            let turn_radius_m = self.params.vehicle.turn_radius_m;
            let rule = EscapeRule { radius_m: keep_m, turn_radius_m, surfaces };
            last_escapable(&request.grid, &path.points, clear_m, &rule).unwrap_or(0.0)
        };
        times.certify += lap.take(&self.clock);
        self.finish(request, &path, stop_m, takes_over.speed_mps, times)
    }

    /// The guide with a start that the car can drive.
    fn drivable_way(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        guide: &Guide,
    ) -> Result<Way, Rejection> {
        let grid = &request.grid;
        let room = MaskRoom {
            resolution_m: grid.resolution_m(),
            bounds: grid.bounds(),
            blocked: &self.tight,
        };
        let vehicle = &self.params.vehicle;
        let query = ManoeuvreQuery {
            pose: branch.pose(),
            speed_mps: branch.speed_mps,
            guide,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: vehicle.acceleration_limit_mps2(),
        };
        let reaches_goal = self.params.plan.policy != Policy::Frontier
            || guide
                .points
                .last()
                .is_some_and(|p| (p - request.goal.position).norm() <= request.goal.radius_m);
        match self.manoeuvre.find(&room, &query, &self.params.manoeuvre) {
            Ok(None) => Ok(Way { points: guide.points.clone(), manoeuvre: None, reaches_goal }),
            Ok(Some(manoeuvre)) => {
                let mut points: Vec<Point> =
                    manoeuvre.path.points.iter().map(|p| p.position).collect();
                if let Some(joined) = manoeuvre.joins_at {
                    points.extend_from_slice(&guide.points[joined + 1..]);
                }
                let reaches_goal = reaches_goal && manoeuvre.joins_at.is_some();
                Ok(Way { points, manoeuvre: Some(manoeuvre.path), reaches_goal })
            }
            Err(none) => Err(Rejection::Shape(none.to_string())),
        }
    }

    /// The smoothed path from the branch point on, and whether it goes to the way's end.
    fn shape(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        way: &Way,
    ) -> Result<(Path, bool), Rejection> {
        let keep_m = self.keep_m();
        let field = ShapeField {
            occupied: Clearance::new(&request.grid, &self.occupied),
            blocked: Clearance::new(&request.grid, &self.blocked),
            unknown_floor_m: keep_m + self.params.plan.unknown_room_m,
        };
        let vehicle = &self.params.vehicle;
        let moving = branch.speed_mps > 0.0 || branch.s_m > 0.0;
        let end_radius_m = if way.reaches_goal {
            (request.goal.radius_m - self.params.plan.goal_depth_m).max(0.0)
        } else {
            0.0
        };
        let smoothed = self.smoother.smooth(
            &self.params.smooth,
            &field,
            &SmoothRequest {
                guide: &way.points,
                warm: false,
                start: branch.pose(),
                start_curvature_pm: moving.then_some(branch.point.curvature_pm),
                start_speed_mps: branch.speed_mps,
                end_radius_m,
                radius_m: keep_m,
                curvature_limit_pm: vehicle.curvature_limit_pm(),
                acceleration_limit_mps2: self.params.speed.friction_use
                    * vehicle.acceleration_limit_mps2(),
                speed_max_mps: self.params.speed.speed_max_mps,
            },
        );
        match (smoothed, &way.manoeuvre) {
            (Ok(smoothed), _) => Ok((smoothed.path, smoothed.complete)),
            // The manoeuvre can be driven as it is.
            (Err(_), Some(manoeuvre)) => Ok((manoeuvre.clone(), false)),
            (Err(error), None) => Err(Rejection::Shape(error.to_string())),
        }
    }

    /// Ends the path inside the goal disc; says whether it gets there.
    fn end_at_goal(&self, request: &PlanRequest, path: &mut Path) -> bool {
        let goal = request.goal;
        let inside_m = (goal.radius_m - self.params.plan.goal_depth_m).max(0.05);
        let distance = |p: &PathPoint| (p.position - goal.position).norm();
        let Some(last) = path.points.last() else { return false };
        if distance(last) > goal.radius_m {
            return false;
        }
        // The last time that the path enters the disc counts: it may pass by before.
        let outside = path.points.iter().rposition(|p| distance(p) > inside_m);
        if let Some(entry) = outside.and_then(|i| path.points.get(i + 1)) {
            let s_m = entry.s_m;
            path.cut(s_m);
        }
        true
    }

    /// Cuts the path at the stop, sets speeds, and has it certified.
    fn finish(
        &mut self,
        request: &PlanRequest,
        path: &Path,
        stop_m: f64,
        start_speed_mps: f64,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let mut lap = Lap::new(&self.clock);
        if stop_m < SHORTEST_PLAN_M {
            return Err(Rejection::NothingToGain);
        }
        let mut executable = path.clone();
        executable.cut(stop_m);
        let limits = SpeedLimits::new(&self.params.speed, &self.params.vehicle);
        let task = SpeedTask { start_speed_mps, end: End::Rest, caps_mps: None };
        let mut points = Vec::new();
        self.profiler
            .profile(&executable.points, &limits, &task, &mut points)
            .map_err(|error| Rejection::Speed(error.to_string()))?;
        times.speed += lap.take(&self.clock);
        let trajectory = Trajectory { start: request.takes_over, points };
        let taken_over = request.committed.trajectory.at(request.takes_over);
        let p = &self.params;
        let limits = Limits::new(&p.certify, &p.vehicle, &p.speed);
        let passed = certify(&trajectory, &request.grid, &limits).and_then(|_| {
            let pose = Pose {
                position: taken_over.path.position,
                heading_rad: taken_over.path.heading_rad,
            };
            check_start(&trajectory, pose, taken_over.speed_mps, &StartTolerance::default())
        });
        times.certify += lap.take(&self.clock);
        passed.map_err(Rejection::Certificate)?;
        let beyond = path
            .points
            .iter()
            .filter(|point| point.s_m > stop_m)
            .step_by(4)
            .map(|point| point.position)
            .collect();
        Ok(Plan { number: request.number, scan_stamp: request.scan_stamp, trajectory, beyond })
    }
}

impl Branch {
    fn pose(&self) -> Pose {
        Pose { position: self.point.position, heading_rad: self.point.heading_rad }
    }
}

/// The guide, made drivable at its start.
struct Way {
    points: Vec<Point>,
    manoeuvre: Option<Path>,
    reaches_goal: bool,
}

/// The committed path from `from` to the branch point, then `path`; arc length from zero.
fn join(committed: &Trajectory, from: PathPoint, branch: &Branch, path: &Path) -> Path {
    const SHORTEST_EDGE_M: f64 = 1e-3;
    let between = committed
        .points
        .iter()
        .map(|p| p.path)
        .filter(|p| p.s_m > from.s_m + SHORTEST_EDGE_M && p.s_m < branch.s_m - SHORTEST_EDGE_M);
    let rebased = |p: PathPoint| PathPoint { s_m: p.s_m - from.s_m, ..p };
    let mut points = vec![rebased(from)];
    points.extend(between.map(rebased));
    let length_m = branch.s_m - from.s_m;
    points.extend(path.points.iter().map(|p| PathPoint { s_m: p.s_m + length_m, ..*p }));
    Path { points }
}

/// Why there is no guide.
enum GuideFailure {
    Unreachable,
    Nothing,
}

/// Measures consecutive parts.
struct Lap(Duration);

impl Lap {
    fn new(clock: &Stopwatch) -> Self {
        Self(clock())
    }

    fn take(&mut self, clock: &Stopwatch) -> Duration {
        let now = clock();
        now.saturating_sub(std::mem::replace(&mut self.0, now))
    }
}
