//! The CAN interface between the daemon and the car's controller.
//!
//! `docs/can-interface.md` describes it for the one who builds the other side. Frames go in and
//! typed messages come out:
//!
//! | | sends with | receives with |
//! |---|---|---|
//! | daemon | [`Encoder`] | [`Decoder`] -> [`CarMessage`] |
//! | car | [`CarEncoder`] | [`CarDecoder`] -> [`DaemonMessage`] |
//!
//! A scan, a tail or a measurement that lost a part is dropped whole and counted, never filled.
//! Any bytes may come in: memory is bounded and nothing panics.

mod assembly;
mod car;
mod daemon;
mod database;
mod dbc;
mod e2e;
mod fields;
mod frame;
mod odometry;
mod receiver;
mod scan;
mod signal;
mod tail;

use crate::command::{BrakingTail, CarStatus, ForceSetpoint};
use crate::scan::{Odometry, Scan};
use crate::time::Instant;
use crate::tunables;

pub use car::{CarDecoder, CarEncoder};
pub use daemon::{Decoder, Encoder};
pub use database::{INTERFACE_VERSION, Message, Sender, messages, protection};
pub use dbc::{database_text, frame_tables};
pub use frame::{CanFrame, CanId, DATA_MAX, Layout};
pub use signal::{Multiplex, Signal};

tunables! {
    /// The CAN interface between the daemon and the car.
    pub struct CanParams in "can" {
        /// Network interface, as `ip link` shows it.
        interface: String = "can0", restart;
        /// Which family of frames is spoken: `fd` (CAN FD, up to 64 bytes) or `classic` (8 bytes).
        layout: Layout = Layout::Fd, restart, one of;
    }
}

/// Most beams in a scan.
pub const BEAMS_MAX: usize = 4096;
/// Most samples in a braking tail.
pub const SAMPLES_MAX: usize = 128;
/// Longest time from the first to the last frame of a scan, a tail or a measurement, seconds.
pub const ASSEMBLY_MAX_S: f64 = 0.1;

/// A moment on the clock of the car's controller, microseconds. Frames carry its low 32 bits; the
/// decoder makes up the rest, so times of one [`epoch`](CarScan::epoch) can be subtracted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct CarTime(u64);

impl CarTime {
    /// The moment `micros` microseconds after the controller's start.
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// Microseconds since the controller's start.
    pub const fn as_micros(self) -> u64 {
        self.0
    }

    /// Seconds from `other` to `self`, negative if `other` is later.
    pub fn seconds_after(self, other: Self) -> f64 {
        (self.0 as i128 - other.0 as i128) as f64 * 1e-6
    }
}

/// A scan as the car sent it.
#[derive(Clone, Debug, PartialEq)]
pub struct CarScan {
    /// When it was measured, on the controller's clock.
    pub time: CarTime,
    /// Counts the controller's starts that the decoder noticed: times and totals of different
    /// epochs have nothing to do with each other.
    pub epoch: u32,
    /// Counts scans, wrapping.
    pub sequence: u16,
    /// Direction of beam 0 in the body frame, radians.
    pub angle_first_rad: f64,
    /// Angle from one beam to the next, radians, positive counter-clockwise.
    pub angle_step_rad: f64,
    /// The lidar's range, metres.
    pub range_max_m: f64,
    /// Ranges as in [`Scan::ranges_m`].
    pub ranges_m: Vec<f32>,
}

impl CarScan {
    /// The scan, once its time is known on the clock of the core.
    pub fn into_scan(self, stamp: Instant) -> Scan {
        Scan {
            stamp,
            sequence: self.sequence,
            angle_first_rad: self.angle_first_rad,
            angle_step_rad: self.angle_step_rad,
            range_max_m: self.range_max_m,
            ranges_m: self.ranges_m,
        }
    }
}

/// Wheel odometry as the car sends it: what its sensors measure and the totals it keeps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarOdometry {
    /// When it was measured, on the controller's clock.
    pub time: CarTime,
    /// As in [`CarScan::epoch`].
    pub epoch: u32,
    /// Distance travelled by the body origin, metres, since the controller started.
    pub travelled_m: f64,
    /// Angle turned, radians, not wrapped, since the controller started.
    pub turned_rad: f64,
    /// Speed of the left rear wheel, metres per second.
    pub wheel_left_mps: f64,
    /// Speed of the right rear wheel, metres per second.
    pub wheel_right_mps: f64,
    /// Angle of the virtual middle front wheel, radians, positive to the left.
    pub steering_rad: f64,
    /// Yaw rate, radians per second.
    pub yaw_rate_rps: f64,
}

impl CarOdometry {
    /// What the car's sensors measure in that motion (the inverse of
    /// [`into_odometry`](Self::into_odometry)).
    pub fn from_odometry(
        time: CarTime,
        odometry: &Odometry,
        wheelbase_m: f64,
        track_m: f64,
    ) -> Self {
        let difference = 0.5 * track_m * odometry.yaw_rate_rps;
        Self {
            time,
            epoch: 0,
            travelled_m: odometry.travelled_m,
            turned_rad: odometry.turned_rad,
            wheel_left_mps: odometry.speed_mps - difference,
            wheel_right_mps: odometry.speed_mps + difference,
            steering_rad: (odometry.steering_curvature_pm * wheelbase_m).atan(),
            yaw_rate_rps: odometry.yaw_rate_rps,
        }
    }

