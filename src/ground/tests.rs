//! The vehicle in conversation with a ground station, without a link.

mod commands;
mod goals;
mod identity;
mod nonsense;
mod stations;
mod telemetry;

use std::sync::Arc;

use proptest::prelude::*;

use super::*;
use crate::frames::Pose;
use crate::scan::Scan;
use crate::wire::mavlink::common::{
    COMMAND_INT_DATA, COMMAND_LONG_DATA, MavAutopilot, MavCmd, MavFrame, MavModeFlag, MavState,
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
pub(super) struct Talk {
    pub(super) ground: Ground,
    now: Instant,
    pub(super) mode: CoreMode,
    /// What the core answers.
    refusal: Option<Refusal>,
    pub(super) asked: Vec<CoreRequest>,
}

impl Talk {
    fn new() -> Self {
        Self::with(MavlinkParams::default())
    }

    fn with(params: MavlinkParams) -> Self {
        Self::serving(params, Vec::new())
    }

    pub(super) fn serving(params: MavlinkParams, services: Vec<Box<dyn Service>>) -> Self {
        let mut ground = Ground::new(params, services);
        let now = at(0.0);
        assert!(ground.handle_channel_open(now, CHANNEL, ChannelInfo::default()));
        let mut talk =
            Self { ground, now, mode: CoreMode::Standby, refusal: None, asked: Vec::new() };
        talk.look();
        talk.drain();
        talk
    }

    pub(super) fn look(&mut self) {
        self.ground.handle_core(self.now, view(self.now, self.mode));
    }

    /// Everything that is sent, with the core's answers to what is asked.
    pub(super) fn drain(&mut self) -> Vec<MavMessage> {
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

    pub(super) fn hear(&mut self, message: &MavMessage) -> Vec<MavMessage> {
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

    pub(super) fn long(&mut self, command: MavCmd, params: [f32; 7]) -> Vec<MavMessage> {
        self.hear(&MavMessage::COMMAND_LONG(long(command, params)))
    }

    pub(super) fn ack(&mut self, command: MavCmd, params: [f32; 7]) -> MavResult {
        result(&self.long(command, params))
    }

    fn int(&mut self, command: MavCmd, frame: MavFrame, x: i32, y: i32) -> Vec<MavMessage> {
        self.hear(&MavMessage::COMMAND_INT(int(command, frame, x, y)))
    }
}

pub(super) fn long(command: MavCmd, params: [f32; 7]) -> COMMAND_LONG_DATA {
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

pub(super) fn int(command: MavCmd, frame: MavFrame, x: i32, y: i32) -> COMMAND_INT_DATA {
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

pub(super) fn result(sent: &[MavMessage]) -> MavResult {
    let mut acks = sent.iter().filter_map(|message| match message {
        MavMessage::COMMAND_ACK(data) => Some(data),
        _ => None,
    });
    let ack = acks.next().expect("an acknowledgement");
    assert!(acks.next().is_none(), "one command, one acknowledgement: {sent:?}");
    assert_eq!((ack.target_system, ack.target_component), (255, 190));
    ack.result
}

pub(super) fn texts(sent: &[MavMessage]) -> String {
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
