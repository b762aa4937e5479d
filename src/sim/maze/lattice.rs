//! Random routes and passages on the lattice of hallway cells.
//!
//! A cell is its number `j * SIDE + i`.

use std::collections::VecDeque;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Cells along a side of the lattice.
pub(super) const SIDE: usize = 10;
/// Cells of the lattice.
pub(super) const CELLS: usize = SIDE * SIDE;

const START: usize = 0;
const GOAL: usize = CELLS - 1;

/// Which neighbours are joined, and the way from start to goal.
#[derive(Clone, Debug)]
pub(super) struct Lattice {
    /// Whether a cell belongs to the maze.
    pub used: [bool; CELLS],
    /// Whether a cell is joined to the one on its right.
    open_right: [bool; CELLS],
    /// Whether a cell is joined to the one above it.
    open_up: [bool; CELLS],
    /// Cells from start to goal.
    pub route: Vec<usize>,
}

impl Lattice {
    fn closed() -> Self {
        Self {
            used: [false; CELLS],
            open_right: [false; CELLS],
            open_up: [false; CELLS],
            route: Vec::new(),
        }
    }

    /// A single hallway.
    fn along(route: Vec<usize>) -> Self {
        let mut lattice = Self::closed();
        for cell in &route {
            lattice.used[*cell] = true;
        }
        for pair in route.windows(2) {
            lattice.join(pair[0], pair[1]);
        }
        lattice.route = route;
        lattice
    }

    fn join(&mut self, a: usize, b: usize) {
        let low = a.min(b);
        if a.abs_diff(b) == 1 {
            self.open_right[low] = true;
        } else {
            self.open_up[low] = true;
        }
    }

    fn is_open(&self, a: usize, b: usize) -> bool {
        let low = a.min(b);
        if a.abs_diff(b) == 1 { self.open_right[low] } else { self.open_up[low] }
    }

    /// Whether a wall stands between two neighbours: they are not joined and at least one belongs
    /// to the maze.
    pub fn has_wall(&self, a: usize, b: usize) -> bool {
        !self.is_open(a, b) && (self.used[a] || self.used[b])
    }

    /// A hallway between opposite corners by loop-erased random walk, not too short and with many
    /// corners.
    pub fn direct(rng: &mut ChaCha8Rng) -> Self {
        const LENGTH_MIN: usize = 30;
        loop {
            let mut route = vec![START];
            let mut is_goal = [false; CELLS];
            is_goal[GOAL] = true;
            loop_erased_walk(rng, &mut route, &is_goal);
            let interior = route.len() - 2;
            // Corners in at least 45 per cent of the cells between the ends.
            if route.len() >= LENGTH_MIN && 100 * corners(&route) >= 45 * interior {
                return Self::along(route);
            }
        }
    }

    /// A hallway between opposite corners that fills most of the lattice.
    ///
    /// A loop-erased random walk is kept changing at random places: a step is pushed out to the
    /// side, a push is undone, a corner is flipped over. These are the moves of the BFACF algorithm
    /// (Berg and Foerster 1981; Aragao de Carvalho, Caracciolo and Froehlich 1983), which reaches
    /// every self-avoiding walk between the two ends; undoing a push only one time in
    /// [`UNDO_ONE_IN`] keeps the walk long.
    pub fn winding(rng: &mut ChaCha8Rng) -> Self {
        const CHANGES: u32 = 6_000;
        const UNDO_ONE_IN: u32 = 3;
        const LENGTH_MIN: usize = 70;
        let mut route = vec![START];
        let mut is_goal = [false; CELLS];
        is_goal[GOAL] = true;
        loop_erased_walk(rng, &mut route, &is_goal);
        let mut used = [false; CELLS];
        for cell in &route {
            used[*cell] = true;
        }
        let mut change = 0;
        while change < CHANGES || route.len() < LENGTH_MIN {
            change += 1;
            let k = below(rng, route.len() as u32 - 1) as usize;
            let left = below(rng, 2) == 0;
            let undo = below(rng, UNDO_ONE_IN) == 0;
            let (a, b) = (route[k], route[k + 1]);
            let Some((c, d)) = beside(a, b, left) else { continue };
            let before = k > 0 && route[k - 1] == c;
            let after = route.get(k + 2) == Some(&d);
            match (before, after) {
                (true, true) if undo => {
                    route.drain(k..k + 2);
                    used[a] = false;
                    used[b] = false;
                }
                (true, false) if !used[d] => {
                    route[k] = d;
                    used[a] = false;
                    used[d] = true;
                }
                (false, true) if !used[c] => {
                    route[k + 1] = c;
                    used[b] = false;
                    used[c] = true;
                }
                (false, false) if !used[c] && !used[d] => {
                    route.splice(k + 1..k + 1, [c, d]);
                    used[c] = true;
                    used[d] = true;
                }
                _ => {}
            }
        }
        Self::along(route)
    }

