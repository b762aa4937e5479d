//! The car's end of the bus: body, controller, sensors, and the frames between them and the bus.
//! The rig and the car as a process of its own share it.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use super::bus::{BusParams, FrameBits};
use super::car::{Car, CarParams, CarState, OdometryReading};
use super::controller::{Controller, ControllerParams};
use super::lidar::{BeamFan, Lidar, LidarParams};
use super::world::World;
use crate::command::{CarStatus, ForceSetpoint};
use crate::frames::Pose;
use crate::time::{Duration, Instant};
use crate::vehicle::VehicleParams;
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

/// What the car sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MessageClass {
    /// Turns of the lidar.
    Scan,
    /// Wheel odometry.
    Odometry,
    /// What the controller says about itself.
    Status,
    /// Its sign of life.
    Heartbeat,
}

impl MessageClass {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Scan, Self::Odometry, Self::Status, Self::Heartbeat];
}

/// Everything that is on board of the simulated car.
pub struct CarEnd {
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
    scans: u64,
    setpoint: ForceSetpoint,
    silent: [bool; MessageClass::ALL.len()],
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
pub struct CarEndSetup<'a> {
    /// Where it stands at first, map frame.
    pub start: Pose,
    /// The vehicle.
    pub vehicle: &'a VehicleParams,
    /// The body.
    pub car: &'a CarParams,
    /// The controller.
    pub controller: &'a ControllerParams,
    /// The lidar.
    pub lidar: &'a LidarParams,
    /// Layout of the frames.
    pub layout: Layout,
    /// Seed of the sensors' noise.
    pub seed: u64,
}

