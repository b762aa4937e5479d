//! The interface as a whole: what one side encodes, the other decodes.

use proptest::prelude::*;

use super::*;
use crate::command::TailSample;

const NOW: Instant = Instant::from_nanos(1_000_000_000);

pub(super) fn scan(beams: usize, sequence: u16) -> Scan {
    let range_max_m = 12.0;
    Scan {
        stamp: Instant::ZERO,
        sequence,
        angle_first_rad: -std::f64::consts::PI,
        angle_step_rad: std::f64::consts::TAU / beams.max(4) as f64,
        range_max_m,
        ranges_m: (0..beams)
            .map(|i| match (i + usize::from(sequence)) % 17 {
                3 => f32::NAN,
                5 => f32::INFINITY,
                k => (0.3 + 0.7 * k as f64 + 1e-3 * i as f64 % 0.5) as f32,
            })
            .collect(),
    }
}

pub(super) fn tail(samples: usize) -> BrakingTail {
    let spacing_m = 0.05;
    BrakingTail {
        plan: 77,
        anchor_travelled_m: 123.456_78,
        anchor_turned_rad: -4.567_891,
        anchor_offset_m: -0.021,
        spacing_m,
        samples: (0..samples)
            .map(|i| TailSample {
                curvature_pm: 1.9 * (i as f64 * 0.3).sin(),
                speed_mps: (2.0 * 8.0 * spacing_m * (samples - 1 - i) as f64).sqrt(),
            })
            .collect(),
    }
}

fn feed(decoder: &mut Decoder, frames: &[CanFrame]) -> Vec<CarMessage> {
    frames.iter().filter_map(|frame| decoder.decode(NOW, frame).ok().flatten()).collect()
}

fn feed_car(decoder: &mut CarDecoder, frames: &[CanFrame]) -> Vec<DaemonMessage> {
    frames.iter().filter_map(|frame| decoder.decode(NOW, frame).ok().flatten()).collect()
}

fn same_scan(sent: &Scan, received: &CarScan) {
    assert_eq!(received.sequence, sent.sequence);
    assert_eq!(received.range_max_m, sent.range_max_m);
    assert!((received.angle_first_rad - sent.angle_first_rad).abs() < 6e-9);
    let last = (sent.ranges_m.len() - 1) as f64;
    assert!((received.angle_step_rad - sent.angle_step_rad).abs() * last < 3e-6);
    assert_eq!(received.ranges_m.len(), sent.ranges_m.len());
    for (sent_m, received_m) in sent.ranges_m.iter().zip(&received.ranges_m) {
        if sent_m.is_nan() {
            assert!(received_m.is_nan());
        } else if f64::from(*sent_m) >= sent.range_max_m {
            assert!(f64::from(*received_m) >= sent.range_max_m);
        } else {
            assert!((sent_m - received_m).abs() < 2.6e-4, "{sent_m} {received_m}");
            assert!(f64::from(*received_m) < sent.range_max_m);
        }
    }
}

#[test]
fn scans_of_all_sizes_arrive() {
    for &layout in Layout::ALL {
        let mut encoder = CarEncoder::new(layout, 3);
        let mut decoder = Decoder::new(layout);
        for (sequence, beams) in [1, 2, 3, 27, 28, 29, 33, 360, 1080, 4096].into_iter().enumerate()
        {
            let sent = scan(beams, sequence as u16);
            let time = CarTime::from_micros(25_000 * sequence as u64);
            let mut frames = Vec::new();
            encoder.encode_scan(time, &sent, &mut frames).unwrap();
            let messages = feed(&mut decoder, &frames);
            let [CarMessage::Scan(received)] = &messages[..] else { panic!("{messages:?}") };
            same_scan(&sent, received);
            assert_eq!(received.time, time);
        }
        assert_eq!(decoder.stats().complete, 10);
        assert_eq!(decoder.stats().lost + decoder.stats().incomplete, 0);
    }
}

#[test]
fn a_full_circle_is_still_one_after_the_bus() {
    for &layout in Layout::ALL {
        let mut frames = Vec::new();
        CarEncoder::new(layout, 0)
            .encode_scan(CarTime::default(), &scan(1080, 0), &mut frames)
            .unwrap();
        let messages = feed(&mut Decoder::new(layout), &frames);
        let [CarMessage::Scan(received)] = &messages[..] else { panic!("{messages:?}") };
        assert!(received.clone().into_scan(NOW).is_full_circle());
    }
}

