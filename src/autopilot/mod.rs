//! The autopilot core: frames and commands in, frames and planning jobs out, no clock of its own.
//!
//! The caller hands in every received frame ([`Autopilot::handle_frame`]), every finished planning
//! job ([`Autopilot::handle_job_done`]) and the passing of time ([`Autopilot::handle_time`], due at
//! [`Autopilot::poll_at`]); it fetches frames to send, jobs to run and events to log. Planning is
//! slower than the control tick, so it leaves as a job and comes back as an event, late or never
//! without holding anything up: the committed plan ends at rest in known free space anyway.

mod commands;
mod committed;
mod document;
mod event;
mod failsafe;
mod fence;
mod grant;
mod health;
mod mode;
mod planning;
mod reconfigure;
mod tick;
mod witness;

use std::collections::VecDeque;
use std::sync::Arc;

pub use committed::Committed;
pub use document::markdown as failsafe_page;
pub use event::{Command, Event, Refusal, Statistics};
pub use failsafe::{Action, ActiveFaults, Clears, Fault, Row, TABLE};
pub use health::{BusHealth, BusState, HostHealth};
pub use mode::Mode;
pub use witness::{Happening, Witness};

use crate::control::{ControlParams, Tracker, TrackingError};
use crate::fence::Fence;
use crate::frames::Pose;
use crate::guard::{Guard, GuardCounts, GuardParams};
use crate::localize::{ClockMap, Localizer};
use crate::map::{CellRect, Grid, MapParams, Mapper};
use crate::odometry::Reading;
use crate::plan::certify::CertifyParams;
use crate::plan::speed::SpeedParams;
use crate::plan::{FencePainter, Goal, PlanRequest};
use crate::scan::{Odometry, Scan};
use crate::time::Instant;
use crate::tunables;
use crate::vehicle::VehicleParams;
use crate::wire::can::{CanFrame, CarMessage, Decoder, Encoder, Layout, WireStats};
use failsafe::GAP_S;
use grant::Grant;
use health::Health;
use planning::InFlight;

tunables! {
    /// The autopilot core.
    pub struct AutopilotParams in "autopilot" {
        /// Setpoints a second; every detector of the failsafe table runs as often.
        control_rate_hz: f64 = 100.0, restart, in 20.0..=1000.0, "Hz";
        /// Radius of the disc around a goal within which the car must come to rest.
        goal_radius_m: f64 = 0.5, at_rest, in 0.05..=10.0, "m";
        /// Most time granted to a planning step: the new plan takes over at the first control tick
        /// after it. Where four in five of the last steps took less, less is granted; where the last one
        /// took longer, as long as that and a quarter, up to 0.1 s.
        plan_budget_s: f64 = 0.015, at_rest, in 0.001..=1.0, "s";
        /// Least time between two planning requests; 0 asks for a plan after every scan.
        plan_period_s: f64 = 0.0, at_rest, in 0.0..=10.0, "s";
        /// Time between two braking tails while driving.
        tail_period_s: f64 = 0.05, at_rest, in 0.01..=0.5, "s";
        /// Tracking error at which the car is stopped: along with pose and map errors it must stay
        /// within the certified margin.
        tracking_error_max_m: f64 = 0.04, at_rest, in 0.005..=0.5, "m";
        /// A car whose battery stays below this voltage is stopped and not armed; 3.2 V a cell
        /// spare the battery. 0 switches the check off.
        battery_low_v: f64 = 9.6, live, in 0.0..=100.0, "V";
        /// So many error frames on the bus within a second end the drive.
        bus_errors_max_ps: u32 = 50, restart, in 1..=10000, "";
    }
}

impl AutopilotParams {
    /// The control period, seconds.
    pub fn tick_s(&self) -> f64 {
        1.0 / self.control_rate_hz
    }
}

