//! One scenario: a drive under way, a fault, and what must come of it.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use apexd::autopilot::{Action, Clears, Command, CoreParams, Event, Fault, Mode, Refusal};
use apexd::frames::{Point, Pose};
use apexd::sim::rig::Rig;
use apexd::time::Instant;

use super::trial::Trial;

/// What a scenario finds wrong, in words.
pub type Outcome = Result<(), String>;

/// Fails a scenario unless a condition holds.
macro_rules! must {
    ($holds:expr, $($what:tt)+) => {
        let holds: bool = $holds;
        if !holds {
            return Err(format!($($what)+));
        }
    };
}
pub(crate) use must;

/// Seconds that a fault stays after its cause.
pub const CALM_S: f64 = 0.5;

/// Empty, 30 m long: nothing in the way, and room to turn.
pub fn hall() -> Trial {
    Trial::hall(30.0, 8.0, Pose::new(2.0, 4.0, 0.0), Point::new(27.0, 4.0))
}

/// A drive with the events it has seen.
pub struct Play {
    pub rig: Rig,
    pub fault: Fault,
    events: Vec<Event>,
    /// Before the last millisecond.
    before: Instant,
    /// A switch for planners and predictors that fail when it is set.
    pub switch: Arc<AtomicBool>,
}

/// What a row's detector sees.
#[derive(Clone, Copy, Debug)]
pub struct Raised {
    /// The car's speed then, m/s.
    pub speed_mps: f64,
    /// Plans adopted until then.
    plans: u64,
}

impl Play {
    pub fn new(rig: Rig, fault: Fault, suppressed: bool, switch: Arc<AtomicBool>) -> Self {
        let before = rig.now();
        let mut play = Self { rig, fault, events: Vec::new(), before, switch };
        if suppressed {
            play.rig.core_mut().suppress(fault);
        }
        play
    }

    pub fn now_s(&self) -> f64 {
        self.rig.now().as_secs_f64()
    }

    /// One millisecond; the judge's word counts at every one.
    fn step(&mut self) -> Outcome {
        self.before = self.rig.now();
        self.rig.step();
        while let Some(event) = self.rig.poll_event() {
            self.events.push(event);
        }
        let judge = self.rig.judge();
        must!(judge.collisions() == 0, "contact at {:?}", self.rig.car());
        must!(judge.unknown_entries() == 0, "unknown entry at {:?}", self.rig.car());
        Ok(())
    }

    pub fn run(&mut self, seconds: f64) -> Outcome {
        let until = self.rig.now().offset_by(seconds);
        while self.rig.now() < until {
            self.step()?;
        }
        Ok(())
    }

    /// Goes on until something holds.
    pub fn until(&mut self, limit_s: f64, holds: impl Fn(&Rig) -> bool) -> Outcome {
        let until = self.rig.now().offset_by(limit_s);
        while !holds(&self.rig) {
            must!(self.rig.now() < until, "not within {limit_s} s: {:?}", self.rig.core().mode());
            self.step()?;
        }
        Ok(())
    }

    /// Lets the car get going.
    pub fn get_going(&mut self, speed_mps: f64) -> Outcome {
        self.until(6.0, |rig| rig.car().speed_mps >= speed_mps)?;
        let faults: Vec<Fault> = self.rig.core().faults().iter().collect();
        must!(faults.is_empty(), "faults before anything is wrong: {faults:?}");
        must!(self.rig.core().mode() == Mode::Drive, "not driving");
        Ok(())
    }

    /// Waits for the fault, whose cause is there from now on. `source_s` is how long the cause
    /// may take to show in what the core is told: the period of what no longer comes.
    pub fn expect_raised(&mut self, source_s: f64) -> Result<Raised, String> {
        self.expect_raised_since(self.rig.now(), source_s)
    }

    /// The same for a cause that has come about in the last millisecond.
    pub fn expect_raised_just_now(&mut self) -> Result<Raised, String> {
        self.expect_raised_since(self.before, 0.0)
    }

    fn expect_raised_since(&mut self, cause: Instant, source_s: f64) -> Result<Raised, String> {
        let within_s = self.fault.row().within_s(&CoreParams::default()) + source_s;
        let fault = self.fault;
        self.until(within_s + 0.05, |rig| rig.core().faults().contains(fault))?;
        let took_s = self.rig.now().seconds_after(cause);
        // Looked at once a millisecond.
        must!(took_s <= within_s + 0.001, "took {took_s:.4} s, allowed {within_s:.4} s");
        self.run(0.002)?;
        let says_so = |event: &Event| {
            matches!(event, Event::FaultRaised { at, fault: raised }
                if *raised == fault && at.seconds_after(cause) > -0.201)
        };
        must!(self.events.iter().any(says_so), "no event says so");
        let plans = self.rig.core().statistics().plans_adopted;
        Ok(Raised { speed_mps: self.rig.car().speed_mps, plans })
    }

    /// What the row calls for happens: braking at once, the plan driven to its end, or nothing.
    pub fn expect_action(&mut self, raised: Raised) -> Outcome {
        // Bends leave 0.7 of the grip at worst.
        self.expect_action_with(raised, 0.7)
    }

