//! Frontiers: where known free space borders on unknown space that the car could drive into.
//!
//! A frontier cell is free, touches an unknown cell with one of its four sides, and lies in the
//! part of free space that the car's disc can reach. Frontier cells that touch (also diagonally)
//! form one frontier. Many of them lead nowhere and no beam will ever clear them: specks that
//! grazing beams leave between free space and a wall, gaps between hits on a far wall, cells that a
//! slanted wall cuts through. They are told from real ones by trying the step: from one of the
//! frontier's cells the disc's centre must be able to move into an unknown neighbour with no
//! occupied cell under the disc.

use super::{Blocking, Cell, CellIndex, DistanceField, Grid};
use crate::frames::{Point, Vector};

/// One connected piece of the border between free and unknown space.
#[derive(Clone, Debug, PartialEq)]
pub struct Frontier {
    /// Its cells, row by row.
    pub cells: Vec<CellIndex>,
    /// Those of them from which the disc can cross into unknown space.
    pub crossings: Vec<CellIndex>,
    /// Mean of the cells' centres, map frame, metres. May lie outside free space.
    pub centroid: Point,
    /// The cell nearest to the centroid from which the disc can cross into unknown space.
    pub representative: CellIndex,
}

/// Finds frontiers; keeps its scratch memory from call to call.
#[derive(Clone, Debug, Default)]
pub struct FrontierFinder {
    marks: Vec<u8>,
    stack: Vec<CellIndex>,
}

/// The disc's centre can get here through free space.
const REACHED: u8 = 1;
/// A frontier cell.
const BORDER: u8 = 2;
/// A frontier cell that belongs to a cluster already.
const CLUSTERED: u8 = 4;

const SIDES: [(i32, i32); 4] = [(1, 0), (0, 1), (-1, 0), (0, -1)];
const AROUND: [(i32, i32); 8] =
    [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)];

/// The frontiers of a grid; see [`FrontierFinder::find`].
pub fn frontiers(
    grid: &Grid,
    occupied: &DistanceField,
    start: CellIndex,
    radius_m: f64,
) -> Vec<Frontier> {
    FrontierFinder::default().find(grid, occupied, start, radius_m)
}

impl FrontierFinder {
    /// The frontiers that a disc of `radius_m` can reach from `start` through free space and cross,
    /// in the order of their first cells, row by row.
    ///
    /// `occupied` is the grid's field of distances to occupied cells, with a cap above the radius
    /// and half a cell. The disc may be centred on a cell whose distance in that field is at least
    /// the radius and half a cell: exact where a wall runs along the cells, up to 0.21 cells
    /// generous at corners. Since only cell centres are tried, a passage may have to be up to one
    /// cell wider than the disc. Around the start, where the car stands, none of this is asked.
    ///
    /// # Panics
    /// If the field is of another kind or not up to date, or its cap too small.
    pub fn find(
        &mut self,
        grid: &Grid,
        occupied: &DistanceField,
        start: CellIndex,
        radius_m: f64,
    ) -> Vec<Frontier> {
        let resolution = grid.resolution_m();
        let clear_m = radius_m + 0.5 * resolution;
        assert_eq!(occupied.blocking(), Blocking::Occupied, "the field's kind");
        assert_eq!(occupied.bounds(), grid.bounds(), "the field is not up to date with the grid");
        assert!(occupied.cap_m() > clear_m, "field capped at {} m", occupied.cap_m());
        let clear_m = (clear_m - 1e-6) as f32;
        let clear = |c: CellIndex| occupied.distance_m(c) >= clear_m;

        self.marks.clear();
        self.marks.resize(grid.cells().len(), 0);
        self.reach(grid, start, radius_m, clear);
        let found = self.mark_border(grid, radius_m);
        let mut result = Vec::new();
        for c in found {
            let offset = grid.offset(c).expect("a frontier cell is stored");
            if self.marks[offset] & CLUSTERED != 0 {
                continue;
            }
            let cells = self.cluster(grid, c);
            result.extend(self.judge(grid, cells, radius_m, clear));
        }
        result
    }

    /// Marks the free cells that the disc's centre can reach from the start.
    fn reach(
        &mut self,
        grid: &Grid,
        start: CellIndex,
        radius_m: f64,
        clear: impl Fn(CellIndex) -> bool,
    ) {
        let near = (radius_m / grid.resolution_m() + 1.0).powi(2);
        let passable = |c: CellIndex| {
            let (dx, dy) = (f64::from(c.ix - start.ix), f64::from(c.iy - start.iy));
            clear(c) || dx * dx + dy * dy <= near
        };
        self.stack.clear();
        if let Some(offset) = grid.offset(start)
            && grid.cells()[offset] == Cell::Free
        {
            self.marks[offset] |= REACHED;
            self.stack.push(start);
        }
        while let Some(c) = self.stack.pop() {
            for (dx, dy) in SIDES {
                let next = CellIndex::new(c.ix + dx, c.iy + dy);
                let Some(offset) = grid.offset(next) else { continue };
                let fresh = self.marks[offset] & REACHED == 0;
                if fresh && grid.cells()[offset] == Cell::Free && passable(next) {
                    self.marks[offset] |= REACHED;
                    self.stack.push(next);
                }
            }
        }
    }

