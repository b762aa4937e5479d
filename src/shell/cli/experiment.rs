//! The options of `apexd experiment`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};

use super::value::{family, latency, positive};
use crate::experiment::barn::{BarnRequest, Field, RESOLUTION_M};
use crate::experiment::campaign::CampaignRequest;
use crate::experiment::paper::{Method, Pace, PaperRequest, Sweep};
use crate::experiment::run::Timing;
use crate::sim::maze::Family;
use crate::sim::rig::Latency;

/// Options of `apexd experiment`.
#[derive(Args, Debug)]
pub struct ExperimentArgs {
    /// Which experiment.
    #[command(subcommand)]
    pub which: Which,
}

/// The experiments.
#[derive(Debug, Subcommand)]
pub enum Which {
    /// Re-run the experiments of Elhafsi et al. (2020) and ours beside them.
    ///
    /// Drives held-out mazes with each method and compares completion times with those of the known
    /// map. Tables (CSV, JSON, Markdown) and figures (SVG, PNG) go to --out, with the results of the
    /// single drives; the same command goes on where it was interrupted.
    Paper(Box<PaperArgs>),
    /// Look for collisions and unknown entries in random drives.
    ///
    /// Draws world, start, goal, policy, predictor (also random and inverted ones), speed, latency
    /// and lidar rate of each drive, and counts what must not happen; every failure comes with the
    /// command that repeats it. Ends with 1 if a drive was unsafe.
    Campaign(Box<CampaignArgs>),
    /// Drive BARN's published worlds and score the drives as the BARN Challenge does.
    ///
    /// Drives each world of a folder with each method. Worlds that the known map does not lead this
    /// car through are counted apart. Ends with 1 if a drive was unsafe.
    Barn(Box<BarnArgs>),
    /// Join the results of several folders (of shards, say) and make tables and figures anew.
    Merge(MergeArgs),
}

/// Where results go and how they are made.
#[derive(Args, Debug)]
pub struct WorkArgs {
    /// Folder for results, tables and figures; runs/paper, runs/campaign or runs/barn if not given. Drives
    /// whose results lie there already are not driven again.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// Drives at a time; as many as there are cores if not given. For planning times worth telling
    /// use one.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..),
        help_heading = "Work")]
    pub jobs: Option<u16>,
    /// Do only this part of the drives: number I (from 0) of N. `apexd experiment merge` joins the
    /// parts; they may share a folder.
    #[arg(long, value_name = "I/N", value_parser = shard, help_heading = "Work")]
    pub shard: Option<[u64; 2]>,
    /// Count results of other builds of this program as done, too.
    #[arg(long, help_heading = "Work")]
    pub any_build: bool,
    /// Set one parameter in all drives; may be repeated.
    #[arg(
        long,
        value_name = "SECTION.KEY=VALUE",
        allow_hyphen_values = true,
        help_heading = "Configuration"
    )]
    pub set: Vec<String>,
    /// How the results are shown.
    #[command(flatten)]
    pub show: ShowArgs,
}

/// How results are shown.
#[derive(Args, Debug)]
pub struct ShowArgs {
    /// Put tables and figures into this Markdown page, between the lines `<!-- apexd experiment
    /// NAME: begin -->` and `<!-- apexd experiment NAME: end -->`; the figures go to img/ beside it.
    #[arg(long, value_name = "FILE.md", help_heading = "Output")]
    pub page: Option<PathBuf>,
    /// True time optima (CSV with seed, speed_max_mps and optimum_s, as the solver in
    /// tests/bench/optimum writes it).
    #[arg(long, value_name = "FILE.csv", help_heading = "Output")]
    pub optimum: Option<PathBuf>,
    /// Print tables as one JSON object instead of text.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

/// How much is driven.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// Three mazes at 4 m/s, each scan: minutes.
    Small,
    /// The paper's: 30 mazes at 1 to 4 m/s, at 2 Hz and after each scan, and sensor range against
    /// prediction range: hours.
    Paper,
    /// The paper's and 6 and 8 m/s, in all three families of mazes, the other readings of its
    /// text, and shapes fitted to what the network is nearly sure of.
    Full,
}

