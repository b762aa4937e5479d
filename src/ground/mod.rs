//! The vehicle as ground stations see it: MAVLink without a socket, a clock or a file.
//!
//! The caller hands in what arrives ([`Ground::handle_message`]), the newest view of the core
//! ([`Ground::handle_core`]), what happens in it ([`Ground::handle_event`]), its answers
//! ([`Ground::handle_reply`]) and the passing of time ([`Ground::handle_time`], due at
//! [`Ground::poll_at`]); it fetches messages to send and wishes for the core. Parameters, missions
//! and files are [services](Service) of their own that are added to it.
//!
//! Everything that a person on the other side may send is refused in words rather than ignored, and
//! nothing here is trusted by the core: whatever is asked for, the core and its guard decide.

#![allow(deprecated, reason = "ground stations still speak the old words")]

mod asked;
mod channels;
mod commander;
mod core;
mod fields;
mod ftp;
mod ftp_sessions;
#[cfg(test)]
mod lossy;
mod metadata;
mod mission;
mod mission_items;
mod mission_run;
mod mission_upload;
mod modes;
mod obstacles;
mod orders;
mod outbox;
mod parameters;
mod places;
mod said_places;
mod service;
mod settings;
mod stations;
mod streams;
mod telemetry;
mod wanted;

pub use self::core::{
    CoreCounts, CoreEvent, CoreFault, CoreMode, CoreRequest, CoreView, FaultAction, Fresh,
    PlanPoint, Refusal, RefusalKind, StorageAction,
};
pub use channels::{CHANNELS_MAX, ChannelInfo};
pub use ftp::{Ftp, Shelf, ShelfEntry, ShelfFault, Volume};
pub use metadata::{METADATA_PATH, Metadata};
pub use mission::Mission;
pub use modes::{Mode, ModeFault};
pub use outbox::{ChannelId, Outbox, Peer, RequestId, To};
pub use parameters::{KEPT as KEPT_PARAMETERS, Parameters};
pub use said_places::SAID_PLACES;
pub use service::{Keeper, Service};
pub use settings::{Identity, KeySetup, MavlinkParams, StationLost, Unsigned};
pub use streams::{Interval, IntervalFault};
pub use wanted::{Denial, Step, Wanted};

use std::sync::Arc;

use channels::Channels;
use commander::Commander;
use said_places::{SaidPlaces, configured_origin};
use telemetry::Facts;

use crate::frames::Point;
use crate::params::Params;
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::{
    self as c, MavMessage, MavProtocolCapability, MavResult, MavSeverity, MavType,
};
use crate::wire::mavlink::{Body, Message, MessageData, Origin, RawBody};

/// The component that an autopilot is.
pub const COMPONENT: u8 = 1;
/// A view older than this means that the core is not alive.
const VIEW_LIFE: Duration = Duration::from_millis(500);
/// Between two heartbeats without a change.
const HEARTBEAT_PERIOD: Duration = Duration::from_secs(1);
/// How often time is looked at while there is anybody to talk to.
const TICK: Duration = Duration::from_millis(20);

/// Where the car returns to, map frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Home {
    /// The place.
    pub position: Point,
    /// The direction it stood in, if that is known.
    pub heading_rad: Option<f64>,
}

/// The vehicle's side of MAVLink.
pub struct Ground {
    params: MavlinkParams,
    channels: Channels,
    out: Outbox,
    commander: Commander,
    services: Vec<Box<dyn Service>>,
    view: Option<(Instant, CoreView)>,
    origin: Option<Origin>,
    home: Option<Home>,
    /// What of the two stations have said, and who keeps it.
    said: SaidPlaces,
    place_keeper: Option<Box<dyn Keeper>>,
    unix_us: Option<(Instant, u64)>,
    next_heartbeat: Instant,
    next_time: Instant,
    shown: Option<(c::HEARTBEAT_DATA, c::CURRENT_MODE_DATA)>,
    /// When a ground station was heard last, whichever: only the loss of all of them counts.
    station_heard: Option<Instant>,
    station_lost: bool,
    lost_request: Option<RequestId>,
}

impl Ground {
    /// A vehicle that nobody talks to yet.
    pub fn new(params: MavlinkParams, services: Vec<Box<dyn Service>>) -> Self {
        let origin = configured_origin(&params);
        Self {
            params,
            channels: Channels::default(),
            out: Outbox::default(),
            commander: Commander::default(),
            services,
            view: None,
            origin,
            home: None,
            said: SaidPlaces::default(),
            place_keeper: None,
            unix_us: None,
            next_heartbeat: Instant::ZERO,
            next_time: Instant::ZERO,
            shown: None,
            station_heard: None,
            station_lost: false,
            lost_request: None,
        }
    }

