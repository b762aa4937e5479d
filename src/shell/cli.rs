//! The command line's grammar.

mod run;

use std::path::{Path, PathBuf};

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use clap::{ArgAction, Args, Parser, Subcommand};

pub use run::RunArgs;

use super::car::CarRequest;
use super::configuration::Flag;
use super::experiment::args::ExperimentArgs;
use super::mavlink::LinkUrl;
use super::place::{PlaceRequest, WorldSource};
use super::sil::SilRequest;
use crate::experiment::dataset::{HELD_OUT_FROM, Settings};
use crate::experiment::evaluate::{Request, SceneSource, SetRequest};
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::maze::Family;
use crate::sim::rig::Latency;
use crate::tunable::{Field, Value};
use crate::wire::can::Layout;

/// Drives an RC-scale car fast and safely through places it has never seen.
///
/// Exit codes: 0 done and goal reached; 1 the run failed (stuck, out of time, collision,
/// unreachable); 2 bad usage or bad input; 75 a ground station asked for a restart; 78 bad
/// configuration (file, environment or --set).
#[derive(Debug, Parser)]
#[command(name = "apexd", version)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Log more to standard error; twice for even more.
    #[arg(short, long, global = true, action = ArgAction::Count)]
    pub verbose: u8,
}

/// What the program can do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Drive a simulated car to a goal.
    Sil(Box<SilArgs>),
    /// Drive the car on a CAN bus: the daemon.
    Run(Box<RunArgs>),
    /// Be the simulated car on a CAN interface.
    ///
    /// In real time, with the worlds, the lidar and the controller of `apexd sil`; the daemon
    /// (`apexd run`) is another process. The car starts when it is told to and the drive is over
    /// when it has stood at the goal for a second.
    Car(Box<CarArgs>),
    /// Write a maze as ROS map_server files.
    Maze(MazeArgs),
    /// Make training or held-out data for the predictor.
    Dataset(Box<DatasetArgs>),
    /// Score what predicts occupancy, on scenes that it has not seen.
    Evaluate(Box<EvaluateArgs>),
    /// Re-run the paper's experiments, or look for unsafe drives at random.
    Experiment(ExperimentArgs),
    /// Feed the log of a drive to the autopilot again, and compare what it does.
    ///
    /// The log is one of `apexd sil --log` or of the daemon (`apexd run`). Exit codes: 0 everything
    /// is to the last bit what it was (or --set was given), 1 something differs or a part of the log
    /// is missing, 2 the log cannot be read or replayed.
    Replay(ReplayArgs),
    /// Print the table of parameters.
    Params(ParamsArgs),
    /// Say what is wrong with a configuration file.
    Check(CheckArgs),
}

/// The world of a drive, its start and its goal.
#[derive(Args, Clone, Debug)]
pub struct WorldArgs {
    /// Drive through the random maze with this number.
    #[arg(long, value_name = "SEED", default_value_t = 1, help_heading = "World")]
    pub maze: u64,
    /// Kind of maze.
    #[arg(
        long,
        value_parser = family(),
        default_value = Family::Thin.name(),
        help_heading = "World"
    )]
    pub family: Family,
    /// Drive through a ROS map_server map instead of a maze.
    #[arg(
        long,
        value_name = "FILE.yaml",
        conflicts_with_all = ["maze", "family"],
        requires = "start",
        help_heading = "World"
    )]
    pub map: Option<PathBuf>,
    /// Where the car begins: metres in the map frame, degrees counter-clockwise from map x. A maze
    /// has a start of its own.
    #[arg(
        long,
        value_name = "X,Y,DEG",
        value_parser = pose,
        allow_hyphen_values = true,
        help_heading = "World"
    )]
    pub start: Option<Pose>,
    /// Where it is to go: metres in the map frame. A maze has a goal of its own.
    #[arg(
        long,
        value_name = "X,Y",
        value_parser = point,
        allow_hyphen_values = true,
        help_heading = "World"
    )]
    pub goal: Option<Point>,
}

