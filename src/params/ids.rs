//! The short names that ground stations know parameters by: at most sixteen characters.
//!
//! A name depends on nothing but the parameter's own section and name, so that it stays when others
//! come and go: the section's abbreviation, then the name without its unit, with vowels inside words
//! left out from the end on until it fits. Two names that come out the same get one from a table.

use super::Params;
use crate::tunable::Allowed;

/// The most characters of a name.
pub const ID_LENGTH: usize = 16;

/// Abbreviations of sections; the first four letters stand for one that is not listed.
const SECTIONS: &[(&str, &str)] = &[
    ("vehicle", "VEH"),
    ("autopilot", "AP"),
    ("predict", "PRED"),
    ("search", "SRCH"),
    ("manoeuvre", "MAN"),
    ("smooth", "SMO"),
    ("speed", "SPD"),
    ("control", "CTL"),
    ("guard", "GRD"),
    ("daemon", "DMN"),
    ("controller", "ECU"),
    ("lidar", "LID"),
    ("mavlink", "MAV"),
];

/// Names that the rule gives to two parameters, or makes unreadable.
const NAMES: &[(&str, &str)] = &[
    ("autopilot.bus_errors_max_ps", "AP_BUS_ERR_MAX"),
    ("autopilot.tracking_error_max_m", "AP_TRACK_ERR_MAX"),
    ("car.odometry_rate_hz", "CAR_ODO_RATE"),
    ("control.lateral_settle_s", "CTL_LAT_SETTLE"),
    ("control.lateral_settle_min_m", "CTL_LAT_SETT_MIN"),
    ("controller.tail_offset_max_m", "ECU_TAIL_OFF_MAX"),
    ("daemon.stop_time_limit_s", "DMN_STOP_LIMIT"),
    ("guard.drive_jerk_max_mps3", "GRD_DRV_JERK_MAX"),
    ("guard.lateral_jerk_max_mps3", "GRD_LAT_JERK_MAX"),
    ("guard.odometry_age_max_s", "GRD_ODO_AGE_MAX"),
    ("mavlink.origin_altitude_m", "MAV_ORIG_ALT"),
    ("mavlink.origin_known", "MAV_ORIG_KNOWN"),
    ("mavlink.origin_latitude_deg", "MAV_ORIG_LAT"),
    ("mavlink.origin_longitude_deg", "MAV_ORIG_LON"),
    ("plan.unknown_room_m", "PLAN_UNKN_ROOM"),
    ("smooth.bubble_radius_max_m", "SMO_BUB_RAD_MAX"),
];

/// Suffixes of names that say nothing but the unit, longest first.
const UNITS: &[&str] = &[
    "_mps3", "_mps2", "_mps", "_rad", "_deg", "_bps", "_pm", "_hz", "_kg", "_mb", "_ms", "_m",
    "_s", "_v", "_n",
];

/// The name of `section.name`, if ground stations can be told its value at all: texts do not fit.
pub fn id_of(section: &str, name: &str, allowed: &Allowed) -> Option<String> {
    if matches!(allowed, Allowed::Text) {
        return None;
    }
    let full = format!("{section}.{name}");
    if let Some((_, id)) = NAMES.iter().find(|(key, _)| *key == full) {
        return Some((*id).to_owned());
    }
    let short = SECTIONS.iter().find(|(long, _)| *long == section);
    let prefix = short.map_or_else(|| section.chars().take(4).collect(), |(_, s)| (*s).to_owned());
    let bare = UNITS.iter().find_map(|unit| name.strip_suffix(unit)).unwrap_or(name);
    let mut id = format!("{prefix}_{bare}").to_uppercase();
    // Vowels go from the end on; the first letter of every word stays.
    let mut at = id.len();
    while id.len() > ID_LENGTH && at > prefix.len() + 2 {
        at -= 1;
        let bytes = id.as_bytes();
        if b"AEIOU".contains(&bytes[at]) && bytes[at - 1] != b'_' {
            id.remove(at);
        }
    }
    id.truncate(ID_LENGTH);
    Some(id)
}

/// Every name with its `section.name`, in order of declaration.
pub fn ids() -> Vec<(String, String)> {
    let table = Params::table();
    let of = |section: &super::SectionTable| {
        let named = |row: &crate::tunable::Tunable| {
            let id = id_of(section.name, row.name, &row.allowed)?;
            Some((id, format!("{}.{}", section.name, row.name)))
        };
        section.rows.iter().filter_map(named).collect::<Vec<_>>()
    };
    table.iter().flat_map(of).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    #[test]
    fn no_two_parameters_share_a_name_and_every_name_fits() {
        let mut seen = BTreeMap::new();
        for (id, key) in ids() {
            assert!((1..=ID_LENGTH).contains(&id.len()), "{key}: {id}");
            assert!(id.bytes().all(|b| b.is_ascii_uppercase() || b.is_ascii_digit() || b == b'_'));
            if let Some(other) = seen.insert(id.clone(), key.clone()) {
                panic!("{key} and {other} are both called {id}");
            }
        }
        assert!(seen.len() > 50);
    }

    #[test]
    fn every_name_of_the_table_is_one_of_a_parameter() {
        for (key, _) in NAMES {
            assert!(super::super::row(key).is_some(), "{key}");
        }
        for (section, _) in SECTIONS {
            assert!(Params::table().iter().any(|table| table.name == *section), "{section}");
        }
    }

    #[test]
    fn a_name_is_made_of_section_and_name_and_shortened_only_where_it_must_be() {
        let id = |key: &str| {
            let (section, name) = key.split_once('.').unwrap();
            id_of(section, name, &Allowed::Bool).unwrap()
        };
        assert_eq!(id("speed.speed_max_mps"), "SPD_SPEED_MAX");
        assert_eq!(id("vehicle.turn_radius_m"), "VEH_TURN_RADIUS");
        assert_eq!(id("manoeuvre.curvature_share"), "MAN_CURVATUR_SHR");
        assert_eq!(id("control.lateral_settle_min_m"), "CTL_LAT_SETT_MIN");
        assert_eq!(id_of("predict", "model", &Allowed::Text), None);
    }
}
