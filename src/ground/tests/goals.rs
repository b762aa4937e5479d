//! Goals and places in every frame, and the places that are kept.

use super::*;

#[test]
fn a_goal_in_the_local_frame_turns_north_east_into_map_coordinates() {
    let mut talk = Talk::new();
    let reposition = MavCmd::MAV_CMD_DO_REPOSITION;
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_LOCAL_NED, 50_000, -12_500);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    let point = Point::new(-1.25, 5.0);
    assert_eq!(talk.asked, [CoreRequest::Goto { point, through_known: false }]);
    assert_eq!(talk.ground.mode(), Mode::Guided);
    talk.asked.clear();
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_LOCAL_ENU, 50_000, -12_500);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    let point = Point::new(5.0, -1.25);
    assert_eq!(talk.asked, [CoreRequest::Goto { point, through_known: false }]);
}

#[test]
fn a_goal_on_the_earth_needs_an_origin() {
    let mut talk = Talk::new();
    let reposition = MavCmd::MAV_CMD_DO_REPOSITION;
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_GLOBAL, 473_977_420, 85_455_940);
    assert_eq!(result(&sent), R::MAV_RESULT_FAILED);
    assert!(texts(&sent).contains("origin"));
    let origin = [0.0, 0.0, 0.0, 0.0, 47.397_742, 8.545_594, 488.0];
    let sent = talk.long(MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN, origin);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    assert!(sent.iter().any(|message| matches!(message, MavMessage::GPS_GLOBAL_ORIGIN(_))));
    let ten_m_north = 473_977_420 + 899;
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_GLOBAL_INT, ten_m_north, 85_455_940);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    let [CoreRequest::Goto { point, .. }] = talk.asked[..] else { panic!("{:?}", talk.asked) };
    // The origin came in single precision: half a metre.
    assert!((point - Point::new(0.0, 10.0)).norm() < 0.5, "{point}");
}

/// Keeps texts where a test can see them, or refuses to.
#[derive(Clone, Default)]
struct Drawer(std::sync::Arc<std::sync::Mutex<(Option<String>, bool)>>);

impl Keeper for Drawer {
    fn keep(&mut self, name: &str, text: &str) -> Result<(), String> {
        assert_eq!(name, SAID_PLACES);
        let mut drawer = self.0.lock().unwrap();
        if drawer.1 {
            return Err("the disk is full".into());
        }
        drawer.0 = Some(text.into());
        Ok(())
    }
}

#[test]
fn origin_and_home_that_a_station_set_outlast_a_restart() {
    let drawer = Drawer::default();
    let kept = || drawer.0.lock().unwrap().0.clone();
    let start = |params: MavlinkParams| {
        let mut talk = Talk::with(params);
        let text = kept();
        talk.ground.keep_places(Some(Box::new(drawer.clone())), text.as_deref()).unwrap();
        talk
    };
    let mut talk = start(MavlinkParams::default());
    assert_eq!(kept(), None, "nothing was said");
    let refused = [0.0, 0.0, 0.0, 0.0, 95.0, 8.5, 0.0];
    assert_ne!(talk.ack(MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN, refused), R::MAV_RESULT_ACCEPTED);
    assert_eq!(kept(), None, "what was refused is not kept");
    let origin = c::SET_GPS_GLOBAL_ORIGIN_DATA {
        latitude: 473_977_420,
        longitude: 85_455_940,
        altitude: 488_000,
        ..Default::default()
    };
    talk.hear(&MavMessage::SET_GPS_GLOBAL_ORIGIN(origin));
    let home_at = |x, y| {
        let local = MavFrame::MAV_FRAME_LOCAL_NED;
        let data = int(MavCmd::MAV_CMD_DO_SET_HOME, local, x, y);
        MavMessage::COMMAND_INT(COMMAND_INT_DATA { param1: 0.0, ..data })
    };
    let sent = talk.hear(&home_at(70_000, -30_000));
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);

    let mut talk = start(MavlinkParams::default());
    let sent = talk.long(MavCmd::MAV_CMD_GET_HOME_POSITION, [0.0; 7]);
    let home = sent.iter().find_map(|message| match message {
        MavMessage::HOME_POSITION(home) => Some(home.clone()),
        _ => None,
    });
    let home = home.expect("an origin is known, so home has a place on the earth");
    assert_eq!((home.x, home.y, home.altitude), (7.0, -3.0, 488_000));
    assert_eq!(talk.ack(MavCmd::MAV_CMD_NAV_RETURN_TO_LAUNCH, [0.0; 7]), R::MAV_RESULT_ACCEPTED);
    let [CoreRequest::Goto { point, .. }] = talk.asked[..] else { panic!("{:?}", talk.asked) };
    assert_eq!(point, Point::new(-3.0, 7.0));

    // A word of the configuration that is newer than the station's counts.
    let newer =
        MavlinkParams { origin_known: true, origin_latitude_deg: 12.0, ..MavlinkParams::default() };
    let mut talk = start(newer);
    let sent = talk.long(MavCmd::MAV_CMD_GET_HOME_POSITION, [0.0; 7]);
    let north = sent.iter().find_map(|message| match message {
        MavMessage::HOME_POSITION(home) => Some(home.latitude),
        _ => None,
    });
    assert_eq!(north.expect("a home") / 1_000_000, 120);

    // What cannot be kept is in force all the same, and the station is told.
    drawer.0.lock().unwrap().1 = true;
    let sent = talk.hear(&home_at(10_000, 10_000));
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    assert!(texts(&sent).contains("the disk is full"), "{}", texts(&sent));
    assert!(Talk::new().ground.keep_places(None, Some("nonsense")).is_err());
}