    /// Marks and lists the free cells beside unknown ones that a disc with a reached centre covers
    /// (or touches, to a cell).
    fn mark_border(&mut self, grid: &Grid, radius_m: f64) -> Vec<CellIndex> {
        let reach = radius_m / grid.resolution_m() + 1.0;
        let span = reach.floor() as i32;
        let bounds = grid.bounds();
        let mut found = Vec::new();
        for iy in bounds.y0..bounds.y1 {
            let row = grid.row(iy).expect("a row inside the bounds");
            for (ix, _) in (bounds.x0..).zip(row).filter(|(_, cell)| **cell == Cell::Free) {
                let c = CellIndex::new(ix, iy);
                let unknown = |(dx, dy): &(i32, i32)| {
                    grid.get(CellIndex::new(ix + dx, iy + dy)) == Cell::Unknown
                };
                if !SIDES.iter().any(unknown) {
                    continue;
                }
                let covered = (-span..=span).any(|dy| {
                    (-span..=span).any(|dx| {
                        f64::from(dx * dx + dy * dy) <= reach * reach
                            && grid
                                .offset(CellIndex::new(ix + dx, iy + dy))
                                .is_some_and(|offset| self.marks[offset] & REACHED != 0)
                    })
                });
                if covered {
                    self.marks[grid.offset(c).expect("inside the bounds")] |= BORDER;
                    found.push(c);
                }
            }
        }
        found
    }

    /// Collects the frontier cells connected to one of them, row by row.
    fn cluster(&mut self, grid: &Grid, first: CellIndex) -> Vec<CellIndex> {
        let mut cells = Vec::new();
        self.stack.clear();
        self.stack.push(first);
        self.marks[grid.offset(first).expect("a frontier cell is stored")] |= CLUSTERED;
        while let Some(c) = self.stack.pop() {
            cells.push(c);
            for (dx, dy) in AROUND {
                let next = CellIndex::new(c.ix + dx, c.iy + dy);
                let Some(offset) = grid.offset(next) else { continue };
                if self.marks[offset] & (BORDER | CLUSTERED) == BORDER {
                    self.marks[offset] |= CLUSTERED;
                    self.stack.push(next);
                }
            }
        }
        cells.sort_unstable_by_key(|c| (c.iy, c.ix));
        cells
    }

