//! What the planner foresaw at one moment: the probability that space is occupied, from white for
//! free to dark for occupied, as in figure 3 of Elhafsi et al. (2020).

use super::axes::{Frame, ticks};
use super::colour::{FREE, INK, OCCUPIED, Rgb, SOFT_INK};
use super::colour_bar::ColourBar;
use super::drive::{GOAL, TRUE_WALL, cell_layer, goal_cross, start_arrow, truth_layer};
use super::outline::outline;
use super::svg::{Anchor, Svg};
use super::{ReportError, Scenery};
use crate::frames::Point;
use crate::map::{Cell, CellIndex};
use crate::sim::rig::Snapshot;

const SEEN: &str = "#1462c4";
const PLAN: &str = "#0a8a3c";
const IMAGINED: &str = "#d01c5b";

const PLOT: f64 = 820.0;
const MARGIN_LEFT: f64 = 76.0;
const MARGIN_RIGHT: f64 = 116.0;
const MARGIN_TOP: f64 = 84.0;
const MARGIN_BOTTOM: f64 = 100.0;

/// The picture as an SVG document.
pub fn picture(scenery: &Scenery<'_>, snapshot: &Snapshot) -> Result<String, ReportError> {
    let window = snapshot.window;
    let resolution = snapshot.grid.resolution_m();
    let metres = |cells: i32| f64::from(cells) * resolution;
    let (x, y) = ([metres(window.x0), metres(window.x1)], [metres(window.y0), metres(window.y1)]);
    let frame = Frame { corner: [MARGIN_LEFT, MARGIN_TOP], size: [PLOT, PLOT], x, y };
    let page_width = MARGIN_LEFT + PLOT + MARGIN_RIGHT;
    let mut svg = Svg::new(page_width, MARGIN_TOP + PLOT + MARGIN_BOTTOM);

    cell_layer(&mut svg, &frame, window, |c| {
        let row = (c.iy - window.y0) as usize * window.width();
        shade(snapshot.occupied[row + (c.ix - window.x0) as usize])
    })?;
    svg.clipped("plot", frame.corner, frame.size, |svg| {
        truth_layer(svg, &frame, scenery.truth);
        seen_layer(svg, &frame, snapshot);
        path_layer(svg, &frame, snapshot);
        let goal = frame.place(scenery.goal.x, scenery.goal.y);
        let radius = scenery.goal_radius_m * PLOT / (x[1] - x[0]);
        svg.circle(goal, radius, &format!("fill=\"none\" stroke=\"{GOAL}\" stroke-width=\"2\""));
        goal_cross(svg, goal);
        let car = snapshot.pose.position;
        start_arrow(svg, frame.place(car.x, car.y), snapshot.pose.heading_rad);
    });
    frame.draw_y(&mut svg, &ticks(y, 7), "north y (m)");
    frame.draw_x(&mut svg, &ticks(x, 7), "east x (m)");
    colour_bar(&mut svg, &frame);
    let middle = 0.5 * page_width;
    let head = format!("Foreseen at {:.1} s", snapshot.t_s);
    svg.text([middle, 34.0], 24.0, Anchor::Middle, INK, &head);
    svg.text([middle, 62.0], 15.0, Anchor::Middle, SOFT_INK, scenery.title);
    legend(&mut svg, page_width, frame.bottom() + 76.0, !scenery.truth.is_empty());
    Ok(svg.finish())
}

/// White for free, dark for occupied; what is no probability is shown as one half.
fn shade(p: f32) -> Rgb {
    let share = if (0.0..=1.0).contains(&p) { f64::from(p) } else { 0.5 };
    let mix = |a: u8, b: u8| (f64::from(a) + share * (f64::from(b) - f64::from(a))).round() as u8;
    Rgb(mix(FREE.0, OCCUPIED.0), mix(FREE.1, OCCUPIED.1), mix(FREE.2, OCCUPIED.2))
}

/// The edge of what has been seen.
fn seen_layer(svg: &mut Svg, frame: &Frame, snapshot: &Snapshot) {
    let (window, resolution) = (snapshot.window, snapshot.grid.resolution_m());
    let unknown = |x: usize, y: usize| {
        let cell = CellIndex::new(window.x0 + x as i32, window.y0 + y as i32);
        snapshot.grid.get(cell) == Cell::Unknown
    };
    let to_map = |p: Point| {
        let cells = |origin: i32, k: f64| (f64::from(origin) + k) * resolution;
        Point::new(cells(window.x0, p.x), cells(window.y0, p.y))
    };
    let lines = outline(window.width(), window.height(), unknown, to_map);
    let lines = lines.into_iter().map(|line| line.map(|p| frame.place(p.x, p.y)));
    svg.segments(lines, &format!("fill=\"none\" stroke=\"{SEEN}\" stroke-width=\"1.1\""));
}

/// The plan, and how it is imagined to go on.
fn path_layer(svg: &mut Svg, frame: &Frame, snapshot: &Snapshot) {
    let place = |p: &Point| frame.place(p.x, p.y);
    let line = "fill=\"none\" stroke-linecap=\"round\" stroke-linejoin=\"round\"";
    let beyond = snapshot.path.last().into_iter().chain(&snapshot.beyond).map(place);
    let dashes = "stroke-width=\"3\" stroke-dasharray=\"1 7\"";
    svg.chain(beyond, &format!("{line} stroke=\"{IMAGINED}\" {dashes}"));
    let path = snapshot.path.iter().map(place);
    svg.chain(path, &format!("{line} stroke=\"{PLAN}\" stroke-width=\"4\""));
}

fn colour_bar(svg: &mut Svg, frame: &Frame) {
    let height = 420.0;
    let top = frame.corner[1] + 0.5 * (frame.size[1] - height);
    let bar = ColourBar {
        corner: [frame.right() + 22.0, top],
        height,
        name: "probability",
        label: "probability of being occupied",
        label_gap: 62.0,
    };
    let marks = [(0.0, "free"), (0.5, "0.5"), (1.0, "occ.")].map(|(p, text)| (p, text.into()));
    bar.draw(svg, |p| shade(p as f32), &marks);
}

/// What the marks mean, in a row below the plot.
fn legend(svg: &mut Svg, page_width: f64, y: f64, truth: bool) {
    const GAP: f64 = 30.0;
    let mut entries = vec![
        (SEEN, "", "edge of what has been seen", 168.0),
        (PLAN, "", "plan", 28.0),
        (IMAGINED, " stroke-dasharray=\"1 5\"", "how it may go on", 106.0),
    ];
    if truth {
        entries.push((TRUE_WALL, "", "true walls", 64.0));
    }
    let width: f64 = entries.iter().map(|(.., width)| 24.0 + width + GAP).sum::<f64>() - GAP;
    let mut x = 0.5 * (page_width - width);
    for (colour, dashes, name, width) in entries {
        let style = format!("stroke=\"{colour}\" stroke-width=\"3\"{dashes}");
        svg.line([x, y], [x + 18.0, y], &style);
        svg.text([x + 24.0, y + 4.5], 13.5, Anchor::Start, INK, name);
        x += 24.0 + width + GAP;
    }
}
