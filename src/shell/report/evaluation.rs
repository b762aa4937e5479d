//! Scores as pictures: what was foreseen beside what is there, and reliability diagrams.

use std::path::{Path, PathBuf};

use super::axes::{Frame, ticks};
use super::colour::{INK, Rgb, SOFT_INK};
use super::drive::cell_layer;
use super::svg::{Anchor, Svg};
use super::{ReportError, raster};
use crate::experiment::dataset::NO_TARGET;
use crate::experiment::evaluate::{Evaluation, RadiusScores, Sample, Scored, SetScores};
use crate::map::{Cell, CellIndex, CellRect};
use crate::predict::lattice::{CROP_CELLS, CROP_CENTRE};

const SEEN_FREE: Rgb = Rgb(218, 232, 247);
const SEEN_WALL: Rgb = Rgb(27, 74, 138);
const NOT_ASKED: Rgb = Rgb(244, 234, 205);
const FRONTIER: &str = "#d01c5b";
const CAR: &str = "#0a8a3c";

/// Side of one panel, pixels.
const PANEL: f64 = 312.0;
const GAP: f64 = 18.0;
const MARGIN: f64 = 30.0;

/// Most predictors in one picture.
const SHOWN_MAX: usize = 5;

/// Colours of Okabe and Ito ("Color universal design", 2008), told apart by colour-blind eyes.
const LINES: [&str; 7] =
    ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#20242c"];

/// Reliability bins with fewer cells than this scatter too much to be shown.
const BIN_MIN: u64 = 30;

/// Writes `evaluation.json`, a reliability diagram for each set and a picture of each sample into
/// a folder that exists, and returns their paths.
pub fn write_evaluation(
    folder: &Path,
    evaluation: &Evaluation,
    samples: &[Sample],
) -> Result<Vec<PathBuf>, ReportError> {
    let mut written = Vec::new();
    let mut put = |name: String, bytes: &[u8]| {
        let path = folder.join(name);
        std::fs::write(&path, bytes)
            .map_err(|error| ReportError::Write { path: path.clone(), error })?;
        written.push(path);
        Ok::<(), ReportError>(())
    };
    let json = serde_json::to_string_pretty(evaluation).expect("scores are plain data");
    put("evaluation.json".into(), format!("{json}\n").as_bytes())?;
    for set in &evaluation.sets {
        let (name, svg) = (file_name(&set.name), reliability(set));
        put(format!("reliability-{name}.svg"), svg.as_bytes())?;
        put(format!("reliability-{name}.png"), &raster::png("reliability", &svg)?)?;
        for (k, sample) in samples.iter().filter(|s| s.set == set.name).enumerate() {
            let svg = picture(sample)?;
            put(format!("scene-{name}-{k}.svg"), svg.as_bytes())?;
            put(format!("scene-{name}-{k}.png"), &raster::png("scene", &svg)?)?;
        }
    }
    Ok(written)
}

/// A set's name as part of a file's name.
fn file_name(name: &str) -> String {
    let mut text = String::new();
    for c in name.chars() {
        if c.is_ascii_alphanumeric() {
            text.push(c.to_ascii_lowercase());
        } else if !text.ends_with('-') {
            text.push('-');
        }
    }
    text.trim_matches('-').to_owned()
}

/// One scene: what is there, and what each predictor says.
fn picture(sample: &Sample) -> Result<String, ReportError> {
    let shown = &sample.predictions[..sample.predictions.len().min(SHOWN_MAX)];
    let panels = 1 + shown.len();
    let columns = panels.min(3);
    let rows = panels.div_ceil(columns);
    let width = 2.0 * MARGIN + columns as f64 * (PANEL + GAP) - GAP;
    let height = 76.0 + rows as f64 * (PANEL + 34.0) + 50.0;
    let mut svg = Svg::new(width, height);
    let (family, number) = sample.world;
    let kind = ["thin maze", "solid maze", "branching maze", "map"][usize::from(family.min(3))];
    let title = format!("{} · {kind} {number}", sample.set);
    svg.text([MARGIN, 36.0], 20.0, Anchor::Start, INK, &title);

    let half = CROP_CENTRE as f64 * sample.view.crop.resolution_m;
    for panel in 0..panels {
        let (column, row) = ((panel % columns) as f64, (panel / columns) as f64);
        let corner = [MARGIN + column * (PANEL + GAP), 76.0 + row * (PANEL + 34.0)];
        let frame = Frame { corner, size: [PANEL, PANEL], x: [-half, half], y: [-half, half] };
        let (name, prediction) = match panel.checked_sub(1) {
            None => ("what is there", None),
            Some(k) => (shown[k].0.as_str(), Some(&shown[k].1)),
        };
        svg.text([corner[0], corner[1] - 8.0], 14.0, Anchor::Start, INK, name);
        let all = CellRect { x0: 0, y0: 0, x1: CROP_CELLS as i32, y1: CROP_CELLS as i32 };
        cell_layer(&mut svg, &frame, all, |c| cell_colour(sample, prediction, c))?;
        marks(&mut svg, &frame, sample);
        svg.rect(corner, frame.size, &format!("fill=\"none\" stroke=\"{SOFT_INK}\""));
    }
    legend(&mut svg, [MARGIN, height - 26.0]);
    Ok(svg.finish())
}

