//! Scores of predictors on scenes that they have not seen.
//!
//! Scored are the cells that a scene has not observed, whose truth is known, and that lie within a
//! radius of the centre of a piece of the frontier (free cells beside unknown ones, at least three
//! that touch). All scores are means over cells; their intervals count worlds, because the cells of
//! one world hang together.
//!
//! The edge metric asks what a planner asks, whether the hallway goes on: an inner edge of a maze's
//! lattice of which no cell is observed is given the mean of its cells' probabilities, and is open
//! or closed. It is *near* if a cell beside it is at most 2.5 m from the frontier on foot, through
//! free space not observed yet.

mod baselines;
mod card;
mod contender;
mod metrics;
mod network;
mod request;
mod scores;
mod table;
mod view;

use std::collections::BTreeSet;

pub use baselines::{Baseline, Kind as BaselineKind};
pub use card::{ModelFacts, card};
pub use metrics::{RELIABILITY_BINS, Reliability, Scores, Tally, clustered_interval, log_loss};
pub use network::{NetworkScored, Treatment};
pub use request::{Request, SceneSource, SetRequest};
pub use scores::{Band, Difference, EdgeScores, Evaluation, RadiusScores, Scored, SetScores};
pub use table::table;
pub use view::{Edge, MazeLattice, Phase, View};

use crate::experiment::dataset::{DatasetError, SceneRow};
use crate::predict::lattice::CROP_CELLS;
use contender::{Contender, edge_scores, radius_scores};

/// Edges are scored in discs of this radius around the frontier's pieces, metres.
pub const EDGE_RADIUS_M: f64 = 5.0;

/// Edges up to this far from the frontier are near, metres: one hallway.
pub const EDGE_NEAR_M: f64 = 2.5;

/// Anything that gives probabilities of being occupied.
pub trait Probabilities {
    /// The name in tables.
    fn name(&self) -> String;

    /// Side of the coarse cells that it is made for, metres; `None` if it takes any.
    fn resolution_m(&self) -> Option<f64> {
        None
    }

    /// Writes for each cell (its offset on the scene's crop) the probability that it is occupied.
    /// Asked once a scene.
    fn probabilities(
        &mut self,
        view: &View,
        cells: &[usize],
        out: &mut [f32],
    ) -> Result<(), PredictionError>;
}

/// Why a predictor cannot be scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PredictionError {
    /// It fails.
    #[error("{0}")]
    Failed(String),
    /// It gives something that is no probability.
    #[error("it gives the probability {0}")]
    NotAProbability(f32),
}

/// Why an evaluation did not come about.
#[derive(Debug, thiserror::Error)]
pub enum EvaluateError {
    /// The scenes cannot be made or read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// A predictor fails.
    #[error("{name} cannot be scored: {error}")]
    Prediction {
        /// The predictor.
        name: String,
        /// What happened.
        error: PredictionError,
    },
    /// Not a single cell to score.
    #[error("{set} has no unobserved cell within {radius_m} m of a frontier")]
    NothingToScore {
        /// The scenes.
        set: String,
        /// The radius, metres.
        radius_m: f64,
    },
    /// A data set's lattice is another one than the predictor's.
    #[error("{set} has cells of {resolution_m} m, but {name} was trained on {wanted_m} m")]
    Resolution {
        /// The scenes.
        set: String,
        /// Their cells, metres.
        resolution_m: f64,
        /// The predictor.
        name: String,
        /// Its cells, metres.
        wanted_m: f64,
    },
}

/// A scene with predictions of it, for a picture.
pub struct Sample {
    /// Which set it is of.
    pub set: String,
    /// Which world: family and number as in a data set.
    pub world: (u8, i64),
    /// The scene.
    pub view: View,
    /// For each predictor its name and the probabilities on the crop, NaN where it was not asked.
    pub predictions: Vec<(String, Vec<f32>)>,
}

