//! The geometry of a braking tail: its curve laid out in the plane, and how to steer along it.

use crate::command::{BrakingTail, TailSample};
use crate::frames::{Point, Pose, Vector, heading_vector, wrap_angle};
use crate::odometry::OdometryTrack;

/// The curve is stored at steps of at most this length, metres: short enough that an arc of the mean
/// curvature stands for the linearly changing one (error below 0.01 mm a step).
const STEP_MAX_M: f64 = 0.05;
/// Samples further apart than this do not describe a path of a car this size.
const SPACING_MAX_M: f64 = 1.0;

/// Why a tail was refused.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum TailError {
    /// It has no samples.
    #[error("the braking tail has no samples")]
    Empty,
    /// The distance between samples is not a sensible length.
    #[error("the spacing of the braking tail is {0} m, but must be positive and at most 1 m")]
    Spacing(f64),
    /// A number is not finite, or a speed is negative.
    #[error("sample {0} of the braking tail is not a curvature and a speed")]
    Sample(usize),
    /// The last sample is not at rest.
    #[error("the braking tail ends at {0} m/s, but must end at rest")]
    EndsMoving(f64),
    /// The odometry has no memory of the anchor.
    #[error(
        "the braking tail is anchored at {0} m travelled, which the odometry does not remember"
    )]
    Anchor(f64),
}

/// A state on the curve, or the car's state relative to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TailPosition {
    /// Distance along the curve from its start, metres, within the curve.
    pub s_m: f64,
    /// How far the car is beyond the curve's end, metres; zero if it is not.
    pub beyond_m: f64,
    /// How far the car is to the left of the curve, metres.
    pub offset_m: f64,
    /// The car's heading less the curve's, radians.
    pub heading_error_rad: f64,
    /// Curvature of the curve there, 1/m.
    pub curvature_pm: f64,
    /// Highest speed from which the rest of the tail ends at rest, m/s.
    pub speed_mps: f64,
    /// Acceleration of that speed limit along the curve, m/s^2.
    pub accel_mps2: f64,
}

/// A braking tail laid out in the frame of an odometry track.
#[derive(Clone, Debug, Default)]
pub struct TailCurve {
    plan: u16,
    step_m: f64,
    points: Vec<CurvePoint>,
}

#[derive(Clone, Copy, Debug)]
struct CurvePoint {
    pose: Pose,
    curvature_pm: f64,
    /// Squared speed, which runs linearly with distance.
    speed_squared: f64,
}

impl TailCurve {
    /// Lays the tail out from where the track stood at the tail's anchor.
    pub fn anchored(tail: &BrakingTail, track: &OdometryTrack) -> Result<Self, TailError> {
        let anchor = (tail.anchor_travelled_m, tail.anchor_turned_rad, tail.anchor_offset_m);
        if !(anchor.0.is_finite() && anchor.1.is_finite() && anchor.2.is_finite()) {
            return Err(TailError::Anchor(anchor.0));
        }
        let forgotten = TailError::Anchor(anchor.0);
        let car = track.pose_at_travelled(anchor.0).ok_or(forgotten)?;
        let (newest, newest_pose) = track.newest().ok_or(forgotten)?;
        // The track's frame may be turned against the odometry's totals.
        let heading = wrap_angle(anchor.1 - newest.turned_rad + newest_pose.heading_rad);
        let forward = heading_vector(heading);
        let left = Vector::new(-forward.y, forward.x);
        let start = Pose { position: car.position - left * anchor.2, heading_rad: heading };
        Self::laid_out(tail, start)
    }

    /// Lays the tail out from a pose of its first sample.
    pub fn laid_out(tail: &BrakingTail, start: Pose) -> Result<Self, TailError> {
        let last = tail.samples.last().ok_or(TailError::Empty)?;
        if !(tail.spacing_m > 0.0 && tail.spacing_m <= SPACING_MAX_M) {
            return Err(TailError::Spacing(tail.spacing_m));
        }
        let valid = |s: &TailSample| s.curvature_pm.is_finite() && s.speed_mps >= 0.0;
        if let Some(i) = tail.samples.iter().position(|s| !valid(s) || s.speed_mps.is_infinite()) {
            return Err(TailError::Sample(i));
        }
        if last.speed_mps != 0.0 {
            return Err(TailError::EndsMoving(last.speed_mps));
        }
        let parts = (tail.spacing_m / STEP_MAX_M).ceil().max(1.0);
        let step = tail.spacing_m / parts;
        let first = &tail.samples[0];
        let mut points = Vec::with_capacity(tail.samples.len() * parts as usize);
        points.push(CurvePoint {
            pose: start,
            curvature_pm: first.curvature_pm,
            speed_squared: first.speed_mps * first.speed_mps,
        });
        let mut pose = start;
        for pair in tail.samples.windows(2) {
            let (k0, k1) = (pair[0].curvature_pm, pair[1].curvature_pm);
            let (b0, b1) = (pair[0].speed_mps.powi(2), pair[1].speed_mps.powi(2));
            let mut before = k0;
            for part in 1..=parts as usize {
                let u = part as f64 / parts;
                let curvature = k0 + u * (k1 - k0);
                pose = along_clothoid(pose, step, before, curvature);
                before = curvature;
                let speed_squared = b0 + u * (b1 - b0);
                points.push(CurvePoint { pose, curvature_pm: curvature, speed_squared });
            }
        }
        Ok(Self { plan: tail.plan, step_m: step, points })
    }

