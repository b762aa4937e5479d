//! The control tick: settles the mode, follows the committed plan, sends what the guard lets pass.

use super::{Action, Autopilot, Clears, Event, Fault, Mode, REST_SPEED_MPS};
use crate::command::ForceSetpoint;
use crate::control::braking_tail;
use crate::frames::Pose;
use crate::time::Instant;
use crate::wire::can::DaemonMode;

/// A car at rest that is further than this from the end of its plan stands elsewhere, metres.
const PUSHED_M: f64 = 0.02;
/// Heartbeats are sent this often, seconds.
const HEARTBEAT_PERIOD_S: f64 = 0.1;

impl Autopilot {
    pub(super) fn tick(&mut self, now: Instant) {
        if self.committed.promote(now) {
            self.next_tail = now;
        }
        self.check_health(now);
        let state = self.state(now);
        let standing = state.is_none_or(|(_, speed)| speed.abs() < REST_SPEED_MPS);
        self.settle_mode(now, state, standing);
        let mut setpoint = ForceSetpoint::default();
        if let Some((pose, speed)) = state.filter(|_| self.is_following()) {
            let trajectory = &self.committed.current().trajectory;
            let tracking = self.tracker.track(trajectory, now, pose, speed);
            self.last_error = tracking.error;
            setpoint = tracking.setpoint;
            if tracking.error.lateral_m.abs() > self.params.autopilot.tracking_error_max_m {
                self.raise(now, Fault::TrackingError);
                self.settle_mode(now, state, standing);
            }
            if !self.is_following() {
                setpoint = ForceSetpoint::default();
            }
        }
        if self.mode == Mode::Drive && standing {
            self.check_arrival(now);
        }
        self.send(now, setpoint);
        if !standing {
            let age = now.since(self.committed.current().scan_stamp);
            self.statistics.plan_ages.push(age);
        }
    }

    /// Whether setpoints lead along the committed plan.
    fn is_following(&self) -> bool {
        matches!(self.mode, Mode::Drive | Mode::Hold | Mode::Stop) && !self.braking
    }

    /// The mode that the active faults call for.
    fn settle_mode(&mut self, now: Instant, state: Option<(Pose, f64)>, standing: bool) {
        if standing && self.mode == Mode::Stop && self.is_pose_trusted(true) {
            for fault in self.faults.iter().filter(|fault| fault.row().clears == Clears::AtRest) {
                self.clear(now, fault);
            }
        }
        let action = self.decisive_action();
        match (self.mode, action) {
            (Mode::Drive | Mode::Hold, Some(_)) => self.transition(now, Mode::Stop),
            (Mode::Stop, None) if standing => {
                self.stand_here(now);
                match self.goal {
                    Some(_) if self.paused => self.transition(now, Mode::Hold),
                    Some(_) => self.begin_drive(now),
                    None => self.transition(now, Mode::Standby),
                }
            }
            _ => {}
        }
        // A plan that is not being followed, or cannot be, gives way to standing here.
        let given_up = match self.mode {
            Mode::Disarmed | Mode::Standby => true, // somebody pushed the car
            Mode::Stop => true,                     // finishing a plan does not mean to set off
            Mode::Drive => self.guard.stopping().is_some(),
            Mode::Hold => false,
        };
        if given_up && standing {
            let planned = self.committed.newest().trajectory.last().path.position;
            if state.is_some_and(|(pose, _)| (pose.position - planned).norm() > PUSHED_M) {
                self.stand_here(now);
            }
        }
        if self.mode == Mode::Stop {
            self.braking |= action == Some(Action::BrakeNow);
        } else {
            self.braking = false;
        }
    }

    fn send(&mut self, now: Instant, setpoint: ForceSetpoint) {
        if now >= self.next_tail {
            self.next_tail = now.offset_by(self.params.autopilot.tail_period_s);
            self.send_tail(now);
        }
        let decision = self.guard.check(now, setpoint);
        self.statistics.guard_stops = self.guard.counts().stops;
        if self.guard.stopping().is_some() {
            self.raise(now, Fault::GuardStop);
        }
        match self.encoder.encode_setpoint(&decision.setpoint) {
            Ok(frame) => self.frames.push_back(frame),
            Err(_) => self.statistics.setpoints_unsendable += 1,
        }
        if now >= self.next_heartbeat {
            self.next_heartbeat = now.offset_by(HEARTBEAT_PERIOD_S);
            let uptime_ms = now.since(self.started).as_millis() as u32;
            let mode = match self.mode {
                Mode::Disarmed => DaemonMode::Standby,
                Mode::Standby | Mode::Hold => DaemonMode::Hold,
                Mode::Drive => DaemonMode::Guided,
                Mode::Stop => DaemonMode::Stop,
            };
            self.frames.push_back(self.encoder.encode_heartbeat(uptime_ms, mode));
        }
    }

    fn send_tail(&mut self, now: Instant) {
        // Without a pose that can be believed the tail that the car holds is the better one.
        let Some((odometry, pose)) = self.localizer.newest() else { return };
        if !self.is_pose_trusted(odometry.speed_mps.abs() < REST_SPEED_MPS) {
            return;
        }
        let plan = self.committed.current();
        let tail = braking_tail(
            plan.number as u16,
            &plan.trajectory,
            &odometry,
            pose,
            &self.params.vehicle,
            &self.params.control,
        );
        // A tail that the guard cannot place proves nothing to it; its older one stays.
        let _ = self.guard.handle_tail(&tail);
        self.tail_frames.clear();
        match self.encoder.encode_tail(&tail, &mut self.tail_frames) {
            Ok(()) => {
                self.health.note_tail(now, tail.plan);
                self.frames.extend(self.tail_frames.drain(..));
            }
            Err(_) => self.statistics.tails_unsendable += 1,
        }
    }

    fn check_arrival(&mut self, now: Instant) {
        let Some(goal) = self.goal else { return };
        let Some(pose) = self.localizer.pose_at(now) else { return };
        let finished = self.committed.is_finished(now);
        if finished && (pose.position - goal.position).norm() <= goal.radius_m {
            self.goal = None;
            self.events.push_back(Event::GoalReached { at: now, position: pose.position });
            self.stand_here(now);
            self.transition(now, Mode::Standby);
        }
    }
}
