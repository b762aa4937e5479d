use std::fmt::Write;

use super::*;
use crate::experiment::run::{Benchmark, Keep, Record, RunSpec, Task, Timing, WallTimes};
use crate::frames::Point;
use crate::sim::drive::Spread;
use crate::sim::maze::Family;

/// A corridor that leads from (-2.25, 3) up to (-2.25, 13), in the set's form, with these posts.
fn text(posts: &[[f64; 2]]) -> String {
    let mut list = String::new();
    for [x, y] in posts {
        let _ = write!(list, "{}[{x},{y}]", if list.is_empty() { "" } else { "," });
    }
    format!(
        "{{\"world\":7,\"cylinder_radius_m\":0.075,\"start\":[-2.25,3.0,1.57],\
         \"goal\":[-2.25,13.0],\"obstacles_xy_m\":[{list}],\
         \"reference_path_xy_m\":[[-2.25,5.0],[-1.05,6.6],[-2.25,8.2]]}}"
    )
}

fn record(world: u32, policy: &str, outcome: Outcome, time_s: f64) -> Record {
    let spec = RunSpec {
        policy: policy.into(),
        latency: Timing::Fixed(0.02),
        set: vec!["map.resolution_m=0.05".into()],
        ..RunSpec::maze(Family::Posts, world.into())
    };
    let benchmark = Some(Benchmark { world, path_m: 12.0 });
    let task = Task { experiment: NAME.into(), spec, keep: Keep::default(), benchmark };
    Record {
        key: task.key(),
        program: "p".into(),
        command: task.spec.command(),
        task,
        drive: drive(outcome, time_s),
        reference: None,
        floor: None,
        course: Vec::new(),
        wall: WallTimes::default(),
        realtime_factor: 1.0,
    }
}

fn drive(outcome: Outcome, time_s: f64) -> Drive {
    Drive {
        outcome,
        time_s,
        path_m: 11.0,
        collisions: u64::from(outcome == Outcome::Collision),
        unknown_entries: 0,
        min_clearance_m: Some(0.06),
        replans: 100,
        plans_rejected: 0,
        guard_stops: 0,
        candidates: 1.0,
        prediction_faults: 0,
        age_ms: Spread::default(),
        digest: "d".into(),
    }
}

#[test]
fn a_world_is_read_with_its_own_path_s_length() {
    let field = Field::parse(&text(&[[-0.075, 0.075]])).unwrap();
    assert_eq!((field.number, field.posts.len(), field.start), (7, 1, [-2.25, 3.0, 90.0]));
    // 2 m up, two sides of 2 m, 4.8 m up.
    assert!((field.path_m - 10.8).abs() < 1e-12, "{}", field.path_m);
}

#[test]
fn what_is_no_world_is_refused_with_the_reason() {
    let good = text(&[[-0.075, 0.075]]);
    for (from, to, why) in [
        ("0.075,", "-0.075,", "cylinder_radius_m is -0.075"),
        ("[-2.25,13.0]", "[-2.25,1e9]", "is no place"),
        ("1.57", "157", "direction is 157"),
        ("\"goal\"", "\"gaol\"", "missing field `goal`"),
        ("}", "", "EOF"),
    ] {
        let error = Field::parse(&good.replacen(from, to, 1)).unwrap_err();
        assert!(error.contains(why), "{error}");
    }
}

#[test]
fn a_post_fills_the_cells_that_it_overlaps_and_the_ground_around_is_open() {
    let field = Field::parse(&text(&[[-0.075, 0.075], [-4.425, 9.525]])).unwrap();
    let world = field.world(0.05);
    let solid = (0..world.width() as i64)
        .flat_map(|x| (0..world.height() as i64).map(move |y| (x, y)))
        .filter(|(x, y)| world.is_cell_solid(*x, *y))
        .count();
    assert_eq!(solid, 2 * 9, "three by three cells a post, none that it only touches");
    for [x, y] in [[-0.005, 0.005], [-0.145, 0.145], [-4.495, 9.455]] {
        assert!(world.is_solid(Point::new(x, y)), "({x}, {y})");
    }
    for [x, y] in [[0.005, 0.075], [-0.075, -0.005], [-2.25, 15.9], [2.9, -2.8], [-7.4, 5.0]] {
        assert!(!world.is_solid(Point::new(x, y)), "({x}, {y})");
    }
    // Finer cells follow the circle: area 0.01767 m^2 a post.
    let fine = field.world(0.01);
    let solid = (0..fine.width() as i64)
        .flat_map(|x| (0..fine.height() as i64).map(move |y| (x, y)))
        .filter(|(x, y)| fine.is_cell_solid(*x, *y))
        .count();
    assert!((2 * 177..2 * 225).contains(&solid), "{solid}");
}

