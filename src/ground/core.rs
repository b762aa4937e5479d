//! What the vehicle's side knows of the autopilot core, and what it asks of it.
//!
//! The shell fills these in from the core and obeys what comes out: this module knows neither the
//! core nor its planner.

use std::sync::Arc;

use crate::fence::Fence;
use crate::frames::{Point, Pose};
use crate::scan::Scan;
use crate::time::Instant;
use crate::tunable::Value;

/// What the core is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CoreMode {
    /// Nothing but arming gets out of it.
    Disarmed,
    /// Armed, at rest, without a goal.
    Standby,
    /// Has a goal but waits.
    Hold,
    /// On the way to a goal.
    Drive,
    /// A failsafe acts.
    Stop,
    /// Ended by a ground station until the next start.
    Terminated,
}

impl CoreMode {
    /// Whether setpoints may move the car.
    pub const fn is_armed(self) -> bool {
        !matches!(self, Self::Disarmed | Self::Terminated)
    }
}

/// What is done about a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultAction {
    /// The car comes to rest along its plan.
    FinishesPlan,
    /// The car brakes as hard as it can.
    Brakes,
    /// Nothing.
    Reports,
}

/// A row of the failsafe table that is active.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CoreFault {
    /// Its name.
    pub name: &'static str,
    /// What it is about, in words.
    pub detection: &'static str,
    /// What is done about it.
    pub action: FaultAction,
}

/// A place on the plan being driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanPoint {
    /// Map frame.
    pub position: Point,
    /// Direction of travel, map frame, radians.
    pub heading_rad: f64,
    /// Metres per second.
    pub speed_mps: f64,
    /// Along the path, positive forward.
    pub accel_mps2: f64,
    /// 1/m, positive to the left.
    pub curvature_pm: f64,
}

/// How fresh what the core hears is, each by the core's own time-outs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Fresh {
    /// Wheel odometry.
    pub odometry: bool,
    /// Lidar scans.
    pub scan: bool,
    /// The word of the car's controller.
    pub status: bool,
}

/// Counts since the start, for `SYS_STATUS`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CoreCounts {
    /// Frames of the bus that were refused.
    pub frames_refused: u64,
    /// Error frames on the bus.
    pub error_frames: u64,
    /// Plans that were rejected.
    pub plans_rejected: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
}

/// The core at one moment.
#[derive(Clone, Debug, PartialEq)]
pub struct CoreView {
    /// When, on the core's clock.
    pub at: Instant,
    /// What it is doing.
    pub mode: CoreMode,
    /// Where the car is, map frame, once there is odometry.
    pub pose: Option<Pose>,
    /// Its speed, m/s.
    pub speed_mps: f64,
    /// Its yaw rate, counter-clockwise.
    pub yaw_rate_rps: f64,
    /// Where it stood at the start, map frame.
    pub start: Pose,
    /// Where it is driving to.
    pub goal: Option<Point>,
    /// What is wrong, most important first.
    pub faults: Vec<CoreFault>,
    /// Why it cannot be armed now; empty if it can.
    pub not_ready: Vec<String>,
    /// What the plan being driven says about this moment.
    pub target: Option<PlanPoint>,
    /// A few places on the rest of the plan, the last one where it ends at rest.
    pub plan: Vec<PlanPoint>,
    /// How far the car is to the left of its plan, metres.
    pub cross_track_m: f64,
    /// The newest scan.
    pub scan: Option<Arc<Scan>>,
    /// Volts.
    pub battery_v: Option<f64>,
    /// Freshness of the inputs.
    pub fresh: Fresh,
    /// Share of the control period that is used, 0 to 1.
    pub load: f64,
    /// Counts.
    pub counts: CoreCounts,
    /// The highest speed that may be asked for, m/s.
    pub speed_max_mps: f64,
}

impl CoreView {
    /// The fault that decides what the car does, if one does.
    pub fn acting_fault(&self) -> Option<&CoreFault> {
        self.faults.iter().find(|fault| fault.action != FaultAction::Reports)
    }
}

