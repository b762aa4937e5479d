//! The shape program: which points may move where, and what a good shape costs.
//!
//! The unknowns are points `X_0..X_m` of the plane. Every term is a linear combination of up to
//! three consecutive ones plus a constant, the same for x and y (a [`Stencil`]), so that the
//! Newton matrix of an interior-point method is block-pentadiagonal with 2 x 2 blocks.

use crate::frames::{Point, Vector};

/// `coef[0] X_first + coef[1] X_{first+1} + coef[2] X_{first+2} + offset`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stencil {
    /// Index of the first point; `first + 2` is a point too (with coefficient zero if need be).
    pub first: usize,
    /// Coefficients of the three points.
    pub coef: [f64; 3],
    /// Constant part, metres.
    pub offset: Vector,
}

impl Stencil {
    /// The value at given points, metres.
    pub fn at(&self, x: &[Point]) -> Vector {
        let p = &x[self.first..self.first + 3];
        self.offset
            + p[0].coords * self.coef[0]
            + p[1].coords * self.coef[1]
            + p[2].coords * self.coef[2]
    }
}

/// A second difference of the points: it costs and it is bounded.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bend {
    /// The second difference.
    pub stencil: Stencil,
    /// It must not be longer than this, metres, positive.
    pub bound_m: f64,
    /// Cost per squared metre.
    pub weight: f64,
}

/// A first difference of the points: it costs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stretch {
    /// The first difference.
    pub stencil: Stencil,
    /// Cost per squared metre.
    pub weight: f64,
}

/// A difference between the lengths of successive steps: it costs, which keeps the points evenly
/// spaced. Linear in the points: each step is measured along a fixed direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Unevenness {
    /// Index of the first of three points.
    pub first: usize,
    /// The value is the sum of dot products of these with the three points, plus `offset_m`.
    pub coef: [Vector; 3],
    /// Constant part, metres.
    pub offset_m: f64,
    /// Cost per squared metre.
    pub weight: f64,
}

impl Unevenness {
    /// The value at given points, metres.
    pub fn at(&self, x: &[Point]) -> f64 {
        let products = self.coef.iter().zip(&x[self.first..]).map(|(c, p)| c.dot(&p.coords));
        self.offset_m + products.sum::<f64>()
    }
}

/// A disc that holds one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// Metres.
    pub centre: Point,
    /// Metres, positive.
    pub radius_m: f64,
}

/// Minimise the weighted squares of bends, stretches and unevennesses such that point `i` lies in `discs[i]` and
/// no bend exceeds its bound.
#[derive(Clone, Debug, Default)]
pub struct Program {
    /// One per unknown point, at least three.
    pub discs: Vec<Disc>,
    /// In order of their stencils.
    pub bends: Vec<Bend>,
    /// In order of their stencils.
    pub stretches: Vec<Stretch>,
    /// In any order.
    pub unevennesses: Vec<Unevenness>,
}

impl Program {
    /// Number of unknown points.
    pub fn point_count(&self) -> usize {
        self.discs.len()
    }

    /// Forgets the terms, keeps the memory.
    pub fn clear(&mut self) {
        self.discs.clear();
        self.bends.clear();
        self.stretches.clear();
        self.unevennesses.clear();
    }

    /// The cost of given points.
    pub fn cost(&self, x: &[Point]) -> f64 {
        let bends = self.bends.iter().map(|b| b.weight * b.stencil.at(x).norm_squared());
        let stretches = self.stretches.iter().map(|s| s.weight * s.stencil.at(x).norm_squared());
        let uneven = self.unevennesses.iter().map(|u| u.weight * u.at(x).powi(2));
        bends.sum::<f64>() + stretches.sum::<f64>() + uneven.sum::<f64>()
    }

    /// By how much given points break the worst constraint, relative to its bound; not positive
    /// when they keep them all.
    pub fn violation(&self, x: &[Point]) -> f64 {
        let discs = self.discs.iter().zip(x).map(|(d, p)| (p - d.centre).norm() / d.radius_m - 1.0);
        let bends = self.bends.iter().map(|b| b.stencil.at(x).norm() / b.bound_m - 1.0);
        discs.chain(bends).fold(f64::NEG_INFINITY, f64::max)
    }
}

/// Why a program has no solution.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SolveError {
    /// Proved: no points keep all constraints.
    #[error("the constraints contradict each other")]
    Infeasible,
    /// Not solved within the iteration limit (close to infeasible, or badly scaled).
    #[error("no solution within {0} iterations")]
    IterationLimit(u32),
    /// Arithmetic broke down.
    #[error("numerical breakdown in iteration {0}")]
    Numerical(u32),
}

#[cfg(test)]
pub(super) mod samples {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A random program like those of real corridors, feasible or not: discs along a random curve,
    /// all kinds of terms, some bounds tight.
    pub fn random_program(seed: u64) -> (Program, Vec<Point>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let m = rng.random_range(3..120);
        let d = rng.random_range(0.05..0.2);
        let curvature_max = rng.random_range(0.5..3.0);
        let mut program = Program::default();
        let (mut p, mut heading, mut turn) = (Point::origin(), 0.0_f64, 0.0_f64);
        let mut points = Vec::new();
        for _ in 0..m + 2 {
            points.push(p);
            turn = (turn + rng.random_range(-0.6..0.6)).clamp(-1.1, 1.1) * 0.95;
            heading += turn * d * curvature_max;
            p += Vector::new(heading.cos(), heading.sin()) * d;
        }
        let (before, after) = (points[0], points[m + 1]);
        let x = points[1..=m].to_vec();
        // Discs that miss their points make some programs infeasible.
        let reach = if seed.is_multiple_of(3) { 1.6 } else { 0.7 };
        for p in &x {
            let radius_m = rng.random_range(0.01..0.6);
            let off = Vector::new(rng.random_range(-reach..reach), rng.random_range(-reach..reach));
            program.discs.push(Disc { centre: p + off * radius_m, radius_m });
        }
        let bound_m = curvature_max * d * d;
        let length_weight = rng.random_range(0.0..2.0) / (d * d);
        let weight = d.powi(-4);
        for k in 0..m {
            // neighbours of point k, of which the first and the last are fixed
            let first = k.max(1).min(m - 2) - 1;
            let mut stencil = Stencil { first, coef: [0.0; 3], offset: Vector::zeros() };
            let mut stretch = stencil;
            let (t0, t1) = (points[k + 1] - points[k], points[k + 2] - points[k + 1]);
            let (t0, t1) = (t0.normalize(), t1.normalize());
            let mut uneven = Unevenness {
                first,
                coef: [Vector::zeros(); 3],
                offset_m: 0.0,
                weight: 30.0 * weight,
            };
            for (j, bend, step, row) in [
                (k as i64 - 1, -1.0, 0.0, t0),
                (k as i64, 2.0, -1.0, -t0 - t1),
                (k as i64 + 1, -1.0, 1.0, t1),
            ] {
                if (0..m as i64).contains(&j) {
                    let i = j as usize - first;
                    stencil.coef[i] += bend;
                    stretch.coef[i] += step;
                    uneven.coef[i] += row;
                } else {
                    let fixed = if j < 0 { before } else { after };
                    stencil.offset += fixed.coords * bend;
                    stretch.offset += fixed.coords * step;
                    uneven.offset_m += fixed.coords.dot(&row);
                }
            }
            program.bends.push(Bend { stencil, bound_m, weight });
            program.stretches.push(Stretch { stencil: stretch, weight: length_weight });
            if seed.is_multiple_of(2) {
                program.unevennesses.push(uneven);
            }
        }
        (program, x)
    }
}
