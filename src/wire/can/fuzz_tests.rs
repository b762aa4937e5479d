//! Both decoders against millions of frames of every kind of wrongness. Nothing panics, whatever
//! comes out makes sense, and memory stays within bounds that no sender can move.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::tests::{motion, scan, tail};
use super::*;
use crate::wire::can::database::Kind;
use crate::wire::can::e2e::Protector;

/// Frames of each kind of wrongness, in each layout.
const FRAMES: usize = if cfg!(debug_assertions) { 20_000 } else { 600_000 };

/// Most that the daemon's decoder holds: the ranges of one scan, and the payloads of a classic one
/// (in a vector that grows by doubling).
const DAEMON_BYTES_MAX: usize = BEAMS_MAX * 4 + 2 * (3 + BEAMS_MAX.div_ceil(3)) * 6;
/// Most that the car's holds: the same for a tail.
const CAR_BYTES_MAX: usize = SAMPLES_MAX * 16 + 2 * (2 + SAMPLES_MAX.div_ceil(2)) * 6;

/// Both ends under attack, on a clock that mostly goes on.
struct Target {
    daemon: Decoder,
    car: CarDecoder,
    now: Instant,
    /// Scans, odometry, status, heartbeats; setpoints, tails, heartbeats.
    understood: [u64; 7],
}

impl Target {
    fn new(layout: Layout) -> Self {
        Self {
            daemon: Decoder::new(layout),
            car: CarDecoder::new(layout),
            now: Instant::from_nanos(1_000_000_000),
            understood: [0; 7],
        }
    }

    fn take(&mut self, rng: &mut impl Rng, frame: &CanFrame) {
        self.now = match rng.random_range(0..1000) {
            0 => self.now.offset_by(rng.random_range(-0.3..0.3)),
            1 => self.now.offset_by(rng.random_range(0.0..5.0)),
            _ => self.now.offset_by(1e-4),
        };
        if let Ok(Some(message)) = self.daemon.decode(self.now, frame) {
            self.understood[from_car(&message)] += 1;
        }
        if let Ok(Some(message)) = self.car.decode(self.now, frame) {
            self.understood[from_daemon(&message)] += 1;
        }
        let (daemon, car) = (self.daemon.capacity(), self.car.capacity());
        assert!(daemon <= DAEMON_BYTES_MAX && car <= CAR_BYTES_MAX, "{daemon} {car} bytes");
    }
}

/// Checks a message to the daemon; its place in `understood`.
fn from_car(message: &CarMessage) -> usize {
    match message {
        CarMessage::Scan(scan) => {
            assert!((1..=BEAMS_MAX).contains(&scan.ranges_m.len()));
            assert!(scan.ranges_m.capacity() <= BEAMS_MAX);
            assert!(scan.angle_first_rad.is_finite() && scan.angle_step_rad != 0.0);
            assert!(scan.range_max_m > 0.0 && scan.range_max_m < 33.0);
            assert!(scan.ranges_m.iter().all(|range| range.is_nan() || *range >= 0.0));
            0
        }
        CarMessage::Odometry(odometry) => {
            let values = [
                odometry.travelled_m,
                odometry.turned_rad,
                odometry.wheel_left_mps,
                odometry.wheel_right_mps,
                odometry.steering_rad,
                odometry.yaw_rate_rps,
            ];
            assert!(values.iter().all(|value| value.is_finite()), "{odometry:?}");
            let used = odometry.into_odometry(Instant::ZERO, 0.26);
            assert!(used.steering_curvature_pm.is_finite());
            1
        }
        CarMessage::Status(status) => {
            assert!((0.0..66.0).contains(&status.battery_v) && status.setpoint_age_s >= 0.0);
            2
        }
        CarMessage::Heartbeat(_) => 3,
    }
}

/// Checks a message to the car.
fn from_daemon(message: &DaemonMessage) -> usize {
    match message {
        DaemonMessage::Setpoint(setpoint) => {
            let values = [setpoint.longitudinal_n, setpoint.lateral_n, setpoint.curvature_pm];
            assert!(values.iter().all(|value| value.is_finite()), "{setpoint:?}");
            4
        }
        DaemonMessage::Tail(tail) => {
            assert!((1..=SAMPLES_MAX).contains(&tail.samples.len()));
            assert!(tail.samples.capacity() <= SAMPLES_MAX);
            let anchor = [tail.anchor_travelled_m, tail.anchor_turned_rad, tail.anchor_offset_m];
            assert!(anchor.iter().all(|value| value.is_finite()) && tail.spacing_m > 0.0);
            let sound = |s: &crate::command::TailSample| {
                s.curvature_pm.is_finite() && s.speed_mps >= 0.0 && s.speed_mps.is_finite()
            };
            assert!(tail.samples.iter().all(sound));
            assert_eq!(tail.samples.last().map(|sample| sample.speed_mps), Some(0.0));
            5
        }
        DaemonMessage::Heartbeat(_) => 6,
    }
}

