//! The car's end of the bus: body, controller, sensors, and the frames between them and the bus.

use std::collections::VecDeque;

use crate::command::ForceSetpoint;
use crate::frames::Pose;
use crate::scan::Scan;
use crate::sim::bus::NodeId;
use crate::sim::car::{Car, CarState, OdometryReading};
use crate::sim::controller::Controller;
use crate::sim::lidar::{BeamFan, Lidar};
use crate::sim::world::World;
use crate::time::{Duration, Instant};
use crate::wire::can::{
    CanFrame, CarDecoder, CarEncoder, CarOdometry, CarTime, DaemonMessage, Layout,
};

/// The car's clock is ahead of the core's by this much: nobody may take them for the same.
const CLOCK_AHEAD_US: u64 = 7_654_321;
/// Status and heartbeat periods, microseconds.
const STATUS_PERIOD_US: u64 = 20_000;
const HEARTBEAT_PERIOD_US: u64 = 100_000;
/// Scans whose delivery is still open are forgotten beyond this number.
const SENT_SCANS: usize = 32;

/// Everything that is on board of the simulated car.
pub struct CarEnd {
    node: NodeId,
    car: Car,
    controller: Controller,
    /// What the controller is after a restart.
    fresh_controller: Controller,
    lidar: Lidar,
    encoder: CarEncoder,
    decoder: CarDecoder,
    layout: Layout,
    starts: Starts,
    wheelbase_m: f64,
    track_m: f64,
    scan_period_us: u64,
    odometry_period_us: u64,
    sequence: u16,
    setpoint: ForceSetpoint,
    scan_delay: Duration,
    /// Scans that are held back, with the time at which they may go.
    held: VecDeque<(Instant, Vec<CanFrame>)>,
    out: VecDeque<CanFrame>,
    frames: Vec<CanFrame>,
    sent: VecDeque<(u16, Pose, Vec<f32>)>,
}

/// What counts from the controller's start.
#[derive(Clone, Copy, Debug, Default)]
struct Starts {
    /// Starts so far, less one.
    boot: u8,
    /// Totals of the body then.
    travelled_m: f64,
    turned_rad: f64,
    /// The controller's clock less its usual lead over the core's, microseconds.
    shift_us: i64,
}

impl Starts {
    /// The clock that stamps carry.
    fn stamp(&self, at: Instant) -> CarTime {
        CarTime::from_micros(micros(at).saturating_add_signed(self.shift_us))
    }
}

/// What a [`CarEnd`] is made of.
pub struct CarEndParts {
    /// Its place on the bus.
    pub node: NodeId,
    /// The body.
    pub car: Car,
    /// The controller.
    pub controller: Controller,
    /// The lidar.
    pub lidar: Lidar,
    /// Makes its frames.
    pub encoder: CarEncoder,
    /// Reads the daemon's frames.
    pub decoder: CarDecoder,
    /// Layout of both.
    pub layout: Layout,
    /// Distance between the axles, metres.
    pub wheelbase_m: f64,
    /// Distance between left and right wheels, metres.
    pub track_m: f64,
    /// Scans per second.
    pub scan_rate_hz: f64,
    /// Odometry frames per second.
    pub odometry_rate_hz: f64,
}

impl CarEnd {
    /// Puts the parts together.
    pub fn new(parts: CarEndParts) -> Self {
        let period_us = |rate_hz: f64| (1e6 / rate_hz).round().max(1.0) as u64;
        Self {
            node: parts.node,
            car: parts.car,
            fresh_controller: parts.controller.clone(),
            controller: parts.controller,
            lidar: parts.lidar,
            encoder: parts.encoder,
            decoder: parts.decoder,
            layout: parts.layout,
            starts: Starts::default(),
            wheelbase_m: parts.wheelbase_m,
            track_m: parts.track_m,
            scan_period_us: period_us(parts.scan_rate_hz),
            odometry_period_us: period_us(parts.odometry_rate_hz),
            sequence: 0,
            setpoint: ForceSetpoint::default(),
            scan_delay: Duration::ZERO,
            held: VecDeque::new(),
            out: VecDeque::new(),
            frames: Vec::new(),
            sent: VecDeque::new(),
        }
    }

    /// Its place on the bus.
    pub const fn node(&self) -> NodeId {
        self.node
    }

    /// The true state.
    pub const fn state(&self) -> &CarState {
        self.car.state()
    }

    /// What the controller makes the car do.
    pub const fn setpoint(&self) -> &ForceSetpoint {
        &self.setpoint
    }

    /// The lidar's beams.
    pub fn fan(&self) -> &BeamFan {
        self.lidar.fan()
    }

    /// The emergency-stop button.
    pub fn set_emergency_stop(&mut self, pressed: bool) {
        self.controller.set_emergency_stop(pressed);
    }

    /// The battery's voltage, volts.
    pub fn set_battery_v(&mut self, battery_v: f64) {
        self.controller.set_battery_v(battery_v);
    }

    /// From now on scans leave this long after they were measured.
    pub fn set_scan_delay(&mut self, delay: Duration) {
        self.scan_delay = delay;
    }

    /// Restarts the controller at `now`: it forgets everything, its clock and its totals begin at
    /// zero.
    pub fn restart(&mut self, now: Instant) {
        let body = self.car.odometry(0);
        self.starts = Starts {
            boot: self.starts.boot.wrapping_add(1),
            travelled_m: body.travelled_m,
            turned_rad: body.turned_rad,
            shift_us: -(micros(now) as i64),
        };
        self.controller = self.fresh_controller.clone();
        self.encoder = CarEncoder::new(self.layout, self.starts.boot);
        self.decoder = CarDecoder::new(self.layout);
        self.out.clear();
        self.held.clear();
    }

