//! The options of the commands that drive a simulated car: `apexd sil` and `apexd car`.

use std::path::PathBuf;

use clap::Args;

use super::value::{
    PredictorChoice, family, latency, layout, not_negative, point, policy, pose, positive,
    predictor,
};
use super::{ConfigArgs, Flag};
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::shell::car::CarRequest;
use crate::shell::mavlink::LinkUrl;
use crate::shell::place::{PlaceRequest, WorldSource};
use crate::shell::sil::SilRequest;
use crate::sim::maze::Family;
use crate::sim::rig::Latency;
use crate::tunable::{Field, Value};
use crate::wire::can::Layout;

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

    /// Where parameters come from.
    #[command(flatten)]
    pub config: ConfigArgs,

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
    pub(in crate::shell) fn flags(&self) -> Vec<Flag> {
        let (kind, model) = match &self.predictor {
            Some(PredictorChoice::Kind(kind)) => (Some(*kind), None),
            Some(PredictorChoice::Network(file)) => (Some(PredictorKind::Cnp), Some(file)),
            None => (None, None),
        };
        let model_text = model.map(|file| Value::Text(file.clone()));
        // Who names a network wants to see that one drive or nothing.
        let fallback = model.map(|_| Value::Bool(false));
        let number = |number: Option<f64>| number.map(Value::Real);
        [
            ("--policy", "plan.policy", self.policy.map(|policy| policy.to_value())),
            ("--predictor", "predict.kind", kind.map(|kind| kind.to_value())),
            ("--predictor", "predict.model", model_text),
            ("--predictor", "predict.fallback", fallback),
            ("--speed-max", "speed.speed_max_mps", number(self.speed_max)),
            ("--lidar-range", "lidar.range_m", number(self.lidar_range)),
            ("--prediction-range", "predict.range_m", number(self.prediction_range)),
        ]
        .into_iter()
        .filter_map(|(option, key, value)| Flag::given(option, key, value))
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

    /// Where parameters come from.
    #[command(flatten)]
    pub config: ConfigArgs,

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
    pub(in crate::shell) fn flags(&self) -> Vec<Flag> {
        let interface = self.can.clone().map(Value::Text);
        let layout = self.layout.map(|layout| layout.to_value());
        [("--can", "can.interface", interface), ("--layout", "can.layout", layout)]
            .into_iter()
            .filter_map(|(option, key, value)| Flag::given(option, key, value))
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

#[cfg(test)]
mod tests {
    use clap::Parser;
    use clap::error::ErrorKind;

    use super::*;
    use crate::shell::cli::{Cli, Command};

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
