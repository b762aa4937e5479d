//! What becomes of the drive when every ground station has gone silent.

use super::core::CoreRequest;
use super::modes::Mode;
use super::settings::StationLost;
use super::{Ground, fresh};
use crate::time::Instant;
use crate::wire::mavlink::common::MavSeverity;

impl Ground {
    /// Looks whether every ground station has gone silent.
    pub(super) fn watch_stations(&mut self, now: Instant) {
        let Some(newest) = self.station_heard else { return };
        let Some(view) = fresh(&self.view, now) else { return };
        let silent = now.since(newest).as_secs_f64() > self.params.station_timeout_s;
        // One that went silent before the car was armed is not missed.
        let lost = silent && (self.station_lost || view.mode.is_armed());
        if lost == self.station_lost {
            return;
        }
        self.station_lost = lost;
        let action = self.params.station_lost;
        if lost {
            let done = match action {
                StationLost::Report => "driving on",
                StationLost::Stop => "stopping",
                StationLost::Return => "returning",
            };
            let text = format!("Ground station lost, {done}");
            self.out.say(MavSeverity::MAV_SEVERITY_WARNING, &text);
        } else {
            self.out.say(MavSeverity::MAV_SEVERITY_INFO, "Ground station is back");
        }
        match action {
            StationLost::Report => {}
            StationLost::Stop => {
                self.lost_request = self.out.request(CoreRequest::GroundStationLost(lost));
            }
            StationLost::Return if lost => {
                if let Some(home) = self.home {
                    self.commander.set_mode(Mode::Return);
                    let goto = CoreRequest::Goto { point: home.position, through_known: true };
                    self.lost_request = self.out.request(goto);
                }
            }
            StationLost::Return => {}
        }
    }
}
