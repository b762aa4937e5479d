//! The frames as another implementation sees them: the Python package cantools reads
//! `params/car.dbc`, decodes what this crate sends and encodes what this crate receives.
//!
//! Needs a Python with cantools: the one that `APEXD_PYTHON` names, else `python3`. Without
//! `APEXD_PYTHON` and without cantools the test says that it was skipped.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::io::Write;
use std::process::{Command, Stdio};

use apexd::command::{BrakingTail, CarStatus, ForceSetpoint, TailSample};
use apexd::scan::Scan;
use apexd::time::Instant;
use apexd::wire::can::{
    CanFrame, CanId, CarDecoder, CarEncoder, CarMessage, CarOdometry, CarTime, DaemonMessage,
    DaemonMode, Decoder, Encoder, INTERFACE_VERSION, Layout,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Map, Value, json};

/// The Python to use, or `None` if cantools may be missing and is.
fn python() -> Option<String> {
    let named = std::env::var("APEXD_PYTHON").ok();
    let python = named.clone().unwrap_or_else(|| "python3".to_owned());
    let found = Command::new(&python)
        .args(["-c", "import cantools"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    assert!(found || named.is_none(), "APEXD_PYTHON={python} cannot import cantools");
    found.then_some(python)
}

/// Sends the requests to the script, one a line, and returns its answers.
fn ask(python: &str, requests: &[Value]) -> Vec<Value> {
    let root = env!("CARGO_MANIFEST_DIR");
    let mut child = Command::new(python)
        .arg(format!("{root}/tests/interop/can_dbc.py"))
        .arg(format!("{root}/params/car.dbc"))
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut input = child.stdin.take().unwrap();
    let text: String = requests.iter().map(|request| format!("{request}\n")).collect();
    let writer = std::thread::spawn(move || input.write_all(text.as_bytes()));
    let output = child.wait_with_output().unwrap();
    let _ = writer.join().unwrap();
    assert!(output.status.success(), "can_dbc.py found a disagreement, see above");
    let text = String::from_utf8(output.stdout).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// "This frame must decode to that": numbers as lowest and highest accepted, choices by name.
fn check(frame: &CanFrame, signals: Map<String, Value>) -> Value {
    json!({"check": {
        "id": frame.id.raw(), "fd": frame.fd, "data": hex(frame.data()), "signals": signals,
    }})
}

fn near(value: f64, tolerance: f64) -> Value {
    json!([value - tolerance - 1e-9, value + tolerance + 1e-9])
}

macro_rules! signals {
    ($($name:expr => $value:expr),* $(,)?) => {{
        let mut map = Map::new();
        $(map.insert($name.to_string(), $value);)*
        map
    }};
}

fn frame_of(answer: &Value) -> CanFrame {
    let text = answer["data"].as_str().unwrap();
    let bytes: Vec<u8> = (0..text.len() / 2)
        .map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).unwrap())
        .collect();
    let id = CanId::standard(answer["id"].as_u64().unwrap() as u16);
    CanFrame::new(id, answer["fd"].as_bool().unwrap(), &bytes).unwrap()
}

fn suffix(layout: Layout) -> &'static str {
    if layout == Layout::Fd { "" } else { "Classic" }
}

struct Chance(ChaCha8Rng);

impl Chance {
    fn between(&mut self, lowest: f64, highest: f64) -> f64 {
        lowest + (highest - lowest) * self.0.random::<f64>()
    }

    fn scan(&mut self, beams: usize) -> Scan {
        let range_max_m = 0.5 * self.between(4.0, 60.0).round();
        Scan {
            stamp: Instant::ZERO,
            sequence: self.0.random(),
            angle_first_rad: self.between(-3.2, 3.2),
            angle_step_rad: self.between(-0.1, 0.1),
            range_max_m,
            ranges_m: (0..beams)
                .map(|_| match self.0.random_range(0..10) {
                    0 => f32::NAN,
                    1 => f32::INFINITY,
                    _ => self.between(0.0, range_max_m - 1e-3) as f32,
                })
                .collect(),
        }
    }

    fn odometry(&mut self) -> CarOdometry {
        CarOdometry {
            time: CarTime::from_micros(u64::from(self.0.random::<u32>())),
            epoch: 0,
            travelled_m: self.between(0.0, 42_949.0),
            turned_rad: self.between(-2147.0, 2147.0),
            wheel_left_mps: self.between(-10.0, 10.0),
            wheel_right_mps: self.between(-10.0, 10.0),
            steering_rad: self.between(-0.6, 0.6),
            yaw_rate_rps: self.between(-9.0, 9.0),
        }
    }

