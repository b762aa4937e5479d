//! Who is at the other ends: learned from what arrives, bounded, and forgotten.

use std::collections::BTreeMap;

use super::outbox::{ChannelId, Peer};
use super::streams::Streams;
use crate::time::{Duration, Instant};

/// Channels at a time, over all links.
pub const CHANNELS_MAX: usize = 64;
/// Components that are remembered on one channel.
const PEERS_MAX: usize = 32;
/// A component that has been silent for this long is forgotten.
const FORGET: Duration = Duration::from_secs(120);

/// What is known about a remote end when it appears.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ChannelInfo {
    /// It cannot be anybody but this computer or whoever holds the other end of a cable.
    pub trusted: bool,
    /// What it can carry, if that is little.
    pub bytes_per_s: Option<f64>,
}

/// A remote end.
#[derive(Debug)]
pub struct Channel {
    /// What kind of end it is.
    pub info: ChannelInfo,
    /// What is sent there regularly.
    pub streams: Streams,
    peers: BTreeMap<(u8, u8), Instant>,
}

/// All remote ends.
#[derive(Debug, Default)]
pub struct Channels {
    by_id: BTreeMap<ChannelId, Channel>,
}

impl Channels {
    /// A remote end appeared; says whether there was room.
    pub fn open(&mut self, now: Instant, id: ChannelId, info: ChannelInfo) -> bool {
        if self.by_id.len() >= CHANNELS_MAX && !self.by_id.contains_key(&id) {
            return false;
        }
        let streams = Streams::new(now, info.bytes_per_s);
        self.by_id.insert(id, Channel { info, streams, peers: BTreeMap::new() });
        true
    }

    /// A remote end is gone.
    pub fn close(&mut self, id: ChannelId) {
        self.by_id.remove(&id);
    }

    /// A remote end.
    pub fn get(&self, id: ChannelId) -> Option<&Channel> {
        self.by_id.get(&id)
    }

    /// A remote end, to change what is sent there.
    pub fn get_mut(&mut self, id: ChannelId) -> Option<&mut Channel> {
        self.by_id.get_mut(&id)
    }

    /// Every remote end.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (ChannelId, &mut Channel)> {
        self.by_id.iter_mut().map(|(id, channel)| (*id, channel))
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.by_id.len()
    }

    /// Remembers who was heard; says whether the channel is known.
    pub fn heard(&mut self, now: Instant, peer: Peer) -> bool {
        let Some(channel) = self.by_id.get_mut(&peer.channel) else { return false };
        let key = (peer.system, peer.component);
        if channel.peers.len() >= PEERS_MAX && !channel.peers.contains_key(&key) {
            channel.peers.retain(|_, heard| now.since(*heard) < FORGET);
            if channel.peers.len() >= PEERS_MAX {
                return true;
            }
        }
        channel.peers.insert(key, now);
        true
    }

    /// Every component that has been heard lately.
    pub fn peers(&self, now: Instant) -> impl Iterator<Item = Peer> + '_ {
        self.by_id.iter().flat_map(move |(id, channel)| {
            let recent = channel.peers.iter().filter(move |(_, heard)| now.since(**heard) < FORGET);
            recent.map(|((system, component), _)| Peer {
                channel: *id,
                system: *system,
                component: *component,
            })
        })
    }
}