#[test]
fn the_frame_counts_are_those_of_the_document() {
    for (layout, beams, expected) in [(Layout::Fd, 1080, 40), (Layout::Classic, 360, 124)] {
        let mut frames = Vec::new();
        CarEncoder::new(layout, 0)
            .encode_scan(CarTime::default(), &scan(beams, 0), &mut frames)
            .unwrap();
        assert_eq!(frames.len(), expected);
    }
}

/// Losing any run of frames of three scans, also runs as long as the counters' periods, leaves only
/// scans that were sent, and the first scan without a gap comes through.
#[test]
fn a_scan_that_lost_any_run_of_frames_is_dropped_whole() {
    for (layout, beams) in [(Layout::Fd, 100), (Layout::Classic, 60), (Layout::Classic, 360)] {
        let mut encoder = CarEncoder::new(layout, 0);
        let sent: Vec<Scan> = (0..4).map(|i| scan(beams, i)).collect();
        let mut frames = Vec::new();
        for scan in &sent {
            encoder.encode_scan(CarTime::default(), scan, &mut frames).unwrap();
        }
        let a_scan = frames.len() / 4;
        for run in [1, 2, 3, 7, 8, 15, 30, 165, 256].into_iter().filter(|run| *run < 2 * a_scan) {
            for from in (1..a_scan).step_by(1 + a_scan / 40) {
                let mut decoder = Decoder::new(layout);
                let kept = [&frames[..from], &frames[from + run..]].concat();
                let messages = feed(&mut decoder, &kept);
                for message in &messages {
                    let CarMessage::Scan(received) = message else { panic!("{message:?}") };
                    assert_ne!(received.sequence, 0, "run {run} from {from}");
                    same_scan(&sent[usize::from(received.sequence)], received);
                }
                let CarMessage::Scan(last) = messages.last().unwrap() else { panic!() };
                assert_eq!(last.sequence, 3);
                assert!(decoder.stats().incomplete + decoder.stats().orphans > 0);
            }
        }
    }
}

#[test]
fn a_repeated_frame_does_no_harm() {
    for &layout in Layout::ALL {
        let mut frames = Vec::new();
        CarEncoder::new(layout, 0)
            .encode_scan(CarTime::default(), &scan(360, 0), &mut frames)
            .unwrap();
        let doubled: Vec<CanFrame> = frames.iter().flat_map(|frame| [*frame, *frame]).collect();
        let mut decoder = Decoder::new(layout);
        assert_eq!(feed(&mut decoder, &doubled).len(), 1);
        assert_eq!(decoder.stats().repeated as usize, frames.len());
    }
}

#[test]
fn swapped_frames_of_a_scan_drop_it() {
    for &layout in Layout::ALL {
        let mut frames = Vec::new();
        CarEncoder::new(layout, 0)
            .encode_scan(CarTime::default(), &scan(360, 0), &mut frames)
            .unwrap();
        for i in 0..frames.len() - 1 {
            let mut swapped = frames.clone();
            swapped.swap(i, i + 1);
            assert_eq!(feed(&mut Decoder::new(layout), &swapped), []);
        }
    }
}

#[test]
fn a_scan_that_takes_too_long_is_dropped() {
    for &layout in Layout::ALL {
        let mut encoder = CarEncoder::new(layout, 0);
        let mut decoder = Decoder::new(layout);
        let mut frames = Vec::new();
        encoder.encode_scan(CarTime::default(), &scan(360, 0), &mut frames).unwrap();
        let (last, rest) = frames.split_last().unwrap();
        feed(&mut decoder, rest);
        let late = NOW.offset_by(ASSEMBLY_MAX_S + 1e-3);
        assert!(matches!(decoder.decode(late, last), Err(WireError::Incomplete { .. })));
        assert_eq!(decoder.stats().incomplete, 1);
    }
}

pub(super) fn motion(time: CarTime, travelled_m: f64, turned_rad: f64) -> CarOdometry {
    CarOdometry {
        time,
        epoch: 0,
        travelled_m,
        turned_rad,
        wheel_left_mps: 3.9,
        wheel_right_mps: 4.1,
        steering_rad: 0.26,
        yaw_rate_rps: 1.0,
    }
}

