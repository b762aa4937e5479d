//! The control loop: joins the core to the bus, the planner and whoever gives orders. It owns the
//! core; nothing in it waits for anything but its own events.

mod bus;
mod ending;

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::mpsc;

use super::change;
use super::errand::{Errand, Step};
use super::link::Link;
use super::seam::{CommandRefusal, CoreSnapshot, InnerSeam, Request};
use super::statistics::{Frames, Statistics, Summary};
use super::timing::Timing;
use super::worker::{Finished, PlanningParams, Worker};
use crate::autopilot::{Autopilot, Command, Event, HostHealth, Mode};
use crate::frames::Point;
use crate::params::Params;
use crate::shell::load::LoadMeter;
use crate::shell::logbook::Recorder;
use crate::shell::simulator::log;
use crate::time::{Duration, Instant};
use crate::wire::can::CanFrame;
use bus::SCANS_MAX;
use ending::{Ending, Reason};

/// Between two snapshots for whoever listens.
const SNAPSHOT_PERIOD: Duration = Duration::from_millis(50);
/// Between two lines of statistics.
const LINE_PERIOD: Duration = Duration::from_secs(1);
/// Between two attempts to arm.
const ERRAND_PERIOD: Duration = Duration::from_millis(50);
/// The car is told for this long that the daemon is disarmed before it ends.
const FAREWELL: Duration = Duration::from_millis(100);
/// What the rest of the daemon has to say to the control loop.
#[derive(Debug)]
pub enum Order {
    /// End, with the car at rest; given twice: at once.
    End,
    /// The configuration as it is now on disk.
    Params(Box<Params>),
    /// Whether the disk is full.
    DiskFull(bool),
}

/// What the control loop has to say to the rest of the daemon.
#[derive(Clone, Debug)]
pub enum Word {
    /// Read the configuration again.
    Reload,
    /// What goes on, for the service manager.
    Status(String),
    /// The drive is written down in this folder.
    Recording(PathBuf),
    /// The end has begun.
    Stopping,
}

/// Shows from outside that the control loop is alive.
#[derive(Debug, Default)]
pub struct Pulse {
    ticks: AtomicU64,
}

impl Pulse {
    /// Ticks so far.
    pub fn ticks(&self) -> u64 {
        self.ticks.load(Ordering::Relaxed)
    }
}

/// The loop's connections to everything that is not the car.
pub struct Outside {
    /// Orders of the daemon.
    pub orders: mpsc::Receiver<Order>,
    /// Requests from anywhere, and what is published.
    pub seam: InnerSeam,
    /// Word to the daemon.
    pub words: std::sync::mpsc::Sender<Word>,
    /// Sign of life.
    pub pulse: Arc<Pulse>,
    /// Counts the lines that the log had no room for.
    pub log_dropped: Box<dyn Fn() -> u64 + Send>,
    /// Writes the drive down; the core has its witness.
    pub recorder: Option<Recorder>,
}

/// What a run is for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Task {
    /// Where to drive, map frame.
    pub goal: Option<Point>,
    /// End once there.
    pub until_goal: bool,
    /// End after this many seconds.
    pub time_limit_s: Option<f64>,
    /// The previous run did not end as it should: no arming without being told.
    pub after_crash: bool,
}

/// The control loop.
pub struct Control<L, T, W> {
    core: Autopilot,
    params: Arc<Params>,
    link: L,
    timing: T,
    worker: W,
    outside: Outside,
    errand: Errand,
    task: Task,
    begun: Instant,
    statistics: Statistics,
    outbox: VecDeque<(Instant, CanFrame)>,
    /// When the bus is offered again what it has not taken.
    send_at: Option<Instant>,
    unsent: u64,
    frames_since_tick: u64,
    frames_blind: u32,
    scans: VecDeque<(Instant, Instant)>,
    scan_driven: Instant,
    job_since: Option<Instant>,
    plans_lost: u64,
    deaf_until: Option<Instant>,
    deaf_reason: String,
    disk_full: bool,
    goal_reached: bool,
    ending: Option<(Reason, Ending)>,
    next_errand: Instant,
    next_snapshot: Instant,
    next_line: Instant,
    load: LoadMeter,
}

