//! How long a planning step may take: as long as nearly all of the last ones took, since a plan takes
//! over only when the time granted is over, and information ages meanwhile.

use std::collections::VecDeque;

/// Steps that are remembered: five seconds of them at 20 Hz.
const STEPS: usize = 100;
/// Before so many the most is granted.
const STEPS_MIN: usize = 8;
/// Of the steps remembered one, and one more of each so many, may have taken longer: the first step of
/// a drive often does. A plan that comes too late is lost, which makes information one scan older, once;
/// granting less makes it younger at all other steps.
const LATE_ONE_IN: usize = 50;
/// Slow steps come in bursts, where a place is hard to plan in: the next one is granted this many
/// times what the last one took.
const LAST_FACTOR: f64 = 1.25;
/// Granted beyond what steps took, seconds.
const MARGIN_S: f64 = 1e-3;

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

    /// What the next step is granted, at most `most_s`; seconds.
    pub fn granted_s(&mut self, most_s: f64) -> f64 {
        if self.took_s.len() < STEPS_MIN {
            return most_s;
        }
        self.sorted.clear();
        self.sorted.extend(&self.took_s);
        let rank = self.sorted.len() - 2 - self.sorted.len() / LATE_ONE_IN;
        let (_, nearly_all_s, _) = self.sorted.select_nth_unstable_by(rank, f64::total_cmp);
        let last_s = self.took_s.back().map_or(0.0, |last_s| LAST_FACTOR * last_s);
        most_s.min(nearly_all_s.max(last_s) + MARGIN_S)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_much_is_granted_as_nearly_all_of_the_last_steps_took() {
        let mut grant = Grant::default();
        assert_eq!(grant.granted_s(0.02), 0.02);
        for _ in 0..200 {
            grant.note(0.004);
        }
        assert_eq!(grant.granted_s(0.02), LAST_FACTOR * 0.004 + MARGIN_S);
        for _ in 0..3 {
            grant.note(0.5);
            assert_eq!(grant.granted_s(0.02), 0.02, "the next one may well be slow, too");
        }
        grant.note(0.004);
        assert_eq!(
            grant.granted_s(0.02),
            LAST_FACTOR * 0.004 + MARGIN_S,
            "three in a hundred may be late"
        );
        grant.note(0.5);
        grant.note(0.004);
        assert_eq!(grant.granted_s(0.02), 0.02, "four may not");
        for _ in 0..100 {
            grant.note(0.5);
        }
        assert_eq!(grant.granted_s(0.02), 0.02, "never more than the most");
        for _ in 0..100 {
            grant.note(0.002);
        }
        assert_eq!(
            grant.granted_s(0.02),
            LAST_FACTOR * 0.002 + MARGIN_S,
            "what is long ago is forgotten"
        );
    }
}
