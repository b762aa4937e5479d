//! What the core watches in order to notice faults: the detectors of the failsafe table, and the
//! checks before the car is armed.

use std::collections::VecDeque;

use super::failsafe::{
    BATTERY_HOLD_S, CALM_S, CORRUPT_PER_S, DISORDER_PER_S, FRAME_LATE_S, GAP_S,
    HEARTBEAT_TIMEOUT_S, LATE_TICK_SHARE, OVERLOAD_SHARE, PLAN_TIMEOUT_S, POSE_ERROR_MAX_M,
    SCAN_LATE_SHARE, SCAN_MISSING_SHARE, STATUS_TIMEOUT_S, TAIL_SUPERSEDED_S, TAIL_TIMEOUT_S,
    UNSENT_PER_S, WINDOW_S, odometry_late_s,
};
use super::{Action, Autopilot, Clears, Event, Fault, Happening, Mode, REST_SPEED_MPS, Refusal};
use crate::command::CarStatus;
use crate::scan::Odometry;
use crate::time::Instant;
use crate::vehicle::VehicleParams;
use crate::wire::can::{CarHeartbeat, INTERFACE_VERSION, WireError};

/// How a CAN controller takes part in the traffic: its state of error confinement (ISO 11898-1), the
/// worse the later.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BusState {
    /// It sends, receives and marks errors.
    #[default]
    Active,
    /// After many errors (a counter has reached 128): it may no longer mark errors of others, and
    /// waits longer.
    Passive,
    /// After too many errors in sending, or with its interface down: it takes no part any more.
    Off,
}

/// What the driver of the bus says. Where nobody tells (the simulator), all is well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusHealth {
    /// State of the computer's own CAN controller.
    pub state: BusState,
    /// Error frames since the start.
    pub error_frames: u64,
    /// Frames of ours that could not be sent, since the start.
    pub frames_unsent: u64,
}

/// What the computer says about itself. Where nobody tells, all is well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HostHealth {
    /// The log cannot be written for want of space.
    pub disk_full: bool,
    /// A predictor was asked for and is not there: the planner works without.
    pub predictor_missing: bool,
}

/// Notices when something happens too often within [`WINDOW_S`]. Remembers no more than it takes.
#[derive(Debug)]
struct Burst {
    limit: usize,
    at: VecDeque<Instant>,
}

impl Burst {
    /// Full with `limit` events.
    fn of(limit: usize) -> Self {
        Self { limit: limit.max(1), at: VecDeque::new() }
    }

    fn note(&mut self, now: Instant, times: u64) {
        for _ in 0..times.min(self.limit as u64) {
            if self.at.len() == self.limit {
                self.at.pop_front();
            }
            self.at.push_back(now);
        }
    }

    fn is_full(&self, now: Instant) -> bool {
        self.at.len() == self.limit && now.seconds_after(self.at[0]) <= WINDOW_S
    }
}

/// What the detectors remember.
#[derive(Debug)]
pub(super) struct Health {
    bus: BusHealth,
    host: HostHealth,
    heartbeat: Option<(Instant, CarHeartbeat)>,
    status: Option<(Instant, CarStatus)>,
    /// When the newest scan and the newest odometry were measured.
    scan: Option<Instant>,
    odometry: Option<Instant>,
    corrupt: Burst,
    disorder: Burst,
    bus_errors: Burst,
    unsent: Burst,
    late_ticks: Burst,
    frames_lost: u64,
    /// A frame waited too long since the last tick.
    frame_late: bool,
    low_battery_since: Option<Instant>,
    /// The car's count of lost set points (its lowest bit) that is known about.
    loss_toggle: bool,
    /// Plans of the tails sent, and when the next one took their place.
    tails: VecDeque<(u16, Option<Instant>)>,
    /// When the car was last known to hold one of them that is not too old.
    tail_held: Option<Instant>,
    /// Whether the newest planning step went without prediction.
    no_prediction: bool,
    /// When each fault's cause was seen last.
    seen: [Instant; Fault::ALL.len()],
    /// The latest moment that the core was told of, once it has ticked.
    newest: Option<Instant>,
}

