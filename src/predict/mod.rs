//! How likely an unseen point is occupied.
//!
//! A prediction may change the path and the wished speed, never the stop: `guard` and
//! `plan::certify` have no access to it.

mod cnp;
mod crop_network;
mod document;
mod fault;
pub mod lattice;
mod metadata;
mod model_error;
mod network;
mod reach;
mod reference;
mod runtime;
mod supervise;
#[cfg(test)]
mod test_networks;
mod trust;

pub use cnp::CnpPredictor;
pub use crop_network::CropNetwork;
pub use fault::PredictFault;
pub use metadata::Metadata;
pub use model_error::ModelError;
pub use network::{Answers, Network};
pub use reference::{NoPrediction, OraclePredictor, RandomPredictor};
pub use runtime::RuntimeError;
pub use supervise::{PredictReport, Supervised, SupervisedView};
pub use trust::Calibration;

use std::sync::Arc;

use reference::Missing;
use runtime::Runtime;

use crate::frames::{Point, Pose};
use crate::map::{CellRect, Grid};
use crate::time::Duration;
use crate::{choices, tunables};

/// The planner's view of the unknown during one step.
pub trait OccupancyView {
    /// Writes the probability that each map-frame point is occupied into `out` (same length).
    /// Answers are in `[0, 1]`; an answer that is not (NaN included) is treated by the planner as
    /// "nothing is known" (0.5).
    fn occupied(&mut self, points: &[Point], out: &mut [f32]);

    /// Whether every answer for a point of the rectangle between two corners (the lower and the
    /// higher one, map frame, metres) is 0.5, so that it need not be asked for. May be false
    /// though it is so. Asked for squares of some cells all over the map, so it must be quick.
    fn silent(&self, _low: Point, _high: Point) -> bool {
        false
    }

    /// Whether it may know anything for certain: an answer of 0 or 1 of a view that may not is but
    /// a number that was rounded.
    fn is_ever_certain(&self) -> bool {
        false
    }

    /// How much this step's scene looks like those that it has learned from, from 0 to 1; 0 where it
    /// does not say.
    fn familiarity(&mut self) -> f64 {
        0.0
    }
}

/// The answer where nothing is foreseen.
const SILENT: f32 = 0.5;

/// The network that ships.
const SHIPPED: &[u8] = include_bytes!("../../params/cnp.onnx");

/// What a predictor may look at before a step.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// What is known; a predictor that answers later may keep the snapshot.
    pub grid: &'a Arc<Grid>,
    /// Where the car is, map frame.
    pub pose: Pose,
    /// Where it is to go, map frame, metres.
    pub goal: Point,
    /// Holds every cell that has changed since the scene observed before; the whole grid at first.
    pub changed: CellRect,
}

/// Foresees what the car has not seen.
///
/// Once per step [`observe`](Self::observe) takes in the scene (a model encodes it there); the
/// planner then asks the predictor, as an [`OccupancyView`], for the points that its search comes
/// across, some tens at a time, and for those beside the way, some hundreds at a time (a model
/// decodes them there, and remembers them for the step).
pub trait Predictor: OccupancyView + Send {
    /// Takes in the newest scene. Later questions are about it.
    fn observe(&mut self, scene: &Scene<'_>);

    /// What has gone wrong since the last scene, if anything has; its answers are 0.5 since.
    fn fault(&self) -> Option<&PredictFault> {
        None
    }

    /// What has been worked through since the last scene.
    fn effort(&self) -> Effort {
        Effort::default()
    }

    /// How long it may take in a step.
    fn time_limit(&self) -> Option<Duration> {
        None
    }
}

/// What a predictor works through in a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effort {
    /// Observed cells that were encoded.
    pub context: u32,
    /// Cells that were decoded.
    pub decoded: u32,
}

choices! {
    /// Where the view of the unknown comes from.
    pub enum PredictorKind {
        /// What a trained network foresees: the one of `predict.model`, or the one that ships.
        Cnp = "cnp",
        /// Nothing is foreseen: every unknown point is occupied with probability 0.5.
        None = "none",
        /// The true map, within the prediction range; simulation only.
        Oracle = "oracle",
        /// A number drawn for each cell, the same all through a drive.
        Random = "random",
        /// The opposite of the true map, within the prediction range; simulation only.
        Inverted = "inverted",
    }
}

