//! What the parts of a planning step take.

use super::{Planner, Stopwatch};
use crate::time::Duration;

/// Measures consecutive parts.
pub(super) struct Lap(Duration);

impl Lap {
    pub(super) fn new(clock: &Stopwatch) -> Self {
        Self(clock())
    }

    pub(super) fn take(&mut self, clock: &Stopwatch) -> Duration {
        let now = clock();
        now.saturating_sub(std::mem::replace(&mut self.0, now))
    }
}

/// Measures a part without the prediction in it.
pub(super) struct OwnLap {
    lap: Lap,
    predicted: Duration,
}

impl Planner {
    /// Begins to measure a part in which the predictor is asked.
    pub(super) fn own_lap(&self) -> OwnLap {
        OwnLap { lap: Lap::new(&self.clock), predicted: self.predictor.spent() }
    }

    /// What the part took, less what the predictor took of it.
    pub(super) fn own_time(&self, mut part: OwnLap) -> Duration {
        let predicted = self.predictor.spent().saturating_sub(part.predicted);
        part.lap.take(&self.clock).saturating_sub(predicted)
    }
}
