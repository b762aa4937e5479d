//! The finished curve against every limit.

use super::super::request::{SmoothError, SmoothStats};
use super::{CURVE_MARGIN_M, Smoother, Strictness, Task};
use crate::plan::bubbles::ClearanceField;

/// Rounding of the finished curve against its limits, metres and relative.
const CLEARANCE_TOLERANCE_M: f64 = 1e-5;
const CURVATURE_TOLERANCE: f64 = 1e-6;

/// What the speed profile may use beyond the wished share where the start speed asks for it. Less
/// refuses a path along which a plan at the limit is being driven already: its braking, worked out
/// anew from other samples, comes out a rounding too weak.
const BRAKE_LEAVE: f64 = 1.03;

/// What to change after a failed check.
pub(super) enum Mend {
    /// Curvature bound times this.
    Curvature(f64),
    /// The grip bound near the start.
    Friction,
    /// The bubbles' radii where the curve is too near.
    Clearance,
}

impl Smoother {
    /// Checks the sampled curve against every limit.
    pub(super) fn verify<F: ClearanceField>(
        &self,
        task: &Task<'_, F>,
        strictness: Strictness,
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
        let most = limit_pm * (1.0 + CURVATURE_TOLERANCE);
        if stats.curvature_max_pm.is_nan() || stats.curvature_max_pm > most {
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
                (task.field.clearance_m(p.position), task.must_keep_m(p.s_m, strictness));
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
    /// must nowhere be more than the bends bear. (With some leave: the speed profile is the judge,
    /// this saves it hopeless paths.)
    pub(super) fn brake<F: ClearanceField>(&self, task: &Task<'_, F>) -> Result<(), SmoothError> {
        let grip = BRAKE_LEAVE * task.request.acceleration_limit_mps2;
        let mut energy = task.request.start_speed_mps.powi(2);
        for w in self.path.points.windows(2) {
            let lateral = energy * w[0].curvature_pm.abs().max(w[1].curvature_pm.abs());
            if lateral > grip {
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
    pub(super) fn shrink_where_near<F: ClearanceField>(
        &mut self,
        task: &Task<'_, F>,
        strictness: Strictness,
    ) {
        let samples = self.path.points.len() - 1;
        let per_piece = samples / self.spline.pieces();
        self.lack_m.clear();
        self.lack_m.resize(self.shrink_m.len(), 0.0);
        for (i, p) in self.path.points.iter().enumerate() {
            let lack = task.must_keep_m(p.s_m, strictness) - task.field.clearance_m(p.position);
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