    /// Sets the clock that its stamps carry ahead (or back) by so many seconds.
    pub fn shift_clock(&mut self, seconds: f64) {
        self.starts.shift_us += (seconds * 1e6).round() as i64;
    }

    /// Sends heartbeats of another version of the interface.
    pub fn set_interface_version(&mut self, version: u8) {
        self.encoder.set_version(version);
    }

    /// What the wheels have measured since the controller's start.
    fn odometry(&self, clock_us: u64) -> OdometryReading {
        let mut reading = self.car.odometry(clock_us);
        reading.travelled_m -= self.starts.travelled_m;
        reading.turned_rad -= self.starts.turned_rad;
        reading
    }

    /// True pose and ranges of a scan that was sent; older ones are forgotten.
    pub fn take_sent_scan(&mut self, sequence: u16) -> Option<(Pose, Vec<f32>)> {
        let found = self.sent.iter().position(|(sent, ..)| *sent == sequence)?;
        self.sent.drain(..=found).next_back().map(|(_, pose, ranges)| (pose, ranges))
    }

    /// The next frame to send.
    pub fn poll_frame(&mut self) -> Option<CanFrame> {
        self.out.pop_front()
    }

    /// A frame from the bus.
    pub fn handle_frame(&mut self, at: Instant, frame: &CanFrame) {
        let odometry = self.odometry(0);
        self.decoder.note_totals(odometry.travelled_m, odometry.turned_rad);
        match self.decoder.decode(own_clock(at), frame) {
            Ok(Some(DaemonMessage::Setpoint(setpoint))) => {
                self.controller.handle_setpoint(own_clock(at), setpoint);
            }
            // A tail that makes no sense is counted by the controller, the old one stays.
            Ok(Some(DaemonMessage::Tail(tail))) => drop(self.controller.handle_tail(&tail)),
            // What the decoder drops it counts.
            Ok(Some(DaemonMessage::Heartbeat(_)) | None) | Err(_) => {}
        }
    }

    /// Moves on by one step that ends at `end`, then measures and reports what is due.
    pub fn step(&mut self, end: Instant, dt_s: f64, world: &World) {
        let begin = end.offset_by(-dt_s);
        let reading = self.odometry(micros(begin));
        self.setpoint = self.controller.step(own_clock(begin), &reading);
        self.car.step(dt_s, &self.setpoint);

        let us = end.as_nanos() / 1000;
        let time = self.starts.stamp(end);
        let due = |period_us: u64| us % period_us < (dt_s * 1e6) as u64;
        if due(self.odometry_period_us) {
            let odometry = self.odometry(time.as_micros()).on_own_clock();
            let message =
                CarOdometry::from_odometry(time, &odometry, self.wheelbase_m, self.track_m);
            self.send(|encoder, frames| encoder.encode_odometry(&message, frames).is_ok());
        }
        if due(STATUS_PERIOD_US) {
            let frame = self.encoder.encode_status(&self.controller.status(own_clock(end)));
            self.out.push_back(frame);
        }
        if due(HEARTBEAT_PERIOD_US) {
            let frame = self.encoder.encode_heartbeat(time);
            self.out.push_back(frame);
        }
        if due(self.scan_period_us) {
            self.measure(end, time, world);
        }
        while self.held.front().is_some_and(|(at, _)| *at <= end) {
            self.out.extend(self.held.pop_front().into_iter().flat_map(|(_, frames)| frames));
        }
    }

    fn measure(&mut self, end: Instant, time: CarTime, world: &World) {
        let pose = self.car.state().pose;
        let ranges_m = self.lidar.scan(world, pose);
        let fan = self.lidar.fan();
        let scan = Scan {
            stamp: end,
            sequence: self.sequence,
            angle_first_rad: fan.angle_first_rad(),
            angle_step_rad: fan.angle_step_rad(),
            range_max_m: fan.range_max_m(),
            ranges_m,
        };
        self.frames.clear();
        if self.encoder.encode_scan(time, &scan, &mut self.frames).is_ok() {
            // Behind those that are still held back, whatever the delay is now: a lidar's scans
            // do not overtake each other.
            if self.scan_delay.is_zero() && self.held.is_empty() {
                self.out.extend(self.frames.drain(..));
            } else {
                let last = self.held.back().map_or(end, |(at, _)| *at);
                self.held.push_back((last.max(end + self.scan_delay), self.frames.clone()));
            }
            self.sent.push_back((self.sequence, pose, scan.ranges_m));
            if self.sent.len() > SENT_SCANS {
                self.sent.pop_front();
            }
        }
        self.sequence = self.sequence.wrapping_add(1);
    }

    fn send(&mut self, encode: impl FnOnce(&mut CarEncoder, &mut Vec<CanFrame>) -> bool) -> bool {
        self.frames.clear();
        let sent = encode(&mut self.encoder, &mut self.frames);
        self.out.extend(self.frames.drain(..));
        sent
    }
}

fn micros(at: Instant) -> u64 {
    at.as_nanos() / 1000 + CLOCK_AHEAD_US
}

fn own_clock(at: Instant) -> Instant {
    Instant::from_nanos(at.as_nanos() + CLOCK_AHEAD_US * 1000)
}