/// Options of `apexd experiment paper`.
#[derive(Args, Debug)]
pub struct PaperArgs {
    /// How much is driven; the other options change single things.
    #[arg(long, value_enum, default_value_t = Preset::Small, help_heading = "What is driven")]
    pub preset: Preset,
    /// Mazes of each family, from seed 1000000 on, or from --first-seed.
    #[arg(long, value_name = "N", help_heading = "What is driven")]
    pub mazes: Option<u64>,
    /// Seed of the first maze. From 1000000 up no network has seen them.
    #[arg(long, value_name = "SEED", default_value_t = 1_000_000, help_heading = "What is driven")]
    pub first_seed: u64,
    /// Kinds of maze, separated by commas.
    #[arg(long, value_parser = family(), value_delimiter = ',', help_heading = "What is driven")]
    pub family: Vec<Family>,
    /// Highest speeds, m/s, separated by commas.
    #[arg(long, value_name = "M/S", value_parser = positive, value_delimiter = ',',
        help_heading = "What is driven")]
    pub speeds: Vec<f64>,
    /// Methods, separated by commas: POLICY[+PREDICTOR][:section.key=value]... The known map is
    /// always driven, too.
    #[arg(long, value_name = "METHOD", value_delimiter = ',', help_heading = "What is driven")]
    pub methods: Vec<Method>,
    /// When is planned, separated by commas: after each scan, or as in the paper at 2 Hz with the
    /// world waiting for the planner.
    #[arg(long, value_enum, value_delimiter = ',', help_heading = "What is driven")]
    pub pace: Vec<PaceArg>,
    /// Time from a scan to its plan where the world does not wait: seconds, or `measured`.
    #[arg(long, value_name = "measured|SECONDS", value_parser = latency, default_value = "0.02",
        help_heading = "What is driven")]
    pub latency: Latency,
    /// Mazes in which sensor range and prediction range are varied; 0 for none.
    #[arg(long, value_name = "N", help_heading = "Ranges")]
    pub sweep_mazes: Option<usize>,
    /// Speed at which they are varied, m/s.
    #[arg(long, value_name = "M/S", value_parser = positive, default_value_t = 4.0,
        help_heading = "Ranges")]
    pub sweep_speed: f64,
    /// Sensor ranges, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "2.5,5,7.5,10", help_heading = "Ranges")]
    pub sensor_ranges: Vec<f64>,
    /// Prediction ranges, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "2.5,5,7.5", help_heading = "Ranges")]
    pub prediction_ranges: Vec<f64>,
    /// Output and work.
    #[command(flatten)]
    pub work: WorkArgs,
}

/// When is planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PaceArg {
    /// After each scan, with a latency.
    EachScan,
    /// Twice a second; the world waits.
    Paper,
}

impl PaperArgs {
    /// What these options ask for.
    pub fn request(&self) -> PaperRequest {
        let or = |given: &[f64], preset: &[f64]| {
            if given.is_empty() { preset.to_vec() } else { given.to_vec() }
        };
        let small = self.preset == Preset::Small;
        let full = self.preset == Preset::Full;
        let mazes = self.mazes.unwrap_or(if small { 3 } else { 30 });
        let speeds: &[f64] = match self.preset {
            Preset::Small => &[4.0],
            Preset::Paper => &[1.0, 2.0, 3.0, 4.0],
            Preset::Full => &[1.0, 2.0, 3.0, 4.0, 6.0, 8.0],
        };
        let families = match (self.family.is_empty(), full) {
            (false, _) => self.family.clone(),
            (true, true) => Family::MAZES.to_vec(),
            (true, false) => vec![Family::Thin],
        };
        let paces = match (self.pace.is_empty(), small) {
            (true, true) => vec![Pace::EachScan],
            (true, false) => vec![Pace::EachScan, Pace::Paper],
            (false, _) => {
                let pace = |pace: &PaceArg| match pace {
                    PaceArg::EachScan => Pace::EachScan,
                    PaceArg::Paper => Pace::Paper,
                };
                self.pace.iter().map(pace).collect()
            }
        };
        let mut methods = self.methods.clone();
        if methods.is_empty() {
            methods = Method::defaults();
            methods.extend(full.then(Method::variants).into_iter().flatten());
        }
        let sweep_mazes = self.sweep_mazes.unwrap_or(if small { 0 } else { 10 });
        let compared = ["frontier", "map-predictive+cnp", "map-predictive+oracle"];
        let sweep = (sweep_mazes > 0).then(|| Sweep {
            mazes: sweep_mazes,
            speed_mps: self.sweep_speed,
            sensor_m: self.sensor_ranges.clone(),
            prediction_m: self.prediction_ranges.clone(),
            methods: compared.map(|text| text.parse().expect("the names are well formed")).to_vec(),
        });
        let speeds_mps = or(&self.speeds, speeds);
        let picture = |speed: &&f64| **speed == 4.0;
        PaperRequest {
            families,
            seeds: (self.first_seed..self.first_seed.saturating_add(mazes)).collect(),
            picture_speed_mps: *speeds_mps.iter().find(picture).unwrap_or(&speeds_mps[0]),
            speeds_mps,
            methods,
            paces,
            latency: timing(self.latency),
            sweep,
            set: self.work.set.clone(),
        }
    }
}

