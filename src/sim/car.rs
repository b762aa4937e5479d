//! The simulated car: the paper's friction-circle car, regular at rest.
//!
//! State (x, y, theta, v >= 0); theta' = kappa v, |kappa| <= 1/R_min, a^2 + (kappa v^2)^2 <= A^2
//! (Elhafsi et al. 2020, section V, in the form that keeps the heading at rest). Every step is
//! solved exactly for constant acceleration and curvature, including the moment of coming to rest.

use crate::command::ForceSetpoint;
use crate::frames::Pose;
use crate::scan::Odometry;
use crate::time::Instant;
use crate::tunables;
use crate::vehicle::VehicleParams;

tunables! {
    /// The simulated car's own properties.
    pub struct CarParams in "car" {
        /// Time constant of the steering; 0 turns the wheels at once.
        steering_lag_s: f64 = 0.0, restart, in 0.0..=0.5, "s";
        /// Time constant of drive and brakes; 0 acts at once.
        drive_lag_s: f64 = 0.0, restart, in 0.0..=0.5, "s";
        /// Odometry readings a second.
        odometry_rate_hz: f64 = 100.0, restart, in 10.0..=1000.0, "Hz";
        /// Relative error of the measured distance and speed.
        travel_error: f64 = 0.0, restart, in -0.1..=0.1, "";
        /// Relative error of the measured angle and yaw rate.
        turn_error: f64 = 0.0, restart, in -0.1..=0.1, "";
    }
}

/// Below this speed the car steers by the setpoint's curvature alone.
const STEER_BY_CURVATURE_MPS: f64 = 0.4;
/// Above this speed it steers by the lateral force alone; in between the two are blended linearly,
/// so that nothing jumps at the nominal 0.5 m/s.
const STEER_BY_FORCE_MPS: f64 = 0.6;

/// Wheel odometry as the car's controller measures it, on the controller's own clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometryReading {
    /// The controller's clock, microseconds since it started.
    pub clock_us: u64,
    /// See [`Odometry::travelled_m`].
    pub travelled_m: f64,
    /// See [`Odometry::turned_rad`].
    pub turned_rad: f64,
    /// See [`Odometry::speed_mps`].
    pub speed_mps: f64,
    /// See [`Odometry::yaw_rate_rps`].
    pub yaw_rate_rps: f64,
    /// See [`Odometry::steering_curvature_pm`].
    pub steering_curvature_pm: f64,
}

impl OdometryReading {
    /// The reading as the core uses it, stamped on the core's clock.
    pub fn stamped(&self, stamp: Instant) -> Odometry {
        Odometry {
            stamp,
            travelled_m: self.travelled_m,
            turned_rad: self.turned_rad,
            speed_mps: self.speed_mps,
            yaw_rate_rps: self.yaw_rate_rps,
            steering_curvature_pm: self.steering_curvature_pm,
        }
    }

    /// The reading stamped on the controller's own clock.
    pub fn on_own_clock(&self) -> Odometry {
        self.stamped(Instant::from_nanos(self.clock_us.saturating_mul(1000)))
    }
}

/// The true state of the car.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarState {
    /// True pose, map frame.
    pub pose: Pose,
    /// True speed, m/s, never negative.
    pub speed_mps: f64,
    /// Acceleration along the car during the last step, m/s^2.
    pub accel_mps2: f64,
    /// Curvature driven during the last step, 1/m (less than the steering's while sliding).
    pub curvature_pm: f64,
}

/// The friction-circle car.
#[derive(Clone, Debug)]
pub struct Car {
    mass_kg: f64,
    accel_limit_mps2: f64,
    curvature_limit_pm: f64,
    params: CarParams,
    state: CarState,
    /// Acceleration that drive and brakes produce, m/s^2.
    drive_mps2: f64,
    /// Curvature at which the wheels stand, 1/m.
    steering_pm: f64,
    travelled_m: f64,
    turned_rad: f64,
    slides: u64,
}

impl Car {
    /// A car at rest.
    pub fn new(vehicle: &VehicleParams, params: &CarParams, pose: Pose) -> Self {
        Self {
            mass_kg: vehicle.mass_kg,
            accel_limit_mps2: vehicle.acceleration_limit_mps2(),
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            params: params.clone(),
            state: CarState { pose, speed_mps: 0.0, accel_mps2: 0.0, curvature_pm: 0.0 },
            drive_mps2: 0.0,
            steering_pm: 0.0,
            travelled_m: 0.0,
            turned_rad: 0.0,
            slides: 0,
        }
    }