/// Everything that the core is made of.
#[derive(Clone, Debug, Default)]
pub struct CoreParams {
    /// The car.
    pub vehicle: VehicleParams,
    /// The core itself.
    pub autopilot: AutopilotParams,
    /// The occupancy grid.
    pub map: MapParams,
    /// Path tracking.
    pub control: ControlParams,
    /// The last gate.
    pub guard: GuardParams,
    /// The certificate, for looking again at the plan under way.
    pub certify: CertifyParams,
    /// The speed profile, for shortening the plan under way.
    pub speed: SpeedParams,
}

/// Below this speed the car counts as standing, m/s.
const REST_SPEED_MPS: f64 = 0.02;
/// The sans-IO core.
pub struct Autopilot {
    params: CoreParams,
    started: Instant,
    mode: Mode,
    goal: Option<Goal>,
    wish: Wish,
    faults: ActiveFaults,
    /// Faults whose detectors are switched off, in tests.
    suppressed: ActiveFaults,
    health: Health,
    /// A person wants the car to wait.
    paused: bool,
    /// Braking goes on until the car stands, whether or not its cause does.
    braking: bool,
    decoder: Decoder,
    encoder: Encoder,
    clock: ClockMap,
    localizer: Localizer,
    mapper: Mapper,
    tracker: Tracker,
    guard: Guard,
    committed: Committed,
    inputs: Inputs,
    job: Option<PlanRequest>,
    in_flight: Option<InFlight>,
    /// Whether the newest planning step did without the prediction by choice.
    passed_over: bool,
    grant: Grant,
    next_number: u32,
    changed: CellRect,
    next_tick: Instant,
    next_tail: Instant,
    next_heartbeat: Instant,
    last_adopted: Instant,
    next_request: Instant,
    tail_frames: Vec<CanFrame>,
    frames: VecDeque<CanFrame>,
    events: VecDeque<Event>,
    statistics: Statistics,
    last_error: TrackingError,
    fence: Arc<Fence>,
    painter: FencePainter,
    testimony: witness::Testimony,
}

/// The newest of everything that comes in.
#[derive(Default)]
struct Inputs {
    scan: Option<(Instant, Pose)>,
    raw_scan: Option<Arc<Scan>>,
    /// Start of the car's controller that the totals belong to.
    epoch: Option<u32>,
}

/// How the goal is to be driven to, and whether anybody still listens.
#[derive(Clone, Copy, Debug, Default)]
struct Wish {
    /// A speed not to be exceeded, m/s.
    speed_limit_mps: Option<f64>,
    /// Through known space, if there is a way.
    through_known: bool,
    /// Every ground station has gone silent, and that is to stop the car.
    station_lost: bool,
}

impl Autopilot {
    /// A disarmed core for a car that stands at `start` (map frame).
    pub fn new(params: CoreParams, layout: Layout, start: Pose, now: Instant) -> Self {
        let tick_s = params.autopilot.tick_s();
        let mut mapper = Mapper::new(&params.map);
        mapper.mark_footprint(start.position, params.vehicle.radius_m + params.certify.margin_m);
        Self {
            started: now,
            mode: Mode::Disarmed,
            goal: None,
            wish: Wish::default(),
            faults: ActiveFaults::default(),
            suppressed: ActiveFaults::default(),
            health: Health::new(now, tick_s, params.autopilot.bus_errors_max_ps),
            paused: false,
            braking: false,
            decoder: Decoder::new(layout),
            encoder: Encoder::new(layout),
            clock: ClockMap::new(),
            localizer: Localizer::new(start),
            mapper,
            tracker: Tracker::new(&params.vehicle, &params.control, tick_s),
            guard: Guard::new(&params.vehicle, &params.guard, tick_s),
            committed: Committed::standing(now, start),
            inputs: Inputs::default(),
            job: None,
            in_flight: None,
            passed_over: false,
            grant: Grant::default(),
            next_number: 1,
            changed: CellRect::EMPTY,
            next_tick: now,
            next_tail: now,
            next_heartbeat: now,
            last_adopted: now,
            next_request: now,
            tail_frames: Vec::new(),
            frames: VecDeque::new(),
            events: VecDeque::new(),
            statistics: Statistics::default(),
            last_error: TrackingError::default(),
            fence: Arc::default(),
            painter: FencePainter::default(),
            testimony: witness::Testimony::default(),
            params,
        }
    }

