//! Whether the disc that follows a path stays clear of cells, exactly.
//!
//! A disc of radius `r` swept along a segment touches a square exactly if the distance from the
//! segment to the square is below `r`. The path between two samples is no segment but the cubic of
//! [`Trajectory::at_time`](super::super::Trajectory::at_time); it lies within [`bulge_m`] of its
//! chord, which is added to the radius. Distances to squares, not to cell centres, and no distance
//! field: interpolated fields overestimate.

use crate::frames::{Point, heading_vector};
use crate::map::{Cell, CellIndex, CellRect, Grid};
use crate::plan::PathPoint;

/// Which cells a swept disc must not touch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Surfaces {
    /// Everything that has not been seen to be free.
    Unseen,
    /// All cells that do not count as free, with what has been seen of them.
    OccupiedAndUnknown,
    /// Only cells in which a beam has ended; the unknown is hoped to be free.
    Occupied,
}

impl Surfaces {
    #[inline]
    fn hold(self, cell: Cell) -> bool {
        match self {
            Self::Unseen | Self::OccupiedAndUnknown => cell != Cell::Free,
            Self::Occupied => cell == Cell::Occupied,
        }
    }
}

/// A cell that a swept disc touches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Contact {
    pub cell: CellIndex,
    pub state: Cell,
    /// Distance from the chord to the cell's square, metres.
    pub distance_m: f64,
}

/// Largest distance between the curve of an edge and its chord: a cubic with end tangents of length
/// `ds` leaves its chord by at most a quarter of the larger lateral tangent component. On an arc
/// this is the sagitta `kappa ds^2 / 8`. Infinite where a number is not finite.
pub(super) fn bulge_m(a: &PathPoint, b: &PathPoint) -> f64 {
    let chord = b.position - a.position;
    let length = chord.norm();
    let ds = (b.s_m - a.s_m).abs();
    if length <= 1e-9 {
        return 0.25 * ds;
    }
    let lateral = |heading: f64| {
        let t = heading_vector(heading);
        (t.x * chord.y - t.y * chord.x).abs() / length
    };
    let bulge = 0.25 * ds * lateral(a.heading_rad).max(lateral(b.heading_rad));
    if bulge.is_finite() { bulge } else { f64::INFINITY }
}

/// A cell that the disc touches while its centre runs along the curve from `a` to `b`, if any.
pub(super) fn edge_contact(
    grid: &Grid,
    a: &PathPoint,
    b: &PathPoint,
    radius_m: f64,
    surfaces: Surfaces,
) -> Option<Contact> {
    contact(grid, a.position, b.position, radius_m + bulge_m(a, b), surfaces)
}

/// A cell to which the segment from `a` to `b` is closer than `reach_m`, if any: the first one in
/// row order. What is not finite is in contact with the cell it would lie in.
pub(super) fn contact(
    grid: &Grid,
    a: Point,
    b: Point,
    reach_m: f64,
    surfaces: Surfaces,
) -> Option<Contact> {
    let finite = a.coords.iter().chain(b.coords.iter()).all(|v| v.is_finite());
    if !finite || !reach_m.is_finite() {
        let cell = grid.cell_at(a);
        return Some(Contact { cell, state: grid.get(cell), distance_m: f64::NAN });
    }
    let res = grid.resolution_m();
    let bounds = grid.bounds();
    if surfaces != Surfaces::Occupied
        && let Some(outside) = contact_with_outside(grid, a, b, reach_m)
    {
        return Some(outside);
    }
    // Column and row of a coordinate, kept inside the bounds before it becomes a whole number.
    let index = |v: f64, low: i32, high: i32| {
        (v / res).floor().clamp(f64::from(low) - 1.0, f64::from(high)) as i32
    };
    let window = CellRect {
        x0: index(a.x.min(b.x) - reach_m, bounds.x0, bounds.x1),
        y0: index(a.y.min(b.y) - reach_m, bounds.y0, bounds.y1),
        x1: index(a.x.max(b.x) + reach_m, bounds.x0, bounds.x1) + 1,
        y1: index(a.y.max(b.y) + reach_m, bounds.y0, bounds.y1) + 1,
    }
    .intersection(&bounds);
    if window.is_empty() {
        return None;
    }
    let cells = grid.cells();
    for iy in window.y0..window.y1 {
        let start = grid.offset(CellIndex::new(window.x0, iy)).expect("the window is in bounds");
        let row = &cells[start..start + window.width()];
        for (ix, &state) in (window.x0..).zip(row) {
            if !surfaces.hold(state) {
                continue;
            }
            let distance_sq = distance_to_square_sq(a, b, ix, iy, res);
            if distance_sq < reach_m * reach_m {
                let cell = CellIndex::new(ix, iy);
                let mut blocked = grid.blocked_quarters(cell);
                let is_touched = |quarter: CellIndex| {
                    let (ix, iy) = (quarter.ix, quarter.iy);
                    distance_to_square_sq(a, b, ix, iy, 0.5 * res) < reach_m * reach_m
                };
                if surfaces == Surfaces::Unseen
                    && grid.seen_quarters(cell) != 0
                    && !blocked.any(is_touched)
                {
                    continue;
                }
                return Some(Contact { cell, state, distance_m: distance_sq.sqrt() });
            }
        }
    }
    None
}

