//! The constraints of the shape program as second-order cones, four side by side.
//!
//! Each constraint, divided by its bound, is a slack (1, u) in the cone, u = L x + o. Discs are one
//! point each, bends a stencil of three. What is done to each cone for itself is done to four at
//! once; what goes from points to cones and back, and every sum, keeps its order, so that results
//! do not depend on the width of the processor's registers.

use wide::f64x4;

use super::banded::{Banded, V2};
use super::program::Program;

/// Cones side by side.
const WIDTH: usize = 4;

/// A vector of the plane for each of four cones.
type W2 = [f64x4; 2];

fn dot(a: W2, b: W2) -> f64x4 {
    a[0] * b[0] + a[1] * b[1]
}

fn scaled(k: f64x4, v: W2) -> W2 {
    [k * v[0], k * v[1]]
}

fn plus(a: W2, b: W2) -> W2 {
    [a[0] + b[0], a[1] + b[1]]
}

fn minus(a: W2, b: W2) -> W2 {
    [a[0] - b[0], a[1] - b[1]]
}

/// Four cones: constants, iterate and directions.
#[derive(Clone, Copy, Debug, Default)]
struct Four {
    offset: W2,
    /// Slack tail (its head is 1) and multiplier.
    u: W2,
    z0: f64x4,
    z: W2,
    /// Scaling: W = beta * [w0, w'; w, I + w w'/(1 + w0)].
    inv_beta: f64x4,
    w0: f64x4,
    w: W2,
    /// lambda = W z = W^-1 s.
    l0: f64x4,
    l: W2,
    /// Primal residual u - (L x + o).
    res: W2,
    /// Directions: slack tail, multiplier.
    du: W2,
    dz0: f64x4,
    dz: W2,
    /// Jordan product of the predictor's scaled directions; then W^-1 c of the corrector.
    c0: f64x4,
    c: W2,
}

impl Four {
    /// W^-1 of a vector with head `h` and tail `t`.
    fn unscale(&self, h: f64x4, t: W2) -> (f64x4, W2) {
        let wt = dot(self.w, t);
        let k = wt / (1.0 + self.w0) - h;
        (
            self.inv_beta * (self.w0 * h - wt),
            [self.inv_beta * (t[0] + self.w[0] * k), self.inv_beta * (t[1] + self.w[1] * k)],
        )
    }

    /// The Nesterov-Todd scaling of the present iterate; false when one has left its cone.
    fn rescale(&mut self) -> bool {
        let ss = 1.0 - dot(self.u, self.u);
        let zz = self.z0 * self.z0 - dot(self.z, self.z);
        // written so that NaN is false
        let zero = f64x4::splat(0.0);
        if !(ss.simd_gt(zero) & zz.simd_gt(zero) & self.z0.simd_gt(zero)).all() {
            return false;
        }
        let (rs, rz) = (ss.sqrt(), zz.sqrt());
        let (is, iz) = (1.0 / rs, 1.0 / rz);
        let cross = (self.z0 + dot(self.z, self.u)) * is * iz;
        let half = 0.5 / (0.5 * (1.0 + cross)).sqrt();
        self.w0 = half * (is + self.z0 * iz);
        self.w =
            [half * (self.u[0] * is - self.z[0] * iz), half * (self.u[1] * is - self.z[1] * iz)];
        self.inv_beta = (rz * is).sqrt();
        (self.l0, self.l) = self.unscale(f64x4::splat(1.0), self.u);
        true
    }
}

/// For the largest step that keeps (h, t) + step * (dh, dt) in the cone, from inside it: c and q,
/// the step being c / q where q is positive and unlimited where it is not, or is no number.
fn to_boundary(h: f64x4, t: W2, dh: f64x4, dt: W2) -> [f64x4; 2] {
    // The boundary is at the roots of a x^2 + 2 b x + c with c > 0; the smallest positive one, if
    // there is one, is c / (-b + sqrt(b^2 - a c)).
    let a = dh * dh - dot(dt, dt);
    let b = h * dh - dot(t, dt);
    let c = h * h - dot(t, t);
    [c, (b * b - a * c).sqrt() - b]
}

/// What the present iterate amounts to.
pub(super) struct Residuals {
    /// Sum of the products of slacks and multipliers.
    pub(super) gap: f64,
    /// Sum of the products of multipliers and slacks at x = 0.
    pub(super) constant: f64,
    /// Largest difference of a slack from its value, relative to the bound.
    pub(super) primal: f64,
}

