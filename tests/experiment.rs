//! `apexd experiment` as a whole: resuming, shards, threads, reproducing commands, files; a campaign
//! without an unsafe drive, and unsafe drives that are counted.

#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::AtomicBool;

use apexd::experiment::campaign::{CampaignRequest, Tally, tables};
use apexd::experiment::run::{Record, Tools, execute};
use apexd::plan::Stopwatch;
use apexd::sim::maze::Family;
use rayon::prelude::*;
use serde_json::Value;
use tempfile::TempDir;

/// What the program printed, and how it ended.
struct Ran {
    code: i32,
    out: String,
    err: String,
}

fn apexd(folder: &Path, arguments: &str) -> Ran {
    let mut command = Command::new(env!("CARGO_BIN_EXE_apexd"));
    command.args(arguments.split_whitespace()).current_dir(folder).stdin(Stdio::null());
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("APEXD__") {
            command.env_remove(name);
        }
    }
    let output = command.output().unwrap();
    Ran {
        code: output.status.code().expect("the program was not killed"),
        out: String::from_utf8(output.stdout).unwrap(),
        err: String::from_utf8(output.stderr).unwrap(),
    }
}

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The results of a folder by key, without what the wall clock says.
fn results(folder: &Path) -> BTreeMap<String, Value> {
    let mut results = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if name.starts_with("results") {
            for line in read(&path).lines() {
                let mut record: Value = serde_json::from_str(line).unwrap();
                let object = record.as_object_mut().unwrap();
                object.remove("wall");
                object.remove("realtime_factor");
                let key = record["key"].as_str().unwrap().to_owned();
                assert_eq!(results.insert(key, record), None, "a drive was driven twice");
            }
        }
    }
    results
}

/// A drive of a few seconds of simulated time.
const SHORT: &str = "experiment campaign --seed 3 --family posts,solid --policies map-predictive,frontier \
                     --predictors none,inverted --speeds 4,8";

#[test]
fn interrupted_split_and_spread_over_threads_an_experiment_comes_out_the_same() {
    let root = TempDir::new().unwrap();
    let run = |arguments: &str| {
        let ran = apexd(root.path(), &format!("{SHORT} {arguments}"));
        assert_eq!(ran.code, 0, "{arguments}: {}", ran.err);
        ran
    };
    let of = |name: &str| results(&root.path().join(name));
    run("--runs 6 --jobs 2 --out whole");
    let whole = of("whole");
    assert_eq!(whole.len(), 6);

    // Half of it, then a line that was cut off, then the rest.
    run("--runs 3 --jobs 1 --out parts");
    let file = root.path().join("parts/results.jsonl");
    let torn = read(&file) + "{\"key\": \"12";
    std::fs::write(&file, torn).unwrap();
    run("--runs 6 --jobs 1 --out parts");
    assert_eq!(of("parts"), whole);
    // Everything is done: nothing is driven again.
    let before = read(&file);
    run("--runs 6 --jobs 1 --out parts");
    assert_eq!(read(&file), before);

    run("--runs 6 --jobs 1 --shard 0/2 --out a");
    run("--runs 6 --jobs 1 --shard 1/2 --out b");
    assert!(!root.path().join("a/tables").exists(), "a part has no tables");
    let merged = apexd(root.path(), "experiment merge a b --out joined --json");
    assert_eq!(merged.code, 0, "{}", merged.err);
    assert_eq!(of("joined"), whole);
    for name in ["campaign.csv", "campaign.json", "campaign.md"] {
        let table = |folder: &str| read(&root.path().join(folder).join("tables").join(name));
        assert_eq!(table("joined"), table("whole"), "{name}");
    }
    let json: Value = serde_json::from_str(merged.out.lines().last().unwrap()).unwrap();
    assert_eq!((json["drives"].as_u64(), &json["experiment"]), (Some(6), &"campaign".into()));

    // Every command repeats its drive.
    for record in whole.values().take(3) {
        let command = record["command"].as_str().unwrap().strip_prefix("apexd ").unwrap();
        let ran = apexd(root.path(), &format!("{command} --json --out again"));
        let summary: Value = serde_json::from_str(ran.out.lines().last().unwrap()).unwrap();
        assert_eq!(summary["digest"], record["drive"]["digest"], "{command}");
        assert_eq!(summary["time_s"], record["drive"]["time_s"], "{command}");
    }
}

