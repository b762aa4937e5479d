//! From single drives to what is said of the methods.

use std::collections::{BTreeMap, BTreeSet};

use super::optima::Optima;
use super::{OURS, stated};
use crate::experiment::floor::AGES_S;
use crate::experiment::run::{Record, RunSpec, Timing, WallTimes, WorldSpec};
use crate::experiment::statistics::{Interval, TTest, bootstrap, mean, paired_t, welch_t};
use crate::params::Params;
use crate::plan::Policy;
use crate::sim::maze::Family;

/// Everything that is said.
#[derive(Clone, Debug, Default)]
pub struct Analysis {
    /// Completion times by family, timing, speed and method.
    pub completions: Vec<Completion>,
    /// Methods held against each other.
    pub comparisons: Vec<Comparison>,
    /// Wall times of planning steps by method.
    pub steps: Vec<StepRow>,
    /// Sensor range against prediction range.
    pub ranges: Vec<RangeRow>,
    /// The price of safety along the known map's path.
    pub floors: Vec<FloorRow>,
}

/// Completion times of one method under one condition.
#[derive(Clone, Debug)]
pub struct Completion {
    /// Kind of maze.
    pub family: String,
    /// When is planned, in words.
    pub timing: String,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Name of the method.
    pub method: String,
    /// Drives.
    pub drives: usize,
    /// Drives that reached the goal.
    pub arrived: usize,
    /// Time over that of the known map, by maze.
    pub ratios: BTreeMap<u64, f64>,
    /// Mean of these, with its bootstrap interval.
    pub ratio: Option<Interval>,
    /// Time over the true optimum, mean over the mazes whose optimum is known, and their number.
    pub over_optimum: Option<(f64, usize)>,
    /// Time over the safe floor of the known map's path, mean.
    pub over_floor: Option<f64>,
    /// The paper's figure, from and to.
    pub stated: Option<[f64; 2]>,
    /// Instants of contact.
    pub collisions: u64,
    /// Instants in space not seen to be free.
    pub unknown_entries: u64,
    /// Share of the plans that did not pass the certificate.
    pub rejected: f64,
    /// Median age of the scan behind the plan being driven, mean over the drives, milliseconds.
    pub age_ms: f64,
}

/// Two methods in the same mazes under the same condition.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// Kind of maze.
    pub family: String,
    /// When is planned, in words.
    pub timing: String,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// The one.
    pub a: String,
    /// The other.
    pub b: String,
    /// Mazes that both drove to the goal.
    pub mazes: usize,
    /// Difference of their times over the known map's, the one less the other, with the bootstrap
    /// interval over mazes.
    pub difference: Option<Interval>,
    /// Pair by pair.
    pub paired: Option<TTest>,
    /// As if the mazes had been different ones: the paper's.
    pub welch: Option<TTest>,
    /// The paper's probability.
    pub stated: Option<&'static str>,
}

/// Planning steps of one method.
#[derive(Clone, Debug)]
pub struct StepRow {
    /// Name of the method.
    pub method: String,
    /// Wall times over all its drives.
    pub wall: WallTimes,
    /// Mean number of candidate paths.
    pub candidates: f64,
    /// Mean time over that of the paper's method, if that was driven.
    pub factor: Option<f64>,
    /// The paper's mean time, milliseconds.
    pub stated_ms: Option<f64>,
}

/// One method with one pair of ranges.
#[derive(Clone, Debug)]
pub struct RangeRow {
    /// Name of the method.
    pub method: String,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Lidar range, metres.
    pub sensor_m: f64,
    /// Prediction range, metres; `None` where nothing is predicted.
    pub prediction_m: Option<f64>,
    /// Drives.
    pub drives: usize,
    /// Time over that of the known map.
    pub ratio: Option<Interval>,
}

/// The safe floor at one speed.
#[derive(Clone, Debug)]
pub struct FloorRow {
    /// Kind of maze.
    pub family: String,
    /// Highest speed, m/s.
    pub speed_mps: f64,
    /// Mazes.
    pub mazes: usize,
    /// Mean of safe time over unrestricted time, for each of [`AGES_S`].
    pub ratios: Vec<f64>,
}

/// Speeds and ranges as whole thousandths, so that they can be keys.
fn thousandths(value: f64) -> u64 {
    (value * 1e3).round() as u64
}

fn maze_seed(spec: &RunSpec) -> Option<u64> {
    match &spec.world {
        WorldSpec::Maze { seed, .. } => Some(*seed),
        WorldSpec::Map { .. } => None,
    }
}

/// The known map's drives by family, seed and speed.
type Bases<'a> = BTreeMap<(&'a str, u64, u64), &'a Record>;

impl Analysis {
    /// Of these drives.
    pub fn of(records: &[&Record], optima: &Optima) -> Self {
        let bases = bases(records);
        let completions = completions(records, &bases, optima);
        Self {
            comparisons: comparisons(&completions),
            steps: steps(records),
            ranges: ranges(records, &bases),
            floors: floors(&bases),
            completions,
        }
    }

