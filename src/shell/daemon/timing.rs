//! The clock of the control thread and its alarm.

use std::os::fd::{AsFd, AsRawFd, BorrowedFd, RawFd};

use nix::sys::time::TimeSpec;
use nix::sys::timerfd::{ClockId, Expiration, TimerFd, TimerFlags, TimerSetTimeFlags};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use crate::shell::clock::Clock;
use crate::time::{Duration, Instant};

/// So often are the clocks compared; the closest pair of readings counts.
const READINGS: u32 = 8;

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
    /// What the system's clock showed at the zero of ours.
    zero: Duration,
    timer: AsyncFd<Timer>,
    armed: Option<Instant>,
}

impl MonotonicTiming {
    /// An alarm on that clock. Within an async runtime only.
    pub fn new(clock: Clock) -> std::io::Result<Self> {
        let flags = TimerFlags::TFD_NONBLOCK | TimerFlags::TFD_CLOEXEC;
        let timer = TimerFd::new(ClockId::CLOCK_MONOTONIC, flags)?;
        let zero = zero_of(&clock)?;
        Ok(Self { clock, zero, timer: watched(timer)?, armed: None })
    }

    /// Sets the alarm to a moment as the system counts it, so that delays on the way here do not
    /// add up.
    fn arm(&self, at: Instant) -> nix::Result<()> {
        let due = Expiration::OneShot(TimeSpec::from_duration(self.zero + at.since(Instant::ZERO)));
        self.timer.get_ref().0.set(due, TimerSetTimeFlags::TFD_TIMER_ABSTIME)
    }
}

/// What the system's monotonic clock showed when `clock` showed zero; never earlier, so that no
/// alarm rings too early.
fn zero_of(clock: &Clock) -> nix::Result<Duration> {
    let mut least = Duration::MAX;
    for _ in 0..READINGS {
        let ours = clock.now();
        let system = nix::time::clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC)?;
        least = least.min(Duration::from(system).saturating_sub(ours.since(Instant::ZERO)));
    }
    Ok(least)
}

impl Timing for MonotonicTiming {
    fn now(&self) -> Instant {
        self.clock.now()
    }

    async fn until(&mut self, at: Instant) {
        if self.armed != Some(at) {
            self.arm(at).expect("a timer takes every moment");
            self.armed = Some(at);
        }
        loop {
            let mut guard = self.timer.readable().await.expect("the timer belongs to this runtime");
            let rung = guard.try_io(|timer| {
                let mut rings = [0; 8];
                Ok(nix::unistd::read(timer.as_fd(), &mut rings)?)
            });
            // Otherwise it was set anew after it had rung.
            if matches!(rung, Ok(Ok(_))) {
                self.armed = None;
                return;
            }
        }
    }
}

/// The timer under the eyes of the runtime.
#[expect(
    deprecated,
    reason = "a timer that owns its descriptor meets what the unsafe successor asks for"
)]
fn watched(timer: TimerFd) -> std::io::Result<AsyncFd<Timer>> {
    AsyncFd::with_interest(Timer(timer), Interest::READABLE)
}

/// A timer's descriptor.
struct Timer(TimerFd);

impl AsFd for Timer {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}

impl AsRawFd for Timer {
    fn as_raw_fd(&self) -> RawFd {
        self.0.as_fd().as_raw_fd()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
