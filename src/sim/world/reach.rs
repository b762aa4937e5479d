//! Whether a disc can get from one place to another in the true world, by brute force.
//!
//! The disc's centre moves between the centres of raster cells, in four directions, over those
//! whose exact distance to the solid is at least the radius. An answer of yes is therefore exact to
//! half a cell (the clearance between two such centres can be that much smaller), an answer of no
//! may overlook a passage less than a cell wider than the disc.

use std::cmp::Ordering;
use std::collections::{BinaryHeap, VecDeque};

use super::{World, floor};
use crate::frames::Point;

impl World {
    /// Whether a disc of `radius_m` gets from `start` to `goal`; false if it fits at neither.
    pub fn reachable(&self, start: Point, goal: Point, radius_m: f64) -> bool {
        let goals = self.clear_cells_at(goal, radius_m);
        let mut queue = VecDeque::from(self.clear_cells_at(start, radius_m));
        let mut visited = vec![false; self.width * self.height];
        for (ix, iy) in &queue {
            visited[self.index(*ix, *iy)] = true;
        }
        while let Some((ix, iy)) = queue.pop_front() {
            if goals.contains(&(ix, iy)) {
                return true;
            }
            for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
                let (x, y) = (ix + dx, iy + dy);
                if let Some(i) = self.offset(x, y)
                    && !visited[i]
                    && self.is_clear(x, y, radius_m)
                {
                    visited[i] = true;
                    queue.push_back((x, y));
                }
            }
        }
        false
    }

    /// Length of a short way for a disc of `radius_m` from `start` to `goal`, metres; `None` if
    /// there is none. The way takes straight and diagonal steps between cell centres and is up to
    /// 8.3 per cent longer than the shortest (a ray at 22.5 degrees).
    pub fn path_length_m(&self, start: Point, goal: Point, radius_m: f64) -> Option<f64> {
        let goals = self.clear_cells_at(goal, radius_m);
        let mut length = vec![f64::INFINITY; self.width * self.height];
        // 0: not looked at, 1: clear, 2: not clear.
        let mut clear = vec![0u8; self.width * self.height];
        let mut is_clear = |x: i64, y: i64| {
            self.offset(x, y).is_some_and(|i| {
                if clear[i] == 0 {
                    clear[i] = if self.is_clear(x, y, radius_m) { 1 } else { 2 };
                }
                clear[i] == 1
            })
        };
        let mut heap = BinaryHeap::new();
        for (ix, iy) in self.clear_cells_at(start, radius_m) {
            length[self.index(ix, iy)] = 0.0;
            heap.push(Reached { length: 0.0, ix, iy });
        }
        while let Some(Reached { length: so_far, ix, iy }) = heap.pop() {
            if so_far > length[self.index(ix, iy)] {
                continue;
            }
            if goals.contains(&(ix, iy)) {
                return Some(so_far * self.resolution_m);
            }
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let (x, y) = (ix + dx, iy + dy);
                    // A diagonal step needs both cells beside it.
                    if (dx, dy) == (0, 0) || !is_clear(x, y) || !is_clear(ix, y) || !is_clear(x, iy)
                    {
                        continue;
                    }
                    let step = if dx != 0 && dy != 0 { std::f64::consts::SQRT_2 } else { 1.0 };
                    let i = self.index(x, y);
                    if so_far + step < length[i] {
                        length[i] = so_far + step;
                        heap.push(Reached { length: so_far + step, ix: x, iy: y });
                    }
                }
            }
        }
        None
    }

    fn is_clear(&self, ix: i64, iy: i64, radius_m: f64) -> bool {
        let radius = radius_m / self.resolution_m;
        let centre = super::Local { u: ix as f64 + 0.5, v: iy as f64 + 0.5 };
        !self.is_cell_solid(ix, iy) && self.distance_cells(centre, radius) >= radius
    }

    /// The cells from which a disc at the point can set out: those around it, its own first, whose
    /// centres are clear; none if the disc does not fit at the point itself.
    fn clear_cells_at(&self, point: Point, radius_m: f64) -> Vec<(i64, i64)> {
        if self.is_solid(point) || self.distance_m(point, radius_m) < radius_m {
            return Vec::new();
        }
        let p = self.to_local(point);
        let (ix, iy) = (floor(p.u), floor(p.v));
        if self.is_clear(ix, iy, radius_m) {
            return vec![(ix, iy)];
        }
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (ix + dx, iy + dy)));
        around.filter(|(x, y)| self.is_clear(*x, *y, radius_m)).collect()
    }

    fn index(&self, ix: i64, iy: i64) -> usize {
        self.offset(ix, iy).expect("a clear cell lies in the raster")
    }
}

/// A cell on the frontier of the search, the shortest way first.
struct Reached {
    length: f64,
    ix: i64,
    iy: i64,
}

impl Ord for Reached {
    fn cmp(&self, other: &Self) -> Ordering {
        other
            .length
            .total_cmp(&self.length)
            .then_with(|| (other.iy, other.ix).cmp(&(self.iy, self.ix)))
    }
}

impl PartialOrd for Reached {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Reached {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Reached {}
