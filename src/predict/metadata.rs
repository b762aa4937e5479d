//! What a network's file says about itself, and whether that fits this program.

use std::collections::BTreeMap;

use super::lattice::{CROP_CELLS, ContextSelection};
use super::model_error::ModelError;
use super::trust::Calibration;

/// The version of the agreement between training and this program.
const FORMAT_VERSION: &str = "1";
/// The frame of `context` and `target`.
const FRAME: &str = "robot-cell";

/// What a network's file says about itself.
#[derive(Clone, Debug, PartialEq)]
pub struct Metadata {
    /// Name of the architecture, for people.
    pub architecture: String,
    /// Side of the coarse cells that the network was trained on, metres.
    pub resolution_m: f64,
    /// Lidar ranges of the training scenes, metres.
    pub lidar_ranges_m: Vec<f64>,
    /// How far from the frontier the network was trained to predict, metres.
    pub prediction_range_m: f64,
    /// Which observed cells it is given.
    pub context: ContextSelection,
    /// SHA-256 of the manifests of the data it was trained on, comma-separated.
    pub trained_on: String,
    /// The kind of world that it is for, if it says so.
    pub world: Option<String>,
    /// Its calibration, if it has one.
    pub calibration: Option<Calibration>,
    /// All entries of the file, by key, for people.
    pub entries: Vec<(String, String)>,
}

impl Metadata {
    /// Reads and checks the entries of a file.
    pub(super) fn parse(entries: &BTreeMap<&str, &str>) -> Result<Self, ModelError> {
        let fixed = |key: &'static str, allowed: &str| {
            let wanted = || format!("{allowed:?}");
            let value = required(entries, key, wanted)?;
            if value == allowed { Ok(()) } else { Err(bad(key, value, wanted())) }
        };
        fixed("format_version", FORMAT_VERSION)?;
        fixed("frame", FRAME)?;
        fixed("crop_cells", &CROP_CELLS.to_string())?;
        // Work that a network leaves to its caller. None is known so far.
        for key in ["preprocessing", "postprocessing"] {
            if let Some(value) = entries.get(key).filter(|v| !matches!(**v, "" | "none")) {
                return Err(bad(key, value, "none; such steps belong into the graph".into()));
            }
        }
        let architecture = required(entries, "architecture", || "a name".into())?;
        if architecture.trim().is_empty() {
            return Err(bad("architecture", architecture, "a name".into()));
        }
        let context = required(entries, "context", context_names)?;
        let context = ContextSelection::from_name(context)
            .ok_or_else(|| bad("context", context, context_names()))?;
        let trained_on = required(entries, "trained_on", || HASH_WANTED.into())?;
        let is_hash = |part: &str| part.len() == 64 && part.bytes().all(|b| b.is_ascii_hexdigit());
        if !trained_on.split(',').all(|part| is_hash(part.trim())) {
            return Err(bad("trained_on", trained_on, HASH_WANTED.into()));
        }
        let calibration = match entries.get("calibration") {
            None => None,
            Some(text) => {
                Calibration::parse(text).map_err(|wanted| bad("calibration", text, wanted))?
            }
        };
        Ok(Self {
            architecture: architecture.to_owned(),
            resolution_m: length(entries, "resolution_m", 0.02, 2.0)?,
            lidar_ranges_m: lengths(entries, "lidar_range_m", 0.1, 200.0)?,
            prediction_range_m: length(entries, "prediction_range_m", 0.1, 100.0)?,
            context,
            trained_on: trained_on.to_owned(),
            world: entries.get("world").map(|world| (*world).to_owned()),
            calibration,
            entries: entries.iter().map(|(k, v)| ((*k).to_owned(), (*v).to_owned())).collect(),
        })
    }
}

const HASH_WANTED: &str = "the SHA-256 of the training data's manifest (64 hexadecimal digits)";

fn context_names() -> String {
    let names = [ContextSelection::All, ContextSelection::WallsAndFrontier].map(|c| c.name());
    format!("one of {}", names.join(", "))
}

fn required<'a>(
    entries: &BTreeMap<&str, &'a str>,
    key: &'static str,
    wanted: impl FnOnce() -> String,
) -> Result<&'a str, ModelError> {
    let value = entries.get(key).copied();
    value.ok_or_else(|| ModelError::MissingMetadata { key, wanted: wanted() })
}

