//! The program as scripts and people meet it: the built binary, its exit codes, what it prints and
//! what it leaves behind.

#![allow(
    clippy::disallowed_methods,
    clippy::unwrap_used,
    reason = "tests of a program that runs by the clock"
)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use apexd::frames::Pose;
use apexd::mapfile::{self, MapCell, MapFile};
use tempfile::TempDir;

/// What one run of the program came to.
struct Ran {
    code: i32,
    out: String,
    err: String,
}

impl Ran {
    /// The JSON object on the last line of standard output.
    fn json(&self) -> serde_json::Value {
        let line = self.out.lines().last().unwrap_or_else(|| panic!("no output: {}", self.err));
        serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))
    }

    /// Fails unless the run ended with `code` after one message that holds all of `texts`.
    fn refused(&self, code: i32, texts: &[&str]) {
        assert_eq!(self.code, code, "{}", self.err);
        assert_eq!(self.err.lines().count(), 1, "one message is enough: {}", self.err);
        for text in texts {
            assert!(self.err.contains(text), "{text:?} is not in {}", self.err);
        }
        assert!(self.out.is_empty(), "{}", self.out);
    }
}

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_apexd"));
    command.args(arguments).current_dir(folder).stdin(Stdio::null());
    for (name, _) in std::env::vars_os() {
        if name.to_string_lossy().starts_with("APEXD__") {
            command.env_remove(name);
        }
    }
    command
}

fn ran(output: Output) -> Ran {
    Ran {
        code: output.status.code().expect("the program was not killed"),
        out: String::from_utf8(output.stdout).unwrap(),
        err: String::from_utf8(output.stderr).unwrap(),
    }
}

fn apexd(folder: &Path, arguments: &[&str]) -> Ran {
    ran(command(folder, arguments).output().unwrap())
}

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

const RESOLUTION_M: f64 = 0.1;

/// A room of 9 by 4 m with its lower left corner at (-1, -2) m, walls around it, and more of them
/// where `wall` says so (metres in the map frame).
fn room(folder: &Path, wall: impl Fn(f64, f64) -> bool) -> PathBuf {
    let (width, height) = (90, 40);
    let cell = |i: usize| {
        let (ix, iy) = (i % width, i / width);
        let edge = ix == 0 || iy == 0 || ix == width - 1 || iy == height - 1;
        let centre = |i: usize| (i as f64 + 0.5) * RESOLUTION_M;
        if edge || wall(centre(ix) - 1.0, centre(iy) - 2.0) {
            MapCell::Occupied
        } else {
            MapCell::Free
        }
    };
    let map = MapFile {
        resolution_m: RESOLUTION_M,
        origin: Pose::new(-1.0, -2.0, 0.0),
        width,
        height,
        cells: (0..width * height).map(cell).collect(),
    };
    let path = folder.join("room.yaml");
    mapfile::save(&path, &map).unwrap();
    path
}

/// Drives across the room, 6 m straight on unless `more` says otherwise.
fn cross(folder: &Path, more: &[&str]) -> Ran {
    apexd(folder, &crossing(more))
}

/// The arguments for that.
fn crossing<'a>(more: &[&'a str]) -> Vec<&'a str> {
    let fixed = ["sil", "--map", "room.yaml", "--start", "0,0,0", "--goal", "6,0"];
    let given = |option: &&str| more.contains(option);
    let mut arguments: Vec<&str> = fixed[..3].to_vec();
    for pair in fixed[3..].chunks(2) {
        if !given(&pair[0]) {
            arguments.extend(pair);
        }
    }
    arguments.extend(more);
    arguments
}

