//! The figures of the paper's experiments: completion times and step times as bars, sensor range
//! against prediction range as a map of heat, and drives coloured by speed, with what the paper
//! states beside what was measured.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::axes::{Frame, ticks};
use super::colour::{HAIRLINE, INK, SOFT_INK, viridis};
use super::colour_bar::speed_bar;
use super::drive::truth_layer;
use super::svg::{Anchor, Svg};
use super::{ReportError, put, raster};
use crate::experiment::paper::{Analysis, Completion, OURS, RangeRow, StepRow, stated};
use crate::experiment::run::{Record, WallTimes, WorldSpec, place};
use crate::shell::simulator::walls;

/// Colours of Okabe and Ito ("Color universal design", 2008), told apart by colour-blind eyes.
const PALETTE: [&str; 8] =
    ["#d55e00", "#56b4e9", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#7a5195", "#8a8f98"];
const STATED: &str = "#20242c";

/// A finished figure.
pub struct Figure {
    /// Name of its files.
    pub name: String,
    /// The picture.
    pub svg: String,
    /// Whether a page shows it as pixels: it has very many lines.
    pub heavy: bool,
}

/// All figures that the results give.
///
/// # Errors
/// If a world of a kept drive cannot be had again.
pub fn draw(analysis: &Analysis, records: &[&Record]) -> Result<Vec<Figure>, ReportError> {
    let mut figures = Vec::new();
    let mut add = |name: String, svg: String, heavy| {
        let name = name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
        figures.push(Figure { name, svg, heavy });
    };
    for (family, timing) in analysis.conditions() {
        let rows: Vec<&Completion> = analysis
            .completions
            .iter()
            .filter(|c| (&c.family, &c.timing) == (&family, &timing))
            .filter(|c| c.method != "known-map" && c.ratio.is_some())
            .collect();
        if !rows.is_empty() {
            let title = format!("Completion time · {family} mazes · {timing}");
            add(format!("completion-{family}-{timing}"), completion(&rows, &title), false);
        }
    }
    if !analysis.steps.is_empty() {
        add("steps".into(), steps(&analysis.steps), false);
    }
    if !analysis.ranges.is_empty() {
        add("ranges".into(), ranges(&analysis.ranges), false);
    }
    let mut kept: BTreeMap<(&str, u64), Vec<&Record>> = BTreeMap::new();
    for record in records.iter().filter(|record| !record.course.is_empty()) {
        let spec = &record.task.spec;
        if let WorldSpec::Maze { family, seed } = &spec.world {
            kept.entry((family, *seed)).or_default().push(record);
        }
    }
    for ((family, _), drives) in kept {
        add(format!("courses-{family}"), courses(&drives)?, true);
    }
    Ok(figures)
}

/// Writes a figure as SVG and PNG into a folder that exists; gives the file that a page shows.
///
/// # Errors
/// If it cannot be drawn or written.
pub fn write(folder: &Path, figure: &Figure) -> Result<Option<PathBuf>, ReportError> {
    let [svg, png] = ["svg", "png"].map(|kind| folder.join(format!("{}.{kind}", figure.name)));
    put(&svg, figure.svg.as_bytes())?;
    put(&png, &raster::png("experiment", &figure.svg)?)?;
    Ok(Some(if figure.heavy { png } else { svg }))
}

/// The methods of some rows in their order, each once.
fn names<'a>(rows: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let mut names = Vec::new();
    for name in rows {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    names
}

fn colour(methods: &[&str], method: &str) -> &'static str {
    PALETTE[methods.iter().position(|name| *name == method).unwrap_or(0) % PALETTE.len()]
}

/// Width of a text in the bundled font, a little generous.
fn width_of(text: &str, size: f64) -> f64 {
    0.52 * size * text.chars().count() as f64
}

/// A row of coloured names.
fn legend(svg: &mut Svg, left: f64, y: f64, entries: &[(&str, &str)], marked: bool) {
    let mut x = left;
    for (name, colour) in entries {
        svg.rect([x, y - 11.0], [14.0, 12.0], &format!("fill=\"{colour}\""));
        svg.text([x + 19.0, y], 13.0, Anchor::Start, INK, name);
        x += 19.0 + width_of(name, 13.0) + 16.0;
    }
    if marked {
        mark(svg, [x + 8.0, y - 5.0], [x + 8.0, y - 5.0]);
        svg.text([x + 22.0, y], 13.0, Anchor::Start, INK, "stated in the paper");
    }
}

