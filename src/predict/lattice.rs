//! What a learned predictor sees: the map on a coarse lattice, cropped around the car.
//!
//! Coarse cell `(i, j)` covers `[i r, (i+1) r) x [j r, (j+1) r)` of the map frame, whatever the
//! size of the map's own cells. It is occupied if a map cell whose centre lies in it is occupied,
//! else free if none of them is unknown, else unknown. (If the map's cells are so large that no
//! centre lies in it, the map cell at its own centre decides.) The training data are made by the
//! same code, so that a network meets on the road what it was trained on.

use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect, Grid};

/// Coarse cells along a side of the crop.
pub const CROP_CELLS: usize = 104;

/// Column and row of the car's own coarse cell in the crop.
pub const CROP_CENTRE: usize = CROP_CELLS / 2;

/// A centre this close below a line of the lattice, in coarse cells, counts as on it: products of
/// indices and cell sizes are off by rounding.
const ROUNDING: f64 = 1e-6;

/// The map on the coarse lattice, kept up to date change by change.
#[derive(Clone, Debug)]
pub struct Lattice {
    coarse: Grid,
    fine_resolution_m: f64,
    fine_bounds: CellRect,
}

impl Lattice {
    /// A lattice of cells of `resolution_m` over nothing yet.
    ///
    /// # Panics
    /// If `resolution_m` is not positive and finite.
    pub fn new(resolution_m: f64) -> Self {
        Self {
            coarse: Grid::new(resolution_m),
            fine_resolution_m: 0.0,
            fine_bounds: CellRect::EMPTY,
        }
    }

    /// Takes in a map of which only `changed` differs from the one before (it may also have
    /// grown). A map of other cells, or one that does not hold the former one's bounds, is read
    /// from the beginning.
    pub fn update(&mut self, map: &Grid, changed: CellRect) {
        let mut changed = changed.intersection(&map.bounds());
        if map.resolution_m() != self.fine_resolution_m
            || self.fine_bounds.union(&map.bounds()) != map.bounds()
        {
            self.coarse = Grid::new(self.coarse.resolution_m());
            self.fine_resolution_m = map.resolution_m();
            changed = map.bounds();
        }
        self.fine_bounds = map.bounds();
        if changed.is_empty() {
            return;
        }
        let scale = self.fine_resolution_m / self.coarse.resolution_m();
        // Coarse cells that the changed ones overlap.
        let low = |v: i32| (f64::from(v) * scale + ROUNDING).floor() as i32;
        let high = |v: i32| (f64::from(v) * scale - ROUNDING).ceil() as i32;
        let touched = CellRect {
            x0: low(changed.x0),
            y0: low(changed.y0),
            x1: high(changed.x1),
            y1: high(changed.y1),
        };
        self.coarse.grow_to(touched);
        for j in touched.y0..touched.y1 {
            let rows = centres_in(j, scale);
            for i in touched.x0..touched.x1 {
                let columns = centres_in(i, scale);
                let cell = combined(map, columns, rows);
                self.coarse.set(CellIndex::new(i, j), cell);
            }
        }
    }

    /// Side of a coarse cell, metres.
    pub const fn resolution_m(&self) -> f64 {
        self.coarse.resolution_m()
    }

    /// The coarse cells as a grid of their own, in the same frame as the map.
    pub const fn cells(&self) -> &Grid {
        &self.coarse
    }

    /// The coarse cell that holds a point of the map frame.
    pub fn cell_at(&self, p: Point) -> CellIndex {
        let at = |v: f64| (v / self.coarse.resolution_m()).floor() as i32;
        CellIndex::new(at(p.x), at(p.y))
    }

    /// What is known around the car.
    pub fn crop(&self, car: Point, into: &mut Crop) {
        let centre = self.cell_at(car);
        into.car = centre;
        into.resolution_m = self.coarse.resolution_m();
        for (row, cells) in into.cells.chunks_exact_mut(CROP_CELLS).enumerate() {
            cells.fill(Cell::Unknown);
            let bounds = self.coarse.bounds();
            let Some(known) = self.coarse.row(centre.iy + row as i32 - CROP_CENTRE as i32) else {
                continue;
            };
            let x0 = centre.ix - CROP_CENTRE as i32;
            let from = x0.max(bounds.x0);
            let to = (x0 + CROP_CELLS as i32).min(bounds.x1);
            if from < to {
                cells[(from - x0) as usize..(to - x0) as usize].copy_from_slice(
                    &known[(from - bounds.x0) as usize..(to - bounds.x0) as usize],
                );
            }
        }
    }
}

