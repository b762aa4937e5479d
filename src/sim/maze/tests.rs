use std::collections::BTreeSet;

use super::*;
use crate::sim::world::World;

const FAMILIES: [Family; 3] = [Family::Thin, Family::Solid, Family::Branching];

/// Free world cells that are joined to the start, corners included.
fn joined_to_start(maze: &Maze) -> Vec<(i64, i64)> {
    let world = &maze.world;
    let cell = |v: f64| (v / world.resolution_m()) as i64;
    let start = (cell(maze.start.position.x), cell(maze.start.position.y));
    let mut visited = vec![false; world.width() * world.height()];
    let mut stack = vec![start];
    let mut joined = Vec::new();
    while let Some((x, y)) = stack.pop() {
        if world.is_cell_solid(x, y) {
            continue;
        }
        let i = y as usize * world.width() + x as usize;
        if std::mem::replace(&mut visited[i], true) {
            continue;
        }
        joined.push((x, y));
        for dy in -1..=1 {
            stack.extend((-1..=1).map(|dx| (x + dx, y + dy)));
        }
    }
    joined
}

#[test]
fn every_maze_leads_from_corner_to_corner_with_room_for_the_car() {
    for family in FAMILIES {
        for seed in 0..200 {
            let maze = generate(family, seed, 0.25).unwrap();
            assert_eq!(maze.route[0], (0, 0));
            assert_eq!(maze.route[maze.route.len() - 1], (9, 9));
            for pair in maze.route.windows(2) {
                let (a, b) = (pair[0], pair[1]);
                assert_eq!(a.0.abs_diff(b.0) + a.1.abs_diff(b.1), 1, "{family:?} {seed}");
            }
            assert!(
                maze.world.reachable(maze.start.position, maze.goal, 0.25),
                "{family:?} {seed}"
            );
        }
    }
}

#[test]
fn no_place_of_a_route_is_blocked_and_the_car_faces_along_it() {
    for family in FAMILIES {
        for seed in 0..200 {
            let maze = generate(family, seed, 0.25).unwrap();
            for (i, j) in &maze.route {
                let centre = Point::new((f64::from(*i) + 0.5) * 2.5, (f64::from(*j) + 0.5) * 2.5);
                // Nothing nearer than the wall on the low side, whose face is at 1 m.
                assert!(maze.world.distance_m(centre, 2.0) > 1.0 - 1e-9);
            }
            let ahead = maze.start.to_map(Point::new(2.5, 0.0));
            let (i, j) = maze.route[1];
            let second = Point::new((f64::from(i) + 0.5) * 2.5, (f64::from(j) + 0.5) * 2.5);
            assert!((ahead - second).norm() < 1e-9);
        }
    }
}

#[test]
fn hallways_without_branches_are_closed_all_along() {
    for family in [Family::Thin, Family::Solid] {
        for seed in 0..200 {
            let maze = generate(family, seed, 0.25).unwrap();
            let route: BTreeSet<(u8, u8)> = maze.route.iter().copied().collect();
            assert_eq!(route.len(), maze.route.len(), "a route crosses itself");
            let mut reached = BTreeSet::new();
            for (x, y) in joined_to_start(&maze) {
                let cell = ((x / 10) as u8, (y / 10) as u8);
                assert!(route.contains(&cell), "{family:?} {seed}: a hole into {cell:?}");
                reached.insert(cell);
            }
            assert_eq!(reached, route);
            // A plug anywhere cuts the goal off: there is no way round.
            for k in [1, maze.route.len() / 2, maze.route.len() - 2] {
                let (i, j) = maze.route[k];
                let centre = Pose::new((f64::from(i) + 0.5) * 2.5, (f64::from(j) + 0.5) * 2.5, 0.0);
                let mut plugged = maze.clone();
                plugged.world.fill_rect(centre, 2.4, 2.4);
                assert!(!plugged.world.reachable(maze.start.position, maze.goal, 0.0));
            }
        }
    }
}

#[test]
fn off_the_route_a_solid_maze_is_solid_and_a_thin_one_hollow() {
    let off_route = |maze: &Maze| -> Vec<Point> {
        let cells = (0..10u8).flat_map(|j| (0..10u8).map(move |i| (i, j)));
        cells
            .filter(|cell| !maze.route.contains(cell))
            .map(|(i, j)| Point::new((f64::from(i) + 0.5) * 2.5, (f64::from(j) + 0.5) * 2.5))
            .collect()
    };
    for seed in 0..50 {
        let solid = generate(Family::Solid, seed, 0.1).unwrap();
        assert!(off_route(&solid).iter().all(|p| solid.world.is_solid(*p)));
        let thin = generate(Family::Thin, seed, 0.1).unwrap();
        assert!(off_route(&thin).iter().all(|p| !thin.world.is_solid(*p)));
    }
}