fn random_frame(rng: &mut impl Rng, layout: Layout) -> CanFrame {
    const LENGTHS: [usize; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64];
    let kind = Kind::ALL[rng.random_range(0..Kind::ALL.len())];
    let id = match rng.random_range(0..20) {
        0 => CanId::extended(rng.random()),
        1 => CanId::standard(rng.random()),
        _ => CanId::standard(kind.id(layout)),
    };
    let mut bytes = [0; DATA_MAX];
    rng.fill(&mut bytes[..]);
    let len =
        if rng.random() { kind.len(layout) } else { LENGTHS[rng.random_range(0..LENGTHS.len())] };
    let fd = len > 8 || rng.random();
    CanFrame::new(id, fd, &bytes[..len]).expect("a length that exists")
}

#[test]
fn random_bytes_do_no_harm() {
    for &layout in Layout::ALL {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut target = Target::new(layout);
        for _ in 0..FRAMES {
            let frame = random_frame(&mut rng, layout);
            target.take(&mut rng, &frame);
        }
        let stats = target.daemon.stats();
        assert!(stats.wrong_crc > 0 && stats.wrong_length > 0 && stats.foreign > 0, "{stats:?}");
    }
}

/// Seals that fit: what stands behind the end-to-end protection is reached.
struct Sealer {
    layout: Layout,
    protectors: [Protector; Kind::ALL.len()],
}

impl Sealer {
    fn new(layout: Layout) -> Self {
        let protectors = Kind::ALL.map(|kind| Protector::new(layout, kind.data_id(layout)));
        Self { layout, protectors }
    }

    fn seal(&mut self, kind: Kind, data: [u8; DATA_MAX]) -> CanFrame {
        let index = Kind::ALL.iter().position(|k| *k == kind).expect("all are listed");
        daemon::seal(kind, self.layout, &mut self.protectors[index], data)
    }
}

#[test]
fn random_content_under_a_right_seal_does_no_harm() {
    for &layout in Layout::ALL {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut target = Target::new(layout);
        let mut sealer = Sealer::new(layout);
        let mut parts = [0u8; Kind::ALL.len()];
        for _ in 0..FRAMES {
            let index = rng.random_range(0..Kind::ALL.len());
            let (kind, part) = (Kind::ALL[index], &mut parts[index]);
            let mut data = [0; DATA_MAX];
            rng.fill(&mut data[..]);
            // Parts that come in order now and then get further into a message.
            if rng.random_bool(0.9) {
                *part = match rng.random_range(0..40) {
                    0 => 12,
                    1 => 15,
                    2 => rng.random_range(0..16),
                    _ if *part >= 12 => (*part + 1) % 15,
                    _ => (*part + 1) % 11,
                };
                match layout {
                    Layout::Classic => data[1] = (data[1] & 0x0F) | *part << 4,
                    Layout::Fd => data[3] = u8::from(!rng.random_bool(0.05)),
                }
            }
            let frame = sealer.seal(kind, data);
            target.take(&mut rng, &frame);
        }
        let stats = target.daemon.stats();
        assert_eq!(stats.wrong_crc, 0);
        assert!(stats.incomplete + stats.orphans + stats.bad_value > 1000, "{stats:?}");
        assert!([2, 3, 4].iter().all(|i| target.understood[*i] > 100), "{:?}", target.understood);
    }
}

