//! The results.

use serde::Serialize;

use super::metrics::{Reliability, Scores};
use crate::experiment::dataset::{MapEntry, Settings};

/// Scores within one band of distances.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Band {
    /// From this distance on, metres.
    pub from_m: f64,
    /// Up to this distance, metres; absent if there is no end.
    pub to_m: Option<f64>,
    /// The scores.
    #[serde(flatten)]
    pub scores: Scores,
}

/// A paired difference.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Mean over the cells.
    pub mean: f64,
    /// Half the width of the 95 % interval, by worlds.
    pub ci95: Option<f64>,
}

/// Scores of one predictor within one radius.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The predictor.
    pub name: String,
    /// The scores.
    #[serde(flatten)]
    pub scores: Scores,
    /// Half the width of the 95 % interval of the log loss, by worlds.
    pub log_loss_ci95: Option<f64>,
    /// Log loss less that of the first predictor, on the same cells; absent for the first.
    pub against_first: Option<Difference>,
    /// By distance from the nearest frontier cell.
    pub by_distance: Vec<Band>,
    /// The reliability diagram.
    pub reliability: Vec<Reliability>,
}

/// All predictors within one radius.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RadiusScores {
    /// The radius, metres.
    pub radius_m: f64,
    /// The predictors.
    pub predictors: Vec<Scored>,
}

/// One predictor's scores on the edges of mazes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EdgeScores {
    /// The predictor.
    pub name: String,
    /// Edges near the frontier.
    pub near: Scores,
    /// By distance on foot.
    pub by_distance: Vec<Band>,
}

/// The scores on one set of scenes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SetScores {
    /// The scenes' name.
    pub name: String,
    /// Whether the scenes are kept from training: mazes by their seeds, data sets by their mark.
    /// Absent for maps, whose use in training nobody can tell.
    pub held_out: Option<bool>,
    /// Number of scenes.
    pub scenes: usize,
    /// Number of worlds.
    pub worlds: usize,
    /// How the scenes were made.
    pub settings: Settings,
    /// The maps.
    pub maps: Vec<MapEntry>,
    /// SHA-256 of the manifest, of a data set written before.
    pub manifest_sha256: Option<String>,
    /// What the baselines were fitted on.
    pub baselines_fitted_on: String,
    /// By radius.
    pub radii: Vec<RadiusScores>,
    /// Of mazes: the edge metric.
    pub edges: Vec<EdgeScores>,
}

/// All scores.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    /// The program's version.
    pub apexd: String,
    /// By set.
    pub sets: Vec<SetScores>,
}
