//! Drives across maps of real places, as mapped by robots: offices, corridors, a home, a floor
//! plan, a race track.
//!
//! The maps are not part of the package. `APEXD_DATA` names the folder that holds them; without it
//! every test here says so and passes. With `APEXD_DRIVES` set to a folder, each drive leaves its
//! pictures there.
#![allow(clippy::disallowed_methods, reason = "the wall clock feeds figures alone")]

use std::path::Path;
use std::time::Instant;

use apexd::autopilot::Event;
use apexd::frames::{Point, Pose};
use apexd::mapfile;
use apexd::params::Params;
use apexd::plan::Policy;
use apexd::predict::PredictorKind;
use apexd::shell::report;
use apexd::sim::drive::{Outcome, Summary};
use apexd::sim::rig::{Rig, RigSetup};
use apexd::sim::world::World;

/// One way across one map.
struct Drive {
    /// Below the data folder.
    map: &'static str,
    /// x and y in metres, heading in degrees, map frame.
    start: (f64, f64, f64),
    /// x and y in metres, map frame.
    goal: (f64, f64),
    /// The car's radius, metres.
    radius_m: f64,
    /// Its top speed, m/s.
    speed_max_mps: f64,
    /// Side of a map cell, metres.
    cell_m: f64,
    /// Scans a second.
    scans_hz: f64,
}

/// A car as it comes: 0.2 m, 4 m/s, cells of 0.1 m, 20 scans a second.
const STANDARD: Drive = Drive {
    map: "",
    start: (0.0, 0.0, 0.0),
    goal: (0.0, 0.0),
    radius_m: 0.2,
    speed_max_mps: 4.0,
    cell_m: 0.1,
    scans_hz: 20.0,
};

/// How the way is chosen.
const METHODS: [(Policy, PredictorKind); 3] = [
    (Policy::MapPredictive, PredictorKind::None),
    (Policy::MapPredictive, PredictorKind::Oracle),
    (Policy::KnownMap, PredictorKind::None),
];

fn run(drive: &Drive, world: &World, policy: Policy, kind: PredictorKind) -> Summary {
    let mut params = Params::default();
    params.vehicle.radius_m = drive.radius_m;
    params.plan.policy = policy;
    params.predict.kind = kind;
    params.speed.speed_max_mps = drive.speed_max_mps;
    params.map.resolution_m = drive.cell_m;
    params.lidar.rate_hz = drive.scans_hz;
    let (x, y, degrees) = drive.start;
    let start = Pose::new(x, y, degrees.to_radians());
    let goal = Point::new(drive.goal.0, drive.goal.1);
    let force_limit_n = params.vehicle.mass_kg * params.vehicle.acceleration_limit_mps2();
    let goal_radius_m = params.autopilot.goal_radius_m;
    let began = Instant::now();
    let setup = RigSetup {
        stopwatch: Box::new(move || began.elapsed()),
        ..RigSetup::new(&params, world.clone(), start, Some(goal))
    };
    let mut rig = Rig::new(setup).expect("start and goal are free");
    let mut rejections = std::collections::BTreeMap::<String, usize>::new();
    rig.drive(|rig| {
        while let Some(event) = rig.poll_event() {
            if let Event::PlanRejected { rejection, .. } = &event {
                let text = format!("{rejection:?}").chars().take(70).collect();
                *rejections.entry(text).or_default() += 1;
            }
        }
    });
    let summary = rig.summary(began.elapsed().as_secs_f64());
    eprintln!(
        "{} {} {}: {:?}, {:.1} m in {:.1} s, clearance {:.3} m, collisions {}, unknown entries {}, guard stops {}, rejected {} of {}, plan {:.1} / {:.1} ms",
        drive.map,
        policy.name(),
        kind.name(),
        summary.outcome,
        summary.path_m,
        summary.time_s,
        summary.min_clearance_m,
        summary.collisions,
        summary.unknown_entries,
        summary.guard_stops,
        summary.plans_rejected,
        summary.replans,
        summary.plan_ms.p50,
        summary.plan_ms.p99,
    );
    eprintln!("   at {:?} {:?} {:.1} s", rig.car().pose, rejections, began.elapsed().as_secs_f64());
    if let Ok(folder) = std::env::var("APEXD_DRIVES") {
        let name = Path::new(drive.map).file_stem().expect("a file").to_string_lossy().into_owned();
        let title = format!("{name} {} {}", policy.name(), kind.name());
        let record = report::DriveRecord {
            truth: outline(world),
            snapshot: rig.snapshot().cloned(),
            title: title.clone(),
            summary: summary.clone(),
            trace: rig.trace().clone(),
            grid: rig.core().grid().clone(),
            start,
            goal,
            goal_radius_m,
            speed_limit_mps: drive.speed_max_mps,
            force_limit_n,
        };
        report::write(&Path::new(&folder).join(title.replace(' ', "-")), &record)
            .expect("the pictures can be written");
    }
    summary
}