/// Plans of tails that are remembered: half a second at 40 scans a second.
const TAILS: usize = 20;
/// A gap in a stream counts as no more frames than this: what is silent for longer than a few frames
/// has a row of its own.
const GAP_COUNTS_MAX: u64 = 5;
/// Angle by which the totals may turn further than the steering allows, radians: noise at rest.
const TURN_SLACK_RAD: f64 = 0.05;

impl Health {
    pub(super) fn new(now: Instant, tick_s: f64, bus_errors_max_ps: u32) -> Self {
        let late_ticks = (OVERLOAD_SHARE * WINDOW_S / tick_s).ceil() as usize;
        Self {
            bus: BusHealth::default(),
            host: HostHealth::default(),
            heartbeat: None,
            status: None,
            scan: None,
            odometry: None,
            corrupt: Burst::of(CORRUPT_PER_S),
            disorder: Burst::of(DISORDER_PER_S),
            bus_errors: Burst::of(bus_errors_max_ps as usize),
            unsent: Burst::of(UNSENT_PER_S),
            late_ticks: Burst::of(late_ticks),
            frames_lost: 0,
            frame_late: false,
            low_battery_since: None,
            loss_toggle: false,
            tails: VecDeque::new(),
            tail_held: None,
            no_prediction: false,
            seen: [now; Fault::ALL.len()],
            newest: None,
        }
    }

    /// A scan was put into the map.
    pub(super) const fn note_scan(&mut self, stamp: Instant) {
        self.scan = Some(stamp);
    }

    /// A planning step came back, with or without prediction.
    pub(super) const fn note_prediction(&mut self, missing: bool) {
        self.no_prediction = missing;
    }

    /// The watch over tails begins anew.
    pub(super) const fn trust_tails(&mut self, now: Instant) {
        self.tail_held = Some(now);
    }

    /// A tail of a plan goes out.
    pub(super) fn note_tail(&mut self, now: Instant, plan: u16) {
        match self.tails.back_mut() {
            Some((newest, _)) if *newest == plan => return,
            Some((_, superseded)) => *superseded = Some(now),
            None => {}
        }
        if self.tails.len() == TAILS {
            self.tails.pop_front();
        }
        self.tails.push_back((plan, None));
    }

    /// Whether a tail of that plan is as good as the newest one.
    fn is_tail_valid(&self, now: Instant, plan: u16) -> bool {
        self.tails.iter().rev().find(|(sent, _)| *sent == plan).is_some_and(|(_, superseded)| {
            superseded.is_none_or(|at| now.seconds_after(at) <= TAIL_SUPERSEDED_S)
        })
    }
}

/// How far the car may be from where one arc through the totals puts it, after a gap between two
/// readings: over a distance d between known headings, a path whose curvature stays within k
/// strays from the arc by less than k d^2 / 4.
fn gap_error_m(before: &Odometry, after: &Odometry, vehicle: &VehicleParams) -> f64 {
    let distance = (after.travelled_m - before.travelled_m).abs();
    let slowest = before.speed_mps.min(after.speed_mps).max(0.1);
    let sharpest =
        vehicle.curvature_limit_pm().min(vehicle.acceleration_limit_mps2() / (slowest * slowest));
    0.25 * sharpest * distance * distance
}

/// Whether the totals say that the car turned further than it can.
fn turned_too_far(before: &Odometry, after: &Odometry, vehicle: &VehicleParams) -> bool {
    let distance = (after.travelled_m - before.travelled_m).abs();
    let turn = (after.turned_rad - before.turned_rad).abs();
    turn > 1.2 * vehicle.curvature_limit_pm() * distance + TURN_SLACK_RAD
}

/// Whether the pose is uncertain after two readings in a row.
pub(super) fn strays(before: &Odometry, after: &Odometry, vehicle: &VehicleParams) -> bool {
    gap_error_m(before, after, vehicle) > POSE_ERROR_MAX_M || turned_too_far(before, after, vehicle)
}

fn age_s(now: Instant, at: Option<Instant>) -> f64 {
    at.map_or(f64::INFINITY, |at| now.seconds_after(at))
}

impl Autopilot {
    /// What the driver of the bus says about it: at every change, and at least every 100 ms while
    /// there are errors.
    pub fn handle_bus_health(&mut self, now: Instant, health: BusHealth) {
        self.testimony.note_at(now, Happening::Bus(&health));
        self.note_time(now);
        let before = std::mem::replace(&mut self.health.bus, health);
        let errors = health.error_frames.saturating_sub(before.error_frames);
        let unsent = health.frames_unsent.saturating_sub(before.frames_unsent);
        self.health.bus_errors.note(now, errors);
        self.health.unsent.note(now, unsent);
        if health.state == BusState::Off {
            self.raise(now, Fault::BusOff);
        }
    }

