//! Drives the known-map policy through mazes and writes, for each, one JSON file with all that the
//! offline time optimum needs: the walls, the task, the car's limits, and the drive to compare.
//!
//!     cargo run --release --example optimum-export -- --out DIR [--speed 4] [--seeds 1..30]
//!         [--set section.name=value]...

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use apexd::params::{Layers, Params};
use apexd::sim::drive::Outcome;
use apexd::sim::maze::{Family, Maze, generate};
use apexd::sim::rig::{Rig, RigSetup};
use clap::Parser;
use serde_json::json;

/// Writes mazes and known-map drives for the offline time optimum.
#[derive(Parser)]
struct Options {
    /// Folder for the files; made if need be.
    #[arg(long)]
    out: PathBuf,
    /// Highest speed, m/s.
    #[arg(long, default_value_t = 4.0)]
    speed: f64,
    /// First and last seed, both included.
    #[arg(long, default_value = "1..30", value_parser = seeds)]
    seeds: (u64, u64),
    /// A parameter, `section.name=value`.
    #[arg(long)]
    set: Vec<String>,
}

fn seeds(text: &str) -> Result<(u64, u64), String> {
    let (first, last) = text.split_once("..").unwrap_or((text, text));
    let number = |t: &str| t.parse().map_err(|error| format!("{t:?}: {error}"));
    Ok((number(first)?, number(last)?))
}

/// From this speed on the lidar scans at 40 Hz.
const FAST_MPS: f64 = 6.0;

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    std::fs::create_dir_all(&options.out)?;
    let mut layers = Layers::new();
    layers.set("plan.policy=known-map");
    layers.set(&format!("speed.speed_max_mps={}", options.speed));
    if options.speed >= FAST_MPS {
        layers.set("lidar.rate_hz=40");
    }
    for assignment in &options.set {
        layers.set(assignment);
    }
    let params = layers.build().map_err(|faults| faults.to_string())?;
    let mut ratios = Vec::new();
    for seed in options.seeds.0..=options.seeds.1 {
        let file = options.out.join(format!("thin-{seed}-{}.json", options.speed));
        let maze = generate(Family::Thin, seed, 0.1)?;
        let time_s = drive(&maze, &params, &file)?;
        if let (Some(time_s), Some(optimum_s)) = (time_s, optimum_s(seed, options.speed)) {
            ratios.push(time_s / optimum_s);
            eprintln!("    {:.4} of the optimum, {optimum_s:.3} s", time_s / optimum_s);
        }
    }
    if !ratios.is_empty() {
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        let worst = ratios.iter().copied().fold(0.0, f64::max);
        eprintln!("{} drives: mean {mean:.4} of the optimum, worst {worst:.4}", ratios.len());
    }
    Ok(())
}

/// The optimum of a maze at a speed limit, seconds, where `optima.csv` has it.
fn optimum_s(seed: u64, speed_mps: f64) -> Option<f64> {
    include_str!("optima.csv").lines().skip(1).find_map(|line| {
        let mut fields = line.split(',');
        let this = fields.next()?.parse() == Ok(seed) && fields.next()?.parse() == Ok(speed_mps);
        this.then(|| fields.next()?.parse().ok()).flatten()
    })
}

/// Drives, writes the file, and returns the time if the goal was reached, seconds.
fn drive(maze: &Maze, params: &Params, file: &Path) -> Result<Option<f64>, Box<dyn Error>> {
    #[allow(clippy::disallowed_methods)] // a tool beside the product, for its own figures
    let begun = Instant::now();
    let mut rig = Rig::new(RigSetup {
        seed: maze.seed,
        stopwatch: Box::new(move || begun.elapsed()),
        ..RigSetup::new(params, maze.world.clone(), maze.start, Some(maze.goal))
    })?;
    rig.drive(|_| {});
    let summary = rig.summary(begun.elapsed().as_secs_f64());
    let world = &maze.world;
    let rows: Vec<String> = (0..world.height())
        .map(|y| {
            let solid = |x| world.is_cell_solid(x as i64, y as i64);
            (0..world.width()).map(|x| if solid(x) { '#' } else { '.' }).collect()
        })
        .collect();
    let first_motion_s = rig.trace().samples.first().map_or(0.0, |sample| sample.t_s);
    let round = |value: f64| (value * 1e5).round() / 1e5;
    let course: Vec<[f64; 6]> = rig
        .trace()
        .samples
        .iter()
        .map(|sample| {
            [
                sample.t_s - first_motion_s,
                sample.pose.position.x,
                sample.pose.position.y,
                sample.pose.heading_rad,
                sample.speed_mps,
                sample.curvature_pm,
            ]
            .map(round)
        })
        .collect();
    let vehicle = &params.vehicle;
    let record = json!({
        "family": "thin",
        "seed": maze.seed,
        "resolution_m": world.resolution_m(),
        // Row 0 is the lowest; its first cell's corner is the origin of the map frame.
        "rows": rows,
        "route": maze.route,
        "start": [maze.start.position.x, maze.start.position.y, maze.start.heading_rad],
        "goal": [maze.goal.x, maze.goal.y],
        "goal_radius_m": params.autopilot.goal_radius_m,
        "keep_m": vehicle.radius_m + params.certify.margin_m,
        "acceleration_limit_mps2": vehicle.acceleration_limit_mps2(),
        "turn_radius_m": vehicle.turn_radius_m,
        "speed_max_mps": params.speed.speed_max_mps,
        "summary": summary,
        // Each: time since the first motion, x, y, heading, speed, curvature; SI units.
        "course": course,
    });
    std::fs::write(file, serde_json::to_string(&record)?)?;
    eprintln!("{} {:?} {:.3} s", file.display(), summary.outcome, summary.time_s);
    Ok((summary.outcome == Outcome::Goal).then_some(summary.time_s))
}
