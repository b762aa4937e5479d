//! The search for the cheapest way of the grid.
//!
//! Cell by cell in and beside the unknown, by jumps where all around weighs the same or is
//! blocked (see `boards`).
//!
//! Why jumping loses no cheapest way: let a cell's cost be reached through one of its neighbours.
//! A straight last step is left out only where another way to the cell is strictly cheaper. A
//! diagonal last step is also left out where another way costs the same, but that one ends with a
//! straight step, which is not left out.

use super::astar::{
    COST_MAX, GuideSearch, JUMPED, Node, STEP_BITS, STEP_MASK, STEPS, SearchError, Target,
    UNREACHED,
};
use super::boards::Boards;
use super::buckets::{Buckets, SPAN};
use super::window::{Asker, BLOCKED, DIAGONAL, KNOWN, STRAIGHT, UNASKED};

/// The longest diagonal part of a jump over known-free cells; the straight part is at most twice as
/// long.
const LONGEST: u32 = 64;
// A jump adds at most twice its cost to the key: once as cost, once because the goal is farther.
const _: () = assert!(2 * LONGEST * (2 * STRAIGHT + DIAGONAL) < SPAN as u32);
/// Shorter jumps are not worth it; cells in which they are the longest are taken one by one.
const SHORTEST: u32 = 4;

/// The longest diagonal part of a jump over cells of equal weight, or `None` if they are too costly
/// to jump.
pub(super) fn longest_jump(weight: u16) -> Option<u32> {
    let longest = LONGEST * u32::from(KNOWN) / u32::from(weight);
    Some(longest.min(LONGEST)).filter(|longest| *longest >= SHORTEST)
}

/// Bit `i` of entry `s`: after arriving by step `s`, step `i` leads to a cell that is reached at
/// less cost from the cell before, whatever anything weighs (where it may be entered from there
/// at all, it is a straight step away or the cell before itself).
const BEHIND: [u8; 8] = {
    let mut behind = [0; 8];
    let mut s = 0;
    while s < 4 {
        let back = (s + 2) % 4;
        behind[s] = 1 << back | 1 << (4 + back) | 1 << (4 + (back + 3) % 4);
        // Diagonal `4 + s` came from between the straight steps `s` and `s + 1`.
        behind[4 + s] = 1 << back | 1 << ((s + 3) % 4) | 1 << (4 + back);
        s += 1;
    }
    behind
};

/// What has been reached, and the queue of what to expand.
struct Open<'a> {
    stride: usize,
    target: Target,
    nodes: &'a mut [Node],
    parents: &'a mut [u32],
    written: &'a mut Vec<u32>,
    queue: &'a mut Buckets,
}

impl Open<'_> {
    /// Takes a way to a cell, the last step of which is `step`, if none as cheap is known. It comes
    /// from the cell before or, by a jump, from `parent`.
    #[inline(always)]
    fn relax(&mut self, x: u32, y: u32, g: u32, step: usize, parent: Option<usize>) {
        let at = y as usize * self.stride + x as usize;
        let node = &mut self.nodes[at];
        if *node >> STEP_BITS > g {
            if *node == UNREACHED {
                self.written.push(at as u32);
            }
            *node = g << STEP_BITS | step as u32;
            if let Some(parent) = parent {
                *node |= JUMPED;
                self.parents[at] = parent as u32;
            }
            self.queue.push(g + self.target.bound(x, y), y << 16 | x);
        }
    }

    /// Notes that a jump passes over a cell, and whether it is the cheapest so far to get there.
    #[inline(always)]
    fn pass(&mut self, x: u32, y: u32, g: u32, step: usize) -> bool {
        let at = y as usize * self.stride + x as usize;
        let node = &mut self.nodes[at];
        if *node >> STEP_BITS <= g {
            return false;
        }
        if *node == UNREACHED {
            self.written.push(at as u32);
        }
        *node = g << STEP_BITS | step as u32;
        true
    }
}

/// A plain cell that is not mixed, being expanded.
struct Jump<'a, 'b> {
    boards: &'a Boards,
    open: &'a mut Open<'b>,
    parent: usize,
    /// Cost of a straight step.
    straight: u32,
    /// Cost of a diagonal step.
    diagonal: u32,
    /// Most diagonal steps.
    longest: u32,
}

impl Jump<'_, '_> {
    /// Straight on from a cell that costs `g`, to where a cheapest way may turn.
    #[inline(always)]
    fn straight(&mut self, x: u32, y: u32, g: u32, step: usize) {
        let along_x = step.is_multiple_of(2);
        let rising = step < 2;
        let run =
            if along_x { self.boards.run_x(x, y, rising) } else { self.boards.run_y(x, y, rising) };
        if run.plain {
            let from = if along_x { x } else { y };
            let length = run.at.abs_diff(from).min(2 * self.longest);
            let to = if rising { from + length } else { from - length };
            let (x, y) = if along_x { (to, y) } else { (x, to) };
            self.open.relax(x, y, g + length * self.straight, step, Some(self.parent));
        }
    }

