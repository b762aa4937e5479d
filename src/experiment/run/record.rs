//! What came of a drive.

use serde::{Deserialize, Serialize};

use super::figures::WallTimes;
use super::spec::Task;
use crate::experiment::floor::SafeFloor;
use crate::sim::drive::{Outcome, Spread, Summary};

/// The figures of a drive that follow from its description alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drive {
    /// How it ended.
    pub outcome: Outcome,
    /// Seconds from the first motion to rest.
    pub time_s: f64,
    /// Length of the true path, metres.
    pub path_m: f64,
    /// Instants of contact.
    pub collisions: u64,
    /// Instants in space that was not seen to be free.
    pub unknown_entries: u64,
    /// Smallest true distance to an obstacle, less the car's radius, metres; `None` if none was
    /// near.
    pub min_clearance_m: Option<f64>,
    /// Planning steps.
    pub replans: u64,
    /// Plans that did not pass the certificate.
    pub plans_rejected: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
    /// Mean number of candidate paths a step weighed.
    pub candidates: f64,
    /// Planning steps in which the prediction failed.
    pub prediction_faults: u64,
    /// Age of the newest scan in the plan being driven, milliseconds.
    pub age_ms: Spread,
    /// Hash over every setpoint.
    pub digest: String,
}

impl From<&Summary> for Drive {
    fn from(s: &Summary) -> Self {
        Self {
            outcome: s.outcome,
            time_s: s.time_s,
            path_m: s.path_m,
            collisions: s.collisions,
            unknown_entries: s.unknown_entries,
            min_clearance_m: Some(s.min_clearance_m).filter(|m| m.is_finite()),
            replans: s.replans,
            plans_rejected: s.plans_rejected,
            guard_stops: s.guard_stops,
            candidates: s.candidates,
            prediction_faults: s.prediction_faults,
            age_ms: s.age_ms,
            digest: s.digest.clone(),
        }
    }
}

/// One line of a file of results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// [`Task::key`] of the task.
    pub key: String,
    /// The program that drove: version and hash.
    pub program: String,
    /// What was driven.
    pub task: Task,
    /// The command that repeats it.
    pub command: String,
    /// What came of it.
    pub drive: Drive,
    /// How the known map would have done, where the drive did not arrive and that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference: Option<Drive>,
    /// What a safe drive along the same path would take, if that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub floor: Option<SafeFloor>,
    /// Course: x and y in metres, speed in m/s, if it was asked for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub course: Vec<[f32; 3]>,
    /// Wall times on the machine that drove.
    pub wall: WallTimes,
    /// Simulated time over wall time.
    pub realtime_factor: f64,
}

impl Record {
    /// Whether the goal was reached.
    pub fn arrived(&self) -> bool {
        self.drive.outcome == Outcome::Goal
    }

    /// Whether two records of one task agree in all that follows from the task. Where the latency
    /// is that of the machine, nothing does.
    pub fn agrees_with(&self, other: &Self) -> bool {
        self.key == other.key
            && (self.task.spec.latency == super::Timing::Measured || self.drive == other.drive)
    }
}