    /// What the computer says about itself, at every change.
    pub fn handle_host_health(&mut self, now: Instant, health: HostHealth) {
        self.testimony.note_at(now, Happening::Host(&health));
        self.note_time(now);
        self.health.host = health;
    }

    /// The newest status of the car's controller, and when it came.
    pub const fn car_status(&self) -> Option<&(Instant, CarStatus)> {
        self.health.status.as_ref()
    }

    /// Why the car cannot be armed now; empty if it can. Faults whose rows only report (such as a
    /// missing network) are no reason: they are among [`faults`](Self::faults).
    pub fn pre_arm(&self, now: Instant) -> Vec<Refusal> {
        let mut reasons = Vec::new();
        let mut need = |holds: bool, reason: Refusal| {
            if !holds {
                reasons.push(reason);
            }
        };
        let (health, params) = (&self.health, &self.params);
        let heartbeat = health
            .heartbeat
            .filter(|(at, _)| now.seconds_after(*at) <= HEARTBEAT_TIMEOUT_S)
            .map(|(_, heartbeat)| heartbeat.version);
        need(heartbeat.is_some(), Refusal::NoHeartbeat);
        if let Some(theirs) = heartbeat {
            let refusal = Refusal::WrongVersion { theirs, ours: INTERFACE_VERSION };
            need(theirs == INTERFACE_VERSION, refusal);
        }
        let status = health
            .status
            .filter(|(at, _)| now.seconds_after(*at) <= STATUS_TIMEOUT_S)
            .map(|(_, status)| status);
        need(status.is_some(), Refusal::NoStatus);
        if let Some(status) = status {
            need(!status.emergency_stop, Refusal::EmergencyStop);
            need(!status.setpoint_lost, Refusal::SetpointLost);
            let low_v = params.autopilot.battery_low_v;
            let low = Refusal::BatteryLow { battery_v: status.battery_v, low_v };
            need(status.battery_v >= low_v, low);
        }
        need(age_s(now, health.odometry) <= odometry_late_s(params), Refusal::NoOdometry);
        need(
            age_s(now, health.scan) <= SCAN_LATE_SHARE * params.guard.scan_age_max_s,
            Refusal::NoScan,
        );
        need(self.localizer.speed_at(now).abs() <= REST_SPEED_MPS, Refusal::Moving);
        need(age_s(now, health.tail_held) <= TAIL_TIMEOUT_S, Refusal::TailNotHeld);
        need(health.bus.state == BusState::Active, Refusal::BusNotActive(health.bus.state));
        need(!health.host.disk_full, Refusal::DiskFull);
        need(!self.faults.contains(Fault::Overload), Refusal::Overload);
        need(!self.faults.contains(Fault::Terminated), Refusal::Terminated);
        for fault in [Fault::ClockJump, Fault::CorruptFrames, Fault::BusErrors] {
            need(!self.faults.contains(fault), Refusal::Unsettled(fault));
        }
        reasons
    }

    /// The car is armed: what has happened before is known about.
    pub(super) fn forget_losses(&mut self) {
        if let Some((_, status)) = &self.health.status {
            self.health.loss_toggle = status.loss_toggle;
        }
    }

    // ---- detectors that look at what comes in

    /// Any input carries the time. One far beyond the tick that was due means that this process
    /// stood still or that its clock jumped: whatever it believed until then is out of date.
    pub(super) fn note_time(&mut self, now: Instant) {
        let Some(newest) = self.health.newest else { return };
        self.health.newest = Some(newest.max(now));
        if now.seconds_after(self.next_tick.max(newest)) > GAP_S {
            self.stood_still(now);
        }
    }

    fn stood_still(&mut self, now: Instant) {
        self.raise(now, Fault::ClockJump);
        // What has waited meanwhile is late, but its stamps are right.
        self.clock.excuse(now.offset_by(CALM_S));
        self.committed.drop_next();
        self.void_job();
    }