/// The cells of the finer grid, from the first to the one after the last, whose centres lie in cell
/// `k` of the coarser one along one axis; the one that holds its centre if there are none.
fn centres_in(k: i32, scale: f64) -> [i32; 2] {
    let first = |k: i32| (f64::from(k) / scale - 0.5 - ROUNDING / scale).ceil() as i32;
    let (from, to) = (first(k), first(k + 1));
    if from < to {
        return [from, to];
    }
    let holder = ((f64::from(k) + 0.5) / scale).floor() as i32;
    [holder, holder + 1]
}

fn combined(map: &Grid, columns: [i32; 2], rows: [i32; 2]) -> Cell {
    let bounds = map.bounds();
    let inside = columns[0] >= bounds.x0 && columns[1] <= bounds.x1;
    let mut result = if inside { Cell::Free } else { Cell::Unknown };
    let from = columns[0].clamp(bounds.x0, bounds.x1) - bounds.x0;
    let to = columns[1].clamp(bounds.x0, bounds.x1) - bounds.x0;
    for iy in rows[0]..rows[1] {
        let Some(row) = map.row(iy) else {
            result = Cell::Unknown;
            continue;
        };
        for cell in &row[from as usize..to as usize] {
            match cell {
                Cell::Occupied => return Cell::Occupied,
                Cell::Unknown => result = Cell::Unknown,
                Cell::Free => {}
            }
        }
    }
    result
}

/// The coarse cells around the car, the car's own in the middle; no rotation.
///
/// Points given for it are in the *robot-cell frame*: metres from the lower left corner of the
/// car's coarse cell, along the axes of the map frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Crop {
    /// The car's coarse cell, counted from the origin of the map frame.
    pub car: CellIndex,
    /// Side of a coarse cell, metres.
    pub resolution_m: f64,
    /// Row by row from the lowest y, [`CROP_CELLS`] squared.
    pub cells: Vec<Cell>,
}

impl Default for Crop {
    fn default() -> Self {
        Self {
            car: CellIndex::new(0, 0),
            resolution_m: 0.25,
            cells: vec![Cell::Unknown; CROP_CELLS * CROP_CELLS],
        }
    }
}

/// Which of the observed cells a network is given.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ContextSelection {
    /// All of them.
    All,
    /// The occupied ones and the free ones on the frontier: the inside of free space says little.
    WallsAndFrontier,
}

impl ContextSelection {
    /// The name in a model file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::WallsAndFrontier => "walls-and-frontier",
        }
    }

    /// The selection of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [Self::All, Self::WallsAndFrontier].into_iter().find(|s| s.name() == name)
    }
}

impl Crop {
    /// Corner of the robot-cell frame, map frame, metres.
    pub fn origin(&self) -> Point {
        Point::new(
            f64::from(self.car.ix) * self.resolution_m,
            f64::from(self.car.iy) * self.resolution_m,
        )
    }

    /// Centre of a cell by column and row of the crop, robot-cell frame.
    pub fn centre(&self, column: usize, row: usize) -> [f32; 2] {
        let at = |k: usize| ((k as f64 - CROP_CENTRE as f64 + 0.5) * self.resolution_m) as f32;
        [at(column), at(row)]
    }

    /// Whether a cell is free and touches an unknown one of the crop with one of its four sides.
    pub fn is_frontier(&self, column: usize, row: usize) -> bool {
        let unknown = |column: usize, row: usize| {
            column < CROP_CELLS
                && row < CROP_CELLS
                && self.cells[row * CROP_CELLS + column] == Cell::Unknown
        };
        self.cells[row * CROP_CELLS + column] == Cell::Free
            && (unknown(column.wrapping_sub(1), row)
                || unknown(column + 1, row)
                || unknown(column, row.wrapping_sub(1))
                || unknown(column, row + 1))
    }

    /// Writes the context set into `out`: x and y of the cell's centre in the robot-cell frame, and
    /// 0 for free or 1 for occupied; row by row.
    pub fn context(&self, selection: ContextSelection, out: &mut Vec<[f32; 3]>) {
        out.clear();
        for row in 0..CROP_CELLS {
            for column in 0..CROP_CELLS {
                let label = match self.cells[row * CROP_CELLS + column] {
                    Cell::Unknown => continue,
                    Cell::Occupied => 1.0,
                    Cell::Free => {
                        let wanted =
                            selection == ContextSelection::All || self.is_frontier(column, row);
                        if !wanted {
                            continue;
                        }
                        0.0
                    }
                };
                let [x, y] = self.centre(column, row);
                out.push([x, y, label]);
            }
        }
    }

