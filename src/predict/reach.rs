//! Which points lie within the prediction range of the frontier.

use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect, Grid};

/// Side of a block, metres; rounded to whole cells.
const BLOCK_M: f64 = 0.5;

/// The frontier (free cells beside unknown ones) on blocks of half a metre, and all blocks whose
/// centre is no farther from the centre of one of these than the range. So the range is kept to
/// within a block's diagonal, 0.71 m.
#[derive(Clone, Debug, Default)]
pub(super) struct Reach {
    range_m: f64,
    resolution_m: f64,
    /// Cells along the side of a block.
    side: i32,
    /// The blocks below, by column and row of blocks.
    bounds: CellRect,
    frontier: Vec<bool>,
    within: Vec<bool>,
}

impl Reach {
    pub(super) fn new(range_m: f64) -> Self {
        Self { range_m, ..Self::default() }
    }

    /// Takes in a grid of which only `changed` differs from the one before.
    pub(super) fn update(&mut self, grid: &Grid, changed: CellRect) {
        let side = (BLOCK_M / grid.resolution_m()).round().max(1.0) as i32;
        let block_m = f64::from(side) * grid.resolution_m();
        let range = self.range_m / block_m;
        let known = blocks(grid.bounds(), side);
        let bounds = if known.is_empty() { known } else { known.grown(range.ceil() as i32) };
        let mut changed = changed;
        if bounds != self.bounds || side != self.side || grid.resolution_m() != self.resolution_m {
            self.resolution_m = grid.resolution_m();
            self.side = side;
            self.bounds = bounds;
            self.frontier.clear();
            self.frontier.resize(bounds.width() * bounds.height(), false);
            changed = grid.bounds();
        }
        // A change also makes or ends the frontier of the cells beside it.
        let changed = changed.grown(1).intersection(&grid.bounds());
        let touched = blocks(changed, side);
        let mut differs = false;
        for by in touched.y0..touched.y1 {
            for bx in touched.x0..touched.x1 {
                let at = self.offset(bx, by).expect("blocks of the grid lie within its blocks");
                let now = holds_frontier(grid, CellIndex::new(bx * side, by * side), side);
                differs |= self.frontier[at] != now;
                self.frontier[at] = now;
            }
        }
        if differs || self.within.len() != self.frontier.len() {
            self.spread(range);
        }
    }

    fn spread(&mut self, range: f64) {
        self.within.clear();
        self.within.resize(self.frontier.len(), false);
        let reach = range.floor() as i32;
        let halves: Vec<i32> = (-reach..=reach)
            .map(|dy| (range * range - f64::from(dy * dy)).sqrt().floor() as i32)
            .collect();
        let width = self.bounds.width() as i32;
        let height = self.bounds.height() as i32;
        for (at, _) in self.frontier.iter().enumerate().filter(|(_, frontier)| **frontier) {
            let (x, y) = (at as i32 % width, at as i32 / width);
            for (half, dy) in halves.iter().zip(-reach..) {
                if (0..height).contains(&(y + dy)) {
                    let row = (y + dy) * width;
                    let (from, to) = ((x - half).max(0), (x + half + 1).min(width));
                    self.within[(row + from) as usize..(row + to) as usize].fill(true);
                }
            }
        }
    }

    /// Whether a point lies within the range of the frontier.
    pub(super) fn holds(&self, p: Point) -> bool {
        if self.side == 0 {
            return false;
        }
        let block_m = f64::from(self.side) * self.resolution_m;
        let block = |v: f64| (v / block_m).floor() as i32;
        self.offset(block(p.x), block(p.y)).is_some_and(|at| self.within[at])
    }

    /// Whether each point of a lattice of `side` by `side` points, row by row from the lowest one,
    /// lies within the range.
    pub(super) fn mark(&self, low: Point, step_m: f64, side: usize, out: &mut Vec<bool>) {
        out.clear();
        if self.side == 0 {
            out.resize(side * side, false);
            return;
        }
        let block_m = f64::from(self.side) * self.resolution_m;
        let blocks = |from: f64| -> Vec<i32> {
            (0..side).map(|k| ((from + k as f64 * step_m) / block_m).floor() as i32).collect()
        };
        let (columns, rows) = (blocks(low.x), blocks(low.y));
        for by in rows {
            let within = |bx: &i32| self.offset(*bx, by).is_some_and(|at| self.within[at]);
            out.extend(columns.iter().map(within));
        }
    }

