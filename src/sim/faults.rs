//! Faults on the virtual bus: lost, changed, doubled and late frames, nodes cut off, foreign
//! traffic.
//!
//! The bus itself stays perfect; faults act where a frame is handed to a node, as a bad driver, a
//! gateway or memory would. What the wire's own CRC would have caught is more, not less, than
//! happens on a real bus.

use std::collections::BTreeMap;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::time::Instant;
use crate::wire::can::{CanFrame, CanId};

use super::bus::{BusParams, NodeId, QueueFull, VirtualBus};

/// What goes wrong in a drive. Times are seconds on the core's clock.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FaultPlan {
    /// Seed of all chance; the same plan and seed on the same traffic do the same.
    pub seed: u64,
    /// Faults of single frames.
    pub frames: Vec<FrameFault>,
    /// Nodes off the bus.
    pub cuts: Vec<Cut>,
    /// Foreign traffic.
    pub floods: Vec<Flood>,
}

/// What happens to a frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Harm {
    /// It does not arrive.
    Loss,
    /// That many bits of its data, drawn by chance, arrive flipped (the same bit may be drawn
    /// twice).
    Flip {
        /// How many.
        bits: u32,
    },
    /// It arrives twice.
    Duplicate,
    /// It arrives later by a time drawn evenly from 0 to this many seconds, so that frames may
    /// overtake each other.
    Delay {
        /// The longest delay, seconds.
        up_to_s: f64,
    },
}

/// A fault that strikes single frames by chance.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameFault {
    /// What happens.
    pub harm: Harm,
    /// How likely, for each frame, 0 to 1.
    pub probability: f64,
    /// Only frames for this node (by its number).
    #[serde(default)]
    pub receiver: Option<usize>,
    /// Only standard frames with identifiers in this range, both ends included.
    #[serde(default)]
    pub ids: Option<(u16, u16)>,
    /// From this time on, seconds.
    #[serde(default)]
    pub from_s: f64,
    /// Before this time, seconds.
    #[serde(default = "forever")]
    pub until_s: f64,
}

/// A node whose connection is cut: it neither sends nor receives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cut {
    /// The node's number.
    pub node: usize,
    /// From this time on, seconds.
    pub from_s: f64,
    /// Before this time, seconds.
    #[serde(default = "forever")]
    pub until_s: f64,
}

/// A babbling node: frames of one identifier at a fixed rate, with any content.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Flood {
    /// Standard identifier; low ones starve the others.
    pub id: u16,
    /// CAN FD with 64 bytes instead of classic with 8.
    #[serde(default)]
    pub fd: bool,
    /// Time from one frame to the next, seconds.
    pub period_s: f64,
    /// From this time on, seconds.
    pub from_s: f64,
    /// Before this time, seconds.
    #[serde(default = "forever")]
    pub until_s: f64,
}

fn forever() -> f64 {
    f64::INFINITY
}

/// Shortest period of a flood: shorter ones gain nothing on a bus that is already full.
const FLOOD_PERIOD_MIN_S: f64 = 1e-5;

fn within(now: Instant, from_s: f64, until_s: f64) -> bool {
    let now_s = now.as_secs_f64();
    now_s >= from_s && now_s < until_s
}

impl FrameFault {
    fn concerns(&self, now: Instant, receiver: usize, frame: &CanFrame) -> bool {
        within(now, self.from_s, self.until_s)
            && self.receiver.is_none_or(|node| node == receiver)
            && self.ids.is_none_or(|(first, last)| {
                !frame.id.is_extended()
                    && (u32::from(first)..=u32::from(last)).contains(&frame.id.raw())
            })
    }
}

/// How often each fault struck.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FaultCounts {
    /// Frames lost by chance.
    pub lost: u64,
    /// Frames changed.
    pub flipped: u64,
    /// Frames doubled.
    pub duplicated: u64,
    /// Frames delayed.
    pub delayed: u64,
    /// Frames to or from a node that was cut off.
    pub cut: u64,
    /// Foreign frames queued.
    pub flooded: u64,
}

