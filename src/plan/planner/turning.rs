//! Turning round: where a plan may stop so that the car can, and doing so where nothing else is
//! left.

use super::executable::{Caution, WAYS_ON};
use super::exits::Aim;
use super::shape::Candidate;
use super::ways::{aside_rad, leaves_heading, with_transitions};
use super::{Branch, Planner};
use crate::frames::{Point, Pose};
use crate::map::{Clearance, Grid};
use crate::plan::certify::{Surfaces, clear_length_m, escapes, leads_on};
use crate::plan::impasse::Courage;
use crate::plan::path::at_distance;
use crate::plan::request::{Plan, PlanRequest, StepTimes};
use crate::plan::search::{Guide, ManoeuvreParams, ManoeuvreQuery, arcs_path, retreat};
use crate::plan::{Path, PathPoint};
use crate::time::Instant;

/// Kept beyond what the certificate asks for, metres: what lies between two samples is nearer to
/// corners than they are, and bulges over the chord. More where a stop is chosen than where the
/// turn is driven, so that rounding cannot turn the answer round.
const STOP_SPARE_M: f64 = 0.005;
const TURN_SPARE_M: f64 = 0.002;
/// The search for a manoeuvre may take this many times as long: the car stands.
const PATIENCE: u32 = 4;
/// A guide that starts out farther to the side than this leads back.
const BEHIND_RAD: f64 = std::f64::consts::FRAC_PI_2;
/// The tracks that the car may turn back onto: their length, and distances between poses, metres.
const TRACKS_M: f64 = 3.0;
const TRACK_STEP_M: f64 = 0.3;
/// Tracks are remembered by points this far apart, metres.
const MEMORY_STEP_M: f64 = 0.1;
/// A car that is suddenly this far from its tracks has been put down elsewhere, metres.
const JUMP_M: f64 = 0.5;
/// An alternative that takes this much longer is tried only after the direct way has been hoped
/// for, seconds. With less the car hopes itself into dead ends that it does not get out of; with
/// much more it looks into every corner of a furnished floor.
const DETOUR_S: f64 = 5.0;
/// Farther ahead much may change before the car gets there, metres.
const NEAR_M: f64 = 3.0;
/// Narrow places are not looked for nearer than this, metres: where the car stands is no place to
/// blame.
const TIGHT_FROM_M: f64 = 0.7;
/// From a manoeuvre's beginning that is shorter than this no more would be seen, metres.
const GLIMPSE_M: f64 = 0.1;
/// Stops are looked for at steps of this length, metres.
const STOP_STEP_M: f64 = 0.1;

/// Where the car has been.
#[derive(Clone, Debug, Default)]
pub(super) struct Tracks {
    poses: Vec<Pose>,
    until: Instant,
    driven_m: f64,
}

impl Tracks {
    /// Adds what the car drives until the take-over.
    pub(super) fn follow(&mut self, request: &PlanRequest) {
        let committed = &request.committed.trajectory;
        let from_m = committed.at(self.until).path.s_m;
        let here = committed.at(request.takes_over).path;
        self.until = request.takes_over;
        self.driven_m += (here.s_m - from_m).max(0.0);
        let driven = committed.points.iter().map(|p| p.path);
        let driven = driven.filter(|p| p.s_m > from_m && p.s_m < here.s_m);
        for p in driven.chain(std::iter::once(here)) {
            let step_m = self.poses.last().map(|last| (p.position - last.position).norm());
            if step_m.is_some_and(|step_m| step_m > JUMP_M) {
                self.poses.clear();
            } else if step_m.is_some_and(|step_m| step_m < MEMORY_STEP_M) {
                continue;
            }
            self.poses.push(Pose { position: p.position, heading_rad: p.heading_rad });
        }
        let kept = 2 * (TRACKS_M / MEMORY_STEP_M) as usize;
        if self.poses.len() > 2 * kept {
            self.poses.drain(..self.poses.len() - kept);
        }
    }

    /// Metres driven since the planner began.
    pub(super) const fn driven_m(&self) -> f64 {
        self.driven_m
    }

