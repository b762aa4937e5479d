//! The tables of BARN's worlds.

use std::collections::{BTreeMap, BTreeSet};

use super::{LIMIT_S, method, score, succeeded};
use crate::experiment::failures::failures;
use crate::experiment::run::{Benchmark, Record};
use crate::experiment::statistics::mean;
use crate::experiment::table::{Cell, Table};
use crate::plan::Policy;
use crate::sim::drive::Outcome;

/// The drives by world and method, the known map's first.
struct Sorted<'a> {
    /// Names, the known map's first.
    methods: Vec<String>,
    /// By number.
    worlds: BTreeMap<u32, World<'a>>,
}

struct World<'a> {
    /// Length of the set's own path, metres.
    path_m: f64,
    drives: BTreeMap<String, &'a Record>,
}

impl World<'_> {
    /// Whether the known map leads through it; `None` if that has not been driven.
    fn passable(&self) -> Option<bool> {
        self.drives.get(Policy::KnownMap.name()).map(|record| succeeded(&record.drive))
    }
}

impl<'a> Sorted<'a> {
    fn of(records: &[&'a Record]) -> Self {
        let mut worlds: BTreeMap<u32, World<'a>> = BTreeMap::new();
        for record in records {
            let Some(Benchmark { world, path_m }) = record.task.benchmark else { continue };
            let world =
                worlds.entry(world).or_insert_with(|| World { path_m, drives: BTreeMap::new() });
            world.drives.insert(method(&record.task.spec), record);
        }
        let names: BTreeSet<&String> = worlds.values().flat_map(|w| w.drives.keys()).collect();
        let mut methods: Vec<String> = names.into_iter().cloned().collect();
        methods.sort_by_key(|name| name != Policy::KnownMap.name());
        Self { methods, worlds }
    }
}

fn ended(outcome: Outcome) -> String {
    format!("{outcome:?}").to_lowercase()
}

/// How the drives of each method came out, world by world, and the failures.
pub fn tables(records: &[&Record]) -> Vec<Table> {
    let sorted = Sorted::of(records);
    if sorted.worlds.is_empty() {
        return Vec::new();
    }
    let tables = [
        methods(&sorted),
        by_world(
            &sorted,
            "barn-scores",
            "Score in each world, or how the drive ended. The path is the set's own from start to \
             goal; par is the time that it takes at 2 m/s.",
            |record, path_m| {
                if succeeded(&record.drive) {
                    Cell::Real(score(&record.drive, path_m), 3)
                } else if record.arrived() {
                    Cell::text(format!("after {LIMIT_S} s"))
                } else {
                    Cell::text(ended(record.drive.outcome))
                }
            },
        ),
        by_world(
            &sorted,
            "barn-times",
            "Seconds from the first motion to rest at the goal in each world.",
            |record, _| Cell::real(record.arrived().then_some(record.drive.time_s), 2),
        ),
        failures(records),
    ];
    tables.into_iter().filter(|table| !table.rows.is_empty()).collect()
}

fn methods(sorted: &Sorted<'_>) -> Table {
    let mut table = Table::new(
        "barn",
        "BARN's worlds by method. A world is passable if the known map leads through it; time, over \
         that of the known map and clearance are means over the passable worlds that were crossed.",
        &[
            "method",
            "worlds",
            "crossed",
            "score",
            "passable",
            "crossed of these",
            "score in these",
            "time s",
            "over known map",
            "clearance m",
            "collided",
            "entered unknown",
            "stuck",
            "timeout",
            "given up",
        ],
    );
    for name in &sorted.methods {
        let driven: Vec<(&World<'_>, &Record)> = sorted
            .worlds
            .values()
            .filter_map(|world| Some((world, *world.drives.get(name)?)))
            .collect();
        let passable: Vec<_> =
            driven.iter().filter(|(world, _)| world.passable() == Some(true)).copied().collect();
        let crossed = |of: &[(&World<'_>, &Record)]| {
            of.iter().filter(|(_, record)| succeeded(&record.drive)).count()
        };
        let mean_score = |of: &[(&World<'_>, &Record)]| {
            let scores: Vec<f64> =
                of.iter().map(|(world, r)| score(&r.drive, world.path_m)).collect();
            Cell::ratio(mean(&scores))
        };
        let done: Vec<_> = passable.iter().filter(|(_, r)| succeeded(&r.drive)).collect();
        let over = |(world, record): &&(&World<'_>, &Record)| {
            let known = world.drives.get(Policy::KnownMap.name())?;
            Some(record.drive.time_s / known.drive.time_s)
        };
        let times: Vec<f64> = done.iter().map(|(_, r)| r.drive.time_s).collect();
        let ratios: Vec<f64> = done.iter().filter_map(over).collect();
        let clearances: Vec<f64> =
            done.iter().filter_map(|(_, r)| r.drive.min_clearance_m).collect();
        let count = |what: &dyn Fn(&Record) -> bool| {
            Cell::from(driven.iter().filter(|(_, record)| what(record)).count())
        };
        table.push(vec![
            Cell::text(name),
            driven.len().into(),
            crossed(&driven).into(),
            mean_score(&driven),
            passable.len().into(),
            crossed(&passable).into(),
            mean_score(&passable),
            Cell::real(mean(&times), 2),
            Cell::ratio(mean(&ratios)),
            Cell::ratio(mean(&clearances)),
            count(&|r| r.drive.collisions > 0),
            count(&|r| r.drive.unknown_entries > 0),
            count(&|r| r.drive.outcome == Outcome::Stuck),
            count(&|r| {
                r.drive.outcome == Outcome::Timeout || r.arrived() && r.drive.time_s > LIMIT_S
            }),
            count(&|r| r.drive.outcome == Outcome::Unreachable),
        ]);
    }
    table
}

fn by_world(
    sorted: &Sorted<'_>,
    name: &'static str,
    title: &str,
    cell: impl Fn(&Record, f64) -> Cell,
) -> Table {
    let columns: Vec<&str> = ["world", "path m", "par s"]
        .into_iter()
        .chain(sorted.methods.iter().map(String::as_str))
        .collect();
    let mut table = Table::new(name, title, &columns);
    for (number, world) in &sorted.worlds {
        let mut row = vec![
            u64::from(*number).into(),
            Cell::Real(world.path_m, 2),
            Cell::Real(world.path_m / super::PAR_SPEED_MPS, 2),
        ];
        row.extend(sorted.methods.iter().map(|method| {
            world.drives.get(method).map_or(Cell::Empty, |record| cell(record, world.path_m))
        }));
        table.push(row);
    }
    table
}

/// Which worlds cannot be crossed, in a sentence.
pub fn summary(records: &[&Record]) -> String {
    let sorted = Sorted::of(records);
    let known: Vec<(u32, bool)> = sorted
        .worlds
        .iter()
        .filter_map(|(number, world)| Some((*number, world.passable()?)))
        .collect();
    let closed: Vec<String> = known
        .iter()
        .filter(|(_, passable)| !passable)
        .map(|(number, _)| number.to_string())
        .collect();
    let mut text = format!(
        "The known map leads through {} of {} worlds",
        known.len() - closed.len(),
        known.len()
    );
    if !closed.is_empty() {
        text += &format!("; not through {}", closed.join(", "));
    }
    let unsafe_drives =
        records.iter().filter(|r| r.drive.collisions + r.drive.unknown_entries > 0).count();
    text + &format!(". {unsafe_drives} of {} drives were unsafe.", records.len())
}
