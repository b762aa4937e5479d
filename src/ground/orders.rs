//! A command on its way: seen whether it makes sense and is not the same again, handed to whomever
//! it concerns, answered.

use super::commander::Scope;
use super::modes::Mode;
use super::outbox::Peer;
use super::said_places::SaidPlaces;
use super::wanted::{Denial, Step, Wanted};
use super::{Ground, Home, fields, fresh, telemetry};
use crate::frames::Point;
use crate::time::Instant;
use crate::wire::mavlink::MessageData;
use crate::wire::mavlink::common::{self as c, MavCmd};

impl Ground {
    pub(super) fn command(&mut self, now: Instant, from: Peer, wanted: Wanted) {
        // A message that is asked for again was not heard, whatever became of the answer.
        let asks = self.asked_message(&wanted).is_some();
        if !asks && self.commander.is_repetition(now, from, &wanted, &mut self.out) {
            return;
        }
        let step = self.step(now, from, &wanted);
        let places = step.is_ok()
            && matches!(
                wanted.command,
                MavCmd::MAV_CMD_DO_SET_HOME | MavCmd::MAV_CMD_DO_SET_GLOBAL_ORIGIN
            );
        if places {
            let said = match wanted.command {
                MavCmd::MAV_CMD_DO_SET_HOME => SaidPlaces { home: self.home, ..self.said },
                _ => SaidPlaces { origin: self.origin, ..self.said },
            };
            self.keep_said(said);
        }
        // The order matters to ground stations: first the acknowledgement, then the message.
        let asked = step.is_ok().then(|| self.asked_message(&wanted)).flatten();
        self.commander.proceed(now, Some(from), wanted, step, &mut self.out);
        if let Some((id, which)) = asked {
            self.send_message(now, from, id, which);
        }
        if places {
            self.show_places(now);
        }
        self.show_changes(now);
    }

    fn step(&mut self, now: Instant, from: Peer, wanted: &Wanted) -> Result<Step, Denial> {
        fields::check(wanted)?;
        match wanted.command {
            MavCmd::MAV_CMD_REQUEST_MESSAGE => {
                let id = wanted.whole(1, 0xFF_FFFF)?;
                let ours = telemetry::knows(id)
                    || self.services.iter().any(|service| service.message(id).is_some());
                if id == c::AVAILABLE_MODES_DATA::ID && !wanted.params[1].is_nan() {
                    let count = Mode::all(self.params.identity).len() as u32;
                    wanted.whole(2, count)?;
                }
                return if ours { self.tellable(now, wanted) } else { Err(Denial::unsupported()) };
            }
            MavCmd::MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
            | MavCmd::MAV_CMD_REQUEST_PROTOCOL_VERSION
            | MavCmd::MAV_CMD_GET_HOME_POSITION => return self.tellable(now, wanted),
            MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL => {
                return self.set_interval(now, from, wanted);
            }
            MavCmd::MAV_CMD_GET_MESSAGE_INTERVAL => {
                wanted.whole(1, u32::from(u16::MAX))?;
                return Ok(Step::Done);
            }
            _ => {}
        }
        let auto = match wanted.command {
            MavCmd::MAV_CMD_DO_SET_MODE => {
                let (main, sub) = (wanted.params[1], wanted.params[2]);
                let custom = wanted.params[0] as u32 & 1 == 1;
                let sub = if sub.is_nan() { 0.0 } else { sub };
                custom && Mode::of_command(main as u32, sub as u32) == Ok(Mode::Auto)
            }
            MavCmd::MAV_CMD_DO_SET_STANDARD_MODE => {
                Mode::of_standard(wanted.params[0] as u32) == Some(Mode::Auto)
            }
            _ => false,
        };
        let told = if auto { Wanted::mission_start() } else { *wanted };
        for service in &mut self.services {
            if let Some(step) = service.handle_command(now, &told, &mut self.out) {
                return step;
            }
        }
        let home = self.home.get_or_insert(Home { position: Point::origin(), heading_rad: None });
        let mut scope = Scope {
            params: &self.params,
            view: fresh(&self.view, now),
            origin: &mut self.origin,
            home,
        };
        self.commander.obey(wanted, &mut scope, &mut self.out)
    }

    pub(super) fn set_mode(&mut self, now: Instant, data: &c::SET_MODE_DATA) {
        let home = self.home.get_or_insert(Home { position: Point::origin(), heading_rad: None });
        let scope = Scope {
            params: &self.params,
            view: fresh(&self.view, now),
            origin: &mut self.origin,
            home,
        };
        let mission = self.commander.set_mode_message(now, data, &scope, &mut self.out);
        if let Some(wanted) = mission {
            let mut services = self.services.iter_mut();
            let step = services
                .find_map(|service| service.handle_command(now, &wanted, &mut self.out))
                .unwrap_or_else(|| Err(Denial::failed("there is no mission")));
            self.commander.proceed(now, None, wanted, step, &mut self.out);
        }
        self.show_changes(now);
    }
}
