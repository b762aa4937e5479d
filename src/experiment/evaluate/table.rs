//! Scores as a table for a terminal.

use std::fmt::Write;

use super::{EdgeScores, Evaluation, Scored, Scores, SetScores};

/// All scores, without a line break at the end.
pub fn table(evaluation: &Evaluation) -> String {
    let sets: Vec<String> = evaluation.sets.iter().map(of_set).collect();
    sets.join("\n\n")
}

fn of_set(set: &SetScores) -> String {
    let mut text = String::new();
    let kept = match set.held_out {
        Some(true) => ", held out",
        Some(false) => ", NOT held out: networks may have been trained on them",
        None => "",
    };
    let _ = write!(
        text,
        "{}: {} scenes of {} worlds{kept}; baselines fitted on {}",
        set.name, set.scenes, set.worlds, set.baselines_fitted_on
    );
    for radius in &set.radii {
        let cells = radius.predictors.first().map_or(0, |p| p.scores.count);
        let _ =
            write!(text, "\n\n  {:<36}", format!("within {} m ({cells} cells)", radius.radius_m));
        let _ = write!(text, "{:>18}{:>10}{:>8}{:>8}", "log loss", "accuracy", "AUC", "ECE");
        if let Some(first) = radius.predictors.first() {
            let _ = write!(text, "   log loss less that of {}", first.name);
        }
        for scored in &radius.predictors {
            let _ = write!(text, "\n    {:<34}{}", scored.name, of_scored(scored));
        }
        let _ = write!(text, "\n  {:<36}", "log loss by distance");
        if let Some(first) = radius.predictors.first() {
            for band in &first.by_distance {
                let _ = write!(text, "{:>10}", span(band.from_m, band.to_m));
            }
        }
        for scored in &radius.predictors {
            let _ = write!(text, "\n    {:<34}", scored.name);
            for band in &scored.by_distance {
                let _ = write!(text, "{:>10.4}", band.scores.log_loss);
            }
        }
    }
    if let Some(first) = set.edges.first() {
        let head = format!(
            "edges near the frontier ({}, {:.1} % closed)",
            first.near.count,
            100.0 * first.near.occupied
        );
        let _ = write!(text, "\n\n  {head:<46}");
        let _ = write!(text, "{:>8}{:>10}{:>8}{:>8}", "log loss", "accuracy", "AUC", "ECE");
        let _ = write!(text, "   AUC by distance");
        for band in &first.by_distance {
            let _ = write!(text, " {}", span(band.from_m, band.to_m));
        }
        for edges in &set.edges {
            let _ = write!(text, "\n    {:<42}{}", edges.name, of_edges(edges));
        }
    }
    text
}

fn of_scored(scored: &Scored) -> String {
    let interval = scored.log_loss_ci95.map_or_else(String::new, |ci| format!(" ± {ci:.4}"));
    let against = scored.against_first.map_or_else(String::new, |d| {
        let interval = d.ci95.map_or_else(String::new, |ci| format!(" ± {ci:.4}"));
        format!("   {:+.4}{interval}", d.mean)
    });
    let Scores { log_loss, accuracy, auc, ece, .. } = scored.scores;
    let log_loss = format!("{log_loss:.4}{interval}");
    format!("{log_loss:>18}{accuracy:>10.4}{:>8}{ece:>8.4}{against}", share(auc))
}

fn of_edges(edges: &EdgeScores) -> String {
    let Scores { log_loss, accuracy, auc, ece, .. } = edges.near;
    let mut text = format!("{log_loss:>8.4}{accuracy:>10.4}{:>8}{ece:>8.4}   ", share(auc));
    for band in &edges.by_distance {
        let _ = write!(text, "{:>8}", share(band.scores.auc));
    }
    text
}

/// A share that may be missing.
pub(super) fn share(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |v| format!("{v:.4}"))
}

/// A band of distances in metres.
pub(super) fn span(from_m: f64, to_m: Option<f64>) -> String {
    to_m.map_or_else(|| format!("{from_m}-"), |to_m| format!("{from_m}-{to_m}"))
}
