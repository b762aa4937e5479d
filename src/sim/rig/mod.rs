//! The rig: the autopilot core on one end of the virtual bus, the simulated car on the other, a
//! virtual clock in between.
//!
//! The same loop serves `apexd sil` and the tests. Core and car exchange nothing but CAN frames.
//! Planning runs in line; its answer is handed back after the latency asked for, so that age of
//! information is not fiction.

mod process;
mod setup;
mod snapshot;

use std::collections::VecDeque;

use process::Process;
pub use setup::{Latency, RigSetup, SetupError, grid_of};
use snapshot::Album;
pub use snapshot::Snapshot;

use crate::autopilot::{Autopilot, Command, CoreParams, Event, Fault, Mode};
use crate::frames::Point;
use crate::plan::{PlanRequest, PlannerParams, Planning, StepReport};
use crate::sim::account::Account;
use crate::sim::bus::NodeId;
use crate::sim::car::CarState;
use crate::sim::car_end::CarEnd;
use crate::sim::drive::{Outcome, PlanMark, Spread, Summary, Trace, TraceSample};
use crate::sim::faults::FaultyBus;
use crate::sim::judge::Judge;
use crate::sim::world::World;
use crate::time::{Duration, Instant};

/// Physics and the judge run at this period.
const STEP: Duration = Duration::from_millis(1);
/// The trace keeps a sample this often, in steps.
const TRACE_STEPS: u64 = 10;
/// At rest for this long without a plan worth driving, the car is stuck, seconds.
const STUCK_S: f64 = 5.0;
/// A plan worth driving is longer than this, metres.
const WORTH_DRIVING_M: f64 = 0.1;
/// Below this speed the car counts as standing, m/s: the controller holds it there.
const REST_SPEED_MPS: f64 = 1e-3;

/// A simulated drive.
pub struct Rig {
    world: World,
    account: Account,
    judge: Judge,
    bus: FaultyBus,
    daemon_node: NodeId,
    car_node: NodeId,
    core: Autopilot,
    planner: Box<dyn Planning>,
    car: CarEnd,
    goal: Option<Point>,
    goal_radius_m: f64,
    latency: Latency,
    time_limit_s: f64,
    now: Instant,
    steps: u64,
    job: Option<(Instant, StepReport)>,
    process: Process,
    started: Option<Instant>,
    moved_m: f64,
    last_useful: Instant,
    outcome: Option<Outcome>,
    interrupted: bool,
    scans_seen: u64,
    events: VecDeque<Event>,
    plan_ms: Vec<f64>,
    predict_ms: Vec<f64>,
    predict_effort: [u64; 2],
    reports: Option<Vec<(PlanRequest, StepReport)>>,
    album: Option<Album>,
    trace: Trace,
    digest: crc::Digest<'static, u64>,
}

static DIGEST: crc::Crc<u64> = crc::Crc::<u64>::new(&crc::CRC_64_XZ);

impl Rig {
    /// A rig with the car at rest at the start.
    ///
    /// # Errors
    /// If start or goal lie in a wall, or the predictor cannot be made.
    pub fn new(setup: RigSetup) -> Result<Self, SetupError> {
        setup.build()
    }

    /// The clock's reading.
    pub const fn now(&self) -> Instant {
        self.now
    }

    /// How the drive ended, once it has.
    pub const fn outcome(&self) -> Option<Outcome> {
        self.outcome
    }

    /// The true state of the car.
    pub const fn car(&self) -> &CarState {
        self.car.state()
    }

    /// The core under test.
    pub const fn core(&self) -> &Autopilot {
        &self.core
    }

    /// The core under test, to give it commands.
    pub fn core_mut(&mut self) -> &mut Autopilot {
        &mut self.core
    }

    /// The true world.
    pub const fn world(&self) -> &World {
        &self.world
    }

    /// The true world, to set things down in it.
    pub fn world_mut(&mut self) -> &mut World {
        &mut self.world
    }

    /// What the beams have shown, by the simulator's own account.
    pub const fn account(&self) -> &Account {
        &self.account
    }

    /// Contacts and unknown entries so far.
    pub const fn judge(&self) -> &Judge {
        &self.judge
    }

    /// Presses or releases the emergency-stop button.
    pub fn set_emergency_stop(&mut self, pressed: bool) {
        self.car.set_emergency_stop(pressed);
    }

    /// Sets another goal, or the first one; the drive starts when the core takes it.
    pub fn set_goal(&mut self, goal: Point) {
        self.goal = Some(goal);
        self.outcome = None;
        // A refusal is repeated until the core is ready.
        if self.core.mode().is_armed() {
            let _ = self.core.handle_command(self.now, Command::Goto(goal));
        }
    }

    /// Takes new parameters of core and planner, as a running daemon does.
    pub fn set_params(&mut self, core: CoreParams, planner: &PlannerParams) {
        self.core.set_params(core);
        self.planner.set_params(planner);
    }

