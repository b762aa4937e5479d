//! What is driven.

use std::fmt::Write;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::frames::{Point, Pose, wrap_angle};
use crate::params::{Layers, Params};
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::maze::Family;
use crate::sim::rig::Latency;

/// Where the walls come from.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WorldSpec {
    /// A maze or a field of posts.
    Maze {
        /// Name of its family.
        family: String,
        /// Its number.
        seed: u64,
    },
    /// A ROS map_server map.
    Map {
        /// Its YAML file.
        file: String,
    },
}

impl WorldSpec {
    /// The family's name, or `map`.
    pub fn family(&self) -> &str {
        match self {
            Self::Maze { family, .. } => family,
            Self::Map { .. } => "map",
        }
    }
}

/// Time from a scan to the plan made from it.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Timing {
    /// As long as planning takes on the machine.
    Measured,
    /// So many seconds.
    Fixed(f64),
}

impl Timing {
    /// As the rig wants it.
    pub const fn latency(self) -> Latency {
        match self {
            Self::Measured => Latency::Measured,
            Self::Fixed(seconds) => Latency::Fixed(seconds),
        }
    }

    /// As `--latency` wants it.
    pub fn text(self) -> String {
        match self {
            Self::Measured => "measured".into(),
            Self::Fixed(seconds) => seconds.to_string(),
        }
    }
}

/// A drive, described so that it can be driven again: with a fixed latency to the last bit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunSpec {
    /// The walls.
    pub world: WorldSpec,
    /// Metres, metres, degrees in the map frame; the maze's own start if not given.
    pub start: Option<[f64; 3]>,
    /// Metres in the map frame; the maze's own goal if not given.
    pub goal: Option<[f64; 2]>,
    /// Name of the policy.
    pub policy: String,
    /// Name of the predictor, or the file of a network.
    pub predictor: String,
    /// Highest speed, m/s.
    pub speed_max_mps: f64,
    /// How far the lidar sees, metres.
    pub lidar_range_m: f64,
    /// Scans a second.
    pub lidar_rate_hz: f64,
    /// How far predictions reach into the unknown, metres.
    pub prediction_range_m: f64,
    /// Least time between two planning steps, seconds; 0 plans after every scan.
    pub plan_period_s: f64,
    /// Time from a scan to its plan.
    pub latency: Timing,
    /// Seed of the sensors' noise and of the random predictor.
    pub seed: u64,
    /// Further parameters, `section.key=value`.
    pub set: Vec<String>,
}

/// Why a drive cannot be had.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SpecError {
    /// No such policy.
    #[error("this build has no policy {name:?}; it has {}", Policy::NAMES.join(", "))]
    Policy {
        /// What was asked for.
        name: String,
    },
    /// No such predictor.
    #[error("there is no predictor {name:?}; there are {}, and files FILE.onnx", PredictorKind::NAMES.join(", "))]
    Predictor {
        /// What was asked for.
        name: String,
    },
    /// No such family of worlds.
    #[error("there is no family {name:?} of worlds; there are {}", Family::NAMES.join(", "))]
    Family {
        /// What was asked for.
        name: String,
    },
    /// A parameter's value is refused.
    #[error("{0}")]
    Parameters(String),
}

impl RunSpec {
    /// A drive through a maze at the defaults of `apexd sil`, nothing foreseen.
    pub fn maze(family: Family, seed: u64) -> Self {
        let params = Params::default();
        Self {
            world: WorldSpec::Maze { family: family.name().into(), seed },
            start: None,
            goal: None,
            policy: Policy::MapPredictive.name().into(),
            predictor: PredictorKind::None.name().into(),
            speed_max_mps: params.speed.speed_max_mps,
            lidar_range_m: params.lidar.range_m,
            lidar_rate_hz: params.lidar.rate_hz,
            prediction_range_m: params.predict.range_m,
            plan_period_s: params.autopilot.plan_period_s,
            latency: Timing::Fixed(0.02),
            seed: 1,
            set: Vec::new(),
        }
    }

    /// The start as a pose; the same arithmetic as that of `--start`.
    pub fn start_pose(&self) -> Option<Pose> {
        self.start.map(|[x, y, degrees]| Pose::new(x, y, wrap_angle(degrees.to_radians())))
    }

    /// The goal as a point.
    pub fn goal_point(&self) -> Option<Point> {
        self.goal.map(|[x, y]| Point::new(x, y))
    }