    /// The frontier's pieces: frontier cells that touch, also diagonally, at least
    /// `cells_min` of them. For each the cell (column and row of the crop) nearest to the piece's
    /// centroid; nearest to the car first.
    pub fn frontier_centres(&self, cells_min: usize) -> Vec<[usize; 2]> {
        let mut left = vec![false; self.cells.len()];
        for row in 0..CROP_CELLS {
            for column in 0..CROP_CELLS {
                left[row * CROP_CELLS + column] = self.is_frontier(column, row);
            }
        }
        let mut centres = Vec::new();
        let (mut stack, mut piece) = (Vec::new(), Vec::new());
        for first in 0..left.len() {
            if !left[first] {
                continue;
            }
            left[first] = false;
            stack.push(first);
            piece.clear();
            while let Some(at) = stack.pop() {
                piece.push([at % CROP_CELLS, at / CROP_CELLS]);
                let (column, row) = (at % CROP_CELLS, at / CROP_CELLS);
                for y in row.saturating_sub(1)..=(row + 1).min(CROP_CELLS - 1) {
                    for x in column.saturating_sub(1)..=(column + 1).min(CROP_CELLS - 1) {
                        let next = y * CROP_CELLS + x;
                        if left[next] {
                            left[next] = false;
                            stack.push(next);
                        }
                    }
                }
            }
            if piece.len() >= cells_min {
                centres.push(nearest_to_centroid(&piece));
            }
        }
        let away = |[column, row]: &[usize; 2]| {
            let d = |k: usize| k.abs_diff(CROP_CENTRE).pow(2);
            (d(*column) + d(*row), *row, *column)
        };
        centres.sort_by_key(away);
        centres
    }
}