    fn status(&mut self) -> CarStatus {
        CarStatus {
            emergency_stop: self.0.random(),
            setpoint_lost: self.0.random(),
            loss_toggle: self.0.random(),
            tail_plan: self.0.random::<bool>().then(|| self.0.random()),
            battery_v: self.between(0.0, 60.0),
            setpoint_age_s: self.between(0.0, 60.0),
        }
    }

    fn setpoint(&mut self) -> ForceSetpoint {
        ForceSetpoint {
            longitudinal_n: self.between(-600.0, 600.0),
            lateral_n: self.between(-600.0, 600.0),
            curvature_pm: self.between(-16.0, 16.0),
            drive: self.0.random(),
        }
    }

    fn tail(&mut self, samples: usize) -> BrakingTail {
        BrakingTail {
            plan: self.0.random(),
            anchor_travelled_m: self.between(0.0, 42_949.0),
            anchor_turned_rad: self.between(-2147.0, 2147.0),
            anchor_offset_m: self.between(-0.25, 0.25),
            spacing_m: self.between(0.01, 0.6),
            samples: (0..samples)
                .map(|i| TailSample {
                    curvature_pm: self.between(-10.0, 10.0),
                    speed_mps: if i + 1 == samples { 0.0 } else { self.between(0.0, 20.0) },
                })
                .collect(),
        }
    }
}

fn range_signal(range_m: Option<&f32>, range_max_m: f64) -> Value {
    match range_m {
        Some(range_m) if f64::from(*range_m) >= range_max_m => json!("NoReturn"),
        Some(range_m) if !range_m.is_nan() => near(f64::from(*range_m), 2.5e-4),
        _ => json!("Invalid"),
    }
}

fn flag(value: bool) -> Value {
    near(f64::from(u8::from(value)), 0.0)
}

fn number(value: impl Into<f64>) -> Value {
    near(value.into(), 0.0)
}

fn checks_of_scan(layout: Layout, time: CarTime, scan: &Scan, frames: &[CanFrame]) -> Vec<Value> {
    let beams = &scan.ranges_m;
    let stamp = near(time.as_micros() as f64 * 1e-6, 0.0);
    let count = number(beams.len() as f64);
    let first = near(scan.angle_first_rad, 5e-9);
    let step = near(scan.angle_step_rad, 5e-10);
    let range_max = near(scan.range_max_m, 0.0);
    let block = |per_block: usize, i: usize, map: &mut Map<String, Value>| {
        for j in 0..per_block {
            let range = beams.get(i * per_block + j);
            map.insert(format!("Range{j:02}"), range_signal(range, scan.range_max_m));
        }
    };
    match layout {
        Layout::Fd => {
            let mut checks = vec![check(
                &frames[0],
                signals! {
                    "Part" => json!("Head"), "Scan" => number(scan.sequence), "Stamp" => stamp,
                    "BeamCount" => count, "AngleFirst" => first, "AngleStep" => step,
                    "RangeMax" => range_max, "Boot" => number(2),
                },
            )];
            for (i, frame) in frames[1..].iter().enumerate() {
                let mut map = signals! {
                    "Part" => json!("Block"), "Scan" => number(scan.sequence),
                    "FirstBeam" => number(i as f64 * 28.0), "Last" => flag(i + 2 == frames.len()),
                };
                block(28, i, &mut map);
                checks.push(check(frame, map));
            }
            checks
        }
        Layout::Classic => {
            let (end, blocks) = frames[3..].split_last().unwrap();
            let mut checks = vec![
                check(
                    &frames[0],
                    signals! {
                        "Part" => number(12), "Stamp" => stamp, "Scan" => number(scan.sequence),
                    },
                ),
                check(
                    &frames[1],
                    signals! { "AngleFirst" => first, "BeamCount" => count, "Boot" => number(2) },
                ),
                check(&frames[2], signals! { "AngleStep" => step, "RangeMax" => range_max }),
                check(
                    end,
                    signals! {
                        "EndScan" => number(scan.sequence),
                        "EndBeamCount" => number(beams.len() as f64),
                    },
                ),
            ];
            for (i, frame) in blocks.iter().enumerate() {
                let mut map = signals! { "Part" => number((i % 11) as f64) };
                block(3, i, &mut map);
                checks.push(check(frame, map));
            }
            checks
        }
    }
}

