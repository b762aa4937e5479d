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

use super::PathPoint;
use super::fenced::FencePainter;
use super::foreseen::{Foreseen, ForeseenParams};
use super::impasse::{Courage, Impasses};
use super::request::{Plan, PlanRequest, Planning, Rejection, StepReport, StepTimes, Verdict};
use super::search::{Guide, GuideSearch, ManoeuvreSearch};
use super::smooth::Smoother;
use super::speed::{End, SpeedLimits, SpeedProfiler, SpeedTask};
use crate::frames::Pose;
use crate::map::{Blocking, CellRect, DistanceField, FrontierFinder, Grid};
use crate::predict::{OccupancyView, Predictor, Scene, Supervised};
use crate::time::Duration;

mod executable;
mod exits;
mod guides;
mod janson;
mod lap;
mod params;
mod reliance;
mod shape;
mod turning;
mod wandering;
mod ways;

use exits::Aim;
use guides::GuideFailure;
pub use janson::JansonParams;
use janson::Weigher;
use lap::Lap;
pub use params::{PlanParams, PlannerParams, Policy, Reading, StopRule};
use reliance::Reliance;
use shape::{Bends, Candidate};
use wandering::Wandering;
use ways::{Way, leaves_heading};

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
    reliance: Reliance,
    /// What of this step's view shapes rely on.
    relied_on: ForeseenParams,
    /// Whether shapes rely on any of it.
    relies: bool,
    lethal: Vec<bool>,
    tight: Vec<bool>,
    /// What this step's guide aims at.
    aim: Aim,
    /// Whether this step's searches take unknown space for free, as nothing is foreseen of it.
    hopes: bool,
    weigher: Weigher,
    impasses: Impasses,
    tracks: turning::Tracks,
    wandering: Wandering,
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
            reliance: Reliance::default(),
            relied_on: ForeseenParams::default().of_certainty(),
            relies: false,
            lethal: Vec::new(),
            tight: Vec::new(),
            aim: Aim::Anywhere,
            hopes: false,
            weigher: Weigher::default(),
            impasses: Impasses::default(),
            tracks: turning::Tracks::default(),
            wandering: Wandering::default(),
            guide: GuideSearch::new(),
            manoeuvre: ManoeuvreSearch::default(),
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
        if self.wandering.look(request.goal.position, &seen.grid, self.tracks.driven_m()) {
            self.predictor.pass_over(&scene);
        } else {
            self.predictor.observe(&scene, &self.clock);
        }
        let is_stuck = self.impasses.courage() != Courage::Proven || self.impasses.is_standing();
        let mut view = self.predictor.view(&self.clock);
        self.relied_on = self.reliance.judge(&self.params, is_stuck, &mut view);
        self.relies = self.relied_on.rely_on_any_of(&view);

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
        self.wandering.follow(&guide);
        let verdict = self.along_guide(request, branches, &guide, times, candidates);
        match &verdict {
            Verdict::Rejected(_) if here.speed_mps <= 0.0 => {
                if self.impasses.count_failure() {
                    let turned = self.turn_back(request, &here, &guide, times);
                    let hoped = turned.or_else(|| self.hoped_turn(request, &here, &guide, times));
                    let plan = hoped.or_else(|| self.way_on(request, &here, &guide, times));
                    if let Some(plan) = plan {
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

    /// Whether the committed plan ends well inside the goal disc soon: nothing is left to gain then.
    fn nearly_there(&self, request: &PlanRequest, here: &Branch) -> bool {
        const SOON_M: f64 = 3.0;
        const ROUNDING_M: f64 = 1e-6;
        let stop = request.committed.trajectory.last().path;
        // On the rim the car's own errors would decide.
        let rim_m = (stop.position - request.goal.position).norm() - self.inside_goal_m(request);
        rim_m <= ROUNDING_M && stop.s_m - here.s_m < SOON_M
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
}

impl Branch {
    fn pose(&self) -> Pose {
        Pose { position: self.point.position, heading_rad: self.point.heading_rad }
    }
}
