//! A primal-dual interior-point method for the shape program, linear in the number of points.
//!
//! Each constraint "a vector of the plane is no longer than its bound" is a second-order cone of
//! dimension 3 whose first slack component is constant. With everything divided by the bound:
//! slack s = (1, u), u = L x + o. The method is the usual one for quadratic objectives over
//! symmetric cones (Vandenberghe, "The CVXOPT linear and quadratic cone program solvers", 2010,
//! sections 4 to 7): Nesterov-Todd scaling, Mehrotra's predictor and corrector, started at a
//! centred but infeasible point. Its Newton matrix is block-pentadiagonal with 2 x 2 blocks and
//! factored without pivoting.
//!
//! Infeasibility is proved, not guessed: for multipliers z in the cone, every feasible x has
//! 0 <= sum z.s(x), an affine function of x; if its maximum over the discs is negative, no x is
//! feasible.

use super::program::{Program, SolveError};
use crate::frames::{Point, Vector};

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerances {
    /// Duality gap relative to the cost.
    pub gap: f64,
    /// Constraint residuals relative to their bounds.
    pub feasibility: f64,
    /// Most iterations.
    pub iterations_max: u32,
}

impl Tolerances {
    /// As tight as double precision allows with room to spare; for comparisons.
    pub const TIGHT: Self = Self { gap: 1e-8, feasibility: 1e-9, iterations_max: 60 };
    /// Path shapes within a fraction of a millimetre of the optimum.
    pub const SHAPE: Self = Self { gap: 1e-4, feasibility: 1e-7, iterations_max: 40 };
}

type V2 = [f64; 2];

fn dot(a: V2, b: V2) -> f64 {
    a[0] * b[0] + a[1] * b[1]
}

/// One cone: its fixed data and its iterate.
#[derive(Clone, Copy, Debug, Default)]
struct Cone {
    first: usize,
    /// Stencil over the points relative to their discs' centres, divided by the bound.
    coef: [f64; 3],
    offset: V2,
    /// Slack tail (its head is 1) and multiplier.
    u: V2,
    z0: f64,
    z: V2,
    /// Scaling: W = beta * [w0, w'; w, I + w w'/(1 + w0)].
    inv_beta: f64,
    w0: f64,
    w: V2,
    /// lambda = W z = W^-1 s.
    l0: f64,
    l: V2,
    /// Primal residual u - (L x + o).
    res: V2,
    /// Directions: slack tail, multiplier.
    du: V2,
    dz0: f64,
    dz: V2,
    /// W^-1 c of the corrector.
    c0: f64,
    c: V2,
}

impl Cone {
    fn linear(&self, x: &[V2]) -> V2 {
        let (a, b, c) = (x[self.first], x[self.first + 1], x[self.first + 2]);
        let k = self.coef;
        [k[0] * a[0] + k[1] * b[0] + k[2] * c[0], k[0] * a[1] + k[1] * b[1] + k[2] * c[1]]
    }

    fn scatter(&self, v: V2, out: &mut [V2]) {
        let out = &mut out[self.first..self.first + 3];
        for (o, k) in out.iter_mut().zip(self.coef) {
            o[0] += k * v[0];
            o[1] += k * v[1];
        }
    }

    /// W^-1 of a vector with head `h` and tail `t`.
    fn unscale(&self, h: f64, t: V2) -> (f64, V2) {
        let wt = dot(self.w, t);
        let k = wt / (1.0 + self.w0) - h;
        (
            self.inv_beta * (self.w0 * h - wt),
            [self.inv_beta * (t[0] + self.w[0] * k), self.inv_beta * (t[1] + self.w[1] * k)],
        )
    }