    /// The same car at another true speed (for trials that begin in motion).
    pub fn with_speed(mut self, speed_mps: f64) -> Self {
        self.state.speed_mps = speed_mps.max(0.0);
        self
    }

    /// The true state.
    pub const fn state(&self) -> &CarState {
        &self.state
    }

    /// True distance travelled, metres.
    pub const fn travelled_m(&self) -> f64 {
        self.travelled_m
    }

    /// Steps during which more force was asked for than the tyres transmit.
    pub const fn slides(&self) -> u64 {
        self.slides
    }

    /// Drives on for `dt_s` (1 ms in simulation) under constant forces. Forces that are not finite
    /// act as zero.
    ///
    /// A request beyond the friction circle makes the tyres slide: both forces are scaled down to
    /// the circle, the car runs wide of where its wheels point, and the step is counted.
    pub fn step(&mut self, dt_s: f64, command: &ForceSetpoint) {
        let finite = |x: f64| if x.is_finite() { x } else { 0.0 };
        let v = self.state.speed_mps;
        let steer =
            self.steering_request(finite(command.lateral_n), finite(command.curvature_pm), v);
        let drive = finite(command.longitudinal_n) / self.mass_kg;
        self.steering_pm = lagged(self.steering_pm, steer, dt_s, self.params.steering_lag_s);
        self.drive_mps2 = lagged(self.drive_mps2, drive, dt_s, self.params.drive_lag_s);

        let lateral = self.steering_pm * v * v;
        let norm = self.drive_mps2.hypot(lateral);
        let mut share = 1.0;
        if norm > self.accel_limit_mps2 {
            share = self.accel_limit_mps2 / norm;
            // Rounding is not a slide.
            if share < 1.0 - 1e-9 {
                self.slides += 1;
            }
        }
        let mut accel = self.drive_mps2 * share;
        if v == 0.0 {
            accel = accel.max(0.0); // brakes hold, they do not reverse
        }
        // The curvature that the tyres bring about; they slide sideways only when moving.
        let curvature = self.steering_pm * share;
        let moving_s = if accel < 0.0 { dt_s.min(v / -accel) } else { dt_s };
        let stops = accel < 0.0 && v / -accel <= dt_s;
        let distance = (v + 0.5 * accel * moving_s) * moving_s;
        let turn = curvature * distance;
        self.state = CarState {
            pose: self.state.pose.along_arc(distance, turn),
            speed_mps: if stops { 0.0 } else { (v + accel * dt_s).max(0.0) },
            accel_mps2: accel,
            curvature_pm: curvature,
        };
        self.travelled_m += distance;
        self.turned_rad += turn;
    }

    /// What the wheel sensors say now; `clock_us` is the controller's clock.
    pub fn odometry(&self, clock_us: u64) -> OdometryReading {
        let (travel, turn) = (1.0 + self.params.travel_error, 1.0 + self.params.turn_error);
        OdometryReading {
            clock_us,
            travelled_m: self.travelled_m * travel,
            turned_rad: self.turned_rad * turn,
            speed_mps: self.state.speed_mps * travel,
            yaw_rate_rps: self.state.curvature_pm * self.state.speed_mps * turn,
            steering_curvature_pm: self.steering_pm,
        }
    }

    fn steering_request(&self, lateral_n: f64, curvature_pm: f64, v: f64) -> f64 {
        let by_force = ((v - STEER_BY_CURVATURE_MPS)
            / (STEER_BY_FORCE_MPS - STEER_BY_CURVATURE_MPS))
            .clamp(0.0, 1.0);
        let limit = self.curvature_limit_pm;
        let mut request = curvature_pm.clamp(-limit, limit) * (1.0 - by_force);
        if by_force > 0.0 {
            request += by_force * (lateral_n / (self.mass_kg * v * v)).clamp(-limit, limit);
        }
        request
    }
}

