//! The region that one scan proves free: a fan of triangles between neighbouring beams.
//!
//! Two neighbouring beams with directions `u`, `v` and ranges `a`, `b` prove the triangle from the
//! sensor to `a' u` and `b' v`. What bounds it in between is a choice:
//!
//! - Where the two end points and one more neighbour lie on one straight line (the next end point
//!   lies within [`Limits::straight_m`] of the continued line), the surface is taken to run
//!   straight between them: `a' = a`, `b' = b`. Without this the floor along a wall seen at a
//!   grazing angle would stay unknown until the car has driven past.
//! - Anywhere else a surface may begin or end between the beams, so both sides get the shorter
//!   range less half the beam spacing there, `a' = b' = min(a, b) (1 - angle/2)`: a right-angled
//!   or blunter corner that points at the sensor between two beams reaches at most half their
//!   spacing in front of the nearer end point.
//!
//! What remains unseen is a part of an obstacle that lies between two neighbouring beams and
//! touches neither; it is thinner than their spacing, which is held below [`Limits::spacing_m`].
//! A beam without a range proves nothing, and neither do the two gaps beside it.

use std::f64::consts::{PI, TAU};

use crate::frames::{Point, Pose, Vector};
use crate::scan::Scan;

/// Gaps wider than this prove nothing: a handful of beams is not a fan.
const GAP_MAX_RAD: f64 = 0.5;
/// By how many steps rounding of the step may displace the last beam of a turn. Thousands of beams
/// with a step given to 1e-9 rad stay below 0.002.
const ROUNDING_BEAMS: f64 = 0.01;

/// What a scan must satisfy to prove space free.
#[derive(Clone, Copy, Debug)]
pub(super) struct Limits {
    /// Largest distance between neighbouring beams, metres.
    pub spacing_m: f64,
    /// Largest distance of an end point from the line through its neighbours that still counts as
    /// one straight surface, metres.
    pub straight_m: f64,
    /// Ranges are cut here, metres.
    pub range_m: f64,
}

/// One beam, in the map's axes.
#[derive(Clone, Copy, Debug)]
struct Beam {
    /// Direction.
    u: Vector,
    /// One over the direction's components, never infinite.
    inverse: Vector,
    /// How far a square that the beam crosses may reach along it, metres; negative for never.
    limit_m: f64,
}

/// The triangle between a beam and the next one counter-clockwise.
#[derive(Clone, Copy, Debug)]
struct Gap {
    /// End on the first beam, relative to the sensor.
    from: Vector,
    /// From there to the end on the second beam.
    along: Vector,
    /// Whether it proves anything at all.
    open: bool,
}

/// The end of a beam on a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// End point, map frame.
    pub end: Point,
    /// Unit vector into the surface: its normal where its direction is known, else the beam's.
    pub into: Vector,
    /// Whether the surface's direction is not known.
    pub lone: bool,
}

/// The proven-free region of the last scan given to [`set`](Self::set).
#[derive(Clone, Debug, Default)]
pub(super) struct Fan {
    /// Directions in the body frame, kept while the lidar's layout stays the same.
    body: Vec<Vector>,
    layout: Option<(f64, f64, usize)>,
    /// Range in metres, NaN for a beam that says nothing.
    ranges: Vec<f64>,
    returned: Vec<bool>,
    /// Whether the surface runs straight from this end point to the next.
    straight: Vec<bool>,
    beams: Vec<Beam>,
    gaps: Vec<Gap>,
    /// Square of the farthest that the region can reach in each gap and its neighbours.
    reach2: Vec<f32>,
    /// Radius that is proven free in both gaps beside each beam, metres.
    clear_m: Vec<f32>,
    full: bool,
    /// How far the beam coordinate may be off, with two beams to spare.
    slack: f32,
    first_rad: f32,
    per_rad: f32,
    period: f32,
    radius_m: f64,
    sensor: Point,
}