impl CarEnd {
    /// Puts the parts together.
    pub fn new(setup: &CarEndSetup<'_>) -> Self {
        let period_us = |rate_hz: f64| (1e6 / rate_hz).round().max(1.0) as u64;
        let vehicle = setup.vehicle;
        let controller = Controller::new(vehicle, setup.controller);
        Self {
            car: Car::new(vehicle, setup.car, setup.start),
            fresh_controller: controller.clone(),
            controller,
            lidar: Lidar::new(setup.lidar, setup.seed),
            encoder: CarEncoder::new(setup.layout, 0),
            decoder: CarDecoder::new(setup.layout),
            layout: setup.layout,
            starts: Starts::default(),
            wheelbase_m: vehicle.wheelbase_m,
            track_m: vehicle.track_m,
            scan_period_us: period_us(setup.lidar.rate_hz),
            odometry_period_us: period_us(setup.car.odometry_rate_hz),
            sequence: 0,
            scans: 0,
            setpoint: ForceSetpoint::default(),
            silent: [false; MessageClass::ALL.len()],
            scan_delay: Duration::ZERO,
            held: VecDeque::new(),
            out: VecDeque::new(),
            frames: Vec::new(),
            sent: VecDeque::new(),
        }
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

    /// Stops sending a class of messages, or sends them again. Nothing is measured meanwhile, and
    /// no counter runs on: the sensor is gone, not the bus.
    pub fn set_silent(&mut self, class: MessageClass, silent: bool) {
        self.silent[class as usize] = silent;
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

    /// Scans measured so far.
    pub const fn scans(&self) -> u64 {
        self.scans
    }

    /// What the controller says about itself.
    pub fn status(&self, now: Instant) -> CarStatus {
        self.controller.status(own_clock(now))
    }

    /// When a step of `dt` that ends after `after` next has something to send; what it answers to
    /// frames does not count.
    pub fn next_output(&self, after: Instant, dt: Duration) -> Instant {
        let micros = after.as_nanos() / 1000;
        let next =
            [self.odometry_period_us, STATUS_PERIOD_US, HEARTBEAT_PERIOD_US, self.scan_period_us]
                .map(|period| Instant::from_nanos((micros / period + 1) * period * 1000));
        let held = self.held.front().map(|(at, _)| *at);
        let next = next.into_iter().chain(held).min().unwrap_or(after);
        // Steps end at whole multiples of their length.
        let step = (dt.as_nanos() as u64).max(1);
        Instant::from_nanos(next.as_nanos().div_ceil(step) * step).max(after + dt)
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
        let due = |class: MessageClass, period_us| !self.silent[class as usize] && due(period_us);
        let [scan, status, heartbeat] = [
            due(MessageClass::Scan, self.scan_period_us),
            due(MessageClass::Status, STATUS_PERIOD_US),
            due(MessageClass::Heartbeat, HEARTBEAT_PERIOD_US),
        ];
        if due(MessageClass::Odometry, self.odometry_period_us) {
            let odometry = self.odometry(time.as_micros()).on_own_clock();
            let message =
                CarOdometry::from_odometry(time, &odometry, self.wheelbase_m, self.track_m);
            self.encode(|encoder, frames| encoder.encode_odometry(&message, frames).is_ok());
            self.out.extend(self.frames.drain(..));
        }
        if status {
            let frame = self.encoder.encode_status(&self.controller.status(own_clock(end)));
            self.out.push_back(frame);
        }
        if heartbeat {
            let frame = self.encoder.encode_heartbeat(time);
            self.out.push_back(frame);
        }
        if scan {
            self.measure(end, time, world);
        }
        while self.held.front().is_some_and(|(at, _)| *at <= end) {
            self.out.extend(self.held.pop_front().into_iter().flat_map(|(_, frames)| frames));
        }
    }

    fn measure(&mut self, end: Instant, time: CarTime, world: &World) {
        let pose = self.car.state().pose;
        let ranges_m = self.lidar.scan(world, pose);
        let scan = self.lidar.fan().scan(end, self.sequence, ranges_m);
        if self.encode(|encoder, frames| encoder.encode_scan(time, &scan, frames).is_ok()) {
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
        self.scans += 1;
        self.sequence = self.sequence.wrapping_add(1);
    }

    /// Encodes into `frames`; whether that was possible.
    fn encode(&mut self, encode: impl FnOnce(&mut CarEncoder, &mut Vec<CanFrame>) -> bool) -> bool {
        self.frames.clear();
        encode(&mut self.encoder, &mut self.frames)
    }
}

/// Share of the bus that scans alone take: 1 is all of it.
pub fn scan_load(layout: Layout, lidar: &LidarParams, bus: &BusParams) -> f64 {
    let fan = BeamFan::new(lidar);
    let scan = fan.scan(Instant::ZERO, 0, vec![1.0; fan.beams()]);
    let mut frames = Vec::new();
    // A scan that cannot be encoded takes no time.
    let _ = CarEncoder::new(layout, 0).encode_scan(CarTime::default(), &scan, &mut frames);
    let time_s = |frame| FrameBits::of(frame).duration(bus).as_secs_f64();
    frames.iter().map(time_s).sum::<f64>() * lidar.rate_hz
}

fn micros(at: Instant) -> u64 {
    at.as_nanos() / 1000 + CLOCK_AHEAD_US
}

fn own_clock(at: Instant) -> Instant {
    Instant::from_nanos(at.as_nanos() + CLOCK_AHEAD_US * 1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_lidar_fits_an_fd_bus_and_a_small_one_a_classic_bus() {
        let load = |layout, beams, rate_hz| {
            let lidar = LidarParams { beams, rate_hz, ..LidarParams::default() };
            scan_load(layout, &lidar, &BusParams::default())
        };
        let fd = load(Layout::Fd, 1080, 40.0);
        assert!((0.15..0.4).contains(&fd), "{fd}");
        assert!((load(Layout::Fd, 1080, 20.0) - 0.5 * fd).abs() < 1e-12);
        let small = load(Layout::Classic, 360, 10.0);
        assert!((0.1..0.5).contains(&small), "{small}");
        assert!(load(Layout::Classic, 1080, 20.0) > 0.8, "with odometry and tails, too much");
    }
}
