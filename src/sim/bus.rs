//! A CAN bus in virtual time: arbitration, frame durations, priority queues.
//!
//! Frame durations take the largest number of stuff bits, so the bus is never slower in reality.
//! Identifiers decide arbitration, as on the wire. A node sends its queued frame of lowest
//! identifier first and frames of one identifier in order, as a controller with enough mailboxes
//! does. Errors on the wire are not modelled here: see [`faults`](super::faults).

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

use crate::time::{Duration, Instant};
use crate::tunables;
use crate::wire::can::CanFrame;

tunables! {
    /// The virtual CAN bus.
    pub struct BusParams in "bus" {
        /// Bit rate of classic frames and of the arbitration phase.
        bitrate_bps: u32 = 1_000_000, restart, in 10_000..=1_000_000, "bit/s";
        /// Bit rate of the data phase of CAN FD frames.
        data_bitrate_bps: u32 = 5_000_000, restart, in 10_000..=8_000_000, "bit/s";
        /// Frames that a node can queue for sending and that wait for it to be read.
        queue_frames: u32 = 2048, restart, in 1..=65536, "";
    }
}

/// One end of the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(usize);

impl NodeId {
    /// Nodes are numbered from 0 in order of joining.
    pub const fn index(self) -> usize {
        self.0
    }
}

/// The send queue is full: the frame was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("node {node} has {queued} frames queued for sending, no more are taken")]
pub struct QueueFull {
    /// Which node.
    pub node: usize,
    /// Its queued frames.
    pub queued: usize,
}

/// Length of a frame on the bus including the pause after it, with the most stuff bits that its
/// format can need.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameBits {
    /// At the bit rate of the arbitration phase.
    pub nominal: u32,
    /// At the bit rate of the data phase.
    pub data: u32,
}

impl FrameBits {
    /// Counts the bits of a frame (ISO 11898-1:2015).
    pub fn of(frame: &CanFrame) -> Self {
        Self::count(frame.id.is_extended(), frame.fd, frame.data().len() as u32)
    }

    /// Counts the bits of a frame with `bytes` bytes of data.
    pub fn count(extended: bool, fd: bool, bytes: u32) -> Self {
        if !fd {
            // Start, identifier, RTR, IDE, r0 (extended: SRR, IDE, 18 more bits, RTR, r1, r0),
            // length, data, CRC: stuffed. A stuff bit follows each four bits at worst.
            let stuffed = 8 * bytes + if extended { 54 } else { 34 };
            // CRC delimiter, acknowledgement, its delimiter, end of frame, intermission.
            return Self { nominal: stuffed + (stuffed - 1) / 4 + 13, data: 0 };
        }
        // Start, identifier, RRS, IDE, FDF, res, BRS (extended: SRR and 18 more bits).
        let arbitration = if extended { 36 } else { 17 };
        // ESI, length, data.
        let payload = 5 + 8 * bytes;
        let stuff_all = (arbitration + payload - 1) / 4;
        let stuff_nominal = (arbitration - 1) / 4;
        // Stuff count (4) and CRC, with a fixed stuff bit before every four of these.
        let check = if bytes <= 16 { 4 + 17 + 6 } else { 4 + 21 + 7 };
        Self {
            nominal: arbitration + stuff_nominal + 13,
            data: payload + (stuff_all - stuff_nominal) + check,
        }
    }

    /// How long it takes.
    pub fn duration(self, params: &BusParams) -> Duration {
        let nanos = |bits: u32, rate: u32| u64::from(bits) * 1_000_000_000 / u64::from(rate.max(1));
        Duration::from_nanos(
            nanos(self.nominal, params.bitrate_bps) + nanos(self.data, params.data_bitrate_bps),
        )
    }
}

/// A frame waiting to be sent: its rank, its age, and where it lies. The lowest goes first.
type Waiting = Reverse<(u32, u64, u32)>;

#[derive(Clone, Debug, Default)]
struct Node {
    sending: BinaryHeap<Waiting>,
    /// The frames that `sending` points to, and the places that are free again.
    frames: Vec<CanFrame>,
    vacant: Vec<u32>,
    received: VecDeque<(Instant, CanFrame)>,
    overruns: u64,
}

#[derive(Clone, Debug)]
struct Transmission {
    node: usize,
    frame: CanFrame,
    ends: Instant,
}

/// A CAN bus that all its nodes share.
#[derive(Clone, Debug)]
pub struct VirtualBus {
    params: BusParams,
    nodes: Vec<Node>,
    /// The clock's reading: calls with an earlier time count as this.
    now: Instant,
    /// When the newest frame to join an empty bus was queued.
    wanted: Instant,
    /// When the bus last became free.
    free: Instant,
    on_wire: Option<Transmission>,
    queued: usize,
    order: u64,
    busy: Duration,
}

