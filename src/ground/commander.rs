//! Commands: asked of the core, acknowledged, remembered for repetitions. What they mean is in
//! [`meaning`].

mod meaning;

use std::collections::VecDeque;

use super::core::Refusal;
use super::modes::Mode;
use super::outbox::{Outbox, Peer, RequestId};
use super::wanted::{Denial, Step, Wanted};
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::{self as c, MavCmd, MavMessage, MavResult, MavSeverity};
use crate::wire::mavlink::{MessageData, RawBody};
pub use meaning::Scope;

/// Answers that are remembered for repetitions.
const ANSWERS_MAX: usize = 32;
/// Commands that wait for the core.
const PENDING_MAX: usize = 64;
/// A repetition later than this is a command of its own.
const REPEAT: Duration = Duration::from_secs(3);
/// The core answers within a control period; this long means that it will not.
const SILENCE: Duration = Duration::from_secs(1);
/// The same words are not said again sooner than this.
const ECHO: Duration = Duration::from_secs(2);
/// Texts about refusals within one second.
const TEXTS_PER_S: u32 = 10;
/// Why a command is not obeyed that is none of this car's.
const NO_SUCH_COMMAND: &str = "there is no such command here";

#[derive(Debug)]
struct Pending {
    ids: Vec<RequestId>,
    since: Instant,
    peer: Option<Peer>,
    wanted: Wanted,
    mode: Option<Mode>,
}

/// Takes commands and acknowledges them.
#[derive(Debug)]
pub struct Commander {
    mode: Mode,
    /// What was interrupted by a pause.
    paused: Option<Mode>,
    pending: VecDeque<Pending>,
    answers: VecDeque<(Instant, Peer, Wanted, MavResult)>,
    last_text: Option<(Instant, String)>,
    texts: (Instant, u32),
}

impl Default for Commander {
    fn default() -> Self {
        Self {
            mode: Mode::Hold,
            paused: None,
            pending: VecDeque::new(),
            answers: VecDeque::new(),
            last_text: None,
            texts: (Instant::ZERO, 0),
        }
    }
}

impl Commander {
    /// The mode that was chosen.
    pub const fn mode(&self) -> Mode {
        self.mode
    }

    /// A service chose a mode.
    pub fn set_mode(&mut self, mode: Mode) {
        self.mode = mode;
        self.paused = None;
    }

    /// Whether a command is one that has been answered or is being answered; sends that answer
    /// again if it is known.
    pub fn is_repetition(
        &mut self,
        now: Instant,
        from: Peer,
        wanted: &Wanted,
        out: &mut Outbox,
    ) -> bool {
        let same = |peer: Option<Peer>, other: &Wanted| peer == Some(from) && other.repeats(wanted);
        if self.pending.iter().any(|pending| same(pending.peer, &pending.wanted)) {
            return true;
        }
        if wanted.confirmation == 0 {
            return false;
        }
        let known = self.answers.iter().rev().find(|(at, peer, other, _)| {
            now.since(*at) < REPEAT && *peer == from && other.repeats(wanted)
        });
        let Some((.., result)) = known else { return false };
        acknowledge(from, wanted.command, *result, out);
        true
    }

    /// A command whose number, or whose frame, the dialect does not know.
    pub fn refuse_raw(
        &mut self,
        now: Instant,
        from: Peer,
        command: u16,
        result: MavResult,
        out: &mut Outbox,
    ) {
        let reason = match result {
            MavResult::MAV_RESULT_COMMAND_UNSUPPORTED_MAV_FRAME => "its frame is not known",
            _ => NO_SUCH_COMMAND,
        };
        self.say_refusal(now, format!("Command {command} refused: {reason}"), out);
        acknowledge_raw(from, command, result, out);
    }

    /// Carries a command on from the decision about it.
    pub fn proceed(
        &mut self,
        now: Instant,
        peer: Option<Peer>,
        wanted: Wanted,
        step: Result<Step, Denial>,
        out: &mut Outbox,
    ) {
        let (requests, mode) = match step {
            Ok(Step::Done) => return self.finish(now, peer, &wanted, Ok(()), out),
            Ok(Step::Ask(requests, mode)) => (requests, mode),
            Err(denial) => return self.finish(now, peer, &wanted, Err(denial), out),
        };
        let ids: Option<Vec<RequestId>> = if self.pending.len() < PENDING_MAX {
            requests.into_iter().map(|request| out.request(request)).collect()
        } else {
            None
        };
        match ids {
            Some(ids) => self.pending.push_back(Pending { ids, since: now, peer, wanted, mode }),
            None => {
                let denial = Denial::later("too many commands at once");
                self.finish(now, peer, &wanted, Err(denial), out);
            }
        }
    }