/// A virtual bus that follows a fault plan; otherwise used like [`VirtualBus`].
#[derive(Clone, Debug)]
pub struct FaultyBus {
    bus: VirtualBus,
    plan: FaultPlan,
    rng: ChaCha8Rng,
    nodes: Vec<NodeId>,
    babbler: Option<NodeId>,
    /// When each flood sends next.
    flood_next: Vec<Instant>,
    /// Frames on their way to a node: by node, time and order.
    arriving: Vec<BTreeMap<(Instant, u64), CanFrame>>,
    order: u64,
    now: Instant,
    counts: FaultCounts,
}

impl FaultyBus {
    /// A bus without nodes.
    pub fn new(params: &BusParams, plan: FaultPlan) -> Self {
        let flood_next = plan
            .floods
            .iter()
            .map(|flood| Instant::ZERO.offset_by(flood.from_s.max(0.0)))
            .collect();
        Self {
            bus: VirtualBus::new(params),
            rng: ChaCha8Rng::seed_from_u64(plan.seed),
            plan,
            nodes: Vec::new(),
            babbler: None,
            flood_next,
            arriving: Vec::new(),
            order: 0,
            now: Instant::ZERO,
            counts: FaultCounts::default(),
        }
    }

    /// A new node; numbered from 0 in order of joining.
    pub fn join(&mut self) -> NodeId {
        // The babbling node joins behind the others, at the first pumping: numbers stay as joined.
        assert!(self.babbler.is_none(), "nodes join before traffic starts");
        let node = self.bus.join();
        self.nodes.push(node);
        self.arriving.push(BTreeMap::new());
        node
    }

    /// Lets more go wrong: the plan's times count from `origin` on, and nothing of it lasts beyond
    /// `end`. Its seed does not count; chance goes on as it began.
    pub fn add(&mut self, plan: &FaultPlan, origin: Instant, end: Option<Instant>) {
        let origin_s = origin.as_secs_f64();
        let end_s = end.map_or(f64::INFINITY, Instant::as_secs_f64);
        let window = |from_s: f64, until_s: f64| {
            (origin_s + from_s.max(0.0), (origin_s + until_s).min(end_s))
        };
        for fault in &plan.frames {
            let (from_s, until_s) = window(fault.from_s, fault.until_s);
            self.plan.frames.push(FrameFault { from_s, until_s, ..fault.clone() });
        }
        for cut in &plan.cuts {
            let (from_s, until_s) = window(cut.from_s, cut.until_s);
            self.plan.cuts.push(Cut { from_s, until_s, ..cut.clone() });
        }
        for flood in &plan.floods {
            let (from_s, until_s) = window(flood.from_s, flood.until_s);
            self.flood_next.push(Instant::ZERO.offset_by(from_s));
            self.plan.floods.push(Flood { from_s, until_s, ..flood.clone() });
        }
    }

    /// How often each fault struck so far.
    pub fn counts(&self) -> &FaultCounts {
        &self.counts
    }

    /// The bus underneath, for its statistics.
    pub fn bus(&self) -> &VirtualBus {
        &self.bus
    }

    fn is_cut(&self, now: Instant, node: usize) -> bool {
        self.plan.cuts.iter().any(|cut| cut.node == node && within(now, cut.from_s, cut.until_s))
    }