    /// The timings, families and methods that occur in the completion times, in order.
    pub fn conditions(&self) -> Vec<(String, String)> {
        let all: BTreeSet<_> =
            self.completions.iter().map(|c| (c.family.clone(), c.timing.clone())).collect();
        all.into_iter().collect()
    }
}

fn bases<'a>(records: &[&'a Record]) -> Bases<'a> {
    let mut bases = Bases::new();
    for record in records.iter().copied().filter(|r| r.task.spec.policy == Policy::KnownMap.name())
    {
        let spec = &record.task.spec;
        let Some(seed) = maze_seed(spec) else { continue };
        let key = (spec.world.family(), seed, thousandths(spec.speed_max_mps));
        let base = bases.entry(key).or_insert(record);
        // Where known maps with different parameters are compared, the plain one is the base.
        if spec.set.len() < base.task.spec.set.len() {
            *base = record;
        }
    }
    bases
}

/// Time over that of the known map in the same maze at the same speed, where both arrived.
fn ratio(record: &Record, bases: &Bases<'_>) -> Option<f64> {
    let spec = &record.task.spec;
    let key = (spec.world.family(), maze_seed(spec)?, thousandths(spec.speed_max_mps));
    let base = bases.get(&key).filter(|base| base.arrived() && record.arrived())?;
    Some(record.drive.time_s / base.drive.time_s)
}

/// Where a method stands in tables: the paper's order, others behind by name.
fn order(method: &str) -> (usize, String) {
    const ORDER: [&str; 8] = [
        "known-map",
        "frontier",
        "map-predictive+none",
        OURS,
        "map-predictive+oracle",
        "janson",
        "janson-lite",
        "janson+cnp",
    ];
    let place = ORDER.iter().position(|name| *name == method).unwrap_or(ORDER.len());
    (place, method.to_owned())
}

/// Ranges as they are if nothing else is said.
fn has_main_ranges(spec: &RunSpec) -> bool {
    let params = Params::default();
    spec.lidar_range_m == params.lidar.range_m && spec.prediction_range_m == params.predict.range_m
}

fn completions(records: &[&Record], bases: &Bases<'_>, optima: &Optima) -> Vec<Completion> {
    let mut groups: BTreeMap<_, Vec<&Record>> = BTreeMap::new();
    for record in records.iter().filter(|record| has_main_ranges(&record.task.spec)) {
        let spec = &record.task.spec;
        let key = (
            spec.world.family(),
            spec.timing(),
            thousandths(spec.speed_max_mps),
            order(&spec.method()),
        );
        groups.entry(key).or_default().push(record);
    }
    groups
        .into_iter()
        .map(|((family, timing, speed, (_, method)), group)| {
            let speed_mps = speed as f64 / 1e3;
            let seed = |record: &Record| maze_seed(&record.task.spec);
            let ratios: BTreeMap<u64, f64> =
                group.iter().filter_map(|r| Some((seed(r)?, ratio(r, bases)?))).collect();
            let optimum = |record: &Record| {
                let thin = family == Family::Thin.name() && record.arrived();
                let time_s = optima.time_s(seed(record).filter(|_| thin)?, speed_mps)?;
                Some(record.drive.time_s / time_s)
            };
            let over_optimum: Vec<f64> = group.iter().filter_map(|r| optimum(r)).collect();
            let age_s = match group[0].task.spec.latency {
                Timing::Fixed(seconds) => seconds,
                Timing::Measured => 0.0,
            };
            let over_floor: Vec<f64> = ratios
                .iter()
                .filter_map(|(seed, ratio)| {
                    let base = bases.get(&(family, *seed, speed))?;
                    Some(ratio / base.floor.as_ref()?.ratio(age_s)?)
                })
                .collect();
            let sum = |f: &dyn Fn(&Record) -> u64| group.iter().map(|r| f(r)).sum::<u64>();
            let values: Vec<f64> = ratios.values().copied().collect();
            let ages: Vec<f64> = group.iter().map(|r| r.drive.age_ms.p50).collect();
            Completion {
                family: family.to_owned(),
                timing,
                speed_mps,
                drives: group.len(),
                arrived: group.iter().filter(|r| r.arrived()).count(),
                ratio: bootstrap(&values),
                ratios,
                over_optimum: mean(&over_optimum).map(|m| (m, over_optimum.len())),
                over_floor: mean(&over_floor),
                stated: stated::completion(&method, speed_mps),
                collisions: sum(&|r| r.drive.collisions),
                unknown_entries: sum(&|r| r.drive.unknown_entries),
                rejected: sum(&|r| r.drive.plans_rejected) as f64
                    / sum(&|r| r.drive.replans).max(1) as f64,
                age_ms: mean(&ages).unwrap_or_default(),
                method,
            }
        })
        .collect()
}

