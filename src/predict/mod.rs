//! How likely an unseen point is occupied.
//!
//! A prediction may change the path and the wished speed, never the stop: `guard` and
//! `plan::certify` have no access to it.

mod reach;
mod reference;

pub use reference::{NoPrediction, OraclePredictor, RandomPredictor};

use std::sync::Arc;

use crate::frames::{Point, Pose};
use crate::map::{CellRect, Grid};
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
}

/// The answer where nothing is foreseen.
const SILENT: f32 = 0.5;

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
}

choices! {
    /// Where the view of the unknown comes from.
    pub enum PredictorKind {
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
        kind: PredictorKind = PredictorKind::None, at_rest, one of;
        /// How far from the frontier of the known map anything is foreseen; 0.5 beyond.
        range_m: f64 = 5.0, at_rest, in 0.5..=50.0, "m";
    }
}

/// Why a predictor cannot be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PredictError {
    /// Only a simulation knows the true map.
    #[error("predictor {:?} needs the true map, which only a simulated world gives", kind.name())]
    NoTruth {
        /// What was asked for.
        kind: PredictorKind,
    },
}

/// The predictor that the parameters name. `truth` is the true map in the map frame, `seed` fixes
/// the draws of `random`.
pub fn build(
    params: &PredictParams,
    truth: Option<Arc<Grid>>,
    seed: u64,
) -> Result<Box<dyn Predictor>, PredictError> {
    let kind = params.kind;
    let oracle = |inverted| {
        let truth = truth.ok_or(PredictError::NoTruth { kind })?;
        Ok(Box::new(OraclePredictor::new(truth, params.range_m, inverted)))
    };
    Ok(match kind {
        PredictorKind::None => Box::new(NoPrediction),
        PredictorKind::Random => Box::new(RandomPredictor::new(seed)),
        PredictorKind::Oracle => oracle(false)?,
        PredictorKind::Inverted => oracle(true)?,
    })
}
