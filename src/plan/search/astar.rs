//! A* on the 8-connected grid.
//!
//! Costs are whole numbers, so that results do not depend on the order of additions and the queue
//! is an array of lists. A straight known-free step costs [`STRAIGHT`], a diagonal one
//! [`DIAGONAL`]; their ratio is sqrt(2) within 5e-5.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::buckets::{Buckets, SPAN};
use super::pull::Puller;
use super::{Guide, Penalty, SearchParams, SearchQuery, Terrain, cell_at};
use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect};
use crate::predict::OccupancyView;

/// Cost of a straight step between two cells of weight [`KNOWN`].
pub(super) const STRAIGHT: u32 = 140;
/// Cost of a diagonal step between two cells of weight [`KNOWN`].
pub(super) const DIAGONAL: u32 = 198;
/// Weight of a known-free cell: what half a straight step through it costs.
pub(super) const KNOWN: u16 = (STRAIGHT / 2) as u16;
/// Weight of a cell that may not be entered.
pub(super) const BLOCKED: u16 = 0;
/// Weight of an unknown cell for which the view has not been asked yet.
pub(super) const UNASKED: u16 = u16::MAX;
/// An unknown cell costs at most this many times as much as a known one. Holds an edge's cost
/// below the span of the queue.
const FACTOR_MAX: f64 = 320.0;
/// Scale of the factor on the heuristic with [`Penalty::Literal`]: [`KNOWN`] is one.
const LITERAL_FACTOR_MAX: f64 = 900.0;
/// The view is asked for blocks of this many cells by as many, as a power of two.
const BLOCK_SHIFT: u32 = 3;
/// The largest window that is searched, cells (a square of 280 m at 0.1 m).
const CELLS_MAX: usize = 8_000_000;
/// The longest way in units of cost; what exceeds it is not followed. With one more step it still
/// fits into a [`Node`].
const COST_MAX: u32 = (u32::MAX >> STEP_BITS) - SPAN as u32;

/// Steps to the eight neighbours: four straight ones, then four diagonal ones, each diagonal `i`
/// between the straight ones `i - 4` and `(i - 3) % 4`.
const STEPS: [(i32, i32); 8] =
    [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)];
/// The steps that can be part of a cheapest way after arriving by a step where everything around
/// has the same weight: every other neighbour is reached at less cost from the cell before.
const AHEAD: [[usize; 3]; 8] =
    [[0, 4, 7], [1, 4, 5], [2, 5, 6], [3, 6, 7], [0, 1, 4], [1, 2, 5], [2, 3, 6], [0, 3, 7]];

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
type Node = u32;
/// A cell that was not reached.
const UNREACHED: Node = Node::MAX;
const STEP_BITS: u32 = 4;
const STEP_MASK: u32 = (1 << STEP_BITS) - 1;

/// The rectangle searched, with a ring of blocked cells around it, as flat arrays.
pub(super) struct Window {
    /// Cells in a row, ring included.
    pub(super) stride: usize,
    /// Rows, ring included.
    pub(super) rows: usize,
    /// Map cell of the array's first cell.
    origin: CellIndex,
    pub(super) resolution_m: f64,
    /// Weight of each cell: [`BLOCKED`], [`UNASKED`], or what half a straight step costs.
    pub(super) weights: Vec<u16>,
}

impl Window {
    fn fill(&mut self, terrain: &Terrain<'_>, rect: CellRect, unknown: u16) {
        self.stride = rect.width() + 2;
        self.rows = rect.height() + 2;
        self.origin = CellIndex::new(rect.x0 - 1, rect.y0 - 1);
        self.resolution_m = terrain.resolution_m;
        self.weights.clear();
        self.weights.resize(self.stride * self.rows, unknown);
        let bounds = terrain.bounds;
        let width = bounds.width();
        if width > 0 {
            let known = terrain.cells.chunks_exact(width).zip(terrain.lethal.chunks_exact(width));
            for (row, (cells, lethal)) in known.enumerate() {
                let y = (bounds.y0 - self.origin.iy) as usize + row;
                let at = y * self.stride + (bounds.x0 - self.origin.ix) as usize;
                let out = &mut self.weights[at..at + width];
                for ((weight, cell), lethal) in out.iter_mut().zip(cells).zip(lethal) {
                    let open = match cell {
                        Cell::Unknown => unknown,
                        Cell::Free => KNOWN,
                        Cell::Occupied => BLOCKED,
                    };
                    *weight = if *lethal { BLOCKED } else { open };
                }
            }
        }
        self.weights[..self.stride].fill(BLOCKED);
        let last = self.stride * (self.rows - 1);
        self.weights[last..].fill(BLOCKED);
        for row in self.weights.chunks_exact_mut(self.stride) {
            row[0] = BLOCKED;
            row[self.stride - 1] = BLOCKED;
        }
    }