impl WorldArgs {
    /// What these options ask for.
    fn place(&self) -> PlaceRequest {
        let world = match &self.map {
            Some(file) => WorldSource::Map { file: file.clone() },
            None => WorldSource::Maze { seed: self.maze, family: self.family },
        };
        PlaceRequest { world, start: self.start, goal: self.goal }
    }
}

/// Options of `apexd sil`.
#[derive(Args, Debug)]
pub struct SilArgs {
    /// Where to drive.
    #[command(flatten)]
    pub world: WorldArgs,

    /// How to plan [parameter plan.policy].
    #[arg(long, value_parser = policy(), help_heading = "Planning")]
    pub policy: Option<Policy>,
    /// What the planner is told about space that it has not seen: `cnp` (the trained network that
    /// ships), `oracle` (the truth), `none`, `random`, `inverted` (the opposite of the truth), or a
    /// network of your own. None of them can make a drive unsafe [parameters predict.kind,
    /// predict.model].
    #[arg(
        long,
        value_name = "NAME|FILE.onnx",
        value_parser = predictor,
        help_heading = "Planning"
    )]
    pub predictor: Option<PredictorChoice>,
    /// Largest speed, m/s [parameter speed.speed_max_mps].
    #[arg(long, value_name = "M/S", value_parser = positive, help_heading = "Planning")]
    pub speed_max: Option<f64>,
    /// How far the lidar sees, metres [parameter lidar.range_m].
    #[arg(long, value_name = "METRES", value_parser = positive, help_heading = "Planning")]
    pub lidar_range: Option<f64>,
    /// How far from what is known predictions reach, metres [parameter predict.range_m].
    #[arg(long, value_name = "METRES", value_parser = positive, help_heading = "Planning")]
    pub prediction_range: Option<f64>,

    /// Seed of everything random during the drive (sensor noise, the random predictor).
    #[arg(long, default_value_t = 1, help_heading = "Simulation")]
    pub seed: u64,
    /// Time from a scan to the plan made from it: this many seconds, or as long as planning really
    /// takes on this machine (`measured`; then a drive cannot be repeated exactly).
    #[arg(
        long,
        value_name = "measured|SECONDS",
        value_parser = latency,
        default_value = "0.02",
        help_heading = "Simulation"
    )]
    pub latency: Latency,
    /// Give up after this many simulated seconds from the first motion on. If not given, ten times
    /// what the way takes at full speed on the true map.
    #[arg(long, value_name = "SECONDS", value_parser = positive, help_heading = "Simulation")]
    pub time_limit: Option<f64>,
    /// Keep pace with the clock on the wall instead of running as fast as possible.
    #[arg(long, help_heading = "Simulation")]
    pub realtime: bool,

    /// Let ground stations join by this MAVLink link, in real time: udpin:HOST:PORT,
    /// udpout:HOST:PORT, tcpin:HOST:PORT, tcpout:HOST:PORT, serial:DEVICE:BAUD; may be repeated.
    /// Without --goal the car waits for one and the drive goes on until it is interrupted. The
    /// parameter mavlink.links is not looked at: a simulation opens nothing by itself.
    #[arg(long, value_name = "URL", help_heading = "Simulation")]
    pub mavlink: Vec<LinkUrl>,

    /// Draw what the planner foresaw this many seconds after the first motion. If not given, halfway
    /// through the drive.
    #[arg(long, value_name = "SECONDS", value_parser = not_negative, help_heading = "Output")]
    pub snapshot: Option<f64>,

    /// Configuration file (TOML) over the built-in defaults.
    #[arg(long, value_name = "FILE", help_heading = "Configuration")]
    pub config: Option<PathBuf>,
    /// Set one parameter, over file and environment (`apexd params` has them all); may be repeated.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,

    /// Folder for pictures and figures; runs/<UTC time> if not given.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// Write a log of the drive to this file, for `apexd replay`.
    #[arg(long, value_name = "FILE.mcap", help_heading = "Output")]
    pub log: Option<PathBuf>,
    /// Print the figures as one JSON object instead of the summary.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

