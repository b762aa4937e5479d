//! A* on the 8-connected grid.
//!
//! Costs are whole numbers, so that results do not depend on the order of additions and the queue
//! is an array of lists. A straight known-free step costs [`STRAIGHT`], a diagonal one
//! [`DIAGONAL`]; their ratio is sqrt(2) within 5e-5.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::boards::Boards;
use super::buckets::{Buckets, SPAN};
use super::jump::longest_jump;
use super::pull::Puller;
use super::window::{
    Asker, BLOCKED, Block, CELLS_MAX, DIAGONAL, Pricing, SILENT, STRAIGHT, Window,
};
use super::{Guide, Penalty, SearchParams, SearchQuery, Terrain, cell_at};
use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect};
use crate::predict::OccupancyView;

/// The longest way in units of cost; what exceeds it is not followed. With one more jump it
/// still fits into a [`Node`].
pub(super) const COST_MAX: u32 = (u32::MAX >> STEP_BITS) - SPAN as u32;

/// Steps to the eight neighbours: four straight ones, then four diagonal ones, each diagonal `i`
/// between the straight ones `i - 4` and `(i - 3) % 4`.
pub(super) const STEPS: [(i32, i32); 8] =
    [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)];
/// Why there is no way.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SearchError {
    /// A coordinate or a length is not a usable number.
    #[error("{what} is {value}, but must be {wanted}")]
    BadQuery {
        /// What is wrong.
        what: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        wanted: &'static str,
    },
    /// Map, start and goal together span more cells than are searched.
    #[error("map, start and goal span {cells} cells, allowed are {CELLS_MAX}")]
    TooLarge {
        /// Cells in the window.
        cells: usize,
    },
    /// The disc fits neither where the car is nor within two cells of there.
    #[error("the car at ({x_m:.2}, {y_m:.2}) m is in an obstacle")]
    StartBlocked {
        /// Where, metres.
        x_m: f64,
        /// Where, metres.
        y_m: f64,
    },
    /// Nowhere within the goal radius may the disc's centre be.
    #[error("the goal ({x_m:.2}, {y_m:.2}) m is in an obstacle")]
    GoalBlocked {
        /// Where, metres.
        x_m: f64,
        /// Where, metres.
        y_m: f64,
    },
    /// Every cell that can be reached has been looked at. Where the way may lead through the
    /// unknown this is a proof (up to the size of a cell): obstacles in the *known* map enclose
    /// the start or the goal, whatever the unknown holds.
    #[error("no way leads to the goal ({expanded} cells searched)")]
    Unreachable {
        /// How many cells were expanded.
        expanded: usize,
    },
    /// The search ran out of numbers: only ways longer than 1.9 million known-free cells, or 4000
    /// cells that are foreseen to be surely occupied, are left. Proves nothing.
    #[error("every way to the goal is too long to search")]
    TooLong,
}

/// One cell of the search in a word: the cost from the start, then the step by which it was
/// reached in [`STEP_BITS`] bits. Small words keep the search in the cache.
pub(super) type Node = u32;
/// A cell that was not reached.
pub(super) const UNREACHED: Node = Node::MAX;
pub(super) const STEP_BITS: u32 = 4;
pub(super) const STEP_MASK: u32 = 7;
/// Set where a cell was reached by a jump, not from the cell before.
pub(super) const JUMPED: u32 = 8;

/// What counts as having arrived, in cells of the window.
#[derive(Clone, Copy)]
pub(super) struct Target {
    pub(super) x: i64,
    pub(super) y: i64,
    /// Goal and radius in cells, for the exact test of a cell centre.
    pub(super) centre: (f64, f64),
    radius2: f64,
    /// No accepted cell is closer to the goal's cell than this, as a cost.
    slack: u32,
}

impl Target {
    /// Octile distance, less the radius: never more than what a way over known-free cells costs.
    #[inline]
    pub(super) fn bound(&self, x: u32, y: u32) -> u32 {
        let dx = (i64::from(x) - self.x).unsigned_abs() as u32;
        let dy = (i64::from(y) - self.y).unsigned_abs() as u32;
        let (long, short) = (dx.max(dy), dx.min(dy));
        (STRAIGHT * long + (DIAGONAL - STRAIGHT) * short).saturating_sub(self.slack)
    }

