//! The process's clocks: the monotonic one that everything is timed by, and the wall clock, which
//! may jump and serves only to read the stamps that the kernel puts on frames.

use nix::errno::Errno;
use nix::sys::time::TimeSpec;
use nix::sys::timerfd::{ClockId, Expiration, TimerFd, TimerFlags, TimerSetTimeFlags};
use nix::time::clock_gettime;
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

use super::watch::{Descriptor, watched};
use crate::time::{Duration, Instant};

/// The monotonic clock, counted from the start of the process. Copies show the same time.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    /// What the kernel's monotonic clock read at the start.
    begin: Duration,
}

/// The kernel's monotonic clock.
fn monotonic() -> Duration {
    let time = clock_gettime(nix::time::ClockId::CLOCK_MONOTONIC);
    Duration::from(time.expect("every kernel has a monotonic clock"))
}

impl Clock {
    /// A clock that reads zero now.
    pub fn start() -> Self {
        Self { begin: monotonic() }
    }

    /// The time now.
    pub fn now(&self) -> Instant {
        Instant::ZERO + monotonic().saturating_sub(self.begin)
    }

    /// A moment of this clock for the timers of the runtime, which are exact to a millisecond; see
    /// [`Alarm`] for more.
    pub fn deadline(&self, at: Instant) -> tokio::time::Instant {
        let now = tokio::time::Instant::now();
        let here = self.now();
        if at >= here {
            now + at.since(here)
        } else {
            now.checked_sub(here.since(at)).unwrap_or(now)
        }
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

/// Rings at a moment of the clock, as exactly as the kernel can wake a process.
#[derive(Debug)]
pub struct Alarm {
    clock: Clock,
    timer: AsyncFd<Descriptor<TimerFd>>,
}

impl Alarm {
    /// An alarm that is not set. Needs a tokio runtime.
    ///
    /// # Errors
    /// If the kernel has no more timers or descriptors for this process.
    pub fn new(clock: &Clock) -> std::io::Result<Self> {
        let flags = TimerFlags::TFD_NONBLOCK | TimerFlags::TFD_CLOEXEC;
        let timer = TimerFd::new(ClockId::CLOCK_MONOTONIC, flags)?;
        Ok(Self { clock: *clock, timer: watched(timer, Interest::READABLE)? })
    }

    /// Lets it ring then, and not at the time set before; at once if that is over.
    ///
    /// # Errors
    /// None that a sound kernel gives.
    pub fn set(&self, at: Instant) -> std::io::Result<()> {
        // Zero would switch the timer off.
        let at = (self.clock.begin + at.since(Instant::ZERO)).max(Duration::from_nanos(1));
        let once = Expiration::OneShot(TimeSpec::from_duration(at));
        Ok(self.timer.get_ref().0.set(once, TimerSetTimeFlags::TFD_TIMER_ABSTIME)?)
    }

    /// Waits for it to ring. Dropping the wait loses nothing.
    ///
    /// # Errors
    /// None that a sound kernel gives.
    pub async fn rings(&self) -> std::io::Result<()> {
        loop {
            let mut ready = self.timer.readable().await?;
            match self.timer.get_ref().0.wait() {
                Ok(()) => return Ok(()),
                Err(Errno::EAGAIN) => ready.clear_ready(),
                Err(errno) => return Err(errno.into()),
            }
        }
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
        let (from, to) = (clock.deadline(a), clock.deadline(b));
        let error = (to - from).as_secs_f64() - b.seconds_after(a);
        // Two readings of two clocks; a busy machine may pause between them.
        assert!(error.abs() < 0.2, "{error}");
    }

    #[test]
    fn an_alarm_rings_when_it_was_last_set_to_and_not_before() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let clock = Clock::start();
            let alarm = Alarm::new(&clock).unwrap();
            let soon = clock.now() + Duration::from_millis(5);
            alarm.set(clock.now() + Duration::from_secs(3600)).unwrap();
            alarm.set(soon).unwrap();
            alarm.rings().await.unwrap();
            assert!(clock.now() >= soon);
            let later = clock.now() + Duration::from_millis(20);
            alarm.set(clock.now()).unwrap();
            // It has rung already, but is set anew before anybody hears it.
            tokio::task::yield_now().await;
            alarm.set(later).unwrap();
            alarm.rings().await.unwrap();
            assert!(clock.now() >= later);
            alarm.set(Instant::ZERO).unwrap();
            alarm.rings().await.unwrap();
        });
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