impl SilArgs {
    /// The parameters that have options of their own, as far as they are given.
    pub(super) fn flags(&self) -> Vec<Flag> {
        let mut choices =
            vec![("--policy", "plan.policy", self.policy.map(|policy| policy.to_value()))];
        let predictor = |key, value| ("--predictor", key, Some(value));
        match &self.predictor {
            Some(PredictorChoice::Kind(kind)) => {
                choices.push(predictor("predict.kind", kind.to_value()));
            }
            Some(PredictorChoice::Network(file)) => choices.extend([
                predictor("predict.kind", PredictorKind::Cnp.to_value()),
                predictor("predict.model", Value::Text(file.clone())),
                // Who names a network wants to see that one drive or nothing.
                predictor("predict.fallback", Value::Bool(false)),
            ]),
            None => {}
        }
        let numbers = [
            ("--speed-max", "speed.speed_max_mps", self.speed_max),
            ("--lidar-range", "lidar.range_m", self.lidar_range),
            ("--prediction-range", "predict.range_m", self.prediction_range),
        ]
        .map(|(option, key, number)| (option, key, number.map(Value::Real)));
        choices
            .into_iter()
            .chain(numbers)
            .filter_map(|(option, key, value)| Some(Flag { option, key, value: value? }))
            .collect()
    }

    /// The drive that these options ask for.
    pub fn request(&self, params: Params, out: PathBuf) -> SilRequest {
        SilRequest {
            place: self.world.place(),
            seed: self.seed,
            latency: self.latency,
            time_limit_s: self.time_limit,
            realtime: self.realtime || !self.mavlink.is_empty(),
            links: self.mavlink.clone(),
            snapshot_s: self.snapshot,
            params,
            out,
            log: self.log.clone(),
        }
    }
}

/// Options of `apexd car`.
#[derive(Args, Debug)]
pub struct CarArgs {
    /// CAN interface, as `ip link` shows it [parameter can.interface].
    #[arg(long, value_name = "IFACE", help_heading = "Bus")]
    pub can: Option<String>,
    /// Which family of frames is spoken [parameter can.layout].
    #[arg(long, value_parser = layout(), help_heading = "Bus")]
    pub layout: Option<Layout>,
    /// Where to drive.
    #[command(flatten)]
    pub world: WorldArgs,
    /// What happens to the car and the bus under way: emergency stop, a box on the way, lost
    /// frames and more (TOML, see docs/car.md).
    #[arg(long, value_name = "FILE.toml", help_heading = "Simulation")]
    pub script: Option<PathBuf>,
    /// Seed of everything random during the drive (sensor noise, faults).
    #[arg(long, default_value_t = 1, help_heading = "Simulation")]
    pub seed: u64,
    /// Give up after this many seconds from the first motion on, or from the start without one.
    #[arg(long, value_name = "SECONDS", value_parser = positive, help_heading = "Simulation")]
    pub time_limit: Option<f64>,
    /// Go on after the goal is reached or something is touched, until SIGTERM or the time limit.
    #[arg(long, help_heading = "Simulation")]
    pub stay: bool,

    /// Configuration file (TOML) over the built-in defaults.
    #[arg(long, value_name = "FILE", help_heading = "Configuration")]
    pub config: Option<PathBuf>,
    /// Set one parameter, over file and environment (`apexd params` has them all); may be repeated.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,

    /// Write the truth to this file, line by line: where the car is, what it touches, what it enters
    /// unseen (JSON, see docs/car.md).
    #[arg(long, value_name = "FILE", help_heading = "Output")]
    pub truth: Option<PathBuf>,
    /// Print the figures as one JSON object instead of the summary.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

impl CarArgs {
    /// The parameters that have options of their own, as far as they are given.
    pub(super) fn flags(&self) -> Vec<Flag> {
        let interface = self.can.clone().map(Value::Text);
        let layout = self.layout.map(|layout| layout.to_value());
        [("--can", "can.interface", interface), ("--layout", "can.layout", layout)]
            .into_iter()
            .filter_map(|(option, key, value)| Some(Flag { option, key, value: value? }))
            .collect()
    }

