//! Where a simulated drive takes place.

use std::path::PathBuf;

use super::sil::{RunError, input};
use crate::frames::{Point, Pose};
use crate::mapfile;
use crate::params::Params;
use crate::sim::car_end::scan_load;
use crate::sim::maze::{self, Family};
use crate::sim::world::World;

/// Side of a cell of a maze, metres; a map file brings its own.
pub(super) const MAZE_RESOLUTION_M: f64 = 0.1;

/// Where the walls come from.
#[derive(Clone, Debug, PartialEq)]
pub enum WorldSource {
    /// A random maze.
    Maze {
        /// Its number.
        seed: u64,
        /// Its kind.
        family: Family,
    },
    /// A ROS map_server map.
    Map {
        /// Its YAML file.
        file: PathBuf,
    },
}

impl WorldSource {
    /// What a person calls it.
    pub fn title(&self) -> String {
        match self {
            Self::Maze { seed, family } => format!("maze {seed} ({})", family.name()),
            Self::Map { file } => {
                file.file_stem().map_or_else(String::new, |name| name.to_string_lossy().into())
            }
        }
    }
}

/// Where to drive, from where and to where.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaceRequest {
    /// Where to drive.
    pub world: WorldSource,
    /// Where to begin, map frame; the maze's own start if not given. Always given with a map.
    pub start: Option<Pose>,
    /// Where to go, map frame; the maze's own goal if not given.
    pub goal: Option<Point>,
}

/// The place itself.
pub(super) struct Place {
    /// The true world.
    pub world: World,
    /// Where to begin.
    pub start: Pose,
    /// Where to go, if anybody has said so.
    goal: Option<Point>,
}

impl Place {
    /// Where to go.
    pub(super) fn needed_goal(&self) -> Result<Point, RunError> {
        self.goal.ok_or_else(|| missing("goal X,Y"))
    }
}

fn missing(what: &str) -> RunError {
    RunError::Input(format!("a map needs --{what}").into())
}

impl PlaceRequest {
    /// Makes the maze or reads the map.
    pub(super) fn place(&self) -> Result<Place, RunError> {
        match &self.world {
            WorldSource::Maze { seed, family } => {
                let maze = maze::generate(*family, *seed, MAZE_RESOLUTION_M).map_err(input)?;
                Ok(Place {
                    start: self.start.unwrap_or(maze.start),
                    goal: self.goal.or(Some(maze.goal)),
                    world: maze.world,
                })
            }
            WorldSource::Map { file } => Ok(Place {
                start: self.start.ok_or_else(|| missing("start X,Y,DEG"))?,
                goal: self.goal,
                world: World::from_map(&mapfile::load(file).map_err(input)?),
            }),
        }
    }
}

/// Above this share of the bus scans come late, and with them everything else that is not urgent.
const SCAN_LOAD_MAX: f64 = 0.8;

/// Says so if the lidar has more to say than the bus can carry.
pub(super) fn warn_of_load(params: &Params) {
    let load = scan_load(params.can.layout, &params.lidar, &params.bus);
    if load > SCAN_LOAD_MAX {
        let (beams, rate_hz) = (params.lidar.beams, params.lidar.rate_hz);
        tracing::warn!(
            "{rate_hz} scans a second of {beams} beams take {:.0} % of the bus in {} frames: lower \
             lidar.beams or lidar.rate_hz (360 beams at 10 Hz fit classic frames)",
            100.0 * load,
            params.can.layout.name()
        );
    }
}