#[test]
fn the_families_have_the_lengths_and_corners_that_they_promise() {
    let mut thin_cells = 0;
    for seed in 0..200 {
        let thin = generate(Family::Thin, seed, 0.25).unwrap();
        assert!(thin.route.len() >= 70, "most of the area");
        assert!(100 * thin.corners() >= 40 * (thin.route.len() - 2), "thin {seed}");
        thin_cells += thin.route.len();
        let solid = generate(Family::Solid, seed, 0.25).unwrap();
        assert!(solid.route.len() >= 30);
        assert!(100 * solid.corners() >= 45 * (solid.route.len() - 2));
        let branching = generate(Family::Branching, seed, 0.25).unwrap();
        assert!(branching.route.len() >= 25);
    }
    assert!((80..=95).contains(&(thin_cells / 200)), "mean {}", thin_cells / 200);
}

#[test]
fn a_branching_maze_reaches_everywhere_and_has_dead_ends_and_loops() {
    for seed in 0..200 {
        let maze = generate(Family::Branching, seed, 0.25).unwrap();
        let cells: BTreeSet<(i64, i64)> =
            joined_to_start(&maze).iter().map(|(x, y)| (x / 10, y / 10)).collect();
        // Column and row 10 hold nothing but the closing walls.
        assert_eq!(cells.len(), 100);
        let open = |a: (i64, i64), b: (i64, i64)| {
            // The world cell in the middle of the line between two neighbours.
            let (x, y) = (5 * (a.0 + b.0 + 1), 5 * (a.1 + b.1 + 1));
            !maze.world.is_cell_solid(x, y)
        };
        let mut passages = 0;
        let mut dead_ends = 0;
        for j in 0..10 {
            for i in 0..10 {
                let ways = [(1, 0), (0, 1), (-1, 0), (0, -1)]
                    .iter()
                    .filter(|(di, dj)| {
                        let other = (i + di, j + dj);
                        (0..10).contains(&other.0)
                            && (0..10).contains(&other.1)
                            && open((i, j), other)
                    })
                    .count();
                passages += ways;
                dead_ends += usize::from(ways == 1);
            }
        }
        // A tree on 100 cells has 99 passages; each one more is a loop.
        assert_eq!(passages / 2, 99 + 6);
        assert!(dead_ends >= 10, "seed {seed}: {dead_ends} dead ends");
    }
}

#[test]
fn a_maze_follows_from_family_and_seed_alone() {
    let text = |maze: &Maze| -> String {
        let step = |w: &[(u8, u8)]| match (w[1].0 as i8 - w[0].0 as i8, w[1].1 as i8 - w[0].1 as i8)
        {
            (1, 0) => 'r',
            (0, 1) => 'u',
            (-1, 0) => 'l',
            _ => 'd',
        };
        maze.route.windows(2).map(step).collect()
    };
    // Written down once: a change here changes every recorded result.
    let expected = [
        (
            Family::Thin,
            "urdrrululurrdrdrdrrruruuulddluulddluuuruuullddddluldlulurrurulldluurrrrrrrddrdldrruuulur",
        ),
        (Family::Solid, "rurrrulullluuuuurdrurrrurdrurr"),
        (Family::Branching, "ruuluurrrrrddrruruuruuuu"),
    ];
    for (family, route) in expected {
        let fine = generate(family, 7, 0.05).unwrap();
        let coarse = generate(family, 7, 0.1).unwrap();
        assert_eq!(text(&fine), route, "{family:?}");
        assert_eq!(fine.route, coarse.route);
        assert_eq!(coarse, generate(family, 7, 0.1).unwrap());
        assert_ne!(coarse.route, generate(family, 8, 0.1).unwrap().route);
        assert_eq!((fine.world.width(), coarse.world.width()), (501, 251));
    }
}

#[test]
fn a_maze_written_as_a_map_is_the_same_world() {
    for family in FAMILIES {
        let maze = generate(family, 3, 0.1).unwrap();
        assert_eq!(World::from_map(&maze.to_map_file()), maze.world);
    }
}

#[test]
fn a_resolution_that_does_not_fit_the_hallway_is_refused() {
    for resolution_m in [0.3, 0.0, -0.1, f64::NAN, f64::INFINITY, 0.001, 2.5] {
        let error = generate(Family::Thin, 1, resolution_m).unwrap_err();
        assert!(error.to_string().contains("resolution"), "{error}");
    }
}
