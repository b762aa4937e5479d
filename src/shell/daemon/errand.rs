//! A goal given at the start: arms the car as soon as the checks pass, and sends it there.

use std::mem::Discriminant;

use crate::autopilot::{Autopilot, Command, Refusal};
use crate::frames::Point;
use crate::time::{Duration, Instant};

/// Between two lines about what is waited for.
const SAY_AGAIN: Duration = Duration::from_secs(1);

/// How far the errand has come.
#[derive(Debug)]
enum State {
    /// Disarmed, and nobody has asked for anything else.
    Idle { after_crash: bool },
    /// As soon as the checks pass.
    Waiting { goal: Point, said: Vec<Discriminant<Refusal>>, said_at: Option<Instant> },
    /// Under way, done, or somebody else has taken over.
    Over,
}

/// What there is to say after a step.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Nothing new.
    Nothing,
    /// A line for the log.
    Said(String),
}

/// A goal given at the start.
#[derive(Debug)]
pub struct Errand {
    state: State,
    announced: bool,
}

impl Errand {
    /// An errand, or none. After a crash the car waits to be armed by somebody, whatever the goal:
    /// nobody knows what has happened.
    pub fn new(goal: Option<Point>, after_crash: bool) -> Self {
        let state = match goal {
            Some(goal) if !after_crash => State::Waiting { goal, said: Vec::new(), said_at: None },
            _ => State::Idle { after_crash },
        };
        Self { state, announced: false }
    }

    /// Why the car is not armed, as long as nothing has happened to it.
    pub fn why_disarmed(&self) -> Option<&'static str> {
        match self.state {
            State::Idle { after_crash: true } => Some("previous run ended unexpectedly; disarmed"),
            State::Idle { after_crash: false } => Some("waiting for a command to arm"),
            State::Waiting { .. } | State::Over => None,
        }
    }

    /// Somebody else gives commands.
    pub fn overrule(&mut self) {
        self.state = State::Over;
    }

    /// Does what can be done now.
    pub fn step(&mut self, core: &mut Autopilot, now: Instant) -> Step {
        let State::Waiting { goal, said, said_at } = &mut self.state else {
            let announced = std::mem::replace(&mut self.announced, true);
            return match self.why_disarmed().filter(|_| !announced) {
                Some(why) => Step::Said(why.to_owned()),
                None => Step::Nothing,
            };
        };
        let goal = *goal;
        let reasons = core.pre_arm(now);
        if !reasons.is_empty() {
            // Figures in them may change all the time.
            let kinds: Vec<_> = reasons.iter().map(std::mem::discriminant).collect();
            // And they may come and go.
            if *said == kinds || said_at.is_some_and(|at| now.since(at) < SAY_AGAIN) {
                return Step::Nothing;
            }
            *said = kinds;
            *said_at = Some(now);
            let names: Vec<_> = reasons.iter().map(ToString::to_string).collect();
            return Step::Said(format!("waiting to arm: {}", names.join("; ")));
        }
        let started = core
            .handle_command(now, Command::Arm)
            .and_then(|()| core.handle_command(now, Command::Goto(goal)));
        self.state = State::Over;
        Step::Said(match started {
            Ok(()) => format!("armed; driving to ({:.2}, {:.2}) m", goal.x, goal.y),
            Err(refusal) => format!("not driving: {refusal}"),
        })
    }
}
