//! The passes: reference, bubbles, program, curve, and the checks of the finished curve.

use super::banded_socp::{BandedSolver, Tolerances};
use super::program::{Bend, Disc, Program, SolveError, Stencil, Stretch, Unevenness};
use super::reference;
use super::request::{SmoothError, SmoothParams, SmoothRequest, SmoothStats, Smoothed, Solver};
use super::spline::Spline;
use crate::frames::{Point, Vector, heading_vector};
use crate::plan::Path;
use crate::plan::bubbles::{Bubble, BubbleSizes, ClearanceField, bubble_at};

/// Samples of the finished path are at most this far apart.
const SAMPLE_SPACING_M: f64 = 0.05;
/// Fewest polynomial pieces of a path.
const PIECES_MIN: usize = 8;
/// Shortest guide worth a path.
const GUIDE_MIN_M: f64 = 0.05;
/// Limits are tightened from their exact values at the start to those with margin over this
/// length, so that the rest of a path that kept them with margin is feasible when replanned.
const RAMP_M: f64 = 1.5;
/// Beyond the start, bubbles keep this much more than asked: the curve lies up to this far inside
/// the chords between control points.
const CURVE_MARGIN_M: f64 = 0.001;
/// By how much a car may start too close to an obstacle (drift of the map against the plan under
/// way); it must get clear of it within `RAMP_M`.
const START_DEFICIT_MAX_M: f64 = 0.06;
/// Rounding of the finished curve against its limits, metres and relative.
const CLEARANCE_TOLERANCE_M: f64 = 1e-5;
const CURVATURE_TOLERANCE: f64 = 1e-6;
/// Most solves after the passes to mend a limit that the finished curve breaks.
const REPAIRS_MAX: u32 = 5;
/// Shares of the friction circle for turning and for braking (3-4-5) while the start speed is shed.
const TURN_SHARE: f64 = 0.8;
const BRAKE_SHARE: f64 = 0.6;

/// How strictly a program is set up.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Strictness {
    /// With margins, as a finished path should have them.
    Margins,
    /// The limits themselves.
    Bare,
    /// Turning radius divided by this; the result is no path but a better reference.
    Relaxed(f64),
}

/// Shapes paths; keeps its memory between calls.
#[derive(Clone, Debug, Default)]
pub struct Smoother {
    solver: BandedSolver,
    program: Program,
    /// Points of equal spacing that the bubbles are built about; index 0 is the start.
    reference: Vec<Point>,
    bubbles: Vec<Bubble>,
    /// Taken off the bubbles' radii by repairs, per control point.
    shrink_m: Vec<f64>,
    lack_m: Vec<f64>,
    /// Unknowns, then all of `C_1 .. C_n`.
    unknowns: Vec<Point>,
    controls: Vec<Point>,
    spline: Spline,
    path: Path,
}

/// What the passes of one request share.
struct Task<'a, F> {
    field: &'a F,
    request: &'a SmoothRequest<'a>,
    params: &'a SmoothParams,
    /// Clearance that the start lacks.
    deficit_m: f64,
    /// Fixed end, or centre of the disc that it may lie in.
    end: Point,
    end_radius_m: f64,
    /// Taken off the curvature bound and the friction share by repairs.
    curvature_share: f64,
    friction_share: f64,
}