#[test]
fn a_goal_without_a_position_means_here() {
    let mut talk = Talk::new();
    let reposition = MavCmd::MAV_CMD_DO_REPOSITION;
    let nan = f32::NAN;
    let hold = [-1.0, 1.0, 0.0, nan, nan, nan, nan];
    assert_eq!(talk.ack(reposition, hold), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Hold]);
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_GLOBAL, i32::MAX, i32::MAX);
    assert_eq!(result(&sent), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Hold, CoreRequest::Hold]);
    assert_eq!(talk.ground.mode(), Mode::Hold);
}

#[test]
fn frames_and_values_that_make_no_sense_are_refused_with_a_reason() {
    let mut talk = Talk::with(MavlinkParams { origin_known: true, ..MavlinkParams::default() });
    let reposition = MavCmd::MAV_CMD_DO_REPOSITION;
    for frame in [MavFrame::MAV_FRAME_BODY_FRD, MavFrame::MAV_FRAME_MISSION] {
        let sent = talk.int(reposition, frame, 1, 1);
        assert_eq!(result(&sent), R::MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME);
        assert!(texts(&sent).contains("refused"));
    }
    let good = [-1.0, 1.0, 0.0, f32::NAN, 0.0, 0.0, 0.0];
    assert_eq!(talk.ack(reposition, good), R::MAV_RESULT_ACCEPTED);
    talk.asked.clear();
    for (number, values) in [
        (1, vec![f32::INFINITY, f32::NEG_INFINITY, 99.0, 0.01]),
        (2, vec![f32::INFINITY, 0.5, -1.0, 77.0]),
        (3, vec![f32::INFINITY]),
        (4, vec![f32::INFINITY]),
        (5, vec![f32::INFINITY, f32::NAN, 95.0, 45.0]),
        (6, vec![f32::INFINITY, f32::NAN, 181.0, 45.0]),
        (7, vec![f32::INFINITY]),
    ] {
        for value in values {
            let mut params = good;
            params[number - 1] = value;
            talk.now = talk.now.offset_by(3.0);
            talk.look();
            let sent = talk.long(reposition, params);
            assert_eq!(result(&sent), R::MAV_RESULT_DENIED, "parameter {number} = {value}");
            assert!(texts(&sent).contains("refused"), "parameter {number} = {value}");
        }
    }
    let sent = talk.int(reposition, MavFrame::MAV_FRAME_LOCAL_NED, 20_000_000, 0);
    assert_eq!(result(&sent), R::MAV_RESULT_DENIED);
    assert!(talk.asked.is_empty(), "{:?}", talk.asked);
}

fn target(north: f32, east: f32, type_mask: Mask) -> MavMessage {
    MavMessage::SET_POSITION_TARGET_LOCAL_NED(SET_POSITION_TARGET_LOCAL_NED_DATA {
        x: north,
        y: east,
        type_mask,
        target_system: 1,
        target_component: 1,
        coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
        ..Default::default()
    })
}

#[test]
fn setpoints_are_followed_in_guided_mode_if_they_are_positions() {
    let position_only = Mask::from_bits_retain(0b1101_1111_1000);
    let mut talk = Talk::new();
    assert!(texts(&talk.hear(&target(5.0, 1.0, position_only))).contains("guided"));
    talk.ack(MavCmd::MAV_CMD_DO_SET_MODE, [1.0, 15.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    talk.asked.clear();
    for (north, east, mask) in [
        (5.0, 1.0, Mask::from_bits_retain(0b1101_1100_0111)),
        (5.0, 1.0, Mask::from_bits_retain(0b0000_0000_0000)),
        (5.0, 1.0, Mask::from_bits_retain(0b1101_1111_1001)),
        (f32::NAN, 1.0, position_only),
        (5.0, f32::INFINITY, position_only),
        (5000.0, 1.0, position_only),
    ] {
        talk.now = talk.now.offset_by(3.0);
        talk.look();
        assert!(texts(&talk.hear(&target(north, east, mask))).contains("refused"));
    }
    assert!(talk.asked.is_empty());
    talk.hear(&target(5.0, 1.0, position_only));
    let goto = CoreRequest::Goto { point: Point::new(1.0, 5.0), through_known: false };
    assert_eq!(talk.asked, [goto]);
    // The same goal again, as streams of setpoints have it, is no news.
    let mut driving = view(talk.now, CoreMode::Drive);
    driving.goal = Some(Point::new(1.0, 5.0));
    talk.ground.handle_core(talk.now, driving);
    talk.hear(&target(5.0, 1.0, position_only));
    assert_eq!(talk.asked.len(), 1);
}
