//! Random drives that look for what must not happen: contact, and entry into space that was not seen
//! to be free.
//!
//! Everything about a drive is drawn at random: world, start, goal, policy, predictor (also ones that
//! tell nonsense or the opposite of the truth), speed, latency, lidar rate. Drive number `i` of a
//! seed is the same whatever the number of drives.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use rayon::prelude::*;

use super::dataset::HELD_OUT_FROM;
use super::failures::failures;
use super::run::{Keep, Record, RunError, RunSpec, SpecError, Task, Timing, WorldSpec};
use super::table::{Cell, Table};
use crate::frames::{Point, Vector};
use crate::mapfile;
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::drive::Outcome;
use crate::sim::maze::{self, Family};
use crate::sim::world::World;

/// Name of the experiment in its records.
pub const NAME: &str = "campaign";

/// What is drawn from.
#[derive(Clone, Debug, PartialEq)]
pub struct CampaignRequest {
    /// Number of drives.
    pub runs: u64,
    /// Seed of all that is drawn.
    pub seed: u64,
    /// Kinds of maze, and posts.
    pub families: Vec<Family>,
    /// Map files; together they are as likely as one family.
    pub maps: Vec<String>,
    /// Policies.
    pub policies: Vec<String>,
    /// Predictors, for the policies that listen to one.
    pub predictors: Vec<String>,
    /// Highest speeds, m/s.
    pub speeds_mps: Vec<f64>,
    /// Latencies.
    pub latencies: Vec<Timing>,
    /// Scans a second.
    pub lidar_rates_hz: Vec<f64>,
    /// Parameters for all drives.
    pub set: Vec<String>,
}

impl Default for CampaignRequest {
    fn default() -> Self {
        Self {
            runs: 100,
            seed: 1,
            families: Family::ALL.to_vec(),
            maps: Vec::new(),
            policies: ["map-predictive", "frontier", "janson", "janson-lite"]
                .map(str::to_owned)
                .to_vec(),
            predictors: ["cnp", "none", "oracle", "random", "inverted"].map(str::to_owned).to_vec(),
            speeds_mps: vec![1.0, 2.0, 4.0, 6.0, 8.0],
            latencies: [0.0, 0.02, 0.05, 0.1].map(Timing::Fixed).to_vec(),
            lidar_rates_hz: vec![10.0, 20.0, 40.0],
            set: Vec::new(),
        }
    }
}

/// One in so many drives goes from the world's own start to its own goal, the longest way.
const OWN_TASK_ONE_IN: u32 = 4;
/// Room around a random start or goal, metres.
const ROOM_M: f64 = 0.45;
/// Free way ahead of a random start, metres: a car without reverse gear must be able to turn.
const AHEAD_M: f64 = 1.2;
/// Straight distance from a random start to a random goal, metres.
const APART_M: f64 = 5.0;
/// Draws of a start and a goal in one world; in a world too small for them there are none.
const DRAWS: usize = 2000;

/// A map that cannot be driven in.
#[derive(Debug, thiserror::Error)]
pub enum CampaignError {
    /// The map cannot be read, or a name is unknown.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The map has no room for a random drive.
    #[error(
        "{file}: no start and goal with {ROOM_M} m of room around them were found {APART_M} m apart"
    )]
    NoRoom {
        /// Its file.
        file: String,
    },
    /// There is nothing to draw from.
    #[error("there are no {0} to draw from")]
    Nothing(&'static str),
}

impl CampaignRequest {
    /// The drives.
    ///
    /// # Errors
    /// If a map cannot be read or has no room, or this program does not know a policy.
    pub fn tasks(&self) -> Result<Vec<Task>, CampaignError> {
        for (name, none) in [
            ("worlds", self.families.is_empty() && self.maps.is_empty()),
            ("policies", self.policies.is_empty()),
            ("predictors", self.predictors.is_empty()),
            ("speeds", self.speeds_mps.is_empty()),
            ("latencies", self.latencies.is_empty()),
            ("lidar rates", self.lidar_rates_hz.is_empty()),
        ] {
            if none {
                return Err(CampaignError::Nothing(name));
            }
        }
        self.check_values().map_err(RunError::from)?;
        let maps: Vec<World> = self
            .maps
            .iter()
            .map(|file| {
                let map = mapfile::load(Path::new(file)).map_err(|error| RunError::Map {
                    file: file.clone(),
                    error: Box::new(error),
                })?;
                Ok(World::from_map(&map))
            })
            .collect::<Result<_, RunError>>()?;
        (0..self.runs).into_par_iter().map(|number| self.task(number, &maps)).collect()
    }