#[test]
fn a_short_drive_reaches_its_goal_twice_in_the_very_same_way() {
    let folder = folder();
    room(folder.path(), |x, y| (2.5..3.0).contains(&x) && y > -0.5);
    let first = cross(folder.path(), &["--json", "--out", "a"]);
    assert_eq!(first.code, 0, "{}", first.err);
    let json = first.json();
    assert_eq!(json["outcome"], "goal");
    assert_eq!((&json["collisions"], &json["unknown_entries"]), (&0.into(), &0.into()));
    for key in ["time_s", "path_m", "min_clearance_m", "replans", "candidates", "realtime_factor"] {
        assert!(json[key].as_f64().unwrap() > 0.0, "{key}: {json}");
    }
    for key in ["plan_ms", "predict_ms", "age_ms"] {
        for figure in ["p50", "p99", "max"] {
            assert!(json[key][figure].as_f64().unwrap() >= 0.0, "{key}.{figure}: {json}");
        }
    }
    assert!(json["plans_rejected"].is_u64() && json["guard_stops"].is_u64(), "{json}");

    let second = cross(folder.path(), &["--json", "--out", "b"]);
    assert_eq!(second.json()["digest"], json["digest"]);
    let slower = cross(folder.path(), &["--json", "--out", "c", "--speed-max", "1"]);
    assert_ne!(slower.json()["digest"], json["digest"]);
    assert!(slower.json()["time_s"].as_f64() > json["time_s"].as_f64());

    let pictures = ["drive.svg", "drive.png", "speed.svg", "speed.png"];
    let foreseen = ["prediction.svg", "prediction.png"];
    for name in pictures.into_iter().chain(foreseen).chain(["summary.json"]) {
        let bytes = std::fs::read(folder.path().join("a").join(name)).unwrap();
        assert!(!bytes.is_empty(), "{name}");
    }
    let text = std::fs::read_to_string(folder.path().join("a/summary.json")).unwrap();
    let kept: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert_eq!(kept, json);
}

#[test]
fn a_person_reads_a_summary_and_finds_the_report_in_runs() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    let ran = cross(folder.path(), &["--policy", "known-map", "--latency", "0.01"]);
    assert_eq!(ran.code, 0, "{}", ran.err);
    for text in ["Goal reached after", "0 collisions", "plans rejected", "runs/"] {
        assert!(ran.out.contains(text), "{text}: {}", ran.out);
    }
    let reports: Vec<_> = std::fs::read_dir(folder.path().join("runs")).unwrap().collect();
    assert_eq!(reports.len(), 1);
}

#[test]
fn every_policy_and_predictor_drives() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    for policy in ["map-predictive", "frontier", "janson", "janson-lite", "known-map"] {
        let ran = cross(folder.path(), &["--json", "--out", policy, "--policy", policy]);
        assert_eq!((ran.code, &ran.json()["outcome"]), (0, &"goal".into()), "{policy}");
    }
    for predictor in ["cnp", "none", "oracle", "random", "inverted"] {
        let options = ["--json", "--out", predictor, "--predictor", predictor, "--seed", "7"];
        let ran = cross(folder.path(), &options);
        assert_eq!((ran.code, &ran.json()["outcome"]), (0, &"goal".into()), "{predictor}");
    }
}

#[test]
fn a_network_is_taken_by_its_file_or_refused_with_the_reason() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/params/cnp.onnx");
    let by_file = cross(folder.path(), &["--json", "--out", "a", "--predictor", shipped]);
    assert_eq!(by_file.code, 0, "{}", by_file.err);
    let by_name = cross(folder.path(), &["--json", "--out", "b", "--predictor", "cnp"]);
    assert_eq!(by_file.json()["digest"], by_name.json()["digest"]);
    std::fs::write(folder.path().join("bad.onnx"), "not a network").unwrap();
    for (file, reason) in [("bad.onnx", "no intact ONNX file"), ("none.onnx", "cannot be read")] {
        let ran = cross(folder.path(), &["--predictor", file]);
        assert_eq!(ran.code, 2, "{}", ran.err);
        assert!(ran.err.contains(file) && ran.err.contains(reason), "{}", ran.err);
    }
    let set = ["--json", "--predictor", "cnp", "--set", "predict.model=none.onnx"];
    let ran = cross(folder.path(), &set);
    assert_eq!(ran.code, 0, "{}", ran.err);
    assert!(ran.json()["prediction_faults"].as_u64().unwrap() >= 1, "{}", ran.out);
    assert!(ran.err.contains("driving without prediction"), "{}", ran.err);
}

