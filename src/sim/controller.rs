//! The controller on board the car: it obeys fresh setpoints and otherwise stops along the newest
//! braking tail.
//!
//! | age of the newest setpoint | steering | along the car |
//! |---|---|---|
//! | up to 25 ms | as set | as set, but no faster than the tail allows (and 0.05 m/s) |
//! | up to 100 ms | along the tail | as set, but no faster than the tail allows |
//! | more: lost, latched until a setpoint with `drive == false` | along the tail | full braking |
//!
//! The tail's speed binds fresh setpoints too: a plan that brakes from the top of its speed profile
//! with all the grip there is cannot be met any more by a car that went on accelerating for the
//! 25 ms of silence (15 cm beyond the stop were measured), and a car that gets setpoints but no
//! tails would outrun its last one.
//!
//! Emergency stop and `drive == false` brake like a lost link. Without a usable tail the car brakes
//! straight. The tail is followed with feedback on the lateral and heading error, dead-reckoned
//! from the car's own odometry.

use super::car::OdometryReading;
use crate::command::{BrakingTail, CarStatus, ForceSetpoint};
use crate::odometry::OdometryTrack;
use crate::tail::{TailCurve, TailError, TailPosition, bend_share};
use crate::time::Instant;
use crate::tunables;
use crate::vehicle::VehicleParams;

tunables! {
    /// The car's own controller, as simulated.
    pub struct ControllerParams in "controller" {
        /// A setpoint older than this no longer steers the car; the tail does.
        setpoint_fresh_s: f64 = 0.025, restart, in 0.005..=0.5, "s";
        /// A setpoint older than this is lost: the car stops along the tail.
        setpoint_lost_s: f64 = 0.1, restart, in 0.01..=1.0, "s";
        /// A tail further from the car than this is not followed.
        tail_offset_max_m: f64 = 0.15, restart, in 0.02..=1.0, "m";
        /// Battery voltage reported.
        battery_v: f64 = 11.1, restart, in 0.0..=100.0, "V";
    }
}

/// How long the controller remembers where it was, to find the anchor of a tail.
const MEMORY_S: f64 = 1.0;
/// Time over which the car settles back onto the tail; short against a stop, long against the
/// controller's period of 1 ms.
const SETTLE_S: f64 = 0.06;
/// Shortest distance over which the car settles back onto the tail, metres.
const SETTLE_MIN_M: f64 = 0.12;
/// Speed above the tail's that a fresh setpoint may use: what the steps of 10 ms at a sudden change
/// of acceleration amount to. Braking has reserve enough to take it back.
const FRESH_TOLERANCE_MPS: f64 = 0.05;
/// Gain from excess speed to deceleration, 1/s.
const SPEED_GAIN_PS: f64 = 20.0;
/// A tail that points elsewhere by more than this is not followed, radians.
const HEADING_ERROR_MAX_RAD: f64 = 0.6;
/// Share of the tyres' grip that the controller uses, so that rounding does not make them slide.
const GRIP_SHARE: f64 = 0.999;

/// The car's controller.
#[derive(Clone, Debug)]
pub struct Controller {
    params: ControllerParams,
    mass_kg: f64,
    accel_limit_mps2: f64,
    curvature_limit_pm: f64,
    track: OdometryTrack,
    setpoint: Option<(Instant, ForceSetpoint)>,
    tail: Option<TailCurve>,
    tail_s_m: f64,
    /// The curvature kept while standing.
    steering_pm: f64,
    emergency_stop: bool,
    lost: bool,
    loss_toggle: bool,
    tail_usable: bool,
    tails_refused: u64,
}

