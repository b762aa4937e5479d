//! How busy a thread is.

use nix::time::{ClockId, clock_gettime};

use crate::time::{Duration, Instant};

/// The share is that of this long, at the least.
const WINDOW: Duration = Duration::from_millis(500);

/// Measures the share of its time that the calling thread works.
#[derive(Debug, Default)]
pub struct LoadMeter {
    before: Option<(Instant, Duration)>,
    load: f64,
}

impl LoadMeter {
    /// The share of late, 0 to 1. To be called by one thread alone.
    pub fn measure(&mut self, now: Instant) -> f64 {
        // A kernel without this clock does not exist; without an answer the load stays unknown.
        let Ok(used) = clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID) else { return 0.0 };
        let used = Duration::from(used);
        match self.before {
            Some((at, _)) if now.since(at) < WINDOW => {}
            Some((at, before)) => {
                let share = used.saturating_sub(before).as_secs_f64() / now.seconds_after(at);
                self.load = share.clamp(0.0, 1.0);
                self.before = Some((now, used));
            }
            None => self.before = Some((now, used)),
        }
        self.load
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shell::clock::Clock;

    #[test]
    fn a_thread_that_works_is_told_from_one_that_sleeps() {
        let clock = Clock::start();
        let mut meter = LoadMeter::default();
        meter.measure(clock.now());
        #[expect(clippy::disallowed_methods, reason = "the shell may wait")]
        std::thread::sleep(WINDOW);
        let asleep = meter.measure(clock.now() + Duration::from_millis(1));
        assert!(asleep < 0.2, "{asleep}");
    }
}