/// A bus without CAN FD, with as many beams as it carries.
#[test]
fn a_maze_is_driven_over_classic_frames() {
    let folder = folder();
    let small = ["--set", "lidar.beams=360", "--set", "lidar.rate_hz=10"];
    let drive = |set: &[&str]| {
        let arguments = ["sil", "--maze", "3", "--predictor", "none", "--out", "out", "--json"];
        apexd(folder.path(), &[&arguments, set].concat())
    };
    let classic = drive(&[&small[..], &["--set", "can.layout=classic"]].concat());
    let json = classic.json();
    assert_eq!((classic.code, &json["outcome"]), (0, &"goal".into()), "{json}");
    assert_eq!((&json["collisions"], &json["unknown_entries"]), (&0.into(), &0.into()));
    assert!(!classic.err.contains("bus"), "{}", classic.err);
    let fd = drive(&small).json();
    assert_ne!(json["digest"], fd["digest"], "another layout rounds and arrives otherwise");
    // More than the bus carries is said, and driven as well as it can be.
    let limit = ["--set", "can.layout=classic", "--time-limit", "0.2"];
    let loaded = drive(&limit);
    assert!(loaded.err.contains("of the bus"), "{}", loaded.err);
}

#[test]
fn the_car_refuses_what_cannot_be_and_says_why() {
    let folder = folder();
    let car = |more: &[&str]| apexd(folder.path(), &[&["car", "--can", "nocan0"], more].concat());
    // With or without CAN in this machine's kernel, that interface is not there.
    let refused = car(&["--truth", "truth.jsonl"]);
    assert_eq!(refused.code, 2, "{}", refused.err);
    assert!(refused.err.contains("nocan0") || refused.err.contains("CAN sockets"));
    assert!(!folder.path().join("truth.jsonl").exists());
    car(&["--start", "-50,0,0"]).refused(2, &["start", "outside the map"]);
    std::fs::write(folder.path().join("s.toml"), "[[event]]\nspeed = 1.0\n").unwrap();
    let script = car(&["--script", "s.toml"]);
    assert_eq!(script.code, 2);
    assert!(script.err.contains("s.toml") && script.err.contains("speed_mps"), "{}", script.err);
    car(&["--script", "none.toml"]).refused(2, &["none.toml"]);
    assert_eq!(car(&["--set", "can.layout=lin"]).code, 78);
    assert_eq!(car(&["--layout", "lin"]).code, 2);
}

#[test]
fn the_daemon_says_why_it_cannot_begin_and_forgets_no_crash() {
    let folder = folder();
    let state = folder.path().join("state");
    std::fs::create_dir(&state).unwrap();
    let directory = format!("daemon.state_directory={}", state.display());
    let begin = || {
        let quick = ["--set", "predict.kind=none", "--set", "daemon.lock_memory=false"];
        let mut words = vec!["run", "--can", "nocan0", "--set", &directory];
        words.extend(quick);
        apexd(folder.path(), &words)
    };
    let first = begin();
    assert_eq!(first.code, 1, "{}", first.err);
    // Which of the two depends on the kernel that the test runs on.
    let named = ["nocan0", "modprobe can_raw"].iter().any(|text| first.err.contains(text));
    assert!(named, "{}", first.err);
    assert!(!first.err.contains("ended unexpectedly"), "{}", first.err);
    assert_eq!(std::fs::read_dir(&state).unwrap().count(), 0, "no mark is left");

    // As a daemon leaves it that was killed.
    std::fs::write(state.join("running"), "1\n").unwrap();
    for _ in 0..2 {
        let ran = begin();
        assert_eq!(ran.code, 1, "{}", ran.err);
        let said = "previous run ended unexpectedly; disarmed";
        assert!(ran.err.contains(said), "{}", ran.err);
    }
}

#[test]
fn the_daemon_refuses_what_it_cannot_do() {
    let folder = folder();
    for (arguments, code, text) in [
        ("run --until-goal", 2, "--goal"),
        ("run --goal 1", 2, "two numbers X,Y"),
        ("run --time-limit 0", 2, "above zero"),
        ("run --set daemon.priority=100", 78, "0 to 99"),
        ("run --set plan.policy=known-map", 78, "true map"),
        ("run --set predict.kind=oracle --set daemon.lock_memory=false", 78, "true map"),
    ] {
        let words: Vec<&str> = arguments.split_whitespace().collect();
        let ran = apexd(folder.path(), &words);
        assert_eq!(ran.code, code, "{arguments}: {}", ran.err);
        assert!(ran.err.contains(text), "{arguments}: {}", ran.err);
        assert!(ran.out.is_empty(), "{}", ran.out);
    }
}