/// A row of L.
#[derive(Clone, Copy, Debug)]
struct Row {
    first: usize,
    coef: [f64; 3],
}

/// All cones of a program: discs first (cone i holds point i), then bends, each kind filled up to
/// whole fours with repetitions of its last one, which count for nothing.
#[derive(Clone, Debug, Default)]
pub(super) struct Cones {
    /// Of the discs, 1 / m.
    inverse_radii: Vec<f64>,
    /// Of the bends, divided by their bounds.
    rows: Vec<Row>,
    fours: Vec<Four>,
    /// One entry per cone, for what goes to and from points and for sums.
    lanes: [Vec<f64>; 4],
}

impl Cones {
    /// Number of cones.
    pub(super) fn len(&self) -> usize {
        self.inverse_radii.len() + self.rows.len()
    }

    /// Where the bends begin in `lanes`.
    fn bends_from(&self) -> usize {
        self.inverse_radii.len().next_multiple_of(WIDTH)
    }

    /// Takes up a program whose discs have these centres.
    pub(super) fn load(&mut self, program: &Program, centres: &[crate::frames::Point]) {
        self.inverse_radii.clear();
        self.inverse_radii.extend(program.discs.iter().map(|d| 1.0 / d.radius_m));
        self.rows.clear();
        let bends_from = self.bends_from();
        let count = bends_from + program.bends.len().next_multiple_of(WIDTH);
        for lane in &mut self.lanes {
            lane.clear();
            lane.resize(count, 0.0);
        }
        for (i, bend) in program.bends.iter().enumerate() {
            let inverse = 1.0 / bend.bound_m;
            let stencil = &bend.stencil;
            self.rows.push(Row { first: stencil.first, coef: stencil.coef.map(|c| c * inverse) });
            let offset = stencil.at(centres) * inverse;
            (self.lanes[0][bends_from + i], self.lanes[1][bends_from + i]) = (offset.x, offset.y);
        }
        self.fill_up();
        self.fours.clear();
        self.fours.resize(count / WIDTH, Four::default());
        let [x, y, ..] = &self.lanes;
        for ((four, x), y) in self.fours.iter_mut().zip(chunks(x)).zip(chunks(y)) {
            four.offset = [f64x4::from(*x), f64x4::from(*y)];
        }
    }

    /// Slack from the guess, drawn into the inner part of its cone; multipliers on the central
    /// path.
    pub(super) fn start(&mut self, x: &[V2], mu: f64) {
        self.gather(x);
        let one = f64x4::splat(1.0);
        let [vx, vy, ..] = &self.lanes;
        for ((four, vx), vy) in self.fours.iter_mut().zip(chunks(vx)).zip(chunks(vy)) {
            let u = plus([f64x4::from(*vx), f64x4::from(*vy)], four.offset);
            let norm = dot(u, u).sqrt();
            let depth = f64x4::splat(START_DEPTH);
            let shrink = norm.simd_gt(depth).select(depth / norm, one);
            four.u = [u[0] * shrink, u[1] * shrink];
            let k = mu / (one - dot(four.u, four.u));
            four.z0 = k;
            four.z = [-k * four.u[0], -k * four.u[1]];
        }
    }

    /// Residuals at `x`; adds L' z to `pull`.
    pub(super) fn residuals(&mut self, x: &[V2], pull: &mut [V2]) -> Residuals {
        self.gather(x);
        let mut primal = f64x4::splat(0.0);
        let [a, b, c, d] = &mut self.lanes;
        let lanes = chunks_mut(a).zip(chunks_mut(b)).zip(chunks_mut(c)).zip(chunks_mut(d));
        for (four, (((vx, vy), gap), constant)) in self.fours.iter_mut().zip(lanes) {
            let value = [f64x4::from(*vx), f64x4::from(*vy)];
            four.res = minus(minus(four.u, value), four.offset);
            primal = primal.max(four.res[0].abs()).max(four.res[1].abs());
            *gap = (four.z0 + dot(four.u, four.z)).to_array();
            *constant = (four.z0 + dot(four.z, four.offset)).to_array();
            (*vx, *vy) = (four.z[0].to_array(), four.z[1].to_array());
        }
        let (mut gap, mut constant) = (0.0, 0.0);
        for i in self.places() {
            gap += self.lanes[2][i];
            constant += self.lanes[3][i];
        }
        self.scatter(pull);
        Residuals { gap, constant, primal: primal.to_array().into_iter().fold(0.0, f64::max) }
    }

