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

use std::sync::Arc;

use super::certify::{
    CertifyParams, EscapeRule, Limits, StartTolerance, Surfaces, certify, check_start,
    clear_length_m, last_escapable,
};
use super::fenced::FencePainter;
use super::foreseen::{Foreseen, ForeseenParams, ShapeField};
use super::impasse::{Courage, Impasses};
use super::request::{Plan, PlanRequest, Planning, Rejection, StepReport, StepTimes, Verdict};
use super::search::{
    Guide, GuideSearch, ManoeuvreParams, ManoeuvreQuery, ManoeuvreSearch, Room, SearchParams,
};
use super::smooth::{SmoothParams, SmoothRequest, Smoother};
use super::speed::{End, SpeedLimits, SpeedParams, SpeedProfiler, SpeedTask};
use super::{Path, PathPoint, Trajectory};
use crate::frames::{Point, Pose};
use crate::map::{Blocking, CellRect, Clearance, DistanceField, FrontierFinder, Grid};
use crate::predict::{OccupancyView, Predictor, Scene, Supervised};
use crate::time::Duration;
use crate::vehicle::VehicleParams;
use crate::{choices, tunables};

mod exits;
mod guides;
mod janson;
mod turning;
mod ways;

use exits::Aim;
use guides::GuideFailure;
pub use janson::JansonParams;
use janson::Weigher;
use ways::{Way, join, leaves_heading, with_transitions};

choices! {
    /// How the way is chosen.
    pub enum Policy {
        /// All the way to the goal over known and predicted map (the paper's method).
        MapPredictive = "map-predictive",
        /// To the frontier whose centroid is nearest to the goal (the paper's naive baseline).
        Frontier = "frontier",
        /// Through the exit from known space that promises the earliest arrival, each one's path
        /// shaped and timed, no faster than what will have been seen allows (after Janson, Hu and
        /// Pavone 2018).
        Janson = "janson",
        /// The same, timed without regard to what will have been seen, but with a price for
        /// arriving at the exit in another direction than the way goes on.
        JansonLite = "janson-lite",
        /// All the way over a map that is known from the start (the reference).
        KnownMap = "known-map",
    }
}

choices! {
    /// How the policy map-predictive gets to the goal (the paper's text allows both).
    pub enum Reading {
        /// One search, from the car to the goal.
        Direct = "direct",
        /// The cheapest over all frontiers of the way through known space to the frontier's middle
        /// and on to the goal.
        ViaFrontier = "via-frontier",
    }
}

choices! {
    /// Where a plan may come to rest. Every stop is safe; the question is whether a car without
    /// reverse gear gets on from there.
    pub enum StopRule {
        /// Where there is room for a quarter turn, or for a turning radius straight on, as far as
        /// occupied space is known.
        Optimistic = "optimistic",
        /// The same with all unknown space taken for occupied.
        Seen = "seen",
        /// Where the car can turn back onto the way that it came by, in space known to be free.
        TurnRound = "turn-round",
    }
}

tunables! {
    /// How a planning step is put together.
    pub struct PlanParams in "plan" {
        /// How the way is chosen.
        policy: Policy = Policy::MapPredictive, at_rest, one of;
        /// How the policy map-predictive gets to the goal.
        reading: Reading = Reading::Direct, live, one of;
        /// Clearance granted to the path's shape beside unknown space, beyond what the certificate
        /// asks for; the certificate then ends the executable part before it.
        unknown_room_m: f64 = 0.3, live, in 0.0..=2.0, "m";
        /// Kept from walls, where there is room, in the path's shape through space that is foreseen,
        /// beyond what the certificate asks for: a car farther from a corner looks round it earlier,
        /// and need not slow down for what it cannot see yet.
        wall_room_m: f64 = 0.1, live, in 0.0..=1.0, "m";
        /// What a stop must leave room for.
        stop_rule: StopRule = StopRule::TurnRound, live, one of;
        /// Plans end this far inside the goal disc.
        goal_depth_m: f64 = 0.1, live, in 0.0..=1.0, "m";
    }
}

