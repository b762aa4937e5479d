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

use super::banded::{Banded, V2};
use super::cones::Cones;
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

/// The solver; keeps its memory between calls.
#[derive(Clone, Debug, Default)]
pub struct BandedSolver {
    cones: Cones,
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
            let residuals = self.cones.residuals(&self.x, &mut self.pull);
            let (gap, mut reach) = (residuals.gap, residuals.constant);
            let mut dual = 0.0_f64;
            for ((g, p), r) in self.gradient.iter().zip(&self.pull).zip(&self.radii) {
                dual = dual.max(r * (g[0] - p[0]).abs()).max(r * (g[1] - p[1]).abs());
                reach += r * (p[0] * p[0] + p[1] * p[1]).sqrt();
            }
            if !(cost.is_finite() && gap.is_finite()) {
                return Err(SolveError::Numerical(iteration));
            }
            if reach < 0.0 {
                return Err(SolveError::Infeasible);
            }
            let scale = cost.abs().max(1e-6);
            if residuals.primal <= tolerances.feasibility
                && gap <= tolerances.gap * scale
                && dual <= tolerances.gap * scale
            {
                for ((out, v), disc) in x.iter_mut().zip(&self.x).zip(&program.discs) {
                    *out = disc.centre + Vector::new(v[0], v[1]);
                }
                return Ok(iteration);
            }

            // Newton matrix P + L' W^-2 L
            self.matrix.clone_from(&self.hessian);
            if !(self.cones.add_to(&mut self.matrix) && self.matrix.factor()) {
                return Err(SolveError::Numerical(iteration));
            }
            // predictor: -(P x + q) + L' W^-2 res
            self.rhs.clear();
            self.rhs.extend(self.gradient.iter().map(|g| [-g[0], -g[1]]));
            self.cones.add_residuals(&mut self.rhs);
            self.solve_for_step();
            let reached = self.cones.predict(&self.step);
            // corrector
            let sigma = (1.0 - reached).powi(3);
            self.cones.correct(sigma * (gap / count), &mut self.rhs);
            self.solve_for_step();
            let reached = self.cones.direct(&self.step, 1.0 / STEP_SHARE);
            let taken = STEP_SHARE * reached;
            for (x, d) in self.x.iter_mut().zip(&self.step) {
                x[0] += taken * d[0];
                x[1] += taken * d[1];
            }
            self.cones.advance(taken);
        }
        Err(SolveError::IterationLimit(tolerances.iterations_max))
    }

    fn solve_for_step(&mut self) {
        self.step.clone_from(&self.rhs);
        self.matrix.solve(&mut self.step);
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
        self.cones.load(program, &self.centres);
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
        self.cones.start(&self.x, mu);
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
}

/// Share of the way to the cone's boundary that a step takes.
const STEP_SHARE: f64 = 0.99;

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