    #[inline]
    pub(super) fn index(&self, x: u32, y: u32) -> usize {
        y as usize * self.stride + x as usize
    }

    /// Weights around a cell in the order of [`STEPS`].
    #[inline(always)]
    fn around(&self, at: usize) -> [u16; 8] {
        let (s, w) = (self.stride, &self.weights);
        let (low, row, high) = (&w[at - s - 1..][..3], &w[at - 1..][..3], &w[at + s - 1..][..3]);
        [row[2], high[1], row[0], low[1], high[2], high[0], low[0], low[2]]
    }

    /// Centre of a cell, map frame.
    pub(super) fn centre(&self, x: u32, y: u32) -> Point {
        let centre =
            |origin: i32, i: u32| (f64::from(origin) + f64::from(i) + 0.5) * self.resolution_m;
        Point::new(centre(self.origin.ix, x), centre(self.origin.iy, y))
    }

    fn locate(&self, cell: CellIndex) -> (u32, u32) {
        ((cell.ix - self.origin.ix) as u32, (cell.iy - self.origin.iy) as u32)
    }
}

/// Turns answers of the view into weights.
#[derive(Clone, Copy)]
struct Pricing {
    penalty: Penalty,
    alpha: f64,
    eps: f64,
    v_ref_mps: f64,
}

impl Pricing {
    fn weight(&self, phi: f32) -> u16 {
        let phi = if (0.0..=1.0).contains(&phi) { f64::from(phi) } else { 0.5 };
        let penalty = self.alpha / (1.0 - phi + self.eps);
        let factor = match self.penalty {
            Penalty::Edge => (1.0 + self.v_ref_mps * penalty).min(FACTOR_MAX),
            Penalty::Literal => penalty.min(LITERAL_FACTOR_MAX),
        };
        // A factor of zero (alpha = 0 with `literal`) must not read as blocked.
        (factor * f64::from(KNOWN)).round().max(1.0) as u16
    }
}

/// Asks the view block by block and keeps the answers as weights.
struct Asker<'v> {
    view: &'v mut dyn OccupancyView,
    pricing: Pricing,
    asked: usize,
}

/// Scratch of one question to the view.
#[derive(Default)]
struct Block {
    cells: Vec<u32>,
    points: Vec<Point>,
    answers: Vec<f32>,
}

impl Asker<'_> {
    #[cold]
    fn ask(&mut self, window: &mut Window, block: &mut Block, x: u32, y: u32) {
        let side = 1 << BLOCK_SHIFT;
        let (x0, y0) = (x >> BLOCK_SHIFT << BLOCK_SHIFT, y >> BLOCK_SHIFT << BLOCK_SHIFT);
        block.cells.clear();
        block.points.clear();
        for y in y0..(y0 + side).min(window.rows as u32) {
            for x in x0..(x0 + side).min(window.stride as u32) {
                let at = window.index(x, y);
                if window.weights[at] == UNASKED {
                    block.cells.push(at as u32);
                    block.points.push(window.centre(x, y));
                }
            }
        }
        block.answers.clear();
        block.answers.resize(block.points.len(), f32::NAN);
        self.view.occupied(&block.points, &mut block.answers);
        self.asked += block.points.len();
        for (at, phi) in block.cells.iter().zip(&block.answers) {
            window.weights[*at as usize] = self.pricing.weight(*phi);
        }
    }

    /// Asks for whatever is still unasked in the square of three cells around one.
    fn ask_around(&mut self, window: &mut Window, block: &mut Block, x: u32, y: u32) {
        for y in y - 1..=y + 1 {
            for x in x - 1..=x + 1 {
                if window.weights[window.index(x, y)] == UNASKED {
                    self.ask(window, block, x, y);
                }
            }
        }
    }
}

/// What counts as having arrived, in cells of the window.
#[derive(Clone, Copy)]
struct Target {
    x: i64,
    y: i64,
    /// Goal and radius in cells, for the exact test of a cell centre.
    centre: (f64, f64),
    radius2: f64,
    /// No accepted cell is closer to the goal's cell than this, as a cost.
    slack: u32,
}

impl Target {
    /// Octile distance, less the radius: never more than what a way over known-free cells costs.
    #[inline]
    fn bound(&self, x: u32, y: u32) -> u32 {
        let dx = (i64::from(x) - self.x).unsigned_abs() as u32;
        let dy = (i64::from(y) - self.y).unsigned_abs() as u32;
        let (long, short) = (dx.max(dy), dx.min(dy));
        (STRAIGHT * long + (DIAGONAL - STRAIGHT) * short).saturating_sub(self.slack)
    }

    #[inline]
    fn reached(&self, x: u32, y: u32) -> bool {
        let (dx, dy) = (f64::from(x) + 0.5 - self.centre.0, f64::from(y) + 0.5 - self.centre.1);
        (i64::from(x) == self.x && i64::from(y) == self.y) || dx * dx + dy * dy <= self.radius2
    }
}

