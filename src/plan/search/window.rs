//! The rectangle that is searched: what entering each cell costs.

use super::boards::Boards;
use super::{Penalty, Terrain};
use crate::frames::{Point, Vector};
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
/// The probability of being occupied where the view knows nothing.
pub(super) const SILENT: f32 = 0.5;
/// The view is asked for blocks of this many cells by as many, as a power of two.
const BLOCK_SHIFT: u32 = 3;
const SIDE: usize = 1 << BLOCK_SHIFT;
/// The largest window that is searched, cells (a square of 280 m at 0.1 m).
pub(super) const CELLS_MAX: usize = 8_000_000;

/// The rectangle searched, with a ring of blocked cells around it, as flat arrays.
#[derive(Default)]
pub(super) struct Window {
    /// Cells in a row, ring included.
    pub(super) stride: usize,
    /// Rows, ring included.
    pub(super) rows: usize,
    /// Map cell of the array's first cell.
    pub(super) origin: CellIndex,
    pub(super) resolution_m: f64,
    /// Weight of each cell: [`BLOCKED`], [`UNASKED`], or what half a straight step costs.
    pub(super) weights: Vec<u16>,
    /// Scratch: one row, and what its unknown cells are.
    classes: Vec<Class>,
    unknown_row: Vec<Class>,
}

/// What a cell is, as a byte whose lowest bits can be gathered into words.
pub(super) type Class = u8;
/// May not be entered.
pub(super) const CLASS_BLOCKED: Class = 0;
/// Known to be free.
pub(super) const CLASS_FREE: Class = 1;
/// Unknown and nothing is foreseen there: all such cells weigh the same.
pub(super) const CLASS_SILENT: Class = 2;
/// May be entered at the price that the view is to be asked for.
pub(super) const CLASS_UNKNOWN: Class = 4;

impl Window {
    /// Takes in the terrain within `rect`; `silent` is the weight of cells for which the view
    /// need not be asked, where there may be such cells.
    pub(super) fn fill(
        &mut self,
        boards: &mut Boards,
        terrain: &Terrain<'_>,
        rect: CellRect,
        through_unknown: bool,
        silent: Option<(u16, &dyn OccupancyView)>,
    ) {
        let unknown = if through_unknown { CLASS_UNKNOWN } else { CLASS_BLOCKED };
        let silent = silent.filter(|_| through_unknown);
        let silent_weight = silent.map_or(UNASKED, |(weight, _)| weight);
        let (width, height) = (rect.width(), rect.height());
        self.stride = width + 2;
        self.rows = height + 2;
        self.origin = CellIndex::new(rect.x0 - 1, rect.y0 - 1);
        self.resolution_m = terrain.resolution_m;
        let corner = |x: u32, y: u32| {
            let corner =
                |origin: i32, i: u32| (f64::from(origin) + f64::from(i)) * terrain.resolution_m;
            Point::new(corner(rect.x0 - 1, x), corner(rect.y0 - 1, y))
        };
        // Every cell is written below.
        self.weights.resize(self.stride * self.rows, BLOCKED);
        boards.resize(self.stride, self.rows);
        let classes = &mut self.classes;
        classes.clear();
        classes.resize(self.stride.next_multiple_of(64), CLASS_BLOCKED);
        self.unknown_row.clear();
        self.unknown_row.resize(width, unknown);
        let bounds = terrain.bounds;
        let left = (bounds.x0 - self.origin.ix) as usize;
        for (y, weights) in self.weights.chunks_exact_mut(self.stride).enumerate() {
            if y == 0 || y > height {
                weights.fill(BLOCKED);
                continue;
            }
            if let Some((_, view)) = silent.filter(|_| y == 1 || y % SIDE == 0) {
                let blocks = self.unknown_row.chunks_mut(SIDE).enumerate();
                let low = corner(0, (y / SIDE * SIDE) as u32);
                for (i, cells) in blocks {
                    let low = Point::new(corner((i * SIDE + 1) as u32, 0).x, low.y);
                    let high = low + Vector::repeat(SIDE as f64 * terrain.resolution_m);
                    let class = if view.silent(low, high) { CLASS_SILENT } else { CLASS_UNKNOWN };
                    cells.fill(class);
                }
            }
            classes[1..=width].copy_from_slice(&self.unknown_row);
            let row = y as i64 + i64::from(self.origin.iy) - i64::from(bounds.y0);
            if (0..bounds.height() as i64).contains(&row) {
                let from = row as usize * bounds.width();
                let cells = &terrain.cells[from..from + bounds.width()];
                let lethal = &terrain.lethal[from..from + bounds.width()];
                let out = &mut classes[left..left + bounds.width()];
                for ((class, cell), lethal) in out.iter_mut().zip(cells).zip(lethal) {
                    let open = match cell {
                        Cell::Unknown => *class,
                        Cell::Free => CLASS_FREE,
                        Cell::Occupied => CLASS_BLOCKED,
                    };
                    *class = if *lethal { CLASS_BLOCKED } else { open };
                }
            }
            for (weight, class) in weights.iter_mut().zip(&*classes) {
                let open = if *class == CLASS_FREE { KNOWN } else { BLOCKED };
                let open = if *class == CLASS_SILENT { silent_weight } else { open };
                *weight = if *class == CLASS_UNKNOWN { UNASKED } else { open };
            }
            boards.set_row(y, classes);
        }
    }