impl VirtualBus {
    /// An empty bus, free from the clock's origin on.
    pub fn new(params: &BusParams) -> Self {
        Self {
            params: params.clone(),
            nodes: Vec::new(),
            now: Instant::ZERO,
            wanted: Instant::ZERO,
            free: Instant::ZERO,
            on_wire: None,
            queued: 0,
            order: 0,
            busy: Duration::ZERO,
        }
    }

    /// A new node.
    pub fn join(&mut self) -> NodeId {
        self.nodes.push(Node::default());
        NodeId(self.nodes.len() - 1)
    }

    /// Queues a frame for sending.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn send(&mut self, now: Instant, node: NodeId, frame: CanFrame) -> Result<(), QueueFull> {
        self.advance(now);
        let queue = &mut self.nodes[node.0];
        if queue.sending.len() >= self.params.queue_frames as usize {
            return Err(QueueFull { node: node.0, queued: queue.sending.len() });
        }
        if self.queued == 0 {
            self.wanted = self.now;
        }
        self.queued += 1;
        self.order += 1;
        let place = match queue.vacant.pop() {
            Some(place) => {
                queue.frames[place as usize] = frame;
                place
            }
            None => {
                queue.frames.push(frame);
                queue.frames.len() as u32 - 1
            }
        };
        queue.sending.push(Reverse((frame.id.arbitration_rank(), self.order, place)));
        Ok(())
    }

    /// When the next frame arrives, if nobody sends anything before.
    pub fn poll_at(&self) -> Option<Instant> {
        if let Some(on_wire) = &self.on_wire {
            return Some(on_wire.ends);
        }
        let (start, node) = self.next_start()?;
        let node = &self.nodes[node];
        let frame = &node.frames[node.sending.peek()?.0.2 as usize];
        Some(start + FrameBits::of(frame).duration(&self.params))
    }

    /// Who wins the bus next, and when. Frames queued at that very moment still take part.
    fn next_start(&self) -> Option<(Instant, usize)> {
        if self.queued == 0 {
            return None;
        }
        let winner = self
            .nodes
            .iter()
            .enumerate()
            .filter_map(|(i, node)| node.sending.peek().map(|head| (head.0.0, i)))
            .min()?;
        Some((self.free.max(self.wanted), winner.1))
    }

    /// Lets time pass until `now`.
    pub fn advance(&mut self, now: Instant) {
        self.now = self.now.max(now);
        loop {
            if let Some(on_wire) = self.on_wire.take_if(|on_wire| on_wire.ends <= self.now) {
                self.free = on_wire.ends;
                self.deliver(&on_wire);
            }
            if self.on_wire.is_some() {
                return;
            }
            match self.next_start() {
                Some((start, node)) if start < self.now => self.begin(start, node),
                _ => return,
            }
        }
    }

    fn begin(&mut self, start: Instant, node: usize) {
        let queue = &mut self.nodes[node];
        let Some(Reverse((_, _, place))) = queue.sending.pop() else { return };
        queue.vacant.push(place);
        let frame = queue.frames[place as usize];
        self.queued -= 1;
        let duration = FrameBits::of(&frame).duration(&self.params);
        self.busy += duration;
        self.on_wire = Some(Transmission { node, frame, ends: start + duration });
    }

    fn deliver(&mut self, done: &Transmission) {
        let limit = self.params.queue_frames as usize;
        for (i, node) in self.nodes.iter_mut().enumerate() {
            if i == done.node {
                continue;
            }
            // As in a controller's FIFO: the newest frame is the one that does not fit.
            if node.received.len() >= limit {
                node.overruns += 1;
            } else {
                node.received.push_back((done.ends, done.frame));
            }
        }
    }

    /// The next frame that has arrived at a node, and when its last bit did.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn receive(&mut self, node: NodeId) -> Option<(Instant, CanFrame)> {
        self.nodes[node.0].received.pop_front()
    }

    /// Frames that a node lost because nobody read them.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn overruns(&self, node: NodeId) -> u64 {
        self.nodes[node.0].overruns
    }

    /// Frames that a node has queued for sending.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn queued(&self, node: NodeId) -> usize {
        self.nodes[node.0].sending.len()
    }

    /// Total time that frames have occupied the bus.
    pub fn busy(&self) -> Duration {
        self.busy
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::CanId;

    fn frame(id: u16, byte: u8) -> CanFrame {
        CanFrame::new(CanId::standard(id), false, &[byte; 8]).unwrap()
    }

    fn at(micros: u64) -> Instant {
        Instant::from_nanos(micros * 1000)
    }

    fn bus(nodes: usize) -> (VirtualBus, Vec<NodeId>) {
        let mut bus = VirtualBus::new(&BusParams::default());
        let ids = (0..nodes).map(|_| bus.join()).collect();
        (bus, ids)
    }

    fn arrivals(bus: &mut VirtualBus, node: NodeId) -> Vec<(u64, u32)> {
        std::iter::from_fn(|| bus.receive(node))
            .map(|(at, frame)| (at.as_nanos() / 1000, frame.id.raw()))
            .collect()
    }

    /// Worst cases as in the literature: 135 and 160 bits for 8 bytes (Davis et al. 2007, with the
    /// three bits of intermission).
    #[test]
    fn frames_are_as_long_as_the_standard_makes_them() {
        let classic = |extended, bytes| FrameBits::count(extended, false, bytes).nominal;
        assert_eq!(classic(false, 8), 135);
        assert_eq!(classic(true, 8), 160);
        assert_eq!(classic(false, 0), 55);
        let fd = FrameBits::count(false, true, 64);
        assert_eq!(fd, FrameBits { nominal: 34, data: 678 });
        let micros = fd.duration(&BusParams::default()).as_nanos() as f64 * 1e-3;
        assert_eq!(micros, 34.0 + 135.6);
    }

    #[test]
    fn a_frame_arrives_everywhere_but_at_its_sender_when_it_ends() {
        let (mut bus, n) = bus(3);
        bus.send(at(10), n[0], frame(1, 0)).unwrap();
        assert_eq!(bus.poll_at(), Some(at(145)));
        bus.advance(at(144));
        assert_eq!(bus.receive(n[1]), None);
        bus.advance(at(145));
        assert_eq!(arrivals(&mut bus, n[1]), [(145, 1)]);
        assert_eq!(arrivals(&mut bus, n[2]), [(145, 1)]);
        assert_eq!(arrivals(&mut bus, n[0]), []);
        assert_eq!(bus.poll_at(), None);
    }

    #[test]
    fn the_lowest_identifier_wins_when_the_bus_becomes_free() {
        let (mut bus, n) = bus(3);
        // At one moment: arbitration, whoever queued first.
        bus.send(at(0), n[0], frame(0x300, 0)).unwrap();
        bus.send(at(0), n[1], frame(0x200, 0)).unwrap();
        // While 0x200 is on the wire: nobody interrupts it.
        bus.send(at(50), n[0], frame(0x100, 0)).unwrap();
        bus.send(at(60), n[1], frame(0x150, 0)).unwrap();
        bus.advance(at(10_000));
        assert_eq!(
            arrivals(&mut bus, n[2]),
            [(135, 0x200), (270, 0x100), (405, 0x150), (540, 0x300)]
        );
        assert_eq!(bus.busy(), Duration::from_micros(540));
    }

    #[test]
    fn frames_of_one_identifier_keep_their_order() {
        let (mut bus, n) = bus(2);
        for byte in 0..50 {
            bus.send(at(0), n[0], frame(0x100, byte)).unwrap();
            bus.send(at(0), n[0], frame(0x080, byte)).unwrap();
        }
        bus.advance(at(1_000_000));
        let got: Vec<_> = std::iter::from_fn(|| bus.receive(n[1])).collect();
        for id in [0x100, 0x080] {
            let bytes: Vec<u8> =
                got.iter().filter(|f| f.1.id.raw() == id).map(|f| f.1.data()[0]).collect();
            assert_eq!(bytes, (0..50).collect::<Vec<u8>>());
        }
        assert!(got[..50].iter().all(|f| f.1.id.raw() == 0x080));
    }

    #[test]
    fn stepping_by_poll_at_and_in_one_go_agree() {
        let run = |step: bool| {
            let (mut bus, n) = bus(3);
            for i in 0..200u64 {
                let t = at(i * 97);
                while step && bus.poll_at().is_some_and(|next| next <= t) {
                    bus.advance(bus.poll_at().unwrap());
                }
                bus.send(t, n[(i % 2) as usize], frame((i * 7 % 31) as u16, i as u8)).unwrap();
            }
            bus.advance(at(100_000));
            std::iter::from_fn(|| bus.receive(n[2])).collect::<Vec<_>>()
        };
        let whole = run(false);
        assert_eq!(whole.len(), 200);
        assert_eq!(whole, run(true));
        assert!(
            whole.windows(2).all(|pair| pair[1].0.since(pair[0].0) >= Duration::from_micros(135))
        );
    }

    #[test]
    fn full_queues_refuse_and_unread_ones_overrun() {
        let mut bus = VirtualBus::new(&BusParams { queue_frames: 3, ..BusParams::default() });
        let (a, b) = (bus.join(), bus.join());
        for i in 0..3 {
            bus.send(at(0), a, frame(1, i)).unwrap();
        }
        assert_eq!(bus.send(at(0), a, frame(1, 3)), Err(QueueFull { node: 0, queued: 3 }));
        bus.advance(at(10_000));
        bus.send(at(10_000), a, frame(1, 4)).unwrap();
        bus.advance(at(20_000));
        assert_eq!(bus.overruns(b), 1);
        assert_eq!(arrivals(&mut bus, b).len(), 3);
    }
}