    /// Adds L' W^-2 L to the Newton matrix; false when the iterate has left a cone.
    pub(super) fn add_to(&mut self, matrix: &mut Banded) -> bool {
        let [a, b, c, _] = &mut self.lanes;
        let lanes = chunks_mut(a).zip(chunks_mut(b)).zip(chunks_mut(c));
        for (four, ((xx, xy), yy)) in self.fours.iter_mut().zip(lanes) {
            if !four.rescale() {
                return false;
            }
            let ib2 = four.inv_beta * four.inv_beta;
            let w = four.w;
            *xx = (ib2 * (2.0 * w[0] * w[0] + 1.0)).to_array();
            *xy = (ib2 * 2.0 * w[0] * w[1]).to_array();
            *yy = (ib2 * (2.0 * w[1] * w[1] + 1.0)).to_array();
        }
        let [xx, xy, yy, _] = &self.lanes;
        for (i, k) in self.inverse_radii.iter().enumerate() {
            matrix.add_diagonal(i, [xx[i], xy[i], yy[i]], k * k);
        }
        let from = self.bends_from();
        for (row, i) in self.rows.iter().zip(from..) {
            matrix.add_scaled(row.first, row.coef, [xx[i], xy[i], yy[i]]);
        }
        true
    }

    /// Adds L' W^-2 res.
    pub(super) fn add_residuals(&mut self, rhs: &mut [V2]) {
        let [vx, vy, ..] = &mut self.lanes;
        for ((four, vx), vy) in self.fours.iter().zip(chunks_mut(vx)).zip(chunks_mut(vy)) {
            let ib2 = four.inv_beta * four.inv_beta;
            let wr = 2.0 * dot(four.w, four.res);
            *vx = (ib2 * (four.w[0] * wr + four.res[0])).to_array();
            *vy = (ib2 * (four.w[1] * wr + four.res[1])).to_array();
        }
        self.scatter(rhs);
    }

    /// How far the predictor's step for the points can be taken, at most 1; keeps what the
    /// corrector needs.
    pub(super) fn predict(&mut self, step: &[V2]) -> f64 {
        self.gather(step);
        let [a, b, c, d] = &mut self.lanes;
        let lanes = chunks_mut(a).zip(chunks_mut(b)).zip(chunks_mut(c)).zip(chunks_mut(d));
        for (four, (((a, b), c), d)) in self.fours.iter_mut().zip(lanes) {
            let y = minus(four.res, [f64x4::from(*a), f64x4::from(*b)]);
            let (h, t) = four.unscale(f64x4::splat(0.0), y);
            // scaled directions of slack and multiplier: -(h, t) and (h, t) - lambda
            let (ph, pt) = (h - four.l0, minus(t, four.l));
            [*a, *b] = to_boundary(four.l0, four.l, -h, [-t[0], -t[1]]).map(f64x4::to_array);
            [*c, *d] = to_boundary(four.l0, four.l, ph, pt).map(f64x4::to_array);
            // their Jordan product
            four.c0 = -(h * ph + dot(t, pt));
            four.c = [-(h * pt[0] + ph * t[0]), -(h * pt[1] + ph * t[1])];
        }
        self.reach(1.0)
    }

    /// Adds the corrector's part, for the central path's point `target`.
    pub(super) fn correct(&mut self, target: f64, rhs: &mut [V2]) {
        let [vx, vy, ..] = &mut self.lanes;
        for ((four, vx), vy) in self.fours.iter_mut().zip(chunks_mut(vx)).zip(chunks_mut(vy)) {
            // lambda \ (target e - product)
            let (v0, v) = (target - four.c0, [-four.c[0], -four.c[1]]);
            let det = four.l0 * four.l0 - dot(four.l, four.l);
            let c0 = (four.l0 * v0 - dot(four.l, v)) / det;
            let inv = 1.0 / four.l0;
            let c = scaled(inv, minus(v, scaled(c0, four.l)));
            (four.c0, four.c) = four.unscale(c0, c);
            (*vx, *vy) = (four.c[0].to_array(), four.c[1].to_array());
        }
        self.scatter(rhs);
    }

