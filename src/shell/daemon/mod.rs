//! `apexd run`: the daemon. A control thread owns core and bus, a planning thread plans, this one
//! keeps house.

mod change;
mod control;
mod errand;
mod histogram;
mod keeper;
mod link;
mod log;
mod marker;
mod params;
mod realtime;
mod seam;
mod statistics;
mod timing;
mod worker;

use std::ffi::OsString;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::runtime;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

pub use change::{ChangeRefusal, apply as apply_change};
pub use params::DaemonParams;
pub use seam::{CommandRefusal, CoreSnapshot, InnerSeam, Request, Seam};

use super::can::CanLinkError;
use super::cli::RunArgs;
use super::clock::Clock;
use super::logbook::{Logbook, Place, WhenFull};
use super::mavlink::{self, End, Ender, Joined, Mavlink, MavlinkError};
use super::shelved::Limits;
use super::{Exit, complain, configuration, configured, folder, say};
use crate::autopilot::Autopilot;
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::plan::Policy;
use crate::predict;
use crate::record::{Header, Readings, Source, params_text};
use crate::time::Instant;
use control::{Control, Order, Outside, Pulse, Task, Word};
use keeper::Keeper;
use link::SocketLink;
use log::Log;
use marker::Marker;
use statistics::Summary;
use timing::MonotonicTiming;
use worker::{PlanningParams, ThreadWorker};

/// Orders that may wait.
const ORDERS_MAX: usize = 16;

