//! What the grid makes of scans of small worlds, whose geometry is their own.

use super::*;
use crate::frames::heading_vector;
use crate::time::Instant;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

const RANGE_M: f64 = 7.5;

/// A rectangular obstacle: centre, half sides, heading. Geometry of its own.
#[derive(Clone, Copy, Debug)]
struct Block {
    pose: Pose,
    half: Vector,
}

impl Block {
    fn aligned(x0: f64, y0: f64, x1: f64, y1: f64) -> Self {
        let pose = Pose::new(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0);
        Self { pose, half: Vector::new(0.5 * (x1 - x0), 0.5 * (y1 - y0)) }
    }

    /// How deep a point lies inside, metres; negative outside.
    fn depth(&self, p: Point) -> f64 {
        let q = self.pose.to_body(p);
        (self.half.x - q.x.abs()).min(self.half.y - q.y.abs())
    }

    /// Distance along a ray to the first side, by intersecting all four.
    fn cast(&self, from: Point, direction: Vector) -> f64 {
        let corner =
            |sx: f64, sy: f64| self.pose.to_map(Point::new(sx * self.half.x, sy * self.half.y));
        let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        let mut nearest = f64::INFINITY;
        for i in 0..4 {
            let (a, b) = (corners[i], corners[(i + 1) % 4]);
            let side = b - a;
            let det = direction.perp(&side);
            let (t, s) = ((a - from).perp(&side) / det, (a - from).perp(&direction) / det);
            if t >= 0.0 && (0.0..=1.0).contains(&s) {
                nearest = nearest.min(t);
            }
        }
        nearest
    }
}

fn lidar(world: &[Block], truth: &Pose, beams: usize) -> Scan {
    let step = TAU / beams as f64;
    let ranges_m = (0..beams)
        .map(|i| {
            let direction = heading_vector(truth.heading_rad + step * i as f64);
            let cast = |b: &Block| b.cast(truth.position, direction);
            let range = world.iter().map(cast).fold(RANGE_M, f64::min);
            // Millimetres, as on the wire.
            ((range * 1000.0).round() / 1000.0) as f32
        })
        .collect();
    Scan {
        stamp: Instant::ZERO,
        sequence: 0,
        angle_first_rad: 0.0,
        angle_step_rad: step,
        range_max_m: RANGE_M,
        ranges_m,
    }
}

/// Walls of one cell around a corridor with a bend, all on cell boundaries.
fn corridor() -> Vec<Block> {
    vec![
        Block::aligned(-2.0, -1.3, 6.0, -1.2),
        Block::aligned(-2.0, 1.2, 3.5, 1.3),
        Block::aligned(3.4, 1.3, 3.5, 6.0),
        Block::aligned(6.0, -1.3, 6.1, 6.0),
        Block::aligned(-2.1, -1.3, -2.0, 1.3),
    ]
}

fn random_world(rng: &mut ChaCha8Rng, rotated: bool) -> Vec<Block> {
    let mut world = Vec::new();
    while world.len() < 14 {
        let block = if rotated {
            let (x, y) = (rng.random_range(-7.0..7.0), rng.random_range(-7.0..7.0));
            let half = Vector::new(rng.random_range(0.06..1.5), rng.random_range(0.06..0.6));
            Block { pose: Pose::new(x, y, rng.random_range(-3.0..3.0)), half }
        } else {
            let mut cell = |low: i32, high: i32| f64::from(rng.random_range(low..high)) * 0.1;
            let (x, y) = (cell(-70, 60), cell(-70, 60));
            Block::aligned(x, y, x + cell(1, 30), y + cell(1, 12))
        };
        if block.depth(Point::origin()) < -1.0 {
            world.push(block);
        }
    }
    world
}

fn cells(grid: &Grid, kind: Cell) -> Vec<CellIndex> {
    let bounds = grid.bounds();
    (bounds.y0..bounds.y1)
        .flat_map(|iy| (bounds.x0..bounds.x1).map(move |ix| CellIndex::new(ix, iy)))
        .filter(|c| grid.get(*c) == kind)
        .collect()
}

/// The quarters seen of cells that are not free, as cells of a grid twice as fine.
fn seen_quarters(grid: &Grid) -> Vec<CellIndex> {
    let fine = Grid::new(0.5 * grid.resolution_m());
    let cells = cells(grid, Cell::Unknown).into_iter().chain(cells(grid, Cell::Occupied));
    let quarters = cells
        .flat_map(|c| (0..4).map(move |k| CellIndex::new(2 * c.ix + (k & 1), 2 * c.iy + (k >> 1))));
    quarters.filter(|q| grid.state_at(fine.centre(*q)) == Cell::Free).collect()
}