impl<L: Link, T: Timing, W: Worker> Control<L, T, W> {
    /// A loop about to begin.
    pub fn new(
        core: Autopilot,
        params: Params,
        link: L,
        timing: T,
        worker: W,
        outside: Outside,
        task: Task,
    ) -> Self {
        let now = timing.now();
        Self {
            core,
            params: Arc::new(params),
            link,
            worker,
            outside,
            errand: Errand::new(task.goal, task.after_crash),
            task,
            begun: now,
            statistics: Statistics::new(now),
            outbox: VecDeque::with_capacity(256),
            send_at: None,
            unsent: 0,
            frames_since_tick: 0,
            frames_blind: 0,
            scans: VecDeque::with_capacity(SCANS_MAX + 1),
            scan_driven: Instant::ZERO,
            job_since: None,
            plans_lost: 0,
            deaf_until: None,
            deaf_reason: String::new(),
            disk_full: false,
            goal_reached: false,
            ending: None,
            next_errand: now,
            next_snapshot: now,
            next_line: now + LINE_PERIOD,
            load: LoadMeter::default(),
            timing,
        }
    }

    /// Runs until the daemon is to end and the car stands.
    pub async fn run(mut self) -> Summary {
        self.report_host(self.begun);
        let reason = loop {
            // In order of urgency; a branch that is not taken has lost nothing.
            tokio::select! {
                biased;
                () = self.timing.until(self.wake_at()) => self.wake(),
                Some(order) = self.outside.orders.recv() => {
                    if self.obey(order) {
                        break Reason::CutOff;
                    }
                }
                finished = self.worker.finished() => self.take_plan(finished),
                received = self.link.receive(), if self.deaf_until.is_none() => match received {
                    Ok(received) => self.hear(received),
                    Err(error) => self.turn_deaf(error.to_string()),
                },
                Some(request) = self.outside.seam.requests.recv() => self.grant(request),
            }
            if let Some((reason, Ending::Farewell { since })) = self.ending
                && self.timing.now().since(since) >= FAREWELL
            {
                break reason;
            }
        };
        self.summary(reason)
    }

    // ---- what comes in

    fn report_host(&mut self, now: Instant) {
        let health = HostHealth {
            disk_full: self.disk_full,
            predictor_missing: self.worker.is_predictor_missing(),
        };
        self.core.handle_host_health(now, health);
    }

    fn take_plan(&mut self, finished: Finished) {
        let now = self.timing.now();
        self.job_since = None;
        match finished {
            Finished::Report(report) => {
                self.statistics.plan.note(report.times.total);
                self.statistics.predict.note(report.times.predict);
                self.core.handle_job_done(now, *report);
            }
            Finished::Lost { number, reason } => {
                tracing::error!(number, "planning failed: {reason}");
                self.plans_lost += 1;
                self.core.handle_job_lost(now, number);
            }
        }
        self.fetch(now);
    }

    /// Does as ordered; says whether that is to end at once.
    fn obey(&mut self, order: Order) -> bool {
        match order {
            Order::End if self.ending.is_some() => {
                tracing::warn!("told to end again: ending at once");
                return true;
            }
            Order::End => self.begin_end(Reason::Asked, "told to end"),
            Order::Params(params) => self.change_all(&params),
            Order::DiskFull(full) => {
                self.disk_full = full;
                self.report_host(self.timing.now());
            }
        }
        false
    }

    fn grant(&mut self, request: Request) {
        match request {
            Request::Command { command, reply } => {
                let answer = if self.ending.is_some() {
                    Err(CommandRefusal::Ending)
                } else {
                    self.command(command).map_err(Into::into)
                };
                // Who does not wait for the answer does not want it.
                let _ = reply.send(answer);
            }
            Request::SetParameter { key, value, reply } => {
                let at_rest = self.core.is_at_rest(self.timing.now());
                let answer = change::apply(Arc::make_mut(&mut self.params), &key, &value, at_rest);
                if answer == Ok(true) {
                    tracing::info!("{key} = {value}");
                    self.put_params();
                }
                let _ = reply.send(answer.map(drop));
            }
            Request::SetFence { fence, reply } => {
                let now = self.timing.now();
                self.core.set_fence(now, fence);
                self.fetch(now);
                let _ = reply.send(());
            }
        }
    }

