//! What the heartbeat shows, and the modes in both alphabets.

use super::*;

#[test]
fn heartbeats_come_each_second_at_once_on_a_change_and_only_while_the_core_is_alive() {
    let mut talk = Talk::new();
    assert_eq!(heartbeats(&talk.advance(3.0)).len(), 3);
    talk.mode = CoreMode::Drive;
    let sent = talk.advance(0.05);
    let beat = &heartbeats(&sent)[0];
    assert!(beat.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED));
    assert_eq!(beat.system_status, MavState::MAV_STATE_ACTIVE);
    assert!(sent.iter().any(|message| matches!(message, MavMessage::CURRENT_MODE(_))));
    talk.mode = CoreMode::Disarmed;
    let beat = &heartbeats(&talk.advance(0.05))[0];
    assert!(!beat.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED));
    // The core falls silent.
    let mut after = Vec::new();
    for _ in 0..100 {
        talk.now = talk.now.offset_by(0.05);
        talk.ground.handle_time(talk.now);
        after.extend(talk.drain().into_iter().map(|message| (talk.now, message)));
    }
    let late = talk.now.offset_by(-4.4);
    assert!(after.iter().all(|(at, _)| *at < late), "{:?}", after.last());
}

#[test]
fn its_time_comes_however_much_else_happens() {
    let mut talk = Talk::new();
    talk.ground.handle_time(talk.now);
    let due = talk.ground.poll_at();
    for _ in 0..100 {
        talk.now = talk.now.offset_by(0.001);
        talk.hear(&station_heartbeat());
        talk.look();
    }
    assert_eq!(talk.ground.poll_at(), due);
    assert!(due.seconds_after(talk.now) < 0.0);
}

#[test]
fn a_failsafe_shows_in_heartbeat_mode_and_words() {
    let mut talk = Talk::new();
    talk.ack(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, 15.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    let fault = CoreFault { name: "scan late", detection: "", action: FaultAction::FinishesPlan };
    let mut stopped = view(talk.now, CoreMode::Stop);
    stopped.faults.push(fault);
    talk.ground.handle_core(talk.now, stopped);
    talk.ground.handle_event(talk.now, &CoreEvent::FaultRaised(fault));
    let sent = talk.drain();
    let beat = &heartbeats(&sent)[0];
    assert_eq!((beat.custom_mode, beat.system_status), (4, MavState::MAV_STATE_CRITICAL));
    let shown = sent.iter().find_map(|message| match message {
        MavMessage::CURRENT_MODE(data) => Some((data.custom_mode, data.intended_custom_mode)),
        _ => None,
    });
    assert_eq!(shown, Some((4, 15)));
    assert_eq!(texts(&sent), "Failsafe: scan late, stopping");
}

#[test]
fn the_two_identities_speak_their_own_alphabets_and_understand_both() {
    for (identity, autopilot, hold) in [
        (Identity::Generic, MavAutopilot::MAV_AUTOPILOT_GENERIC, 4),
        (Identity::Px4, MavAutopilot::MAV_AUTOPILOT_PX4, 4 << 16 | 3 << 24),
    ] {
        let mut talk = Talk::with(MavlinkParams { identity, ..MavlinkParams::default() });
        let beat = heartbeats(&talk.advance(1.0)).remove(0);
        assert_eq!((beat.autopilot, beat.custom_mode), (autopilot, hold));
        for (main, sub, mode) in [
            (15.0, 0.0, Mode::Guided),
            (4.0, 0.0, Mode::Hold),
            (6.0, 0.0, Mode::Offboard),
            (4.0, 3.0, Mode::Hold),
            (11.0, 0.0, Mode::Return),
            (4.0, 5.0, Mode::Return),
        ] {
            let set = [1.0, main, sub, 0.0, 0.0, 0.0, 0.0];
            assert_eq!(talk.ack(MavCmd::MAV_CMD_DO_SET_MODE, set), R::MAV_RESULT_ACCEPTED);
            assert_eq!(talk.ground.mode(), mode);
        }
        for (main, sub) in [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (4.0, 2.0), (10.0, 0.0)] {
            // The same words are not said twice in a row.
            talk.advance(3.0);
            let sent = talk.long(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, main, sub, 0.0, 0.0, 0.0, 0.0]);
            assert_eq!(result(&sent), R::MAV_RESULT_FAILED, "{main}/{sub}");
            assert!(texts(&sent).contains("refused"), "{sent:?}");
            assert_eq!(talk.ground.mode(), Mode::Return);
        }
        // The flag for custom modes is missing; a number is none.
        for p in [[0.0, 15.0], [f32::NAN, 15.0], [1.0, f32::NAN], [1.0, -1.0], [1.0, 4.5]] {
            let set = [p[0], p[1], 0.0, 0.0, 0.0, 0.0, 0.0];
            assert_eq!(talk.ack(MavCmd::MAV_CMD_DO_SET_MODE, set), R::MAV_RESULT_DENIED);
        }
    }
}

