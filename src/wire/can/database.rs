//! Every message of the interface; its signals are in `fields`. The codec, `params/car.dbc` and the tables of
//! `docs/can-interface.md` all come from here.

use super::fields::{
    SCAN_CLASSIC, SCAN_FD, TAIL_CLASSIC, TAIL_FD, car_heartbeat, daemon_heartbeat, odometry,
    setpoint, status,
};
use super::frame::Layout;
use super::signal::Signal;

/// Version of the frames; both sides send theirs in the heartbeat.
pub const INTERFACE_VERSION: u8 = 2;

/// Who sends a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sender {
    /// The car's controller.
    Car,
    /// The daemon.
    Daemon,
}

/// One message: everything that travels under one identifier.
#[derive(Clone, Debug)]
pub struct Message {
    /// Name in the database.
    pub name: &'static str,
    /// Standard identifier.
    pub id: u16,
    /// Its layout.
    pub layout: Layout,
    /// Data ID of the end-to-end protection.
    pub data_id: u16,
    /// Length of its data field, bytes.
    pub len: u8,
    /// Who sends it.
    pub sender: Sender,
    /// Time from one sending to the next, milliseconds; 0 if it is a stream of many frames.
    pub cycle_ms: u16,
    /// What it is for.
    pub text: &'static str,
    /// Its signals, without those of the end-to-end protection.
    pub signals: Vec<Signal>,
}

/// The messages, in order of priority.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Status,
    Setpoint,
    Odometry,
    Tail,
    CarHeartbeat,
    DaemonHeartbeat,
    Scan,
}

impl Kind {
    pub(super) const ALL: [Self; 7] = [
        Self::Status,
        Self::Setpoint,
        Self::Odometry,
        Self::Tail,
        Self::CarHeartbeat,
        Self::DaemonHeartbeat,
        Self::Scan,
    ];

    /// The standard identifier: the lower, the more urgent. Odd ones are classic.
    pub(super) const fn id(self, layout: Layout) -> u16 {
        let id = match self {
            Self::Status => 0x020,
            Self::Setpoint => 0x040,
            Self::Odometry => 0x050,
            Self::Tail => 0x060,
            Self::CarHeartbeat => 0x070,
            Self::DaemonHeartbeat => 0x078,
            Self::Scan => 0x100,
        };
        match layout {
            Layout::Classic => id | 1,
            Layout::Fd => id,
        }
    }

    /// The Data ID of the end-to-end protection.
    pub(super) const fn data_id(self, layout: Layout) -> u16 {
        0xA000 + self.id(layout)
    }

    /// Data length, bytes.
    pub(super) const fn len(self, layout: Layout) -> usize {
        match (layout, self) {
            (Layout::Classic, _) => 8,
            (Layout::Fd, Self::Scan | Self::Tail) => 64,
            (Layout::Fd, Self::Odometry) => 24,
            (Layout::Fd, _) => 12,
        }
    }

    pub(super) const fn sender(self) -> Sender {
        match self {
            Self::Setpoint | Self::Tail | Self::DaemonHeartbeat => Sender::Daemon,
            _ => Sender::Car,
        }
    }
}

/// The signals of the end-to-end protection.
pub fn protection(layout: Layout) -> [Signal; 2] {
    match layout {
        Layout::Classic => [
            Signal::new("Crc", 0, 8, 1.0, "", "AUTOSAR E2E profile 11: CRC-8 SAE J1850"),
            Signal::new("Counter", 8, 4, 1.0, "", "AUTOSAR E2E profile 11: 0 to 14"),
        ],
        Layout::Fd => [
            Signal::new("Crc", 0, 16, 1.0, "", "AUTOSAR E2E profile 5: CRC-16 CCITT"),
            Signal::new("Counter", 16, 8, 1.0, "", "AUTOSAR E2E profile 5: 0 to 255"),
        ],
    }
}

