//! The fastest speed profile on a fixed path: friction circle, speed caps, a given start speed, and
//! rest (or a given speed) at the end.
//!
//! With `b = v^2` at the samples and constant acceleration `a = (b1 - b0) / (2 ds)` in between
//! (Verscheure et al. 2009; Lipp and Boyd 2014), every edge must satisfy `|(a, kappa b)| <= A` with
//! the curvature and the `b` of *both* of its ends. A backward pass finds the largest `b` from
//! which the rest of the path can be driven, a forward pass drives as fast as that allows (the two
//! passes of time-optimal path parameterisation by reachability analysis, Pham and Pham 2018). All
//! steps have closed forms, so a profile costs O(samples).
//!
//! Between the samples the lateral acceleration is the product of a linear curvature and a linear
//! `b`. It exceeds the larger end value only where the two run in opposite directions; for equal
//! products at the ends by `(kappa ds)^2 a^2 / A^2`, which is 1 % at a curvature of 2 per metre
//! and 0.05 m between samples. [`HARD_USE`] leaves room for twice that.

use super::path::{PathPoint, TrajectoryPoint};
use crate::tunables;
use crate::vehicle::VehicleParams;

#[cfg(test)]
mod tests;

/// Share of the tyres' force that a profile may use at its samples where the wished share cannot be
/// kept from the given start speed; the remaining 2 % cover what happens between the samples.
pub const HARD_USE: f64 = 0.98;

/// A speed cap is at least this, m/s: otherwise a path would take for ever.
pub const SLOWEST_CAP_MPS: f64 = 1e-3;

tunables! {
    /// How fast a path is driven.
    pub struct SpeedParams in "speed" {
        /// Highest speed.
        speed_max_mps: f64 = 4.0, live, in 0.1..=20.0, "m/s";
        /// Share of the tyres' force that a plan may use; the rest is for the feedback that keeps
        /// the car on it.
        friction_use: f64 = 0.95, live, in 0.3..=0.98, "";
        /// Highest acceleration of the drive, where the motor gives less than the tyres hold.
        accel_max_mps2: f64 = 50.0, live, in 0.1..=50.0, "m/s^2";
        /// Highest deceleration of the brakes, where they give less than the tyres hold.
        brake_max_mps2: f64 = 50.0, live, in 0.1..=50.0, "m/s^2";
    }
}

/// What a profile must keep to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpeedLimits {
    /// Speed cap, m/s.
    pub speed_max_mps: f64,
    /// Radius of the friction circle to plan with, m/s^2.
    pub accel_limit_mps2: f64,
    /// Radius of the friction circle that may be used as long as the start speed is too high for
    /// the one above (a plan that starts on an earlier one does so by a rounding of the sampling),
    /// m/s^2; not below `accel_limit_mps2`.
    pub hard_limit_mps2: f64,
    /// Cap on the acceleration along the path, m/s^2.
    pub accel_max_mps2: f64,
    /// Cap on the deceleration along the path, m/s^2.
    pub brake_max_mps2: f64,
}

impl SpeedLimits {
    /// The limits of a car driven with these parameters.
    pub fn new(speed: &SpeedParams, vehicle: &VehicleParams) -> Self {
        let tyres = vehicle.acceleration_limit_mps2();
        Self {
            speed_max_mps: speed.speed_max_mps,
            accel_limit_mps2: speed.friction_use * tyres,
            hard_limit_mps2: speed.friction_use.max(HARD_USE) * tyres,
            accel_max_mps2: speed.accel_max_mps2,
            brake_max_mps2: speed.brake_max_mps2,
        }
    }
}

/// How a profile ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum End {
    /// At rest.
    Rest,
    /// No faster than this, m/s (for costs; such a profile is never executed).
    Speed(f64),
}

/// The conditions of one profile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpeedTask<'a> {
    /// Speed at the first sample, m/s.
    pub start_speed_mps: f64,
    /// How it ends at the last sample.
    pub end: End,
    /// Further speed caps, one per sample, at least 0.001 m/s.
    pub caps_mps: Option<&'a [f64]>,
}