fn checks_of_tail(layout: Layout, tail: &BrakingTail, frames: &[CanFrame]) -> Vec<Value> {
    let travelled = near(tail.anchor_travelled_m, 5e-6);
    let turned = near(tail.anchor_turned_rad, 5e-7);
    let spacing = near(tail.spacing_m, 5e-6);
    let sample = |map: &mut Map<String, Value>, j: usize, i: usize, curvature: f64, speed: f64| {
        if let Some(sample) = tail.samples.get(i) {
            map.insert(format!("Curvature{j:02}"), near(sample.curvature_pm, curvature));
            // Never above what was asked for.
            let highest = sample.speed_mps + 1e-6 * speed;
            map.insert(format!("Speed{j:02}"), json!([highest - 1.01 * speed, highest + 1e-9]));
        }
    };
    match layout {
        Layout::Fd => {
            let mut checks = vec![check(
                &frames[0],
                signals! {
                    "Part" => json!("Head"), "Plan" => number(tail.plan),
                    "SampleCount" => number(tail.samples.len() as f64),
                    "AnchorTravelled" => travelled, "AnchorTurned" => turned,
                    "Spacing" => spacing, "AnchorOffset" => near(tail.anchor_offset_m, 5e-6),
                },
            )];
            for (i, frame) in frames[1..].iter().enumerate() {
                let mut map = signals! {
                    "Plan" => number(tail.plan), "FirstSample" => number(i as f64 * 14.0),
                    "Last" => flag(i + 2 == frames.len()),
                };
                (0..14).for_each(|j| sample(&mut map, j, i * 14 + j, 2.5e-4, 1e-3));
                checks.push(check(frame, map));
            }
            checks
        }
        Layout::Classic => {
            let (end, blocks) = frames[2..].split_last().unwrap();
            let mut checks = vec![
                check(
                    &frames[0],
                    signals! { "AnchorTravelled" => travelled, "Plan" => number(tail.plan) },
                ),
                check(&frames[1], signals! { "AnchorTurned" => turned, "Spacing" => spacing }),
                check(
                    end,
                    signals! {
                        "EndPlan" => number(tail.plan),
                        "EndSampleCount" => number(tail.samples.len() as f64),
                        "AnchorOffset" => near(tail.anchor_offset_m, 5e-4),
                    },
                ),
            ];
            for (i, frame) in blocks.iter().enumerate() {
                let mut map = signals! { "Part" => number((i % 11) as f64) };
                (0..2).for_each(|j| sample(&mut map, j, i * 2 + j, 6.25e-4, 0.02));
                checks.push(check(frame, map));
            }
            checks
        }
    }
}

fn odometry_signals(value: &CarOdometry) -> Map<String, Value> {
    signals! {
        "Boot" => number(2),
        "Stamp" => near(value.time.as_micros() as f64 * 1e-6, 0.0),
        "Travelled" => near(value.travelled_m, 5e-6),
        "Turned" => near(value.turned_rad, 5e-7),
        "WheelSpeedLeft" => near(value.wheel_left_mps, 5e-4),
        "WheelSpeedRight" => near(value.wheel_right_mps, 5e-4),
        "SteeringAngle" => near(value.steering_rad, 2.5e-5),
        "YawRate" => near(value.yaw_rate_rps, 5e-4),
    }
}

