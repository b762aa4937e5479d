//! What the daemon tells the car's controller.
//!
//! The controller holds the newest setpoint for a short while and otherwise follows the newest
//! braking tail, so that a computer that dies still leaves a car that stops inside known free
//! space.

/// Forces wished for, at one moment.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct ForceSetpoint {
    /// Force along the car, newtons, positive forward. Braking never turns into reversing.
    pub longitudinal_n: f64,
    /// Force to the left, newtons.
    pub lateral_n: f64,
    /// Curvature of the path at this point, 1/m, positive to the left: below 0.5 m/s the car steers
    /// by it, since a lateral force says nothing about the wheels of a car at rest.
    pub curvature_pm: f64,
    /// Whether the daemon wants the car to move at all. When false the controller brakes along the
    /// newest tail and then holds the car at rest.
    pub drive: bool,
}

/// How to come to rest from here on without any further word: the newest committed plan, cut to the
/// stretch that a stop needs.
///
/// Its place is given in the car's own odometry, which both sides know exactly: when the controller
/// stood at `travelled_m == anchor_travelled_m`, the car was abreast of the first sample,
/// `anchor_offset_m` to the left of it, and the path's direction there is
/// `turned_rad == anchor_turned_rad` (see [`Odometry`](crate::scan::Odometry)). The controller
/// remembers where it was at the anchor, lays the curve out from there
/// ([`TailCurve`](crate::tail::TailCurve)) and steers back onto it.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct BrakingTail {
    /// Number of the committed plan it belongs to, wrapping.
    pub plan: u16,
    /// The controller's travelled distance where the tail begins, metres.
    pub anchor_travelled_m: f64,
    /// The controller's turned angle along the path's direction where the tail begins, radians.
    pub anchor_turned_rad: f64,
    /// How far the car was to the left of the path at the anchor, metres.
    pub anchor_offset_m: f64,
    /// Distance between samples, metres.
    pub spacing_m: f64,
    /// Samples from the anchor on; the last one has speed zero.
    pub samples: Vec<TailSample>,
}

/// One sample of a [`BrakingTail`]. Curvature and squared speed run linearly to the next one (a
/// constant deceleration).
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct TailSample {
    /// Curvature of the path, 1/m, positive to the left.
    pub curvature_pm: f64,
    /// Highest speed from which the rest of the tail still ends at rest at its last sample, m/s.
    pub speed_mps: f64,
}

/// What the car's controller says about itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarStatus {
    /// The emergency-stop button is pressed (or its wire is cut).
    pub emergency_stop: bool,
    /// Setpoints stopped coming while driving; latched until a setpoint with `drive == false`.
    pub setpoint_lost: bool,
    /// Changes whenever setpoints are lost: a loss shows even if the latch was cleared before
    /// anybody saw it set.
    pub loss_toggle: bool,
    /// Whether the controller holds a complete braking tail, and of which plan.
    pub tail_plan: Option<u16>,
    /// Battery voltage, volts.
    pub battery_v: f64,
    /// Age of the newest valid setpoint, seconds.
    pub setpoint_age_s: f64,
}