/// Why there is no profile.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SpeedError {
    /// A path without samples.
    #[error("the path has no samples")]
    Empty,
    /// Rest to rest needs a sample in between at which to move.
    #[error("a path from rest to rest needs three samples, this one has {samples}")]
    TooFewSamples {
        /// How many there are.
        samples: usize,
    },
    /// Arc length does not grow, or a number is not finite.
    #[error(
        "sample {sample} has arc length {s_m} m and curvature {curvature_pm}/m; arc length must increase and both be finite"
    )]
    BadSample {
        /// Its index.
        sample: usize,
        /// Its arc length, metres.
        s_m: f64,
        /// Its curvature, 1/m.
        curvature_pm: f64,
    },
    /// The caps do not belong to the path.
    #[error("{caps} speed caps for {samples} samples")]
    CapCount {
        /// Caps given.
        caps: usize,
        /// Samples of the path.
        samples: usize,
    },
    /// A limit, cap or speed is negative, zero where it must not be, or not a number.
    #[error("{what} is {value}, must be {wanted}")]
    BadNumber {
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        wanted: &'static str,
    },
    /// From this start speed the car can neither stop in time nor take the bends ahead.
    #[error(
        "start speed {given_mps:.3} m/s, at most {allowed_mps:.3} m/s lets the car keep to the path and stop"
    )]
    StartTooFast {
        /// The highest start speed for which there is a profile, m/s.
        allowed_mps: f64,
        /// The start speed given, m/s.
        given_mps: f64,
    },
}

/// Computes profiles; keeps its scratch memory from one to the next.
#[derive(Clone, Debug, Default)]
pub struct SpeedProfiler {
    /// Largest `v^2` at each sample from which the rest can be driven within the limits.
    envelope: Vec<f64>,
    /// The same for the hard friction circle and without caps; filled only where needed.
    hard: Vec<f64>,
    /// `v^2` of the profile.
    squares: Vec<f64>,
}

/// The dynamic limits as the two passes need them.
#[derive(Clone, Copy)]
struct Circle {
    radius: f64,
    squared: f64,
    accel: f64,
    brake: f64,
}

impl Circle {
    fn new(radius: f64, limits: &SpeedLimits) -> Self {
        let (accel, brake) = (limits.accel_max_mps2, limits.brake_max_mps2);
        Self { radius, squared: radius * radius, accel, brake }
    }

    /// Larger solution `y` of `(y - x)^2 = d^2 (A^2 - k^2 y^2)`, the discriminant clamped at zero:
    /// the largest speed square at one end of an edge that its own friction circle allows, given
    /// the other end's `x`. `d` is twice the edge's length. (The root's sign gives the smaller one.)
    #[inline]
    fn reach(&self, x: f64, k: f64, d: f64, sign: f64) -> f64 {
        let (k2, kd) = (k * k, k * d);
        let w = 1.0 + kd * kd;
        (x + sign * d * (self.squared * w - k2 * x * x).max(0.0).sqrt()) / w
    }

    /// What the circle leaves for accelerating or braking at speed square `b`.
    #[inline]
    fn along(&self, b: f64, k: f64) -> f64 {
        let lateral = k * b;
        (self.squared - lateral * lateral).max(0.0).sqrt()
    }

    /// The largest `b` at the start of an edge from which some `c <= next` is reached at its end:
    /// the maximum over `c` of `min(c + d * min(brake, along(c)), reach(c))`, a concave function.
    #[inline]
    fn before(&self, next: f64, k0: f64, k1: f64, d: f64) -> f64 {
        // At the tip of the start's circle the speed is the highest that it allows at all, and
        // staying at that speed reaches `next` or less.
        if k0 * next >= self.radius {
            return self.radius / k0;
        }
        let k1d = k1 * d;
        let w1 = 1.0 + k1d * k1d;
        let mut c = next;
        // Beyond `A / (k1 sqrt(w1))` a faster end loses more braking than it gains. Going down from
        // `next` pays until the end's circle is no longer what binds, at the latest to there. (With
        // `k0 >= k1` the start's circle is always the tighter one.)
        if k0 < k1 && k1 * k1 * next * next * w1 > self.squared {
            let top = self.radius / (k1 * w1.sqrt());
            let both_circles = d * self.radius * k0 / (k1 - k0).hypot(k1d * k0);
            let brakes = (self.squared - self.brake * self.brake).max(0.0).sqrt() / k1;
            // By rounding `top` may be above `next`.
            c = both_circles.max(brakes).max(top).min(next);
        }
        let end = c + d * self.brake.min(self.along(c, k1));
        end.min(self.reach(c, k0, d, 1.0))
    }

    /// The largest speed square at the end of an edge that starts with `b`.
    #[inline]
    fn fastest_after(&self, b: f64, k0: f64, k1: f64, d: f64) -> f64 {
        let start = b + d * self.accel.min(self.along(b, k0));
        start.min(self.reach(b, k1, d, 1.0))
    }

