//! How far shapes may rely on a network.

use super::PlannerParams;
use crate::plan::foreseen::ForeseenParams;
use crate::predict::OccupancyView;

/// Weight of the newest scene in the mean of how familiar they look.
const NEWEST: f64 = 0.1;

/// Whether the scenes of late look like those that a network was trained on.
///
/// A shape drawn into space that turns out otherwise costs more than one that fits saves. So what a
/// network holds for likely is drawn upon only where it is at home, at speeds at which there is time to
/// think again, and not by a car that has got stuck.
#[derive(Debug, Default)]
pub(super) struct Reliance {
    /// Running mean, 0 to 1.
    familiarity: f64,
}

impl Reliance {
    /// What of this step's view shapes rely on; `is_stuck`: the car has been looking for a way out.
    pub(super) fn judge(
        &mut self,
        params: &PlannerParams,
        is_stuck: bool,
        view: &mut dyn OccupancyView,
    ) -> ForeseenParams {
        let wanted = &params.foreseen;
        let nothing = wanted.of_certainty();
        if view.is_ever_certain() {
            return wanted.clone();
        }
        let is_asked = wanted.free_at_most > 0.0 || wanted.occupied_at_least < 1.0;
        let is_slow = params.speed.speed_max_mps <= wanted.network_speed_mps;
        if !is_asked || !is_slow || !params.plan.policy.is_predictive() {
            self.familiarity = 0.0;
            return nothing;
        }
        self.familiarity += NEWEST * (view.familiarity() - self.familiarity);
        let is_at_home = self.familiarity >= wanted.familiarity_at_least;
        if is_at_home && !is_stuck { wanted.clone() } else { nothing }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Point;

    struct View {
        certain: bool,
        familiarity: f64,
    }

    impl OccupancyView for View {
        fn occupied(&mut self, _: &[Point], _: &mut [f32]) {
            panic!("it is not asked for answers");
        }

        fn is_ever_certain(&self) -> bool {
            self.certain
        }

        fn familiarity(&mut self) -> f64 {
            self.familiarity
        }
    }

    fn relies(reliance: &mut Reliance, params: &PlannerParams, stuck: bool, view: f64) -> bool {
        let mut view = View { certain: false, familiarity: view };
        reliance.judge(params, stuck, &mut view).free_at_most > 0.0
    }

    #[test]
    fn a_network_is_relied_on_once_scenes_have_looked_familiar_for_a_while() {
        let params = PlannerParams::default();
        assert!(params.foreseen.free_at_most > 0.0);
        let mut reliance = Reliance::default();
        assert!(!relies(&mut reliance, &params, false, 0.6));
        let after = (0..20).position(|_| relies(&mut reliance, &params, false, 0.6));
        assert!(after.is_some_and(|after| after > 3), "{after:?}");
        assert!((0..20).all(|_| relies(&mut reliance, &params, false, 0.6)));
        // One odd scene is nothing, many are.
        assert!(relies(&mut reliance, &params, false, 0.0));
        assert!(!(0..20).all(|_| relies(&mut reliance, &params, false, 0.0)));
        assert!(!relies(&mut reliance, &params, false, 0.1));
    }

    #[test]
    fn a_fast_car_and_one_that_is_stuck_rely_on_no_network_but_on_who_knows() {
        let mut params = PlannerParams::default();
        let mut reliance = Reliance { familiarity: 1.0 };
        assert!(relies(&mut reliance, &params, false, 1.0));
        assert!(!relies(&mut reliance, &params, true, 1.0));
        params.speed.speed_max_mps = 8.0;
        assert!(!relies(&mut reliance, &params, false, 1.0));
        let mut oracle = View { certain: true, familiarity: 0.0 };
        assert!(reliance.judge(&params, true, &mut oracle).free_at_most > 0.0);
    }
}