    /// Number of this system.
    pub const fn system(&self) -> u8 {
        // The parameter's range ends at 250.
        self.params.system_id as u8
    }

    /// The mode that was chosen.
    pub const fn mode(&self) -> Mode {
        self.commander.mode()
    }

    /// Takes the parameters that may change under way.
    pub fn set_params(&mut self, params: &MavlinkParams) {
        self.params.forced_arming = params.forced_arming;
        self.params.station_lost = params.station_lost;
        self.params.station_timeout_s = params.station_timeout_s;
        self.params.battery_empty_v = params.battery_empty_v;
        self.params.battery_full_v = params.battery_full_v;
    }

    /// All parameters in force, for the services.
    pub fn handle_params(&mut self, params: &Arc<Params>) {
        for service in &mut self.services {
            service.handle_params(params);
        }
    }

    // ---- inputs

    /// A remote end appeared; says whether there is room for it.
    pub fn handle_channel_open(&mut self, now: Instant, id: ChannelId, info: ChannelInfo) -> bool {
        // Whoever comes sees the vehicle at once.
        self.next_heartbeat = now;
        self.out.note_rate(id, info.bytes_per_s);
        self.next_time = now;
        self.channels.open(now, id, info)
    }

    /// A remote end is gone.
    pub fn handle_channel_closed(&mut self, id: ChannelId) {
        self.channels.close(id);
        self.out.note_rate(id, None);
    }

    /// The time of day, microseconds since 1970.
    pub fn handle_clock(&mut self, now: Instant, unix_us: u64) {
        self.unix_us = Some((now, unix_us));
    }

    /// A message arrived, as it is on the wire.
    pub fn handle_body(&mut self, now: Instant, from: Peer, body: &Body) {
        match body {
            Body::Message(message) => self.handle_message(now, from, message),
            Body::Raw(raw) => self.handle_raw(now, from, raw),
        }
    }

    /// A message arrived.
    pub fn handle_message(&mut self, now: Instant, from: Peer, message: &MavMessage) {
        if !self.is_from_outside(now, from) {
            return;
        }
        let target = (message.target_system_id(), message.target_component_id());
        if !self.is_for_us(target.0.unwrap_or(0), target.1.unwrap_or(0)) {
            return;
        }
        match message {
            MavMessage::HEARTBEAT(data) if data.mavtype == MavType::MAV_TYPE_GCS => {
                self.station_heard = Some(now);
            }
            MavMessage::COMMAND_LONG(data) => self.command(now, from, Wanted::of_long(data)),
            MavMessage::COMMAND_INT(data) => self.command(now, from, Wanted::of_int(data)),
            MavMessage::SET_MODE(data) => self.set_mode(now, data),
            MavMessage::SET_POSITION_TARGET_LOCAL_NED(data) => {
                let target = places::of_local_target(data);
                let view = fresh(&self.view, now);
                self.commander.follow(now, target, view, &mut self.out);
            }
            MavMessage::SET_POSITION_TARGET_GLOBAL_INT(data) => {
                let target = places::of_global_target(data, self.origin.as_ref());
                let view = fresh(&self.view, now);
                self.commander.follow(now, target, view, &mut self.out);
            }
            MavMessage::SET_GPS_GLOBAL_ORIGIN(data) => self.set_origin(now, data),
            MavMessage::TIMESYNC(data) => self.answer_timesync(now, from, data),
            MavMessage::PING(data) => self.answer_ping(from, data),
            MavMessage::SETUP_SIGNING(data) => self.setup_signing(from, data),
            _ => {
                for service in &mut self.services {
                    service.handle(now, from, message, &mut self.out);
                }
            }
        }
    }

    /// A message with a value in it that the dialect does not name.
    pub fn handle_raw(&mut self, now: Instant, from: Peer, raw: &RawBody) {
        if !self.is_from_outside(now, from) {
            return;
        }
        // Command, target system and target component have the same places in both forms.
        if raw.id == c::COMMAND_LONG_DATA::ID || raw.id == c::COMMAND_INT_DATA::ID {
            let [system, component] = raw.bytes(30);
            if !self.is_for_us(system, component) {
                return;
            }
            let command = u16::from_le_bytes(raw.bytes(28));
            // A command that is known came with a frame that is not.
            let known = MavMessage::parse(
                crate::wire::mavlink::MavlinkVersion::V2,
                c::COMMAND_LONG_DATA::ID,
                &raw.payload[..raw.payload.len().min(30)],
            );
            let result = if known.is_ok() {
                MavResult::MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME
            } else {
                MavResult::MAV_RESULT_UNSUPPORTED
            };
            self.commander.refuse_raw(now, from, command, result, &mut self.out);
            return;
        }
        for service in &mut self.services {
            service.handle_raw(now, from, raw, &mut self.out);
        }
    }