    /// Gives the core a map that is known from the start; scans still add to it.
    pub fn preload_map(&mut self, grid: Grid) {
        self.changed = self.changed.union(&grid.bounds());
        self.mapper = Mapper::with_grid(&self.params.map, grid);
    }

    /// What it is doing.
    pub const fn mode(&self) -> Mode {
        self.mode
    }

    /// The faults that are active.
    pub const fn faults(&self) -> &ActiveFaults {
        &self.faults
    }

    /// Where it is driving to.
    pub const fn goal(&self) -> Option<&Goal> {
        self.goal.as_ref()
    }

    /// What it knows of the world.
    pub fn grid(&self) -> &Grid {
        self.mapper.grid()
    }

    /// The committed plan.
    pub const fn committed(&self) -> &Committed {
        &self.committed
    }

    /// Estimated pose and speed at `now`.
    pub fn state(&self, now: Instant) -> Option<(Pose, f64)> {
        self.localizer.pose_at(now).map(|pose| (pose, self.localizer.speed_at(now)))
    }

    /// Yaw rate by the newest odometry, rad/s, counter-clockwise; zero without any.
    pub fn yaw_rate_rps(&self) -> f64 {
        self.localizer.newest().map_or(0.0, |(odometry, _)| odometry.yaw_rate_rps)
    }

    /// The newest complete scan.
    pub const fn newest_scan(&self) -> Option<&Arc<Scan>> {
        self.inputs.raw_scan.as_ref()
    }

    /// Counts since the start.
    pub const fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// What the decoder has seen on the bus.
    pub fn wire_statistics(&self) -> &WireStats {
        self.decoder.stats()
    }

    /// What the guard has done.
    pub const fn guard_counts(&self) -> &GuardCounts {
        self.guard.counts()
    }

    /// How far the car was off its plan at the latest tick.
    pub const fn tracking_error(&self) -> &TrackingError {
        &self.last_error
    }

    // ---- inputs

    /// A frame arrived at `now` (the moment at which it came, even if it had to wait).
    pub fn handle_frame(&mut self, now: Instant, frame: &CanFrame) {
        self.testimony.note_at(now, Happening::Frame(frame));
        self.note_time(now);
        self.note_frame(now);
        let message = self.decoder.decode(now, frame);
        self.note_wire(now, message.as_ref().err());
        match message {
            Ok(None) => {}
            Ok(Some(CarMessage::Odometry(odometry))) => {
                let stamp = self.car_time(now, odometry.time.as_micros());
                let epoch = odometry.epoch;
                let wheelbase_m = self.params.vehicle.wheelbase_m;
                self.handle_odometry(now, epoch, &odometry.into_odometry(stamp, wheelbase_m));
            }
            Ok(Some(CarMessage::Scan(scan))) => {
                let stamp = self.car_time(now, scan.time.as_micros());
                self.handle_scan(now, scan.into_scan(stamp));
            }
            Ok(Some(CarMessage::Status(status))) => self.handle_status(now, status),
            Ok(Some(CarMessage::Heartbeat(heartbeat))) => self.handle_heartbeat(now, heartbeat),
            Err(_) => self.statistics.frames_refused += 1,
        }
    }

    /// A moment on the car's clock, on ours.
    fn car_time(&mut self, now: Instant, car_us: u64) -> Instant {
        let reading = self.clock.map(car_us, now);
        if reading.jumped {
            self.raise(now, Fault::ClockJump);
        }
        reading.stamp
    }

    fn handle_odometry(&mut self, now: Instant, epoch: u32, odometry: &Odometry) {
        let before = self.localizer.newest();
        let restarted = self.inputs.epoch.replace(epoch).is_some_and(|before| before != epoch);
        if restarted {
            self.localizer.begin_anew();
            self.guard.begin_anew();
        }
        let reading = self.localizer.handle_odometry(odometry);
        self.guard.handle_odometry(odometry);
        self.note_odometry(odometry.stamp);
        let strays = match (reading, before) {
            (Reading::Restarted, _) => true,
            (Reading::Taken, Some((before, _))) => {
                health::strays(&before, odometry, &self.params.vehicle)
            }
            _ => false,
        };
        if restarted || strays {
            self.lose_pose(now);
        }
    }