impl Fan {
    /// Takes a scan measured at `pose`. The caller has checked that all numbers are sane (finite,
    /// step not zero, range positive).
    pub fn set(&mut self, pose: &Pose, scan: &Scan, limits: &Limits) {
        let step = scan.angle_step_rad.abs();
        let count = scan.ranges_m.len();
        // Beams past a whole turn repeat the first ones. The step came over the bus, rounded: a turn
        // that seems to miss the first beam by a hair is a whole one all the same, and the gap
        // that closes it has its own width.
        let turn = (TAU / step - ROUNDING_BEAMS).ceil();
        self.full = count as f64 + 0.5 >= turn;
        let n = if self.full { count.min(turn as usize) } else { count };
        self.lay_out(scan, n);
        self.sensor = pose.position;
        let reversed = scan.angle_step_rad < 0.0;
        let range_max = scan.range_max_m.min(limits.range_m);
        self.ranges.clear();
        self.returned.clear();
        for i in 0..n {
            let range = f64::from(scan.ranges_m[if reversed { n - 1 - i } else { i }]);
            // Zero and negative ranges are what some drivers put for "no measurement".
            self.ranges.push(if range > 0.0 { range.min(range_max) } else { f64::NAN });
            self.returned.push(range > 0.0 && range < range_max);
        }
        let (sin, cos) = pose.heading_rad.sin_cos();
        self.beams.clear();
        self.beams.extend(self.body.iter().map(|b| {
            let u = Vector::new(cos * b.x - sin * b.y, sin * b.x + cos * b.y);
            let inverse = |c: f64| 1.0 / if c.abs() < 1e-12 { 1e-12_f64.copysign(c) } else { c };
            Beam { u, inverse: Vector::new(inverse(u.x), inverse(u.y)), limit_m: -1.0 }
        }));
        let closing = TAU - step * (n as f64 - 1.0);
        let widest = if self.full { step.max(closing) } else { step };
        self.radius_m = if widest < GAP_MAX_RAD { limits.spacing_m / widest } else { 0.0 };
        let first = if reversed { n - 1 } else { 0 };
        self.first_rad = (pose.heading_rad + scan.angle_rad(first)).rem_euclid(TAU) as f32;
        self.per_rad = (1.0 / step) as f32;
        self.period = (TAU / step) as f32;
        self.slack = 2.0 + 5e-5 * self.per_rad;
        self.find_straight(limits.straight_m);
        self.span_gaps(step, closing);
    }

    /// Radius around the sensor beyond which the beams stand too far apart, metres.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Longest range, metres.
    pub fn range_m(&self) -> f64 {
        self.ranges.iter().copied().fold(0.0, f64::max)
    }

    /// The smallest box that holds the sensor and every beam's end: lower and upper corner.
    pub fn extent(&self) -> (Point, Point) {
        let (mut low, mut high) = (self.sensor, self.sensor);
        for (beam, range) in self.beams.iter().zip(&self.ranges) {
            if !range.is_nan() {
                let end = self.sensor + beam.u * *range;
                low = low.inf(&end);
                high = high.sup(&end);
            }
        }
        (low, high)
    }

