//! The YAML half of a map.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde_norway::Value;

use super::{MapFile, MapFileError};
use crate::frames::Pose;

/// How a pixel becomes an occupancy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mode {
    /// Darkness against two thresholds.
    Trinary,
    /// The same here: what lies between the thresholds is unknown.
    Scale,
    /// The pixel value is the occupancy in per cent; above 100 unknown.
    Raw,
}

/// What the YAML file says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Metadata {
    pub image: PathBuf,
    pub resolution_m: f64,
    pub origin: Pose,
    pub negate: bool,
    pub occupied_thresh: f64,
    pub free_thresh: f64,
    pub mode: Mode,
}

/// A millimetre to ten metres: wide of every map in use, narrow enough to notice a wrong unit.
pub(super) const RESOLUTION_ALLOWED: &str = "a number of metres from 0.001 to 10";
const IMAGE_ALLOWED: &str = "the name of a PNG or PGM picture, relative to this file";
const ORIGIN_ALLOWED: &str =
    "a list of three numbers [x, y, yaw] in metres (up to 1e6) and radians";
const NEGATE_ALLOWED: &str = "0 or 1";
const THRESHOLD_ALLOWED: &str = "a number from 0 to 1";
const MODE_ALLOWED: &str = "trinary, scale or raw";

pub(super) fn resolution_is_allowed(resolution_m: f64) -> bool {
    (0.001..=10.0).contains(&resolution_m)
}

/// Reads the text of the YAML file at `path`.
pub(super) fn parse(path: &Path, text: &str) -> Result<Metadata, MapFileError> {
    let not_a_map = |reason: String| MapFileError::NotAMap { path: path.to_owned(), reason };
    if text.trim().is_empty() {
        return Err(not_a_map("it is empty".into()));
    }
    let document: Value = serde_norway::from_str(text).map_err(|e| not_a_map(e.to_string()))?;
    let Value::Mapping(keys) = document else {
        return Err(not_a_map("it has no keys".into()));
    };
    if !["image", "resolution", "origin"].iter().any(|key| keys.contains_key(*key)) {
        return Err(not_a_map("it has none of the keys of a map".into()));
    }
    let invalid = |key, value: &Value, allowed| MapFileError::Invalid {
        path: path.to_owned(),
        key,
        value: shown(value),
        allowed,
    };
    let required = |key, allowed| match keys.get(key) {
        None | Some(Value::Null) => {
            Err(MapFileError::Missing { path: path.to_owned(), key, allowed })
        }
        Some(value) => Ok(value),
    };
    let threshold = |key, default| match keys.get(key) {
        None => Ok(default),
        Some(value) => number(value)
            .filter(|t| (0.0..=1.0).contains(t))
            .ok_or_else(|| invalid(key, value, THRESHOLD_ALLOWED)),
    };

    let image = required("image", IMAGE_ALLOWED)?;
    let image = match image {
        Value::String(name) if !name.is_empty() => PathBuf::from(name),
        other => return Err(invalid("image", other, IMAGE_ALLOWED)),
    };
    let resolution = required("resolution", RESOLUTION_ALLOWED)?;
    let resolution_m = number(resolution)
        .filter(|r| resolution_is_allowed(*r))
        .ok_or_else(|| invalid("resolution", resolution, RESOLUTION_ALLOWED))?;
    let origin = required("origin", ORIGIN_ALLOWED)?;
    let origin = pose(origin).ok_or_else(|| invalid("origin", origin, ORIGIN_ALLOWED))?;
    let negate = match keys.get("negate") {
        None => false,
        Some(Value::Bool(negate)) => *negate,
        Some(value) => match number(value) {
            Some(0.0) => false,
            Some(1.0) => true,
            _ => return Err(invalid("negate", value, NEGATE_ALLOWED)),
        },
    };
    let occupied_thresh = threshold("occupied_thresh", 0.65)?;
    let free_thresh = threshold("free_thresh", 0.196)?;
    if free_thresh > occupied_thresh {
        return Err(MapFileError::Invalid {
            path: path.to_owned(),
            key: "free_thresh",
            value: format!("{free_thresh} and occupied_thresh is {occupied_thresh}"),
            allowed: "at most occupied_thresh",
        });
    }
    let mode = match keys.get("mode") {
        None => Mode::Trinary,
        Some(value) => match value.as_str() {
            Some("trinary") => Mode::Trinary,
            Some("scale") => Mode::Scale,
            Some("raw") => Mode::Raw,
            _ => return Err(invalid("mode", value, MODE_ALLOWED)),
        },
    };
    Ok(Metadata { image, resolution_m, origin, negate, occupied_thresh, free_thresh, mode })
}

/// The YAML file of a map whose picture is called `image`.
pub(super) fn text(map: &MapFile, image: &str) -> String {
    // Never in exponent form: PyYAML takes `1e-7` for a text.
    let real = |v: f64| {
        let text = v.to_string();
        if text.contains('.') { text } else { text + ".0" }
    };
    let mut text = String::new();
    // JSON strings are YAML strings, and quoting keeps a name like `no.pgm: x` one.
    let image = Value::String(image.to_owned());
    let image = serde_json::to_string(&image).expect("a text has a JSON form");
    let Pose { position, heading_rad } = map.origin;
    writeln!(text, "image: {image}").expect("a String takes every write");
    writeln!(text, "resolution: {}", real(map.resolution_m)).expect("a String takes every write");
    writeln!(text, "origin: [{}, {}, {}]", real(position.x), real(position.y), real(heading_rad))
        .expect("a String takes every write");
    text + "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\nmode: trinary\n"
}

/// A number, also one in quotes (map_server's own YAML reader makes no difference).
fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Number(n) => n.as_f64(),
        Value::String(text) => text.trim().parse().ok(),
        _ => None,
    }
}

fn pose(value: &Value) -> Option<Pose> {
    let [x, y, yaw] = value.as_sequence()?.as_slice() else { return None };
    let (x, y, yaw) = (number(x)?, number(y)?, number(yaw)?);
    // Beyond a million metres a double no longer resolves a tenth of a nanometre, and no map frame
    // is that far from its map.
    let near = |v: f64| v.abs() <= 1e6;
    (near(x) && near(y) && near(yaw)).then(|| Pose::new(x, y, yaw))
}

/// A value on one line and not too long, for a message.
fn shown(value: &Value) -> String {
    const LENGTH_MAX: usize = 60;
    let text = serde_json::to_string(value).unwrap_or_else(|_| format!("{value:?}"));
    // JSON has no word for these and writes null.
    let text = match value {
        Value::Number(n) => n.to_string(),
        _ => text,
    };
    if text.chars().count() <= LENGTH_MAX {
        return text;
    }
    text.chars().take(LENGTH_MAX).chain("...".chars()).collect()
}