/// Deepest point of a cell's square inside an obstacle, on a dense lattice with its corners.
fn intrusion(world: &[Block], grid: &Grid, c: CellIndex) -> f64 {
    let h = grid.resolution_m();
    let centre = grid.centre(c);
    let near: Vec<_> = world.iter().filter(|b| b.depth(centre) > -h).collect();
    let mut deepest = if near.is_empty() { -h } else { f64::NEG_INFINITY };
    for i in 0..=10 {
        for j in 0..=10 {
            let p = Point::new(
                (f64::from(c.ix) + 0.1 * f64::from(i)) * h,
                (f64::from(c.iy) + 0.1 * f64::from(j)) * h,
            );
            deepest = near.iter().map(|b| b.depth(p)).fold(deepest, f64::max);
        }
    }
    deepest
}

/// Deepest point inside an obstacle on the way from the sensor to a point.
fn hidden_behind(world: &[Block], sensor: Point, p: Point) -> f64 {
    (0..=100)
        .map(|i| sensor + (p - sensor) * (f64::from(i) / 100.0))
        .flat_map(|q| world.iter().map(move |b| b.depth(q)))
        .fold(f64::NEG_INFINITY, f64::max)
}

proptest! {
    #![proptest_config(ProptestConfig {
        failure_persistence: None,
        ..ProptestConfig::with_cases(16)
    })]

    #[test]
    fn in_a_world_on_the_cells_no_wall_is_ever_free(
        seed in 0u64..10_000, x in -0.5f64..0.5, y in -0.5f64..0.5, heading in -3.1f64..3.1,
    ) {
        let world = random_world(&mut ChaCha8Rng::seed_from_u64(seed), false);
        let mut mapper = Mapper::new(&MapParams::default());
        for i in 0..3 {
            let pose = Pose::new(x + 0.07 * f64::from(i), y, heading);
            mapper.insert(&pose, &lidar(&world, &pose, 1080));
        }
        let free = cells(mapper.grid(), Cell::Free);
        prop_assert!(free.len() > 300);
        for c in free {
            prop_assert!(intrusion(&world, mapper.grid(), c) < 1e-6, "{c:?}");
        }
        let occupied = cells(mapper.grid(), Cell::Occupied);
        let depths = occupied.iter().map(|c| intrusion(&world, mapper.grid(), *c));
        let (mut beside, mut count) = (0, 0);
        for depth in depths {
            // A rounded range may cut a corner; then the cell at least touches the wall.
            prop_assert!(depth > -1e-3, "{depth}");
            beside += usize::from(depth < 0.01);
            count += 1;
        }
        prop_assert!(beside * 50 <= count, "{beside} of {count}");
    }

    #[test]
    fn what_stands_in_a_free_cell_is_thinner_than_the_beams_are_apart(
        seed in 0u64..10_000, x in -0.5f64..0.5, y in -0.5f64..0.5, heading in -3.1f64..3.1,
        fine: bool,
    ) {
        let world = random_world(&mut ChaCha8Rng::seed_from_u64(seed), true);
        let params =
            MapParams { resolution_m: if fine { 0.05 } else { 0.1 }, ..Default::default() };
        let mut mapper = Mapper::new(&params);
        let pose = Pose::new(x, y, heading);
        let scan = lidar(&world, &pose, 1080);
        let insertion = mapper.insert(&pose, &scan);
        prop_assert!(insertion.newly_free > 300);
        let free = cells(mapper.grid(), Cell::Free);
        for c in free.into_iter().step_by(if fine { 20 } else { 5 }) {
            let centre = mapper.grid().centre(c);
            let apart = (centre - pose.position).norm() * scan.angle_step_rad;
            let slack = apart + params.free_tolerance_m + 0.005;
            prop_assert!(intrusion(&world, mapper.grid(), c) < slack, "{c:?}");
            prop_assert!(hidden_behind(&world, pose.position, centre) < slack, "{c:?}");
        }
        let quarters = seen_quarters(mapper.grid());
        prop_assert_eq!(quarters.is_empty(), fine, "quarters of small cells are all rim");
        let grid = Grid::new(0.5 * params.resolution_m);
        // Farther away the slack is as wide as a quarter.
        let near = |q: &CellIndex| (grid.centre(*q) - pose.position).norm() < 4.0;
        for q in quarters.into_iter().filter(near) {
            let centre = grid.centre(q);
            let apart = (centre - pose.position).norm() * scan.angle_step_rad;
            let slack = apart + params.free_tolerance_m + 0.005;
            prop_assert!(intrusion(&world, &grid, q) < slack, "{q:?}");
            prop_assert!(hidden_behind(&world, pose.position, centre) < slack, "{q:?}");
        }
    }

    #[test]
    fn what_is_plainly_in_view_is_free(
        seed in 0u64..10_000, x in -0.5f64..0.5, y in -0.5f64..0.5, heading in -3.1f64..3.1,
    ) {
        let world = random_world(&mut ChaCha8Rng::seed_from_u64(seed), true);
        let mut mapper = Mapper::new(&MapParams::default());
        let pose = Pose::new(x, y, heading);
        mapper.insert(&pose, &lidar(&world, &pose, 1080));
        for iy in (-50..50).step_by(2) {
            for ix in (-50..50).step_by(3) {
                // A cell that can be seen with a beam's spacing to spare all around.
                let centre = mapper.grid().centre(CellIndex::new(ix, iy));
                if (centre - pose.position).norm() > 6.0 {
                    continue;
                }
                let seen = (0..16).all(|i| {
                    let p = centre + heading_vector(TAU * f64::from(i) / 16.0) * 0.16;
                    let length = (p - pose.position).norm();
                    let direction = (p - pose.position) / length;
                    world.iter().all(|b| b.cast(pose.position, direction) > length)
                });
                if seen {
                    prop_assert_eq!(mapper.grid().get(CellIndex::new(ix, iy)), Cell::Free);
                }
            }
        }
    }

    #[test]
    fn drift_of_two_centimetres_turns_no_cell(seed in 0u64..10_000) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let world = corridor();
        let mut mapper = Mapper::new(&MapParams::default());
        let mut seen = vec![];
        for i in 0..20 {
            let truth = Pose::new(0.2 * f64::from(i), 0.02 * f64::from(i % 7), 0.01);
            let mut off = |limit: f64| rng.random_range(-limit..limit);
            let believed = Pose::new(
                truth.position.x + off(0.014),
                truth.position.y + off(0.014),
                truth.heading_rad + off(0.001),
            );
            let insertion = mapper.insert(&believed, &lidar(&world, &truth, 1080));
            prop_assert_eq!(insertion.turned_occupied, 0);
            // Nothing known is ever forgotten.
            let free = cells(mapper.grid(), Cell::Free);
            prop_assert!(seen.iter().all(|c| mapper.grid().get(*c) == Cell::Free));
            seen = free;
        }
    }
}