/// The grid search. Holds its working memory, so that searching again allocates nothing but the
/// answer.
pub struct GuideSearch {
    window: Window,
    nodes: Vec<Node>,
    /// Whether a cell has been expanded (with [`Penalty::Literal`] alone).
    closed: Vec<bool>,
    queue: Buckets,
    heap: BinaryHeap<(Reverse<u64>, u32, u32)>,
    block: Block,
    puller: Puller,
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
            window: Window {
                stride: 0,
                rows: 0,
                origin: CellIndex::default(),
                resolution_m: 1.0,
                weights: Vec::new(),
            },
            nodes: Vec::new(),
            closed: Vec::new(),
            queue: Buckets::new(),
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
        self.window.fill(terrain, rect, if query.through_unknown { UNASKED } else { BLOCKED });
        self.nodes.clear();
        self.nodes.resize(self.window.weights.len(), UNREACHED);

        let start = self.start_cell(terrain, query)?;
        let target = self.target(terrain, query)?;
        let mut asker = Asker {
            view,
            pricing: Pricing {
                penalty: params.penalty,
                alpha: params.alpha,
                eps: params.eps,
                v_ref_mps: query.v_ref_mps,
            },
            asked: 0,
        };
        asker.ask_around(&mut self.window, &mut self.block, start.0, start.1);
        let (end, expanded) = match params.penalty {
            Penalty::Edge => self.run_edge(start, target, &mut asker)?,
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

    fn target(&self, terrain: &Terrain<'_>, query: &SearchQuery) -> Result<Target, SearchError> {
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
        let columns = x.saturating_sub(reach)..(x + reach + 1).min(self.window.stride as u32);
        for y in y.saturating_sub(reach)..(y + reach + 1).min(self.window.rows as u32) {
            for x in columns.clone() {
                if self.window.weights[self.window.index(x, y)] != BLOCKED && target.reached(x, y) {
                    return Ok(target);
                }
            }
        }
        Err(SearchError::GoalBlocked { x_m: query.goal.x, y_m: query.goal.y })
    }

    fn run_edge(
        &mut self,
        start: (u32, u32),
        target: Target,
        asker: &mut Asker<'_>,
    ) -> Result<((u32, u32), usize), SearchError> {
        let Self { window, nodes, queue, block, .. } = self;
        let from = window.index(start.0, start.1);
        nodes[from] = 0;
        let key = target.bound(start.0, start.1);
        queue.reset(key);
        queue.push(key, start.1 << 16 | start.0);
        let stride = window.stride as isize;
        let offsets = STEPS.map(|(dx, dy)| dy as isize * stride + dx as isize);
        let (mut expanded, mut too_long) = (0, false);
        while let Some((key, item)) = queue.pop() {
            let (x, y) = (item & 0xffff, item >> 16);
            let at = window.index(x, y);
            let node = nodes[at];
            let own_g = node >> STEP_BITS;
            let bound = target.bound(x, y);
            if own_g + bound != key {
                // A cheaper way here was found, and followed, since this was pushed.
                continue;
            }
            if bound == 0 && target.reached(x, y) {
                return Ok(((x, y), expanded));
            }
            if own_g > COST_MAX {
                too_long = true;
                continue;
            }
            expanded += 1;
            let own = window.weights[at];
            let mut around = window.around(at);
            let mut relax = |step: usize, cost: u32| {
                let there = (at as isize + offsets[step]) as usize;
                let g = own_g + cost;
                let node = &mut nodes[there];
                if *node >> STEP_BITS > g {
                    *node = g << STEP_BITS | step as u32;
                    let (dx, dy) = STEPS[step];
                    let (x, y) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
                    queue.push(g + target.bound(x, y), y << 16 | x);
                }
            };
            let straight = 2 * u32::from(own);
            if around.iter().fold(0, |odd, w| odd | (w ^ own)) == 0 && at != from {
                let diagonal = straight * DIAGONAL / STRAIGHT;
                for &step in &AHEAD[(node & STEP_MASK) as usize] {
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

    /// `f = g + w |n - goal|`, `g` the length of the way, each cell expanded once.
    fn run_literal(
        &mut self,
        start: (u32, u32),
        target: Target,
        asker: &mut Asker<'_>,
    ) -> Result<((u32, u32), usize), SearchError> {
        let from = self.window.index(start.0, start.1);
        self.nodes[from] = 0;
        self.closed.clear();
        self.closed.resize(self.nodes.len(), false);
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
        loop {
            cells.push((x, y));
            let node = self.nodes[self.window.index(x, y)];
            if node == 0 {
                // Only the start costs nothing.
                break;
            }
            let (dx, dy) = STEPS[(node & STEP_MASK) as usize];
            (x, y) = (x.wrapping_add_signed(-dx), y.wrapping_add_signed(-dy));
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
