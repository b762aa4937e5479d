use std::cell::RefCell;

use super::report::DriveRecord;
use super::sil::{Progress, SilRequest};
use super::*;
use crate::frames::{Point, Pose};
use crate::map::{Cell, CellIndex, Grid};
use crate::sim::drive::{Spread, Summary, Trace};
use crate::sim::maze::Family;

/// Ends every drive at once, in a given way, and remembers what it was asked for.
struct Puppet {
    outcome: Result<Outcome, fn() -> RunError>,
    asked: RefCell<Vec<SilRequest>>,
}

impl Puppet {
    fn that_ends(outcome: Outcome) -> Self {
        Self { outcome: Ok(outcome), asked: RefCell::default() }
    }
}

impl Simulator for Puppet {
    fn drive(
        &self,
        request: &SilRequest,
        progress: &mut dyn FnMut(&Progress),
    ) -> Result<DriveRecord, RunError> {
        self.asked.borrow_mut().push(request.clone());
        progress(&Progress { remaining_m: 1.0, ..Progress::default() });
        let outcome = match self.outcome {
            Ok(outcome) => outcome,
            Err(error) => return Err(error()),
        };
        let mut grid = Grid::new(0.1);
        grid.set(CellIndex::new(3, 3), Cell::Occupied);
        Ok(DriveRecord {
            title: request.title(),
            summary: Summary {
                outcome,
                time_s: 2.0,
                path_m: 7.0,
                collisions: 0,
                unknown_entries: 0,
                min_clearance_m: 0.25,
                replans: 40,
                plans_rejected: 1,
                guard_stops: 0,
                candidates: 1.0,
                plan_ms: Spread { p50: 1.0, p99: 2.0, max: 3.0 },
                predict_ms: Spread::default(),
                predict_context: 0.0,
                predict_decoded: 0.0,
                prediction_faults: 0,
                age_ms: Spread::default(),
                realtime_factor: 10.0,
                digest: "00ff".into(),
            },
            trace: Trace::default(),
            grid,
            truth: Vec::new(),
            snapshot: None,
            start: Pose::new(0.0, 0.0, 0.0),
            goal: Point::new(1.0, 1.0),
            goal_radius_m: 0.5,
            speed_limit_mps: 4.0,
            force_limit_n: 22.0,
        })
    }

    fn write_maze(&self, _seed: u64, _family: Family, out: &Path) -> Result<(), RunError> {
        std::fs::write(out, "").map_err(|error| RunError::Input(error.into()))
    }
}

fn run(puppet: &Puppet, environment: &[(&str, &str)], arguments: &[&str]) -> (Exit, String) {
    let words = std::iter::once("apexd").chain(arguments.iter().copied());
    let cli = Cli::try_parse_from(words).unwrap();
    let environment: Vec<(OsString, OsString)> =
        environment.iter().map(|(name, value)| (name.into(), value.into())).collect();
    let mut out = Vec::new();
    let exit = execute(&cli, &environment, puppet, &Terminal::new(0), &mut out);
    (exit, String::from_utf8(out).unwrap())
}

fn sil(puppet: &Puppet, arguments: &[&str]) -> (Exit, String) {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let fixed = ["sil", "--out", out.to_str().unwrap()];
    let result = run(puppet, &[], &[&fixed, arguments].concat());
    let figures = std::fs::read_to_string(out.join("summary.json"));
    assert_eq!(figures.is_ok(), puppet.outcome.is_ok());
    result
}

#[test]
fn only_a_drive_that_reaches_its_goal_ends_well() {
    for (outcome, exit) in [
        (Outcome::Goal, Exit::Done),
        (Outcome::Stuck, Exit::Failed),
        (Outcome::Timeout, Exit::Failed),
        (Outcome::Collision, Exit::Failed),
        (Outcome::Unreachable, Exit::Failed),
        (Outcome::Interrupted, Exit::Failed),
    ] {
        assert_eq!(sil(&Puppet::that_ends(outcome), &[]).0, exit, "{outcome:?}");
    }
}

#[test]
fn the_last_line_with_json_is_the_summary() {
    let (_, out) = sil(&Puppet::that_ends(Outcome::Goal), &["--json"]);
    let json: serde_json::Value = serde_json::from_str(out.lines().last().unwrap()).unwrap();
    assert_eq!((&json["outcome"], &json["digest"]), (&"goal".into(), &"00ff".into()));
    assert_eq!((&json["plan_ms"]["p99"], &json["replans"]), (&2.0.into(), &40.into()));
}

#[test]
fn the_summary_for_a_person_names_outcome_figures_and_folder() {
    let (_, out) = sil(&Puppet::that_ends(Outcome::Stuck), &[]);
    for text in ["Stuck after 2.00 s", "7.0 m, mean 3.50 m/s", "0 collisions", "/out"] {
        assert!(out.contains(text), "{out}");
    }
}