#[test]
fn walls_of_a_corridor_become_occupied_and_the_floor_up_to_them_free() {
    let world = corridor();
    let mut mapper = Mapper::new(&MapParams::default());
    let pose = Pose::new(0.03, 0.04, 0.2);
    let first = mapper.insert(&pose, &lidar(&world, &pose, 1080));
    assert_eq!((first.turned_occupied, first.refused), (0, None));
    assert_eq!(first.newly_free, cells(mapper.grid(), Cell::Free).len());
    assert_eq!(first.newly_occupied, cells(mapper.grid(), Cell::Occupied).len());
    for ix in -15..30 {
        for iy in -12..12 {
            assert_eq!(mapper.grid().get(CellIndex::new(ix, iy)), Cell::Free, "{ix} {iy}");
        }
    }
    for ix in -10..15 {
        assert_eq!(mapper.grid().get(CellIndex::new(ix, 12)), Cell::Occupied, "{ix}");
        assert_eq!(mapper.grid().get(CellIndex::new(ix, -13)), Cell::Occupied, "{ix}");
    }
    let changed = cells(mapper.grid(), Cell::Free);
    assert!(changed.iter().all(|c| first.changed.contains(*c)));
    // The same again teaches nothing and copies nothing.
    let kept = mapper.snapshot();
    let again = mapper.insert(&pose, &lidar(&world, &pose, 1080));
    assert_eq!(again, Insertion::default());
    assert!(Arc::ptr_eq(&kept, &mapper.snapshot()));
}

