//! Where ground stations and the like join in: requests into the control loop, snapshots and events
//! out of it. Whoever is slow misses some, and holds up nothing.

use std::sync::Arc;

use tokio::sync::{broadcast, mpsc, oneshot, watch};

use super::change::ChangeRefusal;
use crate::autopilot::{ActiveFaults, Autopilot, Command, Event, Mode, Refusal};
use crate::command::CarStatus;
use crate::fence::Fence;
use crate::frames::Pose;
use crate::params::Params;
use crate::plan::{Goal, Plan};
use crate::scan::Scan;
use crate::time::Instant;
use crate::tunable::Value;

/// Why a command was not obeyed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CommandRefusal {
    /// The core refuses it.
    #[error(transparent)]
    Core(#[from] Refusal),
    /// The daemon is about to end.
    #[error("the daemon is ending")]
    Ending,
}

/// A wish from outside.
#[derive(Debug)]
pub enum Request {
    /// Something for the core.
    Command {
        /// What.
        command: Command,
        /// What came of it.
        reply: oneshot::Sender<Result<(), CommandRefusal>>,
    },
    /// A new value of a parameter.
    SetParameter {
        /// `section.name`.
        key: String,
        /// The value.
        value: Value,
        /// What came of it.
        reply: oneshot::Sender<Result<(), ChangeRefusal>>,
    },
    /// Another fence.
    SetFence {
        /// Where the car may drive.
        fence: Arc<Fence>,
        /// It is in force.
        reply: oneshot::Sender<()>,
    },
}

/// The core at one moment.
#[derive(Clone, Debug)]
pub struct CoreSnapshot {
    /// When.
    pub at: Instant,
    /// What it is doing.
    pub mode: Mode,
    /// The faults that are active.
    pub faults: ActiveFaults,
    /// Where it is driving to.
    pub goal: Option<Goal>,
    /// Pose (map frame) and speed (m/s), once there is odometry.
    pub state: Option<(Pose, f64)>,
    /// Newest word of the car's controller, and when it came.
    pub car_status: Option<(Instant, CarStatus)>,
    /// The plan being driven.
    pub plan: Arc<Plan>,
    /// Why the car cannot be armed now; empty if it can.
    pub not_ready: Vec<Refusal>,
    /// Yaw rate, counter-clockwise.
    pub yaw_rate_rps: f64,
    /// How far the car is to the left of its plan, metres.
    pub cross_track_m: f64,
    /// The newest scan.
    pub scan: Option<Arc<Scan>>,
    /// Counts since the start.
    pub counts: Counts,
    /// Share of the control period that is used, as far as it is known.
    pub load: f64,
    /// The parameters in force.
    pub params: Arc<Params>,
}

/// A few counts since the start.
#[derive(Clone, Copy, Debug, Default)]
pub struct Counts {
    /// Frames that the decoder refused.
    pub frames_refused: u64,
    /// Error frames on the bus, as far as they are known.
    pub error_frames: u64,
    /// Planning steps without a plan.
    pub plans_rejected: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
}

impl CoreSnapshot {
    /// The core now.
    pub fn of(core: &Autopilot, params: &Arc<Params>, now: Instant) -> Self {
        Self {
            at: now,
            mode: core.mode(),
            faults: *core.faults(),
            goal: core.goal().copied(),
            state: core.state(now),
            car_status: core.car_status().copied(),
            plan: Arc::clone(core.committed().current()),
            not_ready: core.pre_arm(now),
            yaw_rate_rps: core.yaw_rate_rps(),
            cross_track_m: core.tracking_error().lateral_m,
            scan: core.newest_scan().map(Arc::clone),
            counts: Counts {
                frames_refused: core.statistics().frames_refused,
                error_frames: 0,
                plans_rejected: core.statistics().plans_rejected,
                guard_stops: core.statistics().guard_stops,
            },
            load: 0.0,
            params: Arc::clone(params),
        }
    }
}

/// The outer end of the seam.
#[derive(Clone, Debug)]
pub struct Seam {
    /// Takes requests.
    pub requests: mpsc::Sender<Request>,
    /// Shows the newest snapshot, 20 a second.
    pub snapshots: watch::Receiver<Option<Arc<CoreSnapshot>>>,
    events: broadcast::Sender<Event>,
}

impl Seam {
    /// Requests that may wait.
    const REQUESTS_MAX: usize = 64;
    /// Events that a slow listener may fall behind.
    const EVENTS_MAX: usize = 256;

    /// The outer end, and what the control loop needs of the inner one.
    pub fn new() -> (Self, InnerSeam) {
        let (requests, inbox) = mpsc::channel(Self::REQUESTS_MAX);
        let (publish, snapshots) = watch::channel(None);
        let (events, _) = broadcast::channel(Self::EVENTS_MAX);
        let inner = InnerSeam { requests: inbox, snapshots: publish, events: events.clone() };
        (Self { requests, snapshots, events }, inner)
    }

    /// Every event from now on.
    pub fn events(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }
}

/// The inner end of the seam.
#[derive(Debug)]
pub struct InnerSeam {
    /// Requests from anywhere.
    pub requests: mpsc::Receiver<Request>,
    /// Where snapshots are published.
    pub snapshots: watch::Sender<Option<Arc<CoreSnapshot>>>,
    /// Where events are published.
    pub events: broadcast::Sender<Event>,
}