/// First-order lag, exact for a constant request during the step.
fn lagged(now: f64, request: f64, dt_s: f64, lag_s: f64) -> f64 {
    if lag_s <= 0.0 { request } else { request + (now - request) * (-dt_s / lag_s).exp() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const DT: f64 = 1e-3;

    fn car() -> Car {
        Car::new(&VehicleParams::default(), &CarParams::default(), Pose::new(0.0, 0.0, 0.0))
    }

    fn forces(longitudinal_n: f64, lateral_n: f64, curvature_pm: f64) -> ForceSetpoint {
        ForceSetpoint { longitudinal_n, lateral_n, curvature_pm, drive: true }
    }

    #[test]
    fn full_braking_from_four_metres_a_second_takes_the_textbook_distance() {
        let mut car = car().with_speed(4.0);
        let mut steps = 0;
        while car.state().speed_mps > 0.0 {
            car.step(DT, &forces(-1000.0, 0.0, 0.0));
            steps += 1;
        }
        assert!((car.travelled_m() - 16.0 / (2.0 * 8.829)).abs() < 1e-9);
        assert_eq!(steps, (4.0_f64 / 8.829 / DT).ceil() as i32);
        assert_eq!(car.state().pose.heading_rad, 0.0);
    }

    #[test]
    fn the_lateral_force_turns_the_car_on_its_circle_and_the_curvature_does_so_at_low_speed() {
        for (speed, setpoint) in
            [(4.0, forces(0.0, 2.5 * 16.0 * 0.5, 0.0)), (0.3, forces(0.0, 0.0, 0.5))]
        {
            let mut car = car().with_speed(speed);
            for _ in 0..1000 {
                car.step(DT, &setpoint);
            }
            let exact = Pose::new(0.0, 0.0, 0.0).along_arc(speed, speed * 0.5);
            assert!((car.state().pose.position - exact.position).norm() < 1e-9);
        }
    }

    #[test]
    fn a_car_at_rest_keeps_its_heading_and_never_reverses() {
        let mut car = car();
        for _ in 0..1000 {
            car.step(DT, &forces(-20.0, 20.0, 2.0));
        }
        assert_eq!(car.state().pose, Pose::new(0.0, 0.0, 0.0));
        assert_eq!(car.odometry(0).steering_curvature_pm, 2.0);
    }

    #[test]
    fn too_much_force_slides_and_is_counted() {
        let mut car = car().with_speed(4.0);
        car.step(DT, &forces(-22.0725, 0.0, 0.0));
        assert_eq!(car.slides(), 0);
        car.step(DT, &forces(-22.0725, 22.0725, 0.0));
        assert_eq!(car.slides(), 1);
        assert!((car.state().accel_mps2 + 8.829 / 2f64.sqrt()).abs() < 1e-6);
    }

    #[test]
    fn the_lags_are_first_order() {
        let params = CarParams { drive_lag_s: 0.1, steering_lag_s: 0.05, ..CarParams::default() };
        let mut car = Car::new(&VehicleParams::default(), &params, Pose::new(0.0, 0.0, 0.0));
        for _ in 0..50 {
            car.step(DT, &forces(2.5, 0.0, 1.0));
        }
        let reached = |lag: f64| 1.0 - (-0.05f64 / lag).exp();
        assert!((car.state().accel_mps2 - reached(0.1)).abs() < 1e-9);
        assert!((car.odometry(0).steering_curvature_pm - reached(0.05)).abs() < 1e-9);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn no_forces_whatever_break_the_friction_circle_the_turning_circle_or_the_standstill(
            commands in prop::collection::vec((-60.0..60.0f64, -60.0..60.0f64, -9.0..9.0f64), 40),
            speed in 0.0..8.0f64,
            odd in prop::sample::select(vec![0.0, f64::NAN, f64::INFINITY]),
        ) {
            let mut car = car().with_speed(speed);
            for (a, b, k) in commands {
                for i in 0..20 {
                    let before = *car.state();
                    let travelled = car.travelled_m();
                    car.step(DT, &forces(if i == 7 { odd } else { a }, b, k));
                    let now = car.state();
                    let lateral = now.curvature_pm * before.speed_mps.powi(2);
                    prop_assert!(now.accel_mps2.hypot(lateral) <= 8.829 * (1.0 + 1e-9));
                    prop_assert!(now.curvature_pm.abs() <= 2.0 + 1e-12);
                    prop_assert!(now.speed_mps >= 0.0);
                    prop_assert!(now.speed_mps.is_finite());
                    prop_assert!(car.travelled_m() >= travelled);
                    if before.speed_mps == 0.0 && now.speed_mps == 0.0 {
                        prop_assert_eq!(now.pose.heading_rad, before.pose.heading_rad);
                    }
                }
            }
        }
    }
}
