//! The grid search over whole maps, and the manoeuvre out of a dead end.

use apexd::frames::{Point, Pose};
use apexd::map::{Cell, CellRect};
use apexd::plan::search::{
    GuideSearch, ManoeuvreParams, ManoeuvreQuery, ManoeuvreSearch, MaskRoom, SearchParams,
    SearchQuery, Terrain,
};
use apexd::predict::NoPrediction;
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;

struct Map {
    bounds: CellRect,
    cells: Vec<Cell>,
    lethal: Vec<bool>,
    blocked: Vec<bool>,
}

impl Map {
    fn new(width: i32, height: i32, cell: impl Fn(i32, i32) -> Cell) -> Self {
        let bounds = CellRect { x0: 0, y0: 0, x1: width, y1: height };
        let cells: Vec<Cell> = (0..width * height).map(|at| cell(at % width, at / width)).collect();
        // The disc of 0.2 m by the squares of the cells around.
        let near = |x: i32, y: i32, hit: &dyn Fn(Cell) -> bool| {
            (-2..=2).any(|dy: i32| {
                (-2..=2).any(|dx: i32| {
                    let gap = |d: i32| f64::from(d.abs()) * 0.1 - 0.05;
                    let (gx, gy) = (gap(dx).max(0.0), gap(dy).max(0.0));
                    let (nx, ny) = (x + dx, y + dy);
                    gx * gx + gy * gy < 0.2 * 0.2
                        && (0..width).contains(&nx)
                        && (0..height).contains(&ny)
                        && hit(cells[(ny * width + nx) as usize])
                })
            })
        };
        let mask = |hit: &dyn Fn(Cell) -> bool| {
            (0..width * height).map(|at| near(at % width, at / width, hit)).collect()
        };
        let lethal = mask(&|c| c == Cell::Occupied);
        let blocked = mask(&|c| c != Cell::Free);
        Self { bounds, cells, lethal, blocked }
    }

    fn terrain(&self) -> Terrain<'_> {
        let Self { bounds, cells, lethal, .. } = self;
        Terrain { resolution_m: 0.1, bounds: *bounds, cells, lethal }
    }
}

/// Corridors of 2.5 m that wind from the bottom to the top of a square of 25 m.
fn winding(x: i32, y: i32) -> Cell {
    let wall_y = y % 25 == 0 && if y / 25 % 2 == 0 { x >= 25 } else { x < 225 };
    let rim = x == 0 || y == 0 || x == 249 || y == 249;
    if rim || wall_y { Cell::Occupied } else { Cell::Free }
}

/// 90 m by 70 m with a pillar in every square of 3 m; known below, unknown above.
fn pillars(x: i32, y: i32) -> Cell {
    let hash = (x / 30 * 7919 + y / 30 * 104_729) % 20;
    let (dx, dy) = (x % 30 - 5 - hash, y % 30 - 24 + hash);
    if y > 400 {
        Cell::Unknown
    } else if dx.abs() < 4 && dy.abs() < 5 {
        Cell::Occupied
    } else {
        Cell::Free
    }
}

fn search(c: &mut Criterion) {
    let mut group = c.benchmark_group("search");
    let ask = |start: (f64, f64), goal: (f64, f64)| SearchQuery {
        start: Point::new(start.0, start.1),
        goal: Point::new(goal.0, goal.1),
        goal_radius_m: 0.0,
        v_ref_mps: 4.0,
        through_unknown: true,
    };
    let params = SearchParams::default();
    let half = |x, y| if y > 125 { Cell::Unknown } else { winding(x, y) };
    let cases = [
        ("maze 250x250 known", Map::new(250, 250, winding), ask((24.0, 1.2), (1.2, 24.0))),
        ("maze 250x250 half known", Map::new(250, 250, half), ask((24.0, 1.2), (1.2, 24.0))),
        ("hall 900x700 half known", Map::new(900, 700, pillars), ask((1.0, 1.0), (88.0, 68.0))),
        (
            "hall 900x700 enclosed goal",
            Map::new(900, 700, |x, y| {
                let (dx, dy) = ((x - 850).abs(), (y - 650).abs());
                if dx.max(dy) == 30 { Cell::Occupied } else { pillars(x, y.min(400)) }
            }),
            ask((1.0, 1.0), (85.0, 65.0)),
        ),
    ];
    for (name, map, query) in &cases {
        let mut search = GuideSearch::new();
        let result = search.find(&map.terrain(), query, &mut NoPrediction, &params);
        match &result {
            Ok(guide) => eprintln!("{name}: {} expanded, {} asked", guide.expanded, guide.asked),
            Err(error) => eprintln!("{name}: {error}"),
        }
        group.bench_function(*name, |b| {
            b.iter(|| black_box(search.find(&map.terrain(), query, &mut NoPrediction, &params)));
        });
    }
    group.finish();
}

fn manoeuvre(c: &mut Criterion) {
    // A dead end of 2.4 m, the car before its end wall, the goal behind the car.
    let corridor = |x: i32, y: i32| {
        let wall = x == 79 || y == 0 || y == 25 || y > 25;
        if wall { Cell::Occupied } else { Cell::Free }
    };
    let map = Map::new(80, 40, corridor);
    let mut group = c.benchmark_group("manoeuvre");
    let pose = Pose::new(6.9, 1.3, 0.0);
    let query = SearchQuery {
        start: pose.position,
        goal: Point::new(0.5, 1.3),
        goal_radius_m: 0.0,
        v_ref_mps: 4.0,
        through_unknown: true,
    };
    let params = SearchParams::default();
    let guide = GuideSearch::new()
        .find(&map.terrain(), &query, &mut NoPrediction, &params)
        .expect("the corridor is open");
    let room = MaskRoom { resolution_m: 0.1, bounds: map.bounds, blocked: &map.blocked };
    for (name, pose) in [
        ("dead end", pose),
        ("sideways", Pose::new(6.0, 1.3, 1.5)),
        ("nose on", Pose::new(7.3, 1.6, 0.0)),
    ] {
        let query = ManoeuvreQuery {
            pose,
            speed_mps: 0.0,
            guide: &guide,
            curvature_limit_pm: 2.0,
            acceleration_limit_mps2: 8.829,
        };
        let params = ManoeuvreParams::default();
        let mut search = ManoeuvreSearch::default();
        match search.find(&room, &query, &params) {
            Ok(Some(found)) => eprintln!(
                "{name}: {} expanded, {:.2} m, joins at {:?}",
                found.expanded,
                found.path.length_m(),
                found.joins_at
            ),
            other => eprintln!("{name}: {other:?}"),
        }
        group.bench_function(name, |b| {
            b.iter(|| black_box(search.find(&room, &query, &params)));
        });
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(30).warm_up_time(std::time::Duration::from_millis(300))
        .measurement_time(std::time::Duration::from_secs(1));
    targets = search, manoeuvre
}
criterion_main!(benches);