    /// A circular arc on which the car brakes from `speed_mps` to rest over `length_m`.
    pub fn arc(start: Pose, curvature_pm: f64, length_m: f64, speed_mps: f64) -> Self {
        let parts = (length_m / STEP_MAX_M).ceil().max(1.0);
        let step = length_m.max(1e-6) / parts;
        let points = (0..=parts as usize)
            .map(|i| {
                let s = i as f64 * step;
                CurvePoint {
                    pose: start.along_arc(s, s * curvature_pm),
                    curvature_pm,
                    speed_squared: speed_mps * speed_mps * (1.0 - i as f64 / parts),
                }
            })
            .collect();
        Self { plan: 0, step_m: step, points }
    }

    /// Number of the plan that the tail belongs to.
    pub fn plan(&self) -> u16 {
        self.plan
    }

    /// Length of the curve, metres.
    pub fn length_m(&self) -> f64 {
        self.step_m * self.points.len().saturating_sub(1) as f64
    }

    /// The pose `s_m` along the curve, carried on with the end's curvature outside it.
    ///
    /// # Panics
    /// If the curve is empty (a default one).
    pub fn pose_at(&self, s_m: f64) -> Pose {
        let (i, u) = self.locate(s_m);
        let (a, b) = (&self.points[i], &self.points[(i + 1).min(self.points.len() - 1)]);
        let ds = s_m - i as f64 * self.step_m;
        let curvature = a.curvature_pm + u * (b.curvature_pm - a.curvature_pm);
        along_clothoid(a.pose, ds, a.curvature_pm, curvature)
    }

    /// Curvature `s_m` along the curve, 1/m.
    pub fn curvature_at(&self, s_m: f64) -> f64 {
        let (i, u) = self.locate(s_m);
        let (a, b) = (&self.points[i], &self.points[(i + 1).min(self.points.len() - 1)]);
        a.curvature_pm + u * (b.curvature_pm - a.curvature_pm)
    }

    /// Highest speed `s_m` along the curve from which the rest of it ends at rest, m/s.
    pub fn speed_at(&self, s_m: f64) -> f64 {
        let (i, u) = self.locate(s_m);
        let (a, b) = (&self.points[i], &self.points[(i + 1).min(self.points.len() - 1)]);
        (a.speed_squared + u * (b.speed_squared - a.speed_squared)).max(0.0).sqrt()
    }

    /// Where a car stands relative to the curve. `s_guess_m` is where it was found last.
    pub fn locate_car(&self, car: Pose, s_guess_m: f64) -> TailPosition {
        let length = self.length_m();
        let mut s = s_guess_m.clamp(0.0, length);
        let mut ahead = 0.0;
        let mut foot = self.pose_at(s);
        for _ in 0..8 {
            ahead = (car.position - foot.position).dot(&heading_vector(foot.heading_rad));
            let next = (s + ahead).clamp(0.0, length);
            let moved = (next - s).abs();
            s = next;
            foot = self.pose_at(s);
            if moved < 1e-5 {
                break;
            }
        }
        let forward = heading_vector(foot.heading_rad);
        let off: Vector = car.position - foot.position;
        let (i, u) = self.locate(s);
        let (a, b) = (&self.points[i], &self.points[(i + 1).min(self.points.len() - 1)]);
        TailPosition {
            s_m: s,
            beyond_m: if s >= length { ahead.max(0.0) } else { 0.0 },
            offset_m: forward.x * off.y - forward.y * off.x,
            heading_error_rad: wrap_angle(car.heading_rad - foot.heading_rad),
            curvature_pm: a.curvature_pm + u * (b.curvature_pm - a.curvature_pm),
            speed_mps: (a.speed_squared + u * (b.speed_squared - a.speed_squared)).max(0.0).sqrt(),
            accel_mps2: 0.5 * (b.speed_squared - a.speed_squared) / self.step_m,
        }
    }