    #[inline]
    pub(super) fn reached(&self, x: u32, y: u32) -> bool {
        let (dx, dy) = (f64::from(x) + 0.5 - self.centre.0, f64::from(y) + 0.5 - self.centre.1);
        (i64::from(x) == self.x && i64::from(y) == self.y) || dx * dx + dy * dy <= self.radius2
    }
}

/// The grid search. Holds its working memory, so that searching again allocates nothing but the
/// answer.
pub struct GuideSearch {
    pub(super) window: Window,
    pub(super) boards: Boards,
    /// One for each cell of the window, and more: memory is not given back.
    pub(super) nodes: Vec<Node>,
    /// Where a cell was reached by a jump: from which one.
    pub(super) parents: Vec<u32>,
    /// Where nodes have been written.
    pub(super) written: Vec<u32>,
    /// Whether a cell has been expanded (with [`Penalty::Literal`] alone).
    pub(super) closed: Vec<bool>,
    pub(super) queue: Buckets,
    pub(super) heap: BinaryHeap<(Reverse<u64>, u32, u32)>,
    pub(super) block: Block,
    pub(super) puller: Puller,
}

impl Default for GuideSearch {
    fn default() -> Self {
        Self::new()
    }
}

impl GuideSearch {
    /// A search that has seen nothing yet.
    pub fn new() -> Self {
        Self {
            window: Window::default(),
            boards: Boards::default(),
            nodes: Vec::new(),
            parents: Vec::new(),
            written: Vec::new(),
            closed: Vec::new(),
            queue: Buckets::default(),
            heap: BinaryHeap::new(),
            block: Block::default(),
            puller: Puller::default(),
        }
    }

    /// The cheapest way from the start to the goal.
    ///
    /// A diagonal step is taken only where both cells beside it may be entered. The view is asked
    /// for an unknown cell when the search first comes next to it, together with the cells around;
    /// an answer outside `[0, 1]` counts as 0.5. Among ways of equal cost the choice is fixed by
    /// the order of the steps. [`Penalty::Edge`] gives the cheapest way of the grid;
    /// [`Penalty::Literal`] expands each cell once and promises nothing.
    ///
    /// # Panics
    /// If the terrain's slices do not have as many elements as its bounds have cells.
    pub fn find(
        &mut self,
        terrain: &Terrain<'_>,
        query: &SearchQuery,
        view: &mut dyn OccupancyView,
        params: &SearchParams,
    ) -> Result<Guide, SearchError> {
        let size = terrain.bounds.width() * terrain.bounds.height();
        assert!(
            terrain.cells.len() == size && terrain.lethal.len() == size,
            "a terrain's slices match its bounds"
        );
        check(terrain, query)?;
        let rect = window_rect(terrain, query, params.border_m)?;
        let pricing = Pricing {
            penalty: params.penalty,
            alpha: params.alpha,
            eps: params.eps,
            v_ref_mps: query.v_ref_mps,
        };
        let silent_weight = pricing.weight(SILENT);
        let silent_jump = longest_jump(silent_weight);
        let silent = (params.penalty == Penalty::Edge && silent_jump.is_some())
            .then_some((silent_weight, &*view));
        self.window.fill(&mut self.boards, terrain, rect, query.through_unknown, silent);
        for at in self.written.drain(..) {
            self.nodes[at as usize] = UNREACHED;
        }
        let cells = self.window.weights.len();
        if self.nodes.len() < cells {
            self.nodes.resize(cells, UNREACHED);
            self.parents.resize(cells, 0);
        }

        let start = self.start_cell(terrain, query)?;
        let target = self.target(terrain, query)?;
        let mut asker = Asker { view, pricing, asked: 0 };
        self.boards.finish();
        asker.ask_around(&mut self.window, &mut self.block, start.0, start.1);
        let (end, expanded) = match params.penalty {
            Penalty::Edge => self.run_edge(start, target, &mut asker, silent_jump.unwrap_or(1))?,
            Penalty::Literal => self.run_literal(start, target, &mut asker)?,
        };
        let asked = asker.asked;
        Ok(self.guide(terrain, query, target, end, expanded, asked))
    }

