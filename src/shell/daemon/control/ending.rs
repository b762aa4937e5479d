//! The end of the loop: with the car at rest, and told that this is the end.

use super::super::link::Link;
use super::super::timing::Timing;
use super::super::worker::Worker;
use super::{Control, Word};
use crate::autopilot::Command;
use crate::time::{Duration, Instant};

/// The car counts as standing after this long without motion, when the daemon is to end.
const STANDING: Duration = Duration::from_millis(200);
/// Granted to braking once the car has not come to rest along its plan.
const BRAKING: Duration = Duration::from_secs(2);

/// Why the loop ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reason {
    Asked,
    CutOff,
    Goal,
    TimeLimit,
    PlannerLost,
}

/// How far the end has come.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Ending {
    /// The car comes to rest along its plan.
    Plan { since: Instant, standing_since: Option<Instant> },
    /// It did not in time, and brakes.
    Brake { since: Instant },
    /// It stands, and is told that this is the end.
    Farewell { since: Instant },
}

impl<L: Link, T: Timing, W: Worker> Control<L, T, W> {
    pub(super) fn begin_end(&mut self, reason: Reason, why: &str) {
        if self.ending.is_some() {
            return;
        }
        let now = self.timing.now();
        tracing::info!("{why}: bringing the car to rest");
        let _ = self.outside.words.send(Word::Stopping);
        // Refused where the car is at rest or coming to rest anyway.
        let _ = self.core.handle_command(now, Command::Pause);
        self.ending = Some((reason, Ending::Plan { since: now, standing_since: None }));
        self.fetch(now);
    }

    pub(super) fn advance_end(&mut self, now: Instant) {
        let Some((_, ending)) = &mut self.ending else { return };
        let standing = self.core.is_at_rest(now);
        match ending {
            Ending::Plan { since, standing_since } => {
                let stood = standing && {
                    let from = *standing_since.get_or_insert(now);
                    now.since(from) >= STANDING
                };
                if !standing {
                    *standing_since = None;
                }
                if stood {
                    *ending = Ending::Farewell { since: now };
                } else if now.seconds_after(*since) > self.params.daemon.stop_time_limit_s {
                    tracing::error!("the car does not come to rest along its plan: braking");
                    *ending = Ending::Brake { since: now };
                } else {
                    return;
                }
                // Disarming is never refused.
                let _ = self.core.handle_command(now, Command::Disarm);
                self.fetch(now);
            }
            Ending::Brake { since } => {
                if standing || now.since(*since) > BRAKING {
                    *ending = Ending::Farewell { since: now };
                }
            }
            Ending::Farewell { .. } => {}
        }
    }
}
