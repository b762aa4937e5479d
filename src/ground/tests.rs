//! The vehicle in conversation with a ground station, without a link.

use std::sync::Arc;

use proptest::prelude::*;

use super::*;
use crate::frames::Pose;
use crate::scan::Scan;
use crate::wire::mavlink::common::{
    COMMAND_INT_DATA, COMMAND_LONG_DATA, MavAutopilot, MavFrame, MavModeFlag, MavState,
    PositionTargetTypemask as Mask, SET_POSITION_TARGET_LOCAL_NED_DATA,
};
use crate::wire::mavlink::{MavlinkVersion, RawBody};

const CHANNEL: ChannelId = ChannelId(3);
const STATION: Peer = Peer { channel: CHANNEL, system: 255, component: 190 };

fn at(seconds: f64) -> Instant {
    Instant::from_nanos(10_000_000_000).offset_by(seconds)
}

fn scan() -> Arc<Scan> {
    Arc::new(Scan {
        stamp: at(0.0),
        sequence: 1,
        angle_first_rad: 0.0,
        angle_step_rad: std::f64::consts::TAU / 360.0,
        range_max_m: 10.0,
        ranges_m: vec![3.0; 360],
    })
}

fn view(now: Instant, mode: CoreMode) -> CoreView {
    let point = |x: f64| PlanPoint {
        position: Point::new(x, 2.0),
        heading_rad: 0.0,
        speed_mps: 1.0,
        accel_mps2: 0.0,
        curvature_pm: 0.0,
    };
    CoreView {
        at: now,
        mode,
        pose: Some(Pose::new(1.0, 2.0, 0.0)),
        speed_mps: 1.5,
        yaw_rate_rps: 0.2,
        start: Pose::new(0.0, 0.0, 0.0),
        goal: None,
        faults: Vec::new(),
        not_ready: Vec::new(),
        target: Some(point(1.0)),
        plan: vec![point(2.0), point(3.0)],
        cross_track_m: 0.01,
        scan: Some(scan()),
        battery_v: Some(7.4),
        fresh: Fresh { odometry: true, scan: true, status: true },
        load: 0.123,
        counts: CoreCounts::default(),
        speed_max_mps: 4.0,
    }
}

/// A vehicle with one station, and what came of it.
struct Talk {
    ground: Ground,
    now: Instant,
    mode: CoreMode,
    /// What the core answers.
    refusal: Option<Refusal>,
    asked: Vec<CoreRequest>,
}

impl Talk {
    fn new() -> Self {
        Self::with(MavlinkParams::default())
    }

    fn with(params: MavlinkParams) -> Self {
        let mut ground = Ground::new(params, Vec::new());
        let now = at(0.0);
        assert!(ground.handle_channel_open(now, CHANNEL, ChannelInfo::default()));
        let mut talk =
            Self { ground, now, mode: CoreMode::Standby, refusal: None, asked: Vec::new() };
        talk.look();
        talk.drain();
        talk
    }

    fn look(&mut self) {
        self.ground.handle_core(self.now, view(self.now, self.mode));
    }

    /// Everything that is sent, with the core's answers to what is asked.
    fn drain(&mut self) -> Vec<MavMessage> {
        let mut sent = Vec::new();
        loop {
            if let Some((id, request)) = self.ground.poll_request() {
                self.asked.push(request);
                let answer = self.refusal.clone().map_or(Ok(()), Err);
                self.ground.handle_reply(self.now, id, &answer);
            } else if let Some((_, body)) = self.ground.poll_message() {
                match body {
                    Body::Message(message) => sent.push(*message),
                    Body::Raw(raw) => {
                        let parsed = MavMessage::parse(MavlinkVersion::V2, raw.id, &raw.payload);
                        sent.extend(parsed);
                    }
                }
            } else {
                return sent;
            }
        }
    }

    fn hear(&mut self, message: &MavMessage) -> Vec<MavMessage> {
        self.ground.handle_message(self.now, STATION, message);
        self.drain()
    }

    fn advance(&mut self, seconds: f64) -> Vec<MavMessage> {
        let mut sent = Vec::new();
        let end = self.now.offset_by(seconds);
        while self.now < end {
            self.now = self.now.offset_by(0.05);
            self.look();
            self.ground.handle_time(self.now);
            sent.extend(self.drain());
        }
        sent
    }

