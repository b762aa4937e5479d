//! What leaves: messages for ground stations and wishes for the core, both in bounded queues.

use std::collections::{BTreeMap, VecDeque};

use super::core::CoreRequest;
use crate::wire::mavlink::common::{self, MavMessage, MavSeverity};
use crate::wire::mavlink::{Body, CharArray};

/// Messages that may wait to be fetched.
const MESSAGES_MAX: usize = 1024;
/// Wishes that may wait to be fetched.
const REQUESTS_MAX: usize = 64;
/// Bytes of text in one message.
const TEXT_BYTES: usize = 50;
/// Texts longer than this are cut.
const TEXT_BYTES_MAX: usize = 5 * TEXT_BYTES;

/// One remote end: a serial line, a TCP connection, a UDP address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ChannelId(pub u32);

/// A component of another system, as it is reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Peer {
    /// Where its messages come from, and answers go to.
    pub channel: ChannelId,
    /// The system.
    pub system: u8,
    /// The part of it.
    pub component: u8,
}

/// Where a message goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum To {
    /// To every channel.
    Everyone,
    /// To one channel.
    Channel(ChannelId),
}

impl From<Peer> for To {
    fn from(peer: Peer) -> Self {
        Self::Channel(peer.channel)
    }
}

/// Tells the answers to wishes apart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RequestId(pub u64);

/// The queues of what leaves.
#[derive(Debug, Default)]
pub struct Outbox {
    messages: VecDeque<(To, Body)>,
    requests: VecDeque<(RequestId, CoreRequest)>,
    next_request: u64,
    next_text: u16,
    dropped: u64,
    /// What channels can carry, where that is little, bytes a second.
    rates: BTreeMap<ChannelId, f64>,
}

impl Outbox {
    /// Sends a message. With a full queue it is dropped and counted.
    pub fn send(&mut self, to: impl Into<To>, body: impl Into<Body>) {
        if self.messages.len() >= MESSAGES_MAX {
            self.dropped += 1;
        } else {
            self.messages.push_back((to.into(), body.into()));
        }
    }

    /// Asks something of the core; its answer comes with the same number. `None` if too much is
    /// being asked already.
    pub fn request(&mut self, request: CoreRequest) -> Option<RequestId> {
        if self.requests.len() >= REQUESTS_MAX {
            return None;
        }
        self.next_request += 1;
        let id = RequestId(self.next_request);
        self.requests.push_back((id, request));
        Some(id)
    }

    /// Says something to every person who listens; a long text goes in several pieces.
    pub fn say(&mut self, severity: MavSeverity, text: &str) {
        let text = up_to(text, TEXT_BYTES_MAX);
        let id = if text.len() > TEXT_BYTES {
            self.next_text = self.next_text.wrapping_add(1).max(1);
            self.next_text
        } else {
            0
        };
        let mut rest = text;
        let mut chunk_seq = 0;
        loop {
            let piece = up_to(rest, TEXT_BYTES);
            rest = &rest[piece.len()..];
            self.send(
                To::Everyone,
                MavMessage::STATUSTEXT(common::STATUSTEXT_DATA {
                    severity,
                    text: CharArray::from(piece),
                    id,
                    chunk_seq,
                }),
            );
            // Only a piece that is not full shows that it is the last one.
            if rest.is_empty() && (id == 0 || piece.len() < TEXT_BYTES) {
                return;
            }
            chunk_seq += 1;
        }
    }

    /// The next message to send.
    pub fn poll_message(&mut self) -> Option<(To, Body)> {
        self.messages.pop_front()
    }

    /// The next wish.
    pub fn poll_request(&mut self) -> Option<(RequestId, CoreRequest)> {
        self.requests.pop_front()
    }

    /// Messages that found the queue full.
    pub const fn dropped(&self) -> u64 {
        self.dropped
    }

    /// What a channel can carry, bytes a second, where that is little.
    pub fn note_rate(&mut self, channel: ChannelId, bytes_per_s: Option<f64>) {
        match bytes_per_s {
            Some(rate) => self.rates.insert(channel, rate),
            None => self.rates.remove(&channel),
        };
    }

    /// Bytes a second that a long transfer may send on a channel: half of what it can carry.
    pub fn transfer_rate(&self, channel: ChannelId) -> f64 {
        /// On channels that carry a lot; bounds the work, and the other side's too.
        const PLENTY: f64 = 200_000.0;
        self.rates.get(&channel).map_or(PLENTY, |rate| 0.5 * rate)
    }

    /// Room left for messages: long transfers wait for it.
    pub fn room(&self) -> usize {
        MESSAGES_MAX - self.messages.len()
    }
}

/// The beginning of a text, at most so many bytes, no character torn.
fn up_to(text: &str, bytes: usize) -> &str {
    let mut end = bytes.min(text.len());
    while !text.is_char_boundary(end) {
        end -= 1;
    }
    &text[..end]
}
