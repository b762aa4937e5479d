//! The simulator's own account of what the car has been shown to be free.
//!
//! Kept on the world's grid, at the resolution of one world cell: a cell counts as shown as soon as
//! one delivered beam has crossed its inside before its end, even if it crossed no more than a
//! corner of it. That is the most that a scan can be said to show, so whatever the daemon takes for
//! free beyond this account was invented. The daemon's own rule is stricter; as long as the beams
//! that free one of its cells lie no further apart than a world cell there, it stays within the
//! account.

use super::lidar::BeamFan;
use super::world::{World, floor, square_distance_squared};
use crate::frames::{Point, Pose};

/// Which cells of a world have been shown free.
#[derive(Clone, Debug, PartialEq)]
pub struct Account {
    shown: Vec<bool>,
}

impl Account {
    /// An account that knows nothing but the place on which the car stands: the free cells that
    /// overlap a disc of `radius_m` around `start`.
    pub fn new(world: &World, start: Point, radius_m: f64) -> Self {
        let mut shown = vec![false; world.width() * world.height()];
        for_each_cell_of_disc(world, start, radius_m, |ix, iy| {
            if let Some(i) = world.offset(ix, iy)
                && !world.is_cell_solid(ix, iy)
            {
                shown[i] = true;
            }
            true
        });
        Self { shown }
    }

    /// Enters a scan that has reached the daemon: the ranges that were delivered, and the true pose
    /// at which they were measured. A beam shows the cells up to its delivered range, or to the true
    /// surface where that is nearer; a NaN shows none.
    pub fn delivered(&mut self, world: &World, fan: &BeamFan, pose: Pose, ranges_m: &[f32]) {
        let start = world.to_local(pose.position);
        for (direction, range) in fan.map_directions(pose).zip(ranges_m) {
            if range.is_nan() {
                continue;
            }
            let length = f64::from(*range).min(fan.range_max_m()) / world.resolution_m();
            let direction = world.to_local_direction(direction);
            world.traverse(start, direction, length, |i| self.shown[i] = true);
        }
    }

    /// Enters a map that was given beforehand: every free cell counts as shown.
    pub fn show_all(&mut self, world: &World) {
        for iy in 0..world.height() {
            for ix in 0..world.width() {
                let free = !world.is_cell_solid(ix as i64, iy as i64);
                self.shown[iy * world.width() + ix] = free;
            }
        }
    }

    /// Whether the cell that holds the point has been shown free.
    pub fn is_shown(&self, world: &World, point: Point) -> bool {
        let p = world.to_local(point);
        world.offset(floor(p.u), floor(p.v)).is_some_and(|i| self.shown[i])
    }

    /// Whether a disc overlaps a cell that has not been shown free (touching does not count).
    pub fn entered_unknown(&self, world: &World, position: Point, radius_m: f64) -> bool {
        let mut entered = false;
        for_each_cell_of_disc(world, position, radius_m, |ix, iy| {
            entered = !world.offset(ix, iy).is_some_and(|i| self.shown[i]);
            !entered
        });
        entered
    }

    /// Number of cells shown free.
    pub fn shown_cells(&self) -> usize {
        self.shown.iter().filter(|shown| **shown).count()
    }
}

