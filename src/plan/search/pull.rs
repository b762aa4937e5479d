//! Pulls a way over the grid taut.

use super::window::{BLOCKED, KNOWN, UNASKED, Window};
use crate::frames::Point;

/// How far ahead a shortcut may reach, cells; bounds the work per cell of the way.
const REACH: usize = 128;

/// Replaces pieces of a way over the grid by straight lines, where the line is open and costs no
/// more than the piece.
#[derive(Default)]
pub(super) struct Puller {
    /// The way, cell by cell, from start to end.
    pub(super) cells: Vec<(u32, u32)>,
    /// Cost from the start, in known-free cell widths.
    costs: Vec<f64>,
    corners: Vec<(u32, u32)>,
}

impl Puller {
    /// The points of the way in [`cells`](Self::cells), at most one cell apart; `first` and `last`
    /// take the place of the centres of the first and the last cell.
    pub(super) fn pull(
        &mut self,
        window: &Window,
        first: Point,
        last: Option<Point>,
    ) -> Vec<Point> {
        self.shorten(window);
        let mut points = vec![first];
        let corners = self.corners.len();
        for (i, cell) in self.corners.iter().enumerate() {
            // The first corner is the start's own cell, unless that could not be entered.
            if i == 0 && inside(window, first, *cell) {
                continue;
            }
            let mut to = window.centre(cell.0, cell.1);
            if let Some(last) = last.filter(|_| i + 1 == corners) {
                to = last;
            }
            extend(&mut points, to, window.resolution_m);
        }
        if let Some(last) = last.filter(|_| corners == 1) {
            extend(&mut points, last, window.resolution_m);
        }
        points
    }

    fn shorten(&mut self, window: &Window) {
        let weight = |(x, y): (u32, u32)| f64::from(window.weights[window.index(x, y)]);
        self.costs.clear();
        self.costs.push(0.0);
        let mut sum = 0.0;
        for pair in self.cells.windows(2) {
            let straight = pair[0].0 == pair[1].0 || pair[0].1 == pair[1].1;
            let length = if straight { 1.0 } else { std::f64::consts::SQRT_2 };
            sum += 0.5 * length * (weight(pair[0]) + weight(pair[1]));
            self.costs.push(sum);
        }
        self.corners.clear();
        self.corners.push(self.cells[0]);
        let mut anchor = 0;
        while anchor + 1 < self.cells.len() {
            let mut next = anchor + 1;
            let end = (anchor + REACH).min(self.cells.len() - 1);
            while next < end {
                let saved = self.costs[next + 1] - self.costs[anchor];
                match line_cost(window, self.cells[anchor], self.cells[next + 1]) {
                    // A hair of tolerance for the order of additions.
                    Some(cost) if cost <= saved * (1.0 + 1e-9) => next += 1,
                    _ => break,
                }
            }
            self.corners.push(self.cells[next]);
            anchor = next;
        }
    }
}

fn inside(window: &Window, p: Point, cell: (u32, u32)) -> bool {
    let offset = p - window.centre(cell.0, cell.1);
    offset.amax() <= 0.5 * window.resolution_m * (1.0 + 1e-9)
}

/// Adds the straight line to `to` in equal steps of at most one cell.
fn extend(points: &mut Vec<Point>, to: Point, resolution_m: f64) {
    let from = *points.last().expect("a way starts with its first point");
    let steps = ((to - from).norm() / resolution_m - 1e-9).ceil();
    if steps < 1.0 {
        return;
    }
    let steps = steps as u32;
    for i in 1..=steps {
        points.push(from + (to - from) * (f64::from(i) / f64::from(steps)));
    }
}

/// Weight integrated along the straight line between two cell centres, in cell widths, or `None`
/// where the line touches a cell that may not be entered or was not asked for.
fn line_cost(window: &Window, from: (u32, u32), to: (u32, u32)) -> Option<f64> {
    let (nx, ny) = (from.0.abs_diff(to.0), from.1.abs_diff(to.1));
    let sx = if to.0 > from.0 { 1 } else { -1 };
    let sy = if to.1 > from.1 { 1 } else { -1 };
    let open = |x: u32, y: u32| {
        let weight = window.weights[window.index(x, y)];
        (weight != BLOCKED && weight != UNASKED).then_some(weight)
    };
    // The line crosses column borders at (2 ix + 1) / (2 nx) of its length and row borders alike;
    // both are compared as whole numbers.
    let length = f64::from(nx).hypot(f64::from(ny));
    let (mut x, mut y) = from;
    let (mut ix, mut iy) = (0, 0);
    let (mut sum, mut done) = (0.0, 0.0);
    let mut plain = true;
    loop {
        let weight = open(x, y)?;
        plain &= weight == KNOWN;
        let (cross_x, cross_y) = (
            if ix < nx { u64::from(2 * ix + 1) * u64::from(ny.max(1)) } else { u64::MAX },
            if iy < ny { u64::from(2 * iy + 1) * u64::from(nx.max(1)) } else { u64::MAX },
        );
        let whole = 2.0 * f64::from(nx.max(1)) * f64::from(ny.max(1));
        let cross = cross_x.min(cross_y);
        let until = if cross == u64::MAX { 1.0 } else { cross as f64 / whole };
        sum += f64::from(weight) * (until - done);
        done = until;
        if cross == u64::MAX {
            break;
        }
        if cross_x == cross_y {
            // Through a corner: both cells beside it must be open, as for a diagonal step.
            open(x.wrapping_add_signed(sx), y)?;
            open(x, y.wrapping_add_signed(sy))?;
        }
        if cross_x == cross {
            x = x.wrapping_add_signed(sx);
            ix += 1;
        }
        if cross_y == cross {
            y = y.wrapping_add_signed(sy);
            iy += 1;
        }
    }
    // Exact where everything is known, so that a straight way compares equal to itself.
    Some(if plain { length * f64::from(KNOWN) } else { length * sum })
}