/// All messages of both layouts, in order of identifiers.
pub fn messages() -> Vec<Message> {
    let mut messages: Vec<Message> = Kind::ALL
        .into_iter()
        .flat_map(|kind| Layout::ALL.iter().map(move |layout| message(kind, *layout)))
        .collect();
    messages.sort_by_key(|message| message.id);
    messages
}

fn message(kind: Kind, layout: Layout) -> Message {
    let fd = layout == Layout::Fd;
    let (fd_name, classic_name, cycle_ms, text) = match kind {
        Kind::Status => (
            "CarStatus",
            "CarStatusClassic",
            20,
            "What the controller says about itself; also sent at once when a flag changes",
        ),
        Kind::Setpoint => ("DriveSetpoint", "DriveSetpointClassic", 10, "Forces wished for"),
        Kind::Odometry => (
            "CarOdometry",
            "CarOdometryClassic",
            10,
            "Running totals, wheel speeds, steering angle, yaw rate",
        ),
        Kind::Tail => (
            "BrakingTail",
            "BrakingTailClassic",
            0,
            "How to come to rest without a further word; one tail per committed plan",
        ),
        Kind::CarHeartbeat => {
            ("CarHeartbeat", "CarHeartbeatClassic", 100, "The controller is alive")
        }
        Kind::DaemonHeartbeat => {
            ("DaemonHeartbeat", "DaemonHeartbeatClassic", 100, "The daemon is alive")
        }
        Kind::Scan => {
            ("LidarScan", "LidarScanClassic", 0, "One turn of the lidar, split over frames")
        }
    };
    let signals = match (kind, layout) {
        (Kind::Status, _) => status(layout).list(),
        (Kind::Setpoint, _) => setpoint(layout).list(),
        (Kind::CarHeartbeat, _) => car_heartbeat(layout).list(),
        (Kind::DaemonHeartbeat, _) => daemon_heartbeat(layout).list(),
        (Kind::Odometry, _) => {
            let mut list = odometry(layout).list();
            if fd {
                list.retain(|signal| signal.name != "Part" && signal.name != "StampAgain");
            }
            list
        }
        (Kind::Scan, Layout::Fd) => SCAN_FD.list(),
        (Kind::Scan, Layout::Classic) => SCAN_CLASSIC.list(),
        (Kind::Tail, Layout::Fd) => TAIL_FD.list(),
        (Kind::Tail, Layout::Classic) => TAIL_CLASSIC.list(),
    };
    Message {
        name: if fd { fd_name } else { classic_name },
        id: kind.id(layout),
        data_id: kind.data_id(layout),
        layout,
        len: kind.len(layout) as u8,
        sender: kind.sender(),
        cycle_ms,
        text,
        signals,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::signal::Multiplex;

    fn together(a: Multiplex, b: Multiplex) -> bool {
        match (a, b) {
            (Multiplex::On(a0, a1), Multiplex::On(b0, b1)) => a0 <= b1 && b0 <= a1,
            _ => true,
        }
    }

    #[test]
    fn no_two_signals_share_a_bit_and_all_fit_their_frame() {
        for message in messages() {
            let mut placed: Vec<(u16, u16, Multiplex, &str)> = Vec::new();
            for signal in protection(message.layout).iter().chain(&message.signals) {
                for i in 0..signal.count {
                    let start = signal.start + i * signal.stride;
                    let end = start + u16::from(signal.bits);
                    assert!(end <= u16::from(message.len) * 8, "{} {}", message.name, signal.name);
                    for (other_start, other_end, multiplex, name) in &placed {
                        assert!(
                            !together(signal.multiplex, *multiplex)
                                || end <= *other_start
                                || *other_end <= start,
                            "{}: {} and {name}",
                            message.name,
                            signal.name
                        );
                    }
                    placed.push((start, end, signal.multiplex, signal.name));
                }
            }
        }
    }

    #[test]
    fn identifiers_and_data_ids_are_unique() {
        let all = messages();
        for (i, a) in all.iter().enumerate() {
            for b in &all[i + 1..] {
                assert_ne!(a.id, b.id);
                assert_ne!(a.name, b.name);
            }
        }
    }
}
