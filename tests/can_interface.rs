//! `params/car.dbc` and the tables of `docs/can-interface.md` follow from the code.
//!
//! After a change of the frames, `APEXD_BLESS=1 cargo test --test can_interface` writes them anew.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use apexd::command::{BrakingTail, CarStatus, ForceSetpoint, TailSample};
use apexd::scan::Scan;
use apexd::sim::bus::{BusParams, FrameBits, VirtualBus};
use apexd::time::Instant;
use apexd::wire::can::{
    CanFrame, CarEncoder, CarOdometry, CarTime, DaemonMode, Encoder, Layout, database_text,
    frame_tables,
};

fn path(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// Compares a file with what it should hold, or writes it.
fn settle(name: &str, wanted: &str) {
    if std::env::var_os("APEXD_BLESS").is_some() {
        fs::write(path(name), wanted).unwrap();
    }
    let found = fs::read_to_string(path(name)).unwrap_or_default();
    assert!(found == wanted, "{name} is stale: APEXD_BLESS=1 cargo test --test can_interface");
}

/// Replaces what stands between two markers.
fn put_between(text: &str, section: &str, content: &str) -> String {
    let (begin, end) =
        (format!("<!-- {section}: generated -->"), format!("<!-- {section}: end -->"));
    let from = text.find(&begin).unwrap_or_else(|| panic!("no {begin}")) + begin.len();
    let to = text.find(&end).unwrap_or_else(|| panic!("no {end}"));
    format!("{}\n\n{}\n\n{}", &text[..from], content.trim(), &text[to..])
}

#[test]
fn the_database_follows_from_the_codec() {
    settle("params/car.dbc", &database_text());
}

#[test]
fn the_document_follows_from_the_codec() {
    let name = "docs/can-interface.md";
    let text = fs::read_to_string(path(name)).unwrap();
    let text = put_between(&text, "frames", &frame_tables());
    let text = put_between(&text, "load", &load_tables());
    settle(name, &text);
}

/// What one sending of each message puts on the bus, and how often a second.
struct Traffic {
    name: &'static str,
    from_car: bool,
    frames: Vec<CanFrame>,
    rate_hz: f64,
}

fn traffic(
    layout: Layout,
    beams: usize,
    scan_hz: f64,
    samples: usize,
    tail_hz: f64,
) -> Vec<Traffic> {
    let mut car = CarEncoder::new(layout, 0);
    let mut daemon = Encoder::new(layout);
    let status = CarStatus {
        emergency_stop: false,
        setpoint_lost: false,
        loss_toggle: false,
        tail_plan: None,
        battery_v: 7.4,
        setpoint_age_s: 0.0,
    };
    let odometry = CarOdometry {
        time: CarTime::default(),
        epoch: 0,
        travelled_m: 0.0,
        turned_rad: 0.0,
        wheel_left_mps: 0.0,
        wheel_right_mps: 0.0,
        steering_rad: 0.0,
        yaw_rate_rps: 0.0,
    };
    let scan = Scan {
        stamp: Instant::ZERO,
        sequence: 0,
        angle_first_rad: 0.0,
        angle_step_rad: std::f64::consts::TAU / beams as f64,
        range_max_m: 20.0,
        ranges_m: vec![1.0; beams],
    };
    let tail = BrakingTail {
        spacing_m: 0.05,
        samples: vec![TailSample::default(); samples],
        ..BrakingTail::default()
    };
    let (mut odometry_frames, mut scan_frames, mut tail_frames) = (vec![], vec![], vec![]);
    car.encode_odometry(&odometry, &mut odometry_frames).unwrap();
    car.encode_scan(CarTime::default(), &scan, &mut scan_frames).unwrap();
    daemon.encode_tail(&tail, &mut tail_frames).unwrap();
    let one =
        |name, from_car, frame, rate_hz| Traffic { name, from_car, frames: vec![frame], rate_hz };
    vec![
        one("status", true, car.encode_status(&status), 50.0),
        one("setpoint", false, daemon.encode_setpoint(&ForceSetpoint::default()).unwrap(), 100.0),
        Traffic { name: "odometry", from_car: true, frames: odometry_frames, rate_hz: 100.0 },
        Traffic { name: "tail", from_car: false, frames: tail_frames, rate_hz: tail_hz },
        one("car heartbeat", true, car.encode_heartbeat(CarTime::default()), 10.0),
        one("daemon heartbeat", false, daemon.encode_heartbeat(0, DaemonMode::Hold), 10.0),
        Traffic { name: "scan", from_car: true, frames: scan_frames, rate_hz: scan_hz },
    ]
}

/// Two seconds of all that traffic on the virtual bus, each message beginning at its own moment;
/// the longest time from queueing to the last frame's end, by message, in milliseconds.
fn latencies(params: &BusParams, traffic: &[Traffic]) -> Vec<f64> {
    let mut bus = VirtualBus::new(params);
    let (car, daemon) = (bus.join(), bus.join());
    let mut events: Vec<(u64, usize)> = Vec::new();
    for (i, message) in traffic.iter().enumerate() {
        // Offsets and slightly wrong periods, as independent clocks have: all phases come up.
        let period_us = 1e6 / message.rate_hz * (1.0 - 1e-3 * i as f64);
        let count = (2e6 / period_us) as u64;
        events.extend((0..count).map(|k| ((137 * i) as u64 + (k as f64 * period_us) as u64, i)));
    }
    events.sort_unstable();
    let mut longest = vec![0.0f64; traffic.len()];
    let mut open: Vec<std::collections::VecDeque<(Instant, usize)>> =
        vec![std::collections::VecDeque::new(); traffic.len()];
    let mut collect =
        |bus: &mut VirtualBus, open: &mut Vec<std::collections::VecDeque<(Instant, usize)>>| {
            for node in [car, daemon] {
                while let Some((at, frame)) = bus.receive(node) {
                    let of = |message: &Traffic| message.frames[0].id == frame.id;
                    let i = traffic.iter().position(of).unwrap();
                    let first = open[i].front_mut().unwrap();
                    first.1 -= 1;
                    if first.1 == 0 {
                        longest[i] = longest[i].max(at.seconds_after(first.0) * 1e3);
                        open[i].pop_front();
                    }
                }
            }
        };
    for (micros, i) in events {
        let now = Instant::from_nanos(micros * 1000);
        open[i].push_back((now, traffic[i].frames.len()));
        let node = if traffic[i].from_car { car } else { daemon };
        for frame in &traffic[i].frames {
            bus.send(now, node, *frame).unwrap();
        }
        collect(&mut bus, &mut open);
    }
    bus.advance(Instant::from_nanos(4_000_000_000));
    collect(&mut bus, &mut open);
    assert!(open.iter().all(|waiting| waiting.is_empty()));
    longest
}

fn load_tables() -> String {
    let mut text = String::new();
    for (title, layout, bitrate, data_bitrate, beams, scan_hz) in [
        ("CAN FD, 1 / 5 Mbit/s, 1080 beams at 40 Hz", Layout::Fd, 1_000_000, 5_000_000, 1080, 40.0),
        (
            "CAN FD, 500 kbit/s / 2 Mbit/s, 1080 beams at 20 Hz",
            Layout::Fd,
            500_000,
            2_000_000,
            1080,
            20.0,
        ),
        ("Classic, 1 Mbit/s, 360 beams at 10 Hz", Layout::Classic, 1_000_000, 1_000_000, 360, 10.0),
        ("Classic, 500 kbit/s, 360 beams at 10 Hz", Layout::Classic, 500_000, 500_000, 360, 10.0),
    ] {
        let params = BusParams {
            bitrate_bps: bitrate,
            data_bitrate_bps: data_bitrate,
            ..BusParams::default()
        };
        let traffic = traffic(layout, beams, scan_hz, 40, 20.0);
        let longest = latencies(&params, &traffic);
        let _ = writeln!(
            text,
            "**{title}** (tails of 40 samples at 20 Hz)\n\n\
             | message | frames each | sendings/s | frames/s | one frame, µs | load, % | longest delivery, ms |\n\
             |---|---|---|---|---|---|---|"
        );
        let (mut rate, mut load) = (0.0, 0.0);
        for (message, longest_ms) in traffic.iter().zip(longest) {
            let micros =
                FrameBits::of(&message.frames[0]).duration(&params).as_nanos() as f64 * 1e-3;
            let frames_hz = message.rate_hz * message.frames.len() as f64;
            let percent = frames_hz * micros * 1e-4;
            rate += frames_hz;
            load += percent;
            let _ = writeln!(
                text,
                "| {} | {} | {} | {frames_hz} | {micros:.1} | {percent:.1} | {longest_ms:.2} |",
                message.name,
                message.frames.len(),
                message.rate_hz,
            );
        }
        let _ = writeln!(text, "| **all** | | | {rate} | | **{load:.1}** | |\n");
        assert!(load < 75.0, "{title}: {load} %");
    }
    text
}
