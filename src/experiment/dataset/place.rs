//! A world in which scenes are taken: where the car can be, and ways to drive.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::truth::Truth;
use crate::frames::{Point, Vector};
use crate::map::{Blocking, Cell, CellIndex, CellRect, DistanceField, Grid};
use crate::mapfile::MapFile;
use crate::sim::world::World;

/// The widest berth that a way keeps, metres: most of half a hallway.
const BERTH_MAX_M: f64 = 1.0;

/// Nearer than this to a wall no scan is taken, metres: the car's radius.
const CAR_RADIUS_M: f64 = 0.2;

/// A point is looked for this often before the cell's own centre is taken.
const TRIES: usize = 8;

/// A world with the places that a car can reach in it. Offsets count its raster's cells row by row.
pub struct Place {
    /// The true walls.
    pub world: World,
    /// The labels.
    pub truth: Truth,
    /// Distances between centres of raster cells, in the raster's own frame.
    field: DistanceField,
    clearance_m: f64,
    /// The cells of one piece of free space, a car's clearance away from every wall.
    reachable: Vec<u32>,
    search: Search,
}

/// Scratch memory of the search for ways.
#[derive(Default)]
struct Search {
    /// Cost to come, in tenths of a cell.
    cost: Vec<u32>,
    parent: Vec<u32>,
    touched: Vec<u32>,
    heap: BinaryHeap<Reverse<(u32, u32)>>,
}

impl Place {
    /// A map as a place. The piece of free space is the one around `inside`, or the largest if none
    /// is given; `None` if there is none for a car of that clearance.
    pub fn new(
        map: &MapFile,
        resolution_m: f64,
        clearance_m: f64,
        inside: Option<Point>,
    ) -> Option<Self> {
        let world = World::from_map(map);
        let truth = Truth::new(map, &world, resolution_m);
        let field = distances(&world);
        let mut place = Self {
            world,
            truth,
            field,
            clearance_m,
            reachable: Vec::new(),
            search: Search::default(),
        };
        place.find_reachable(inside);
        (!place.reachable.is_empty()).then_some(place)
    }

    fn find_reachable(&mut self, inside: Option<Point>) {
        let cells = self.world.width() * self.world.height();
        let mut seen = vec![false; cells];
        let mut best: Vec<u32> = Vec::new();
        let first = inside.map(|p| self.offset_of(p));
        for start in 0..cells as u32 {
            if seen[start as usize] || !self.is_clear(start, self.clearance_m) {
                continue;
            }
            seen[start as usize] = true;
            let mut piece = vec![start];
            let mut next = 0;
            while next < piece.len() {
                let at = piece[next];
                next += 1;
                for (other, _) in self.neighbours(at).into_iter().flatten() {
                    if !seen[other as usize] && self.is_clear(other, self.clearance_m) {
                        seen[other as usize] = true;
                        piece.push(other);
                    }
                }
            }
            if let Some(first) = first {
                if piece.contains(&first) {
                    best = piece;
                    break;
                }
            } else if piece.len() > best.len() {
                best = piece;
            }
        }
        best.sort_unstable();
        self.reachable = best;
    }

    /// A random point with a car's clearance, exact to the true walls.
    pub fn random_point(&self, rng: &mut ChaCha8Rng) -> Point {
        let cell = self.reachable[rng.random_range(0..self.reachable.len())];
        self.point_near(self.centre(cell), self.clearance_m, rng)
    }

    /// A random point in the raster cell around a centre (the way it is turned does not matter),
    /// which keeps a clearance, or the centre itself.
    fn point_near(&self, centre: Point, clearance_m: f64, rng: &mut ChaCha8Rng) -> Point {
        let half = 0.5 * self.world.resolution_m();
        for _ in 0..TRIES {
            let p =
                centre + Vector::new(rng.random_range(-half..half), rng.random_range(-half..half));
            if self.world.distance_m(p, 2.0 * clearance_m) >= clearance_m {
                return p;
            }
        }
        centre
    }

