//! Block-pentadiagonal symmetric matrices with 2 x 2 blocks, factored without pivoting.

/// A vector of the plane.
pub(super) type V2 = [f64; 2];
/// Symmetric 2 x 2 as (xx, xy, yy).
pub(super) type S2 = [f64; 3];
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
pub(super) struct Banded {
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
    /// All zero, for `n` points.
    pub(super) fn reset(&mut self, n: usize) {
        self.d.clear();
        self.d.resize(n, [0.0; 3]);
        for v in [&mut self.e, &mut self.f] {
            v.clear();
            v.resize(n, [0.0; 4]);
        }
    }

    /// Adds `w s` at point `k`.
    pub(super) fn add_diagonal(&mut self, k: usize, s: S2, w: f64) {
        add_sym(&mut self.d[k], s, w);
    }

    /// Adds `c c'` (Kronecker) `s` at the three points from `k` on.
    pub(super) fn add_scaled(&mut self, k: usize, c: [f64; 3], s: S2) {
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
    pub(super) fn add_outer(&mut self, k: usize, c: [V2; 3], w: f64) {
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
    pub(super) fn multiply(&self, x: &[V2], out: &mut [V2]) {
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
    pub(super) fn factor(&mut self) -> bool {
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
    pub(super) fn solve(&self, b: &mut [V2]) {
        // The last two results travel in registers: each step waits for the one before.
        let (mut last, mut before) = ([0.0; 2], [0.0; 2]);
        for ((v, e), f) in b.iter_mut().zip(&self.e).zip(&self.f) {
            v[0] -= e[0] * last[0] + e[1] * last[1];
            v[1] -= e[2] * last[0] + e[3] * last[1];
            v[0] -= f[0] * before[0] + f[1] * before[1];
            v[1] -= f[2] * before[0] + f[3] * before[1];
            (before, last) = (last, *v);
        }
        let (mut last, mut before) = ([0.0; 2], [0.0; 2]);
        // Of the rows after: what they take from this one.
        let (mut e_after, mut f_after, mut f_second) = ([0.0; 4], [0.0; 4], [0.0; 4]);
        let blocks = self.d.iter().zip(&self.e).zip(&self.f);
        for (v, ((d, e), f)) in b.iter_mut().zip(blocks).rev() {
            let mut x = solve_factored(*d, *v);
            x[0] -= e_after[0] * last[0] + e_after[2] * last[1];
            x[1] -= e_after[1] * last[0] + e_after[3] * last[1];
            x[0] -= f_second[0] * before[0] + f_second[2] * before[1];
            x[1] -= f_second[1] * before[0] + f_second[3] * before[1];
            *v = x;
            (before, last) = (last, x);
            (f_second, f_after, e_after) = (f_after, *f, *e);
        }
    }
}
