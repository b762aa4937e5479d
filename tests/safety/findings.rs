//! What was found to be wrong, by the name of the rule.
//!
//! | rule | at every planning step |
//! |---|---|
//! | P1 | a plan starts in the state that the committed plan has when it takes over |
//! | P2 | neighbouring chords turn no more than the tightest bend explains |
//! | P3 | no circle through three samples is tighter than the turning circle |
//! | P4 | the disc of car and margin, swept along it, stays in cells known to be free |
//! | P5 | it ends at rest |
//! | P6 | accelerations recomputed from positions and times stay within the tyres' grip |
//! | P7 | speeds lie between zero and the limit, times increase |
//! | P8 | from every point full braking along the path ends before the plan does |
//! | P10 | nothing of the imagined rest of the way is among what is executed |
//! | P11 | what is driven was certified, or is what was driven before, still clear in the newest map |
//! | P12 | knowledge only grows; free cells are free in truth |
//! | P14 | the plan of a moving car stops in the goal, or where a quarter turn to one side is clear, or a turn back that swings out to the other side first (the product asks for more: a way onto its tracks) |
//!
//! | rule | at every simulated millisecond |
//! |---|---|
//! | I1 | the true footprint touches nothing |
//! | I2 | the true footprint lies in cells that the map knows to be free at that time |
//! | I3 | forces asked for, and accelerations driven, stay within the tyres' grip |
//! | I4 | the curvature driven stays within the turning circle |
//! | I5 | the speed lies between zero and the limit |
//! | I6 | the heading is kept at rest, and the car moves along it |
//! | I7 | braking from here along the committed plan ends on it, without contact in the true world |
//! | I8 | the true position follows the committed plan |
//! | I9 | no beam ends beyond its range or behind a wall |
//! | I10 | the plan being driven rests on a scan no older than rate and latency explain |

use std::collections::BTreeMap;

/// The violations of a drive: how many of each rule, and what the first one was.
#[derive(Clone, Debug, Default)]
pub struct Findings {
    by_rule: BTreeMap<&'static str, (u64, String)>,
}

impl Findings {
    /// Enters a violation; `what` is only asked for the first of a rule.
    pub fn enter(&mut self, rule: &'static str, what: impl FnOnce() -> String) {
        self.by_rule.entry(rule).or_insert_with(|| (0, what())).0 += 1;
    }

    /// Enters a violation unless a condition holds.
    pub fn check(&mut self, holds: bool, rule: &'static str, what: impl FnOnce() -> String) {
        if !holds {
            self.enter(rule, what);
        }
    }

    /// How often a rule was violated.
    pub fn count(&self, rule: &str) -> u64 {
        self.by_rule.get(rule).map_or(0, |(count, _)| *count)
    }

    /// Takes over what another inspection found.
    pub fn extend(&mut self, other: Self) {
        for (rule, (count, what)) in other.by_rule {
            self.by_rule.entry(rule).or_insert_with(|| (0, what)).0 += count;
        }
    }

    /// Fails the test if anything was found.
    #[track_caller]
    pub fn assert_none(&self, drive: &str) {
        assert!(self.by_rule.is_empty(), "{drive}: {:#?}", self.by_rule);
    }
}