impl<F: ClearanceField> Task<'_, F> {
    /// Clearance that the finished path must have at arc length `s_m`.
    fn must_keep_m(&self, s_m: f64) -> f64 {
        self.request.radius_m - self.deficit_m * (1.0 - s_m / RAMP_M).max(0.0)
    }

    /// Share of the ramp from bare limits to limits with margin.
    fn ramp(&self, s_m: f64, strictness: Strictness) -> f64 {
        match strictness {
            Strictness::Bare => 0.0,
            _ => (s_m / RAMP_M).min(1.0),
        }
    }

    /// Clearance that bubbles keep at `s_m` for control points `d_m` apart: on the chord between
    /// two points that are both this far from a corner, the middle is `must_keep_m` from it.
    fn bubble_keep_m(&self, s_m: f64, d_m: f64, strictness: Strictness) -> f64 {
        let keep = self.must_keep_m(s_m);
        let chord = (keep * keep + 0.25 * d_m * d_m).sqrt() + CURVE_MARGIN_M;
        keep + (chord - keep) * self.ramp(s_m, strictness)
    }

    /// Curvature bound at `s_m`: turning radius, and near the start what the speed allows that is
    /// left there under braking.
    fn curvature_bound_pm(&self, s_m: f64, strictness: Strictness) -> f64 {
        let limit = self.request.curvature_limit_pm;
        if let Strictness::Relaxed(factor) = strictness {
            return limit * factor;
        }
        let bare = 0.998;
        let share =
            bare + (self.params.curvature_share.min(bare) - bare) * self.ramp(s_m, strictness);
        let turn = limit * share * self.curvature_share;
        let grip = self.request.acceleration_limit_mps2;
        let energy = self.request.start_speed_mps.powi(2);
        if energy <= 0.0 {
            return turn;
        }
        // Holding the speed at (nearly) full grip, or having braked all the way.
        let held = self.request.start_curvature_pm.map_or(0.0, |k| k.abs() * energy / grip);
        let hold = held.clamp(0.95, 1.0) * grip / energy;
        let left = energy - 2.0 * BRAKE_SHARE * grip * s_m;
        let braked = if left > 0.0 { TURN_SHARE * grip / left } else { f64::INFINITY };
        turn.min((self.friction_share * hold.max(braked)).max(self.held_pm(s_m)))
    }

    /// Curvature that the car's present way has at `s_m`, 1/m.
    fn held_pm(&self, s_m: f64) -> f64 {
        let held = self.request.held;
        let next = held.partition_point(|(s, _)| *s < s_m);
        match (next.checked_sub(1).and_then(|i| held.get(i)), held.get(next)) {
            (Some((s0, k0)), Some((s1, k1))) => (k0 + (k1 - k0) * ((s_m - s0) / (s1 - s0))).abs(),
            (None, Some((_, k))) => k.abs(),
            // Where that way stops it asks for nothing.
            _ => 0.0,
        }
    }
}

impl Smoother {
    /// A path along the guide, or why there is none.
    pub fn smooth(
        &mut self,
        params: &SmoothParams,
        field: &impl ClearanceField,
        request: &SmoothRequest<'_>,
    ) -> Result<Smoothed, SmoothError> {
        check(request)?;
        let (length_m, complete) = self.take_guide(params, request)?;
        let clearance = field.clearance_m(request.start.position);
        let deficit_m = (request.radius_m - clearance).max(0.0);
        if deficit_m > START_DEFICIT_MAX_M {
            return Err(SmoothError::Blocked {
                s_m: 0.0,
                clearance_m: clearance,
                keep_m: request.radius_m,
            });
        }
        let sizes = sizes(params);
        let last = *self.reference.last().expect("the guide has points");
        // An end at the horizon is nobody's wish: it moves to where there is room.
        let end =
            if complete { last } else { bubble_at(field, last, request.radius_m, &sizes).centre };
        let mut task = Task {
            field,
            request,
            params,
            deficit_m,
            end,
            end_radius_m: if complete { request.end_radius_m } else { 0.0 },
            curvature_share: 1.0,
            friction_share: 1.0,
        };
        let mut stats = SmoothStats::default();
        let passes = if request.warm { params.passes_warm } else { params.passes };
        let mut length_m = length_m;
        let mut pass = 0;
        let mut strictness = Strictness::Margins;
        let mut d_m;
        loop {
            d_m = self.resample(params, length_m);
            self.shrink_m.clear();
            self.shrink_m.resize(self.reference.len(), 0.0);
            self.blow(&task, d_m, strictness)?;
            pass += 1;
            match self.solve(&task, d_m, strictness, &mut stats) {
                Ok(()) => {
                    if pass >= passes {
                        break;
                    }
                }
                Err(error) if stats.relaxed >= 3 => return Err(SmoothError::Infeasible(error)),
                Err(_) => {
                    // A reference that is no drivable path (sharp corners, a start across it) may
                    // leave no room for one: a relaxed solution is the better reference.
                    stats.relaxed += 1;
                    strictness = Strictness::Bare;
                    let relaxed = [2.0, 5.0].into_iter().find_map(|factor| {
                        self.solve(&task, d_m, Strictness::Relaxed(factor), &mut stats).ok()
                    });
                    if relaxed.is_none() {
                        return Err(SmoothError::Infeasible(SolveError::Infeasible));
                    }
                    pass = pass.min(passes.saturating_sub(2));
                }
            }
            length_m = self.refer_to_spline();
        }
        loop {
            self.spline.sample(SAMPLE_SPACING_M, &mut self.path);
            let Err((error, mend)) = self.verify(&task, &mut stats) else { break };
            if stats.repairs >= REPAIRS_MAX {
                return Err(error);
            }
            stats.repairs += 1;
            match mend {
                Mend::Curvature(factor) => {
                    task.curvature_share *= factor;
                    let length_m = self.refer_to_spline();
                    d_m = self.resample(params, length_m);
                    self.shrink_m.clear();
                    self.shrink_m.resize(self.reference.len(), 0.0);
                    self.blow(&task, d_m, strictness)?;
                }
                Mend::Friction => task.friction_share *= 0.85,
                Mend::Clearance => {
                    self.shrink_where_near(&task);
                    self.blow(&task, d_m, strictness)?;
                }
            }
            self.solve(&task, d_m, strictness, &mut stats).map_err(SmoothError::Infeasible)?;
        }
        stats.points = self.controls.len();
        Ok(Smoothed { path: self.path.clone(), complete, stats })
    }

