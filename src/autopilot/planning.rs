//! Plans: asked for, taken over, looked at again when the map changes.

use std::sync::Arc;

use super::{Autopilot, Event, Fault, Happening, Mode};
use crate::map::CellRect;
use crate::plan::certify::recertify;
use crate::plan::speed::SpeedLimits;
use crate::plan::{Goal, Path, Plan, PlanRequest, StepReport, Verdict, shorten};
use crate::time::Instant;

/// Plans are shifted in time to meet the car only above this speed, m/s.
const RETIME_SPEED_MIN_MPS: f64 = 0.3;
/// Largest shift at once, seconds: the period of a 20 Hz lidar.
const RETIME_MAX_S: f64 = 0.05;
/// A planning request may come this much before its period is over, seconds.
const PLAN_PERIOD_SLACK_S: f64 = 0.005;

/// A planning step under way.
pub(super) struct InFlight {
    pub(super) number: u32,
    pub(super) since: Instant,
    goal: Goal,
    /// Its answer is not wanted any more.
    void: bool,
    /// Beams have ended in free space since: its answer is to be looked at again.
    pub(super) outdated: bool,
}

impl Autopilot {
    /// A planning job came back.
    pub fn handle_job_done(&mut self, now: Instant, report: StepReport) {
        self.testimony.note_at(now, Happening::JobDone(&report));
        self.note_time(now);
        let Some(job) = self.in_flight.take_if(|job| job.number == report.number) else { return };
        self.grant.note(now.seconds_after(job.since));
        self.statistics.replans += 1;
        self.statistics.candidates += u64::from(report.candidates);
        let prediction = report.prediction;
        self.health.note_prediction(prediction.fault.is_some() || prediction.resting);
        if prediction.passed_over && !self.passed_over {
            let number = report.number;
            self.events.push_back(Event::PredictionPassedOver { at: now, number });
        }
        self.passed_over = prediction.passed_over;
        if let Some(fault) = prediction.fault {
            self.statistics.prediction_faults += 1;
            self.events.push_back(Event::PredictionFault { at: now, number: report.number, fault });
        }
        let wanted = !job.void && self.goal == Some(job.goal);
        match report.verdict {
            _ if !wanted => self.statistics.plans_stale += 1,
            Verdict::Plan(plan) => {
                let welcome = self.mode == Mode::Drive
                    && self.decisive_action().is_none()
                    && report.base == self.committed.newest().number;
                match self.in_time(now, report.takes_over, *plan) {
                    None => {
                        self.statistics.plans_late += 1;
                        self.events.push_back(Event::PlanLate { number: report.number });
                    }
                    Some(plan) if welcome && !(job.outdated && self.is_revoked(&plan)) => {
                        self.adopt(now, plan);
                    }
                    Some(_) => self.statistics.plans_stale += 1,
                }
            }
            Verdict::Keep => self.last_adopted = now,
            Verdict::Rejected(rejection) => {
                self.statistics.plans_rejected += 1;
                self.events.push_back(Event::PlanRejected { number: report.number, rejection });
            }
            Verdict::Unreachable => {
                self.raise(now, Fault::GoalUnreachable);
            }
        }
    }

    /// The plan if it can still take over. A car that stands where a plan begins may begin late:
    /// without that, planning that always takes longer than it is granted would never let the car
    /// set out.
    fn in_time(&self, now: Instant, takes_over: Instant, mut plan: Plan) -> Option<Plan> {
        if now > takes_over {
            let waits = self.committed.is_finished(now);
            if !waits || plan.trajectory.points.first().is_none_or(|p| p.speed_mps > 0.0) {
                return None;
            }
            plan.trajectory.start = self.tick_from(now);
        }
        Some(plan)
    }

    /// Whether something stands on a plan by now.
    fn is_revoked(&self, plan: &Plan) -> bool {
        let radius_m = self.params.vehicle.radius_m + self.params.certify.margin_m;
        recertify(&plan.trajectory, 0.0, self.mapper.grid(), radius_m).is_err()
    }

    fn adopt(&mut self, now: Instant, plan: Plan) {
        self.last_adopted = now;
        self.statistics.plans_adopted += 1;
        let stop = plan.trajectory.last().path;
        self.events.push_back(Event::PlanAdopted {
            number: plan.number,
            stop: stop.position,
            length_m: stop.s_m,
        });
        self.committed.schedule(plan);
    }

