//! How fast a path can be driven by a car that must be able to stop within what it will have seen.
//!
//! Along an imagined path the known space grows: at arc length `s` it is what is known now and what
//! can be seen from the path up to `s`, if there are no other obstacles than those known or
//! foreseen. Where the path's first unseen point lies `h(s)` ahead, and what the car acts upon is
//! `tau` old, it can stop in time at speeds with `v tau + v^2 / (2 A) <= h(s)`. A path that
//! looks round a corner earlier may be driven faster, and so pays for its detour, without a weight
//! between exploring and arriving (after Janson, Hu and Pavone 2018; the benchmark of a planner
//! that knows everything and is still safe).

use super::PathPoint;
use crate::frames::{Point, Vector, heading_vector};
use crate::map::{Cell, CellIndex, Clearance, Grid};

/// Points of a path are judged this far apart, metres.
const STRIDE_M: f64 = 0.1;

/// What is known and foreseen, and what the car can do.
pub(super) struct Sight<'a> {
    /// What rays run through: everything but occupied cells.
    pub(super) grid: &'a Grid,
    /// To what is not known to be free.
    pub(super) known: Clearance<'a>,
    /// Radius of the disc that must have been seen, metres.
    pub(super) radius_m: f64,
    /// How far the lidar sees, metres.
    pub(super) range_m: f64,
    /// Age of what the car acts upon, seconds.
    pub(super) age_s: f64,
    /// Deceleration, m/s^2.
    pub(super) brake_mps2: f64,
    /// Faster than this is never driven, m/s.
    pub(super) speed_max_mps: f64,
}

/// Works out speed caps; keeps its scratch memory.
#[derive(Debug, Default)]
pub(super) struct Visibility {
    samples: Vec<Sample>,
    caps: Vec<f64>,
}

/// A point of the path with the two ends of the disc's diameter across it.
#[derive(Clone, Copy, Debug)]
struct Sample {
    s_m: f64,
    eye: Point,
    across: [Point; 3],
    /// One bit for each point across that has been seen.
    seen: u8,
}

const ALL_SEEN: u8 = 0b111;

impl Visibility {
    /// A speed cap for each point of the path, m/s.
    pub(super) fn caps_mps(&mut self, path: &[PathPoint], sight: &Sight<'_>) -> &[f64] {
        self.place_samples(path, sight);
        let enough_m = sight.speed_max_mps * sight.age_s
            + sight.speed_max_mps * sight.speed_max_mps / (2.0 * sight.brake_mps2);
        let reach_m = enough_m + sight.radius_m;
        self.caps.clear();
        let mut next = 0;
        for i in 0..self.samples.len() {
            let horizon_m = self.horizon_m(i, reach_m, sight) - sight.radius_m;
            let cap = sight.cap_mps(horizon_m.min(enough_m));
            let until_m = self.samples.get(i + 1).map_or(f64::INFINITY, |s| s.s_m);
            while next < path.len() && path[next].s_m < until_m {
                self.caps.push(cap);
                next += 1;
            }
        }
        &self.caps
    }

    fn place_samples(&mut self, path: &[PathPoint], sight: &Sight<'_>) {
        self.samples.clear();
        for p in path {
            if self.samples.last().is_some_and(|last| p.s_m < last.s_m + STRIDE_M) {
                continue;
            }
            let ahead = heading_vector(p.heading_rad);
            let aside = Vector::new(-ahead.y, ahead.x) * sight.radius_m;
            let across = [p.position, p.position + aside, p.position - aside];
            let is_known = sight.known.at_up_to(p.position, sight.radius_m) >= sight.radius_m;
            let seen = if is_known { ALL_SEEN } else { 0 };
            self.samples.push(Sample { s_m: p.s_m, eye: p.position, across, seen });
        }
    }

    /// How far ahead of a sample the path has been seen once the car is there, metres, as far as
    /// `reach_m`.
    fn horizon_m(&mut self, from: usize, reach_m: f64, sight: &Sight<'_>) -> f64 {
        let Sample { s_m, eye, .. } = self.samples[from];
        let mut horizon_m = f64::INFINITY;
        for sample in &mut self.samples[from + 1..] {
            let ahead_m = sample.s_m - s_m;
            if ahead_m > reach_m {
                break;
            }
            for (i, p) in sample.across.iter().enumerate() {
                let bit = 1 << i;
                if sample.seen & bit == 0 && sight.sees(eye, *p) {
                    sample.seen |= bit;
                }
            }
            if sample.seen != ALL_SEEN {
                horizon_m = horizon_m.min(ahead_m);
            }
        }
        horizon_m.min(reach_m)
    }
}

