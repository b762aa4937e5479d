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