    /// The drive that these options ask for.
    pub fn request(&self, params: Params) -> CarRequest {
        CarRequest {
            place: self.world.place(),
            script: self.script.clone(),
            seed: self.seed,
            time_limit_s: self.time_limit,
            stay: self.stay,
            truth: self.truth.clone(),
            params,
        }
    }
}

/// Options of `apexd maze`.
#[derive(Args, Debug)]
pub struct MazeArgs {
    /// Number of the maze.
    #[arg(long)]
    pub seed: u64,
    /// Kind of maze.
    #[arg(long, value_parser = family(), default_value = Family::Thin.name())]
    pub family: Family,
    /// The YAML file to write; the picture is put beside it.
    #[arg(long, value_name = "FILE.yaml")]
    pub out: PathBuf,
}

/// Options of `apexd dataset`.
#[derive(Args, Debug)]
pub struct DatasetArgs {
    /// Folder to write; must be empty.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: PathBuf,
    /// Write into the folder even if it is not empty.
    #[arg(long, help_heading = "Output")]
    pub force: bool,
    /// Print the manifest as one JSON object instead of the summary.
    #[arg(long, help_heading = "Output")]
    pub json: bool,

    /// Kinds of maze, separated by commas.
    #[arg(
        long,
        value_parser = family(),
        value_delimiter = ',',
        default_value = Family::Thin.name(),
        help_heading = "Worlds"
    )]
    pub families: Vec<Family>,
    /// Mazes of each kind, from seed A to the one before B. Seeds from 1000000 up are held out.
    #[arg(long, value_name = "A..B", value_parser = seeds, help_heading = "Worlds")]
    pub seeds: Option<[u64; 2]>,
    /// A folder with ROS map_server maps, searched with everything below it, or one YAML file; may
    /// be repeated.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "Worlds")]
    pub maps: Vec<PathBuf>,
    /// Make data for scoring, from mazes that no network is trained on (the folder is marked, and
    /// training refuses it).
    #[arg(long, help_heading = "Worlds")]
    pub held_out: bool,
    /// Scenes in each maze and in each map.
    #[arg(long, value_name = "N", default_value_t = 50, help_heading = "Scenes")]
    pub scenes_per_world: usize,
    /// What the scenes are like.
    #[command(flatten)]
    pub scenes: SceneArgs,
}

impl DatasetArgs {
    /// What these options ask for.
    pub fn settings(&self) -> Settings {
        Settings {
            held_out: self.held_out,
            ..self.scenes.settings(
                &self.families,
                self.seeds.unwrap_or([0, 0]),
                self.scenes_per_world,
            )
        }
    }
}

/// How the scenes of a data set are made.
#[derive(Args, Clone, Debug)]
pub struct SceneArgs {
    /// Side of a world cell of the mazes, metres. If it equals --resolution, everything is done on
    /// the lattice itself: maps are brought to it, and the car's map has cells of that size.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.1,
        help_heading = "Scenes")]
    pub world_resolution: f64,
    /// Side of a cell of the lattice that a network sees, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.25,
        help_heading = "Scenes")]
    pub resolution: f64,
    /// How far the lidar sees, metres; of several each scene draws one.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "7.5", help_heading = "Scenes")]
    pub lidar_range: Vec<f64>,
    /// Beams of a scan.
    #[arg(long, value_name = "N", default_value_t = 1080, help_heading = "Scenes")]
    pub beams: u32,
    /// Share of the scenes whose map has been built along a drive; the others have one scan.
    #[arg(long, value_name = "FRACTION", value_parser = share, default_value_t = 0.5,
        help_heading = "Scenes")]
    pub along_drive: f64,
    /// Longest drive, metres; drives of each order of magnitude up to it are equally frequent.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 160.0,
        help_heading = "Scenes")]
    pub drive_max: f64,
    /// Least distance of the poses from a wall, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.3,
        help_heading = "Scenes")]
    pub clearance: f64,
    /// Seed of poses and drives.
    #[arg(long, default_value_t = 1, help_heading = "Scenes")]
    pub seed: u64,
}