/// Contact with what the grid does not store, all of it unknown. The stored cells are a rectangle,
/// so the distance from inside to the outside is least at an end of the segment.
fn contact_with_outside(grid: &Grid, a: Point, b: Point, reach_m: f64) -> Option<Contact> {
    let res = grid.resolution_m();
    let bounds = grid.bounds();
    let low = Point::new(f64::from(bounds.x0) * res, f64::from(bounds.y0) * res);
    let high = Point::new(f64::from(bounds.x1) * res, f64::from(bounds.y1) * res);
    for p in [a, b] {
        let (from_low, from_high) = (p - low, high - p);
        let distance = from_low.x.min(from_low.y).min(from_high.x).min(from_high.y);
        if distance >= reach_m {
            continue;
        }
        let mut cell = grid.cell_at(p);
        if distance == from_low.x {
            cell.ix = cell.ix.min(bounds.x0 - 1);
        } else if distance == from_high.x {
            cell.ix = cell.ix.max(bounds.x1);
        } else if distance == from_low.y {
            cell.iy = cell.iy.min(bounds.y0 - 1);
        } else {
            cell.iy = cell.iy.max(bounds.y1);
        }
        let distance_m = distance.max(0.0);
        return Some(Contact { cell, state: Cell::Unknown, distance_m });
    }
    None
}

/// Whether every stored cell around these positions is free, so far that no edge between them can
/// touch another: a quick look that spares the edges' own. Says no where it cannot tell.
pub(super) fn open_around<'a>(
    grid: &Grid,
    path: impl Iterator<Item = &'a PathPoint>,
    radius_m: f64,
) -> bool {
    let (mut low, mut high) = (Point::new(f64::MAX, f64::MAX), Point::new(f64::MIN, f64::MIN));
    let (mut before, mut longest) = (None::<f64>, 0.0_f64);
    let mut finite = radius_m.is_finite();
    for p in path {
        finite &= p.position.x.is_finite() && p.position.y.is_finite() && p.s_m.is_finite();
        low = Point::new(low.x.min(p.position.x), low.y.min(p.position.y));
        high = Point::new(high.x.max(p.position.x), high.y.max(p.position.y));
        longest = longest.max(before.map_or(0.0, |s| (p.s_m - s).abs()));
        before = Some(p.s_m);
    }
    if !finite || before.is_none() {
        return false;
    }
    // No curve bulges by more than a quarter of its edge's length (see `bulge_m`).
    let reach = radius_m + 0.25 * longest;
    let inverse = 1.0 / grid.resolution_m();
    let bounds = grid.bounds();
    let (x0, y0) = (((low.x - reach) * inverse).floor(), ((low.y - reach) * inverse).floor());
    let (x1, y1) = (((high.x + reach) * inverse).ceil(), ((high.y + reach) * inverse).ceil());
    let inside = x0 > f64::from(bounds.x0)
        && y0 > f64::from(bounds.y0)
        && x1 < f64::from(bounds.x1)
        && y1 < f64::from(bounds.y1);
    if !inside {
        return false;
    }
    let (x0, x1, y0, y1) = (x0 as i32, x1 as i32, y0 as i32, y1 as i32);
    let width = (x1 - x0) as usize;
    (y0..y1).all(|iy| {
        let start = grid.offset(CellIndex::new(x0, iy)).expect("the window is in bounds");
        let row = &grid.cells()[start..start + width];
        row.iter().fold(true, |free, c| free & (*c == Cell::Free))
    })
}

/// Squared distance from a segment to a cell's closed square. Two disjoint convex polygons are
/// closest at a corner of one of them.
fn distance_to_square_sq(a: Point, b: Point, ix: i32, iy: i32, res: f64) -> f64 {
    let (x0, y0) = (f64::from(ix) * res, f64::from(iy) * res);
    let (x1, y1) = (f64::from(ix + 1) * res, f64::from(iy + 1) * res);
    let to_square = |p: Point| {
        let (dx, dy) = (p.x - p.x.clamp(x0, x1), p.y - p.y.clamp(y0, y1));
        dx * dx + dy * dy
    };
    let mut least = to_square(a).min(to_square(b));
    if least == 0.0 {
        return 0.0;
    }
    let d = b - a;
    let length_sq = d.norm_squared();
    if length_sq == 0.0 {
        return least;
    }
    // On which side of the segment's line each corner lies tells whether the line cuts the square.
    let (mut left, mut right) = (false, false);
    for corner in [Point::new(x0, y0), Point::new(x1, y0), Point::new(x0, y1), Point::new(x1, y1)] {
        let c = corner - a;
        let side = d.x * c.y - d.y * c.x;
        left |= side >= 0.0;
        right |= side <= 0.0;
        let along = c.dot(&d);
        // Beyond the ends the ends' own distances count.
        if along > 0.0 && along < length_sq {
            least = least.min(side * side / length_sq);
        }
    }
    let overlaps =
        a.x.min(b.x) <= x1 && a.x.max(b.x) >= x0 && a.y.min(b.y) <= y1 && a.y.max(b.y) >= y0;
    // Separating axes of segment and square: the two of the square and the segment's normal.
    if left && right && overlaps { 0.0 } else { least }
}