    /// Poses behind a point of a path that the tracks lead to, the nearest first: the point itself,
    /// then back along the path and the tracks.
    fn behind(&self, path: &[PathPoint], from: &PathPoint) -> Vec<Pose> {
        let pose = |p: &PathPoint| Pose { position: p.position, heading_rad: p.heading_rad };
        let on_path = path.iter().rev().filter(|p| p.s_m < from.s_m).map(pose);
        let mut poses = vec![pose(from)];
        let (mut last, mut gone_m, mut stepped_m) = (poses[0], 0.0, 0.0);
        for pose in on_path.chain(self.poses.iter().rev().copied()) {
            let step_m = (pose.position - last.position).norm();
            (last, gone_m, stepped_m) = (pose, gone_m + step_m, stepped_m + step_m);
            if gone_m > TRACKS_M {
                break;
            }
            if stepped_m >= TRACK_STEP_M {
                poses.push(pose);
                stepped_m = 0.0;
            }
        }
        poses
    }
}

impl Planner {
    /// The largest arc length, not above `s_max_m`, at which a car that stops can turn back onto
    /// the way that it came by, clear of these.
    pub(super) fn last_turnable(
        &self,
        grid: &Grid,
        path: &[PathPoint],
        s_max_m: f64,
        surfaces: Surfaces,
    ) -> Option<f64> {
        let steps = 0..=(s_max_m / STOP_STEP_M) as u32;
        let mut stops = steps.map(|i| s_max_m - f64::from(i) * STOP_STEP_M);
        stops.find(|s_m| self.turns_back(grid, surfaces, path, *s_m))
    }

    /// Whether a car that stops there can turn back onto the way that it came by, clear of these.
    fn turns_back(&self, grid: &Grid, surfaces: Surfaces, path: &[PathPoint], s_m: f64) -> bool {
        let Some(stop) = at_distance(path, s_m) else { return false };
        let room = self.room(grid, surfaces, STOP_SPARE_M);
        let pose = Pose { position: stop.position, heading_rad: stop.heading_rad };
        let behind = self.tracks.behind(path, &stop);
        retreat(&room, pose, &behind, self.params.vehicle.turn_radius_m).is_some()
    }

    /// Whether the car can turn back where a plan stops.
    pub(super) fn is_stop_proven(&self, grid: &Grid, plan: &Plan) -> bool {
        let path: Vec<PathPoint> = plan.trajectory.points.iter().map(|p| p.path).collect();
        let stop_m = plan.trajectory.last().path.s_m;
        self.turns_back(grid, self.not_seen(), &path, stop_m)
    }

    /// For a car that stands and gets nowhere along its guide: closes the place that keeps it from
    /// going there if that costs little; otherwise takes courage.
    pub(super) fn try_another_way(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) {
        let car = here.point.position;
        let Some((place, proven)) = self.tight_place(&request.grid, guide) else {
            self.impasses.take_courage(car);
            return;
        };
        let mut cost_s = |planner: &mut Self| {
            planner.set_masks(request);
            planner
                .guide(request, here, Aim::Anywhere, times)
                .map_or(f64::INFINITY, |guide| guide.cost_s)
        };
        let before = self.impasses.clone();
        self.impasses.open();
        let direct_s = cost_s(self);
        self.impasses = before;
        let possible = self.impasses.close(car, place);
        let detour_s = cost_s(self) - direct_s;
        let far = detour_s > DETOUR_S
            && match self.impasses.courage() {
                Courage::Proven => true,
                Courage::Hopeful => proven,
                Courage::Bold => false,
            };
        if far || !possible {
            self.impasses.take_courage(car);
        }
    }