/// A stated figure: a diamond, or one at either end of a line.
fn mark(svg: &mut Svg, low: [f64; 2], high: [f64; 2]) {
    svg.line(low, high, &format!("stroke=\"{STATED}\" stroke-width=\"2\""));
    for [x, y] in [low, high] {
        let corners = [[x - 5.0, y], [x, y - 5.0], [x + 5.0, y], [x, y + 5.0], [x - 5.0, y]];
        svg.chain(corners, &format!("fill=\"{STATED}\" stroke=\"#fff\" stroke-width=\"1\""));
    }
}

/// Mean completion times with their intervals, a group of bars for each speed.
fn completion(rows: &[&Completion], title: &str) -> String {
    const BAR: f64 = 20.0;
    const GAP: f64 = 34.0;
    let methods = names(rows.iter().map(|row| &*row.method));
    let mut speeds: Vec<f64> = rows.iter().map(|row| row.speed_mps).collect();
    speeds.sort_by(f64::total_cmp);
    speeds.dedup();
    let group = BAR * methods.len() as f64 + GAP;
    let entries: Vec<(&str, &str)> =
        methods.iter().map(|method| (*method, colour(&methods, method))).collect();
    let names_px: f64 = entries.iter().map(|(name, _)| 35.0 + width_of(name, 13.0)).sum();
    let width = (group * speeds.len() as f64).max(names_px + 180.0);
    let ends = rows.iter().filter_map(|row| row.ratio);
    let highest =
        ends.clone().map(|r| r.high).chain(rows.iter().filter_map(|r| Some(r.stated?[1])));
    let top = highest.fold(1.02, f64::max);
    let bottom = ends.map(|r| r.low).fold(1.0, f64::min);
    let y = [bottom - 0.04 * (top - bottom), top + 0.06 * (top - bottom)];
    let frame = Frame { corner: [84.0, 92.0], size: [width, 330.0], x: [0.0, width], y };
    let mut svg = Svg::new(84.0 + width + 30.0, 92.0 + 330.0 + 66.0);
    svg.text([84.0, 34.0], 20.0, Anchor::Start, INK, title);
    let marked = rows.iter().any(|row| row.stated.is_some());
    legend(&mut svg, 84.0, 66.0, &entries, marked);
    let marks = ticks(y, 6);
    frame.draw_grid(&mut svg, &[], &marks);
    let margin = 0.5 * (width - group * speeds.len() as f64);
    for row in rows {
        let Some(ratio) = row.ratio else { continue };
        let g = speeds.iter().position(|speed| *speed == row.speed_mps).unwrap_or(0) as f64;
        let m = methods.iter().position(|method| *method == row.method).unwrap_or(0) as f64;
        let x = margin + g * group + 0.5 * GAP + m * BAR;
        let [left, from] = frame.place(x + 2.0, 1.0);
        let [_, to] = frame.place(x, ratio.mean);
        let fill = colour(&methods, &row.method);
        let bar = ([left, from.min(to)], [BAR - 4.0, (from - to).abs()]);
        svg.rect(bar.0, bar.1, &format!("fill=\"{fill}\""));
        let middle = x + 0.5 * BAR;
        let whisker = [frame.place(middle, ratio.low), frame.place(middle, ratio.high)];
        let style = format!("stroke=\"{INK}\" stroke-width=\"1.4\"");
        svg.line(whisker[0], whisker[1], &style);
        for [px, py] in whisker {
            svg.line([px - 4.0, py], [px + 4.0, py], &style);
        }
        if let Some([low, high]) = row.stated {
            mark(&mut svg, frame.place(middle, low), frame.place(middle, high));
        }
        if row.arrived < row.drives {
            let text = format!("{}/{}", row.arrived, row.drives);
            let [px, py] = frame.place(middle, ratio.high);
            svg.text([px, py - 8.0], 11.0, Anchor::Middle, SOFT_INK, &text);
        }
    }
    frame.draw_y(&mut svg, &marks, "time / known map's time");
    for (g, speed) in speeds.iter().enumerate() {
        let [px, _] = frame.place(margin + (g as f64 + 0.5) * group, y[0]);
        let text = format!("{speed} m/s");
        svg.text([px, frame.bottom() + 22.0], 14.0, Anchor::Middle, INK, &text);
    }
    let middle = 84.0 + 0.5 * width;
    let text = "highest speed; bars are means, whiskers bootstrapped 95 % intervals";
    svg.text([middle, frame.bottom() + 48.0], 13.0, Anchor::Middle, SOFT_INK, text);
    svg.finish()
}

