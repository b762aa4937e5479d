//! The search for the cheapest way of the grid.
//!
//! Cell by cell in and beside the unknown, by jumps where all around is known (see `boards`).
//!
//! Why jumping loses no cheapest way: let a cell's cost be reached through one of its neighbours.
//! A straight last step is left out only where another way to the cell is strictly cheaper. A
//! diagonal last step is also left out where another way costs the same, but that one ends with a
//! straight step, which is not left out.

use super::astar::{
    AHEAD, COST_MAX, GuideSearch, Node, STEP_BITS, STEP_MASK, STEPS, SearchError, Target, UNREACHED,
};
use super::boards::Boards;
use super::buckets::{Buckets, SPAN};
use super::window::{Asker, BLOCKED, DIAGONAL, STRAIGHT, UNASKED};

/// The longest straight part of a jump, cells.
const STRAIGHT_MAX: u32 = 128;
/// The longest diagonal part of a jump, cells.
const DIAGONAL_MAX: u32 = 64;
// A jump adds at most twice its cost to the key: once as cost, once because the goal is farther.
const _: () = assert!(2 * (STRAIGHT_MAX * STRAIGHT + DIAGONAL_MAX * DIAGONAL) < SPAN as u32);

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
    /// Takes a way to a cell by a step from `parent`, if none as cheap is known.
    #[inline(always)]
    fn relax(&mut self, x: u32, y: u32, g: u32, step: usize, parent: usize) {
        let at = y as usize * self.stride + x as usize;
        let node = &mut self.nodes[at];
        if *node >> STEP_BITS > g {
            if *node == UNREACHED {
                self.written.push(at as u32);
            }
            *node = g << STEP_BITS | step as u32;
            self.parents[at] = parent as u32;
            self.queue.push(g + self.target.bound(x, y), y << 16 | x);
        }
    }
}

/// A free cell around which all is known, being expanded.
struct Jump<'a, 'b> {
    boards: &'a Boards,
    open: &'a mut Open<'b>,
    parent: usize,
}

impl Jump<'_, '_> {
    /// Straight on from a cell that costs `g`, to where a cheapest way may turn.
    #[inline(always)]
    fn straight(&mut self, x: u32, y: u32, g: u32, step: usize) {
        let along_x = step.is_multiple_of(2);
        let rising = step < 2;
        let run = if along_x {
            self.boards.run_x(x, y, rising)
        } else {
            self.boards.run_y(x, y, rising)
        };
        if run.free {
            let from = if along_x { x } else { y };
            let length = run.at.abs_diff(from).min(STRAIGHT_MAX);
            let to = if rising { from + length } else { from - length };
            let (x, y) = if along_x { (to, y) } else { (x, to) };
            self.open.relax(x, y, g + length * STRAIGHT, step, self.parent);
        }
    }

    /// Diagonally on, and straight to both sides from each cell on the way.
    #[inline(always)]
    fn diagonal(&mut self, mut x: u32, mut y: u32, mut g: u32, step: usize) {
        let (dx, dy) = STEPS[step];
        for length in 1..=DIAGONAL_MAX {
            let (nx, ny) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            let boards = self.boards;
            if !(boards.free(nx, y) && boards.free(x, ny) && boards.free(nx, ny)) {
                return;
            }
            (x, y) = (nx, ny);
            g += DIAGONAL;
            if length == DIAGONAL_MAX || boards.mixed(x, y) {
                self.open.relax(x, y, g, step, self.parent);
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
            if self.boards.free(bx, by) && !self.boards.free(px, py) {
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
    ) -> Result<((u32, u32), usize), SearchError> {
        let Self { window, boards, nodes, parents, written, queue, block, .. } = self;
        let from = window.index(start.0, start.1);
        queue.reset(target.bound(start.0, start.1));
        let mut open = Open { stride: window.stride, target, nodes, parents, written, queue };
        open.relax(start.0, start.1, 0, 0, from);
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
            if boards.free(x, y) && !boards.mixed(x, y) {
                let mut jump = Jump { boards, open: &mut open, parent: at };
                if at == from { jump.start(x, y) } else { jump.expand(x, y, g, step) }
                continue;
            }
            let own = window.weights[at];
            let mut around = window.around(at);
            let mut relax = |step: usize, cost: u32| {
                let (dx, dy) = STEPS[step];
                let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                open.relax(x, y, g + cost, step, at);
            };
            let straight = 2 * u32::from(own);
            if around.iter().fold(0, |odd, w| odd | (w ^ own)) == 0 && at != from {
                let diagonal = straight * DIAGONAL / STRAIGHT;
                for &step in &AHEAD[step] {
                    relax(step, if step < 4 { straight } else { diagonal });
                }
                continue;
            }
            if around.iter().fold(false, |any, w| any | (*w == UNASKED)) {
                asker.ask_around(window, block, x, y);
                around = window.around(at);
            }
            for (step, weight) in around.iter().enumerate() {
                let both = u32::from(own) + u32::from(*weight);
                if *weight == BLOCKED {
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