    /// The curvature that brings a car at `position` back onto the curve within a few
    /// `settle_m`: critically damped in distance, with the curve's curvature `ahead_m` further on.
    pub fn steer(&self, position: &TailPosition, ahead_m: f64, settle_m: f64) -> f64 {
        self.curvature_at(position.s_m + ahead_m)
            - position.offset_m / (settle_m * settle_m)
            - 2.0 * position.heading_error_rad / settle_m
    }

    /// Centres of the curve between two distances, at most `spacing_m` apart, both ends included.
    pub fn centres(&self, from_m: f64, to_m: f64, spacing_m: f64) -> impl Iterator<Item = Point> {
        let parts = ((to_m - from_m) / spacing_m).ceil().max(1.0);
        (0..=parts as usize)
            .map(move |i| self.pose_at(from_m + (to_m - from_m) * i as f64 / parts).position)
    }

    /// Index of the point at or before `s_m`, and the fraction of the step beyond it (0 to 1).
    fn locate(&self, s_m: f64) -> (usize, f64) {
        if self.points.len() < 2 {
            return (0, 0.0);
        }
        let x = s_m / self.step_m;
        let i = (x.max(0.0) as usize).min(self.points.len() - 2);
        (i, (x - i as f64).clamp(0.0, 1.0))
    }
}

/// The least share of the grip that a bend gets of a car that is too fast for it: 0.6 are left for
/// braking.
pub const BEND_SHARE_MIN: f64 = 0.8;

/// The lateral acceleration, m/s^2, of a braking car in a bend that asks for `wished`: all of it as
/// long as the tyres hold it. Of a bend that asks for more, as much less than the tyres hold as is
/// missing, but [`BEND_SHARE_MIN`] at least: a car that is too fast for a bend and only steers does not get
/// any slower, and where the bend tightens it is lost.
pub fn bend_share(wished: f64, grip: f64) -> f64 {
    let missing = (wished.abs() / grip - 1.0).max(0.0);
    let share = (1.0 - missing).max(BEND_SHARE_MIN);
    wished.clamp(-share * grip, share * grip)
}

