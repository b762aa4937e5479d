//! Component metadata: what a ground station reads to show parameters with their texts, units and
//! limits. The form is that of the schemas in MAVLink's `component_metadata` folder.

use serde_json::{Map, Value as Json, json};

use super::parameters::type_of;
use crate::params::{Params, id_of};
use crate::tunable::{Allowed, Change, Tunable, Value};
use crate::wire::mavlink::common::{CompMetadataType, MavParamType};

/// Where the general file is.
pub const METADATA_PATH: &str = "general.json";
/// Where the parameters are.
const PARAMETERS_PATH: &str = "parameters.json";
/// A short text is no longer than this.
const SHORT: usize = 80;

/// The files.
#[derive(Clone, Debug, PartialEq)]
pub struct Metadata {
    /// Name and contents of each.
    pub files: Vec<(&'static str, Vec<u8>)>,
}

impl Default for Metadata {
    fn default() -> Self {
        let parameters = parameters().to_string().into_bytes();
        let general = json!({
            "version": 1,
            "metadataTypes": [{
                "type": CompMetadataType::COMP_METADATA_TYPE_PARAMETER as u32,
                "uri": format!("mftp:///{PARAMETERS_PATH}"),
                "fileCrc": crc32(&parameters),
            }],
        });
        let general = general.to_string().into_bytes();
        Self { files: vec![(METADATA_PATH, general), (PARAMETERS_PATH, parameters)] }
    }
}

impl Metadata {
    /// The general file's address.
    pub fn uri() -> String {
        format!("mftp:///{METADATA_PATH}")
    }

    /// The general file's checksum.
    pub fn crc(&self) -> u32 {
        crc32(&self.files[0].1)
    }
}

/// The checksum of MAVLink's files: like that of Ethernet, but nothing is inverted.
pub fn crc32(bytes: &[u8]) -> u32 {
    let mut digest = Crc::default();
    digest.update(bytes);
    digest.finish()
}

static CRC: crc::Crc<u32> = crc::Crc::<u32>::new(&crc::Algorithm {
    width: 32,
    poly: 0x04C1_1DB7,
    init: 0,
    refin: true,
    refout: true,
    xorout: 0,
    check: 0x2DFD_2D88,
    residue: 0,
});

/// That checksum, piece by piece.
pub struct Crc(crc::Digest<'static, u32>);

impl Default for Crc {
    fn default() -> Self {
        Self(CRC.digest())
    }
}

impl Crc {
    /// Takes in more.
    pub fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// The checksum of all that was taken in.
    pub fn finish(self) -> u32 {
        self.0.finalize()
    }
}

fn parameters() -> Json {
    let mut rows = Vec::new();
    for section in Params::table() {
        for row in &section.rows {
            if let Some(id) = id_of(section.name, row.name, &row.allowed) {
                rows.push(parameter(id, section.name, row));
            }
        }
    }
    json!({ "version": 1, "parameters": rows })
}

fn parameter(id: String, section: &str, row: &Tunable) -> Json {
    let mut json = Map::new();
    let mut put = |key: &str, value: Json| json.insert(key.to_owned(), value);
    put("name", id.into());
    let real = type_of(row) == MavParamType::MAV_PARAM_TYPE_REAL32;
    put("type", if real { "Float" } else { "Int32" }.into());
    put("shortDesc", short(&format!("{section}.{}: {}", row.name, row.text)).into());
    put("longDesc", row.text.into());
    put("group", section.into());
    put("category", "Standard".into());
    put("rebootRequired", (row.change == Change::Restart).into());
    if !row.unit.is_empty() {
        put("units", row.unit.into());
    }
    put("default", number(&row.default, row));
    match row.allowed {
        Allowed::Real(min, max) => {
            put("min", min.into());
            put("max", max.into());
            put("decimalPlaces", decimals(min, max, &row.default).into());
        }
        Allowed::Integer(min, max) => {
            put("min", min.into());
            put("max", max.into());
        }
        Allowed::Bool => {
            put("min", 0.into());
            put("max", 1.into());
            put(
                "values",
                json!([
                    { "value": 0, "description": "no" },
                    { "value": 1, "description": "yes" },
                ]),
            );
        }
        Allowed::Choice(names) => {
            let value = |(at, name): (usize, &&str)| json!({ "value": at, "description": name });
            put("min", 0.into());
            put("max", (names.len() - 1).into());
            put("values", names.iter().enumerate().map(value).collect());
        }
        Allowed::Text => {}
    }
    Json::Object(json)
}

/// A value as a number.
fn number(value: &Value, row: &Tunable) -> Json {
    match value {
        Value::Real(v) => (*v).into(),
        Value::Integer(v) => (*v).into(),
        Value::Bool(v) => i64::from(*v).into(),
        Value::Text(text) => match row.allowed {
            Allowed::Choice(names) => names.iter().position(|name| name == text).into(),
            _ => Json::Null,
        },
    }
}

/// Digits behind the point that tell the limits and the default apart from their neighbours.
fn decimals(min: f64, max: f64, default: &Value) -> usize {
    let default = if let Value::Real(v) = default { *v } else { 0.0 };
    let digits = |v: f64| {
        let text = format!("{v}");
        text.split_once('.').map_or(0, |(_, behind)| behind.len())
    };
    [min, max, default].map(digits).into_iter().max().map_or(3, |most| (most + 1).clamp(2, 7))
}

/// The beginning of a text, up to a whole word.
fn short(text: &str) -> String {
    if text.chars().count() <= SHORT {
        return text.to_owned();
    }
    let mut out = String::new();
    for word in text.split_whitespace() {
        if out.chars().count() + word.chars().count() + 4 > SHORT {
            break;
        }
        if !out.is_empty() {
            out.push(' ');
        }
        out.push_str(word);
    }
    out + "..."
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_the_one_of_mavlinks_files() {
        // From zlib: crc32(b"123456789", 0xFFFFFFFF) ^ 0xFFFFFFFF.
        assert_eq!(crc32(b"123456789"), 0x2DFD_2D88);
        assert_eq!(crc32(b""), 0);
    }

    #[test]
    fn every_number_of_the_table_is_described() {
        let files = Metadata::default().files;
        let general: Json = serde_json::from_slice(&files[0].1).unwrap();
        let crc = &general["metadataTypes"][0]["fileCrc"];
        assert_eq!(crc.as_u64(), Some(crc32(&files[1].1).into()));
        let parameters: Json = serde_json::from_slice(&files[1].1).unwrap();
        let rows = parameters["parameters"].as_array().unwrap();
        assert_eq!(rows.len(), crate::params::ids().len());
        for row in rows {
            let number = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key} of {row}"));
            assert!(number("min") <= number("default") && number("default") <= number("max"));
            assert!(row["shortDesc"].as_str().unwrap().chars().count() <= SHORT, "{row}");
        }
        let policy = rows.iter().find(|row| row["name"] == "PLAN_POLICY").unwrap();
        assert_eq!(policy["values"][1]["description"], "frontier");
    }
}
