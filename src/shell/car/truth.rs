//! The truth, line by line, for whoever judges the drive. Each line is written whole and at once,
//! so that a process that is killed leaves a file that can be read.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::{CarEnding, failed, input, shown};
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::shell::sil::RunError;
use crate::sim::solo::Record;

/// The first line.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct World {
    /// Where the car begins: metres and radians, map frame.
    start: [f64; 3],
    /// Where it is to go: metres, map frame.
    goal: [f64; 2],
    /// How near to the goal counts as there, metres.
    goal_radius_m: f64,
    /// The car's radius, metres.
    radius_m: f64,
    /// The interface.
    can: String,
    /// What is spoken on it.
    layout: &'static str,
}

impl World {
    /// What the drive begins with.
    pub fn of(params: &Params, (start, goal): (Pose, Point)) -> Self {
        Self {
            start: [start.position.x, start.position.y, start.heading_rad],
            goal: [goal.x, goal.y],
            goal_radius_m: params.autopilot.goal_radius_m,
            radius_m: params.vehicle.radius_m,
            can: params.can.interface.clone(),
            layout: params.can.layout.name(),
        }
    }
}

/// A line with its kind.
#[derive(Serialize)]
struct Line<'a, T> {
    kind: &'static str,
    #[serde(flatten)]
    content: &'a T,
}

/// The file, if one is wanted.
pub struct Truth {
    file: Option<(PathBuf, BufWriter<File>)>,
    line: Vec<u8>,
}

#[derive(Debug, thiserror::Error)]
#[error("cannot write the truth to {path}: {error}")]
struct WriteError {
    path: String,
    error: std::io::Error,
}

impl Truth {
    /// Makes the file anew.
    pub fn create(path: Option<&Path>) -> Result<Self, RunError> {
        let open = |path: &Path| {
            let file = File::create(path)
                .map_err(|error| input(WriteError { path: shown(path), error }))?;
            Ok((path.to_owned(), BufWriter::new(file)))
        };
        Ok(Self { file: path.map(open).transpose()?, line: Vec::new() })
    }

    /// The first line.
    pub fn world(&mut self, world: &World) -> Result<(), RunError> {
        self.write(&Line { kind: "world", content: world })?;
        self.flush()
    }

    /// A line of the drive; it is in the file after the next flush.
    pub fn record(&mut self, record: &Record) -> Result<(), RunError> {
        self.write(record)
    }

    /// The last line.
    pub fn end(&mut self, ending: &CarEnding) -> Result<(), RunError> {
        self.write(&Line { kind: "end", content: ending })?;
        self.flush()
    }

    fn write(&mut self, line: &impl Serialize) -> Result<(), RunError> {
        let Some((path, file)) = &mut self.file else { return Ok(()) };
        self.line.clear();
        serde_json::to_writer(&mut self.line, line).expect("a record is plain data");
        self.line.push(b'\n');
        // A line that does not fit the buffer any more is not torn apart.
        let full = file.buffer().len() + self.line.len() > file.capacity();
        let written = if full { file.flush() } else { Ok(()) };
        written
            .and_then(|()| file.write_all(&self.line))
            .map_err(|error| failed(WriteError { path: shown(path), error }))
    }

    /// Writes what is left.
    pub fn flush(&mut self) -> Result<(), RunError> {
        let Some((path, file)) = &mut self.file else { return Ok(()) };
        file.flush().map_err(|error| failed(WriteError { path: shown(path), error }))
    }
}