    /// Hallways everywhere: a uniform spanning tree (Wilson, "Generating random spanning trees more
    /// quickly than the cover time", STOC 1996) with some walls taken out, which makes loops.
    /// Drawn anew until the shortest way is not too direct.
    pub fn branching(rng: &mut ChaCha8Rng) -> Self {
        const LENGTH_MIN: usize = 25;
        loop {
            let lattice = Self::tree_with_loops(rng);
            if lattice.route.len() >= LENGTH_MIN {
                return lattice;
            }
        }
    }

    fn tree_with_loops(rng: &mut ChaCha8Rng) -> Self {
        const LOOPS: usize = 6;
        let mut lattice = Self::closed();
        lattice.used[GOAL] = true;
        for cell in 0..CELLS {
            let mut branch = vec![cell];
            loop_erased_walk(rng, &mut branch, &lattice.used);
            for pair in branch.windows(2) {
                lattice.join(pair[0], pair[1]);
            }
            for cell in branch {
                lattice.used[cell] = true;
            }
        }
        let mut taken = 0;
        while taken < LOOPS {
            let a = below(rng, CELLS as u32) as usize;
            let Some(b) = neighbour(a, below(rng, 4)) else { continue };
            if !lattice.is_open(a, b) {
                lattice.join(a, b);
                taken += 1;
            }
        }
        lattice.route = lattice.shortest_route();
        lattice
    }

    /// A way from start to goal with the fewest cells (breadth first from the goal).
    fn shortest_route(&self) -> Vec<usize> {
        let mut next = [None; CELLS];
        next[GOAL] = Some(GOAL);
        let mut queue = VecDeque::from([GOAL]);
        while let Some(cell) = queue.pop_front() {
            for other in (0..4).filter_map(|side| neighbour(cell, side)) {
                if next[other].is_none() && self.is_open(cell, other) {
                    next[other] = Some(cell);
                    queue.push_back(other);
                }
            }
        }
        let mut route = vec![START];
        let mut cell = START;
        while cell != GOAL {
            cell = next[cell].expect("a spanning tree joins every cell to the goal");
            route.push(cell);
        }
        route
    }
}

/// Extends `route` by a random walk from its last cell until the walk meets a cell of `ends`,
/// cutting out every loop as it closes. Leaves a route that begins in `ends` as it is.
fn loop_erased_walk(rng: &mut ChaCha8Rng, route: &mut Vec<usize>, ends: &[bool; CELLS]) {
    loop {
        let cell = route[route.len() - 1];
        if ends[cell] {
            return;
        }
        let Some(next) = neighbour(cell, below(rng, 4)) else { continue };
        match route.iter().position(|visited| *visited == next) {
            Some(k) => route.truncate(k + 1),
            None => route.push(next),
        }
    }
}

/// The neighbour on a side (0 right, 1 up, 2 left, 3 down), or `None` at the border.
fn neighbour(cell: usize, side: u32) -> Option<usize> {
    let (i, j) = (cell % SIDE, cell / SIDE);
    match side {
        0 => (i + 1 < SIDE).then(|| cell + 1),
        1 => (j + 1 < SIDE).then(|| cell + SIDE),
        2 => (i > 0).then(|| cell - 1),
        _ => (j > 0).then(|| cell - SIDE),
    }
}

/// The two cells beside the step from `a` to `b`, on one of its two sides.
fn beside(a: usize, b: usize, left: bool) -> Option<(usize, usize)> {
    let side = match (a.abs_diff(b) == 1, left) {
        (true, true) => 1,
        (true, false) => 3,
        (false, true) => 2,
        (false, false) => 0,
    };
    Some((neighbour(a, side)?, neighbour(b, side)?))
}

/// Number of cells in which a route turns.
fn corners(route: &[usize]) -> usize {
    route.windows(3).filter(|w| w[1].abs_diff(w[0]) != w[2].abs_diff(w[1])).count()
}

/// A random whole number below `n`. Drawn here, not by a library, so that a new version of one
/// cannot change every maze; uneven by less than one in ten million for the few outcomes in use.
fn below(rng: &mut ChaCha8Rng, n: u32) -> u32 {
    ((u64::from(rng.next_u32()) * u64::from(n)) >> 32) as u32
}