/// Dead reckoning over 100 m of bends from what arrives, against the exact totals.
#[test]
fn dead_reckoning_over_the_bus_drifts_by_less_than_two_millimetres_in_a_hundred_metres() {
    for &layout in Layout::ALL {
        let mut encoder = CarEncoder::new(layout, 0);
        let mut decoder = Decoder::new(layout);
        let mut exact = crate::frames::Pose::new(0.0, 0.0, 0.0);
        let mut reckoned = exact;
        // Near the wraps of both totals and of the stamp.
        let (start_m, start_rad) = (42_949.6, 2147.4);
        let mut last = (start_m, start_rad);
        let mut before: Option<CarOdometry> = None;
        for step in 0..=2500u64 {
            let distance_m = step as f64 * 0.04;
            let now = (start_m + distance_m, start_rad + 1.5 * (0.37 * distance_m).sin());
            let time = CarTime::from_micros((1 << 32) - 1_000_000 + step * 10_000);
            let mut frames = Vec::new();
            encoder.encode_odometry(&motion(time, now.0, now.1), &mut frames).unwrap();
            let messages = feed(&mut decoder, &frames);
            let [CarMessage::Odometry(received)] = messages[..] else { panic!("{messages:?}") };
            // The epoch's first stamp has no history: from there on times and totals only grow.
            if let Some(before) = before {
                assert!((received.time.seconds_after(before.time) - 0.01).abs() < 1e-9);
                reckoned = reckoned.along_arc(
                    received.travelled_m - before.travelled_m,
                    received.turned_rad - before.turned_rad,
                );
                exact = exact.along_arc(now.0 - last.0, now.1 - last.1);
            }
            last = now;
            before = Some(received);
        }
        let drift_m = (reckoned.position - exact.position).norm();
        assert!(drift_m < 2e-3, "{drift_m}");
    }
}

#[test]
fn wheels_and_steering_give_the_odometry_back() {
    let odometry = Odometry {
        stamp: NOW,
        travelled_m: 12.3,
        turned_rad: 4.5,
        speed_mps: 4.0,
        yaw_rate_rps: 2.0,
        steering_curvature_pm: 0.5,
    };
    let sent = CarOdometry::from_odometry(CarTime::from_micros(5), &odometry, 0.26, 0.2);
    for &layout in Layout::ALL {
        let mut frames = Vec::new();
        CarEncoder::new(layout, 0).encode_odometry(&sent, &mut frames).unwrap();
        let messages = feed(&mut Decoder::new(layout), &frames);
        let [CarMessage::Odometry(received)] = messages[..] else { panic!("{messages:?}") };
        let back = received.into_odometry(NOW, 0.26);
        assert!((back.speed_mps - 4.0).abs() < 1e-3);
        assert!((back.yaw_rate_rps - 2.0).abs() < 1e-3);
        assert!((back.steering_curvature_pm - 0.5).abs() < 2e-4);
        assert!((back.travelled_m - 12.3).abs() < 1e-5);
        assert!((back.turned_rad - 4.5).abs() < 1e-6);
    }
}

#[test]
fn parts_of_different_measurements_are_never_mixed() {
    let mut encoder = CarEncoder::new(Layout::Classic, 0);
    let mut frames = Vec::new();
    for step in 0..40u64 {
        let value = motion(CarTime::from_micros(step * 10_000), step as f64, -(step as f64));
        encoder.encode_odometry(&value, &mut frames).unwrap();
    }
    // Runs of 15 and 60 frames leave counter and part number in step.
    for run in 1..=100 {
        for from in 0..8 {
            let kept = [&frames[..from], &frames[from + run..]].concat();
            for message in feed(&mut Decoder::new(Layout::Classic), &kept) {
                let CarMessage::Odometry(value) = message else { panic!("{message:?}") };
                assert_eq!(value.time.as_micros(), 10_000 * value.travelled_m.round() as u64);
                assert!((value.travelled_m + value.turned_rad).abs() < 1e-4);
            }
        }
    }
}

