//! The executable part of a plan: where it stops, how fast it is driven, and its certificate.

use super::lap::Lap;
use super::shape::Candidate;
use super::{Planner, Policy, SHORTEST_EDGE_M, SHORTEST_PLAN_M, StopRule};
use crate::frames::Pose;
use crate::map::Grid;
use crate::plan::certify::{
    EscapeRule, Limits, StartTolerance, Surfaces, certify, check_start, clear_length_m, has_escape,
    last_stop, leads_on,
};
use crate::plan::impasse::Courage;
use crate::plan::request::{Plan, PlanRequest, Rejection, StepTimes};
use crate::plan::speed::{End, SLOWEST_CAP_MPS, SpeedLimits, SpeedTask};
use crate::plan::{Path, PathPoint, Trajectory};

/// So many ways on, one after the other, a bold stop must leave: one may end before a wall, two in
/// a nook.
pub(super) const WAYS_ON: u32 = 4;
/// Deceleration towards a lower speed that was asked for, m/s^2.
const SLOW_DOWN_MPS2: f64 = 2.0;

/// For how long a plan could go on at each of its speeds before it had to brake for its stop.
#[derive(Clone, Copy, Debug)]
pub(super) struct Caution {
    for_s: f64,
    /// Up to this speed it need not.
    above_mps: f64,
}