#[test]
fn a_goal_behind_closed_walls_is_unreachable() {
    let folder = folder();
    room(folder.path(), |x, _| (3.0..3.3).contains(&x));
    let ran = cross(folder.path(), &["--json", "--out", "out"]);
    assert_eq!((ran.code, &ran.json()["outcome"]), (1, &"unreachable".into()), "{}", ran.err);
}

#[test]
fn a_drive_ends_at_its_time_limit() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    let ran = cross(folder.path(), &["--json", "--out", "out", "--time-limit", "0.5"]);
    assert_eq!((ran.code, &ran.json()["outcome"]), (1, &"timeout".into()), "{}", ran.err);
}

#[test]
fn places_that_no_car_can_be_at_are_refused() {
    let folder = folder();
    room(folder.path(), |x, y| (5.8..6.2).contains(&x) && y.abs() < 0.2);
    let at = folder.path();
    cross(at, &[]).refused(2, &["the goal (6.00, 0.00) m is inside a wall"]);
    let options = ["--goal", "40,0"];
    cross(at, &options).refused(2, &["the goal (40.00, 0.00) m", "(-1.00, -2.00)", "(8.00, 2.00)"]);
    let options = ["--goal", "3,0", "--start", "-5,0,0"];
    cross(at, &options).refused(2, &["the start (-5.00, 0.00) m is outside the map"]);
    let options = ["--goal", "3,0", "--start", "5.7,0,0"];
    cross(at, &options).refused(2, &["the start (5.70, 0.00) m", "0.10 m", "radius 0.2 m"]);
    let reports = std::fs::read_dir(at.join("runs")).unwrap().count();
    assert_eq!(reports, 0, "a refused drive leaves no report");
}

#[test]
fn files_that_are_no_maps_are_refused() {
    let folder = folder();
    let yaml = room(folder.path(), |_, _| false);
    let picture = yaml.with_extension("pgm");
    let whole = std::fs::read(&picture).unwrap();

    std::fs::write(&picture, &whole[..whole.len() / 2]).unwrap();
    cross(folder.path(), &[]).refused(2, &["room.pgm", "cut off", "90 x 40"]);
    std::fs::write(&picture, "P5\n2000000 2000000\n255\n").unwrap();
    cross(folder.path(), &[]).refused(2, &["room.pgm", "2000000 x 2000000", "at most"]);
    std::fs::write(&picture, "no picture").unwrap();
    cross(folder.path(), &[]).refused(2, &["room.pgm", "neither a PNG nor a PGM"]);
    std::fs::remove_file(&picture).unwrap();
    cross(folder.path(), &[]).refused(2, &["cannot read", "room.pgm"]);

    std::fs::write(&picture, &whole).unwrap();
    std::fs::write(&yaml, "image: room.pgm\nresolution: -1\norigin: [0, 0, 0]\n").unwrap();
    cross(folder.path(), &[]).refused(2, &["resolution is -1", "from 0.001 to 10"]);
    std::fs::write(&yaml, "just a line of text").unwrap();
    cross(folder.path(), &[]).refused(2, &["room.yaml is not a map file", "map_server"]);
    std::fs::remove_file(&yaml).unwrap();
    cross(folder.path(), &[]).refused(2, &["cannot read", "room.yaml"]);
}

#[test]
fn a_true_map_beyond_all_measure_is_refused() {
    let folder = folder();
    let yaml = room(folder.path(), |_, _| false);
    // 90 by 40 cells of 10 m are 36 million cells of 0.1 m, and 144 million of 0.05 m.
    std::fs::write(&yaml, "image: room.pgm\nresolution: 10\norigin: [0, 0, 0]\n").unwrap();
    let options = ["--start", "50,50,0", "--goal", "90,50", "--policy", "known-map"];
    let ran = cross(folder.path(), &[&options[..], &["--set", "map.resolution_m=0.05"]].concat());
    ran.refused(2, &["144000000 cells of 0.05 m", "at most 67108864"]);
}

