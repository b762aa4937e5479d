//! What of the paper's experiments is to be driven.

use std::collections::{BTreeMap, BTreeSet};

use crate::experiment::run::{Keep, RunSpec, SpecError, Task, Timing};
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::maze::Family;

/// From this speed on the lidar scans at 40 Hz: at 20 Hz the car would drive more than its stopping
/// reserve between two scans.
const FAST_MPS: f64 = 6.0;
/// Scans a second, slow and fast.
const SCAN_RATES_HZ: [f64; 2] = [20.0, 40.0];
/// The paper's planner runs at 2 Hz.
const PAPER_PERIOD_S: f64 = 0.5;

/// How often is planned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// After every scan, with a latency: what a car can have.
    EachScan,
    /// Twice a second, and the world waits for the planner: the paper's.
    Paper,
}

/// How is planned: `POLICY[+PREDICTOR][:section.key=value]...`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Method {
    /// Name of the policy.
    pub policy: String,
    /// Name of the predictor, or a network's file.
    pub predictor: String,
    /// Further parameters.
    pub set: Vec<String>,
}

/// A method that cannot be read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{text:?} is no method: wanted is POLICY[+PREDICTOR][:section.key=value]..., as in map-predictive+cnp"
)]
pub struct MethodError {
    /// What was given.
    pub text: String,
}

impl std::str::FromStr for Method {
    type Err = MethodError;

    fn from_str(text: &str) -> Result<Self, MethodError> {
        let wrong = || MethodError { text: text.to_owned() };
        let mut parts = text.split(':');
        let name = parts.next().filter(|name| !name.is_empty()).ok_or_else(wrong)?;
        let set: Vec<String> = parts.map(str::to_owned).collect();
        let (policy, predictor) = match name.split_once('+') {
            Some((policy, predictor)) => (policy, predictor),
            None if name == Policy::MapPredictive.name() => (name, PredictorKind::Cnp.name()),
            None => (name, PredictorKind::None.name()),
        };
        if policy.is_empty() || predictor.is_empty() || set.iter().any(|s| !s.contains('=')) {
            return Err(wrong());
        }
        Ok(Self { policy: policy.into(), predictor: predictor.into(), set })
    }
}

impl Method {
    /// The methods of the paper, and what is between them.
    pub fn defaults() -> Vec<Self> {
        [
            "frontier",
            "map-predictive+none",
            "map-predictive+cnp",
            "map-predictive+oracle",
            "janson",
            "janson-lite",
            "janson+cnp",
        ]
        .map(|text| text.parse().expect("the names are well formed"))
        .into()
    }
}

impl Method {
    /// The paper's method as its text can be read otherwise: by way of the frontiers, and with the
    /// penalty on the search's heuristic. And with shapes that rely on no network.
    pub fn variants() -> Vec<Self> {
        [
            "map-predictive+cnp:plan.reading=via-frontier",
            "map-predictive+cnp:search.penalty=literal",
            "map-predictive+cnp:foreseen.free_at_most=0:foreseen.occupied_at_least=1",
        ]
        .map(|text| text.parse().expect("the names are well formed"))
        .into()
    }
}

/// Sensor range against prediction range, as in the paper's heat map.
#[derive(Clone, Debug, PartialEq)]
pub struct Sweep {
    /// Mazes, from the first seed on.
    pub mazes: usize,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Lidar ranges, metres.
    pub sensor_m: Vec<f64>,
    /// Prediction ranges, metres.
    pub prediction_m: Vec<f64>,
    /// Methods.
    pub methods: Vec<Method>,
}

/// What is to be driven.
#[derive(Clone, Debug, PartialEq)]
pub struct PaperRequest {
    /// Kinds of maze.
    pub families: Vec<Family>,
    /// Their numbers.
    pub seeds: Vec<u64>,
    /// Highest speeds, m/s.
    pub speeds_mps: Vec<f64>,
    /// Methods beside the known map, which is always driven: the others are compared with it.
    pub methods: Vec<Method>,
    /// How often is planned.
    pub paces: Vec<Pace>,
    /// Time from a scan to its plan where the world does not wait.
    pub latency: Timing,
    /// The sweep over ranges, if it is wanted.
    pub sweep: Option<Sweep>,
    /// Parameters for all methods.
    pub set: Vec<String>,
    /// The speed at which drives are kept for pictures, m/s.
    pub picture_speed_mps: f64,
}