impl SceneArgs {
    /// Scenes in some mazes.
    fn settings(&self, families: &[Family], seeds: [u64; 2], scenes_per_world: usize) -> Settings {
        Settings {
            families: families.iter().map(|family| family.name().to_owned()).collect(),
            seeds,
            scenes_per_world,
            resolution_m: self.resolution,
            world_resolution_m: self.world_resolution,
            lidar_ranges_m: self.lidar_range.clone(),
            beams: self.beams,
            along_drive: self.along_drive,
            drive_max_m: self.drive_max,
            clearance_m: self.clearance,
            held_out: seeds[0] >= HELD_OUT_FROM,
            seed: self.seed,
        }
    }
}

/// Options of `apexd evaluate`.
#[derive(Args, Debug)]
pub struct EvaluateArgs {
    /// Kinds of maze to score on, separated by commas; a table for each.
    #[arg(long, value_parser = family(), value_delimiter = ',', help_heading = "What is scored")]
    pub family: Vec<Family>,
    /// Mazes of each kind, from seed A to the one before B.
    #[arg(long, value_name = "A..B", value_parser = seeds, default_value = "1000000..1000030",
        help_heading = "What is scored")]
    pub seeds: [u64; 2],
    /// A folder with ROS map_server maps to score on, searched with everything below it, or one
    /// YAML file; may be repeated, a table for each.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "What is scored")]
    pub maps: Vec<PathBuf>,
    /// A folder that `apexd dataset` has written to score on; may be repeated, a table for each.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "What is scored")]
    pub dataset: Vec<PathBuf>,
    /// Networks to score (ONNX files), beside the baselines.
    #[arg(long, value_name = "FILE.onnx", num_args = 1.., help_heading = "What is scored")]
    pub model: Vec<PathBuf>,
    /// Shared library of ONNX Runtime that runs them; if not given, the runtime that is part of
    /// the program [parameter predict.onnxruntime].
    #[arg(long, value_name = "FILE", help_heading = "What is scored")]
    pub onnxruntime: Option<PathBuf>,
    /// Cells up to this far from the centre of a piece of the frontier, metres; several give
    /// several tables.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "7.5,5", help_heading = "What is scored")]
    pub radius: Vec<f64>,

    /// Scenes in each maze and in each map.
    #[arg(long, value_name = "N", default_value_t = 20, help_heading = "Scenes")]
    pub scenes_per_world: usize,
    /// Most scenes of a data set, evenly spread over it.
    #[arg(long, value_name = "N", default_value_t = 2000, help_heading = "Scenes")]
    pub scenes_max: usize,
    /// What the scenes are like (those of data sets are as they are).
    #[command(flatten)]
    pub scenes: SceneArgs,

    /// Fit the baselines of mazes on these training mazes.
    #[arg(long, value_name = "A..B", value_parser = seeds, default_value = "0..60",
        help_heading = "Baselines")]
    pub fit_seeds: [u64; 2],
    /// Fit the baselines of maps on these maps; on the scored ones if not given.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "Baselines")]
    pub fit_maps: Vec<PathBuf>,
    /// Fit the baselines of data sets on this one; if not given, on training mazes made in the same
    /// way, or on the scored scenes if these are of maps.
    #[arg(long, value_name = "DIR", help_heading = "Baselines")]
    pub fit_dataset: Option<PathBuf>,

    /// Folder for pictures, reliability diagrams and the scores as evaluation.json.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// Write a model card beside each network: FILE.md for FILE.onnx. Scenes that networks are
    /// trained on are refused.
    #[arg(long, requires = "model", help_heading = "Output")]
    pub card: bool,
    /// Scenes of each table to draw.
    #[arg(long, value_name = "N", default_value_t = 4, help_heading = "Output")]
    pub pictures: usize,
    /// Print the scores as one JSON object instead of tables.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

