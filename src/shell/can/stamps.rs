//! From the kernel's receive stamps, which are on the wall clock, to the monotonic clock.

use crate::time::{Duration, Instant};

/// No frame waits longer to be read by a process that is alive; older stamps are those of a jump.
const AGE_MAX: Duration = Duration::from_millis(200);
/// A change of the difference of the clocks that slewing cannot explain from one reading to the
/// next.
const JUMP: Duration = Duration::from_millis(1);

/// What the wall clock is ahead of the monotonic one, nanoseconds.
type Ahead = i128;

/// Follows the difference between the two clocks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Stamps {
    ahead: Option<Ahead>,
    /// The difference before the newest jump, as long as frames from before it may come.
    before: Option<(Ahead, Instant)>,
}

impl Stamps {
    /// Both clocks were read together.
    pub fn read(&mut self, now: Instant, wall: Duration) {
        let ahead = wall.as_nanos() as Ahead - Ahead::from(now.as_nanos());
        if let Some(old) = self.ahead
            && (ahead - old).unsigned_abs() > JUMP.as_nanos()
        {
            self.before = Some((old, now + AGE_MAX));
        }
        self.before = self.before.filter(|(_, until)| now <= *until);
        self.ahead = Some(ahead);
    }

    /// When a frame with that stamp came; `now` is the newest reading.
    ///
    /// After a jump the stamp may be from either side of it. The younger of the two ages that are
    /// possible at all is taken: it is wrong by no more than the frame's true age.
    pub fn at(&self, now: Instant, stamp: Duration) -> Instant {
        let stamp = stamp.as_nanos() as Ahead;
        let ages = [self.ahead, self.before.map(|(ahead, _)| ahead)].map(|ahead| {
            let age = Ahead::from(now.as_nanos()) - (stamp - ahead?);
            // A stamp in the future by less than a jump is that of an imprecise reading.
            let age = if age < 0 && age.unsigned_abs() <= JUMP.as_nanos() { 0 } else { age };
            u64::try_from(age).ok().filter(|age| u128::from(*age) <= AGE_MAX.as_nanos())
        });
        let age = ages.into_iter().flatten().min().unwrap_or_else(|| self.impossible(now, stamp));
        now - Duration::from_nanos(age)
    }

    /// The age to assume for a stamp that lies outside of what is possible: the nearest that is.
    fn impossible(&self, now: Instant, stamp: Ahead) -> u64 {
        let age = self.ahead.map_or(0, |ahead| Ahead::from(now.as_nanos()) - (stamp - ahead));
        // Without a jump a process was held up for long; with one nothing is known.
        if age > 0 && self.before.is_none() { AGE_MAX.as_nanos() as u64 } else { 0 }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const WALL: Duration = Duration::from_secs(1_700_000_000);

    fn at(micros: u64) -> Instant {
        Instant::from_nanos(micros * 1000)
    }

    fn us(micros: u64) -> Duration {
        Duration::from_micros(micros)
    }

    #[test]
    fn a_stamp_is_as_old_as_the_wall_clock_says() {
        let mut stamps = Stamps::default();
        stamps.read(at(5_000_000), WALL);
        assert_eq!(stamps.at(at(5_000_000), WALL - us(1_500)), at(4_998_500));
        assert_eq!(stamps.at(at(5_000_000), WALL), at(5_000_000));
    }

    #[test]
    fn impossible_ages_are_cut_off() {
        let mut stamps = Stamps::default();
        stamps.read(at(5_000_000), WALL);
        assert_eq!(stamps.at(at(5_000_000), WALL + us(700)), at(5_000_000));
        assert_eq!(stamps.at(at(5_000_000), WALL + us(9_000_000)), at(5_000_000));
        assert_eq!(stamps.at(at(5_000_000), WALL - us(900_000)), at(4_800_000));
        assert_eq!(Stamps::default().at(at(5), WALL), at(5), "before any reading");
    }

    #[test]
    fn a_slewed_wall_clock_is_followed() {
        let mut stamps = Stamps::default();
        // 500 ppm fast for an hour: 1.8 s in all.
        for second in 0..3600 {
            let wall = WALL + us(second * 1_000_500);
            stamps.read(at(second * 1_000_000), wall);
            let came = stamps.at(at(second * 1_000_000), wall.saturating_sub(us(100)));
            assert!(second == 0 || came == at(second * 1_000_000 - 100), "{second}: {came:?}");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(256))]

        /// Frames every millisecond, read some milliseconds later; the wall clock jumps in the
        /// middle, forward or back, by anything from 2 ms to years.
        #[test]
        fn a_jump_of_the_wall_clock_moves_no_frame_by_more_than_its_own_age(
            magnitude in 2_000.0f64..1e14, power in 0.0f64..1.0, forward: bool, delay in 0u64..20_000,
        ) {
            let jump = us(magnitude.powf(power).max(2_000.0) as u64);
            let wall_at = |micros: u64| {
                let true_wall = WALL * 2 + us(micros);
                match (micros < 500_000, forward) {
                    (true, _) => true_wall,
                    (false, true) => true_wall + jump,
                    (false, false) => true_wall.saturating_sub(jump),
                }
            };
            let mut stamps = Stamps::default();
            for frame in 1..1_000u64 {
                let (came, read) = (frame * 1_000, frame * 1_000 + delay);
                stamps.read(at(read), wall_at(read));
                let mapped = stamps.at(at(read), wall_at(came));
                prop_assert!(mapped <= at(read), "later than it was read");
                let error = mapped.seconds_after(at(came)).abs();
                // Once the jump is over by 0.2 s, and before it, nothing is left of it.
                let settled = read < 500_000 || came >= 500_000 && read > 720_000;
                let allowed = if settled { 1e-9 } else { delay as f64 * 1e-6 + 1e-9 };
                prop_assert!(error <= allowed, "{came} read at {read}: {error}");
            }
        }
    }
}