    #[inline]
    pub(super) fn index(&self, x: u32, y: u32) -> usize {
        y as usize * self.stride + x as usize
    }

    /// Weights around a cell in the order of the search's steps.
    #[inline(always)]
    pub(super) fn around(&self, at: usize) -> [u16; 8] {
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

    pub(super) fn locate(&self, cell: CellIndex) -> (u32, u32) {
        ((cell.ix - self.origin.ix) as u32, (cell.iy - self.origin.iy) as u32)
    }
}

/// Turns answers of the view into weights.
#[derive(Clone, Copy)]
pub(super) struct Pricing {
    pub(super) penalty: Penalty,
    pub(super) alpha: f64,
    pub(super) eps: f64,
    pub(super) v_ref_mps: f64,
}

impl Pricing {
    pub(super) fn weight(&self, phi: f32) -> u16 {
        let phi = if (0.0..=1.0).contains(&phi) { phi } else { SILENT };
        let phi = f64::from(phi);
        let penalty = self.alpha / (1.0 - phi + self.eps);
        let factor = match self.penalty {
            Penalty::Edge => (1.0 + self.v_ref_mps * penalty).min(FACTOR_MAX),
            Penalty::Literal => penalty.min(LITERAL_FACTOR_MAX),
        };
        // A factor of zero (alpha = 0 with `literal`) must not read as blocked.
        // Rounded; `f64::round` is a call into the C library.
        (factor * f64::from(KNOWN) + 0.5).max(1.0) as u16
    }
}

/// Asks the view block by block and keeps the answers as weights.
pub(super) struct Asker<'v> {
    pub(super) view: &'v mut dyn OccupancyView,
    pub(super) pricing: Pricing,
    pub(super) asked: usize,
}

/// Scratch of one question to the view.
#[derive(Default)]
pub(super) struct Block {
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
        // Coarser cells than ours answer several of ours in turn with the same number.
        let (mut last_phi, mut last) = (SILENT, self.pricing.weight(SILENT));
        for (at, phi) in block.cells.iter().zip(&block.answers) {
            if phi.to_bits() != last_phi.to_bits() {
                (last_phi, last) = (*phi, self.pricing.weight(*phi));
            }
            window.weights[*at as usize] = last;
        }
    }

    /// Asks for whatever is still unasked in the square of three cells around one.
    pub(super) fn ask_around(&mut self, window: &mut Window, block: &mut Block, x: u32, y: u32) {
        for y in y - 1..=y + 1 {
            for x in x - 1..=x + 1 {
                if window.weights[window.index(x, y)] == UNASKED {
                    self.ask(window, block, x, y);
                }
            }
        }
    }
}