    /// Ends the drive early: the car comes to rest along its plan, which ends the drive as
    /// [`Outcome::Interrupted`].
    pub fn interrupt(&mut self) {
        self.interrupted = true;
    }

    /// From now on keeps every request with its answer, for [`take_reports`](Self::take_reports).
    pub fn keep_reports(&mut self) {
        self.reports.get_or_insert_default();
    }

    /// From now on looks now and then at what the planner foresees, for
    /// [`snapshot`](Self::snapshot): at a time in seconds from the first motion on, or halfway.
    pub fn keep_snapshot(&mut self, at_s: Option<f64>) {
        self.album = Some(Album::new(at_s));
    }

    /// What the planner foresaw nearest to the time asked for, so far.
    pub fn snapshot(&self) -> Option<&Snapshot> {
        self.album.as_ref()?.chosen(self.driven_s())
    }

    /// What the planner foresaw at moments spread over the drive so far, in order.
    pub fn snapshots(&self) -> &[Snapshot] {
        self.album.as_ref().map_or(&[], Album::kept)
    }

    /// Seconds since the first motion.
    fn driven_s(&self) -> f64 {
        self.started.map_or(0.0, |at| self.now.seconds_after(at))
    }

    /// The planning steps since the last call.
    pub fn take_reports(&mut self) -> Vec<(PlanRequest, StepReport)> {
        self.reports.as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// The core's next event that nobody has taken yet.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// The course of the drive so far.
    pub const fn trace(&self) -> &Trace {
        &self.trace
    }

    /// Distance travelled, metres.
    pub const fn distance_m(&self) -> f64 {
        self.moved_m
    }

    /// Runs until the drive has ended; `each` is called after every simulated millisecond.
    pub fn drive(&mut self, mut each: impl FnMut(&mut Self)) -> Outcome {
        loop {
            if let Some(outcome) = self.outcome {
                return outcome;
            }
            self.step();
            each(self);
        }
    }

    /// One millisecond.
    pub fn step(&mut self) {
        let end = self.now + STEP;
        self.settle(end);
        self.now = end;
        self.steps += 1;

        let before = self.car.state().pose.position;
        self.car.step(end, STEP.as_secs_f64(), &self.world);
        self.moved_m += (self.car.state().pose.position - before).norm();
        while let Some(frame) = self.car.poll_frame() {
            // A full queue loses the frame, as a real controller's would.
            let _ = self.bus.send(end, self.car_node, frame);
        }
        let verdict =
            self.judge.observe(&self.world, &self.account, self.car.state().pose.position);
        if self.process.is_stopped(self.now) {
            // Nobody listens.
        } else if self.interrupted {
            // Refused where the car is at rest or coming to rest anyway.
            let _ = self.core.handle_command(self.now, Command::Pause);
        } else {
            self.start_when_ready();
        }
        self.judge_outcome(verdict.contact);
        if self.steps.is_multiple_of(TRACE_STEPS) && self.started.is_some() {
            self.trace.samples.push(self.sample());
        }
    }

    /// The figures of the drive; `wall_s` is how long it took on the wall clock.
    pub fn summary(&self, wall_s: f64) -> Summary {
        let statistics = self.core.statistics();
        let ages: Vec<f64> =
            statistics.plan_ages.iter().map(|age| age.as_secs_f64() * 1e3).collect();
        let replans = statistics.replans;
        let per_step = |count: u64| count as f64 / self.predict_ms.len().max(1) as f64;
        Summary {
            outcome: self.outcome.unwrap_or(if self.interrupted {
                Outcome::Interrupted
            } else {
                Outcome::Timeout
            }),
            time_s: self.driven_s(),
            path_m: self.moved_m,
            collisions: self.judge.collisions(),
            unknown_entries: self.judge.unknown_entries(),
            min_clearance_m: self.judge.min_clearance_m(),
            replans,
            plans_rejected: statistics.plans_rejected,
            guard_stops: statistics.guard_stops,
            candidates: statistics.candidates as f64 / replans.max(1) as f64,
            plan_ms: Spread::of(&self.plan_ms),
            predict_ms: Spread::of(&self.predict_ms),
            predict_context: per_step(self.predict_effort[0]),
            predict_decoded: per_step(self.predict_effort[1]),
            prediction_faults: statistics.prediction_faults,
            age_ms: Spread::of(&ages),
            realtime_factor: if wall_s > 0.0 { self.now.as_secs_f64() / wall_s } else { 0.0 },
            digest: format!("{:016x}", self.digest.clone().finalize()),
        }
    }

    /// Lets everything happen on the bus and in the core until `end`.
    fn settle(&mut self, end: Instant) {
        loop {
            let job = self.job.as_ref().map(|(at, _)| self.process.wakes_at(*at));
            let tick = self.process.ticks_at(self.core.poll_at());
            let next = [self.bus.poll_at(), Some(tick), job]
                .into_iter()
                .flatten()
                .min()
                .filter(|at| *at <= end);
            let Some(next) = next else { break };
            self.now = self.now.max(next);
            self.bus.advance(self.now);
            while let Some((at, frame)) = self.bus.receive(self.car_node) {
                self.car.handle_frame(at, &frame);
            }
            if self.process.is_stopped(self.now) {
                continue;
            }
            while let Some((at, frame)) = self.bus.receive(self.daemon_node) {
                self.core.handle_frame(Process::stamp(self.now, at), &frame);
                self.enter_delivered_scan();
            }
            if let Some((_, report)) = self.job.take_if(|(at, _)| *at <= self.now) {
                self.core.handle_job_done(self.now, report);
            }
            if self.now >= tick {
                self.core.handle_time(self.now);
            }
            self.fetch();
        }
    }

    /// Takes what the core wants to send, have planned, and have said.
    fn fetch(&mut self) {
        while let Some(frame) = self.core.poll_frame() {
            self.digest.update(frame.data());
            let _ = self.bus.send(self.now, self.daemon_node, frame);
        }
        if let Some(request) = self.core.poll_job() {
            let report = self.planner.step(&request);
            self.plan_ms.push(report.times.total.as_secs_f64() * 1e3);
            self.predict_ms.push(report.times.predict.as_secs_f64() * 1e3);
            let effort = report.prediction.effort;
            self.predict_effort[0] += u64::from(effort.context);
            self.predict_effort[1] += u64::from(effort.decoded);
            let done = match self.latency {
                Latency::Fixed(seconds) => self.now.offset_by(seconds),
                Latency::Measured => self.now + report.times.total,
            };
            let t_s = self.driven_s();
            if let Some(album) = &mut self.album {
                album.step(t_s, &request, &report, &mut *self.planner);
            }
            if let Some(reports) = &mut self.reports {
                reports.push((request, report.clone()));
            }
            let never = Instant::from_nanos(u64::MAX);
            self.job = Some((if self.process.planner_hangs { never } else { done }, report));
        }
        while let Some(event) = self.core.poll_event() {
            if let Event::PlanAdopted { stop, length_m, .. } = event {
                let t_s = self.now.as_secs_f64();
                self.trace.plans.push(PlanMark { t_s, stop });
                if length_m > WORTH_DRIVING_M {
                    self.last_useful = self.now;
                }
            }
            self.events.push_back(event);
        }
    }

    /// Only scans that reached the core whole count as seen.
    fn enter_delivered_scan(&mut self) {
        if self.core.statistics().scans == self.scans_seen {
            return;
        }
        self.scans_seen = self.core.statistics().scans;
        let Some(sequence) = self.core.newest_scan().map(|scan| scan.sequence) else { return };
        if let Some((pose, ranges)) = self.car.take_sent_scan(sequence) {
            self.account.delivered(&self.world, self.car.fan(), pose, &ranges);
        }
    }

    /// Arms and gives the goal as soon as the core has heard from every sensor.
    fn start_when_ready(&mut self) {
        let Some(goal) = self.goal else { return };
        if self.core.mode() == Mode::Disarmed
            && self.steps.is_multiple_of(50)
            && self.core.handle_command(self.now, Command::Arm).is_ok()
            && self.core.handle_command(self.now, Command::Goto(goal)).is_ok()
        {
            self.last_useful = self.now;
        }
    }

    fn judge_outcome(&mut self, contact: bool) {
        let state = self.car.state();
        let moving = state.speed_mps > REST_SPEED_MPS;
        if moving {
            self.started.get_or_insert(self.now);
            self.last_useful = self.now;
        }
        let waited = self.now.seconds_after(self.started.unwrap_or(Instant::ZERO));
        let Some(goal) = self.goal else {
            // Whoever commands the car decides where it goes and when it is there.
            self.outcome = if contact {
                Some(Outcome::Collision)
            } else if self.interrupted && !moving {
                Some(Outcome::Interrupted)
            } else if waited > self.time_limit_s {
                Some(Outcome::Timeout)
            } else {
                None
            };
            return;
        };
        let at_goal = (state.pose.position - goal).norm() <= self.goal_radius_m;
        let stands = !moving && self.now.seconds_after(self.last_useful) > STUCK_S;
        self.outcome = if contact {
            Some(Outcome::Collision)
        } else if at_goal && !moving && self.core.goal().is_none() && self.core.mode().is_armed() {
            Some(Outcome::Goal)
        } else if self.core.faults().contains(Fault::GoalUnreachable) && !moving {
            Some(Outcome::Unreachable)
        } else if self.interrupted && !moving {
            Some(Outcome::Interrupted)
        } else if stands {
            Some(Outcome::Stuck)
        } else if waited > self.time_limit_s {
            Some(Outcome::Timeout)
        } else {
            None
        };
    }

    fn sample(&self) -> TraceSample {
        let state = self.car.state();
        let setpoint = self.car.setpoint();
        TraceSample {
            t_s: self.now.as_secs_f64(),
            pose: state.pose,
            speed_mps: state.speed_mps,
            curvature_pm: state.curvature_pm,
            longitudinal_n: setpoint.longitudinal_n,
            lateral_n: setpoint.lateral_n,
        }
    }
}
