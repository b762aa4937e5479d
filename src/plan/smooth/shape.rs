//! The passes: reference, bubbles, program, curve, and the checks of the finished curve.

use super::banded_socp::{BandedSolver, Tolerances};
use super::program::{Bend, Disc, Program, SolveError, Stencil, Stretch, Unevenness};
use super::reference;
use super::request::{SmoothError, SmoothParams, SmoothRequest, SmoothStats, Smoothed, Solver};
use super::spline::Spline;
use crate::frames::{Point, Vector, heading_vector};
use crate::plan::Path;
use crate::plan::bubbles::{Bubble, BubbleSizes, ClearanceField, bubble_at};

mod checks;
mod grip;
mod guide;

use checks::Mend;
use grip::{TURN_SHARE_MIN, TURN_SHARE_STEP, held_pm};
use guide::END_ROOM_M;

/// A guide that leads into a place without room, or into a bend that cannot be driven, is followed
/// up to there if that is at least this far: much changes before the car gets there. Nearer,
/// another way is wanted.
const LEAD_MIN_M: f64 = 0.8;
/// A path ends this far before a place without room.
const LEAD_GAP_M: f64 = 0.25;
/// Samples of the finished path are at most this far apart.
const SAMPLE_SPACING_M: f64 = 0.05;
/// Limits are tightened from their exact values at the start to those with margin over this
/// length, so that the rest of a path that kept them with margin is feasible when replanned.
const RAMP_M: f64 = 1.0;
/// Bubbles keep this much more than the finished curve must: the curve lies up to this far inside
/// the chords between control points.
const CURVE_MARGIN_M: f64 = 0.001;
/// By how much a car may start too close to an obstacle (drift of the map against the plan under
/// way); it must get clear of it within `RAMP_M`.
const START_DEFICIT_MAX_M: f64 = 0.06;
/// Most solves after the passes to mend a limit that the finished curve breaks.
const REPAIRS_MAX: u32 = 5;
/// Weight of squared differences between successive steps against squared second differences.
/// Without it points gather in bends, which makes tight bends look cheap and breaks the turning
/// radius (every tenth maze failed, the others were 1 % slower). In the first pass less, because
/// the reference's directions there are those of a staircase of cells.
const EVENNESS_FIRST: f64 = 100.0;
const EVENNESS: f64 = 1000.0;

/// Turning radius is divided by this in the first pass about a guide on cells.
const FIRST_PASS_RELAXED: f64 = 1.5;

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
    /// Curvature that the tyres bear at equal steps from the start; unlimited after the last.
    grip_bound_pm: Vec<f64>,
    grip_step_m: f64,
    curvatures_pm: Vec<f64>,
    path: Path,
}

/// What the passes of one request share.
struct Task<'a, F> {
    field: &'a F,
    request: &'a SmoothRequest<'a>,
    params: &'a SmoothParams,
    /// Clearance that the start has, and what it lacks.
    start_clearance_m: f64,
    deficit_m: f64,
    end_clearance_m: f64,
    /// Of the present reference.
    length_m: f64,
    /// Fixed end, or centre of the disc that it may lie in.
    end: Point,
    end_radius_m: f64,
    /// Taken off the curvature bound by repairs.
    curvature_share: f64,
    /// Least share of the friction circle for bends while the start speed is shed.
    turn_share_min: f64,
}

