//! Exact distance from points and segments to the squares of blocking cells.
//!
//! A distance transform knows distances between cell centres only. The certificate and the bubbles
//! need the distance from an arbitrary point to the nearest blocking square itself (zero inside).
//! Without a distance field the scan goes row by row outwards, with one column by column; either
//! stops at the nearest square found so far.

use super::{Blocking, Cell, CellIndex, DistanceField, Grid, floor_to_index};
use crate::frames::{Point, Vector};

/// Distance in metres from a point of the map frame to the nearest blocking cell's square, zero
/// inside, at most `cap_m`. Cells outside the grid are unknown.
pub fn clearance_m(grid: &Grid, p: Point, blocking: Blocking, cap_m: f64) -> f64 {
    Search { grid, blocking }.nearest_to_point(p, 0.0, cap_m)
}

/// Distance in metres from the segment `a` to `b` (map frame) to the nearest blocking cell's
/// square, zero where it enters one, at most `cap_m`. Cells outside the grid are unknown.
pub fn segment_clearance_m(grid: &Grid, a: Point, b: Point, blocking: Blocking, cap_m: f64) -> f64 {
    Search { grid, blocking }.nearest_to_segment(a, b, cap_m)
}

/// Exact clearance made fast by a distance field of the same grid.
///
/// With the field's distance `d` at the cell that holds the point, `o` the point's distance from
/// that cell's centre and `h` the side of a cell, the distance to the nearest blocking square lies
/// in `[d - o - h/sqrt(2), d + o - h/2]`; where `d` is capped only the lower bound holds. The exact
/// search looks only at squares in that ring.
#[derive(Clone, Copy, Debug)]
pub struct Clearance<'a> {
    grid: &'a Grid,
    field: &'a DistanceField,
}

impl<'a> Clearance<'a> {
    /// Joins a grid and the field that is up to date with it.
    ///
    /// # Panics
    /// If the field covers other bounds than the grid.
    pub fn new(grid: &'a Grid, field: &'a DistanceField) -> Self {
        assert_eq!(grid.bounds(), field.bounds(), "the field is not up to date with the grid");
        Self { grid, field }
    }

    /// Exact distance in metres from a point (map frame) to the nearest blocking square, at most
    /// the field's cap.
    pub fn at(&self, p: Point) -> f64 {
        self.at_up_to(p, self.field.cap_m())
    }

    /// Whether [`at`](Self::at) is at least `least_m`, which may not be above the field's cap; most
    /// points are decided by one look-up.
    pub fn reaches(&self, p: Point, least_m: f64) -> bool {
        let cell = self.grid.cell_at(p);
        let centres =
            if self.grid.bounds().contains(cell) { self.field.distance_m(cell) } else { 0.0 };
        if centres > 0.0 {
            let offset = (p - self.grid.centre(cell)).norm();
            let most = f64::from(centres) * (1.0 + 1e-6) + offset - 0.5 * self.grid.resolution_m();
            // A capped distance may be anything above.
            if most < least_m && f64::from(centres) < self.field.cap_m() * (1.0 - 1e-6) {
                return false;
            }
        }
        self.at_up_to(p, least_m) >= least_m
    }

    /// Whether a disc around a point keeps clear of everything that has not been seen to be free:
    /// unlike the rest, this knows of [quarters](Grid::seen_quarters) of cells.
    pub fn is_seen_around(&self, centre: Point, radius_m: f64) -> bool {
        let reach = Vector::repeat(radius_m);
        let (low, high) = (self.grid.cell_at(centre - reach), self.grid.cell_at(centre + reach));
        let is_touched = |low: Point, side_m: f64| {
            let (dx, dy) =
                (gap(centre.x, low.x, low.x + side_m), gap(centre.y, low.y, low.y + side_m));
            dx * dx + dy * dy < radius_m * radius_m
        };
        let is_clear = |c: CellIndex| {
            let corner = |c: CellIndex, side_m: f64| {
                Point::new(f64::from(c.ix) * side_m, f64::from(c.iy) * side_m)
            };
            let side_m = self.grid.resolution_m();
            self.grid.get(c) == Cell::Free
                || !is_touched(corner(c, side_m), side_m)
                || (self.grid.seen_quarters(c) != 0
                    && !self
                        .grid
                        .blocked_quarters(c)
                        .any(|q| is_touched(corner(q, 0.5 * side_m), 0.5 * side_m)))
        };
        (low.iy..=high.iy).all(|iy| (low.ix..=high.ix).all(|ix| is_clear(CellIndex::new(ix, iy))))
    }

