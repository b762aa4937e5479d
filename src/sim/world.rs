//! The true world: a raster of solid squares and what can be asked of it exactly.
//!
//! At this module's interface everything is in the map frame, in metres. Inside, points are in
//! cell units of the raster's own frame (rotated by the yaw of its origin), where cell `(ix, iy)`
//! is the closed square `[ix, ix+1] x [iy, iy+1]`. Everything outside the raster is solid.

mod reach;

use crate::frames::{Point, Pose, Vector, heading_vector};
use crate::mapfile::{MapCell, MapFile};

/// A point or direction in cell units of the raster's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Local {
    pub u: f64,
    pub v: f64,
}

/// The solid cells of the true world.
#[derive(Clone, Debug, PartialEq)]
pub struct World {
    resolution_m: f64,
    origin: Pose,
    /// Unit vector of the raster's rows.
    forward: Vector,
    width: usize,
    height: usize,
    /// For each cell the chessboard distance, in cells, to the nearest solid cell (the outside
    /// counts); 0 for a solid cell; at most [`GAP_MAX`]. A lower bound that lets the exact tests
    /// skip empty space.
    gap: Vec<u8>,
}

/// Where the chessboard distance stops counting.
const GAP_MAX: u8 = u8::MAX;

impl World {
    /// A world from its cells: row by row from the bottom, row 0 at `origin` and along its heading.
    ///
    /// # Panics
    /// If `solid` does not hold `width * height` cells, there are none, or `resolution_m` is not
    /// positive and finite.
    pub fn new(
        resolution_m: f64,
        origin: Pose,
        width: usize,
        height: usize,
        solid: &[bool],
    ) -> Self {
        assert!(resolution_m > 0.0 && resolution_m.is_finite(), "resolution {resolution_m} m");
        assert!(width > 0 && height > 0, "a world of {width} x {height} cells");
        assert_eq!(solid.len(), width * height, "cells of a world of {width} x {height}");
        let gap = solid.iter().map(|s| if *s { 0 } else { GAP_MAX }).collect();
        let forward = heading_vector(origin.heading_rad);
        let mut world = Self { resolution_m, origin, forward, width, height, gap };
        world.update_gaps();
        world
    }

    /// The world that a map shows; what the map does not know is solid.
    ///
    /// # Panics
    /// If the map's fields contradict each other ([`crate::mapfile::load`] never gives such a map).
    pub fn from_map(map: &MapFile) -> Self {
        let solid: Vec<bool> = map.cells.iter().map(|cell| *cell != MapCell::Free).collect();
        Self::new(map.resolution_m, map.origin, map.width, map.height, &solid)
    }

    /// The world as a map: solid cells occupied, all others free.
    pub fn to_map_file(&self) -> MapFile {
        let state = |gap: &u8| if *gap == 0 { MapCell::Occupied } else { MapCell::Free };
        MapFile {
            resolution_m: self.resolution_m,
            origin: self.origin,
            width: self.width,
            height: self.height,
            cells: self.gap.iter().map(state).collect(),
        }
    }

    /// Side of a cell, metres.
    pub const fn resolution_m(&self) -> f64 {
        self.resolution_m
    }

    /// Lower left corner of cell (0, 0) and direction of the rows, map frame.
    pub const fn origin(&self) -> Pose {
        self.origin
    }

    /// Cells in a row.
    pub const fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub const fn height(&self) -> usize {
        self.height
    }

    /// Whether cell `(ix, iy)` is solid; true outside the raster.
    #[inline]
    pub fn is_cell_solid(&self, ix: i64, iy: i64) -> bool {
        self.offset(ix, iy).is_none_or(|i| self.gap[i] == 0)
    }

    /// Centre of cell `(ix, iy)`, map frame.
    pub fn cell_centre(&self, ix: i64, iy: i64) -> Point {
        self.to_map(Local { u: ix as f64 + 0.5, v: iy as f64 + 0.5 })
    }