/// Why the daemon did not begin.
#[derive(Debug, thiserror::Error)]
enum StartError {
    #[error(transparent)]
    Link(#[from] CanLinkError),
    #[error("cannot set up the control thread: {0}")]
    System(#[from] std::io::Error),
}

/// Runs the daemon to its end.
pub fn run(
    args: &RunArgs,
    environment: &[(OsString, OsString)],
    verbose: u8,
    out: &mut dyn Write,
) -> Exit {
    let log = Log::new(verbose);
    let params = match configured(&args.config, environment, &args.flags()) {
        Ok(params) => params,
        Err(exit) => return exit,
    };
    let layers = (args.config.clone(), environment.to_vec(), args.flags());
    let load = move || {
        let (config, environment, flags) = &layers;
        configuration::load(config, environment, flags)
    };
    if params.plan.policy == Policy::KnownMap {
        complain("plan.policy known-map needs the true map, which only a simulated world gives");
        return Exit::Configuration;
    }
    if params.daemon.lock_memory {
        realtime::lock_memory();
    }
    let planning = PlanningParams { planner: params.planner(), predict: params.predict.clone() };
    let readings = Readings::default();
    let kept = readings.clone();
    let build = Box::new(move |params: &PlanningParams| worker::build(params, &kept));
    let worker = match ThreadWorker::start(planning, build) {
        Ok(worker) => worker,
        Err(error) => {
            complain(&error.to_string());
            return Exit::Configuration;
        }
    };
    let state_directory = configuration::state_directory(&params, environment);
    let logs = configuration::log_directory(&params, environment);
    let marker = state_directory.as_deref().and_then(|directory| {
        Marker::set(directory)
            .inspect_err(|error| {
                tracing::warn!("cannot leave a mark in {}: {error}", directory.display());
            })
            .ok()
    });
    let task = Task {
        goal: args.goal,
        until_goal: args.until_goal,
        time_limit_s: args.time_limit,
        after_crash: marker.as_ref().is_some_and(|marker| marker.after_crash),
    };
    if task.after_crash {
        tracing::warn!("previous run ended unexpectedly; disarmed");
    }

    let (orders, when_ordered) = mpsc::channel(ORDERS_MAX);
    let (words, when_said) = std::sync::mpsc::channel();
    let (seam, inner_seam) = Seam::new();
    let start = args.start.unwrap_or_else(|| Pose::new(0.0, 0.0, 0.0));
    let restart = Arc::new(AtomicBool::new(false));
    let joined = Joined {
        seam,
        start,
        services: mavlink::services(&params, state_directory.as_deref(), logs.clone()),
        ender: ender(orders.clone(), Arc::clone(&restart)),
    };
    let mavlink = match join(&params, state_directory.as_deref(), joined) {
        Ok(mavlink) => mavlink,
        Err(error) => {
            complain(&error.to_string());
            never_began(marker);
            return Exit::Configuration;
        }
    };
    let pulse = Arc::new(Pulse::default());
    let outside = Outside {
        orders: when_ordered,
        seam: inner_seam,
        words: words.clone(),
        pulse: Arc::clone(&pulse),
        log_dropped: Box::new(log.dropped()),
        recorder: None,
    };
    let records = logs.filter(|_| params.daemon.record);
    let keeper = Keeper {
        orders: orders.clone(),
        words: when_said,
        pulse,
        load: Box::new(load),
        config: args.config.file.clone(),
        watched: state_directory.into_iter().collect(),
        disk_free_min: keeper::disk_free_min(&params),
        tick_rate_hz: params.autopilot.control_rate_hz,
    };
    let control = std::thread::Builder::new().name("apexd-control".into()).spawn(move || {
        let record = Record { folder: records, readings };
        control_thread(params, start, worker, outside, task, record, orders, words)
    });
    let control = match control {
        Ok(control) => control,
        Err(error) => {
            complain(&StartError::from(error).to_string());
            return Exit::Failed;
        }
    };
    keeper.run();
    let summary = match control.join() {
        Ok(Ok(summary)) => summary,
        Ok(Err(error)) => {
            complain(&error.to_string());
            never_began(marker);
            return Exit::Failed;
        }
        Err(panic) => {
            complain(&format!("the control thread failed: {}", worker::panic_text(&*panic)));
            return Exit::Failed;
        }
    };
    drop(mavlink);
    let exit = match exit_of(&summary, task) {
        Exit::Done if restart.load(Ordering::Relaxed) => Exit::Restart,
        exit => exit,
    };
    if summary.outcome != "cut off" {
        end_well(marker);
    }
    tracing::info!("{summary}");
    drop(log);
    if args.json {
        say(out, &serde_json::to_string(&summary).expect("a summary is plain data"));
    }
    exit
}

/// The control thread, from the socket to the last setpoint.
#[expect(clippy::too_many_arguments, reason = "everything that moves into the thread")]
fn control_thread(
    params: Params,
    start: Pose,
    worker: ThreadWorker,
    mut outside: Outside,
    task: Task,
    record: Record,
    orders: mpsc::Sender<Order>,
    words: std::sync::mpsc::Sender<Word>,
) -> Result<Summary, StartError> {
    let clock = Clock::start();
    // Without timers of the runtime: it would ask for the time at every turn.
    let runtime = runtime::Builder::new_current_thread().enable_io().build()?;
    runtime.block_on(async {
        let layout = params.can.layout;
        let link = SocketLink::open(&params.can, clock)?;
        let timing = MonotonicTiming::new(clock)?;
        let mut terminate = signal(SignalKind::terminate())?;
        let mut interrupt = signal(SignalKind::interrupt())?;
        let mut hang_up = signal(SignalKind::hangup())?;
        tokio::spawn(async move {
            loop {
                tokio::select! {
                    _ = terminate.recv() => {}
                    _ = interrupt.recv() => {}
                    _ = hang_up.recv() => {
                        let _ = words.send(Word::Reload);
                        continue;
                    }
                }
                let _ = orders.send(Order::End).await;
            }
        });
        let made = clock.now();
        let mut core = Autopilot::new(params.core(), layout, start, made);
        // Here, where nothing is due yet: it waits for the disk, and its thread must not inherit the
        // priority.
        let logbook = record.begin(&params, start, task.goal, made);
        if let Some(logbook) = &logbook {
            core.set_witness(logbook.recorder().scribe(record.readings));
            outside.recorder = Some(logbook.recorder().clone());
            if let Some(folder) = record.folder {
                let _ = outside.words.send(Word::Recording(folder));
            }
        }
        realtime::raise_priority(params.daemon.priority);
        let summary = Control::new(core, params, link, timing, worker, outside, task).run().await;
        // The last setpoint has been sent. What went wrong has been said.
        let _ = logbook.map(Logbook::close_soon);
        Ok(summary)
    })
}

/// Where the drive is written down.
struct Record {
    folder: Option<PathBuf>,
    /// What the planner's clock shows.
    readings: Readings,
}

impl Record {
    /// Begins the log. Without one the car drives all the same.
    fn begin(
        &self,
        params: &Params,
        start: Pose,
        goal: Option<Point>,
        made: Instant,
    ) -> Option<Logbook> {
        let megabytes = |number: u32| u64::from(number) * 1_000_000;
        let limits = Limits {
            part_bytes: megabytes(params.daemon.log_part_mb),
            kept_bytes: megabytes(params.daemon.log_kept_mb),
            kept_files: params.daemon.log_kept_files as usize,
            free_min: keeper::disk_free_min(params),
        };
        let header = Header {
            build: env!("CARGO_PKG_VERSION").to_owned(),
            source: Source::Run,
            begun_utc: folder::now(),
            made,
            start,
            goal,
            seed: 0,
            params: params_text(params),
            network: predict::network_digest(&params.predict),
            part: 1,
        };
        let place = Place::Folder(self.folder.clone()?, limits);
        Logbook::begin(place, header, None, WhenFull::Drop)
            .inspect(|logbook| tracing::info!("recording to {}", logbook.path().display()))
            .inspect_err(|error| tracing::error!("{error}; the drive is not recorded"))
            .ok()
    }
}

/// MAVLink links, if there are to be any.
fn join(
    params: &Params,
    state_directory: Option<&Path>,
    joined: Joined,
) -> Result<Option<Mavlink>, MavlinkError> {
    let urls = mavlink::parse_list(&params.mavlink.links)?;
    if urls.is_empty() {
        return Ok(None);
    }
    Mavlink::start(&params.mavlink, &urls, state_directory, joined).map(Some)
}

/// Lets a ground station end the daemon, for good or to be started anew.
fn ender(orders: mpsc::Sender<Order>, restart: Arc<AtomicBool>) -> Ender {
    Box::new(move |how| {
        restart.store(how == End::Restart, Ordering::Relaxed);
        orders.try_send(Order::End).map_err(|_| "the daemon takes no more orders".to_owned())
    })
}

fn exit_of(summary: &Summary, task: Task) -> Exit {
    let missed = task.goal.is_some() && !summary.goal_reached;
    match summary.outcome {
        "planner lost" => Exit::Failed,
        "timeout" if missed => Exit::Failed,
        _ => Exit::Done,
    }
}

/// Nothing has moved; but what an earlier run has left behind is still to be known about.
fn never_began(marker: Option<Marker>) {
    end_well(marker.filter(|marker| !marker.after_crash));
}

fn end_well(marker: Option<Marker>) {
    if let Some(Err(error)) = marker.map(Marker::remove) {
        tracing::warn!("cannot take the mark away: {error}");
    }
}

#[cfg(test)]
mod tests;
