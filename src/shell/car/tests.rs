use super::*;
use crate::shell::place::WorldSource;
use crate::sim::drive::Outcome;
use crate::sim::faults::FaultCounts;
use crate::sim::maze::Family;
use crate::sim::solo::{Record, StateRecord};

fn request() -> CarRequest {
    let world = WorldSource::Maze { seed: 3, family: Family::Thin };
    CarRequest {
        place: PlaceRequest { world, start: None, goal: None },
        script: None,
        seed: 1,
        time_limit_s: None,
        stay: false,
        truth: None,
        params: Params::default(),
    }
}

fn ending() -> CarEnding {
    CarEnding {
        summary: SoloSummary {
            outcome: Outcome::Goal,
            collisions: 0,
            unknown_entries: 2,
            min_clearance_m: f64::INFINITY,
            path_m: 12.5,
            time_s: 6.0,
            at_rest: true,
            goal_distance_m: 0.1,
            scans: 120,
            scans_delivered: 119,
            frames_unsent: 0,
            faults: FaultCounts::default(),
        },
        frames: FrameCounts { sent: 4000, ..FrameCounts::default() },
        punctuality: Punctuality::default(),
    }
}

fn state(t_s: f64) -> Record {
    Record::State(StateRecord {
        t_s,
        x_m: 1.0,
        y_m: -2.0,
        heading_rad: 0.5,
        speed_mps: 3.0,
        curvature_pm: 0.25,
        contact: false,
        unknown_entry: true,
        setpoint_lost: false,
        emergency_stop: false,
    })
}

fn lines(path: &std::path::Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(path).unwrap();
    assert!(text.ends_with('\n'), "a torn line: {text:?}");
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn the_truth_has_a_line_for_the_world_for_each_state_and_for_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.jsonl");
    let mut truth = Truth::create(Some(&path)).unwrap();
    let request = request();
    let setup = setup(&request).unwrap();
    truth.world(&World::of(&request.params, (setup.start, setup.goal))).unwrap();
    assert_eq!(lines(&path).len(), 1, "the first line is there at once");
    truth.record(&state(0.01)).unwrap();
    let event = Record::Event { t_s: 0.02, event: 1, what: "a box".into(), over: false };
    truth.record(&event).unwrap();
    truth.flush().unwrap();
    assert_eq!(lines(&path).len(), 3);
    truth.end(&ending()).unwrap();
    let lines = lines(&path);
    let kinds: Vec<&str> = lines.iter().map(|line| line["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["world", "state", "event", "end"]);
    let [world, state, event, end] = &lines[..] else { panic!("four lines") };
    assert_eq!(world["start"].as_array().unwrap().len(), 3);
    assert_eq!((&world["can"], &world["layout"]), (&"can0".into(), &"fd".into()));
    assert_eq!(world["radius_m"], 0.2);
    assert_eq!((&state["t_s"], &state["speed_mps"]), (&0.01.into(), &3.0.into()));
    assert_eq!((&state["contact"], &state["unknown_entry"]), (&false.into(), &true.into()));
    assert_eq!((&event["event"], &event["what"]), (&1.into(), &"a box".into()));
    assert_eq!((&end["outcome"], &end["unknown_entries"]), (&"goal".into(), &2.into()));
    assert!(end["min_clearance_m"].is_null(), "nothing near is no number");
    assert_eq!(end["frames"]["sent"], 4000);
    assert!(end["punctuality"]["late_ms"]["p99"].is_number());
}

/// Whatever was written when the process is killed between two flushes is whole lines.
#[test]
fn no_line_is_ever_torn() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.jsonl");
    let mut truth = Truth::create(Some(&path)).unwrap();
    for i in 0..500 {
        truth.record(&state(f64::from(i) * 0.01)).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.is_empty() || text.ends_with('\n'), "after {i}");
    }
    truth.flush().unwrap();
    assert_eq!(lines(&path).len(), 500);
}

#[test]
fn without_a_file_nothing_is_written_and_a_bad_one_is_bad_input() {
    let mut truth = Truth::create(None).unwrap();
    truth.record(&state(0.0)).unwrap();
    truth.end(&ending()).unwrap();
    let error = Truth::create(Some("/nowhere/at/all".as_ref())).err().unwrap();
    assert!(matches!(&error, RunError::Input(_)), "{error}");
    assert!(error.to_string().contains("/nowhere/at/all"));
}

#[test]
fn a_bad_script_is_refused_with_its_name_and_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("script.toml");
    std::fs::write(&path, "[[event]]\nafter = 1.0\n").unwrap();
    let with = |path: &std::path::Path| CarRequest { script: Some(path.to_owned()), ..request() };
    let error = setup(&with(&path)).unwrap_err();
    let text = error.to_string();
    assert!(matches!(error, RunError::Input(_)));
    assert!(text.contains("script.toml") && text.contains("line 2"), "{text}");
    assert!(text.contains("after_s"), "{text}");
    let missing = setup(&with(&folder.path().join("none.toml"))).unwrap_err().to_string();
    assert!(missing.contains("none.toml") && missing.contains("No such file"), "{missing}");
    std::fs::write(&path, "[[event]]\nbattery_v = 9.0\n").unwrap();
    assert_eq!(setup(&with(&path)).unwrap().script.event.len(), 1);
}

#[test]
fn the_setup_takes_layout_and_goal_radius_from_the_parameters() {
    let mut request = request();
    request.params.can.layout = crate::wire::can::Layout::Classic;
    request.params.autopilot.goal_radius_m = 0.7;
    request.time_limit_s = Some(3.0);
    request.stay = true;
    let setup = setup(&request).unwrap();
    assert_eq!(setup.layout, crate::wire::can::Layout::Classic);
    assert_eq!((setup.goal_radius_m, setup.time_limit_s, setup.stay), (0.7, Some(3.0), true));
}

/// The machine that runs the tests may have CAN or not: an interface that no machine has is refused
/// in both cases, before anything is written.
#[test]
fn without_the_interface_nothing_is_driven_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.jsonl");
    let mut request = request();
    request.params.can.interface = "nocan0".into();
    request.truth = Some(path.clone());
    let error = drive(&request).unwrap_err();
    assert!(matches!(&error, RunError::Input(_)), "{error}");
    assert!(!path.exists());
}

#[test]
fn the_figures_for_a_person_name_what_matters() {
    let text = ending().text();
    for part in ["Goal", "12.5 m", "2 unknown entries", "119 of 120", "4000 sent", "no wall near"] {
        assert!(text.contains(part), "{part}: {text}");
    }
}