/// Frames of sound messages of all kinds and sizes, from two starts of the controller.
fn sound_frames(rng: &mut impl Rng, layout: Layout) -> Vec<CanFrame> {
    let mut frames = Vec::new();
    for boot in [1, 2] {
        let mut car = CarEncoder::new(layout, boot);
        let mut daemon = Encoder::new(layout);
        for step in 0..60u64 {
            let time = CarTime::from_micros(step * 10_000);
            let beams = [1, 28, 29, 60, 360, 1080, BEAMS_MAX][rng.random_range(0..7)];
            if step % 5 == 0 {
                let beams = if step % 20 == 0 { beams } else { 40 };
                car.encode_scan(time, &scan(beams, step as u16), &mut frames).expect("fits");
            }
            let value = motion(time, step as f64, -(step as f64));
            car.encode_odometry(&value, &mut frames).expect("fits");
            frames.push(car.encode_heartbeat(time));
            let samples = rng.random_range(1..=SAMPLES_MAX);
            if step % 5 == 1 {
                daemon.encode_tail(&tail(samples), &mut frames).expect("fits");
            }
            frames.push(daemon.encode_heartbeat(step as u32, DaemonMode::Guided));
            frames.push(daemon.encode_setpoint(&ForceSetpoint::default()).expect("fits"));
            frames.push(car.encode_status(&CarStatus {
                emergency_stop: false,
                setpoint_lost: rng.random(),
                loss_toggle: rng.random(),
                tail_plan: None,
                battery_v: 11.0,
                setpoint_age_s: 0.01,
            }));
        }
    }
    frames
}

/// One frame of a stream gone wrong: bits flipped, cut short, sent twice, sent at another time,
/// sent under another identifier, or not sent.
fn harmed(rng: &mut impl Rng, stream: &[CanFrame], at: usize, out: &mut Vec<CanFrame>) {
    let mut frame = stream[at];
    match rng.random_range(0..7) {
        0 => {
            let data = frame.data_mut();
            for _ in 0..rng.random_range(1..6) {
                let bit = rng.random_range(0..data.len() * 8);
                data[bit / 8] ^= 1 << (bit % 8);
            }
            out.push(frame);
        }
        1 => {
            let len = rng.random_range(0..=8.min(frame.data().len()));
            out.extend(CanFrame::new(frame.id, frame.fd, &frame.data()[..len]));
        }
        2 => out.extend([frame, frame]),
        3 => out.push(stream[rng.random_range(0..stream.len())]),
        4 => {
            frame.id = CanId::standard(stream[rng.random_range(0..stream.len())].id.raw() as u16);
            out.push(frame);
        }
        5 => {
            frame.fd = !frame.fd;
            out.push(frame);
        }
        _ => {}
    }
}

#[test]
fn sound_streams_with_every_kind_of_harm_do_none() {
    for &layout in Layout::ALL {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut target = Target::new(layout);
        // Traffic of the other layout in between, as from a second car.
        let foreign = sound_frames(&mut rng, Layout::ALL[1 - layout.index()]);
        let (mut given, mut out) = (0, Vec::new());
        while given < FRAMES {
            let stream = sound_frames(&mut rng, layout);
            let rate = [0.0, 1e-3, 1e-2, 0.1, 0.5][rng.random_range(0..5)];
            for at in 0..stream.len() {
                out.clear();
                if rng.random_bool(rate) {
                    harmed(&mut rng, &stream, at, &mut out);
                } else {
                    out.push(stream[at]);
                }
                if rng.random_bool(0.01) {
                    out.push(foreign[rng.random_range(0..foreign.len())]);
                }
                given += out.len();
                for frame in &out {
                    target.take(&mut rng, frame);
                }
            }
        }
        assert!(target.understood.iter().all(|count| *count > 30), "{:?}", target.understood);
        let stats = target.daemon.stats();
        assert!(stats.wrong_crc > 100 && stats.incomplete > 10 && stats.restarts > 2, "{stats:?}");
    }
}

/// A sender who knows the seal and the order, and lies in every other field.
#[test]
fn lies_in_the_right_order_do_no_harm() {
    for &layout in Layout::ALL {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut target = Target::new(layout);
        let mut sealer = Sealer::new(layout);
        let mut given = 0;
        while given < FRAMES {
            for frame in sound_frames(&mut rng, layout) {
                given += 1;
                let kind =
                    Kind::ALL.into_iter().find(|k| u32::from(k.id(layout)) == frame.id.raw());
                let kind = kind.expect("our own frame");
                let mut data = *frame.padded();
                // Parts, boot and counters stay; one or two bytes behind them do not.
                if rng.random_bool(0.02) {
                    let len = kind.len(layout);
                    let at = rng.random_range(len.min(4)..=len) % len;
                    data[at] = rng.random();
                }
                let frame = sealer.seal(kind, data);
                target.take(&mut rng, &frame);
            }
        }
        assert!(target.understood.iter().all(|count| *count > 30), "{:?}", target.understood);
        let stats = target.daemon.stats();
        assert!(stats.incomplete + stats.bad_value > 10, "{stats:?}");
    }
}
