//! The daemon's two ends: setpoints out, the car's messages in.

use crate::command::{BrakingTail, CarStatus, ForceSetpoint};
use crate::time::Instant;

use super::database::{INTERFACE_VERSION, Kind, Sender};
use super::e2e::Protector;
use super::fields::{
    CarHeartbeatSignals, DaemonHeartbeatSignals, SetpointSignals, StatusSignals, car_heartbeat,
    daemon_heartbeat, odometry, setpoint, status,
};
use super::frame::{CanFrame, CanId, DATA_MAX, Layout};
use super::odometry::{OdometryAssembly, RawOdometry, Unwrapper};
use super::receiver::Receiver;
use super::scan::{RawScan, ScanAssembly};
use super::{
    CarHeartbeat, CarMessage, CarOdometry, CarScan, CarTime, DaemonMode, WireError, WireStats, tail,
};

/// A protected frame of that message.
pub(super) fn seal(
    kind: Kind,
    layout: Layout,
    protector: &mut Protector,
    mut data: [u8; DATA_MAX],
) -> CanFrame {
    let data = &mut data[..kind.len(layout)];
    protector.protect(data);
    CanFrame::new(CanId::standard(kind.id(layout)), layout == Layout::Fd, data)
        .expect("the database knows only lengths that exist")
}

/// Makes the daemon's frames; owns their counters.
#[derive(Clone, Debug)]
pub struct Encoder {
    layout: Layout,
    setpoint: Protector,
    tail: Protector,
    heartbeat: Protector,
    bytes: Vec<u8>,
}

impl Encoder {
    /// Counters start at zero.
    pub fn new(layout: Layout) -> Self {
        let protector = |kind: Kind| Protector::new(layout, kind.data_id(layout));
        Self {
            layout,
            setpoint: protector(Kind::Setpoint),
            tail: protector(Kind::Tail),
            heartbeat: protector(Kind::DaemonHeartbeat),
            bytes: Vec::new(),
        }
    }

    /// A setpoint. Values beyond their signals are sent at the end of the range; what is not a
    /// number is refused (the car then brakes by itself).
    pub fn encode_setpoint(&mut self, value: &ForceSetpoint) -> Result<CanFrame, WireError> {
        const SIGNALS: [SetpointSignals; 2] = [setpoint(Layout::Classic), setpoint(Layout::Fd)];
        let s = &SIGNALS[self.layout.index()];
        let mut data = [0; DATA_MAX];
        s.drive.put(&mut data, i64::from(value.drive));
        for (signal, value) in [
            (&s.longitudinal, value.longitudinal_n),
            (&s.lateral, value.lateral_n),
            (&s.curvature, value.curvature_pm),
        ] {
            if value.is_nan() {
                return Err(WireError::OutOfRange { signal: signal.name, value });
            }
            signal.put(&mut data, signal.saturate(value, 0.0));
        }
        Ok(seal(Kind::Setpoint, self.layout, &mut self.setpoint, data))
    }

    /// A braking tail, appended to `frames`; nothing is appended on an error. Speeds are rounded
    /// down, anchors wrap.
    pub fn encode_tail(
        &mut self,
        value: &BrakingTail,
        frames: &mut Vec<CanFrame>,
    ) -> Result<(), WireError> {
        let Self { layout, tail: protector, bytes, .. } = self;
        tail::encode(*layout, value, bytes, |data| {
            frames.push(seal(Kind::Tail, *layout, protector, data));
        })
    }

    /// A heartbeat.
    pub fn encode_heartbeat(&mut self, uptime_ms: u32, mode: DaemonMode) -> CanFrame {
        const SIGNALS: [DaemonHeartbeatSignals; 2] =
            [daemon_heartbeat(Layout::Classic), daemon_heartbeat(Layout::Fd)];
        let s = &SIGNALS[self.layout.index()];
        let mut data = [0; DATA_MAX];
        s.uptime.put(&mut data, i64::from(uptime_ms));
        s.mode.put(&mut data, i64::from(mode.number()));
        s.version.put(&mut data, i64::from(INTERFACE_VERSION));
        seal(Kind::DaemonHeartbeat, self.layout, &mut self.heartbeat, data)
    }
}

/// What belongs to one start of the controller.
#[derive(Clone, Copy, Debug, Default)]
struct Epoch {
    number: u32,
    boot: Option<u8>,
    stamp: Unwrapper,
    travelled: Unwrapper,
    turned: Unwrapper,
}

impl Epoch {
    /// Notes the low bits of the boot number; whether the controller started anew.
    fn note(&mut self, boot: u8) -> bool {
        let restarted = self.boot.is_some_and(|known| known != boot);
        if restarted {
            *self = Self { number: self.number.wrapping_add(1), ..Self::default() };
        }
        self.boot = Some(boot);
        restarted
    }

    fn time(&mut self, stamp: u32) -> CarTime {
        CarTime::from_micros(self.stamp.next(i64::from(stamp)).max(0) as u64)
    }
}