/// The first frame after a restart may be taken for a repeated one, the second never.
#[test]
fn a_restart_of_the_controller_begins_a_new_epoch() {
    for &layout in Layout::ALL {
        let mut decoder = Decoder::new(layout);
        for (epoch, boot) in [255, 0, 1].into_iter().enumerate() {
            let mut encoder = CarEncoder::new(layout, boot);
            let mut frames = Vec::new();
            for step in 0..2 {
                frames.push(encoder.encode_heartbeat(CarTime::from_micros(3_000_000_000 + step)));
                // Totals start anew: unwrapped against the old ones they would come out wrong.
                let travelled_m = 30_000.0 * f64::from(boot & 1);
                let value = motion(CarTime::from_micros(10 + step), travelled_m, 1.0);
                encoder.encode_odometry(&value, &mut frames).unwrap();
            }
            let messages = feed(&mut decoder, &frames);
            assert!(messages.len() >= 2, "{messages:?}");
            for message in messages {
                match message {
                    CarMessage::Heartbeat(heartbeat) => {
                        assert_eq!((heartbeat.boot, heartbeat.version), (boot, INTERFACE_VERSION));
                        assert_eq!(heartbeat.epoch, epoch as u32);
                    }
                    CarMessage::Odometry(value) => {
                        assert!((value.travelled_m - 30_000.0 * f64::from(boot & 1)).abs() < 1e-5);
                        assert_eq!(value.epoch, epoch as u32);
                    }
                    other => panic!("{other:?}"),
                }
            }
        }
        assert_eq!(decoder.stats().restarts, 2);
    }
}

#[test]
fn status_and_heartbeats_arrive() {
    for &layout in Layout::ALL {
        let mut encoder = CarEncoder::new(layout, 200);
        let mut decoder = Decoder::new(layout);
        for (tail_plan, age) in [(None, f64::INFINITY), (Some(65_535), 0.012)] {
            let sent = CarStatus {
                emergency_stop: tail_plan.is_none(),
                setpoint_lost: tail_plan.is_some(),
                loss_toggle: tail_plan.is_some(),
                tail_plan,
                battery_v: 7.412,
                setpoint_age_s: age,
            };
            let frame = encoder.encode_status(&sent);
            let Ok(Some(CarMessage::Status(received))) = decoder.decode(NOW, &frame) else {
                panic!()
            };
            assert!((received.battery_v - sent.battery_v).abs() < 1e-9);
            assert_eq!(CarStatus { battery_v: sent.battery_v, ..received }, sent,);
        }
        let mut encoder = Encoder::new(layout);
        let mut car = CarDecoder::new(layout);
        for mode in DaemonMode::ALL {
            let frame = encoder.encode_heartbeat(0xFFFF_FFFF, mode);
            let expected =
                DaemonHeartbeat { uptime_ms: 0xFFFF_FFFF, mode, version: INTERFACE_VERSION };
            assert_eq!(car.decode(NOW, &frame), Ok(Some(DaemonMessage::Heartbeat(expected))));
        }
    }
}

#[test]
fn setpoints_arrive_within_half_a_count_and_saturate_beyond() {
    for &layout in Layout::ALL {
        let mut encoder = Encoder::new(layout);
        let mut car = CarDecoder::new(layout);
        let sent = ForceSetpoint {
            longitudinal_n: -21.987_6,
            lateral_n: 13.579,
            curvature_pm: -1.987_65,
            drive: true,
        };
        let frame = encoder.encode_setpoint(&sent).unwrap();
        let Ok(Some(DaemonMessage::Setpoint(got))) = car.decode(NOW, &frame) else { panic!() };
        assert!((got.longitudinal_n - sent.longitudinal_n).abs() <= 0.01 + 1e-9);
        assert!((got.lateral_n - sent.lateral_n).abs() <= 0.01 + 1e-9);
        assert!((got.curvature_pm - sent.curvature_pm).abs() <= 2.5e-4 + 1e-9);
        assert!(got.drive);
        let sent = ForceSetpoint { longitudinal_n: -1e9, drive: false, ..sent };
        let frame = encoder.encode_setpoint(&sent).unwrap();
        let Ok(Some(DaemonMessage::Setpoint(got))) = car.decode(NOW, &frame) else { panic!() };
        assert_eq!(got.longitudinal_n, -655.36);
        assert!(!got.drive);
        let wrong = ForceSetpoint { lateral_n: f64::NAN, ..sent };
        let error = encoder.encode_setpoint(&wrong).unwrap_err();
        assert_eq!(error.to_string(), "signal LateralForce cannot hold NaN");
    }
}

