//! `apexd evaluate`.

use std::io::Write;
use std::path::{Path, PathBuf};

use super::cli::EvaluateArgs;
use super::progress::Terminal;
use super::report::{ReportError, write_evaluation};
use super::{Exit, complain, folder, say};
use crate::experiment::dataset::{DatasetError, HELD_OUT_FROM, sha256};
use crate::experiment::evaluate::{
    EvaluateError, Evaluation, ModelFacts, NetworkScored, PredictionError, Probabilities, card,
    evaluate, table,
};
use crate::predict::{self, PredictError, PredictParams};

/// A network from the command line.
struct Model {
    file: PathBuf,
    facts: ModelFacts,
    /// The names under which it is scored: as it is, calibrated, faded.
    names: Vec<String>,
}

/// All networks of the command line.
#[derive(Default)]
struct Loaded {
    models: Vec<Model>,
    /// Each under every treatment that makes a difference.
    scored: Vec<Box<dyn Probabilities>>,
}

/// Why a network cannot be scored.
#[derive(Debug, thiserror::Error)]
enum ModelError {
    #[error("{}: {error}", .file.display())]
    Read { file: PathBuf, error: std::io::Error },
    #[error(transparent)]
    Load(#[from] PredictError),
    #[error("{}: {error}", .file.display())]
    Run { file: PathBuf, error: PredictionError },
}

/// Scores, and says, draws and writes down the scores.
pub fn run(args: &EvaluateArgs, terminal: &Terminal, out: &mut dyn Write) -> Exit {
    let request = args.request();
    if request.sets.is_empty() {
        complain("there is nothing to score on: give --family, --maps or --dataset");
        return Exit::Usage;
    }
    if args.card && !args.family.is_empty() && args.seeds[0] < HELD_OUT_FROM {
        complain(&no_card(&format!("seeds {} to {}", args.seeds[0], args.seeds[1] - 1)));
        return Exit::Usage;
    }
    if let Some(Err(error)) = args.out.as_deref().map(|out| folder::prepare(Some(out))) {
        complain(&error.to_string());
        return Exit::Usage;
    }
    let Loaded { models, mut scored } = match load(args) {
        Ok(loaded) => loaded,
        Err(error) => {
            complain(&error.to_string());
            return Exit::Usage;
        }
    };
    let bar = terminal.count_bar("scenes");
    let result = evaluate(&request, &mut scored, &|done, total| bar.show(done, total));
    bar.finish();
    let (evaluation, samples) = match result {
        Ok(result) => result,
        Err(error) => {
            complain(&error.to_string());
            return match error {
                EvaluateError::Prediction { .. }
                | EvaluateError::Dataset(DatasetError::File { .. }) => Exit::Failed,
                _ => Exit::Usage,
            };
        }
    };
    let text = if args.json {
        serde_json::to_string(&evaluation).expect("scores are plain data")
    } else {
        table(&evaluation)
    };
    say(out, &text);
    let drawn = args.out.as_deref().map(|out| write_evaluation(out, &evaluation, &samples));
    if let Some(Err(error)) = drawn {
        complain(&error.to_string());
        return Exit::Failed;
    }
    if !args.card {
        return Exit::Done;
    }
    if let Some(set) = evaluation.sets.iter().find(|set| set.held_out == Some(false)) {
        complain(&no_card(&set.name));
        return Exit::Usage;
    }
    for model in &models {
        if let Err(error) = write_card(model, &models, &evaluation) {
            complain(&error.to_string());
            return Exit::Failed;
        }
    }
    Exit::Done
}

fn no_card(what: &str) -> String {
    format!("no model card is written from {what}: a network may have been trained on them")
}

/// The networks of the command line, and what is to be scored.
fn load(args: &EvaluateArgs) -> Result<Loaded, ModelError> {
    let Loaded { mut models, mut scored } = Loaded::default();
    for file in &args.model {
        let bytes =
            std::fs::read(file).map_err(|error| ModelError::Read { file: file.clone(), error })?;
        let text = |path: &Path| path.to_string_lossy().into_owned();
        let params = PredictParams {
            model: text(file),
            onnxruntime: args.onnxruntime.as_deref().map(text).unwrap_or_default(),
            fallback: false,
            ..PredictParams::default()
        };
        let mut network = predict::load(&params)?;
        let stem = file.file_stem().map_or_else(|| text(file), |s| s.to_string_lossy().into());
        let taken = models.iter().any(|model| model.facts.name == stem);
        let name = if taken { text(file) } else { stem };
        let facts = ModelFacts {
            name: name.clone(),
            file: file.file_name().unwrap_or_default().to_string_lossy().into(),
            bytes: bytes.len(),
            sha256: sha256(&bytes),
            metadata: network.metadata().entries.clone(),
        };
        let treatments = NetworkScored::treatments(&mut network)
            .map_err(|error| ModelError::Run { file: file.clone(), error })?;
        let mut names = Vec::new();
        for treatment in treatments {
            let network = predict::load(&params)?;
            let one = NetworkScored::new(name.clone(), network, treatment);
            names.push(one.name());
            scored.push(Box::new(one));
        }
        models.push(Model { file: file.clone(), facts, names });
    }
    Ok(Loaded { models, scored })
}

fn write_card(model: &Model, models: &[Model], evaluation: &Evaluation) -> Result<(), ReportError> {
    let others = models.iter().filter(|other| other.file != model.file);
    let others: Vec<String> = others.flat_map(|other| other.names.clone()).collect();
    let path = model.file.with_extension("md");
    let page = card(&model.facts, evaluation, &others);
    std::fs::write(&path, page).map_err(|error| ReportError::Write { path, error })
}
