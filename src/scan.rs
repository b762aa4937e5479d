//! What the car's sensors say, after decoding and before interpretation.

use crate::time::Instant;

/// One turn of the lidar, all beams measured at one moment.
///
/// A range is metres from the lidar (which sits at the body origin) to the first surface. A value
/// of at least `range_max_m` means that nothing was seen up to `range_max_m`; NaN means that the
/// beam says nothing at all and neither frees nor occupies space.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    /// When it was measured, on the clock of the computer that runs the core.
    pub stamp: Instant,
    /// Counts scans, wrapping.
    pub sequence: u16,
    /// Direction of beam 0 in the body frame, radians.
    pub angle_first_rad: f64,
    /// Angle from one beam to the next, radians, positive counter-clockwise.
    pub angle_step_rad: f64,
    /// The lidar's range, metres.
    pub range_max_m: f64,
    /// One range a beam, metres.
    pub ranges_m: Vec<f32>,
}

impl Scan {
    /// Direction of beam `index` in the body frame, radians.
    pub fn angle_rad(&self, index: usize) -> f64 {
        self.angle_first_rad + self.angle_step_rad * index as f64
    }

    /// Whether the beams close a full circle (the last beam is the first one's neighbour).
    pub fn is_full_circle(&self) -> bool {
        let swept = self.angle_step_rad.abs() * self.ranges_m.len() as f64;
        (swept - std::f64::consts::TAU).abs() < 0.5 * self.angle_step_rad.abs()
    }
}

/// Wheel odometry: totals since the car's controller started, and rates at the stamp.
///
/// Totals, not rates, carry the pose: a lost frame then costs nothing, and rounding does not add
/// up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Odometry {
    /// When it was measured, on the clock of the computer that runs the core.
    pub stamp: Instant,
    /// Distance travelled by the body origin, metres, since the controller started.
    pub travelled_m: f64,
    /// Angle turned, radians, not wrapped, since the controller started.
    pub turned_rad: f64,
    /// Speed of the body origin, metres per second.
    pub speed_mps: f64,
    /// Yaw rate, radians per second.
    pub yaw_rate_rps: f64,
    /// Curvature that the steering stands at, 1/m, positive to the left.
    pub steering_curvature_pm: f64,
}
