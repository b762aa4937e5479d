//! The drive along a mission: started, gone on with, stopped, and led to another item.

use super::super::core::CoreRequest;
use super::super::mission_items::Fault;
use super::super::mission_run::{Next, Run, State};
use super::super::modes::Mode;
use super::super::outbox::{Outbox, To};
use super::super::wanted::{Denial, Step, Wanted};
use super::{Asked, Mission, SETTLE};
use crate::time::Instant;
use crate::wire::mavlink::common::{self as c, MavMessage, MavSeverity};

impl Mission {
    /// As `MAV_CMD_MISSION_START` says.
    pub(super) fn start_as(&mut self, now: Instant, wanted: &Wanted) -> Result<Step, Denial> {
        // Zero, or nothing, is what stations say who do not mean any.
        let first = wanted.optional_whole(1, u16::MAX.into())?.unwrap_or(0) as usize;
        let count = self.goals.len();
        if first > 0 && first >= count {
            return Err(Denial::denied(format!("item {first} of {count}")));
        }
        let last = wanted.optional_whole(2, u16::MAX.into())?.unwrap_or(0) as usize;
        if last > 0 && last + 1 < count {
            let end = count - 1;
            return Err(Denial::denied(format!("a mission is driven to its end, item {end}")));
        }
        let requests = self.start(now, (first > 0).then_some(first))?;
        Ok(Step::Ask(requests, Some(Mode::Auto)))
    }

    /// As `MAV_CMD_DO_SET_MISSION_CURRENT` says.
    pub(super) fn choose(
        &mut self,
        now: Instant,
        wanted: &Wanted,
        out: &mut Outbox,
    ) -> Result<Step, Denial> {
        // -1 keeps the present item.
        let keep = wanted.params[0] == -1.0;
        let seq = if keep { self.run.current as u32 } else { wanted.whole(1, u16::MAX.into())? };
        let reset = wanted.params[1] == 1.0;
        if reset && (seq as usize) < self.goals.len() {
            self.run.forget_jumps();
        }
        self.set_current(now, seq, out).map_err(Denial::denied)?;
        Ok(Step::Done)
    }

    /// Stops on the way, with a word about it.
    pub(super) fn hold(&mut self, now: Instant, why: &str, out: &mut Outbox) {
        let text = format!("Mission stopped: {why}");
        self.say(now, MavSeverity::MAV_SEVERITY_WARNING, &text, out);
        if self.run.is_going() {
            self.run.state = State::Paused;
        }
        self.rest(out);
    }

    fn rest(&mut self, out: &mut Outbox) {
        if let Some(id) = out.request(CoreRequest::Hold) {
            self.remember(id, Asked::Hold);
        }
        self.wish = Some(Mode::Hold);
    }

    /// What is to be asked of the core to start or go on.
    fn start(&mut self, now: Instant, first: Option<usize>) -> Result<Vec<CoreRequest>, Denial> {
        if self.goals.is_empty() {
            return Err(Denial::failed("there is no mission"));
        }
        let from = match first {
            Some(first) => {
                self.run.forget_jumps();
                first
            }
            None if self.run.state == State::Complete => {
                self.run.forget_jumps();
                0
            }
            None => self.run.current,
        };
        let before = self.run.clone();
        let failed =
            |(at, fault): (usize, Fault)| Denial::failed(format!("item {at}: {}", fault.reason));
        match self.run.seek(&self.goals, from, self.origin.as_ref()) {
            Ok(Next::Ask(requests)) => {
                self.starting = Some(now);
                Ok(requests)
            }
            Ok(Next::End) => {
                self.run = before;
                Err(Denial::failed("the mission has no goal from there on"))
            }
            Err(fault) => {
                self.run = before;
                Err(failed(fault))
            }
        }
    }

    /// Goes on with an item while driving.
    fn go_on(&mut self, now: Instant, from: usize, out: &mut Outbox) {
        match self.run.seek(&self.goals, from, self.origin.as_ref()) {
            Ok(Next::Ask(requests)) => {
                for request in requests {
                    match out.request(request) {
                        Some(id) => self.remember(id, Asked::Goal),
                        None => return self.hold(now, "the autopilot takes no goal", out),
                    }
                }
            }
            Ok(Next::End) => {
                self.say(now, MavSeverity::MAV_SEVERITY_INFO, "Mission complete", out);
                self.rest(out);
            }
            Err((at, fault)) => {
                self.hold(now, &format!("item {at}: {}", fault.reason), out);
            }
        }
        self.show(now, out);
    }

    pub(super) fn reached(&mut self, now: Instant, out: &mut Outbox) {
        let seq = self.run.current as u16;
        out.send(
            To::Everyone,
            MavMessage::MISSION_ITEM_REACHED(c::MISSION_ITEM_REACHED_DATA { seq }),
        );
        let Some(item) = self.goals.get(self.run.current).copied() else { return };
        if !item.goes_on {
            // The next start goes on with the one behind it.
            let next = self.run.current + 1;
            if next < self.goals.len() {
                self.run.current = next;
                return self.hold(now, &format!("item {seq} says so"), out);
            }
        }
        self.run.state = State::Waiting(now + Run::wait(&item));
        self.go_on_after_wait(now, out);
    }

    pub(super) fn go_on_after_wait(&mut self, now: Instant, out: &mut Outbox) {
        if let State::Waiting(until) = self.run.state
            && now >= until
        {
            self.go_on(now, self.run.current + 1, out);
        }
    }

    /// Another item is to be the present one.
    pub(super) fn set_current(
        &mut self,
        now: Instant,
        seq: u32,
        out: &mut Outbox,
    ) -> Result<(), String> {
        let at = seq as usize;
        if at >= self.goals.len() {
            return Err(format!("item {seq} of a mission of {}", self.goals.len()));
        }
        let going = self.run.is_going();
        self.run.current = at;
        if going {
            self.go_on(now, at, out);
        } else if self.run.state == State::Complete {
            self.run.state = State::Paused;
        }
        self.next_word = now;
        self.show(now, out);
        Ok(())
    }

    /// The mode that was chosen is another one.
    pub(super) fn follow_mode(&mut self, now: Instant, mode: Mode) {
        self.mode = Some(mode);
        if mode == Mode::Auto {
            self.starting = None;
            match self.run.state {
                State::Asked => self.run.state = State::Driving,
                // Continued after a pause, with the same goal.
                State::Paused if self.run.goal().is_some() => self.run.state = State::Driving,
                _ => {}
            }
        } else if self.starting.is_none_or(|since| now.since(since) >= SETTLE) {
            self.starting = None;
            if self.run.is_going() {
                self.run.state = State::Paused;
            }
        }
    }
}