    /// A frame was handled: late, if ticks went by since it came.
    pub(super) fn note_frame(&mut self, at: Instant) {
        if self.health.newest.is_some_and(|newest| newest.seconds_after(at) > FRAME_LATE_S) {
            self.health.frame_late = true;
        }
    }

    /// The tick due at `due` takes place.
    pub(super) fn note_tick(&mut self, now: Instant, due: Instant) {
        let tick_s = self.params.autopilot.tick_s();
        // Frames that waited were read with the times of their arrival; this is how late it is.
        if self.health.newest.is_some() && now.seconds_after(due) > GAP_S {
            self.stood_still(now);
        }
        let health = &mut self.health;
        match health.newest {
            None => health.newest = Some(now),
            Some(_) => {
                let periods = now.seconds_after(due) / tick_s;
                if periods > LATE_TICK_SHARE || health.frame_late {
                    health.late_ticks.note(now, 1 + periods as u64);
                }
            }
        }
        health.frame_late = false;
    }

    /// What the decoder had to say beside the message.
    pub(super) fn note_wire(&mut self, now: Instant, error: Option<&WireError>) {
        let health = &mut self.health;
        let lost = self.decoder.stats().lost;
        let gap = (lost - health.frames_lost).min(GAP_COUNTS_MAX);
        health.disorder.note(now, gap);
        health.frames_lost = lost;
        match error {
            Some(WireError::Repeated { .. } | WireError::WrongSequence { .. }) => {
                health.disorder.note(now, 1);
            }
            Some(
                WireError::WrongCrc { .. }
                | WireError::WrongLength { .. }
                | WireError::BadValue { .. },
            ) => health.corrupt.note(now, 1),
            _ => {}
        }
    }

    pub(super) fn note_odometry(&mut self, stamp: Instant) {
        self.health.odometry = Some(stamp);
    }

    pub(super) fn handle_status(&mut self, now: Instant, status: CarStatus) {
        self.health.status = Some((now, status));
        if status.emergency_stop {
            self.raise(now, Fault::EmergencyStop);
        }
        // The latch is cleared by our own `drive == false`, perhaps before we ever see it set. The
        // toggle stays.
        let lost = status.setpoint_lost || status.loss_toggle != self.health.loss_toggle;
        if lost && self.mode.is_armed() {
            self.raise(now, Fault::SetpointLost);
        }
        if status.tail_plan.is_some_and(|plan| self.health.is_tail_valid(now, plan)) {
            self.health.tail_held = Some(now);
        }
        if status.battery_v < self.params.autopilot.battery_low_v {
            self.health.low_battery_since.get_or_insert(now);
        } else {
            self.health.low_battery_since = None;
        }
    }

    pub(super) fn handle_heartbeat(&mut self, now: Instant, heartbeat: CarHeartbeat) {
        let before = self.health.heartbeat.replace((now, heartbeat));
        // All eight bits: the two that travel with every measurement may be the same by chance.
        if before.is_some_and(|(_, before)| before.boot != heartbeat.boot) {
            self.lose_pose(now);
        }
    }

    // ---- detectors that run at every tick

    pub(super) fn check_health(&mut self, now: Instant) {
        let driving = matches!(self.mode, Mode::Drive | Mode::Hold | Mode::Stop);
        let (health, params) = (&self.health, &self.params);
        let status_at = health.status.map(|(at, _)| at);
        let scan_age_s = age_s(now, health.scan) / params.guard.scan_age_max_s;
        let job_age_s = self.in_flight.as_ref().map_or(0.0, |job| now.seconds_after(job.since));
        // Where plans are asked for seldom, none is late before the next one is due.
        let no_plan_s = PLAN_TIMEOUT_S + params.autopilot.plan_period_s;
        let no_plan = now.seconds_after(self.last_adopted) > no_plan_s;
        let low_s = health.low_battery_since.map_or(0.0, |since| now.seconds_after(since));
        let causes = [
            (Fault::ClockJump, false),
            (Fault::OdometryLate, driving && age_s(now, health.odometry) > odometry_late_s(params)),
            (Fault::StatusLost, driving && age_s(now, status_at) > STATUS_TIMEOUT_S),
            (Fault::ScanMissing, driving && scan_age_s > SCAN_MISSING_SHARE),
            (Fault::ScanLate, driving && scan_age_s > SCAN_LATE_SHARE),
            (Fault::TailNotHeld, driving && age_s(now, health.tail_held) > TAIL_TIMEOUT_S),
            (Fault::CorruptFrames, health.corrupt.is_full(now) || health.disorder.is_full(now)),
            (
                Fault::BusErrors,
                health.bus.state == BusState::Passive
                    || health.bus_errors.is_full(now)
                    || health.unsent.is_full(now),
            ),
            (Fault::Overload, health.late_ticks.is_full(now)),
            (Fault::StationLost, self.wish.station_lost),
            (Fault::GuardStop, self.guard.stopping().is_some()),
            (Fault::PlannerLate, job_age_s > PLAN_TIMEOUT_S),
            (Fault::NoPlan, self.mode == Mode::Drive && no_plan),
            (Fault::NoPrediction, health.host.predictor_missing || health.no_prediction),
            (Fault::DiskFull, health.host.disk_full),
        ];
        for (fault, cause) in causes {
            if cause {
                self.raise(now, fault);
            } else if fault.row().clears == Clears::ByItself
                && now.seconds_after(self.health.seen[fault as usize]) >= CALM_S
            {
                self.clear(now, fault);
            }
        }
        // At rest the voltage recovers: only a person lets the car drive on.
        if driving && low_s > BATTERY_HOLD_S {
            self.raise(now, Fault::BatteryLow);
        }
    }

