//! The policies `janson` and `janson-lite`: weigh exits from known space by the time of arrival.
//!
//! After Janson, Hu and Pavone, "Safe motion planning in unknown environments: optimality
//! benchmarks and tractable policies" (2018, arXiv 1804.05804), as it can be made out: every exit
//! from known space gets a path of its own, through known space to the exit and on to the goal as
//! if the unknown were free (or at the price that a prediction puts on it); the path is shaped like
//! any other; and the exit with the least time of arrival wins. That a car must be able to stop
//! within what it knows is left to the plan that is made of the winner, as with every other
//! policy; it costs the candidates only what they will not have seen in time
//! ([`Visibility`]).

use super::exits::{Aim, Sampling, WayOut};
use super::shape::{Bends, Candidate};
use super::ways::leaves_heading;
use super::{Branch, Planner, Policy};
use crate::frames::{Point, Vector};
use crate::map::{Clearance, Grid};
use crate::plan::request::{PlanRequest, StepTimes};
use crate::plan::search::Guide;
use crate::plan::visibility::{Sight, Visibility};
use crate::predict::OccupancyView;
use crate::time::Instant;
use crate::tunables;

tunables! {
    /// How the policies `janson` and `janson-lite` weigh exits from known space.
    pub struct JansonParams in "janson" {
        /// How far the lidar is taken to see when a view is imagined.
        sight_m: f64 = 7.5, live, in 0.5..=100.0, "m";
        /// With `janson-lite`: weight of the time to turn from the direction of arrival at an exit
        /// into that of going on.
        arrival_weight: f64 = 1.0, live, in 0.0..=10.0, "";
    }
}

/// A shaped path may be this much shorter than the polyline that it follows, metres.
const SHORTCUT_M: f64 = 1.0;
/// Directions before and behind an exit are taken over this, metres.
const DIRECTION_M: f64 = 1.0;
/// Time between scans until two have come, seconds.
const PERIOD_S: f64 = 0.05;
/// A longer time between two requests is a pause, seconds.
const PERIOD_MAX_S: f64 = 1.0;

/// An exit and the time of arrival through it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Weighed {
    pub(super) aim: Aim,
    pub(super) cost_s: f64,
}

/// What weighing keeps from step to step.
#[derive(Debug, Default)]
pub(super) struct Weigher {
    visibility: Visibility,
    /// This step's candidates that were shaped and timed.
    pub(super) weighed: Vec<Weighed>,
    /// When the last request's scan was measured.
    scan_stamp: Option<Instant>,
    period_s: Option<f64>,
    points: Vec<Point>,
    answers: Vec<f32>,
}

impl Weigher {
    /// Takes note of the time between scans.
    fn keep_time(&mut self, scan_stamp: Instant) {
        let since = self.scan_stamp.map(|last| scan_stamp.seconds_after(last));
        self.scan_stamp = Some(scan_stamp);
        if let Some(period_s) = since.filter(|s| *s > 0.0 && *s <= PERIOD_MAX_S) {
            self.period_s = Some(period_s);
        }
    }

    /// How old what the car acts upon gets until the next plan takes over, seconds.
    fn age_s(&self, request: &PlanRequest) -> f64 {
        let latency_s = request.takes_over.seconds_after(request.scan_stamp).max(0.0);
        latency_s + self.period_s.unwrap_or(PERIOD_S)
    }
}

impl Planner {
    /// The exit with the earliest arrival and the way through it; `None` if no candidate can be
    /// driven.
    pub(super) fn best_weighed(
        &mut self,
        request: &PlanRequest,
        branches: &[Branch],
        times: &mut StepTimes,
        candidates: &mut u32,
    ) -> Option<WayOut> {
        self.weigher.keep_time(request.scan_stamp);
        self.weigher.weighed.clear();
        self.hopes = self.is_blind(&request.grid);
        let mut ways = self.ways_out(request, &branches[0], Sampling::Spread, times);
        // The most promising ones first: what cannot be faster than the best one so far need not
        // be shaped.
        ways.sort_by(|a, b| a.guide.length_m.total_cmp(&b.guide.length_m));
        let speed_max_mps = self.params.speed.speed_max_mps;
        let (mut costs, mut best_s) = (Vec::new(), f64::INFINITY);
        for (i, way) in ways.iter().enumerate() {
            let least_s = (way.guide.length_m - SHORTCUT_M) / speed_max_mps;
            if least_s >= best_s + self.doubt_s(way) {
                break;
            }
            *candidates += 1;
            let cost_s = self.weigh(request, branches, way.aim, &way.guide, times);
            let Some(cost_s) = cost_s else { continue };
            self.weigher.weighed.push(Weighed { aim: way.aim, cost_s });
            costs.push((i, cost_s));
            best_s = best_s.min(cost_s);
        }
        let chosen = self.choose(request, &ways, &costs)?;
        Some(ways.swap_remove(chosen))
    }

    /// Whether nothing is foreseen anywhere.
    fn is_blind(&mut self, grid: &Grid) -> bool {
        let (bounds, side) = (grid.bounds(), grid.resolution_m());
        let border = Vector::repeat(self.params.search.border_m);
        let corner = |x: i32, y: i32| Point::new(f64::from(x) * side, f64::from(y) * side);
        let low = corner(bounds.x0, bounds.y0) - border;
        let high = corner(bounds.x1, bounds.y1) + border;
        self.predictor.view(&self.clock).silent(low, high)
    }

