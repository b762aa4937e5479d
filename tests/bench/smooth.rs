//! Time to shape a path of 20 m through a winding corridor, on a sampled distance field.

use apexd::frames::{Point, Pose};
use apexd::plan::bubbles::ClearanceField;
use apexd::plan::smooth::{SmoothParams, SmoothRequest, Smoother};
use criterion::{Criterion, criterion_group, criterion_main};
use std::hint::black_box;

/// Distances on a 0.1 m grid, interpolated: about what a look-up in a distance transform costs.
struct Sampled {
    width: usize,
    cells: Vec<f32>,
}

const CELL_M: f64 = 0.1;

impl Sampled {
    /// Corridor 1.2 m to each side of a polyline.
    fn around(line: &[Point]) -> Self {
        let (width, height) = (260, 120);
        let distance = |p: Point| {
            let segments = line.windows(2).map(|w| {
                let along = w[1] - w[0];
                let t = ((p - w[0]).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
                (p - (w[0] + along * t)).norm()
            });
            segments.fold(f64::INFINITY, f64::min)
        };
        let cells = (0..width * height)
            .map(|i| Point::new((i % width) as f64 * CELL_M, (i / width) as f64 * CELL_M))
            .map(|p| (1.2 - distance(p)).max(0.0) as f32)
            .collect();
        Self { width, cells }
    }
}

impl ClearanceField for Sampled {
    fn clearance_m(&self, p: Point) -> f64 {
        let (x, y) = (p.x / CELL_M, p.y / CELL_M);
        let (i, j) = (x as usize, y as usize);
        let at = j * self.width + i;
        if at + self.width + 1 >= self.cells.len() {
            return 0.0;
        }
        let (u, v) = (x - i as f64, y - j as f64);
        let c = |k: usize| f64::from(self.cells[at + k]);
        let low = c(0) * (1.0 - u) + c(1) * u;
        let high = c(self.width) * (1.0 - u) + c(self.width + 1) * u;
        low * (1.0 - v) + high * v
    }
}

fn shaping(c: &mut Criterion) {
    let corners =
        [(2.0, 2.0), (7.0, 2.0), (7.0, 7.0), (12.0, 7.0), (12.0, 2.0), (17.0, 2.0), (17.0, 7.0)];
    let line: Vec<Point> = corners.iter().map(|&(x, y)| Point::new(x, y)).collect();
    let field = Sampled::around(&line);
    let guide: Vec<Point> = line
        .windows(2)
        .flat_map(|w| (0..50).map(|i| w[0] + (w[1] - w[0]) * (f64::from(i) / 50.0)))
        .collect();
    let params = SmoothParams::default();
    let cold = SmoothRequest {
        guide: &guide,
        warm: false,
        start: Pose::new(2.0, 2.0, 0.0),
        start_curvature_pm: None,
        held: &[],
        start_speed_mps: 0.0,
        end_radius_m: 0.0,
        radius_m: 0.25,
        curvature_limit_pm: 2.0,
        acceleration_limit_mps2: 8.829,
        speed_max_mps: 4.0,
    };
    let mut smoother = Smoother::default();
    let shaped = smoother.smooth(&params, &field, &cold).expect("the corridor is wide");
    println!("cold: {:?}", shaped.stats);
    let last: Vec<Point> = shaped.path.points.iter().map(|p| p.position).collect();
    let warm = SmoothRequest { guide: &last, warm: true, ..cold };
    let stats = smoother.smooth(&params, &field, &warm).expect("the corridor is wide").stats;
    println!("warm: {stats:?}");
    c.bench_function("smooth 20 m from cells", |b| {
        b.iter(|| smoother.smooth(&params, &field, black_box(&cold)).map(|s| s.stats));
    });
    c.bench_function("smooth 20 m from the last plan", |b| {
        b.iter(|| smoother.smooth(&params, &field, black_box(&warm)).map(|s| s.stats));
    });
}

criterion_group!(benches, shaping);
criterion_main!(benches);
