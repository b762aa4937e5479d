//! Drives the drives of an experiment, several at a time, until they are done or a person ends it.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;
use tokio::signal::unix::{SignalKind, signal};

use super::store::{Store, StoreError};
use crate::experiment::results::Results;
use crate::experiment::run::{Driven, RunError, Task, Tools, execute};
use crate::plan::Stopwatch;
use crate::shell::pace;
use crate::shell::report::{ReportError, Scenery, write_snapshot};
use crate::shell::simulator::walls;

/// Why the work came to an end before its time.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// A drive could not begin.
    #[error("{error}; it was to be {command}")]
    Run {
        /// Why.
        error: RunError,
        /// The command that repeats it.
        command: String,
    },
    /// Results could not be written.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A picture could not be written.
    #[error(transparent)]
    Report(#[from] ReportError),
    /// There are no threads or signals to be had.
    #[error("cannot work: {0}")]
    System(String),
}

/// What came of the work.
#[derive(Debug, Default)]
pub struct Done {
    /// Whether a person ended it early.
    pub interrupted: bool,
    /// Commands of drives that the program did not survive.
    pub crashed: Vec<String>,
}

/// Drives what is not among the results yet; `show` hears how many of how many are done.
///
/// # Errors
/// If a drive cannot begin, or its result cannot be written.
pub fn drive(
    tasks: &[Task],
    results: &mut Results,
    store: &Store,
    pictures: &Path,
    jobs: usize,
    program: &str,
    show: &(dyn Fn(usize, usize) + Sync),
) -> Result<Done, WorkError> {
    let open: Vec<&Task> = tasks.iter().filter(|task| !results.contains(&task.key())).collect();
    let stop = AtomicBool::new(false);
    let begun = pace::now();
    let stopwatch = || Box::new(move || begun.elapsed()) as Stopwatch;
    let tools = Tools { stopwatch: &stopwatch, stop: &stop, program };
    let done = AtomicUsize::new(tasks.len() - open.len());
    show(done.load(Ordering::Relaxed), tasks.len());
    let fresh = Mutex::new(Vec::new());
    let crashed = Mutex::new(Vec::new());
    let system = |error: &dyn std::fmt::Display| WorkError::System(error.to_string());
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(jobs)
        .build()
        .map_err(|error| system(&error))?;
    let one = |task: &&Task| -> Result<(), WorkError> {
        if stop.load(Ordering::Relaxed) {
            return Ok(());
        }
        let command = || task.spec.command();
        let Ok(result) = catch_unwind(AssertUnwindSafe(|| execute(task, &tools))) else {
            tracing::error!(command = command(), "the drive crashed");
            crashed.lock().unwrap_or_else(PoisonError::into_inner).push(command());
            return Ok(());
        };
        let driven = result.map_err(|error| WorkError::Run { error, command: command() })?;
        let Some(driven) = driven else { return Ok(()) };
        write_snapshots(pictures, &driven)?;
        store.append(&driven.record)?;
        fresh.lock().unwrap_or_else(PoisonError::into_inner).push(driven.record);
        show(done.fetch_add(1, Ordering::Relaxed) + 1, tasks.len());
        Ok(())
    };
    let outcome = watched(&stop, || {
        // One by one, so that a thread that is through with its own takes over others.
        pool.install(|| open.par_iter().with_max_len(1).try_for_each(one))
    })
    .map_err(|error| system(&error))?;
    for record in fresh.into_inner().unwrap_or_else(PoisonError::into_inner) {
        let path = pictures.to_owned();
        results
            .add(record)
            .map_err(|error| StoreError::Results { path, error: Box::new(error) })?;
    }
    outcome?;
    Ok(Done {
        interrupted: stop.load(Ordering::Relaxed),
        crashed: crashed.into_inner().unwrap_or_else(PoisonError::into_inner),
    })
}

/// Works while a thread beside it listens for Ctrl-C and SIGTERM.
fn watched<T>(stop: &AtomicBool, work: impl FnOnce() -> T) -> std::io::Result<T> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let _inside = runtime.enter();
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let (finished, ended) = tokio::sync::oneshot::channel::<()>();
    Ok(std::thread::scope(|scope| {
        let runtime = &runtime;
        scope.spawn(move || {
            runtime.block_on(async {
                tokio::select! {
                    _ = interrupt.recv() => {}
                    _ = terminate.recv() => {}
                    _ = ended => return,
                }
                tracing::warn!("interrupted: the drives under way are given up");
                stop.store(true, Ordering::Relaxed);
            });
        });
        let value = work();
        // Nobody listens any longer if a signal came.
        let _ = finished.send(());
        value
    }))
}

fn write_snapshots(folder: &Path, driven: &Driven) -> Result<(), ReportError> {
    let spec = &driven.record.task.spec;
    let truth = if driven.snapshots.is_empty() { Vec::new() } else { walls(&driven.place.world) };
    let title = format!("{} · {} m/s", spec.method(), spec.speed_max_mps);
    let goal_radius_m = spec.params().map_or(0.5, |params| params.autopilot.goal_radius_m);
    let scenery = Scenery { title: &title, truth: &truth, goal: driven.place.goal, goal_radius_m };
    for (i, snapshot) in driven.snapshots.iter().enumerate() {
        let name = format!("prediction-{}-{}-{}", spec.world.family(), spec.method(), i + 1);
        let name: String =
            name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        write_snapshot(folder, &name, &scenery, snapshot)?;
    }
    Ok(())
}
