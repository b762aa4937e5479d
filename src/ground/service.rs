//! What every service beside the vehicle itself looks like: parameters, missions, files.

use std::sync::Arc;

use super::core::{CoreEvent, CoreView, Refusal};
use super::modes::Mode;
use super::outbox::{Outbox, Peer, RequestId};
use super::wanted::{Denial, Step, Wanted};
use crate::params::Params;
use crate::time::Instant;
use crate::wire::mavlink::common::{MavMessage, MavProtocolCapability};
use crate::wire::mavlink::{Origin, RawBody};

/// A service. It is handed everything that concerns this vehicle and picks what is its own.
pub trait Service: Send {
    /// A message to this vehicle, or to all.
    fn handle(&mut self, now: Instant, from: Peer, message: &MavMessage, out: &mut Outbox);

    /// A message to this vehicle, or to all, with a value in it that the dialect does not name.
    fn handle_raw(&mut self, _now: Instant, _from: Peer, _raw: &RawBody, _out: &mut Outbox) {}

    /// A command; `None` if it is not this service's. Choosing the mode "auto" comes as
    /// `MAV_CMD_MISSION_START`.
    fn handle_command(
        &mut self,
        _now: Instant,
        _wanted: &Wanted,
        _out: &mut Outbox,
    ) -> Option<Result<Step, Denial>> {
        None
    }

    /// The core as it is now, with the mode that was chosen.
    fn handle_core(&mut self, _now: Instant, _view: &CoreView, _mode: Mode, _out: &mut Outbox) {}

    /// The parameters in force; also when nothing has changed.
    fn handle_params(&mut self, _params: &Arc<Params>) {}

    /// Where on the earth the map lies, when that has been said.
    fn handle_origin(&mut self, _now: Instant, _origin: &Origin, _out: &mut Outbox) {}

    /// Something happened in the core.
    fn handle_event(&mut self, _now: Instant, _event: &CoreEvent, _mode: Mode, _out: &mut Outbox) {}

    /// The answer to a wish; says whether it was this service's.
    fn handle_reply(
        &mut self,
        _now: Instant,
        _id: RequestId,
        _result: &Result<(), Refusal>,
        _out: &mut Outbox,
    ) -> bool {
        false
    }

    /// Time has passed.
    fn handle_time(&mut self, _now: Instant, _out: &mut Outbox) {}

    /// When [`handle_time`](Self::handle_time) is due next.
    fn poll_at(&self) -> Option<Instant> {
        None
    }

    /// A mode that the service wishes for by itself (a mission that has ended holds).
    fn poll_mode(&mut self) -> Option<Mode> {
        None
    }

    /// What `AUTOPILOT_VERSION` says thanks to it.
    fn capabilities(&self) -> MavProtocolCapability {
        MavProtocolCapability::empty()
    }

    /// The message that was asked for by its number, if it is this service's.
    fn message(&self, _id: u32) -> Option<MavMessage> {
        None
    }
}

/// Keeps texts over a restart, each under a name.
pub trait Keeper: Send {
    /// Keeps a text instead of what was kept under that name, all of it or nothing.
    ///
    /// # Errors
    /// Why it cannot be kept, for a person.
    fn keep(&mut self, name: &str, text: &str) -> Result<(), String>;
}