/// Mean step times by part, a bar for each method.
fn steps(rows: &[StepRow]) -> String {
    const HEIGHT: f64 = 30.0;
    const WIDTH: f64 = 620.0;
    let left = 40.0 + rows.iter().map(|row| width_of(&row.method, 14.0)).fold(0.0, f64::max);
    let p99 = |row: &StepRow| row.wall.total.spread.quantile(0.99).unwrap_or_default();
    let longest = rows.iter().map(|row| p99(row).max(row.wall.total.mean())).fold(0.1, f64::max);
    let height = HEIGHT * rows.len() as f64;
    let x = [0.0, 1.05 * longest];
    let frame = Frame { corner: [left, 92.0], size: [WIDTH, height], x, y: [0.0, height] };
    let mut svg = Svg::new(left + WIDTH + 330.0, 92.0 + height + 64.0);
    svg.text([left, 34.0], 20.0, Anchor::Start, INK, "Wall time of a planning step");
    let entries: Vec<(&str, &str)> =
        WallTimes::PARTS.into_iter().zip(PALETTE.iter().copied()).collect();
    legend(&mut svg, left, 66.0, &entries, false);
    let marks = ticks(x, 8);
    frame.draw_grid(&mut svg, &marks, &[]);
    for (i, row) in rows.iter().enumerate() {
        let y = height - (i as f64 + 0.5) * HEIGHT;
        let [_, middle] = frame.place(0.0, y);
        svg.text([left - 10.0, middle + 5.0], 14.0, Anchor::End, INK, &row.method);
        let mut from = 0.0;
        for (ms, (_, fill)) in row.wall.means_ms().into_iter().zip(&entries) {
            let [a, _] = frame.place(from, y);
            from += ms;
            let [b, _] = frame.place(from, y);
            svg.rect([a, middle - 9.0], [b - a, 18.0], &format!("fill=\"{fill}\""));
        }
        let [a, _] = frame.place(from, y);
        let [b, _] = frame.place(p99(row), y);
        let style = format!("stroke=\"{INK}\" stroke-width=\"1.4\"");
        svg.line([a, middle], [b, middle], &style);
        svg.line([b, middle - 5.0], [b, middle + 5.0], &style);
        let mean = row.wall.total.mean();
        let mut text = format!("{mean:.2} ms");
        if let Some(paper) = row.stated_ms {
            text += &format!(" · paper {paper:.0} ms");
        }
        if row.method == OURS {
            let ms = row.wall.predict.mean();
            text += &format!(", of it prediction {ms:.1} · {:.0} ms", stated::PREDICTION_MS);
        }
        svg.text([frame.right() + 12.0, middle + 5.0], 13.0, Anchor::Start, INK, &text);
    }
    frame.draw_x(
        &mut svg,
        &marks,
        "ms; bars are means by part, the line ends at the 99th percentile",
    );
    svg.finish()
}

/// Completion times by sensor and prediction range, a block of squares for each method.
fn ranges(rows: &[RangeRow]) -> String {
    const SIDE: f64 = 62.0;
    const LEFT: f64 = 70.0;
    let methods = names(rows.iter().map(|row| &*row.method));
    let values = |value: &dyn Fn(&RangeRow) -> Option<f64>| {
        let mut values: Vec<f64> = rows.iter().filter_map(value).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        values
    };
    let sensors = values(&|row| Some(row.sensor_m));
    let predictions = values(&|row| row.prediction_m);
    let means: Vec<f64> = rows.iter().filter_map(|row| Some(row.ratio?.mean)).collect();
    let least = means.iter().copied().fold(f64::INFINITY, f64::min);
    let most = means.iter().copied().fold(1.0, f64::max).max(least + 1e-3);
    let block = SIDE * sensors.len() as f64;
    let rows_high = predictions.len().max(1) as f64;
    let wide = LEFT + (block + LEFT) * methods.len() as f64;
    let mut svg = Svg::new(wide.max(760.0), 120.0 + rows_high * SIDE + 70.0);
    let title = "Completion time over the known map's, by sensor and prediction range";
    svg.text([LEFT, 34.0], 20.0, Anchor::Start, INK, title);
    svg.text([LEFT, 58.0], 13.0, Anchor::Start, SOFT_INK, stated::RANGES);
    for (k, method) in methods.iter().enumerate() {
        let x0 = LEFT + k as f64 * (block + LEFT);
        let y0 = 104.0;
        svg.text([x0, y0 - 12.0], 15.0, Anchor::Start, INK, method);
        for row in rows.iter().filter(|row| row.method == **method) {
            let Some(ratio) = row.ratio else { continue };
            let at = |list: &[f64], v: f64| list.iter().position(|w| *w == v).unwrap_or(0) as f64;
            let x = x0 + at(&sensors, row.sensor_m) * SIDE;
            // What predicts nothing is the same for every prediction range: one tall square.
            let (y, high) = match row.prediction_m {
                Some(m) => (y0 + (rows_high - 1.0 - at(&predictions, m)) * SIDE, SIDE),
                None => (y0, rows_high * SIDE),
            };
            // Light is fast.
            let share = (ratio.mean - least) / (most - least);
            let fill = viridis(1.0 - share).hex();
            svg.rect([x, y], [SIDE, high], &format!("fill=\"{fill}\" stroke=\"#fff\""));
            let ink = if share > 0.45 { "#fff" } else { INK };
            let text = format!("{:.3}", ratio.mean);
            let middle = [x + 0.5 * SIDE, y + 0.5 * high + 5.0];
            svg.text(middle, 14.0, Anchor::Middle, ink, &text);
        }
        for (i, sensor) in sensors.iter().enumerate() {
            let x = x0 + (i as f64 + 0.5) * SIDE;
            let y = y0 + rows_high * SIDE + 20.0;
            svg.text([x, y], 13.0, Anchor::Middle, INK, &sensor.to_string());
        }
        for (i, prediction) in predictions.iter().enumerate() {
            let y = y0 + (rows_high - 0.5 - i as f64) * SIDE + 5.0;
            svg.text([x0 - 8.0, y], 13.0, Anchor::End, INK, &prediction.to_string());
        }
        let below = y0 + rows_high * SIDE + 44.0;
        svg.text([x0 + 0.5 * block, below], 13.0, Anchor::Middle, INK, "sensor range (m)");
        let beside = [x0 - 44.0, y0 + 0.5 * rows_high * SIDE];
        svg.text_upwards(beside, 13.0, INK, "prediction range (m)");
    }
    svg.finish()
}