impl Policy {
    /// Whether what is foreseen has a say in the way.
    const fn is_predictive(self) -> bool {
        matches!(self, Self::MapPredictive | Self::Janson | Self::JansonLite)
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
    /// What of a prediction shapes rely on.
    pub foreseen: ForeseenParams,
    /// How exits from known space are weighed.
    pub janson: JansonParams,
}

/// Reads the wall clock, for statistics only; a constant makes the planner a pure function.
pub type Stopwatch = Box<dyn Fn() -> Duration + Send>;

/// Distances beyond this need not be told apart: larger than the largest bubble and the car.
const FIELD_CAP_M: f64 = 1.5;
/// Below this speed a car with the default tyres takes any bend the steering can.
const TURN_SPEED_SHARE: f64 = 0.9;
/// Samples of a path are no closer than this, metres.
const SHORTEST_EDGE_M: f64 = 1e-3;
/// Shapes keep this much more clearance than the certificate asks for: it measures chords and their
/// bulge where smoothing looks at samples.
const SHAPE_SLACK_M: f64 = 0.005;
/// A shape ends no nearer than this where nothing is known or foreseen, metres.
const FORESEEN_LEAST_M: f64 = 4.0;
/// Deceleration towards a lower speed that was asked for, m/s^2.
const SLOW_DOWN_MPS2: f64 = 2.0;
/// A plan whose executable part is shorter than this is no progress.
pub const SHORTEST_PLAN_M: f64 = 0.02;

/// Turns maps into certified plans.
pub struct Planner {
    params: PlannerParams,
    predictor: Supervised,
    painter: FencePainter,
    clock: Stopwatch,
    occupied: DistanceField,
    blocked: DistanceField,
    foreseen: Foreseen,
    lethal: Vec<bool>,
    tight: Vec<bool>,
    /// What this step's guide aims at.
    aim: Aim,
    /// Whether this step's searches take unknown space for free, as nothing is foreseen of it.
    hopes: bool,
    weigher: Weigher,
    impasses: Impasses,
    tracks: turning::Tracks,
    guide: GuideSearch,
    manoeuvre: ManoeuvreSearch,
    frontiers: FrontierFinder,
    smoother: Smoother,
    profiler: SpeedProfiler,
    first: bool,
}

impl Planning for Planner {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        self.answer(request)
    }

    fn set_params(&mut self, params: &PlannerParams) {
        self.params = params.clone();
    }

    fn view(&mut self) -> Option<Box<dyn OccupancyView + '_>> {
        // Showing takes no time that counts: it must not change what is driven.
        Some(Box::new(self.predictor.view(&|| Duration::ZERO)))
    }
}

