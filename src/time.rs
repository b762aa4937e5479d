//! The core's own clock reading.
//!
//! Nothing below `shell` may ask an operating system for the time: an [`Instant`] comes in with
//! every input, so a drive can be replayed. The origin is arbitrary (start of the daemon, start of
//! the simulation) and never compared across processes.

use std::fmt;
use std::ops::{Add, AddAssign, Sub};

pub use std::time::Duration;

/// A moment on the clock that is handed to the core, in nanoseconds since its arbitrary origin.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Instant(u64);

impl Instant {
    /// The clock's origin.
    pub const ZERO: Self = Self(0);

    /// The moment `nanos` nanoseconds after the origin.
    pub const fn from_nanos(nanos: u64) -> Self {
        Self(nanos)
    }

    /// Nanoseconds since the origin.
    pub const fn as_nanos(self) -> u64 {
        self.0
    }

    /// Seconds since the origin (exact to 1 microsecond for 285 years).
    pub fn as_secs_f64(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Time since `earlier`; zero if `earlier` is later.
    pub fn since(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }

    /// Seconds from `other` to `self`, negative if `other` is later.
    pub fn seconds_after(self, other: Self) -> f64 {
        (self.0 as i128 - other.0 as i128) as f64 * 1e-9
    }

    /// The moment `seconds` later (earlier if negative), stopping at the ends of the clock.
    pub fn offset_by(self, seconds: f64) -> Self {
        let nanos = (seconds.abs() * 1e9).round() as u64;
        if seconds >= 0.0 {
            Self(self.0.saturating_add(nanos))
        } else {
            Self(self.0.saturating_sub(nanos))
        }
    }
}

impl Add<Duration> for Instant {
    type Output = Self;
    fn add(self, rhs: Duration) -> Self {
        Self(self.0.saturating_add(u64::try_from(rhs.as_nanos()).unwrap_or(u64::MAX)))
    }
}

impl AddAssign<Duration> for Instant {
    fn add_assign(&mut self, rhs: Duration) {
        *self = *self + rhs;
    }
}

impl Sub<Duration> for Instant {
    type Output = Self;
    fn sub(self, rhs: Duration) -> Self {
        Self(self.0.saturating_sub(u64::try_from(rhs.as_nanos()).unwrap_or(u64::MAX)))
    }
}

impl fmt::Display for Instant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} s", self.as_secs_f64())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_are_the_inverse_of_differences() {
        let t = Instant::from_nanos(5_000_000_000);
        assert_eq!(t.offset_by(-1.25).seconds_after(t), -1.25);
        assert_eq!(t.offset_by(0.5).since(t), Duration::from_millis(500));
        assert_eq!(t.since(t.offset_by(1.0)), Duration::ZERO);
    }

    #[test]
    fn the_clock_stops_at_its_ends() {
        assert_eq!(Instant::ZERO.offset_by(-1.0), Instant::ZERO);
        assert_eq!(
            Instant::from_nanos(u64::MAX) + Duration::from_secs(1),
            Instant::from_nanos(u64::MAX)
        );
    }
}