    /// Reads the parameters with each value that may be drawn, so that a name or a number that does
    /// not do is found before anything is driven.
    fn check_values(&self) -> Result<(), SpecError> {
        let base = RunSpec { set: self.set.clone(), ..RunSpec::maze(Family::Thin, 0) };
        let policies = self.policies.iter().map(|p| RunSpec { policy: p.clone(), ..base.clone() });
        let predictors =
            self.predictors.iter().map(|p| RunSpec { predictor: p.clone(), ..base.clone() });
        let speeds = self.speeds_mps.iter().map(|v| RunSpec { speed_max_mps: *v, ..base.clone() });
        let rates =
            self.lidar_rates_hz.iter().map(|r| RunSpec { lidar_rate_hz: *r, ..base.clone() });
        let mut all = policies.chain(predictors).chain(speeds).chain(rates);
        all.try_for_each(|spec| spec.params().map(drop))
    }

    fn task(&self, number: u64, maps: &[World]) -> Result<Task, CampaignError> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(number);
        let kinds = self.families.len() + usize::from(!maps.is_empty());
        let kind = index(&mut rng, kinds);
        let seed = HELD_OUT_FROM + u64::from(rng.next_u32() % 1_000_000);
        let own_task = rng.next_u32().is_multiple_of(OWN_TASK_ONE_IN);
        let mut spec = RunSpec::maze(Family::Thin, seed);
        let task = match self.families.get(kind) {
            Some(family) => {
                spec.world = WorldSpec::Maze { family: family.name().into(), seed };
                let maze = maze::generate(*family, seed, maze::RESOLUTION_M)
                    .expect("the usual resolution divides the hallway");
                if own_task { None } else { start_and_goal(&maze.world, &mut rng) }
            }
            None => {
                let i = index(&mut rng, maps.len());
                let file = self.maps[i].clone();
                spec.world = WorldSpec::Map { file: file.clone() };
                let task = start_and_goal(&maps[i], &mut rng);
                Some(task.ok_or(CampaignError::NoRoom { file })?)
            }
        };
        if let Some((start, goal)) = task {
            (spec.start, spec.goal) = (Some(start), Some(goal));
        }
        spec.policy.clone_from(pick(&mut rng, &self.policies));
        let predictor = pick(&mut rng, &self.predictors).clone();
        let listens =
            ![Policy::Frontier, Policy::KnownMap].map(Policy::name).contains(&&*spec.policy);
        spec.predictor = if listens { predictor } else { PredictorKind::None.name().into() };
        spec.speed_max_mps = *pick(&mut rng, &self.speeds_mps);
        spec.latency = *pick(&mut rng, &self.latencies);
        spec.lidar_rate_hz = *pick(&mut rng, &self.lidar_rates_hz);
        spec.seed = u64::from(rng.next_u32());
        spec.set.clone_from(&self.set);
        let keep = Keep { reference: true, ..Keep::default() };
        Ok(Task { experiment: NAME.into(), spec, keep, benchmark: None })
    }
}

fn index(rng: &mut ChaCha8Rng, n: usize) -> usize {
    (rng.next_u32() as usize) % n
}

fn pick<'a, T>(rng: &mut ChaCha8Rng, from: &'a [T]) -> &'a T {
    &from[index(rng, from.len())]
}

/// A random start (metres, metres, degrees) and goal with room around them, on whole centimetres
/// and degrees so that a command line carries them exactly.
fn start_and_goal(world: &World, rng: &mut ChaCha8Rng) -> Option<([f64; 3], [f64; 2])> {
    let [low, high] = world.bounds();
    let between = |rng: &mut ChaCha8Rng, low: f64, high: f64| {
        let share = f64::from(rng.next_u32()) / 2f64.powi(32);
        ((low + share * (high - low)) * 100.0).round() / 100.0
    };
    let place = |rng: &mut ChaCha8Rng| {
        let x = between(rng, low.x, high.x);
        Point::new(x, between(rng, low.y, high.y))
    };
    let roomy = |p: Point| world.contains(p) && world.distance_m(p, 2.0 * ROOM_M) >= ROOM_M;
    for _ in 0..DRAWS {
        let (start, goal) = (place(rng), place(rng));
        let degrees = f64::from(rng.next_u32() % 360) - 180.0;
        let way: Vector = goal - start;
        if way.norm() >= APART_M
            && roomy(start)
            && roomy(goal)
            && world.raycast(start, degrees.to_radians(), AHEAD_M) >= AHEAD_M
        {
            return Some(([start.x, start.y, degrees], [goal.x, goal.y]));
        }
    }
    None
}

