//! The plan being driven and the one that is about to take over.
//!
//! Plan or keep (P11): a new plan replaces the old one at its take-over time or not at all, and the
//! old one always ends at rest inside space that was known free when it was certified.

use std::sync::Arc;

use crate::frames::Pose;
use crate::plan::{Plan, Trajectory, TrajectoryPoint};
use crate::time::Instant;

/// So much of the way behind a plan's start is kept with it, metres. A car that lags behind its plan
/// is still on the old one's path when the new one takes over; without it the new path would be
/// carried back from its start as it bends there, which led the car up to 4 cm astray at 8 m/s.
const WAY_BEHIND_M: f64 = 0.5;
/// Samples are no closer than this, metres.
const SHORTEST_EDGE_M: f64 = 1e-3;

/// The committed plan and its successor.
#[derive(Clone, Debug)]
pub struct Committed {
    current: Arc<Plan>,
    next: Option<Arc<Plan>>,
    /// When `next` takes over.
    takes_over: Instant,
}

impl Committed {
    /// Standing still.
    pub fn standing(now: Instant, pose: Pose) -> Self {
        Self { current: Arc::new(Plan::standing(now, pose)), next: None, takes_over: now }
    }

    /// The plan being driven.
    pub const fn current(&self) -> &Arc<Plan> {
        &self.current
    }

    /// The plan whose take-over is pending.
    pub const fn next(&self) -> Option<&Arc<Plan>> {
        self.next.as_ref()
    }

    /// When the pending plan takes over.
    pub fn pending_from(&self) -> Option<Instant> {
        self.next.as_ref().map(|_| self.takes_over)
    }

    /// The plan that will be driven at the end of all that is decided.
    pub fn newest(&self) -> &Arc<Plan> {
        self.next.as_ref().unwrap_or(&self.current)
    }

    /// Accepts a plan that starts on the current one at its own start time.
    pub fn schedule(&mut self, mut plan: Plan) {
        self.takes_over = plan.trajectory.start;
        let before_m = plan.trajectory.last().path.s_m;
        plan.trajectory = with_way_behind(&self.newest().trajectory, plan.trajectory);
        // The imagined part goes on counting where the executable one ends.
        let behind_m = plan.trajectory.last().path.s_m - before_m;
        for point in &mut plan.beyond.points {
            point.s_m += behind_m;
        }
        self.next = Some(Arc::new(plan));
    }

    /// Lets a pending plan take over once its time has come; says whether it did.
    pub fn promote(&mut self, now: Instant) -> bool {
        match self.next.take() {
            Some(plan) if self.takes_over <= now => {
                self.current = plan;
                true
            }
            pending => {
                self.next = pending;
                false
            }
        }
    }

    /// Drops both for another plan at once.
    pub fn replace(&mut self, plan: Plan) {
        self.current = Arc::new(plan);
        self.next = None;
    }

    /// Shifts everything that is decided by `seconds` (positive: later). Same path, same speed at
    /// each place.
    pub fn retime(&mut self, seconds: f64) {
        let shift = |plan: &mut Arc<Plan>| {
            let trajectory = &mut Arc::make_mut(plan).trajectory;
            trajectory.start = trajectory.start.offset_by(seconds);
        };
        shift(&mut self.current);
        self.next.iter_mut().for_each(shift);
    }

    /// Forgets the pending plan.
    pub fn drop_next(&mut self) {
        self.next = None;
    }

    /// State on the committed plan.
    pub fn at(&self, now: Instant) -> TrajectoryPoint {
        match &self.next {
            Some(next) if self.takes_over <= now => next.trajectory.at(now),
            _ => self.current.trajectory.at(now),
        }
    }

    /// Whether all that is decided has been driven to its end.
    pub fn is_finished(&self, now: Instant) -> bool {
        let plan = &self.newest().trajectory;
        now.seconds_after(plan.start) >= plan.duration_s()
    }
}

