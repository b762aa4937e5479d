//! Messages that are asked for by a command, once or in intervals.

use super::outbox::Peer;
use super::streams::{Interval, IntervalFault};
use super::wanted::{Denial, Step, Wanted};
use super::{Ground, telemetry};
use crate::time::Instant;
use crate::wire::mavlink::MessageData;
use crate::wire::mavlink::common::{self as c, MavCmd, MavMessage};

impl Ground {
    /// The message that a command asks for, and which of several.
    pub(super) fn asked_message(&self, wanted: &Wanted) -> Option<(u32, u32)> {
        match wanted.command {
            MavCmd::MAV_CMD_REQUEST_MESSAGE => {
                Some((wanted.params[0] as u32, wanted.params[1] as u32))
            }
            MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES => {
                Some((c::AUTOPILOT_VERSION_DATA::ID, 0))
            }
            MavCmd::MAV_CMD_REQUEST_PROTOCOL_VERSION => Some((c::PROTOCOL_VERSION_DATA::ID, 0)),
            MavCmd::MAV_CMD_GET_HOME_POSITION => Some((c::HOME_POSITION_DATA::ID, 0)),
            MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL => {
                Some((c::MESSAGE_INTERVAL_DATA::ID, wanted.params[0] as u32))
            }
            _ => None,
        }
    }

    /// Whether there is anything to say in the message that is asked for: an acceptance without it
    /// would leave the station waiting. Stations ask for many things, so nobody is told in words.
    pub(super) fn tellable(&self, now: Instant, wanted: &Wanted) -> Result<Step, Denial> {
        let Some((id, which)) = self.asked_message(wanted) else { return Ok(Step::Done) };
        if self.services.iter().any(|service| service.message(id).is_some()) {
            return Ok(Step::Done);
        }
        let Some((_, view)) = &self.view else { return Err(Denial::later("")) };
        if !telemetry::messages(id, which, &self.facts(view, now)).is_empty() {
            return Ok(Step::Done);
        }
        let places = [
            c::GPS_GLOBAL_ORIGIN_DATA::ID,
            c::HOME_POSITION_DATA::ID,
            c::GLOBAL_POSITION_INT_DATA::ID,
        ];
        let unplaced = self.origin.is_none() && places.contains(&id);
        Err(if unplaced { Denial::failed("") } else { Denial::later("") })
    }

    pub(super) fn send_message(&mut self, now: Instant, to: Peer, id: u32, which: u32) {
        if id == c::MESSAGE_INTERVAL_DATA::ID {
            let channel = self.channels.get(to.channel);
            let period_s = channel.and_then(|channel| channel.streams.period_s(which));
            let interval_us = match period_s {
                None => 0,
                Some(0.0) => -1,
                Some(period_s) => (period_s * 1e6).round() as i32,
            };
            let data = c::MESSAGE_INTERVAL_DATA { interval_us, message_id: which as u16 };
            self.out.send(to, MavMessage::MESSAGE_INTERVAL(data));
            return;
        }
        if let Some(message) = self.services.iter().find_map(|service| service.message(id)) {
            self.out.send(to, message);
            return;
        }
        // What has never been seen cannot be told; of a core that fell silent the last is told.
        let Some((_, view)) = &self.view else { return };
        for message in telemetry::messages(id, which, &self.facts(view, now)) {
            self.out.send(to, message);
        }
    }

    pub(super) fn set_interval(
        &mut self,
        now: Instant,
        from: Peer,
        wanted: &Wanted,
    ) -> Result<Step, Denial> {
        let id = wanted.whole(1, 0xFF_FFFF)?;
        let interval = match wanted.finite(2)? {
            0.0 => Interval::Default,
            -1.0 => Interval::Never,
            micros => Interval::Seconds(micros * 1e-6),
        };
        let Some(channel) = self.channels.get_mut(from.channel) else {
            return Err(Denial::failed("the link is gone"));
        };
        match channel.streams.set(now, id, interval) {
            Ok(()) => Ok(Step::Done),
            Err(IntervalFault::NoStream) => Err(Denial::unsupported()),
            Err(fault @ IntervalFault::Range) => Err(Denial::denied(fault.to_string())),
        }
    }
}
