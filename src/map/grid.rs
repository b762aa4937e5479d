//! The three-state grid and its geometry.

use crate::frames::Point;

/// The largest whole number that is not above `v`, saturating. `f64::floor` is a call into the C
/// library on the oldest processors that this is compiled for, and cells are looked up a lot.
#[inline]
pub fn floor_to_index(v: f64) -> i32 {
    let truncated = v as i32;
    truncated.saturating_sub(i32::from(f64::from(truncated) > v))
}

/// What is known of one cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Default)]
#[repr(u8)]
pub enum Cell {
    /// Nothing is known; the planner's safe part never enters it.
    #[default]
    Unknown = 0,
    /// The whole square has been seen to be free.
    Free = 1,
    /// A beam has ended in it.
    Occupied = 2,
}

/// A cell by its column and row: cell `(ix, iy)` covers `[ix, ix+1) x [iy, iy+1)` cell sizes from
/// the origin of the map frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct CellIndex {
    /// Column, growing with map x.
    pub ix: i32,
    /// Row, growing with map y.
    pub iy: i32,
}

impl CellIndex {
    /// A cell by column and row.
    pub const fn new(ix: i32, iy: i32) -> Self {
        Self { ix, iy }
    }
}

/// A rectangle of cells, `x0..x1` by `y0..y1` (upper ends excluded); empty if an end does not
/// exceed its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct CellRect {
    /// First column.
    pub x0: i32,
    /// First row.
    pub y0: i32,
    /// One past the last column.
    pub x1: i32,
    /// One past the last row.
    pub y1: i32,
}

impl CellRect {
    /// The rectangle that holds nothing.
    pub const EMPTY: Self = Self { x0: 0, y0: 0, x1: 0, y1: 0 };

    /// Whether it holds no cell.
    pub const fn is_empty(&self) -> bool {
        self.x1 <= self.x0 || self.y1 <= self.y0
    }

    /// Columns.
    pub fn width(&self) -> usize {
        usize::try_from(self.x1 - self.x0).unwrap_or(0)
    }

    /// Rows.
    pub fn height(&self) -> usize {
        usize::try_from(self.y1 - self.y0).unwrap_or(0)
    }

    /// Whether the cell lies inside.
    pub const fn contains(&self, c: CellIndex) -> bool {
        c.ix >= self.x0 && c.ix < self.x1 && c.iy >= self.y0 && c.iy < self.y1
    }

    /// The smallest rectangle that holds both.
    pub fn union(&self, other: &Self) -> Self {
        if self.is_empty() {
            return *other;
        }
        if other.is_empty() {
            return *self;
        }
        Self {
            x0: self.x0.min(other.x0),
            y0: self.y0.min(other.y0),
            x1: self.x1.max(other.x1),
            y1: self.y1.max(other.y1),
        }
    }

    /// What both hold.
    pub fn intersection(&self, other: &Self) -> Self {
        Self {
            x0: self.x0.max(other.x0),
            y0: self.y0.max(other.y0),
            x1: self.x1.min(other.x1),
            y1: self.y1.min(other.y1),
        }
    }

    /// Wider by `cells` on every side.
    pub const fn grown(&self, cells: i32) -> Self {
        Self { x0: self.x0 - cells, y0: self.y0 - cells, x1: self.x1 + cells, y1: self.y1 + cells }
    }
}

/// All quarters of a cell, as a set: see [`Grid::seen_quarters`].
const QUARTERS: u8 = 0b1111;

/// A dense grid that grows; everything outside its bounds is [`Cell::Unknown`].
///
/// Of a cell that does not count as free, quarters may have been seen to be free. A view that opens
/// round a corner proves them before it proves whole cells, and a disc that is swept round the corner
/// needs no more.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    resolution_m: f64,
    bounds: CellRect,
    cells: Vec<Cell>,
    quarters: Vec<u8>,
}

impl Grid {
    /// An empty grid with square cells of `resolution_m` metres.
    ///
    /// # Panics
    /// If `resolution_m` is not positive and finite.
    pub fn new(resolution_m: f64) -> Self {
        assert!(resolution_m > 0.0 && resolution_m.is_finite(), "resolution {resolution_m} m");
        let (cells, quarters) = (Vec::new(), Vec::new());
        Self { resolution_m, bounds: CellRect::EMPTY, cells, quarters }
    }

