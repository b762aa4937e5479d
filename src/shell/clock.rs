//! The process's clocks: the monotonic one that everything is timed by, and the wall clock, which
//! may jump and serves only to read the stamps that the kernel puts on frames.

use crate::time::{Duration, Instant};

/// The monotonic clock, counted from the start of the process. Copies show the same time.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    begin: std::time::Instant,
}

impl Clock {
    /// A clock that reads zero now.
    pub fn start() -> Self {
        Self { begin: super::pace::now() }
    }

    /// The time now.
    pub fn now(&self) -> Instant {
        Instant::ZERO + self.begin.elapsed()
    }

    /// A moment of this clock for the timers of the runtime.
    pub fn deadline(&self, at: Instant) -> tokio::time::Instant {
        tokio::time::Instant::from_std(self.begin + at.since(Instant::ZERO))
    }

    /// Monotonic and wall clock read together; the wall clock since 1970 (zero if it is set
    /// earlier).
    #[expect(clippy::disallowed_methods, reason = "the shell may ask for the time")]
    pub fn both(&self) -> (Instant, Duration) {
        let mut readings = (self.now(), Duration::ZERO);
        // Who is put to sleep between the two reads again: else the pause would look like a jump of
        // the wall clock.
        for _ in 0..READINGS_MAX {
            let wall = std::time::SystemTime::now();
            let after = self.now();
            readings.1 = wall.duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
            if after.since(readings.0) <= TOGETHER {
                break;
            }
            readings.0 = after;
        }
        readings
    }
}

/// Two readings no further apart count as taken together.
const TOGETHER: Duration = Duration::from_micros(500);
/// So often is it tried.
const READINGS_MAX: u32 = 3;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_show_the_same_time_and_it_only_goes_forward() {
        let clock = Clock::start();
        let copy = clock;
        let (a, b, c) = (clock.now(), copy.now(), clock.now());
        assert!(a <= b && b <= c);
        assert!(c.since(a) < Duration::from_secs(60), "not two clocks: {a} {c}");
    }

    #[test]
    fn a_deadline_is_as_far_away_as_the_moment() {
        let clock = Clock::start();
        let (a, b) = (clock.now(), clock.now() + Duration::from_millis(250));
        assert_eq!(clock.deadline(b) - clock.deadline(a), b.since(a));
    }

    #[test]
    fn the_wall_clock_is_read_with_the_monotonic_one() {
        let clock = Clock::start();
        let before = clock.now();
        let (at, wall) = clock.both();
        assert!(before <= at && at <= clock.now());
        // 2024-01-01: a machine that tests this program is younger.
        assert!(wall > Duration::from_secs(1_704_067_200), "{wall:?}");
    }
}
