use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::*;

/// A random world of squares, about `percent` of them solid, in a frame that is moved and turned.
pub(in crate::sim) fn random_world(seed: u64, percent: u32) -> World {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (width, height) = (20 + rng.next_u32() as usize % 30, 20 + rng.next_u32() as usize % 30);
    let solid: Vec<bool> = (0..width * height).map(|_| rng.next_u32() % 100 < percent).collect();
    let yaw = f64::from(rng.next_u32()) / f64::from(u32::MAX) * 6.0 - 3.0;
    let origin = Pose::new(f64::from(rng.next_u32() % 50), -f64::from(rng.next_u32() % 9), yaw);
    World::new(0.1, origin, width, height, &solid)
}

/// A map-frame point from coordinates in cells of the raster's frame.
fn at(world: &World, u: f64, v: f64) -> Point {
    world.origin().to_map(Point::new(u * world.resolution_m(), v * world.resolution_m()))
}

#[test]
fn the_bounds_are_the_smallest_upright_rectangle_around_the_raster() {
    for seed in 0..20 {
        let world = random_world(seed, 10);
        let (w, h) = (world.width() as f64, world.height() as f64);
        let [low, high] = world.bounds();
        let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(u, v)| at(&world, u, v));
        let least = |pick: fn(&Point) -> f64| corners.iter().map(pick).fold(f64::MAX, f64::min);
        let most = |pick: fn(&Point) -> f64| corners.iter().map(pick).fold(f64::MIN, f64::max);
        assert!((low - Point::new(least(|c| c.x), least(|c| c.y))).norm() < 1e-9);
        assert!((high - Point::new(most(|c| c.x), most(|c| c.y))).norm() < 1e-9);
        for (u, v, inside) in
            [(0.1, 0.1, true), (w - 0.1, h - 0.1, true), (-0.1, 1.0, false), (1.0, h + 0.1, false)]
        {
            assert_eq!(world.contains(at(&world, u, v)), inside);
        }
        assert!(!world.contains(Point::new(f64::NAN, 0.0)));
    }
}

/// Distance to the nearest solid square or to the raster's edge, looking at every cell.
fn distance_by_looking_everywhere(world: &World, point: Point) -> f64 {
    let p = world.origin().to_body(point) / world.resolution_m();
    let (w, h) = (world.width() as f64, world.height() as f64);
    let mut best = p.x.min(w - p.x).min(p.y).min(h - p.y).max(0.0);
    for iy in 0..world.height() as i64 {
        for ix in 0..world.width() as i64 {
            if world.is_cell_solid(ix, iy) {
                let dx = (p.x - p.x.clamp(ix as f64, (ix + 1) as f64)).abs();
                let dy = (p.y - p.y.clamp(iy as f64, (iy + 1) as f64)).abs();
                best = best.min(dx.hypot(dy));
            }
        }
    }
    best * world.resolution_m()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn distances_are_those_of_looking_everywhere(
        seed in 0u64..10_000, percent in 0u32..30, u in -2.0f64..52.0, v in -2.0f64..52.0,
        cap in 0.01f64..3.0,
    ) {
        let world = random_world(seed, percent);
        let point = at(&world, u, v);
        let truth = distance_by_looking_everywhere(&world, point);
        let uncapped = world.distance_m(point, f64::INFINITY);
        prop_assert!((uncapped - truth).abs() < 1e-9, "{uncapped} against {truth}");
        let capped = world.distance_m(point, cap);
        prop_assert!((capped - truth.min(cap)).abs() < 1e-9, "{capped} against {truth}, cap {cap}");
        prop_assert_eq!(world.is_solid(point), truth == 0.0);
    }

    #[test]
    fn rays_end_where_marching_ends(
        seed in 0u64..10_000, percent in 0u32..20, u in 0.0f64..50.0, v in 0.0f64..50.0,
        angle in -4.0f64..4.0, range in 0.05f64..6.0,
    ) {
        let world = random_world(seed, percent);
        let point = at(&world, u, v);
        let cast = world.raycast(point, angle, range);
        prop_assert!((0.0..=range).contains(&cast));
        // No point before the end is solid, unless the ray cuts less than a step off a corner.
        let direction = heading_vector(angle);
        let step = 1e-3;
        let mut solid_steps = 0;
        let mut t = 0.0;
        while t < cast - 1e-9 {
            solid_steps += usize::from(world.is_solid(point + direction * t));
            t += step;
        }
        prop_assert!(solid_steps == 0, "{solid_steps} solid points before {cast}");
        // The end lies on a solid square.
        if cast < range {
            prop_assert!(world.distance_m(point + direction * cast, 1.0) < 1e-9);
        }
    }

    #[test]
    fn a_ray_crosses_each_cell_once_and_only_its_neighbours_next(
        seed in 0u64..10_000, u in 0.0f64..20.0, v in 0.0f64..20.0, angle in -4.0f64..4.0,
    ) {
        let world = random_world(seed, 5);
        let direction = world.to_local_direction(heading_vector(angle));
        let mut visited: Vec<usize> = Vec::new();
        world.traverse(Local { u, v }, direction, 60.0, |i| visited.push(i));
        for pair in visited.windows(2) {
            let apart = pair[0].abs_diff(pair[1]);
            prop_assert!(apart == 1 || apart == world.width());
        }
        let length = visited.len();
        visited.sort_unstable();
        visited.dedup();
        prop_assert_eq!(visited.len(), length);
        prop_assert!(visited.iter().all(|i| world.gap[*i] > 0));
    }
}

