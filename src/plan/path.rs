//! Paths (geometry alone) and trajectories (geometry with time).

use crate::frames::{Point, Pose, wrap_angle};
use crate::time::Instant;

/// One sample of a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathPoint {
    /// Arc length from the start of the path, metres.
    pub s_m: f64,
    /// Map frame, metres.
    pub position: Point,
    /// Direction of travel, radians.
    pub heading_rad: f64,
    /// Curvature, 1/m, positive to the left.
    pub curvature_pm: f64,
}

/// Samples with strictly increasing arc length, at most a few centimetres apart. Between samples
/// the curve is the arc whose curvature runs linearly from one to the next.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Path {
    /// The samples.
    pub points: Vec<PathPoint>,
}

impl Path {
    /// Arc length of the last sample, metres; zero for an empty path.
    pub fn length_m(&self) -> f64 {
        self.points.last().map_or(0.0, |p| p.s_m)
    }

    /// The point at an arc length, clamped to the ends; `None` for an empty path.
    pub fn at_distance(&self, s_m: f64) -> Option<PathPoint> {
        at_distance(&self.points, s_m)
    }

    /// Ends the path at arc length `s_m`: the samples before it stay and an interpolated one
    /// closes. A rest of less than a millimetre is dropped instead, so that the path gets no
    /// longer than `s_m` and no edge so short that its direction is rounding noise.
    pub fn cut(&mut self, s_m: f64) {
        const SHORTEST_EDGE_M: f64 = 1e-3;
        let Some(end) = self.at_distance(s_m) else { return };
        if s_m >= self.length_m() {
            return;
        }
        let keep = self.points.partition_point(|p| p.s_m <= s_m).max(1);
        self.points.truncate(keep);
        if end.s_m - self.length_m() >= SHORTEST_EDGE_M {
            self.points.push(end);
        }
    }
}

/// The point of a sampled path at an arc length, clamped to the ends; `None` without samples.
pub(super) fn at_distance(points: &[PathPoint], s_m: f64) -> Option<PathPoint> {
    let next = points.partition_point(|p| p.s_m <= s_m);
    if next == 0 {
        return points.first().copied();
    }
    let a = &points[next - 1];
    let Some(b) = points.get(next) else { return Some(*a) };
    Some(between(a, b, (s_m - a.s_m) / (b.s_m - a.s_m)))
}

/// One sample of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrajectoryPoint {
    /// Where.
    pub path: PathPoint,
    /// Seconds after the trajectory's start.
    pub t_s: f64,
    /// Speed along the path, m/s, never negative.
    pub speed_mps: f64,
    /// Acceleration along the path from this sample to the next, m/s^2 (constant in between).
    pub accel_mps2: f64,
}

/// A path with a speed profile. The executable ones end at rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// When its first sample is to be reached.
    pub start: Instant,
    /// At least one sample; arc length strictly increasing, time strictly increasing.
    pub points: Vec<TrajectoryPoint>,
}

impl Trajectory {
    /// Standing still at a pose.
    pub fn at_rest(start: Instant, pose: Pose) -> Self {
        let path = PathPoint {
            s_m: 0.0,
            position: pose.position,
            heading_rad: pose.heading_rad,
            curvature_pm: 0.0,
        };
        let point = TrajectoryPoint { path, t_s: 0.0, speed_mps: 0.0, accel_mps2: 0.0 };
        Self { start, points: vec![point] }
    }

    /// Seconds from start to rest.
    pub fn duration_s(&self) -> f64 {
        self.last().t_s
    }

    /// The sample at which it ends.
    pub fn last(&self) -> &TrajectoryPoint {
        self.points.last().expect("a trajectory has at least one sample")
    }

    /// State at a moment: the first sample before the start, the last one after the end.
    pub fn at(&self, now: Instant) -> TrajectoryPoint {
        self.at_time(now.seconds_after(self.start))
    }

    /// State `t_s` seconds after the start, with the arc length solved exactly for the constant
    /// acceleration between samples.
    pub fn at_time(&self, t_s: f64) -> TrajectoryPoint {
        let next = self.points.partition_point(|p| p.t_s <= t_s);
        if next == 0 {
            return self.points[0];
        }
        let a = &self.points[next - 1];
        let Some(b) = self.points.get(next) else {
            return TrajectoryPoint { t_s: a.t_s, accel_mps2: 0.0, ..*a };
        };
        let dt = t_s - a.t_s;
        let ds = (a.speed_mps + 0.5 * a.accel_mps2 * dt) * dt;
        let length = b.path.s_m - a.path.s_m;
        TrajectoryPoint {
            path: between(&a.path, &b.path, (ds / length).clamp(0.0, 1.0)),
            t_s,
            speed_mps: (a.speed_mps + a.accel_mps2 * dt).max(0.0),
            accel_mps2: a.accel_mps2,
        }
    }

