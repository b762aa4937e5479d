//! How long a planning step may take. A plan starts from the state that the car will have when it takes
//! over, so that moment is promised when the plan is asked for: too early, and the plan comes too late
//! and is lost; too late, and information ages for nothing. What the last steps took tells which.

use std::collections::VecDeque;

/// Steps remembered: five seconds at 20 Hz.
const STEPS: usize = 100;
/// Before so many the most is granted.
const STEPS_MIN: usize = 8;
/// Of the steps remembered one in so many may have taken longer. Plans take over at control ticks, so
/// waiting for one more of them makes information 10 ms older at every step, while a plan that is lost
/// makes it one scan older once, 50 ms: where fewer than one step in five needs the tick, it does not pay.
const LATE_ONE_IN: usize = 5;
/// Slow steps come in bursts, where a place is hard to plan in: the next one is granted this many
/// times what the last one took. Without, a third more plans would be lost.
const LAST_FACTOR: f64 = 1.25;
/// Granted beyond what steps took, seconds.
const MARGIN_S: f64 = 1e-3;
/// Granted at most where the last step took longer than it was to, seconds. Were it not more, a computer or
/// a place that makes all steps slow would have every plan lost, and the car stand. A plan that old is
/// still worth driving: two scans.
const SLOW_S: f64 = 0.1;

/// Remembers how long planning took.
#[derive(Debug, Default)]
pub struct Grant {
    took_s: VecDeque<f64>,
    sorted: Vec<f64>,
}

impl Grant {
    /// A step took so long from its request until its answer was there, seconds.
    pub fn note(&mut self, took_s: f64) {
        if self.took_s.len() == STEPS {
            self.took_s.pop_front();
        }
        self.took_s.push_back(took_s.max(0.0));
    }

    /// What the next step is granted, at most `most_s` unless the last one took longer; seconds.
    pub fn granted_s(&mut self, most_s: f64) -> f64 {
        let took_s = self.took_s.back().copied().unwrap_or(0.0);
        let last_s = LAST_FACTOR * took_s + MARGIN_S;
        if took_s > most_s + MARGIN_S {
            return last_s.min(SLOW_S).max(most_s);
        }
        if self.took_s.len() < STEPS_MIN {
            return most_s;
        }
        self.sorted.clear();
        self.sorted.extend(&self.took_s);
        let rank = self.sorted.len() - 1 - self.sorted.len() / LATE_ONE_IN;
        let (_, most_took_s, _) = self.sorted.select_nth_unstable_by(rank, f64::total_cmp);
        most_s.min(last_s.max(*most_took_s + MARGIN_S))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grant(took_s: impl IntoIterator<Item = f64>) -> Grant {
        let mut grant = Grant::default();
        took_s.into_iter().for_each(|took_s| grant.note(took_s));
        grant
    }

    /// So many slow steps of 12 ms, the others of 4 ms, the newest one of 1 ms.
    fn mixed(slow: usize) -> Grant {
        let mut steps = [0.004; STEPS];
        steps[..slow].fill(0.012);
        steps[STEPS - 1] = 0.001;
        grant(steps)
    }

    #[test]
    fn at_first_the_most_is_granted() {
        assert_eq!(grant([]).granted_s(0.02), 0.02);
        assert_eq!(grant([0.004; STEPS_MIN - 1]).granted_s(0.02), 0.02);
        assert_eq!(grant([0.004; STEPS_MIN]).granted_s(0.02), LAST_FACTOR * 0.004 + MARGIN_S);
    }

    #[test]
    fn slow_steps_are_waited_for_if_more_than_one_in_five_is_slow() {
        for (slow, took_s) in [(0, 0.004), (20, 0.004), (21, 0.012), (99, 0.012)] {
            assert_eq!(mixed(slow).granted_s(0.02), took_s + MARGIN_S, "{slow}");
        }
        let mut slower = mixed(99);
        assert_eq!(slower.granted_s(0.01), 0.01, "never more than the most");
    }

    #[test]
    fn while_steps_take_longer_than_the_most_they_are_waited_for() {
        assert_eq!(
            grant([0.03]).granted_s(0.02),
            LAST_FACTOR * 0.03 + MARGIN_S,
            "from the first on"
        );
        assert_eq!(grant([0.03; 200]).granted_s(0.02), LAST_FACTOR * 0.03 + MARGIN_S);
        assert_eq!(grant([0.5; 200]).granted_s(0.02), SLOW_S);
        assert_eq!(grant([0.5; 200]).granted_s(0.2), 0.2, "whoever grants more gets that");
        let mut once = grant([0.5; 200]);
        once.note(0.0205);
        assert_eq!(once.granted_s(0.02), 0.02, "until one is quick enough");
    }

    #[test]
    fn behind_a_slow_step_the_next_one_may_be_slow_too() {
        let mut grant = mixed(0);
        grant.note(0.008);
        assert_eq!(grant.granted_s(0.02), LAST_FACTOR * 0.008 + MARGIN_S);
        grant.note(0.018);
        assert_eq!(grant.granted_s(0.02), 0.02, "but never more than the most");
        grant.note(0.001);
        assert_eq!(grant.granted_s(0.02), 0.004 + MARGIN_S);
    }

    #[test]
    fn what_is_long_ago_is_forgotten() {
        let mut grant = grant([0.5; 150]);
        (0..STEPS).for_each(|_| grant.note(0.002));
        assert_eq!(grant.granted_s(0.02), LAST_FACTOR * 0.002 + MARGIN_S);
    }
}