    // ---- the faults themselves

    pub(super) fn raise(&mut self, now: Instant, fault: Fault) {
        if self.suppressed.contains(fault) {
            return;
        }
        self.health.seen[fault as usize] = now;
        if self.faults.set(fault, true) {
            self.events.push_back(Event::FaultRaised { at: now, fault });
        }
    }

    pub(super) fn clear(&mut self, now: Instant, fault: Fault) {
        if self.faults.set(fault, false) {
            self.events.push_back(Event::FaultCleared { at: now, fault });
        }
    }

    pub(super) fn decisive_action(&self) -> Option<Action> {
        self.faults.decisive().map(|row| row.action)
    }

    /// Whether the car is known to stand, or where it goes.
    pub(super) fn is_pose_trusted(&self, standing: bool) -> bool {
        let timely =
            ![Fault::ClockJump, Fault::OdometryLate].into_iter().any(|f| self.faults.contains(f));
        timely && (standing || !self.faults.contains(Fault::PoseLost))
    }

    /// Switches a detector off, to find out whether a test notices.
    #[doc(hidden)]
    pub fn suppress(&mut self, fault: Fault) {
        self.suppressed.set(fault, true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Instant {
        Instant::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn a_burst_is_noticed_at_its_limit_and_forgotten_after_a_second() {
        let mut burst = Burst::of(10);
        for i in 0..9 {
            burst.note(at(100 * i), 1);
        }
        assert!(!burst.is_full(at(850)));
        burst.note(at(900), 1);
        assert!(burst.is_full(at(900)) && burst.is_full(at(1000)));
        assert!(!burst.is_full(at(1001)));
        burst.note(at(5000), u64::MAX);
        assert!(burst.is_full(at(5000)));
        assert_eq!(burst.at.len(), 10);
    }

    fn reading(travelled_m: f64, turned_rad: f64, speed_mps: f64) -> Odometry {
        Odometry {
            stamp: Instant::ZERO,
            travelled_m,
            turned_rad,
            speed_mps,
            yaw_rate_rps: 0.0,
            steering_curvature_pm: 0.0,
        }
    }

    #[test]
    fn a_gap_matters_by_what_the_car_may_have_done_in_it() {
        let vehicle = VehicleParams::default();
        let gap = |distance: f64, speed: f64, turn: f64| {
            strays(&reading(5.0, 1.0, speed), &reading(5.0 + distance, 1.0 + turn, speed), &vehicle)
        };
        // Five frames lost at 4 m/s, ten at 8 m/s: no sharp bend fits in there.
        assert!(!gap(0.2, 4.0, 0.0));
        assert!(!gap(0.5, 8.0, 0.0));
        // Half a metre round unknown bends, down to a stop.
        assert!(gap(0.5, 0.0, 0.0));
        assert!(!gap(0.1, 0.0, 0.0));
        // Lifted up and put down the other way round.
        assert!(gap(0.0, 0.0, 3.0));
        assert!(!gap(0.15, 2.0, 0.3));
    }
}