#[test]
fn the_one_frontier_of_a_bend_lies_round_it() {
    let world = corridor();
    let mut mapper = Mapper::new(&MapParams::default());
    // Walls seen at grazing angles are full of gaps, from every place.
    for i in 0..12 {
        let pose = Pose::new(-0.5 + 0.19 * f64::from(i), 0.3 - 0.05 * f64::from(i), 0.1);
        mapper.insert(&pose, &lidar(&world, &pose, 1080));
        let mut field = crate::map::DistanceField::new(crate::map::Blocking::Occupied, 1.5);
        field.update(mapper.grid(), CellRect::EMPTY);
        let start = mapper.grid().cell_at(pose.position);
        let found = crate::map::frontiers(mapper.grid(), &field, start, 0.2);
        assert_eq!(found.len(), 1, "{pose:?} {found:?}");
        let at = mapper.grid().centre(found[0].representative);
        assert!(at.x > 3.5 && at.y > 0.0, "{at}");
    }
}

#[test]
fn an_object_set_down_in_free_space_is_reported_and_stays() {
    let mut world = corridor();
    let mut mapper = Mapper::new(&MapParams::default());
    let pose = Pose::new(0.0, 0.0, 0.0);
    mapper.insert(&pose, &lidar(&world, &pose, 1080));
    let held = mapper.snapshot();
    world.push(Block { pose: Pose::new(2.53, 0.18, 0.4), half: Vector::new(0.06, 0.06) });
    let insertion = mapper.insert(&pose, &lidar(&world, &pose, 1080));
    assert!(insertion.turned_occupied >= 1);
    assert_eq!((insertion.newly_free, insertion.newly_occupied), (0, 0));
    let occupied: Vec<_> = cells(mapper.grid(), Cell::Occupied)
        .into_iter()
        .filter(|c| insertion.changed.contains(*c))
        .collect();
    assert_eq!(occupied.len(), insertion.turned_occupied);
    assert!(occupied.iter().all(|c| held.get(*c) == Cell::Free));
    // Taken away again: occupied stays occupied.
    world.pop();
    let after = mapper.insert(&pose, &lidar(&world, &pose, 1080));
    assert_eq!((after.newly_free, after.changed), (0, CellRect::EMPTY));
    assert!(occupied.iter().all(|c| mapper.grid().get(*c) == Cell::Occupied));
}

/// Distance from a point to the nearest quarter of an occupied cell that was not seen to be free.
fn clearance_of_occupied(grid: &Grid, p: Point) -> f64 {
    let quarters = cells(grid, Cell::Occupied).into_iter().flat_map(|c| grid.blocked_quarters(c));
    let beyond = |v: f64, i: i32| {
        let low = 0.05 * f64::from(i);
        (low - v).max(v - low - 0.05).max(0.0)
    };
    quarters.map(|q| beyond(p.x, q.ix).hypot(beyond(p.y, q.iy))).fold(f64::INFINITY, f64::min)
}

#[test]
fn what_is_set_down_on_a_quarter_that_was_seen_is_reported_and_takes_it_back() {
    let world = corridor();
    let pose = Pose::new(0.0, 0.03, 0.1);
    let mut mapper = Mapper::new(&MapParams::default());
    mapper.insert(&pose, &lidar(&world, &pose, 1080));
    let fine = Grid::new(0.05);
    let (mut turned, mut beside) = (0, 0);
    for q in seen_quarters(mapper.grid()) {
        let centre = fine.centre(q);
        let away = centre - pose.position;
        // Away from all else that could explain a hit, and no thinner than beams are apart.
        if away.norm() > 6.0 || world.iter().any(|b| b.depth(centre) > -0.1) {
            continue;
        }
        let mut mapper = mapper.clone();
        let thing = Block {
            pose: Pose { position: centre, heading_rad: 0.0 },
            half: Vector::repeat(0.025),
        };
        let mut world = world.clone();
        world.push(thing);
        let insertion = mapper.insert(&pose, &lidar(&world, &pose, 1080));
        // A hit right before unknown space is booked to that.
        assert!(insertion.turned_occupied + insertion.newly_occupied > 0, "{q:?}");
        if insertion.turned_occupied == 0 {
            beside += 1;
            assert!(clearance_of_occupied(mapper.grid(), centre) < 0.025 + 0.03, "{q:?}");
        } else {
            turned += 1;
            assert!(clearance_of_occupied(mapper.grid(), centre) < 0.025 + 1e-9, "{q:?}");
        }
    }
    assert!(turned > 5, "{turned}, {beside} beside");
}

