//! What the daemon knows of itself: how punctual it is, what it costs, what was lost.

use std::fmt;

use nix::sys::resource::{UsageWho, getrusage};
use nix::sys::time::TimeValLike;
use serde::Serialize;

use super::histogram::Durations;
use crate::autopilot::Fault;
use crate::sim::drive::Spread;
use crate::time::{Duration, Instant};

/// A figure in the second under way and since the start.
#[derive(Clone, Debug, Default)]
pub struct Figure {
    second: Durations,
    all: Durations,
}

impl Figure {
    /// One more duration.
    pub fn note(&mut self, duration: Duration) {
        self.second.note(duration);
        self.all.note(duration);
    }

    /// One more number.
    pub fn note_count(&mut self, count: u64) {
        self.second.note_count(count);
        self.all.note_count(count);
    }
}

/// Gathers the figures; in fixed memory but for the few kinds of faults.
#[derive(Debug)]
pub struct Statistics {
    begun: Instant,
    /// Control ticks done.
    pub ticks: u64,
    /// Control ticks that were so late that the next one was due.
    pub ticks_missed: u64,
    /// From when a tick was due to when it began.
    pub tick_jitter: Figure,
    /// Length of a tick, its frames sent.
    pub tick: Figure,
    /// From the last frame of a scan to the first setpoint of a plan made from it.
    pub scan_to_setpoint: Figure,
    /// Planning steps.
    pub plan: Figure,
    /// Their share in predicting.
    pub predict: Figure,
    /// Age of the newest scan in the plan being driven.
    pub age: Figure,
    /// Frames taken from the bus without a pause.
    pub burst: Figure,
    /// Frames waiting to be sent, at each tick.
    pub outbox: Figure,
    /// Requests from outside that wait, at each tick.
    pub requests: Figure,
    /// CPU time of the process in a second, thousandths.
    cpu: Durations,
    cpu_before: Option<(Instant, Duration)>,
    cpu_first: Option<(Instant, Duration)>,
    faults: Vec<FaultFigures>,
}

/// How often a fault was raised.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FaultFigures {
    /// Its name.
    pub name: &'static str,
    /// When it was raised first, seconds since the daemon's start.
    pub first_s: f64,
    /// How often.
    pub count: u64,
}

/// CPU time over wall time of the whole process, in cores.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Cpu {
    /// Over the whole run.
    pub mean: f64,
    /// Median of the seconds.
    pub p50: f64,
    /// 99th percentile of the seconds.
    pub p99: f64,
    /// Busiest second.
    pub max: f64,
}

/// Counts of frames since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Frames {
    /// Taken from the bus.
    pub received: u64,
    /// Missing by their counters.
    pub lost: u64,
    /// Received and not taken: wrong CRC, length, counter or value.
    pub refused: u64,
    /// Dropped by the kernel because the daemon did not read them in time.
    pub dropped: u64,
    /// Scans and measurements dropped because a part was missing.
    pub incomplete: u64,
    /// Received, but none of the car's.
    pub foreign: u64,
    /// Given to the bus.
    pub sent: u64,
    /// That the bus did not take.
    pub unsent: u64,
    /// Error reports of the driver.
    pub errors: u64,
}

/// Lengths of queues.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Queues {
    /// Frames taken from the bus without a pause.
    pub received: Spread,
    /// Frames waiting to be sent, at each tick.
    pub to_send: Spread,
    /// Requests from outside that wait, at each tick.
    pub requests: Spread,
}

/// Everything, for people and scripts.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Summary {
    /// What the core was doing at last.
    pub mode: &'static str,
    /// How the run ended: `goal`, `stopped` (told to end), `timeout`, `cut off` (told to end
    /// twice), `planner lost`.
    pub outcome: &'static str,
    /// Whether the car came to rest at the goal.
    pub goal_reached: bool,
    /// Since the start of the daemon, seconds.
    pub time_s: f64,
    /// Control ticks.
    pub ticks: u64,
    /// Ticks so late that the next one was due.
    pub ticks_missed: u64,
    /// From when a tick was due to when it began.
    pub tick_jitter_ms: Spread,
    /// Length of a tick.
    pub tick_ms: Spread,
    /// From the last frame of a scan to the first setpoint of a plan made from it.
    pub scan_to_setpoint_ms: Spread,
    /// Planning steps.
    pub plan_ms: Spread,
    /// Predicting in them.
    pub predict_ms: Spread,
    /// Age of the newest scan in the plan being driven.
    pub age_ms: Spread,
    /// Scans that reached the map.
    pub scans: u64,
    /// Planning steps.
    pub replans: u64,
    /// Plans that came too late.
    pub plans_late: u64,
    /// Planning steps that never came back.
    pub plans_lost: u64,
    /// Times that the guard took over.
    pub guard_stops: u64,
    /// CPU time over wall time, in cores.
    pub cpu: Cpu,
    /// Frames.
    pub frames: Frames,
    /// Queues.
    pub queues: Queues,
    /// Lines that the log had no room for.
    pub log_dropped: u64,
    /// Pieces of the drive's log dropped because the disk did not keep up or failed.
    pub record_dropped: u64,
    /// Faults raised, in order of their first time.
    pub faults: Vec<FaultFigures>,
}

/// Of durations in milliseconds.
fn text_ms(Spread { p50, p99, max }: &Spread) -> String {
    format!("{p50:.2}/{p99:.2}/{max:.2}")
}

impl fmt::Display for Frames {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { received, lost, refused, dropped, unsent, .. } = self;
        write!(
            f,
            "{received} frames received, {lost} lost, {refused} refused, {dropped} dropped, \
             {unsent} unsent"
        )
    }
}

