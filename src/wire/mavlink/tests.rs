//! Frames against those of another implementation (pymavlink), and against noise.

use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavMessage, MavModeFlag, MavState,
    MavType,
};
use super::*;
use crate::frames::Point;

/// What pymavlink 2.4.50 packs for [`heartbeat`] from system 42, component 7.
const HEARTBEAT_V2: &str = "fd090000092a07000000010203040a0c8104032ceb";
const HEARTBEAT_V1: &str = "fe09092a0700010203040a0c810403a13c";
/// Arming, signed with the key 00 01 .. 1f, link 5, time stamp 123456789012.
const SIGNED: &str = "fd2001000a2a074c00000000803f0000000000000000000000000000000000000000000000009001\
                      01018a4305141a99be1c00e5f2d4abbe16";
const STAMP: u64 = 123_456_789_012;

fn bytes(hex: &str) -> Vec<u8> {
    let digit = |i: usize| u8::from_str_radix(&hex[i..i + 2], 16).unwrap();
    (0..hex.len()).step_by(2).map(digit).collect()
}

fn key() -> [u8; 32] {
    std::array::from_fn(|i| i as u8)
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 0x0403_0201,
        mavtype: MavType::MAV_TYPE_GROUND_ROVER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
        base_mode: MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED
            | MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}

fn header(sequence: u8) -> Header {
    Header { system: 42, component: 7, sequence }
}

fn all(parser: &mut Parser, bytes: &[u8]) -> Vec<(Header, Body)> {
    let mut found = Vec::new();
    parser.push(bytes, |frame| found.push((frame.header, frame.body())));
    found
}

#[test]
fn frames_are_those_of_another_implementation() {
    let body = Body::from(heartbeat());
    assert_eq!(encode(header(9), &body, None), bytes(HEARTBEAT_V2));
    for hex in [HEARTBEAT_V2, HEARTBEAT_V1] {
        let found = all(&mut Parser::new(), &bytes(hex));
        assert_eq!(found, [(header(9), body.clone())], "{hex}");
    }
}

#[test]
fn a_signature_is_that_of_another_implementation() {
    let arm = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        param1: 1.0,
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    });
    let mut signing = Signing::new(key(), &SigningState::default());
    let sent = encode(header(10), &arm.into(), Some((&mut signing, 5, STAMP)));
    assert_eq!(sent, bytes(SIGNED));
}

fn check(signing: &mut Signing, bytes: &[u8], now: u64) -> Result<(), SigningFault> {
    let mut result = None;
    Parser::new().push(bytes, |frame| result = Some(signing.check(&frame, now)));
    result.expect("one frame")
}

#[test]
fn a_signed_frame_is_taken_once() {
    let mut signing = Signing::new(key(), &SigningState::default());
    let frame = bytes(SIGNED);
    assert_eq!(check(&mut signing, &frame, STAMP), Ok(()));
    assert_eq!(check(&mut signing, &frame, STAMP), Err(SigningFault::Replayed));
    // After a restart too.
    let state = signing.take_state(STAMP);
    let mut again = Signing::new(key(), &state);
    assert_eq!(check(&mut again, &frame, STAMP), Err(SigningFault::Replayed));
}

#[test]
fn other_keys_unsigned_frames_and_old_ones_are_refused() {
    let frame = bytes(SIGNED);
    let mut other = Signing::new([7; 32], &SigningState::default());
    assert_eq!(check(&mut other, &frame, STAMP), Err(SigningFault::Wrong));
    let mut signing = Signing::new(key(), &SigningState::default());
    assert_eq!(check(&mut signing, &bytes(HEARTBEAT_V2), STAMP), Err(SigningFault::Wrong));
    assert_eq!(check(&mut signing, &bytes(HEARTBEAT_V1), STAMP), Err(SigningFault::Wrong));
    let minute = 60 * 100_000;
    assert_eq!(check(&mut signing, &frame, STAMP + minute + 1), Err(SigningFault::Old));
    assert_eq!(check(&mut signing, &frame, STAMP + minute), Ok(()));
}