impl EvaluateArgs {
    /// What these options ask for.
    pub fn request(&self) -> Request {
        let made = |families: &[Family], seeds, maps: &[PathBuf]| SceneSource::Made {
            settings: self.scenes.settings(families, seeds, self.scenes_per_world),
            maps: maps.to_vec(),
        };
        let mut sets: Vec<SetRequest> = self
            .family
            .iter()
            .map(|family| SetRequest {
                name: format!("{} mazes", family.name()),
                scenes: made(&[*family], self.seeds, &[]),
                fit: Some(made(&[*family], self.fit_seeds, &[])),
            })
            .collect();
        sets.extend(self.maps.iter().map(|folder| SetRequest {
            name: format!("maps {}", last_name(folder)),
            scenes: made(&[], [0, 0], std::slice::from_ref(folder)),
            fit: (!self.fit_maps.is_empty()).then(|| made(&[], [0, 0], &self.fit_maps)),
        }));
        sets.extend(self.dataset.iter().map(|folder| {
            let stored = |folder: &Path| SceneSource::Stored {
                folder: folder.to_owned(),
                most: self.scenes_max,
            };
            let scenes = stored(folder);
            let fit = match &self.fit_dataset {
                Some(folder) => Some(stored(folder)),
                None => scenes.alike(self.fit_seeds),
            };
            SetRequest { name: format!("data set {}", last_name(folder)), scenes, fit }
        }));
        Request { sets, radii_m: self.radius.clone(), pictures: self.pictures }
    }
}

/// The last part of a path, without the extension of a file.
fn last_name(path: &Path) -> String {
    path.file_stem().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into())
}

/// Options of `apexd replay`.
#[derive(Args, Clone, Debug)]
pub struct ReplayArgs {
    /// The log, or its first part; further parts are read from files beside it.
    #[arg(value_name = "FILE.mcap")]
    pub file: PathBuf,
    /// Set one parameter, over those of the log, to see what would have come of it; may be repeated.
    /// The car still moves as it did then. Differences are no failure then.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,
    /// Print the comparison as one JSON object.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

/// Options of `apexd params`.
#[derive(Args, Clone, Copy, Debug)]
pub struct ParamsArgs {
    /// As one JSON object.
    #[arg(long)]
    pub json: bool,
    /// As a Markdown page.
    #[arg(long, conflicts_with = "json")]
    pub markdown: bool,
}

/// Options of `apexd check`.
#[derive(Args, Debug)]
pub struct CheckArgs {
    /// The file to check.
    pub file: PathBuf,
    /// As one JSON object.
    #[arg(long)]
    pub json: bool,
}

/// Reads a value by its name; `--help` and the error on any other name list them all.
fn choice<T: Copy + Send + Sync + 'static>(
    all: &'static [T],
    name: fn(T) -> &'static str,
    text: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let names = all
        .iter()
        .map(|value| PossibleValue::new(name(*value)).help(text(*value).trim_end_matches('.')));
    PossibleValuesParser::new(names.collect::<Vec<_>>()).map(move |given| {
        let named = all.iter().find(|value| name(**value) == given);
        *named.expect("only names of the list get through")
    })
}

pub(super) fn family() -> impl TypedValueParser<Value = Family> {
    choice(Family::ALL, Family::name, Family::text)
}

fn layout() -> impl TypedValueParser<Value = Layout> {
    choice(Layout::ALL, Layout::name, Layout::text)
}

fn policy() -> impl TypedValueParser<Value = Policy> {
    choice(Policy::ALL, Policy::name, Policy::text)
}

/// A predictor by its name, or a network by its file.
#[derive(Clone, Debug, PartialEq)]
pub enum PredictorChoice {
    /// One of those that have a name.
    Kind(PredictorKind),
    /// The trained network of an ONNX file.
    Network(String),
}

fn predictor(text: &str) -> Result<PredictorChoice, String> {
    if let Some(kind) = PredictorKind::from_name(text) {
        return Ok(PredictorChoice::Kind(kind));
    }
    if text.ends_with(".onnx") {
        return Ok(PredictorChoice::Network(text.to_owned()));
    }
    Err(format!("wanted is one of {}, or a file FILE.onnx", PredictorKind::NAMES.join(", ")))
}

