//! Where ground stations have said that the map lies and that home is, kept over a restart.

use serde::{Deserialize, Serialize};

use super::outbox::To;
use super::service::Keeper;
use super::settings::MavlinkParams;
use super::wanted::Denial;
use super::{Ground, Home, places, telemetry};
use crate::frames::Point;
use crate::time::Instant;
use crate::wire::mavlink::common::{self as c, MavSeverity};
use crate::wire::mavlink::{Geodetic, MessageData, Origin};

/// The name under which they are kept.
pub const SAID_PLACES: &str = "places.json";
/// Degrees, and metres of height, that are no difference: text forms round.
const SAME: f64 = 1e-9;

/// What stations have said, and what the configuration said then.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SaidPlaces {
    /// Where the map lies.
    pub origin: Option<Origin>,
    /// Where the car returns to.
    pub home: Option<Home>,
}

#[derive(Debug, Serialize, Deserialize)]
struct Kept {
    /// By a station.
    origin: Option<KeptOrigin>,
    /// By the configuration at that time: once that has been changed, it is the newer word.
    configured_origin: Option<KeptOrigin>,
    home: Option<KeptHome>,
}

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct KeptOrigin {
    latitude_deg: f64,
    longitude_deg: f64,
    altitude_m: f64,
}

#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct KeptHome {
    x_m: f64,
    y_m: f64,
    heading_rad: Option<f64>,
}

impl From<Origin> for KeptOrigin {
    fn from(origin: Origin) -> Self {
        let Geodetic { latitude_deg, longitude_deg } = origin.place;
        Self { latitude_deg, longitude_deg, altitude_m: origin.altitude_m }
    }
}

impl KeptOrigin {
    fn checked(self) -> Result<Origin, String> {
        let place = Geodetic::checked(self.latitude_deg, self.longitude_deg)
            .ok_or("the origin is no place on the earth")?;
        let altitude_m = self.altitude_m;
        places::checked_altitude(altitude_m).map_err(|denial| denial.reason)?;
        Ok(Origin { place, altitude_m })
    }

    fn is(self, other: Self) -> bool {
        let pairs = [
            (self.latitude_deg, other.latitude_deg),
            (self.longitude_deg, other.longitude_deg),
            (self.altitude_m, other.altitude_m),
        ];
        pairs.iter().all(|(a, b)| (a - b).abs() <= SAME)
    }
}

impl SaidPlaces {
    /// To be kept. `configured`: the origin of the configuration.
    pub fn text(&self, configured: Option<Origin>) -> String {
        let home = self.home.map(|home| KeptHome {
            x_m: home.position.x,
            y_m: home.position.y,
            heading_rad: home.heading_rad,
        });
        let kept = Kept {
            origin: self.origin.map(Into::into),
            configured_origin: configured.map(Into::into),
            home,
        };
        serde_json::to_string_pretty(&kept).expect("numbers and names always have a text form")
    }

    /// What was kept, as far as it still holds. `configured`: the origin of the configuration now.
    ///
    /// # Errors
    /// What is wrong with the text, for a person.
    pub fn of_text(text: &str, configured: Option<Origin>) -> Result<Self, String> {
        let kept: Kept = serde_json::from_str(text).map_err(|error| error.to_string())?;
        let same = match (kept.configured_origin, configured) {
            (None, None) => true,
            (Some(then), Some(now)) => then.is(now.into()),
            _ => false,
        };
        let origin = kept.origin.filter(|_| same).map(KeptOrigin::checked).transpose()?;
        let home = kept.home.map(|home| {
            let position = Point::new(home.x_m, home.y_m);
            let heading_rad = home.heading_rad.filter(|heading| heading.is_finite());
            places::in_reach(position)
                .map(|position| Home { position, heading_rad })
                .map_err(|denial| denial.reason)
        });
        Ok(Self { origin, home: home.transpose()? })
    }
}

impl Ground {
    /// Takes up what stations said of origin and home before a restart, a text that `keeper` kept
    /// under [`SAID_PLACES`], and keeps what they will say.
    ///
    /// # Errors
    /// What is wrong with the text; then nothing of it is taken up.
    pub fn keep_places(
        &mut self,
        keeper: Option<Box<dyn Keeper>>,
        kept: Option<&str>,
    ) -> Result<(), String> {
        self.place_keeper = keeper;
        let configured = configured_origin(&self.params);
        let said = kept.map(|text| SaidPlaces::of_text(text, configured)).transpose()?;
        self.said = said.unwrap_or_default();
        self.origin = self.said.origin.or(self.origin);
        self.home = self.said.home.or(self.home);
        Ok(())
    }

