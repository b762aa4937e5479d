//! Where solid cells touch free ones, as a few long lines.

use crate::frames::Point;

/// The border between solid and free cells of a raster of `width` by `height` cells, as lines in
/// cell units (cell `(x, y)` covers `[x, x+1) x [y, y+1)`), neighbouring ones joined, each passed
/// through `to_map`. Cells outside the raster count as solid, so that a free cell on the edge has
/// a border.
pub fn outline(
    width: usize,
    height: usize,
    solid: impl Fn(usize, usize) -> bool,
    to_map: impl Fn(Point) -> Point,
) -> Vec<[Point; 2]> {
    let at = |x: isize, y: isize| {
        let inside = x >= 0 && y >= 0 && x < width as isize && y < height as isize;
        !inside || solid(x as usize, y as usize)
    };
    let mut lines = Vec::new();
    let (columns, rows) = (width as isize, height as isize);
    for y in 0..=rows {
        joined(
            columns,
            |x| at(x, y) != at(x, y - 1),
            |from, to| {
                lines.push([Point::new(from, y as f64), Point::new(to, y as f64)]);
            },
        );
    }
    for x in 0..=columns {
        joined(
            rows,
            |y| at(x, y) != at(x - 1, y),
            |from, to| {
                lines.push([Point::new(x as f64, from), Point::new(x as f64, to)]);
            },
        );
    }
    lines.into_iter().map(|line| line.map(&to_map)).collect()
}

/// Calls `found` with the ends of every run of places in `0..count` that hold.
fn joined(count: isize, holds: impl Fn(isize) -> bool, mut found: impl FnMut(f64, f64)) {
    let mut start = None;
    for i in 0..=count {
        let here = i < count && holds(i);
        match (start, here) {
            (None, true) => start = Some(i),
            (Some(from), false) => {
                found(from as f64, i as f64);
                start = None;
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_solid_block_in_the_open_has_four_long_sides_and_the_edge_four() {
        let block = |x: usize, y: usize| (2..5).contains(&x) && (1..3).contains(&y);
        let lines = outline(8, 6, block, |p| p);
        let length: f64 = lines.iter().map(|[a, b]| (b - a).norm()).sum();
        assert_eq!((lines.len(), length), (8, 2.0 * (3.0 + 2.0) + 2.0 * (8.0 + 6.0)));
    }

    #[test]
    fn points_pass_through_the_given_transform() {
        let lines = outline(1, 1, |_, _| false, |p| Point::new(10.0 + p.x, -p.y));
        assert_eq!(lines.len(), 4);
        assert!(lines.iter().flatten().all(|p| p.x >= 10.0 && p.y <= 0.0));
        assert!(outline(0, 0, |_, _| false, |p| p).is_empty());
        assert!(outline(3, 3, |_, _| true, |p| p).is_empty());
    }
}
