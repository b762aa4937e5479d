//! The true world on the coarse lattice.

use crate::frames::{Point, Pose};
use crate::map::{CellIndex, CellRect};
use crate::mapfile::{MapCell, MapFile};
use crate::predict::lattice::{CROP_CELLS, CROP_CENTRE};
use crate::sim::world::World;

/// Label of a coarse cell without a target: outside of the world, or not known to the map.
pub const NO_TARGET: u8 = 255;

/// Not one centre of the raster has fallen into the coarse cell.
const EMPTY: u8 = 254;

/// As in the predictor's lattice.
const ROUNDING: f64 = 1e-6;

/// The labels of all coarse cells that a world touches: 0 free, 1 occupied, [`NO_TARGET`].
///
/// The rule is that of the predictor's lattice: occupied if a raster cell whose centre lies in the
/// coarse cell is occupied, else without target if one of them is unknown, else free.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    resolution_m: f64,
    bounds: CellRect,
    labels: Vec<u8>,
}

impl Truth {
    /// The labels of a map, whose raster is also given as a world.
    pub fn new(map: &MapFile, world: &World, resolution_m: f64) -> Self {
        let [low, high] = world.bounds();
        let at = |v: f64| (v / resolution_m + ROUNDING).floor() as i32;
        let end = |v: f64| (v / resolution_m - ROUNDING).ceil() as i32;
        let bounds = CellRect { x0: at(low.x), y0: at(low.y), x1: end(high.x), y1: end(high.y) };
        let mut truth =
            Self { resolution_m, bounds, labels: vec![EMPTY; bounds.width() * bounds.height()] };
        for (k, cell) in map.cells.iter().enumerate() {
            let centre = world.cell_centre((k % map.width) as i64, (k / map.width) as i64);
            let Some(offset) = truth.offset(CellIndex::new(at(centre.x), at(centre.y))) else {
                continue;
            };
            let label = &mut truth.labels[offset];
            *label = match (*cell, *label) {
                (MapCell::Occupied, _) | (_, 1) => 1,
                (MapCell::Unknown, _) | (_, NO_TARGET) => NO_TARGET,
                (MapCell::Free, _) => 0,
            };
        }
        truth.settle_rest(map, world);
        truth
    }

    /// Coarse cells that no centre fell into, and free ones that stick out of the raster.
    fn settle_rest(&mut self, map: &MapFile, world: &World) {
        for j in self.bounds.y0..self.bounds.y1 {
            for i in self.bounds.x0..self.bounds.x1 {
                let offset = self.offset(CellIndex::new(i, j)).expect("inside the bounds");
                let within = |du: f64, dv: f64| {
                    let r = self.resolution_m;
                    Point::new((f64::from(i) + du) * r, (f64::from(j) + dv) * r)
                };
                if self.labels[offset] == EMPTY {
                    self.labels[offset] = match pixel(map, within(0.5, 0.5)) {
                        Some(MapCell::Occupied) => 1,
                        Some(MapCell::Free) => 0,
                        Some(MapCell::Unknown) | None => NO_TARGET,
                    };
                }
                if self.labels[offset] == 0 {
                    let corners = [(0.001, 0.001), (0.999, 0.001), (0.001, 0.999), (0.999, 0.999)];
                    if corners.iter().any(|(du, dv)| !world.contains(within(*du, *dv))) {
                        self.labels[offset] = NO_TARGET;
                    }
                }
            }
        }
    }

    /// The label of a coarse cell.
    pub fn get(&self, c: CellIndex) -> u8 {
        self.offset(c).map_or(NO_TARGET, |offset| self.labels[offset])
    }

    /// The labels of the crop around the car's coarse cell, row by row.
    pub fn crop(&self, car: CellIndex) -> Vec<u8> {
        let mut labels = Vec::with_capacity(CROP_CELLS * CROP_CELLS);
        let first = |v: i32| v - CROP_CENTRE as i32;
        for j in first(car.iy)..first(car.iy) + CROP_CELLS as i32 {
            for i in first(car.ix)..first(car.ix) + CROP_CELLS as i32 {
                labels.push(self.get(CellIndex::new(i, j)));
            }
        }
        labels
    }

    /// A map with one cell a coarse cell.
    pub fn to_map(&self) -> MapFile {
        let state = |label: &u8| match label {
            0 => MapCell::Free,
            1 => MapCell::Occupied,
            _ => MapCell::Unknown,
        };
        let (x, y) = (f64::from(self.bounds.x0), f64::from(self.bounds.y0));
        MapFile {
            resolution_m: self.resolution_m,
            origin: Pose::new(x * self.resolution_m, y * self.resolution_m, 0.0),
            width: self.bounds.width(),
            height: self.bounds.height(),
            cells: self.labels.iter().map(state).collect(),
        }
    }