    /// Whether a point of the rectangle between two corners may lie within the range.
    pub(super) fn touches(&self, low: Point, high: Point) -> bool {
        if self.side == 0 {
            return false;
        }
        let block_m = f64::from(self.side) * self.resolution_m;
        let block = |v: f64| (v / block_m).floor() as i32;
        let touched = CellRect {
            x0: block(low.x),
            y0: block(low.y),
            x1: block(high.x) + 1,
            y1: block(high.y) + 1,
        };
        let touched = touched.intersection(&self.bounds);
        (touched.y0..touched.y1).any(|by| {
            (touched.x0..touched.x1).any(|bx| self.offset(bx, by).is_some_and(|at| self.within[at]))
        })
    }

    fn offset(&self, bx: i32, by: i32) -> Option<usize> {
        let b = self.bounds;
        b.contains(CellIndex::new(bx, by))
            .then(|| (by - b.y0) as usize * b.width() + (bx - b.x0) as usize)
    }
}

/// The blocks that a rectangle of cells touches.
fn blocks(cells: CellRect, side: i32) -> CellRect {
    if cells.is_empty() {
        return CellRect::EMPTY;
    }
    let up = |v: i32| (v - 1).div_euclid(side) + 1;
    CellRect {
        x0: cells.x0.div_euclid(side),
        y0: cells.y0.div_euclid(side),
        x1: up(cells.x1),
        y1: up(cells.y1),
    }
}

fn holds_frontier(grid: &Grid, from: CellIndex, side: i32) -> bool {
    (from.iy..from.iy + side).any(|iy| {
        (from.ix..from.ix + side).any(|ix| {
            let unknown = |dx, dy| grid.get(CellIndex::new(ix + dx, iy + dy)) == Cell::Unknown;
            grid.get(CellIndex::new(ix, iy)) == Cell::Free
                && (unknown(1, 0) || unknown(-1, 0) || unknown(0, 1) || unknown(0, -1))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn true_distance(grid: &Grid, p: Point) -> f64 {
        let b = grid.bounds();
        let mut least = f64::INFINITY;
        for iy in b.y0..b.y1 {
            for ix in b.x0..b.x1 {
                if holds_frontier(grid, CellIndex::new(ix, iy), 1) {
                    least = least.min((grid.centre(CellIndex::new(ix, iy)) - p).norm());
                }
            }
        }
        least
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn the_range_holds_within_a_block_and_updates_equal_a_fresh_start(
            rects in prop::collection::vec((-60..60_i32, -60..60_i32, 1..25_i32, 1..25_i32, 0..3_u8), 1..6),
            probes in prop::collection::vec((-12.0..12.0, -12.0..12.0), 30),
        ) {
            let mut grid = Grid::new(0.1);
            let mut reach = Reach::new(3.0);
            for (x, y, w, h, kind) in rects {
                let changed = CellRect { x0: x, y0: y, x1: x + w, y1: y + h };
                for iy in changed.y0..changed.y1 {
                    for ix in changed.x0..changed.x1 {
                        let cell = [Cell::Free, Cell::Occupied, Cell::Free][usize::from(kind)];
                        grid.set(CellIndex::new(ix, iy), cell);
                    }
                }
                reach.update(&grid, changed);
                let mut fresh = Reach::new(3.0);
                fresh.update(&grid, grid.bounds());
                prop_assert_eq!(&reach.within, &fresh.within);
            }
            for (x, y) in probes {
                let p = Point::new(x, y);
                let distance = true_distance(&grid, p);
                // Half a diagonal at either end, and the cell within the block.
                if distance < 3.0 - 0.71 {
                    prop_assert!(reach.holds(p), "{distance}");
                }
                if distance > 3.0 + 0.71 {
                    prop_assert!(!reach.holds(p), "{distance}");
                }
                for (w, h) in [(0.0, 0.0), (0.8, 0.8), (0.1, 1.7)] {
                    let (low, high) = (Point::new(p.x - w, p.y - h), Point::new(p.x + h, p.y + w));
                    prop_assert!(reach.touches(low, high) || !reach.holds(p));
                }
            }
        }
    }

    #[test]
    fn before_anything_is_known_nothing_is_in_range() {
        let mut reach = Reach::new(5.0);
        assert!(!reach.holds(Point::new(0.0, 0.0)));
        reach.update(&Grid::new(0.1), CellRect::EMPTY);
        assert!(!reach.holds(Point::new(0.0, 0.0)));
    }
}
