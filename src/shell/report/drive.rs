//! The drive on the map that was known at its end.
//!
//! The picture is a pile of layers, lowest first: map, true walls, path, plan ends, start and goal.
//! Another raster (a prediction, say) is one more call of [`cell_layer`] between them.

use image::ImageEncoder;

use super::axes::{Frame, ticks};
use super::colour::{self, INK, OCCUPIED, Rgb, SOFT_INK, UNKNOWN, viridis};
use super::colour_bar::speed_bar;
use super::svg::{Anchor, Svg};
use super::{DriveRecord, ReportError, outcome_text};
use crate::frames::{Point, heading_vector};
use crate::map::{Cell, CellIndex, CellRect, Grid};
use crate::sim::drive::TraceSample;

pub(super) const TRUE_WALL: &str = "#c9742b";
const PLAN_END: &str = "#d01c5b";
const START: &str = "#1462c4";
pub(super) const GOAL: &str = "#0a8a3c";

/// The largest plot, pixels.
const PLOT_MAX: [f64; 2] = [1000.0, 860.0];
/// The narrowest page on which title and legend have room, pixels.
const PAGE_WIDTH_MIN: f64 = 800.0;
const MARGIN_LEFT: f64 = 76.0;
const MARGIN_RIGHT: f64 = 106.0;
const MARGIN_TOP: f64 = 84.0;
const MARGIN_BOTTOM: f64 = 100.0;

/// The picture as an SVG document.
pub fn picture(record: &DriveRecord) -> Result<String, ReportError> {
    let shown = shown_cells(record);
    let resolution = record.grid.resolution_m();
    let metres = |cells: i32| f64::from(cells) * resolution;
    let (x, y) = ([metres(shown.x0), metres(shown.x1)], [metres(shown.y0), metres(shown.y1)]);
    let scale = (PLOT_MAX[0] / (x[1] - x[0])).min(PLOT_MAX[1] / (y[1] - y[0]));
    let size = [scale * (x[1] - x[0]), scale * (y[1] - y[0])];
    let page_width = (MARGIN_LEFT + size[0] + MARGIN_RIGHT).max(PAGE_WIDTH_MIN);
    let left = MARGIN_LEFT + 0.5 * (page_width - MARGIN_LEFT - size[0] - MARGIN_RIGHT);
    let frame = Frame { corner: [left, MARGIN_TOP], size, x, y };
    let mut svg = Svg::new(page_width, MARGIN_TOP + size[1] + MARGIN_BOTTOM);

    let map = |cell: CellIndex| match record.grid.get(cell) {
        Cell::Free => colour::FREE,
        Cell::Unknown => UNKNOWN,
        Cell::Occupied => OCCUPIED,
    };
    cell_layer(&mut svg, &frame, shown, map)?;
    svg.clipped("plot", frame.corner, frame.size, |svg| {
        truth_layer(svg, &frame, &record.truth);
        path_layer(svg, &frame, record);
        plan_layer(svg, &frame, record);
        mark_layer(svg, &frame, record, scale);
    });
    let count = |length: f64| ((length / 110.0) as usize).clamp(2, 10);
    frame.draw_y(&mut svg, &ticks(y, count(size[1])), "north y (m)");
    frame.draw_x(&mut svg, &ticks(x, count(size[0])), "east x (m)");
    colour_bar(&mut svg, &frame, record.speed_limit_mps);
    title(&mut svg, page_width, record);
    legend(&mut svg, page_width, frame.bottom() + 76.0, !record.truth.is_empty());
    Ok(svg.finish())
}

/// The rectangle that holds everything known, the path, start and goal, with a little room.
fn shown_cells(record: &DriveRecord) -> CellRect {
    let grid = &record.grid;
    let mut shown = known_cells(grid);
    let mut hold = |p: Point, around_m: f64| {
        if p.x.is_finite() && p.y.is_finite() {
            let c = grid.cell_at(p);
            let cell = CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 };
            shown = shown.union(&cell.grown((around_m / grid.resolution_m()).ceil() as i32));
        }
    };
    hold(record.start.position, 0.5);
    hold(record.goal, record.goal_radius_m + 0.2);
    for sample in &record.trace.samples {
        hold(sample.pose.position, 0.3);
    }
    shown.grown((0.5 / grid.resolution_m()).ceil() as i32)
}

