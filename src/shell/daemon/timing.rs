//! The clock of the control thread and its alarm.

use crate::shell::clock::{Alarm, Clock};
use crate::time::Instant;

/// Tells the time and waits for a moment.
pub trait Timing {
    /// The time.
    fn now(&self) -> Instant;

    /// Returns once the time has come. Dropping the future and asking again loses nothing.
    async fn until(&mut self, at: Instant);
}

/// The monotonic clock of the system, with a timer of its own: the timers of the async runtime
/// know whole milliseconds only.
pub struct MonotonicTiming {
    clock: Clock,
    alarm: Alarm,
    armed: Option<Instant>,
}

impl MonotonicTiming {
    /// An alarm on that clock. Within an async runtime only.
    pub fn new(clock: Clock) -> std::io::Result<Self> {
        Ok(Self { clock, alarm: Alarm::new(&clock)?, armed: None })
    }
}

impl Timing for MonotonicTiming {
    fn now(&self) -> Instant {
        self.clock.now()
    }

    async fn until(&mut self, at: Instant) {
        if self.armed != Some(at) {
            self.alarm.set(at).expect("a timer takes every moment");
            self.armed = Some(at);
        }
        self.alarm.rings().await.expect("the timer belongs to this runtime");
        self.armed = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Duration;

    #[test]
    fn it_rings_at_the_moment_also_if_asked_again_in_between() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let clock = Clock::start();
            let mut timing = MonotonicTiming::new(clock).unwrap();
            let first = clock.now() + Duration::from_millis(20);
            while tokio::time::timeout(Duration::from_millis(3), timing.until(first)).await.is_err()
            {
                assert!(clock.now() < first + Duration::from_secs(5), "it never rings");
            }
            assert!(clock.now() >= first);
            // Set to a moment that has passed, it rings at once; set again, only then.
            timing.until(first).await;
            let later = clock.now() + Duration::from_millis(10);
            timing.until(later).await;
            assert!(clock.now() >= later);
        });
    }
}