    /// The core as it is now.
    pub fn handle_core(&mut self, now: Instant, view: CoreView) {
        let start = view.start;
        self.home
            .get_or_insert(Home { position: start.position, heading_rad: Some(start.heading_rad) });
        if self.view.is_none() {
            self.tell_origin(now);
        }
        let mode = self.commander.mode();
        for service in &mut self.services {
            service.handle_core(now, &view, mode, &mut self.out);
        }
        self.view = Some((now, view));
        self.take_modes();
        self.show_changes(now);
    }

    /// Something happened in the core.
    pub fn handle_event(&mut self, now: Instant, event: &CoreEvent) {
        match event {
            CoreEvent::FaultRaised(fault) => {
                let (severity, done) = match fault.action {
                    FaultAction::Brakes => (MavSeverity::MAV_SEVERITY_CRITICAL, "braking"),
                    FaultAction::FinishesPlan => (MavSeverity::MAV_SEVERITY_ERROR, "stopping"),
                    FaultAction::Reports => (MavSeverity::MAV_SEVERITY_NOTICE, ""),
                };
                let comma = if done.is_empty() { "" } else { ", " };
                self.out.say(severity, &format!("Failsafe: {}{comma}{done}", fault.name));
            }
            CoreEvent::FaultCleared(fault) => {
                let text = format!("Failsafe over: {}", fault.name);
                self.out.say(MavSeverity::MAV_SEVERITY_INFO, &text);
            }
            CoreEvent::GoalReached { .. } => {
                self.out.say(MavSeverity::MAV_SEVERITY_INFO, "Goal reached");
            }
            CoreEvent::ModeChanged { to } => {
                // The next view is a while away, and until then a mode would be shown that is over.
                if let Some((_, view)) = &mut self.view {
                    view.mode = *to;
                }
                if *to == CoreMode::Terminated {
                    let text = "Terminated: the car stands until the next start";
                    self.out.say(MavSeverity::MAV_SEVERITY_CRITICAL, text);
                }
            }
        }
        let mode = self.commander.mode();
        for service in &mut self.services {
            service.handle_event(now, event, mode, &mut self.out);
        }
        self.take_modes();
    }

    /// The core's answer to a wish.
    pub fn handle_reply(&mut self, now: Instant, id: RequestId, result: &Result<(), Refusal>) {
        if self.lost_request == Some(id) {
            self.lost_request = None;
            if let Err(refusal) = result {
                self.out.say(MavSeverity::MAV_SEVERITY_WARNING, &refusal.reason);
            }
            return;
        }
        if !self.commander.handle_reply(now, id, result, &mut self.out) {
            let mut services = self.services.iter_mut();
            services.any(|service| service.handle_reply(now, id, result, &mut self.out));
        }
        self.take_modes();
        self.show_changes(now);
    }

    /// Time has passed; does what is due.
    pub fn handle_time(&mut self, now: Instant) {
        self.next_time = now + if self.channels.count() > 0 { TICK } else { HEARTBEAT_PERIOD };
        self.commander.handle_time(now, &mut self.out);
        for service in &mut self.services {
            service.handle_time(now, &mut self.out);
        }
        self.take_modes();
        self.watch_stations(now);
        self.show_changes(now);
        let Some(view) = fresh(&self.view, now) else { return };
        let mut due = Vec::new();
        for (id, channel) in self.channels.iter_mut() {
            channel.streams.take_due(now, |number| due.push((id, number)));
        }
        let facts = self.facts(view, now);
        let told = |(id, number)| {
            let messages = telemetry::messages(number, 0, &facts);
            messages.into_iter().map(move |message| (id, message))
        };
        let sent: Vec<_> = due.into_iter().flat_map(told).collect();
        for (id, message) in sent {
            self.out.send(To::Channel(id), message);
        }
    }

    // ---- outputs

    /// When [`handle_time`](Self::handle_time) is due next.
    pub fn poll_at(&self) -> Instant {
        let services = self.services.iter().filter_map(|service| service.poll_at());
        let own = services.chain(self.commander.poll_at()).min();
        own.map_or(self.next_time, |at| at.min(self.next_time))
    }

    /// The next message to send.
    pub fn poll_message(&mut self) -> Option<(To, Body)> {
        self.out.poll_message()
    }

    /// The next wish for the core or the shell.
    pub fn poll_request(&mut self) -> Option<(RequestId, CoreRequest)> {
        self.out.poll_request()
    }