    /// The smallest speed square at the end of an edge that starts with `b`.
    #[inline]
    fn slowest_after(&self, b: f64, k0: f64, k1: f64, d: f64) -> f64 {
        let start = b - d * self.brake.min(self.along(b, k0));
        start.max(self.reach(b, k1, d, -1.0)).max(0.0)
    }
}

impl SpeedProfiler {
    /// An empty profiler.
    pub fn new() -> Self {
        Self::default()
    }

    /// The fastest profile, written to `out` (replacing what it held). Times start at zero.
    pub fn profile(
        &mut self,
        path: &[PathPoint],
        limits: &SpeedLimits,
        task: &SpeedTask<'_>,
        out: &mut Vec<TrajectoryPoint>,
    ) -> Result<(), SpeedError> {
        out.clear();
        self.solve(path, limits, task)?;
        out.reserve(path.len());
        let (mut t, mut speed) = (0.0, self.squares[0].sqrt());
        for (i, point) in path.iter().enumerate() {
            let Some(next) = path.get(i + 1) else {
                out.push(TrajectoryPoint {
                    path: *point,
                    t_s: t,
                    speed_mps: speed,
                    accel_mps2: 0.0,
                });
                break;
            };
            let ds = next.s_m - point.s_m;
            let end = self.squares[i + 1].sqrt();
            let accel = (self.squares[i + 1] - self.squares[i]) / (2.0 * ds);
            out.push(TrajectoryPoint { path: *point, t_s: t, speed_mps: speed, accel_mps2: accel });
            t += 2.0 * ds / (speed + end);
            speed = end;
        }
        Ok(())
    }

    /// Duration of the fastest profile in seconds, for comparing paths.
    pub fn travel_time_s(
        &mut self,
        path: &[PathPoint],
        limits: &SpeedLimits,
        task: &SpeedTask<'_>,
    ) -> Result<f64, SpeedError> {
        self.solve(path, limits, task)?;
        let (mut t, mut speed) = (0.0, self.squares[0].sqrt());
        for (edge, b) in path.windows(2).zip(&self.squares[1..]) {
            let end = b.sqrt();
            t += 2.0 * (edge[1].s_m - edge[0].s_m) / (speed + end);
            speed = end;
        }
        Ok(t)
    }

    /// Largest speed at each sample of the latest path from which the rest of it can be driven
    /// within the planning limits, squared, m^2/s^2.
    pub fn envelope_squared(&self) -> &[f64] {
        &self.envelope
    }

    fn solve(
        &mut self,
        path: &[PathPoint],
        limits: &SpeedLimits,
        task: &SpeedTask<'_>,
    ) -> Result<(), SpeedError> {
        check(path, limits, task)?;
        let end_square = match task.end {
            End::Rest => 0.0,
            End::Speed(v) => v * v,
        };
        let circle = Circle::new(limits.accel_limit_mps2, limits);
        let cap = limits.speed_max_mps * limits.speed_max_mps;
        let own = task.caps_mps;
        fill_envelope(&mut self.envelope, path, &circle, end_square, |i| {
            own.map_or(cap, |caps| cap.min(caps[i] * caps[i]))
        });

        let start = task.start_speed_mps * task.start_speed_mps;
        if start == 0.0 && path.len() == 2 && self.envelope[1] == 0.0 {
            return Err(SpeedError::TooFewSamples { samples: 2 });
        }
        let allowed = self.envelope[0];
        // A few roundings: the start speed usually is the root of such a square.
        const SLACK: f64 = 1.0 + 1e-12;
        if start <= allowed * SLACK {
            self.forward(path, &circle, start.min(allowed));
            return Ok(());
        }
        let hard = Circle::new(limits.hard_limit_mps2, limits);
        fill_envelope(&mut self.hard, path, &hard, end_square, |_| f64::INFINITY);
        if start > self.hard[0] * SLACK {
            return Err(SpeedError::StartTooFast {
                allowed_mps: allowed.max(self.hard[0]).sqrt(),
                given_mps: task.start_speed_mps,
            });
        }
        self.forward_from_above(path, &circle, &hard, start.min(self.hard[0]));
        Ok(())
    }

    /// Drives as fast as the envelope allows.
    fn forward(&mut self, path: &[PathPoint], circle: &Circle, start: f64) {
        self.squares.clear();
        self.squares.reserve(path.len());
        self.squares.push(start);
        let mut b = start;
        for (edge, limit) in path.windows(2).zip(&self.envelope[1..]) {
            let (k0, k1, d) = edge_numbers(edge);
            b = circle.fastest_after(b, k0, k1, d).min(*limit);
            self.squares.push(b);
        }
    }