impl fmt::Display for Queues {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let of = |Spread { p50, p99, max }: &Spread| format!("{p50:.0}/{p99:.0}/{max:.0}");
        let (received, to_send) = (of(&self.received), of(&self.to_send));
        write!(f, "queues {received} received {to_send} to send {} requests", of(&self.requests))
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} after {:.1} s, {} ticks ({} missed); ms p50/p99/max: jitter {} tick {} \
             scan-to-setpoint {} plan {} predict {} age {}; {} scans, {} plans ({} late, {} lost), {} \
             guard stops; cpu {:.0} % (busiest second {:.0} %), {}; {}, {} log lines dropped",
            self.outcome,
            self.time_s,
            self.ticks,
            self.ticks_missed,
            text_ms(&self.tick_jitter_ms),
            text_ms(&self.tick_ms),
            text_ms(&self.scan_to_setpoint_ms),
            text_ms(&self.plan_ms),
            text_ms(&self.predict_ms),
            text_ms(&self.age_ms),
            self.scans,
            self.replans,
            self.plans_late,
            self.plans_lost,
            self.guard_stops,
            self.cpu.mean * 100.0,
            self.cpu.max * 100.0,
            self.frames,
            self.queues,
            self.log_dropped,
        )
    }
}

impl Statistics {
    /// Nothing yet.
    pub fn new(now: Instant) -> Self {
        Self {
            begun: now,
            ticks: 0,
            ticks_missed: 0,
            tick_jitter: Figure::default(),
            tick: Figure::default(),
            scan_to_setpoint: Figure::default(),
            plan: Figure::default(),
            predict: Figure::default(),
            age: Figure::default(),
            burst: Figure::default(),
            outbox: Figure::default(),
            requests: Figure::default(),
            cpu: Durations::default(),
            cpu_before: None,
            cpu_first: None,
            faults: Vec::new(),
        }
    }

    /// A fault was raised.
    pub fn note_fault(&mut self, at: Instant, fault: Fault) {
        let name = fault.name();
        match self.faults.iter_mut().find(|figures| figures.name == name) {
            Some(figures) => figures.count += 1,
            None => {
                let first_s = at.seconds_after(self.begun);
                self.faults.push(FaultFigures { name, first_s, count: 1 });
            }
        }
    }

    /// Takes up the CPU time of the process; gives that of the time since the call before, in cores.
    pub fn note_cpu(&mut self, now: Instant) -> f64 {
        let Some(spent) = cpu_time() else { return 0.0 };
        self.cpu_first.get_or_insert((now, spent));
        let cores = self.cpu_before.map_or(0.0, |before| cores(before, (now, spent)));
        if self.cpu_before.replace((now, spent)).is_some() {
            self.cpu.note_count((cores * 1e3) as u64);
        }
        cores
    }

    fn cpu(&self, now: Instant) -> Cpu {
        let Spread { p50, p99, max } = self.cpu.spread();
        let mean = match (self.cpu_first, cpu_time()) {
            (Some(first), Some(spent)) => cores(first, (now, spent)),
            _ => 0.0,
        };
        Cpu { mean, p50: p50 * 1e-3, p99: p99 * 1e-3, max: max * 1e-3 }
    }

    /// The line of a second that has passed; the next one begins.
    pub fn line(&mut self, cpu: f64, frames: &Frames, log_dropped: u64) -> String {
        let of = |figure: &Figure| text_ms(&figure.second.spread_ms());
        let line = format!(
            "ms p50/p99/max: jitter {} tick {} scan-to-setpoint {} plan {} predict {}; cpu \
             {:.0} %, {frames}; {}, {} log lines dropped",
            of(&self.tick_jitter),
            of(&self.tick),
            of(&self.scan_to_setpoint),
            of(&self.plan),
            of(&self.predict),
            cpu * 100.0,
            Queues {
                received: self.burst.second.spread(),
                to_send: self.outbox.second.spread(),
                requests: self.requests.second.spread(),
            },
            log_dropped,
        );
        for figure in [
            &mut self.tick_jitter,
            &mut self.tick,
            &mut self.scan_to_setpoint,
            &mut self.plan,
            &mut self.predict,
            &mut self.age,
            &mut self.burst,
            &mut self.outbox,
            &mut self.requests,
        ] {
            figure.second.clear();
        }
        line
    }

    /// Fills in what it knows.
    pub fn fill(&self, now: Instant, summary: &mut Summary) {
        summary.time_s = now.seconds_after(self.begun);
        summary.ticks = self.ticks;
        summary.ticks_missed = self.ticks_missed;
        summary.tick_jitter_ms = self.tick_jitter.all.spread_ms();
        summary.tick_ms = self.tick.all.spread_ms();
        summary.scan_to_setpoint_ms = self.scan_to_setpoint.all.spread_ms();
        summary.plan_ms = self.plan.all.spread_ms();
        summary.predict_ms = self.predict.all.spread_ms();
        summary.age_ms = self.age.all.spread_ms();
        summary.cpu = self.cpu(now);
        summary.queues = Queues {
            received: self.burst.all.spread(),
            to_send: self.outbox.all.spread(),
            requests: self.requests.all.spread(),
        };
        summary.faults.clone_from(&self.faults);
    }
}

/// CPU time of the process so far.
fn cpu_time() -> Option<Duration> {
    let usage = getrusage(UsageWho::RUSAGE_SELF).ok()?;
    let us = usage.user_time().num_microseconds() + usage.system_time().num_microseconds();
    u64::try_from(us).ok().map(Duration::from_micros)
}

fn cores(before: (Instant, Duration), after: (Instant, Duration)) -> f64 {
    let wall_s = after.0.seconds_after(before.0);
    let spent_s = after.1.saturating_sub(before.1).as_secs_f64();
    if wall_s > 0.0 { spent_s / wall_s } else { 0.0 }
}
