//! The car's clock seen from the core's.
//!
//! A frame carries the car's clock reading and arrives a little later: by the transmission time at
//! least, by more when the bus or the computer was busy. The difference of the two clocks is
//! therefore the smallest one seen, given up slowly so that it follows clocks that drift apart.

use crate::time::Instant;

/// Clocks drift apart by at most this much (cheap quartz: 100 parts in a million each).
const DRIFT_MAX: f64 = 200e-6;
/// A clock that goes back by more than this, or ahead by more than that, has jumped. Reordering on
/// the bus explains the one up to its limit, nothing explains the other.
const BACK_S: f64 = 1.0;
const AHEAD_S: f64 = 0.2;
/// Frames that seem to be later than this, so many in a row, did not all wait on the bus: the car's
/// clock was set back.
const LATE_S: f64 = 0.05;
const LATE_COUNT: u32 = 5;

/// A moment on the car's clock, on the core's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CarClockReading {
    /// The moment on the core's clock; never later than its arrival.
    pub stamp: Instant,
    /// The car's clock has jumped: its controller was restarted.
    pub jumped: bool,
}

/// Turns the car's clock into the core's.
#[derive(Clone, Debug, Default)]
pub struct ClockMap {
    state: Option<State>,
    excused_until: Instant,
}

#[derive(Clone, Copy, Debug)]
struct State {
    /// Core's clock less the car's, seconds.
    offset_s: f64,
    received: Instant,
    car_us: u64,
    late: u32,
}

impl ClockMap {
    /// A map that knows nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Frames received until then may be late for reasons of ours (this process stood still).
    pub fn excuse(&mut self, until: Instant) {
        self.excused_until = until;
    }

    /// Maps the car's clock reading (microseconds, not wrapped) of a frame that arrived at
    /// `received`.
    pub fn map(&mut self, car_us: u64, received: Instant) -> CarClockReading {
        let car_s = car_us as f64 * 1e-6;
        let sample_s = received.as_secs_f64() - car_s;
        let fresh = State { offset_s: sample_s, received, car_us, late: 0 };
        let mut jumped = false;
        let mut state = match self.state {
            None => fresh,
            Some(old) => {
                let drift_s = DRIFT_MAX * received.seconds_after(old.received).max(0.0);
                let mut state = State { received, car_us: car_us.max(old.car_us), ..old };
                state.offset_s += drift_s;
                let late = sample_s > state.offset_s + LATE_S && received > self.excused_until;
                state.late = if late { old.late + 1 } else { 0 };
                // Back by more than reordering on the bus explains, or ahead all of a sudden.
                let back = old.car_us.saturating_sub(car_us) as f64 * 1e-6 > BACK_S;
                let ahead = sample_s < state.offset_s - AHEAD_S;
                jumped = back || ahead || state.late >= LATE_COUNT;
                if jumped { fresh } else { state }
            }
        };
        state.offset_s = state.offset_s.min(sample_s);
        self.state = Some(state);
        let stamp = Instant::ZERO.offset_by((car_s + state.offset_s).max(0.0)).min(received);
        CarClockReading { stamp, jumped }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Frames every 10 ms with 0.2 ms of transmission and random waiting; the car's clock runs fast
    /// or slow by `drift`.
    fn largest_error(drift: f64, seed: u64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut map = ClockMap::new();
        let mut worst = 0.0_f64;
        for i in 0..20_000 {
            let t = 100.0 + f64::from(i) * 0.01;
            let car_us = ((t - 90.0) * (1.0 + drift) * 1e6) as u64;
            let wait = if rng.random_bool(0.3) { rng.random_range(0.0..0.02) } else { 0.0 };
            let received = Instant::ZERO.offset_by(t + 2e-4 + wait);
            let reading = map.map(car_us, received);
            assert!(!reading.jumped && reading.stamp <= received);
            if i > 100 {
                worst = worst.max((reading.stamp.as_secs_f64() - t).abs());
            }
        }
        worst
    }

    #[test]
    fn waiting_on_the_bus_does_not_shift_the_stamps() {
        for (seed, drift) in [(1, 0.0), (2, 1e-4), (3, -1e-4)] {
            let worst = largest_error(drift, seed);
            assert!(worst < 5e-4, "{drift} {worst}");
        }
    }

    #[test]
    fn a_restarted_controller_is_noticed_at_once_and_stamps_are_right_again() {
        let mut map = ClockMap::new();
        for i in 0..100_u64 {
            map.map(500_000_000 + i * 10_000, Instant::from_nanos(2_000_000_000 + i * 10_000_000));
        }
        let received = Instant::from_nanos(4_000_000_000);
        let reading = map.map(1000, received);
        assert_eq!(reading, CarClockReading { stamp: received, jumped: true });
        assert!(!map.map(11_000, received.offset_by(0.01)).jumped);
    }

    #[test]
    fn a_clock_that_leaps_ahead_is_noticed_too() {
        let mut map = ClockMap::new();
        map.map(1_000_000, Instant::from_nanos(5_000_000_000));
        assert!(map.map(60_000_000, Instant::from_nanos(5_010_000_000)).jumped);
    }

    #[test]
    fn one_late_burst_is_not_a_jump_but_a_lasting_shift_is() {
        let mut map = ClockMap::new();
        let at = |s: f64| Instant::ZERO.offset_by(s);
        map.map(1_000_000, at(2.0));
        assert!(!map.map(1_010_000, at(4.5)).jumped);
        assert!(!map.map(3_510_000, at(4.511)).jumped);
        // A computer whose clock stood still against the car's for 3 s.
        let jumps: Vec<bool> = (0..6_u32)
            .map(|i| {
                map.map(3_520_000 + u64::from(i) * 10_000, at(8.0 + f64::from(i) * 0.01)).jumped
            })
            .collect();
        assert_eq!(jumps, [false, false, false, false, true, false]);
    }
}