#[test]
fn the_paper_s_experiment_leaves_tables_figures_and_a_page() {
    let root = TempDir::new().unwrap();
    let page = root.path().join("page.md");
    let frame = "kept\n<!-- apexd experiment paper: begin -->\n<!-- apexd experiment paper: end -->\nkept\n";
    std::fs::write(&page, frame).unwrap();
    let ran = apexd(
        root.path(),
        "experiment paper --mazes 1 --family solid --speeds 6 --pace each-scan,paper \
         --methods frontier,map-predictive+oracle --sweep-mazes 1 --sweep-speed 6 \
         --sensor-ranges 5 --prediction-ranges 2.5 --out out --page page.md --json",
    );
    assert_eq!(ran.code, 0, "{}", ran.err);
    let json: Value = serde_json::from_str(ran.out.lines().last().unwrap()).unwrap();
    let rows = json["tables"]["completion"].as_array().unwrap();
    assert_eq!(rows.len(), 5, "the known map, and two methods at two paces");
    let known = rows.iter().find(|row| row["method"] == "known-map").unwrap();
    assert_eq!(known["mean"].as_f64(), Some(1.0));
    assert!(json["tables"]["floor"][0]["age 0 ms"].as_f64().unwrap() >= 1.0);
    for table in ["completion", "steps", "floor"] {
        let csv = read(&root.path().join(format!("out/tables/{table}.csv")));
        let columns = csv.lines().next().unwrap().split(',').count();
        assert!(csv.lines().count() > 1 && columns > 3, "{csv}");
    }
    for figure in ["completion-solid-each-scan--latency-20-ms", "steps", "courses-solid"] {
        let svg = read(&root.path().join(format!("out/figures/{figure}.svg")));
        assert!(svg.matches("<rect").count() > 3, "{figure} is empty");
        let png = std::fs::read(root.path().join(format!("out/figures/{figure}.png"))).unwrap();
        assert!(png.starts_with(b"\x89PNG") && png.len() > 5000, "{figure}");
    }
    let text = read(&page);
    assert!(text.starts_with("kept\n") && text.ends_with("kept\n"));
    assert!(text.contains("| solid | each scan, latency 20 ms | 6 | frontier |"), "{text}");
    assert!(text.contains("    apexd experiment paper --mazes 1"), "{text}");
    assert!(root.path().join("img/paper-courses-solid.png").exists());
}

#[test]
fn what_cannot_be_driven_is_refused_before_anything_is_driven() {
    let root = TempDir::new().unwrap();
    for (arguments, code, text) in [
        ("paper --methods levitate", 2, "no policy \"levitate\"; it has map-predictive"),
        ("paper --set speed.nonsense=1", 78, "speed.nonsense"),
        ("paper --optimum missing.csv", 2, "missing.csv"),
        ("campaign --policies levitate --runs 2", 2, "no policy \"levitate\""),
        ("campaign --predictors dice --policies map-predictive", 2, "no predictor \"dice\""),
        ("merge missing", 2, "missing"),
    ] {
        let ran = apexd(root.path(), &format!("experiment {arguments}"));
        assert_eq!(ran.code, code, "{arguments}: {}", ran.err);
        assert!(ran.err.contains(text), "{arguments}: {}", ran.err);
    }
}

fn no_clock() -> Stopwatch {
    Box::new(|| std::time::Duration::ZERO)
}

#[test]
fn random_drives_touch_nothing_and_enter_nothing_unseen() {
    let request = CampaignRequest {
        runs: std::env::var("APEXD_CAMPAIGN_RUNS").map_or(24, |n| n.parse().expect("a number")),
        policies: vec!["map-predictive".into(), "frontier".into()],
        predictors: ["none", "oracle", "random", "inverted"].map(str::to_owned).to_vec(),
        // The winding mazes take longest; `tests/campaign.rs` drives them.
        families: vec![Family::Solid, Family::Branching, Family::Posts],
        speeds_mps: vec![4.0, 6.0, 8.0],
        ..CampaignRequest::default()
    };
    let stop = AtomicBool::new(false);
    let tools = Tools { stopwatch: &no_clock, stop: &stop, program: "test" };
    let records: Vec<Record> = request
        .tasks()
        .unwrap()
        .par_iter()
        .map(|task| execute(task, &tools).unwrap().expect("nobody interrupts").record)
        .collect();
    let tally = Tally::of(&records);
    let all: Vec<&Record> = records.iter().collect();
    let tables = tables(&all);
    println!("{}", tables.iter().map(|t| t.markdown()).collect::<Vec<_>>().join("\n"));
    assert!(tally.is_safe(), "{tally:?}");
    assert!(4 * tally.goal >= 3 * tally.solvable, "hardly anybody arrives: {tally:?}");
    let predictive = records.iter().filter(|r| r.task.spec.policy == "map-predictive");
    let tally = Tally::of(predictive);
    assert!(tally.runs > 5 && tally.goal == tally.solvable, "not all arrive: {tally:?}");
}

