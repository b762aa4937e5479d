//! Exact Euclidean distance transform of the grid, kept up to date window by window.
//!
//! Separable (Saito and Toriwaki 1994): distance to the nearest blocking cell within each column,
//! then the minimum of `dx^2 + column^2` along each row, all in whole cells. Distances are capped,
//! so both passes look at most the cap far and a change reaches at most the cap far. With a cap of
//! some twenty cells the row minimum is fastest as a plain vectorised sweep over the offsets, which
//! stops as soon as no farther offset can improve any cell of the row.

use super::{Cell, CellIndex, CellRect, Grid};

/// Which cells count as obstacles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Blocking {
    /// Occupied cells only; unknown space counts as passable.
    Occupied,
    /// Everything that is not known to be free, also everything outside the grid's bounds.
    OccupiedOrUnknown,
}

impl Blocking {
    /// Whether a cell is an obstacle.
    #[inline]
    pub const fn blocks(self, cell: Cell) -> bool {
        match self {
            Self::Occupied => matches!(cell, Cell::Occupied),
            Self::OccupiedOrUnknown => !matches!(cell, Cell::Free),
        }
    }
}

/// The most cells that the cap may span: squares of distances then fit 16 bits.
const REACH_MAX: i32 = 180;

/// Distance from each cell's centre to the centre of the nearest blocking cell, capped.
#[derive(Clone, Debug)]
pub struct DistanceField {
    blocking: Blocking,
    cap_m: f64,
    resolution_m: f64,
    /// The cap in whole cells, rounded up.
    reach: i32,
    bounds: CellRect,
    /// Cells to the nearest blocking cell of the same column, at most `reach`.
    columns: Vec<u8>,
    values: Vec<f32>,
    scratch: Scratch,
}

#[derive(Clone, Debug, Default)]
struct Scratch {
    carry: Vec<u8>,
    squares: Vec<i16>,
    best: Vec<i16>,
}

impl DistanceField {
    /// A field over nothing yet; [`update`](Self::update) fills it.
    ///
    /// # Panics
    /// If `cap_m` is not positive and finite.
    pub fn new(blocking: Blocking, cap_m: f64) -> Self {
        assert!(cap_m > 0.0 && cap_m.is_finite(), "distance cap {cap_m} m");
        Self {
            blocking,
            cap_m,
            resolution_m: 0.0,
            reach: 0,
            bounds: CellRect::EMPTY,
            columns: Vec::new(),
            values: Vec::new(),
            scratch: Scratch::default(),
        }
    }

    /// Which cells count as obstacles.
    pub const fn blocking(&self) -> Blocking {
        self.blocking
    }

    /// The largest distance told, metres.
    pub const fn cap_m(&self) -> f64 {
        self.cap_m
    }

    /// The cells that [`values`](Self::values) covers: the grid's bounds at the last update.
    pub const fn bounds(&self) -> CellRect {
        self.bounds
    }

    /// Distances in metres, row by row as [`Grid::cells`].
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// For each cell of a row inside the bounds: how many rows away the nearest blocking cell of the
    /// same column is (it may be above or below); at most the cap, rounded up, which also stands
    /// for farther ones. Whatever lies outside the bounds is unknown.
    pub(super) fn rows_away(&self, iy: i32) -> &[u8] {
        let start = self.offset(self.bounds.x0, iy);
        &self.columns[start..start + self.bounds.width()]
    }

    /// Distance in metres from a cell's centre to the nearest blocking cell's centre, at most the
    /// cap. Outside the bounds: zero if unknown cells block, else the cap (which is right if no
    /// occupied cell lies within the cap of the bounds, as in the grid of a
    /// [`Mapper`](super::Mapper) for caps up to 2 m).
    #[inline]
    pub fn distance_m(&self, c: CellIndex) -> f32 {
        if self.bounds.contains(c) {
            return self.values[self.offset(c.ix, c.iy)];
        }
        match self.blocking {
            Blocking::Occupied => self.cap_m as f32,
            Blocking::OccupiedOrUnknown => 0.0,
        }
    }

