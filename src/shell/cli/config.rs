//! What a command line says of parameters.

use std::path::PathBuf;

use clap::Args;

use crate::tunable::Value;

/// Configuration file and assignments.
#[derive(Args, Clone, Debug, Default)]
pub struct ConfigArgs {
    /// Configuration file (TOML) over the built-in defaults.
    #[arg(long = "config", value_name = "FILE", help_heading = "Configuration")]
    pub file: Option<PathBuf>,
    /// Set one parameter, over file and environment (`apexd params` has them all); may be repeated.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,
}

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

impl Flag {
    /// The option, if it was given a value.
    pub(super) fn given(
        option: &'static str,
        key: &'static str,
        value: Option<Value>,
    ) -> Option<Self> {
        value.map(|value| Self { option, key, value })
    }
}
