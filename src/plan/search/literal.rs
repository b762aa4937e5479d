//! The search with the factor on the heuristic, as the paper's text says.

use std::cmp::Reverse;

use super::astar::{COST_MAX, GuideSearch, STEP_BITS, STEPS, SearchError, Target, UNREACHED};
use super::window::{Asker, BLOCKED, DIAGONAL, KNOWN, STRAIGHT};

impl GuideSearch {
    /// `f = g + w |n - goal|`, `g` the length of the way, each cell expanded once.
    pub(super) fn run_literal(
        &mut self,
        start: (u32, u32),
        target: Target,
        asker: &mut Asker<'_>,
    ) -> Result<((u32, u32), usize), SearchError> {
        let from = self.window.index(start.0, start.1);
        self.nodes[from] = 0;
        self.written.push(from as u32);
        self.closed.clear();
        self.closed.resize(self.window.weights.len(), false);
        self.heap.clear();
        self.heap.push((Reverse(0), 0, start.1 << 16 | start.0));
        let stride = self.window.stride as isize;
        let offsets = STEPS.map(|(dx, dy)| dy as isize * stride + dx as isize);
        let (mut expanded, mut pushed, mut too_long) = (0, 0_u32, false);
        while let Some((_, _, item)) = self.heap.pop() {
            let (x, y) = (item & 0xffff, item >> 16);
            let at = self.window.index(x, y);
            if self.closed[at] {
                continue;
            }
            self.closed[at] = true;
            let own_g = self.nodes[at] >> STEP_BITS;
            if target.reached(x, y) {
                return Ok(((x, y), expanded));
            }
            if own_g > COST_MAX {
                too_long = true;
                continue;
            }
            expanded += 1;
            asker.ask_around(&mut self.window, &mut self.block, x, y);
            let around = self.window.around(at);
            for step in 0..8 {
                let open = around[step] != BLOCKED
                    && (step < 4
                        || (around[step - 4] != BLOCKED && around[(step - 3) % 4] != BLOCKED));
                if !open {
                    continue;
                }
                let there = (at as isize + offsets[step]) as usize;
                let g = own_g + if step < 4 { STRAIGHT } else { DIAGONAL };
                if self.closed[there] || self.nodes[there] >> STEP_BITS <= g {
                    continue;
                }
                if self.nodes[there] == UNREACHED {
                    self.written.push(there as u32);
                }
                self.nodes[there] = g << STEP_BITS | step as u32;
                let (dx, dy) = STEPS[step];
                let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                let (cx, cy) = target.centre;
                let distance = (f64::from(x) + 0.5 - cx).hypot(f64::from(y) + 0.5 - cy);
                let factor = f64::from(around[step]) / f64::from(KNOWN);
                let h = factor * distance * f64::from(STRAIGHT);
                pushed = pushed.saturating_add(1);
                self.heap.push((Reverse(u64::from(g) + h.round() as u64), pushed, y << 16 | x));
            }
        }
        Err(if too_long { SearchError::TooLong } else { SearchError::Unreachable { expanded } })
    }
}