fn cell_colour(sample: &Sample, prediction: Option<&Vec<f32>>, c: CellIndex) -> Rgb {
    let k = c.iy as usize * CROP_CELLS + c.ix as usize;
    match sample.view.crop.cells[k] {
        Cell::Free => return SEEN_FREE,
        Cell::Occupied => return SEEN_WALL,
        Cell::Unknown => {}
    }
    match prediction {
        Some(p) if p[k].is_nan() => NOT_ASKED,
        Some(p) => grey(p[k]),
        None if sample.view.truth[k] == NO_TARGET => NOT_ASKED,
        None => grey(f32::from(sample.view.truth[k])),
    }
}

/// White for free, dark for occupied.
fn grey(p: f32) -> Rgb {
    let v = (255.0 - 215.0 * p.clamp(0.0, 1.0)).round() as u8;
    Rgb(v, v, v)
}

fn marks(svg: &mut Svg, frame: &Frame, sample: &Sample) {
    let place = |[column, row]: [usize; 2]| {
        let [x, y] = sample.view.crop.centre(column, row);
        frame.place(f64::from(x), f64::from(y))
    };
    let ring = format!("fill=\"none\" stroke=\"{FRONTIER}\" stroke-width=\"2\"");
    for centre in &sample.view.centres {
        svg.circle(place(*centre), 4.0, &ring);
    }
    let car = place([CROP_CENTRE, CROP_CENTRE]);
    svg.circle(car, 4.5, &format!("fill=\"{CAR}\" stroke=\"#fff\" stroke-width=\"1.5\""));
}

fn legend(svg: &mut Svg, [mut x, y]: [f64; 2]) {
    let swatch = |svg: &mut Svg, x: f64, fill: String| {
        let style = format!("fill=\"{fill}\" stroke=\"{SOFT_INK}\" stroke-width=\"0.8\"");
        svg.rect([x, y - 10.0], [14.0, 12.0], &style);
    };
    svg.circle([x + 7.0, y - 4.0], 4.5, &format!("fill=\"{CAR}\""));
    svg.text([x + 20.0, y], 13.0, Anchor::Start, INK, "car");
    x += 62.0;
    svg.circle(
        [x + 7.0, y - 4.0],
        4.0,
        &format!("fill=\"none\" stroke=\"{FRONTIER}\" stroke-width=\"2\""),
    );
    svg.text([x + 20.0, y], 13.0, Anchor::Start, INK, "frontier");
    x += 92.0;
    let entries = [
        (SEEN_FREE, "seen free", 92.0),
        (SEEN_WALL, "seen wall", 92.0),
        (grey(0.0), "free", 58.0),
        (grey(0.5), "even", 62.0),
        (grey(1.0), "occupied", 90.0),
        (NOT_ASKED, "not asked, or nobody knows", 80.0),
    ];
    for (colour, name, width) in entries {
        swatch(svg, x, colour.hex());
        svg.text([x + 20.0, y], 13.0, Anchor::Start, INK, name);
        x += width;
    }
}

/// Share of occupied cells against predicted probability, for each radius.
fn reliability(set: &SetScores) -> String {
    const SIZE: f64 = 400.0;
    const LEFT: f64 = 78.0;
    let panels = set.radii.len() as f64;
    let predictors = set.radii.first().map_or(0, |r| r.predictors.len());
    let top = 70.0;
    let bottom = top + SIZE + 62.0;
    let height = bottom + 20.0 * predictors as f64 + 14.0;
    let mut svg = Svg::new(LEFT + panels * (SIZE + LEFT), height);
    svg.text([LEFT, 34.0], 20.0, Anchor::Start, INK, &format!("Reliability: {}", set.name));
    for (k, radius) in set.radii.iter().enumerate() {
        let corner = [LEFT + k as f64 * (SIZE + LEFT), top];
        let frame = Frame { corner, size: [SIZE, SIZE], x: [0.0, 1.0], y: [0.0, 1.0] };
        reliability_panel(&mut svg, &frame, radius);
        let at = [corner[0], bottom];
        reliability_key(&mut svg, at, radius);
    }
    svg.finish()
}