impl Controller {
    /// A controller that has heard nothing yet: it holds the car.
    pub fn new(vehicle: &VehicleParams, params: &ControllerParams) -> Self {
        Self {
            params: params.clone(),
            mass_kg: vehicle.mass_kg,
            accel_limit_mps2: vehicle.acceleration_limit_mps2() * GRIP_SHARE,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            track: OdometryTrack::in_own_frame(MEMORY_S),
            setpoint: None,
            tail: None,
            tail_s_m: 0.0,
            steering_pm: 0.0,
            emergency_stop: false,
            lost: false,
            loss_toggle: false,
            tail_usable: false,
            tails_refused: 0,
        }
    }

    /// A setpoint has arrived at `now` on the controller's clock. One that is not finite is ignored.
    pub fn handle_setpoint(&mut self, now: Instant, setpoint: ForceSetpoint) {
        let values = [setpoint.longitudinal_n, setpoint.lateral_n, setpoint.curvature_pm];
        if values.iter().any(|v| !v.is_finite()) {
            return;
        }
        if !setpoint.drive {
            self.lost = false;
        }
        self.setpoint = Some((now, setpoint));
    }

    /// A complete braking tail has arrived; one that makes no sense is refused and the old one kept.
    pub fn handle_tail(&mut self, tail: &BrakingTail) -> Result<(), TailError> {
        match TailCurve::anchored(tail, &self.track) {
            Ok(curve) => {
                self.tail = Some(curve);
                self.tail_s_m = 0.0;
                Ok(())
            }
            Err(error) => {
                self.tails_refused += 1;
                Err(error)
            }
        }
    }

    /// The emergency-stop button, pressed or released.
    pub fn set_emergency_stop(&mut self, pressed: bool) {
        self.emergency_stop = pressed;
    }

    /// The battery voltage reported from now on, volts.
    pub fn set_battery_v(&mut self, battery_v: f64) {
        self.params.battery_v = battery_v;
    }

    /// Tails that were refused.
    pub const fn tails_refused(&self) -> u64 {
        self.tails_refused
    }

    /// One controller period (1 ms): what the car is made to do. `own` is its own odometry at
    /// `now`, both on its own clock.
    pub fn step(&mut self, now: Instant, own: &OdometryReading) -> ForceSetpoint {
        self.track.push(&own.stamped(now));
        let speed = own.speed_mps;
        let place = self.place_on_tail();
        self.tail_usable = place.is_some();

        let age_s = self.setpoint.map_or(f64::INFINITY, |(at, _)| now.seconds_after(at));
        let drive = self.setpoint.map(|(_, s)| s).filter(|s| s.drive);
        if drive.is_some() && age_s > self.params.setpoint_lost_s && !self.lost {
            self.lost = true;
            self.loss_toggle = !self.loss_toggle;
        }
        let out = match drive {
            Some(setpoint) if !self.lost && !self.emergency_stop => {
                if age_s <= self.params.setpoint_fresh_s {
                    self.obey(setpoint, place, speed)
                } else {
                    self.hold(&setpoint, place, speed)
                }
            }
            _ => self.brake(place, speed),
        };
        self.steering_pm = out.curvature_pm;
        out
    }

    /// What the controller says about itself at `now`.
    pub fn status(&self, now: Instant) -> CarStatus {
        CarStatus {
            emergency_stop: self.emergency_stop,
            setpoint_lost: self.lost,
            loss_toggle: self.loss_toggle,
            tail_plan: self.tail.as_ref().filter(|_| self.tail_usable).map(TailCurve::plan),
            battery_v: self.params.battery_v,
            setpoint_age_s: self.setpoint.map_or(f64::INFINITY, |(at, _)| now.seconds_after(at)),
        }
    }

    /// Where the car is on its tail, if that tail is here at all.
    fn place_on_tail(&mut self) -> Option<TailPosition> {
        let (_, pose) = self.track.newest()?;
        let curve = self.tail.as_ref()?;
        let place = curve.locate_car(pose, self.tail_s_m);
        self.tail_s_m = place.s_m;
        let reach = self.params.tail_offset_max_m;
        (place.offset_m.abs() <= reach
            && place.beyond_m <= reach
            && place.heading_error_rad.abs() <= HEADING_ERROR_MAX_RAD)
            .then_some(place)
    }