#[test]
fn tails_of_all_sizes_arrive_and_never_allow_more_speed_than_was_sent() {
    for (layout, curvature_pm, speed_mps) in
        [(Layout::Fd, 2.6e-4, 1.1e-3), (Layout::Classic, 6.3e-4, 0.0201)]
    {
        let mut encoder = Encoder::new(layout);
        let mut car = CarDecoder::new(layout);
        // Two turns of the wrapping total further on.
        let base_m = 2.0 * 42_949.672_96;
        car.note_totals(base_m + 123.0, -4.0);
        for samples in [1, 2, 13, 14, 15, 63, 127, 128] {
            let mut sent = tail(samples);
            sent.anchor_travelled_m += base_m;
            let mut frames = Vec::new();
            encoder.encode_tail(&sent, &mut frames).unwrap();
            let messages = feed_car(&mut car, &frames);
            let [DaemonMessage::Tail(got)] = &messages[..] else { panic!("{messages:?}") };
            assert_eq!(got.plan, sent.plan);
            assert!((got.anchor_travelled_m - sent.anchor_travelled_m).abs() < 6e-6);
            assert!((got.anchor_turned_rad - sent.anchor_turned_rad).abs() < 6e-7);
            assert!((got.anchor_offset_m - sent.anchor_offset_m).abs() < 6e-4);
            assert!((got.spacing_m - sent.spacing_m).abs() < 1e-9);
            assert_eq!(got.samples.len(), samples);
            for (sent, got) in sent.samples.iter().zip(&got.samples) {
                assert!((sent.curvature_pm - got.curvature_pm).abs() < curvature_pm);
                assert!(got.speed_mps <= sent.speed_mps + 1e-6 * speed_mps);
                assert!(got.speed_mps > sent.speed_mps - speed_mps);
            }
            assert_eq!(got.samples.last().unwrap().speed_mps, 0.0);
        }
    }
}

#[test]
fn a_tail_with_a_frame_missing_is_no_tail() {
    for &layout in Layout::ALL {
        let mut encoder = Encoder::new(layout);
        let mut frames = Vec::new();
        encoder.encode_tail(&tail(40), &mut frames).unwrap();
        for gone in 0..frames.len() {
            let mut kept = frames.clone();
            kept.remove(gone);
            assert_eq!(feed_car(&mut CarDecoder::new(layout), &kept), []);
        }
    }
}

#[test]
fn what_cannot_be_sent_is_refused_and_leaves_no_frames() {
    for &layout in Layout::ALL {
        let mut encoder = Encoder::new(layout);
        let mut frames = Vec::new();
        let mut moving = tail(5);
        moving.samples[4].speed_mps = 0.1;
        let mut steep = tail(5);
        steep.samples[2].curvature_pm = 99.0;
        let mut coarse = tail(5);
        coarse.spacing_m = 0.7;
        let mut flat = tail(5);
        flat.spacing_m = 0.0;
        let mut nowhere = tail(5);
        nowhere.anchor_turned_rad = f64::NAN;
        for bad in [tail(0), tail(129), moving, steep, coarse, flat, nowhere] {
            assert!(encoder.encode_tail(&bad, &mut frames).is_err());
        }
        let mut encoder = CarEncoder::new(layout, 0);
        let far = Scan { range_max_m: 40.0, ..scan(9, 0) };
        let empty = Scan { ranges_m: vec![], ..scan(9, 0) };
        let turned = Scan { angle_first_rad: f64::NAN, ..scan(9, 0) };
        for bad in [far, empty, turned, scan(4097, 0)] {
            assert!(encoder.encode_scan(CarTime::default(), &bad, &mut frames).is_err());
        }
        let lost = motion(CarTime::default(), f64::NAN, 0.0);
        assert!(encoder.encode_odometry(&lost, &mut frames).is_err());
        assert_eq!(frames, []);
    }
}

#[test]
fn other_traffic_is_ignored_and_wrong_formats_are_counted() {
    let mut decoder = Decoder::new(Layout::Fd);
    for id in [CanId::standard(0x123), CanId::extended(0x100), CanId::standard(0x040)] {
        let frame = CanFrame::new(id, false, &[0; 8]).unwrap();
        assert_eq!(decoder.decode(NOW, &frame), Ok(None));
    }
    assert_eq!(decoder.stats().foreign, 3);
    let frame = CanFrame::new(CanId::standard(0x100), true, &[0; 8]).unwrap();
    assert_eq!(decoder.decode(NOW, &frame), Err(WireError::WrongLength { id: 0x100, len: 8 }));
    // One layout's frames mean nothing to the other.
    let frame = CarEncoder::new(Layout::Classic, 0).encode_heartbeat(CarTime::default());
    assert_eq!(decoder.decode(NOW, &frame), Ok(None));
}

