//! One scene with everything that is measured on it before a prediction is scored.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::experiment::dataset::{FAMILY_MAP, FRONTIER_CELLS_MIN, NO_TARGET, SceneRow};
use crate::map::{Cell, CellIndex};
use crate::predict::lattice::{CROP_CELLS, Crop};
use crate::sim::maze::HALLWAY_M;

const CELLS: usize = CROP_CELLS * CROP_CELLS;

/// Hallways along a side of a maze.
const HALLWAYS: i64 = 10;

/// A scene on its crop; vectors hold one entry a cell of the crop, row by row, distances in metres
/// from cell centre to cell centre (infinite if there is no such cell).
pub struct View {
    /// What is observed.
    pub crop: Crop,
    /// 0 free, 1 occupied, [`NO_TARGET`].
    pub truth: Vec<u8>,
    /// To the nearest free cell beside an unknown one.
    pub frontier_m: Vec<f32>,
    /// To the nearest observed wall.
    pub wall_m: Vec<f32>,
    /// To the nearest cell observed free.
    pub free_m: Vec<f32>,
    /// Centres of the frontier's pieces, column and row, nearest to the car first.
    pub centres: Vec<[usize; 2]>,
    /// Where the maze's own lattice lies, in a maze.
    pub maze: Option<MazeLattice>,
}

/// The lattice of a maze's walls on the crop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MazeLattice {
    /// Column and row of the crop at which the maze's first wall stands; may be negative.
    origin: [i64; 2],
    /// Coarse cells from one wall line to the next.
    pitch: i64,
}

/// Where a cell lies on the maze's lattice.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Phase {
    /// Where wall lines cross.
    Post,
    /// On one wall line.
    Line,
    /// Off the wall lines.
    Inside,
}

/// A place where a wall between two hallway cells may stand.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Its cells, without the posts at its ends.
    pub cells: Vec<usize>,
    /// Whether the wall is there.
    pub closed: bool,
    /// How far a cell beside it is from the frontier, on foot through free space that is not
    /// observed yet, metres.
    pub from_frontier_m: f64,
}

impl View {
    /// Measures a scene.
    pub fn new(row: &SceneRow, resolution_m: f64) -> Self {
        let cells = row.observed.iter().map(|state| match state {
            0 => Cell::Unknown,
            1 => Cell::Free,
            _ => Cell::Occupied,
        });
        // Where in the map the crop lies does not matter here.
        let crop = Crop { car: CellIndex::new(0, 0), resolution_m, cells: cells.collect() };
        let frontier = |k: usize| crop.is_frontier(k % CROP_CELLS, k / CROP_CELLS);
        let frontier_m = distances(frontier, resolution_m);
        let wall_m = distances(|k| crop.cells[k] == Cell::Occupied, resolution_m);
        let free_m = distances(|k| crop.cells[k] == Cell::Free, resolution_m);
        let centres = crop.frontier_centres(FRONTIER_CELLS_MIN);
        let maze = (row.family != FAMILY_MAP)
            .then(|| MazeLattice::find(&row.truth, resolution_m))
            .flatten();
        Self { crop, truth: row.truth.clone(), frontier_m, wall_m, free_m, centres, maze }
    }

    /// The cells that are not observed and within `radius_m` of the centre of a piece of the
    /// frontier; those without a target are left out unless `all`.
    pub fn cells_within(&self, radius_m: f64, all: bool) -> Vec<usize> {
        (0..CELLS)
            .filter(|k| self.crop.cells[*k] == Cell::Unknown)
            .filter(|k| all || self.truth[*k] != NO_TARGET)
            .filter(|k| self.is_within(*k, radius_m))
            .collect()
    }

    fn is_within(&self, k: usize, radius_m: f64) -> bool {
        let radius = radius_m / self.crop.resolution_m;
        let (column, row) = (k % CROP_CELLS, k / CROP_CELLS);
        self.centres.iter().any(|[x, y]| {
            let (dx, dy) = (column.abs_diff(*x) as f64, row.abs_diff(*y) as f64);
            dx * dx + dy * dy <= radius * radius
        })
    }