/// Options of `apexd experiment campaign`.
#[derive(Args, Debug)]
pub struct CampaignArgs {
    /// Number of drives.
    #[arg(long, value_name = "N", default_value_t = 100, help_heading = "What is driven")]
    pub runs: u64,
    /// Seed of all that is drawn.
    #[arg(long, default_value_t = 1, help_heading = "What is driven")]
    pub seed: u64,
    /// Kinds of world to draw from; all if not given.
    #[arg(long, value_parser = family(), value_delimiter = ',', help_heading = "What is driven")]
    pub family: Vec<Family>,
    /// A folder with ROS map_server maps, searched with everything below it, or one YAML file, to
    /// draw from, too; may be repeated.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "What is driven")]
    pub maps: Vec<PathBuf>,
    /// Draw from maps only.
    #[arg(long, requires = "maps", conflicts_with = "family", help_heading = "What is driven")]
    pub maps_only: bool,
    /// Policies to draw from.
    #[arg(long, value_name = "NAME", value_delimiter = ',', help_heading = "What is driven")]
    pub policies: Vec<String>,
    /// Predictors to draw from.
    #[arg(
        long,
        value_name = "NAME|FILE.onnx",
        value_delimiter = ',',
        help_heading = "What is driven"
    )]
    pub predictors: Vec<String>,
    /// Highest speeds to draw from, m/s.
    #[arg(long, value_name = "M/S", value_parser = positive, value_delimiter = ',',
        help_heading = "What is driven")]
    pub speeds: Vec<f64>,
    /// Latencies to draw from: seconds, or `measured` (such drives cannot be repeated exactly).
    #[arg(long, value_name = "measured|SECONDS", value_parser = latency, value_delimiter = ',',
        help_heading = "What is driven")]
    pub latencies: Vec<Latency>,
    /// Scans a second to draw from.
    #[arg(long, value_name = "HZ", value_parser = positive, value_delimiter = ',',
        help_heading = "What is driven")]
    pub lidar_rates: Vec<f64>,
    /// Output and work.
    #[command(flatten)]
    pub work: WorkArgs,
}

impl CampaignArgs {
    /// What these options ask for; `maps` are the files found.
    pub fn request(&self, maps: Vec<String>) -> CampaignRequest {
        fn or<T: Clone>(given: &[T], usual: Vec<T>) -> Vec<T> {
            if given.is_empty() { usual } else { given.to_vec() }
        }
        let usual = CampaignRequest::default();
        let latencies: Vec<Timing> = self.latencies.iter().copied().map(timing).collect();
        CampaignRequest {
            runs: self.runs,
            seed: self.seed,
            families: if self.maps_only { Vec::new() } else { or(&self.family, usual.families) },
            maps,
            policies: or(&self.policies, usual.policies),
            predictors: or(&self.predictors, usual.predictors),
            speeds_mps: or(&self.speeds, usual.speeds_mps),
            latencies: or(&latencies, usual.latencies),
            lidar_rates_hz: or(&self.lidar_rates, usual.lidar_rates_hz),
            set: self.work.set.clone(),
        }
    }
}

/// Options of `apexd experiment barn`.
#[derive(Args, Debug)]
pub struct BarnArgs {
    /// The folder with the worlds, files world_*.json, or one such file: world, cylinder_radius_m,
    /// obstacles_xy_m, start (metres, metres, radians), goal and reference_path_xy_m in metres.
    #[arg(long, value_name = "DIR", help_heading = "What is driven")]
    pub worlds: PathBuf,
    /// Methods, separated by commas: POLICY[+PREDICTOR][:section.key=value]... The known map is
    /// always driven, too.
    #[arg(long, value_name = "METHOD", value_delimiter = ',', help_heading = "What is driven")]
    pub methods: Vec<Method>,
    /// Highest speed, m/s; the Challenge's robot has 2.
    #[arg(long, value_name = "M/S", value_parser = positive, default_value_t = 2.0,
        help_heading = "What is driven")]
    pub speed_max: f64,
    /// How far the lidar sees, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 7.5,
        help_heading = "What is driven")]
    pub lidar_range: f64,
    /// Side of a cell of the world and of the car's map, metres.
    #[arg(long, value_name = "METRES", value_parser = resolution, default_value = "0.05",
        help_heading = "What is driven")]
    pub resolution: f64,
    /// Time from a scan to its plan: seconds, or `measured`.
    #[arg(long, value_name = "measured|SECONDS", value_parser = latency, default_value = "0.02",
        help_heading = "What is driven")]
    pub latency: Latency,
    /// Output and work.
    #[command(flatten)]
    pub work: WorkArgs,
}