fn known_cells(grid: &Grid) -> CellRect {
    let bounds = grid.bounds();
    let mut known = CellRect::EMPTY;
    let width = bounds.width().max(1);
    for (i, cell) in grid.cells().iter().enumerate() {
        if *cell != Cell::Unknown {
            let (x, y) = (bounds.x0 + (i % width) as i32, bounds.y0 + (i / width) as i32);
            known = known.union(&CellRect { x0: x, y0: y, x1: x + 1, y1: y + 1 });
        }
    }
    known
}

/// A colour for every cell of a rectangle, as an embedded picture.
pub(super) fn cell_layer(
    svg: &mut Svg,
    frame: &Frame,
    cells: CellRect,
    colour: impl Fn(CellIndex) -> Rgb,
) -> Result<(), ReportError> {
    let mut pixels = Vec::with_capacity(3 * cells.width() * cells.height());
    for iy in (cells.y0..cells.y1).rev() {
        for ix in cells.x0..cells.x1 {
            let Rgb(r, g, b) = colour(CellIndex::new(ix, iy));
            pixels.extend([r, g, b]);
        }
    }
    let mut png = Vec::new();
    image::codecs::png::PngEncoder::new_with_quality(
        &mut png,
        image::codecs::png::CompressionType::Best,
        image::codecs::png::FilterType::NoFilter,
    )
    .write_image(
        &pixels,
        cells.width() as u32,
        cells.height() as u32,
        image::ExtendedColorType::Rgb8,
    )
    .map_err(|error| ReportError::Draw { what: "drive", why: error.to_string() })?;
    svg.png(frame.corner, frame.size, &png);
    Ok(())
}

/// The walls that there really are.
pub(super) fn truth_layer(svg: &mut Svg, frame: &Frame, truth: &[[Point; 2]]) {
    let lines = truth.iter().map(|line| line.map(|p| frame.place(p.x, p.y)));
    let style = format!(
        "fill=\"none\" stroke=\"{TRUE_WALL}\" stroke-width=\"1.1\" stroke-opacity=\"0.75\""
    );
    svg.segments(lines, &style);
}

/// Where each adopted plan would have come to rest.
fn plan_layer(svg: &mut Svg, frame: &Frame, record: &DriveRecord) {
    for mark in &record.trace.plans {
        let at = frame.place(mark.stop.x, mark.stop.y);
        svg.circle(at, 1.5, &format!("fill=\"{PLAN_END}\" fill-opacity=\"0.8\""));
    }
}

/// The true path, coloured by speed.
fn path_layer(svg: &mut Svg, frame: &Frame, record: &DriveRecord) {
    const LEVELS: f64 = 48.0;
    let place = |s: &TraceSample| frame.place(s.pose.position.x, s.pose.position.y);
    let level = |s: &TraceSample| {
        (s.speed_mps / record.speed_limit_mps.max(1e-9) * LEVELS).round().clamp(0.0, LEVELS) as u32
    };
    let line = "fill=\"none\" stroke-linecap=\"round\" stroke-linejoin=\"round\"";

    // Samples a fraction of a pixel apart add nothing but bytes.
    let mut chain: Vec<([f64; 2], u32)> = Vec::new();
    for (i, sample) in record.trace.samples.iter().enumerate() {
        let at = place(sample);
        let far = chain.last().is_none_or(|(before, _)| distance(*before, at) >= 0.8);
        if far || i + 1 == record.trace.samples.len() {
            chain.push((at, level(sample)));
        }
    }
    // A light border sets the path off against walls.
    let border = chain.iter().map(|(at, _)| *at);
    svg.chain(border, &format!("{line} stroke=\"#fff\" stroke-width=\"7\""));
    let mut from = 0;
    while from + 1 < chain.len() {
        let shade = chain[from + 1].1;
        let run = chain[from + 1..].iter().take_while(|(_, level)| *level == shade).count();
        let stroke = viridis(f64::from(shade) / LEVELS).hex();
        let points = chain[from..=from + run].iter().map(|(at, _)| *at);
        svg.chain(points, &format!("{line} stroke=\"{stroke}\" stroke-width=\"4.6\""));
        from += run;
    }
}

/// Start and goal.
fn mark_layer(svg: &mut Svg, frame: &Frame, record: &DriveRecord, scale: f64) {
    let goal = frame.place(record.goal.x, record.goal.y);
    let style = format!(
        "fill=\"{GOAL}\" fill-opacity=\"0.14\" stroke=\"{GOAL}\" stroke-width=\"2\" \
         stroke-dasharray=\"5 3\""
    );
    svg.circle(goal, record.goal_radius_m * scale, &style);
    goal_cross(svg, goal);
    start_arrow(svg, frame.place(record.start.position.x, record.start.position.y), {
        record.start.heading_rad
    });
}