    /// Side of a cell, metres.
    pub const fn resolution_m(&self) -> f64 {
        self.resolution_m
    }

    /// The cells that are stored.
    pub const fn bounds(&self) -> CellRect {
        self.bounds
    }

    /// The stored cells, row by row from `bounds().y0`, each row from `bounds().x0`.
    pub fn cells(&self) -> &[Cell] {
        &self.cells
    }

    /// Position of a cell in [`cells`](Self::cells), or `None` outside the bounds.
    #[inline]
    pub fn offset(&self, c: CellIndex) -> Option<usize> {
        self.bounds.contains(c).then(|| {
            (c.iy - self.bounds.y0) as usize * self.bounds.width()
                + (c.ix - self.bounds.x0) as usize
        })
    }

    /// What is known of a cell.
    #[inline]
    pub fn get(&self, c: CellIndex) -> Cell {
        self.offset(c).map_or(Cell::Unknown, |i| self.cells[i])
    }

    /// The stored cells of one row, from `bounds().x0` on; `None` outside the bounds.
    #[inline]
    pub fn row(&self, iy: i32) -> Option<&[Cell]> {
        let start = self.offset(CellIndex::new(self.bounds.x0, iy))?;
        Some(&self.cells[start..start + self.bounds.width()])
    }

    /// The quarters of a cell that have been seen to be free although the cell does not count as
    /// free: bit 0 the one of least x and y, bit 1 its neighbour in x, bits 2 and 3 those above.
    #[inline]
    pub fn seen_quarters(&self, c: CellIndex) -> u8 {
        self.offset(c).map_or(0, |i| self.quarters[i])
    }

    /// The quarters of a cell that may hold something, as cells of a grid twice as fine; all of a
    /// cell of which nothing is known, none of one that is free.
    #[inline]
    pub fn blocked_quarters(&self, c: CellIndex) -> impl Iterator<Item = CellIndex> + use<> {
        let free = if self.get(c) == Cell::Free { QUARTERS } else { self.seen_quarters(c) };
        let quarters = (0..4).filter(move |k| free & (1 << k) == 0);
        quarters.map(move |k| CellIndex::new(2 * c.ix + (k & 1), 2 * c.iy + (k >> 1)))
    }

    /// What is known of the quarter of a cell that holds a point of the map frame.
    #[inline]
    pub fn state_at(&self, p: Point) -> Cell {
        let c = self.cell_at(p);
        if self.seen_quarters(c) & self.quarter_at(p) != 0 { Cell::Free } else { self.get(c) }
    }

    /// The bit of the quarter of its cell that holds a point.
    fn quarter_at(&self, p: Point) -> u8 {
        let half_m = 0.5 * self.resolution_m;
        let odd = |v: f64| floor_to_index(v / half_m) & 1;
        1 << (odd(p.x) | odd(p.y) << 1)
    }

    /// Adds quarters that have been seen to be free to a stored cell that does not count as free.
    pub(crate) fn see_quarters(&mut self, c: CellIndex, quarters: u8) {
        let offset = self.offset(c).expect("the cell is stored");
        self.quarters[offset] |= quarters;
    }

    /// Makes a stored cell occupied, but for its quarters that have been seen to be free.
    pub(super) fn occupy(&mut self, c: CellIndex) {
        let offset = self.offset(c).expect("the cell is stored");
        self.cells[offset] = Cell::Occupied;
    }