    /// The edges of a maze's lattice of which no cell is observed and all lie within `radius_m` of
    /// the centre of a piece of the frontier. The outer walls are not among them.
    pub fn edges(&self, radius_m: f64) -> Vec<Edge> {
        let Some(maze) = self.maze else { return Vec::new() };
        let on_foot = self.on_foot_from_frontier();
        let mut edges = Vec::new();
        for line in 1..HALLWAYS {
            for along in 0..HALLWAYS {
                for upright in [true, false] {
                    let cells = maze.edge(line, along, upright);
                    edges.extend(
                        cells.and_then(|cells| self.edge(cells, upright, radius_m, &on_foot)),
                    );
                }
            }
        }
        edges
    }

    fn edge(
        &self,
        cells: Vec<usize>,
        upright: bool,
        radius_m: f64,
        on_foot: &[f64],
    ) -> Option<Edge> {
        let open = |k: &usize| {
            self.crop.cells[*k] == Cell::Unknown
                && self.truth[*k] != NO_TARGET
                && self.is_within(*k, radius_m)
        };
        if !cells.iter().all(open) {
            return None;
        }
        let closed = cells.iter().all(|k| self.truth[*k] == 1);
        let side = if upright { 1 } else { CROP_CELLS };
        // An inner edge has cells on both sides, but the crop may end there.
        let beside = cells.iter().flat_map(|k| [k.checked_sub(side), Some(k + side)]).flatten();
        let from_frontier_m =
            beside.filter_map(|k| on_foot.get(k)).fold(f64::INFINITY, |least, d| least.min(*d));
        Some(Edge { cells, closed, from_frontier_m })
    }

    /// Way from the nearest frontier cell to every unobserved free cell, in steps to eight sides
    /// through such cells.
    fn on_foot_from_frontier(&self) -> Vec<f64> {
        let mut cost = vec![u32::MAX; CELLS];
        let mut heap = BinaryHeap::new();
        for (k, cost) in cost.iter_mut().enumerate() {
            if self.crop.is_frontier(k % CROP_CELLS, k / CROP_CELLS) {
                *cost = 0;
                heap.push(Reverse((0, k)));
            }
        }
        while let Some(Reverse((so_far, k))) = heap.pop() {
            if so_far > cost[k] {
                continue;
            }
            let (column, row) = ((k % CROP_CELLS) as i64, (k / CROP_CELLS) as i64);
            for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)] {
                let inside = 0..CROP_CELLS as i64;
                if !inside.contains(&(column + dx)) || !inside.contains(&(row + dy)) {
                    continue;
                }
                let next = ((row + dy) * CROP_CELLS as i64 + column + dx) as usize;
                // In thousandths of a cell.
                let through = so_far + if dx != 0 && dy != 0 { 1414 } else { 1000 };
                let hidden = self.crop.cells[next] == Cell::Unknown && self.truth[next] == 0;
                if hidden && through < cost[next] {
                    cost[next] = through;
                    heap.push(Reverse((through, next)));
                }
            }
        }
        let metres = |cost: u32| match cost {
            u32::MAX => f64::INFINITY,
            cost => f64::from(cost) / 1000.0 * self.crop.resolution_m,
        };
        cost.into_iter().map(metres).collect()
    }
}

impl MazeLattice {
    /// Finds the lattice by the borders of the labels: a maze has labels from its first wall to its
    /// last. `None` if the crop ends within the maze on both sides (it does not at 0.25 m).
    fn find(truth: &[u8], resolution_m: f64) -> Option<Self> {
        let pitch = (HALLWAY_M / resolution_m).round() as i64;
        if (pitch as f64 * resolution_m - HALLWAY_M).abs() > 1e-9 {
            return None;
        }
        let origin_along = |index: fn(usize) -> usize| {
            let labelled = (0..CELLS).filter(|k| truth[*k] != NO_TARGET).map(index);
            let (first, last) = labelled.fold((usize::MAX, 0), |(a, b), v| (a.min(v), b.max(v)));
            let (first, last) = (i64::try_from(first).ok()?, last as i64);
            let length = HALLWAYS * pitch;
            let end = CROP_CELLS as i64 - 1;
            // Where the labels begin or end within the crop, there the maze does.
            match (first > 0, last < end) {
                (true, true) => (last - first == length).then_some(first),
                (true, false) => Some(first),
                (false, true) => Some(last - length),
                (false, false) => None,
            }
        };
        let origin = [origin_along(|k| k % CROP_CELLS)?, origin_along(|k| k / CROP_CELLS)?];
        Some(Self { origin, pitch })
    }