impl Caution {
    /// Brakes at the last moment.
    pub(super) const NONE: Self = Self { for_s: 0.0, above_mps: 0.0 };
}

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
        let (stop_m, caution) = if candidate.reaches_goal && clear_m >= path.length_m() {
            (clear_m, Caution::NONE)
        } else {
            (self.stop_m(&request.grid, path, clear_m), self.caution())
        };
        times.certify += lap.take(&self.clock);
        self.finish(request, path, stop_m, caution, times)
    }

    /// What a stop on the way asks for.
    const fn caution(&self) -> Caution {
        let plan = &self.params.plan;
        if self.relies || matches!(plan.policy, Policy::KnownMap) {
            return Caution::NONE;
        }
        Caution { for_s: plan.caution_s, above_mps: plan.caution_above_mps }
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
        caution: Caution,
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
        let wished = caps_mps(&executable.points, start_speed_mps, request.speed_cap_mps);
        let caps = with_caution(&executable.points, &limits, caution, wished);
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

/// The caps lowered to where the car could still go on for as long as `caution` says before it brakes
/// fully and comes to rest at the path's end.
fn with_caution(
    path: &[PathPoint],
    limits: &SpeedLimits,
    caution: Caution,
    caps_mps: Option<Vec<f64>>,
) -> Option<Vec<f64>> {
    let Caution { for_s, above_mps } = caution;
    if for_s <= 0.0 || above_mps >= limits.speed_max_mps {
        return caps_mps;
    }
    let brake = limits.accel_limit_mps2.min(limits.brake_max_mps2);
    let end_m = path.last()?.s_m;
    let mut caps_mps = caps_mps.unwrap_or_else(|| vec![f64::INFINITY; path.len()]);
    for (cap, p) in caps_mps.iter_mut().zip(path) {
        // v for_s + v^2 / (2 brake) = what is left
        let left_m = end_m - p.s_m;
        let careful = brake * ((for_s * for_s + 2.0 * left_m / brake).sqrt() - for_s);
        *cap = cap.min(careful.max(above_mps).max(SLOWEST_CAP_MPS));
    }
    Some(caps_mps)
}

#[cfg(test)]
mod tests {
    use super::super::exits::tests::{fill, planner, request};
    use super::*;
    use crate::frames::Point;
    use crate::map::Cell;
    use crate::plan::TrajectoryPoint;
    use crate::plan::request::{Planning, Verdict};
    use crate::plan::speed::{SpeedParams, SpeedProfiler};
    use crate::plan::test_paths::{hairpins, straight};
    use crate::predict::NoPrediction;
    use crate::vehicle::VehicleParams;

    fn limits() -> SpeedLimits {
        let speed = SpeedParams { speed_max_mps: 8.0, ..SpeedParams::default() };
        SpeedLimits::new(&speed, &VehicleParams::default())
    }

    const fn always(for_s: f64) -> Caution {
        Caution { for_s, above_mps: 0.0 }
    }

    /// Metres that are left at each sample after going on for as long as that and braking fully.
    fn spare_m(path: &Path, limits: &SpeedLimits, caution: Caution, start_mps: f64) -> Vec<f64> {
        let caps = with_caution(&path.points, limits, caution, None);
        let task =
            SpeedTask { start_speed_mps: start_mps, end: End::Rest, caps_mps: caps.as_deref() };
        let mut driven = Vec::new();
        SpeedProfiler::new().profile(&path.points, limits, &task, &mut driven).unwrap();
        spare_of(&driven, limits, caution.for_s)
    }

    fn spare_of(driven: &[TrajectoryPoint], limits: &SpeedLimits, for_s: f64) -> Vec<f64> {
        let end_m = driven.last().unwrap().path.s_m;
        let needed_m = |v: f64| v * for_s + v * v / (2.0 * limits.accel_limit_mps2);
        driven.iter().map(|p| end_m - p.path.s_m - needed_m(p.speed_mps)).collect()
    }

    /// The least that is spare above 4 m/s in the plan of a car that stands at one end of a hall whose
    /// other end it has not seen, with 0.15 s of caution.
    fn spare_in_hall_m(change: impl Fn(&mut Planner)) -> f64 {
        let mut grid = Grid::new(0.1);
        fill(&mut grid, -1..141, -1..41, Cell::Occupied);
        fill(&mut grid, 0..140, 0..40, Cell::Unknown);
        fill(&mut grid, 0..100, 0..40, Cell::Free);
        let ask = request(grid, Pose::new(1.0, 2.0, 0.0), Point::new(13.5, 2.0));
        let mut planner = planner(Policy::MapPredictive, Box::new(NoPrediction));
        planner.params.speed.speed_max_mps = 8.0;
        change(&mut planner);
        let Verdict::Plan(plan) = planner.step(&ask).verdict else { panic!("no plan") };
        let limits = SpeedLimits::new(&planner.params.speed, &planner.params.vehicle);
        let driven = &plan.trajectory.points;
        let fast = driven.iter().zip(spare_of(driven, &limits, 0.15));
        let fast: Vec<f64> =
            fast.filter(|(p, _)| p.speed_mps > 4.001).map(|(_, spare_m)| spare_m).collect();
        assert!(fast.len() > 20, "{} fast samples", fast.len());
        fast.into_iter().fold(f64::INFINITY, f64::min)
    }

    #[test]
    fn plans_into_the_unseen_are_cautious_and_others_are_not() {
        assert!(spare_in_hall_m(|_| {}) >= -1e-3);
        assert!(spare_in_hall_m(|planner| planner.params.plan.caution_s = 0.0) < -0.1);
        assert!(spare_in_hall_m(|planner| planner.params.plan.caution_above_mps = 8.0) < -0.1);
        assert!(spare_in_hall_m(|planner| planner.params.plan.policy = Policy::KnownMap) < -0.1);
    }

    #[test]
    fn a_planner_whose_shapes_rely_on_something_foreseen_is_not_cautious() {
        let mut planner = planner(Policy::MapPredictive, Box::new(NoPrediction));
        assert_eq!(planner.caution().for_s, 0.15);
        planner.relies = true;
        assert_eq!(planner.caution().for_s, 0.0);
    }

    #[test]
    fn a_cautious_plan_could_go_on_for_a_while_before_it_had_to_brake() {
        let at = Pose::new(0.0, 0.0, 0.0);
        for path in [straight(at, 7.0, 0.05), hairpins(at, 9.0, 1.6, 0.05)] {
            let spare_m = spare_m(&path, &limits(), always(0.3), 2.0);
            assert!(spare_m.iter().all(|spare_m| *spare_m >= -1e-3), "{spare_m:?}");
            // And no slower than that: somewhere nothing is spare.
            let moving = &spare_m[..spare_m.len() - 4];
            assert!(moving.iter().any(|spare_m| *spare_m < 1e-3), "{spare_m:?}");
        }
    }

    #[test]
    fn a_car_that_is_too_fast_for_caution_brakes_until_it_is_cautious() {
        // 4.2 m at full braking from 8 m/s, with 1.2 m of caution before.
        let path = straight(Pose::new(0.0, 0.0, 0.0), 5.0, 0.05);
        let spare_m = spare_m(&path, &limits(), always(0.15), 8.0);
        assert!(spare_m[0] < 0.0, "{spare_m:?}");
        let cautious = spare_m.iter().position(|spare_m| *spare_m >= -1e-3).unwrap();
        assert!(cautious < spare_m.len() - 4, "{spare_m:?}");
        assert!(spare_m[cautious..].iter().all(|spare_m| *spare_m >= -1e-3), "{spare_m:?}");
    }

    #[test]
    fn caution_lowers_the_caps_that_are_asked_for_and_raises_none() {
        let path = straight(Pose::new(0.0, 0.0, 0.0), 6.0, 0.05).points;
        let asked: Vec<f64> = path.iter().map(|p| 1.0 + p.s_m).collect();
        assert_eq!(with_caution(&path, &limits(), Caution::NONE, None), None);
        assert_eq!(
            with_caution(&path, &limits(), Caution::NONE, Some(asked.clone())),
            Some(asked.clone())
        );
        let alone = with_caution(&path, &limits(), always(0.2), None).unwrap();
        let both = with_caution(&path, &limits(), always(0.2), Some(asked.clone())).unwrap();
        for ((both, alone), asked) in both.iter().zip(&alone).zip(&asked) {
            assert_eq!(*both, alone.min(*asked));
        }
        // A slow car needs none.
        let slow = with_caution(&path, &limits(), Caution { for_s: 0.2, above_mps: 4.0 }, None);
        for (slow, alone) in slow.unwrap().iter().zip(&alone) {
            assert_eq!(*slow, alone.max(4.0));
        }
        let never = Caution { for_s: 0.2, above_mps: 8.0 };
        assert_eq!(with_caution(&path, &limits(), never, None), None);
        // Weaker brakes ask for more room.
        let weak = SpeedLimits { brake_max_mps2: 3.0, ..limits() };
        assert!(with_caution(&path, &weak, always(0.2), None).unwrap()[0] < alone[0]);
    }
}
