//! The modes of the autopilot and the few ways from one to another.

/// What the autopilot is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Mode {
    /// Sends `drive == false`; nothing but arming gets out of it.
    Disarmed,
    /// Armed, at rest, without a goal.
    Standby,
    /// Has a goal but is told to wait: comes to rest along the committed plan and stays there.
    Hold,
    /// On the way to a goal.
    Drive,
    /// A failsafe acts: the car comes to rest and stays there until the fault is cleared.
    Stop,
}

impl Mode {
    /// The name used in logs and heartbeats.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Disarmed => "disarmed",
            Self::Standby => "standby",
            Self::Hold => "hold",
            Self::Drive => "drive",
            Self::Stop => "stop",
        }
    }

    /// The number used in the heartbeat frame.
    pub const fn code(self) -> u8 {
        match self {
            Self::Disarmed => 0,
            Self::Standby => 1,
            Self::Hold => 2,
            Self::Drive => 3,
            Self::Stop => 4,
        }
    }

    /// Whether setpoints may move the car.
    pub const fn is_armed(self) -> bool {
        !matches!(self, Self::Disarmed)
    }
}