    /// The Nesterov-Todd scaling of the present iterate; false when it has left the cone.
    fn rescale(&mut self) -> bool {
        let ss = 1.0 - dot(self.u, self.u);
        let zz = self.z0 * self.z0 - dot(self.z, self.z);
        // written so that NaN is false
        if !(ss > 0.0 && zz > 0.0 && self.z0 > 0.0) {
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
        (self.l0, self.l) = self.unscale(1.0, self.u);
        true
    }
}

/// The largest step in [0, limit] that keeps (h, t) + step * (dh, dt) in the cone, from inside it.
fn step_to_boundary(h: f64, t: V2, dh: f64, dt: V2, limit: f64) -> f64 {
    // The boundary is at the roots of a x^2 + 2 b x + c with c > 0; the smallest positive one, if
    // there is one, is c / (-b + sqrt(b^2 - a c)).
    let a = dh * dh - dot(dt, dt);
    let b = h * dh - dot(t, dt);
    let c = h * h - dot(t, t);
    let discriminant = b * b - a * c;
    if discriminant < 0.0 {
        return limit;
    }
    let q = discriminant.sqrt() - b;
    // as a product, because q may be zero
    if c < limit * q { c / q } else { limit }
}

/// Symmetric 2 x 2 as (xx, xy, yy).
type S2 = [f64; 3];
/// Full 2 x 2, row by row.
type M2 = [f64; 4];

/// Solves a symmetric 2 x 2 system from its factors (1 / pivot, multiplier, 1 / pivot). Substitution
/// keeps its accuracy where the block is almost singular; the explicit inverse does not.
fn solve_factored(f: S2, v: V2) -> V2 {
    let y = (v[1] - f[1] * v[0]) * f[2];
    [v[0] * f[0] - f[1] * y, y]
}

/// a * D^-1 for a factored symmetric D
fn divide(a: M2, f: S2) -> M2 {
    let (r0, r1) = (solve_factored(f, [a[0], a[1]]), solve_factored(f, [a[2], a[3]]));
    [r0[0], r0[1], r1[0], r1[1]]
}

/// a * b'
fn mul_transposed(a: M2, b: M2) -> M2 {
    [
        a[0] * b[0] + a[1] * b[1],
        a[0] * b[2] + a[1] * b[3],
        a[2] * b[0] + a[3] * b[1],
        a[2] * b[2] + a[3] * b[3],
    ]
}

fn add_sym(d: &mut S2, s: S2, k: f64) {
    for (d, s) in d.iter_mut().zip(s) {
        *d += k * s;
    }
}

/// Block-pentadiagonal symmetric matrix, then its factors L D L'.
#[derive(Debug, Default)]
struct Banded {
    /// Diagonal blocks; after factoring the factors of their Schur complements.
    d: Vec<S2>,
    /// Blocks (k, k-1) and (k, k-2); after factoring those of L.
    e: Vec<M2>,
    f: Vec<M2>,
}

impl Clone for Banded {
    fn clone(&self) -> Self {
        Self { d: self.d.clone(), e: self.e.clone(), f: self.f.clone() }
    }

    /// Keeps the memory, which the derived one would not.
    fn clone_from(&mut self, source: &Self) {
        self.d.clone_from(&source.d);
        self.e.clone_from(&source.e);
        self.f.clone_from(&source.f);
    }
}

impl Banded {
    fn reset(&mut self, n: usize) {
        self.d.clear();
        self.d.resize(n, [0.0; 3]);
        for v in [&mut self.e, &mut self.f] {
            v.clear();
            v.resize(n, [0.0; 4]);
        }
    }

    /// Adds `c c'` (Kronecker) `s` at the three points from `k` on.
    fn add_scaled(&mut self, k: usize, c: [f64; 3], s: S2) {
        let add = |d: &mut M2, k: f64| {
            d[0] += k * s[0];
            d[1] += k * s[1];
            d[2] += k * s[1];
            d[3] += k * s[2];
        };
        for (d, c) in self.d[k..].iter_mut().zip(c) {
            add_sym(d, s, c * c);
        }
        add(&mut self.e[k + 1], c[0] * c[1]);
        add(&mut self.e[k + 2], c[1] * c[2]);
        add(&mut self.f[k + 2], c[0] * c[2]);
    }

    /// Adds `w c c'` for a row of three 2-vectors at the three points from `k` on.
    fn add_outer(&mut self, k: usize, c: [V2; 3], w: f64) {
        let outer = |m: &mut M2, a: V2, b: V2| {
            m[0] += w * a[0] * b[0];
            m[1] += w * a[0] * b[1];
            m[2] += w * a[1] * b[0];
            m[3] += w * a[1] * b[1];
        };
        for (d, a) in self.d[k..].iter_mut().zip(c) {
            add_sym(d, [a[0] * a[0], a[0] * a[1], a[1] * a[1]], w);
        }
        outer(&mut self.e[k + 1], c[1], c[0]);
        outer(&mut self.e[k + 2], c[2], c[1]);
        outer(&mut self.f[k + 2], c[2], c[0]);
    }