    /// The guide from the start to the horizon as the first reference; its length and whether that
    /// is all of it.
    fn take_guide(
        &mut self,
        params: &SmoothParams,
        request: &SmoothRequest<'_>,
    ) -> Result<(f64, bool), SmoothError> {
        self.reference.clear();
        self.reference.push(request.start.position);
        let (mut length_m, mut complete) = (0.0, true);
        let mut last = request.start.position;
        for &p in request.guide {
            let step = (p - last).norm();
            if !step.is_finite() {
                return Err(SmoothError::BadRequest {
                    what: "a guide coordinate",
                    value: step,
                    allowed: "finite",
                });
            }
            if step < 1e-9 {
                continue;
            }
            let room = params.horizon_m - length_m;
            if step > room {
                self.reference.push(last + (p - last) * (room / step));
                length_m = params.horizon_m;
                complete = false;
                break;
            }
            self.reference.push(p);
            length_m += step;
            last = p;
        }
        if length_m < GUIDE_MIN_M {
            return Err(SmoothError::GuideTooShort { length_m, least_m: GUIDE_MIN_M });
        }
        Ok((length_m, complete))
    }

    /// Replaces the reference polyline by points at equal steps along it; returns the step.
    fn resample(&mut self, params: &SmoothParams, length_m: f64) -> f64 {
        let pieces = ((length_m / params.spacing_m).ceil() as usize).max(PIECES_MIN);
        let d_m = length_m / pieces as f64;
        let polyline = std::mem::take(&mut self.reference);
        let out = &mut self.controls;
        out.clear();
        out.push(polyline[0]);
        let (mut before, mut i) = (0.0, 1);
        for k in 1..pieces {
            let s = k as f64 * d_m;
            loop {
                let (a, b) = (polyline[i - 1], polyline[i]);
                let step = (b - a).norm();
                if before + step >= s || i + 1 == polyline.len() {
                    out.push(a + (b - a) * ((s - before) / step.max(1e-12)).min(1.0));
                    break;
                }
                before += step;
                i += 1;
            }
        }
        out.push(polyline[polyline.len() - 1]);
        self.reference = std::mem::replace(&mut self.controls, polyline);
        d_m
    }