    /// The parameters of the drive, over the built-in defaults.
    ///
    /// # Errors
    /// If a name is unknown or a value refused.
    pub fn params(&self) -> Result<Params, SpecError> {
        let mut layers = Layers::new();
        for assignment in &self.set {
            layers.set(assignment);
        }
        for (key, value) in [
            ("speed.speed_max_mps", self.speed_max_mps),
            ("lidar.range_m", self.lidar_range_m),
            ("lidar.rate_hz", self.lidar_rate_hz),
            ("predict.range_m", self.prediction_range_m),
            ("autopilot.plan_period_s", self.plan_period_s),
        ] {
            layers.set(&format!("{key}={value}"));
        }
        let mut params =
            layers.build().map_err(|faults| SpecError::Parameters(faults.to_string()))?;
        let policy = Policy::from_name(&self.policy);
        params.plan.policy =
            policy.ok_or_else(|| SpecError::Policy { name: self.policy.clone() })?;
        match PredictorKind::from_name(&self.predictor) {
            Some(kind) => params.predict.kind = kind,
            // As `--predictor FILE.onnx` has it.
            None if self.predictor.ends_with(".onnx") => {
                params.predict.kind = PredictorKind::Cnp;
                params.predict.model.clone_from(&self.predictor);
                params.predict.fallback = false;
            }
            None => return Err(SpecError::Predictor { name: self.predictor.clone() }),
        }
        Ok(params)
    }

    /// The method's name: policy, predictor if there is one, and further parameters.
    pub fn method(&self) -> String {
        let mut name = self.policy.clone();
        if self.predictor != PredictorKind::None.name() || self.policy == "map-predictive" {
            name += "+";
            name += &self.predictor;
        }
        for assignment in &self.set {
            name += ":";
            name += assignment;
        }
        name
    }

    /// When is planned and how long that takes, in words.
    pub fn timing(&self) -> String {
        let when = if self.plan_period_s > 0.0 {
            format!("{} Hz", short(1.0 / self.plan_period_s))
        } else {
            "each scan".into()
        };
        match self.latency {
            Timing::Measured => format!("{when}, latency as measured"),
            Timing::Fixed(seconds) => format!("{when}, latency {} ms", short(seconds * 1e3)),
        }
    }

    /// The command that repeats the drive.
    pub fn command(&self) -> String {
        let plain = Self::maze(Family::Thin, 0);
        let mut text = String::from("apexd sil");
        let mut add = |words: std::fmt::Arguments<'_>| {
            text.push(' ');
            text.write_fmt(words).expect("a string takes everything");
        };
        match &self.world {
            WorldSpec::Maze { family, seed } => {
                add(format_args!("--maze {seed} --family {family}"))
            }
            WorldSpec::Map { file } => add(format_args!("--map {}", quoted(file))),
        }
        if let Some([x, y, degrees]) = self.start {
            add(format_args!("--start {x},{y},{degrees}"));
        }
        if let Some([x, y]) = self.goal {
            add(format_args!("--goal {x},{y}"));
        }
        add(format_args!("--policy {} --predictor {}", self.policy, quoted(&self.predictor)));
        add(format_args!("--speed-max {}", self.speed_max_mps));
        if self.lidar_range_m != plain.lidar_range_m {
            add(format_args!("--lidar-range {}", self.lidar_range_m));
        }
        if self.prediction_range_m != plain.prediction_range_m {
            add(format_args!("--prediction-range {}", self.prediction_range_m));
        }
        add(format_args!("--latency {} --seed {}", self.latency.text(), self.seed));
        if self.lidar_rate_hz != plain.lidar_rate_hz {
            add(format_args!("--set lidar.rate_hz={}", self.lidar_rate_hz));
        }
        if self.plan_period_s != plain.plan_period_s {
            add(format_args!("--set autopilot.plan_period_s={}", self.plan_period_s));
        }
        for assignment in &self.set {
            add(format_args!("--set {}", quoted(assignment)));
        }
        text
    }
}

/// A number with as many decimals as it needs, at most three.
fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// A word as a shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "._-/=:+,@%".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', "'\\''"))
    }
}

/// What is kept of a drive beyond its figures.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Keep {
    /// Where it led and how fast, for pictures; with a predictor also what was foreseen.
    pub course: bool,
    /// How much slower a safe drive along the same path would have to be (see
    /// [`floor`](crate::experiment::floor)).
    pub floor: bool,
    /// If it does not arrive: whether the known map would have led there.
    pub reference: bool,
}

/// A drive of an experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Task {
    /// Name of the experiment.
    pub experiment: String,
    /// What is driven.
    pub spec: RunSpec,
    /// What is kept.
    pub keep: Keep,
    /// What the drive is judged by, if the experiment is a benchmark of others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub benchmark: Option<Benchmark>,
}

/// A world of a published benchmark.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Benchmark {
    /// Its number there.
    pub world: u32,
    /// Length of the benchmark's own path from start to goal, metres.
    pub path_m: f64,
}

impl Task {
    /// Two tasks with the same key are the same.
    pub fn key(&self) -> String {
        let text = serde_json::to_string(self).expect("a task is plain data");
        let hash = Sha256::digest(text);
        hash.iter().take(10).map(|byte| format!("{byte:02x}")).collect()
    }
}