/// The paper's method against every other one, and predictions for the other planner.
fn comparisons(completions: &[Completion]) -> Vec<Comparison> {
    let mut comparisons = Vec::new();
    for a in completions {
        for b in completions {
            let same = (&a.family, &a.timing, a.speed_mps) == (&b.family, &b.timing, b.speed_mps);
            let wanted =
                a.method == OURS && b.method != OURS && b.method != Policy::KnownMap.name()
                    || a.method == "janson+cnp" && b.method == "janson";
            if !same || !wanted {
                continue;
            }
            let both = |c: &Completion, other: &Completion| -> Vec<f64> {
                let shared = c.ratios.iter().filter(|(seed, _)| other.ratios.contains_key(seed));
                shared.map(|(_, ratio)| *ratio).collect()
            };
            let (x, y) = (both(a, b), both(b, a));
            let differences: Vec<f64> = x.iter().zip(&y).map(|(x, y)| x - y).collect();
            comparisons.push(Comparison {
                family: a.family.clone(),
                timing: a.timing.clone(),
                speed_mps: a.speed_mps,
                a: a.method.clone(),
                b: b.method.clone(),
                mazes: x.len(),
                difference: bootstrap(&differences),
                paired: paired_t(&x, &y),
                welch: welch_t(&x, &y),
                stated: stated::p(&a.method, &b.method, a.speed_mps),
            });
        }
    }
    comparisons
}

fn steps(records: &[&Record]) -> Vec<StepRow> {
    let mut groups: BTreeMap<_, (WallTimes, f64)> = BTreeMap::new();
    for record in records.iter().filter(|record| has_main_ranges(&record.task.spec)) {
        let (wall, candidates) = groups.entry(order(&record.task.spec.method())).or_default();
        wall.join(&record.wall);
        *candidates += record.drive.candidates * record.drive.replans as f64;
    }
    let ours_ms = groups.get(&order(OURS)).map(|(wall, _)| wall.total.mean());
    groups
        .into_iter()
        .map(|((_, method), (wall, candidates))| StepRow {
            candidates: candidates / wall.total.spread.count().max(1) as f64,
            factor: ours_ms.filter(|ms| *ms > 0.0).map(|ms| wall.total.mean() / ms),
            stated_ms: stated::step_ms(&method),
            method,
            wall,
        })
        .collect()
}

fn ranges(records: &[&Record], bases: &Bases<'_>) -> Vec<RangeRow> {
    // A sweep has more than one range at its speed; the mazes of its cells must be the same ones,
    // so the main comparison lends only those that the sweep has driven too.
    let swept: BTreeSet<(u64, &str, Option<u64>)> = records
        .iter()
        .map(|record| &record.task.spec)
        .filter(|spec| !has_main_ranges(spec))
        .map(|spec| (thousandths(spec.speed_max_mps), spec.world.family(), maze_seed(spec)))
        .collect();
    let mut groups: BTreeMap<_, Vec<&Record>> = BTreeMap::new();
    for record in records {
        let spec = &record.task.spec;
        let speed = thousandths(spec.speed_max_mps);
        let place = (speed, spec.world.family(), maze_seed(spec));
        let known = spec.policy == Policy::KnownMap.name();
        if known || spec.plan_period_s > 0.0 || !swept.contains(&place) {
            continue;
        }
        let prediction = (spec.predictor != "none").then(|| thousandths(spec.prediction_range_m));
        let key = (speed, order(&spec.method()), thousandths(spec.lidar_range_m), prediction);
        groups.entry(key).or_default().push(record);
    }
    // Methods that were driven with one pair of ranges only are no part of the sweep.
    let swept_methods: BTreeSet<String> = {
        let mut cells: BTreeMap<String, usize> = BTreeMap::new();
        for (_, (_, method), _, _) in groups.keys() {
            *cells.entry(method.clone()).or_default() += 1;
        }
        cells.into_iter().filter(|(_, n)| *n > 1).map(|(method, _)| method).collect()
    };
    groups
        .into_iter()
        .filter(|((_, (_, method), _, _), _)| swept_methods.contains(method))
        .map(|((speed, (_, method), sensor, prediction), group)| {
            let ratios: Vec<f64> = group.iter().filter_map(|r| ratio(r, bases)).collect();
            RangeRow {
                method,
                speed_mps: speed as f64 / 1e3,
                sensor_m: sensor as f64 / 1e3,
                prediction_m: prediction.map(|p| p as f64 / 1e3),
                drives: group.len(),
                ratio: bootstrap(&ratios),
            }
        })
        .collect()
}

fn floors(bases: &Bases<'_>) -> Vec<FloorRow> {
    let mut groups: BTreeMap<(&str, u64), Vec<&Record>> = BTreeMap::new();
    for ((family, _, speed), record) in bases {
        if record.floor.is_some() {
            groups.entry((family, *speed)).or_default().push(record);
        }
    }
    groups
        .into_iter()
        .map(|((family, speed), group)| {
            let at = |age_s: f64| {
                let ratios: Vec<f64> =
                    group.iter().filter_map(|r| r.floor.as_ref()?.ratio(age_s)).collect();
                mean(&ratios).unwrap_or(f64::NAN)
            };
            FloorRow {
                family: family.to_owned(),
                speed_mps: speed as f64 / 1e3,
                mazes: group.len(),
                ratios: AGES_S.map(at).to_vec(),
            }
        })
        .collect()
}