#[test]
fn bad_usage_and_bad_configuration_have_codes_of_their_own() {
    let folder = folder();
    let at = folder.path();
    for arguments in [
        &["sil", "--policy", "best"][..],
        &["sil", "--family", "round"],
        &["sil", "--map", "room.yaml"],
        &["sil", "--start", "1,2"],
        &["sil", "--speed-max", "-1"],
        &["sil", "--latency", "soon"],
        &["drive"],
        &[],
    ] {
        let ran = apexd(at, arguments);
        assert_eq!(ran.code, 2, "{arguments:?}: {}", ran.err);
        assert!(!ran.err.is_empty(), "{arguments:?}");
    }
    let ran = apexd(at, &["sil", "--policy", "best"]);
    for name in ["map-predictive", "frontier", "janson", "janson-lite", "known-map"] {
        assert!(ran.err.contains(name), "{}", ran.err);
    }
    let ran = apexd(at, &["sil", "--speed-max", "1000"]);
    ran.refused(2, &["--speed-max", "speed.speed_max_mps is 1000.0, allowed is 0.1 to 20 m/s"]);
    let ran = apexd(at, &["sil", "--lidar-range", "1e6"]);
    ran.refused(2, &["--lidar-range", "lidar.range_m is 1000000.0, allowed is"]);

    for (arguments, said) in [
        (["--set", "vehicle.friction=9"], "vehicle.friction is 9, allowed is 0.05 to 2"),
        (["--set", "vehicle.frition=1"], "did you mean vehicle.friction?"),
        (["--set", "vehicle.friction=much"], "is \"much\", but must be 0.05 to 2"),
        (["--config", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ] {
        let ran = apexd(at, &[&["sil"], &arguments[..]].concat());
        assert_eq!(ran.code, 78, "{}", ran.err);
        assert!(ran.err.contains(said), "{}", ran.err);
    }
    let ran = command(at, &["sil"]).env("APEXD__VEHICLE__FRICTION", "0").output();
    assert_eq!(ran.unwrap().status.code(), Some(78));
    assert!(!at.join("runs").exists(), "nothing was driven");
}

#[test]
fn every_command_helps() {
    let folder = folder();
    let help = apexd(folder.path(), &["--help"]);
    assert_eq!(help.code, 0);
    for command in ["sil", "maze", "dataset", "evaluate", "params", "check"] {
        assert!(help.out.contains(command), "{}", help.out);
        let ran = apexd(folder.path(), &[command, "--help"]);
        assert_eq!((ran.code, ran.err.as_str()), (0, ""), "{command}");
        assert!(ran.out.contains("Usage:"), "{}", ran.out);
    }
    assert_eq!(
        apexd(folder.path(), &["--version"]).out.trim(),
        concat!("apexd ", env!("CARGO_PKG_VERSION"))
    );
}

#[test]
fn the_table_of_parameters_comes_in_three_forms() {
    let folder = folder();
    let plain = apexd(folder.path(), &["params"]);
    assert!(plain.code == 0 && plain.out.contains("speed_max_mps"), "{}", plain.out);
    let json = apexd(folder.path(), &["params", "--json"]);
    assert!(json.json().is_object());
    let page = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/parameters.md");
    let markdown = apexd(folder.path(), &["params", "--markdown"]).out;
    assert_eq!(markdown.trim_end(), std::fs::read_to_string(page).unwrap().trim_end());
}

#[test]
fn a_configuration_file_is_checked() {
    let folder = folder();
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/params/rc-car.toml");
    assert_eq!(apexd(folder.path(), &["check", shipped]).code, 0);
    std::fs::write(folder.path().join("bad.toml"), "[vehicle]\nmas_kg = 3\nfriction = 9\n")
        .unwrap();
    let bad = apexd(folder.path(), &["check", "bad.toml"]);
    assert_eq!(bad.code, 78);
    for text in ["bad.toml:2", "did you mean vehicle.mass_kg?", "bad.toml:3", "0.05 to 2"] {
        assert!(bad.out.contains(text), "{}", bad.out);
    }
    let bad = apexd(folder.path(), &["check", "bad.toml", "--json"]);
    assert_eq!((bad.code, &bad.json()["ok"]), (78, &false.into()));
}

#[test]
fn a_maze_becomes_files_that_load_as_the_same_maze() {
    let folder = folder();
    for family in ["thin", "solid", "branching"] {
        let name = format!("{family}.yaml");
        let arguments = ["maze", "--seed", "3", "--family", family, "--out", &name];
        assert_eq!(apexd(folder.path(), &arguments).code, 0);
        let map = mapfile::load(folder.path().join(&name)).unwrap();
        let kind = apexd::sim::maze::Family::from_name(family).unwrap();
        let maze = apexd::sim::maze::generate(kind, 3, 0.1).unwrap();
        assert_eq!(map, maze.to_map_file());
    }
    let arguments = ["maze", "--seed", "3", "--out", "maze.png"];
    apexd(folder.path(), &arguments).refused(2, &["maze.png", "ends in .yaml or .yml"]);
    let arguments = ["maze", "--seed", "3", "--out", "no/where.yaml"];
    apexd(folder.path(), &arguments).refused(2, &["cannot write", "no/where"]);
}

#[test]
fn a_drive_in_real_time_keeps_pace_with_the_clock() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    let begin = Instant::now();
    let ran = cross(folder.path(), &["--json", "--out", "out", "--realtime"]);
    let wall_s = begin.elapsed().as_secs_f64();
    assert_eq!((ran.code, &ran.json()["outcome"]), (0, &"goal".into()), "{}", ran.err);
    let factor = ran.json()["realtime_factor"].as_f64().unwrap();
    assert!(factor <= 1.01 && factor > 0.2, "{factor}");
    assert!(wall_s >= ran.json()["time_s"].as_f64().unwrap());
    // The clock paces the drive, it does not change it.
    let fast = cross(folder.path(), &["--json", "--out", "fast"]);
    assert_eq!(fast.json()["digest"], ran.json()["digest"]);
}

#[cfg(unix)]
#[test]
fn a_drive_that_is_told_to_end_stops_the_car_and_reports() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    for signal in ["INT", "TERM"] {
        let slowly = ["--realtime", "--speed-max", "0.5", "--lidar-range", "1.5"];
        let arguments = crossing(&[&["--json", "--out", signal][..], &slowly].concat());
        let mut command = command(folder.path(), &arguments);
        let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(1500));
        let id = child.id().to_string();
        assert!(Command::new("kill").args(["-s", signal, &id]).status().unwrap().success());
        let ran = ran(child.wait_with_output().unwrap());
        assert_eq!((ran.code, &ran.json()["outcome"]), (1, &"interrupted".into()), "{}", ran.err);
        // Half a metre a second, then the rest of a plan that sees a metre and a half ahead.
        let path_m = ran.json()["path_m"].as_f64().unwrap();
        assert!(path_m > 0.05 && path_m < 3.0, "{path_m}");
        assert_eq!(ran.json()["collisions"], 0);
        assert!(folder.path().join(signal).join("drive.png").exists());
    }
}