    /// Curvature along the tail, straight on without one, as it stands when at rest.
    fn steer(&self, place: Option<TailPosition>, speed: f64) -> f64 {
        if speed == 0.0 {
            return self.steering_pm;
        }
        let (Some(place), Some(curve)) = (place, self.tail.as_ref()) else { return 0.0 };
        let settle = (SETTLE_S * speed).max(SETTLE_MIN_M);
        let limit = self.curvature_limit_pm;
        let curvature = curve.steer(&place, 0.0005 * speed, settle).clamp(-limit, limit);
        let v2 = speed * speed;
        if curvature.abs() * v2 <= self.accel_limit_mps2 {
            return curvature;
        }
        bend_share(curvature * v2, self.accel_limit_mps2) / v2
    }

    fn obey(
        &self,
        setpoint: ForceSetpoint,
        place: Option<TailPosition>,
        speed: f64,
    ) -> ForceSetpoint {
        let Some(on_tail) = place else { return setpoint };
        let limit = self.mass_kg * envelope(&on_tail, speed - FRESH_TOLERANCE_MPS);
        if setpoint.longitudinal_n <= limit {
            return setpoint;
        }
        let grip = self.mass_kg * self.accel_limit_mps2;
        let room = (grip * grip - setpoint.lateral_n.powi(2)).max(0.0).sqrt();
        ForceSetpoint { longitudinal_n: limit.max(-room), ..setpoint }
    }

    fn hold(
        &self,
        setpoint: &ForceSetpoint,
        place: Option<TailPosition>,
        speed: f64,
    ) -> ForceSetpoint {
        let Some(on_tail) = place else { return self.brake(None, speed) };
        let curvature = self.steer(place, speed);
        let envelope = envelope(&on_tail, speed);
        let grip = self.grip_along(curvature, speed);
        let wished = setpoint.longitudinal_n / self.mass_kg;
        self.forces(wished.min(envelope).clamp(-grip, grip), curvature, speed)
    }

    fn brake(&self, place: Option<TailPosition>, speed: f64) -> ForceSetpoint {
        let curvature = self.steer(place, speed);
        if speed == 0.0 {
            return self.forces(0.0, curvature, speed);
        }
        self.forces(-self.grip_along(curvature, speed), curvature, speed)
    }

    /// What the bend leaves of the tyres' grip, m/s^2.
    fn grip_along(&self, curvature: f64, speed: f64) -> f64 {
        let lateral = curvature * speed * speed;
        (self.accel_limit_mps2.powi(2) - lateral * lateral).max(0.0).sqrt()
    }

    fn forces(&self, accel: f64, curvature: f64, speed: f64) -> ForceSetpoint {
        ForceSetpoint {
            longitudinal_n: self.mass_kg * accel,
            lateral_n: self.mass_kg * curvature * speed * speed,
            curvature_pm: curvature,
            drive: true,
        }
    }
}

/// The acceleration that keeps to the tail's speed, or leads back to it, m/s^2.
fn envelope(on_tail: &TailPosition, speed: f64) -> f64 {
    on_tail.accel_mps2 + SPEED_GAIN_PS * (on_tail.speed_mps - speed)
}

#[cfg(test)]
mod tests {
    use super::super::car::{Car, CarParams};
    use super::*;
    use crate::command::TailSample;
    use crate::frames::Pose;

    /// A car with its controller, stepped together at 1 ms.
    struct Bench {
        car: Car,
        controller: Controller,
        ms: u64,
    }

    impl Bench {
        fn new(speed: f64) -> Self {
            let vehicle = VehicleParams::default();
            let car = Car::new(&vehicle, &CarParams::default(), Pose::new(0.0, 0.0, 0.0));
            let controller = Controller::new(&vehicle, &ControllerParams::default());
            let mut bench = Self { car: car.with_speed(speed), controller, ms: 0 };
            // The first period only starts the odometry.
            bench.controller.step(bench.now(), &bench.car.odometry(0));
            bench
        }