    /// The same with this share of the grip left for braking.
    pub fn expect_action_with(&mut self, raised: Raised, grip_share: f64) -> Outcome {
        match self.fault.row().action {
            Action::BrakeNow => {
                self.run(0.035)?;
                must!(self.rig.core().mode() == Mode::Stop, "mode {:?}", self.rig.core().mode());
                let stop_s = raised.speed_mps / (grip_share * 8.829) + 0.05;
                self.until(stop_s, |rig| rig.car().speed_mps == 0.0)
                    .map_err(|e| format!("does not brake: {e}"))
            }
            Action::FinishPlan => {
                self.run(0.015)?;
                must!(self.rig.core().mode() == Mode::Stop, "mode {:?}", self.rig.core().mode());
                self.until(12.0, |rig| rig.car().speed_mps == 0.0)?;
                let plans = self.rig.core().statistics().plans_adopted;
                must!(plans == raised.plans, "{} plans adopted since", plans - raised.plans);
                Ok(())
            }
            Action::Report => {
                self.run(0.3)?;
                let decisive = self.rig.core().faults().decisive().map(|row| row.fault);
                must!(decisive.is_none(), "{decisive:?} acts");
                must!(self.rig.core().mode() != Mode::Stop, "a report stops the car");
                Ok(())
            }
        }
    }

    /// The car stands and stays, for as long as the fault is there.
    pub fn expect_rest(&mut self, seconds: f64) -> Outcome {
        let place = self.rig.car().pose;
        let until = self.rig.now().offset_by(seconds);
        while self.rig.now() < until {
            self.step()?;
            must!(self.rig.car().pose == place, "moves although it is to stand");
        }
        must!(self.rig.core().faults().contains(self.fault), "the fault is gone before its cause");
        Ok(())
    }

    /// The cause is gone from now on: what the row says clears the fault, and nothing else.
    /// `drains_s`: how long what is counted over a window takes to run out of it.
    pub fn expect_cleared(&mut self, drains_s: f64) -> Outcome {
        let fault = self.fault;
        let is_there = |rig: &Rig| rig.core().faults().contains(fault);
        match fault.row().clears {
            Clears::ByItself => {
                self.run(CALM_S - 0.06)?;
                must!(is_there(&self.rig), "cleared at once: it would flap");
                self.until(0.06 + drains_s + 0.1, |rig| !is_there(rig))
                    .map_err(|e| format!("does not clear: {e}"))
            }
            Clears::AtRest => {
                must!(!is_there(&self.rig) || self.rig.car().speed_mps == 0.0, "cleared moving");
                self.until(0.1, |rig| !is_there(rig)).map_err(|e| format!("does not clear: {e}"))
            }
            Clears::ByArming => {
                self.expect_rest(2.0).map_err(|e| format!("after the cause: {e}"))?;
                must!(self.rig.core().mode() == Mode::Stop, "mode {:?}", self.rig.core().mode());
                self.arm().map_err(|refusal| format!("cannot be armed: {refusal}"))?;
                must!(!is_there(&self.rig), "arming does not clear it");
                let place = self.rig.car().pose;
                self.run(0.5)?;
                must!(self.rig.car().pose == place, "moves without being told to");
                Ok(())
            }
            Clears::ByRestart => Err("nothing clears it".into()),
            Clears::ByNewGoal => Err("say which goal: expect_cleared_by".into()),
        }
    }

    /// Nothing but a new goal clears the fault.
    pub fn expect_cleared_by(&mut self, goal: Point) -> Outcome {
        let fault = self.fault;
        must!(fault.row().clears == Clears::ByNewGoal, "another row");
        self.expect_rest(2.0)?;
        self.arm().map_err(|refusal| format!("cannot be armed: {refusal}"))?;
        must!(self.rig.core().faults().contains(fault), "arming clears it");
        self.goto(goal).map_err(|refusal| format!("takes no goal: {refusal}"))?;
        must!(!self.rig.core().faults().contains(fault), "a new goal does not clear it");
        self.expect_progress()
    }

    /// The car gets on.
    fn expect_progress(&mut self) -> Outcome {
        let before = self.rig.distance_m();
        self.run(2.0)?;
        let driven = self.rig.distance_m() - before;
        let faults: Vec<Fault> = self.rig.core().faults().iter().collect();
        let mode = self.rig.core().mode();
        must!(driven > 0.5, "goes on for {driven:.2} m only: {mode:?}, {faults:?}");
        Ok(())
    }

    /// The car stays where it is, whatever the core thinks.
    pub fn expect_standing(&mut self, seconds: f64) -> Outcome {
        let place = self.rig.car().pose;
        self.run(seconds)?;
        must!(self.rig.car().pose == place, "moves although it is to stand");
        Ok(())
    }

    pub fn arm(&mut self) -> Result<(), Refusal> {
        let now = self.rig.now();
        self.rig.core_mut().handle_command(now, Command::Arm)
    }

    pub fn goto(&mut self, goal: Point) -> Result<(), Refusal> {
        let now = self.rig.now();
        self.rig.core_mut().handle_command(now, Command::Goto(goal))
    }

    /// The drive goes on: by itself, after `Continue`, or to a goal that was given anew.
    pub fn expect_drive(&mut self) -> Outcome {
        let now = self.rig.now();
        let core = self.rig.core_mut();
        if core.mode() == Mode::Hold {
            core.handle_command(now, Command::Continue).map_err(|e| e.to_string())?;
        }
        if core.mode() == Mode::Standby {
            self.goto(Point::new(27.0, 4.0)).map_err(|e| e.to_string())?;
        }
        self.expect_progress()
    }
}
