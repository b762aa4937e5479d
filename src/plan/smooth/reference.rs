//! The shape program on Clarabel, a general conic solver: the reference for the banded one.

use super::program::{Program, SolveError, Stencil};
use crate::frames::{Point, Vector};
use clarabel::algebra::CscMatrix;
use clarabel::solver::{
    DefaultSettingsBuilder, DefaultSolver, IPSolver, SolverStatus, SupportedConeT,
};

/// Solves `program` to 1e-9 and puts the solution into `x`. Returns the number of iterations.
pub fn solve(program: &Program, x: &mut [Point]) -> Result<u32, SolveError> {
    let n = 2 * program.point_count();
    let largest = program.bends.iter().map(|b| b.weight * b.bound_m * b.bound_m);
    let unit = 1.0 / largest.fold(f64::MIN_POSITIVE, f64::max);
    let (mut rows, mut cols, mut values) = (Vec::new(), Vec::new(), Vec::new());
    let mut q = vec![0.0; n];
    // Unknown are the points relative to their discs' centres: the cost then has no large
    // constant part, to which the solver's relative tolerance would apply.
    let centres: Vec<Point> = program.discs.iter().map(|d| d.centre).collect();
    let bends = program.bends.iter().map(|b| (&b.stencil, b.weight));
    let stretches = program.stretches.iter().map(|s| (&s.stencil, s.weight));
    for (stencil, weight) in bends.chain(stretches) {
        let Stencil { first, coef, .. } = stencil;
        let offset = stencil.at(&centres);
        let w = 2.0 * unit * weight;
        for axis in 0..2 {
            for j in 0..3 {
                for i in 0..=j {
                    rows.push(2 * (first + i) + axis);
                    cols.push(2 * (first + j) + axis);
                    values.push(w * coef[i] * coef[j]);
                }
                q[2 * (first + j) + axis] += w * coef[j] * offset[axis];
            }
        }
    }
    for row in &program.unevennesses {
        let w = 2.0 * unit * row.weight;
        let flat: Vec<f64> = row.coef.iter().flat_map(|c| [c.x, c.y]).collect();
        for j in 0..6 {
            for i in 0..=j {
                rows.push(2 * row.first + i);
                cols.push(2 * row.first + j);
                values.push(w * flat[i] * flat[j]);
            }
            q[2 * row.first + j] += w * flat[j] * row.at(&centres);
        }
    }
    let p = CscMatrix::new_from_triplets(n, n, rows, cols, values);

    let (mut rows, mut cols, mut values, mut b) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (i, disc) in program.discs.iter().enumerate() {
        for axis in 0..2 {
            rows.push(b.len() + 1 + axis);
            cols.push(2 * i + axis);
            values.push(-1.0 / disc.radius_m);
        }
        b.extend([1.0, 0.0, 0.0]);
    }
    for bend in &program.bends {
        let (s, inv) = (&bend.stencil, 1.0 / bend.bound_m);
        for axis in 0..2 {
            for i in 0..3 {
                rows.push(b.len() + 1 + axis);
                cols.push(2 * (s.first + i) + axis);
                values.push(-inv * s.coef[i]);
            }
        }
        let offset = s.at(&centres) * inv;
        b.extend([1.0, offset.x, offset.y]);
    }
    let a = CscMatrix::new_from_triplets(b.len(), n, rows, cols, values);
    let cones = vec![SupportedConeT::SecondOrderConeT(3); b.len() / 3];
    let settings = DefaultSettingsBuilder::default()
        .verbose(false)
        .tol_gap_abs(1e-10)
        .tol_gap_rel(1e-12)
        .tol_feas(1e-9)
        .build()
        .expect("constant settings are valid");
    let mut solver = DefaultSolver::new(&p, &q, &a, &b, &cones, settings)
        .expect("the program's matrices have matching sizes");
    solver.solve();
    let solution = &solver.solution;
    match solution.status {
        SolverStatus::Solved | SolverStatus::AlmostSolved => {
            for ((out, v), centre) in x.iter_mut().zip(solution.x.chunks_exact(2)).zip(&centres) {
                *out = centre + Vector::new(v[0], v[1]);
            }
            Ok(solution.iterations)
        }
        SolverStatus::PrimalInfeasible | SolverStatus::AlmostPrimalInfeasible => {
            Err(SolveError::Infeasible)
        }
        SolverStatus::MaxIterations => Err(SolveError::IterationLimit(solution.iterations)),
        _ => Err(SolveError::Numerical(solution.iterations)),
    }
}
