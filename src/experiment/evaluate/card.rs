//! The model card: what a network is, and how well it does, as a page of Markdown.

use std::fmt::Write;

use super::table::{share, span};
use super::{Evaluation, SetScores};
use crate::experiment::dataset::Settings;

/// What a network's file says about it, for the head of the card.
#[derive(Clone, Debug, PartialEq)]
pub struct ModelFacts {
    /// Its name in the scores.
    pub name: String,
    /// Its file's name, without folders.
    pub file: String,
    /// Size of the file, bytes.
    pub bytes: usize,
    /// SHA-256 of the file.
    pub sha256: String,
    /// What the file says about itself: key and value, in the order to be shown.
    pub metadata: Vec<(String, String)>,
}

/// The card of one network among those scored. Other networks are left out, baselines are shown.
pub fn card(facts: &ModelFacts, evaluation: &Evaluation, others: &[String]) -> String {
    let mut text = String::new();
    let mut line = |content: &str| {
        text.push_str(content);
        text.push('\n');
    };
    line(&format!("# {}\n", facts.file));
    line(
        "The probability that space which the car has not seen is occupied, from what it has seen.",
    );
    line("This page is written by `apexd evaluate --card`; do not edit it.\n");
    line("| | |\n|---|---|");
    line(&format!("| file | `{}`, {} bytes |", facts.file, facts.bytes));
    line(&format!("| SHA-256 | `{}` |", facts.sha256));
    for (key, value) in &facts.metadata {
        // A bar would end the cell.
        let value = value.replace('|', "\\|").replace('\n', " ");
        line(&format!("| {key} | {value} |"));
    }
    line(&format!("| scored by | apexd {} |\n", evaluation.apexd));
    line(
        "Scored are cells that a scene has not observed, within the radius of the centre of a piece \
         of the frontier. Log loss in nats a cell, with 95 % intervals that count worlds; ECE is \
         the expected calibration error over 20 bins. `docs/prediction.md` has the definitions.",
    );
    for set in &evaluation.sets {
        line("");
        line(of_set(set, others).trim_end());
    }
    text
}

fn of_set(set: &SetScores, others: &[String]) -> String {
    let mut text = String::new();
    let shown = |name: &str| !others.iter().any(|other| other == name);
    let kept = match set.held_out {
        Some(true) => "held out from training",
        Some(false) => "**not held out**",
        None => "maps",
    };
    let _ = writeln!(text, "## {}\n", set.name);
    let _ = writeln!(
        text,
        "{} scenes of {} worlds, {kept}: {}.",
        set.scenes,
        set.worlds,
        how(&set.settings)
    );
    if let Some(hash) = &set.manifest_sha256 {
        let _ = writeln!(text, "SHA-256 of the manifest: `{hash}`.");
    }
    let _ = writeln!(text, "Baselines are fitted on {}.", set.baselines_fitted_on);
    for radius in &set.radii {
        let Some(first) = radius.predictors.first() else { continue };
        let _ = writeln!(
            text,
            "\n### Within {} m: {} cells, {:.1} % occupied\n",
            radius.radius_m,
            first.scores.count,
            100.0 * first.scores.occupied
        );
        let bands: Vec<String> = first
            .by_distance
            .iter()
            .map(|band| format!(" {} m |", span(band.from_m, band.to_m)))
            .collect();
        let _ = writeln!(
            text,
            "| predictor | log loss | accuracy | AUC | ECE | log loss by distance:{}",
            bands.concat()
        );
        let _ = writeln!(text, "|---|---|---|---|---|{}", "---|".repeat(bands.len()));
        for scored in radius.predictors.iter().filter(|p| shown(&p.name)) {
            let s = &scored.scores;
            let ci = scored.log_loss_ci95.map_or_else(String::new, |ci| format!(" ± {ci:.4}"));
            let _ = write!(
                text,
                "| {} | {:.4}{ci} | {:.4} | {} | {:.4} |",
                scored.name,
                s.log_loss,
                s.accuracy,
                share(s.auc),
                s.ece
            );
            for band in &scored.by_distance {
                let _ = write!(text, " {:.4} |", band.scores.log_loss);
            }
            text.push('\n');
        }
    }
    if let Some(first) = set.edges.first() {
        let _ = writeln!(
            text,
            "\n### Edges near the frontier: {}, {:.1} % closed\n\n\
             | predictor | log loss | accuracy | AUC |\n|---|---|---|---|",
            first.near.count,
            100.0 * first.near.occupied
        );
        for edges in set.edges.iter().filter(|e| shown(&e.name)) {
            let s = &edges.near;
            let _ = writeln!(
                text,
                "| {} | {:.4} | {:.4} | {} |",
                edges.name,
                s.log_loss,
                s.accuracy,
                share(s.auc)
            );
        }
    }
    if !set.maps.is_empty() {
        let _ = writeln!(text, "\n| map | scenes | SHA-256 of its cells |\n|---|---|---|");
        for map in &set.maps {
            // Where the file lay is nobody's business.
            let name = map.file.rsplit(['/', '\\']).next().unwrap_or_default();
            let _ = writeln!(text, "| {name} | {} | `{}` |", map.scenes, map.sha256);
        }
    }
    text
}

/// How scenes were made, in words.
pub(super) fn how(settings: &Settings) -> String {
    let [from, end] = settings.seeds;
    let mazes = if from < end {
        format!("{} mazes, seeds {from} to {}, ", settings.families.join(", "), end - 1)
    } else {
        String::new()
    };
    let ranges: Vec<String> = settings.lidar_ranges_m.iter().map(f64::to_string).collect();
    format!(
        "{mazes}world cells of {} m, lidar {} m with {} beams, {:.0} % of the maps built along \
         drives of up to {} m, clearance {} m, seed {}",
        settings.world_resolution_m,
        ranges.join(" or "),
        settings.beams,
        100.0 * settings.along_drive,
        settings.drive_max_m,
        settings.clearance_m,
        settings.seed
    )
}