    /// The frontier that a cluster makes, if the disc could cross it.
    fn judge(
        &self,
        grid: &Grid,
        cells: Vec<CellIndex>,
        radius_m: f64,
        clear: impl Fn(CellIndex) -> bool,
    ) -> Option<Frontier> {
        let low = cells.iter().fold((i32::MAX, i32::MAX), |m, c| (m.0.min(c.ix), m.1.min(c.iy)));
        let high = cells.iter().fold((i32::MIN, i32::MIN), |m, c| (m.0.max(c.ix), m.1.max(c.iy)));
        // A cell of slack: the outermost cells of an opening stay unknown beside slanted walls.
        let across = f64::from(high.0 - low.0 + 2).hypot(f64::from(high.1 - low.1 + 2));
        if across * grid.resolution_m() < 2.0 * radius_m {
            return None;
        }
        let sum = cells.iter().fold(Vector::zeros(), |sum, c| sum + grid.centre(*c).coords);
        let centroid = Point::from(sum / cells.len() as f64);
        let reached =
            |c: &CellIndex| grid.offset(*c).is_some_and(|offset| self.marks[offset] & REACHED != 0);
        let crosses = |c: &CellIndex| {
            SIDES.iter().any(|(dx, dy)| {
                let next = CellIndex::new(c.ix + dx, c.iy + dy);
                grid.get(next) == Cell::Unknown && clear(next)
            })
        };
        let away = |c: &CellIndex| (grid.centre(*c) - centroid).norm_squared();
        let crossings: Vec<CellIndex> =
            cells.iter().filter(|c| reached(c) && crosses(c)).copied().collect();
        let representative =
            crossings.iter().min_by(|a, b| away(a).total_cmp(&away(b))).copied()?;
        Some(Frontier { cells, crossings, centroid, representative })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::CellRect;

    const RADIUS_M: f64 = 0.2;

    fn fill(grid: &mut Grid, rect: CellRect, cell: Cell) {
        for iy in rect.y0..rect.y1 {
            for ix in rect.x0..rect.x1 {
                grid.set(CellIndex::new(ix, iy), cell);
            }
        }
    }

    const fn rect(x0: i32, y0: i32, x1: i32, y1: i32) -> CellRect {
        CellRect { x0, y0, x1, y1 }
    }

    /// A room of 40 by 30 cells with walls of one cell around it, everything outside unknown.
    fn room() -> Grid {
        let mut grid = Grid::new(0.1);
        fill(&mut grid, rect(0, 0, 42, 32), Cell::Occupied);
        fill(&mut grid, rect(1, 1, 41, 31), Cell::Free);
        grid
    }

    fn find(grid: &Grid) -> Vec<Frontier> {
        let mut field = DistanceField::new(Blocking::Occupied, 1.5);
        field.update(grid, CellRect::EMPTY);
        frontiers(grid, &field, CellIndex::new(20, 15), RADIUS_M)
    }

    #[test]
    fn a_closed_room_has_no_frontier() {
        assert_eq!(find(&room()), vec![]);
    }

    #[test]
    fn a_doorway_is_one_frontier_with_its_middle_as_representative() {
        let mut grid = room();
        fill(&mut grid, rect(41, 10, 42, 21), Cell::Free);
        let found = find(&grid);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].cells.len(), 11);
        assert_eq!(found[0].representative, CellIndex::new(41, 15));
        assert!((found[0].centroid - Point::new(4.15, 1.55)).norm() < 1e-9);
    }

    #[test]
    fn holes_too_narrow_for_the_car_are_no_frontiers() {
        // The disc of 0.4 m, centred on a cell, needs five cells.
        for width in 1..=6 {
            for cell in [Cell::Unknown, Cell::Free] {
                let mut grid = room();
                fill(&mut grid, rect(41, 10, 42, 10 + width), cell);
                assert_eq!(find(&grid).len(), usize::from(width >= 5), "{width} {cell:?}");
            }
        }
    }

    #[test]
    fn holes_in_a_grazed_wall_are_no_frontiers_though_there_are_many() {
        let mut grid = room();
        for ix in (2..40).step_by(3) {
            fill(&mut grid, rect(ix, 31, ix + 2, 32), Cell::Unknown);
        }
        // Floor along the wall that was never proven free.
        fill(&mut grid, rect(5, 30, 30, 31), Cell::Unknown);
        assert_eq!(find(&grid), vec![]);
    }

    #[test]
    fn an_unseen_corner_of_the_room_is_a_frontier() {
        let mut grid = room();
        fill(&mut grid, rect(28, 1, 41, 14), Cell::Unknown);
        let found = find(&grid);
        assert_eq!(found.len(), 1);
        assert!(found[0].cells.contains(&CellIndex::new(27, 7)));
        assert!(found[0].cells.contains(&CellIndex::new(33, 14)));
    }

    #[test]
    fn free_space_that_the_car_cannot_get_to_has_no_frontier() {
        let mut grid = room();
        // A second room, open to the unknown on its far side, seen through a slit of two cells.
        fill(&mut grid, rect(42, 1, 60, 31), Cell::Free);
        fill(&mut grid, rect(41, 15, 42, 17), Cell::Free);
        fill(&mut grid, rect(42, 0, 60, 1), Cell::Occupied);
        fill(&mut grid, rect(42, 31, 60, 32), Cell::Occupied);
        assert_eq!(find(&grid), vec![]);
        fill(&mut grid, rect(41, 14, 42, 19), Cell::Free);
        let found = find(&grid);
        assert_eq!(found.len(), 1);
        assert!(found[0].cells.iter().all(|c| c.ix == 59));
    }

    #[test]
    fn two_openings_come_in_row_order_and_touch_no_scratch_of_the_last_call() {
        let mut grid = room();
        fill(&mut grid, rect(10, 31, 20, 32), Cell::Unknown);
        fill(&mut grid, rect(25, 0, 35, 1), Cell::Unknown);
        let mut field = DistanceField::new(Blocking::Occupied, 1.5);
        field.update(&grid, CellRect::EMPTY);
        let mut finder = FrontierFinder::default();
        let first = finder.find(&grid, &field, CellIndex::new(20, 15), RADIUS_M);
        assert_eq!(first.len(), 2);
        assert!(first[0].cells.iter().all(|c| c.iy == 1));
        assert!(first[1].cells.iter().all(|c| c.iy == 30));
        assert_eq!(finder.find(&grid, &field, CellIndex::new(20, 15), RADIUS_M), first);
    }

    #[test]
    fn a_start_outside_free_space_finds_nothing() {
        let grid = room();
        let mut field = DistanceField::new(Blocking::Occupied, 1.5);
        field.update(&grid, CellRect::EMPTY);
        for start in [CellIndex::new(0, 0), CellIndex::new(-4000, 7)] {
            assert_eq!(frontiers(&grid, &field, start, RADIUS_M), vec![]);
        }
    }

    #[test]
    fn a_start_close_to_a_wall_still_finds_the_way_out() {
        let mut grid = room();
        fill(&mut grid, rect(41, 10, 42, 21), Cell::Free);
        let mut field = DistanceField::new(Blocking::Occupied, 1.5);
        field.update(&grid, CellRect::EMPTY);
        assert_eq!(frontiers(&grid, &field, CellIndex::new(1, 15), RADIUS_M).len(), 1);
    }
}
