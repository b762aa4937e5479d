//! The shortest way between two poses for a car that only drives forwards (Dubins 1957): three
//! pieces, each a straight line or an arc of the tightest turn.

use crate::frames::Pose;
use std::f64::consts::TAU;

/// Three pieces one after the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Dubins {
    /// Curvature (1/m, positive to the left) and length (m) of each piece.
    pub(super) pieces: [(f64, f64); 3],
    /// Sum of the lengths, metres.
    pub(super) length_m: f64,
}

/// The angle in `[0, TAU)`, a rounding error below zero counting as zero rather than a full turn.
fn turn(angle: f64) -> f64 {
    let turn = angle.rem_euclid(TAU);
    if turn > TAU - 1e-9 { 0.0 } else { turn }
}

/// The shortest of the six candidates.
pub(super) fn shortest(from: Pose, to: Pose, radius_m: f64) -> Dubins {
    let candidates = candidates(from, to, radius_m).into_iter().flatten();
    let shortest = candidates.min_by(|a, b| a.length_m.total_cmp(&b.length_m));
    shortest.expect("one of the first two exists whatever the poses")
}

/// The six candidates (Shkel and Lumelsky 2001 give them in closed form), as far as they exist.
pub(super) fn candidates(from: Pose, to: Pose, radius_m: f64) -> [Option<Dubins>; 6] {
    let offset = to.position - from.position;
    let d = offset.norm() / radius_m;
    let line = if d > 0.0 { offset.y.atan2(offset.x) } else { 0.0 };
    let (a, b) = (from.heading_rad - line, to.heading_rad - line);
    let ((sa, ca), (sb, cb)) = (a.sin_cos(), b.sin_cos());
    let cab = (a - b).cos();

    let mut found = [None; 6];
    let mut offer = |word: usize, signs: [f64; 3], lengths: [f64; 3]| {
        found[word] = Some(Dubins {
            pieces: std::array::from_fn(|i| (signs[i] / radius_m, lengths[i] * radius_m)),
            length_m: lengths.iter().sum::<f64>() * radius_m,
        });
    };
    // left, straight, left
    let p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sa - sb);
    if p2 >= 0.0 {
        let t = (cb - ca).atan2(d + sa - sb);
        offer(0, [1.0, 0.0, 1.0], [turn(t - a), p2.sqrt(), turn(b - t)]);
    }
    // right, straight, right
    let p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sb - sa);
    if p2 >= 0.0 {
        let t = (ca - cb).atan2(d - sa + sb);
        offer(1, [-1.0, 0.0, -1.0], [turn(a - t), p2.sqrt(), turn(t - b)]);
    }
    // left, straight, right
    let p2 = d * d - 2.0 + 2.0 * cab + 2.0 * d * (sa + sb);
    if p2 >= 0.0 {
        let p = p2.sqrt();
        let t = (-ca - cb).atan2(d + sa + sb) - (-2.0_f64).atan2(p);
        offer(2, [1.0, 0.0, -1.0], [turn(t - a), p, turn(t - b)]);
    }
    // right, straight, left
    let p2 = d * d - 2.0 + 2.0 * cab - 2.0 * d * (sa + sb);
    if p2 >= 0.0 {
        let p = p2.sqrt();
        let t = (ca + cb).atan2(d - sa - sb) - 2.0_f64.atan2(p);
        offer(3, [-1.0, 0.0, 1.0], [turn(a - t), p, turn(b - t)]);
    }
    // right, left, right
    let c = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sa - sb)) / 8.0;
    if c.abs() <= 1.0 {
        let p = turn(TAU - c.acos());
        let t = turn(a - (ca - cb).atan2(d - sa + sb) + 0.5 * p);
        offer(4, [-1.0, 1.0, -1.0], [t, p, turn(a - b - t + p)]);
    }
    // left, right, left
    let c = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sb - sa)) / 8.0;
    if c.abs() <= 1.0 {
        let p = turn(TAU - c.acos());
        let t = turn(-a + (cb - ca).atan2(d + sa - sb) + 0.5 * p);
        offer(5, [1.0, -1.0, 1.0], [t, p, turn(b - a - t + p)]);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    fn end(from: Pose, way: &Dubins) -> Pose {
        way.pieces.iter().fold(from, |pose, (k, length)| pose.along_arc(*length, k * length))
    }

    proptest! {
        #[test]
        fn the_pieces_lead_from_one_pose_to_the_other(
            x in -4.0..4.0, y in -4.0..4.0, a in -PI..PI, b in -PI..PI, radius in 0.2..2.0,
        ) {
            let (from, to) = (Pose::new(0.3, -0.2, a), Pose::new(x, y, b));
            for way in candidates(from, to, radius).iter().flatten() {
                let got = end(from, way);
                prop_assert!((got.position - to.position).norm() < 1e-6, "{way:?}");
                prop_assert!(crate::frames::wrap_angle(got.heading_rad - b).abs() < 1e-6);
            }
            let way = shortest(from, to, radius);
            prop_assert!(way.length_m >= (to.position - from.position).norm() - 1e-9);
        }
    }

    #[test]
    fn turning_round_side_by_side_takes_half_a_circle() {
        let way = shortest(Pose::new(0.0, 0.0, 0.0), Pose::new(0.0, 1.0, PI), 0.5);
        assert!((way.length_m - 0.5 * PI).abs() < 1e-9, "{way:?}");
    }

    #[test]
    fn turning_round_on_the_spot_takes_three_arcs() {
        let way = shortest(Pose::new(0.0, 0.0, 0.0), Pose::new(0.0, 0.0, PI), 0.5);
        assert!((way.length_m - 0.5 * PI * (7.0 / 3.0)).abs() < 1e-6, "{way:?}");
    }
}