#[test]
fn errors_of_the_simulator_become_exit_codes_and_leave_no_empty_folder() {
    let cases: [(fn() -> RunError, Exit); 2] = [
        (|| RunError::Input("the start lies inside a wall".into()), Exit::Usage),
        (|| RunError::Failed("the bus broke".into()), Exit::Failed),
    ];
    for (error, exit) in cases {
        let puppet = Puppet { outcome: Err(error), asked: RefCell::default() };
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        assert_eq!(run(&puppet, &[], &["sil", "--out", out.to_str().unwrap()]).0, exit);
        assert!(!out.exists());
    }
}

#[test]
fn file_environment_and_set_reach_the_drive_in_that_order() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("car.toml");
    std::fs::write(&file, "[vehicle]\nmass_kg = 3.0\nfriction = 0.8\nradius_m = 0.3\n").unwrap();
    let puppet = Puppet::that_ends(Outcome::Goal);
    let environment =
        [("APEXD__VEHICLE__FRICTION", "0.7"), ("APEXD__VEHICLE__RADIUS_M", "0.25"), ("HOME", "/")];
    let out = folder.path().join("out");
    let (out, file) = (out.to_str().unwrap(), file.to_str().unwrap());
    let arguments =
        ["sil", "--config", file, "--set", "vehicle.radius_m=0.1", "--out", out, "--maze", "5"];
    assert_eq!(run(&puppet, &environment, &arguments).0, Exit::Done);
    let asked = &puppet.asked.borrow()[0];
    let vehicle = &asked.params.vehicle;
    assert_eq!((vehicle.mass_kg, vehicle.friction, vehicle.radius_m), (3.0, 0.7, 0.1));
    assert_eq!(asked.title(), "maze 5 (thin) · map-predictive, cnp");
}

#[test]
fn a_bad_configuration_drives_nothing() {
    let puppet = Puppet::that_ends(Outcome::Goal);
    let much = [("APEXD__VEHICLE__FRICTION", "much")];
    assert_eq!(run(&puppet, &much, &["sil"]).0, Exit::Configuration);
    for [option, value] in [["--set", "vehicle.friction=9"], ["--config", "/nowhere/at/all.toml"]] {
        assert_eq!(run(&puppet, &[], &["sil", option, value]).0, Exit::Configuration);
    }
    assert!(puppet.asked.borrow().is_empty());
}

#[test]
fn an_option_out_of_range_is_bad_usage_unless_the_configuration_is_bad_too() {
    let puppet = Puppet::that_ends(Outcome::Goal);
    assert_eq!(run(&puppet, &[], &["sil", "--speed-max", "1000"]).0, Exit::Usage);
    let both = ["sil", "--speed-max", "1000", "--set", "vehicle.friction=9"];
    assert_eq!(run(&puppet, &[], &both).0, Exit::Configuration);
    assert!(puppet.asked.borrow().is_empty());
    let options = ["--speed-max", "2", "--policy", "frontier", "--set", "speed.speed_max_mps=3"];
    assert_eq!(sil(&puppet, &options).0, Exit::Done);
    let asked = &puppet.asked.borrow()[0];
    assert_eq!(asked.params.speed.speed_max_mps, 2.0);
    assert_eq!(asked.title(), "maze 1 (thin) · frontier");
}

#[test]
fn a_folder_that_cannot_be_made_is_bad_input() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let below = file.path().join("x");
    let puppet = Puppet::that_ends(Outcome::Goal);
    assert_eq!(run(&puppet, &[], &["sil", "--out", below.to_str().unwrap()]).0, Exit::Usage);
    assert!(puppet.asked.borrow().is_empty());
}

#[test]
fn a_maze_is_written_where_it_is_wanted() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("m.yaml");
    let puppet = Puppet::that_ends(Outcome::Goal);
    let (exit, said) = run(&puppet, &[], &["maze", "--seed", "3", "--out", out.to_str().unwrap()]);
    assert_eq!((exit, out.exists()), (Exit::Done, true));
    assert!(said.contains("m.yaml"));
    let nowhere = run(&puppet, &[], &["maze", "--seed", "3", "--out", "/nowhere/at/all.yaml"]);
    assert_eq!(nowhere.0, Exit::Usage);
}

#[test]
fn a_file_is_checked_by_itself() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("car.toml");
    let path = file.to_str().unwrap().to_owned();
    let puppet = Puppet::that_ends(Outcome::Goal);
    let environment = [("APEXD__VEHICLE__FRICTION", "much")];
    let check = |text: &str, more: &[&str]| {
        std::fs::write(&file, text).unwrap();
        run(&puppet, &environment, &[&["check", path.as_str()], more].concat())
    };
    assert_eq!(check("[vehicle]\nmass_kg = 3\n", &[]), (Exit::Done, format!("{path}: ok\n")));
    let (exit, said) = check("[vehicle]\nmass_kg = -3\nfrition = 1\n", &[]);
    assert_eq!(exit, Exit::Configuration);
    assert_eq!(
        said,
        format!(
            "{path}:2: vehicle.mass_kg is -3, allowed is 0.1 to 50 kg\n\
             {path}:3: vehicle.frition: no such parameter; did you mean vehicle.friction?\n"
        )
    );
    let (exit, said) = check("mass_kg = 3\n", &["--json"]);
    let json: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!((exit, &json["ok"]), (Exit::Configuration, &false.into()));
    assert_eq!(json["faults"].as_array().unwrap().len(), 1);
}