    /// The directions that belong to a step of the points, and how far they can be taken, at most
    /// `limit`.
    pub(super) fn direct(&mut self, step: &[V2], limit: f64) -> f64 {
        self.gather(step);
        let one = f64x4::splat(1.0);
        let zero = f64x4::splat(0.0);
        let [a, b, c, d] = &mut self.lanes;
        let lanes = chunks_mut(a).zip(chunks_mut(b)).zip(chunks_mut(c)).zip(chunks_mut(d));
        for (four, (((a, b), c), d)) in self.fours.iter_mut().zip(lanes) {
            let y = minus(four.res, [f64x4::from(*a), f64x4::from(*b)]);
            let wy = dot(four.w, y);
            let ib2 = four.inv_beta * four.inv_beta;
            four.du = [-y[0], -y[1]];
            four.dz0 = four.c0 - four.z0 - ib2 * 2.0 * four.w0 * wy;
            let (w, ww) = (four.w, 2.0 * wy);
            four.dz = [
                four.c[0] - four.z[0] + ib2 * (ww * w[0] + y[0]),
                four.c[1] - four.z[1] + ib2 * (ww * w[1] + y[1]),
            ];
            [*a, *b] = to_boundary(one, four.u, zero, four.du).map(f64x4::to_array);
            [*c, *d] = to_boundary(four.z0, four.z, four.dz0, four.dz).map(f64x4::to_array);
        }
        self.reach(limit)
    }

    /// Goes a share of the directions.
    pub(super) fn advance(&mut self, share: f64) {
        let share = f64x4::splat(share);
        for four in &mut self.fours {
            four.z0 += share * four.dz0;
            four.u = plus(four.u, scaled(share, four.du));
            four.z = plus(four.z, scaled(share, four.dz));
        }
    }

    /// The cones' places in `lanes`.
    fn places(&self) -> impl Iterator<Item = usize> + use<> {
        let from = self.bends_from();
        (0..self.inverse_radii.len()).chain(from..from + self.rows.len())
    }

    /// The largest step from the results of [`to_boundary`] in `lanes`, two of them per cone.
    fn reach(&self, limit: f64) -> f64 {
        let [c0, q0, c1, q1] = &self.lanes;
        let mut reached = limit;
        for i in self.places() {
            // as a product, because q may be zero
            if c0[i] < reached * q0[i] {
                reached = c0[i] / q0[i];
            }
            if c1[i] < reached * q1[i] {
                reached = c1[i] / q1[i];
            }
        }
        reached
    }

    /// L x, into the first two of `lanes`.
    fn gather(&mut self, x: &[V2]) {
        let from = self.bends_from();
        let [vx, vy, ..] = &mut self.lanes;
        let lanes = vx.iter_mut().zip(vy.iter_mut());
        for (((vx, vy), k), x) in lanes.zip(&self.inverse_radii).zip(x) {
            (*vx, *vy) = (k * x[0], k * x[1]);
        }
        let lanes = vx[from..].iter_mut().zip(&mut vy[from..]);
        for ((vx, vy), row) in lanes.zip(&self.rows) {
            let (a, b, c) = (x[row.first], x[row.first + 1], x[row.first + 2]);
            let k = row.coef;
            *vx = k[0] * a[0] + k[1] * b[0] + k[2] * c[0];
            *vy = k[0] * a[1] + k[1] * b[1] + k[2] * c[1];
        }
        self.fill_up();
    }

    /// Repeats the last disc and the last bend in the first two of `lanes`.
    fn fill_up(&mut self) {
        let (discs, from) = (self.inverse_radii.len(), self.bends_from());
        let bends = from + self.rows.len();
        for lane in &mut self.lanes[..2] {
            let last = lane[discs - 1];
            lane[discs..from].fill(last);
            if bends > from {
                let last = lane[bends - 1];
                lane[bends..].fill(last);
            }
        }
    }

    /// Adds L' times the first two of `lanes`.
    fn scatter(&self, out: &mut [V2]) {
        let [vx, vy, ..] = &self.lanes;
        let lanes = vx.iter().zip(vy);
        for ((out, k), (vx, vy)) in out.iter_mut().zip(&self.inverse_radii).zip(lanes) {
            out[0] += k * vx;
            out[1] += k * vy;
        }
        let from = self.bends_from();
        for (row, (vx, vy)) in self.rows.iter().zip(vx[from..].iter().zip(&vy[from..])) {
            for (out, k) in out[row.first..][..3].iter_mut().zip(row.coef) {
                out[0] += k * vx;
                out[1] += k * vy;
            }
        }
    }
}

fn chunks(lane: &[f64]) -> impl Iterator<Item = &[f64; WIDTH]> {
    lane.as_chunks().0.iter()
}

fn chunks_mut(lane: &mut [f64]) -> impl Iterator<Item = &mut [f64; WIDTH]> {
    lane.as_chunks_mut().0.iter_mut()
}

/// How close to the boundary of its cone (at 1) a slack may start.
const START_DEPTH: f64 = 0.7;