#[test]
fn a_refused_signature_moves_no_clock() {
    let mut signing = Signing::new(key(), &SigningState::default());
    let mut frame = bytes(SIGNED);
    let last = frame.len() - 1;
    frame[last] ^= 1;
    // Its time stamp as far in the future as can be.
    frame[last - 11..last - 5].copy_from_slice(&[0xFF; 6]);
    assert_eq!(check(&mut signing, &frame, STAMP), Err(SigningFault::Wrong));
    assert_eq!(check(&mut signing, &bytes(SIGNED), STAMP), Ok(()));
}

#[test]
fn time_stamps_rise_strictly_over_restarts_and_clocks_that_go_back() {
    let mut last = 0;
    let mut state = SigningState::default();
    for (restart, now) in [STAMP, STAMP - 5_000_000, 0, STAMP + 7].into_iter().enumerate() {
        let mut signing = Signing::new(key(), &state);
        for i in 0..40_000_u64 {
            if signing.is_store_due(now + i) {
                state = signing.take_state(now + i);
            }
            let signature = signing.sign(b"frame", 0, now + i);
            let mut stamp = [0; 8];
            stamp[..6].copy_from_slice(&signature[1..7]);
            let stamp = u64::from_le_bytes(stamp);
            assert!(stamp > last, "{restart} {i}: {stamp} after {last}");
            assert!(stamp <= state.used_up_to);
            last = stamp;
        }
    }
}

#[test]
fn the_memory_of_streams_is_bounded() {
    let mut signing = Signing::new(key(), &SigningState::default());
    for i in 0..200_u64 {
        let mut sender = Signing::new(key(), &SigningState::default());
        let from = Header { system: 1 + i as u8, component: 1, sequence: 0 };
        let frame = encode(from, &heartbeat().into(), Some((&mut sender, 0, STAMP + i)));
        assert_eq!(check(&mut signing, &frame, STAMP + i), Ok(()));
    }
    assert_eq!(signing.take_state(STAMP).streams.len(), 64);
}

#[test]
fn the_key_is_in_no_log() {
    let signing = Signing::new([0xAB; 32], &SigningState::default());
    let said = format!("{signing:?}");
    assert!(!said.contains("171") && !said.to_lowercase().contains("ab"), "{said}");
}

#[test]
fn a_flag_that_is_not_understood_hides_no_later_frame() {
    let mut odd = bytes(HEARTBEAT_V2);
    odd[2] = 2;
    odd.extend(bytes(HEARTBEAT_V2));
    assert_eq!(all(&mut Parser::new(), &odd).len(), 1);
}

#[test]
fn a_frame_that_ends_too_soon_costs_one_datagram_only() {
    let mut parser = Parser::new();
    let whole = bytes(HEARTBEAT_V2);
    let mut count = 0;
    parser.push_datagram(&whole[..15], |_| count += 1);
    parser.push_datagram(&whole, |_| count += 1);
    assert_eq!(count, 1);
}

#[test]
fn a_command_that_the_dialect_does_not_know_is_handed_on_raw() {
    let command = |number: u16| {
        let mut payload = vec![0; 33];
        payload[28..30].copy_from_slice(&number.to_le_bytes());
        payload[30] = 1;
        let body = Body::Raw(RawBody { id: COMMAND_LONG_DATA::ID, payload });
        all(&mut Parser::new(), &encode(header(0), &body, None)).remove(0).1
    };
    assert!(matches!(command(400), Body::Message(_)));
    let Body::Raw(raw) = command(42_424) else { panic!("the dialect has learnt a new command") };
    assert_eq!(u16::from_le_bytes(raw.bytes(28)), 42_424);
    assert_eq!(raw.bytes(60), [0_u8; 2]);
}

#[test]
fn every_message_of_the_dialect_survives_the_way_there_and_back() {
    let mut count = 0;
    for id in 0..20_000 {
        let Some(message) = MavMessage::default_message_from_id(id) else { continue };
        let body = Body::from(message);
        let found = all(&mut Parser::new(), &encode(header(1), &body, None));
        assert_eq!(found, [(header(1), body)], "{id}");
        count += 1;
    }
    assert!(count > 150, "{count}");
}