tunables! {
    /// The view of the unknown.
    pub struct PredictParams in "predict" {
        /// Where the view comes from.
        kind: PredictorKind = PredictorKind::Cnp, at_rest, one of;
        /// How far from the frontier of the known map anything is foreseen; 0.5 beyond.
        range_m: f64 = 5.0, at_rest, in 0.5..=50.0, "m";
        /// The trained network's ONNX file; if empty, the one that is part of the program.
        model: String = "", restart;
        /// The shared library of ONNX Runtime that runs the network; if empty, the runtime that is
        /// part of the program.
        onnxruntime: String = "", restart;
        /// A step that predicts for longer goes on without, and so do the next ones.
        time_limit_s: f64 = 0.01, restart, in 0.0001..=10.0, "s";
        /// Draw predictions towards 0.5 as far as the network calls the scene unfamiliar.
        fade: bool = false, restart;
        /// Drive without prediction if the network cannot be used (a fault is raised); otherwise
        /// do not drive.
        fallback: bool = true, restart;
    }
}

/// Why a predictor cannot be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PredictError {
    /// Only a simulation knows the true map.
    #[error("predictor {:?} needs the true map, which only a simulated world gives", kind.name())]
    NoTruth {
        /// What was asked for.
        kind: PredictorKind,
    },
    /// The network cannot be used.
    #[error("cannot use the network {file}: {error}")]
    Model {
        /// Its file.
        file: String,
        /// What does not fit.
        error: ModelError,
    },
    /// The inference runtime cannot be had.
    #[error(transparent)]
    Runtime(#[from] RuntimeError),
}

/// The predictor that the parameters name. `truth` is the true map in the map frame, `seed` fixes
/// the draws of `random`.
///
/// # Errors
/// If the true map or the network is missing; a network that cannot be used is only an error
/// without [`PredictParams::fallback`], and else a predictor that has nothing but a fault to tell.
pub fn build(
    params: &PredictParams,
    truth: Option<Arc<Grid>>,
    seed: u64,
) -> Result<Box<dyn Predictor>, PredictError> {
    let kind = params.kind;
    let oracle = |inverted| -> Result<_, PredictError> {
        let truth = truth.ok_or(PredictError::NoTruth { kind })?;
        Ok(Box::new(OraclePredictor::new(truth, params.range_m, inverted)))
    };
    Ok(match kind {
        PredictorKind::Cnp => learned(params)?,
        PredictorKind::None => Box::new(NoPrediction),
        PredictorKind::Random => Box::new(RandomPredictor::new(seed)),
        PredictorKind::Oracle => oracle(false)?,
        PredictorKind::Inverted => oracle(true)?,
    })
}

/// SHA-256 of the network that the parameters name, hexadecimal; empty if none is asked for, or if it
/// cannot be read.
pub fn network_digest(params: &PredictParams) -> String {
    use sha2::Digest;
    let bytes = match (params.kind, &*params.model) {
        (PredictorKind::Cnp, "") => SHIPPED.to_vec(),
        (PredictorKind::Cnp, file) => std::fs::read(file).unwrap_or_default(),
        _ => Vec::new(),
    };
    if bytes.is_empty() {
        return String::new();
    }
    sha2::Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

fn learned(params: &PredictParams) -> Result<Box<dyn Predictor>, PredictError> {
    match load(params) {
        Ok(network) => Ok(Box::new(CnpPredictor::new(network, params))),
        Err(error) if params.fallback => {
            tracing::warn!("driving without prediction: {error}");
            Ok(Box::new(Missing::new(&error)))
        }
        Err(error) => Err(error),
    }
}

/// The network that the parameters name, ready to run.
///
/// # Errors
/// Says what does not fit, and what would.
pub fn load(params: &PredictParams) -> Result<Network, PredictError> {
    let runtime = match Runtime::choose(&params.onnxruntime) {
        Err(error) if params.fallback && !params.onnxruntime.is_empty() => {
            tracing::warn!("{error}; using the built-in runtime");
            Runtime::choose("")?
        }
        chosen => chosen?,
    };
    let shipped = params.model.is_empty();
    let file = if shipped { "that is part of the program" } else { &*params.model };
    let fail = |error| PredictError::Model { file: file.to_owned(), error };
    let network = if shipped {
        Network::load(SHIPPED, runtime)
    } else {
        std::fs::read(&params.model)
            .map_err(|error| ModelError::Unreadable { why: error.to_string() })
            .and_then(|bytes| Network::load(&bytes, runtime))
    };
    let network = network.map_err(fail)?;
    let Metadata { architecture, world, trained_on, .. } = network.metadata();
    tracing::info!(runtime = runtime.name(), architecture, world, trained_on, "network {file}");
    Ok(network)
}