/// What came of some drives.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Drives.
    pub runs: u64,
    /// Drives that reached the goal.
    pub goal: u64,
    /// Drives in worlds that the known map leads through.
    pub solvable: u64,
    /// Of these, those that got stuck.
    pub stuck: u64,
    /// Of these, those that ran out of time.
    pub timeout: u64,
    /// Of these, those that were given up as unreachable.
    pub unreachable: u64,
    /// Drives in worlds that the known map does not lead through either.
    pub unsolvable: u64,
    /// Drives with contact.
    pub collided: u64,
    /// Instants of contact.
    pub collisions: u64,
    /// Drives that entered space not seen to be free.
    pub entered: u64,
    /// Instants in such space.
    pub unknown_entries: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
    /// Planning steps.
    pub replans: u64,
    /// Plans that did not pass the certificate.
    pub plans_rejected: u64,
}

impl Tally {
    /// Counts a drive.
    pub fn add(&mut self, record: &Record) {
        let drive = &record.drive;
        // A drive that arrived or touched something says by itself that there was a way to go.
        let known_map = record.reference.as_ref().map_or(Outcome::Goal, |r| r.outcome);
        let solvable = u64::from(known_map == Outcome::Goal);
        let count = |outcome| u64::from(drive.outcome == outcome);
        self.runs += 1;
        self.goal += count(Outcome::Goal);
        self.solvable += solvable;
        self.unsolvable += 1 - solvable;
        self.stuck += solvable * count(Outcome::Stuck);
        self.timeout += solvable * count(Outcome::Timeout);
        self.unreachable += solvable * count(Outcome::Unreachable);
        self.collided += u64::from(drive.collisions > 0);
        self.collisions += drive.collisions;
        self.entered += u64::from(drive.unknown_entries > 0);
        self.unknown_entries += drive.unknown_entries;
        self.guard_stops += drive.guard_stops;
        self.replans += drive.replans;
        self.plans_rejected += drive.plans_rejected;
    }

    /// Of drives together.
    pub fn of<'a>(records: impl IntoIterator<Item = &'a Record>) -> Self {
        let mut tally = Self::default();
        for record in records {
            tally.add(record);
        }
        tally
    }

    /// Whether nothing happened that must not.
    pub const fn is_safe(&self) -> bool {
        self.collisions == 0 && self.unknown_entries == 0
    }

    /// If nothing happened in this many drives, at 95 per cent confidence it happens in less than
    /// this share of them (Clopper and Pearson 1934, for no event).
    pub fn rate_below(&self) -> f64 {
        1.0 - 0.05f64.powf(1.0 / self.runs.max(1) as f64)
    }
}

/// The counts in a sentence or two.
pub fn summary(records: &[&Record]) -> String {
    let t = Tally::of(records.iter().copied());
    let mut text = format!(
        "{} drives: {} at the goal; {} with collisions, {} with unknown entries. Of {} worlds that \
         the known map leads through, {} stuck, {} out of time, {} given up; {} worlds that it does \
         not lead through either.",
        t.runs,
        t.goal,
        t.collided,
        t.entered,
        t.solvable,
        t.stuck,
        t.timeout,
        t.unreachable,
        t.unsolvable
    );
    if t.runs > 0 && t.is_safe() {
        text += &format!(
            " At 95 % confidence less than {:.2} % of such drives are unsafe.",
            100.0 * t.rate_below()
        );
    }
    text
}