    pub(super) fn set_origin(&mut self, now: Instant, data: &c::SET_GPS_GLOBAL_ORIGIN_DATA) {
        let altitude_m = f64::from(data.altitude) * 1e-3;
        let place = Geodetic::from_e7(data.latitude, data.longitude)
            .ok_or_else(|| Denial::denied("no place on the earth"))
            .and_then(|place| places::checked_altitude(altitude_m).map(|()| place));
        match place {
            Ok(place) => {
                self.origin = Some(Origin { place, altitude_m });
                self.keep_said(SaidPlaces { origin: self.origin, ..self.said });
                self.show_places(now);
            }
            Err(denial) => {
                let text = format!("SET_GPS_GLOBAL_ORIGIN refused: {}", denial.reason);
                self.out.say(MavSeverity::MAV_SEVERITY_WARNING, &text);
            }
        }
    }

    /// Stations repeat themselves: only news is written.
    pub(super) fn keep_said(&mut self, said: SaidPlaces) {
        if std::mem::replace(&mut self.said, said) == said {
            return;
        }
        let Some(keeper) = &mut self.place_keeper else { return };
        let text = self.said.text(configured_origin(&self.params));
        if let Err(why) = keeper.keep(SAID_PLACES, &text) {
            let text = format!("Origin and home are in force, but not kept: {why}");
            self.out.say(MavSeverity::MAV_SEVERITY_WARNING, &text);
        }
    }

    /// The origin, to the services.
    pub(super) fn tell_origin(&mut self, now: Instant) {
        if let Some(origin) = &self.origin {
            for service in &mut self.services {
                service.handle_origin(now, origin, &mut self.out);
            }
        }
    }

    /// Origin and home, to everybody.
    pub(super) fn show_places(&mut self, now: Instant) {
        self.tell_origin(now);
        let Some((_, view)) = &self.view else { return };
        let facts = self.facts(view, now);
        let ids = [c::GPS_GLOBAL_ORIGIN_DATA::ID, c::HOME_POSITION_DATA::ID];
        let messages = ids.map(|id| telemetry::messages(id, 0, &facts));
        for message in messages.into_iter().flatten() {
            self.out.send(To::Everyone, message);
        }
    }
}

/// Where the configuration says that the map lies.
pub(super) fn configured_origin(params: &MavlinkParams) -> Option<Origin> {
    let place = Geodetic::checked(params.origin_latitude_deg, params.origin_longitude_deg);
    place
        .filter(|_| params.origin_known)
        .map(|place| Origin { place, altitude_m: params.origin_altitude_m })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn origin(latitude_deg: f64) -> Origin {
        Origin { place: Geodetic { latitude_deg, longitude_deg: 8.545_594_1 }, altitude_m: 488.3 }
    }

    #[test]
    fn what_was_said_reads_back_until_the_configuration_says_something_new() {
        let home = Home { position: Point::new(3.25, -1.5), heading_rad: Some(0.1) };
        let said = SaidPlaces { origin: Some(origin(47.397_742_1)), home: Some(home) };
        for configured in [None, Some(origin(12.345_678_9))] {
            let text = said.text(configured);
            let read = SaidPlaces::of_text(&text, configured).unwrap();
            assert_eq!(read.home, said.home);
            let place = read.origin.unwrap().place;
            assert!((place.latitude_deg - 47.397_742_1).abs() < SAME, "{place:?}");
            let newer = SaidPlaces::of_text(&text, Some(origin(1.0))).unwrap();
            assert_eq!(newer, SaidPlaces { origin: None, home: said.home });
        }
        let nothing = SaidPlaces::default();
        assert_eq!(SaidPlaces::of_text(&nothing.text(None), None), Ok(nothing));
    }

    #[test]
    fn a_text_that_makes_no_sense_is_refused_with_a_reason() {
        let origin = r#"{"latitude_deg": 91, "longitude_deg": 8, "altitude_m": 0}"#;
        let high = r#"{"latitude_deg": 1, "longitude_deg": 8, "altitude_m": 1e9}"#;
        let far = r#"{"x_m": 1e6, "y_m": 0, "heading_rad": null}"#;
        for (origin, home, reason) in [
            (origin, "null", "no place"),
            (high, "null", "height"),
            ("null", far, "allowed is 1000 m"),
            ("7", "null", "invalid type"),
        ] {
            let text =
                format!(r#"{{"origin": {origin}, "configured_origin": null, "home": {home}}}"#);
            let said = SaidPlaces::of_text(&text, None).unwrap_err();
            assert!(said.contains(reason), "{said}");
        }
        assert!(SaidPlaces::of_text("", None).is_err());
    }
}
