//! What the tyres bear near the start, where the car has a speed that it cannot shed at once.

use super::super::request::SmoothRequest;
use super::Smoother;

/// While the start speed is shed, bends may use what share of the friction circle the last curve
/// used there, but at most and at least these (the least leaves freedom on straights, at the cost
/// of some braking; repairs lower it by the step).
const TURN_SHARE_MAX: f64 = 0.98;
pub(super) const TURN_SHARE_MIN: f64 = 0.6;
pub(super) const TURN_SHARE_STEP: f64 = 0.12;

impl Smoother {
    /// Bends that even full braking on a straight does not bring into the friction circle are
    /// hopeless: the bound before there is a curve.
    pub(super) fn brake_straight(&mut self, request: &SmoothRequest<'_>) {
        self.grip_bound_pm.clear();
        self.grip_step_m = 0.05;
        let grip = request.acceleration_limit_mps2;
        let mut left = request.start_speed_mps.powi(2);
        while left > 0.0 {
            self.grip_bound_pm.push(TURN_SHARE_MAX * grip / left);
            left -= 2.0 * grip * self.grip_step_m;
        }
        self.hold_first(request);
    }

    /// The bound from the present curve: bends may use the share of the friction circle that they
    /// use there, and the rest brakes. Whatever keeps this bound can be driven from the start
    /// speed: with the turning share c, squared speed e and bound c A / e, a flatter curve only
    /// brakes more.
    pub(super) fn brake_along_spline(&mut self, request: &SmoothRequest<'_>, share_min: f64) {
        let pieces = self.spline.pieces();
        self.grip_step_m = self.spline.at(0, 0.0).velocity.norm() * 0.5;
        self.curvatures_pm.clear();
        self.curvatures_pm.extend(
            (0..2 * pieces)
                .map(|i| self.spline.at(i / 2, 0.5 * (i % 2) as f64).curvature_pm().abs()),
        );
        self.brake_along_curvatures(request, share_min);
    }

    /// The same from the reference, when that is a drivable shape.
    pub(super) fn brake_along_reference(
        &mut self,
        request: &SmoothRequest<'_>,
        d_m: f64,
        share_min: f64,
    ) {
        self.grip_step_m = d_m;
        self.curvatures_pm.clear();
        self.curvatures_pm.push(request.start_curvature_pm.unwrap_or(0.0).abs());
        self.curvatures_pm.extend(
            self.reference.windows(3).map(|w| ((w[2] - w[1]) - (w[1] - w[0])).norm() / (d_m * d_m)),
        );
        self.brake_along_curvatures(request, share_min);
    }

    pub(super) fn brake_along_curvatures(&mut self, request: &SmoothRequest<'_>, share_min: f64) {
        self.grip_bound_pm.clear();
        let grip = request.acceleration_limit_mps2;
        let mut left = request.start_speed_mps.powi(2);
        for curvature in &self.curvatures_pm {
            if left <= 0.0 {
                break;
            }
            let share = (curvature * left / grip).clamp(share_min, TURN_SHARE_MAX);
            self.grip_bound_pm.push(share * grip / left);
            left -= 2.0 * grip * (1.0 - share * share).sqrt() * self.grip_step_m;
        }
        self.hold_first(request);
    }

    /// A car on the limit of the friction circle may stay there for the first steps.
    pub(super) fn hold_first(&mut self, request: &SmoothRequest<'_>) {
        let held = request.start_curvature_pm.unwrap_or(0.0).abs();
        for bound in self.grip_bound_pm.iter_mut().take(2) {
            *bound = bound.max(held);
        }
    }
}

/// Curvature at `s_m` of the way that the car is on, 1/m; where that way stops, zero.
pub(super) fn held_pm(held: &[(f64, f64)], s_m: f64) -> f64 {
    let next = held.partition_point(|(s, _)| *s < s_m);
    match (next.checked_sub(1).and_then(|i| held.get(i)), held.get(next)) {
        (Some((s0, k0)), Some((s1, k1))) => (k0 + (k1 - k0) * ((s_m - s0) / (s1 - s0))).abs(),
        (None, Some((_, k))) => k.abs(),
        _ => 0.0,
    }
}