    /// Brings the field up to date with a grid in which only cells inside `changed` differ from the
    /// one at the last update (the grid may also have grown). The result is the same, bit for bit,
    /// as that of a fresh field. With another cell size, or bounds that do not hold the former
    /// ones, everything is computed anew.
    ///
    /// # Panics
    /// If the cap spans more than 180 cells.
    pub fn update(&mut self, grid: &Grid, changed: CellRect) {
        if grid.resolution_m() != self.resolution_m
            || self.bounds.union(&grid.bounds()) != grid.bounds()
        {
            self.resolution_m = grid.resolution_m();
            let reach = (self.cap_m / self.resolution_m - 1e-9).ceil();
            assert!(reach <= f64::from(REACH_MAX), "cap {} m of {reach} cells", self.cap_m);
            self.reach = reach as i32;
            self.bounds = CellRect::EMPTY;
        }
        let old = self.bounds;
        if old != grid.bounds() {
            self.move_to(grid.bounds());
            if old.is_empty() {
                self.refresh(grid, grid.bounds());
                return;
            }
            // Inside the former bounds nothing has changed: what is outside was unknown before and
            // is unknown now (but for `changed`). The new cells near the former bounds need values.
            let near = old.grown(self.reach);
            for strip in [
                CellRect { y1: old.y0, ..near },
                CellRect { y0: old.y1, ..near },
                CellRect { x1: old.x0, y0: old.y0, y1: old.y1, ..near },
                CellRect { x0: old.x1, y0: old.y0, y1: old.y1, ..near },
            ] {
                self.refresh_columns(grid, strip);
                self.refresh_values(strip);
            }
        }
        if !changed.is_empty() {
            self.refresh(grid, changed);
        }
    }

    #[inline]
    fn offset(&self, ix: i32, iy: i32) -> usize {
        (iy - self.bounds.y0) as usize * self.bounds.width() + (ix - self.bounds.x0) as usize
    }

    /// Lays the arrays out for larger bounds; the new cells get the value that they have far from
    /// everything known.
    fn move_to(&mut self, bounds: CellRect) {
        let (column, value) = match self.blocking {
            Blocking::Occupied => (self.reach as u8, self.cap_m as f32),
            Blocking::OccupiedOrUnknown => (0, 0.0),
        };
        let (old, width) = (self.bounds, self.bounds.width());
        let count = bounds.width() * bounds.height();
        let old_columns = std::mem::replace(&mut self.columns, vec![column; count]);
        let old_values = std::mem::replace(&mut self.values, vec![value; count]);
        self.bounds = bounds;
        if old.is_empty() {
            return;
        }
        for (row, iy) in (old.y0..old.y1).enumerate() {
            let (from, to) = (row * width, self.offset(old.x0, iy));
            self.columns[to..to + width].copy_from_slice(&old_columns[from..from + width]);
            self.values[to..to + width].copy_from_slice(&old_values[from..from + width]);
        }
    }

    /// Recomputes everything that cells inside `changed` can reach.
    fn refresh(&mut self, grid: &Grid, changed: CellRect) {
        let rows = changed.grown(self.reach);
        self.refresh_columns(grid, CellRect { x0: changed.x0, x1: changed.x1, ..rows });
        self.refresh_values(rows);
    }

    /// Recomputes the distances within columns, for the cells of `rect`.
    fn refresh_columns(&mut self, grid: &Grid, rect: CellRect) {
        let rect = rect.intersection(&self.bounds);
        if rect.is_empty() {
            return;
        }
        let (blocking, far, width) = (self.blocking, self.reach as u8, rect.width());
        let sources = CellRect { y0: rect.y0 - self.reach, y1: rect.y1 + self.reach, ..rect }
            .intersection(&self.bounds);
        let start = (rect.x0 - self.bounds.x0) as usize;
        let outside = if blocking == Blocking::Occupied { far } else { 0 };
        let mut carry = std::mem::take(&mut self.scratch.carry);
        let step = |carry: &mut [u8], iy: i32| {
            let row = grid.row(iy).expect("the sources lie inside the grid");
            for (distance, cell) in carry.iter_mut().zip(&row[start..start + width]) {
                let next = (*distance + 1).min(far);
                *distance = if blocking.blocks(*cell) { 0 } else { next };
            }
        };
        // A pass that starts inside the bounds starts `reach` cells away: nothing beyond counts.
        let begin = |at_edge: bool| if at_edge { outside } else { far };
        carry.clear();
        carry.resize(width, begin(sources.y0 == self.bounds.y0));
        for iy in sources.y0..rect.y1 {
            step(&mut carry, iy);
            if iy >= rect.y0 {
                let to = self.offset(rect.x0, iy);
                self.columns[to..to + width].copy_from_slice(&carry);
            }
        }
        carry.fill(begin(sources.y1 == self.bounds.y1));
        for iy in (rect.y0..sources.y1).rev() {
            step(&mut carry, iy);
            if iy < rect.y1 {
                let to = self.offset(rect.x0, iy);
                for (column, distance) in self.columns[to..to + width].iter_mut().zip(&carry) {
                    *column = (*column).min(*distance);
                }
            }
        }
        self.scratch.carry = carry;
    }