    /// The odometry, once its time is known on the clock of the core: speed is the mean of the rear
    /// wheels, curvature the tangent of the steering angle over the wheelbase.
    pub fn into_odometry(self, stamp: Instant, wheelbase_m: f64) -> Odometry {
        Odometry {
            stamp,
            travelled_m: self.travelled_m,
            turned_rad: self.turned_rad,
            speed_mps: 0.5 * (self.wheel_left_mps + self.wheel_right_mps),
            yaw_rate_rps: self.yaw_rate_rps,
            steering_curvature_pm: self.steering_rad.tan() / wheelbase_m,
        }
    }
}

/// The controller's sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CarHeartbeat {
    /// When it was sent, on the controller's clock.
    pub time: CarTime,
    /// As in [`CarScan::epoch`].
    pub epoch: u32,
    /// Counts starts of the controller, wrapping.
    pub boot: u8,
    /// Version of the frames that the controller speaks, see [`INTERFACE_VERSION`].
    pub version: u8,
}

/// What the daemon is doing, for whoever watches the bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DaemonMode {
    /// Disarmed.
    #[default]
    Standby,
    /// Armed and at rest.
    Hold,
    /// Drives to a goal given by a person.
    Guided,
    /// Drives a mission.
    Auto,
    /// Drives back.
    Return,
    /// Stopped for good by a failure, until a person clears it.
    Stop,
}

impl DaemonMode {
    const ALL: [Self; 6] =
        [Self::Standby, Self::Hold, Self::Guided, Self::Auto, Self::Return, Self::Stop];

    /// Its number on the bus.
    pub const fn number(self) -> u8 {
        self as u8
    }

    /// The mode of that number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.get(usize::from(number)).copied()
    }
}

/// The daemon's sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DaemonHeartbeat {
    /// Milliseconds since the daemon's start, wrapping.
    pub uptime_ms: u32,
    /// What it is doing.
    pub mode: DaemonMode,
    /// Version of the frames that it speaks, see [`INTERFACE_VERSION`].
    pub version: u8,
}

/// What the car says.
#[derive(Clone, Debug, PartialEq)]
pub enum CarMessage {
    /// One turn of the lidar.
    Scan(CarScan),
    /// Totals and rates.
    Odometry(CarOdometry),
    /// Emergency stop, battery, setpoint age.
    Status(CarStatus),
    /// Sign of life.
    Heartbeat(CarHeartbeat),
}

/// What the daemon says.
#[derive(Clone, Debug, PartialEq)]
pub enum DaemonMessage {
    /// Forces wished for.
    Setpoint(ForceSetpoint),
    /// A complete braking tail.
    Tail(BrakingTail),
    /// Sign of life.
    Heartbeat(DaemonHeartbeat),
}

/// Why a frame was dropped or a message not sent.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum WireError {
    /// Length or format is not what the identifier calls for.
    #[error("frame {id:#05x} has a wrong length or format ({len} bytes)")]
    WrongLength {
        /// Identifier.
        id: u16,
        /// Bytes of data.
        len: u8,
    },
    /// The end-to-end CRC is wrong.
    #[error("frame {id:#05x} has a wrong CRC")]
    WrongCrc {
        /// Identifier.
        id: u16,
    },
    /// The same counter as in the frame before.
    #[error("frame {id:#05x} was repeated")]
    Repeated {
        /// Identifier.
        id: u16,
    },
    /// The counter went back, or ahead by more than half its range.
    #[error("frame {id:#05x} came out of sequence")]
    WrongSequence {
        /// Identifier.
        id: u16,
    },
    /// A frame that is intact but says nothing that the interface knows.
    #[error("frame {id:#05x} holds a value that the interface does not know")]
    BadValue {
        /// Identifier.
        id: u16,
    },
    /// Parts of a scan, a tail or a measurement are missing: all of it was dropped.
    #[error("a message under {id:#05x} lost a part and was dropped")]
    Incomplete {
        /// Identifier.
        id: u16,
    },
    /// A value to be sent does not fit its signal (or is not a number).
    #[error("signal {signal} cannot hold {value}")]
    OutOfRange {
        /// Name in the CAN database.
        signal: &'static str,
        /// The value.
        value: f64,
    },
    /// A message to be sent has no elements or too many.
    #[error("a message of {count} elements cannot be sent, allowed are 1 to {max}")]
    WrongCount {
        /// Beams or samples.
        count: usize,
        /// Most allowed.
        max: usize,
    },
    /// A braking tail to be sent does not end at rest.
    #[error("a braking tail that ends at {speed_mps} m/s cannot be sent")]
    TailWithoutRest {
        /// Speed of its last sample, m/s.
        speed_mps: f64,
    },
}

/// What a receiver has seen, by class.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireStats {
    /// Frames taken.
    pub accepted: u64,
    /// Frames whose identifier is not one for this side: other traffic, ignored.
    pub foreign: u64,
    /// Frames that the counters say are missing.
    pub lost: u64,
    /// Frames dropped for a wrong length or format.
    pub wrong_length: u64,
    /// Frames dropped for a wrong CRC.
    pub wrong_crc: u64,
    /// Frames dropped as repeated.
    pub repeated: u64,
    /// Frames dropped as out of sequence.
    pub wrong_sequence: u64,
    /// Frames dropped for an unknown value.
    pub bad_value: u64,
    /// Scans, tails and measurements begun and dropped because a part was missing.
    pub incomplete: u64,
    /// Frames of such messages whose beginning was never seen.
    pub orphans: u64,
    /// Complete scans or tails.
    pub complete: u64,
    /// Starts of the controller noticed after the first.
    pub restarts: u64,
}

#[cfg(test)]
mod fuzz_tests;
#[cfg(test)]
mod tests;
