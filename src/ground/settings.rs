//! What can be configured about MAVLink.

use crate::{choices, tunables};

choices! {
    /// Whose habits the vehicle takes on.
    pub enum Identity {
        /// A generic autopilot: every ground station shows it; modes are numbered as those of ArduPilot's rovers.
        Generic = "generic",
        /// Says that it is a PX4 rover: QGroundControl and MAVSDK offer modes, go-to, pause, mission start.
        Px4 = "px4",
    }
}

choices! {
    /// What becomes of packets without a signature when a key is set.
    pub enum Unsigned {
        /// They are dropped.
        Refuse = "refuse",
        /// All are dropped but RADIO_STATUS, which telemetry radios send themselves.
        Radio = "radio",
        /// They are accepted like signed ones.
        Accept = "accept",
    }
}

choices! {
    /// Who may set the key for signatures by SETUP_SIGNING.
    pub enum KeySetup {
        /// Nobody: the key is read from its file.
        Refuse = "refuse",
        /// Whoever comes by a serial line or from this computer itself.
        Trusted = "trusted",
    }
}

choices! {
    /// What the car does when every ground station has gone silent while it is armed.
    pub enum StationLost {
        /// It says so and drives on.
        Report = "report",
        /// It comes to rest along its plan, and goes on when a station is heard again.
        Stop = "stop",
        /// It drives back to where it started.
        Return = "return",
    }
}

tunables! {
    /// MAVLink: how ground stations reach the vehicle and what they see.
    pub struct MavlinkParams in "mavlink" {
        /// Links, separated by commas: udpin:HOST:PORT, udpout:HOST:PORT, tcpin:HOST:PORT,
        /// tcpout:HOST:PORT, serial:DEVICE:BAUD. Without any nothing is opened.
        links: String = "", restart;
        /// Number of this system in the network of vehicles and ground stations.
        system_id: u32 = 1, restart, in 1..=250, "";
        /// Whose autopilot it looks like.
        identity: Identity = Identity::Generic, restart, one of;
        /// File with the key for signatures, 64 hexadecimal digits. Without one nothing is signed.
        signing_key_file: String = "", restart;
        /// What becomes of packets without a signature when there is a key.
        unsigned: Unsigned = Unsigned::Radio, restart, one of;
        /// Who may set the key by a message; it is written to the key file.
        key_setup: KeySetup = KeySetup::Refuse, restart, one of;
        /// Whether a ground station that forces arming is heard. The checks are made all the same:
        /// there is none without which the car could drive.
        forced_arming: bool = false, live;
        /// What is done when every ground station has gone silent while the car is armed.
        station_lost: StationLost = StationLost::Report, live, one of;
        /// A ground station that has not been heard for this long has gone silent.
        station_timeout_s: f64 = 5.0, live, in 1.0..=120.0, "s";
        /// Whether the map has a known place on the earth; without one there are no global positions
        /// until a ground station sets the origin.
        origin_known: bool = false, restart;
        /// Latitude of the map's origin.
        origin_latitude_deg: f64 = 0.0, restart, in -89.9..=89.9, "deg";
        /// Longitude of the map's origin.
        origin_longitude_deg: f64 = 0.0, restart, in -180.0..=180.0, "deg";
        /// Height of the map above mean sea level.
        origin_altitude_m: f64 = 0.0, restart, in -500.0..=9000.0, "m";
        /// Voltage at which the battery is shown as empty, with full linear in between; 0 shows no
        /// percentage.
        battery_empty_v: f64 = 0.0, live, in 0.0..=100.0, "V";
        /// Voltage at which the battery is shown as full.
        battery_full_v: f64 = 0.0, live, in 0.0..=100.0, "V";
    }
}