    fn command(&mut self, command: Command) -> Result<(), crate::autopilot::Refusal> {
        let now = self.timing.now();
        let answer = self.core.handle_command(now, command);
        match &answer {
            Ok(()) => tracing::info!("{command:?}"),
            Err(refusal) => tracing::warn!("{command:?} refused: {refusal}"),
        }
        self.errand.overrule();
        self.fetch(now);
        answer
    }

    /// Takes over what may change now of a new configuration, and refuses the rest by name.
    fn change_all(&mut self, wanted: &Params) {
        let at_rest = self.core.is_at_rest(self.timing.now());
        let mut changed = false;
        for (key, value, _) in change::differences(&self.params, wanted) {
            match change::apply(Arc::make_mut(&mut self.params), &key, &value, at_rest) {
                Ok(_) => {
                    tracing::info!("{key} = {value}");
                    changed = true;
                }
                Err(refusal) => tracing::warn!("{refusal}"),
            }
        }
        if changed {
            self.put_params();
        } else {
            tracing::info!("the configuration changes nothing");
        }
    }

    fn put_params(&mut self) {
        if let Some(recorder) = &self.outside.recorder {
            recorder.note_params(self.timing.now(), Arc::clone(&self.params));
        }
        self.core.set_params(self.params.core());
        self.worker.set_params(PlanningParams {
            planner: self.params.planner(),
            predict: self.params.predict.clone(),
        });
    }

    // ---- time

    /// When there is something to do, whatever comes in.
    fn wake_at(&self) -> Instant {
        let tick = self.core.poll_at();
        self.send_at.map_or(tick, |at| at.min(tick))
    }

    /// Does what is due.
    fn wake(&mut self) {
        self.frames_blind = 0;
        let now = self.timing.now();
        if self.send_at.is_some_and(|at| now >= at) {
            self.send();
        }
        if now >= self.core.poll_at() {
            self.tick(now);
        }
    }

    fn tick(&mut self, now: Instant) {
        let due = self.core.poll_at();
        self.statistics.tick_jitter.note(now.since(due));
        self.statistics.burst.note_count(std::mem::take(&mut self.frames_since_tick));
        if self.deaf_until.is_some_and(|until| now >= until) {
            self.open_again();
        }
        self.report_bus(now);
        self.core.handle_time(now);
        let missed = self.core.poll_at().seconds_after(due) / self.params.autopilot.tick_s();
        self.statistics.ticks += 1;
        self.statistics.ticks_missed += (missed.round() as u64).saturating_sub(1);
        self.fetch(now);
        let sent = self.timing.now();
        self.note_first_use(sent);
        self.statistics.outbox.note_count(self.outbox.len() as u64);
        self.statistics.requests.note_count(self.outside.seam.requests.len() as u64);
        self.statistics.tick.note(sent.since(now));
        self.outside.pulse.ticks.fetch_add(1, Ordering::Relaxed);
        self.look_after(now);
    }

    /// A setpoint of a plan made from a newer scan than before has just been sent.
    fn note_first_use(&mut self, sent: Instant) {
        let stamp = self.core.committed().current().scan_stamp;
        if stamp <= self.scan_driven {
            return;
        }
        self.scan_driven = stamp;
        while let Some((scan, received)) = self.scans.front().copied() {
            if scan > stamp {
                break;
            }
            self.scans.pop_front();
            if scan == stamp && self.core.mode() == Mode::Drive {
                self.statistics.scan_to_setpoint.note(sent.since(received));
            }
        }
    }

    /// What is due now and then.
    fn look_after(&mut self, now: Instant) {
        if now >= self.next_errand {
            self.next_errand = now + ERRAND_PERIOD;
            self.run_errand(now);
        }
        if now >= self.next_snapshot {
            self.next_snapshot = now + SNAPSHOT_PERIOD;
            let mut snapshot = CoreSnapshot::of(&self.core, &self.params, now);
            snapshot.load = self.load.measure(now);
            snapshot.counts.error_frames = self.link.statistics().error_frames;
            self.outside.seam.snapshots.send_replace(Some(Arc::new(snapshot)));
        }
        if now >= self.next_line {
            self.next_line = now + LINE_PERIOD;
            self.report_host(now);
            self.write_line(now);
        }
        let patience_s = self.params.daemon.planner_limit_s;
        if self.job_since.is_some_and(|since| now.seconds_after(since) > patience_s) {
            self.begin_end(Reason::PlannerLost, "the planner does not come back");
        }
        let limit_s = self.task.time_limit_s.unwrap_or(f64::INFINITY);
        if now.seconds_after(self.begun) > limit_s {
            self.begin_end(Reason::TimeLimit, "the time is up");
        }
        self.advance_end(now);
    }

