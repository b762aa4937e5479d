//! A fence as occupied cells: whatever keeps the car off walls keeps it off fences.
//!
//! Only plans see these cells. What is predicted, and what is drawn on a map, knows no fence.

use std::sync::Arc;

use crate::fence::{Fence, crossing_x, edges};
use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect, Grid};

/// No occupied cell lies nearer to the bounds of a grid than this, metres: what
/// [`DistanceField::distance_m`](crate::map::DistanceField::distance_m) asks for.
const BORDER_M: f64 = 2.0;
/// Around the map and the goal a fence is looked at this far, metres.
const ROUND_M: f64 = 1.0;
/// A goal so far off that the fence up to there would be more cells than this is not looked at.
const CELLS_MAX: i64 = 2_000_000;

/// Paints fences onto grids. Keeps what it made of the newest fence.
#[derive(Clone, Debug, Default)]
pub struct FencePainter {
    fence: Arc<Fence>,
    resolution_m: f64,
    bounds: CellRect,
    mask: Vec<bool>,
}

impl FencePainter {
    /// The grid with every cell occupied that is not wholly where the fence allows the car to be, as
    /// far as the grid and a little around it and around the goal. Says whether other cells are
    /// fenced off than the last time. `None` without a fence.
    pub fn paint(
        &mut self,
        grid: &Grid,
        fence: &Arc<Fence>,
        goal: Option<Point>,
    ) -> (Option<Grid>, bool) {
        if fence.is_empty() {
            let changed = !self.fence.is_empty();
            *self = Self::default();
            return (None, changed);
        }
        let region = region(grid, goal);
        let same = Arc::ptr_eq(&self.fence, fence) || self.fence == *fence;
        let changed = !same || self.bounds != region || self.resolution_m != grid.resolution_m();
        if changed {
            self.fence = Arc::clone(fence);
            self.resolution_m = grid.resolution_m();
            self.bounds = region;
            self.mask = forbidden(fence, region, grid);
        }
        let mut painted = grid.clone();
        let border = (BORDER_M / grid.resolution_m()).ceil() as i32;
        painted.grow_to(region.grown(border));
        let width = region.width();
        for (row, iy) in self.mask.chunks_exact(width.max(1)).zip(region.y0..) {
            for (taken, ix) in row.iter().zip(region.x0..) {
                if *taken {
                    painted.set(CellIndex::new(ix, iy), Cell::Occupied);
                }
            }
        }
        (Some(painted), changed)
    }
}

/// The cells that are looked at.
fn region(grid: &Grid, goal: Option<Point>) -> CellRect {
    let round = (ROUND_M / grid.resolution_m()).ceil() as i32;
    let single = |c: CellIndex| CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 };
    let with_goal = goal.map(|goal| grid.bounds().union(&single(grid.cell_at(goal)).grown(round)));
    with_goal
        .filter(|r| i64::from(r.x1 - r.x0) * i64::from(r.y1 - r.y0) <= CELLS_MAX)
        .unwrap_or_else(|| grid.bounds())
}

/// Which cells of a rectangle are not wholly allowed, row by row.
fn forbidden(fence: &Fence, region: CellRect, grid: &Grid) -> Vec<bool> {
    let count = region.width() * region.height();
    let mut taken = vec![!fence.inside.is_empty(); count];
    let mut inside = vec![false; count];
    for group in &fence.inside {
        let mut all = vec![true; count];
        for polygon in group {
            inside.fill(false);
            fill(polygon, region, grid, &mut inside);
            all.iter_mut().zip(&inside).for_each(|(all, one)| *all &= one);
        }
        taken.iter_mut().zip(&all).for_each(|(taken, all)| *taken &= !all);
    }
    // Where two groups overlap, an edge of one of them is no edge of what is allowed.
    let centres = taken.clone();
    for polygon in fence.inside.iter().flatten() {
        outline(polygon, region, grid, |at| {
            taken[at] = taken[at] || fence.inside.len() == 1 || is_beside(&centres, region, at);
        });
    }
    for polygon in &fence.outside {
        fill(polygon, region, grid, &mut taken);
        outline(polygon, region, grid, |at| taken[at] = true);
    }
    taken
}

/// Whether a cell or one of its eight neighbours is marked.
fn is_beside(marks: &[bool], region: CellRect, at: usize) -> bool {
    let (width, height) = (region.width(), region.height());
    let (x, y) = (at % width, at / width);
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    (y.saturating_sub(1)..(y + 2).min(height))
        .any(|y| columns.clone().any(|x| marks[y * width + x]))
}

/// Marks the cells whose centres lie inside a polygon.
fn fill(polygon: &[Point], region: CellRect, grid: &Grid, marks: &mut [bool]) {
    let (width, resolution_m) = (region.width(), grid.resolution_m());
    let mut crossings = Vec::new();
    for (row, iy) in marks.chunks_exact_mut(width.max(1)).zip(region.y0..) {
        let y = (f64::from(iy) + 0.5) * resolution_m;
        crossings.clear();
        crossings.extend(edges(polygon).filter_map(|edge| crossing_x(&edge, y)));
        crossings.sort_by(f64::total_cmp);
        for pair in crossings.chunks_exact(2) {
            // The first centre that is not left of each crossing.
            let column = |x: f64| {
                let first = (x / resolution_m - 0.5).ceil() - f64::from(region.x0);
                first.clamp(0.0, width as f64) as usize
            };
            row[column(pair[0])..column(pair[1])].fill(true);
        }
    }
}