/// Calls `visit` with every cell whose square overlaps the disc, until it says `false`.
fn for_each_cell_of_disc(
    world: &World,
    centre: Point,
    radius_m: f64,
    mut visit: impl FnMut(i64, i64) -> bool,
) {
    let c = world.to_local(centre);
    let radius = radius_m / world.resolution_m();
    for iy in floor(c.v - radius)..=floor(c.v + radius) {
        for ix in floor(c.u - radius)..=floor(c.u + radius) {
            if square_distance_squared(c, ix, iy) < radius * radius && !visit(ix, iy) {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::sim::lidar::{Lidar, LidarParams};
    use crate::sim::maze::{Family, generate};
    use crate::sim::world::tests::random_world;

    /// Length of the part of a line inside a cell's square, as a share of the line; negative by how
    /// far it misses (clipping after Liang and Barsky).
    fn length_inside(from: Point, to: Point, ix: i64, iy: i64) -> f64 {
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for (p, d, low) in [(from.x, to.x - from.x, ix as f64), (from.y, to.y - from.y, iy as f64)]
        {
            if d.abs() < 1e-12 {
                if p < low || p > low + 1.0 {
                    return -1.0;
                }
                continue;
            }
            let (a, b) = ((low - p) / d, (low + 1.0 - p) / d);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        leave - enter
    }

    /// Whether nothing solid lies between two points.
    fn has_line_of_sight(world: &World, from: Point, to: Point) -> bool {
        let offset = to - from;
        let range = offset.norm();
        world.raycast(from, offset.y.atan2(offset.x), range) >= range - 1e-9
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn the_shown_cells_are_those_that_some_beam_cuts_before_its_end_or_the_first_surface(
            seed in 0u64..1_000, percent in 1u32..25, u in 1.0f64..19.0, v in 1.0f64..19.0,
            heading in -3.0f64..3.0, noise in 0u32..2,
        ) {
            let world = random_world(seed, percent);
            let position = world.origin().to_map(Point::new(0.1 * u, 0.1 * v));
            let pose = Pose { position, heading_rad: heading };
            let params = LidarParams {
                beams: 200, range_m: 1.8, noise_m: 0.1 * f64::from(noise), ..Default::default()
            };
            let mut lidar = Lidar::new(&params, seed);
            let mut account = Account::new(&world, position, 0.0);
            let ranges = lidar.scan(&world, pose);
            account.delivered(&world, lidar.fan(), pose, &ranges);
            // Where each beam ends, in cells of the raster's frame.
            let ends: Vec<Point> = ranges.iter().enumerate().map(|(k, range)| {
                let fan = lidar.fan();
                let angle = heading + fan.angle_first_rad() + fan.angle_step_rad() * k as f64;
                let length = world.raycast(position, angle, f64::from(*range).min(1.8));
                let end = position + crate::frames::heading_vector(angle) * length;
                world.origin().to_body(end) / world.resolution_m()
            }).collect();
            let from = Point::new(u, v);
            for iy in 0..world.height() as i64 {
                for ix in 0..world.width() as i64 {
                    let shown = account.is_shown(&world, world.cell_centre(ix, iy));
                    if world.is_cell_solid(ix, iy) {
                        prop_assert!(!shown, "{ix} {iy} is solid");
                        continue;
                    }
                    let cut = ends.iter().map(|to| length_inside(from, *to, ix, iy));
                    let longest = cut.fold(f64::NEG_INFINITY, f64::max);
                    // Cuts of no length may go either way.
                    prop_assert!(
                        if shown { longest > -1e-6 } else { longest < 1e-6 },
                        "cell {ix} {iy}: shown {shown}, longest cut {longest}"
                    );
                }
            }
        }

        #[test]
        fn a_disc_enters_the_unknown_exactly_when_it_covers_a_point_not_shown(
            seed in 0u64..1_000, u in 2.0f64..18.0, v in 2.0f64..18.0,
            du in -6.0f64..6.0, dv in -6.0f64..6.0, radius in 0.01f64..0.4,
        ) {
            let world = random_world(seed, 3);
            let place = |u: f64, v: f64| world.origin().to_map(Point::new(0.1 * u, 0.1 * v));
            let pose = Pose { position: place(u, v), heading_rad: 0.0 };
            let mut lidar = Lidar::new(&LidarParams::default(), 0);
            let mut account = Account::new(&world, pose.position, 0.2);
            let ranges = lidar.scan(&world, pose);
            account.delivered(&world, lidar.fan(), pose, &ranges);
            let centre = place(u + du, v + dv);
            let covered = |radius: f64| {
                (0..120).any(|k| (0..=40).any(|n| {
                    let out = radius * f64::from(n) / 40.0;
                    let p = centre + crate::frames::heading_vector(f64::from(k) * 0.05236) * out;
                    !account.is_shown(&world, p)
                }))
            };
            let entered = account.entered_unknown(&world, centre, radius);
            // Points inside say yes for certain; points of a slightly larger disc, no for certain.
            prop_assert!(entered || !covered(radius * (1.0 - 1e-9)));
            prop_assert!(!entered || covered(radius + 0.02));
        }
    }

    #[test]
    fn only_what_was_delivered_counts() {
        let maze = generate(Family::Solid, 2, 0.1).unwrap();
        let mut lidar = Lidar::new(&LidarParams::default(), 0);
        let mut account = Account::new(&maze.world, maze.start.position, 0.2);
        // A disc of 0.2 m centred on a cell's centre overlaps 21 cells of 0.1 m.
        assert_eq!(account.shown_cells(), 21);
        assert!(!account.entered_unknown(&maze.world, maze.start.position, 0.2));
        let ahead = maze.start.to_map(Point::new(0.5, 0.0));
        assert!(account.entered_unknown(&maze.world, ahead, 0.2));
        let mut ranges = lidar.scan(&maze.world, maze.start);
        let nothing = vec![f32::NAN; ranges.len()];
        account.delivered(&maze.world, lidar.fan(), maze.start, &nothing);
        assert_eq!(account.shown_cells(), 21);
        // Half of the beams arrive cut short: they show no more than they say.
        for range in &mut ranges {
            *range = range.min(0.8);
        }
        account.delivered(&maze.world, lidar.fan(), maze.start, &ranges);
        assert!(!account.entered_unknown(&maze.world, ahead, 0.2));
        let further = maze.start.to_map(Point::new(0.9, 0.0));
        assert!(account.entered_unknown(&maze.world, further, 0.2));
    }

    #[test]
    fn a_turn_on_the_spot_shows_all_that_is_in_sight() {
        let maze = generate(Family::Thin, 5, 0.1).unwrap();
        let mut lidar = Lidar::new(&LidarParams::default(), 0);
        let mut account = Account::new(&maze.world, maze.start.position, 0.2);
        let ranges = lidar.scan(&maze.world, maze.start);
        account.delivered(&maze.world, lidar.fan(), maze.start, &ranges);
        let mut seen = 0;
        for iy in 0..60 {
            for ix in 0..60 {
                let centre = maze.world.cell_centre(ix, iy);
                let near = (centre - maze.start.position).norm() < 6.0;
                if near
                    && !maze.world.is_cell_solid(ix, iy)
                    && has_line_of_sight(&maze.world, maze.start.position, centre)
                {
                    assert!(account.is_shown(&maze.world, centre), "cell {ix} {iy}");
                    seen += 1;
                }
            }
        }
        assert!(seen > 1_000, "{seen} cells in sight");
    }
}