/// The pose after a short step on which the curvature runs linearly from `k0_pm` to `k1_pm`: an arc of
/// the mean curvature whose chord points as the clothoid's does (to first order).
fn along_clothoid(start: Pose, step_m: f64, k0_pm: f64, k1_pm: f64) -> Pose {
    let correction = (k0_pm - k1_pm) * step_m / 12.0;
    let turned = Pose { heading_rad: start.heading_rad + correction, ..start };
    let end = turned.along_arc(step_m, 0.5 * (k0_pm + k1_pm) * step_m);
    Pose { heading_rad: wrap_angle(end.heading_rad - correction), ..end }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::Odometry;
    use crate::time::Instant;

    fn tail(curvatures: &[f64]) -> BrakingTail {
        let n = curvatures.len();
        let samples = curvatures
            .iter()
            .enumerate()
            .map(|(i, k)| TailSample {
                curvature_pm: *k,
                speed_mps: (4.0 * (n - 1 - i) as f64).sqrt(),
            })
            .collect();
        BrakingTail { spacing_m: 0.1, samples, ..BrakingTail::default() }
    }

    #[test]
    fn a_clothoid_is_laid_out_as_its_series_says() {
        // Curvature 0 to 1 over 1 m: theta = s^2/2; x, y by numerical quadrature.
        let tail = tail(&(0..=10).map(|i| f64::from(i) * 0.1).collect::<Vec<_>>());
        let curve = TailCurve::laid_out(&tail, Pose::new(0.0, 0.0, 0.0)).unwrap();
        let n = 100_000;
        let (mut x, mut y) = (0.0, 0.0);
        for i in 0..n {
            let s = (f64::from(i) + 0.5) / f64::from(n);
            x += (0.5 * s * s).cos() / f64::from(n);
            y += (0.5 * s * s).sin() / f64::from(n);
        }
        let end = curve.pose_at(1.0);
        assert!((end.position - Point::new(x, y)).norm() < 1e-5, "{end:?} {x} {y}");
        assert!((end.heading_rad - 0.5).abs() < 1e-12);
        assert!((curve.length_m() - 1.0).abs() < 1e-12);
        assert!((curve.curvature_at(0.55) - 0.55).abs() < 1e-12);
    }

    #[test]
    fn the_car_is_found_beside_the_curve_with_its_speed_limit() {
        let curve = TailCurve::laid_out(&tail(&[1.5; 11]), Pose::new(3.0, 1.0, 2.0)).unwrap();
        let foot = curve.pose_at(0.43);
        let left = heading_vector(foot.heading_rad + std::f64::consts::FRAC_PI_2);
        let car = Pose {
            position: foot.position + left * 0.05,
            heading_rad: wrap_angle(foot.heading_rad - 0.1),
        };
        let found = curve.locate_car(car, 0.0);
        assert!((found.s_m - 0.43).abs() < 1e-4, "{found:?}");
        assert!((found.offset_m - 0.05).abs() < 1e-4);
        assert!((found.heading_error_rad + 0.1).abs() < 1e-3);
        // v^2 = 4 * (10 - s / 0.1)
        assert!((found.speed_mps.powi(2) - 40.0 * (1.0 - found.s_m)).abs() < 1e-9);
        assert!((found.accel_mps2 + 20.0).abs() < 1e-9);
        let past = curve.pose_at(1.2);
        let found = curve.locate_car(past, 0.9);
        assert!(found.beyond_m > 0.15 && found.speed_mps == 0.0, "{found:?}");
    }

    #[test]
    fn an_anchored_tail_starts_beside_the_remembered_pose() {
        let mut track = OdometryTrack::in_own_frame(1.0);
        for i in 0..50_u64 {
            track.push(&Odometry {
                stamp: Instant::from_nanos(i * 10_000_000),
                travelled_m: 0.05 * i as f64,
                turned_rad: 7.0,
                speed_mps: 5.0,
                yaw_rate_rps: 0.0,
                steering_curvature_pm: 0.0,
            });
        }
        let tail = BrakingTail {
            anchor_travelled_m: 2.0,
            anchor_turned_rad: 7.1,
            anchor_offset_m: 0.03,
            ..tail(&[0.0, 0.0])
        };
        let curve = TailCurve::anchored(&tail, &track).unwrap();
        let car = track.pose_at_travelled(2.0).unwrap();
        let found = curve.locate_car(car, 0.0);
        assert!((found.offset_m - 0.03).abs() < 1e-12 && found.s_m.abs() < 1e-9);
        assert!((found.heading_error_rad + 0.1).abs() < 1e-12);
        let forgotten = BrakingTail { anchor_travelled_m: -1.0, ..tail };
        assert_eq!(TailCurve::anchored(&forgotten, &track).unwrap_err(), TailError::Anchor(-1.0));
    }

    #[test]
    fn broken_tails_are_refused() {
        let start = Pose::new(0.0, 0.0, 0.0);
        let good = tail(&[0.0, 0.0, 0.0]);
        let refused = |t: &BrakingTail| TailCurve::laid_out(t, start).unwrap_err();
        assert_eq!(refused(&BrakingTail::default()), TailError::Empty);
        assert_eq!(
            refused(&BrakingTail { spacing_m: 0.0, ..good.clone() }),
            TailError::Spacing(0.0)
        );
        let mut moving = good.clone();
        moving.samples[2].speed_mps = 1.0;
        assert_eq!(refused(&moving), TailError::EndsMoving(1.0));
        let mut broken = good.clone();
        broken.samples[1].speed_mps = f64::NAN;
        assert_eq!(refused(&broken), TailError::Sample(1));
        broken.samples[1] = TailSample { curvature_pm: f64::INFINITY, speed_mps: 1.0 };
        assert_eq!(refused(&broken), TailError::Sample(1));
    }

    #[test]
    fn a_bend_gets_what_the_tyres_hold_and_less_where_that_is_not_enough() {
        for (wished, share) in
            [(0.0, 0.0), (4.0, 4.0), (-8.0, -8.0), (8.4, 7.6), (-9.0, -7.0), (20.0, 6.4)]
        {
            assert!((bend_share(wished, 8.0) - share).abs() < 1e-9, "{wished}");
        }
    }

    #[test]
    fn a_single_sample_is_a_place_to_stand() {
        let curve = TailCurve::laid_out(&tail(&[0.7]), Pose::new(0.0, 0.0, 0.0)).unwrap();
        let found = curve.locate_car(Pose::new(0.5, 0.01, 0.0), 0.0);
        assert_eq!((found.s_m, found.speed_mps), (0.0, 0.0));
        assert!((found.beyond_m - 0.5).abs() < 1e-9);
    }
}