/// Scores predictors, and baselines beside them. `progress` hears how many scenes of how many are
/// done.
///
/// # Errors
/// If scenes cannot be made or read, there is nothing to score, or a predictor fails.
pub fn evaluate(
    request: &Request,
    models: &mut [Box<dyn Probabilities>],
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<(Evaluation, Vec<Sample>), EvaluateError> {
    let mut samples = Vec::new();
    let mut sets = Vec::new();
    for set in &request.sets {
        sets.push(evaluate_set(request, set, models, progress, &mut samples)?);
    }
    Ok((Evaluation { apexd: env!("CARGO_PKG_VERSION").to_owned(), sets }, samples))
}

/// The baselines of one set: tables fitted for each radius.
struct Baselines {
    /// By kind, then by radius.
    tables: Vec<Vec<Baseline>>,
}

impl Baselines {
    fn new(mazes: bool, radii: usize) -> Self {
        let tables = BaselineKind::all(mazes);
        Self { tables: tables.into_iter().map(|k| vec![Baseline::new(k); radii]).collect() }
    }

    fn fit(&mut self, view: &View, cells: &[Vec<usize>]) {
        for tables in &mut self.tables {
            for (table, cells) in tables.iter_mut().zip(cells) {
                table.fit(view, cells);
            }
        }
    }
}

fn evaluate_set(
    request: &Request,
    set: &SetRequest,
    models: &mut [Box<dyn Probabilities>],
    progress: &(dyn Fn(usize, usize) + Sync),
    samples: &mut Vec<Sample>,
) -> Result<SetScores, EvaluateError> {
    let radii = &request.radii_m;
    let resolution_m = set.scenes.resolution_m()?;
    for model in models.iter() {
        if let Some(wanted_m) = model.resolution_m().filter(|m| (m - resolution_m).abs() > 1e-9) {
            let (set, name) = (set.name.clone(), model.name());
            return Err(EvaluateError::Resolution { set, resolution_m, name, wanted_m });
        }
    }
    let fit_source = set.fit.as_ref().unwrap_or(&set.scenes);
    let mut baselines: Option<Baselines> = None;
    let fitted = fit_source.for_each(&|_, _| {}, &mut |row| {
        let view = View::new(&row, resolution_m);
        let cells: Vec<Vec<usize>> = radii.iter().map(|r| view.cells_within(*r, false)).collect();
        let mazes = view.maze.is_some();
        baselines.get_or_insert_with(|| Baselines::new(mazes, radii.len())).fit(&view, &cells);
    })?;
    let mut baselines = baselines.unwrap_or_else(|| Baselines::new(false, radii.len()));
    let baselines_fitted_on = match set.fit {
        Some(_) => fitted.text,
        None => "the scored scenes themselves".to_owned(),
    };

    let names = models.iter().map(|m| m.name());
    let names = names.chain(baselines.tables.iter().map(|tables| tables[0].name()));
    let mut contenders: Vec<Contender> =
        names.map(|name| Contender::new(name, radii.len())).collect();
    let count = set.scenes.count()?;
    // In the middle of as many equal parts.
    let sampled =
        |k: usize| (0..request.pictures).any(|i| (2 * i + 1) * count / (2 * request.pictures) == k);
    let (mut scenes, mut failure) = (0, None);
    let mut worlds = BTreeSet::new();
    let origin = set.scenes.for_each(progress, &mut |row| {
        if failure.is_some() {
            return;
        }
        worlds.insert((row.family, row.source));
        let shown = sampled(scenes);
        scenes += 1;
        let scene = ScoredScene::new(&row, resolution_m, radii);
        match scene.score(models, &mut baselines, &mut contenders) {
            Ok(predictions) if shown => samples.push(Sample {
                set: set.name.clone(),
                world: scene.world,
                view: scene.view,
                predictions,
            }),
            Ok(_) => {}
            Err(error) => failure = Some(error),
        }
    })?;
    if let Some(error) = failure {
        return Err(error);
    }
    Ok(SetScores {
        name: set.name.clone(),
        held_out: origin.held_out,
        scenes,
        worlds: worlds.len(),
        settings: origin.settings,
        maps: origin.maps,
        manifest_sha256: origin.manifest_sha256,
        baselines_fitted_on,
        radii: radius_scores(set, radii, &contenders)?,
        edges: contenders.iter().filter_map(edge_scores).collect(),
    })
}

/// One scene with what is to be scored of it.
struct ScoredScene {
    view: View,
    world: (u8, i64),
    /// Cells to score, by radius.
    cells: Vec<Vec<usize>>,
    edges: Vec<Edge>,
    /// Everything that is asked for.
    asked: Vec<usize>,
}

impl ScoredScene {
    fn new(row: &SceneRow, resolution_m: f64, radii_m: &[f64]) -> Self {
        let view = View::new(row, resolution_m);
        let edges = view.edges(EDGE_RADIUS_M);
        let widest = radii_m.iter().fold(EDGE_RADIUS_M, |a, b| a.max(*b));
        // Cells without a target too: their predictions are shown in pictures.
        let asked = view.cells_within(widest, true);
        let cells = radii_m.iter().map(|r| view.cells_within(*r, false)).collect();
        Self { world: (row.family, row.source), cells, edges, asked, view }
    }

    /// Asks everyone and adds up; gives the predictions.
    fn score(
        &self,
        models: &mut [Box<dyn Probabilities>],
        baselines: &mut Baselines,
        contenders: &mut [Contender],
    ) -> Result<Vec<(String, Vec<f32>)>, EvaluateError> {
        let (of_models, of_baselines) = contenders.split_at_mut(models.len());
        let mut predictions = Vec::new();
        for (model, contender) in models.iter_mut().zip(of_models) {
            let p = self.ask(model.as_mut())?;
            for radius in 0..self.cells.len() {
                self.add_cells(contender, radius, &p);
            }
            self.add_edges(contender, &p);
            predictions.push((contender.name.clone(), p));
        }
        for (tables, contender) in baselines.tables.iter_mut().zip(of_baselines) {
            let mut last = Vec::new();
            for (radius, table) in tables.iter_mut().enumerate() {
                last = self.ask(table)?;
                self.add_cells(contender, radius, &last);
            }
            self.add_edges(contender, &last);
            predictions.push((contender.name.clone(), last));
        }
        Ok(predictions)
    }

    /// The probabilities on the crop, NaN where nothing is asked.
    fn ask(&self, model: &mut dyn Probabilities) -> Result<Vec<f32>, EvaluateError> {
        let mut p = vec![f32::NAN; CROP_CELLS * CROP_CELLS];
        if self.asked.is_empty() {
            return Ok(p);
        }
        let mut answers = vec![f32::NAN; self.asked.len()];
        let asked = model.probabilities(&self.view, &self.asked, &mut answers);
        let outside = answers.iter().find(|p| !(0.0..=1.0).contains(*p));
        let checked = asked
            .and_then(|()| outside.map_or(Ok(()), |p| Err(PredictionError::NotAProbability(*p))));
        checked.map_err(|error| EvaluateError::Prediction { name: model.name(), error })?;
        for (k, answer) in self.asked.iter().zip(answers) {
            p[*k] = answer;
        }
        Ok(p)
    }

    fn add_cells(&self, contender: &mut Contender, radius: usize, p: &[f32]) {
        for k in &self.cells[radius] {
            let distance_m = f64::from(self.view.frontier_m[*k]);
            contender.add_cell(radius, self.world, distance_m, p[*k], self.view.truth[*k] == 1);
        }
    }

    fn add_edges(&self, contender: &mut Contender, p: &[f32]) {
        for edge in &self.edges {
            let sum: f32 = edge.cells.iter().map(|k| p[*k]).sum();
            contender.add_edge(edge, sum / edge.cells.len() as f32);
        }
    }
}

#[cfg(test)]
mod tests;