fn reliability_panel(svg: &mut Svg, frame: &Frame, radius: &RadiusScores) {
    let head = format!("within {} m of the frontier", radius.radius_m);
    svg.text([frame.corner[0], frame.corner[1] - 10.0], 14.0, Anchor::Start, SOFT_INK, &head);
    let marks = ticks([0.0, 1.0], 5);
    frame.draw_grid(svg, &marks, &marks);
    let [a, b] = [frame.place(0.0, 0.0), frame.place(1.0, 1.0)];
    svg.line(a, b, &format!("stroke=\"{SOFT_INK}\" stroke-dasharray=\"4 4\""));
    for (scored, colour) in radius.predictors.iter().zip(LINES.iter().cycle()) {
        let points = points(scored);
        let line = points.iter().map(|(p, occupied, _)| frame.place(*p, *occupied));
        let style = format!("fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.8\"");
        svg.chain(line, &style);
        let all = scored.scores.count as f64;
        for (p, occupied, count) in points {
            // The area shows how many cells there are, never so small as to vanish.
            let size = 2.0 + 7.0 * (count as f64 / all).sqrt();
            svg.circle(frame.place(p, occupied), size, &format!("fill=\"{colour}\""));
        }
    }
    frame.draw_y(svg, &marks, "share that is occupied");
    frame.draw_x(svg, &marks, "predicted probability");
}

/// Mean probability, share and count of the bins that say something.
fn points(scored: &Scored) -> Vec<(f64, f64, u64)> {
    let bins = scored.reliability.iter().filter(|bin| bin.count >= BIN_MIN);
    bins.map(|bin| (bin.predicted, bin.occupied, bin.count)).collect()
}

fn reliability_key(svg: &mut Svg, [x, y]: [f64; 2], radius: &RadiusScores) {
    for (k, (scored, colour)) in radius.predictors.iter().zip(LINES.iter().cycle()).enumerate() {
        let y = y + 20.0 * k as f64;
        svg.line([x, y], [x + 22.0, y], &format!("stroke=\"{colour}\" stroke-width=\"3\""));
        let text = format!(
            "{}: log loss {:.4}, ECE {:.4}",
            scored.name, scored.scores.log_loss, scored.scores.ece
        );
        svg.text([x + 30.0, y + 4.5], 13.0, Anchor::Start, INK, &text);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiment::dataset::Settings;
    use crate::experiment::evaluate::{Request, SceneSource, SetRequest, evaluate};

    #[test]
    fn every_set_and_sample_gets_its_files() {
        let settings = |seeds: [u64; 2]| Settings {
            families: vec!["branching".into()],
            seeds,
            scenes_per_world: 2,
            resolution_m: 0.25,
            world_resolution_m: 0.25,
            lidar_ranges_m: vec![5.0],
            beams: 720,
            along_drive: 0.0,
            drive_max_m: 10.0,
            clearance_m: 0.5,
            held_out: seeds[0] >= 1_000_000,
            seed: 1,
        };
        let made = |seeds| SceneSource::Made { settings: settings(seeds), maps: Vec::new() };
        let set = SetRequest {
            name: "branching & more".into(),
            scenes: made([1_000_000, 1_000_002]),
            fit: Some(made([0, 2])),
        };
        let request = Request { sets: vec![set], radii_m: vec![5.0, 2.5], pictures: 2 };
        let (evaluation, samples) = evaluate(&request, &mut [], &|_, _| {}).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let written = write_evaluation(folder.path(), &evaluation, &samples).unwrap();
        assert_eq!(written.len(), 1 + 2 + 4);
        for path in &written {
            assert!(std::fs::metadata(path).unwrap().len() > 1000, "{}", path.display());
        }
        assert!(folder.path().join("scene-branching-more-1.png").exists());
        let json = std::fs::read_to_string(folder.path().join("evaluation.json")).unwrap();
        let json: serde_json::Value = serde_json::from_str(&json).unwrap();
        assert_eq!(json["sets"][0]["scenes"], 4);
    }
}
