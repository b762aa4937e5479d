//! The car as the planner and the guard know it: mass, tyres, turning circle, size.

use crate::tunables;
use crate::units::GRAVITY_MPS2;

tunables! {
    /// The friction-circle car of the paper (Elhafsi et al. 2020, section V).
    pub struct VehicleParams in "vehicle" {
        /// Mass.
        mass_kg: f64 = 2.5, restart, in 0.1..=50.0, "kg";
        /// Friction coefficient between tyres and floor.
        friction: f64 = 0.9, at_rest, in 0.05..=2.0, "";
        /// Radius of the tightest turn.
        turn_radius_m: f64 = 0.5, at_rest, in 0.1..=5.0, "m";
        /// Radius of the disc that holds the whole car.
        radius_m: f64 = 0.20, at_rest, in 0.02..=2.0, "m";
        /// Distance between front and rear axle (odometry and steering frames only).
        wheelbase_m: f64 = 0.26, restart, in 0.05..=2.0, "m";
        /// Distance between left and right wheel (odometry frames only).
        track_m: f64 = 0.20, restart, in 0.05..=2.0, "m";
    }
}

impl VehicleParams {
    /// The largest acceleration that the tyres transmit, `mu * g`, in m/s^2.
    pub fn acceleration_limit_mps2(&self) -> f64 {
        self.friction * GRAVITY_MPS2
    }

    /// The largest curvature that the steering reaches, 1/m.
    pub fn curvature_limit_pm(&self) -> f64 {
        1.0 / self.turn_radius_m
    }
}