#[test]
fn silent_beams_free_and_occupy_nothing() {
    let world = corridor();
    let mut mapper = Mapper::new(&MapParams::default());
    let pose = Pose::new(0.0, 0.0, 0.0);
    let mut scan = lidar(&world, &pose, 1080);
    scan.ranges_m.fill(f32::NAN);
    assert_eq!(mapper.insert(&pose, &scan), Insertion::default());
    let mut scan = lidar(&world, &pose, 1080);
    // A quarter turn ahead is silent.
    for i in (0..135).chain(945..1080) {
        scan.ranges_m[i] = f32::NAN;
    }
    mapper.insert(&pose, &scan);
    for c in cells(mapper.grid(), Cell::Free) {
        let p = mapper.grid().centre(c);
        assert!(p.x < p.y.abs() + 1e-9, "{c:?}");
    }
    assert_eq!(mapper.grid().get(CellIndex::new(-5, 0)), Cell::Free);
}

#[test]
fn no_return_frees_up_to_the_range_and_occupies_nothing() {
    let mut mapper = Mapper::new(&MapParams::default());
    let pose = Pose::new(0.02, 0.01, 0.0);
    let mut scan = lidar(&[], &pose, 1080);
    let insertion = mapper.insert(&pose, &scan);
    assert_eq!(insertion.newly_occupied, 0);
    assert_eq!(mapper.grid().get(CellIndex::new(72, 0)), Cell::Free);
    assert_eq!(mapper.grid().get(CellIndex::new(75, 0)), Cell::Unknown);
    let area = insertion.newly_free as f64 * 0.01;
    assert!((0.97..1.0).contains(&(area / (std::f64::consts::PI * RANGE_M * RANGE_M))));
    scan.ranges_m.fill(f32::INFINITY);
    assert_eq!(mapper.insert(&pose, &scan), Insertion::default());
}

#[test]
fn the_footprint_is_free_but_never_overrides_an_obstacle() {
    let mut mapper = Mapper::new(&MapParams::default());
    let position = Point::new(5.02, -3.01);
    let insertion = mapper.mark_footprint(position, 0.2);
    assert!(insertion.newly_free >= 4);
    for c in cells(mapper.grid(), Cell::Free) {
        let far = (mapper.grid().centre(c) - position).abs() + Vector::repeat(0.05);
        assert!(far.norm() <= 0.2 && insertion.changed.contains(c));
    }
    let c = mapper.grid().cell_at(position);
    Arc::make_mut(&mut mapper.grid).set(c, Cell::Occupied);
    assert_eq!(mapper.mark_footprint(position, 0.2), Insertion::default());
    assert_eq!(mapper.grid().get(c), Cell::Occupied);
}

#[test]
fn unusable_scans_are_refused_with_a_reason() {
    let mut mapper = Mapper::new(&MapParams::default());
    let pose = Pose::new(0.0, 0.0, 0.0);
    let good = lidar(&corridor(), &pose, 1080);
    let cases = [
        (Pose::new(f64::NAN, 0.0, 0.0), good.clone()),
        (Pose::new(0.0, 0.0, f64::INFINITY), good.clone()),
        (Pose::new(1e12, 0.0, 0.0), good.clone()),
        (pose, Scan { angle_step_rad: 0.0, ..good.clone() }),
        (pose, Scan { angle_step_rad: f64::NAN, ..good.clone() }),
        (pose, Scan { angle_first_rad: f64::NAN, ..good.clone() }),
        (pose, Scan { range_max_m: -1.0, ..good.clone() }),
    ];
    for (pose, scan) in cases {
        let insertion = mapper.insert(&pose, &scan);
        assert!(matches!(insertion.refused, Some(Refusal::BadNumber { .. })), "{insertion:?}");
    }
    assert!(mapper.grid().bounds().is_empty());
    mapper.insert(&pose, &good);
    let insertion = mapper.insert(&Pose::new(9e5, 9e5, 0.0), &good);
    assert!(matches!(insertion.refused, Some(Refusal::TooLarge { .. })));
    for ranges_m in [vec![], vec![3.0], vec![3.0, 2.0]] {
        let few = Scan { ranges_m, ..good.clone() };
        assert_eq!(mapper.insert(&pose, &few).newly_free, 0);
    }
}

#[test]
fn a_scan_turned_round_gives_the_same_grid() {
    let pose = Pose::new(0.3, -0.2, 0.7);
    let forward = lidar(&corridor(), &pose, 1080);
    let mut ranges_m = forward.ranges_m.clone();
    ranges_m.reverse();
    let backward = Scan {
        angle_first_rad: forward.angle_rad(1079),
        angle_step_rad: -forward.angle_step_rad,
        ranges_m,
        ..forward.clone()
    };
    let mut grids = vec![];
    for scan in [forward, backward] {
        let mut mapper = Mapper::new(&MapParams::default());
        mapper.insert(&pose, &scan);
        grids.push(mapper.snapshot());
    }
    assert_eq!(grids[0], grids[1]);
}
