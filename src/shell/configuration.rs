//! Reads the layers of the configuration from where they are kept.

use std::ffi::OsString;
use std::path::Path;

use super::shown;
use crate::params::{ENVIRONMENT_PREFIX, Faults, Layers, Params};
use crate::tunable::Value;

/// An option of its own that stands for a parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct Flag {
    /// The option, with its dashes.
    pub option: &'static str,
    /// The parameter, with its section.
    pub key: &'static str,
    /// The value given.
    pub value: Value,
}

/// Defaults, file, environment, `--set` and options, each over the one before.
pub fn load(
    file: Option<&Path>,
    environment: &[(OsString, OsString)],
    set: &[String],
    flags: &[Flag],
) -> Result<Params, Faults> {
    let mut layers = Layers::new();
    if let Some(file) = file {
        read(&mut layers, file);
    }
    let mut texts = Vec::new();
    for (name, value) in environment {
        let shown_name = name.to_string_lossy();
        if !shown_name.starts_with(ENVIRONMENT_PREFIX) {
            continue;
        }
        match (name.to_str(), value.to_str()) {
            (Some(name), Some(value)) => texts.push((name.to_owned(), value.to_owned())),
            _ => {
                layers.unreadable_variable(&shown_name);
            }
        }
    }
    layers.environment(texts);
    for assignment in set {
        layers.set(assignment);
    }
    for Flag { option, key, value } in flags {
        layers.flag(option, key, value);
    }
    layers.build()
}

/// A file by itself.
pub fn check(file: &Path) -> Result<Params, Faults> {
    let mut layers = Layers::new();
    read(&mut layers, file);
    layers.build()
}

fn read(layers: &mut Layers, file: &Path) {
    match std::fs::read_to_string(file) {
        Ok(text) => layers.file(&shown(file), &text),
        Err(error) => layers.unreadable_file(&shown(file), &error),
    };
}
