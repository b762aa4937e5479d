//! The services beside the vehicle itself, with the files that they keep and hand out.

use std::fs;
use std::path::{Path, PathBuf};

use super::keys::replace;
use super::shelf::Folders;
use crate::ground::{Ftp, Ground, Keeper, Mission, Parameters, SAID_PLACES, Service};
use crate::params::Params;
use crate::shell::configuration;

/// A kept file that is longer than this is none of ours, bytes.
const KEPT_BYTES_MAX: u64 = 1 << 20;

/// Parameters, missions and files; what is to outlast a restart goes into the state directory, what is
/// handed out comes from the folder of logs.
pub fn services(
    params: &Params,
    state_directory: Option<&Path>,
    logs: Option<PathBuf>,
) -> Vec<Box<dyn Service>> {
    let keeper = || keeper(state_directory);
    let kept_text = |name: &str| kept_text(state_directory, name);
    let system = params.mavlink.system_id as u8;
    vec![
        Box::new(Parameters::new(params, configuration::kept(state_directory), keeper())),
        Box::new(Mission::new(system, keeper(), kept_text)),
        Box::new(Ftp::new(Box::new(Folders::new(logs)))),
    ]
}

/// Lets the vehicle take up what stations said of origin and home before, and keep it.
pub fn keep_places(ground: &mut Ground, state_directory: Option<&Path>) {
    let kept = kept_text(state_directory, SAID_PLACES);
    match ground.keep_places(keeper(state_directory), kept.as_deref()) {
        Err(fault) => {
            tracing::warn!("{SAID_PLACES} in the state directory is passed over: {fault}")
        }
        Ok(()) if kept.is_some() => {
            tracing::info!("origin and home are those that ground stations set in an earlier run");
        }
        Ok(()) => {}
    }
}

fn keeper(state_directory: Option<&Path>) -> Option<Box<dyn Keeper>> {
    let folder = state_directory?.to_owned();
    Some(Box::new(Files { folder }))
}

fn kept_text(state_directory: Option<&Path>, name: &str) -> Option<String> {
    let path = state_directory?.join(name);
    let short = fs::metadata(&path).ok()?.len() <= KEPT_BYTES_MAX;
    fs::read_to_string(&path).ok().filter(|_| short)
}

/// Files in the state directory, each replaced as a whole.
struct Files {
    folder: PathBuf,
}

impl Keeper for Files {
    fn keep(&mut self, name: &str, text: &str) -> Result<(), String> {
        fs::create_dir_all(&self.folder)
            .and_then(|()| replace(&self.folder.join(name), text.as_bytes()))
            .map_err(|error| format!("cannot write {} in {}: {error}", name, self.folder.display()))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::params::kept_text;
    use crate::shell::cli::ConfigArgs;
    use crate::tunable::Value;

    #[test]
    fn what_is_kept_replaces_what_was_kept_and_is_read_as_a_layer_of_the_configuration() {
        let folder = tempfile::tempdir().unwrap();
        let state = folder.path().join("state");
        let mut files = Files { folder: state.clone() };
        files.keep("parameters.toml", "old").unwrap();
        let mut values = BTreeMap::new();
        values.insert("speed.speed_max_mps".to_owned(), Value::Real(2.5));
        values.insert("plan.policy".to_owned(), Value::Text("frontier".into()));
        files.keep("parameters.toml", &kept_text(&values)).unwrap();
        assert_eq!(configuration::kept(Some(&state)), values);
        assert_eq!(fs::read_dir(&state).unwrap().count(), 1, "nothing is left lying about");

        let config = folder.path().join("a.toml");
        let text = format!(
            "[speed]\nspeed_max_mps = 3\n[daemon]\nstate_directory = {:?}\n",
            state.display()
        );
        fs::write(&config, text).unwrap();
        let load = |set: &[String]| {
            let args = ConfigArgs { file: Some(config.clone()), set: set.to_vec() };
            configuration::load(&args, &[], &[]).unwrap()
        };
        assert_eq!(load(&[]).speed.speed_max_mps, 2.5, "over the file");
        let set = ["speed.speed_max_mps=1.5".to_owned()];
        assert_eq!(load(&set).speed.speed_max_mps, 1.5, "below the command line");

        files.keep("parameters.toml", "[speed]\nspeed_max_mps = 99\nsped = 1\n[plan\n").unwrap();
        assert_eq!(load(&[]).speed.speed_max_mps, 3.0, "a broken file keeps nothing from starting");
    }
}
