//! The modes that a ground station sees and chooses, in the two alphabets that they are written in.

use super::settings::Identity;
use crate::wire::mavlink::common::MavStandardMode;

/// What a ground station has the vehicle do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Stay where it is, or come to rest on the way.
    Hold,
    /// Drive to the goals that it is given.
    Guided,
    /// The same, in the word of PX4 for goals that come as a stream.
    Offboard,
    /// Drive a mission.
    Auto,
    /// Drive back to where it started.
    Return,
}

/// PX4's main modes.
const PX4_MANUAL: u32 = 1;
const PX4_AUTO: u32 = 4;
const PX4_OFFBOARD: u32 = 6;
/// PX4's modes below `AUTO`.
const PX4_LOITER: u32 = 3;
const PX4_MISSION: u32 = 4;
const PX4_RETURN: u32 = 5;
/// Modes of ArduPilot's rovers.
const ROVER_MANUAL: u32 = 0;
const ROVER_HOLD: u32 = 4;
const ROVER_AUTO: u32 = 10;
const ROVER_RETURN: u32 = 11;
const ROVER_GUIDED: u32 = 15;

/// Why a mode cannot be chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ModeFault {
    /// Nobody can steer this car by hand.
    #[error("this car has no manual mode")]
    Manual,
    /// Neither alphabet has it, or only one that this vehicle does not offer.
    #[error("mode {main}/{sub} is not known")]
    Unknown {
        /// Mode, or PX4's main mode.
        main: u32,
        /// PX4's mode below it.
        sub: u32,
    },
}

impl Mode {
    /// The modes that can be chosen.
    pub const fn all(identity: Identity) -> &'static [Self] {
        match identity {
            Identity::Generic => &[Self::Hold, Self::Guided, Self::Auto, Self::Return],
            // Where PX4 drives to a goal it is in the mode that it holds in.
            Identity::Px4 => &[Self::Hold, Self::Auto, Self::Return, Self::Offboard],
        }
    }

    /// The name that people see.
    pub const fn name(self, identity: Identity) -> &'static str {
        match (self, identity) {
            (Self::Hold, _) | (Self::Guided, Identity::Px4) => "Hold",
            (Self::Guided | Self::Offboard, Identity::Generic) => "Guided",
            (Self::Offboard, Identity::Px4) => "Offboard",
            (Self::Auto, Identity::Generic) => "Auto",
            (Self::Auto, Identity::Px4) => "Mission",
            (Self::Return, Identity::Generic) => "RTL",
            (Self::Return, Identity::Px4) => "Return",
        }
    }

    /// `custom_mode` of a heartbeat.
    pub const fn custom_mode(self, identity: Identity) -> u32 {
        match (identity, self) {
            (Identity::Generic, Self::Hold) => ROVER_HOLD,
            (Identity::Generic, Self::Guided | Self::Offboard) => ROVER_GUIDED,
            (Identity::Generic, Self::Auto) => ROVER_AUTO,
            (Identity::Generic, Self::Return) => ROVER_RETURN,
            (Identity::Px4, Self::Hold | Self::Guided) => PX4_AUTO << 16 | PX4_LOITER << 24,
            (Identity::Px4, Self::Offboard) => PX4_OFFBOARD << 16,
            (Identity::Px4, Self::Auto) => PX4_AUTO << 16 | PX4_MISSION << 24,
            (Identity::Px4, Self::Return) => PX4_AUTO << 16 | PX4_RETURN << 24,
        }
    }

    /// The standard mode that it is.
    pub const fn standard(self) -> MavStandardMode {
        match self {
            Self::Auto => MavStandardMode::MAV_STANDARD_MODE_MISSION,
            Self::Return => MavStandardMode::MAV_STANDARD_MODE_SAFE_RECOVERY,
            Self::Hold | Self::Guided | Self::Offboard => {
                MavStandardMode::MAV_STANDARD_MODE_NON_STANDARD
            }
        }
    }

    /// The mode of a standard mode.
    pub const fn of_standard(standard: u32) -> Option<Self> {
        if standard == MavStandardMode::MAV_STANDARD_MODE_MISSION as u32 {
            Some(Self::Auto)
        } else if standard == MavStandardMode::MAV_STANDARD_MODE_SAFE_RECOVERY as u32 {
            Some(Self::Return)
        } else {
            None
        }
    }

    /// The mode of the two numbers in `MAV_CMD_DO_SET_MODE`. Both alphabets are understood: they
    /// collide in no mode that this vehicle has.
    ///
    /// # Errors
    /// If it has no such mode.
    pub const fn of_command(main: u32, sub: u32) -> Result<Self, ModeFault> {
        match (main, sub) {
            (ROVER_MANUAL | PX4_MANUAL, 0) => Err(ModeFault::Manual),
            (ROVER_HOLD, 0) | (PX4_AUTO, PX4_LOITER) => Ok(Self::Hold),
            (ROVER_AUTO, 0) | (PX4_AUTO, PX4_MISSION) => Ok(Self::Auto),
            (ROVER_RETURN, 0) | (PX4_AUTO, PX4_RETURN) => Ok(Self::Return),
            (ROVER_GUIDED, 0) => Ok(Self::Guided),
            (PX4_OFFBOARD, 0) => Ok(Self::Offboard),
            _ => Err(ModeFault::Unknown { main, sub }),
        }
    }

    /// The mode of a `custom_mode`.
    ///
    /// # Errors
    /// If it is none of this vehicle's.
    pub const fn of_custom(custom: u32) -> Result<Self, ModeFault> {
        if custom >> 16 == 0 {
            Self::of_command(custom, 0)
        } else {
            Self::of_command(custom >> 16 & 0xFF, custom >> 24)
        }
    }
}