    /// Nobody knows where the car is on the map: both begin anew from here.
    fn lose_pose(&mut self, now: Instant) {
        self.raise(now, Fault::PoseLost);
        if !self.faults.contains(Fault::PoseLost) {
            return;
        }
        self.mapper.forget();
        self.changed = self.changed.union(&self.mapper.grid().bounds());
        self.inputs.scan = None;
        self.goal = None;
        self.void_job();
        self.stand_here(now);
    }

    /// The place where the car stands is free.
    fn mark_standing(&mut self, now: Instant) {
        if let Some(pose) = self.localizer.pose_at(now) {
            let radius_m = self.params.vehicle.radius_m + self.params.certify.margin_m;
            let insertion = self.mapper.mark_footprint(pose.position, radius_m);
            self.changed = self.changed.union(&insertion.changed);
        }
    }

    fn handle_scan(&mut self, now: Instant, scan: Scan) {
        // Right after a jump the stamps are still settling: centimetres at speed.
        let settled = !self.faults.contains(Fault::ClockJump);
        let Some(pose) = self.localizer.pose_at(scan.stamp).filter(|_| settled) else {
            self.statistics.scans_without_pose += 1;
            return;
        };
        let insertion = self.mapper.insert(&pose, &scan);
        self.changed = self.changed.union(&insertion.changed);
        self.statistics.scans += 1;
        self.inputs.scan = Some((scan.stamp, pose));
        self.health.note_scan(scan.stamp);
        self.guard.handle_scan(&scan);
        self.inputs.raw_scan = Some(Arc::new(scan));
        if insertion.turned_occupied > 0 {
            if let Some(job) = &mut self.in_flight {
                job.outdated = true;
            }
            self.certify_again(now);
        }
        self.request_plan(now);
    }

    /// Time has passed; does what is due.
    pub fn handle_time(&mut self, now: Instant) {
        self.testimony.note_at(now, Happening::Time);
        self.note_time(now);
        if now >= self.next_tick {
            self.note_tick(now, self.next_tick);
            // After a pause (a late caller) the ticks missed are not made up for.
            let tick_s = self.params.autopilot.tick_s();
            let missed = (now.seconds_after(self.next_tick) / tick_s).floor();
            self.next_tick = self.next_tick.offset_by((missed + 1.0) * tick_s);
            self.tick(now);
            self.testify_state(now);
        } else if self.next_tick.seconds_after(now) > GAP_S {
            // Time runs back: nothing is done until it has caught up, and the car, which hears
            // nothing any more, stops by itself.
            self.raise(self.next_tick, Fault::ClockJump);
        }
    }

    // ---- outputs

    /// When [`handle_time`](Self::handle_time) is due next.
    pub const fn poll_at(&self) -> Instant {
        self.next_tick
    }

    /// The next frame to send.
    pub fn poll_frame(&mut self) -> Option<CanFrame> {
        let frame = self.frames.pop_front()?;
        self.testimony.note(Happening::Sent(&frame));
        Some(frame)
    }

    /// The next planning job to run.
    pub fn poll_job(&mut self) -> Option<PlanRequest> {
        let job = self.job.take()?;
        self.testimony.note(Happening::JobAsked { number: job.number });
        Some(job)
    }

    /// The next thing to log.
    pub fn poll_event(&mut self) -> Option<Event> {
        let event = self.events.pop_front()?;
        self.testimony.note(Happening::Event(&event));
        Some(event)
    }

    // ---- inside

    fn transition(&mut self, now: Instant, mode: Mode) {
        if mode != self.mode {
            self.events.push_back(Event::ModeChanged { at: now, from: self.mode, to: mode });
            self.mode = mode;
        }
    }
}