#[test]
fn random_payloads_in_valid_frames_break_nothing() {
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let ids: Vec<u32> =
        (0..20_000).filter(|id| MavMessage::default_message_from_id(*id).is_some()).collect();
    let mut parser = Parser::new();
    for i in 0..1_000_000 {
        let id = ids[i % ids.len()];
        let payload = (0..random.random_range(0..=255)).map(|_| random.random()).collect();
        let frame = encode(header(i as u8), &Body::Raw(RawBody { id, payload }), None);
        assert_eq!(all(&mut parser, &frame).len(), 1);
    }
}

#[test]
fn places_on_the_earth_and_points_of_the_map_are_inverse() {
    let place = Geodetic { latitude_deg: 47.397_742, longitude_deg: 8.545_594 };
    let origin = Origin { place, altitude_m: 488.0 };
    for point in [Point::new(0.0, 0.0), Point::new(123.4, -56.7), Point::new(-900.0, 400.0)] {
        let [latitude, longitude] = origin.place_of(point).as_e7();
        let back = origin.point_of(Geodetic::from_e7(latitude, longitude).unwrap());
        assert!((back - point).norm() < 0.02, "{point} {back}");
    }
    // One degree of latitude there is 111.17 km, one of longitude 75.46 km.
    let north = origin.point_of(Geodetic { latitude_deg: 47.407_742, ..place });
    assert!((north.y - 1111.7).abs() < 0.5 && north.x.abs() < 1e-9, "{north}");
    let east = origin.point_of(Geodetic { longitude_deg: 8.555_594, ..place });
    assert!((east.x - 754.6).abs() < 0.5 && east.y.abs() < 1e-9, "{east}");
    assert_eq!(Geodetic::checked(91.0, 0.0), None);
    assert_eq!(Geodetic::checked(f64::NAN, 0.0), None);
    assert_eq!(Geodetic::from_e7(0, 1_800_000_001), None);
}

#[test]
fn a_car_that_faces_east_has_a_yaw_of_ninety_degrees() {
    assert!((yaw_of(0.0).to_degrees() - 90.0).abs() < 1e-12);
    assert!(yaw_of(std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    assert_eq!(ned_of(Point::new(1.0, 2.0)), [2.0, 1.0]);
    assert_eq!(point_of_ned(2.0, 1.0), Point::new(1.0, 2.0));
    for heading in [-3.0, -1.0, 0.5, 2.0] {
        assert!((map_heading(yaw_of(heading)) - heading).abs() < 1e-12);
    }
}

proptest! {
    #[test]
    fn frames_are_found_among_noise_however_the_bytes_come(
        noise in prop::collection::vec(any::<u8>(), 0..400),
        cuts in prop::collection::vec(1_usize..300, 1..20),
    ) {
        // Frames begin with one of these; noise that has them may swallow what follows it.
        let noise: Vec<u8> = noise.into_iter().filter(|b| *b != 0xFD && *b != 0xFE).collect();
        let mut stream = noise.clone();
        stream.extend(bytes(HEARTBEAT_V2));
        stream.extend(&noise);
        stream.extend(bytes(HEARTBEAT_V1));
        let mut parser = Parser::new();
        let mut found = Vec::new();
        let mut rest = &stream[..];
        for cut in cuts.iter().cycle() {
            if rest.is_empty() {
                break;
            }
            let (piece, more) = rest.split_at((*cut).min(rest.len()));
            found.extend(all(&mut parser, piece));
            rest = more;
        }
        prop_assert_eq!(found.len(), 2);
        prop_assert_eq!(parser.counts().garbage_bytes, 2 * noise.len() as u64);
    }

    #[test]
    fn noise_of_any_kind_only_delays_what_follows(
        noise in prop::collection::vec(prop_oneof![Just(0xFD_u8), Just(0xFE), any::<u8>()], 0..900),
    ) {
        let mut parser = Parser::new();
        all(&mut parser, &noise);
        // At most one frame's length of what follows is taken for a part of the noise.
        let mut found = Vec::new();
        for _ in 0..2 + FRAME_MAX / 21 {
            found.extend(all(&mut parser, &bytes(HEARTBEAT_V2)));
        }
        prop_assert!(found.iter().filter(|(from, _)| *from == header(9)).count() > 1);
    }
}