#[test]
fn cantools_decodes_what_we_send() {
    let Some(python) = python() else {
        eprintln!("skipped: no Python with cantools (pip install cantools, or set APEXD_PYTHON)");
        return;
    };
    let mut chance = Chance(ChaCha8Rng::seed_from_u64(1));
    let mut requests = Vec::new();
    for &layout in Layout::ALL {
        let mut car = CarEncoder::new(layout, 6);
        let mut daemon = Encoder::new(layout);
        for round in 0..60u32 {
            let status = chance.status();
            requests.push(check(
                &car.encode_status(&status),
                signals! {
                    "EmergencyStop" => flag(status.emergency_stop),
                    "SetpointLost" => flag(status.setpoint_lost),
                    "LossToggle" => flag(status.loss_toggle),
                    "TailHeld" => flag(status.tail_plan.is_some()),
                    "TailPlan" => number(status.tail_plan.unwrap_or(0)),
                    "BatteryVoltage" => near(status.battery_v, 5e-4),
                    "SetpointAge" => near(status.setpoint_age_s, 5e-4),
                },
            ));
            let setpoint = chance.setpoint();
            requests.push(check(
                &daemon.encode_setpoint(&setpoint).unwrap(),
                signals! {
                    "Drive" => flag(setpoint.drive),
                    "LongitudinalForce" => near(setpoint.longitudinal_n, 0.01),
                    "LateralForce" => near(setpoint.lateral_n, 0.01),
                    "PathCurvature" => near(setpoint.curvature_pm, 2.5e-4),
                },
            ));
            let time = CarTime::from_micros(u64::from(round) * 71_000_003);
            requests.push(check(
                &car.encode_heartbeat(time),
                signals! {
                    "Stamp" => near((time.as_micros() as u32) as f64 * 1e-6, 0.0),
                    "Boot" => number(6), "InterfaceVersion" => number(INTERFACE_VERSION),
                },
            ));
            requests.push(check(
                &daemon.encode_heartbeat(round * 1001, DaemonMode::Return),
                signals! {
                    "Uptime" => near(f64::from(round) * 1.001, 0.0), "Mode" => json!("Return"),
                    "InterfaceVersion" => number(INTERFACE_VERSION),
                },
            ));
            let odometry = chance.odometry();
            let mut frames = Vec::new();
            car.encode_odometry(&odometry, &mut frames).unwrap();
            let mut map = odometry_signals(&odometry);
            if layout == Layout::Fd {
                requests.push(check(&frames[0], map));
            } else {
                let stamp = map["Stamp"].clone();
                let mut of = |names: &[&str]| -> Map<String, Value> {
                    names.iter().map(|n| ((*n).to_owned(), map.remove(*n).unwrap())).collect()
                };
                let parts = [
                    of(&["Stamp", "WheelSpeedLeft", "Boot"]),
                    of(&["Travelled", "WheelSpeedRight"]),
                    of(&["Turned", "SteeringAngle"]),
                    of(&["YawRate"]),
                ];
                for (i, (frame, mut part)) in frames.iter().zip(parts).enumerate() {
                    part.insert("Part".to_owned(), number(i as f64));
                    if i == 3 {
                        part.insert("StampAgain".to_owned(), stamp.clone());
                    }
                    requests.push(check(frame, part));
                }
            }
        }
        for beams in [1, 30, 100, 360] {
            let scan = chance.scan(beams);
            let time = CarTime::from_micros(u64::from(chance.0.random::<u32>()));
            let mut frames = Vec::new();
            car.encode_scan(time, &scan, &mut frames).unwrap();
            requests.extend(checks_of_scan(layout, time, &scan, &frames));
        }
        for samples in [1, 15, 50, 128] {
            let tail = chance.tail(samples);
            let mut frames = Vec::new();
            daemon.encode_tail(&tail, &mut frames).unwrap();
            requests.extend(checks_of_tail(layout, &tail, &frames));
        }
    }
    let answers = ask(&python, &requests);
    assert_eq!(answers.len(), requests.len());
    println!("cantools agrees on {} frames", answers.len());
}

fn make(name: &str, layout: Layout, counter: usize, signals: Map<String, Value>) -> Value {
    let counter = counter % if layout == Layout::Fd { 256 } else { 15 };
    json!({"make": {
        "message": format!("{name}{}", suffix(layout)), "counter": counter, "signals": signals,
    }})
}

