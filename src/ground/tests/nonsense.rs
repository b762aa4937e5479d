//! Floods and nonsense.

use super::*;

#[test]
fn a_flood_fills_no_memory() {
    let mut talk = Talk::new();
    for i in 0..50_000_u32 {
        let peer = Peer { system: (i % 255) as u8 + 1, component: (i / 255) as u8, ..STATION };
        let mut arm = long(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0., 0., 0., 0., 0., 0.]);
        arm.confirmation = i as u8;
        talk.ground.handle_message(talk.now, peer, &MavMessage::COMMAND_LONG(arm));
        talk.ground.handle_message(talk.now, peer, &station_heartbeat());
    }
    let messages = std::iter::from_fn(|| talk.ground.poll_message()).count();
    let requests = std::iter::from_fn(|| talk.ground.poll_request()).count();
    assert!(messages <= 1024 && requests <= 64, "{messages} messages, {requests} requests");
    assert!(talk.ground.peers(talk.now).len() <= 32);
    for i in 0..1000 {
        talk.ground.handle_channel_open(talk.now, ChannelId(100 + i), ChannelInfo::default());
    }
    assert!(talk.ground.channels.count() <= CHANNELS_MAX);
}

/// A number as a hostile or broken station may send it.
fn odd_number() -> impl Strategy<Value = f32> {
    prop_oneof![
        any::<f32>(),
        Just(f32::NAN),
        Just(f32::INFINITY),
        Just(f32::NEG_INFINITY),
        Just(0.0),
        Just(1.0),
        Just(f32::MAX),
    ]
}

/// Messages that are obeyed without an acknowledgement: mode, origin, and goals in two frames.
const OLD_WORDS: [u32; 4] = [11, 48, 84, 86];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn no_payload_makes_it_panic_or_leaves_a_command_without_an_answer(
        id in prop_oneof![Just(75_u32), Just(76), 0_u32..450],
        mut payload in prop::collection::vec(any::<u8>(), 33..=255),
        numbers in prop::collection::vec(odd_number(), 7),
        command in prop_oneof![16_u16..700, any::<u16>()],
        armed in any::<bool>(),
    ) {
        prop_assume!(MavMessage::default_message_from_id(id).is_some());
        let is_command = id == 75 || id == 76;
        if is_command {
            for (i, number) in numbers.iter().enumerate() {
                payload[4 * i..4 * i + 4].copy_from_slice(&number.to_le_bytes());
            }
            payload[28..30].copy_from_slice(&command.to_le_bytes());
            payload[30..32].copy_from_slice(&[1, 1]);
        }
        let mut talk = Talk::new();
        talk.mode = if armed { CoreMode::Drive } else { CoreMode::Disarmed };
        talk.look();
        talk.drain();
        let body = Body::decode(MavlinkVersion::V2, id, &payload);
        let before = (talk.ground.mode(), talk.ground.origin, talk.ground.home);
        talk.ground.handle_body(talk.now, STATION, &body);
        let sent = talk.drain();
        let accepted = sent.iter().any(|message| match message {
            MavMessage::COMMAND_ACK(ack) => ack.result == R::MAV_RESULT_ACCEPTED,
            _ => false,
        });
        if !accepted && !OLD_WORDS.contains(&id) {
            prop_assert_eq!(&talk.asked, &[]);
            let after = (talk.ground.mode(), talk.ground.origin, talk.ground.home);
            prop_assert_eq!(after, before);
        }
        if is_command {
            let acks = sent.iter().filter(|m| m.message_id() == 77).count();
            // An acknowledgement of a command that the dialect lacks cannot be parsed here.
            prop_assert!(acks == 1 || matches!(body, Body::Raw(_)), "{body:?}: {sent:?}");
        }
        for request in &talk.asked {
            if let CoreRequest::Goto { point, .. } = request {
                prop_assert!(point.coords.norm() <= 1000.0);
            }
            if let CoreRequest::SpeedLimit(Some(speed)) = request {
                prop_assert!((0.0999..=4.0).contains(speed));
            }
        }
        talk.advance(0.5);
    }
}
