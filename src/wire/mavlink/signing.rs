//! Signatures of MAVLink 2: the first 48 bits of SHA-256 over key, frame, link and time stamp.
//!
//! Time stamps count tens of microseconds since the beginning of 2015 and rise strictly in each
//! stream (system, component, link), over restarts too: what has been accepted and what may have
//! been sent is kept by the caller ([`Signing::take_state`]).

use std::collections::BTreeMap;
use std::fmt;

use sha2::{Digest, Sha256};

use super::frame::{Frame, SIGNATURE};

/// A new stream may lag behind by this much: one minute.
const LAG_MAX: u64 = 60 * 100_000;
/// Time stamps are used up to what was last stored; this much is stored ahead: 30 seconds.
const LEASE: u64 = 30 * 100_000;
/// Streams that are remembered.
const STREAMS_MAX: usize = 64;
/// Time stamps have 48 bits.
const TIMESTAMP_MAX: u64 = (1 << 48) - 1;

/// The newest time stamp of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StreamStamp {
    /// The sender.
    pub system: u8,
    /// Its part.
    pub component: u8,
    /// Its link.
    pub link: u8,
    /// The newest time stamp accepted from it.
    pub timestamp: u64,
}

/// What must outlive a restart.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SigningState {
    /// No time stamp beyond this one has been used.
    pub used_up_to: u64,
    /// What has been accepted.
    pub streams: Vec<StreamStamp>,
}

/// Why a signature was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SigningFault {
    /// Another key, or other bytes.
    #[error("wrong signature")]
    Wrong,
    /// Not newer than what was accepted before.
    #[error("replayed")]
    Replayed,
    /// A new stream that is more than a minute behind.
    #[error("too old")]
    Old,
}

/// A key and the state that goes with it.
pub struct Signing {
    key: [u8; 32],
    /// The newest time stamp that was used or accepted.
    timestamp: u64,
    /// What is on disk allows time stamps up to here.
    stored_up_to: u64,
    streams: BTreeMap<(u8, u8, u8), u64>,
    unsaved: bool,
}

impl fmt::Debug for Signing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Signing").field("timestamp", &self.timestamp).finish_non_exhaustive()
    }
}

impl Signing {
    /// A key with what was stored before, if anything.
    pub fn new(key: [u8; 32], stored: &SigningState) -> Self {
        let streams = stored.streams.iter().take(STREAMS_MAX);
        Self {
            key,
            timestamp: stored.used_up_to,
            stored_up_to: stored.used_up_to,
            streams: streams.map(|s| ((s.system, s.component, s.link), s.timestamp)).collect(),
            unsaved: true,
        }
    }

    /// Checks the signature of a frame. Nothing has changed if it is refused.
    ///
    /// # Errors
    /// Says why; a frame without a signature is [wrong](SigningFault::Wrong) too.
    pub fn check(&mut self, frame: &Frame<'_>, now: u64) -> Result<(), SigningFault> {
        let Some(signature) = frame.signature else { return Err(SigningFault::Wrong) };
        let stream = (frame.header.system, frame.header.component, signature.link);
        let hash = self.hash(frame.covered, signature.link, signature.timestamp);
        // In constant time: what leaks byte by byte can be guessed byte by byte.
        let differs = hash.iter().zip(signature.hash).fold(0, |acc, (a, b)| acc | (a ^ b));
        if differs != 0 {
            return Err(SigningFault::Wrong);
        }
        match self.streams.get(&stream) {
            Some(newest) if signature.timestamp <= *newest => return Err(SigningFault::Replayed),
            None if signature.timestamp.saturating_add(LAG_MAX) < self.timestamp.max(now) => {
                return Err(SigningFault::Old);
            }
            _ => {}
        }
        if self.streams.len() >= STREAMS_MAX && !self.streams.contains_key(&stream) {
            let oldest = self.streams.iter().min_by_key(|(_, stamp)| **stamp).map(|(key, _)| *key);
            oldest.map(|key| self.streams.remove(&key));
        }
        self.streams.insert(stream, signature.timestamp);
        self.timestamp = self.timestamp.max(signature.timestamp);
        self.unsaved = true;
        Ok(())
    }

    /// The signature of a frame's bytes up to its checksum, with a time stamp that is later than
    /// any before, and not before `now`.
    pub fn sign(&mut self, covered: &[u8], link: u8, now: u64) -> [u8; SIGNATURE] {
        self.timestamp = self.timestamp.saturating_add(1).max(now).min(TIMESTAMP_MAX);
        let hash = self.hash(covered, link, self.timestamp);
        let mut signature = [0; SIGNATURE];
        signature[0] = link;
        signature[1..7].copy_from_slice(&self.timestamp.to_le_bytes()[..6]);
        signature[7..].copy_from_slice(&hash);
        signature
    }

    /// Whether what is stored runs out; then [`take_state`](Self::take_state) is to be stored
    /// before anything more is signed.
    pub fn is_store_due(&self, now: u64) -> bool {
        self.timestamp.max(now).saturating_add(LEASE / 2) > self.stored_up_to
    }

    /// What is to be stored now. It allows for some seconds to come.
    pub fn take_state(&mut self, now: u64) -> SigningState {
        self.stored_up_to = self.timestamp.max(now).saturating_add(LEASE).min(TIMESTAMP_MAX);
        self.unsaved = false;
        SigningState {
            used_up_to: self.stored_up_to,
            streams: self
                .streams
                .iter()
                .map(|(&(system, component, link), &timestamp)| StreamStamp {
                    system,
                    component,
                    link,
                    timestamp,
                })
                .collect(),
        }
    }

    /// Whether something was accepted since the state was last taken.
    pub const fn has_news(&self) -> bool {
        self.unsaved
    }

    fn hash(&self, covered: &[u8], link: u8, timestamp: u64) -> [u8; 6] {
        let mut sha = Sha256::new();
        sha.update(self.key);
        sha.update(covered);
        sha.update([link]);
        sha.update(&timestamp.to_le_bytes()[..6]);
        let digest = sha.finalize();
        std::array::from_fn(|i| digest[i])
    }
}