#[test]
fn a_data_set_is_written_and_scored() {
    let folder = tempfile::tempdir().unwrap();
    let scenes = ["--world-resolution", "0.25", "--lidar-range", "5", "--beams", "720"];
    let small = ["--scenes-per-world", "3"];
    let dataset = |out: &str, more: &[&str]| {
        let start = ["dataset", "--out", out];
        apexd(folder.path(), &[&start[..], &scenes, &small, more].concat())
    };
    let held_out = ["--families", "thin,solid", "--seeds", "1000000..1000002", "--held-out"];
    let made = dataset("test", &[&held_out[..], &["--json"]].concat());
    assert_eq!(made.code, 0, "{}", made.err);
    let manifest = made.json();
    assert_eq!((&manifest["scenes"], &manifest["held_out"]), (&12.into(), &true.into()));
    assert_eq!(manifest["arrays"].as_array().unwrap().len(), 8);

    dataset("test", &held_out).refused(2, &["test is not empty", "--force"]);
    dataset("x", &held_out[..4]).refused(2, &["1000000 to 1000001", "held out", "--held-out"]);
    dataset("x", &["--seeds", "5..7", "--held-out"]).refused(2, &["--held-out", "is 5"]);
    dataset("x", &[]).refused(2, &["--seeds", "--maps"]);
    dataset("x", &["--maps", "nowhere"]).refused(1, &["nowhere"]);
    assert!(!folder.path().join("x").exists());

    let evaluate = |more: &[&str]| apexd(folder.path(), &[&["evaluate"], more].concat());
    let fit = ["--fit-seeds", "0..2"];
    let set = ["--dataset", "test", "--out", "scores", "--pictures", "1", "--json"];
    let scored = evaluate(&[&set[..], &fit].concat());
    assert_eq!(scored.code, 0, "{}", scored.err);
    let scores = scored.json();
    let set = &scores["sets"][0];
    assert_eq!((&set["scenes"], &set["held_out"]), (&12.into(), &true.into()));
    assert_eq!(set["radii"][1]["radius_m"], 5.0);
    assert!(set["radii"][0]["predictors"][0]["log_loss"].as_f64().unwrap() > 0.0);
    for file in ["evaluation.json", "reliability-data-set-test.svg", "scene-data-set-test-0.png"] {
        assert!(folder.path().join("scores").join(file).exists(), "{file}");
    }
    let table =
        evaluate(&[&["--family", "solid", "--seeds", "7..9"], &scenes[..], &small, &fit].concat());
    assert_eq!(table.code, 0, "{}", table.err);
    assert!(table.out.contains("NOT held out") && table.out.contains("lattice oracle"));

    evaluate(&[]).refused(2, &["--family", "--maps", "--dataset"]);
    evaluate(&["--dataset", "scores"]).refused(1, &["manifest.json"]);
}

