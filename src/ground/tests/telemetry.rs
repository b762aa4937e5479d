//! What is told by itself, in intervals and when asked.

use super::*;

#[test]
fn a_message_that_is_asked_for_again_is_sent_again() {
    let mut talk = Talk::new();
    let mut request = long(MavCmd::MAV_CMD_REQUEST_MESSAGE, [148.0, 0., 0., 0., 0., 0., 0.]);
    // Answer and message were lost on their way.
    for confirmation in 0..3 {
        request.confirmation = confirmation;
        let sent = talk.hear(&MavMessage::COMMAND_LONG(request.clone()));
        assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
        assert!(sent.iter().any(|message| matches!(message, MavMessage::AUTOPILOT_VERSION(_))));
    }
}

#[test]
fn a_message_that_is_asked_for_comes_after_its_acknowledgement() {
    let mut talk = Talk::new();
    let request = MavCmd::MAV_CMD_REQUEST_MESSAGE;
    let sent = talk.long(request, [148.0, 0., 0., 0., 0., 0., 0.]);
    let [MavMessage::COMMAND_ACK(ack), MavMessage::AUTOPILOT_VERSION(version)] = &sent[..] else {
        panic!("{sent:?}")
    };
    assert_eq!(ack.result, R::MAV_RESULT_ACCEPTED);
    assert!(version.capabilities.contains(MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_MAVLINK2));
    let sent = talk.long(request, [435.0, 0., 0., 0., 0., 0., 0.]);
    assert_eq!(sent.len(), 5);
    let sent = talk.long(request, [435.0, 2., 0., 0., 0., 0., 0.]);
    let [_, MavMessage::AVAILABLE_MODES(mode)] = &sent[..] else { panic!("{sent:?}") };
    assert_eq!((mode.mode_index, mode.number_modes, mode.custom_mode), (2, 4, 15));
    assert_eq!(mode.mode_name.to_str(), Ok("Guided"));
    assert_eq!(talk.ack(request, [435.0, 5., 0., 0., 0., 0., 0.]), R::MAV_RESULT_DENIED);
    assert_eq!(talk.ack(request, [999.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_UNSUPPORTED);
    assert_eq!(talk.ack(request, [f32::NAN, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_DENIED);
}

#[test]
fn what_cannot_be_told_is_not_promised() {
    let mut talk = Talk::new();
    let request = |id: f32| (MavCmd::MAV_CMD_REQUEST_MESSAGE, [id, 0., 0., 0., 0., 0., 0.]);
    let get_home = (MavCmd::MAV_CMD_GET_HOME_POSITION, [0.0; 7]);
    // Origin, home and place on the earth, before anybody has said where the map lies.
    for (command, params) in [request(49.0), request(242.0), request(33.0), get_home] {
        let sent = talk.long(command, params);
        assert_eq!(result(&sent), R::MAV_RESULT_FAILED, "{params:?}");
        assert_eq!(sent.len(), 1, "stations ask often, and are not told each time: {sent:?}");
    }
    // What the core does not know now it may know soon.
    let mut blind = view(talk.now, CoreMode::Disarmed);
    (blind.pose, blind.scan) = (None, None);
    talk.ground.handle_core(talk.now, blind);
    talk.drain();
    for id in [30.0, 32.0, 330.0] {
        let (command, params) = request(id);
        assert_eq!(talk.ack(command, params), R::MAV_RESULT_TEMPORARILY_REJECTED, "{id}");
    }
    let origin = [0.0, 0.0, 0.0, 0.0, 47.397_742, 8.545_594, 488.0];
    talk.ack(MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN, origin);
    for (command, params) in [request(49.0), request(242.0), get_home] {
        let sent = talk.long(command, params);
        assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED, "{params:?}");
        assert_eq!(sent.len(), 2, "{sent:?}");
    }
}

#[test]
fn intervals_are_set_for_one_link_and_told() {
    let mut talk = Talk::new();
    let other = ChannelId(8);
    assert!(talk.ground.handle_channel_open(talk.now, other, ChannelInfo::default()));
    let set = MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL;
    let attitude = |us: f32| [30.0, us, 0., 0., 0., 0., 0.];
    assert_eq!(talk.ack(set, attitude(1e6)), R::MAV_RESULT_ACCEPTED);
    let count = |talk: &mut Talk| {
        let mut counts = [0_i32, 0];
        for _ in 0..40 {
            talk.now = talk.now.offset_by(0.05);
            talk.look();
            talk.ground.handle_time(talk.now);
            while let Some((to, body)) = talk.ground.poll_message() {
                if body.id() == 30 {
                    counts[usize::from(to == To::Channel(other))] += 1;
                }
            }
        }
        counts
    };
    // The one that was just set is due at once.
    let near = |counts: [i32; 2], wanted: [i32; 2]| {
        assert!(counts.iter().zip(wanted).all(|(a, b)| (a - b).abs() <= 1), "{counts:?}");
    };
    near(count(&mut talk), [2, 20]);
    let sent = talk.long(MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL, attitude(0.0));
    let told = sent.iter().find_map(|message| match message {
        MavMessage::MESSAGE_INTERVAL(data) => Some((data.message_id, data.interval_us)),
        _ => None,
    });
    assert_eq!(told, Some((30, 1_000_000)));
    assert_eq!(talk.ack(set, attitude(-1.0)), R::MAV_RESULT_ACCEPTED);
    near(count(&mut talk), [0, 20]);
    assert_eq!(talk.ack(set, attitude(0.0)), R::MAV_RESULT_ACCEPTED);
    near(count(&mut talk), [20, 20]);
    for us in [1.0, 1e13, f32::NAN, f32::INFINITY, -7.0] {
        assert_eq!(talk.ack(set, attitude(us)), R::MAV_RESULT_DENIED, "{us}");
    }
    assert_eq!(talk.ack(set, [300.0, 1e6, 0., 0., 0., 0., 0.]), R::MAV_RESULT_UNSUPPORTED);
}

#[test]
fn a_slow_link_gets_less() {
    let mut bytes = 0;
    let mut talk = Talk::new();
    talk.ground.handle_channel_closed(CHANNEL);
    let slow = ChannelInfo { trusted: true, bytes_per_s: Some(1000.0) };
    talk.ground.handle_channel_open(talk.now, CHANNEL, slow);
    for message in talk.advance(20.0) {
        let mut buffer = [0; 300];
        bytes += message.ser(MavlinkVersion::V2, &mut buffer) + 12;
    }
    assert!((8_000..16_000).contains(&bytes), "{bytes} bytes in 20 s");
}

#[test]
fn telemetry_says_what_the_core_knows_in_the_other_frame() {
    let mut talk = Talk::with(MavlinkParams {
        origin_known: true,
        origin_latitude_deg: 47.0,
        origin_longitude_deg: 8.0,
        battery_empty_v: 6.4,
        battery_full_v: 8.4,
        ..MavlinkParams::default()
    });
    let sent = talk.advance(6.0);
    let count = |id: u32| sent.iter().filter(|message| message.message_id() == id).count();
    for id in [1, 2, 30, 32, 33, 49, 62, 74, 85, 147, 242, 245, 330, 331, 332, 436] {
        assert!(count(id) >= 1, "message {id} is missing");
    }
    assert!((55..=65).contains(&count(32)), "{}", count(32));
    for message in &sent {
        match message {
            MavMessage::LOCAL_POSITION_NED(data) => {
                assert_eq!((data.x, data.y, data.z), (2.0, 1.0, 0.0));
                assert!(data.vx.abs() < 1e-6 && (data.vy - 1.5).abs() < 1e-6);
            }
            MavMessage::ATTITUDE(data) => {
                assert!((data.yaw - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
                assert_eq!(data.yawspeed, -0.2);
            }
            MavMessage::GLOBAL_POSITION_INT(data) => {
                assert_eq!(data.hdg, 9000);
                assert!(data.lat > 470_000_000 && data.lon > 80_000_000);
            }
            MavMessage::SYS_STATUS(data) => {
                assert_eq!((data.load, data.voltage_battery), (123, 7400));
                assert_eq!(data.battery_remaining, 50);
                assert_eq!(
                    data.onboard_control_sensors_health,
                    data.onboard_control_sensors_present
                );
            }
            MavMessage::TRAJECTORY_REPRESENTATION_WAYPOINTS(data) => {
                assert_eq!(data.valid_points, 2);
                assert_eq!((data.pos_x[1], data.pos_y[1]), (2.0, 3.0));
                assert!(data.pos_x[2].is_nan());
            }
            MavMessage::OBSTACLE_DISTANCE(data) => {
                assert!(data.distances.iter().all(|cm| *cm == 300));
            }
            _ => {}
        }
    }
}

#[test]
fn without_inputs_the_health_bits_say_so_and_positions_are_not_made_up() {
    use crate::wire::mavlink::common::MavSysStatusSensor as Sensor;
    let mut talk = Talk::new();
    let mut blind = view(talk.now, CoreMode::Disarmed);
    blind.pose = None;
    blind.fresh = Fresh::default();
    blind.battery_v = None;
    blind.not_ready = vec!["no fresh wheel odometry".into()];
    talk.ground.handle_core(talk.now, blind);
    talk.ground.handle_time(talk.now);
    let sent = talk.drain();
    let health = sent.iter().find_map(|message| match message {
        MavMessage::SYS_STATUS(data) => Some(data.onboard_control_sensors_health),
        _ => None,
    });
    assert_eq!(health, Some(Sensor::empty()));
    for id in [30, 32, 33, 330, 331] {
        assert!(sent.iter().all(|message| message.message_id() != id), "message {id}");
    }
}

#[test]
fn the_clock_is_told_to_who_asks() {
    let mut talk = Talk::new();
    let ask = c::TIMESYNC_DATA { tc1: 0, ts1: 77, target_system: 0, target_component: 0 };
    let sent = talk.hear(&MavMessage::TIMESYNC(ask.clone()));
    let [MavMessage::TIMESYNC(answer)] = &sent[..] else { panic!("{sent:?}") };
    assert_eq!((answer.tc1, answer.ts1), (talk.now.as_nanos() as i64, 77));
    assert_eq!((answer.target_system, answer.target_component), (255, 190));
    // An answer of somebody else is not answered.
    assert!(talk.hear(&MavMessage::TIMESYNC(c::TIMESYNC_DATA { tc1: 5, ..ask })).is_empty());
}

#[test]
fn long_words_come_in_pieces_of_fifty_bytes() {
    let mut out = Outbox::default();
    let text = "ä".repeat(60);
    out.say(MavSeverity::MAV_SEVERITY_INFO, &text);
    let mut together = String::new();
    let mut pieces = 0;
    while let Some((To::Everyone, Body::Message(message))) = out.poll_message() {
        let MavMessage::STATUSTEXT(data) = *message else { panic!() };
        assert_eq!(u32::from(data.chunk_seq), pieces);
        assert_eq!(data.id, 1);
        together += data.text.to_str().unwrap();
        pieces += 1;
    }
    assert_eq!((together, pieces), (text, 3));
    // One that fills its last piece needs an empty one, which says that it has ended.
    out.say(MavSeverity::MAV_SEVERITY_INFO, &"x".repeat(100));
    assert_eq!(std::iter::from_fn(|| out.poll_message()).count(), 3);
    out.say(MavSeverity::MAV_SEVERITY_INFO, &"x".repeat(50));
    assert_eq!(std::iter::from_fn(|| out.poll_message()).count(), 1);
}

#[test]
fn only_as_a_px4_and_while_it_is_armed_the_car_seems_to_fly() {
    use crate::wire::mavlink::common::MavLandedState as Landed;
    const AIR: Landed = Landed::MAV_LANDED_STATE_IN_AIR;
    const GROUND: Landed = Landed::MAV_LANDED_STATE_ON_GROUND;
    for (identity, armed) in [(Identity::Generic, GROUND), (Identity::Px4, AIR)] {
        for (mode, wanted) in [
            (CoreMode::Disarmed, GROUND),
            (CoreMode::Standby, armed),
            (CoreMode::Drive, armed),
            (CoreMode::Stop, armed),
            (CoreMode::Terminated, GROUND),
        ] {
            let mut talk = Talk::with(MavlinkParams { identity, ..MavlinkParams::default() });
            talk.mode = mode;
            talk.look();
            talk.drain();
            let request = [245.0, 0., 0., 0., 0., 0., 0.];
            let sent = talk.long(MavCmd::MAV_CMD_REQUEST_MESSAGE, request);
            let [_, MavMessage::EXTENDED_SYS_STATE(state)] = &sent[..] else { panic!("{sent:?}") };
            assert_eq!(state.landed_state, wanted, "{identity:?} {mode:?}");
        }
    }
}
