//! The shortest way between two poses for a car that only drives forwards (Dubins 1957): three
//! pieces, each a straight line or an arc of the tightest turn.

use crate::frames::Pose;
use std::f64::consts::{PI, TAU};

/// Three pieces one after the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Dubins {
    /// Curvature (1/m, positive to the left) and length (m) of each piece.
    pub(super) pieces: [(f64, f64); 3],
    /// Sum of the lengths, metres.
    pub(super) length_m: f64,
}

/// Which way each piece turns: left 1, straight 0, right -1.
type Word = [f64; 3];

/// The angle in `[0, TAU)`, a rounding error below zero counting as zero rather than a full turn.
fn turn(angle: f64) -> f64 {
    // The remainder without a division: within two turns these differences are exact.
    let turn = if angle.abs() >= 2.0 * TAU {
        angle.rem_euclid(TAU)
    } else {
        let rest = if angle >= TAU {
            angle - TAU
        } else if angle <= -TAU {
            angle + TAU
        } else {
            angle
        };
        if rest < 0.0 { rest + TAU } else { rest }
    };
    if turn > TAU - 1e-9 { 0.0 } else { turn }
}

/// The shortest of the six candidates.
pub(super) fn shortest(from: Pose, to: Pose, radius_m: f64) -> Dubins {
    let mut best = ([0.0; 3], [0.0; 3], f64::INFINITY);
    candidates(from, to, radius_m, |word, lengths, length_m| {
        if length_m < best.2 {
            best = (word, lengths, length_m);
        }
        best.2
    });
    let (word, lengths, length_m) = best;
    assert!(length_m.is_finite(), "one of the first two exists whatever the poses");
    dubins(word, lengths, length_m, radius_m)
}

/// All candidates that exist.
pub(super) fn ways(from: Pose, to: Pose, radius_m: f64) -> Vec<Dubins> {
    let mut ways = Vec::with_capacity(6);
    candidates(from, to, radius_m, |word, lengths, length_m| {
        ways.push(dubins(word, lengths, length_m, radius_m));
        f64::INFINITY
    });
    ways
}

fn dubins(word: Word, lengths: [f64; 3], length_m: f64, radius_m: f64) -> Dubins {
    let pieces = std::array::from_fn(|i| (word[i] / radius_m, lengths[i] * radius_m));
    Dubins { pieces, length_m }
}

/// Offers the six candidates (Shkel and Lumelsky 2001 give them in closed form), as far as they
/// exist: which way the pieces turn, their lengths in radii, and the sum in metres. The answer is the
/// length from which on candidates need not be offered.
fn candidates(
    from: Pose,
    to: Pose,
    radius_m: f64,
    mut offer: impl FnMut(Word, [f64; 3], f64) -> f64,
) {
    let offset = to.position - from.position;
    let d = offset.norm() / radius_m;
    let line = if d > 0.0 { offset.y.atan2(offset.x) } else { 0.0 };
    let (a, b) = (from.heading_rad - line, to.heading_rad - line);
    let ((sa, ca), (sb, cb)) = (a.sin_cos(), b.sin_cos());
    let cab = (a - b).cos();

    let mut enough_m = f64::INFINITY;
    let mut offer = |word: Word, lengths: [f64; 3]| {
        offer(word, lengths, lengths.iter().sum::<f64>() * radius_m)
    };
    // left, straight, left
    let p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sa - sb);
    if p2 >= 0.0 {
        let t = (cb - ca).atan2(d + sa - sb);
        enough_m = offer([1.0, 0.0, 1.0], [turn(t - a), p2.sqrt(), turn(b - t)]);
    }
    // right, straight, right
    let p2 = 2.0 + d * d - 2.0 * cab + 2.0 * d * (sb - sa);
    if p2 >= 0.0 && p2.sqrt() * radius_m < enough_m {
        let t = (ca - cb).atan2(d - sa + sb);
        enough_m = offer([-1.0, 0.0, -1.0], [turn(a - t), p2.sqrt(), turn(t - b)]);
    }
    // left, straight, right
    let p2 = d * d - 2.0 + 2.0 * cab + 2.0 * d * (sa + sb);
    if p2 >= 0.0 && p2.sqrt() * radius_m < enough_m {
        let p = p2.sqrt();
        let t = (-ca - cb).atan2(d + sa + sb) - (-2.0_f64).atan2(p);
        enough_m = offer([1.0, 0.0, -1.0], [turn(t - a), p, turn(t - b)]);
    }
    // right, straight, left
    let p2 = d * d - 2.0 + 2.0 * cab - 2.0 * d * (sa + sb);
    if p2 >= 0.0 && p2.sqrt() * radius_m < enough_m {
        let p = p2.sqrt();
        let t = (ca + cb).atan2(d - sa - sb) - 2.0_f64.atan2(p);
        enough_m = offer([-1.0, 0.0, 1.0], [turn(a - t), p, turn(b - t)]);
    }
    // Of three arcs the middle one is at least half a circle, but for rounding.
    let half_m = 0.999 * PI * radius_m;
    // right, left, right
    let c = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sa - sb)) / 8.0;
    if c.abs() < 1.0 && half_m < enough_m {
        let p = turn(TAU - c.acos());
        let t = turn(a - (ca - cb).atan2(d - sa + sb) + 0.5 * p);
        enough_m = offer([-1.0, 1.0, -1.0], [t, p, turn(a - b - t + p)]);
    }
    // left, right, left
    let c = (6.0 - d * d + 2.0 * cab + 2.0 * d * (sb - sa)) / 8.0;
    if c.abs() < 1.0 && half_m < enough_m {
        let p = turn(TAU - c.acos());
        let t = turn(-a + (cb - ca).atan2(d + sa - sb) + 0.5 * p);
        offer([1.0, -1.0, 1.0], [t, p, turn(b - a - t + p)]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn end(from: Pose, way: &Dubins) -> Pose {
        way.pieces.iter().fold(from, |pose, (k, length)| pose.along_arc(*length, k * length))
    }

    proptest! {
        #[test]
        fn the_pieces_lead_from_one_pose_to_the_other(
            x in -4.0..4.0, y in -4.0..4.0, a in -PI..PI, b in -PI..PI, radius in 0.2..2.0,
        ) {
            let (from, to) = (Pose::new(0.3, -0.2, a), Pose::new(x, y, b));
            let ways = ways(from, to, radius);
            for way in &ways {
                let got = end(from, way);
                prop_assert!((got.position - to.position).norm() < 1e-6, "{way:?}");
                prop_assert!(crate::frames::wrap_angle(got.heading_rad - b).abs() < 1e-6);
            }
            let way = shortest(from, to, radius);
            let least_m = ways.iter().map(|way| way.length_m).fold(f64::INFINITY, f64::min);
            prop_assert_eq!(way.length_m, least_m);
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