fn empty(width: usize, height: usize, origin: Pose) -> World {
    World::new(0.5, origin, width, height, &vec![false; width * height])
}

#[test]
fn the_outside_is_solid() {
    let world = empty(10, 6, Pose::new(1.0, 2.0, 0.0));
    assert!(world.is_solid(Point::new(0.99, 3.0)));
    assert!(!world.is_solid(Point::new(1.01, 3.0)));
    assert_eq!(world.raycast(Point::new(2.0, 3.0), 0.0, 100.0), 4.0);
    assert_eq!(world.raycast(Point::new(2.0, 3.0), 0.0, 3.0), 3.0);
    assert_eq!(world.raycast(Point::new(-5.0, 3.0), 0.0, 3.0), 0.0);
    assert_eq!(world.distance_m(Point::new(3.0, 2.75), 5.0), 0.75);
    assert_eq!(world.distance_m(Point::new(3.0, 2.75), 0.5), 0.5);
    for bad in [f64::NAN, f64::INFINITY, -1e300] {
        assert_eq!(world.distance_m(Point::new(bad, 3.0), 5.0), 0.0);
    }
}

#[test]
fn a_turned_map_lies_where_its_origin_says() {
    // Rows run along map y, columns along minus x.
    let mut cells = vec![MapCell::Free; 12];
    cells[2] = MapCell::Occupied;
    cells[4] = MapCell::Unknown;
    let map = MapFile {
        resolution_m: 1.0,
        origin: Pose::new(10.0, 20.0, std::f64::consts::FRAC_PI_2),
        width: 4,
        height: 3,
        cells,
    };
    let world = World::from_map(&map);
    assert!(world.is_solid(Point::new(9.5, 22.5)), "cell (2, 0)");
    assert!(world.is_solid(Point::new(8.5, 20.5)), "cell (0, 1), unknown");
    assert!(!world.is_solid(Point::new(9.5, 20.5)));
    assert!((world.cell_centre(2, 0) - Point::new(9.5, 22.5)).norm() < 1e-12);
    let ahead = world.raycast(Point::new(9.5, 20.25), std::f64::consts::FRAC_PI_2, 9.0);
    assert!((ahead - 1.75).abs() < 1e-12, "{ahead}");
}