    /// Matrix (not yet factored) times `x`.
    fn multiply(&self, x: &[V2], out: &mut [V2]) {
        for (k, out) in out.iter_mut().enumerate() {
            let (d, v) = (self.d[k], x[k]);
            *out = [d[0] * v[0] + d[1] * v[1], d[1] * v[0] + d[2] * v[1]];
        }
        for (off, blocks) in [(1, &self.e), (2, &self.f)] {
            for k in off..x.len() {
                let (b, v, u) = (blocks[k], x[k - off], x[k]);
                out[k][0] += b[0] * v[0] + b[1] * v[1];
                out[k][1] += b[2] * v[0] + b[3] * v[1];
                out[k - off][0] += b[0] * u[0] + b[2] * u[1];
                out[k - off][1] += b[1] * u[0] + b[3] * u[1];
            }
        }
    }

    /// In place; false when the matrix is not positive definite.
    fn factor(&mut self) -> bool {
        let n = self.d.len();
        for k in 0..n {
            let mut d = self.d[k];
            let mut subtract = |l: M2, u: M2| {
                d[0] -= l[0] * u[0] + l[1] * u[1];
                d[1] -= l[0] * u[2] + l[1] * u[3];
                d[2] -= l[2] * u[2] + l[3] * u[3];
            };
            if k >= 1 {
                let mut u1 = self.e[k];
                if k >= 2 {
                    let u2 = self.f[k];
                    let l2 = divide(u2, self.d[k - 2]);
                    self.f[k] = l2;
                    let t = mul_transposed(u2, self.e[k - 1]);
                    for i in 0..4 {
                        u1[i] -= t[i];
                    }
                    subtract(l2, u2);
                }
                let l1 = divide(u1, self.d[k - 1]);
                self.e[k] = l1;
                subtract(l1, u1);
            }
            let first = 1.0 / d[0];
            let multiplier = d[1] * first;
            let second = d[2] - multiplier * d[1];
            if !(d[0] > 0.0 && second > 0.0) {
                return false;
            }
            self.d[k] = [first, multiplier, 1.0 / second];
        }
        true
    }