impl PaperRequest {
    /// The drives, each once, in an order that spreads long and short ones evenly.
    ///
    /// # Errors
    /// If this program has no such policy or predictor, or refuses a parameter.
    pub fn tasks(&self) -> Result<Vec<Task>, SpecError> {
        let known = RunSpec::maze(Family::Thin, 0).world;
        let mut tasks = BTreeMap::new();
        let mut add = |spec: RunSpec, keep: Keep| {
            let task = Task { experiment: super::NAME.into(), spec, keep, benchmark: None };
            // The same drive is wanted for the comparison and for the sweep: once is enough.
            tasks.entry(task.key()).or_insert(task);
        };
        let known_map = Method {
            policy: Policy::KnownMap.name().into(),
            predictor: PredictorKind::None.name().into(),
            set: Vec::new(),
        };
        for family in &self.families {
            for (i, seed) in self.seeds.iter().enumerate() {
                let course = |speed| i == 0 && speed == self.picture_speed_mps;
                let mut speeds = self.speeds_mps.clone();
                let sweep = self.sweep.as_ref().filter(|sweep| i < sweep.mazes);
                speeds.extend(sweep.map(|sweep| sweep.speed_mps));
                for speed in speeds {
                    let keep = Keep { course: course(speed), floor: true, reference: false };
                    add(self.spec(*family, *seed, &known_map, speed, Pace::EachScan), keep);
                }
                for speed in &self.speeds_mps {
                    for pace in &self.paces {
                        let course = course(*speed) && *pace == Pace::EachScan;
                        for method in &self.methods {
                            let keep = Keep { course, ..Keep::default() };
                            add(self.spec(*family, *seed, method, *speed, *pace), keep);
                        }
                    }
                }
                for spec in sweep.into_iter().flat_map(|s| self.swept(s, *family, *seed)) {
                    let main =
                        self.spec(*family, *seed, &known_map, spec.speed_max_mps, Pace::EachScan);
                    let ranges = |s: &RunSpec| (s.lidar_range_m, s.prediction_range_m);
                    let course = course(spec.speed_max_mps)
                        && self.speeds_mps.contains(&spec.speed_max_mps)
                        && ranges(&spec) == ranges(&main);
                    add(spec, Keep { course, ..Keep::default() });
                }
            }
        }
        let tasks: Vec<Task> = tasks.into_values().collect();
        // In which maze makes no difference to the parameters, and reading them takes a while.
        let mut checked = BTreeSet::new();
        for task in &tasks {
            let spec = &task.spec;
            let anywhere = RunSpec { world: known.clone(), ..spec.clone() };
            if checked.insert(serde_json::to_string(&anywhere).expect("a spec is plain data")) {
                spec.params()?;
            }
        }
        Ok(tasks)
    }

    /// The drives of the sweep in one maze.
    fn swept(&self, sweep: &Sweep, family: Family, seed: u64) -> Vec<RunSpec> {
        let mut specs = Vec::new();
        for method in &sweep.methods {
            let base = self.spec(family, seed, method, sweep.speed_mps, Pace::EachScan);
            for &lidar_range_m in &sweep.sensor_m {
                let with = |prediction_range_m| RunSpec {
                    lidar_range_m,
                    prediction_range_m,
                    ..base.clone()
                };
                if method.predictor == PredictorKind::None.name() {
                    specs.push(with(base.prediction_range_m));
                } else {
                    specs.extend(sweep.prediction_m.iter().map(|range| with(*range)));
                }
            }
        }
        specs
    }

    fn spec(&self, family: Family, seed: u64, method: &Method, speed: f64, pace: Pace) -> RunSpec {
        let paper = pace == Pace::Paper;
        RunSpec {
            policy: method.policy.clone(),
            predictor: method.predictor.clone(),
            speed_max_mps: speed,
            lidar_rate_hz: SCAN_RATES_HZ[usize::from(speed >= FAST_MPS)],
            plan_period_s: if paper { PAPER_PERIOD_S } else { 0.0 },
            latency: if paper { Timing::Fixed(0.0) } else { self.latency },
            set: self.set.iter().chain(&method.set).cloned().collect(),
            ..RunSpec::maze(family, seed)
        }
    }
}