    /// The place near the car that keeps it from following a guide: where the guide first leaves
    /// proven room, else where it is narrowest, if the car cannot turn round there. And whether it
    /// is the latter, and so there is room beyond.
    fn tight_place(&self, grid: &Grid, guide: &Guide) -> Option<(Point, bool)> {
        let blocked = Clearance::new(grid, &self.blocked);
        let keep_m = self.keep_m();
        let from = guide.points.first()?;
        let near = guide.points.iter().take_while(|p| (*p - from).norm() <= NEAR_M);
        let near = near.map(|p| (*p, blocked.at(*p))).skip(1);
        if let Some((unproven, _)) = near.clone().find(|(_, clearance_m)| *clearance_m < keep_m) {
            return Some((unproven, false));
        }
        let narrow_m = keep_m + self.params.vehicle.turn_radius_m;
        let narrow = near.filter(|(p, _)| (p - from).norm() >= TIGHT_FROM_M);
        let narrowest = narrow.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|n| n.1 < narrow_m);
        narrowest.map(|(p, _)| (p, true))
    }

    /// A plan along a quarter turn or a run straight ahead through space that has been seen, the last
    /// resort of a bold car that has stood for long: away from a wall that it faces too closely for
    /// any other plan. Of several the one from whose end the most ways go on; of these, the one that
    /// ends facing the guide.
    pub(super) fn way_on(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Option<Plan> {
        if self.impasses.courage() != Courage::Bold || !self.impasses.is_lasting() {
            return None;
        }
        let rule = self.escape_rule(self.not_seen());
        let grid = &request.grid;
        let ways: Vec<_> = escapes(grid, here.pose(), &rule).collect();
        let best_of = |more: u32| {
            let ways = ways.iter().filter(|(_, end)| leads_on(grid, *end, &rule, more));
            let aside_rad = |end: Pose| aside_rad(end, guide).unwrap_or(0.0);
            ways.min_by(|a, b| aside_rad(a.1).total_cmp(&aside_rad(b.1)))
        };
        let (arc, _) = (0..=WAYS_ON).rev().find_map(best_of)?;
        let path = arcs_path(here.pose(), &[(arc.curvature_pm, arc.length_m)]);
        self.finish(request, &path, path.length_m(), Caution::NONE, times).ok()
    }

    /// The beginning of a manoeuvre onto the guide through space that is not known to be taken, as far
    /// as it has been seen to be free: for a bold car that has stood for long. From its end more is
    /// seen.
    pub(super) fn hoped_turn(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Option<Plan> {
        if self.impasses.courage() != Courage::Bold || !self.impasses.is_lasting() {
            return None;
        }
        let path = self.patient_manoeuvre(request, here, guide, Surfaces::Occupied)?;
        let seen_m = clear_length_m(&request.grid, &path.points, self.keep_m(), self.not_seen());
        if seen_m < GLIMPSE_M {
            return None;
        }
        self.finish(request, &path, seen_m, Caution::NONE, times).ok()
    }

    /// A standing car's manoeuvre onto the guide, clear of these, as tight as it can.
    fn patient_manoeuvre(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        guide: &Guide,
        surfaces: Surfaces,
    ) -> Option<Path> {
        let vehicle = &self.params.vehicle;
        let query = ManoeuvreQuery {
            pose: here.pose(),
            speed_mps: 0.0,
            guide,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: vehicle.acceleration_limit_mps2(),
        };
        let ordinary = &self.params.manoeuvre;
        let params = ManoeuvreParams {
            curvature_share: 1.0,
            effort: ordinary.effort * PATIENCE,
            ..ordinary.clone()
        };
        let mut search = std::mem::take(&mut self.manoeuvre);
        let found = search.find(&self.room(&request.grid, surfaces, TURN_SPARE_M), &query, &params);
        self.manoeuvre = search;
        let found = found.ok()??;
        found.joins_at.map(|_| with_transitions(&found.path))
    }

    /// A plan that turns the car towards the guide, or at least round.
    ///
    /// Other plans keep some room and some steering for smoothing. A stop, however, is chosen where
    /// the car can just turn round, and what has been promised there must be found again here.
    ///
    /// `None` where the guide leads straight on (unless it has failed for long), or there is no room.
    pub(super) fn turn_back(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Option<Plan> {
        let skip_turn_rad = self.params.manoeuvre.skip_turn_rad;
        let lasting = self.impasses.is_lasting();
        if !leaves_heading(here.pose(), guide, skip_turn_rad) && !lasting {
            return None;
        }
        if let Some(path) = self.patient_manoeuvre(request, here, guide, self.not_seen()) {
            let candidate = Candidate { path, reaches_goal: false, rest_m: 0.0 };
            if let Ok(plan) = self.certified(request, &candidate, times) {
                return Some(plan);
            }
        }
        if !leaves_heading(here.pose(), guide, BEHIND_RAD) && !lasting {
            return None;
        }
        let room = self.room(&request.grid, self.not_seen(), TURN_SPARE_M);
        let behind = self.tracks.behind(&[], &here.point);
        let path = retreat(&room, here.pose(), &behind, self.params.vehicle.turn_radius_m)?;
        let path: Path = with_transitions(&path);
        self.finish(request, &path, path.length_m(), Caution::NONE, times).ok()
    }
}

#[cfg(test)]
#[path = "turning_tests.rs"]
mod tests;
