//! The analysis as tables.

use super::analysis::{Analysis, Completion};
use super::stated;
use crate::experiment::failures::failures;
use crate::experiment::floor::AGES_S;
use crate::experiment::run::{Record, WallTimes};
use crate::experiment::statistics::{Interval, TTest};
use crate::experiment::table::{Cell, Table};

/// Every table that the drives give; none without rows.
pub fn tables(analysis: &Analysis, records: &[&Record]) -> Vec<Table> {
    let tables = [
        completion(analysis),
        comparison(analysis),
        steps(analysis),
        ranges(analysis),
        floors(analysis),
        failures(records),
    ];
    tables.into_iter().filter(|table| !table.rows.is_empty()).collect()
}

fn mean_of(interval: Option<Interval>) -> [Cell; 3] {
    let cell = |end: fn(Interval) -> f64| Cell::real(interval.map(end), 3);
    [cell(|i| i.mean), cell(|i| i.low), cell(|i| i.high)]
}

fn speed(mps: f64) -> Cell {
    Cell::text(mps.to_string())
}

/// A stated figure, or a span of them.
fn span(stated: [f64; 2]) -> String {
    let [low, high] = stated;
    if low == high { format!("{low}") } else { format!("{low} to {high}") }
}

fn completion(analysis: &Analysis) -> Table {
    let mut table = Table::new(
        "completion",
        "Completion time over that of the known-map pipeline in the same maze, mean and bootstrapped \
         95 % interval; over the true optimum, where it is known; over the safe floor of the known \
         map's path.",
        &[
            "mazes",
            "timing",
            "m/s",
            "method",
            "goal",
            "mean",
            "low",
            "high",
            "paper",
            "over optimum",
            "optima",
            "over floor",
            "collisions",
            "unknown entries",
            "rejected %",
            "age ms",
        ],
    );
    for c in &analysis.completions {
        let [mean, low, high] = mean_of(c.ratio);
        let Completion { arrived, drives, .. } = c;
        table.push(vec![
            Cell::text(&c.family),
            Cell::text(&c.timing),
            speed(c.speed_mps),
            Cell::text(&c.method),
            Cell::text(format!("{arrived}/{drives}")),
            mean,
            low,
            high,
            c.stated.map_or(Cell::Empty, |stated| Cell::text(span(stated))),
            Cell::ratio(c.over_optimum.map(|(mean, _)| mean)),
            c.over_optimum.map_or(Cell::Empty, |(_, n)| n.into()),
            Cell::ratio(c.over_floor),
            c.collisions.into(),
            c.unknown_entries.into(),
            Cell::Real(100.0 * c.rejected, 2),
            Cell::Real(c.age_ms, 0),
        ]);
    }
    table
}

fn comparison(analysis: &Analysis) -> Table {
    let mut table = Table::new(
        "tests",
        "Methods held against each other: difference of the completion times over the known map's, \
         with the bootstrapped 95 % interval over mazes, and two-tailed t tests, paired and Welch's.",
        &[
            "mazes",
            "timing",
            "m/s",
            "method",
            "against",
            "n",
            "difference",
            "low",
            "high",
            "paired t",
            "paired p",
            "Welch t",
            "Welch p",
            "paper's p",
        ],
    );
    let t = |test: Option<TTest>| Cell::real(test.map(|t| t.t), 2);
    let p = |test: Option<TTest>| Cell::real(test.map(|t| t.p), 4);
    for c in &analysis.comparisons {
        let difference = |end: fn(Interval) -> f64| Cell::real(c.difference.map(end), 4);
        table.push(vec![
            Cell::text(&c.family),
            Cell::text(&c.timing),
            speed(c.speed_mps),
            Cell::text(&c.a),
            Cell::text(&c.b),
            c.mazes.into(),
            difference(|i| i.mean),
            difference(|i| i.low),
            difference(|i| i.high),
            t(c.paired),
            p(c.paired),
            t(c.welch),
            p(c.welch),
            c.stated.map_or(Cell::Empty, Cell::text),
        ]);
    }
    table
}

fn steps(analysis: &Analysis) -> Table {
    let parts = WallTimes::PARTS.map(|part| format!("{part} ms"));
    let mut columns =
        vec!["method", "steps", "candidates", "p50 ms", "p99 ms", "mean ms", "factor"];
    columns.extend(parts.iter().map(String::as_str));
    columns.push("paper ms");
    let mut table = Table::new(
        "steps",
        "Wall time of a planning step on the machine that drove: percentiles over all steps, means of \
         the parts, and the mean over that of the paper's method.",
        &columns,
    );
    for row in &analysis.steps {
        let total = &row.wall.total;
        let mut cells = vec![
            Cell::text(&row.method),
            total.spread.count().into(),
            Cell::Real(row.candidates, 1),
            Cell::real(total.spread.quantile(0.5), 2),
            Cell::real(total.spread.quantile(0.99), 2),
            Cell::Real(total.mean(), 2),
            Cell::real(row.factor, 2),
        ];
        cells.extend(row.wall.means_ms().map(|ms| Cell::Real(ms, 2)));
        cells.push(Cell::real(row.stated_ms, 0));
        table.push(cells);
    }
    table
}

fn ranges(analysis: &Analysis) -> Table {
    let mut table = Table::new(
        "ranges",
        format!(
            "Completion time over the known map's by sensor and prediction range ({}).",
            stated::RANGES
        ),
        &["method", "m/s", "sensor m", "prediction m", "drives", "mean", "low", "high"],
    );
    for row in &analysis.ranges {
        let [mean, low, high] = mean_of(row.ratio);
        table.push(vec![
            Cell::text(&row.method),
            speed(row.speed_mps),
            Cell::text(row.sensor_m.to_string()),
            row.prediction_m.map_or(Cell::Empty, |m| Cell::text(m.to_string())),
            row.drives.into(),
            mean,
            low,
            high,
        ]);
    }
    table
}

fn floors(analysis: &Analysis) -> Table {
    let ages = AGES_S.map(|age| format!("age {} ms", (age * 1e3).round()));
    let mut columns = vec!["mazes", "m/s", "drives"];
    columns.extend(ages.iter().map(String::as_str));
    let mut table = Table::new(
        "floor",
        "The safe floor: how much longer the known map's path must take for a driver who knows it, but \
         can always stop in what has been seen along it, by the age of what is seen.",
        &columns,
    );
    for row in &analysis.floors {
        let mut cells = vec![Cell::text(&row.family), speed(row.speed_mps), row.mazes.into()];
        cells.extend(row.ratios.iter().map(|ratio| Cell::ratio(Some(*ratio))));
        table.push(cells);
    }
    table
}