/// Drives through one maze side by side, coloured by speed.
fn courses(drives: &[&Record]) -> Result<String, ReportError> {
    const PANEL: f64 = 400.0;
    const GAP: f64 = 24.0;
    let fail = |why: String| ReportError::Draw { what: "courses", why };
    // The paper's three, as far as they were driven.
    let wanted = ["frontier", OURS, "known-map"];
    let shown: Vec<&Record> = wanted
        .iter()
        .filter_map(|name| drives.iter().find(|r| r.task.spec.method() == *name).copied())
        .collect();
    let shown = if shown.is_empty() { drives.iter().copied().take(3).collect() } else { shown };
    let spec = &drives[0].task.spec;
    let world = place(spec).map_err(|error| fail(error.to_string()))?.world;
    let [low, high] = world.bounds();
    let truth = walls(&world);
    let scale = PANEL / (high.x - low.x).max(high.y - low.y);
    let size = [scale * (high.x - low.x), scale * (high.y - low.y)];
    let width = 30.0 + shown.len() as f64 * (size[0] + GAP) + 90.0;
    let mut svg = Svg::new(width, 96.0 + size[1] + 30.0);
    let speed_max = spec.speed_max_mps;
    let title = format!("Drives coloured by speed · {} · up to {speed_max} m/s", world_name(spec));
    svg.text([30.0, 34.0], 20.0, Anchor::Start, INK, &title);
    for (k, record) in shown.iter().enumerate() {
        let frame = Frame {
            corner: [30.0 + k as f64 * (size[0] + GAP), 84.0],
            size,
            x: [low.x, high.x],
            y: [low.y, high.y],
        };
        let text = format!("{} · {:.1} s", record.task.spec.method(), record.drive.time_s);
        svg.text([frame.corner[0], 72.0], 15.0, Anchor::Start, INK, &text);
        svg.rect(frame.corner, size, &format!("fill=\"none\" stroke=\"{HAIRLINE}\""));
        truth_layer(&mut svg, &frame, &truth);
        course(&mut svg, &frame, &record.course, speed_max);
    }
    speed_bar(&mut svg, [width - 92.0, 84.0], size[1].min(300.0), speed_max);
    Ok(svg.finish())
}

fn world_name(spec: &crate::experiment::run::RunSpec) -> String {
    match &spec.world {
        WorldSpec::Maze { family, seed } => format!("maze {seed} ({family})"),
        WorldSpec::Map { file } => file.clone(),
    }
}

fn course(svg: &mut Svg, frame: &Frame, course: &[[f32; 3]], speed_max_mps: f64) {
    const LEVELS: f64 = 32.0;
    let level = |speed: f32| (f64::from(speed) / speed_max_mps * LEVELS).round() as i64;
    let place = |p: &[f32; 3]| frame.place(f64::from(p[0]), f64::from(p[1]));
    let line = "fill=\"none\" stroke-width=\"3.4\" stroke-linecap=\"round\"";
    let mut from = 0;
    while from + 1 < course.len() {
        let shade = level(course[from + 1][2]);
        let run = course[from + 1..].iter().take_while(|p| level(p[2]) == shade).count();
        let stroke = viridis(shade as f64 / LEVELS).hex();
        let points = course[from..=from + run].iter().map(place);
        svg.chain(points, &format!("{line} stroke=\"{stroke}\""));
        from += run;
    }
}
