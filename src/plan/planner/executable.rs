//! The executable part of a plan: where it stops, how fast it is driven, and its certificate.

use super::lap::Lap;
use super::shape::Candidate;
use super::{Planner, SHORTEST_EDGE_M, SHORTEST_PLAN_M, StopRule};
use crate::frames::Pose;
use crate::map::Grid;
use crate::plan::certify::{
    EscapeRule, Limits, StartTolerance, Surfaces, certify, check_start, clear_length_m, has_escape,
    last_stop, leads_on,
};
use crate::plan::impasse::Courage;
use crate::plan::request::{Plan, PlanRequest, Rejection, StepTimes};
use crate::plan::speed::{End, SpeedLimits, SpeedTask};
use crate::plan::{Path, PathPoint, Trajectory};

/// So many ways on, one after the other, a bold stop must leave: one may end before a wall, two in
/// a nook.
pub(super) const WAYS_ON: u32 = 4;
/// Deceleration towards a lower speed that was asked for, m/s^2.
const SLOW_DOWN_MPS2: f64 = 2.0;

impl Planner {
    /// The candidate's executable part with speeds and certificate.
    pub(super) fn certified(
        &mut self,
        request: &PlanRequest,
        candidate: &Candidate,
        times: &mut StepTimes,
    ) -> Result<Plan, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let path = &candidate.path;
        let keep_m = self.keep_m();
        let seen = self.not_seen();
        let clear_m = clear_length_m(&request.grid, &path.points, keep_m, seen);
        let stop_m = if candidate.reaches_goal && clear_m >= path.length_m() {
            clear_m
        } else {
            self.stop_m(&request.grid, path, clear_m)
        };
        times.certify += lap.take(&self.clock);
        self.finish(request, path, stop_m, times)
    }

    /// How near to the goal a path ends, metres.
    pub(super) fn inside_goal_m(&self, request: &PlanRequest) -> f64 {
        (request.goal.radius_m - self.params.plan.goal_depth_m).max(0.05)
    }

    /// Ends the path inside the goal disc; says whether it gets there.
    pub(super) fn end_at_goal(&self, request: &PlanRequest, path: &mut Path) -> bool {
        let goal = request.goal;
        let inside_m = self.inside_goal_m(request);
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
        let points = &path.points;
        let (hoped_rule, seen_rule) =
            (self.escape_rule(Surfaces::Occupied), self.escape_rule(self.not_seen()));
        let escapable = |rule| last_stop(points, clear_m, |pose| has_escape(grid, pose, rule));
        let stop = match self.params.plan.stop_rule {
            StopRule::Optimistic => escapable(&hoped_rule),
            StopRule::Seen => escapable(&seen_rule),
            StopRule::TurnRound => self.last_turnable(grid, points, clear_m, self.not_seen()),
        };
        let courage = self.impasses.courage();
        let hopeful_stop = || self.last_turnable(grid, points, clear_m, Surfaces::Occupied);
        let bold_stop =
            || last_stop(points, clear_m, |pose| leads_on(grid, pose, &seen_rule, WAYS_ON));
        let progress = |s_m: &f64| *s_m >= SHORTEST_PLAN_M;
        stop.filter(progress)
            .or_else(|| (courage >= Courage::Hopeful).then(hopeful_stop).flatten().filter(progress))
            .or_else(|| (courage >= Courage::Bold).then(bold_stop).flatten())
            .unwrap_or(0.0)
    }

    /// What a stop must leave open at the least.
    pub(super) fn escape_rule(&self, surfaces: Surfaces) -> EscapeRule {
        EscapeRule::new(&self.params.certify, &self.params.vehicle, surfaces)
    }

    /// Cuts the path at the stop, sets speeds, and has it certified.
    pub(super) fn finish(
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

/// The speed that is not to be exceeded at each sample. A car that is faster slows down gently.
fn caps_mps(path: &[PathPoint], start_speed_mps: f64, cap_mps: f64) -> Option<Vec<f64>> {
    let begin_m = path.first()?.s_m;
    let cap = |p: &PathPoint| {
        let left = start_speed_mps * start_speed_mps - 2.0 * SLOW_DOWN_MPS2 * (p.s_m - begin_m);
        left.max(0.0).sqrt().max(cap_mps)
    };
    cap_mps.is_finite().then(|| path.iter().map(cap).collect())
}