#[test]
fn we_decode_what_cantools_encodes() {
    let Some(python) = python() else {
        eprintln!("skipped: no Python with cantools (pip install cantools, or set APEXD_PYTHON)");
        return;
    };
    let now = Instant::from_nanos(1);
    let mut chance = Chance(ChaCha8Rng::seed_from_u64(2));
    for &layout in Layout::ALL {
        let rounds = 40;
        let setpoints: Vec<ForceSetpoint> = (0..rounds).map(|_| chance.setpoint()).collect();
        let statuses: Vec<CarStatus> = (0..rounds).map(|_| chance.status()).collect();
        let mut requests = Vec::new();
        for (i, (setpoint, status)) in setpoints.iter().zip(&statuses).enumerate() {
            requests.push(make(
                "DriveSetpoint",
                layout,
                i,
                signals! {
                    "Drive" => json!(u8::from(setpoint.drive)),
                    "LongitudinalForce" => json!(setpoint.longitudinal_n),
                    "LateralForce" => json!(setpoint.lateral_n),
                    "PathCurvature" => json!(setpoint.curvature_pm),
                },
            ));
            requests.push(make(
                "CarStatus",
                layout,
                i,
                signals! {
                    "EmergencyStop" => json!(u8::from(status.emergency_stop)),
                    "SetpointLost" => json!(u8::from(status.setpoint_lost)),
                    "LossToggle" => json!(u8::from(status.loss_toggle)),
                    "TailHeld" => json!(u8::from(status.tail_plan.is_some())),
                    "TailPlan" => json!(status.tail_plan.unwrap_or(0)),
                    "BatteryVoltage" => json!(status.battery_v),
                    "SetpointAge" => json!(status.setpoint_age_s),
                },
            ));
        }
        let scans: Vec<(CarTime, Scan)> = [1, 28, 29, 100]
            .map(|beams| {
                (CarTime::from_micros(chance.0.random::<u32>().into()), chance.scan(beams))
            })
            .into();
        let odometry = chance.odometry();
        for (time, scan) in &scans {
            let ranges: Vec<Value> = scan
                .ranges_m
                .iter()
                .map(|range| match range_signal(Some(range), scan.range_max_m) {
                    Value::String(name) => Value::String(name),
                    _ => json!(range),
                })
                .collect();
            requests.push(json!({"scan": {
                "layout": suffix(layout), "stamp": time.as_micros() as f64 * 1e-6,
                "scan": scan.sequence, "angle_first": scan.angle_first_rad,
                "angle_step": scan.angle_step_rad, "range_max": scan.range_max_m,
                "boot": 1, "ranges": ranges,
            }}));
        }
        requests.push(json!({"odometry": {
            "layout": suffix(layout), "Boot": 1,
            "Stamp": odometry.time.as_micros() as f64 * 1e-6, "Travelled": odometry.travelled_m,
            "Turned": odometry.turned_rad, "WheelSpeedLeft": odometry.wheel_left_mps,
            "WheelSpeedRight": odometry.wheel_right_mps, "SteeringAngle": odometry.steering_rad,
            "YawRate": odometry.yaw_rate_rps,
        }}));
        let mut daemon = Decoder::new(layout);
        let mut car = CarDecoder::new(layout);
        let (mut to_car, mut to_daemon) = (Vec::new(), Vec::new());
        for answer in ask(&python, &requests) {
            let frame = frame_of(&answer);
            to_car.extend(car.decode(now, &frame).unwrap());
            to_daemon.extend(daemon.decode(now, &frame).unwrap());
        }
        assert_eq!(to_car.len(), rounds);
        for (got, sent) in to_car.iter().zip(&setpoints) {
            let DaemonMessage::Setpoint(got) = got else { panic!("{got:?}") };
            assert_eq!(got.drive, sent.drive);
            assert!((got.longitudinal_n - sent.longitudinal_n).abs() < 0.0201);
            assert!((got.lateral_n - sent.lateral_n).abs() < 0.0201);
            assert!((got.curvature_pm - sent.curvature_pm).abs() < 5.1e-4);
        }
        let mut statuses = statuses.iter();
        let mut scans = scans.iter();
        let mut odometries = 0;
        for message in &to_daemon {
            match message {
                CarMessage::Status(got) => {
                    let sent = statuses.next().unwrap();
                    assert_eq!(
                        (got.emergency_stop, got.setpoint_lost, got.tail_plan),
                        (sent.emergency_stop, sent.setpoint_lost, sent.tail_plan)
                    );
                    assert!((got.battery_v - sent.battery_v).abs() < 1.1e-3);
                    assert!((got.setpoint_age_s - sent.setpoint_age_s).abs() < 1.1e-3);
                }
                CarMessage::Scan(got) => {
                    let (_, sent) = scans.next().unwrap();
                    assert_eq!(got.sequence, sent.sequence);
                    assert_eq!(got.range_max_m, sent.range_max_m);
                    assert!((got.angle_first_rad - sent.angle_first_rad).abs() < 1.1e-8);
                    assert!((got.angle_step_rad - sent.angle_step_rad).abs() < 1.1e-9);
                    assert_eq!(got.ranges_m.len(), sent.ranges_m.len());
                    for (got_m, sent_m) in got.ranges_m.iter().zip(&sent.ranges_m) {
                        let same = got_m.is_nan() && sent_m.is_nan()
                            || f64::from(*got_m) >= got.range_max_m
                                && f64::from(*sent_m) >= got.range_max_m
                            || (got_m - sent_m).abs() < 5.1e-4;
                        assert!(same, "{got_m} {sent_m}");
                    }
                }
                CarMessage::Odometry(got) => {
                    odometries += 1;
                    assert!((got.travelled_m - odometry.travelled_m).abs() < 1.1e-5);
                    assert!((got.turned_rad - odometry.turned_rad).abs() < 1.1e-6);
                    assert!((got.wheel_left_mps - odometry.wheel_left_mps).abs() < 1.1e-3);
                    assert!((got.wheel_right_mps - odometry.wheel_right_mps).abs() < 1.1e-3);
                    assert!((got.steering_rad - odometry.steering_rad).abs() < 5.1e-5);
                    assert!((got.yaw_rate_rps - odometry.yaw_rate_rps).abs() < 1.1e-3);
                }
                CarMessage::Heartbeat(_) => panic!("{message:?}"),
            }
        }
        assert_eq!((statuses.count(), scans.count(), odometries), (0, 0, 1));
    }
}
