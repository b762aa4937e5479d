//! Writes one smoothing task and one speed task with what this program makes of them, as JSON, for
//! `peers.py` to give to other programs.
//!
//!     cargo run --release --example peers-export > target/peers.json

use std::error::Error;
use std::time::Instant;

use apexd::frames::{Point, Pose};
use apexd::plan::bubbles::ClearanceField;
use apexd::plan::smooth::{SmoothParams, SmoothRequest, Smoother};
use apexd::plan::speed::{End, SpeedLimits, SpeedParams, SpeedProfiler, SpeedTask};
use apexd::vehicle::VehicleParams;
use serde_json::json;

/// From the middle of the corridor to its walls, metres.
const HALF_WIDTH_M: f64 = 1.2;
/// Clearance of the car's centre, metres.
const RADIUS_M: f64 = 0.25;
const SPEED_MAX_MPS: f64 = 4.0;
const REPEATS: usize = 301;

/// A corridor about a polyline.
struct Corridor(Vec<Point>);

impl ClearanceField for Corridor {
    fn clearance_m(&self, p: Point) -> f64 {
        let distances = self.0.windows(2).map(|w| {
            let along = w[1] - w[0];
            let t = ((p - w[0]).dot(&along) / along.norm_squared()).clamp(0.0, 1.0);
            (p - (w[0] + along * t)).norm()
        });
        (HALF_WIDTH_M - distances.fold(f64::INFINITY, f64::min)).max(0.0)
    }
}

#[allow(clippy::disallowed_methods)] // a tool beside the product, for its own figures
fn median_ms(mut work: impl FnMut()) -> f64 {
    let mut times: Vec<f64> = (0..REPEATS)
        .map(|_| {
            let begun = Instant::now();
            work();
            begun.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    times.sort_by(f64::total_cmp);
    times[REPEATS / 2]
}

fn main() -> Result<(), Box<dyn Error>> {
    let corners =
        [(2.0, 2.0), (7.0, 2.0), (7.0, 7.0), (12.0, 7.0), (12.0, 2.0), (17.0, 2.0), (17.0, 7.0)];
    let line: Vec<Point> = corners.iter().map(|&(x, y)| Point::new(x, y)).collect();
    // Twenty metres of it, as far as one planning step shapes.
    let guide: Vec<Point> = line
        .windows(2)
        .take(4)
        .flat_map(|w| (0..50).map(|i| w[0] + (w[1] - w[0]) * (f64::from(i) / 50.0)))
        .chain([line[4]])
        .collect();
    let field = Corridor(line.clone());
    let vehicle = VehicleParams::default();
    let speed = SpeedParams { speed_max_mps: SPEED_MAX_MPS, ..SpeedParams::default() };
    let limits = SpeedLimits::new(&speed, &vehicle);
    let params = SmoothParams::default();
    let request = SmoothRequest {
        guide: &guide,
        warm: false,
        start: Pose::new(2.0, 2.0, 0.0),
        start_curvature_pm: None,
        held: &[],
        start_speed_mps: 0.0,
        end_radius_m: 0.0,
        radius_m: RADIUS_M,
        curvature_limit_pm: 1.0 / vehicle.turn_radius_m,
        acceleration_limit_mps2: limits.accel_limit_mps2,
        speed_max_mps: SPEED_MAX_MPS,
    };
    let mut smoother = Smoother::default();
    let shaped = smoother.smooth(&params, &field, &request)?;
    let smooth_ms = median_ms(|| {
        let _ = smoother.smooth(&params, &field, &request);
    });
    let mut profiler = SpeedProfiler::new();
    let task = SpeedTask { start_speed_mps: 0.0, end: End::Rest, caps_mps: None };
    let path = &shaped.path.points;
    let time_s = profiler.travel_time_s(path, &limits, &task)?;
    let mut out = Vec::new();
    let speed_ms = median_ms(|| {
        let _ = profiler.profile(path, &limits, &task, &mut out);
    });
    let xy = |points: &[Point]| points.iter().map(|p| [p.x, p.y]).collect::<Vec<_>>();
    let record = json!({
        "line": xy(&line),
        "guide": xy(&guide),
        "half_width_m": HALF_WIDTH_M,
        "radius_m": RADIUS_M,
        "heading_rad": 0.0,
        "turn_radius_m": vehicle.turn_radius_m,
        "accel_limit_mps2": limits.accel_limit_mps2,
        "speed_max_mps": SPEED_MAX_MPS,
        "path": path.iter().map(|p| json!({
            "s": p.s_m, "x": p.position.x, "y": p.position.y,
            "heading": p.heading_rad, "curvature": p.curvature_pm,
        })).collect::<Vec<_>>(),
        "time_s": time_s,
        "smooth_ms": smooth_ms,
        "passes": shaped.stats.solves,
        "speed_ms": speed_ms,
    });
    println!("{record}");
    Ok(())
}