impl<F: ClearanceField> Task<'_, F> {
    /// Clearance that the finished path must have at arc length `s_m`: what is asked and, away
    /// from both ends, the margin; less near a start that lacks it.
    fn must_keep_m(&self, s_m: f64, strictness: Strictness) -> f64 {
        let margin = if strictness == Strictness::Bare { 0.0 } else { self.params.margin_m };
        let near = near_end(s_m).max(near_end(self.length_m - s_m));
        self.request.radius_m + margin * (1.0 - near) - self.deficit_m * near_end(s_m)
    }

    /// Clearance that bubbles keep at `s_m` for control points `d_m` apart: on the chord between
    /// two points that are both this far from a corner, the middle is `must_keep_m` from it.
    /// Never more than what the ends have and what a gentle bend away gains from there.
    fn bubble_keep_m(&self, s_m: f64, d_m: f64, strictness: Strictness) -> f64 {
        let keep = self.must_keep_m(s_m, strictness);
        let extra = (keep * keep + 0.25 * d_m * d_m).sqrt() + CURVE_MARGIN_M - keep;
        let asked = self.request.radius_m;
        let lack_start = extra - (self.start_clearance_m - asked + self.deficit_m);
        let lack_end = extra - (self.end_clearance_m - asked);
        let lack = (lack_start.max(0.0) * near_end(s_m))
            .max(lack_end.clamp(0.0, extra) * near_end(self.length_m - s_m));
        keep + extra - lack
    }

    /// Curvature that the steering allows at `s_m`.
    fn steering_bound_pm(&self, s_m: f64, strictness: Strictness) -> f64 {
        let limit = self.request.curvature_limit_pm;
        if let Strictness::Relaxed(factor) = strictness {
            return limit * factor;
        }
        let exact = 0.998;
        let ramp = if strictness == Strictness::Bare { 0.0 } else { (s_m / RAMP_M).min(1.0) };
        let share = exact + (self.params.curvature_share.min(exact) - exact) * ramp;
        limit * share * self.curvature_share
    }
}

impl Smoother {
    /// A path along the guide, or why there is none.
    ///
    /// A path that stops short of a far place without room lets the car go and see, and so does
    /// one along the first half of a guide that has no drivable shape as a whole.
    ///
    /// # Errors
    /// If the request is unusable, there is no room, or no shape is found.
    pub fn smooth(
        &mut self,
        params: &SmoothParams,
        field: &impl ClearanceField,
        request: &SmoothRequest<'_>,
    ) -> Result<Smoothed, SmoothError> {
        let mut result = self.smooth_within(params, field, request);
        let guide_m: f64 = request.guide.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
        let mut length_m = guide_m.min(params.horizon_m);
        loop {
            length_m = match result {
                Err(SmoothError::Blocked { s_m, .. }) => (s_m - LEAD_GAP_M).min(0.9 * length_m),
                Err(SmoothError::Infeasible(_)) => 0.5 * length_m,
                done => return done,
            };
            if length_m < LEAD_MIN_M {
                return result;
            }
            let nearer = SmoothParams { horizon_m: length_m, ..params.clone() };
            result = self.smooth_within(&nearer, field, request);
        }
    }