    /// Makes the present curve the reference polyline; returns its length.
    fn refer_to_spline(&mut self) -> f64 {
        self.reference.clear();
        let mut length_m = 0.0;
        for k in 0..self.spline.pieces() {
            for t in [0.0, 0.5] {
                self.reference.push(self.spline.at(k, t).position);
            }
        }
        self.reference.push(self.spline.at(self.spline.pieces() - 1, 1.0).position);
        for w in self.reference.windows(2) {
            length_m += (w[1] - w[0]).norm();
        }
        length_m
    }

    /// Bubbles about the reference points, index 0 unused.
    fn blow<F: ClearanceField>(
        &mut self,
        task: &Task<'_, F>,
        d_m: f64,
        strictness: Strictness,
    ) -> Result<(), SmoothError> {
        let sizes = sizes(task.params);
        self.bubbles.clear();
        for (k, (&p, shrink)) in self.reference.iter().zip(&self.shrink_m).enumerate() {
            let s_m = k as f64 * d_m;
            let keep_m = task.bubble_keep_m(s_m, d_m, strictness) + shrink;
            let bubble = bubble_at(task.field, p, keep_m, &sizes);
            if bubble.radius_m < 1e-3 && k > 1 && k + 1 < self.reference.len() {
                let clearance_m = task.field.clearance_m(p);
                return Err(SmoothError::Blocked { s_m, clearance_m, keep_m });
            }
            self.bubbles.push(Bubble { radius_m: bubble.radius_m.max(1e-3), ..bubble });
        }
        Ok(())
    }