/// Understands the car's frames.
#[derive(Clone, Debug)]
pub struct Decoder {
    layout: Layout,
    receiver: Receiver,
    epoch: Epoch,
    scan: ScanAssembly,
    odometry: OdometryAssembly,
}

impl Decoder {
    /// Knows nothing of the car yet.
    pub fn new(layout: Layout) -> Self {
        Self {
            layout,
            receiver: Receiver::new(layout, Sender::Car),
            epoch: Epoch::default(),
            scan: ScanAssembly::new(),
            odometry: OdometryAssembly::default(),
        }
    }

    /// Bytes that it holds on to.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.scan.capacity()
    }

    /// What was seen so far.
    pub fn stats(&self) -> &WireStats {
        &self.receiver.stats
    }

    /// Takes a frame that arrived at `now`; returns the message that it completes, if any. Frames
    /// with other identifiers are ignored. An error says what was dropped; go on with the next
    /// frame.
    pub fn decode(
        &mut self,
        now: Instant,
        frame: &CanFrame,
    ) -> Result<Option<CarMessage>, WireError> {
        let Some(passed) = self.receiver.pass(frame)? else {
            return Ok(None);
        };
        let (kind, lost, layout) = (passed.kind, passed.lost, self.layout);
        match kind {
            Kind::Scan => {
                let outcome = self.scan.take(now, layout, lost, frame);
                let raw = self.receiver.settle(kind, outcome)?;
                Ok(raw.map(|raw| CarMessage::Scan(self.finish_scan(raw))))
            }
            Kind::Odometry => {
                let outcome = self.odometry.take(now, layout, lost, frame);
                let raw = self.receiver.settle(kind, outcome)?;
                Ok(raw.map(|raw| CarMessage::Odometry(self.finish_odometry(&raw))))
            }
            Kind::Status => Ok(Some(CarMessage::Status(read_status(layout, frame)))),
            Kind::CarHeartbeat => Ok(Some(CarMessage::Heartbeat(self.read_heartbeat(frame)))),
            Kind::Setpoint | Kind::Tail | Kind::DaemonHeartbeat => {
                unreachable!("the receiver passes the car's messages only")
            }
        }
    }

    fn note_boot(&mut self, boot: u8) {
        if self.epoch.note(boot & 3) {
            self.receiver.stats.restarts += 1;
        }
    }

    fn finish_scan(&mut self, raw: RawScan) -> CarScan {
        self.note_boot(raw.boot);
        self.receiver.stats.complete += 1;
        CarScan {
            time: self.epoch.time(raw.stamp),
            epoch: self.epoch.number,
            sequence: raw.sequence,
            angle_first_rad: raw.angle_first_rad,
            angle_step_rad: raw.angle_step_rad,
            range_max_m: raw.range_max_m,
            ranges_m: raw.ranges_m,
        }
    }

    fn finish_odometry(&mut self, raw: &RawOdometry) -> CarOdometry {
        self.note_boot(raw.boot);
        let epoch = &mut self.epoch;
        let s = odometry(Layout::Fd);
        CarOdometry {
            time: epoch.time(raw.stamp),
            epoch: epoch.number,
            travelled_m: s.travelled.physical(epoch.travelled.next(i64::from(raw.travelled))),
            turned_rad: s.turned.physical(epoch.turned.next(i64::from(raw.turned))),
            wheel_left_mps: raw.wheel_left_mps,
            wheel_right_mps: raw.wheel_right_mps,
            steering_rad: raw.steering_rad,
            yaw_rate_rps: raw.yaw_rate_rps,
        }
    }

    fn read_heartbeat(&mut self, frame: &CanFrame) -> CarHeartbeat {
        const SIGNALS: [CarHeartbeatSignals; 2] =
            [car_heartbeat(Layout::Classic), car_heartbeat(Layout::Fd)];
        let s = &SIGNALS[self.layout.index()];
        let data = frame.padded();
        let boot = s.boot.get(data) as u8;
        self.note_boot(boot);
        CarHeartbeat {
            time: self.epoch.time(s.stamp.get(data) as u32),
            epoch: self.epoch.number,
            boot,
            version: s.version.get(data) as u8,
        }
    }
}

fn read_status(layout: Layout, frame: &CanFrame) -> CarStatus {
    const SIGNALS: [StatusSignals; 2] = [status(Layout::Classic), status(Layout::Fd)];
    let s = &SIGNALS[layout.index()];
    let data = frame.padded();
    let age = s.setpoint_age.get(data);
    CarStatus {
        emergency_stop: s.emergency_stop.get(data) != 0,
        setpoint_lost: s.setpoint_lost.get(data) != 0,
        loss_toggle: s.loss_toggle.get(data) != 0,
        tail_plan: (s.tail_held.get(data) != 0).then(|| s.tail_plan.get(data) as u16),
        battery_v: s.battery.value(data),
        setpoint_age_s: if age == s.setpoint_age.raw_max() {
            f64::INFINITY
        } else {
            s.setpoint_age.physical(age)
        },
    }
}
