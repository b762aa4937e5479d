//! The car as a process of its own, driven over a real CAN interface by a core in this one. As with
//! the tests of the link, an interface is needed and they are run by name:
//!
//! ```text
//! cargo test --release --test can_drive -- --ignored --test-threads 1
//! ```

#![allow(
    clippy::disallowed_methods,
    clippy::unwrap_used,
    reason = "tests of what depends on the clock"
)]

use std::path::Path;
use std::process::{Child, Command};
use std::sync::mpsc;

use apexd::autopilot::{self, Autopilot, CoreParams, Mode};
use apexd::frames::{Point, Pose};
use apexd::plan::{PlanRequest, Planner, PlannerParams, Planning, StepReport};
use apexd::predict::{self, PredictParams, PredictorKind};
use apexd::shell::can::{CanLink, Received};
use apexd::shell::clock::{Alarm, Clock};
use apexd::time::Duration;
use apexd::wire::can::{Layout, Sender};
use serde_json::Value;

const INTERFACE: &str = "vcan0";

/// The whole lines of the truth so far.
fn truth(path: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(path).unwrap_or_default();
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

fn car(truth: &Path, more: &[&str]) -> Child {
    Command::new(env!("CARGO_BIN_EXE_apexd"))
        .args(["car", "--can", INTERFACE, "--truth", truth.to_str().unwrap()])
        .args(more)
        .spawn()
        .unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// A planner in a thread of its own: the first step in a cold process takes its time.
fn planner(speed_mps: f64) -> (mpsc::Sender<PlanRequest>, mpsc::Receiver<StepReport>) {
    let (requests, asked) = mpsc::channel::<PlanRequest>();
    let (answer, results) = mpsc::channel();
    std::thread::spawn(move || {
        let mut params = PlannerParams::default();
        params.speed.speed_max_mps = speed_mps;
        let none = PredictParams { kind: PredictorKind::None, ..PredictParams::default() };
        let predictor = predict::build(&none, None, 1).unwrap();
        let mut planner = Planner::new(params, predictor, Box::new(|| Duration::ZERO));
        for request in asked {
            if answer.send(planner.step(&request)).is_err() {
                break;
            }
        }
    });
    (requests, results)
}

/// Waits for the car's first line and drives it until it ends or `go_on` says no.
fn drive(path: &Path, layout: Layout, speed_mps: f64, mut go_on: impl FnMut(&Autopilot) -> bool) {
    let world = loop {
        if let Some(world) = truth(path).into_iter().next() {
            break world;
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    let start: Vec<f64> = world["start"].as_array().unwrap().iter().map(number).collect();
    let goal: Vec<f64> = world["goal"].as_array().unwrap().iter().map(number).collect();
    let start = Pose::new(start[0], start[1], start[2]);
    let goal = Point::new(goal[0], goal[1]);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let clock = Clock::start();
        let link = CanLink::open(INTERFACE, layout, Sender::Daemon, &clock).unwrap();
        let alarm = Alarm::new(&clock).unwrap();
        let mut params = CoreParams::default();
        params.speed.speed_max_mps = speed_mps;
        let (requests, results) = planner(speed_mps);
        let mut core = Autopilot::new(params, layout, start, clock.now());
        while go_on(&core) {
            alarm.set(core.poll_at()).unwrap();
            tokio::select! {
                received = link.receive() => {
                    if let Received::Frame { at, frame } = received.unwrap() {
                        core.handle_frame(at, &frame);
                    }
                }
                rung = alarm.rings() => rung.unwrap(),
            }
            while let Some(received) = link.try_receive().unwrap() {
                if let Received::Frame { at, frame } = received {
                    core.handle_frame(at, &frame);
                }
            }
            let now = clock.now();
            if let Ok(report) = results.try_recv() {
                core.handle_job_done(now, report);
            }
            core.handle_time(now);
            if core.mode() == Mode::Disarmed
                && core.handle_command(now, autopilot::Command::Arm).is_ok()
            {
                core.handle_command(now, autopilot::Command::Goto(goal)).unwrap();
            }
            if let Some(request) = core.poll_job() {
                requests.send(request).unwrap();
            }
            while let Some(event) = core.poll_event() {
                if !matches!(event, autopilot::Event::PlanAdopted { .. }) {
                    println!("{now} {event:?}");
                }
            }
            while let Some(frame) = core.poll_frame() {
                link.try_send(&frame).unwrap();
            }
        }
    });
}

fn ended(path: &Path) -> Value {
    let end = truth(path).pop().unwrap();
    assert_eq!(end["kind"], "end", "{end}");
    println!("{end}");
    assert_eq!((&end["collisions"], &end["unknown_entries"]), (&0.into(), &0.into()), "{end}");
    end
}

#[test]
#[ignore = "needs vcan0 and takes some 20 s"]
fn a_core_drives_the_car_process_through_a_maze() {
    for (layout, more) in [
        (Layout::Fd, &["--time-limit", "120"][..]),
        (
            Layout::Classic,
            &["--layout", "classic", "--set", "lidar.beams=360", "--set", "lidar.rate_hz=10"],
        ),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.jsonl");
        let near = ["--maze", "3", "--goal", "6.25,1.25"];
        let mut child = car(&path, &[&near, more].concat());
        drive(&path, layout, 3.0, |_| child.try_wait().unwrap().is_none());
        let status = child.wait().unwrap();
        let end = ended(&path);
        assert_eq!((status.code(), &end["outcome"]), (Some(0), &"goal".into()), "{end}");
    }
}

#[test]
#[ignore = "needs vcan0 and takes some 10 s"]
fn the_car_stops_in_space_it_was_shown_when_the_core_falls_silent_at_speed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("truth.jsonl");
    let mut child = car(&path, &["--maze", "3", "--stay"]);
    let fast = || {
        let newest = truth(&path).pop();
        newest.is_some_and(|line| line["kind"] == "state" && number(&line["speed_mps"]) > 2.0)
    };
    let mut turns = 0u32;
    drive(&path, Layout::Fd, 3.0, |_| {
        turns += 1;
        assert!(child.try_wait().unwrap().is_none(), "the car has ended");
        !(turns.is_multiple_of(50) && fast())
    });
    std::thread::sleep(Duration::from_secs(2));
    let pid = child.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
    let status = child.wait().unwrap();
    let end = ended(&path);
    assert_eq!((status.code(), &end["outcome"]), (Some(1), &"interrupted".into()));
    assert_eq!(end["at_rest"], true);
    assert!(truth(&path).iter().any(|line| line["setpoint_lost"] == true));
}