    fn offset(&self, c: CellIndex) -> Option<usize> {
        self.bounds.contains(c).then(|| {
            (c.iy - self.bounds.y0) as usize * self.bounds.width()
                + (c.ix - self.bounds.x0) as usize
        })
    }
}

/// What a map says of the pixel that holds a point of the map frame.
fn pixel(map: &MapFile, p: Point) -> Option<MapCell> {
    let p = map.origin.to_body(p) / map.resolution_m;
    let (ix, iy) = (p.x.floor(), p.y.floor());
    (ix >= 0.0 && iy >= 0.0).then(|| map.get(ix as usize, iy as usize)).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::maze::{Family, generate};

    fn truth(map: &MapFile, resolution_m: f64) -> Truth {
        Truth::new(map, &World::from_map(map), resolution_m)
    }

    /// The rule, cell by cell, for maps that are not turned.
    fn literal(map: &MapFile, i: i32, j: i32, r: f64) -> u8 {
        let mut found = Vec::new();
        for iy in 0..map.height {
            for ix in 0..map.width {
                let x = map.origin.position.x + (ix as f64 + 0.5) * map.resolution_m;
                let y = map.origin.position.y + (iy as f64 + 0.5) * map.resolution_m;
                if (x / r + 1e-6).floor() as i32 == i && (y / r + 1e-6).floor() as i32 == j {
                    found.extend(map.get(ix, iy));
                }
            }
        }
        if found.contains(&MapCell::Occupied) {
            1
        } else if found.contains(&MapCell::Unknown) || found.is_empty() {
            NO_TARGET
        } else {
            0
        }
    }

    #[test]
    fn labels_follow_the_rule_cell_by_cell() {
        let states = [MapCell::Free, MapCell::Free, MapCell::Unknown, MapCell::Free];
        let (width, height) = (40, 30);
        let cells = (0..width * height)
            .map(|k| if k % 23 == 7 { MapCell::Occupied } else { states[k / 11 % 4] })
            .collect();
        let origin = Pose::new(-1.2, 0.75, 0.0);
        let map = MapFile { resolution_m: 0.05, origin, width, height, cells };
        let truth = truth(&map, 0.25);
        // All whole coarse cells of the map.
        for j in 3..9 {
            for i in -4..3 {
                assert_eq!(truth.get(CellIndex::new(i, j)), literal(&map, i, j, 0.25), "{i} {j}");
            }
        }
        // The left column is only partly on the map: it can be occupied, never free.
        for j in 3..9 {
            let c = CellIndex::new(-5, j);
            let wanted = if literal(&map, -5, j, 0.25) == 1 { 1 } else { NO_TARGET };
            assert_eq!(truth.get(c), wanted, "{j}");
        }
        assert_eq!(truth.get(CellIndex::new(-6, 5)), NO_TARGET);
    }

    #[test]
    fn a_maze_is_the_same_on_the_lattice_at_both_resolutions() {
        for family in Family::MAZES {
            let fine = generate(family, 11, 0.1).unwrap().to_map_file();
            let coarse = generate(family, 11, 0.25).unwrap().to_map_file();
            let fine = truth(&fine, 0.25);
            for iy in 0..coarse.height {
                for ix in 0..coarse.width {
                    let occupied = coarse.get(ix, iy) == Some(MapCell::Occupied);
                    let c = CellIndex::new(ix as i32, iy as i32);
                    assert_eq!(fine.get(c), u8::from(occupied), "{} {ix} {iy}", family.name());
                }
            }
            assert_eq!(truth(&coarse, 0.25).to_map(), coarse);
        }
    }

    #[test]
    fn pixels_larger_than_the_lattice_label_every_cell_whose_centre_they_hold() {
        let cells = vec![MapCell::Free, MapCell::Occupied, MapCell::Unknown, MapCell::Free];
        let origin = Pose::new(0.0, 0.0, 0.0);
        let map = MapFile { resolution_m: 1.0, origin, width: 4, height: 1, cells };
        let truth = truth(&map, 0.25);
        let labels: Vec<u8> = (0..16).map(|i| truth.get(CellIndex::new(i, 1))).collect();
        let mut wanted = [0, 0, 0, 0, 1, 1, 1, 1, 255, 255, 255, 255, 0, 0, 0, 0];
        wanted[12..].fill(0);
        assert_eq!(labels, wanted);
    }
}