    /// Whether the cell that holds the point is solid: the truth that an oracle tells.
    #[inline]
    pub fn is_solid(&self, point: Point) -> bool {
        let p = self.to_local(point);
        self.is_cell_solid(floor(p.u), floor(p.v))
    }

    /// Whether the point lies on the raster.
    pub fn contains(&self, point: Point) -> bool {
        let p = self.to_local(point);
        let is_number = !(p.u.is_nan() || p.v.is_nan());
        is_number && self.offset(floor(p.u), floor(p.v)).is_some()
    }

    /// Lower left and upper right corner of the upright rectangle around the raster, map frame.
    pub fn bounds(&self) -> [Point; 2] {
        let (width, height) = (self.width as f64, self.height as f64);
        let corners = [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)]
            .map(|(u, v)| self.to_map(Local { u, v }));
        let [mut low, mut high] = [corners[0]; 2];
        for corner in corners {
            low = Point::new(low.x.min(corner.x), low.y.min(corner.y));
            high = Point::new(high.x.max(corner.x), high.y.max(corner.y));
        }
        [low, high]
    }

    /// Exact distance from the point to the nearest solid square, metres; 0 inside one. Distances
    /// of `cap_m` and more come back as `cap_m` (give `f64::INFINITY` for no cap; a small cap is
    /// fast).
    pub fn distance_m(&self, point: Point, cap_m: f64) -> f64 {
        let cap = cap_m / self.resolution_m;
        let distance = self.distance_cells(self.to_local(point), cap);
        if distance >= cap { cap_m } else { distance * self.resolution_m }
    }

    /// [`distance_m`](Self::distance_m) in cell units. Looks at rings of cells around the point's
    /// own, from the first that can hold a solid one to the first that can hold no nearer one.
    fn distance_cells(&self, p: Local, cap: f64) -> f64 {
        let (ix, iy) = (floor(p.u), floor(p.v));
        let Some(own) = self.offset(ix, iy).filter(|_| !(p.u.is_nan() || p.v.is_nan())) else {
            return 0.0;
        };
        let first = i64::from(self.gap[own]);
        if first == 0 {
            return 0.0;
        }
        // From the point to the nearest side of its own cell: ring k is at least k - 1 cells more.
        let (a, b) = (p.u - ix as f64, p.v - iy as f64);
        let inset = a.min(1.0 - a).min(b).min(1.0 - b);
        if cap <= (first - 1) as f64 + inset {
            return cap;
        }
        let mut best_squared = cap * cap;
        let mut ring = first;
        loop {
            let least = (ring - 1) as f64 + inset;
            if least * least >= best_squared {
                return best_squared.sqrt();
            }
            let mut look = |x: i64, y: i64| {
                if self.is_cell_solid(x, y) {
                    best_squared = best_squared.min(square_distance_squared(p, x, y));
                }
            };
            for x in ix - ring..=ix + ring {
                look(x, iy - ring);
                look(x, iy + ring);
            }
            for y in iy - ring + 1..iy + ring {
                look(ix - ring, y);
                look(ix + ring, y);
            }
            ring += 1;
        }
    }

    /// Exact length of the ray from `origin` in the direction `angle_rad` to the first solid
    /// square, metres; `range_max_m` if it is not shorter; 0 from inside a solid cell.
    pub fn raycast(&self, origin: Point, angle_rad: f64, range_max_m: f64) -> f64 {
        let start = self.to_local(origin);
        let direction = self.to_local_direction(heading_vector(angle_rad));
        let cells = self.traverse(start, direction, range_max_m / self.resolution_m, |_| {});
        cells.map_or(range_max_m, |t| t * self.resolution_m)
    }

    /// Walks along a ray of `length` cells and calls `visit` with the offset of each free cell
    /// whose interior the ray crosses, in order. Gives the length at which it meets a solid cell,
    /// `None` if it does not. `direction` is a unit vector.
    ///
    /// The traversal of Amanatides and Woo, "A fast voxel traversal algorithm for ray tracing",
    /// Eurographics 1987. A ray exactly through a corner takes the cell beside it on the way, so one
    /// through the common corner of two solid cells is stopped there.
    #[inline]
    pub(super) fn traverse(
        &self,
        start: Local,
        direction: Local,
        length: f64,
        mut visit: impl FnMut(usize),
    ) -> Option<f64> {
        let (mut ix, mut iy) = (floor(start.u), floor(start.v));
        let Some(mut offset) = self.offset(ix, iy) else { return Some(0.0) };
        if self.gap[offset] == 0 {
            return Some(0.0);
        }
        let (step_x, delta_x, mut next_x) = axis(start.u, ix, direction.u);
        let (step_y, delta_y, mut next_y) = axis(start.v, iy, direction.v);
        let row_step = step_y as isize * self.width as isize;
        visit(offset);
        loop {
            let reached;
            if next_x <= next_y {
                reached = next_x;
                ix += step_x;
                if reached >= length {
                    return None;
                }
                if ix as u64 >= self.width as u64 {
                    return Some(reached);
                }
                offset = offset.wrapping_add_signed(step_x as isize);
                next_x += delta_x;
            } else {
                reached = next_y;
                iy += step_y;
                if reached >= length {
                    return None;
                }
                if iy as u64 >= self.height as u64 {
                    return Some(reached);
                }
                offset = offset.wrapping_add_signed(row_step);
                next_y += delta_y;
            }
            if self.gap[offset] == 0 {
                return Some(reached);
            }
            visit(offset);
        }
    }

    /// Makes every cell solid that overlaps a disc: a thing set down in the world. Gives the number
    /// of cells that were free before.
    pub fn fill_disc(&mut self, centre: Point, radius_m: f64) -> usize {
        let c = self.to_local(centre);
        let radius = radius_m / self.resolution_m;
        self.fill(c, radius, |x, y| square_distance_squared(c, x, y) < radius * radius)
    }

    /// Makes every cell solid that overlaps a box, `length_m` along the pose's heading and
    /// `width_m` across it, centred on the pose. Gives the number of cells that were free before.
    pub fn fill_rect(&mut self, centre: Pose, length_m: f64, width_m: f64) -> usize {
        let c = self.to_local(centre.position);
        let along = self.to_local_direction(heading_vector(centre.heading_rad));
        let (half_length, half_width) =
            (0.5 * length_m / self.resolution_m, 0.5 * width_m / self.resolution_m);
        // Half the shadow of a unit square on the box's axes, and of the box on the raster's.
        let square_half = 0.5 * (along.u.abs() + along.v.abs());
        let box_u = half_length * along.u.abs() + half_width * along.v.abs();
        let box_v = half_length * along.v.abs() + half_width * along.u.abs();
        self.fill(c, half_length.hypot(half_width), |x, y| {
            let (du, dv) = (x as f64 + 0.5 - c.u, y as f64 + 0.5 - c.v);
            // Two convex shapes overlap unless one of their sides' directions separates them.
            du.abs() < 0.5 + box_u
                && dv.abs() < 0.5 + box_v
                && (du * along.u + dv * along.v).abs() < half_length + square_half
                && (dv * along.u - du * along.v).abs() < half_width + square_half
        })
    }

    /// Makes the cells solid that `overlaps` picks among those within `radius` of `c`.
    fn fill(&mut self, c: Local, radius: f64, overlaps: impl Fn(i64, i64) -> bool) -> usize {
        let mut filled = 0;
        let span = |centre: f64, cells: usize| {
            floor(centre - radius).max(0)..=floor(centre + radius).min(cells as i64 - 1)
        };
        for y in span(c.v, self.height) {
            for x in span(c.u, self.width) {
                if let Some(i) = self.offset(x, y)
                    && self.gap[i] != 0
                    && overlaps(x, y)
                {
                    self.gap[i] = 0;
                    filled += 1;
                }
            }
        }
        if filled > 0 {
            self.update_gaps();
        }
        filled
    }

    /// Chessboard distance to the nearest solid cell in two passes (Rosenfeld and Pfaltz 1968).
    fn update_gaps(&mut self) {
        let (width, height) = (self.width, self.height);
        let gap = &mut self.gap;
        for iy in 0..height {
            for ix in 0..width {
                let i = iy * width + ix;
                if gap[i] == 0 {
                    continue;
                }
                // Beyond the left, right and lower sides lies the solid outside.
                let left = if ix > 0 { gap[i - 1] } else { 0 };
                let below = if iy > 0 { gap[i - width] } else { 0 };
                let below_left = if ix > 0 && iy > 0 { gap[i - width - 1] } else { 0 };
                let below_right = if ix + 1 < width && iy > 0 { gap[i - width + 1] } else { 0 };
                let least = left.min(below).min(below_left).min(below_right);
                gap[i] = least.saturating_add(1);
            }
        }
        for iy in (0..height).rev() {
            for ix in (0..width).rev() {
                let i = iy * width + ix;
                if gap[i] == 0 {
                    continue;
                }
                let right = if ix + 1 < width { gap[i + 1] } else { 0 };
                let above = if iy + 1 < height { gap[i + width] } else { 0 };
                let above_right =
                    if ix + 1 < width && iy + 1 < height { gap[i + width + 1] } else { 0 };
                let above_left = if ix > 0 && iy + 1 < height { gap[i + width - 1] } else { 0 };
                let least = right.min(above).min(above_right).min(above_left);
                gap[i] = gap[i].min(least.saturating_add(1));
            }
        }
    }

    /// Position of a cell in the raster's arrays, or `None` outside.
    #[inline]
    pub(super) fn offset(&self, ix: i64, iy: i64) -> Option<usize> {
        // A negative index becomes one beyond every raster.
        ((ix as u64) < self.width as u64 && (iy as u64) < self.height as u64)
            .then(|| iy as usize * self.width + ix as usize)
    }

    /// A map-frame point in cell units of the raster's frame.
    #[inline]
    pub(super) fn to_local(&self, p: Point) -> Local {
        let d = p - self.origin.position;
        Local {
            u: (d.x * self.forward.x + d.y * self.forward.y) / self.resolution_m,
            v: (d.y * self.forward.x - d.x * self.forward.y) / self.resolution_m,
        }
    }

    /// A map-frame direction in the raster's frame.
    #[inline]
    pub(super) fn to_local_direction(&self, d: Vector) -> Local {
        Local {
            u: d.x * self.forward.x + d.y * self.forward.y,
            v: d.y * self.forward.x - d.x * self.forward.y,
        }
    }

    fn to_map(&self, p: Local) -> Point {
        let (x, y) = (p.u * self.resolution_m, p.v * self.resolution_m);
        self.origin.position
            + Vector::new(
                x * self.forward.x - y * self.forward.y,
                x * self.forward.y + y * self.forward.x,
            )
    }
}

/// The whole number at or below (saturating: a point far outside stays outside; NaN gives 0).
#[inline]
pub(super) fn floor(v: f64) -> i64 {
    v.floor() as i64
}

/// Squared distance from a point to the closed square of a cell, cell units.
#[inline]
pub(super) fn square_distance_squared(p: Local, ix: i64, iy: i64) -> f64 {
    let beyond = |x: f64, low: f64| (low - x).max(x - low - 1.0).max(0.0);
    let (du, dv) = (beyond(p.u, ix as f64), beyond(p.v, iy as f64));
    du * du + dv * dv
}

/// One axis of the traversal: step of the index, ray length between two crossings, ray length to
/// the first.
#[inline]
fn axis(start: f64, index: i64, direction: f64) -> (i64, f64, f64) {
    if direction > 0.0 {
        (1, 1.0 / direction, ((index + 1) as f64 - start) / direction)
    } else if direction < 0.0 {
        (-1, -1.0 / direction, (index as f64 - start) / direction)
    } else {
        (0, f64::INFINITY, f64::INFINITY)
    }
}

#[cfg(test)]
pub(in crate::sim) mod tests;
