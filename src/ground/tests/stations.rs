//! Stations that fall silent, and their keys.

use super::*;

#[test]
fn a_lost_station_is_missed_only_if_it_was_there_and_the_car_is_armed() {
    for (station_lost, asked) in [
        (StationLost::Report, vec![]),
        (
            StationLost::Stop,
            vec![CoreRequest::GroundStationLost(true), CoreRequest::GroundStationLost(false)],
        ),
        (
            StationLost::Return,
            vec![CoreRequest::Goto { point: Point::origin(), through_known: true }],
        ),
    ] {
        let mut talk = Talk::with(MavlinkParams { station_lost, ..MavlinkParams::default() });
        assert_eq!(texts(&talk.advance(10.0)), "");
        talk.hear(&station_heartbeat());
        talk.mode = CoreMode::Disarmed;
        assert_eq!(texts(&talk.advance(10.0)), "");
        talk.mode = CoreMode::Drive;
        talk.hear(&station_heartbeat());
        assert_eq!(texts(&talk.advance(4.9)), "");
        assert!(texts(&talk.advance(0.3)).starts_with("Ground station lost"));
        assert_eq!(texts(&talk.advance(10.0)), "");
        talk.hear(&station_heartbeat());
        assert_eq!(texts(&talk.advance(0.1)), "Ground station is back");
        assert_eq!(talk.asked, asked, "{station_lost:?}");
    }
}

#[test]
fn a_key_is_taken_from_trusted_links_only_if_that_is_allowed() {
    let setup = MavMessage::SETUP_SIGNING(c::SETUP_SIGNING_DATA {
        initial_timestamp: 0,
        target_system: 1,
        target_component: 1,
        secret_key: [9; 32],
    });
    for (key_setup, trusted, taken) in [
        (KeySetup::Refuse, true, false),
        (KeySetup::Trusted, false, false),
        (KeySetup::Trusted, true, true),
    ] {
        let mut talk = Talk::with(MavlinkParams { key_setup, ..MavlinkParams::default() });
        let info = ChannelInfo { trusted, bytes_per_s: None };
        talk.ground.handle_channel_open(talk.now, CHANNEL, info);
        let sent = talk.hear(&setup);
        assert_eq!(texts(&sent).contains("refused"), !taken);
        assert_eq!(!talk.asked.is_empty(), taken);
        assert!(!format!("{:?}", talk.asked).contains('9'));
    }
}

#[test]
fn a_key_of_zeros_ends_no_signatures() {
    let key_setup = KeySetup::Trusted;
    let mut talk = Talk::with(MavlinkParams { key_setup, ..MavlinkParams::default() });
    let info = ChannelInfo { trusted: true, bytes_per_s: None };
    talk.ground.handle_channel_open(talk.now, CHANNEL, info);
    let sent = talk.hear(&MavMessage::SETUP_SIGNING(c::SETUP_SIGNING_DATA {
        initial_timestamp: 0,
        target_system: 1,
        target_component: 1,
        secret_key: [0; 32],
    }));
    assert!(texts(&sent).contains("SETUP_SIGNING refused"), "{}", texts(&sent));
    assert_eq!(talk.asked, []);
}