    /// As [`at`](Self::at), at most `cap_m` (and at most the field's cap).
    pub fn at_up_to(&self, p: Point, cap_m: f64) -> f64 {
        let cap_m = cap_m.min(self.field.cap_m());
        let cell = self.grid.cell_at(p);
        if !self.grid.bounds().contains(cell) {
            return self.outside(p, cap_m);
        }
        let resolution = self.grid.resolution_m();
        let centres = f64::from(self.field.distance_m(cell));
        let offset = (p - self.grid.centre(cell)).norm();
        // The field is single precision.
        let slack = 1e-6 * (1.0 + centres);
        let least = centres - offset - std::f64::consts::FRAC_1_SQRT_2 * resolution - slack;
        if least >= cap_m {
            return cap_m;
        }
        let capped = centres >= self.field.cap_m() - slack;
        let most = centres + offset - 0.5 * resolution + slack;
        let most = if capped || centres == 0.0 { cap_m } else { most.max(0.0) };
        self.nearest_by_columns(p, cap_m.min(most)).min(cap_m)
    }

    /// [`at_up_to`](Self::at_up_to) for a point outside the bounds, where everything is unknown.
    fn outside(&self, p: Point, cap_m: f64) -> f64 {
        let bounds = self.grid.bounds();
        if self.field.blocking().blocks(Cell::Unknown) {
            return 0.0;
        }
        if bounds.is_empty() {
            return cap_m;
        }
        let resolution = self.grid.resolution_m();
        let side =
            |low: i32, high: i32| (f64::from(low) * resolution, f64::from(high) * resolution);
        let ((x0, x1), (y0, y1)) = (side(bounds.x0, bounds.x1), side(bounds.y0, bounds.y1));
        // The bounds are convex: with q the nearest point of them, |po|^2 >= |pq|^2 + |qo|^2 for
        // all o in them. A hair inside, q lies in a cell.
        let hair = 1e-9 * resolution;
        let q = Point::new(p.x.clamp(x0, x1 - hair), p.y.clamp(y0, y1 - hair));
        if (p - q).norm_squared() + self.at_least(q).powi(2) >= (cap_m + 2.0 * hair).powi(2) {
            return cap_m;
        }
        self.nearest_by_columns(p, cap_m)
    }

