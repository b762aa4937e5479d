//! MAVLink: bytes to messages and back, signatures, and the north-east-down frames of that world.
//!
//! Only the `common` dialect is spoken. MAVLink 1 and 2 are understood, MAVLink 2 is sent. The
//! message definitions come from the crate of the same name; framing and signing are here, because
//! they must not look at a clock, must bound their memory, and must hand on what the crate's types
//! cannot hold (a command that the dialect does not know still deserves an answer).

mod frame;
mod ned;
mod signing;

pub use ::mavlink::dialects::common;
pub use ::mavlink::types::CharArray;
pub use ::mavlink::{MavlinkVersion, Message, MessageData};
pub use frame::{FRAME_MAX, Frame, Header, ParseCounts, Parser, Signature, encode};
pub use ned::{Geodetic, Origin, map_heading, ned_of, point_of_ned, yaw_of};
pub use signing::{Signing, SigningFault, SigningState, StreamStamp};

use common::MavMessage;

/// What a frame carries.
#[derive(Clone, Debug, PartialEq)]
pub enum Body {
    /// A message of the dialect.
    Message(Box<MavMessage>),
    /// A message of the dialect with a value in it that the dialect does not name.
    Raw(RawBody),
}

/// A message as it is on the wire, with the zeros at its end cut off or not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RawBody {
    /// Number of the message.
    pub id: u32,
    /// Its payload, at most 255 bytes.
    pub payload: Vec<u8>,
}

impl RawBody {
    /// `N` bytes of the payload from `at` on; what was cut off is zero.
    pub fn bytes<const N: usize>(&self, at: usize) -> [u8; N] {
        std::array::from_fn(|i| self.payload.get(at + i).copied().unwrap_or(0))
    }
}

impl Body {
    /// Number of the message.
    pub fn id(&self) -> u32 {
        match self {
            Self::Message(message) => message.message_id(),
            Self::Raw(raw) => raw.id,
        }
    }

    /// The message in a payload; raw where its values mean nothing to the dialect.
    pub fn decode(version: MavlinkVersion, id: u32, payload: &[u8]) -> Self {
        match MavMessage::parse(version, id, payload) {
            Ok(message) => Self::Message(Box::new(message)),
            Err(_) => Self::Raw(RawBody { id, payload: payload.to_vec() }),
        }
    }
}

impl From<MavMessage> for Body {
    fn from(message: MavMessage) -> Self {
        Self::Message(Box::new(message))
    }
}

impl From<RawBody> for Body {
    fn from(raw: RawBody) -> Self {
        Self::Raw(raw)
    }
}

#[cfg(test)]
mod tests;