pub(super) fn goal_cross(svg: &mut Svg, [x, y]: [f64; 2]) {
    let style = format!("stroke=\"{GOAL}\" stroke-width=\"2.4\" stroke-linecap=\"round\"");
    svg.line([x - 4.0, y - 4.0], [x + 4.0, y + 4.0], &style);
    svg.line([x - 4.0, y + 4.0], [x + 4.0, y - 4.0], &style);
}

/// An arrow head that points where the car looks.
pub(super) fn start_arrow(svg: &mut Svg, [x, y]: [f64; 2], heading_rad: f64) {
    let corner = |angle: f64, length: f64| {
        let v = heading_vector(heading_rad + angle) * length;
        [x + v.x, y - v.y]
    };
    let corners = [corner(0.0, 11.0), corner(2.5, 9.5), corner(std::f64::consts::PI, 4.0)];
    let points = corners.into_iter().chain([corner(-2.5, 9.5), corner(0.0, 11.0)]);
    let style =
        format!("fill=\"{START}\" stroke=\"#fff\" stroke-width=\"1.5\" stroke-linejoin=\"round\"");
    svg.chain(points, &style);
}

fn colour_bar(svg: &mut Svg, frame: &Frame, speed_limit_mps: f64) {
    let height = frame.size[1].min(420.0);
    let top = frame.corner[1] + 0.5 * (frame.size[1] - height);
    speed_bar(svg, [frame.right() + 22.0, top], height, speed_limit_mps);
}

fn title(svg: &mut Svg, page_width: f64, record: &DriveRecord) {
    let s = &record.summary;
    let middle = 0.5 * page_width;
    let head = format!("{} after {:.2} s", outcome_text(s.outcome), s.time_s);
    svg.text([middle, 34.0], 24.0, Anchor::Middle, INK, &head);
    let mean = if s.time_s > 0.0 { s.path_m / s.time_s } else { 0.0 };
    let clearance = if s.min_clearance_m.is_finite() {
        format!(" · clearance {:.2} m", s.min_clearance_m)
    } else {
        String::new()
    };
    let name =
        if record.title.is_empty() { String::new() } else { format!("{} · ", record.title) };
    let line =
        format!("{name}{:.1} m · mean {mean:.2} m/s · {} replans{clearance}", s.path_m, s.replans);
    svg.text([middle, 62.0], 15.0, Anchor::Middle, SOFT_INK, &line);
}

/// What the marks mean, in a row below the plot.
fn legend(svg: &mut Svg, page_width: f64, y: f64, truth: bool) {
    const SWATCH: f64 = 22.0;
    type Mark = Box<dyn Fn(&mut Svg, [f64; 2])>;
    let patch = |fill: String| -> Mark {
        Box::new(move |svg, [x, y]| {
            let style = format!("fill=\"{fill}\" stroke=\"{SOFT_INK}\" stroke-width=\"0.8\"");
            svg.rect([x - 7.0, y - 6.0], [14.0, 12.0], &style);
        })
    };
    let mut entries: Vec<(Mark, &str, f64)> = vec![
        (Box::new(|svg, at| start_arrow(svg, at, 0.0)), "start", 30.0),
        (Box::new(goal_cross), "goal", 28.0),
        (
            Box::new(|svg, at| svg.circle(at, 3.0, &format!("fill=\"{PLAN_END}\""))),
            "where plans end",
            103.0,
        ),
        (patch(colour::FREE.hex()), "seen free", 60.0),
        (patch(OCCUPIED.hex()), "seen occupied", 90.0),
        (patch(UNKNOWN.hex()), "not seen", 54.0),
    ];
    if truth {
        let wall: Mark = Box::new(|svg, [x, y]| {
            let style = format!("stroke=\"{TRUE_WALL}\" stroke-width=\"1.6\"");
            svg.line([x - 8.0, y], [x + 8.0, y], &style);
        });
        entries.push((wall, "true walls", 64.0));
    }
    let gap = 16.0;
    let width: f64 = entries.iter().map(|(_, _, width)| SWATCH + width + gap).sum::<f64>() - gap;
    let mut x = 0.5 * (page_width - width);
    for (mark, name, width) in entries {
        mark(svg, [x + 8.0, y]);
        svg.text([x + SWATCH, y + 4.5], 13.5, Anchor::Start, INK, name);
        x += SWATCH + width + gap;
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}