    /// Solves with the factors, in place.
    fn solve(&self, b: &mut [V2]) {
        let n = b.len();
        for k in 0..n {
            let mut v = b[k];
            if k >= 1 {
                let (l, p) = (self.e[k], b[k - 1]);
                v[0] -= l[0] * p[0] + l[1] * p[1];
                v[1] -= l[2] * p[0] + l[3] * p[1];
            }
            if k >= 2 {
                let (l, p) = (self.f[k], b[k - 2]);
                v[0] -= l[0] * p[0] + l[1] * p[1];
                v[1] -= l[2] * p[0] + l[3] * p[1];
            }
            b[k] = v;
        }
        for k in (0..n).rev() {
            let mut v = solve_factored(self.d[k], b[k]);
            if k + 1 < n {
                let (l, p) = (self.e[k + 1], b[k + 1]);
                v[0] -= l[0] * p[0] + l[2] * p[1];
                v[1] -= l[1] * p[0] + l[3] * p[1];
            }
            if k + 2 < n {
                let (l, p) = (self.f[k + 2], b[k + 2]);
                v[0] -= l[0] * p[0] + l[2] * p[1];
                v[1] -= l[1] * p[0] + l[3] * p[1];
            }
            b[k] = v;
        }
    }
}

/// The solver; keeps its memory between calls.
#[derive(Clone, Debug, Default)]
pub struct BandedSolver {
    /// Discs first (cone i holds point i), then bends.
    cones: Vec<Cone>,
    radii: Vec<f64>,
    centres: Vec<Point>,
    /// Hessian and linear part of the cost.
    hessian: Banded,
    linear: Vec<V2>,
    matrix: Banded,
    /// The points relative to their discs' centres.
    x: Vec<V2>,
    gradient: Vec<V2>,
    pull: Vec<V2>,
    rhs: Vec<V2>,
    step: Vec<V2>,
}

impl BandedSolver {
    /// Solves `program` from the guess in `x` (any points; one per unknown) and puts the solution
    /// there. Returns the number of iterations. On failure `x` is left as it was.
    pub fn solve(
        &mut self,
        program: &Program,
        tolerances: &Tolerances,
        x: &mut [Point],
    ) -> Result<u32, SolveError> {
        let constant = self.load(program, x);
        let count = self.cones.len() as f64;
        for iteration in 0..tolerances.iterations_max {
            // residuals, gap, certificate
            let cost = self.evaluate_cost() + constant;
            self.pull.iter_mut().for_each(|p| *p = [0.0; 2]);
            let (mut gap, mut primal, mut reach) = (0.0, 0.0_f64, 0.0);
            for cone in &mut self.cones {
                let value = cone.linear(&self.x);
                cone.res =
                    [cone.u[0] - value[0] - cone.offset[0], cone.u[1] - value[1] - cone.offset[1]];
                primal = primal.max(cone.res[0].abs()).max(cone.res[1].abs());
                gap += cone.z0 + dot(cone.u, cone.z);
                reach += cone.z0 + dot(cone.z, cone.offset);
                cone.scatter(cone.z, &mut self.pull);
            }
            let mut dual = 0.0_f64;
            for ((g, p), r) in self.gradient.iter().zip(&self.pull).zip(&self.radii) {
                dual = dual.max(r * (g[0] - p[0]).abs()).max(r * (g[1] - p[1]).abs());
                reach += r * dot(*p, *p).sqrt();
            }
            if !(cost.is_finite() && gap.is_finite()) {
                return Err(SolveError::Numerical(iteration));
            }
            if reach < 0.0 {
                return Err(SolveError::Infeasible);
            }
            let scale = cost.abs().max(1e-6);
            if primal <= tolerances.feasibility
                && gap <= tolerances.gap * scale
                && dual <= tolerances.gap * scale
            {
                for ((out, v), disc) in x.iter_mut().zip(&self.x).zip(&program.discs) {
                    *out = disc.centre + Vector::new(v[0], v[1]);
                }
                return Ok(iteration);
            }

            if !self.assemble() {
                return Err(SolveError::Numerical(iteration));
            }
            // predictor
            self.rhs_predictor();
            self.step.clone_from(&self.rhs);
            self.matrix.solve(&mut self.step);
            let mu = gap / count;
            let mut reached = 1.0_f64;
            for cone in &mut self.cones {
                let d = cone.linear(&self.step);
                let y = [cone.res[0] - d[0], cone.res[1] - d[1]];
                let (h, t) = cone.unscale(0.0, y);
                // scaled directions of slack and multiplier: -(h, t) and (h, t) - lambda
                let (ph, pt) = (h - cone.l0, [t[0] - cone.l[0], t[1] - cone.l[1]]);
                reached = step_to_boundary(cone.l0, cone.l, -h, [-t[0], -t[1]], reached);
                reached = step_to_boundary(cone.l0, cone.l, ph, pt, reached);
                // their Jordan product, kept for the corrector
                cone.c0 = -(h * ph + dot(t, pt));
                cone.c = [-(h * pt[0] + ph * t[0]), -(h * pt[1] + ph * t[1])];
            }
            // corrector
            let sigma = (1.0 - reached).powi(3);
            let target = sigma * mu;
            for cone in &mut self.cones {
                // lambda \ (sigma mu e - product)
                let (v0, v) = (target - cone.c0, [-cone.c[0], -cone.c[1]]);
                let det = cone.l0 * cone.l0 - dot(cone.l, cone.l);
                let c0 = (cone.l0 * v0 - dot(cone.l, v)) / det;
                let inv = 1.0 / cone.l0;
                let c = [(v[0] - c0 * cone.l[0]) * inv, (v[1] - c0 * cone.l[1]) * inv];
                (cone.c0, cone.c) = cone.unscale(c0, c);
                cone.scatter(cone.c, &mut self.rhs);
            }
            self.step.clone_from(&self.rhs);
            self.matrix.solve(&mut self.step);
            let mut reached = 1.0 / STEP_SHARE;
            for cone in &mut self.cones {
                let d = cone.linear(&self.step);
                let y = [cone.res[0] - d[0], cone.res[1] - d[1]];
                let wy = dot(cone.w, y);
                let ib2 = cone.inv_beta * cone.inv_beta;
                cone.du = [-y[0], -y[1]];
                cone.dz0 = cone.c0 - cone.z0 - ib2 * 2.0 * cone.w0 * wy;
                let (w, ww) = (cone.w, 2.0 * wy);
                cone.dz = [
                    cone.c[0] - cone.z[0] + ib2 * (ww * w[0] + y[0]),
                    cone.c[1] - cone.z[1] + ib2 * (ww * w[1] + y[1]),
                ];
                reached = step_to_boundary(1.0, cone.u, 0.0, cone.du, reached);
                reached = step_to_boundary(cone.z0, cone.z, cone.dz0, cone.dz, reached);
            }
            let taken = STEP_SHARE * reached;
            for (x, d) in self.x.iter_mut().zip(&self.step) {
                x[0] += taken * d[0];
                x[1] += taken * d[1];
            }
            for cone in &mut self.cones {
                cone.z0 += taken * cone.dz0;
                for i in 0..2 {
                    cone.u[i] += taken * cone.du[i];
                    cone.z[i] += taken * cone.dz[i];
                }
            }
        }
        Err(SolveError::IterationLimit(tolerances.iterations_max))
    }