    /// Sets up the program about the reference, solves it and puts the result into the spline.
    fn solve<F: ClearanceField>(
        &mut self,
        task: &Task<'_, F>,
        d_m: f64,
        strictness: Strictness,
        stats: &mut SmoothStats,
    ) -> Result<(), SolveError> {
        let request = task.request;
        // control points C_0 .. C_n; C_0 follows from C_1
        let n = self.reference.len() - 1;
        let start = request.start.position.coords;
        let forward = heading_vector(request.start.heading_rad);
        let fixed_first = request.start_curvature_pm.map(|k| {
            let bound = task.curvature_bound_pm(0.0, strictness);
            let left = Vector::new(-forward.y, forward.x);
            start + forward * d_m + left * (k.clamp(-bound, bound) * d_m * d_m / 3.0)
        });
        let low = if fixed_first.is_some() { 2 } else { 1 };
        let high = if task.end_radius_m > 0.0 { n + 1 } else { n };
        let m = high - low;
        let known = |k: usize| match k {
            1 => fixed_first.expect("C_1 is unknown unless it is fixed"),
            _ => task.end.coords,
        };
        let stencil = |terms: &[(usize, f64)], offset: Vector| {
            let first = terms.iter().map(|t| t.0).min().expect("a stencil has terms");
            let first = first.max(low).min(high - 3) - low;
            let mut stencil = Stencil { first, coef: [0.0; 3], offset };
            for &(k, c) in terms {
                if (low..high).contains(&k) {
                    stencil.coef[k - low - first] += c;
                } else {
                    stencil.offset += known(k) * c;
                }
            }
            stencil
        };
        self.program.clear();
        for k in low..high {
            let bubble = &self.bubbles[k];
            self.program.discs.push(if k == n {
                Disc { centre: task.end, radius_m: task.end_radius_m }
            } else {
                Disc { centre: bubble.centre, radius_m: bubble.radius_m }
            });
        }
        let squared = d_m * d_m;
        let weight = 1.0 / (squared * squared);
        let bound = |k: usize| task.curvature_bound_pm(k as f64 * d_m, strictness) * squared;
        let step = forward * d_m;
        if fixed_first.is_none() {
            let turn = stencil(&[(1, -3.0)], (start + step) * 3.0);
            self.program.bends.push(Bend {
                stencil: turn,
                bound_m: bound(0),
                weight: 0.5 * weight,
            });
        }
        let turn = stencil(&[(1, 2.5), (2, -1.0)], (start * 3.0 + step) * -0.5);
        self.program.bends.push(Bend { stencil: turn, bound_m: bound(1), weight });
        for k in 2..n {
            let turn = stencil(&[(k - 1, -1.0), (k, 2.0), (k + 1, -1.0)], Vector::zeros());
            self.program.bends.push(Bend { stencil: turn, bound_m: bound(k), weight });
        }
        let fade = ((8.0 - request.speed_max_mps) / 4.0).clamp(0.0, 1.0);
        let weight = task.params.length_weight_pm2 * fade / squared;
        if weight > 0.0 {
            if fixed_first.is_none() {
                let chord = stencil(&[(1, 1.0)], -start);
                self.program.stretches.push(Stretch { stencil: chord, weight });
            }
            for k in 1..n {
                let chord = stencil(&[(k, -1.0), (k + 1, 1.0)], Vector::zeros());
                self.program.stretches.push(Stretch { stencil: chord, weight });
            }
        }

        // Steps C_{k-1} C_k and C_k C_{k+1} along the reference's directions.
        let evenness = std::env::var("EVEN").map_or(1000.0, |v| v.parse().unwrap());
        let weight = evenness / (squared * squared);
        let reach =
            ((0.01 + std::env::var("REACH").map_or(0.0, |v| v.parse().unwrap())) / d_m) as usize;
        let along = |k: usize| {
            let (a, b) = (k.saturating_sub(reach), (k + 1 + reach).min(n));
            (self.reference[b] - self.reference[a]).normalize()
        };
        for k in 2..n {
            let (t0, t1) = (along(k - 1), along(k));
            let mut row = Unevenness {
                first: (k - 1).max(low).min(high - 3) - low,
                coef: [Vector::zeros(); 3],
                offset_m: 0.0,
                weight,
            };
            for (j, c) in [(k - 1, t0), (k, -t0 - t1), (k + 1, t1)] {
                if (low..high).contains(&j) {
                    row.coef[j - low - row.first] += c;
                } else {
                    row.offset_m += known(j).dot(&c);
                }
            }
            self.program.unevennesses.push(row);
        }

        stats.solves += 1;
        self.unknowns.clear();
        self.unknowns.extend_from_slice(&self.reference[low..high]);
        debug_assert_eq!(self.unknowns.len(), m);
        let iterations = match task.params.solver {
            Solver::Banded => {
                self.solver.solve(&self.program, &Tolerances::SHAPE, &mut self.unknowns)
            }
            Solver::Clarabel => reference::solve(&self.program, &mut self.unknowns),
        }?;
        stats.iterations += iterations;
        self.controls.clear();
        self.controls.extend(fixed_first.map(Point::from));
        self.controls.extend_from_slice(&self.unknowns);
        if high == n {
            self.controls.push(task.end);
        }
        self.spline.set(&request.start, d_m, &self.controls);
        Ok(())
    }

    /// Checks the sampled curve against every limit.
    fn verify<F: ClearanceField>(
        &self,
        task: &Task<'_, F>,
        stats: &mut SmoothStats,
    ) -> Result<(), (SmoothError, Mend)> {
        let limit_pm = task.request.curvature_limit_pm;
        let tightest = self
            .path
            .points
            .iter()
            .max_by(|a, b| a.curvature_pm.abs().total_cmp(&b.curvature_pm.abs()));
        let tightest = tightest.expect("a path has samples");
        stats.curvature_max_pm = tightest.curvature_pm.abs();
        if !(stats.curvature_max_pm <= limit_pm * (1.0 + CURVATURE_TOLERANCE)) {
            let error = SmoothError::TooTight {
                s_m: tightest.s_m,
                curvature_pm: stats.curvature_max_pm,
                limit_pm,
            };
            let factor = (limit_pm / stats.curvature_max_pm * 0.995).clamp(0.8, 0.995);
            return Err((error, Mend::Curvature(factor)));
        }
        stats.clearance_slack_m = f64::INFINITY;
        let mut nearest = None;
        for p in &self.path.points {
            let (clearance_m, keep_m) =
                (task.field.clearance_m(p.position), task.must_keep_m(p.s_m));
            if clearance_m - keep_m < stats.clearance_slack_m {
                stats.clearance_slack_m = clearance_m - keep_m;
                nearest = Some(SmoothError::TooNear { s_m: p.s_m, clearance_m, keep_m });
            }
        }
        if let Some(error) = nearest.filter(|_| stats.clearance_slack_m < -CLEARANCE_TOLERANCE_M) {
            return Err((error, Mend::Clearance));
        }
        self.brake(task).map_err(|error| (error, Mend::Friction))
    }