    /// Queues a frame for sending. A node that is cut off does not notice: its frames vanish.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn send(&mut self, now: Instant, node: NodeId, frame: CanFrame) -> Result<(), QueueFull> {
        self.advance(now);
        if self.is_cut(self.now, node.index()) {
            self.counts.cut += 1;
            return Ok(());
        }
        self.bus.send(self.now, node, frame)
    }

    /// When something happens next, if nobody sends anything before.
    pub fn poll_at(&self) -> Option<Instant> {
        let floods = self.flood_times().map(|(at, _)| at);
        let late = self
            .arriving
            .iter()
            .filter_map(|node| node.keys().map(|(at, _)| *at).find(|at| *at > self.now));
        self.bus.poll_at().into_iter().chain(floods).chain(late).min()
    }

    fn flood_times(&self) -> impl Iterator<Item = (Instant, usize)> + '_ {
        self.flood_next
            .iter()
            .zip(&self.plan.floods)
            .enumerate()
            .filter(|(_, (at, flood))| at.as_secs_f64() < flood.until_s)
            .map(|(i, (at, _))| (*at, i))
    }

    /// Lets time pass until `now`.
    pub fn advance(&mut self, now: Instant) {
        self.now = self.now.max(now);
        while let Some((at, i)) = self.flood_times().min().filter(|(at, _)| *at <= self.now) {
            let flood = &self.plan.floods[i];
            let mut data = [0; 64];
            self.rng.fill(&mut data[..]);
            let data = &data[..if flood.fd { 64 } else { 8 }];
            let frame = CanFrame::new(CanId::standard(flood.id), flood.fd, data)
                .expect("8 and 64 bytes are lengths that exist");
            self.flood_next[i] = at.offset_by(flood.period_s.max(FLOOD_PERIOD_MIN_S));
            let babbler = *self.babbler.get_or_insert_with(|| self.bus.join());
            // A full queue is a flood's natural state.
            if self.bus.send(at, babbler, frame).is_ok() {
                self.counts.flooded += 1;
            }
        }
        self.bus.advance(self.now);
        if let Some(babbler) = self.babbler {
            while self.bus.receive(babbler).is_some() {}
        }
        for i in 0..self.nodes.len() {
            while let Some((at, frame)) = self.bus.receive(self.nodes[i]) {
                self.hand_over(at, i, frame);
            }
        }
    }

    fn hand_over(&mut self, at: Instant, receiver: usize, mut frame: CanFrame) {
        if self.is_cut(at, receiver) {
            self.counts.cut += 1;
            return;
        }
        let mut arrives = at;
        let mut copies = 1;
        for fault in &self.plan.frames {
            if !fault.concerns(at, receiver, &frame)
                || self.rng.random::<f64>() >= fault.probability
            {
                continue;
            }
            match fault.harm {
                Harm::Loss => {
                    self.counts.lost += 1;
                    return;
                }
                Harm::Flip { bits } => {
                    let data = frame.data_mut();
                    if !data.is_empty() {
                        self.counts.flipped += 1;
                        for _ in 0..bits {
                            let bit = self.rng.random_range(0..data.len() * 8);
                            data[bit / 8] ^= 1 << (bit % 8);
                        }
                    }
                }
                Harm::Duplicate => {
                    self.counts.duplicated += 1;
                    copies += 1;
                }
                Harm::Delay { up_to_s } => {
                    self.counts.delayed += 1;
                    arrives = arrives.offset_by(self.rng.random::<f64>() * up_to_s.max(0.0));
                }
            }
        }
        for _ in 0..copies {
            self.order += 1;
            self.arriving[receiver].insert((arrives, self.order), frame);
        }
    }

    /// The next frame that has arrived at a node, and when.
    ///
    /// # Panics
    /// If `node` is not of this bus.
    pub fn receive(&mut self, node: NodeId) -> Option<(Instant, CanFrame)> {
        let arriving = &mut self.arriving[node.index()];
        let first = arriving.first_entry().filter(|first| first.key().0 <= self.now)?;
        let ((at, _), frame) = first.remove_entry();
        Some((at, frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Scan;
    use crate::wire::can::{CarEncoder, CarMessage, CarTime, Decoder, Layout};

    fn at(millis: u64) -> Instant {
        Instant::from_nanos(millis * 1_000_000)
    }

    fn fault(harm: Harm, probability: f64) -> FrameFault {
        FrameFault {
            harm,
            probability,
            receiver: None,
            ids: None,
            from_s: 0.0,
            until_s: f64::INFINITY,
        }
    }

    fn plan(frames: Vec<FrameFault>) -> FaultPlan {
        FaultPlan { seed: 1, frames, ..FaultPlan::default() }
    }

    /// A frame a millisecond for a second, from node 0 to node 1; times in microseconds and ids.
    fn drive(plan: FaultPlan) -> (Vec<(u64, CanFrame)>, FaultCounts) {
        let mut bus = FaultyBus::new(&BusParams::default(), plan);
        let (a, b) = (bus.join(), bus.join());
        let mut got = Vec::new();
        for i in 0..1000u64 {
            let data = i.to_le_bytes();
            let frame = CanFrame::new(CanId::standard(0x100 + (i % 4) as u16), false, &data);
            bus.send(at(i), a, frame.unwrap()).unwrap();
            got.extend(std::iter::from_fn(|| bus.receive(b)));
        }
        bus.advance(at(5000));
        got.extend(std::iter::from_fn(|| bus.receive(b)));
        let got = got.into_iter().map(|(at, f)| (at.as_nanos() / 1000, f)).collect();
        (got, *bus.counts())
    }

    fn number(frame: &CanFrame) -> u64 {
        u64::from_le_bytes(frame.data().try_into().unwrap())
    }

    #[test]
    fn without_faults_everything_arrives_in_order() {
        let (got, counts) = drive(FaultPlan::default());
        assert_eq!(got.len(), 1000);
        assert!(got.iter().enumerate().all(|(i, (_, frame))| number(frame) == i as u64));
        assert_eq!(counts, FaultCounts::default());
    }

    #[test]
    fn the_same_seed_does_the_same_and_another_does_not() {
        let make = |seed| {
            let mut plan = plan(vec![
                fault(Harm::Loss, 0.1),
                fault(Harm::Flip { bits: 2 }, 0.1),
                fault(Harm::Delay { up_to_s: 0.01 }, 0.5),
            ]);
            plan.seed = seed;
            drive(plan)
        };
        assert_eq!(make(7), make(7));
        assert_ne!(make(7), make(8));
    }

    #[test]
    fn loss_strikes_as_often_as_it_says_and_only_whom_it_concerns() {
        let (got, counts) = drive(plan(vec![fault(Harm::Loss, 0.2)]));
        assert!((150..250).contains(&counts.lost), "{counts:?}");
        assert_eq!(got.len() as u64, 1000 - counts.lost);
        let one_id = FrameFault { ids: Some((0x101, 0x101)), ..fault(Harm::Loss, 1.0) };
        let (got, counts) = drive(plan(vec![one_id]));
        assert_eq!((got.len(), counts.lost), (750, 250));
        let other_node = FrameFault { receiver: Some(0), ..fault(Harm::Loss, 1.0) };
        assert_eq!(drive(plan(vec![other_node])).0.len(), 1000);
        let window = FrameFault { from_s: 0.1, until_s: 0.2, ..fault(Harm::Loss, 1.0) };
        assert_eq!(drive(plan(vec![window])).0.len(), 900);
    }

    #[test]
    fn duplicates_and_late_frames_arrive() {
        let (got, counts) = drive(plan(vec![fault(Harm::Duplicate, 1.0)]));
        assert_eq!((got.len(), counts.duplicated), (2000, 1000));
        let (got, _) = drive(plan(vec![fault(Harm::Delay { up_to_s: 0.02 }, 1.0)]));
        assert_eq!(got.len(), 1000);
        assert!(got.windows(2).all(|pair| pair[0].0 <= pair[1].0));
        assert!(got.windows(2).any(|pair| number(&pair[0].1) > number(&pair[1].1)));
    }

    #[test]
    fn what_is_added_under_way_counts_its_times_from_there_and_ends_with_it() {
        let all = FaultPlan {
            seed: 9,
            frames: vec![FrameFault { until_s: 0.1, ..fault(Harm::Loss, 1.0) }],
            cuts: vec![Cut { node: 1, from_s: 0.2, until_s: f64::INFINITY }],
            floods: vec![Flood {
                id: 0x7FF,
                fd: false,
                period_s: 0.01,
                from_s: 0.0,
                until_s: f64::INFINITY,
            }],
        };
        let mut bus = FaultyBus::new(&BusParams::default(), FaultPlan::default());
        let (a, b) = (bus.join(), bus.join());
        let mut got = Vec::new();
        for i in 0..1000u64 {
            if i == 500 {
                bus.add(&all, at(500), Some(at(800)));
            }
            let frame = CanFrame::new(CanId::standard(0x100), false, &i.to_le_bytes());
            bus.send(at(i), a, frame.unwrap()).unwrap();
            bus.advance(at(i) + crate::time::Duration::from_micros(900));
            got.extend(std::iter::from_fn(|| bus.receive(b)).map(|(_, f)| f));
        }
        let numbers: Vec<u64> = got.iter().filter(|f| f.id.raw() == 0x100).map(number).collect();
        let whole = (0..500).chain(600..700).chain(800..1000);
        assert_eq!(numbers, whole.collect::<Vec<u64>>());
        assert_eq!(bus.counts().flooded, 30);
    }

    #[test]
    fn a_cut_node_neither_sends_nor_receives() {
        for node in [0, 1] {
            let cut = Cut { node, from_s: 0.5, until_s: 0.75 };
            let (got, counts) = drive(FaultPlan { cuts: vec![cut], ..FaultPlan::default() });
            assert_eq!(counts.cut, 250);
            assert_eq!(got.len(), 750);
        }
    }

    #[test]
    fn an_urgent_flood_delays_and_a_lazy_one_does_not() {
        let flood = |id| {
            let flood = Flood { id, fd: false, period_s: 0.0, from_s: 0.2, until_s: 0.4 };
            drive(FaultPlan { floods: vec![flood], ..FaultPlan::default() })
        };
        let delay_us = |got: &[(u64, CanFrame)]| {
            got.iter()
                .filter(|(_, frame)| (0x100..0x104).contains(&frame.id.raw()))
                .map(|(at, frame)| at - 1000 * number(frame))
                .max()
                .unwrap()
        };
        let (urgent, counts) = flood(0);
        assert!(counts.flooded > 1000);
        assert!(delay_us(&urgent) > 100_000);
        let (lazy, _) = flood(0x7FF);
        assert!(delay_us(&lazy) <= 2 * 135);
    }

    #[test]
    fn a_plan_reads_from_a_file() {
        let text = r#"
            seed = 5
            frames = [{ harm = "loss", probability = 0.01, ids = [0x100, 0x101] },
                      { harm = { delay = { up_to_s = 0.1 } }, probability = 1.0, from_s = 3.0 }]
            cuts = [{ node = 1, from_s = 2.0 }]
            floods = [{ id = 0, period_s = 0.001, from_s = 1.0, until_s = 2.0 }]
        "#;
        let plan: FaultPlan = toml::from_str(text).unwrap();
        assert_eq!(plan.frames[0].harm, Harm::Loss);
        assert_eq!(plan.cuts[0].until_s, f64::INFINITY);
        assert!(toml::from_str::<FaultPlan>("cut = []").is_err());
    }

    /// Whatever the bus does, a scan that comes out is one that went in.
    #[test]
    fn scans_over_a_bad_bus_are_right_or_missing() {
        for &layout in Layout::ALL {
            let plan = plan(vec![
                fault(Harm::Loss, 2e-3),
                fault(Harm::Flip { bits: 1 }, 2e-3),
                fault(Harm::Duplicate, 2e-3),
                fault(Harm::Delay { up_to_s: 1e-3 }, 2e-3),
            ]);
            let mut bus = FaultyBus::new(&BusParams::default(), plan);
            let (car, daemon) = (bus.join(), bus.join());
            let mut encoder = CarEncoder::new(layout, 0);
            let mut decoder = Decoder::new(layout);
            let (mut complete, mut frames) = (0, Vec::new());
            for sequence in 0..200u16 {
                let range = |beam: usize| (1 + (usize::from(sequence) * 31 + beam * 7) % 19) as f32;
                let scan = Scan {
                    stamp: Instant::ZERO,
                    sequence,
                    angle_first_rad: 0.0,
                    angle_step_rad: 0.02,
                    range_max_m: 30.0,
                    ranges_m: (0..300).map(range).collect(),
                };
                let start = at(50 * u64::from(sequence));
                frames.clear();
                encoder.encode_scan(CarTime::default(), &scan, &mut frames).unwrap();
                for frame in &frames {
                    bus.send(start, car, *frame).unwrap();
                }
                bus.advance(start.offset_by(0.05));
                while let Some((at, frame)) = bus.receive(daemon) {
                    if let Ok(Some(CarMessage::Scan(got))) = decoder.decode(at, &frame) {
                        assert_eq!(got.sequence, sequence);
                        assert_eq!(got.ranges_m, scan.ranges_m);
                        complete += 1;
                    }
                }
            }
            assert!(complete > 50 && complete < 200, "{layout:?}: {complete}");
            assert!(decoder.stats().wrong_crc > 0);
        }
    }
}
