use std::collections::BTreeSet;

use super::*;
use crate::experiment::floor::SafeFloor;
use crate::experiment::run::{Drive, Keep, Record, RunSpec, Task, Timing, WallTimes};
use crate::experiment::table::{Cell, Table};
use crate::plan::StepTimes;
use crate::sim::drive::{Outcome, Spread};
use crate::sim::maze::Family;
use crate::time::Duration;

fn method(text: &str) -> Method {
    text.parse().unwrap()
}

fn request() -> PaperRequest {
    PaperRequest {
        families: vec![Family::Thin],
        seeds: vec![5, 6],
        speeds_mps: vec![4.0, 8.0],
        methods: vec![method("frontier"), method("map-predictive+oracle")],
        paces: vec![Pace::EachScan, Pace::Paper],
        latency: Timing::Fixed(0.01),
        sweep: None,
        set: vec!["speed.friction_use=0.9".into()],
        picture_speed_mps: 4.0,
    }
}

#[test]
fn methods_are_read_with_predictor_and_parameters() {
    assert_eq!(method("map-predictive"), method("map-predictive+cnp"));
    assert_eq!(method("frontier").predictor, "none");
    let full = method("janson+cnp:search.penalty=literal:plan.wall_room_m=0");
    assert_eq!((&*full.policy, &*full.predictor, full.set.len()), ("janson", "cnp", 2));
    for wrong in ["", "+cnp", "janson+", "janson:literal"] {
        assert!(wrong.parse::<Method>().is_err(), "{wrong}");
    }
}

#[test]
fn every_condition_is_driven_once_and_the_known_map_once_for_all_paces() {
    let tasks = request().tasks().unwrap();
    // Two mazes, two speeds: the known map, and two methods at two paces.
    assert_eq!(tasks.len(), 2 * 2 * (1 + 2 * 2));
    let keys: BTreeSet<String> = tasks.iter().map(Task::key).collect();
    assert_eq!(keys.len(), tasks.len());
    assert!(tasks.iter().all(|task| task.spec.set == ["speed.friction_use=0.9"]));
    let paper: Vec<&RunSpec> =
        tasks.iter().map(|task| &task.spec).filter(|spec| spec.plan_period_s > 0.0).collect();
    assert_eq!(paper.len(), 8);
    assert!(paper.iter().all(|spec| spec.latency == Timing::Fixed(0.0)));
    let fast = tasks.iter().filter(|task| task.spec.lidar_rate_hz == 40.0).count();
    assert_eq!(fast, tasks.len() / 2);
    // Pictures are of the first maze at one speed: the known map and two methods.
    assert_eq!(tasks.iter().filter(|task| task.keep.course).count(), 3);
}

#[test]
fn a_sweep_shares_its_middle_with_the_comparison() {
    let without = request().tasks().unwrap().len();
    let sweep = Sweep {
        mazes: 1,
        speed_mps: 4.0,
        sensor_m: vec![5.0, 7.5],
        prediction_m: vec![2.5, 5.0],
        methods: vec![method("frontier"), method("map-predictive+oracle")],
    };
    let with = PaperRequest { sweep: Some(sweep), ..request() }.tasks().unwrap();
    // Frontier at two ranges, the oracle at four pairs, of which one each is driven already.
    assert_eq!(with.len(), without + 1 + 3);
}

#[test]
fn a_policy_that_this_build_does_not_have_is_named() {
    let request = PaperRequest { methods: vec![method("levitate")], ..request() };
    assert!(request.tasks().unwrap_err().to_string().contains("\"levitate\""));
}

/// A drive that took so long.
fn record(spec: RunSpec, time_s: f64) -> Record {
    let task = Task { experiment: NAME.into(), spec, keep: Keep::default(), benchmark: None };
    let drive = Drive {
        outcome: if time_s.is_finite() { Outcome::Goal } else { Outcome::Stuck },
        time_s,
        path_m: 100.0,
        collisions: 0,
        unknown_entries: 0,
        min_clearance_m: Some(0.1),
        replans: 10,
        plans_rejected: 1,
        guard_stops: 0,
        candidates: 2.0,
        prediction_faults: 0,
        age_ms: Spread::default(),
        digest: "0".into(),
    };
    let mut wall = WallTimes::default();
    for ms in 1..=10 {
        let total = Duration::from_millis(if task.spec.policy == "janson" { 10 * ms } else { ms });
        wall.add(&StepTimes { total, ..StepTimes::default() });
    }
    let floor = (task.spec.policy == "known-map")
        .then(|| SafeFloor { path_s: time_s, ratios: vec![[0.0, 1.0], [0.02, 1.25]] });
    Record {
        key: task.key(),
        program: "test".into(),
        command: task.spec.command(),
        task,
        drive,
        reference: None,
        floor,
        course: Vec::new(),
        wall,
        realtime_factor: 1.0,
    }
}

fn spec(policy: &str, predictor: &str, seed: u64) -> RunSpec {
    RunSpec {
        policy: policy.into(),
        predictor: predictor.into(),
        ..RunSpec::maze(Family::Thin, seed)
    }
}