    pub(super) fn request_plan(&mut self, now: Instant) {
        let (Mode::Drive, Some(goal), None, Some((scan_stamp, scan_pose))) =
            (self.mode, self.goal, &self.in_flight, self.inputs.scan)
        else {
            return;
        };
        if self.decisive_action().is_some() || now < self.next_request {
            return;
        }
        // Scans come a little early or late; half a millisecond must not cost a whole scan.
        let wait_s = (self.params.autopilot.plan_period_s - PLAN_PERIOD_SLACK_S).max(0.0);
        self.next_request = now.offset_by(wait_s);
        self.catch_up_with_car(now);
        let number = self.take_number();
        let granted_s = self.grant.granted_s(self.params.autopilot.plan_budget_s);
        // It starts on the newest plan, so not before that one is driven.
        let takes_over = self.tick_from(now.offset_by(granted_s));
        let takes_over = self.committed.pending_from().map_or(takes_over, |at| at.max(takes_over));
        self.in_flight = Some(InFlight { number, since: now, goal, void: false, outdated: false });
        self.job = Some(PlanRequest {
            number,
            grid: self.mapper.snapshot(),
            changed: std::mem::replace(&mut self.changed, CellRect::EMPTY),
            scan_stamp,
            scan_pose,
            committed: Arc::clone(self.committed.newest()),
            takes_over,
            goal,
            speed_cap_mps: self.wish.speed_limit_mps.unwrap_or(f64::INFINITY),
            fence: Arc::clone(&self.fence),
            through_known: self.wish.through_known,
        });
    }

    /// Whatever comes back from the planning step under way is not wanted any more.
    pub(super) fn void_job(&mut self) {
        self.job = None;
        if let Some(job) = &mut self.in_flight {
            job.void = true;
        }
    }

    /// The committed plan becomes standing still where the car is.
    pub(super) fn stand_here(&mut self, now: Instant) {
        if let Some(pose) = self.localizer.pose_at(now) {
            let number = self.take_number();
            self.committed.replace(Plan { number, ..Plan::standing(now, pose) });
        }
    }

    fn take_number(&mut self) -> u32 {
        let number = self.next_number;
        self.next_number = self.next_number.wrapping_add(1);
        number
    }

    /// The first control tick at or after a moment. Plans take over at ticks: one that begins to brake
    /// between two ticks would find the car still accelerating until the next one, and a reversal of
    /// all the grip there is makes that 0.17 m/s, or at 8 m/s a stop 8 cm too late.
    fn tick_from(&self, at: Instant) -> Instant {
        let tick_s = self.params.autopilot.tick_s();
        let ticks = (at.seconds_after(self.next_tick) / tick_s - 1e-6).ceil().max(0.0);
        self.next_tick.offset_by(ticks * tick_s)
    }

    /// The committed plan is a path with a speed for each place; its clock is ours to set. A car
    /// that is a few centimetres late (or early) gets its plan shifted in time rather than being
    /// chased: in bends there is no grip left for catching up.
    fn catch_up_with_car(&mut self, now: Instant) {
        let current = &self.committed.current().trajectory;
        let wanted = current.at(now);
        let along_m = self.last_error.along_m;
        let too_slow = wanted.speed_mps < RETIME_SPEED_MIN_MPS;
        if too_slow || along_m == 0.0 || self.mode != Mode::Drive || current.start > now {
            return;
        }
        let there = current.at_distance(wanted.path.s_m + along_m);
        let late_s = (wanted.t_s - there.t_s).clamp(-RETIME_MAX_S, RETIME_MAX_S);
        self.committed.retime(late_s);
        self.last_error.along_m = 0.0;
    }

    /// A beam ended in space that was known to be free, or the fence is another one: looks at the
    /// plan under way again, and
    /// shortens it if it no longer passes.
    pub(super) fn certify_again(&mut self, now: Instant) {
        let radius_m = self.params.vehicle.radius_m + self.params.certify.margin_m;
        let fenced = self.fenced_grid(now);
        let grid = fenced.as_ref().unwrap_or_else(|| self.mapper.grid());
        let next_fails = self
            .committed
            .next()
            .is_some_and(|next| recertify(&next.trajectory, 0.0, grid, radius_m).is_err());
        if next_fails {
            self.committed.drop_next();
        }
        let current = &self.committed.current().trajectory;
        let elapsed = now.seconds_after(current.start).max(0.0);
        if recertify(current, elapsed, grid, radius_m).is_ok() {
            return;
        }
        self.statistics.plans_revoked += 1;
        let limits = SpeedLimits::new(&self.params.speed, &self.params.vehicle);
        match shorten(current, now, grid, radius_m, &limits) {
            Some(trajectory) => {
                let number = self.take_number();
                let scan_stamp = self.committed.current().scan_stamp;
                self.events.push_back(Event::PlanShortened { at: now, number });
                self.committed.replace(Plan {
                    number,
                    scan_stamp,
                    trajectory,
                    beyond: Path::default(),
                });
                self.next_tail = now;
            }
            None => self.raise(now, Fault::PathBlocked),
        }
    }
}