    /// The start's cell, or the nearest one within two cells that may be entered.
    fn start_cell(
        &self,
        terrain: &Terrain<'_>,
        query: &SearchQuery,
    ) -> Result<(u32, u32), SearchError> {
        const REACH: i32 = 2;
        let cell = cell_at(query.start, terrain.resolution_m);
        let mut best: Option<(f64, (u32, u32))> = None;
        for dy in -REACH..=REACH {
            for dx in -REACH..=REACH {
                let (x, y) = self.window.locate(CellIndex::new(cell.ix + dx, cell.iy + dy));
                // The border is wider than the reach only if it is not tiny.
                if x as usize >= self.window.stride || y as usize >= self.window.rows {
                    continue;
                }
                if self.window.weights[self.window.index(x, y)] == BLOCKED {
                    continue;
                }
                if dx == 0 && dy == 0 {
                    return Ok((x, y));
                }
                let distance = (self.window.centre(x, y) - query.start).norm();
                if distance <= (f64::from(REACH) + 0.5) * terrain.resolution_m
                    && best.is_none_or(|(least, _)| distance < least)
                {
                    best = Some((distance, (x, y)));
                }
            }
        }
        let blocked = SearchError::StartBlocked { x_m: query.start.x, y_m: query.start.y };
        best.map(|(_, cell)| cell).ok_or(blocked)
    }

    fn target(
        &mut self,
        terrain: &Terrain<'_>,
        query: &SearchQuery,
    ) -> Result<Target, SearchError> {
        let resolution = terrain.resolution_m;
        let (x, y) = self.window.locate(cell_at(query.goal, resolution));
        let radius = query.goal_radius_m / resolution;
        let reach = radius.ceil() as u32 + 1;
        // No accepted cell is farther from the goal's cell than the radius and half a diagonal;
        // an octile distance exceeds a straight one by less than 8.3 percent.
        let slack = (radius + 0.71) * 1.083 * f64::from(STRAIGHT);
        let target = Target {
            x: i64::from(x),
            y: i64::from(y),
            centre: (
                query.goal.x / resolution - f64::from(self.window.origin.ix),
                query.goal.y / resolution - f64::from(self.window.origin.iy),
            ),
            radius2: radius * radius,
            slack: if radius > 0.0 { slack.ceil() as u32 } else { 0 },
        };
        let mut open = false;
        let columns = x.saturating_sub(reach)..(x + reach + 1).min(self.window.stride as u32);
        for y in y.saturating_sub(reach)..(y + reach + 1).min(self.window.rows as u32) {
            for x in columns.clone() {
                if self.window.weights[self.window.index(x, y)] != BLOCKED && target.reached(x, y) {
                    self.boards.mark(x, y);
                    open = true;
                }
            }
        }
        let blocked = SearchError::GoalBlocked { x_m: query.goal.x, y_m: query.goal.y };
        open.then_some(target).ok_or(blocked)
    }

