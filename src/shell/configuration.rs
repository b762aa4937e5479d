//! Reads the layers of the configuration from where they are kept.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::cli::{ConfigArgs, Flag};
use super::shown;
use crate::params::{ENVIRONMENT_PREFIX, Faults, Layers, Params};
use crate::tunable::Value;

/// What ground stations set is kept in this file of the state directory.
const KEPT: &str = crate::ground::KEPT_PARAMETERS;
/// The folder of the state directory that logs are in.
const LOGS: &str = "logs";

/// Defaults, file, what ground stations set, environment, `--set` and options, each over the one
/// before.
pub fn load(
    args: &ConfigArgs,
    environment: &[(OsString, OsString)],
    flags: &[Flag],
) -> Result<Params, Faults> {
    // Where things are kept is itself configured, but never by what is kept there.
    let first = layers(args, None, environment, flags).build()?;
    let Some(kept) = state_directory(&first, environment).map(|state| state.join(KEPT)) else {
        return Ok(first);
    };
    layers(args, Some(&kept), environment, flags).build()
}

fn layers(
    args: &ConfigArgs,
    kept: Option<&Path>,
    environment: &[(OsString, OsString)],
    flags: &[Flag],
) -> Layers {
    let mut layers = Layers::new();
    if let Some(file) = &args.file {
        read(&mut layers, file);
    }
    if let Some(kept) = kept {
        put_kept(&mut layers, kept);
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
    for assignment in &args.set {
        layers.set(assignment);
    }
    for Flag { option, key, value } in flags {
        layers.flag(option, key, value);
    }
    layers
}

/// What ground stations set; it is said which values those are. A mistake in there keeps nothing from
/// starting.
fn put_kept(layers: &mut Layers, path: &Path) {
    let text = match std::fs::read_to_string(path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return,
        Err(error) => {
            tracing::warn!("cannot read {}: {error}", shown(path));
            return;
        }
    };
    let (values, faults) = layers.kept(&shown(path), &text);
    for (key, value) in values {
        tracing::info!("{key} = {value} from {}, set by a ground station", shown(path));
    }
    for fault in &faults.0 {
        tracing::warn!("passed over: {fault}");
    }
}

/// The values that ground stations set and that are kept.
pub fn kept(state_directory: Option<&Path>) -> BTreeMap<String, Value> {
    let path = state_directory.map(|state| state.join(KEPT));
    let text = path.as_deref().and_then(|path| std::fs::read_to_string(path).ok());
    text.map_or_else(BTreeMap::new, |text| Layers::new().kept(KEPT, &text).0)
}

/// Where a program keeps what it must remember; of several directories from systemd the first.
pub fn state_directory(params: &Params, environment: &[(OsString, OsString)]) -> Option<PathBuf> {
    directory(&params.daemon.state_directory, "STATE_DIRECTORY", environment)
}

/// The folder of logs, if there is to be one.
pub fn log_directory(params: &Params, environment: &[(OsString, OsString)]) -> Option<PathBuf> {
    directory(&params.daemon.log_directory, "LOGS_DIRECTORY", environment)
        .or_else(|| Some(state_directory(params, environment)?.join(LOGS)))
}

/// What is configured, or what systemd says.
fn directory(
    configured: &str,
    variable: &str,
    environment: &[(OsString, OsString)],
) -> Option<PathBuf> {
    if !configured.is_empty() {
        return Some(configured.into());
    }
    let (_, value) = environment.iter().find(|(name, _)| name == variable)?;
    let first = value.to_str()?.split(':').next()?;
    (!first.is_empty()).then(|| first.into())
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logs_go_where_the_parameter_says_or_systemd_or_into_the_state_directory() {
        let environment = |pairs: &[(&str, &str)]| -> Vec<(OsString, OsString)> {
            pairs.iter().map(|(name, value)| ((*name).into(), (*value).into())).collect()
        };
        let mut params = Params::default();
        let logs = |params: &Params, pairs: &[(&str, &str)]| {
            log_directory(params, &environment(pairs)).map(|path| shown(&path))
        };
        let state = ("STATE_DIRECTORY", "/var/lib/apexd");
        assert_eq!(logs(&params, &[]), None);
        assert_eq!(logs(&params, &[state]).as_deref(), Some("/var/lib/apexd/logs"));
        let both = [state, ("LOGS_DIRECTORY", "/var/log/apexd:/elsewhere")];
        assert_eq!(logs(&params, &both).as_deref(), Some("/var/log/apexd"));
        params.daemon.state_directory = "/state".into();
        assert_eq!(logs(&params, &[]).as_deref(), Some("/state/logs"));
        params.daemon.log_directory = "/logs".into();
        assert_eq!(logs(&params, &both).as_deref(), Some("/logs"));
    }
}
