//! The reference that a program is set up about: first the guide, then the last curve.

use super::super::request::{SmoothError, SmoothParams, SmoothRequest};
use super::{RAMP_M, Smoother, sizes};
use crate::frames::Point;
use crate::plan::bubbles::{ClearanceField, bubble_at};

/// Fewest polynomial pieces of a path.
const PIECES_MIN: usize = 8;
/// Shortest guide worth a path.
const GUIDE_MIN_M: f64 = 0.05;
/// Room wanted at an end on the horizon beyond the clearance to keep; how far back it is looked
/// for, in which steps.
pub(super) const END_ROOM_M: f64 = 0.4;
const END_SEARCH_M: f64 = 1.5;
const END_STEP_M: f64 = 0.1;

impl Smoother {
    /// The guide from the start to the horizon as the first reference; its length and whether that
    /// is all of it.
    pub(super) fn take_guide(
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

    /// Where stepping back found no room, moves the reference's end off the obstacle, its last
    /// metre with it. Returns the new length.
    pub(super) fn shift_end(
        &mut self,
        params: &SmoothParams,
        field: &impl ClearanceField,
        keep_m: f64,
        length_m: f64,
    ) -> f64 {
        let last = *self.reference.last().expect("the guide has points");
        if field.clearance_m(last) >= keep_m + 0.5 * END_ROOM_M {
            return length_m;
        }
        let end = bubble_at(field, last, keep_m, &sizes(params)).centre;
        while self.reference.len() > 2
            && (self.reference[self.reference.len() - 1] - last).norm() < RAMP_M
        {
            self.reference.pop();
        }
        self.reference.push(end);
        self.reference.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
    }

    /// Shortens the reference polyline by up to `END_SEARCH_M`, but no more than half of it, so that
    /// its end has `enough_m` of clearance, or the most there is. Returns by how much.
    pub(super) fn step_back(&mut self, field: &impl ClearanceField, enough_m: f64) -> f64 {
        let clearance_m = |p: &Point| field.clearance_m(*p).min(enough_m);
        let length_m: f64 = self.reference.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
        let search_m = END_SEARCH_M.min(0.5 * length_m);
        let mut end = *self.reference.last().expect("the guide has points");
        let (mut best, mut best_m, mut best_clearance_m) = (end, 0.0, clearance_m(&end));
        let mut points = self.reference.iter().rev().skip(1);
        let (mut back_m, mut next) = (0.0, points.next());
        while let Some(target) = next {
            if best_clearance_m >= enough_m || back_m + END_STEP_M > search_m {
                break;
            }
            // one step towards the point before, or to it
            let way = target - end;
            let step_m = way.norm().min(END_STEP_M);
            if way.norm() <= END_STEP_M {
                end = *target;
                next = points.next();
            } else {
                end += way * (END_STEP_M / way.norm());
            }
            back_m += step_m;
            if clearance_m(&end) > best_clearance_m {
                (best, best_m, best_clearance_m) = (end, back_m, clearance_m(&end));
            }
        }
        let mut left_m = best_m;
        while let [.., before, last] = self.reference[..] {
            let step_m = (last - before).norm();
            if step_m > left_m {
                break;
            }
            left_m -= step_m;
            self.reference.pop();
        }
        if left_m > 0.0 {
            *self.reference.last_mut().expect("the guide has points") = best;
        }
        best_m
    }

    /// Replaces the reference polyline by points at equal steps along it; returns the step.
    pub(super) fn resample(&mut self, params: &SmoothParams, length_m: f64) -> f64 {
        let pieces = ((length_m / params.spacing_m).ceil() as usize).max(PIECES_MIN);
        let d_m = length_m / pieces as f64;
        let mut polyline = std::mem::take(&mut self.reference);
        // A guide cut back to a single point has no direction; the solver then says so.
        if polyline.len() == 1 {
            polyline.push(polyline[0]);
        }
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
    pub(super) fn refer_to_spline(&mut self) -> f64 {
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
}