    fn guide(
        &mut self,
        terrain: &Terrain<'_>,
        query: &SearchQuery,
        target: Target,
        end: (u32, u32),
        expanded: usize,
        asked: usize,
    ) -> Guide {
        let cost = self.nodes[self.window.index(end.0, end.1)] >> STEP_BITS;
        let cells = &mut self.puller.cells;
        cells.clear();
        let (mut x, mut y) = end;
        cells.push(end);
        loop {
            let at = self.window.index(x, y);
            if self.nodes[at] == 0 {
                // Only the start costs nothing.
                break;
            }
            if self.nodes[at] & JUMPED == 0 {
                let (dx, dy) = STEPS[(self.nodes[at] & STEP_MASK) as usize];
                (x, y) = (x.wrapping_add_signed(-dx), y.wrapping_add_signed(-dy));
                cells.push((x, y));
                continue;
            }
            let stride = self.window.stride as u32;
            let (px, py) = (self.parents[at] % stride, self.parents[at] / stride);
            // A jump runs diagonally first and straight then.
            while (x, y) != (px, py) {
                let (nx, ny) = (px.abs_diff(x), py.abs_diff(y));
                if nx >= ny {
                    x = if px > x { x + 1 } else { x - 1 };
                }
                if ny >= nx {
                    y = if py > y { y + 1 } else { y - 1 };
                }
                cells.push((x, y));
            }
        }
        cells.reverse();
        let own_cell = i64::from(end.0) == target.x && i64::from(end.1) == target.y;
        let last = own_cell.then_some(query.goal);
        let points = self.puller.pull(&self.window, query.start, last);
        let unknown = |p: &Point| {
            let c = cell_at(*p, terrain.resolution_m);
            let width = terrain.bounds.width();
            let at =
                (c.iy - terrain.bounds.y0) as usize * width + (c.ix - terrain.bounds.x0) as usize;
            !terrain.bounds.contains(c) || terrain.cells[at] == Cell::Unknown
        };
        Guide {
            known_until: points.iter().position(unknown).unwrap_or(points.len()),
            length_m: points.windows(2).map(|w| (w[1] - w[0]).norm()).sum(),
            cost_s: f64::from(cost) / f64::from(STRAIGHT) * terrain.resolution_m / query.v_ref_mps,
            points,
            expanded,
            asked,
        }
    }
}

/// Coordinates up to a thousand kilometres keep cell numbers well inside an `i32`.
const COORDINATE_MAX_M: f64 = 1.0e6;

fn check(terrain: &Terrain<'_>, query: &SearchQuery) -> Result<(), SearchError> {
    let bad = |what, value, wanted| Err(SearchError::BadQuery { what, value, wanted });
    let coordinates = [
        ("start x", query.start.x),
        ("start y", query.start.y),
        ("goal x", query.goal.x),
        ("goal y", query.goal.y),
    ];
    for (what, value) in coordinates {
        // Not `abs() > MAX`: that would let NaN pass.
        if !(value.abs() <= COORDINATE_MAX_M && (value / terrain.resolution_m).abs() < 1e9) {
            return bad(what, value, "a finite number of metres, at most a million");
        }
    }
    if !(0.0..=1000.0).contains(&query.goal_radius_m) {
        return bad("goal radius", query.goal_radius_m, "0 to 1000 m");
    }
    if !(query.v_ref_mps > 0.0 && query.v_ref_mps.is_finite()) {
        return bad("reference speed", query.v_ref_mps, "a positive number of m/s");
    }
    Ok(())
}

fn window_rect(
    terrain: &Terrain<'_>,
    query: &SearchQuery,
    border_m: f64,
) -> Result<CellRect, SearchError> {
    let resolution = terrain.resolution_m;
    let single = |p: Point| {
        let c = cell_at(p, resolution);
        CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 }
    };
    // One ring of cells at least: through it a way leads round the whole window, so that finding
    // none inside proves that there is none outside either.
    let border = (border_m / resolution).ceil().clamp(1.0, 10_000.0) as i32;
    let reach = (query.goal_radius_m / resolution).ceil() as i32;
    let rect = terrain
        .bounds
        .union(&single(query.start))
        .union(&single(query.goal).grown(reach))
        .grown(border);
    let (width, height) =
        (i64::from(rect.x1) - i64::from(rect.x0), i64::from(rect.y1) - i64::from(rect.y0));
    let cells = (width + 2) * (height + 2);
    // Positions are packed into two halves of 32 bits.
    if cells > CELLS_MAX as i64 || width.max(height) + 2 > 0xffff {
        return Err(SearchError::TooLarge { cells: cells.max(0) as usize });
    }
    Ok(rect)
}

#[cfg(test)]
#[path = "astar_tests.rs"]
mod tests;
