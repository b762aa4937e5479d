//! The car's two ends, for the simulated car and for tests against a real controller.

use crate::command::{BrakingTail, CarStatus, ForceSetpoint};
use crate::scan::Scan;
use crate::time::Instant;

use super::daemon::seal;
use super::database::{INTERFACE_VERSION, Kind, Sender};
use super::e2e::Protector;
use super::fields::{
    CarHeartbeatSignals, DaemonHeartbeatSignals, SetpointSignals, StatusSignals, TAIL_FD,
    car_heartbeat, daemon_heartbeat, setpoint, status,
};
use super::frame::{CanFrame, DATA_MAX, Layout};
use super::odometry::nearest;
use super::receiver::{Fault, Receiver};
use super::tail::{RawTail, TailAssembly};
use super::{
    CarOdometry, CarTime, DaemonHeartbeat, DaemonMessage, DaemonMode, WireError, WireStats,
    odometry, scan,
};

/// Makes the car's frames; owns their counters.
#[derive(Clone, Debug)]
pub struct CarEncoder {
    layout: Layout,
    boot: u8,
    version: u8,
    scan: Protector,
    odometry: Protector,
    status: Protector,
    heartbeat: Protector,
    bytes: Vec<u8>,
}

impl CarEncoder {
    /// Counters start at zero; `boot` counts the controller's starts.
    pub fn new(layout: Layout, boot: u8) -> Self {
        let protector = |kind: Kind| Protector::new(layout, kind.data_id(layout));
        Self {
            layout,
            boot,
            version: INTERFACE_VERSION,
            scan: protector(Kind::Scan),
            odometry: protector(Kind::Odometry),
            status: protector(Kind::Status),
            heartbeat: protector(Kind::CarHeartbeat),
            bytes: Vec::new(),
        }
    }

    /// Heartbeats claim another version of the interface from now on, as an older controller's do.
    pub fn set_version(&mut self, version: u8) {
        self.version = version;
    }

    /// A scan measured at `time` (its own stamp is not sent), appended to `frames`; nothing is
    /// appended on an error.
    pub fn encode_scan(
        &mut self,
        time: CarTime,
        value: &Scan,
        frames: &mut Vec<CanFrame>,
    ) -> Result<(), WireError> {
        let Self { layout, scan: protector, bytes, .. } = self;
        scan::encode(*layout, time, self.boot & 3, value, bytes, |data| {
            frames.push(seal(Kind::Scan, *layout, protector, data));
        })
    }

    /// A measurement of the wheels, appended to `frames`; nothing is appended on an error. The
    /// epoch is not sent.
    pub fn encode_odometry(
        &mut self,
        value: &CarOdometry,
        frames: &mut Vec<CanFrame>,
    ) -> Result<(), WireError> {
        let Self { layout, odometry: protector, .. } = self;
        odometry::encode(*layout, self.boot & 3, value, |data| {
            frames.push(seal(Kind::Odometry, *layout, protector, data));
        })
    }

    /// A status. It is always sent: an unknown age counts as the longest, an unknown voltage as
    /// zero.
    pub fn encode_status(&mut self, value: &CarStatus) -> CanFrame {
        const SIGNALS: [StatusSignals; 2] = [status(Layout::Classic), status(Layout::Fd)];
        let s = &SIGNALS[self.layout.index()];
        let mut data = [0; DATA_MAX];
        s.emergency_stop.put(&mut data, i64::from(value.emergency_stop));
        s.setpoint_lost.put(&mut data, i64::from(value.setpoint_lost));
        s.loss_toggle.put(&mut data, i64::from(value.loss_toggle));
        s.tail_held.put(&mut data, i64::from(value.tail_plan.is_some()));
        s.tail_plan.put(&mut data, i64::from(value.tail_plan.unwrap_or(0)));
        s.battery.put(&mut data, s.battery.saturate(value.battery_v, 0.0));
        s.setpoint_age.put(&mut data, s.setpoint_age.saturate(value.setpoint_age_s, f64::INFINITY));
        seal(Kind::Status, self.layout, &mut self.status, data)
    }

    /// A heartbeat sent at `time`.
    pub fn encode_heartbeat(&mut self, time: CarTime) -> CanFrame {
        const SIGNALS: [CarHeartbeatSignals; 2] =
            [car_heartbeat(Layout::Classic), car_heartbeat(Layout::Fd)];
        let s = &SIGNALS[self.layout.index()];
        let mut data = [0; DATA_MAX];
        s.stamp.put(&mut data, i64::from(time.as_micros() as u32));
        s.boot.put(&mut data, i64::from(self.boot));
        s.version.put(&mut data, i64::from(self.version));
        seal(Kind::CarHeartbeat, self.layout, &mut self.heartbeat, data)
    }
}

