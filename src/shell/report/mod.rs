//! A drive as a person sees it: the map with the path on it, speed and forces over time, and the
//! figures as JSON.
//!
//! Pictures are composed as SVG and rasterised with a font that is part of the program, so that
//! they look the same on a machine without any fonts.

mod axes;
mod colour;
mod colour_bar;
mod drive;
mod evaluation;
pub mod experiment;
mod outline;
mod prediction;
mod raster;
mod speed;
mod svg;

use std::path::{Path, PathBuf};

pub use evaluation::write_evaluation;
pub use outline::outline;

use crate::frames::{Point, Pose};
use crate::map::Grid;
use crate::sim::drive::{Outcome, Summary, Trace};
use crate::sim::rig::Snapshot;

/// A finished drive with everything that the report shows of it.
#[derive(Clone, Debug)]
pub struct DriveRecord {
    /// What was driven, for the second line of the title: world, policy, predictor.
    pub title: String,
    /// The figures.
    pub summary: Summary,
    /// The course.
    pub trace: Trace,
    /// The map that the car knew at the end.
    pub grid: Grid,
    /// Where solid and free touch in the true world, map frame (see [`outline`]); empty if it is
    /// not to be drawn.
    pub truth: Vec<[Point; 2]>,
    /// What the planner foresaw at one moment; nothing if it never planned.
    pub snapshot: Option<Snapshot>,
    /// Where the drive began, map frame.
    pub start: Pose,
    /// Where it was to end, map frame.
    pub goal: Point,
    /// How far from the goal counts as reached, metres.
    pub goal_radius_m: f64,
    /// The largest speed that the planner was allowed, m/s.
    pub speed_limit_mps: f64,
    /// The largest force that the tyres transmit, newtons.
    pub force_limit_n: f64,
}

/// What a picture of one moment shows besides that moment.
#[derive(Clone, Copy, Debug)]
pub struct Scenery<'a> {
    /// What was driven, for the second line of the title.
    pub title: &'a str,
    /// Where solid and free touch in the true world, map frame.
    pub truth: &'a [[Point; 2]],
    /// Where the drive is to end, map frame.
    pub goal: Point,
    /// How far from the goal counts as reached, metres.
    pub goal_radius_m: f64,
}

impl DriveRecord {
    fn scenery(&self) -> Scenery<'_> {
        Scenery {
            title: &self.title,
            truth: &self.truth,
            goal: self.goal,
            goal_radius_m: self.goal_radius_m,
        }
    }
}

/// Writes what was foreseen at one moment as `NAME.svg` and `NAME.png` into a folder that exists.
pub fn write_snapshot(
    folder: &Path,
    name: &str,
    scenery: &Scenery<'_>,
    snapshot: &Snapshot,
) -> Result<(), ReportError> {
    let svg = prediction::picture(scenery, snapshot)?;
    put(&folder.join(format!("{name}.svg")), svg.as_bytes())?;
    put(&folder.join(format!("{name}.png")), &raster::png("prediction", &svg)?)
}

fn put(path: &Path, bytes: &[u8]) -> Result<(), ReportError> {
    std::fs::write(path, bytes).map_err(|error| ReportError::Write { path: path.to_owned(), error })
}

/// Why a report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A folder or file could not be written.
    #[error("cannot write {path}: {error}", path = .path.display())]
    Write {
        /// The folder or file.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// A picture could not be rasterised.
    #[error("cannot draw {what}: {why}")]
    Draw {
        /// The picture.
        what: &'static str,
        /// What went wrong.
        why: String,
    },
}

/// How a drive ended, in words.
pub fn outcome_text(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Goal => "Goal reached",
        Outcome::Stuck => "Stuck",
        Outcome::Timeout => "Time ran out",
        Outcome::Collision => "Collision",
        Outcome::Unreachable => "Goal unreachable",
        Outcome::Interrupted => "Interrupted",
    }
}

/// Writes `drive.svg`, `drive.png`, `speed.svg`, `speed.png`, with a snapshot also `prediction.svg`
/// and `prediction.png`, and `summary.json` into a folder, which is made if need be, and returns
/// their paths.
pub fn write(folder: &Path, record: &DriveRecord) -> Result<Vec<PathBuf>, ReportError> {
    let fail = |path: &Path, error| ReportError::Write { path: path.to_owned(), error };
    std::fs::create_dir_all(folder).map_err(|error| fail(folder, error))?;
    let mut written = Vec::new();
    let mut put = |name: &str, bytes: &[u8]| {
        let path = folder.join(name);
        std::fs::write(&path, bytes).map_err(|error| fail(&path, error))?;
        written.push(path);
        Ok(())
    };
    let mut pictures = vec![("drive", drive::picture(record)?), ("speed", speed::picture(record))];
    if let Some(snapshot) = &record.snapshot {
        pictures.push(("prediction", prediction::picture(&record.scenery(), snapshot)?));
    }
    for (name, svg) in pictures {
        put(&format!("{name}.svg"), svg.as_bytes())?;
        put(&format!("{name}.png"), &raster::png(name, &svg)?)?;
    }
    let json = serde_json::to_string_pretty(&record.summary).expect("a summary is plain data");
    put("summary.json", format!("{json}\n").as_bytes())?;
    Ok(written)
}