impl Sight<'_> {
    /// The speed from which the car can stop within a horizon. Never less than what one cell
    /// allows: however little is seen, the car gets on by that much.
    fn cap_mps(&self, horizon_m: f64) -> f64 {
        let horizon_m = horizon_m.max(self.grid.resolution_m());
        let slip = self.brake_mps2 * self.age_s;
        let cap = (slip * slip + 2.0 * self.brake_mps2 * horizon_m).sqrt() - slip;
        cap.min(self.speed_max_mps)
    }

    /// Whether a point is known to be free, or a beam from `eye` gets to its cell.
    fn sees(&self, eye: Point, p: Point) -> bool {
        let cell = self.grid.cell_at(p);
        self.grid.get(cell) == Cell::Free
            || (p - eye).norm() <= self.range_m && self.is_clear(eye, p, cell)
    }

    /// Whether no occupied cell lies between, cell by cell along the line (Amanatides and Woo
    /// 1987).
    fn is_clear(&self, from: Point, to: Point, last: CellIndex) -> bool {
        let side = self.grid.resolution_m();
        let mut cell = self.grid.cell_at(from);
        let ray = to - from;
        let axis = |from: f64, ray: f64, index: i32| {
            let step = if ray > 0.0 { 1 } else { -1 };
            let border = f64::from(if ray > 0.0 { index + 1 } else { index }) * side;
            let first = if ray == 0.0 { f64::INFINITY } else { (border - from) / ray };
            let each = if ray == 0.0 { f64::INFINITY } else { side / ray.abs() };
            (step, first, each)
        };
        let (step_x, mut next_x, each_x) = axis(from.x, ray.x, cell.ix);
        let (step_y, mut next_y, each_y) = axis(from.y, ray.y, cell.iy);
        while cell != last && next_x.min(next_y) <= 1.0 {
            if next_x < next_y {
                cell.ix += step_x;
                next_x += each_x;
            } else {
                cell.iy += step_y;
                next_y += each_y;
            }
            if cell != last && self.grid.get(cell) == Cell::Occupied {
                return false;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Blocking, DistanceField};

    /// Free for `0 <= x < 4`, `0 <= y < 2`, a wall of one cell along x = 4 but for its opening at
    /// `y >= opening`, unknown beyond.
    fn map(opening: i32) -> (Grid, DistanceField) {
        let mut grid = Grid::new(0.1);
        for iy in 0..20 {
            for ix in 0..40 {
                grid.set(CellIndex::new(ix, iy), Cell::Free);
            }
            if iy < opening {
                grid.set(CellIndex::new(40, iy), Cell::Occupied);
            }
        }
        let mut field = DistanceField::new(Blocking::OccupiedOrUnknown, 1.5);
        field.update(&grid, grid.bounds());
        (grid, field)
    }

    fn straight(from: Point, to: Point) -> Vec<PathPoint> {
        let ray = to - from;
        let steps = (ray.norm() / 0.05).round();
        let point = |i: f64| PathPoint {
            s_m: ray.norm() * i / steps,
            position: from + ray * (i / steps),
            heading_rad: ray.y.atan2(ray.x),
            curvature_pm: 0.0,
        };
        (0..=steps as u32).map(|i| point(f64::from(i))).collect()
    }

    fn caps(grid: &Grid, field: &DistanceField, path: &[PathPoint], range_m: f64) -> Vec<f64> {
        let sight = Sight {
            grid,
            known: Clearance::new(grid, field),
            radius_m: 0.25,
            range_m,
            age_s: 0.1,
            brake_mps2: 8.0,
            speed_max_mps: 4.0,
        };
        Visibility::default().caps_mps(path, &sight).to_vec()
    }

    #[test]
    fn what_is_in_view_is_driven_at_top_speed() {
        let (grid, field) = map(0);
        let path = straight(Point::new(0.5, 1.0), Point::new(9.0, 1.0));
        let caps = caps(&grid, &field, &path, 7.5);
        assert_eq!(caps.len(), path.len());
        assert!(caps.iter().all(|cap| *cap == 4.0), "{caps:?}");
    }

    #[test]
    fn a_short_sight_caps_by_the_stopping_distance() {
        let (grid, field) = map(0);
        let path = straight(Point::new(0.5, 1.0), Point::new(9.0, 1.0));
        let caps = caps(&grid, &field, &path, 1.0);
        // Beyond the known part the first sample that is not in view lies 1.0 to 1.1 m ahead (less
        // at the sides: 0.97 m), 0.25 m of which the disc takes.
        for (p, cap) in path.iter().zip(&caps).filter(|(p, _)| p.s_m > 4.0 && p.s_m < 7.0) {
            let stop_m = cap * 0.1 + cap * cap / 16.0;
            assert!((0.65..=0.86).contains(&stop_m), "{} m: {cap} m/s, {stop_m} m", p.s_m);
        }
        assert_eq!(caps[0], 4.0);
    }

    #[test]
    fn a_corner_seen_late_is_taken_more_slowly() {
        // Up beside the wall and round its end at (4.05, 1.0), near to it or swinging wide.
        let (grid, field) = map(10);
        let slowest = |aside_m: f64| {
            let mut path = straight(Point::new(3.7, 0.3), Point::new(3.7, 1.05 + aside_m));
            let turned = path.last().unwrap().s_m;
            let on = straight(Point::new(3.7, 1.05 + aside_m), Point::new(5.0, 0.2));
            path.extend(on[1..].iter().map(|p| PathPoint { s_m: p.s_m + turned, ..*p }));
            caps(&grid, &field, &path, 7.5).into_iter().fold(4.0, f64::min)
        };
        let (near, wide) = (slowest(0.3), slowest(0.8));
        assert!(near < wide && wide <= 4.0, "{near} {wide}");
    }

    #[test]
    fn walls_are_not_seen_through_and_hide_nothing_of_themselves() {
        let (grid, field) = map(20);
        let sight = Sight {
            grid: &grid,
            known: Clearance::new(&grid, &field),
            radius_m: 0.25,
            range_m: 7.5,
            age_s: 0.1,
            brake_mps2: 8.0,
            speed_max_mps: 4.0,
        };
        let eye = Point::new(1.03, 1.02);
        assert!(sight.sees(eye, Point::new(3.5, 0.5)));
        assert!(sight.sees(eye, Point::new(4.05, 0.5)));
        assert!(!sight.sees(eye, Point::new(4.15, 0.5)));
        assert!(!sight.sees(eye, Point::new(6.0, 1.9)));
        assert!(sight.sees(eye, Point::new(1.0, 7.0)));
        assert!(!sight.sees(eye, Point::new(1.0, 9.0)), "out of range");
    }
}