        fn now(&self) -> Instant {
            Instant::from_nanos(self.ms * 1_000_000)
        }

        fn run(&mut self, ms: u64) {
            for _ in 0..ms {
                let reading = self.car.odometry(self.ms * 1000);
                let out = self.controller.step(self.now(), &reading);
                self.car.step(1e-3, &out);
                self.ms += 1;
            }
        }

        fn set(&mut self, longitudinal_n: f64, drive: bool) {
            let setpoint =
                ForceSetpoint { longitudinal_n, lateral_n: 0.0, curvature_pm: 0.0, drive };
            self.set_forces(setpoint);
        }

        fn set_forces(&mut self, setpoint: ForceSetpoint) {
            self.controller.handle_setpoint(self.now(), setpoint);
        }
    }

    /// A left bend of 2 m radius with braking at 6 m/s^2 at the end.
    fn bend(offset_m: f64) -> BrakingTail {
        let n = 21;
        let samples = (0..n)
            .map(|i| TailSample {
                curvature_pm: 0.5,
                speed_mps: (12.0 * 0.1 * f64::from(n - 1 - i)).sqrt().min(3.5),
            })
            .collect();
        BrakingTail {
            plan: 7,
            anchor_travelled_m: 0.0,
            anchor_turned_rad: 0.0,
            anchor_offset_m: offset_m,
            spacing_m: 0.1,
            samples,
        }
    }

    fn distance_from_bend(pose: Pose, offset_m: f64) -> f64 {
        let centre = crate::frames::Point::new(0.0, 2.0 - offset_m);
        ((pose.position - centre).norm() - 2.0).abs()
    }

    #[test]
    fn a_fresh_setpoint_is_obeyed_and_silence_ends_at_rest_on_the_tail() {
        let mut bench = Bench::new(3.4);
        bench.controller.handle_tail(&bend(0.0)).unwrap();
        bench.set(5.0, true);
        bench.run(20);
        assert!(bench.car.state().accel_mps2 == 2.0 && bench.car.state().curvature_pm == 0.0);
        bench.run(2000);
        assert_eq!(bench.car.state().speed_mps, 0.0);
        assert!(bench.controller.status(bench.now()).setpoint_lost);
        assert!(bench.car.travelled_m() < 2.0, "{}", bench.car.travelled_m());
        let off = distance_from_bend(bench.car.state().pose, 0.0);
        assert!(off < 2e-3, "{off}");
        assert_eq!(bench.car.slides(), 0);
    }

    #[test]
    fn no_force_beats_the_tails_speed() {
        let mut bench = Bench::new(3.4);
        bench.controller.handle_tail(&bend(0.0)).unwrap();
        for _ in 0..200 {
            let lateral_n = 2.5 * 0.5 * bench.car.state().speed_mps.powi(2);
            bench.set_forces(ForceSetpoint {
                longitudinal_n: 15.0,
                lateral_n,
                curvature_pm: 0.5,
                drive: true,
            });
            // 90 ms of silence between setpoints: never lost, mostly on the tail
            for _ in 0..90 {
                bench.run(1);
                let s = bench.car.travelled_m();
                let limit = (12.0 * (2.0 - s)).max(0.0).sqrt().min(3.5);
                let speed = bench.car.state().speed_mps;
                assert!(speed <= limit + 0.1, "{s}: {speed} {limit}");
            }
            if bench.car.travelled_m() > 1.9 {
                break;
            }
        }
        assert!(!bench.controller.status(bench.now()).setpoint_lost);
    }

    #[test]
    fn the_car_steers_back_onto_a_tail_that_starts_beside_it() {
        let mut bench = Bench::new(2.0);
        bench.controller.handle_tail(&bend(0.03)).unwrap();
        bench.set(0.0, false);
        bench.run(2000);
        assert_eq!(bench.car.state().speed_mps, 0.0);
        let off = distance_from_bend(bench.car.state().pose, 0.03);
        assert!(off < 0.02, "{off}");
    }

