//! Frames, poses and angles.
//!
//! The map frame is east-north-up, the body frame forward-left-up with its origin at the centre of
//! the car's footprint disc. Headings are radians, counter-clockwise, zero along map x.

use std::f64::consts::{PI, TAU};

/// A position in metres; the frame is the caller's to name.
pub type Point = nalgebra::Point2<f64>;
/// A difference of positions in metres.
pub type Vector = nalgebra::Vector2<f64>;

/// The same angle in `(-PI, PI]`.
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(TAU);
    if wrapped > PI { wrapped - TAU } else { wrapped }
}

/// The unit vector of a heading.
pub fn heading_vector(heading_rad: f64) -> Vector {
    let (sin, cos) = heading_rad.sin_cos();
    Vector::new(cos, sin)
}

/// Where the body frame lies in the map frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Origin of the body frame, map frame, metres.
    pub position: Point,
    /// Direction of the body's forward axis, radians.
    pub heading_rad: f64,
}

impl Pose {
    /// A pose from its three numbers (metres, metres, radians).
    pub fn new(x_m: f64, y_m: f64, heading_rad: f64) -> Self {
        Self { position: Point::new(x_m, y_m), heading_rad }
    }

    /// A body-frame point in the map frame.
    pub fn to_map(&self, body: Point) -> Point {
        let forward = heading_vector(self.heading_rad);
        self.position + forward * body.x + Vector::new(-forward.y, forward.x) * body.y
    }

    /// A map-frame point in the body frame.
    pub fn to_body(&self, map: Point) -> Point {
        let forward = heading_vector(self.heading_rad);
        let offset = map - self.position;
        Point::new(offset.dot(&forward), forward.x * offset.y - forward.y * offset.x)
    }

    /// The pose after driving `distance_m` along an arc that turns by `turn_rad` (exact for
    /// constant curvature, and for a straight line).
    pub fn along_arc(&self, distance_m: f64, turn_rad: f64) -> Self {
        self.along_chord(chord_m(distance_m, turn_rad), turn_rad)
    }

    /// [`along_arc`](Self::along_arc) for an arc with this [chord](chord_m).
    pub fn along_chord(&self, chord_m: f64, turn_rad: f64) -> Self {
        Self {
            position: self.position + heading_vector(self.heading_rad + 0.5 * turn_rad) * chord_m,
            heading_rad: wrap_angle(self.heading_rad + turn_rad),
        }
    }
}

/// Distance in metres between the ends of an arc of `distance_m` that turns by `turn_rad`.
pub fn chord_m(distance_m: f64, turn_rad: f64) -> f64 {
    let half = 0.5 * turn_rad;
    let sinc = if half.abs() < 1e-4 { 1.0 - half * half / 6.0 } else { half.sin() / half };
    distance_m * sinc
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_half_circle_ends_one_diameter_to_the_left_and_turned_round() {
        let end = Pose::new(0.0, 0.0, 0.0).along_arc(PI * 2.0, PI);
        assert!((end.position - Point::new(0.0, 4.0)).norm() < 1e-12);
        assert!((end.heading_rad.abs() - PI).abs() < 1e-12);
    }

    #[test]
    fn body_and_map_points_are_inverse() {
        let pose = Pose::new(1.0, -2.0, 2.3);
        let p = Point::new(0.7, -0.4);
        assert!((pose.to_body(pose.to_map(p)) - p).norm() < 1e-12);
    }

    #[test]
    fn angles_wrap_into_one_turn() {
        assert!((wrap_angle(3.0 * PI) - PI).abs() < 1e-12);
        assert!((wrap_angle(-3.5 * PI) - 0.5 * PI).abs() < 1e-12);
    }
}