    /// Sets up cones, cost and a centred start; returns the constant part of the cost.
    fn load(&mut self, program: &Program, x: &[Point]) -> f64 {
        let m = program.point_count();
        assert!(m >= 3, "a shape program has at least three points");
        assert_eq!(x.len(), m, "one guess per point");
        // The cost in units of the largest cost that a bend within its bound can have.
        let largest = program.bends.iter().map(|b| b.weight * b.bound_m * b.bound_m);
        let largest = largest.fold(0.0, f64::max);
        let unit = if largest > 0.0 { 1.0 / largest } else { 1.0 };
        self.hessian.reset(m);
        self.linear.clear();
        self.linear.resize(m, [0.0; 2]);
        let mut constant = 0.0;
        let bends = program.bends.iter().map(|b| (&b.stencil, b.weight));
        let stretches = program.stretches.iter().map(|s| (&s.stencil, s.weight));
        self.centres.clear();
        self.centres.extend(program.discs.iter().map(|d| d.centre));
        for (stencil, weight) in bends.chain(stretches) {
            let offset = stencil.at(&self.centres);
            let (k, c, w) = (stencil.first, stencil.coef, unit * weight);
            self.hessian.add_scaled(k, c, [2.0 * w, 0.0, 2.0 * w]);
            for (linear, c) in self.linear[k..].iter_mut().zip(c) {
                linear[0] += 2.0 * w * c * offset.x;
                linear[1] += 2.0 * w * c * offset.y;
            }
            constant += w * offset.norm_squared();
        }
        for row in &program.unevennesses {
            let (k, w, offset) = (row.first, unit * row.weight, row.at(&self.centres));
            let c = row.coef.map(|c| [c.x, c.y]);
            self.hessian.add_outer(k, c, 2.0 * w);
            for (linear, c) in self.linear[k..].iter_mut().zip(c) {
                linear[0] += 2.0 * w * c[0] * offset;
                linear[1] += 2.0 * w * c[1] * offset;
            }
            constant += w * offset * offset;
        }
        self.radii.clear();
        self.radii.extend(program.discs.iter().map(|d| d.radius_m));
        self.cones.clear();
        for (i, disc) in program.discs.iter().enumerate() {
            let mut coef = [0.0; 3];
            let first = i.min(m - 3);
            coef[i - first] = 1.0 / disc.radius_m;
            self.cones.push(Cone { first, coef, ..Cone::default() });
        }
        for bend in &program.bends {
            let inv = 1.0 / bend.bound_m;
            let offset = bend.stencil.at(&self.centres) * inv;
            self.cones.push(Cone {
                first: bend.stencil.first,
                coef: bend.stencil.coef.map(|c| c * inv),
                offset: [offset.x, offset.y],
                ..Cone::default()
            });
        }
        self.x.clear();
        self.x.extend(x.iter().zip(&self.centres).map(|(p, c)| [p.x - c.x, p.y - c.y]));
        for v in [&mut self.gradient, &mut self.pull] {
            v.clear();
            v.resize(m, [0.0; 2]);
        }
        // Slack from the guess, drawn into the inner part of its cone; multipliers on the central
        // path, of the size of the cost that a typical bend has.
        let cost = self.evaluate_cost() + constant;
        let mu = (cost / self.cones.len() as f64).clamp(1e-4, 0.1);
        for cone in &mut self.cones {
            let value = cone.linear(&self.x);
            let u = [value[0] + cone.offset[0], value[1] + cone.offset[1]];
            let norm = dot(u, u).sqrt();
            let shrink = if norm > START_DEPTH { START_DEPTH / norm } else { 1.0 };
            cone.u = [u[0] * shrink, u[1] * shrink];
            let k = mu / (1.0 - dot(cone.u, cone.u));
            cone.z0 = k;
            cone.z = [-k * cone.u[0], -k * cone.u[1]];
        }
        constant
    }

    /// Gradient of the cost at x into `gradient`; returns the cost without its constant.
    fn evaluate_cost(&mut self) -> f64 {
        self.hessian.multiply(&self.x, &mut self.gradient);
        let mut cost = 0.0;
        for ((g, q), x) in self.gradient.iter_mut().zip(&self.linear).zip(&self.x) {
            cost += x[0] * (0.5 * g[0] + q[0]) + x[1] * (0.5 * g[1] + q[1]);
            *g = [g[0] + q[0], g[1] + q[1]];
        }
        cost
    }