    /// Where a cell lies, and whether on the outermost wall lines.
    pub fn phase(&self, k: usize) -> (Phase, bool) {
        let x = (k % CROP_CELLS) as i64 - self.origin[0];
        let y = (k / CROP_CELLS) as i64 - self.origin[1];
        let on = |v: i64| v.rem_euclid(self.pitch) == 0;
        let outer = |v: i64| v == 0 || v == HALLWAYS * self.pitch;
        let phase = match (on(x), on(y)) {
            (true, true) => Phase::Post,
            (false, false) => Phase::Inside,
            _ => Phase::Line,
        };
        (phase, outer(x) || outer(y))
    }

    /// The cells of one edge without its posts, if they all lie on the crop: on the wall line with
    /// number `line`, beside hallway cell number `along`.
    fn edge(&self, line: i64, along: i64, upright: bool) -> Option<Vec<usize>> {
        (1..self.pitch)
            .map(|step| {
                let (across, on) = (line * self.pitch, along * self.pitch + step);
                let (x, y) = if upright { (across, on) } else { (on, across) };
                let (x, y) = (x + self.origin[0], y + self.origin[1]);
                let inside = 0..CROP_CELLS as i64;
                (inside.contains(&x) && inside.contains(&y))
                    .then_some((y * CROP_CELLS as i64 + x) as usize)
            })
            .collect()
    }
}

