//! A command as it came, in either of its two forms, and what becomes of it.

use super::core::{CoreRequest, Refusal, RefusalKind};
use super::modes::Mode;
use crate::wire::mavlink::common::{
    COMMAND_INT_DATA, COMMAND_LONG_DATA, MavCmd, MavFrame, MavResult,
};

/// A command of a ground station.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wanted {
    /// Which.
    pub command: MavCmd,
    /// Its numbers; in the integer form the fifth and sixth are in [`place`](Self::place).
    pub params: [f32; 7],
    /// Frame and the two integers of the integer form.
    pub place: Option<(MavFrame, i32, i32)>,
    /// Counts repetitions of the other form.
    pub confirmation: u8,
}

impl Wanted {
    /// From the form with seven numbers.
    pub const fn of_long(data: &COMMAND_LONG_DATA) -> Self {
        Self {
            command: data.command,
            params: [
                data.param1,
                data.param2,
                data.param3,
                data.param4,
                data.param5,
                data.param6,
                data.param7,
            ],
            place: None,
            confirmation: data.confirmation,
        }
    }

    /// From the form with a frame and two integers.
    pub const fn of_int(data: &COMMAND_INT_DATA) -> Self {
        let numbers = [data.param1, data.param2, data.param3, data.param4];
        let [a, b, c, d] = numbers;
        Self {
            command: data.command,
            params: [a, b, c, d, f32::NAN, f32::NAN, data.z],
            place: Some((data.frame, data.x, data.y)),
            confirmation: 0,
        }
    }

    /// The one that choosing a mission is.
    pub const fn mission_start() -> Self {
        Self {
            command: MavCmd::MAV_CMD_MISSION_START,
            params: [0.0; 7],
            place: None,
            confirmation: 0,
        }
    }

    /// Its name without the common beginning.
    pub fn name(&self) -> String {
        let name = format!("{:?}", self.command);
        name.strip_prefix("MAV_CMD_").map_or(name.clone(), str::to_owned)
    }

    /// One of its numbers (from 1), which must be finite.
    pub fn finite(&self, number: usize) -> Result<f64, Denial> {
        let value = self.params[number - 1];
        if value.is_finite() {
            Ok(f64::from(value))
        } else {
            Err(Denial::denied(format!("parameter {number} is {value}, but must be a number")))
        }
    }

    /// One of its numbers, which may be left out (not-a-number) but must not be infinite.
    pub fn optional(&self, number: usize) -> Result<Option<f64>, Denial> {
        if self.params[number - 1].is_nan() { Ok(None) } else { self.finite(number).map(Some) }
    }

    /// One of its numbers as a whole number from 0 to `max`.
    pub fn whole(&self, number: usize, max: u32) -> Result<u32, Denial> {
        let value = self.finite(number)?;
        if value.fract() == 0.0 && (0.0..=f64::from(max)).contains(&value) {
            Ok(value as u32)
        } else {
            Err(Denial::denied(format!(
                "parameter {number} is {value}, allowed is a whole number from 0 to {max}"
            )))
        }
    }

    /// One of its numbers as a whole number from 0 to `max`, which may be left out (not-a-number).
    pub fn optional_whole(&self, number: usize, max: u32) -> Result<Option<u32>, Denial> {
        if self.params[number - 1].is_nan() { Ok(None) } else { self.whole(number, max).map(Some) }
    }

    /// Whether it is the same one again.
    pub fn repeats(&self, other: &Self) -> bool {
        let bits = |wanted: &Self| wanted.params.map(f32::to_bits);
        self.command == other.command && bits(self) == bits(other) && self.place == other.place
    }
}

/// A command that was not obeyed.
#[derive(Clone, Debug, PartialEq)]
pub struct Denial {
    /// What the acknowledgement says.
    pub result: MavResult,
    /// Why, for a person; empty where nobody needs to be told.
    pub reason: String,
}

impl Denial {
    /// A value that is not acceptable.
    pub fn denied(reason: impl Into<String>) -> Self {
        Self { result: MavResult::MAV_RESULT_DENIED, reason: reason.into() }
    }

    /// Something has to be put right first.
    pub fn failed(reason: impl Into<String>) -> Self {
        Self { result: MavResult::MAV_RESULT_FAILED, reason: reason.into() }
    }

    /// Waiting helps.
    pub fn later(reason: impl Into<String>) -> Self {
        Self { result: MavResult::MAV_RESULT_TEMPORARILY_REJECTED, reason: reason.into() }
    }

    /// Unknown here; ground stations ask for many things, so nothing is said.
    pub const fn unsupported() -> Self {
        Self { result: MavResult::MAV_RESULT_UNSUPPORTED, reason: String::new() }
    }

    /// A frame that positions of this command cannot be in.
    pub fn wrong_frame(frame: MavFrame) -> Self {
        Self {
            result: MavResult::MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME,
            reason: format!("positions in {frame:?} are not understood"),
        }
    }
}

impl From<Refusal> for Denial {
    fn from(refusal: Refusal) -> Self {
        let result = match refusal.kind {
            RefusalKind::Temporary => MavResult::MAV_RESULT_TEMPORARILY_REJECTED,
            RefusalKind::Denied => MavResult::MAV_RESULT_DENIED,
            RefusalKind::Unsupported => MavResult::MAV_RESULT_UNSUPPORTED,
            RefusalKind::Failed => MavResult::MAV_RESULT_FAILED,
        };
        Self { result, reason: refusal.reason }
    }
}

/// What becomes of a command that is understood.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// It is done.
    Done,
    /// The core is asked; its answer is the command's. With success the mode changes.
    Ask(Vec<CoreRequest>, Option<Mode>),
}
