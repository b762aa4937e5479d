use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::*;
use crate::frames::Point;
use crate::map::{Cell, CellRect};
use crate::plan::search::{SearchParams, SearchQuery, Terrain};
use crate::predict::OccupancyView;
use proptest::prelude::*;

const WIDTH: usize = 150;
const HEIGHT: usize = 90;

/// Foresees something on one side of a line only, and says so or not.
struct HalfSilent {
    line_m: f64,
    levels: i64,
    tells: bool,
    asked: usize,
    /// Largest x asked for.
    farthest_m: f64,
}

impl HalfSilent {
    fn answer(&self, p: Point) -> f32 {
        if p.x > self.line_m {
            return 0.5;
        }
        let hash = (p.x as i64 / 5 * 31 + p.y as i64 / 4 * 17).rem_euclid(self.levels);
        hash as f32 / self.levels as f32
    }
}

impl OccupancyView for HalfSilent {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        for (p, out) in points.iter().zip(out) {
            *out = self.answer(*p);
            self.farthest_m = self.farthest_m.max(p.x);
        }
        self.asked += points.len();
    }

    fn silent(&self, low: Point, _: Point) -> bool {
        self.tells && low.x > self.line_m
    }
}

/// Straight and diagonal steps with their costs as the search counts them; written apart from it.
fn steps(weights: &[u32], width: usize, at: usize) -> Vec<(usize, u32)> {
    let (x, y) = ((at % width) as i64, (at / width) as i64);
    let weight = |x: i64, y: i64| {
        let inside = x >= 0 && x < width as i64 && y >= 0 && (y as usize) < weights.len() / width;
        if inside { weights[y as usize * width + x as usize] } else { 0 }
    };
    let mut steps = Vec::new();
    for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
        let there = weight(x + dx, y + dy);
        let open = there > 0 && weight(x + dx, y) > 0 && weight(x, y + dy) > 0;
        if (dx, dy) != (0, 0) && open {
            let both = weight(x, y) + there;
            let cost = if dx != 0 && dy != 0 { both * 198 / 140 } else { both };
            steps.push(((y + dy) as usize * width + (x + dx) as usize, cost));
        }
    }
    steps
}

fn cheapest(weights: &[u32], width: usize, from: usize, to: usize) -> Option<u32> {
    let mut best = vec![u32::MAX; weights.len()];
    let mut heap = BinaryHeap::from([(Reverse(0), from)]);
    best[from] = 0;
    while let Some((Reverse(cost), at)) = heap.pop() {
        if at == to {
            return Some(cost);
        }
        if cost > best[at] {
            continue;
        }
        for (there, step) in steps(weights, width, at) {
            if cost + step < best[there] {
                best[there] = cost + step;
                heap.push((Reverse(cost + step), there));
            }
        }
    }
    None
}

