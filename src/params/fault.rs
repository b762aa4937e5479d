//! What can be wrong with a configuration, said so that it can be put right without a manual.

use std::fmt;

use super::{Params, keys};
use crate::tunable::TunableError;

/// Who gave a value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A configuration file.
    File {
        /// Its name as the user gave it.
        name: String,
        /// Line of the parameter, from 1.
        line: Option<usize>,
    },
    /// What a ground station set, as it was kept.
    Kept {
        /// Its file.
        name: String,
    },
    /// An environment variable.
    Environment {
        /// Its name.
        variable: String,
    },
    /// `--set` on the command line.
    Set {
        /// The assignment as the user gave it.
        assignment: String,
    },
    /// An option of its own on the command line.
    Flag {
        /// The option, with its dashes.
        flag: String,
    },
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { name, line: Some(line) } => write!(f, "{name}:{line}"),
            Self::File { name, line: None } => write!(f, "{name}"),
            Self::Kept { name } => write!(f, "{name}"),
            Self::Environment { variable } => write!(f, "environment variable {variable}"),
            Self::Set { assignment } => write!(f, "--set {assignment}"),
            Self::Flag { flag } => write!(f, "{flag}"),
        }
    }
}

/// What is wrong with one value.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Problem {
    /// The file cannot be opened or is not text.
    #[error("cannot be read: {0}")]
    Unreadable(String),
    /// The file is not TOML.
    #[error("is not valid TOML: {0}")]
    Syntax(String),
    /// No section has this name.
    #[error("no such section; did you mean [{nearest}]? Known: {}", section_names())]
    UnknownSection {
        /// The known section with the most similar name.
        nearest: String,
    },
    /// No parameter has this name.
    #[error("no such parameter; did you mean {nearest}?")]
    UnknownKey {
        /// The known parameter with the most similar name, with its section.
        nearest: String,
    },
    /// A parameter stands outside its section.
    #[error("stands outside any section; did you mean {nearest}?")]
    OutsideSection {
        /// The known parameter with the most similar name, with its section.
        nearest: String,
    },
    /// A section is given as a single value.
    #[error("is a section; give its parameters one by one")]
    IsSection,
    /// A short name that several sections have.
    #[error("is the name of several parameters; write one of {}", .candidates.join(", "))]
    Ambiguous {
        /// The parameters with this name, with their sections.
        candidates: Vec<String>,
    },
    /// `--set` without a value.
    #[error("must have the form section.key=value")]
    NoAssignment,
    /// The value is of the wrong kind or out of range.
    #[error("{0}")]
    Value(#[from] TunableError),
    /// The value is a list, a table or another thing that no parameter can hold.
    #[error("is {value}, but must be {wanted}")]
    Kind {
        /// What the value is, in words.
        value: String,
        /// What is wanted, in words.
        wanted: String,
    },
    /// The environment variable is not UTF-8.
    #[error("is not valid UTF-8")]
    NotUnicode,
}

fn section_names() -> String {
    let names: Vec<&str> = Params::table().iter().map(|section| section.name).collect();
    names.join(", ")
}

/// One thing that is wrong, and where.
#[derive(Clone, Debug, PartialEq)]
pub struct Fault {
    /// Who said so.
    pub origin: Origin,
    /// The parameter or section as the user wrote it; empty if the whole source is at fault.
    pub key: String,
    /// What is wrong.
    pub problem: Problem,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { origin, key, problem } = self;
        match problem {
            Problem::Value(TunableError::WrongType { .. } | TunableError::OutOfRange { .. })
            | Problem::Kind { .. }
            | Problem::OutsideSection { .. }
            | Problem::IsSection
            | Problem::Ambiguous { .. } => write!(f, "{origin}: {key} {problem}"),
            _ if key.is_empty() => write!(f, "{origin}: {problem}"),
            _ => write!(f, "{origin}: {key}: {problem}"),
        }
    }
}

/// Everything that is wrong with a configuration, in the order in which it was given.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Faults(pub Vec<Fault>);

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, fault) in self.0.iter().enumerate() {
            if i > 0 {
                writeln!(f)?;
            }
            write!(f, "{fault}")?;
        }
        Ok(())
    }
}

impl std::error::Error for Faults {}

/// The known section most like `name`.
pub(super) fn nearest_section(name: &str) -> String {
    let table = Params::table();
    let names = table.iter().map(|section| section.name.to_owned());
    most_alike(names, |candidate| alike(name, candidate))
}

/// The known `section.key` most like `name` in `section`.
pub(super) fn nearest_key(section: &str, name: &str) -> String {
    nearest_of(keys(), section, name)
}

/// The key most like `name` in `section`: the same section counts for something, the same name in
/// another section for more.
fn nearest_of(keys: Vec<String>, section: &str, name: &str) -> String {
    const SAME_SECTION: f64 = 0.2;
    most_alike(keys.into_iter(), |key| {
        let (its_section, its_name) = key.split_once('.').expect("keys have the form section.name");
        alike(name, its_name) + if its_section == section { SAME_SECTION } else { 0.0 }
    })
}

fn alike(a: &str, b: &str) -> f64 {
    strsim::normalized_damerau_levenshtein(&a.to_lowercase(), b)
}

/// The first of the best.
fn most_alike(names: impl Iterator<Item = String>, score: impl Fn(&str) -> f64) -> String {
    let mut best = (f64::NEG_INFINITY, String::new());
    for name in names {
        let its = score(&name);
        if its > best.0 {
            best = (its, name);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_name_is_the_one_meant() {
        for (section, given, nearest) in [
            ("", "mass", "vehicle.mass_kg"),
            ("", "turnradius_m", "vehicle.turn_radius_m"),
            ("vehicle", "wheel_base_m", "vehicle.wheelbase_m"),
            ("vehicle", "Friction", "vehicle.friction"),
            ("vehicle", "speed_max_mps", "speed.speed_max_mps"),
            ("car", "mas_kg", "car.mass_kg"),
            ("vehicle", "mas_kg", "vehicle.mass_kg"),
        ] {
            let keys = [
                "vehicle.mass_kg",
                "vehicle.friction",
                "vehicle.turn_radius_m",
                "vehicle.radius_m",
                "vehicle.wheelbase_m",
                "speed.speed_max_mps",
                "car.mass_kg",
            ];
            let keys = keys.map(str::to_owned).to_vec();
            assert_eq!(nearest_of(keys, section, given), nearest, "{section}.{given}");
        }
    }
}