    fn long(&mut self, command: MavCmd, params: [f32; 7]) -> Vec<MavMessage> {
        self.hear(&MavMessage::COMMAND_LONG(long(command, params)))
    }

    fn ack(&mut self, command: MavCmd, params: [f32; 7]) -> MavResult {
        result(&self.long(command, params))
    }

    fn int(&mut self, command: MavCmd, frame: MavFrame, x: i32, y: i32) -> Vec<MavMessage> {
        self.hear(&MavMessage::COMMAND_INT(int(command, frame, x, y)))
    }
}

fn long(command: MavCmd, params: [f32; 7]) -> COMMAND_LONG_DATA {
    let [param1, param2, param3, param4, param5, param6, param7] = params;
    COMMAND_LONG_DATA {
        param1,
        param2,
        param3,
        param4,
        param5,
        param6,
        param7,
        command,
        target_system: 1,
        target_component: 1,
        confirmation: 0,
    }
}

fn int(command: MavCmd, frame: MavFrame, x: i32, y: i32) -> COMMAND_INT_DATA {
    COMMAND_INT_DATA {
        param1: -1.0,
        param2: 1.0,
        param3: 0.0,
        param4: f32::NAN,
        x,
        y,
        z: 0.0,
        command,
        target_system: 1,
        target_component: 1,
        frame,
        current: 0,
        autocontinue: 0,
    }
}

fn result(sent: &[MavMessage]) -> MavResult {
    let mut acks = sent.iter().filter_map(|message| match message {
        MavMessage::COMMAND_ACK(data) => Some(data),
        _ => None,
    });
    let ack = acks.next().expect("an acknowledgement");
    assert!(acks.next().is_none(), "one command, one acknowledgement: {sent:?}");
    assert_eq!((ack.target_system, ack.target_component), (255, 190));
    ack.result
}

fn texts(sent: &[MavMessage]) -> String {
    let text = |message: &MavMessage| match message {
        MavMessage::STATUSTEXT(data) => Some(data.text.to_str().unwrap().to_owned()),
        _ => None,
    };
    sent.iter().filter_map(text).collect()
}

fn heartbeats(sent: &[MavMessage]) -> Vec<c::HEARTBEAT_DATA> {
    let heartbeat = |message: &MavMessage| match message {
        MavMessage::HEARTBEAT(data) => Some(data.clone()),
        _ => None,
    };
    sent.iter().filter_map(heartbeat).collect()
}

use MavResult as R;

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

#[test]
fn every_mode_leads_back_to_itself_in_its_own_alphabet() {
    for identity in [Identity::Generic, Identity::Px4] {
        for mode in Mode::all(identity) {
            assert_eq!(Mode::of_custom(mode.custom_mode(identity)), Ok(*mode));
        }
    }
}

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
    assert_eq!(talk.ack(terminate, [0.0; 7]), R::MAV_RESULT_ACCEPTED);
    assert!(talk.asked.is_empty());
    assert_eq!(talk.ack(terminate, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked, [CoreRequest::Terminate]);
    let reboot = MavCmd::MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN;
    assert_eq!(talk.ack(reboot, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_FAILED);
    talk.mode = CoreMode::Terminated;
    let beat = heartbeats(&talk.advance(0.05)).remove(0);
    assert_eq!(beat.system_status, MavState::MAV_STATE_FLIGHT_TERMINATION);
    assert_eq!(talk.ack(terminate, [0.0; 7]), R::MAV_RESULT_DENIED);
    assert_eq!(talk.ack(reboot, [1.0, 0., 0., 0., 0., 0., 0.]), R::MAV_RESULT_ACCEPTED);
    assert_eq!(talk.asked[1..], [CoreRequest::Restart]);
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
    assert_eq!(talk.ack(MavCmd::MAV_CMD_NAV_TAKEOFF, [0.0; 7]), R::MAV_RESULT_UNSUPPORTED);
    let raw = |command: u16, frame: u8, id: u32| {
        let mut payload = vec![0; 35];
        payload[28..30].copy_from_slice(&command.to_le_bytes());
        payload[30..33].copy_from_slice(&[1, 1, frame]);
        RawBody { id, payload }
    };
    talk.ground.handle_raw(talk.now, STATION, &raw(42_424, 0, COMMAND_LONG_DATA::ID));
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

fn station_heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(c::HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}

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
        talk.ground.handle_body(talk.now, STATION, &body);
        let sent = talk.drain();
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