/// A range of seeds, its upper end left out.
fn seeds(text: &str) -> Result<[u64; 2], String> {
    let ends = text.split_once("..").and_then(|(a, b)| Some([a.parse().ok()?, b.parse().ok()?]));
    match ends {
        Some([from, end]) if from < end => Ok([from, end]),
        _ => Err("wanted are two whole numbers A..B, the second one larger, as in 0..2000".into()),
    }
}

/// A number from 0 to 1.
fn share(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|v| (0.0..=1.0).contains(v));
    number.ok_or_else(|| "wanted is a number from 0 to 1".into())
}

/// `N` numbers separated by commas.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let parsed: Option<Vec<f64>> = text
        .split(',')
        .map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect();
    parsed?.try_into().ok()
}

fn pose(text: &str) -> Result<Pose, String> {
    let [x, y, degrees] = numbers(text).ok_or(
        "wanted are three numbers X,Y,DEG: metres, metres and degrees, as in 1.25,1.25,90",
    )?;
    Ok(Pose::new(x, y, crate::frames::wrap_angle(degrees.to_radians())))
}

fn point(text: &str) -> Result<Point, String> {
    let [x, y] =
        numbers(text).ok_or("wanted are two numbers X,Y: metres and metres, as in 23.75,23.75")?;
    Ok(Point::new(x, y))
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v > 0.0);
    value.ok_or_else(|| "wanted is a number above zero".to_owned())
}

fn not_negative(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
    value.ok_or_else(|| "wanted is a number of seconds, zero or more".to_owned())
}

