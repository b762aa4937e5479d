//! `apexd evaluate`.

use std::io::Write;
use std::path::Path;

use super::cli::EvaluateArgs;
use super::progress::Terminal;
use super::report::{ReportError, write_evaluation};
use super::{Exit, complain, folder, say};
use crate::experiment::dataset::DatasetError;
use crate::experiment::evaluate::{
    EvaluateError, Evaluation, Probabilities, Sample, evaluate, table,
};

/// Scores, and says and draws the scores.
pub fn run(args: &EvaluateArgs, terminal: &Terminal, out: &mut dyn Write) -> Exit {
    let request = args.request();
    if request.sets.is_empty() {
        complain("there is nothing to score on: give --family, --maps or --dataset");
        return Exit::Usage;
    }
    if let Some(Err(error)) = args.out.as_deref().map(|out| folder::prepare(Some(out))) {
        complain(&error.to_string());
        return Exit::Usage;
    }
    let mut models: Vec<Box<dyn Probabilities>> = Vec::new();
    let bar = terminal.count_bar("scenes");
    let scored = evaluate(&request, &mut models, &|done, total| bar.show(done, total));
    bar.finish();
    let (evaluation, samples) = match scored {
        Ok(scored) => scored,
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
    match args.out.as_deref().map(|out| write(out, &evaluation, &samples)) {
        Some(Err(error)) => {
            complain(&error.to_string());
            Exit::Failed
        }
        _ => Exit::Done,
    }
}

fn write(folder: &Path, evaluation: &Evaluation, samples: &[Sample]) -> Result<(), ReportError> {
    write_evaluation(folder, evaluation, samples).map(|_| ())
}
