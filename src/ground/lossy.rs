//! A link for tests that loses, repeats and mixes messages both ways, always the same for a seed.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::outbox::{ChannelId, Outbox, Peer};
use crate::time::Instant;
use crate::wire::mavlink::common::MavMessage;
use crate::wire::mavlink::{Body, MavlinkVersion, Message};

/// The ground station at the other end.
pub const STATION: Peer = Peer { channel: ChannelId(3), system: 255, component: 190 };
/// Share of messages that are lost.
const LOSS: f64 = 0.05;
/// Share of messages that come twice.
const TWICE: f64 = 0.05;
/// Share of messages that come one step later than those behind them.
const LATE: f64 = 0.1;

/// So many seconds after the beginning.
pub fn at(seconds: f64) -> Instant {
    Instant::from_nanos(10_000_000_000).offset_by(seconds)
}

/// Everything that is sent to stations, as they read it.
pub fn station(out: &mut Outbox) -> Vec<MavMessage> {
    let mut sent = Vec::new();
    while let Some((_, body)) = out.poll_message() {
        match body {
            Body::Message(message) => sent.push(*message),
            Body::Raw(raw) => {
                sent.extend(MavMessage::parse(MavlinkVersion::V2, raw.id, &raw.payload).ok());
            }
        }
    }
    sent
}

/// The link.
pub struct Lossy {
    rng: ChaCha8Rng,
    up: Way,
    down: Way,
}

#[derive(Default)]
struct Way {
    now: Vec<MavMessage>,
    later: Vec<MavMessage>,
}

impl Way {
    fn push(&mut self, rng: &mut ChaCha8Rng, message: MavMessage) {
        if rng.random_bool(LOSS) {
            return;
        }
        if rng.random_bool(TWICE) {
            self.later.push(message.clone());
        }
        if rng.random_bool(LATE) { &mut self.later } else { &mut self.now }.push(message);
    }

    fn arrived(&mut self) -> Vec<MavMessage> {
        std::mem::replace(&mut self.now, std::mem::take(&mut self.later))
    }
}

impl Lossy {
    /// A link whose faults come from a seed.
    pub fn new(seed: u64) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), up: Way::default(), down: Way::default() }
    }

    /// To the vehicle.
    pub fn up(&mut self, message: MavMessage) {
        self.up.push(&mut self.rng, message);
    }

    /// From the vehicle.
    pub fn down(&mut self, message: MavMessage) {
        self.down.push(&mut self.rng, message);
    }

    /// What has come to the vehicle by now.
    pub fn arrived_up(&mut self) -> Vec<MavMessage> {
        self.up.arrived()
    }

    /// What has come from the vehicle by now.
    pub fn arrived_down(&mut self) -> Vec<MavMessage> {
        self.down.arrived()
    }
}