    /// Brakes from the start speed as hard as the friction circle allows along the path: its speed
    /// must nowhere be more than the bends bear. (With a few percent of leave: the speed profile
    /// is the judge, this saves it hopeless paths.)
    fn brake<F: ClearanceField>(&self, task: &Task<'_, F>) -> Result<(), SmoothError> {
        let grip = task.request.acceleration_limit_mps2;
        let mut energy = task.request.start_speed_mps.powi(2);
        for w in self.path.points.windows(2) {
            let lateral = energy * w[0].curvature_pm.abs().max(w[1].curvature_pm.abs());
            if lateral > 1.02 * grip {
                return Err(SmoothError::TooFast { s_m: w[1].s_m, speed_mps: energy.sqrt() });
            }
            let braking = (grip * grip - lateral * lateral).max(0.0).sqrt();
            energy -= 2.0 * braking * (w[1].s_m - w[0].s_m);
            if energy <= 0.0 {
                break;
            }
        }
        Ok(())
    }

    /// Takes what the curve lacks in clearance off the bubbles of the control points around.
    fn shrink_where_near<F: ClearanceField>(&mut self, task: &Task<'_, F>) {
        let samples = self.path.points.len() - 1;
        let per_piece = samples / self.spline.pieces();
        self.lack_m.clear();
        self.lack_m.resize(self.shrink_m.len(), 0.0);
        for (i, p) in self.path.points.iter().enumerate() {
            let lack = task.must_keep_m(p.s_m) - task.field.clearance_m(p.position);
            if lack > 0.0 {
                let k = i / per_piece;
                for j in k.saturating_sub(1)..=(k + 2).min(self.lack_m.len() - 1) {
                    self.lack_m[j] = self.lack_m[j].max(lack + CURVE_MARGIN_M);
                }
            }
        }
        for (shrink, lack) in self.shrink_m.iter_mut().zip(&self.lack_m) {
            *shrink += lack;
        }
    }
}

/// What to change after a failed check.
enum Mend {
    /// Curvature bound times this.
    Curvature(f64),
    Friction,
    Clearance,
}

fn sizes(params: &SmoothParams) -> BubbleSizes {
    BubbleSizes { wanted_m: params.bubble_wanted_m, max_m: params.bubble_radius_max_m }
}

fn check(request: &SmoothRequest<'_>) -> Result<(), SmoothError> {
    let bad = |what, value, allowed| Err(SmoothError::BadRequest { what, value, allowed });
    let start = request.start;
    for value in [start.position.x, start.position.y, start.heading_rad] {
        if !value.is_finite() {
            return bad("a start coordinate", value, "finite");
        }
    }
    let curvature = request.start_curvature_pm.unwrap_or(0.0);
    if !curvature.is_finite() {
        return bad("the start's curvature", curvature, "finite");
    }
    for (what, value) in [
        ("the start speed", request.start_speed_mps),
        ("the end's radius", request.end_radius_m),
        ("the clearance to keep", request.radius_m),
        ("the speed limit", request.speed_max_mps),
    ] {
        if !(value >= 0.0 && value.is_finite()) {
            return bad(what, value, "finite and not negative");
        }
    }
    for (what, value) in [
        ("the curvature limit", request.curvature_limit_pm),
        ("the acceleration limit", request.acceleration_limit_mps2),
    ] {
        if !(value > 0.0 && value.is_finite()) {
            return bad(what, value, "finite and positive");
        }
    }
    Ok(())
}
