//! What a log is about: everything that a drive depends on besides its inputs.

use serde::{Deserialize, Serialize};

use super::entry::EntryError;
use crate::frames::{Point, Pose};
use crate::params::{Params, keys, toml_text};
use crate::time::Instant;

/// Version of what the entries mean. A log of another one is refused.
pub const FORMAT: u32 = 1;

/// Who wrote a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// `apexd sil`.
    Sil,
    /// `apexd run`.
    Run,
}

/// What begins every part of a log.
#[derive(Clone, Debug, PartialEq)]
pub struct Header {
    /// Version of the program.
    pub build: String,
    /// Who wrote it.
    pub source: Source,
    /// When it was begun by the clock on the wall, for people.
    pub begun_utc: String,
    /// What the core's clock showed when it was made.
    pub made: Instant,
    /// Where the car stood then, map frame.
    pub start: Pose,
    /// Where it was to go by the command line, for people; the core is told by a command.
    pub goal: Option<Point>,
    /// Seed of the random predictor.
    pub seed: u64,
    /// All parameters, TOML.
    pub params: String,
    /// SHA-256 of the network in use, hexadecimal; empty without one.
    pub network: String,
    /// Which part of the log this is, from 1 up.
    pub part: u32,
}

/// As it is written: numbers as texts, which no reader of JSON rounds.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    format: u32,
    build: String,
    source: Source,
    begun_utc: String,
    made_ns: String,
    start: [String; 3],
    goal: Option<[String; 2]>,
    seed: String,
    network_sha256: String,
    part: u32,
    params: String,
}

impl Header {
    pub(super) fn encode(&self, out: &mut Vec<u8>) {
        let Pose { position, heading_rad } = self.start;
        let written = Written {
            format: FORMAT,
            build: self.build.clone(),
            source: self.source,
            begun_utc: self.begun_utc.clone(),
            made_ns: self.made.as_nanos().to_string(),
            start: [position.x, position.y, heading_rad].map(|v| v.to_string()),
            goal: self.goal.map(|goal| [goal.x, goal.y].map(|v| v.to_string())),
            seed: self.seed.to_string(),
            network_sha256: self.network.clone(),
            part: self.part,
            params: self.params.clone(),
        };
        serde_json::to_writer(out, &written).expect("a header is plain data");
    }

    pub(super) fn decode(data: &[u8]) -> Result<Self, EntryError> {
        /// Read first: another version may have other fields.
        #[derive(Deserialize)]
        struct Version {
            format: u32,
        }
        let nonsense = |what: &dyn std::fmt::Display| {
            EntryError::Nonsense(format!("a header that makes no sense: {what}"))
        };
        let bad = |error: serde_json::Error| nonsense(&error);
        let Version { format } = serde_json::from_slice(data).map_err(bad)?;
        if format != FORMAT {
            return Err(EntryError::Version(format));
        }
        let written: Written = serde_json::from_slice(data).map_err(bad)?;
        let number = |text: &str| {
            let number: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite());
            number.ok_or_else(|| nonsense(&format!("{text:?} for a number")))
        };
        let whole = |text: &str| {
            text.parse::<u64>().map_err(|_| nonsense(&format!("{text:?} for a whole number")))
        };
        let [x, y, heading] = &written.start;
        let start = Pose::new(number(x)?, number(y)?, number(heading)?);
        let goal = match &written.goal {
            Some([x, y]) => Some(Point::new(number(x)?, number(y)?)),
            None => None,
        };
        Ok(Self {
            build: written.build,
            source: written.source,
            begun_utc: written.begun_utc,
            made: Instant::from_nanos(whole(&written.made_ns)?),
            start,
            goal,
            seed: whole(&written.seed)?,
            params: written.params,
            network: written.network_sha256,
            part: written.part,
        })
    }
}

/// All parameters as a header has them: in a form that gives back every number to the last bit.
pub fn params_text(params: &Params) -> String {
    let value = |key: String| {
        let value = params.get(&key).expect("every key has a value");
        (key, value)
    };
    toml_text(&keys().into_iter().map(value).collect())
}
