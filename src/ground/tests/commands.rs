//! Commands: asked of the core, refused, repeated, unknown.

use super::*;

#[test]
fn arming_is_the_cores_decision_and_force_is_refused_unless_allowed() {
    let arm = MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;
    let mut talk = Talk::new();
    assert_eq!(talk.ack(arm, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Arm]);
    talk.refusal = Some(Refusal::failed("no fresh lidar scan"));
    let sent = talk.long(arm, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(result(&sent), R::MAV_RESULT_FAILED);
    assert_eq!(texts(&sent), "COMPONENT_ARM_DISARM refused: no fresh lidar scan");
    talk.asked.clear();
    talk.refusal = None;
    for force in [21196.0, 2989.0] {
        let sent = talk.ack(arm, [1.0, force, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(sent, R::MAV_RESULT_DENIED);
    }
    assert_eq!(talk.ack(arm, [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), R::MAV_RESULT_DENIED);
    assert_eq!(talk.ack(arm, [f32::NAN, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), R::MAV_RESULT_DENIED);
    assert!(talk.asked.is_empty());
    assert_eq!(talk.ack(arm, [0.0, 21196.0, 0.0, 0.0, 0.0, 0.0, 0.0]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Disarm]);
    let allowed = MavlinkParams { forced_arming: true, ..MavlinkParams::default() };
    let mut talk = Talk::with(allowed);
    assert_eq!(talk.ack(arm, [1.0, 21196.0, 0.0, 0.0, 0.0, 0.0, 0.0]), R::MAV_RESULT_ACCEPTED);
}

#[test]
fn the_checks_before_arming_are_told_one_by_one() {
    let mut talk = Talk::new();
    let run = MavCmd::MAV_CMD_RUN_PREARM_CHECKS;
    assert_eq!(talk.ack(run, [0.0; 7]), R::MAV_RESULT_TEMPORARILY_REJECTED);
    let mut unready = view(talk.now, CoreMode::Disarmed);
    unready.not_ready = vec!["no fresh lidar scan".into(), "the car is moving".into()];
    talk.ground.handle_core(talk.now, unready);
    let sent = talk.long(run, [0.0; 7]);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    assert_eq!(texts(&sent), "PreArm: no fresh lidar scanPreArm: the car is moving");
}

#[test]
fn pausing_keeps_the_mode_for_going_on() {
    let mut talk = Talk::new();
    talk.int(MavCmd::MAV_CMD_DO_REPOSITION, MavFrame::MAV_FRAME_LOCAL_NED, 50_000, 0);
    talk.mode = CoreMode::Drive;
    talk.look();
    let pause = MavCmd::MAV_CMD_DO_PAUSE_CONTINUE;
    assert_eq!(talk.ack(pause, [0.0; 7]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.ground.mode(), Mode::Hold);
    talk.mode = CoreMode::Hold;
    talk.look();
    assert_eq!(talk.ack(pause, [0.0; 7]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.ack(pause, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.ground.mode(), Mode::Guided);
    assert_eq!(talk.ack(pause, [2.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_DENIED);
    assert_eq!(talk.asked[1..], [CoreRequest::Hold, CoreRequest::Hold, CoreRequest::Continue]);
}

#[test]
fn speeds_are_asked_for_within_what_the_parameters_allow() {
    let mut talk = Talk::new();
    let change = MavCmd::MAV_CMD_DO_CHANGE_SPEED;
    let mut ack = |kind: f32, speed: f32| talk.ack(change, [kind, speed, -1., 0., 0., 0., 0.]);
    assert_eq!(ack(1.0, 1.5), R::MAV_RESULT_ACCEPTED);
    assert_eq!(ack(0.0, 4.0), R::MAV_RESULT_ACCEPTED);
    assert_eq!(ack(1.0, -1.0), R::MAV_RESULT_ACCEPTED);
    assert_eq!(ack(1.0, -2.0), R::MAV_RESULT_ACCEPTED);
    for speed in [0.0, -3.0, 4.1, f32::NAN, f32::INFINITY] {
        assert_eq!(ack(1.0, speed), R::MAV_RESULT_DENIED, "{speed}");
    }
    assert_eq!(ack(2.0, 1.0), R::MAV_RESULT_DENIED);
    let limits = [Some(1.5), Some(4.0), None].map(CoreRequest::SpeedLimit);
    assert_eq!(talk.asked, limits);
}

#[test]
fn the_way_back_leads_home_through_known_space() {
    let mut talk = Talk::new();
    let set = [0.0, 0.0, 0.0, 0.0, f32::NAN, f32::NAN, 0.0];
    assert_eq!(talk.ack(MavCmd::MAV_CMD_DO_SET_HOME, set), R::MAV_RESULT_DENIED);
    let back = MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH;
    assert_eq!(talk.ack(back, [0.0; 7]), R::MAV_RESULT_ACCEPTED);
    let goto = |point| CoreRequest::Goto { point, through_known: true };
    assert_eq!(talk.asked, [goto(Point::origin())]);
    assert_eq!(talk.ground.mode(), Mode::Return);
    // Home can be moved to where the car is.
    let here = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    assert_eq!(talk.ack(MavCmd::MAV_CMD_DO_SET_HOME, here), R::MAV_RESULT_ACCEPTED);
    talk.ack(back, [0.0, 0., 0., 0., 0., 0., 1.0]);
    assert_eq!(talk.asked[1], goto(Point::new(1.0, 2.0)));
}

#[test]
fn termination_and_restart_are_asked_for_only_in_earnest() {
    let mut talk = Talk::new();
    let terminate = MavCmd::MAV_CMD_DO_FLIGHTTERMINATION;
    // As a station asks whether there is such a thing.
    assert_eq!(talk.ack(terminate, [0.0; 7]), R::MAV_RESULT_FAILED);
    assert!(talk.asked.is_empty());
    assert_eq!(talk.ack(terminate, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Terminate]);
    let reboot = MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN;
    assert_eq!(talk.ack(reboot, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_FAILED);
    talk.mode = CoreMode::Terminated;
    let beat = heartbeats(&talk.advance(0.05)).remove(0);
    assert_eq!(beat.system_status, MavState::MAV_STATE_FLIGHT_TERMINATION);
    assert_eq!(talk.ack(terminate, [0.0; 7]), R::MAV_RESULT_FAILED);
    assert_eq!(talk.ack(reboot, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked[1..], [CoreRequest::Restart]);
}

#[test]
fn a_repeated_command_is_answered_again_but_not_obeyed_again() {
    let mut talk = Talk::new();
    let mut arm = long(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0., 0., 0., 0., 0., 0.]);
    talk.ground.handle_message(talk.now, STATION, &MavMessage::COMMAND_LONG(arm.clone()));
    // The core has not answered yet.
    arm.confirmation = 1;
    talk.ground.handle_message(talk.now, STATION, &MavMessage::COMMAND_LONG(arm.clone()));
    assert_eq!(result(&talk.drain()), R::MAV_RESULT_ACCEPTED);
    arm.confirmation = 2;
    assert_eq!(result(&talk.hear(&MavMessage::COMMAND_LONG(arm))), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Arm]);
}

#[test]
fn a_core_that_does_not_answer_leaves_nobody_waiting() {
    let mut talk = Talk::new();
    let arm = long(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0., 0., 0., 0., 0., 0.]);
    talk.ground.handle_message(talk.now, STATION, &MavMessage::COMMAND_LONG(arm.clone()));
    while talk.ground.poll_request().is_some() {}
    let sent = talk.advance(1.1);
    assert_eq!(result(&sent), R::MAV_RESULT_TEMPORARILY_REJECTED);
    // Without a view nothing is even asked.
    talk.now = talk.now.offset_by(2.0);
    let sent = talk.hear(&MavMessage::COMMAND_LONG(arm));
    assert_eq!(result(&sent), R::MAV_RESULT_TEMPORARILY_REJECTED);
}

#[test]
fn what_is_not_known_is_acknowledged_as_such() {
    let mut talk = Talk::new();
    let sent = talk.long(MavCmd::MAV_CMD_NAV_TAKEOFF, [0.0; 7]);
    assert_eq!(result(&sent), R::MAV_RESULT_UNSUPPORTED);
    assert!(texts(&sent).contains("NAV_TAKEOFF refused"), "{sent:?}");
    let raw = |command: u16, frame: u8, id: u32| {
        let mut payload = vec![0; 35];
        payload[28..30].copy_from_slice(&command.to_le_bytes());
        payload[30..33].copy_from_slice(&[1, 1, frame]);
        RawBody { id, payload }
    };
    talk.ground.handle_raw(talk.now, STATION, &raw(42_424, 0, COMMAND_LONG_DATA::ID));
    let Some((To::Everyone, Body::Message(text))) = talk.ground.poll_message() else { panic!() };
    assert!(texts(&[*text]).starts_with("Command 42424 refused"));
    let _rest_of_the_text = talk.ground.poll_message();
    let Some((To::Channel(CHANNEL), Body::Raw(ack))) = talk.ground.poll_message() else { panic!() };
    assert_eq!((ack.id, &ack.payload[..]), (77, &[0xB8, 0xA5, 3, 0, 0, 0, 0, 0, 255, 190][..]));
    // A frame that does not exist.
    talk.ground.handle_raw(talk.now, STATION, &raw(192, 99, COMMAND_INT_DATA::ID));
    let sent = talk.drain();
    assert_eq!(result(&sent), R::MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME);
}

#[test]
fn messages_for_others_and_from_nobody_are_left_alone() {
    let mut talk = Talk::new();
    let arm = long(MavCmd::MAV_CMD_COMPONENT_ARM_DISARM, [1.0, 0., 0., 0., 0., 0., 0.]);
    for (system, component) in [(2, 1), (1, 25), (255, 0)] {
        let other =
            COMMAND_LONG_DATA { target_system: system, target_component: component, ..arm.clone() };
        assert!(talk.hear(&MavMessage::COMMAND_LONG(other)).is_empty());
    }
    let ourselves = Peer { system: 1, component: 1, ..STATION };
    let unknown = Peer { channel: ChannelId(99), ..STATION };
    for peer in [ourselves, unknown] {
        talk.ground.handle_message(talk.now, peer, &MavMessage::COMMAND_LONG(arm.clone()));
        assert!(talk.drain().is_empty());
    }
    assert!(talk.asked.is_empty());
}