    /// Diagonally on, and straight to both sides from each cell on the way.
    #[inline(always)]
    fn diagonal(&mut self, mut x: u32, mut y: u32, mut g: u32, step: usize) {
        let (dx, dy) = STEPS[step];
        for length in 1..=self.longest {
            let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            let boards = self.boards;
            if !(boards.plain(nx, y) && boards.plain(x, ny) && boards.plain(nx, ny)) {
                return;
            }
            (x, y) = (nx, ny);
            g += self.diagonal;
            if length == self.longest || boards.mixed(x, y) {
                self.open.relax(x, y, g, step, Some(self.parent));
                return;
            }
            if !self.open.pass(x, y, g, step) {
                return;
            }
            self.straight(x, y, g, step - 4);
            self.straight(x, y, g, (step - 3) % 4);
        }
    }

    /// Everything that can be part of a cheapest way after arriving by `step`.
    fn expand(&mut self, x: u32, y: u32, g: u32, step: usize) {
        if step >= 4 {
            self.straight(x, y, g, step - 4);
            self.straight(x, y, g, (step - 3) % 4);
            self.diagonal(x, y, g, step);
            return;
        }
        self.straight(x, y, g, step);
        let (dx, dy) = STEPS[step];
        // A cell beside is reached at less cost from the cell before, unless an obstacle is there.
        for side in [(step + 1) % 4, (step + 3) % 4] {
            let (sx, sy) = STEPS[side];
            let (bx, by) = (x.wrapping_add_signed(sx), y.wrapping_add_signed(sy));
            let (px, py) = (bx.wrapping_add_signed(-dx), by.wrapping_add_signed(-dy));
            if self.boards.plain(bx, by) && !self.boards.plain(px, py) {
                self.straight(x, y, g, side);
                let between = if side == (step + 1) % 4 { 4 + step } else { 4 + side };
                self.diagonal(x, y, g, between);
            }
        }
    }

    /// To all sides.
    fn start(&mut self, x: u32, y: u32) {
        for step in 0..4 {
            self.straight(x, y, 0, step);
            self.diagonal(x, y, 0, step + 4);
        }
    }
}

impl GuideSearch {
    pub(super) fn run_edge(
        &mut self,
        start: (u32, u32),
        target: Target,
        asker: &mut Asker<'_>,
        silent_jump: u32,
    ) -> Result<((u32, u32), usize), SearchError> {
        let Self { window, boards, nodes, parents, written, queue, block, .. } = self;
        let from = window.index(start.0, start.1);
        queue.reset(target.bound(start.0, start.1));
        let mut open = Open { stride: window.stride, target, nodes, parents, written, queue };
        open.relax(start.0, start.1, 0, 0, None);
        let (mut expanded, mut too_long) = (0, false);
        while let Some((key, item)) = open.queue.pop() {
            let (x, y) = (item & 0xffff, item >> 16);
            let at = window.index(x, y);
            let node = open.nodes[at];
            let g = node >> STEP_BITS;
            let bound = target.bound(x, y);
            if g + bound != key {
                // A cheaper way here was found, and followed, since this was pushed.
                continue;
            }
            if bound == 0 && target.reached(x, y) {
                return Ok(((x, y), expanded));
            }
            if g > COST_MAX {
                too_long = true;
                continue;
            }
            expanded += 1;
            let step = (node & STEP_MASK) as usize;
            let own = window.weights[at];
            let straight = 2 * u32::from(own);
            let diagonal = straight * DIAGONAL / STRAIGHT;
            if boards.plain(x, y) && !boards.mixed(x, y) {
                let longest = if own == KNOWN { LONGEST } else { silent_jump };
                let open = &mut open;
                let mut jump = Jump { boards, open, parent: at, straight, diagonal, longest };
                if at == from {
                    jump.start(x, y)
                } else {
                    jump.expand(x, y, g, step)
                }
                continue;
            }
            let mut around = window.around(at);
            let mut relax = |step: usize, cost: u32| {
                let (dx, dy) = STEPS[step];
                let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                open.relax(x, y, g + cost, step, None);
            };
            if around.iter().fold(0, |odd, w| odd | (w ^ own)) == 0 && at != from {
                if step < 4 {
                    relax(step, straight);
                } else {
                    relax(step - 4, straight);
                    relax((step - 3) % 4, straight);
                    relax(step, diagonal);
                }
                continue;
            }
            if around.iter().fold(false, |any, w| any | (*w == UNASKED)) {
                asker.ask_around(window, block, x, y);
                around = window.around(at);
            }
            let behind = if at == from { 0 } else { BEHIND[step] };
            for (step, weight) in around.iter().enumerate() {
                let both = u32::from(own) + u32::from(*weight);
                if *weight == BLOCKED || behind >> step & 1 != 0 {
                } else if step < 4 {
                    relax(step, both);
                } else if around[step - 4] != BLOCKED && around[(step - 3) % 4] != BLOCKED {
                    relax(step, both * DIAGONAL / STRAIGHT);
                }
            }
        }
        Err(if too_long { SearchError::TooLong } else { SearchError::Unreachable { expanded } })
    }
}

#[cfg(test)]
#[path = "jump_tests.rs"]
mod tests;