/// Something that happened in the core.
#[derive(Clone, Debug, PartialEq)]
pub enum CoreEvent {
    /// A fault became active.
    FaultRaised(CoreFault),
    /// A fault is over.
    FaultCleared(CoreFault),
    /// At rest at the goal.
    GoalReached {
        /// Where, map frame.
        position: Point,
    },
    /// Another mode.
    ModeChanged {
        /// After.
        to: CoreMode,
    },
}

/// What is done with the parameters as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StorageAction {
    /// Read them from where they are kept.
    Load,
    /// Write them there.
    Save,
    /// Back to the configuration as it would be without anything kept.
    Reset,
}

/// A wish, for the core or for the shell around it.
#[derive(Clone, PartialEq)]
pub enum CoreRequest {
    /// Make ready to move.
    Arm,
    /// Come to rest and forget the goal.
    Disarm,
    /// Drive to a point, map frame.
    Goto {
        /// Where.
        point: Point,
        /// Only through space that is known to be free, as for the way back.
        through_known: bool,
    },
    /// Come to rest on the way and keep the goal; nothing to do for a car that does not drive.
    Hold,
    /// Go on after a hold.
    Continue,
    /// Drive no faster than this, m/s; `None`: as the parameters say.
    SpeedLimit(Option<f64>),
    /// Come to rest and stay there until the next start.
    Terminate,
    /// Whether ground stations went silent, where the configuration has that stop the car.
    GroundStationLost(bool),
    /// Start the service anew.
    Restart,
    /// End the service.
    Shutdown,
    /// Do something with the parameters as a whole.
    Storage(StorageAction),
    /// Give a parameter another value, in force if its class allows that now.
    SetParameter {
        /// `section.name`.
        key: String,
        /// The value.
        value: Value,
    },
    /// Let the car drive only there.
    SetFence(Arc<Fence>),
    /// Keep and use this key for signatures.
    SigningKey([u8; 32]),
}

impl std::fmt::Debug for CoreRequest {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Arm => f.write_str("Arm"),
            Self::Disarm => f.write_str("Disarm"),
            Self::Goto { point, through_known } => {
                write!(f, "Goto({}, {}, through_known: {through_known})", point.x, point.y)
            }
            Self::Hold => f.write_str("Hold"),
            Self::Continue => f.write_str("Continue"),
            Self::SpeedLimit(speed) => write!(f, "SpeedLimit({speed:?})"),
            Self::Terminate => f.write_str("Terminate"),
            Self::GroundStationLost(lost) => write!(f, "GroundStationLost({lost})"),
            Self::Restart => f.write_str("Restart"),
            Self::Shutdown => f.write_str("Shutdown"),
            Self::Storage(action) => write!(f, "Storage({action:?})"),
            Self::SetParameter { key, value } => write!(f, "SetParameter({key} = {value})"),
            Self::SetFence(fence) => write!(f, "SetFence({fence:?})"),
            // A key belongs in no log.
            Self::SigningKey(_) => f.write_str("SigningKey(..)"),
        }
    }
}

/// How a wish was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefusalKind {
    /// Waiting helps.
    Temporary,
    /// A value is not acceptable.
    Denied,
    /// It is not possible at all.
    Unsupported,
    /// Something has to be put right first.
    Failed,
}

/// Why a wish was refused, in words for a person.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{reason}")]
pub struct Refusal {
    /// What it means for whoever asked.
    pub kind: RefusalKind,
    /// Why.
    pub reason: String,
}

impl Refusal {
    /// A refusal with its reason.
    pub fn new(kind: RefusalKind, reason: impl Into<String>) -> Self {
        Self { kind, reason: reason.into() }
    }

    /// A value is not acceptable.
    pub fn denied(reason: impl Into<String>) -> Self {
        Self::new(RefusalKind::Denied, reason)
    }

    /// Something has to be put right first.
    pub fn failed(reason: impl Into<String>) -> Self {
        Self::new(RefusalKind::Failed, reason)
    }
}