#[test]
fn unsafe_drives_are_counted_and_their_commands_repeat_them() {
    let root = TempDir::new().unwrap();
    // A car whose brakes come half a second late is outside every claim.
    let ran = apexd(
        root.path(),
        "experiment campaign --runs 4 --seed 3 --family thin --policies map-predictive \
         --predictors none --speeds 8 --set car.drive_lag_s=0.5 --set car.steering_lag_s=0.3 \
         --out sluggish --json",
    );
    assert_eq!(ran.code, 1, "an unsafe drive is a failure: {}", ran.err);
    let json: Value = serde_json::from_str(ran.out.lines().last().unwrap()).unwrap();
    let all = &json["tables"]["campaign"][0];
    assert!(all["collided"].as_u64().unwrap() > 0, "{all}");
    let failures = json["tables"]["failures"].as_array().unwrap();
    let collision = failures.iter().find(|row| row["collisions"].as_u64() > Some(0)).unwrap();
    let command = collision["command"].as_str().unwrap().trim_matches('`');
    let again = apexd(root.path(), &format!("{} --json", command.strip_prefix("apexd ").unwrap()));
    let summary: Value = serde_json::from_str(again.out.lines().last().unwrap()).unwrap();
    assert_eq!((again.code, &summary["digest"]), (1, &collision["digest"]), "{command}");
    assert_eq!(summary["collisions"], collision["collisions"]);
}

/// A corridor of posts in the form of BARN's worlds, closed at its lower end, with these rows of
/// posts in it besides.
fn barn_world(number: u32, posts: &[[f64; 2]]) -> String {
    let at = |i: i32, j: i32| [-4.425 + 0.15 * f64::from(i), 0.075 + 0.15 * f64::from(j)];
    let mut all: Vec<[f64; 2]> = (0..30).map(|i| at(i, 0)).collect();
    all.extend((0..64).flat_map(|j| [at(0, j), at(29, j)]));
    all.extend(posts);
    serde_json::json!({
        "world": number,
        "cylinder_radius_m": 0.075,
        "start": [-2.25, 3.0, 1.57],
        "goal": [-2.25, 13.0],
        "obstacles_xy_m": all,
        "reference_path_xy_m": [[-2.25, 5.0], [-1.25, 6.0], [-2.25, 7.0]],
    })
    .to_string()
}

#[test]
fn barn_s_worlds_are_scored_and_those_without_a_way_counted_apart() {
    let root = TempDir::new().unwrap();
    let worlds = root.path().join("worlds");
    std::fs::create_dir(&worlds).unwrap();
    let block: Vec<[f64; 2]> = (12..18).map(|i| [-4.425 + 0.15 * f64::from(i), 6.075]).collect();
    let wall: Vec<[f64; 2]> = (1..29).map(|i| [-4.425 + 0.15 * f64::from(i), 6.075]).collect();
    std::fs::write(worlds.join("world_003.json"), barn_world(3, &block)).unwrap();
    std::fs::write(worlds.join("world_018.json"), barn_world(18, &wall)).unwrap();
    std::fs::write(worlds.join("SOURCE.md"), "not a world").unwrap();
    let page = root.path().join("page.md");
    std::fs::write(
        &page,
        "<!-- apexd experiment barn: begin -->\n<!-- apexd experiment barn: end -->\n",
    )
    .unwrap();
    let command = "experiment barn --worlds worlds --methods map-predictive+none --page page.md \
                   --json";
    let ran = apexd(root.path(), command);
    assert_eq!(ran.code, 0, "{}", ran.err);
    let json: Value = serde_json::from_str(ran.out.lines().last().unwrap()).unwrap();
    assert_eq!(json["drives"], 4);
    let summary = json["summary"].as_str().unwrap();
    assert!(summary.contains("through 1 of 2 worlds; not through 18."), "{summary}");
    for row in json["tables"]["barn"].as_array().unwrap() {
        assert_eq!(
            (&row["worlds"], &row["crossed"], &row["passable"]),
            (&2.into(), &1.into(), &1.into())
        );
        assert_eq!((&row["collided"], &row["entered unknown"]), (&0.into(), &0.into()));
        // The path is 10.83 m long, and hardly a curve keeps the car from its 2 m/s.
        let score = row["score in these"].as_f64().unwrap();
        assert!((score - 0.5).abs() < 1e-9, "{row}");
        assert!((row["score"].as_f64().unwrap() - 0.25).abs() < 1e-9, "{row}");
    }
    let text = read(&page);
    assert!(
        text.contains("| world | path m | par s | known-map | map-predictive+none |"),
        "{text}"
    );
    assert!(text.contains("| 3 | 10.83 | 5.41 | 0.500 | 0.500 |"), "{text}");

    // Nothing is driven again, and every command repeats its drive.
    let place = root.path().join("runs/barn");
    let before = read(&place.join("results.jsonl"));
    assert_eq!(apexd(root.path(), command).code, 0);
    assert_eq!(read(&place.join("results.jsonl")), before);
    for record in results(&place).values() {
        let command = record["command"].as_str().unwrap().strip_prefix("apexd ").unwrap();
        let again = apexd(root.path(), &format!("{command} --json --out again"));
        let summary: Value = serde_json::from_str(again.out.lines().last().unwrap()).unwrap();
        assert_eq!(summary["digest"], record["drive"]["digest"], "{command}");
    }

    let nowhere = apexd(root.path(), "experiment barn --worlds again");
    assert_eq!(nowhere.code, 2);
    assert!(nowhere.err.contains("there is no world in it"), "{}", nowhere.err);
}
