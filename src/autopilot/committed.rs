//! The plan being driven and the one that is about to take over.
//!
//! Plan or keep (P11): a new plan replaces the old one at its take-over time or not at all, and the
//! old one always ends at rest inside space that was known free when it was certified.

use std::sync::Arc;

use crate::frames::Pose;
use crate::plan::{Plan, TrajectoryPoint};
use crate::time::Instant;

/// The committed plan and its successor.
#[derive(Clone, Debug)]
pub struct Committed {
    current: Arc<Plan>,
    next: Option<Arc<Plan>>,
}

impl Committed {
    /// Standing still.
    pub fn standing(now: Instant, pose: Pose) -> Self {
        Self { current: Arc::new(Plan::standing(now, pose)), next: None }
    }

    /// The plan being driven.
    pub const fn current(&self) -> &Arc<Plan> {
        &self.current
    }

    /// The plan whose take-over is pending.
    pub const fn next(&self) -> Option<&Arc<Plan>> {
        self.next.as_ref()
    }

    /// The plan that will be driven at the end of all that is decided.
    pub fn newest(&self) -> &Arc<Plan> {
        self.next.as_ref().unwrap_or(&self.current)
    }

    /// Accepts a plan that starts on the current one at its own start time.
    pub fn schedule(&mut self, plan: Arc<Plan>) {
        self.next = Some(plan);
    }

    /// Lets a pending plan take over once its time has come; says whether it did.
    pub fn promote(&mut self, now: Instant) -> bool {
        match self.next.take() {
            Some(plan) if plan.trajectory.start <= now => {
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
            Some(next) if next.trajectory.start <= now => next.trajectory.at(now),
            _ => self.current.trajectory.at(now),
        }
    }

    /// Whether all that is decided has been driven to its end.
    pub fn is_finished(&self, now: Instant) -> bool {
        let plan = &self.newest().trajectory;
        now.seconds_after(plan.start) >= plan.duration_s()
    }
}