    /// Stores a cell, growing the grid where needed.
    pub fn set(&mut self, c: CellIndex, cell: Cell) {
        if !self.bounds.contains(c) {
            self.grow_to(CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 });
        }
        let offset = self.offset(c).expect("the grid was grown to hold the cell");
        self.cells[offset] = cell;
        self.quarters[offset] = 0;
    }

    /// Makes the bounds hold `rect`. Grows in steps of 64 cells so that driving on does not copy
    /// the grid at every scan.
    pub fn grow_to(&mut self, rect: CellRect) {
        const STEP: i32 = 64;
        if rect.is_empty() || self.bounds.union(&rect) == self.bounds {
            return;
        }
        let down = |v: i32| v.div_euclid(STEP) * STEP;
        let union = self.bounds.union(&rect);
        let bounds = CellRect {
            x0: down(union.x0),
            y0: down(union.y0),
            x1: down(union.x1 + STEP - 1),
            y1: down(union.y1 + STEP - 1),
        };
        self.cells = spread(&self.cells, self.bounds, bounds);
        self.quarters = spread(&self.quarters, self.bounds, bounds);
        self.bounds = bounds;
    }

    /// The cell that holds a point of the map frame.
    #[inline]
    pub fn cell_at(&self, p: Point) -> CellIndex {
        CellIndex {
            ix: floor_to_index(p.x / self.resolution_m),
            iy: floor_to_index(p.y / self.resolution_m),
        }
    }

    /// Centre of a cell, map frame.
    #[inline]
    pub fn centre(&self, c: CellIndex) -> Point {
        Point::new(
            (f64::from(c.ix) + 0.5) * self.resolution_m,
            (f64::from(c.iy) + 0.5) * self.resolution_m,
        )
    }
}

/// What is stored for the cells of `from`, laid out for the larger `to`.
fn spread<T: Copy + Default>(old: &[T], from: CellRect, to: CellRect) -> Vec<T> {
    let mut new = vec![T::default(); to.width() * to.height()];
    let width = from.width();
    for (row, old) in old.chunks_exact(width.max(1)).enumerate() {
        let start = ((from.y0 - to.y0) as usize + row) * to.width() + (from.x0 - to.x0) as usize;
        new[start..start + width].copy_from_slice(old);
    }
    new
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn growing_keeps_every_cell() {
        let mut grid = Grid::new(0.1);
        grid.set(CellIndex::new(0, 0), Cell::Free);
        grid.set(CellIndex::new(-70, 200), Cell::Occupied);
        grid.set(CellIndex::new(63, -1), Cell::Free);
        assert_eq!(grid.get(CellIndex::new(0, 0)), Cell::Free);
        assert_eq!(grid.get(CellIndex::new(-70, 200)), Cell::Occupied);
        assert_eq!(grid.get(CellIndex::new(63, -1)), Cell::Free);
        assert_eq!(grid.cells().iter().filter(|c| **c != Cell::Unknown).count(), 3);
        assert_eq!(grid.get(CellIndex::new(9_999, 9_999)), Cell::Unknown);
    }

    #[test]
    fn quarters_stay_known_until_their_cell_is_free_or_they_are_taken_back() {
        let mut grid = Grid::new(0.1);
        let c = CellIndex::new(-3, 5);
        grid.set(c, Cell::Unknown);
        grid.see_quarters(c, 0b0110);
        grid.grow_to(CellRect { x0: -200, y0: -200, x1: 200, y1: 200 });
        let (left, right) = (Point::new(-0.28, 0.52), Point::new(-0.22, 0.52));
        assert_eq!((grid.state_at(left), grid.state_at(right)), (Cell::Unknown, Cell::Free));
        let blocked: Vec<_> = grid.blocked_quarters(c).collect();
        assert_eq!(blocked, [CellIndex::new(-6, 10), CellIndex::new(-5, 11)]);
        grid.occupy(c);
        assert_eq!((grid.state_at(left), grid.state_at(right)), (Cell::Occupied, Cell::Free));
        grid.set(c, Cell::Occupied);
        assert_eq!((grid.state_at(right), grid.seen_quarters(c)), (Cell::Occupied, 0));
        grid.set(c, Cell::Free);
        assert_eq!((grid.state_at(left), grid.seen_quarters(c)), (Cell::Free, 0));
        assert_eq!(grid.blocked_quarters(c).count(), 0);
        assert_eq!(grid.blocked_quarters(CellIndex::new(9_999, 0)).count(), 4);
    }

    #[test]
    fn a_centre_lies_in_its_own_cell() {
        let grid = Grid::new(0.05);
        for ix in -40..40 {
            let c = CellIndex::new(ix, 7 - ix);
            assert_eq!(grid.cell_at(grid.centre(c)), c);
        }
    }
}