    /// The nearest square to a point, column by column outwards: the field knows how far away each
    /// column's nearest one is. Outside the bounds nothing may block. `cap_m` (no more than the
    /// field's) if none is nearer.
    fn nearest_by_columns(&self, p: Point, cap_m: f64) -> f64 {
        let resolution = self.grid.resolution_m();
        let bounds = self.grid.bounds();
        let blocking = self.field.blocking();
        let mut home = self.grid.cell_at(p);
        // From the outermost row all rows with anything in them lie on the same side.
        home.iy = home.iy.clamp(bounds.y0, bounds.y1 - 1);
        let rows_away = self.field.rows_away(home.iy);
        let gap_y = |iy: i32| {
            let low = f64::from(iy) * resolution;
            gap(p.y, low, low + resolution)
        };
        // To the edges of the own row; the nearer one leads.
        let edge_m = gap_y(home.iy - 1).min(gap_y(home.iy + 1));
        let home_m = gap_y(home.iy);
        let mut best2 = cap_m * cap_m;
        for away in 0.. {
            let mut any = false;
            for ix in [home.ix - away, home.ix + away] {
                let low = f64::from(ix) * resolution;
                let dx = gap(p.x, low, low + resolution);
                if dx * dx >= best2 {
                    continue;
                }
                any = true;
                if ix < bounds.x0 || ix >= bounds.x1 {
                    if blocking.blocks(Cell::Unknown) {
                        best2 = best2.min(dx * dx);
                    }
                    continue;
                }
                let rows = i32::from(rows_away[(ix - bounds.x0) as usize]);
                if rows == 0 {
                    best2 = best2.min(dx * dx + home_m * home_m);
                    continue;
                }
                let least = edge_m + f64::from(rows - 1) * resolution * (1.0 - 1e-12);
                if dx * dx + least * least >= best2 {
                    continue;
                }
                for iy in [home.iy - rows, home.iy + rows] {
                    if blocking.blocks(self.grid.get(CellIndex::new(ix, iy))) {
                        let dy = gap_y(iy);
                        best2 = best2.min(dx * dx + dy * dy);
                    }
                }
            }
            if !any {
                break;
            }
        }
        // Capped values come back as given.
        if best2 >= cap_m * cap_m { cap_m } else { best2.sqrt() }
    }

    /// A lower bound of [`at`](Self::at) in metres, at most 1.42 cells below it, from one look-up.
    #[inline]
    pub fn at_least(&self, p: Point) -> f64 {
        let cell = self.grid.cell_at(p);
        let resolution = self.grid.resolution_m();
        if !self.grid.bounds().contains(cell) {
            // The nearest stored cell may block.
            return 0.0;
        }
        let centres = f64::from(self.field.distance_m(cell));
        let offset = (p - self.grid.centre(cell)).norm();
        (centres * (1.0 - 1e-6) - offset - std::f64::consts::FRAC_1_SQRT_2 * resolution).max(0.0)
    }

    /// Exact distance in metres from the segment `a` to `b` (map frame) to the nearest blocking
    /// square, at most `cap_m` (and at most the field's cap).
    pub fn segment(&self, a: Point, b: Point, cap_m: f64) -> f64 {
        let cap_m = cap_m.min(self.field.cap_m());
        let middle = nalgebra::center(&a, &b);
        if self.at_least(middle) - 0.5 * (b - a).norm() >= cap_m {
            return cap_m;
        }
        self.search().nearest_to_segment(a, b, cap_m)
    }

    fn search(&self) -> Search<'a> {
        Search { grid: self.grid, blocking: self.field.blocking() }
    }
}

#[derive(Clone, Copy)]
struct Search<'a> {
    grid: &'a Grid,
    blocking: Blocking,
}

/// Distance from a number to an interval.
#[inline]
fn gap(v: f64, low: f64, high: f64) -> f64 {
    (low - v).max(v - high).max(0.0)
}