/// Exact distance of every cell of the crop to the nearest cell of a kind, metres (separable, as
/// Saito and Toriwaki 1994).
fn distances(is: impl Fn(usize) -> bool, resolution_m: f64) -> Vec<f32> {
    const FAR: u32 = 1 << 12;
    let mut along = vec![FAR; CELLS];
    for column in 0..CROP_CELLS {
        let mut sweep = |rows: &mut dyn Iterator<Item = usize>| {
            let mut last = FAR;
            for row in rows {
                let k = row * CROP_CELLS + column;
                last = if is(k) { 0 } else { (last + 1).min(FAR) };
                along[k] = along[k].min(last);
            }
        };
        sweep(&mut (0..CROP_CELLS));
        sweep(&mut (0..CROP_CELLS).rev());
    }
    let mut result = vec![f32::INFINITY; CELLS];
    for row in 0..CROP_CELLS {
        let line = &along[row * CROP_CELLS..(row + 1) * CROP_CELLS];
        for column in 0..CROP_CELLS {
            let squares = line.iter().enumerate().filter(|(_, v)| **v < FAR);
            let least = squares.map(|(x, v)| (x.abs_diff(column) as u32).pow(2) + v * v).min();
            if let Some(least) = least {
                let metres = f64::from(least).sqrt() * resolution_m;
                result[row * CROP_CELLS + column] = metres as f32;
            }
        }
    }
    result
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::experiment::dataset::Truth;
    use crate::sim::maze::{Family, generate};

    /// A scene of a thin maze, seen from a point: all free cells within 3 m are observed, and
    /// nothing else.
    pub fn scene(seed: u64, x: f64, y: f64) -> SceneRow {
        let maze = generate(Family::Thin, seed, 0.25).unwrap();
        let truth = Truth::new(&maze.to_map_file(), &maze.world, 0.25);
        let car = CellIndex::new((x / 0.25) as i32, (y / 0.25) as i32);
        let truth = truth.crop(car);
        let observed = (0..CELLS).map(|k| {
            let (dx, dy) = ((k % CROP_CELLS).abs_diff(52), (k / CROP_CELLS).abs_diff(52));
            u8::from(truth[k] == 0 && dx * dx + dy * dy <= 144)
        });
        let observed = observed.collect();
        SceneRow { observed, truth, family: 0, source: seed as i64 }
    }

    #[test]
    fn the_mazes_lattice_is_found_from_everywhere() {
        for (x, y) in [(1.2, 1.3), (12.6, 12.4), (23.9, 2.0), (24.0, 24.0), (13.1, 12.9)] {
            let view = View::new(&scene(2, x, y), 0.25);
            let maze = view.maze.unwrap();
            let cell = |v: f64| (v / 0.25) as i64;
            assert_eq!(maze.origin, [52 - cell(x), 52 - cell(y)], "{x} {y}");
            for k in 0..CELLS {
                let (phase, outer) = maze.phase(k);
                if view.truth[k] == 1 {
                    assert_ne!(phase, Phase::Inside, "every wall stands on the lattice");
                }
                let inside = view.truth[k] != NO_TARGET;
                assert!(!(inside && outer) || view.truth[k] == 1, "outer walls are closed");
            }
        }
    }

    #[test]
    fn edges_are_open_or_closed_as_the_maze_has_them() {
        let (mut open, mut closed) = (0, 0);
        for seed in 0..6 {
            let view = View::new(&scene(seed, 11.0, 13.6), 0.25);
            for edge in view.edges(7.5) {
                assert_eq!(edge.cells.len(), 9);
                let walls = edge.cells.iter().filter(|k| view.truth[**k] == 1).count();
                assert!(walls == 0 || walls == 9, "{walls} cells of a wall");
                assert_eq!(edge.closed, walls == 9);
                if edge.closed { closed += 1 } else { open += 1 }
            }
        }
        assert!(open > 20 && closed > 20, "{open} {closed}");
    }

    #[test]
    fn the_way_from_the_frontier_goes_round_walls() {
        let mut row = scene(0, 12.0, 12.0);
        row.truth = vec![0; CELLS];
        row.observed = vec![0; CELLS];
        // A free cell, and a wall three cells to its right with one gap far up.
        row.observed[52 * CROP_CELLS + 52] = 1;
        for y in 0..CROP_CELLS {
            row.truth[y * CROP_CELLS + 55] = u8::from(y != 72);
        }
        let view = View::new(&row, 0.25);
        let on_foot = view.on_foot_from_frontier();
        let at = |x: usize, y: usize| on_foot[y * CROP_CELLS + x] / 0.25;
        assert_eq!(at(54, 52), 2.0);
        assert_eq!(at(50, 50), 2.828);
        // 20 up and 3 across, then 1 across and 20 down, diagonal steps where they save.
        assert!((at(56, 52) - (17.0 + 3.0 * 1.414 + 19.0 + 1.414)).abs() < 1e-9, "{}", at(56, 52));
        assert_eq!(at(55, 52), f64::INFINITY);
    }

    #[test]
    fn distances_agree_with_brute_force() {
        let marked = [3 + 7 * CROP_CELLS, 90 + 20 * CROP_CELLS, 50 + 101 * CROP_CELLS];
        let fast = distances(|k| marked.contains(&k), 0.25);
        for k in (0..CELLS).step_by(37) {
            let brute = marked.iter().map(|m| {
                let dx = (m % CROP_CELLS).abs_diff(k % CROP_CELLS) as f64;
                let dy = (m / CROP_CELLS).abs_diff(k / CROP_CELLS) as f64;
                dx.hypot(dy) * 0.25
            });
            let brute = brute.fold(f64::INFINITY, f64::min);
            assert!((f64::from(fast[k]) - brute).abs() < 1e-5);
        }
        assert!(distances(|_| false, 0.25).iter().all(|d| *d == f32::INFINITY));
    }

    #[test]
    fn targets_lie_within_the_discs_and_are_not_observed() {
        let view = View::new(&scene(2, 11.0, 13.6), 0.25);
        let near = view.cells_within(2.0, false);
        let far = view.cells_within(5.0, false);
        assert!(near.len() > 50 && near.len() < far.len());
        let centre = |k: usize| view.crop.centre(k % CROP_CELLS, k / CROP_CELLS);
        for k in near {
            assert_eq!(view.crop.cells[k], Cell::Unknown);
            let [x, y] = centre(k);
            let least = view.centres.iter().map(|[column, row]| {
                let [a, b] = view.crop.centre(*column, *row);
                (a - x).hypot(b - y)
            });
            assert!(least.fold(f32::INFINITY, f32::min) <= 2.0 + 1e-5);
        }
    }
}