    fn run_errand(&mut self, now: Instant) {
        if self.ending.is_some() {
            return;
        }
        match self.errand.step(&mut self.core, now) {
            Step::Nothing => {}
            Step::Said(text) => {
                tracing::info!("{text}");
                let _ = self.outside.words.send(Word::Status(text));
            }
        }
        self.fetch(now);
    }

    fn write_line(&mut self, now: Instant) {
        for age in self.core.take_plan_ages() {
            self.statistics.age.note(age);
        }
        let cpu = self.statistics.note_cpu(now);
        let frames = self.frames();
        let dropped = (self.outside.log_dropped)();
        let line = self.statistics.line(cpu, &frames, dropped);
        let speed_mps = self.core.state(now).map_or(0.0, |(_, speed)| speed);
        let mode = self.core.mode().name();
        tracing::info!("{mode} {speed_mps:.2} m/s; {line}");
        let mut status = format!("{mode}, {speed_mps:.1} m/s");
        for (i, fault) in self.core.faults().iter().enumerate() {
            status += if i == 0 { "; faults: " } else { ", " };
            status += fault.name();
        }
        if self.core.mode() == Mode::Disarmed
            && let Some(why) = self.errand.why_disarmed()
        {
            status = format!("{why}; {status}");
        }
        let _ = self.outside.words.send(Word::Status(status));
    }

    // ---- what goes out

    /// Takes what the core wants to send, have planned, and have said.
    fn fetch(&mut self, now: Instant) {
        let waiting = self.outbox.len();
        while let Some(frame) = self.core.poll_frame() {
            self.outbox.push_back((now, frame));
        }
        if self.outbox.len() > waiting {
            self.send();
        }
        if let Some(request) = self.core.poll_job() {
            self.job_since.get_or_insert(now);
            self.worker.submit(request);
        }
        while let Some(event) = self.core.poll_event() {
            log(&event);
            match &event {
                Event::FaultRaised { at, fault } => self.statistics.note_fault(*at, *fault),
                Event::GoalReached { .. } => {
                    self.goal_reached = true;
                    if self.task.until_goal {
                        self.begin_end(Reason::Goal, "at the goal");
                    }
                }
                _ => {}
            }
            // Nobody may be listening.
            let _ = self.outside.seam.events.send(event);
        }
    }

    // ---- figures

    fn frames(&self) -> Frames {
        let wire = self.core.wire_statistics();
        let link = self.link.statistics();
        Frames {
            received: link.received,
            lost: wire.lost,
            refused: wire.wrong_length
                + wire.wrong_crc
                + wire.repeated
                + wire.wrong_sequence
                + wire.bad_value,
            dropped: link.dropped,
            incomplete: wire.incomplete,
            foreign: wire.foreign,
            sent: link.sent,
            unsent: self.unsent,
            errors: link.error_frames,
        }
    }

    fn summary(mut self, reason: Reason) -> Summary {
        let now = self.timing.now();
        for age in self.core.take_plan_ages() {
            self.statistics.age.note(age);
        }
        let core = self.core.statistics();
        let mut summary = Summary {
            mode: self.core.mode().name(),
            outcome: match reason {
                _ if self.goal_reached && reason != Reason::PlannerLost => "goal",
                Reason::Goal => "goal",
                Reason::Asked => "stopped",
                Reason::CutOff => "cut off",
                Reason::TimeLimit => "timeout",
                Reason::PlannerLost => "planner lost",
            },
            goal_reached: self.goal_reached,
            scans: core.scans,
            replans: core.replans,
            plans_late: core.plans_late,
            plans_lost: self.plans_lost,
            guard_stops: core.guard_stops,
            frames: self.frames(),
            log_dropped: (self.outside.log_dropped)(),
            record_dropped: self.outside.recorder.as_ref().map_or(0, Recorder::dropped),
            ..Summary::default()
        };
        self.statistics.fill(now, &mut summary);
        summary
    }
}