/// QGroundControl sets modes of a PX4 by this message, for which there is no acknowledgement
/// (`Vehicle.cc`, `setFlightMode`); it starts missions so.
#[test]
fn the_old_message_for_modes_chooses_every_mode() {
    const MISSION: &str = "QGC WPL 110\n0\t0\t1\t16\t0\t0\t0\t0\t1\t2\t0\t1\n";
    let kept = |name: &str| (name == "mission.txt").then(|| MISSION.to_owned());
    for identity in [Identity::Generic, Identity::Px4] {
        let params = MavlinkParams { identity, ..MavlinkParams::default() };
        let mut talk = Talk::serving(params, vec![Box::new(Mission::new(1, None, kept))]);
        for mode in Mode::all(identity).iter().rev() {
            let custom_mode = mode.custom_mode(identity);
            let sent = talk.hear(&MavMessage::SET_MODE(c::SET_MODE_DATA {
                custom_mode,
                target_system: 1,
                base_mode: MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
            }));
            assert_eq!(talk.ground.mode(), *mode, "{}", texts(&sent));
            assert!(sent.iter().all(|message| message.message_id() != 77), "{sent:?}");
            assert!(heartbeats(&sent).iter().any(|beat| beat.custom_mode == custom_mode));
        }
        let goal = Point::new(2.0, 1.0);
        assert!(talk.asked.contains(&CoreRequest::Goto { point: goal, through_known: false }));
    }
}

#[test]
fn every_mode_leads_back_to_itself_in_its_own_alphabet() {
    for identity in [Identity::Generic, Identity::Px4] {
        for mode in Mode::all(identity) {
            assert_eq!(Mode::of_custom(mode.custom_mode(identity)), Ok(*mode));
        }
    }
}

#[test]
fn a_drive_that_has_ended_is_not_shown_until_the_next_view() {
    let mut talk = Talk::new();
    let sent = talk.long(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, 15.0, 0., 0., 0., 0., 0.]);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    talk.mode = CoreMode::Drive;
    talk.look();
    talk.drain();
    talk.ground.handle_event(talk.now, &CoreEvent::ModeChanged { to: CoreMode::Standby });
    talk.ack(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, 4.0, 0., 0., 0., 0., 0.]);
    // Chosen is to hold, and there is nothing that says otherwise.
    talk.now = talk.now.offset_by(0.02);
    talk.ground.handle_time(talk.now);
    let modes: Vec<_> = heartbeats(&talk.drain()).iter().map(|beat| beat.custom_mode).collect();
    assert!(modes.iter().all(|mode| *mode == 4), "{modes:?}");
    talk.ground.handle_channel_open(talk.now, ChannelId(7), ChannelInfo::default());
    talk.ground.handle_time(talk.now);
    let modes: Vec<_> = heartbeats(&talk.drain()).iter().map(|beat| beat.custom_mode).collect();
    assert_eq!(modes, [4]);
}