    /// Every beam that ended on a surface, counter-clockwise.
    pub fn hits(&self) -> impl Iterator<Item = Hit> + '_ {
        (0..self.beams.len()).filter(|i| self.returned[*i]).map(|i| {
            let normal = self.normal(i);
            let into = normal.unwrap_or(self.beams[i].u);
            Hit { end: self.sensor + self.end(i), into, lone: normal.is_none() }
        })
    }

    /// A cheap answer to [`covers`](Self::covers) for a square centred at `(x, y)` metres from the
    /// sensor with half a diagonal of `half_diagonal_m`, or `None` where only the exact test tells.
    /// "No" may be a little too careful at the ends of a partial fan.
    #[inline]
    pub fn glance(&self, x: f32, y: f32, half_diagonal_m: f32) -> Option<bool> {
        let at = self.beam_coordinate(x, y);
        let distance2 = x * x + y * y;
        // A partial fan has no gap behind its last beam. In a full one a direction may come to lie
        // there by a hair.
        let last = self.reach2.len().wrapping_sub(1);
        let gap = if self.full { (at as usize).min(last) } else { at as usize };
        if self.reach2.get(gap).is_none_or(|reach2| distance2 > *reach2) {
            return Some(false);
        }
        let distance = distance2.sqrt();
        let far = distance + half_diagonal_m;
        if distance < 4.0 * half_diagonal_m || f64::from(far) > self.radius_m {
            return None;
        }
        // asin(t) < 1.02 t up to t = 1/4; two beams more on each side cover the coordinate's error
        // and a closing gap of another width.
        let aside = 1.02 * half_diagonal_m / distance * self.per_rad + self.slack;
        let n = self.clear_m.len() as i32;
        let (first, last) = ((at - aside).floor() as i32, (at + aside).ceil() as i32);
        if !self.full && (first < 0 || last >= n) || last - first >= n {
            return None;
        }
        let clear = if first < 0 {
            let (tail, head) =
                (&self.clear_m[(first + n) as usize..], &self.clear_m[..=last as usize]);
            tail.iter().chain(head).all(|clear| *clear >= far)
        } else if last >= n {
            let (tail, head) =
                (&self.clear_m[first as usize..], &self.clear_m[..=(last - n) as usize]);
            tail.iter().chain(head).all(|clear| *clear >= far)
        } else {
            self.clear_m[first as usize..=last as usize].iter().all(|clear| *clear >= far)
        };
        clear.then_some(true)
    }

    /// Whether a square is proven free, given by its centre relative to the sensor (map axes) and half
    /// its side, metres.
    #[inline]
    pub fn shows(&self, centre: Vector, half_m: f64) -> bool {
        let half = Vector::repeat(half_m);
        self.glance(centre.x as f32, centre.y as f32, half.norm() as f32)
            .unwrap_or_else(|| self.covers(centre - half, centre + half))
    }

    /// Whether the whole rectangle `low..high` (relative to the sensor, map axes) is proven free.
    pub fn covers(&self, low: Vector, high: Vector) -> bool {
        let far = low.abs().sup(&high.abs());
        if far.norm() > self.radius_m {
            return false;
        }
        let corners = [
            Vector::new(low.x, low.y),
            Vector::new(high.x, low.y),
            Vector::new(high.x, high.y),
            Vector::new(low.x, high.y),
        ];
        let mut gaps = [0; 4];
        for (gap, corner) in gaps.iter_mut().zip(corners) {
            let Some(found) = self.gap_of(corner) else { return false };
            let g = &self.gaps[found];
            if !g.open || g.along.perp(&(corner - g.from)) < 0.0 {
                return false;
            }
            *gap = found;
        }
        // A convex square lies inside the triangles if its corners do and if every beam across it
        // leaves it before its limit.
        let n = self.beams.len();
        let (first, crossed) = match silhouette(low, high) {
            Some((clockwise, counter)) => {
                let (from, to) = (gaps[clockwise], gaps[counter]);
                (from + 1, if to >= from { to - from } else { to + n - from })
            }
            None if self.full => (0, n),
            None => return false,
        };
        (first..first + crossed).all(|i| {
            let beam = &self.beams[if i >= n { i - n } else { i }];
            let x = if beam.u.x > 0.0 { high.x } else { low.x } * beam.inverse.x;
            let y = if beam.u.y > 0.0 { high.y } else { low.y } * beam.inverse.y;
            x.min(y) <= beam.limit_m
        })
    }

    fn lay_out(&mut self, scan: &Scan, n: usize) {
        let layout = (scan.angle_first_rad, scan.angle_step_rad, n);
        if self.layout != Some(layout) {
            let reversed = scan.angle_step_rad < 0.0;
            self.body.clear();
            self.body.extend((0..n).map(|i| {
                let (sin, cos) = scan.angle_rad(if reversed { n - 1 - i } else { i }).sin_cos();
                Vector::new(cos, sin)
            }));
            self.layout = Some(layout);
        }
    }

    fn end(&self, i: usize) -> Vector {
        self.beams[i].u * self.ranges[i]
    }

    /// The beam `steps` further counter-clockwise, or `None` past a fan's end.
    fn neighbour(&self, i: usize, steps: isize) -> Option<usize> {
        let n = self.beams.len() as isize;
        let j = i as isize + steps;
        if self.full {
            Some(j.rem_euclid(n) as usize)
        } else {
            (0..n).contains(&j).then_some(j as usize)
        }
    }

    fn find_straight(&mut self, tolerance_m: f64) {
        // Whether `c` lies on the line through `a` and `b`.
        let on_line = |a: Vector, b: Vector, c: Vector| {
            let along = b - a;
            let length = along.norm();
            length > 1e-6 && along.perp(&(c - a)).abs() <= tolerance_m * length
        };
        self.straight.clear();
        for i in 0..self.beams.len() {
            let end_of = |steps| {
                let j = self.neighbour(i, steps)?;
                self.returned[j].then(|| self.end(j))
            };
            let straight = match (end_of(-1), end_of(0), end_of(1), end_of(2)) {
                (before, Some(a), Some(b), after) => {
                    before.is_some_and(|p| on_line(p, a, b))
                        || after.is_some_and(|q| on_line(b, q, a))
                }
                _ => false,
            };
            self.straight.push(straight);
        }
    }

    fn span_gaps(&mut self, step: f64, closing: f64) {
        let n = self.beams.len();
        self.gaps.clear();
        self.reach2.clear();
        let gaps = if self.full { n } else { n.saturating_sub(1) };
        for beam in &mut self.beams {
            beam.limit_m = f64::INFINITY;
        }
        for i in 0..gaps {
            let j = if i + 1 == n { 0 } else { i + 1 };
            let (a, b) = (self.ranges[i], self.ranges[j]);
            let (a, b) = if self.straight[i] {
                (a, b)
            } else if a.is_nan() || b.is_nan() {
                (-1.0, -1.0)
            } else {
                let angle = if j == 0 { closing } else { step };
                let shorter = a.min(b) * (1.0 - 0.5 * angle);
                (shorter, shorter)
            };
            let from = self.beams[i].u * a;
            self.gaps.push(Gap { from, along: self.beams[j].u * b - from, open: a > 0.0 });
            self.beams[i].limit_m = self.beams[i].limit_m.min(a);
            self.beams[j].limit_m = self.beams[j].limit_m.min(b);
        }
        // A chord is nearest in its middle, by the cosine of half its angle; and one part in 10^5
        // for single precision.
        let chord = (0.5 * step.max(closing.min(GAP_MAX_RAD))).cos() * (1.0 - 1e-5);
        self.clear_m.clear();
        self.clear_m.extend(self.beams.iter().map(|beam| (beam.limit_m * chord) as f32));
        for i in 0..gaps {
            let reach = (-1..=2)
                .filter_map(|steps| self.neighbour(i, steps))
                .map(|j| self.ranges[j])
                .fold(0.0, f64::max)
                .min(self.radius_m);
            self.reach2.push((reach * reach) as f32);
        }
    }

    /// Unit normal of the surface at an end point, away from the sensor.
    fn normal(&self, i: usize) -> Option<Vector> {
        // Millimetre steps of the range turn shorter chords at will.
        const CHORD_MIN_M: f64 = 0.005;
        let chord = |a: usize, b: usize| {
            let along = self.end(b) - self.end(a);
            let length = along.norm();
            // Counter-clockwise chord: its right-hand normal points away from the sensor.
            (self.straight[a] && length >= CHORD_MIN_M)
                .then(|| Vector::new(along.y, -along.x) / length)
        };
        let next = self.neighbour(i, 1).and_then(|j| chord(i, j));
        next.or_else(|| self.neighbour(i, -1).and_then(|j| chord(j, i)))
    }

    /// Direction in beams from the first one, in `0..period`; good to a hundredth of a beam.
    #[inline]
    fn beam_coordinate(&self, x: f32, y: f32) -> f32 {
        let t = (angle_of(x, y) - self.first_rad) * self.per_rad;
        if t < 0.0 { t + self.period } else { t }
    }

    /// The gap that holds the direction of `p`.
    fn gap_of(&self, p: Vector) -> Option<usize> {
        let n = self.beams.len();
        let mut i = (self.beam_coordinate(p.x as f32, p.y as f32) as usize).min(n - 1);
        // The coordinate is approximate: step to the gap whose beams really enclose the direction.
        for _ in 0..3 {
            if self.beams[i].u.perp(&p) < 0.0 {
                i = self.neighbour(i, -1)?;
                continue;
            }
            let next = self.neighbour(i, 1)?;
            if self.beams[next].u.perp(&p) < 0.0 {
                return Some(i);
            }
            i = next;
        }
        None
    }
}