    /// Seconds until the car could be at the goal along a way, if it can be driven.
    fn weigh(
        &mut self,
        request: &PlanRequest,
        branches: &[Branch],
        aim: Aim,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Option<f64> {
        let here = branches[0];
        let old = self.old_way(request, guide);
        let goes_on = old.as_ref().is_some_and(|old| old.follows.is_some());
        let mut driven_s = None;
        if goes_on || !leaves_heading(here.pose(), guide, self.params.manoeuvre.skip_turn_rad) {
            let mut tries = vec![Bends::AsCommitted];
            if here.speed_mps > 0.0 {
                tries.push(Bends::AsSpeedAllows);
            }
            for bends in tries {
                let way = self.straight_on(request, guide, old.as_ref());
                let shaped = self.shaped(request, &here, way, bends, times);
                driven_s = shaped.ok().and_then(|shape| self.time(request, &shape));
                if driven_s.is_some() {
                    break;
                }
            }
        }
        if driven_s.is_none() && !(goes_on && here.speed_mps > 0.0) {
            driven_s = self.time_turning(request, branches, aim, guide, times);
        }
        let mut cost_s = driven_s?;
        if self.params.plan.policy == Policy::JansonLite {
            cost_s += self.arrival_s(request, aim, guide);
        }
        if !self.hopes {
            cost_s += self.penalty_s(request, guide);
        }
        Some(cost_s)
    }

    /// Seconds along a shape, at speeds from which the car can stop within what it will have seen.
    fn time(&mut self, request: &PlanRequest, shape: &Candidate) -> Option<f64> {
        if self.params.plan.policy == Policy::JansonLite {
            return self.cost_s(request, shape, None);
        }
        let known = &*request.grid;
        let grid = if self.foreseen.is_silent() { known } else { self.foreseen.grid() };
        let sight = Sight {
            grid,
            known: Clearance::new(known, &self.blocked),
            radius_m: self.keep_m(),
            range_m: self.params.janson.sight_m,
            age_s: self.weigher.age_s(request),
            brake_mps2: (self.params.speed.friction_use
                * self.params.vehicle.acceleration_limit_mps2())
            .min(self.params.speed.brake_max_mps2),
            speed_max_mps: self.params.speed.speed_max_mps,
        };
        let mut visibility = std::mem::take(&mut self.weigher.visibility);
        let caps_mps = visibility.caps_mps(&shape.path.points, &sight);
        let cost_s = self.cost_s(request, shape, Some(caps_mps));
        self.weigher.visibility = visibility;
        cost_s
    }

    /// Seconds along a way that begins with turning off, from whichever branch that is fastest.
    fn time_turning(
        &mut self,
        request: &PlanRequest,
        branches: &[Branch],
        aim: Aim,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Option<f64> {
        let mut least_s: Option<f64> = None;
        for branch in branches {
            let guide = if branch.s_m == branches[0].s_m {
                guide.clone()
            } else {
                let Ok(guide) = self.guide(request, branch, aim, times) else { continue };
                guide
            };
            let shaped = self
                .with_manoeuvre(request, branch, &guide, times)
                .and_then(|way| self.shaped(request, branch, way, Bends::AsCommitted, times));
            let driven_s = shaped.ok().and_then(|shape| self.time(request, &shape));
            least_s = [least_s, driven_s].into_iter().flatten().reduce(f64::min);
        }
        least_s
    }

    /// With `janson-lite`: seconds to turn from the direction in which a way arrives at its exit
    /// into the one in which it goes on, at the fastest turn of the tyres.
    fn arrival_s(&self, request: &PlanRequest, aim: Aim, guide: &Guide) -> f64 {
        let Aim::Through(exit) = aim else { return 0.0 };
        let exit = request.grid.centre(exit);
        let nearest = |i: &usize| (guide.points[*i] - exit).norm_squared();
        let at = (0..guide.points.len()).min_by(|a, b| nearest(a).total_cmp(&nearest(b)));
        let Some(at) = at else { return 0.0 };
        let exit = guide.points[at];
        let far = |p: &&Point| (**p - exit).norm() >= DIRECTION_M;
        let before = guide.points[..at].iter().rev().find(far).or(guide.points.first());
        let behind = guide.points[at..].iter().find(far).or(guide.points.last());
        let turn_rad = before.zip(behind).map_or(0.0, |(before, behind)| {
            let (arrives, goes_on) = (exit - before, behind - exit);
            arrives.perp(&goes_on).atan2(arrives.dot(&goes_on)).abs()
        });
        let vehicle = &self.params.vehicle;
        let fastest_radps = (vehicle.acceleration_limit_mps2() / vehicle.turn_radius_m).sqrt();
        self.params.janson.arrival_weight * turn_rad / fastest_radps
    }

    /// What the search charges for the unknown space along a way, seconds.
    fn penalty_s(&mut self, request: &PlanRequest, guide: &Guide) -> f64 {
        let Weigher { points, answers, .. } = &mut self.weigher;
        let middles = guide.points.windows(2).map(|w| nalgebra::center(&w[0], &w[1]));
        points.clear();
        points.extend(middles);
        answers.clear();
        answers.resize(points.len(), 0.5);
        self.predictor.view(&self.clock).occupied(points, answers);
        let grid = &request.grid;
        let params = &self.params.search;
        let pieces = guide.points.windows(2).zip(points.iter().zip(&*answers));
        let unknown = pieces.filter(|(_, (middle, _))| {
            grid.get(grid.cell_at(**middle)) == crate::map::Cell::Unknown
        });
        unknown
            .map(|(ends, (_, phi))| {
                let phi = f64::from(*phi).clamp(0.0, 1.0);
                (ends[1] - ends[0]).norm() * params.alpha / (1.0 - phi + params.eps)
            })
            .sum()
    }
}
