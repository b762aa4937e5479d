//! Where the car is: wheel odometry from a known start, on the core's clock.
//!
//! Ideal odometry drifts less than 2 cm in 100 m (asserted below), so scans are not matched.

mod clock;

pub use clock::{CarClockReading, ClockMap};

use crate::frames::Pose;
use crate::odometry::{OdometryTrack, Reading};
use crate::scan::Odometry;
use crate::time::Instant;

/// How long poses are remembered, seconds: older scans find no pose and are not used.
pub const MEMORY_S: f64 = 1.0;

/// Dead reckoning in the map frame.
#[derive(Clone, Debug)]
pub struct Localizer {
    start: Pose,
    track: OdometryTrack,
}

impl Localizer {
    /// A car that stands at `start`, map frame.
    pub fn new(start: Pose) -> Self {
        Self { start, track: OdometryTrack::from_pose(start, MEMORY_S) }
    }

    /// Takes up a reading. [`Reading::Restarted`] means that the car may have moved unnoticed: the
    /// pose can no longer be trusted.
    pub fn handle_odometry(&mut self, odometry: &Odometry) -> Reading {
        self.track.push(odometry)
    }

    /// The next reading belongs to other totals (the controller was restarted): goes on from the
    /// last pose, which can no longer be trusted.
    pub fn begin_anew(&mut self) {
        self.track.begin_anew();
    }

    /// Pose at a moment, map frame: interpolated for a scan's stamp, carried on with speed,
    /// acceleration and curvature beyond the newest reading, the start before the first one.
    /// `None` for moments longer ago than [`MEMORY_S`].
    pub fn pose_at(&self, at: Instant) -> Option<Pose> {
        if self.track.newest().is_none() {
            return Some(self.start);
        }
        self.track.pose_at(at)
    }

    /// Speed at a moment from the newest reading on, m/s; zero before the first reading.
    pub fn speed_at(&self, at: Instant) -> f64 {
        self.track.speed_at(at).unwrap_or(0.0)
    }

    /// The newest reading with the pose there: the anchor of braking tails.
    pub fn newest(&self) -> Option<(Odometry, Pose)> {
        self.track.newest()
    }

    /// Seconds since the newest reading; infinite without one.
    pub fn odometry_age_s(&self, now: Instant) -> f64 {
        self.newest().map_or(f64::INFINITY, |(o, _)| now.seconds_after(o.stamp))
    }

    /// Puts the newest pose right (a person who sets the pose, or a scan match).
    pub fn correct(&mut self, pose: Pose) {
        self.start = pose;
        self.track.correct(pose);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::ForceSetpoint;
    use crate::sim::car::{Car, CarParams};
    use crate::vehicle::VehicleParams;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Drives 100 m of random bends at friction-limited speeds and returns the largest position
    /// error, with totals rounded to the given quanta and a share of the readings lost.
    fn drift(seed: u64, quantum_m: f64, quantum_rad: f64, lost: f64, speed_max: f64) -> f64 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let vehicle = VehicleParams::default();
        let start = Pose::new(1.0, -2.0, 0.4);
        let mut car = Car::new(&vehicle, &CarParams::default(), start);
        let mut localizer = Localizer::new(start);
        let round = |x: f64, q: f64| if q > 0.0 { (x / q).round() * q } else { x };
        let (mut ms, mut worst) = (0_u64, 0.0_f64);
        let (mut curvature, mut speed, mut until) = (0.0_f64, 1.0, 0.0);
        while car.travelled_m() < 100.0 {
            if car.travelled_m() >= until {
                curvature = if rng.random_bool(0.5) { 0.0 } else { rng.random_range(-2.0..2.0) };
                speed = (8.0 / f64::abs(curvature).max(1e-3)).sqrt().min(speed_max);
                until += rng.random_range(0.3..2.5);
            }
            // A new setpoint every 10 ms, at another phase than the odometry's readings.
            let v = car.state().speed_mps;
            let k = curvature.clamp(-8.0 / v.max(0.1).powi(2), 8.0 / v.max(0.1).powi(2));
            let setpoint = ForceSetpoint {
                longitudinal_n: 2.5 * (20.0 * (speed - v)).clamp(-8.0, 8.0),
                lateral_n: 2.5 * k * v * v,
                curvature_pm: k,
                drive: true,
            };
            for _ in 0..10 {
                if ms % 10 == 3 && (ms < 10 || !rng.random_bool(lost)) {
                    let reading = car.odometry(ms * 1000);
                    let stamp = Instant::from_nanos(ms * 1_000_000);
                    let mut odometry = reading.stamped(stamp);
                    odometry.travelled_m = round(odometry.travelled_m, quantum_m);
                    odometry.turned_rad = round(odometry.turned_rad, quantum_rad);
                    localizer.handle_odometry(&odometry);
                    let found = localizer.pose_at(stamp).unwrap();
                    worst = worst.max((found.position - car.state().pose.position).norm());
                }
                car.step(1e-3, &setpoint);
                ms += 1;
            }
        }
        worst
    }

    #[test]
    fn ideal_odometry_drifts_less_than_two_centimetres_in_a_hundred_metres() {
        let mut worst = 0.0_f64;
        for seed in 0..8 {
            for speed in [4.0, 8.0] {
                worst = worst.max(drift(seed, 1e-5, 1e-6, 0.0, speed));
            }
        }
        eprintln!("drift in 100 m: {worst:.5} m");
        assert!(worst < 0.02, "{worst}");
    }

    #[test]
    fn one_lost_reading_in_ten_does_not_matter() {
        let worst = (0..8).map(|seed| drift(seed, 1e-5, 1e-6, 0.1, 4.0)).fold(0.0, f64::max);
        eprintln!("drift in 100 m with losses: {worst:.5} m");
        assert!(worst < 0.02, "{worst}");
    }

    #[test]
    fn coarse_quanta_show() {
        for (qm, qr) in [(0.0, 0.0), (1e-5, 1e-6), (1e-4, 1e-5), (1e-4, 1e-4), (1e-3, 1e-3)] {
            let worst = (0..4).map(|seed| drift(seed, qm, qr, 0.0, 4.0)).fold(0.0, f64::max);
            eprintln!("quanta {qm} m, {qr} rad: {worst:.5} m");
        }
        // Rounding that does not matter in the totals would matter if it were summed up.
        let fine = drift(1, 1e-5, 1e-6, 0.0, 4.0);
        assert!(drift(1, 1e-2, 2e-2, 0.0, 4.0) > 2.0 * fine);
    }

    #[test]
    fn before_the_first_reading_the_car_stands_at_its_start() {
        let start = Pose::new(3.0, 4.0, 1.0);
        let localizer = Localizer::new(start);
        assert_eq!(localizer.pose_at(Instant::from_nanos(77)), Some(start));
        assert_eq!(localizer.speed_at(Instant::ZERO), 0.0);
        assert_eq!(localizer.odometry_age_s(Instant::ZERO), f64::INFINITY);
    }
}
