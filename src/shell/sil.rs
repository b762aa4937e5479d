//! What a simulated drive is asked for and what it says while it lasts.

use std::path::{Path, PathBuf};

use super::mavlink::LinkUrl;
use super::place::PlaceRequest;
use super::report::{DriveRecord, outcome_text};
use crate::params::Params;
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::drive::{Spread, Summary};
use crate::sim::maze::Family;
use crate::sim::rig::Latency;

/// One drive, with every option checked.
#[derive(Clone, Debug, PartialEq)]
pub struct SilRequest {
    /// Where to drive, from where and to where.
    pub place: PlaceRequest,
    /// Seed of everything random during the drive.
    pub seed: u64,
    /// Time from a scan to its plan.
    pub latency: Latency,
    /// Give up after this many simulated seconds; the rig's own limit if not given.
    pub time_limit_s: Option<f64>,
    /// Keep pace with the wall clock.
    pub realtime: bool,
    /// MAVLink links. With any of them and without a goal, the car waits for one.
    pub links: Vec<LinkUrl>,
    /// When to look at the prediction, seconds from the first motion on; halfway if not given.
    pub snapshot_s: Option<f64>,
    /// The validated parameters.
    pub params: Params,
    /// Folder for the report; it exists.
    pub out: PathBuf,
    /// Log from which the drive can be replayed.
    pub log: Option<PathBuf>,
}

impl SilRequest {
    /// Whether ground stations say where to drive and when it is over.
    pub fn is_attended(&self) -> bool {
        !self.links.is_empty() && self.place.goal.is_none()
    }

    /// What is driven, in a few words: world, policy and predictor.
    pub fn title(&self) -> String {
        let world = self.place.world.title();
        let policy = self.params.plan.policy;
        let predictor = match policy {
            Policy::MapPredictive | Policy::Janson | Policy::JansonLite => {
                format!(", {}", self.predictor())
            }
            Policy::Frontier | Policy::KnownMap => String::new(),
        };
        format!("{world} · {}{predictor}", policy.name())
    }
}

impl SilRequest {
    /// The predictor's name, or that of the network's file.
    fn predictor(&self) -> String {
        let predict = &self.params.predict;
        let file = Path::new(&predict.model).file_stem();
        match file.filter(|_| predict.kind == PredictorKind::Cnp) {
            Some(name) => name.to_string_lossy().into(),
            None => predict.kind.name().into(),
        }
    }
}

/// How far a drive has come.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Progress {
    /// Simulated time, seconds.
    pub time_s: f64,
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Way driven, metres.
    pub distance_m: f64,
    /// Way to the goal as the planner now sees it, metres.
    pub remaining_m: f64,
    /// Planning steps so far.
    pub replans: u64,
}

/// Why a drive or a maze did not come about.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// What was asked for is impossible: a file that cannot be read, a start inside a wall.
    #[error("{0}")]
    Input(Box<dyn std::error::Error + Send + Sync>),
    /// It was possible, but did not work.
    #[error("{0}")]
    Failed(Box<dyn std::error::Error + Send + Sync>),
}

/// What was asked for is impossible.
pub(super) fn input(error: impl std::error::Error + Send + Sync + 'static) -> RunError {
    RunError::Input(Box::new(error))
}

/// What the command line drives.
pub trait Simulator {
    /// Drives to the end, calling `progress` now and then.
    fn drive(
        &self,
        request: &SilRequest,
        progress: &mut dyn FnMut(&Progress),
    ) -> Result<DriveRecord, RunError>;

    /// Writes a maze as map_server files: `out` and a picture beside it.
    fn write_maze(&self, seed: u64, family: Family, out: &Path) -> Result<(), RunError>;
}

/// The summary for a person, without a line break at its end.
pub fn summary_text(summary: &Summary) -> String {
    let s = summary;
    let mean_mps = if s.time_s > 0.0 { s.path_m / s.time_s } else { 0.0 };
    let clearance = if s.min_clearance_m.is_finite() {
        format!("{:.2} m", s.min_clearance_m)
    } else {
        "no wall near".to_owned()
    };
    let lines = [
        format!("{} after {:.2} s", outcome_text(s.outcome), s.time_s),
        format!("  path            {:.1} m, mean {mean_mps:.2} m/s", s.path_m),
        format!("  clearance       {clearance}"),
        format!(
            "  safety          {} collisions, {} unknown entries, {} guard stops",
            s.collisions, s.unknown_entries, s.guard_stops
        ),
        format!(
            "  planning        {} steps, {} plans rejected, {:.1} candidates a step",
            s.replans, s.plans_rejected, s.candidates
        ),
        format!("  planning time   {}", spread_text(&s.plan_ms)),
        format!("  predicting      {}", spread_text(&s.predict_ms)),
        format!(
            "  prediction      {:.0} cells encoded and {:.0} decoded a step, {} faults",
            s.predict_context, s.predict_decoded, s.prediction_faults
        ),
        format!("  age of scan     {}", spread_text(&s.age_ms)),
        format!("  simulated at    {:.1} times real time", s.realtime_factor),
        format!("  setpoints       digest {}", s.digest),
    ];
    lines.join("\n")
}

fn spread_text(spread: &Spread) -> String {
    format!("{:.2} ms p50, {:.2} ms p99, {:.2} ms max", spread.p50, spread.p99, spread.max)
}