/// A trajectory with the last stretch of the one that it continues before its start. What is asked
/// of it at any moment from its start on stays the same.
fn with_way_behind(old: &Trajectory, new: Trajectory) -> Trajectory {
    let takes_over_s = new.start.seconds_after(old.start);
    if takes_over_s <= 0.0 || takes_over_s >= old.duration_s() {
        return new; // from rest
    }
    let here = old.at_time(takes_over_s).path.s_m;
    let kept = |p: &&TrajectoryPoint| {
        p.path.s_m >= here - WAY_BEHIND_M && p.path.s_m <= here - SHORTEST_EDGE_M
    };
    let mut points: Vec<TrajectoryPoint> = old.points.iter().filter(kept).copied().collect();
    let Some(first) = points.first().copied() else { return new };
    for point in &mut points {
        point.path.s_m -= first.path.s_m;
        point.t_s -= first.t_s;
    }
    // The edge that leads to the new start.
    let (last, start) = (points.len() - 1, &new.points[0]);
    let length = here - first.path.s_m;
    let ds = length - points[last].path.s_m;
    let (v0, v1) = (points[last].speed_mps, start.speed_mps);
    points[last].accel_mps2 = (v1 * v1 - v0 * v0) / (2.0 * ds);
    let duration = points[last].t_s + 2.0 * ds / (v0 + v1);
    points.extend(new.points.iter().map(|p| {
        let mut p = *p;
        p.path.s_m += length;
        p.t_s += duration;
        p
    }));
    Trajectory { start: new.start.offset_by(-duration), points }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::PathPoint;

    /// Straight along x from `x_m`, from one speed to rest.
    fn stop(number: u32, start: Instant, x_m: f64, speed_mps: f64, length_m: f64) -> Plan {
        let accel = -speed_mps * speed_mps / (2.0 * length_m);
        let points = (0..=20)
            .map(|i| {
                let s_m = length_m * f64::from(i) / 20.0;
                let speed = (speed_mps * speed_mps + 2.0 * accel * s_m).max(0.0).sqrt();
                let pose = Pose::new(x_m + s_m, 0.0, 0.0);
                let path =
                    PathPoint { s_m, position: pose.position, heading_rad: 0.0, curvature_pm: 0.0 };
                let t_s = (speed - speed_mps) / accel;
                TrajectoryPoint { path, t_s, speed_mps: speed, accel_mps2: accel }
            })
            .collect();
        Plan { number, trajectory: Trajectory { start, points }, ..Plan::standing(start, pose0()) }
    }

    fn pose0() -> Pose {
        Pose::new(0.0, 0.0, 0.0)
    }

    #[test]
    fn a_plan_keeps_the_way_behind_it_and_says_the_same_from_its_start_on() {
        let begin = Instant::from_nanos(1_000_000_000);
        let old = stop(1, begin, 0.0, 4.0, 2.0);
        let mut committed = Committed::standing(Instant::ZERO, pose0());
        committed.replace(old.clone());
        let over = begin.offset_by(0.2);
        let there = old.trajectory.at(over);
        let mut new = stop(2, over, there.path.position.x, there.speed_mps, 3.0);
        let imagined = new.trajectory.at_distance(3.0).path;
        new.beyond.points.push(PathPoint {
            s_m: 3.25,
            position: imagined.position + crate::frames::Vector::new(0.25, 0.0),
            ..imagined
        });
        committed.schedule(new.clone());
        assert!(!committed.promote(over.offset_by(-1e-3)));
        assert!(committed.promote(over));
        let driven = &committed.current().trajectory;
        for k in 0..100 {
            let at = over.offset_by(0.01 * f64::from(k));
            let (a, b) = (driven.at(at), new.trajectory.at(at));
            assert!((a.path.position - b.path.position).norm() < 1e-7, "{k}");
            assert!((a.speed_mps - b.speed_mps).abs() < 1e-7, "{k}");
        }
        for k in 1..10 {
            let at = over.offset_by(-0.01 * f64::from(k));
            let (a, b) = (driven.at(at), old.trajectory.at(at));
            assert!((a.path.position - b.path.position).norm() < 1e-6, "{k}: {a:?} {b:?}");
        }
        let behind = there.path.position.x - driven.points[0].path.position.x;
        assert!(behind > 0.35 && behind <= WAY_BEHIND_M, "{behind}");
        let ordered = |w: &[TrajectoryPoint]| w[1].t_s > w[0].t_s && w[1].path.s_m > w[0].path.s_m;
        assert!(driven.points.windows(2).all(ordered));
        let gap_m = committed.current().beyond.points[0].s_m - driven.last().path.s_m;
        assert!((gap_m - 0.25).abs() < 1e-9, "the imagined part starts {gap_m} m behind the end");
    }

    #[test]
    fn a_plan_from_rest_has_nothing_behind_it() {
        let begin = Instant::from_nanos(1_000_000_000);
        let mut committed = Committed::standing(Instant::ZERO, pose0());
        let new = stop(2, begin, 0.0, 1.0, 3.0);
        committed.schedule(new.clone());
        assert!(committed.promote(begin));
        assert_eq!(**committed.current(), new);
    }
}