    /// Scalings and the factored Newton matrix P + L' W^-2 L.
    fn assemble(&mut self) -> bool {
        let m = self.x.len();
        self.matrix.clone_from(&self.hessian);
        for (i, cone) in self.cones.iter_mut().enumerate() {
            if !cone.rescale() {
                return false;
            }
            let ib2 = cone.inv_beta * cone.inv_beta;
            let w = cone.w;
            let s = [
                ib2 * (2.0 * w[0] * w[0] + 1.0),
                ib2 * 2.0 * w[0] * w[1],
                ib2 * (2.0 * w[1] * w[1] + 1.0),
            ];
            if i < m {
                let k = cone.coef[i - cone.first];
                add_sym(&mut self.matrix.d[i], s, k * k);
            } else {
                self.matrix.add_scaled(cone.first, cone.coef, s);
            }
        }
        self.matrix.factor()
    }

    /// -(P x + q) + L' W^-2 res.
    fn rhs_predictor(&mut self) {
        self.rhs.clear();
        self.rhs.extend(self.gradient.iter().map(|g| [-g[0], -g[1]]));
        for cone in &self.cones {
            let ib2 = cone.inv_beta * cone.inv_beta;
            let wr = 2.0 * dot(cone.w, cone.res);
            let v = [ib2 * (cone.w[0] * wr + cone.res[0]), ib2 * (cone.w[1] * wr + cone.res[1])];
            cone.scatter(v, &mut self.rhs);
        }
    }
}

/// Share of the way to the cone's boundary that a step takes.
const STEP_SHARE: f64 = 0.99;
/// How close to the boundary of its cone (at 1) a slack may start.
const START_DEPTH: f64 = 0.7;

#[cfg(test)]
mod tests {
    use super::super::program::samples::random_program;
    use super::super::reference;
    use super::*;

    #[test]
    fn it_agrees_with_clarabel_on_random_programs() {
        let mut solver = BandedSolver::default();
        let (mut solved, mut infeasible) = (0, 0);
        for seed in 0..150 {
            let (program, guess) = random_program(seed);
            let (mut own, mut theirs) = (guess.clone(), guess.clone());
            let verdict = reference::solve(&program, &mut theirs);
            match solver.solve(&program, &Tolerances::TIGHT, &mut own) {
                Ok(_) => {
                    solved += 1;
                    verdict.unwrap_or_else(|e| panic!("seed {seed}: Clarabel says {e}"));
                    assert!(program.violation(&own) < 1e-7, "seed {seed}");
                    let (a, b) = (program.cost(&own), program.cost(&theirs));
                    assert!((a - b).abs() <= 1e-6 * b.max(1e-3), "seed {seed}: {a} {b}");
                }
                Err(error) => {
                    assert_eq!(error, SolveError::Infeasible, "seed {seed}");
                    assert!(
                        matches!(verdict, Err(SolveError::Infeasible)),
                        "seed {seed}: {verdict:?}"
                    );
                    assert_eq!(own, guess, "a failure leaves the guess alone");
                    infeasible += 1;
                }
            }
        }
        assert!(solved >= 40 && infeasible >= 20, "{solved} solved, {infeasible} infeasible");
    }

    #[test]
    fn the_working_tolerances_are_good_for_a_fraction_of_a_thousandth() {
        let mut solver = BandedSolver::default();
        let mut solved = 0;
        for seed in 0..150 {
            let (program, guess) = random_program(seed);
            let (mut rough, mut fine) = (guess.clone(), guess);
            let Ok(fewer) = solver.solve(&program, &Tolerances::SHAPE, &mut rough) else {
                continue;
            };
            let more = solver.solve(&program, &Tolerances::TIGHT, &mut fine).unwrap();
            assert!(fewer <= more);
            assert!(program.violation(&rough) < 1e-6);
            assert!(program.cost(&rough) <= program.cost(&fine) * (1.0 + 5e-4) + 1e-3);
            solved += 1;
        }
        assert!(solved >= 40);
    }

    #[test]
    fn numbers_that_are_none_are_reported() {
        let (mut program, mut guess) = random_program(2);
        program.discs[1].radius_m = f64::NAN;
        let result = BandedSolver::default().solve(&program, &Tolerances::SHAPE, &mut guess);
        assert!(matches!(result, Err(SolveError::Numerical(_))), "{result:?}");
    }
}