#[test]
fn no_ray_slips_through_the_common_corner_of_two_solid_cells() {
    let mut solid = vec![false; 100];
    // (5, 4) and (4, 5) touch at (5, 5).
    solid[45] = true;
    solid[54] = true;
    let world = World::new(1.0, Pose::new(0.0, 0.0, 0.0), 10, 10, &solid);
    let diagonal = std::f64::consts::SQRT_2;
    let forth = world.raycast(Point::new(3.0, 3.0), std::f64::consts::FRAC_PI_4, 9.0);
    assert!((forth - 2.0 * diagonal).abs() < 1e-9, "{forth}");
    let back = world.raycast(Point::new(7.5, 7.5), -3.0 * std::f64::consts::FRAC_PI_4, 9.0);
    assert!((back - 2.5 * diagonal).abs() < 1e-9, "{back}");
}

#[test]
fn a_thing_set_down_blocks_rays_and_is_near() {
    let mut world = empty(100, 100, Pose::new(0.0, 0.0, 0.3));
    let before = world.clone();
    let (from, angle) = (world.cell_centre(50, 10), 0.3 + std::f64::consts::FRAC_PI_2);
    assert!(world.raycast(from, angle, 40.0) > 39.0);
    let box_pose = Pose { position: world.cell_centre(50, 40), heading_rad: 1.0 };
    assert!(world.fill_rect(box_pose, 2.0, 1.0) >= 8);
    let seen = world.raycast(from, angle, 40.0);
    assert!((13.5..15.0).contains(&seen), "{seen}");
    let filled = world.fill_disc(world.cell_centre(20, 70), 1.2);
    assert!(filled >= 18, "{filled}");
    assert_eq!(world.fill_disc(world.cell_centre(20, 70), 1.2), 0);
    // Every corner and side of the shapes is covered, and distances see them at once.
    for k in 0..=20 {
        let along = f64::from(k) / 10.0 - 1.0;
        assert!(world.is_solid(box_pose.to_map(Point::new(0.999 * along, 0.499))));
        let round = crate::frames::heading_vector(along * 3.2) * 1.199;
        let p = world.cell_centre(20, 70) + round;
        assert_eq!(world.distance_m(p, 1.0), 0.0);
        let q = world.cell_centre(20, 60);
        let truth = distance_by_looking_everywhere(&world, q);
        assert!((world.distance_m(q, 99.0) - truth).abs() < 1e-9);
    }
    // Off the raster or beyond all measure there is nothing to fill, or everything.
    assert_eq!(world.fill_disc(Point::new(-500.0, 0.0), 1.0), 0);
    let mut all = before;
    assert_eq!(all.fill_disc(all.cell_centre(0, 0), 1e12), 10_000);
}

#[test]
fn a_disc_reaches_what_it_fits_through_to() {
    // A wall of 0.5 m cells with one gap of three cells, 1.5 m.
    let mut solid = vec![false; 40 * 20];
    for iy in 0..20 {
        solid[iy * 40 + 20] = !(9..12).contains(&iy);
    }
    let world = World::new(0.5, Pose::new(0.0, 0.0, 0.7), 40, 20, &solid);
    let (a, b) = (world.cell_centre(5, 5), world.cell_centre(35, 5));
    assert!(world.reachable(a, b, 0.7));
    assert!(!world.reachable(a, b, 0.8));
    assert!(!world.reachable(a, world.cell_centre(20, 3), 0.2), "goal in the wall");
    assert!(!world.reachable(world.cell_centre(0, 0), b, 0.3), "start against the wall");
    let length = world.path_length_m(a, b, 0.7).unwrap();
    // Straight: to the gap's edge and back, 2 x hypot(15, 5) cells at most.
    assert!((15.0..2.0 * 15.0f64.hypot(5.0) * 0.5 * 1.083).contains(&length), "{length}");
    assert_eq!(world.path_length_m(a, b, 0.8), None);
}