#[test]
fn networks_are_scored_and_get_a_card() {
    let folder = tempfile::tempdir().unwrap();
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("params/cnp.onnx");
    std::fs::copy(shipped, folder.path().join("net.onnx")).unwrap();
    let evaluate = |more: &str| {
        let common = "evaluate --family thin --fit-seeds 0..2 --scenes-per-world 2 --radius 5";
        let words: Vec<&str> = common.split(' ').chain(more.split(' ')).collect();
        apexd(folder.path(), &words)
    };
    let held_out = "--seeds 1000000..1000002 --model net.onnx";
    let scored = evaluate(&format!("{held_out} --json --card"));
    assert_eq!(scored.code, 0, "{}", scored.err);
    let predictors = &scored.json()["sets"][0]["radii"][0]["predictors"];
    assert_eq!(predictors[0]["name"], "net");
    assert!(predictors[0]["log_loss"].as_f64().unwrap() > 0.0);
    let card = std::fs::read_to_string(folder.path().join("net.md")).unwrap();
    for text in ["# net.onnx", "SHA-256", "trained_on", "| net |", "| prior |", "1000001"] {
        assert!(card.contains(text), "{text}: {card}");
    }
    let training = evaluate("--seeds 0..2 --model net.onnx --card");
    training.refused(2, &["no model card", "seeds 0 to 1"]);
    let no_model = evaluate("--card");
    assert!(no_model.code == 2 && no_model.err.contains("--model"), "{}", no_model.err);
    evaluate("--model none.onnx").refused(2, &["none.onnx"]);
    std::fs::write(folder.path().join("bad.onnx"), b"no network").unwrap();
    evaluate("--model bad.onnx").refused(2, &["bad.onnx"]);
    evaluate("--model net.onnx --resolution 0.5 --world-resolution 0.25")
        .refused(2, &["0.5 m", "net", "0.25 m"]);
}