/// Calls back for every cell that an edge of a polygon passes through.
fn outline(polygon: &[Point], region: CellRect, grid: &Grid, mut mark: impl FnMut(usize)) {
    let (width, resolution_m) = (region.width(), grid.resolution_m());
    let cell = |v: f64, low: i32, high: i32| {
        (v / resolution_m).floor().clamp(f64::from(low), f64::from(high)) as i32
    };
    for [a, b] in edges(polygon) {
        let (low, high) = if a.y <= b.y { (a, b) } else { (b, a) };
        for iy in cell(low.y, region.y0, region.y1)..=cell(high.y, region.y0 - 1, region.y1 - 1) {
            // The part of the edge inside this row of cells.
            let (bottom, top) = (f64::from(iy) * resolution_m, f64::from(iy + 1) * resolution_m);
            let x_at = |y: f64| {
                let share = if high.y > low.y { (y - low.y) / (high.y - low.y) } else { 0.0 };
                low.x + share.clamp(0.0, 1.0) * (high.x - low.x)
            };
            let (from, to) = if high.y > low.y { (x_at(bottom), x_at(top)) } else { (a.x, b.x) };
            let (left, right) = (from.min(to), from.max(to));
            let first = cell(left, region.x0, region.x1);
            let last = cell(right, region.x0 - 1, region.x1 - 1);
            for ix in first..=last {
                mark((iy - region.y0) as usize * width + (ix - region.x0) as usize);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn grid() -> Grid {
        let mut grid = Grid::new(0.1);
        for ix in -30..30 {
            for iy in -30..30 {
                grid.set(CellIndex::new(ix, iy), Cell::Free);
            }
        }
        grid
    }

    fn square(x: f64, y: f64, side: f64) -> Vec<Point> {
        [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)]
            .map(|(dx, dy)| Point::new(x + dx, y + dy))
            .to_vec()
    }

    fn painted(fence: Fence) -> Grid {
        FencePainter::default().paint(&grid(), &Arc::new(fence), None).0.unwrap()
    }

    #[test]
    fn what_a_fence_forbids_is_occupied_and_nothing_else() {
        let fence = Fence { inside: Vec::new(), outside: vec![square(0.5, 0.5, 1.0)] };
        let painted = painted(fence);
        for (x, y, wanted) in [
            (1.0, 1.0, Cell::Occupied),
            (0.55, 0.55, Cell::Occupied),
            (0.35, 1.0, Cell::Free),
            (1.75, 1.0, Cell::Free),
            (-1.0, -1.0, Cell::Free),
        ] {
            assert_eq!(painted.get(painted.cell_at(Point::new(x, y))), wanted, "({x}, {y})");
        }
    }

    #[test]
    fn outside_an_inclusion_everything_is_occupied_also_what_is_unknown() {
        let fence = Fence { inside: vec![vec![square(-1.0, -1.0, 2.0)]], outside: Vec::new() };
        let painted = painted(fence);
        for (x, y, wanted) in [
            (0.0, 0.0, Cell::Free),
            (1.5, 0.0, Cell::Occupied),
            (0.0, -2.5, Cell::Occupied),
            (3.05, 3.05, Cell::Occupied),
        ] {
            assert_eq!(painted.get(painted.cell_at(Point::new(x, y))), wanted, "({x}, {y})");
        }
    }

    #[test]
    fn groups_that_overlap_are_one_place() {
        let left = square(-2.0, -1.0, 2.05);
        let right = square(-0.25, -1.0, 2.0);
        let fence = Fence { inside: vec![vec![left], vec![right]], outside: Vec::new() };
        let painted = painted(fence);
        for i in -15..15 {
            let p = Point::new(f64::from(i) * 0.1 + 0.05, 0.0);
            assert_eq!(painted.get(painted.cell_at(p)), Cell::Free, "{}", p.x);
        }
    }

    #[test]
    fn only_what_is_new_is_told_as_a_change() {
        let (mut painter, mut grid) = (FencePainter::default(), grid());
        let none = Arc::new(Fence::default());
        let fence = Arc::new(Fence { inside: Vec::new(), outside: vec![square(0.0, 0.0, 1.0)] });
        assert!(!painter.paint(&grid, &none, None).1);
        assert!(painter.paint(&grid, &fence, None).1);
        assert!(!painter.paint(&grid, &fence, None).1);
        grid.set(CellIndex::new(200, 0), Cell::Free);
        assert!(painter.paint(&grid, &fence, None).1, "the map has grown");
        assert!(painter.paint(&grid, &none, None).1);
        assert!(!painter.paint(&grid, &none, None).1);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        /// Every point that a fence forbids lies in an occupied cell.
        #[test]
        fn a_forbidden_point_never_lies_in_a_cell_that_is_free(
            corners in prop::collection::vec((-2.5f64..2.5, -2.5f64..2.5), 3..8),
            include in any::<bool>(),
            points in prop::collection::vec((-2.9f64..2.9, -2.9f64..2.9), 200),
        ) {
            let polygon: Vec<Point> = corners.iter().map(|(x, y)| Point::new(*x, *y)).collect();
            let fence = if include {
                Fence { inside: vec![vec![polygon]], outside: Vec::new() }
            } else {
                Fence { inside: Vec::new(), outside: vec![polygon] }
            };
            let painted = painted(fence.clone());
            for (x, y) in points {
                let p = Point::new(x, y);
                if !fence.allows(p) {
                    prop_assert_eq!(painted.get(painted.cell_at(p)), Cell::Occupied);
                }
            }
        }
    }
}