/// Understands the daemon's frames.
#[derive(Clone, Debug)]
pub struct CarDecoder {
    layout: Layout,
    receiver: Receiver,
    tail: TailAssembly,
    travelled_m: f64,
    turned_rad: f64,
}

impl CarDecoder {
    /// Knows nothing of the daemon yet.
    pub fn new(layout: Layout) -> Self {
        Self {
            layout,
            receiver: Receiver::new(layout, Sender::Daemon),
            tail: TailAssembly::new(),
            travelled_m: 0.0,
            turned_rad: 0.0,
        }
    }

    /// Bytes that it holds on to.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.tail.capacity()
    }

    /// What was seen so far.
    pub fn stats(&self) -> &WireStats {
        &self.receiver.stats
    }

    /// Tells the controller's own totals, metres and radians. The anchors of a tail, which wrap on
    /// the bus, are taken as the ones nearest to them (right within 21 km and 2147 rad).
    pub fn note_totals(&mut self, travelled_m: f64, turned_rad: f64) {
        self.travelled_m = travelled_m;
        self.turned_rad = turned_rad;
    }

    /// Takes a frame that arrived at `now`; returns the message that it completes, if any. Frames
    /// with other identifiers are ignored. An error says what was dropped; go on with the next
    /// frame.
    pub fn decode(
        &mut self,
        now: Instant,
        frame: &CanFrame,
    ) -> Result<Option<DaemonMessage>, WireError> {
        let Some(passed) = self.receiver.pass(frame)? else {
            return Ok(None);
        };
        let (kind, layout) = (passed.kind, self.layout);
        match kind {
            Kind::Setpoint => Ok(Some(DaemonMessage::Setpoint(read_setpoint(layout, frame)))),
            Kind::Tail => {
                let outcome = self.tail.take(now, layout, passed.lost, frame);
                let raw = self.receiver.settle(kind, outcome)?;
                Ok(raw.map(|raw| DaemonMessage::Tail(self.finish_tail(raw))))
            }
            Kind::DaemonHeartbeat => {
                let outcome = read_heartbeat(layout, frame).map(Some);
                Ok(self.receiver.settle(kind, outcome)?.map(DaemonMessage::Heartbeat))
            }
            Kind::Scan | Kind::Odometry | Kind::Status | Kind::CarHeartbeat => {
                unreachable!("the receiver passes the daemon's messages only")
            }
        }
    }

    fn finish_tail(&mut self, raw: RawTail) -> BrakingTail {
        self.receiver.stats.complete += 1;
        let unwrap = |signal: &super::Signal, total: f64, raw: u32| {
            // A cast saturates, and NaN becomes zero.
            signal.physical(nearest((total / signal.scale).round() as i64, raw))
        };
        BrakingTail {
            plan: raw.plan,
            anchor_travelled_m: unwrap(
                &TAIL_FD.anchor_travelled,
                self.travelled_m,
                raw.anchor_travelled,
            ),
            anchor_turned_rad: unwrap(
                &TAIL_FD.anchor_turned,
                self.turned_rad,
                raw.anchor_turned as u32,
            ),
            anchor_offset_m: raw.anchor_offset_m,
            spacing_m: raw.spacing_m,
            samples: raw.samples,
        }
    }
}

fn read_setpoint(layout: Layout, frame: &CanFrame) -> ForceSetpoint {
    const SIGNALS: [SetpointSignals; 2] = [setpoint(Layout::Classic), setpoint(Layout::Fd)];
    let s = &SIGNALS[layout.index()];
    let data = frame.padded();
    ForceSetpoint {
        longitudinal_n: s.longitudinal.value(data),
        lateral_n: s.lateral.value(data),
        curvature_pm: s.curvature.value(data),
        drive: s.drive.get(data) != 0,
    }
}

fn read_heartbeat(layout: Layout, frame: &CanFrame) -> Result<DaemonHeartbeat, Fault> {
    const SIGNALS: [DaemonHeartbeatSignals; 2] =
        [daemon_heartbeat(Layout::Classic), daemon_heartbeat(Layout::Fd)];
    let s = &SIGNALS[layout.index()];
    let data = frame.padded();
    Ok(DaemonHeartbeat {
        uptime_ms: s.uptime.get(data) as u32,
        mode: DaemonMode::from_number(s.mode.get(data) as u8).ok_or(Fault::BadValue)?,
        version: s.version.get(data) as u8,
    })
}
