//! Durations in fixed memory.

use hdrhistogram::Histogram;

use crate::sim::drive::Spread;
use crate::time::Duration;

/// Longest duration told from longer ones.
const LONGEST: Duration = Duration::from_secs(60);
/// Figures are good to so many digits.
const DIGITS: u8 = 2;

/// How often a duration occurred, to 1 %; with whatever is counted instead of microseconds for
/// lengths of queues.
#[derive(Clone, Debug)]
pub struct Durations(Histogram<u32>);

impl Default for Durations {
    fn default() -> Self {
        let longest_us = LONGEST.as_micros() as u64;
        Self(Histogram::new_with_bounds(1, longest_us, DIGITS).expect("the bounds are sound"))
    }
}

impl Durations {
    /// One more.
    pub fn note(&mut self, duration: Duration) {
        self.note_count(u64::try_from(duration.as_micros()).unwrap_or(u64::MAX));
    }

    /// One more that is no duration.
    pub fn note_count(&mut self, count: u64) {
        self.0.saturating_record(count);
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.0.reset();
    }

    /// Median, 99th percentile and longest in milliseconds; zeros if there were none.
    pub fn spread_ms(&self) -> Spread {
        let ms = |us: u64| us as f64 * 1e-3;
        let Spread { p50, p99, max } = self.spread();
        Spread { p50: ms(p50 as u64), p99: ms(p99 as u64), max: ms(max as u64) }
    }

    /// Median, 99th percentile and largest of what was counted; zeros if there was nothing.
    pub fn spread(&self) -> Spread {
        let at = |quantile| self.0.value_at_quantile(quantile) as f64;
        if self.0.is_empty() {
            return Spread::default();
        }
        Spread { p50: at(0.5), p99: at(0.99), max: self.0.max() as f64 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_good_to_one_percent() {
        let mut durations = Durations::default();
        assert_eq!(durations.spread_ms(), Spread::default());
        (1..=1000).for_each(|ms| durations.note(Duration::from_millis(ms)));
        let Spread { p50, p99, max } = durations.spread_ms();
        for (found, exact) in [(p50, 500.0), (p99, 990.0), (max, 1000.0)] {
            assert!((found / exact - 1.0_f64).abs() < 0.01, "{found} instead of {exact}");
        }
    }

    #[test]
    fn what_is_longer_than_the_longest_counts_as_that() {
        let mut durations = Durations::default();
        durations.note(Duration::from_secs(1_000_000));
        assert!(durations.spread_ms().max >= 60_000.0 && durations.spread_ms().max < 66_000.0);
    }
}
