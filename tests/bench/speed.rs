//! The speed profile of a 20 m path with 400 edges.

use std::hint::black_box;

use apexd::frames::Point;
use apexd::plan::PathPoint;
use apexd::plan::speed::{End, SpeedLimits, SpeedParams, SpeedProfiler, SpeedTask};
use apexd::vehicle::VehicleParams;
use criterion::{Criterion, criterion_group, criterion_main};

/// A profile depends on arc length and curvature alone; the positions are left at zero.
fn path(samples: usize) -> Vec<PathPoint> {
    (0..=samples)
        .map(|i| {
            let s_m = i as f64 * 0.05;
            let curvature_pm = (1.5 * (1.1 * s_m).sin() + 0.8 * (2.7 * s_m).sin()).clamp(-2.0, 2.0);
            PathPoint { s_m, position: Point::origin(), heading_rad: 0.0, curvature_pm }
        })
        .collect()
}

fn profile(c: &mut Criterion) {
    let path = path(400);
    let mut profiler = SpeedProfiler::new();
    let mut out = Vec::new();
    for speed_max_mps in [4.0, 8.0] {
        let speed = SpeedParams { speed_max_mps, ..SpeedParams::default() };
        let limits = SpeedLimits::new(&speed, &VehicleParams::default());
        let task = SpeedTask { start_speed_mps: 1.0, end: End::Rest, caps_mps: None };
        c.bench_function(&format!("speed profile, 20 m, {speed_max_mps} m/s"), |b| {
            b.iter(|| {
                profiler.profile(black_box(&path), &limits, &task, &mut out).expect("a profile");
                out.len()
            });
        });
        c.bench_function(&format!("travel time, 20 m, {speed_max_mps} m/s"), |b| {
            b.iter(|| profiler.travel_time_s(black_box(&path), &limits, &task).expect("a time"));
        });
    }
}

criterion_group!(benches, profile);
criterion_main!(benches);
