//! `apexd car`: the simulated car as a process on a CAN interface, in real time.
//!
//! Time passes in steps of 1 ms as in the simulator. The process does not wake for each of them: it
//! sleeps until the next step that has something to send, then makes all steps that are due, in
//! order. What came meanwhile bears the kernel's stamp, so every frame acts in the step in which it
//! came, however late it is read.

mod truth;

use std::path::PathBuf;

use serde::Serialize;
use tokio::runtime;
use tokio::signal::unix::{Signal, SignalKind, signal};

use super::can::{CanLink, CanLinkError, LinkStatistics, Received, SendFault};
use super::clock::{Alarm, Clock};
use super::place::{PlaceRequest, warn_of_load};
use super::report::outcome_text;
use super::shown;
use super::sil::{RunError, input};
use crate::params::Params;
use crate::sim::drive::Spread;
use crate::sim::script::Script;
use crate::sim::solo::{STEP, Solo, SoloSetup, SoloSummary};
use crate::wire::can::Sender;
use truth::{Truth, World};

/// A wake-up later than this is counted, milliseconds.
const LATE_MS: f64 = 5.0;

/// One drive of the car, with every option checked.
#[derive(Clone, Debug, PartialEq)]
pub struct CarRequest {
    /// Where to drive, from where and to where.
    pub place: PlaceRequest,
    /// What happens under way.
    pub script: Option<PathBuf>,
    /// Seed of everything random.
    pub seed: u64,
    /// The drive is over so many seconds after the first motion, or after the start without one.
    pub time_limit_s: Option<f64>,
    /// Go on at the goal and after a contact.
    pub stay: bool,
    /// Where the truth is written.
    pub truth: Option<PathBuf>,
    /// The validated parameters.
    pub params: Params,
}

/// How punctual the process was.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Punctuality {
    /// How much later than planned it woke, milliseconds.
    pub late_ms: Spread,
    /// Times it woke.
    pub wakes: u64,
    /// Times it woke more than 5 ms late.
    pub late_wakes: u64,
}

/// What the interface carried.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FrameCounts {
    /// Frames that the kernel took.
    pub sent: u64,
    /// Times that it took none.
    pub refused: u64,
    /// Frames of the daemon.
    pub received: u64,
    /// Frames of the daemon that the kernel dropped because they were not read in time.
    pub dropped: u64,
    /// Error reports of the driver.
    pub error_frames: u64,
}

impl From<LinkStatistics> for FrameCounts {
    fn from(link: LinkStatistics) -> Self {
        Self {
            sent: link.sent,
            refused: link.unsent,
            received: link.received,
            dropped: link.dropped,
            error_frames: link.error_frames,
        }
    }
}

/// The figures at the end.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct CarEnding {
    /// Of the drive.
    #[serde(flatten)]
    pub summary: SoloSummary,
    /// Of the interface.
    pub frames: FrameCounts,
    /// Of the process.
    pub punctuality: Punctuality,
}

impl CarEnding {
    /// The figures for a person, without a line break at their end.
    pub fn text(&self) -> String {
        let s = &self.summary;
        let clearance = if s.min_clearance_m.is_finite() {
            format!("{:.2} m", s.min_clearance_m)
        } else {
            "no wall near".to_owned()
        };
        let (f, late) = (&self.frames, &self.punctuality);
        [
            format!("{} after {:.2} s", outcome_text(s.outcome), s.time_s),
            format!("  path            {:.1} m, {:.2} m to the goal", s.path_m, s.goal_distance_m),
            format!("  clearance       {clearance}"),
            format!(
                "  safety          {} collisions, {} unknown entries",
                s.collisions, s.unknown_entries
            ),
            format!("  scans           {} of {} delivered whole", s.scans_delivered, s.scans),
            format!(
                "  frames          {} sent, {} without room, {} received, {} dropped, {} errors",
                f.sent, s.frames_unsent, f.received, f.dropped, f.error_frames
            ),
            format!(
                "  late            {:.2} ms p50, {:.2} ms p99, {:.2} ms max",
                late.late_ms.p50, late.late_ms.p99, late.late_ms.max
            ),
        ]
        .join("\n")
    }
}

fn failed(error: impl std::error::Error + Send + Sync + 'static) -> RunError {
    RunError::Failed(Box::new(error))
}

/// A link that cannot be opened is bad input; one that breaks is a failed run.
fn opening(error: CanLinkError) -> RunError {
    match error {
        CanLinkError::System { .. } | CanLinkError::Gone { .. } => failed(error),
        _ => input(error),
    }
}

