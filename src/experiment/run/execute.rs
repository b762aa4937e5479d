//! Driving what is described.

use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use super::figures::WallTimes;
use super::record::{Drive, Record};
use super::spec::{RunSpec, SpecError, Task, WorldSpec};
use crate::experiment::floor;
use crate::frames::{Point, Pose};
use crate::mapfile::{self, MapFileError};
use crate::plan::{Policy, Stopwatch};
use crate::predict::PredictorKind;
use crate::sim::drive::{Outcome, Trace};
use crate::sim::maze::{self, Family};
use crate::sim::rig::{Rig, RigSetup, SetupError, Snapshot};
use crate::sim::world::World;
use crate::wire::can::Layout;

/// What driving needs from outside.
pub struct Tools<'a> {
    /// A clock for the statistics, one for each drive.
    pub stopwatch: &'a (dyn Fn() -> Stopwatch + Sync),
    /// Set when a person wants everything to end.
    pub stop: &'a AtomicBool,
    /// Name and version of this program.
    pub program: &'a str,
}

/// A drive that has ended.
pub struct Driven {
    /// Its figures.
    pub record: Record,
    /// What was foreseen at a few moments, if the course is kept and something is foreseen.
    pub snapshots: Vec<Snapshot>,
    /// Where it went.
    pub place: Place,
}

/// Why there was no drive.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The description makes no sense to this program.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// The map cannot be read.
    #[error("{file}: {error}")]
    Map {
        /// Its file.
        file: String,
        /// What is wrong.
        error: Box<MapFileError>,
    },
    /// A map comes without start or goal.
    #[error("a map needs a start and a goal")]
    NoTask,
    /// World, start, goal or predictor do not do.
    #[error(transparent)]
    Setup(#[from] SetupError),
}

/// Where to drive.
#[derive(Clone, Debug)]
pub struct Place {
    /// The true world.
    pub world: World,
    /// From where.
    pub start: Pose,
    /// To where.
    pub goal: Point,
}

/// World, start and goal of a drive.
///
/// # Errors
/// If there is no such world, or a map is given without start and goal.
pub fn place(spec: &RunSpec) -> Result<Place, RunError> {
    match &spec.world {
        WorldSpec::Maze { family, seed } => {
            let named = Family::from_name(family);
            let family = named.ok_or_else(|| SpecError::Family { name: family.clone() })?;
            let maze = maze::generate(family, *seed, maze::RESOLUTION_M)
                .expect("the usual resolution divides the hallway");
            Ok(Place {
                start: spec.start_pose().unwrap_or(maze.start),
                goal: spec.goal_point().unwrap_or(maze.goal),
                world: maze.world,
            })
        }
        WorldSpec::Map { file } => {
            let map = mapfile::load(Path::new(file))
                .map_err(|error| RunError::Map { file: file.clone(), error: Box::new(error) })?;
            let (Some(start), Some(goal)) = (spec.start_pose(), spec.goal_point()) else {
                return Err(RunError::NoTask);
            };
            Ok(Place { world: World::from_map(&map), start, goal })
        }
    }
}

/// Drives; `None` if a person wanted an end before it was reached.
///
/// # Errors
/// If the description makes no sense, or the drive cannot begin.
pub fn execute(task: &Task, tools: &Tools<'_>) -> Result<Option<Driven>, RunError> {
    let place = place(&task.spec)?;
    let mut rig = rig(&task.spec, &place, tools)?;
    let foresees = task.spec.policy != Policy::KnownMap.name()
        && task.spec.predictor != PredictorKind::None.name();
    if task.keep.course && foresees {
        rig.keep_snapshot(None);
    }
    rig.keep_reports();
    let mut wall = WallTimes::default();
    let clock = (tools.stopwatch)();
    let begin = clock();
    while rig.outcome().is_none() {
        if tools.stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        rig.step();
        for (_, report) in rig.take_reports() {
            wall.add(&report.times);
        }
    }
    let summary = rig.summary(clock().saturating_sub(begin).as_secs_f64());
    let drive = Drive::from(&summary);
    let unsolved = !matches!(drive.outcome, Outcome::Goal | Outcome::Collision);
    let reference = if task.keep.reference && unsolved {
        let Some(reference) = known_map(&task.spec, &place, tools)? else { return Ok(None) };
        Some(reference)
    } else {
        None
    };
    let floor = (task.keep.floor && drive.outcome == Outcome::Goal)
        .then(|| {
            let params = task.spec.params()?;
            Ok::<_, SpecError>(floor::safe_floor(&place.world, rig.trace(), &params))
        })
        .transpose()?
        .flatten();
    let snapshots = rig.snapshots();
    let quarter = |k: usize| snapshots.get(snapshots.len() * k / 4).cloned();
    let record = Record {
        key: task.key(),
        program: tools.program.to_owned(),
        task: task.clone(),
        command: task.spec.command(),
        drive,
        reference,
        floor,
        course: if task.keep.course { course(rig.trace()) } else { Vec::new() },
        wall,
        realtime_factor: summary.realtime_factor,
    };
    Ok(Some(Driven { record, snapshots: (1..4).filter_map(quarter).collect(), place }))
}

/// The same drive over the map that is known from the start.
fn known_map(spec: &RunSpec, place: &Place, tools: &Tools<'_>) -> Result<Option<Drive>, RunError> {
    let spec = RunSpec {
        policy: Policy::KnownMap.name().into(),
        predictor: PredictorKind::None.name().into(),
        ..spec.clone()
    };
    let mut rig = rig(&spec, place, tools)?;
    while rig.outcome().is_none() {
        if tools.stop.load(Ordering::Relaxed) {
            return Ok(None);
        }
        rig.step();
    }
    Ok(Some(Drive::from(&rig.summary(0.0))))
}

fn rig(spec: &RunSpec, place: &Place, tools: &Tools<'_>) -> Result<Rig, RunError> {
    let params = spec.params()?;
    Ok(Rig::new(RigSetup {
        layout: Layout::Fd,
        seed: spec.seed,
        latency: spec.latency.latency(),
        stopwatch: (tools.stopwatch)(),
        ..RigSetup::new(&params, place.world.clone(), place.start, Some(place.goal))
    })?)
}

/// Samples this far apart are enough for a picture, metres.
const COURSE_STEP_M: f64 = 0.2;

fn course(trace: &Trace) -> Vec<[f32; 3]> {
    let mut course: Vec<[f32; 3]> = Vec::new();
    let mut last: Option<Point> = None;
    for sample in &trace.samples {
        let at = sample.pose.position;
        if last.is_none_or(|last| (at - last).norm() >= COURSE_STEP_M) {
            last = Some(at);
            // Three decimals are a millimetre.
            let round = |v: f64| ((v * 1e3).round() / 1e3) as f32;
            course.push([round(at.x), round(at.y), round(sample.speed_mps)]);
        }
    }
    course
}
