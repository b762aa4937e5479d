//! A clock that shows again what it showed before.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::plan::Stopwatch;
use crate::time::Duration;

/// What is still to be shown, and what is shown now.
#[derive(Clone, Debug, Default)]
pub(super) struct Script(Arc<Mutex<(VecDeque<Duration>, Duration)>>);

impl Script {
    /// From now on each look finds so much time passed; later ones none.
    pub(super) fn show(&self, steps: &[Duration]) {
        let mut script = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        *script = (steps.iter().copied().collect(), Duration::ZERO);
    }

    /// The clock.
    pub(super) fn stopwatch(&self) -> Stopwatch {
        let script = Arc::clone(&self.0);
        Box::new(move || {
            let mut script = script.lock().unwrap_or_else(PoisonError::into_inner);
            let passed = script.0.pop_front().unwrap_or_default();
            script.1 = script.1.saturating_add(passed);
            script.1
        })
    }
}
