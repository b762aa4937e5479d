//! What a person or a ground station wants, and what becomes of it.

use super::{Autopilot, Clears, Command, Fault, Happening, Mode, Refusal};
use crate::plan::Goal;
use crate::time::Instant;

impl Autopilot {
    /// A person or a ground station wants something.
    ///
    /// # Errors
    /// Why it is not done.
    pub fn handle_command(&mut self, now: Instant, command: Command) -> Result<(), Refusal> {
        self.testimony.note_at(now, Happening::Command(&command));
        let ends =
            matches!(command, Command::Disarm | Command::Terminate | Command::StationLost(_));
        if self.faults.contains(Fault::Terminated) && !ends {
            return Err(Refusal::Terminated);
        }
        match command {
            Command::Arm => self.arm(now)?,
            Command::Disarm => {
                self.goal = None;
                self.wish.speed_limit_mps = None;
                self.transition(now, Mode::Disarmed);
            }
            Command::Goto(position) | Command::Return(position) => {
                if !(position.x.is_finite() && position.y.is_finite()) {
                    return Err(Refusal::GoalNotFinite { x_m: position.x, y_m: position.y });
                }
                if !self.mode.is_armed() {
                    return Err(Refusal::NotArmed);
                }
                let radius_m = self.params.autopilot.goal_radius_m;
                self.goal = Some(Goal { position, radius_m });
                self.wish.through_known = matches!(command, Command::Return(_));
                self.clear(now, Fault::GoalUnreachable);
                self.paused = false;
                if self.mode != Mode::Stop {
                    self.begin_drive(now);
                }
            }
            Command::Pause => match self.mode {
                Mode::Drive => {
                    self.committed.drop_next();
                    self.paused = true;
                    self.transition(now, Mode::Hold);
                }
                // Stopping already: it shall not go on by itself.
                Mode::Stop if self.goal.is_some() => self.paused = true,
                _ => return Err(Refusal::NotDriving),
            },
            Command::Continue => {
                if self.goal.is_none() || self.mode != Mode::Hold {
                    return Err(Refusal::NothingToContinue);
                }
                self.paused = false;
                self.begin_drive(now);
            }
            Command::SpeedLimit(limit) => {
                if let Some(speed_mps) = limit.filter(|speed| !(*speed > 0.0 && speed.is_finite()))
                {
                    return Err(Refusal::SpeedNotPositive { speed_mps });
                }
                self.wish.speed_limit_mps = limit;
            }
            Command::StationLost(lost) => self.wish.station_lost = lost,
            Command::Terminate => {
                self.goal = None;
                self.raise(now, Fault::Terminated);
            }
        }
        Ok(())
    }

    fn arm(&mut self, now: Instant) -> Result<(), Refusal> {
        let latched = |fault: &Fault| fault.row().clears == Clears::ByArming;
        let faults: Vec<Fault> = self.faults.iter().filter(latched).collect();
        if self.mode.is_armed() && self.mode != Mode::Stop && faults.is_empty() {
            return Ok(());
        }
        if let Some(reason) = self.pre_arm(now).into_iter().next() {
            return Err(reason);
        }
        if self.faults.contains(Fault::PoseLost) {
            self.mark_standing(now);
        }
        for fault in faults {
            self.clear(now, fault);
        }
        self.forget_losses();
        self.stand_here(now);
        if matches!(self.mode, Mode::Disarmed | Mode::Stop) {
            self.paused = self.goal.is_some();
            self.transition(now, if self.goal.is_some() { Mode::Hold } else { Mode::Standby });
        }
        Ok(())
    }

    pub(super) fn begin_drive(&mut self, now: Instant) {
        self.last_adopted = now;
        self.next_request = now;
        self.health.trust_tails(now);
        self.transition(now, Mode::Drive);
    }
}
