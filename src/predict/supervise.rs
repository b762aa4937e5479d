//! Keeps a predictor that fails, babbles or dawdles from holding up or misleading the planner.

use super::{Effort, OccupancyView, PredictFault, Predictor, SILENT, Scene};
use crate::frames::Point;
use crate::map::CellRect;
use crate::time::Duration;

/// After a fault the predictor is left alone for this many steps (a second at 20 Hz).
const REST_STEPS: u32 = 20;
/// After this many faults it is left alone for good.
const STRIKES_MAX: u32 = 3;
/// So many steps in a row without a fault make up for one (ten seconds at 20 Hz).
const FORGIVEN_AFTER_STEPS: u32 = 200;
/// A step that takes this many times as long as allowed is no accident.
const HOPELESS: u32 = 10;

/// What a step's prediction came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictReport {
    /// What went wrong in this step.
    pub fault: Option<PredictFault>,
    /// Nothing was asked of the predictor, because of faults before.
    pub resting: bool,
    /// Nothing was asked of the predictor, because the planner did without it.
    pub passed_over: bool,
    /// What was worked through.
    pub effort: Effort,
    /// Wall time of it, by the clock that the caller injects.
    pub spent: Duration,
}

/// A predictor under supervision.
///
/// The first fault of a step (an answer that is no probability, a network that does not run, more
/// time spent than allowed) ends its prediction: the answers from then on are 0.5. The predictor
/// is then left alone for [`REST_STEPS`] steps, after three faults for good, and so at once after a
/// step of ten times the time allowed. 200 good steps make up for one fault.
pub struct Supervised {
    predictor: Box<dyn Predictor>,
    limit: Option<Duration>,
    strikes: u32,
    resting: u32,
    good_steps: u32,
    /// What has changed in the map since the predictor was last told.
    missed: CellRect,
    step: PredictReport,
}

impl Supervised {
    /// Supervises a predictor within the time that it says a step may take.
    pub fn new(predictor: Box<dyn Predictor>) -> Self {
        Self {
            limit: predictor.time_limit(),
            predictor,
            strikes: 0,
            resting: 0,
            good_steps: 0,
            missed: CellRect::EMPTY,
            step: PredictReport::default(),
        }
    }

    /// Begins a step.
    pub fn observe(&mut self, scene: &Scene<'_>, clock: &dyn Fn() -> Duration) {
        if self.begin(scene) {
            let changed = std::mem::replace(&mut self.missed, CellRect::EMPTY);
            let before = clock();
            self.predictor.observe(&Scene { changed, ..*scene });
            self.look(clock().saturating_sub(before));
        }
    }

    /// Begins a step in which the predictor is not asked.
    pub fn pass_over(&mut self, scene: &Scene<'_>) {
        self.begin(scene);
        self.step.passed_over = true;
    }

    /// Keeps the books of faults and rests; says whether the predictor may be asked.
    fn begin(&mut self, scene: &Scene<'_>) -> bool {
        if !self.is_silent() {
            self.good_steps += 1;
            if self.good_steps >= FORGIVEN_AFTER_STEPS {
                self.good_steps = 0;
                self.strikes = self.strikes.saturating_sub(1);
            }
        }
        self.step = PredictReport::default();
        self.missed = self.missed.union(&scene.changed);
        self.step.resting = self.strikes >= STRIKES_MAX || self.resting > 0;
        self.resting = self.resting.saturating_sub(1);
        !self.step.resting
    }

    /// The view of the unknown in this step.
    pub fn view<'a>(&'a mut self, clock: &'a dyn Fn() -> Duration) -> SupervisedView<'a> {
        SupervisedView { supervised: self, clock }
    }

    /// Time spent in this step so far.
    pub const fn spent(&self) -> Duration {
        self.step.spent
    }

    /// What this step's prediction has come to so far.
    pub fn report(&self) -> PredictReport {
        let idle = self.step.resting || self.step.passed_over;
        let effort = if idle { Effort::default() } else { self.predictor.effort() };
        PredictReport { effort, ..self.step.clone() }
    }

    /// Notes time spent and looks for a fault.
    fn look(&mut self, spent: Duration) {
        self.step.spent += spent;
        let took = self.step.spent;
        let slow = self.limit.filter(|limit| took > *limit);
        let slow = slow.map(|limit| PredictFault::TooSlow { took, limit });
        if let Some(fault) = self.predictor.fault().cloned().or(slow) {
            self.strike(fault);
        }
    }

    fn strike(&mut self, fault: PredictFault) {
        let hopeless = match &fault {
            PredictFault::TooSlow { took, limit } => *took > *limit * HOPELESS,
            _ => false,
        };
        self.strikes = if hopeless { STRIKES_MAX } else { self.strikes + 1 };
        self.resting = REST_STEPS;
        self.good_steps = 0;
        self.step.fault = Some(fault);
    }

    const fn is_silent(&self) -> bool {
        self.step.resting || self.step.passed_over || self.step.fault.is_some()
    }
}

/// The view of the unknown in one step, supervised.
pub struct SupervisedView<'a> {
    supervised: &'a mut Supervised,
    clock: &'a dyn Fn() -> Duration,
}

impl OccupancyView for SupervisedView<'_> {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        let supervised = &mut *self.supervised;
        if supervised.is_silent() {
            out.fill(SILENT);
            return;
        }
        let before = (self.clock)();
        supervised.predictor.occupied(points, out);
        supervised.look((self.clock)().saturating_sub(before));
        for answer in out {
            if !(0.0..=1.0).contains(answer) {
                if !supervised.is_silent() {
                    supervised.strike(PredictFault::NotAProbability { value: *answer });
                }
                *answer = SILENT;
            }
        }
    }

    fn silent(&self, low: Point, high: Point) -> bool {
        self.supervised.is_silent() || self.supervised.predictor.silent(low, high)
    }

    fn is_ever_certain(&self) -> bool {
        !self.supervised.is_silent() && self.supervised.predictor.is_ever_certain()
    }

    fn familiarity(&mut self) -> f64 {
        let supervised = &mut *self.supervised;
        if supervised.is_silent() {
            return 0.0;
        }
        let before = (self.clock)();
        let familiarity = supervised.predictor.familiarity();
        supervised.look((self.clock)().saturating_sub(before));
        if (0.0..=1.0).contains(&familiarity) { familiarity } else { 0.0 }
    }
}

#[cfg(test)]
#[path = "supervise_tests.rs"]
mod tests;
