//! Fields of posts in the manner of the BARN benchmark (Perille, Truong, Xiao and Stone 2020): round
//! posts of 0.075 m radius on a lattice of 0.15 m, scattered at random and drawn together into clumps
//! by a cellular automaton.
//!
//! The field is 12.5 m wide and 25 m long, walled in, with 2.5 m free at either end; the car starts in
//! the middle of the lower end and goes to the middle of the upper one. A field without a way for the
//! car is thinned out until there is one. Posts follow from the seed alone, in whole numbers, and a
//! world cell is solid if a post overlaps it.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

use super::{Family, Maze};
use crate::frames::{Point, Pose};
use crate::sim::world::World;

/// Lengths in hallway widths.
const WIDE: usize = 5;
const LONG: usize = 10;
/// Millimetres.
const HALLWAY_MM: i64 = 2500;
const PITCH_MM: i64 = 150;
const POST_RADIUS_MM: i64 = 75;
/// Lattice places across and along the field.
const COLUMNS: usize = (WIDE as i64 * HALLWAY_MM / PITCH_MM) as usize;
const ROWS: usize = ((LONG as i64 - 2) * HALLWAY_MM / PITCH_MM) as usize;
/// Places filled at first, per cent: from the thinnest field to the densest.
const FILL_PERCENT: [u32; 2] = [6, 16];
/// Rounds of the automaton.
const ROUNDS: usize = 2;
/// A way must be this wide for the car's centre, metres: radius, margin, and room to turn in.
const WAY_RADIUS_M: f64 = 0.45;

/// The field of a seed, at `n` world cells to 2.5 m.
pub(super) fn field(seed: u64, rng: &mut ChaCha8Rng, n: usize, resolution_m: f64) -> Maze {
    let [least, most] = FILL_PERCENT;
    let mut fill = least + rng.next_u32() % (most - least + 1);
    let start = Pose::new(6.25, 1.25, std::f64::consts::FRAC_PI_2);
    let goal = Point::new(6.25, 23.75);
    loop {
        let posts = clumps(rng, fill);
        let world = rasterise(&posts, n, resolution_m);
        // An empty field has a way, so this ends.
        if world.reachable(start.position, goal, WAY_RADIUS_M) {
            return Maze { family: Family::Posts, seed, world, start, goal, route: Vec::new() };
        }
        fill = fill.saturating_sub(1);
    }
}

/// Which places of the lattice hold a post.
fn clumps(rng: &mut ChaCha8Rng, fill_percent: u32) -> Vec<bool> {
    let mut posts: Vec<bool> =
        (0..COLUMNS * ROWS).map(|_| rng.next_u32() % 100 < fill_percent).collect();
    for _ in 0..ROUNDS {
        let neighbours = |i: usize| {
            let (column, row) = ((i % COLUMNS) as isize, (i / COLUMNS) as isize);
            let inside =
                |x: isize, y: isize| x >= 0 && y >= 0 && x < COLUMNS as isize && y < ROWS as isize;
            let mut count = 0;
            for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
                let (x, y) = (column + dx, row + dy);
                if (dx, dy) != (0, 0) && inside(x, y) && posts[y as usize * COLUMNS + x as usize] {
                    count += 1;
                }
            }
            count
        };
        // A post in company stays, a gap between three is closed; the lonely go.
        posts = (0..posts.len())
            .map(|i| match neighbours(i) {
                0 => false,
                1 | 2 => posts[i],
                _ => true,
            })
            .collect();
    }
    posts
}

/// Walls on the low side of the lines around the field, as in the mazes, and the posts.
fn rasterise(posts: &[bool], n: usize, resolution_m: f64) -> World {
    let (width, height) = (WIDE * n + 1, LONG * n + 1);
    let mut solid = vec![false; width * height];
    for (i, cell) in solid.iter_mut().enumerate() {
        let (x, y) = (i % width, i / width);
        *cell = x == 0 || y == 0 || x + 1 == width || y + 1 == height;
    }
    // In units of a millimetre over n a world cell is 2500 wide: whole numbers at every resolution.
    let n = n as i64;
    let radius = POST_RADIUS_MM * n;
    for (i, _) in posts.iter().enumerate().filter(|(_, post)| **post) {
        let (column, row) = ((i % COLUMNS) as i64, (i / COLUMNS) as i64);
        let x = (column * PITCH_MM + PITCH_MM / 2) * n;
        let y = (HALLWAY_MM + row * PITCH_MM + PITCH_MM / 2) * n;
        let cells = |centre: i64| (centre - radius) / HALLWAY_MM..=(centre + radius) / HALLWAY_MM;
        for (ix, iy) in cells(y).flat_map(|iy| cells(x).map(move |ix| (ix, iy))) {
            let beside = |centre: i64, cell: i64| {
                let low = cell * HALLWAY_MM;
                (low - centre).max(centre - low - HALLWAY_MM).max(0)
            };
            let (dx, dy) = (beside(x, ix), beside(y, iy));
            if dx * dx + dy * dy < radius * radius {
                solid[iy as usize * width + ix as usize] = true;
            }
        }
    }
    World::new(resolution_m, Pose::new(0.0, 0.0, 0.0), width, height, &solid)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::maze::generate;

    #[test]
    fn every_field_has_posts_and_a_way_through_them() {
        for seed in 0..30 {
            let field = generate(Family::Posts, seed, 0.1).unwrap();
            let world = &field.world;
            let inner = (1..world.width() - 1)
                .flat_map(|x| (1..world.height() - 1).map(move |y| (x as i64, y as i64)));
            let solid = inner.filter(|(x, y)| world.is_cell_solid(*x, *y)).count();
            let share = solid as f64 / (world.width() * world.height()) as f64;
            assert!((0.002..0.25).contains(&share), "{seed}: {share}");
            assert!(world.reachable(field.start.position, field.goal, WAY_RADIUS_M));
            assert!(world.distance_m(field.start.position, 2.0) > 1.0);
            assert_eq!(field, generate(Family::Posts, seed, 0.1).unwrap());
        }
    }

    #[test]
    fn a_post_is_as_thick_as_its_cells_allow() {
        let mut posts = vec![false; COLUMNS * ROWS];
        posts[20 * COLUMNS + 30] = true;
        let centre = Point::new(30.0 * 0.15 + 0.075, 2.5 + 20.0 * 0.15 + 0.075);
        for (n, resolution_m) in [(25, 0.1), (50, 0.05)] {
            let world = rasterise(&posts, n, resolution_m);
            let ahead = world.raycast(centre - crate::frames::Vector::new(2.0, 0.0), 0.0, 9.0);
            assert!(ahead <= 2.0 - 0.075 + 1e-9 && ahead >= 2.0 - 0.075 - resolution_m, "{ahead}");
        }
    }
}
