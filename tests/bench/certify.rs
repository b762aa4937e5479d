//! The safety proof of a 20 m plan in a corridor 1 m wide, and the questions asked before it.

use std::hint::black_box;

use apexd::frames::{Point, Pose};
use apexd::map::{Cell, CellIndex, Grid};
use apexd::plan::certify::{
    CertifyParams, EscapeRule, Limits, Surfaces, certify, clear_length_m, has_escape, last_stop,
};
use apexd::plan::speed::{End, SpeedLimits, SpeedParams, SpeedProfiler, SpeedTask};
use apexd::plan::{PathPoint, Trajectory};
use apexd::time::Instant;
use apexd::vehicle::VehicleParams;
use criterion::{Criterion, criterion_group, criterion_main};

/// A gently winding way, by small steps of constant curvature.
fn path() -> Vec<PathPoint> {
    let mut pose = Pose::new(0.0, 0.0, 0.0);
    let curvature = |i: usize| 1.5 * (i as f64 * 0.05 * 1.3).sin();
    (0..=400)
        .map(|i| {
            let point = PathPoint {
                s_m: i as f64 * 0.05,
                position: pose.position,
                heading_rad: pose.heading_rad,
                curvature_pm: curvature(i),
            };
            let turn = 0.5 * (curvature(i) + curvature(i + 1)) * 0.05;
            pose = pose.along_arc(0.05, turn);
            point
        })
        .collect()
}

/// Free within `half_width` of the path, walls around, unknown beyond.
fn corridor(path: &[PathPoint], resolution: f64, half_width: f64) -> Grid {
    let mut grid = Grid::new(resolution);
    for (reach, cell) in [(half_width + 2.0 * resolution, Cell::Occupied), (half_width, Cell::Free)]
    {
        for p in path {
            let n = (reach / resolution).ceil() as i32;
            let centre = grid.cell_at(p.position);
            for iy in -n..=n {
                for ix in -n..=n {
                    let c = CellIndex::new(centre.ix + ix, centre.iy + iy);
                    let d: Point = grid.centre(c);
                    if (d - p.position).norm() <= reach {
                        grid.set(c, cell);
                    }
                }
            }
        }
    }
    grid
}

fn proof(c: &mut Criterion) {
    let (speed, vehicle) = (SpeedParams::default(), VehicleParams::default());
    let path = path();
    let mut points = Vec::new();
    let task = SpeedTask { start_speed_mps: 0.0, end: End::Rest, caps_mps: None };
    SpeedProfiler::new()
        .profile(&path, &SpeedLimits::new(&speed, &vehicle), &task, &mut points)
        .expect("a profile");
    let trajectory = Trajectory { start: Instant::ZERO, points };
    let limits = Limits::new(&CertifyParams::default(), &vehicle, &speed);
    for resolution in [0.1, 0.05] {
        let grid = corridor(&path, resolution, 0.5);
        certify(&trajectory, &grid, &limits).expect("the corridor is wide enough");
        c.bench_function(&format!("certify, 20 m, cells of {resolution} m"), |b| {
            b.iter(|| certify(black_box(&trajectory), &grid, &limits).is_ok());
        });
        c.bench_function(&format!("clear length, 20 m, cells of {resolution} m"), |b| {
            b.iter(|| clear_length_m(&grid, black_box(&path), limits.radius_m, Surfaces::Unseen));
        });
        let rule = EscapeRule {
            radius_m: limits.radius_m,
            turn_radius_m: vehicle.turn_radius_m,
            surfaces: Surfaces::OccupiedAndUnknown,
        };
        c.bench_function(&format!("last escapable stop, cells of {resolution} m"), |b| {
            b.iter(|| last_stop(black_box(&path), 19.9, |pose| has_escape(&grid, pose, &rule)));
        });
    }
}

criterion_group!(benches, proof);
criterion_main!(benches);