    fn smooth_within(
        &mut self,
        params: &SmoothParams,
        field: &impl ClearanceField,
        request: &SmoothRequest<'_>,
    ) -> Result<Smoothed, SmoothError> {
        check(request)?;
        let (mut length_m, complete) = self.take_guide(params, request)?;
        let clearance = field.clearance_m(request.start.position);
        let deficit_m = (request.radius_m - clearance).max(0.0);
        if deficit_m > START_DEFICIT_MAX_M {
            return Err(SmoothError::Blocked {
                s_m: 0.0,
                clearance_m: clearance,
                keep_m: request.radius_m,
            });
        }
        if !complete {
            // An end at the horizon is nobody's wish: it goes where there is room.
            length_m -= self.step_back(field, request.radius_m + END_ROOM_M);
            length_m = self.shift_end(params, field, request.radius_m, length_m);
        }
        let end = *self.reference.last().expect("the guide has points");
        let end_room_m = (field.clearance_m(end) - request.radius_m - params.margin_m).max(0.0);
        let mut task = Task {
            field,
            request,
            params,
            start_clearance_m: clearance,
            deficit_m,
            end_clearance_m: field.clearance_m(end),
            length_m,
            end,
            end_radius_m: if complete { request.end_radius_m.min(end_room_m) } else { 0.0 },
            curvature_share: 1.0,
            turn_share_min: TURN_SHARE_MIN,
        };
        let mut stats = SmoothStats::default();
        let passes = if request.warm { params.passes_warm } else { params.passes };
        // length of the reference before, unless that was the guide
        let mut before_m = None;
        let mut is_guide = true;
        let mut pass = 0;
        let mut strictness = Strictness::Margins;
        self.brake_straight(request);
        let mut d_m;
        loop {
            task.length_m = length_m;
            d_m = self.resample(params, length_m) * steady(before_m, length_m);
            self.shrink_m.clear();
            self.shrink_m.resize(self.reference.len(), 0.0);
            self.blow(&task, d_m, strictness)?;
            pass += 1;
            if request.warm && pass == 1 {
                self.brake_along_reference(request, d_m, task.turn_share_min);
            }
            // A guide of straight cells with corners leaves less room than there is.
            let mut attempt = strictness;
            if !request.warm && pass == 1 && passes > 1 && stats.solves == 0 {
                attempt = Strictness::Relaxed(FIRST_PASS_RELAXED);
            }
            match self.solve(&task, d_m, attempt, &mut stats) {
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
                    if stats.relaxed >= 2 {
                        strictness = Strictness::Bare;
                    }
                    let relaxed = [1.25, 2.0, 5.0].into_iter().find_map(|factor| {
                        self.solve(&task, d_m, Strictness::Relaxed(factor), &mut stats).ok()
                    });
                    if relaxed.is_none() {
                        return Err(SmoothError::Infeasible(SolveError::Infeasible));
                    }
                    pass = pass.min(passes.saturating_sub(2));
                }
            }
            before_m = (!std::mem::replace(&mut is_guide, false)).then_some(length_m);
            length_m = self.refer_to_spline();
            self.brake_along_spline(request, task.turn_share_min);
        }
        loop {
            self.spline.sample(SAMPLE_SPACING_M, &mut self.path);
            let Err((error, mend)) = self.verify(&task, strictness, &mut stats) else { break };
            if stats.repairs >= REPAIRS_MAX {
                return Err(error);
            }
            stats.repairs += 1;
            match mend {
                Mend::Curvature(_) | Mend::Friction => {
                    if let Mend::Curvature(factor) = mend {
                        // The first time, equal steps of the right length may be all it takes.
                        if stats.repairs > 1 {
                            task.curvature_share *= factor;
                        }
                    } else {
                        task.turn_share_min = (task.turn_share_min - TURN_SHARE_STEP).max(0.0);
                    }
                    before_m = Some(length_m);
                    length_m = self.refer_to_spline();
                    self.brake_along_spline(request, task.turn_share_min);
                    task.length_m = length_m;
                    d_m = self.resample(params, length_m) * steady(before_m, length_m);
                    self.shrink_m.clear();
                    self.shrink_m.resize(self.reference.len(), 0.0);
                    self.blow(&task, d_m, strictness)?;
                }
                Mend::Clearance => {
                    self.shrink_where_near(&task, strictness);
                    self.blow(&task, d_m, strictness)?;
                }
            }
            self.solve(&task, d_m, strictness, &mut stats).map_err(SmoothError::Infeasible)?;
        }
        stats.points = self.controls.len();
        Ok(Smoothed { path: self.path.clone(), complete, stats })
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
            let bound = task.steering_bound_pm(0.0, strictness);
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
        let relaxed = matches!(strictness, Strictness::Relaxed(_));
        let bound = |k: usize| {
            let s_m = k as f64 * d_m;
            let turn = task.steering_bound_pm(s_m, strictness);
            let grip = self.grip_bound_pm.get((s_m / self.grip_step_m) as usize);
            squared
                * grip
                    .filter(|_| !relaxed)
                    .map_or(turn, |g| turn.min(g.max(held_pm(request.held, s_m))))
        };
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
        let bend = task.request.acceleration_limit_mps2 / request.speed_max_mps.max(0.1).powi(2);
        let bend = bend.min(2.0 * request.curvature_limit_pm);
        let weight = task.params.length_weight * bend * bend / squared;
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
        let first = stats.solves == 0 && !request.warm;
        let weight = if first { EVENNESS_FIRST } else { EVENNESS } / (squared * squared);
        let along = |k: usize| (self.reference[k + 1] - self.reference[k]).normalize();
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
}

/// Factor on the step of the next program, from the lengths of the last two references (none for
/// the guide's, which says nothing). Where the turning radius decides the length, a step too long
/// makes the next result too short, and so on: the mean of the two ends that.
fn steady(before_m: Option<f64>, length_m: f64) -> f64 {
    before_m.map_or(1.0, |before_m| (0.5 * (1.0 + before_m / length_m)).clamp(0.95, 1.05))
}

/// 1 at an end, falling to 0 over `RAMP_M` with no slope there: what a path gains sideways in a
/// gentle bend goes with the square of the distance.
fn near_end(distance_m: f64) -> f64 {
    1.0 - (distance_m.max(0.0) / RAMP_M).min(1.0).powi(2)
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
