//! What the core is told about bus and computer.

/// How a CAN controller takes part in the traffic.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BusState {
    /// It sends, receives and marks errors.
    #[default]
    Active,
    /// After many errors: it may no longer mark errors of others, and waits longer.
    Passive,
    /// After too many errors: it takes no part any more.
    Off,
}

/// What the driver of the bus says. Where nobody tells (the simulator), all is well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusHealth {
    /// State of the computer's own CAN controller.
    pub state: BusState,
    /// Error frames since the start.
    pub error_frames: u64,
    /// Frames of ours that could not be sent, since the start.
    pub frames_unsent: u64,
}

/// What the computer says about itself. Where nobody tells, all is well.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct HostHealth {
    /// The log cannot be written for want of space.
    pub disk_full: bool,
    /// A predictor was asked for and is not there: the planner works without.
    pub predictor_missing: bool,
}
