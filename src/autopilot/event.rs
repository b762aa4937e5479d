//! What the core is told, what it tells, and what it counts.

use super::{BusState, Fault, Mode};
use crate::frames::Point;
use crate::plan::Rejection;
use crate::predict::PredictFault;
use crate::time::{Duration, Instant};

/// A wish of a person or a ground station.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Command {
    /// Makes the car ready to move; clears latched faults.
    Arm,
    /// Brings the car to rest and forgets the goal.
    Disarm,
    /// Drive to a point, map frame.
    Goto(Point),
    /// Come to rest on the way, keep the goal.
    Pause,
    /// Go on after a pause.
    Continue,
    /// Drive to a point, map frame, through space that is known to be free, if there is such a
    /// way.
    Return(Point),
    /// Do not exceed this speed, m/s, until the car is disarmed; `None`: as fast as the parameters
    /// allow.
    SpeedLimit(Option<f64>),
    /// Whether every ground station has gone silent, where that is to stop the car.
    StationLost(bool),
    /// Brake, and stand until the next start.
    Terminate,
}

/// Why a command was refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// The goal is not a point.
    #[error("the goal ({x_m}, {y_m}) m is not a finite point")]
    GoalNotFinite {
        /// Metres.
        x_m: f64,
        /// Metres.
        y_m: f64,
    },
    /// Arm first.
    #[error("the car is not armed")]
    NotArmed,
    /// It was ended.
    #[error("the drive was terminated; only a restart ends that")]
    Terminated,
    /// A speed that is none.
    #[error("the speed limit of {speed_mps} m/s is not a number above zero")]
    SpeedNotPositive {
        /// Metres per second.
        speed_mps: f64,
    },
    /// There is nothing to pause.
    #[error("the car is not driving")]
    NotDriving,
    /// There is nothing to continue.
    #[error("no goal is being held")]
    NothingToContinue,
    /// Pre-arm check.
    #[error("no heartbeat from the car's controller")]
    NoHeartbeat,
    /// Pre-arm check.
    #[error(
        "the car's controller speaks version {theirs} of the CAN interface, this is version {ours}"
    )]
    WrongVersion {
        /// The controller's.
        theirs: u8,
        /// Ours.
        ours: u8,
    },
    /// Pre-arm check.
    #[error("no fresh status from the car's controller")]
    NoStatus,
    /// Pre-arm check.
    #[error("the emergency stop is pressed")]
    EmergencyStop,
    /// Pre-arm check.
    #[error("the car's controller still takes setpoints for lost")]
    SetpointLost,
    /// Pre-arm check.
    #[error("the battery has {battery_v:.2} V, less than {low_v:.2} V")]
    BatteryLow {
        /// Measured, volts.
        battery_v: f64,
        /// Least, volts.
        low_v: f64,
    },
    /// Pre-arm check.
    #[error("no fresh wheel odometry")]
    NoOdometry,
    /// Pre-arm check.
    #[error("no fresh lidar scan")]
    NoScan,
    /// Pre-arm check.
    #[error("the car is moving")]
    Moving,
    /// Pre-arm check.
    #[error("the car's controller holds no braking tail")]
    TailNotHeld,
    /// Pre-arm check.
    #[error("the CAN controller of this computer is {}", bus_state_text(*.0))]
    BusNotActive(BusState),
    /// Pre-arm check.
    #[error("the disk is full: there would be no log")]
    DiskFull,
    /// Pre-arm check.
    #[error("this computer is overloaded: control ticks are late")]
    Overload,
    /// Pre-arm check.
    #[error("{} has not been over for half a second", .0.name())]
    Unsettled(Fault),
}

const fn bus_state_text(state: BusState) -> &'static str {
    match state {
        BusState::Active => "active",
        BusState::Passive => "error-passive",
        BusState::Off => "off the bus",
    }
}

/// Something worth a line in the log.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// Another mode.
    ModeChanged {
        /// When.
        at: Instant,
        /// Before.
        from: Mode,
        /// After.
        to: Mode,
    },
    /// A fault became active.
    FaultRaised {
        /// When.
        at: Instant,
        /// Which.
        fault: Fault,
    },
    /// A fault is over.
    FaultCleared {
        /// When.
        at: Instant,
        /// Which.
        fault: Fault,
    },
    /// A plan will take over.
    PlanAdopted {
        /// Its number.
        number: u32,
        /// Where it ends, map frame.
        stop: Point,
        /// Its length, metres.
        length_m: f64,
    },
    /// A step gave no plan.
    PlanRejected {
        /// Its number.
        number: u32,
        /// Why.
        rejection: Rejection,
    },
    /// A planning step went on without prediction.
    PredictionFault {
        /// When it came back.
        at: Instant,
        /// Its number.
        number: u32,
        /// Why.
        fault: PredictFault,
    },
    /// The prediction has led the car to and fro: planning goes by what is seen until there is
    /// something new to see.
    PredictionPassedOver {
        /// When the first step without it came back.
        at: Instant,
        /// Its number.
        number: u32,
    },
    /// A plan came too late to take over.
    PlanLate {
        /// Its number.
        number: u32,
    },
    /// The plan under way was cut short, because something stands on it.
    PlanShortened {
        /// When.
        at: Instant,
        /// Number of the shortened plan.
        number: u32,
    },
    /// At rest inside the goal disc.
    GoalReached {
        /// When.
        at: Instant,
        /// Where, by the car's own estimate, map frame.
        position: Point,
    },
}

/// Counts since the start.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Statistics {
    /// Scans put into the map.
    pub scans: u64,
    /// Scans dropped because the pose at their time is not known.
    pub scans_without_pose: u64,
    /// Frames that the decoder refused.
    pub frames_refused: u64,
    /// Planning steps that came back.
    pub replans: u64,
    /// Plans that took over.
    pub plans_adopted: u64,
    /// Steps without a plan.
    pub plans_rejected: u64,
    /// Plans that came too late.
    pub plans_late: u64,
    /// Plans for a start that no longer exists.
    pub plans_stale: u64,
    /// Committed plans that something was set down on.
    pub plans_revoked: u64,
    /// Faults of the prediction.
    pub prediction_faults: u64,
    /// Candidate paths of all steps.
    pub candidates: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
    /// Setpoints that do not fit their frame.
    pub setpoints_unsendable: u64,
    /// Braking tails that do not fit their frames.
    pub tails_unsendable: u64,
    /// Age of the newest scan in the plan being driven, at each tick in motion.
    pub plan_ages: Vec<Duration>,
}