impl Search<'_> {
    /// The nearest square, known to be no nearer than `least_m`; `cap_m` if none is nearer.
    fn nearest_to_point(&self, p: Point, least_m: f64, cap_m: f64) -> f64 {
        let resolution = self.grid.resolution_m();
        let home = self.grid.cell_at(p);
        let reach = (cap_m / resolution).ceil() as i32 + 1;
        let mut best2 = cap_m * cap_m;
        // Rows by distance: the own one, then the ones below and above in turn.
        for away in 0..=reach {
            let mut any = false;
            for iy in [home.iy - away, home.iy + away] {
                let low = f64::from(iy) * resolution;
                let dy = gap(p.y, low, low + resolution);
                if dy * dy < best2 {
                    any = true;
                    self.scan_row(p, iy, dy, least_m, &mut best2);
                }
                if away == 0 {
                    break;
                }
            }
            if !any {
                break;
            }
        }
        // Capped values come back as given.
        if best2 >= cap_m * cap_m { cap_m } else { best2.sqrt() }
    }

    /// Improves `best2` by the nearest blocking square of one row on either side of the point.
    #[inline]
    fn scan_row(&self, p: Point, iy: i32, dy: f64, least_m: f64, best2: &mut f64) {
        let resolution = self.grid.resolution_m();
        let row = self.grid.row(iy);
        let x0 = self.grid.bounds().x0;
        let blocked = |ix: i32| {
            let cell = row
                .and_then(|row| usize::try_from(ix - x0).ok().and_then(|i| row.get(i)))
                .copied()
                .unwrap_or(Cell::Unknown);
            self.blocking.blocks(cell)
        };
        let column = floor_to_index(p.x / resolution);
        // Squares nearer than this in x lie within the radius known to be clear.
        let skip = (least_m * least_m - dy * dy).max(0.0).sqrt();
        let skipped = ((skip / resolution) as i32 - 1).max(0);
        let limit = (*best2 - dy * dy).sqrt();
        let last = (limit / resolution) as i32 + 1;
        for side in [-1, 1] {
            for k in skipped..=last {
                if blocked(column + side * k) {
                    let low = f64::from(column + side * k) * resolution;
                    let dx = gap(p.x, low, low + resolution);
                    *best2 = best2.min(dx * dx + dy * dy);
                    break;
                }
            }
        }
    }

    fn nearest_to_segment(&self, a: Point, b: Point, cap_m: f64) -> f64 {
        let resolution = self.grid.resolution_m();
        let bounds = self.grid.bounds();
        let (a, b) = if a.y <= b.y { (a, b) } else { (b, a) };
        let mut best = cap_m;
        let first = floor_to_index((a.y - cap_m) / resolution);
        let last = floor_to_index((b.y + cap_m) / resolution);
        for iy in first..=last {
            let low_y = f64::from(iy) * resolution;
            let high_y = low_y + resolution;
            // The part of the segment that is near enough to this row to matter.
            let Some((x0, x1)) = clip(a, b, low_y - best, high_y + best) else { continue };
            let start = floor_to_index((x0 - best) / resolution);
            let end = floor_to_index((x1 + best) / resolution);
            let row = self.grid.row(iy);
            for ix in start..=end {
                let cell = match row {
                    Some(row) if ix >= bounds.x0 && ix < bounds.x1 => {
                        row[(ix - bounds.x0) as usize]
                    }
                    _ => Cell::Unknown,
                };
                if self.blocking.blocks(cell) {
                    let low = Point::new(f64::from(ix) * resolution, low_y);
                    let high = Point::new(low.x + resolution, high_y);
                    best = best.min(segment_to_box(a, b, low, high));
                    if best <= 0.0 {
                        return 0.0;
                    }
                }
            }
        }
        best
    }
}

/// Range of x of the part of a segment (with `a.y <= b.y`) whose y lies in `low..=high`.
#[inline]
fn clip(a: Point, b: Point, low: f64, high: f64) -> Option<(f64, f64)> {
    if b.y < low || a.y > high {
        return None;
    }
    let rise = b.y - a.y;
    if rise <= 0.0 {
        return Some((a.x.min(b.x), a.x.max(b.x)));
    }
    let at = |y: f64| a.x + (b.x - a.x) * ((y - a.y) / rise).clamp(0.0, 1.0);
    let (x0, x1) = (at(low), at(high));
    Some((x0.min(x1), x0.max(x1)))
}