    /// Everybody who has been heard lately.
    pub fn peers(&self, now: Instant) -> Vec<Peer> {
        self.channels.peers(now).collect()
    }

    // ---- inside

    fn is_from_outside(&mut self, now: Instant, from: Peer) -> bool {
        let ourselves = (self.system(), COMPONENT);
        (from.system, from.component) != ourselves
            && from.system != 0
            && self.channels.heard(now, from)
    }

    /// What messages are made from.
    fn facts<'a>(&'a self, view: &'a CoreView, now: Instant) -> Facts<'a> {
        let start = Home { position: view.start.position, heading_rad: None };
        let services = self.services.iter();
        Facts {
            params: &self.params,
            view,
            mode: self.commander.mode(),
            origin: self.origin,
            home: self.home.unwrap_or(start),
            capabilities: services
                .fold(MavProtocolCapability::empty(), |all, one| all | one.capabilities()),
            unix_us: self.unix_us.map_or(0, |(at, us)| us + now.since(at).as_micros() as u64),
            dropped: self.out.dropped(),
        }
    }

    fn is_for_us(&self, system: u8, component: u8) -> bool {
        (system == 0 || system == self.system()) && (component == 0 || component == COMPONENT)
    }

    fn answer_timesync(&mut self, now: Instant, from: Peer, data: &c::TIMESYNC_DATA) {
        if data.tc1 != 0 {
            return;
        }
        let answer = c::TIMESYNC_DATA {
            tc1: now.as_nanos() as i64,
            ts1: data.ts1,
            target_system: from.system,
            target_component: from.component,
        };
        self.out.send(from, MavMessage::TIMESYNC(answer));
    }

    fn answer_ping(&mut self, from: Peer, data: &c::PING_DATA) {
        // Only questions have no target.
        if data.target_system == 0 && data.target_component == 0 {
            let answer = c::PING_DATA {
                time_usec: data.time_usec,
                seq: data.seq,
                target_system: from.system,
                target_component: from.component,
            };
            self.out.send(from, MavMessage::PING(answer));
        }
    }

    fn setup_signing(&mut self, from: Peer, data: &c::SETUP_SIGNING_DATA) {
        let trusted = self.channels.get(from.channel).is_some_and(|channel| channel.info.trusted);
        if self.params.key_setup != KeySetup::Trusted || !trusted {
            let text = "SETUP_SIGNING refused: not allowed on this link (mavlink.key_setup)";
            self.out.say(MavSeverity::MAV_SEVERITY_WARNING, text);
            return;
        }
        // The message's own word for "no signatures any more"; as a key it would be everybody's.
        if data.secret_key == [0; 32] {
            let text = "SETUP_SIGNING refused: signatures end only with the configuration";
            self.out.say(MavSeverity::MAV_SEVERITY_WARNING, text);
            return;
        }
        // Its answer is of no interest to the station: the message has none.
        self.lost_request = self.out.request(CoreRequest::SigningKey(data.secret_key));
    }

    /// Services may choose a mode.
    fn take_modes(&mut self) {
        for service in &mut self.services {
            if let Some(mode) = service.poll_mode() {
                self.commander.set_mode(mode);
            }
        }
    }

    /// Sends heartbeat and mode when they are due or have changed, while the core is alive.
    fn show_changes(&mut self, now: Instant) {
        let Some(view) = fresh(&self.view, now) else { return };
        let facts = self.facts(view, now);
        let heartbeat = telemetry::heartbeat(&facts);
        let [MavMessage::CURRENT_MODE(mode)] =
            &telemetry::messages(c::CURRENT_MODE_DATA::ID, 0, &facts)[..]
        else {
            unreachable!("there is always a mode")
        };
        let mode = mode.clone();
        let (same_heartbeat, same_mode) = match &self.shown {
            Some((shown, shown_mode)) => (*shown == heartbeat, *shown_mode == mode),
            None => (false, false),
        };
        if !same_heartbeat || now >= self.next_heartbeat {
            self.next_heartbeat = now + HEARTBEAT_PERIOD;
            self.out.send(To::Everyone, MavMessage::HEARTBEAT(heartbeat.clone()));
        }
        if !same_mode {
            self.out.send(To::Everyone, MavMessage::CURRENT_MODE(mode.clone()));
        }
        self.shown = Some((heartbeat, mode));
    }
}

/// The view, if it is not too old.
fn fresh(view: &Option<(Instant, CoreView)>, now: Instant) -> Option<&CoreView> {
    view.as_ref().filter(|(at, _)| now.since(*at) < VIEW_LIFE).map(|(_, view)| view)
}

#[cfg(test)]
mod tests;