/// Drives until the drive is over, or SIGTERM or SIGINT ends it.
///
/// # Errors
/// If the place, the script or the interface are not as they should be, or the truth cannot be
/// written.
pub fn drive(request: &CarRequest) -> Result<CarEnding, RunError> {
    let runtime = runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        // Before anything else: whoever ends the process from now on finds a whole file.
        let mut signals = Signals::new().map_err(failed)?;
        let setup = setup(request)?;
        warn_of_load(&request.params);
        let place = (setup.start, setup.goal);
        let mut solo = Solo::new(setup).map_err(input)?;
        let clock = Clock::start();
        let can = &request.params.can;
        let link = CanLink::open(&can.interface, can.layout, Sender::Car, &clock);
        let link = link.map_err(opening)?;
        let mut truth = Truth::create(request.truth.as_deref())?;
        truth.world(&World::of(&request.params, place))?;
        tracing::info!(interface = link.interface(), "the car stands on the bus");
        let mut process = Process { link: &link, clock, late_ms: Vec::new() };
        let ended = process.run(&mut solo, &mut truth, &mut signals).await;
        let ending = CarEnding {
            summary: solo.summary(),
            frames: link.statistics().into(),
            punctuality: process.punctuality(),
        };
        // Also if the link has broken: what was driven was driven.
        let told = truth.end(&ending);
        ended.and(told).map(|()| ending)
    })
}

fn setup(request: &CarRequest) -> Result<SoloSetup, RunError> {
    let place = request.place.place()?;
    let goal = place.needed_goal()?;
    let script = match &request.script {
        None => Script::default(),
        Some(file) => {
            let refused = |error: &dyn std::fmt::Display| {
                RunError::Input(format!("script {}: {error}", shown(file)).into())
            };
            let text = std::fs::read_to_string(file).map_err(|error| refused(&error))?;
            Script::parse(&text).map_err(|error| refused(&error))?
        }
    };
    let params = &request.params;
    Ok(SoloSetup {
        world: place.world,
        start: place.start,
        goal,
        goal_radius_m: params.autopilot.goal_radius_m,
        margin_m: params.certify.margin_m,
        vehicle: params.vehicle.clone(),
        bus: params.bus.clone(),
        lidar: params.lidar.clone(),
        car: params.car.clone(),
        controller: params.controller.clone(),
        layout: params.can.layout,
        script,
        seed: request.seed,
        time_limit_s: request.time_limit_s,
        stay: request.stay,
    })
}

/// The signals that end the process.
struct Signals {
    interrupt: Signal,
    terminate: Signal,
}

impl Signals {
    fn new() -> std::io::Result<Self> {
        Ok(Self {
            interrupt: signal(SignalKind::interrupt())?,
            terminate: signal(SignalKind::terminate())?,
        })
    }

    async fn any(&mut self) {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
    }
}

/// The drive's life in real time.
struct Process<'a> {
    link: &'a CanLink,
    clock: Clock,
    late_ms: Vec<f64>,
}

impl Process<'_> {
    async fn run(
        &mut self,
        solo: &mut Solo,
        truth: &mut Truth,
        signals: &mut Signals,
    ) -> Result<(), RunError> {
        let alarm = Alarm::new(&self.clock).map_err(failed)?;
        while solo.outcome().is_none() {
            let due = solo.poll_at();
            alarm.set(due).map_err(failed)?;
            tokio::select! {
                biased;
                () = signals.any() => break,
                rung = alarm.rings() => rung.map_err(failed)?,
            }
            let now = self.clock.now();
            self.late_ms.push(now.seconds_after(due) * 1e3);
            // Only frames that are there already can belong to the steps up to `now`.
            self.receive(solo)?;
            while solo.now() + STEP <= now && solo.outcome().is_none() {
                solo.step();
                self.send(solo)?;
                while let Some(record) = solo.poll_record() {
                    truth.record(&record)?;
                }
            }
            truth.flush()?;
        }
        Ok(())
    }

    fn receive(&self, solo: &mut Solo) -> Result<(), RunError> {
        while let Some(received) = self.link.try_receive().map_err(failed)? {
            match received {
                Received::Frame { at, frame } => solo.handle_frame(at, frame),
                Received::Fault(fault) => {
                    let classes: Vec<&str> =
                        fault.classes.iter().map(|class| class.name()).collect();
                    tracing::warn!(?classes, state = ?fault.state, "error on the bus");
                }
            }
        }
        Ok(())
    }

    /// Sends what the socket takes; the rest is tried again in the next step.
    fn send(&self, solo: &mut Solo) -> Result<(), RunError> {
        while let Some(frame) = solo.next_frame() {
            match self.link.try_send(frame) {
                Ok(()) => solo.handle_sent(),
                Err(SendFault::Full) => break,
                // As on a bus without anybody on it.
                Err(SendFault::Down) => solo.handle_lost(),
                Err(fault) => return Err(failed(fault)),
            }
        }
        Ok(())
    }

    fn punctuality(&self) -> Punctuality {
        Punctuality {
            late_ms: Spread::of(&self.late_ms),
            wakes: self.late_ms.len() as u64,
            late_wakes: self.late_ms.iter().filter(|late| **late > LATE_MS).count() as u64,
        }
    }
}

#[cfg(test)]
mod tests;