#[test]
fn a_drive_is_written_down_and_replayed_to_the_last_bit() {
    let folder = folder();
    room(folder.path(), |x, y| (2.5..3.0).contains(&x) && y > -0.5);
    let drive = cross(folder.path(), &["--json", "--out", "out", "--log", "drive.mcap"]);
    assert_eq!(drive.code, 0, "{}", drive.err);
    let digest = drive.json()["digest"].clone();

    let same = apexd(folder.path(), &["replay", "drive.mcap", "--json"]);
    assert_eq!(same.code, 0, "{} {}", same.out, same.err);
    let json = same.json();
    assert_eq!((&json["identical"], &json["ended"]), (&true.into(), &"closed".into()));
    assert_eq!((&json["digest_then"], &json["digest_now"]), (&digest, &digest));
    assert!(json["frames"].as_u64().unwrap() > 100 && json["plans"].as_u64().unwrap() > 10);
    assert_eq!(json["first"], serde_json::Value::Null);
    let said = apexd(folder.path(), &["replay", "drive.mcap"]).out;
    let begin = format!("identical: {} frames, {} plans\n", json["frames"], json["plans"]);
    assert!(said.starts_with(&begin), "{said}");

    // Other parameters: no failure, but figures.
    let set = ["replay", "drive.mcap", "--json", "--set", "speed.speed_max_mps=1"];
    let other = apexd(folder.path(), &set);
    assert_eq!((other.code, &other.json()["identical"]), (0, &false.into()), "{}", other.err);
    assert!(other.json()["setpoints"]["max_n"].as_f64().unwrap() > 0.1, "{}", other.out);
    let said = apexd(folder.path(), &[&set[..2], &set[3..]].concat()).out;
    assert!(said.starts_with("different: ") && said.contains("first at"), "{said}");
    let unknown = apexd(folder.path(), &["replay", "drive.mcap", "--set", "speed.speed_mx=1"]);
    assert_eq!(unknown.code, 78, "{}", unknown.err);
    assert!(unknown.err.contains("no such parameter"), "{}", unknown.err);

    // A log whose frames are not what comes out.
    let log = folder.path().join("drive.mcap");
    let bytes = std::fs::read(&log).unwrap();
    let tampered = folder.path().join("tampered.mcap");
    std::fs::write(&tampered, with_another_frame(&bytes)).unwrap();
    let found = apexd(folder.path(), &["replay", "tampered.mcap", "--json"]);
    assert_eq!((found.code, &found.json()["frames_differing"]), (1, &1.into()), "{}", found.err);
    assert_eq!(found.json()["first"]["what"], "frame");

    // Cut off in the middle, damaged, none at all.
    std::fs::write(&log, &bytes[..bytes.len() / 2]).unwrap();
    let cut = apexd(folder.path(), &["replay", "drive.mcap", "--json"]);
    assert_eq!((cut.code, &cut.json()["ended"]), (0, &"cut-off".into()), "{}", cut.err);
    let mut damaged = bytes.clone();
    damaged[bytes.len() / 2] ^= 1;
    std::fs::write(&log, damaged).unwrap();
    apexd(folder.path(), &["replay", "drive.mcap"])
        .refused(2, &["drive.mcap: the log is damaged at byte "]);
    apexd(folder.path(), &["replay", "room.yaml"]).refused(2, &["no log of apexd"]);
    apexd(folder.path(), &["replay", "gone.mcap"]).refused(2, &["gone.mcap: cannot read the log"]);
    let nowhere = cross(folder.path(), &["--out", "out", "--log", "no/such/folder/a.mcap"]);
    nowhere.refused(2, &["cannot write the log no/such/folder/a.mcap"]);
}

/// The same log with one bit of a frame sent in its middle changed.
fn with_another_frame(bytes: &[u8]) -> Vec<u8> {
    use apexd::record::{Entry, LogReader, LogWriter};
    let mut log = LogReader::new(bytes).unwrap();
    let mut entries: Vec<_> = std::iter::from_fn(|| log.read().unwrap()).collect();
    let middle = entries.len() / 2;
    let sent = entries[middle..].iter_mut().find_map(|(_, entry)| match entry {
        Entry::Sent(frame) => Some(frame),
        _ => None,
    });
    sent.unwrap().data_mut()[0] ^= 1;
    let mut out = LogWriter::new(Vec::new()).unwrap();
    entries.iter().for_each(|(at, entry)| out.put(*at, entry).unwrap());
    out.close().unwrap()
}

#[test]
fn the_log_of_a_killed_drive_is_replayed_up_to_its_end() {
    let folder = folder();
    room(folder.path(), |_, _| false);
    let slowly = ["--realtime", "--speed-max", "0.3", "--set", "predict.kind=none"];
    let logged = ["--out", "out", "--log", "drive.mcap"];
    let arguments = crossing(&[&logged[..], &slowly].concat());
    let mut child = command(folder.path(), &arguments).stderr(Stdio::null()).spawn().unwrap();
    let log = folder.path().join("drive.mcap");
    let begin = Instant::now();
    let length = || log.metadata().map_or(0, |about| about.len());
    while length() < 300_000 {
        assert!(begin.elapsed() < Duration::from_secs(300), "{} bytes", length());
        assert!(child.try_wait().unwrap().is_none(), "it ended by itself");
        std::thread::sleep(Duration::from_millis(20));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let ran = apexd(folder.path(), &["replay", "drive.mcap", "--json"]);
    assert_eq!(ran.code, 0, "{} {}", ran.out, ran.err);
    let json = ran.json();
    assert_eq!((&json["identical"], &json["ended"]), (&true.into(), &"cut-off".into()));
    assert!(json["frames"].as_u64().unwrap() > 100, "{json}");
}