fn outline(world: &World) -> Vec<[Point; 2]> {
    let (origin, side_m) = (world.origin(), world.resolution_m());
    report::outline(
        world.width(),
        world.height(),
        |x, y| world.is_cell_solid(x as i64, y as i64),
        |p| {
            let (sin, cos) = origin.heading_rad.sin_cos();
            let (x, y) = (p.x * side_m, p.y * side_m);
            origin.position + apexd::frames::Vector::new(cos * x - sin * y, sin * x + cos * y)
        },
    )
}

/// Drives one way by every method and asks for the goal, without contact, without leaving what was
/// seen, without the guard having to step in.
fn check(drive: &Drive) {
    let Ok(folder) = std::env::var("APEXD_DATA") else {
        eprintln!("skipped: APEXD_DATA is not set");
        return;
    };
    let map = mapfile::load(Path::new(&folder).join(drive.map)).expect("a map");
    let world = World::from_map(&map);
    let start = Point::new(drive.start.0, drive.start.1);
    let goal = Point::new(drive.goal.0, drive.goal.1);
    let way_m = world.path_length_m(start, goal, drive.radius_m);
    eprintln!("{}: a way of {way_m:?} m", drive.map);
    assert!((goal - start).norm() > 15.0, "start and goal are {} m apart", (goal - start).norm());
    let mut bad = vec![];
    for (policy, kind) in METHODS {
        let s = run(drive, &world, policy, kind);
        if (s.outcome, s.collisions, s.unknown_entries, s.guard_stops) != (Outcome::Goal, 0, 0, 0) {
            bad.push(format!("{} {}: {s:?}", policy.name(), kind.name()));
        }
    }
    assert!(bad.is_empty(), "{}: {bad:#?}", drive.map);
}

#[test]
fn willow_garage_is_crossed_from_the_northern_offices_to_the_southern_corridor() {
    check(&Drive {
        map: "occupancy-maps/willow_garage.yaml",
        start: (21.5, 40.7, 0.0),
        goal: (33.0, 6.2),
        ..STANDARD
    });
}

#[test]
fn gdc_floor_2_is_crossed_from_west_to_north_east() {
    check(&Drive {
        map: "occupancy-maps/gdc_floor2.yaml",
        start: (-48.1, -5.8, 90.0),
        goal: (18.5, 23.35),
        ..STANDARD
    });
}

#[test]
fn the_stata_basement_is_crossed_on_a_map_turned_by_3_14() {
    check(&Drive {
        map: "occupancy-maps/mit_stata_basement.yaml",
        start: (-54.74, 25.13, -90.0),
        goal: (-18.67, 4.07),
        ..STANDARD
    });
}

#[test]
fn a_teaching_floor_is_crossed_through_its_doors_on_cells_of_5_cm() {
    check(&Drive {
        map: "kth-floorplans/50010535_PLAN1.yaml",
        start: (45.67, 26.0, -90.0),
        goal: (50.0, 3.1),
        cell_m: 0.05,
        ..STANDARD
    });
}

#[test]
fn a_furnished_home_is_crossed_by_a_small_car() {
    check(&Drive {
        map: "home-scans/home_c_huge.yaml",
        start: (8.0, 25.5, -90.0),
        goal: (14.67, 4.13),
        radius_m: 0.15,
        speed_max_mps: 2.0,
        cell_m: 0.05,
        ..STANDARD
    });
}

#[test]
fn a_race_track_is_driven_at_six_metres_a_second() {
    check(&Drive {
        map: "race-tracks/Spielberg_map.yaml",
        start: (0.0, 0.0, -165.0),
        goal: (-47.0, 51.5),
        speed_max_mps: 6.0,
        scans_hz: 40.0,
        ..STANDARD
    });
}
