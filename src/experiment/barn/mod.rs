//! The worlds of the Benchmark for Autonomous Robot Navigation (Perille, Truong, Xiao and Stone 2020)
//! with the score of the BARN Challenge (`run.py` of github.com/Daffan/the-barn-challenge, since
//! February 2024), driven by this car in this simulator.

mod field;
mod request;
mod tables;

pub use field::{Field, FieldError, RESOLUTION_M, find_fields};
pub use request::BarnRequest;
pub use tables::{summary, tables};

use super::run::{Drive, RunSpec};
use crate::sim::drive::Outcome;

/// Name of the experiment in its records.
pub const NAME: &str = "barn";

/// The set's own path is thought to be driven at this speed, m/s.
pub const PAR_SPEED_MPS: f64 = 2.0;
/// A drive counts as if it had taken at least and at most so many times as long as that.
const CLIP: [f64; 2] = [2.0, 8.0];
/// A drive that takes longer has failed, seconds.
pub const LIMIT_S: f64 = 100.0;

/// Whether a drive counts as a success.
pub fn succeeded(drive: &Drive) -> bool {
    drive.outcome == Outcome::Goal && drive.collisions == 0 && drive.time_s <= LIMIT_S
}

/// The Challenge's score of a drive: 0 for a failure, 1/8 to 1/2 for a success. `path_m` is the
/// length of the set's own path, metres.
pub fn score(drive: &Drive, path_m: f64) -> f64 {
    let par_s = path_m / PAR_SPEED_MPS;
    let [least, most] = CLIP;
    if succeeded(drive) { par_s / drive.time_s.clamp(least * par_s, most * par_s) } else { 0.0 }
}

/// The parameter that all drives of one request share.
fn resolution_setting(resolution_m: f64) -> String {
    format!("{RESOLUTION_KEY}={resolution_m}")
}

const RESOLUTION_KEY: &str = "map.resolution_m";

/// The method's name without the size of cells, which is that of all.
fn method(spec: &RunSpec) -> String {
    let others = |assignment: &&String| {
        assignment.strip_prefix(RESOLUTION_KEY).is_none_or(|rest| !rest.starts_with('='))
    };
    let set = spec.set.iter().filter(others).cloned().collect();
    RunSpec { set, ..spec.clone() }.method()
}

#[cfg(test)]
mod tests;