fn bad(key: &'static str, value: &str, wanted: String) -> ModelError {
    const SHOWN_MAX: usize = 80;
    let shown: String = value.chars().take(SHOWN_MAX).collect();
    let value = if shown.len() < value.len() { format!("{shown}...") } else { shown };
    ModelError::BadMetadata { key, value, wanted }
}

fn length(
    entries: &BTreeMap<&str, &str>,
    key: &'static str,
    low: f64,
    high: f64,
) -> Result<f64, ModelError> {
    let values = lengths(entries, key, low, high)?;
    match values[..] {
        [value] => Ok(value),
        _ => Err(bad(key, entries[key], format!("one number of metres from {low} to {high}"))),
    }
}

fn lengths(
    entries: &BTreeMap<&str, &str>,
    key: &'static str,
    low: f64,
    high: f64,
) -> Result<Vec<f64>, ModelError> {
    let wanted = || format!("metres from {low} to {high}");
    let text = required(entries, key, wanted)?;
    let parse = |part: &str| part.trim().parse::<f64>().ok().filter(|v| (low..=high).contains(v));
    let values: Option<Vec<f64>> = text.split(',').map(parse).collect();
    values.ok_or_else(|| bad(key, text, wanted()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entries() -> BTreeMap<&'static str, &'static str> {
        BTreeMap::from([
            ("format_version", "1"),
            ("architecture", "convcnp"),
            ("frame", "robot-cell"),
            ("resolution_m", "0.25"),
            ("crop_cells", "104"),
            ("lidar_range_m", "5, 7.5"),
            ("prediction_range_m", "5"),
            ("context", "all"),
            ("trained_on", "00112233445566778899aabbccddeeff00112233445566778899aabbccddeeff"),
        ])
    }

    #[test]
    fn what_fits_is_read() {
        let metadata = Metadata::parse(&entries()).unwrap();
        assert_eq!(metadata.lidar_ranges_m, [5.0, 7.5]);
        assert_eq!((metadata.resolution_m, metadata.prediction_range_m), (0.25, 5.0));
        assert_eq!(metadata.context, ContextSelection::All);
        assert_eq!(metadata.calibration, None);
        assert_eq!(metadata.world, None);
    }

    #[test]
    fn every_missing_entry_is_named_with_what_is_wanted() {
        for key in entries().into_keys() {
            let mut entries = entries();
            entries.remove(key);
            let error = Metadata::parse(&entries).unwrap_err();
            let ModelError::MissingMetadata { key: named, wanted } = &error else {
                panic!("{error}");
            };
            assert_eq!(*named, key);
            assert!(!wanted.is_empty() && error.to_string().contains(wanted), "{error}");
        }
    }

    #[test]
    fn every_entry_that_does_not_fit_is_refused_with_what_is_allowed() {
        for (key, value, allowed) in [
            ("format_version", "2", "\"1\""),
            ("frame", "map", "\"robot-cell\""),
            ("crop_cells", "64", "\"104\""),
            ("resolution_m", "0", "from 0.02 to 2"),
            ("resolution_m", "nan", "from 0.02 to 2"),
            ("resolution_m", "0.25,0.5", "one number"),
            ("resolution_m", "a quarter", "from 0.02 to 2"),
            ("lidar_range_m", "5,,7", "from 0.1 to 200"),
            ("lidar_range_m", "-5", "from 0.1 to 200"),
            ("prediction_range_m", "1e9", "from 0.1 to 100"),
            ("context", "walls", "one of all, walls-and-frontier"),
            ("architecture", " ", "a name"),
            ("trained_on", "yesterday", "SHA-256"),
            ("preprocessing", "rotate", "belong into the graph"),
            ("postprocessing", "temperature", "belong into the graph"),
            ("calibration", "{", "JSON"),
        ] {
            let mut entries = entries();
            entries.insert(key, value);
            let error = Metadata::parse(&entries).unwrap_err();
            let ModelError::BadMetadata { key: named, value: found, wanted } = &error else {
                panic!("{key}: {error}");
            };
            assert_eq!((*named, found.as_str()), (key, value));
            assert!(wanted.contains(allowed), "{key}: {error}");
        }
    }

    #[test]
    fn a_long_value_is_shown_in_part() {
        let mut entries = entries();
        let long = "x".repeat(1000);
        entries.insert("frame", &long);
        assert!(Metadata::parse(&entries).unwrap_err().to_string().len() < 200);
    }
}