    /// State at an arc length, clamped to the trajectory's ends.
    pub fn at_distance(&self, s_m: f64) -> TrajectoryPoint {
        let next = self.points.partition_point(|p| p.path.s_m <= s_m);
        if next == 0 {
            return self.points[0];
        }
        let a = &self.points[next - 1];
        let Some(b) = self.points.get(next) else { return *a };
        let ds = s_m - a.path.s_m;
        let speed = (a.speed_mps * a.speed_mps + 2.0 * a.accel_mps2 * ds).max(0.0).sqrt();
        let mean = 0.5 * (a.speed_mps + speed);
        TrajectoryPoint {
            path: between(&a.path, &b.path, ds / (b.path.s_m - a.path.s_m)),
            t_s: a.t_s + if mean > 0.0 { ds / mean } else { 0.0 },
            speed_mps: speed,
            accel_mps2: a.accel_mps2,
        }
    }
}

/// Cubic Hermite interpolation between two samples: position and heading are continuous, and the
/// position error on an arc of the tightest turn is below a tenth of a millimetre at 0.05 m.
pub(super) fn between(a: &PathPoint, b: &PathPoint, fraction: f64) -> PathPoint {
    let length = b.s_m - a.s_m;
    let (u, u2) = (fraction, fraction * fraction);
    let u3 = u2 * u;
    let ta = crate::frames::heading_vector(a.heading_rad) * length;
    let tb = crate::frames::heading_vector(b.heading_rad) * length;
    let position = a.position.coords * (2.0 * u3 - 3.0 * u2 + 1.0)
        + ta * (u3 - 2.0 * u2 + u)
        + b.position.coords * (3.0 * u2 - 2.0 * u3)
        + tb * (u3 - u2);
    // Heading follows the linear curvature, corrected so that it ends at b's heading.
    let turn = wrap_angle(b.heading_rad - a.heading_rad);
    let linear = 0.5 * (a.curvature_pm + b.curvature_pm) * length;
    let partial = (a.curvature_pm * u + 0.5 * (b.curvature_pm - a.curvature_pm) * u2) * length
        + (turn - linear) * u;
    PathPoint {
        s_m: a.s_m + u * length,
        position: Point::from(position),
        heading_rad: wrap_angle(a.heading_rad + partial),
        curvature_pm: a.curvature_pm + u * (b.curvature_pm - a.curvature_pm),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A quarter circle of radius 0.5 m, driven from 1 m/s to rest.
    fn quarter() -> Trajectory {
        let (n, radius) = (16, 0.5);
        let length = radius * std::f64::consts::FRAC_PI_2;
        let accel = -1.0 / (2.0 * length);
        let points = (0..=n)
            .map(|i| {
                let s = length * f64::from(i) / f64::from(n);
                let angle = s / radius;
                let speed = (1.0 + 2.0 * accel * s).max(0.0).sqrt();
                TrajectoryPoint {
                    path: PathPoint {
                        s_m: s,
                        position: Point::new(radius * angle.sin(), radius * (1.0 - angle.cos())),
                        heading_rad: angle,
                        curvature_pm: 2.0,
                    },
                    t_s: (1.0 - speed) / -accel,
                    speed_mps: speed,
                    accel_mps2: accel,
                }
            })
            .collect();
        Trajectory { start: Instant::from_nanos(1_000_000_000), points }
    }

    #[test]
    fn samples_in_between_lie_on_the_circle() {
        let t = quarter();
        for i in 0..1000 {
            let p = t.at_time(t.duration_s() * f64::from(i) / 1000.0);
            let radius = (p.path.position - Point::new(0.0, 0.5)).norm();
            assert!((radius - 0.5).abs() < 1e-5, "{radius}");
            assert!((p.path.heading_rad - p.path.s_m / 0.5).abs() < 1e-6);
            let same = t.at_distance(p.path.s_m);
            assert!((same.speed_mps - p.speed_mps).abs() < 1e-6);
            assert!((same.t_s - p.t_s).abs() < 1e-6);
        }
    }

    #[test]
    fn a_cut_path_ends_where_it_was_cut_and_lies_on_the_old_one() {
        let whole = Path { points: quarter().points.iter().map(|p| p.path).collect() };
        for i in 0..=100 {
            let s = whole.length_m() * f64::from(i) / 100.0;
            let mut path = whole.clone();
            path.cut(s);
            assert!(path.length_m() <= s + 1e-12 && path.length_m() > s - 1e-3, "{s}");
            assert!(path.points.windows(2).all(|w| w[1].s_m > w[0].s_m));
            assert_eq!(path.points.last().copied(), whole.at_distance(path.length_m()));
        }
        assert_eq!(Path::default().at_distance(1.0), None);
    }

    #[test]
    fn time_is_clamped_to_the_trajectory() {
        let t = quarter();
        assert_eq!(t.at(Instant::ZERO).path, t.points[0].path);
        let end = t.at(Instant::from_nanos(1_000_000_000_000));
        assert_eq!((end.path, end.speed_mps), (t.last().path, 0.0));
    }
}