/// Rectangles of one kind each over a ground of another.
fn terrain() -> impl Strategy<Value = Vec<Cell>> {
    let cell = |kind: u8| [Cell::Free, Cell::Unknown, Cell::Occupied][usize::from(kind % 3)];
    let rect = (0..WIDTH, 0..HEIGHT, 1..60_usize, 1..40_usize, 0..5_u8, 0..3_u8);
    (0..2_u8, prop::collection::vec(rect, 0..60)).prop_map(move |(ground, rects)| {
        let mut cells = vec![cell(ground); WIDTH * HEIGHT];
        for (x, y, w, h, kind, thin) in rects {
            // Thin walls one way or the other are what mazes are made of.
            let (w, h) = [(w, h), (1 + w / 30, h), (w, 1 + h / 20)][usize::from(thin)];
            let kind = if thin > 0 { 2 } else { kind };
            for row in cells.chunks_exact_mut(WIDTH).skip(y).take(h) {
                let end = (x + w).min(WIDTH);
                row[x..end].fill(cell(kind));
            }
        }
        cells
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(120))]

    #[test]
    fn the_way_is_the_cheapest_to_the_last_unit(
        mut cells in terrain(),
        ends in prop::array::uniform4(0.0..1.0_f64),
        line_m in -20.0..170.0_f64,
        levels in 1..6_i64,
        alpha in prop_oneof![Just(0.0), Just(0.25), Just(3.0)],
    ) {
        let place = |x: f64, y: f64| {
            ((x * (WIDTH - 1) as f64) as usize, (y * (HEIGHT - 1) as f64) as usize)
        };
        let (start, goal) = (place(ends[0], ends[1]), place(ends[2], ends[3]));
        for (x, y) in [start, goal] {
            cells[y * WIDTH + x] = Cell::Free;
        }
        let lethal: Vec<bool> = cells.iter().map(|c| *c == Cell::Occupied).collect();
        let bounds = CellRect { x0: 0, y0: 0, x1: WIDTH as i32, y1: HEIGHT as i32 };
        let terrain = Terrain { resolution_m: 1.0, bounds, cells: &cells, lethal: &lethal };
        let centre = |(x, y): (usize, usize)| Point::new(x as f64 + 0.5, y as f64 + 0.5);
        let query = SearchQuery {
            start: centre(start),
            goal: centre(goal),
            goal_radius_m: 0.0,
            v_ref_mps: 4.0,
            through_unknown: true,
        };
        // One cell all around, as the reference has.
        let params = SearchParams { border_m: 1.0, alpha, ..SearchParams::default() };
        let view = HalfSilent { line_m, levels, tells: false, asked: 0, farthest_m: -1e9 };

        // The window of the search without its ring.
        let width = WIDTH + 2;
        let mut weights = Vec::new();
        for y in 0..HEIGHT + 2 {
            for x in 0..width {
                let inside = (1..=WIDTH).contains(&x) && (1..=HEIGHT).contains(&y);
                let cell = if inside { cells[(y - 1) * WIDTH + x - 1] } else { Cell::Unknown };
                let phi = f64::from(view.answer(Point::new(x as f64 - 0.5, y as f64 - 0.5)));
                let factor = 1.0 + 4.0 * alpha / (1.0 - phi + params.eps);
                weights.push(match cell {
                    Cell::Occupied => 0,
                    Cell::Free => 70,
                    Cell::Unknown => (70.0 * factor).round() as u32,
                });
            }
        }
        let offset = |(x, y): (usize, usize)| (y + 1) * width + x + 1;
        let expected = cheapest(&weights, width, offset(start), offset(goal));

        let (mut asked, mut farthest) = (Vec::new(), Vec::new());
        for tells in [false, true] {
            let mut view = HalfSilent { tells, ..view };
            let mut search = GuideSearch::new();
            let found = search.find(&terrain, &query, &mut view, &params);
            asked.push(view.asked);
            farthest.push(view.farthest_m);
            prop_assert_eq!(found.is_ok(), expected.is_some());
            let (Ok(guide), Some(expected)) = (found, expected) else { continue };
            prop_assert_eq!((guide.cost_s * 4.0 * 140.0).round() as u32, expected);
            // The cells before pulling taut are neighbours, and their steps add up.
            let cells = &search.puller.cells;
            let index = |c: &(u32, u32)| (c.1 as usize - 1) * width + c.0 as usize - 1;
            prop_assert_eq!((index(&cells[0]), index(cells.last().unwrap())),
                (offset(start), offset(goal)));
            let mut sum = 0;
            for pair in cells.windows(2) {
                let there = index(&pair[1]);
                let step = steps(&weights, width, index(&pair[0])).into_iter()
                    .find(|(to, _)| *to == there);
                prop_assert!(step.is_some(), "{:?} is no step", pair);
                sum += step.unwrap().1;
            }
            prop_assert_eq!(sum, expected);
        }
        prop_assert!(asked[1] <= asked[0], "{:?}", asked);
        // One block of cells beyond the line at most, unless the weight is too high to jump.
        prop_assert!(alpha == 3.0 || farthest[1] < line_m + 8.0, "{:?}", farthest);
    }
}

#[test]
fn weights_too_high_to_jump_are_taken_cell_by_cell() {
    assert_eq!(longest_jump(KNOWN), Some(LONGEST));
    assert_eq!(longest_jump(2 * KNOWN), Some(LONGEST / 2));
    assert_eq!(longest_jump(u16::MAX - 1), None);
    for weight in (1..u16::MAX).step_by(7) {
        let Some(longest) = longest_jump(weight) else { continue };
        let cost = longest * (4 * u32::from(weight)) + longest * 2 * u32::from(weight) * 198 / 140;
        assert!(2 * cost < SPAN as u32, "{weight}");
    }
}