/// A frame of each message of one layout, both directions.
fn one_of_each(layout: Layout) -> Vec<CanFrame> {
    let mut car = CarEncoder::new(layout, 1);
    let mut daemon = Encoder::new(layout);
    let status = CarStatus {
        emergency_stop: false,
        setpoint_lost: false,
        loss_toggle: false,
        tail_plan: Some(4),
        battery_v: 7.0,
        setpoint_age_s: 0.01,
    };
    let mut frames = vec![
        car.encode_status(&status),
        car.encode_heartbeat(CarTime::from_micros(77)),
        daemon.encode_heartbeat(5, DaemonMode::Auto),
        daemon.encode_setpoint(&ForceSetpoint { drive: true, ..Default::default() }).unwrap(),
    ];
    car.encode_odometry(&motion(CarTime::from_micros(9), 1.0, 2.0), &mut frames).unwrap();
    car.encode_scan(CarTime::from_micros(9), &scan(40, 1), &mut frames).unwrap();
    daemon.encode_tail(&tail(20), &mut frames).unwrap();
    frames
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn any_bytes_may_come_in(
        frames in prop::collection::vec(
            (prop::sample::select(database::Kind::ALL.to_vec()), any::<bool>(), any::<bool>(),
             prop::collection::vec(any::<u8>(), 64), 0usize..16, 0u64..200), 1..40),
        sealed: bool,
    ) {
        let mut now = NOW;
        for &layout in Layout::ALL {
            let mut daemon = Decoder::new(layout);
            let mut car = CarDecoder::new(layout);
            let mut protectors = database::Kind::ALL
                .map(|kind| e2e::Protector::new(layout, kind.data_id(layout)));
            for (kind, fd, own, bytes, len, wait_ms) in &frames {
                now = now.offset_by(*wait_ms as f64 * 1e-3 * 0.1);
                let id = CanId::standard(kind.id(layout));
                // Either anything at all, or the right length with a right CRC and any content.
                let frame = if sealed && *own {
                    let mut data = [0; DATA_MAX];
                    data.copy_from_slice(bytes);
                    let index = database::Kind::ALL.iter().position(|k| k == kind).unwrap();
                    Some(daemon::seal(*kind, layout, &mut protectors[index], data))
                } else {
                    let len = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64][*len];
                    CanFrame::new(id, *fd, &bytes[..len])
                };
                if let Some(frame) = frame {
                    if let Ok(Some(CarMessage::Scan(scan))) = daemon.decode(now, &frame) {
                        prop_assert!(scan.ranges_m.len() <= BEAMS_MAX);
                    }
                    if let Ok(Some(DaemonMessage::Tail(tail))) = car.decode(now, &frame) {
                        prop_assert!(tail.samples.len() <= SAMPLES_MAX);
                        prop_assert_eq!(tail.samples.last().unwrap().speed_mps, 0.0);
                    }
                }
            }
        }
    }

    /// Up to two flipped bits anywhere in one frame of a message: it does not arrive, changed or
    /// not, and the others do.
    #[test]
    fn flipped_bits_never_change_a_message(
        pick: prop::sample::Index, first in 0usize..512, second in 0usize..512,
    ) {
        for &layout in Layout::ALL {
            let frames = one_of_each(layout);
            let intact = (
                feed(&mut Decoder::new(layout), &frames),
                feed_car(&mut CarDecoder::new(layout), &frames),
            );
            // NaN beams make scans unequal to themselves; their text is the same.
            let texts = |messages: &[CarMessage]| -> Vec<String> {
                messages.iter().map(|m| format!("{m:?}")).collect()
            };
            let mut flipped = frames.clone();
            let data = pick.get_mut(&mut flipped).data_mut();
            let bits = data.len() * 8;
            data[first % bits / 8] ^= 1 << (first % 8);
            if second % bits != first % bits {
                data[second % bits / 8] ^= 1 << (second % 8);
            }
            let car = feed(&mut Decoder::new(layout), &flipped);
            let daemon = feed_car(&mut CarDecoder::new(layout), &flipped);
            prop_assert_eq!(car.len() + daemon.len(), intact.0.len() + intact.1.len() - 1);
            let known = texts(&intact.0);
            prop_assert!(texts(&car).iter().all(|text| known.contains(text)));
            prop_assert!(daemon.iter().all(|message| intact.1.contains(message)));
        }
    }
}
