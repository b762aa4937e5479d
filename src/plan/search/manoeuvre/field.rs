//! Distances to go over the plane, turning apart, and the lattice that they and the states lie on.

use super::room::{Ground, Room};
use crate::frames::{Point, Pose, Vector};
use crate::plan::search::buckets::Buckets;
use crate::plan::search::window::{DIAGONAL, STRAIGHT};

/// States in the same square of this side and the same of [`HEADINGS`] sectors are one, metres.
const LATTICE_M: f64 = 0.1;
const HEADINGS: usize = 48;
/// Unit of the distances over the plane, metres.
const FIELD_UNIT_M: f64 = LATTICE_M / STRAIGHT as f64;
/// Distance to go where the plane leads nowhere, metres.
pub(super) const FAR_M: f64 = 100.0;

/// The lattice around the car.
#[derive(Clone, Copy)]
pub(super) struct Lattice {
    origin: Point,
    half: i32,
}

impl Lattice {
    /// As far as `reach_m` to each side.
    pub(super) fn around(origin: Point, reach_m: f64) -> Self {
        Self { origin, half: (reach_m / LATTICE_M).ceil() as i32 }
    }

    /// How many slots for states there are.
    pub(super) fn slots(&self) -> usize {
        self.side() * self.side() * HEADINGS
    }

    fn side(&self) -> usize {
        2 * self.half as usize + 1
    }

    fn square(&self, p: Point) -> Option<usize> {
        let q = (p - self.origin) / LATTICE_M;
        let (x, y) = (q.x.round() as i32 + self.half, q.y.round() as i32 + self.half);
        let side = self.side() as i32;
        (x >= 0 && y >= 0 && x < side && y < side).then(|| y as usize * self.side() + x as usize)
    }

    /// The slot of the states that are as good as at this pose.
    pub(super) fn slot(&self, pose: Pose) -> Option<u32> {
        let sector = (pose.heading_rad / std::f64::consts::TAU * HEADINGS as f64).round() as i32;
        let sector = sector.rem_euclid(HEADINGS as i32) as usize;
        self.square(pose.position).map(|square| (square * HEADINGS + sector) as u32)
    }
}

/// Distances to go over the plane (8-connected squares). Holds its working memory.
#[derive(Default)]
pub(super) struct Field {
    /// Distance to go per square, in the grid search's units of cost; empty where there is only a
    /// direction.
    distances: Vec<u32>,
    open: Vec<bool>,
    queue: Buckets,
}

impl Field {
    /// Forgets all distances: there is only a direction.
    pub(super) fn clear(&mut self) {
        self.distances.clear();
    }

    /// Distances outwards from ends, each with what is left from there, metres.
    pub(super) fn spread<R: Room>(
        &mut self,
        ground: &Ground<'_, R>,
        lattice: Lattice,
        ends: impl Iterator<Item = (Point, f64)>,
    ) {
        let side = lattice.side();
        self.distances.clear();
        self.distances.resize(side * side, u32::MAX);
        self.open.clear();
        for y in 0..side {
            for x in 0..side {
                let offset = |i: usize| (i as f64 - f64::from(lattice.half)) * LATTICE_M;
                let p = lattice.origin + Vector::new(offset(x), offset(y));
                // The rim stays closed, so that no step leaves the array.
                let rim = x == 0 || y == 0 || x + 1 == side || y + 1 == side;
                self.open.push(!rim && ground.open(p));
            }
        }
        self.queue.reset(0);
        for (end, rest_m) in ends {
            // An end on the rim would let a step leave the array.
            let square = lattice.square(end).filter(|square| self.open[*square]);
            let Some(square) = square else { continue };
            let rest = (rest_m / FIELD_UNIT_M).round() as u32;
            if rest < self.distances[square] {
                self.distances[square] = rest;
                self.queue.push(rest, square as u32);
            }
        }
        let row = side as isize;
        let straight = [1, -1, row, -row].map(|step| (step, STRAIGHT));
        let diagonal = [row + 1, row - 1, 1 - row, -1 - row].map(|step| (step, DIAGONAL));
        while let Some((distance, square)) = self.queue.pop() {
            if distance > self.distances[square as usize] {
                continue;
            }
            for (step, length) in straight.into_iter().chain(diagonal) {
                let there = (square as isize + step) as usize;
                let next = distance + length;
                if self.open[there] && next < self.distances[there] {
                    self.distances[there] = next;
                    self.queue.push(next, there as u32);
                }
            }
        }
    }

    /// The distance to go at a point, metres; around closed squares that of the best neighbour.
    pub(super) fn left_m(&self, lattice: Lattice, p: Point) -> f64 {
        if self.distances.is_empty() {
            return 0.0;
        }
        let Some(square) = lattice.square(p) else { return FAR_M };
        let here = self.distances[square];
        if here != u32::MAX {
            return f64::from(here) * FIELD_UNIT_M;
        }
        let side = lattice.side();
        let (x, y) = (square % side, square / side);
        let mut least = u32::MAX;
        for y in y.saturating_sub(1)..(y + 2).min(side) {
            for x in x.saturating_sub(1)..(x + 2).min(side) {
                least = least.min(self.distances[y * side + x]);
            }
        }
        if least == u32::MAX { FAR_M } else { f64::from(least) * FIELD_UNIT_M + LATTICE_M }
    }
}