#[test]
fn the_score_is_the_challenge_s() {
    // Par is 6 s.
    let of = |outcome, time_s| score(&drive(outcome, time_s), 12.0);
    assert!((of(Outcome::Goal, 7.0) - 0.5).abs() < 1e-12, "no faster than half the speed");
    assert!((of(Outcome::Goal, 12.0) - 0.5).abs() < 1e-12);
    assert!((of(Outcome::Goal, 24.0) - 0.25).abs() < 1e-12);
    assert!((of(Outcome::Goal, 60.0) - 0.125).abs() < 1e-12, "no less than an eighth");
    assert!(of(Outcome::Goal, 100.5) == 0.0, "too late");
    for outcome in [Outcome::Stuck, Outcome::Collision, Outcome::Timeout, Outcome::Unreachable] {
        assert!(of(outcome, 7.0) == 0.0);
    }
}

#[test]
fn worlds_that_the_known_map_does_not_cross_are_counted_apart() {
    let records = [
        record(3, "known-map", Outcome::Goal, 10.0),
        record(3, "frontier", Outcome::Goal, 24.0),
        record(18, "known-map", Outcome::Unreachable, 0.0),
        record(18, "frontier", Outcome::Stuck, 9.0),
        record(33, "known-map", Outcome::Goal, 12.0),
        record(33, "frontier", Outcome::Collision, 5.0),
    ];
    let records: Vec<&Record> = records.iter().collect();
    let tables = tables(&records);
    let names: Vec<&str> = tables.iter().map(|table| table.name).collect();
    assert_eq!(names, ["barn", "barn-scores", "barn-times", "failures"]);
    let of = |table: usize, row: usize| tables[table].json()[row].clone();
    assert_eq!(of(0, 0)["method"], "known-map");
    let frontier = of(0, 1);
    for (column, wanted) in [
        ("worlds", 3.0),
        ("crossed", 1.0),
        ("score", 0.25 / 3.0),
        ("passable", 2.0),
        ("crossed of these", 1.0),
        ("score in these", 0.125),
        ("time s", 24.0),
        ("over known map", 2.4),
        ("collided", 1.0),
        ("stuck", 1.0),
    ] {
        let value = frontier[column].as_f64().unwrap();
        assert!((value - wanted).abs() < 1e-12, "{column}: {value}");
    }
    assert_eq!(of(1, 1)["known-map"], "unreachable");
    assert_eq!(of(1, 0)["frontier"], 0.25);
    assert_eq!(of(2, 2)["frontier"], serde_json::Value::Null);
    assert_eq!(of(2, 2)["known-map"], 12.0);
    assert_eq!(tables[3].rows.len(), 3);
    assert_eq!(
        summary(&records),
        "The known map leads through 2 of 3 worlds; not through 18. 1 of 6 drives were unsafe."
    );
}

#[test]
fn the_known_map_is_driven_once_and_unknown_names_are_refused() {
    let field = Field::parse(&text(&[[-0.075, 0.075]])).unwrap();
    let request = |methods: &[&str]| BarnRequest {
        fields: vec![(field.clone(), "m.yaml".into())],
        methods: methods.iter().map(|m| m.parse().unwrap()).collect(),
        speed_max_mps: 2.0,
        lidar_range_m: 7.5,
        resolution_m: 0.05,
        latency: Timing::Fixed(0.02),
        set: Vec::new(),
    };
    let tasks = request(&["known-map", "frontier", "frontier"]).tasks().unwrap();
    let methods: Vec<String> = tasks.iter().map(|task| method(&task.spec)).collect();
    assert_eq!(methods, ["known-map", "frontier"]);
    assert_eq!(
        tasks[1].spec.command(),
        "apexd sil --map m.yaml --start -2.25,3,90 --goal -2.25,13 --policy frontier --predictor \
         none --speed-max 2 --latency 0.02 --seed 1 --set map.resolution_m=0.05"
    );
    assert!(request(&["astrology"]).tasks().is_err());
    assert!(BarnRequest { set: vec!["plan.x=1".into()], ..request(&[]) }.tasks().is_err());
    let usual = BarnRequest { methods: BarnRequest::usual_methods(), ..request(&[]) };
    assert_eq!(usual.tasks().unwrap().len(), 6);
}