    /// A random shortest way of about `length_m` (shorter where the world is), as points
    /// `spacing_m` apart: smoothed a little, as a car cuts its corners, and scattered by up to half
    /// a raster cell.
    pub fn random_way(
        &mut self,
        length_m: f64,
        spacing_m: f64,
        rng: &mut ChaCha8Rng,
    ) -> Vec<Point> {
        let resolution = self.world.resolution_m();
        let wide = BERTH_MAX_M.min(self.field.cap_m() - resolution).max(self.clearance_m);
        let mut berth_m = rng.random_range(self.clearance_m..=wide);
        let start = self.reachable[rng.random_range(0..self.reachable.len())];
        if !self.is_clear(start, berth_m) {
            berth_m = self.clearance_m;
        }
        let limit = (10.0 * length_m / resolution) as u32;
        let mut ends = self.spread(start, berth_m, limit);
        if berth_m > self.clearance_m && self.search.cost[ends[ends.len() - 1] as usize] < limit / 2
        {
            ends = self.spread(start, self.clearance_m, limit);
        }
        // Cells come in the order of their cost: one of the last tenth of the way.
        let farthest = self.search.cost[ends[ends.len() - 1] as usize];
        let first = ends.partition_point(|at| {
            u64::from(self.search.cost[*at as usize]) * 10 < u64::from(farthest) * 9
        });
        let mut at = ends[rng.random_range(first..ends.len())];
        let mut way = vec![self.centre(at)];
        while at != start {
            at = self.search.parent[at as usize];
            way.push(self.centre(at));
        }
        way.reverse();
        let way = self.smoothed(&way);
        resampled(&way, spacing_m)
            .into_iter()
            .map(|p| self.point_near(p, CAR_RADIUS_M, rng))
            .collect()
    }

    /// All cells that can be reached with a berth at a cost up to `limit`, by cost.
    fn spread(&mut self, start: u32, berth_m: f64, limit: u32) -> Vec<u32> {
        let mut search = std::mem::take(&mut self.search);
        let cells = self.world.width() * self.world.height();
        search.cost.resize(cells, u32::MAX);
        search.parent.resize(cells, u32::MAX);
        for at in search.touched.drain(..) {
            search.cost[at as usize] = u32::MAX;
        }
        search.heap.clear();
        search.cost[start as usize] = 0;
        search.touched.push(start);
        search.heap.push(Reverse((0, start)));
        let mut settled = Vec::new();
        while let Some(Reverse((cost, at))) = search.heap.pop() {
            if cost > search.cost[at as usize] {
                continue;
            }
            settled.push(at);
            for (other, step) in self.neighbours(at).into_iter().flatten() {
                let through = cost + step;
                if through <= limit
                    && through < search.cost[other as usize]
                    && self.is_clear(other, berth_m)
                {
                    if search.cost[other as usize] == u32::MAX {
                        search.touched.push(other);
                    }
                    search.cost[other as usize] = through;
                    search.parent[other as usize] = at;
                    search.heap.push(Reverse((through, other)));
                }
            }
        }
        self.search = search;
        settled
    }

    /// Each point's mean with its neighbours on the way up to 0.4 m off, where the car fits there.
    fn smoothed(&self, way: &[Point]) -> Vec<Point> {
        let reach = (0.4 / self.world.resolution_m()).round() as usize;
        let mut smooth = Vec::with_capacity(way.len());
        for (k, raw) in way.iter().enumerate() {
            let reach = reach.min(k).min(way.len() - 1 - k);
            let near = &way[k - reach..=k + reach];
            let sum = near.iter().fold(Vector::zeros(), |sum, p| sum + p.coords);
            let mean = Point::from(sum / near.len() as f64);
            let fits = self.world.distance_m(mean, 2.0 * CAR_RADIUS_M) >= CAR_RADIUS_M;
            smooth.push(if fits { mean } else { *raw });
        }
        smooth
    }

    fn centre(&self, at: u32) -> Point {
        let width = self.world.width() as u32;
        self.world.cell_centre(i64::from(at % width), i64::from(at / width))
    }

    fn offset_of(&self, p: Point) -> u32 {
        let p = self.world.origin().to_body(p) / self.world.resolution_m();
        (p.y.floor() as u32) * self.world.width() as u32 + p.x.floor() as u32
    }