impl BarnArgs {
    /// What these options ask for; `fields` are the worlds found and the maps of them.
    pub fn request(&self, fields: Vec<(Field, String)>) -> BarnRequest {
        let mut methods = self.methods.clone();
        if methods.is_empty() {
            methods = BarnRequest::usual_methods();
        }
        BarnRequest {
            fields,
            methods,
            speed_max_mps: self.speed_max,
            lidar_range_m: self.lidar_range,
            resolution_m: self.resolution,
            latency: timing(self.latency),
            set: self.work.set.clone(),
        }
    }
}

fn resolution(text: &str) -> Result<f64, String> {
    let [fine, coarse] = RESOLUTION_M;
    let value: f64 = text.parse().map_err(|error| format!("{error}"))?;
    if (fine..=coarse).contains(&value) {
        Ok(value)
    } else {
        Err(format!("wanted are {fine} to {coarse} m"))
    }
}

/// Options of `apexd experiment merge`.
#[derive(Args, Debug)]
pub struct MergeArgs {
    /// Folders of experiments.
    #[arg(required = true, value_name = "DIR")]
    pub folders: Vec<PathBuf>,
    /// Folder for the joined results, tables and figures; the first of the given ones if not given.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// Join results of different builds of this program.
    #[arg(long, help_heading = "Work")]
    pub any_build: bool,
    /// How the results are shown.
    #[command(flatten)]
    pub show: ShowArgs,
}

const fn timing(latency: Latency) -> Timing {
    match latency {
        Latency::Measured => Timing::Measured,
        Latency::Fixed(seconds) => Timing::Fixed(seconds),
    }
}

fn shard(text: &str) -> Result<[u64; 2], String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some([i.parse().ok()?, n.parse().ok()?]));
    match parts {
        Some([i, n]) if i < n => Ok([i, n]),
        _ => Err("wanted is I/N with I from 0 to N-1, as in 0/8 to 7/8".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;
    use crate::shell::cli::{Cli, Command};

    fn paper(arguments: &str) -> PaperRequest {
        let words =
            ["apexd", "experiment", "paper"].into_iter().chain(arguments.split_whitespace());
        match Cli::try_parse_from(words).unwrap().command {
            Command::Experiment(ExperimentArgs { which: Which::Paper(args) }) => args.request(),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_presets_are_as_their_help_says() {
        let small = paper("");
        assert_eq!((small.seeds.len(), small.speeds_mps.len(), &small.sweep), (3, 1, &None));
        assert!(small.seeds.iter().all(|seed| *seed >= 1_000_000));
        let paper_ = paper("--preset paper");
        assert_eq!(
            (paper_.seeds.len(), paper_.speeds_mps.as_slice()),
            (30, &[1.0, 2.0, 3.0, 4.0][..])
        );
        assert_eq!(paper_.paces, [Pace::EachScan, Pace::Paper]);
        assert_eq!(paper_.sweep.unwrap().sensor_m, [2.5, 5.0, 7.5, 10.0]);
        let full = paper("--preset full");
        assert_eq!((full.families.len(), full.speeds_mps.len()), (3, 6));
        assert_eq!(full.methods.len(), paper_.methods.len() + 3);
        assert!(full.tasks().is_ok(), "every name is known");
    }

    #[test]
    fn options_go_over_the_preset() {
        let request = paper(
            "--preset paper --mazes 2 --first-seed 7 --family solid --speeds 4,8 --pace paper \
             --methods frontier,map-predictive+oracle:plan.wall_room_m=0 --sweep-mazes 0 \
             --latency measured --set speed.friction_use=0.9",
        );
        assert_eq!((request.seeds, request.families), (vec![7, 8], vec![Family::Solid]));
        assert_eq!((request.speeds_mps, request.paces), (vec![4.0, 8.0], vec![Pace::Paper]));
        assert_eq!(request.methods[1].set, ["plan.wall_room_m=0"]);
        assert_eq!((request.sweep, request.latency), (None, Timing::Measured));
        assert_eq!(request.set, ["speed.friction_use=0.9"]);
    }

    #[test]
    fn a_shard_is_a_number_below_another() {
        assert_eq!(shard("0/8"), Ok([0, 8]));
        for wrong in ["8/8", "1", "-1/3", "a/b", "0/0"] {
            assert!(shard(wrong).is_err(), "{wrong}");
        }
    }
}