/// Distance between a segment and a rectangle; zero if they meet.
fn segment_to_box(a: Point, b: Point, low: Point, high: Point) -> f64 {
    let along = b - a;
    // Slab test for a common point.
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    let mut apart = false;
    for axis in 0..2 {
        let (start, step) = (a[axis], along[axis]);
        if step == 0.0 {
            apart |= start < low[axis] || start > high[axis];
        } else {
            let (t0, t1) = ((low[axis] - start) / step, (high[axis] - start) / step);
            enter = enter.max(t0.min(t1));
            leave = leave.min(t0.max(t1));
        }
    }
    if !apart && enter <= leave {
        return 0.0;
    }
    // Otherwise an end of the segment or a corner of the rectangle is nearest.
    let from_end = |p: Point| gap(p.x, low.x, high.x).powi(2) + gap(p.y, low.y, high.y).powi(2);
    let length2 = along.norm_squared();
    let from_corner = |x: f64, y: f64| {
        let offset = Point::new(x, y) - a;
        let t = if length2 > 0.0 { (offset.dot(&along) / length2).clamp(0.0, 1.0) } else { 0.0 };
        (offset - along * t).norm_squared()
    };
    from_end(a)
        .min(from_end(b))
        .min(from_corner(low.x, low.y))
        .min(from_corner(high.x, low.y))
        .min(from_corner(low.x, high.y))
        .min(from_corner(high.x, high.y))
        .sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::CellRect;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn world(seed: u64, resolution: f64, free: f64) -> Grid {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut grid = Grid::new(resolution);
        for iy in -20..30 {
            for ix in -30..20 {
                let v: f64 = rng.random();
                let cell = if v < free {
                    Cell::Free
                } else if v < 0.5 + 0.5 * free {
                    Cell::Occupied
                } else {
                    Cell::Unknown
                };
                grid.set(CellIndex::new(ix, iy), cell);
            }
        }
        grid
    }

    /// Straight from the definition, over every cell within reach.
    fn brute_force(grid: &Grid, p: Point, blocking: Blocking, cap_m: f64) -> f64 {
        let h = grid.resolution_m();
        let reach = (cap_m / h).ceil() as i32 + 1;
        let home = grid.cell_at(p);
        let mut best = cap_m;
        for iy in home.iy - reach..=home.iy + reach {
            for ix in home.ix - reach..=home.ix + reach {
                if blocking.blocks(grid.get(CellIndex::new(ix, iy))) {
                    let x = p.x.clamp(f64::from(ix) * h, f64::from(ix + 1) * h);
                    let y = p.y.clamp(f64::from(iy) * h, f64::from(iy + 1) * h);
                    best = best.min((p - Point::new(x, y)).norm());
                }
            }
        }
        best
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            failure_persistence: None,
            ..ProptestConfig::with_cases(64)
        })]

        #[test]
        fn point_clearance_is_exact_with_and_without_the_field(
            seed in 0u64..1000, unknown: bool, free in 0.7f64..1.0,
            resolution in prop::sample::select(vec![0.05, 0.1]), cap in 0.05f64..2.0,
        ) {
            let grid = world(seed, resolution, free);
            let blocking = if unknown { Blocking::OccupiedOrUnknown } else { Blocking::Occupied };
            let mut field = DistanceField::new(blocking, 1.5);
            field.update(&grid, CellRect::EMPTY);
            let fast = Clearance::new(&grid, &field);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for _ in 0..50 {
                let p = Point::new(rng.random_range(-3.5..2.5), rng.random_range(-2.5..3.5));
                let wanted = brute_force(&grid, p, blocking, cap);
                prop_assert!((clearance_m(&grid, p, blocking, cap) - wanted).abs() < 1e-12);
                let wanted = brute_force(&grid, p, blocking, cap.min(1.5));
                prop_assert!((fast.at_up_to(p, cap) - wanted).abs() < 1e-12);
                prop_assert_eq!(fast.reaches(p, cap), fast.at_up_to(p, cap) >= cap);
                let exact = fast.at(p);
                prop_assert!((exact - brute_force(&grid, p, blocking, 1.5)).abs() < 1e-12);
                let least = fast.at_least(p);
                prop_assert!(least <= exact);
                if grid.bounds().contains(grid.cell_at(p)) && exact < 1.5 {
                    prop_assert!(least >= exact - 1.4143 * resolution - 1e-5);
                }
            }
        }

        #[test]
        fn segment_clearance_is_the_least_over_its_points(
            seed in 0u64..1000, unknown: bool, free in 0.8f64..1.0, length in 0.0f64..1.5,
        ) {
            let grid = world(seed, 0.1, free);
            let blocking = if unknown { Blocking::OccupiedOrUnknown } else { Blocking::Occupied };
            let mut field = DistanceField::new(blocking, 1.5);
            field.update(&grid, CellRect::EMPTY);
            let fast = Clearance::new(&grid, &field);
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            for i in 0..20 {
                let a = Point::new(rng.random_range(-3.5..2.5), rng.random_range(-2.5..3.5));
                // Among the rest, segments along the axes and a single point.
                let angle = match i {
                    0 => 0.0,
                    1 => std::f64::consts::FRAC_PI_2,
                    _ => rng.random_range(-3.0..3.0),
                };
                let length = if i == 2 { 0.0 } else { length };
                let b = a + crate::frames::heading_vector(angle) * length;
                let cap = 0.35;
                let steps = 2000;
                let sampled = (0..=steps)
                    .map(|k| a + (b - a) * (f64::from(k) / f64::from(steps)))
                    .map(|p| clearance_m(&grid, p, blocking, cap))
                    .fold(cap, f64::min);
                let exact = segment_clearance_m(&grid, a, b, blocking, cap);
                // Sampling overlooks at most half a step.
                prop_assert!(exact <= sampled + 1e-12);
                prop_assert!(exact >= sampled - 0.5 * length / f64::from(steps) - 1e-12);
                let turned = segment_clearance_m(&grid, b, a, blocking, cap);
                prop_assert!((turned - exact).abs() < 1e-12);
                prop_assert!((fast.segment(a, b, cap) - exact).abs() < 1e-12);
            }
        }
    }

    proptest! {
        #[test]
        fn room_is_counted_by_the_quarters_that_were_seen(
            seed in 0u64..1000, radius in 0.05f64..0.5,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut grid = world(seed, 0.1, 0.97);
            for iy in -20..30 {
                for ix in -30..20 {
                    let c = CellIndex::new(ix, iy);
                    if grid.get(c) != Cell::Free {
                        grid.see_quarters(c, rng.random_range(0..16));
                    }
                }
            }
            let mut fine = Grid::new(0.05);
            for iy in -40..60 {
                for ix in -60..40 {
                    let c = CellIndex::new(ix, iy);
                    fine.set(c, grid.state_at(fine.centre(c)));
                }
            }
            let mut field = DistanceField::new(Blocking::OccupiedOrUnknown, 1.5);
            field.update(&grid, CellRect::EMPTY);
            let clearance = Clearance::new(&grid, &field);
            for _ in 0..50 {
                let p = Point::new(rng.random_range(-3.5..2.5), rng.random_range(-2.5..3.5));
                let nearest = brute_force(&fine, p, Blocking::OccupiedOrUnknown, 1.0);
                if (nearest - radius).abs() > 1e-9 {
                    prop_assert_eq!(clearance.is_seen_around(p, radius), nearest > radius);
                }
            }
        }
    }

    #[test]
    fn everything_outside_the_grid_is_unknown() {
        let grid = Grid::new(0.1);
        let p = Point::new(3.0, 4.0);
        assert_eq!(clearance_m(&grid, p, Blocking::OccupiedOrUnknown, 0.3), 0.0);
        assert_eq!(clearance_m(&grid, p, Blocking::Occupied, 0.3), 0.3);
        assert_eq!(segment_clearance_m(&grid, p, p, Blocking::OccupiedOrUnknown, 0.3), 0.0);
        assert_eq!(segment_clearance_m(&grid, p, p, Blocking::Occupied, 0.3), 0.3);
    }
}
