//! Worlds of rectangles, guides on cells and a plain speed pass, for tests of smoothing.

use crate::frames::Point;
use crate::plan::Path;
use crate::plan::bubbles::ClearanceField;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Axis-aligned solid rectangles; distances exact, capped at 2 m.
pub struct Rectangles(pub Vec<[f64; 4]>);

impl ClearanceField for Rectangles {
    fn clearance_m(&self, p: Point) -> f64 {
        let squared = self.0.iter().map(|r| {
            let dx = (r[0] - p.x).max(p.x - r[2]).max(0.0);
            let dy = (r[1] - p.y).max(p.y - r[3]).max(0.0);
            dx * dx + dy * dy
        });
        squared.fold(4.0, f64::min).sqrt()
    }
}

pub const CELL_M: f64 = 2.5;
const HALF_WALL_M: f64 = 0.05;

pub fn cell_centre(cell: (i32, i32)) -> Point {
    Point::new((f64::from(cell.0) + 0.5) * CELL_M, (f64::from(cell.1) + 0.5) * CELL_M)
}

/// Walls along every side of a route's cells that the route does not cross.
pub fn corridor(route: &[(i32, i32)]) -> Rectangles {
    let mut walls = Vec::new();
    for (i, &(x, y)) in route.iter().enumerate() {
        for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1)] {
            let beside = (x + dx, y + dy);
            let before = i > 0 && route[i - 1] == beside;
            if before || route.get(i + 1) == Some(&beside) {
                continue;
            }
            let c = cell_centre((x, y));
            let (mx, my) = (c.x + 0.5 * CELL_M * f64::from(dx), c.y + 0.5 * CELL_M * f64::from(dy));
            let long = 0.5 * CELL_M + HALF_WALL_M;
            let (hx, hy) = if dx == 0 { (long, HALF_WALL_M) } else { (HALF_WALL_M, long) };
            walls.push([mx - hx, my - hy, mx + hx, my + hy]);
        }
    }
    Rectangles(walls)
}

/// A random self-avoiding route of exactly `cells` cells on 10 x 10, with frequent turns.
pub fn random_route(seed: u64, cells: usize) -> Vec<(i32, i32)> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    loop {
        let mut route = vec![(0, 0)];
        while route.len() < cells {
            let (x, y) = route[route.len() - 1];
            let open: Vec<_> = [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)]
                .into_iter()
                .filter(|c| (0..10).contains(&c.0) && (0..10).contains(&c.1))
                .filter(|c| !route.contains(c))
                .collect();
            if open.is_empty() {
                break;
            }
            route.push(open[rng.random_range(0..open.len())]);
        }
        if route.len() == cells {
            return route;
        }
    }
}

/// Shortest way on 8-connected 0.1 m cells whose centres keep `keep_m`, without cutting corners.
pub fn guide_on_cells(
    field: &impl ClearanceField,
    from: Point,
    to: Point,
    keep_m: f64,
) -> Vec<Point> {
    const CELLS: i32 = 260;
    const STEP_M: f64 = 0.1;
    let centre = |i: i32| {
        Point::new(
            (f64::from(i % CELLS) + 0.5) * STEP_M - 0.5,
            (f64::from(i / CELLS) + 0.5) * STEP_M - 0.5,
        )
    };
    let index = |p: Point| {
        let cell = |v: f64| ((v + 0.5) / STEP_M).floor() as i32;
        cell(p.y) * CELLS + cell(p.x)
    };
    let free: Vec<bool> =
        (0..CELLS * CELLS).map(|i| field.clearance_m(centre(i)) >= keep_m).collect();
    let (start, goal) = (index(from), index(to));
    let mut best = vec![u64::MAX; free.len()];
    let mut parent = vec![-1; free.len()];
    let mut heap = BinaryHeap::from([Reverse((0_u64, start))]);
    best[start as usize] = 0;
    while let Some(Reverse((cost, at))) = heap.pop() {
        if at == goal {
            break;
        }
        if cost > best[at as usize] {
            continue;
        }
        for (dx, dy) in [(1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (-1, 1), (-1, -1), (1, -1)] {
            let (x, y) = (at % CELLS + dx, at / CELLS + dy);
            if !(0..CELLS).contains(&x) || !(0..CELLS).contains(&y) {
                continue;
            }
            let next = y * CELLS + x;
            let sides = free[(at + dx) as usize] && free[(at + dy * CELLS) as usize];
            if !free[next as usize] || !sides {
                continue;
            }
            let total = cost + if dx != 0 && dy != 0 { 14142 } else { 10000 };
            if total < best[next as usize] {
                best[next as usize] = total;
                parent[next as usize] = at;
                heap.push(Reverse((total, next)));
            }
        }
    }
    assert!(best[goal as usize] < u64::MAX, "the test's world has a way");
    let mut guide = vec![to];
    let mut at = parent[goal as usize];
    while at >= 0 && at != start {
        guide.push(centre(at));
        at = parent[at as usize];
    }
    guide.push(from);
    guide.reverse();
    guide
}

/// Squared speeds of the fastest way along a path from a start speed to rest, (m/s)^2; `None` if
/// a bend cannot be entered. Forward and backward passes on the friction circle.
pub fn fastest(path: &Path, grip: f64, speed_max: f64, start_speed: f64) -> Option<Vec<f64>> {
    let p = &path.points;
    let cap = |k: f64| (grip / k.abs().max(1e-9)).min(speed_max * speed_max);
    let mut b: Vec<f64> = p.iter().map(|p| cap(p.curvature_pm)).collect();
    let last = b.len() - 1;
    let gain = |b: f64, i: usize, ds: f64| {
        let lateral = p[i].curvature_pm * b;
        2.0 * ds * (grip * grip - lateral * lateral).max(0.0).sqrt()
    };
    b[last] = 0.0;
    for i in (0..last).rev() {
        let ds = p[i + 1].s_m - p[i].s_m;
        b[i] = b[i].min(b[i + 1] + gain(b[i + 1], i + 1, ds));
    }
    let energy = start_speed * start_speed;
    if energy > b[0] * 1.03 + 1e-9 {
        return None;
    }
    b[0] = energy.min(b[0]);
    for i in 0..last {
        let ds = p[i + 1].s_m - p[i].s_m;
        b[i + 1] = b[i + 1].min(b[i] + gain(b[i], i, ds));
    }
    Some(b)
}

/// Time along a path driven at these squared speeds, seconds.
pub fn travel_time_s(path: &Path, b: &[f64]) -> f64 {
    let steps = path.points.windows(2).zip(b.windows(2));
    steps.map(|(p, b)| 2.0 * (p[1].s_m - p[0].s_m) / (b[0].sqrt() + b[1].sqrt())).sum()
}