/// The counts by all that was drawn, and the failures.
pub fn tables(records: &[&Record]) -> Vec<Table> {
    let mut table = Table::new(
        "campaign",
        "Random drives by what was drawn. Stuck, out of time and given up count where the known map \
         leads to the goal; where it does not either, the drive is unsolvable.",
        &[
            "by",
            "value",
            "drives",
            "goal",
            "stuck",
            "timeout",
            "given up",
            "unsolvable",
            "collided",
            "entered unknown",
            "guard stops",
            "rejected %",
        ],
    );
    let mut group = |by: &str, value: &str, records: &[&Record]| {
        let t = Tally::of(records.iter().copied());
        table.push(vec![
            Cell::text(by),
            Cell::text(value),
            t.runs.into(),
            t.goal.into(),
            t.stuck.into(),
            t.timeout.into(),
            t.unreachable.into(),
            t.unsolvable.into(),
            t.collided.into(),
            t.entered.into(),
            t.guard_stops.into(),
            Cell::Real(100.0 * t.plans_rejected as f64 / t.replans.max(1) as f64, 2),
        ]);
    };
    if records.is_empty() {
        return Vec::new();
    }
    group("all", "", records);
    type Value = fn(&RunSpec) -> String;
    let by: [(&str, Value); 5] = [
        ("world", |s| s.world.family().to_owned()),
        ("method", RunSpec::method),
        ("m/s", |s| s.speed_max_mps.to_string()),
        ("latency s", |s| s.latency.text()),
        ("lidar Hz", |s| s.lidar_rate_hz.to_string()),
    ];
    for (name, value) in by {
        let values: BTreeSet<String> = records.iter().map(|r| value(&r.task.spec)).collect();
        let mut groups: BTreeMap<&str, Vec<&Record>> = BTreeMap::new();
        for record in records {
            let own = values.get(&value(&record.task.spec)).expect("it was collected from there");
            groups.entry(own).or_default().push(record);
        }
        for (value, records) in groups {
            group(name, value, &records);
        }
    }
    let failures = failures(records);
    [table, failures].into_iter().filter(|table| !table.rows.is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn request(runs: u64) -> CampaignRequest {
        CampaignRequest {
            runs,
            policies: vec!["map-predictive".into(), "frontier".into()],
            ..CampaignRequest::default()
        }
    }

    #[test]
    fn a_drive_is_the_same_whatever_the_number_of_drives_and_threads() {
        let few = request(10).tasks().unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let many = pool.install(|| request(40).tasks().unwrap());
        assert_eq!(few, many[..10]);
        assert_ne!(few, CampaignRequest { seed: 2, ..request(10) }.tasks().unwrap());
        let keys: BTreeSet<String> = many.iter().map(Task::key).collect();
        assert_eq!(keys.len(), 40);
    }

    #[test]
    fn everything_is_drawn() {
        let tasks = request(300).tasks().unwrap();
        let values = |value: &dyn Fn(&RunSpec) -> String| -> BTreeSet<String> {
            tasks.iter().map(|task| value(&task.spec)).collect()
        };
        assert_eq!(values(&|s| s.world.family().to_owned()).len(), 4);
        assert_eq!(values(&|s| s.speed_max_mps.to_string()).len(), 5);
        assert_eq!(values(&|s| s.latency.text()).len(), 4);
        assert_eq!(values(&|s| s.lidar_rate_hz.to_string()).len(), 3);
        // Five predictors, and the frontier policy without any.
        assert_eq!(values(&RunSpec::method).len(), 6);
        assert!(tasks.iter().filter(|task| task.spec.start.is_some()).count() > 150);
    }

    #[test]
    fn starts_and_goals_have_room_and_lie_on_whole_centimetres() {
        for task in request(60).tasks().unwrap() {
            let place = super::super::run::place(&task.spec).unwrap();
            let [Some(start), Some(goal)] =
                [task.spec.start.map(|[x, y, _]| [x, y]), task.spec.goal]
            else {
                continue;
            };
            for [x, y] in [start, goal] {
                assert!(place.world.distance_m(Point::new(x, y), 1.0) >= ROOM_M);
                assert!((x * 100.0 - (x * 100.0).round()).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn unknown_names_and_empty_lists_are_refused() {
        let of = |policy: &str| CampaignRequest { policies: vec![policy.into()], ..request(3) };
        let error = of("astrology").tasks().unwrap_err().to_string();
        assert!(error.contains("no policy \"astrology\"; it has map-predictive"), "{error}");
        let none = CampaignRequest { speeds_mps: Vec::new(), ..request(3) };
        assert_eq!(none.tasks().unwrap_err().to_string(), "there are no speeds to draw from");
    }
}