    /// Whether a disc around the cell's centre stays off the walls: exact for walls along the
    /// raster, up to 0.21 cells generous at corners.
    fn is_clear(&self, at: u32, radius_m: f64) -> bool {
        let width = self.world.width() as u32;
        let c = CellIndex::new((at % width) as i32, (at / width) as i32);
        let half = 0.5 * self.world.resolution_m();
        f64::from(self.field.distance_m(c)) + 1e-6 >= radius_m + half
    }

    /// The eight neighbours on the raster, with the cost of a step.
    fn neighbours(&self, at: u32) -> [Option<(u32, u32)>; 8] {
        const STEPS: [(i64, i64); 8] =
            [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)];
        let (width, height) = (self.world.width() as i64, self.world.height() as i64);
        let (x, y) = (i64::from(at) % width, i64::from(at) / width);
        STEPS.map(|(dx, dy)| {
            let (x, y) = (x + dx, y + dy);
            let step = if dx != 0 && dy != 0 { 14 } else { 10 };
            ((0..width).contains(&x) && (0..height).contains(&y))
                .then(|| ((y * width + x) as u32, step))
        })
    }
}

/// Distances to the solid, as far as they matter here, in the raster's frame.
fn distances(world: &World) -> DistanceField {
    let mut grid = Grid::new(world.resolution_m());
    let (width, height) = (world.width() as i32, world.height() as i32);
    grid.grow_to(CellRect { x0: 0, y0: 0, x1: width, y1: height });
    for iy in 0..height {
        for ix in 0..width {
            if !world.is_cell_solid(i64::from(ix), i64::from(iy)) {
                grid.set(CellIndex::new(ix, iy), Cell::Free);
            }
        }
    }
    // The field's limit is 180 cells.
    let cap_m = (BERTH_MAX_M + 2.0 * world.resolution_m()).min(179.0 * world.resolution_m());
    let mut field = DistanceField::new(Blocking::OccupiedOrUnknown, cap_m);
    field.update(&grid, CellRect::EMPTY);
    field
}

/// Points a given distance apart along a chain, its first and last point among them.
fn resampled(way: &[Point], spacing_m: f64) -> Vec<Point> {
    let mut points = vec![way[0]];
    let mut since = 0.0;
    for pair in way.windows(2) {
        let (mut from, to) = (pair[0], pair[1]);
        loop {
            let left = (to - from).norm();
            if since + left < spacing_m {
                since += left;
                break;
            }
            from += (to - from) * ((spacing_m - since) / left);
            points.push(from);
            since = 0.0;
        }
    }
    if since > 0.0 {
        points.push(way[way.len() - 1]);
    }
    points
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::maze::{Family, generate};
    use rand::SeedableRng;

    #[test]
    fn ways_through_a_maze_are_as_long_as_asked_for_and_keep_off_the_walls() {
        let maze = generate(Family::Thin, 3, 0.1).unwrap();
        let start = maze.start.position;
        let mut place = Place::new(&maze.to_map_file(), 0.25, 0.3, Some(start)).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for _ in 0..12 {
            let way = place.random_way(20.0, 0.3, &mut rng);
            let length: f64 = way.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
            assert!((14.0..24.0).contains(&length), "{length}");
            for p in &way {
                assert!(place.world.distance_m(*p, 1.0) >= 0.19, "{p}");
            }
            assert!(way.windows(2).all(|w| (w[1] - w[0]).norm() < 0.3 + 0.15));
        }
        for _ in 0..100 {
            let p = place.random_point(&mut rng);
            assert!(place.world.distance_m(p, 1.0) >= 0.29, "{p}");
            assert!(place.world.reachable(start, p, 0.2));
        }
    }

    #[test]
    fn resampling_keeps_ends_and_spacing() {
        let way = [Point::new(0.0, 0.0), Point::new(1.0, 0.0), Point::new(1.0, 1.05)];
        let points = resampled(&way, 0.25);
        assert_eq!(points.len(), 10);
        assert_eq!(points[9], way[2]);
        assert!((points[4] - way[1]).norm() < 1e-12);
    }
}