    /// The same for a start above the envelope: brakes on the hard circle until below it.
    fn forward_from_above(
        &mut self,
        path: &[PathPoint],
        circle: &Circle,
        hard: &Circle,
        start: f64,
    ) {
        self.squares.clear();
        self.squares.push(start);
        let mut b = start;
        for (i, edge) in path.windows(2).enumerate() {
            let (k0, k1, d) = edge_numbers(edge);
            let limit = self.envelope[i + 1];
            b = if b <= self.envelope[i] {
                circle.fastest_after(b, k0, k1, d).min(limit)
            } else {
                let fastest = hard.fastest_after(b, k0, k1, d).min(self.hard[i + 1]);
                hard.slowest_after(b, k0, k1, d).max(limit).min(fastest)
            };
            self.squares.push(b);
        }
    }
}

/// Curvatures at both ends, without sign, and twice the length of an edge.
#[inline]
fn edge_numbers(edge: &[PathPoint]) -> (f64, f64, f64) {
    let d = 2.0 * (edge[1].s_m - edge[0].s_m);
    (edge[0].curvature_pm.abs(), edge[1].curvature_pm.abs(), d)
}

/// The backward pass: largest speed square at each sample from which the end can be reached within
/// caps and circle.
fn fill_envelope(
    envelope: &mut Vec<f64>,
    path: &[PathPoint],
    circle: &Circle,
    end_square: f64,
    cap: impl Fn(usize) -> f64,
) {
    envelope.clear();
    envelope.resize(path.len(), 0.0);
    let last = path.len() - 1;
    // Division by a curvature of zero gives the infinity that is meant.
    let friction = circle.radius / path[last].curvature_pm.abs();
    let mut b = cap(last).min(friction).min(end_square);
    envelope[last] = b;
    for (i, edge) in path.windows(2).enumerate().rev() {
        let (k0, k1, d) = edge_numbers(edge);
        b = circle.before(b, k0, k1, d).min(cap(i));
        envelope[i] = b;
    }
}

fn check(path: &[PathPoint], limits: &SpeedLimits, task: &SpeedTask<'_>) -> Result<(), SpeedError> {
    let positive = |what, value: f64| {
        if value > 0.0 && value.is_finite() {
            return Ok(());
        }
        Err(SpeedError::BadNumber { what, value, wanted: "finite and above zero" })
    };
    let not_negative = |what, value: f64| {
        if value >= 0.0 && value.is_finite() {
            return Ok(());
        }
        Err(SpeedError::BadNumber { what, value, wanted: "finite and not negative" })
    };
    positive("speed_max_mps", limits.speed_max_mps)?;
    positive("accel_limit_mps2", limits.accel_limit_mps2)?;
    positive("hard_limit_mps2", limits.hard_limit_mps2)?;
    positive("accel_max_mps2", limits.accel_max_mps2)?;
    positive("brake_max_mps2", limits.brake_max_mps2)?;
    if limits.hard_limit_mps2 < limits.accel_limit_mps2 {
        return Err(SpeedError::BadNumber {
            what: "hard_limit_mps2",
            value: limits.hard_limit_mps2,
            wanted: "at least accel_limit_mps2",
        });
    }
    not_negative("start speed", task.start_speed_mps)?;
    if let End::Speed(v) = task.end {
        not_negative("end speed", v)?;
    }
    if let Some(caps) = task.caps_mps {
        if caps.len() != path.len() {
            return Err(SpeedError::CapCount { caps: caps.len(), samples: path.len() });
        }
        for &cap in caps {
            // An infinite cap is no cap; one near zero would be a stop in mid-path, for ever.
            if cap.is_nan() || cap < SLOWEST_CAP_MPS {
                let wanted = "at least 0.001 m/s";
                return Err(SpeedError::BadNumber { what: "speed cap", value: cap, wanted });
            }
        }
    }
    if path.is_empty() {
        return Err(SpeedError::Empty);
    }
    let mut before = f64::NEG_INFINITY;
    for (sample, p) in path.iter().enumerate() {
        let increasing = p.s_m > before && p.s_m.is_finite();
        if !increasing || !p.curvature_pm.is_finite() {
            return Err(SpeedError::BadSample { sample, s_m: p.s_m, curvature_pm: p.curvature_pm });
        }
        before = p.s_m;
    }
    Ok(())
}
