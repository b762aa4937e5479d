//! The smoothed curve: a uniform cubic B-spline over control points.
//!
//! Why approximating and not interpolating: its second derivative by the parameter is the second
//! difference of the control points at the knots and linear in between, so a bound on the second
//! differences bounds it everywhere, without the ringing of an interpolating spline. With nearly
//! equal steps d between control points the curvature is that divided by d^2. The curve lies in
//! the convex hull of any four successive control points and passes within |N|/6 of each.

use crate::frames::{Point, Pose, Vector, heading_vector};
use crate::plan::{Path, PathPoint};

/// Control points `C_-1, C_0 .. C_n, C_n+1`, of which `C_-1` and `C_0` follow from the start pose
/// and `C_1`, and `C_n+1` makes the curve end in `C_n` without curvature.
#[derive(Clone, Debug, Default)]
pub struct Spline {
    controls: Vec<Point>,
}

/// Position, first and second derivative by the parameter.
#[derive(Clone, Copy, Debug)]
pub struct Jet {
    /// Map frame, metres.
    pub position: Point,
    /// Metres per unit of the parameter.
    pub velocity: Vector,
    /// Metres per squared unit.
    pub acceleration: Vector,
}

impl Jet {
    /// Signed curvature, 1/m, positive to the left.
    pub fn curvature_pm(&self) -> f64 {
        let (v, a) = (self.velocity, self.acceleration);
        (v.x * a.y - v.y * a.x) / v.norm().powi(3)
    }
}

impl Spline {
    /// From the start pose, the step `d_m` (length of the derivative at the start) and the control
    /// points `C_1 .. C_n`, at least two.
    pub fn set(&mut self, start: &Pose, d_m: f64, from_first: &[Point]) {
        let n = from_first.len();
        assert!(n >= 2, "a spline needs two free control points");
        let forward = heading_vector(start.heading_rad) * d_m;
        // (C_-1 + 4 C_0 + C_1) / 6 = start, (C_1 - C_-1) / 2 = forward
        let first = from_first[0];
        let zeroth = (start.position.coords * 3.0 - first.coords + forward) * 0.5;
        self.controls.clear();
        self.controls.push(first - forward * 2.0);
        self.controls.push(Point::from(zeroth));
        self.controls.extend_from_slice(from_first);
        self.controls.push(from_first[n - 1] + (from_first[n - 1] - from_first[n - 2]));
    }

    /// Number of polynomial pieces; the parameter runs from 0 to this.
    pub fn pieces(&self) -> usize {
        self.controls.len() - 3
    }

    /// The longest step between control points, metres.
    pub fn longest_step_m(&self) -> f64 {
        self.controls.windows(2).map(|w| (w[1] - w[0]).norm()).fold(0.0, f64::max)
    }

    /// The curve in piece `k` at `t` in [0, 1].
    pub fn at(&self, k: usize, t: f64) -> Jet {
        let c = &self.controls[k..k + 4];
        let r = 1.0 - t;
        let (t2, r2) = (t * t, r * r);
        let w = [
            r2 * r / 6.0,
            (4.0 - 6.0 * t2 + 3.0 * t2 * t) / 6.0,
            (4.0 - 6.0 * r2 + 3.0 * r2 * r) / 6.0,
            t2 * t / 6.0,
        ];
        // first differences with quadratic weights, second differences with linear ones
        let f = [c[1] - c[0], c[2] - c[1], c[3] - c[2]];
        Jet {
            position: Point::from(
                c[0].coords * w[0] + c[1].coords * w[1] + c[2].coords * w[2] + c[3].coords * w[3],
            ),
            velocity: f[0] * (0.5 * r2) + f[1] * (0.5 + t - t2) + f[2] * (0.5 * t2),
            acceleration: (f[1] - f[0]) * r + (f[2] - f[1]) * t,
        }
    }

    /// Samples at most `spacing_m` apart, into `path`. Arc length by Simpson's rule, whose error
    /// over a step of 5 cm in the tightest turn is below a nanometre.
    pub fn sample(&self, spacing_m: f64, path: &mut Path) {
        let pieces = self.pieces();
        let per_piece = (self.longest_step_m() / spacing_m).ceil().max(1.0) as usize;
        let step = 1.0 / per_piece as f64;
        path.points.clear();
        path.points.reserve(pieces * per_piece + 1);
        let mut s = 0.0;
        let point = |jet: &Jet, s: f64| PathPoint {
            s_m: s,
            position: jet.position,
            heading_rad: jet.velocity.y.atan2(jet.velocity.x),
            curvature_pm: jet.curvature_pm(),
        };
        let mut last = self.at(0, 0.0);
        path.points.push(point(&last, 0.0));
        for k in 0..pieces {
            for i in 1..=per_piece {
                let t = i as f64 * step;
                let middle = self.at(k, t - 0.5 * step);
                let next = self.at(k, t);
                s += step / 6.0
                    * (last.velocity.norm() + 4.0 * middle.velocity.norm() + next.velocity.norm());
                path.points.push(point(&next, s));
                last = next;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wavy(n: usize, d: f64) -> Spline {
        let points: Vec<Point> = (1..=n)
            .map(|i| {
                let x = i as f64 * d;
                Point::new(x, 0.2 * (1.0 - x.cos()))
            })
            .collect();
        let mut spline = Spline::default();
        spline.set(&Pose::new(0.0, 0.0, 0.0), d, &points);
        spline
    }

    #[test]
    fn it_starts_at_the_pose_and_ends_at_the_last_point() {
        let points = [Point::new(0.4, 0.3), Point::new(0.5, 0.4), Point::new(0.6, 0.4)];
        let start = Pose::new(0.3, 0.2, 0.9);
        let mut spline = Spline::default();
        spline.set(&start, 0.1, &points);
        let jet = spline.at(0, 0.0);
        assert!((jet.position - start.position).norm() < 1e-12);
        assert!((jet.velocity - heading_vector(0.9) * 0.1).norm() < 1e-12);
        let end = spline.at(2, 1.0);
        assert!((end.position - points[2]).norm() < 1e-12);
        assert!(end.acceleration.norm() < 1e-12);
    }

    #[test]
    fn derivatives_match_differences() {
        let spline = wavy(20, 0.1);
        let h = 1e-4;
        for (k, t) in [(0, 0.3), (5, 0.5), (19, 0.7)] {
            let (a, b, c) = (spline.at(k, t - h), spline.at(k, t), spline.at(k, t + h));
            assert!(((c.position - a.position) / (2.0 * h) - b.velocity).norm() < 1e-8);
            assert!(((c.velocity - a.velocity) / (2.0 * h) - b.acceleration).norm() < 1e-8);
        }
    }

    #[test]
    fn samples_are_close_and_their_arc_length_and_heading_agree_with_their_positions() {
        let mut path = Path::default();
        wavy(60, 0.1).sample(0.05, &mut path);
        for w in path.points.windows(2) {
            let chord = (w[1].position - w[0].position).norm();
            let arc = w[1].s_m - w[0].s_m;
            assert!(arc <= 0.05 + 1e-9 && chord <= arc + 1e-12 && arc - chord < 1e-5);
            let turned = 0.5 * (w[0].curvature_pm + w[1].curvature_pm) * arc;
            assert!((w[1].heading_rad - w[0].heading_rad - turned).abs() < 1e-4);
        }
    }
}