fn nearest_to_centroid(piece: &[[usize; 2]]) -> [usize; 2] {
    let n = piece.len();
    let sum = piece.iter().fold([0, 0], |s, c| [s[0] + c[0], s[1] + c[1]]);
    // In whole numbers, scaled by the count, so that ties break the same way everywhere.
    let away = |c: &&[usize; 2]| {
        let square = (c[0] * n).abs_diff(sum[0]).pow(2) + (c[1] * n).abs_diff(sum[1]).pow(2);
        (square, c[1], c[0])
    };
    *piece.iter().min_by_key(away).expect("a piece has cells")
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The rule as the first lines of this file say it, cell by cell.
    fn literal(map: &Grid, i: i32, j: i32, r: f64) -> Cell {
        let b = map.bounds().grown(12);
        let inside = |v: f64, k: i32| (v / r + 1e-6).floor() as i32 == k;
        let mut cells = Vec::new();
        for iy in b.y0..b.y1 {
            for ix in b.x0..b.x1 {
                let c = map.centre(CellIndex::new(ix, iy));
                if inside(c.x, i) && inside(c.y, j) {
                    cells.push(map.get(CellIndex::new(ix, iy)));
                }
            }
        }
        if cells.contains(&Cell::Occupied) {
            Cell::Occupied
        } else if cells.contains(&Cell::Unknown) || cells.is_empty() {
            Cell::Unknown
        } else {
            Cell::Free
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn every_coarse_cell_follows_the_rule_after_every_change(
            rects in prop::collection::vec(
                (-30..30_i32, -30..30_i32, 1..20_i32, 1..20_i32, 0..4_u8), 1..6),
            fine in prop::sample::select(vec![0.05, 0.1, 0.125, 0.2, 0.25]),
        ) {
            let mut map = Grid::new(fine);
            let mut lattice = Lattice::new(0.25);
            for (x, y, w, h, kind) in rects {
                let changed = CellRect { x0: x, y0: y, x1: x + w, y1: y + h };
                for iy in changed.y0..changed.y1 {
                    for ix in changed.x0..changed.x1 {
                        let cell = [Cell::Free, Cell::Occupied, Cell::Free, Cell::Unknown];
                        map.set(CellIndex::new(ix, iy), cell[usize::from(kind)]);
                    }
                }
                lattice.update(&map, changed);
            }
            let reach = (52.0 * fine / 0.25) as i32;
            for j in -reach..reach {
                for i in -reach..reach {
                    let got = lattice.cells().get(CellIndex::new(i, j));
                    prop_assert_eq!(got, literal(&map, i, j, 0.25), "{} {}", i, j);
                }
            }
        }
    }

    #[test]
    fn cells_larger_than_the_lattice_colour_all_lattice_cells_whose_centre_they_hold() {
        let mut map = Grid::new(0.5);
        map.set(CellIndex::new(1, -1), Cell::Occupied);
        let mut lattice = Lattice::new(0.25);
        lattice.update(&map, map.bounds());
        for (i, j, cell) in [
            (1, -1, Cell::Unknown),
            (2, -1, Cell::Occupied),
            (3, -2, Cell::Occupied),
            (4, -1, Cell::Unknown),
            (2, 0, Cell::Unknown),
        ] {
            assert_eq!(lattice.cells().get(CellIndex::new(i, j)), cell, "{i} {j}");
        }
    }

    fn crop(known: &[(usize, usize, Cell)]) -> Crop {
        let mut crop = Crop::default();
        for (column, row, cell) in known {
            crop.cells[row * CROP_CELLS + column] = *cell;
        }
        crop
    }

    #[test]
    fn the_cars_cell_lies_in_the_middle_of_the_crop() {
        let mut map = Grid::new(0.1);
        let car = Point::new(-3.1, 7.6);
        map.set(map.cell_at(car), Cell::Occupied);
        let mut lattice = Lattice::new(0.25);
        lattice.update(&map, map.bounds());
        let mut cut = Crop::default();
        lattice.crop(car, &mut cut);
        let occupied: Vec<usize> =
            (0..cut.cells.len()).filter(|i| cut.cells[*i] == Cell::Occupied).collect();
        assert_eq!(occupied, [CROP_CENTRE * CROP_CELLS + CROP_CENTRE]);
        assert_eq!(cut.car, CellIndex::new(-13, 30));
        assert_eq!(cut.origin(), Point::new(-3.25, 7.5));
        assert_eq!(cut.centre(CROP_CENTRE, CROP_CENTRE), [0.125, 0.125]);
        assert_eq!(cut.centre(0, 103), [-12.875, 12.875]);
    }

    #[test]
    fn a_crop_reaches_beyond_the_map_on_every_side() {
        let mut map = Grid::new(0.25);
        map.set(CellIndex::new(0, 0), Cell::Free);
        let mut lattice = Lattice::new(0.25);
        lattice.update(&map, map.bounds());
        let mut cut = Crop::default();
        for (x, y) in [(-12, -12), (-12, 70), (70, 70), (70, -12), (500, 0), (0, -500)] {
            let car = Point::new(f64::from(x) * 0.25 + 0.1, f64::from(y) * 0.25 + 0.1);
            lattice.crop(car, &mut cut);
            let free = cut.cells.iter().filter(|c| **c == Cell::Free).count();
            let seen = [x, y].iter().all(|v| (0 - v + 52) >= 0 && (0 - v + 52) < 104);
            assert_eq!(free, usize::from(seen), "{x} {y}");
        }
    }

    #[test]
    fn the_context_holds_walls_and_frontier_or_everything_observed() {
        let mut known = vec![(54, 50, Cell::Occupied)];
        for row in 49..52 {
            for column in 50..53 {
                known.push((column, row, Cell::Free));
            }
        }
        known.push((53, 50, Cell::Free));
        let crop = crop(&known);
        let (mut all, mut some) = (Vec::new(), Vec::new());
        crop.context(ContextSelection::All, &mut all);
        crop.context(ContextSelection::WallsAndFrontier, &mut some);
        assert_eq!((all.len(), some.len()), (11, 9));
        // Inside: the middle of the block, and the cell between it and the one before the wall.
        let inside = [crop.centre(51, 50), crop.centre(52, 50)];
        assert!(some.iter().all(|[x, y, _]| !inside.contains(&[*x, *y])));
        let [x, y] = crop.centre(54, 50);
        assert!(some.contains(&[x, y, 1.0]));
        assert_eq!(some.iter().filter(|c| c[2] == 0.0).count(), 8);
    }

    #[test]
    fn frontier_pieces_are_told_apart_and_small_ones_left_out() {
        let mut known = Vec::new();
        for column in 40..47 {
            known.push((column, 52, Cell::Free));
        }
        for row in 60..63 {
            known.push((60, row, Cell::Free));
        }
        known.push((10, 10, Cell::Free));
        let crop = crop(&known);
        assert_eq!(crop.frontier_centres(3), [[43, 52], [60, 61]]);
        assert_eq!(crop.frontier_centres(1).len(), 3);
    }
}