    #[test]
    fn a_car_too_fast_for_its_tail_brakes_in_the_bend_that_tightens() {
        // From 0.8 to 2 1/m within 1.5 m, at what the tyres hold; the car is 0.24 m/s faster.
        let curvature = |i: u32| 0.8 + 1.2 * (f64::from(i) / 15.0).min(1.0);
        let samples = (0..31).map(|i| TailSample {
            curvature_pm: curvature(i),
            speed_mps: (8.0 / curvature(i)).min(8.0 * 0.1 * f64::from(30 - i)).sqrt(),
        });
        let tail = BrakingTail { samples: samples.collect(), ..bend(0.0) };
        let curve = TailCurve::laid_out(&tail, Pose::new(0.0, 0.0, 0.0)).unwrap();
        let mut bench = Bench::new(3.4);
        bench.controller.handle_tail(&tail).unwrap();
        bench.set(0.0, false);
        let (mut off_m, mut s_m) = (0.0_f64, 0.0);
        for _ in 0..1500 {
            bench.run(1);
            let place = curve.locate_car(bench.car.state().pose, s_m);
            (off_m, s_m) = (off_m.max(place.offset_m.abs()), place.s_m);
        }
        assert_eq!(bench.car.state().speed_mps, 0.0);
        assert!(off_m < 0.06, "{off_m}");
        assert_eq!(bench.car.slides(), 0);
    }

    #[test]
    fn lost_is_latched_until_the_daemon_lets_go() {
        let mut bench = Bench::new(1.0);
        bench.set(0.0, true);
        bench.run(150);
        assert!(bench.controller.status(bench.now()).setpoint_lost);
        bench.set(10.0, true);
        bench.run(100);
        assert_eq!(bench.car.state().speed_mps, 0.0);
        bench.set(0.0, false);
        bench.run(1);
        assert!(!bench.controller.status(bench.now()).setpoint_lost);
        bench.set(10.0, true);
        bench.run(10);
        assert!(bench.car.state().speed_mps > 0.0);
    }

    #[test]
    fn without_a_tail_the_car_brakes_straight_and_the_button_stops_it_at_once() {
        let mut bench = Bench::new(4.0);
        bench.controller.set_emergency_stop(true);
        for _ in 0..100 {
            bench.set(10.0, true);
            bench.run(10);
        }
        assert_eq!(bench.car.state().speed_mps, 0.0);
        assert!((bench.car.travelled_m() - 0.906 / GRIP_SHARE).abs() < 2e-3);
        assert_eq!(bench.car.state().pose.heading_rad, 0.0);
        let status = bench.controller.status(bench.now());
        assert!(status.emergency_stop && !status.setpoint_lost && status.tail_plan.is_none());
    }

    #[test]
    fn only_a_tail_that_is_here_counts() {
        let mut bench = Bench::new(0.0);
        bench.controller.handle_tail(&bend(0.0)).unwrap();
        bench.run(1);
        assert_eq!(bench.controller.status(bench.now()).tail_plan, Some(7));
        bench.controller.handle_tail(&bend(0.4)).unwrap();
        bench.run(1);
        assert_eq!(bench.controller.status(bench.now()).tail_plan, None);
        let broken = BrakingTail { samples: vec![], ..bend(0.0) };
        assert_eq!(bench.controller.handle_tail(&broken), Err(TailError::Empty));
        assert_eq!(bench.controller.tails_refused(), 1);
    }

    #[test]
    fn setpoints_that_are_not_numbers_are_ignored() {
        let mut bench = Bench::new(1.0);
        bench.set(f64::NAN, true);
        assert_eq!(bench.controller.status(bench.now()).setpoint_age_s, f64::INFINITY);
        bench.run(1000);
        assert_eq!(bench.car.state().speed_mps, 0.0);
    }
}