pub(super) fn latency(text: &str) -> Result<Latency, String> {
    if text == "measured" {
        return Ok(Latency::Measured);
    }
    let seconds = text.trim().parse::<f64>().ok().filter(|v| (0.0..=1.0).contains(v));
    seconds
        .map(Latency::Fixed)
        .ok_or_else(|| "wanted is `measured` or a number of seconds from 0 to 1".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;
    use clap::error::ErrorKind;

    fn sil(arguments: &str) -> Result<SilArgs, clap::Error> {
        let words = ["apexd", "sil"].into_iter().chain(arguments.split_whitespace());
        match Cli::try_parse_from(words)?.command {
            Command::Sil(args) => Ok(*args),
            other => panic!("{other:?}"),
        }
    }

    fn request(arguments: &str) -> SilRequest {
        sil(arguments).unwrap().request(Params::default(), "out".into())
    }

    #[test]
    fn the_grammar_is_sound() {
        Cli::command().debug_assert();
    }

    #[test]
    fn every_command_and_option_has_a_help_text() {
        for command in Cli::command().get_subcommands() {
            assert!(command.get_about().is_some(), "{}", command.get_name());
            for option in command.get_arguments() {
                let text = option.get_help().map(ToString::to_string).unwrap_or_default();
                assert!(!text.is_empty(), "{} {}", command.get_name(), option.get_id());
            }
        }
    }

    #[test]
    fn without_options_a_thin_maze_is_driven() {
        let request = request("");
        assert_eq!(request.place.world, WorldSource::Maze { seed: 1, family: Family::Thin });
        assert_eq!((request.place.start, request.place.goal), (None, None));
        assert!(sil("").unwrap().flags().is_empty());
        assert_eq!(request.latency, Latency::Fixed(0.02));
        assert!(!request.realtime);
    }

    #[test]
    fn every_option_reaches_the_request() {
        let request = request(
            "--maze 7 --family branching --start -1.5,2,-90 --goal -3,4.25 --seed 9 \
             --latency measured --time-limit 60 --realtime",
        );
        assert_eq!(request.place.world, WorldSource::Maze { seed: 7, family: Family::Branching });
        assert_eq!(request.place.start, Some(Pose::new(-1.5, 2.0, -std::f64::consts::FRAC_PI_2)));
        assert_eq!(request.place.goal, Some(Point::new(-3.0, 4.25)));
        assert_eq!((request.time_limit_s, request.seed), (Some(60.0), 9));
        assert_eq!((request.latency, request.realtime), (Latency::Measured, true));
    }

    #[test]
    fn options_that_stand_for_parameters_name_parameters_that_exist() {
        let args = sil("--policy known-map --predictor inverted --speed-max 8 --lidar-range 5 \
                        --prediction-range 2.5");
        let mut params = Params::default();
        for flag in args.unwrap().flags() {
            params.set(flag.key, &flag.value).unwrap_or_else(|error| panic!("{flag:?} {error}"));
        }
        assert_eq!(params.plan.policy, Policy::KnownMap);
        assert_eq!(params.predict.kind, PredictorKind::Inverted);
        assert_eq!((params.speed.speed_max_mps, params.lidar.range_m), (8.0, 5.0));
        assert_eq!(params.predict.range_m, 2.5);
    }

    #[test]
    fn a_map_needs_start_and_goal_and_excludes_a_maze() {
        let missing = sil("--map a.yaml --goal 1,2").unwrap_err();
        assert_eq!(missing.kind(), ErrorKind::MissingRequiredArgument);
        let both = sil("--map a.yaml --maze 3 --start 0,0,0 --goal 1,2").unwrap_err();
        assert_eq!(both.kind(), ErrorKind::ArgumentConflict);
        let request = request("--map a.yaml --start 0,0,0 --goal 1,2");
        assert_eq!(request.place.world, WorldSource::Map { file: "a.yaml".into() });
    }

    #[test]
    fn the_car_takes_the_world_options_of_the_simulator_and_its_own() {
        let car = |arguments: &str| -> Result<CarArgs, clap::Error> {
            let words = ["apexd", "car"].into_iter().chain(arguments.split_whitespace());
            match Cli::try_parse_from(words)?.command {
                Command::Car(args) => Ok(*args),
                other => panic!("{other:?}"),
            }
        };
        let args = car("--can vcan7 --layout classic --maze 4 --goal -1,2 --script s.toml \
                        --truth t.jsonl --seed 3 --time-limit 9 --stay")
        .unwrap();
        let mut params = Params::default();
        for flag in args.flags() {
            params.set(flag.key, &flag.value).unwrap_or_else(|error| panic!("{flag:?} {error}"));
        }
        assert_eq!(params.can.interface, "vcan7");
        assert_eq!(params.can.layout, Layout::Classic);
        let request = args.request(params);
        assert_eq!(request.place.world, WorldSource::Maze { seed: 4, family: Family::Thin });
        assert_eq!(request.place.goal, Some(Point::new(-1.0, 2.0)));
        assert_eq!((request.seed, request.time_limit_s, request.stay), (3, Some(9.0), true));
        assert_eq!(request.script, Some("s.toml".into()));
        assert_eq!(request.truth, Some("t.jsonl".into()));
        assert!(car("").unwrap().flags().is_empty());
        assert_eq!(car("--layout lin").unwrap_err().exit_code(), 2);
        let missing = car("--map a.yaml --goal 1,2").unwrap_err();
        assert_eq!(missing.kind(), ErrorKind::MissingRequiredArgument);
    }

    #[test]
    fn bad_values_are_refused_with_what_is_wanted() {
        for (arguments, wanted) in [
            ("--start 1,2", "three numbers X,Y,DEG"),
            ("--start 1,2,nan", "three numbers X,Y,DEG"),
            ("--goal 1,2,3", "two numbers X,Y"),
            ("--goal one,two", "two numbers X,Y"),
            ("--goal 1;2", "two numbers X,Y"),
            ("--speed-max 0", "above zero"),
            ("--speed-max inf", "above zero"),
            ("--latency soon", "`measured` or a number of seconds"),
            ("--latency -0.1", "a value is required"),
            ("--latency=-0.1", "`measured` or a number of seconds"),
            ("--latency 2", "`measured` or a number of seconds"),
            ("--time-limit -5", "a value is required"),
            ("--policy best", "map-predictive"),
            ("--predictor magic", "oracle"),
        ] {
            let error = sil(arguments).unwrap_err();
            assert_eq!(error.exit_code(), 2, "{arguments}");
            let text = error.to_string();
            let hinted = text.contains(wanted) || wanted == "a value is required";
            assert!(hinted, "{arguments}: {text}");
        }
    }
}