    /// The core's answer; says whether it was to a command.
    pub fn handle_reply(
        &mut self,
        now: Instant,
        id: RequestId,
        result: &Result<(), Refusal>,
        out: &mut Outbox,
    ) -> bool {
        let Some(index) = self.pending.iter().position(|pending| pending.ids.contains(&id)) else {
            return false;
        };
        match result {
            Ok(()) => {
                let pending = &mut self.pending[index];
                pending.ids.retain(|waiting| *waiting != id);
                if !pending.ids.is_empty() {
                    return true;
                }
                let Some(pending) = self.pending.remove(index) else { return true };
                if let Some(mode) = pending.mode {
                    if mode != Mode::Hold {
                        self.paused = None;
                    }
                    self.mode = mode;
                }
                self.finish(now, pending.peer, &pending.wanted, Ok(()), out);
            }
            Err(refusal) => {
                let Some(pending) = self.pending.remove(index) else { return true };
                let denial = Denial::from(refusal.clone());
                self.finish(now, pending.peer, &pending.wanted, Err(denial), out);
            }
        }
        true
    }

    /// Gives up on what the core does not answer.
    pub fn handle_time(&mut self, now: Instant, out: &mut Outbox) {
        while self.pending.front().is_some_and(|pending| now.since(pending.since) >= SILENCE) {
            let Some(pending) = self.pending.pop_front() else { return };
            let denial = Denial::later("the autopilot did not answer");
            self.finish(now, pending.peer, &pending.wanted, Err(denial), out);
        }
    }

    /// When the patience with the core ends.
    pub fn poll_at(&self) -> Option<Instant> {
        self.pending.front().map(|pending| pending.since + SILENCE)
    }

    fn finish(
        &mut self,
        now: Instant,
        peer: Option<Peer>,
        wanted: &Wanted,
        result: Result<(), Denial>,
        out: &mut Outbox,
    ) {
        let code = match result {
            Ok(()) => MavResult::MAV_RESULT_ACCEPTED,
            Err(Denial { result, reason }) => {
                if !reason.is_empty() {
                    self.say_refusal(now, format!("{} refused: {reason}", wanted.name()), out);
                }
                result
            }
        };
        let Some(peer) = peer else { return };
        acknowledge(peer, wanted.command, code, out);
        if self.answers.len() >= ANSWERS_MAX {
            self.answers.pop_front();
        }
        self.answers.push_back((now, peer, *wanted, code));
    }

    /// Says why something is refused, unless it was just said or too much is being said.
    fn say_refusal(&mut self, now: Instant, text: String, out: &mut Outbox) {
        let echo = |(at, said): &(Instant, String)| now.since(*at) < ECHO && *said == text;
        if self.last_text.as_ref().is_some_and(echo) {
            return;
        }
        if now.since(self.texts.0) >= Duration::from_secs(1) {
            self.texts = (now, 0);
        }
        self.texts.1 += 1;
        if self.texts.1 <= TEXTS_PER_S {
            out.say(MavSeverity::MAV_SEVERITY_WARNING, &text);
            self.last_text = Some((now, text));
        }
    }
}

/// Answers a command.
pub fn acknowledge(to: Peer, command: MavCmd, result: MavResult, out: &mut Outbox) {
    let ack = c::COMMAND_ACK_DATA {
        command,
        result,
        progress: 0,
        result_param2: 0,
        target_system: to.system,
        target_component: to.component,
    };
    out.send(to, MavMessage::COMMAND_ACK(ack));
}

/// Answers a command whose number, or whose frame, the dialect does not know.
fn acknowledge_raw(to: Peer, command: u16, result: MavResult, out: &mut Outbox) {
    let [low, high] = command.to_le_bytes();
    // Command, result, progress, four bytes of a second result, asker.
    let payload = vec![low, high, result as u8, 0, 0, 0, 0, 0, to.system, to.component];
    out.send(to, RawBody { id: c::COMMAND_ACK_DATA::ID, payload });
}