/// The speed that is not to be exceeded at each sample. A car that is faster slows down gently.
fn caps_mps(path: &[PathPoint], start_speed_mps: f64, cap_mps: f64) -> Option<Vec<f64>> {
    let begin_m = path.first()?.s_m;
    let cap = |p: &PathPoint| {
        let left = start_speed_mps * start_speed_mps - 2.0 * SLOW_DOWN_MPS2 * (p.s_m - begin_m);
        left.max(0.0).sqrt().max(cap_mps)
    };
    cap_mps.is_finite().then(|| path.iter().map(cap).collect())
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
            predictor: Supervised::new(predictor),
            painter: FencePainter::default(),
            clock,
            occupied: DistanceField::new(Blocking::Occupied, FIELD_CAP_M),
            blocked: DistanceField::new(Blocking::OccupiedOrUnknown, FIELD_CAP_M),
            foreseen: Foreseen::new(FIELD_CAP_M),
            lethal: Vec::new(),
            tight: Vec::new(),
            aim: Aim::Anywhere,
            hopes: false,
            weigher: Weigher::default(),
            impasses: Impasses::default(),
            tracks: turning::Tracks::default(),
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
        let fenced = self.fenced(request);
        let asked = fenced.as_ref().unwrap_or(request);
        let verdict = self.verdict(asked, request, &mut times, &mut candidates);
        times.total = (self.clock)().saturating_sub(started);
        let prediction = self.predictor.report();
        times.predict = prediction.spent;
        StepReport {
            number: request.number,
            base: request.committed.number,
            takes_over: request.takes_over,
            verdict,
            candidates,
            times,
            prediction,
        }
    }

    /// The request with the fence drawn into its grid; `None` if it is as it came.
    fn fenced(&mut self, request: &PlanRequest) -> Option<PlanRequest> {
        let goal = Some(request.goal.position);
        let (painted, is_new) = self.painter.paint(&request.grid, &request.fence, goal);
        if painted.is_none() && !is_new {
            return None;
        }
        let grid = painted.map_or_else(|| Arc::clone(&request.grid), Arc::new);
        let changed = if is_new { grid.bounds() } else { request.changed };
        Some(PlanRequest { grid, changed, ..request.clone() })
    }

    /// `seen` is the request without a fence in its grid.
    fn verdict(
        &mut self,
        request: &PlanRequest,
        seen: &PlanRequest,
        times: &mut StepTimes,
        candidates: &mut u32,
    ) -> Verdict {
        let mut lap = Lap::new(&self.clock);
        self.impasses.begin(request.goal.position);
        self.tracks.follow(request);
        // A planner that is new to a drive under way has seen nothing of the map yet.
        let first = std::mem::take(&mut self.first);
        let changed = |of: &PlanRequest| if first { of.grid.bounds() } else { of.changed };
        let (changed, scene_changed) = (changed(request), changed(seen));
        self.update_fields(request, changed);
        times.field = lap.take(&self.clock);
        let scene = Scene {
            grid: &seen.grid,
            pose: request.scan_pose,
            goal: request.goal.position,
            changed: scene_changed,
        };
        self.predictor.observe(&scene, &self.clock);

        let branches = self.branches(request);
        let here = branches[0];
        if self.nearly_there(request, &here) {
            return Verdict::Keep;
        }
        let mut found = self.propose(request, &branches, times, candidates);
        if found.is_err() && self.impasses.blame_closed(here.point.position) {
            self.set_masks(request);
            found = self.propose(request, &branches, times, candidates);
        }
        let guide = match found {
            Ok(guide) => guide,
            Err(GuideFailure::Unreachable) => return Verdict::Unreachable,
            Err(GuideFailure::Nothing) => return Verdict::Rejected(Rejection::NothingToGain),
        };
        let verdict = self.along_guide(request, branches, &guide, times, candidates);
        match &verdict {
            Verdict::Rejected(_) if here.speed_mps <= 0.0 => {
                if self.impasses.count_failure() {
                    if let Some(plan) = self.turn_back(request, &here, &guide, times) {
                        return Verdict::Plan(Box::new(plan));
                    }
                    self.try_another_way(request, &here, &guide, times);
                }
            }
            Verdict::Plan(plan) => {
                let proven = || self.is_stop_proven(&request.grid, plan);
                if self.impasses.courage() == Courage::Proven || proven() {
                    self.impasses.record_progress(here.point.position);
                } else {
                    self.impasses.record_gamble();
                }
            }
            _ => self.impasses.record_gamble(),
        }
        verdict
    }

    /// The first plan along the guide that passes every check.
    fn along_guide(
        &mut self,
        request: &PlanRequest,
        branches: Vec<Branch>,
        guide: &Guide,
        times: &mut StepTimes,
        candidates: &mut u32,
    ) -> Verdict {
        let here = branches[0];
        let old = self.old_way(request, guide);
        let mut rejection = Rejection::NothingToGain;
        let goes_on = old.as_ref().is_some_and(|old| old.follows.is_some());
        if goes_on || !leaves_heading(here.pose(), guide, self.params.manoeuvre.skip_turn_rad) {
            *candidates += 1;
            let way = self.straight_on(request, guide, old.as_ref());
            match self.straight_plan(request, &here, way, Bends::AsCommitted, times) {
                Ok(plan) => return Verdict::Plan(Box::new(plan)),
                Err(reason) => rejection = reason,
            }
            // The way leads on as before: drive the old path, as far as it is clear by now.
            if let Some(old) = old.as_ref().filter(|old| old.agrees) {
                *candidates += 1;
                if let Ok(plan) = self.certified(request, &old.candidate, times) {
                    return Verdict::Plan(Box::new(plan));
                }
            }
            if here.speed_mps > 0.0 {
                *candidates += 1;
                let way = self.straight_on(request, guide, old.as_ref());
                match self.straight_plan(request, &here, way, Bends::AsSpeedAllows, times) {
                    Ok(plan) => return Verdict::Plan(Box::new(plan)),
                    Err(reason) => rejection = reason,
                }
            }
        }
        if goes_on && here.speed_mps > 0.0 {
            return Verdict::Rejected(rejection);
        }
        // It leads elsewhere: turn off at once, at turning speed, or where the old plan stops,
        // whichever is fastest.
        let mut turns = Vec::new();
        for branch in branches {
            *candidates += 1;
            let way = if branch.s_m == here.s_m {
                Ok(guide.clone())
            } else {
                self.guide(request, &branch, self.aim, times)
            };
            let turn = way
                .map_err(|_| Rejection::NothingToGain)
                .and_then(|guide| self.with_manoeuvre(request, &branch, &guide, times))
                .and_then(|way| self.shaped(request, &branch, way, Bends::AsCommitted, times));
            match turn {
                Ok(candidate) => {
                    if let Some(cost_s) = self.cost_s(request, &candidate, None) {
                        turns.push((cost_s, candidate));
                    }
                }
                Err(reason) if rejection == Rejection::NothingToGain => rejection = reason,
                Err(_) => {}
            }
        }
        turns.sort_by(|a, b| a.0.total_cmp(&b.0));
        for (_, candidate) in &turns {
            match self.certified(request, candidate, times) {
                Ok(plan) => return Verdict::Plan(Box::new(plan)),
                Err(reason) if rejection == Rejection::NothingToGain => rejection = reason,
                Err(_) => {}
            }
        }
        Verdict::Rejected(rejection)
    }

    fn update_fields(&mut self, request: &PlanRequest, changed: CellRect) {
        self.foreseen.begin(changed);
        self.occupied.update(&request.grid, changed);
        self.blocked.update(&request.grid, changed);
        self.set_masks(request);
    }

    /// Where the disc's centre may not be.
    fn set_masks(&mut self, request: &PlanRequest) {
        let least = self.mask_radius_m(&request.grid) as f32;
        self.lethal.clear();
        self.lethal.extend(self.occupied.values().iter().map(|d| *d < least));
        self.tight.clear();
        self.tight.extend(self.blocked.values().iter().map(|d| *d < least));
        self.impasses.mask(&request.grid, &self.tight, &mut self.lethal);
    }

    /// A cell whose centre is nearer to an obstacle's centre than this is no place for the disc,
    /// metres.
    fn mask_radius_m(&self, grid: &Grid) -> f64 {
        // From a cell's centre to the nearest square is half a cell less than to its centre along
        // the axes (and up to 0.7 diagonally, which smoothing finds out).
        self.keep_m() + 0.5 * grid.resolution_m()
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

    /// Whether the committed plan ends in the goal disc soon: nothing is left to gain then.
    fn nearly_there(&self, request: &PlanRequest, here: &Branch) -> bool {
        const SOON_M: f64 = 3.0;
        let stop = request.committed.trajectory.last().path;
        let inside = (stop.position - request.goal.position).norm() <= request.goal.radius_m;
        inside && stop.s_m - here.s_m < SOON_M
    }

    /// The guide with a start that the car can drive.
    fn with_manoeuvre(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Result<Way, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let room = ClearRoom {
            clearance: Clearance::new(&request.grid, &self.blocked),
            keep_m: self.keep_m() + SHAPE_SLACK_M,
        };
        let vehicle = &self.params.vehicle;
        let query = ManoeuvreQuery {
            pose: branch.pose(),
            speed_mps: branch.speed_mps,
            guide,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: vehicle.acceleration_limit_mps2(),
        };
        let reaches_goal = self.reaches_goal(request, guide);
        let found = self.manoeuvre.find(&room, &query, &self.params.manoeuvre);
        times.manoeuvre += lap.take(&self.clock);
        match found {
            Ok(None) => {
                let points = guide.points.clone();
                Ok(Way { points, warm: false, manoeuvre: None, reaches_goal })
            }
            Ok(Some(manoeuvre)) => {
                let mut points: Vec<Point> =
                    manoeuvre.path.points.iter().map(|p| p.position).collect();
                if let Some(joined) = manoeuvre.joins_at {
                    points.extend_from_slice(&guide.points[joined + 1..]);
                }
                let reaches_goal = reaches_goal && manoeuvre.joins_at.is_some();
                let manoeuvre = Some(with_transitions(&manoeuvre.path));
                Ok(Way { points, warm: false, manoeuvre, reaches_goal })
            }
            Err(none) => Err(Rejection::Shape(none.to_string())),
        }
    }

    fn reaches_goal(&self, request: &PlanRequest, guide: &Guide) -> bool {
        self.params.plan.policy != Policy::Frontier
            || guide
                .points
                .last()
                .is_some_and(|p| (p - request.goal.position).norm() <= request.goal.radius_m)
    }

    /// The way smoothed from the branch point on, with the committed path up to there.
    fn shaped(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        way: Way,
        bends: Bends,
        times: &mut StepTimes,
    ) -> Result<Candidate, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let keep_m = self.keep_m() + SHAPE_SLACK_M;
        let vehicle = &self.params.vehicle;
        // A car that stands may turn its wheels before it goes; what is joined to the committed path
        // must continue its curvature.
        let takes_over_m = request.committed.trajectory.at(request.takes_over).path.s_m;
        let moving = branch.speed_mps > 0.0 || branch.s_m > takes_over_m;
        let mut smooth = self.params.smooth.clone();
        if !self.foreseen.is_silent() {
            // Beyond what is foreseen the guide keeps no distance from anything.
            let mut along_m = 0.0;
            let open = way.points.windows(2).find(|pair| {
                along_m += (pair[1] - pair[0]).norm();
                along_m > FORESEEN_LEAST_M && self.foreseen.is_open(pair[1])
            });
            if open.is_some() {
                smooth.horizon_m = smooth.horizon_m.min(along_m);
            }
        }
        let end_radius_m = if way.reaches_goal {
            (request.goal.radius_m - self.params.plan.goal_depth_m).max(0.0)
        } else {
            0.0
        };
        let held: Vec<(f64, f64)> = match bends {
            Bends::AsSpeedAllows => Vec::new(),
            Bends::AsCommitted => {
                let committed = request.committed.trajectory.points.iter().map(|p| p.path);
                let ahead = committed.filter(|p| p.s_m >= branch.s_m - 0.1);
                ahead.map(|p| (p.s_m - branch.s_m, p.curvature_pm)).collect()
            }
        };
        let task = SmoothRequest {
            guide: &way.points,
            warm: way.warm,
            start: branch.pose(),
            start_curvature_pm: moving.then_some(branch.point.curvature_pm),
            held: &held,
            start_speed_mps: branch.speed_mps,
            end_radius_m,
            radius_m: keep_m,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: self.params.speed.friction_use
                * vehicle.acceleration_limit_mps2(),
            speed_max_mps: self.params.speed.speed_max_mps,
        };
        let field = |occupied, blocked, wall_room_m| ShapeField {
            occupied,
            blocked,
            keep_m,
            unknown_room_m: self.params.plan.unknown_room_m,
            wall_room_m,
        };
        let foreseen = (!self.foreseen.is_silent()).then(|| {
            let wall_room_m = self.params.plan.wall_room_m;
            let field = field(self.foreseen.occupied(), self.foreseen.blocked(), wall_room_m);
            self.smoother.smooth(&smooth, &field, &task)
        });
        // What is foreseen may be wrong. Where nothing is, what lies unseen behind a corner keeps
        // shapes off it already.
        let smoothed = foreseen.and_then(Result::ok).map_or_else(
            || {
                let occupied = Clearance::new(&request.grid, &self.occupied);
                let blocked = Clearance::new(&request.grid, &self.blocked);
                let field = field(occupied, blocked, 0.0);
                self.smoother.smooth(&self.params.smooth, &field, &task)
            },
            Ok,
        );
        let (mut path, complete) = match (smoothed, way.manoeuvre) {
            (Ok(smoothed), _) => (smoothed.path, smoothed.complete),
            // The manoeuvre can be driven as it is.
            (Err(_), Some(manoeuvre)) => (manoeuvre, false),
            (Err(error), None) => {
                times.smooth += lap.take(&self.clock);
                return Err(Rejection::Shape(error.to_string()));
            }
        };
        let way_m: f64 = way.points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
        let rest_m = (way_m - path.length_m()).max(0.0);
        let committed = &request.committed.trajectory;
        let takes_over = committed.at(request.takes_over).path;
        if branch.s_m > takes_over.s_m {
            path = join(committed, takes_over, branch, &path);
        }
        let reaches_goal = complete && way.reaches_goal && self.end_at_goal(request, &mut path);
        times.smooth += lap.take(&self.clock);
        Ok(Candidate { path, reaches_goal, rest_m })
    }

    /// Seconds to the end of the imagined way, if the car can drive it from its present speed, under
    /// further speed caps if any are given.
    fn cost_s(
        &mut self,
        request: &PlanRequest,
        candidate: &Candidate,
        caps_mps: Option<&[f64]>,
    ) -> Option<f64> {
        let limits = SpeedLimits::new(&self.params.speed, &self.params.vehicle);
        let start_speed_mps = request.committed.trajectory.at(request.takes_over).speed_mps;
        let speed_max_mps = limits.speed_max_mps;
        let task = SpeedTask { start_speed_mps, end: End::Speed(speed_max_mps), caps_mps };
        let driven_s = self.profiler.travel_time_s(&candidate.path.points, &limits, &task).ok()?;
        Some(driven_s + candidate.rest_m / speed_max_mps)
    }

    /// A plan straight on along the way.
    fn straight_plan(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        way: Way,
        bends: Bends,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let candidate = self.shaped(request, here, way, bends, times)?;
        self.certified(request, &candidate, times)
    }

    /// The candidate's executable part with speeds and certificate.
    fn certified(
        &mut self,
        request: &PlanRequest,
        candidate: &Candidate,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let path = &candidate.path;
        let keep_m = self.keep_m();
        let clear_m = clear_length_m(&request.grid, &path.points, keep_m);
        let stop_m = if candidate.reaches_goal && clear_m >= path.length_m() {
            clear_m
        } else {
            self.stop_m(&request.grid, path, clear_m)
        };
        times.certify += lap.take(&self.clock);
        self.finish(request, path, stop_m, times)
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

    /// Where on a path that is clear up to `clear_m` the plan stops, metres; zero if nowhere.
    fn stop_m(&self, grid: &Grid, path: &Path, clear_m: f64) -> f64 {
        let rule = |surfaces| EscapeRule {
            radius_m: self.keep_m(),
            turn_radius_m: self.params.vehicle.turn_radius_m,
            surfaces,
        };
        let points = &path.points;
        let optimistic = || last_escapable(grid, points, clear_m, &rule(Surfaces::Occupied));
        let seen = rule(Surfaces::OccupiedAndUnknown);
        let stop = match self.params.plan.stop_rule {
            StopRule::Optimistic => optimistic(),
            StopRule::Seen => last_escapable(grid, points, clear_m, &seen),
            StopRule::TurnRound => {
                self.last_turnable(grid, points, clear_m, Surfaces::OccupiedAndUnknown)
            }
        };
        let courage = self.impasses.courage();
        let hoped = || self.last_turnable(grid, points, clear_m, Surfaces::Occupied);
        let some_way = || last_escapable(grid, points, clear_m, &seen);
        let progress = |s_m: &f64| *s_m >= SHORTEST_PLAN_M;
        stop.filter(progress)
            .or_else(|| (courage >= Courage::Hopeful).then(hoped).flatten().filter(progress))
            .or_else(|| (courage >= Courage::Bold).then(some_way).flatten())
            .unwrap_or(0.0)
    }

    /// Cuts the path at the stop, sets speeds, and has it certified.
    fn finish(
        &mut self,
        request: &PlanRequest,
        path: &Path,
        stop_m: f64,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let mut lap = Lap::new(&self.clock);
        if stop_m < SHORTEST_PLAN_M {
            return Err(Rejection::NothingToGain);
        }
        let mut executable = path.clone();
        executable.cut(stop_m);
        let limits = SpeedLimits::new(&self.params.speed, &self.params.vehicle);
        let taken_over = request.committed.trajectory.at(request.takes_over);
        let start_speed_mps = taken_over.speed_mps;
        let caps = caps_mps(&executable.points, start_speed_mps, request.speed_cap_mps);
        let task = SpeedTask { start_speed_mps, end: End::Rest, caps_mps: caps.as_deref() };
        let mut points = Vec::new();
        self.profiler
            .profile(&executable.points, &limits, &task, &mut points)
            .map_err(|error| Rejection::Speed(error.to_string()))?;
        times.speed += lap.take(&self.clock);
        let trajectory = Trajectory { start: request.takes_over, points };
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
        let stop = trajectory.last().path.s_m;
        let beyond = path.points.iter().filter(|p| p.s_m > stop + SHORTEST_EDGE_M).copied();
        let beyond = Path { points: beyond.collect() };
        Ok(Plan { number: request.number, scan_stamp: request.scan_stamp, trajectory, beyond })
    }
}

impl Branch {
    fn pose(&self) -> Pose {
        Pose { position: self.point.position, heading_rad: self.point.heading_rad }
    }
}

/// How tightly a shape may bend where the car is still too fast for the tightest turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Bends {
    /// As the committed path at the same place.
    AsCommitted,
    /// As the speed that is left there under braking allows.
    AsSpeedAllows,
}

/// A path from the take-over on.
struct Candidate {
    path: Path,
    reaches_goal: bool,
    /// Length of the way beyond the path's end, metres.
    rest_m: f64,
}

struct ClearRoom<'a> {
    clearance: Clearance<'a>,
    keep_m: f64,
}

impl Room for ClearRoom<'_> {
    fn fits(&self, centre: Point) -> bool {
        self.clearance.reaches(centre, self.keep_m)
    }
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