/// Which corners of a rectangle (counted counter-clockwise from the lower left) are seen outermost
/// from the origin, clockwise one first; `None` if the origin lies inside.
fn silhouette(low: Vector, high: Vector) -> Option<(usize, usize)> {
    let side = |low: f64, high: f64| i32::from(low > 0.0) - i32::from(high < 0.0);
    match (side(low.x, high.x), side(low.y, high.y)) {
        (1, 1) => Some((1, 3)),
        (1, 0) => Some((0, 3)),
        (1, _) => Some((0, 2)),
        (0, 1) => Some((1, 0)),
        (0, 0) => None,
        (0, _) => Some((3, 2)),
        (_, 1) => Some((2, 0)),
        (_, 0) => Some((2, 1)),
        _ => Some((3, 1)),
    }
}

/// The direction of `(x, y)` in `0..TAU` by a minimax polynomial of the arc tangent (Hastings 1955,
/// sheet 13): within 1e-5 rad, several times faster than `atan2`.
#[inline]
fn angle_of(x: f32, y: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let a = ax.min(ay) / ax.max(ay).max(f32::MIN_POSITIVE);
    let s = a * a;
    let mut angle = a
        * (0.999_977_26
            + s * (-0.332_623_47
                + s * (0.193_543_46 + s * (-0.116_432_87 + s * (0.052_653_32 - s * 0.011_721_2)))));
    if ay > ax {
        angle = 0.5 * PI as f32 - angle;
    }
    if x < 0.0 {
        angle = PI as f32 - angle;
    }
    if y < 0.0 { TAU as f32 - angle } else { angle }
}

#[cfg(test)]
mod tests;