    /// Recomputes the values of the cells of `rect` from the columns.
    fn refresh_values(&mut self, rect: CellRect) {
        let rect = rect.intersection(&self.bounds);
        if rect.is_empty() {
            return;
        }
        let width = rect.width();
        let reach = self.reach as usize;
        // `squares[i]` belongs to column `rect.x0 - reach + i`; outside the bounds the edge value.
        let outside = match self.blocking {
            Blocking::Occupied => (self.reach * self.reach) as i16,
            Blocking::OccupiedOrUnknown => 0,
        };
        let sources = CellRect { x0: rect.x0 - self.reach, x1: rect.x1 + self.reach, ..rect }
            .intersection(&self.bounds);
        let lead = (sources.x0 - (rect.x0 - self.reach)) as usize;
        let Scratch { squares, best, .. } = &mut self.scratch;
        squares.clear();
        squares.resize(width + 2 * reach, outside);
        let (cap, resolution) = (self.cap_m as f32, self.resolution_m as f32);
        for iy in rect.y0..rect.y1 {
            let row = (iy - self.bounds.y0) as usize * self.bounds.width();
            let from = row + (sources.x0 - self.bounds.x0) as usize;
            let columns = &self.columns[from..from + sources.width()];
            for (square, column) in squares[lead..].iter_mut().zip(columns) {
                *square = i16::from(*column) * i16::from(*column);
            }
            best.clear();
            best.extend_from_slice(&squares[reach..reach + width]);
            for dx in 1..=reach {
                let dx2 = (dx * dx) as i16;
                // Every fourth step is often enough to look whether farther ones can matter.
                if dx % 4 == 1 && best.iter().copied().fold(0, i16::max) <= dx2 {
                    break;
                }
                let left = &squares[reach - dx..reach - dx + width];
                let right = &squares[reach + dx..reach + dx + width];
                for ((best, left), right) in best.iter_mut().zip(left).zip(right) {
                    *best = (*best).min((*left).min(*right).saturating_add(dx2));
                }
            }
            let to = row + (rect.x0 - self.bounds.x0) as usize;
            for (value, best) in self.values[to..to + width].iter_mut().zip(&*best) {
                *value = (f32::from(*best).sqrt() * resolution).min(cap);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn paint(grid: &mut Grid, rng: &mut ChaCha8Rng, rect: CellRect, count: usize) {
        for _ in 0..count {
            let cell = match rng.random_range(0..10) {
                0 => Cell::Occupied,
                1 => Cell::Unknown,
                _ => Cell::Free,
            };
            let x = rng.random_range(rect.x0..rect.x1);
            let y = rng.random_range(rect.y0..rect.y1);
            for iy in y..(y + 6).min(rect.y1) {
                for ix in x..(x + 6).min(rect.x1) {
                    grid.set(CellIndex::new(ix, iy), cell);
                }
            }
        }
    }

    /// Straight from the definition.
    fn brute_force(grid: &Grid, blocking: Blocking, cap_m: f64, c: CellIndex) -> f64 {
        let reach = (cap_m / grid.resolution_m()).ceil() as i32;
        let mut best = cap_m;
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                if blocking.blocks(grid.get(CellIndex::new(c.ix + dx, c.iy + dy))) {
                    best = best.min(f64::from(dx).hypot(f64::from(dy)) * grid.resolution_m());
                }
            }
        }
        best
    }

    fn assert_same(a: &DistanceField, b: &DistanceField) {
        assert_eq!(a.bounds(), b.bounds());
        assert_eq!(a.columns, b.columns);
        assert!(a.values().iter().zip(b.values()).all(|(a, b)| a.to_bits() == b.to_bits()));
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            failure_persistence: None,
            ..ProptestConfig::with_cases(24)
        })]

        #[test]
        fn distances_agree_with_brute_force(seed in 0u64..1000, cap in 0.1f64..1.2, unknown: bool) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut grid = Grid::new(0.1);
            paint(&mut grid, &mut rng, CellRect { x0: -20, y0: 5, x1: 30, y1: 50 }, 200);
            let blocking = if unknown { Blocking::OccupiedOrUnknown } else { Blocking::Occupied };
            let mut field = DistanceField::new(blocking, cap);
            field.update(&grid, CellRect::EMPTY);
            for iy in -5..60 {
                for ix in -30..40 {
                    let c = CellIndex::new(ix, iy);
                    if grid.bounds().contains(c) {
                        let wanted = brute_force(&grid, blocking, cap, c);
                        prop_assert!((f64::from(field.distance_m(c)) - wanted).abs() < 1e-6);
                    }
                }
            }
        }

        #[test]
        fn updating_a_window_gives_the_same_bits_as_starting_afresh(
            seed in 0u64..1000, cap in 0.1f64..1.5, unknown: bool,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut grid = Grid::new(0.1);
            let blocking = if unknown { Blocking::OccupiedOrUnknown } else { Blocking::Occupied };
            let mut field = DistanceField::new(blocking, cap);
            paint(&mut grid, &mut rng, CellRect { x0: 0, y0: 0, x1: 60, y1: 60 }, 100);
            field.update(&grid, CellRect::EMPTY);
            for _ in 0..8 {
                // Now and then outside the bounds, so that the grid grows.
                let x0 = rng.random_range(-50..90);
                let y0 = rng.random_range(-50..90);
                let (w, h) = (rng.random_range(1..40), rng.random_range(1..40));
                let changed = CellRect { x0, y0, x1: x0 + w, y1: y0 + h };
                paint(&mut grid, &mut rng, changed, 10);
                field.update(&grid, changed);
                let mut fresh = DistanceField::new(blocking, cap);
                fresh.update(&grid, CellRect::EMPTY);
                assert_same(&field, &fresh);
            }
        }
    }

    #[test]
    fn outside_the_bounds_unknown_blocks_and_occupied_does_not() {
        let mut grid = Grid::new(0.1);
        grid.set(CellIndex::new(0, 0), Cell::Free);
        let far = CellIndex::new(500, 500);
        for (blocking, wanted) in [(Blocking::Occupied, 1.5), (Blocking::OccupiedOrUnknown, 0.0)] {
            let mut field = DistanceField::new(blocking, 1.5);
            assert_eq!(field.distance_m(far), wanted);
            field.update(&grid, CellRect::EMPTY);
            assert_eq!(field.distance_m(far), wanted);
        }
    }

    #[test]
    fn another_cell_size_starts_afresh() {
        let mut field = DistanceField::new(Blocking::Occupied, 1.0);
        for resolution in [0.1, 0.05] {
            let mut grid = Grid::new(resolution);
            grid.set(CellIndex::new(3, 3), Cell::Occupied);
            field.update(&grid, CellRect::EMPTY);
            let two_away = f64::from(field.distance_m(CellIndex::new(5, 3)));
            assert!((two_away - 2.0 * resolution).abs() < 1e-6);
        }
    }

    #[test]
    fn the_largest_cap_does_not_overflow() {
        let mut grid = Grid::new(0.1);
        grid.set(CellIndex::new(0, 0), Cell::Occupied);
        grid.grow_to(CellRect { x0: -200, y0: -200, x1: 200, y1: 200 });
        let mut field = DistanceField::new(Blocking::Occupied, 18.0);
        field.update(&grid, CellRect::EMPTY);
        assert!((field.distance_m(CellIndex::new(0, 179)) - 17.9).abs() < 1e-5);
        assert!((field.distance_m(CellIndex::new(100, 100)) - 200.0_f32.sqrt()).abs() < 1e-5);
        assert_eq!(field.distance_m(CellIndex::new(179, 179)), 18.0);
    }
}