/// Four mazes: the known map takes 100 s, ours 110 to 113, the oracle 105, frontier 150 and once
/// nothing at all.
fn records() -> Vec<Record> {
    let mut records = Vec::new();
    for seed in 0..4 {
        records.push(record(spec("known-map", "none", seed), 100.0));
        records.push(record(spec("map-predictive", "cnp", seed), 110.0 + seed as f64));
        records.push(record(spec("map-predictive", "oracle", seed), 105.0));
        let lost = seed == 3;
        records.push(record(spec("frontier", "none", seed), if lost { f64::NAN } else { 150.0 }));
        records.push(record(spec("janson", "none", seed), 111.0));
    }
    records
}

fn table<'a>(tables: &'a [Table], name: &str) -> &'a Table {
    tables.iter().find(|table| table.name == name).unwrap_or_else(|| panic!("no table {name}"))
}

#[test]
fn ratios_are_taken_maze_by_maze_and_only_where_both_arrived() {
    let records = records();
    let all: Vec<&Record> = records.iter().collect();
    let optima = Optima::parse("seed,speed_max_mps,optimum_s\n0,4,88\n1,4,111\n0,8,1\n").unwrap();
    let analysis = Analysis::of(&all, &optima);
    let of = |method: &str| analysis.completions.iter().find(|c| c.method == method).unwrap();
    let ours = of(OURS);
    assert!((ours.ratio.unwrap().mean - 1.115).abs() < 1e-12);
    let (over_optimum, n) = ours.over_optimum.unwrap();
    assert!((over_optimum - (110.0 / 88.0 + 1.0) / 2.0).abs() < 1e-12 && n == 2);
    assert!((ours.over_floor.unwrap() - 1.115 / 1.25).abs() < 1e-12);
    assert_eq!(ours.stated, Some([1.07, 1.08]));
    let frontier = of("frontier");
    assert_eq!((frontier.drives, frontier.arrived, frontier.ratios.len()), (4, 3, 3));
    assert!((frontier.ratio.unwrap().mean - 1.5).abs() < 1e-12);

    let against = |b: &str| analysis.comparisons.iter().find(|c| c.b == b).unwrap();
    assert_eq!(against("frontier").mazes, 3);
    assert!(against("frontier").difference.unwrap().high < -0.3);
    assert!(against("frontier").paired.unwrap().p < 0.001);
    assert_eq!(against("frontier").stated, Some("< 0.001"));
    assert_eq!(against("janson").stated, Some("0.46"));
    assert!(analysis.ranges.is_empty(), "nothing was swept");
    let janson = analysis.steps.iter().find(|row| row.method == "janson").unwrap();
    assert!((janson.factor.unwrap() - 10.0).abs() < 1e-9);

    let tables = tables(&analysis, &all);
    assert_eq!(table(&tables, "completion").rows.len(), 5);
    let failures = table(&tables, "failures");
    assert_eq!(failures.rows.len(), 1);
    assert!(
        matches!(&failures.rows[0][6], Cell::Text(text) if text.contains("apexd sil --maze 3"))
    );
    for table in &tables {
        let rows = table.json().as_array().unwrap().len();
        assert_eq!(rows, table.rows.len());
        assert_eq!(table.csv().lines().count(), rows + 1);
    }
}

#[test]
fn the_order_of_the_drives_changes_nothing() {
    let records = records();
    let forth: Vec<&Record> = records.iter().collect();
    let back: Vec<&Record> = records.iter().rev().collect();
    let text = |records: &[&Record]| {
        let analysis = Analysis::of(records, &Optima::default());
        let mut tables = tables(&analysis, records);
        // Failures are listed as they come.
        tables.retain(|table| table.name != "failures");
        tables.iter().map(Table::csv).collect::<String>()
    };
    assert_eq!(text(&forth), text(&back));
}

#[test]
fn a_sweep_is_shown_by_ranges() {
    let mut records = records();
    for seed in 0..2 {
        for (sensor, time_s) in [(2.5, 200.0), (5.0, 120.0)] {
            let spec = RunSpec { lidar_range_m: sensor, ..spec("map-predictive", "cnp", seed) };
            records.push(record(spec, time_s));
        }
    }
    let all: Vec<&Record> = records.iter().collect();
    let analysis = Analysis::of(&all, &Optima::default());
    let rows: Vec<(f64, usize, f64)> = analysis
        .ranges
        .iter()
        .map(|row| (row.sensor_m, row.drives, row.ratio.unwrap().mean))
        .collect();
    // The comparison's own drives fill the third place, in the mazes of the sweep alone.
    assert_eq!(rows, [(2.5, 2, 2.0), (5.0, 2, 1.2), (7.5, 2, 1.105)]);
    let ours = analysis.completions.iter().find(|c| c.method == OURS).unwrap();
    assert_eq!(ours.drives, 4, "other ranges are no part of the comparison");
}
