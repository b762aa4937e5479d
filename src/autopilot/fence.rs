//! A fence for a running core: plans keep to it, and the one under way is looked at again.

use std::sync::Arc;

use super::{Autopilot, Happening};
use crate::fence::Fence;
use crate::map::Grid;
use crate::time::Instant;

impl Autopilot {
    /// Where the car may drive from now on. A plan that leads out of there is shortened, or, if the
    /// car cannot stop before, is given up like one with an obstacle on it.
    pub fn set_fence(&mut self, now: Instant, fence: Arc<Fence>) {
        self.testimony.note_at(now, Happening::Fence(&fence));
        if self.fence == fence {
            return;
        }
        self.fence = fence;
        // What comes back was planned for another fence.
        self.void_job();
        self.certify_again(now);
    }

    /// Where the car may drive.
    pub fn fence(&self) -> &Fence {
        &self.fence
    }

    /// The map with the fence in it, if there is one that matters: a car that stands is not moved
    /// by one that is put around it, nor is that an obstacle on its plan.
    pub(super) fn fenced_grid(&mut self, now: Instant) -> Option<Grid> {
        if self.committed.is_finished(now) {
            return None;
        }
        self.painter.paint(self.mapper.grid(), &self.fence, None).0
    }
}

#[cfg(test)]
mod tests;
