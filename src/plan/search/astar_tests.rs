use super::*;
use crate::predict::NoPrediction;
use proptest::prelude::*;

/// A map drawn with `#` occupied, `.` free, `?` unknown; the first row is the lowest. The disc is
/// smaller than a cell, so only occupied cells are lethal.
struct Map {
    bounds: CellRect,
    cells: Vec<Cell>,
    lethal: Vec<bool>,
}

impl Map {
    fn draw(rows: &[&str]) -> Self {
        let cell = |c| match c {
            '#' => Cell::Occupied,
            '.' => Cell::Free,
            _ => Cell::Unknown,
        };
        let cells: Vec<Cell> = rows.iter().flat_map(|row| row.chars().map(cell)).collect();
        Self::new(rows[0].len(), cells)
    }

    fn new(width: usize, cells: Vec<Cell>) -> Self {
        let bounds = CellRect { x0: 0, y0: 0, x1: width as i32, y1: (cells.len() / width) as i32 };
        let lethal = cells.iter().map(|c| *c == Cell::Occupied).collect();
        Self { bounds, cells, lethal }
    }

    fn terrain(&self) -> Terrain<'_> {
        let Self { bounds, cells, lethal } = self;
        Terrain { resolution_m: 1.0, bounds: *bounds, cells, lethal }
    }
}

fn query(start: (f64, f64), goal: (f64, f64)) -> SearchQuery {
    SearchQuery {
        start: Point::new(start.0, start.1),
        goal: Point::new(goal.0, goal.1),
        goal_radius_m: 0.0,
        v_ref_mps: 1.0,
        through_unknown: true,
    }
}

/// A view that counts its questions.
struct Counting<F> {
    phi: F,
    asked: Vec<Point>,
    questions: usize,
}

impl<F: Fn(Point) -> f32> Counting<F> {
    fn new(phi: F) -> Self {
        Self { phi, asked: Vec::new(), questions: 0 }
    }
}

impl<F: Fn(Point) -> f32> OccupancyView for Counting<F> {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        self.questions += 1;
        self.asked.extend_from_slice(points);
        for (p, out) in points.iter().zip(out) {
            *out = (self.phi)(*p);
        }
    }
}

fn find(map: &Map, query: &SearchQuery) -> Result<Guide, SearchError> {
    GuideSearch::new().find(&map.terrain(), query, &mut NoPrediction, &SearchParams::default())
}

/// Cost in seconds of the cheapest way by plain relaxation over all cells until nothing changes,
/// in real numbers; written apart from the search. `weights`: seconds per metre, `None` blocked.
fn reference(width: usize, weights: &[Option<f64>], from: usize, to: usize, cut: bool) -> f64 {
    let height = weights.len() / width;
    let mut cost = vec![f64::INFINITY; weights.len()];
    cost[from] = 0.0;
    let mut changed = true;
    while changed {
        changed = false;
        for at in 0..weights.len() {
            let (x, y) = ((at % width) as i32, (at / width) as i32);
            let Some(own) = weights[at] else { continue };
            for dy in -1..=1_i32 {
                for dx in -1..=1_i32 {
                    let (nx, ny) = (x + dx, y + dy);
                    let inside =
                        (0..width as i32).contains(&nx) && (0..height as i32).contains(&ny);
                    if !inside || (dx, dy) == (0, 0) {
                        continue;
                    }
                    let index = |x: i32, y: i32| y as usize * width + x as usize;
                    let Some(other) = weights[index(nx, ny)] else { continue };
                    let corner = weights[index(nx, y)].is_none() || weights[index(x, ny)].is_none();
                    if dx != 0 && dy != 0 && corner && !cut {
                        continue;
                    }
                    let length = f64::from(dx * dx + dy * dy).sqrt();
                    let next = cost[at] + 0.5 * length * (own + other);
                    if next < cost[index(nx, ny)] - 1e-12 {
                        cost[index(nx, ny)] = next;
                        changed = true;
                    }
                }
            }
        }
    }
    cost[to]
}

const SIDE: usize = 24;

/// The test's own grid with one ring of unknown cells around it, as the search sees it.
fn ringed(
    map: &Map,
    phi: &dyn Fn(Point) -> f32,
    params: &SearchParams,
    v: f64,
) -> Vec<Option<f64>> {
    let side = SIDE as i32;
    let mut weights = Vec::new();
    for y in -1..=side {
        for x in -1..=side {
            let inside = (0..side).contains(&x) && (0..side).contains(&y);
            let cell = if inside { map.cells[(y * side + x) as usize] } else { Cell::Unknown };
            let p = Point::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            weights.push(match cell {
                Cell::Occupied => None,
                Cell::Free => Some(1.0 / v),
                Cell::Unknown => {
                    let phi = f64::from(phi(p));
                    let factor = 1.0 + v * params.alpha / (1.0 - phi + params.eps);
                    // The search keeps a seventieth of the known cells' cost.
                    Some((factor * 70.0).round() / 70.0 / v)
                }
            });
        }
    }
    weights
}

fn cells() -> impl Strategy<Value = Vec<Cell>> {
    let cell = prop_oneof![
        4 => Just(Cell::Free),
        2 => Just(Cell::Occupied),
        3 => Just(Cell::Unknown),
    ];
    // Single cells, blobs of 4 x 4, and wide open space with a cell here and there.
    let fine = prop::collection::vec(cell.clone(), SIDE * SIDE);
    let coarse = prop::collection::vec(cell, SIDE * SIDE / 16);
    (fine, coarse, 0..3_u8, 10..80_usize).prop_map(|(fine, coarse, kind, every)| {
        (0..SIDE * SIDE)
            .map(|at| match (kind, at % every) {
                (0, _) => fine[at],
                (1, _) => coarse[at / SIDE / 4 * (SIDE / 4) + at % SIDE / 4],
                (_, 7) => Cell::Occupied,
                _ => fine[at / SIDE / 12 * 2 + at % SIDE / 12],
            })
            .collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    #[test]
    fn no_way_of_the_grid_is_cheaper(mut cells in cells(), salt in 0..1000_u32, levels in 1..4_u32) {
        let (from, to) = (0, SIDE * SIDE - 1);
        cells[from] = Cell::Free;
        cells[to] = Cell::Free;
        let map = Map::new(SIDE, cells);
        let phi = move |p: Point| {
            let hash = (p.x * 31.7 + p.y * 57.3 + f64::from(salt)).sin().abs() * 1000.0;
            (hash as u32 % levels) as f32 / levels as f32
        };
        let v = 4.0;
        let edge = f64::from(SIDE as u32) - 0.5;
        let ask = SearchQuery { v_ref_mps: v, ..query((0.5, 0.5), (edge, edge)) };
        // A border of one cell, as the reference has.
        let params = SearchParams { border_m: 1.0, ..SearchParams::default() };
        let mut search = GuideSearch::new();
        let guide = search.find(&map.terrain(), &ask, &mut Counting::new(phi), &params);
        let ring = SIDE + 2;
        let weights = ringed(&map, &phi, &params, v);
        let (from, to) = (ring + 1, ring * ring - ring - 2);
        let best = reference(ring, &weights, from, to, false);
        match guide {
            Ok(guide) => {
                // A diagonal step is rounded down by less than one part in 198.
                prop_assert!((guide.cost_s / best - 1.0).abs() < 2e-3, "{} {best}", guide.cost_s);
                prop_assert_eq!(guide.points[0], ask.start);
                prop_assert_eq!(*guide.points.last().unwrap(), ask.goal);
                for pair in guide.points.windows(2) {
                    prop_assert!((pair[1] - pair[0]).norm() < 1.0 + 1e-9);
                }
                for p in &guide.points {
                    let c = cell_at(*p, 1.0);
                    let at = c.iy as usize * SIDE + c.ix as usize;
                    prop_assert!(!map.bounds.contains(c) || map.cells[at] != Cell::Occupied);
                }
            }
            Err(error) => {
                let unreachable = matches!(error, SearchError::Unreachable { .. });
                prop_assert!(unreachable && best.is_infinite(), "{error} {best}");
            }
        }
    }

    #[test]
    fn any_answers_of_the_view_give_a_way(mut cells in cells(), salt in 0..1000_u32, literal: bool) {
        cells[0] = Cell::Free;
        cells[SIDE * SIDE - 1] = Cell::Free;
        let map = Map::new(SIDE, cells);
        let odd = move |p: Point| {
            let odd = [f32::NAN, -1.0, 2.0, f32::INFINITY, f32::NEG_INFINITY, 0.0, 1.0];
            odd[((p.x * 7.0 + p.y * 13.0) as i64 + i64::from(salt)).rem_euclid(7) as usize]
        };
        let penalty = if literal { Penalty::Literal } else { Penalty::Edge };
        let params = SearchParams { penalty, ..SearchParams::default() };
        let edge = f64::from(SIDE as u32) - 0.5;
        let ask = query((0.5, 0.5), (edge, edge));
        let mut search = GuideSearch::new();
        let odd = search.find(&map.terrain(), &ask, &mut Counting::new(odd), &params);
        let none = search.find(&map.terrain(), &ask, &mut NoPrediction, &params);
        prop_assert_eq!(odd.is_ok(), none.is_ok());
    }
}

#[test]
fn an_unusable_answer_counts_as_one_half() {
    let map = Map::draw(&["..??..??", "..??#.??", "........", "?#???##?"]);
    let ask = query((0.5, 0.5), (7.5, 3.5));
    let params = SearchParams::default();
    let mut search = GuideSearch::new();
    let half = search.find(&map.terrain(), &ask, &mut Counting::new(|_| 0.5), &params).unwrap();
    for odd in [f32::NAN, -0.1, 1.1, f32::INFINITY] {
        let guide = search.find(&map.terrain(), &ask, &mut Counting::new(|_| odd), &params);
        assert_eq!(guide.unwrap(), half);
    }
}

#[test]
fn no_corner_is_cut() {
    // The diagonal gap between two obstacles is closed; the way round it is nine cells long.
    let map = Map::draw(&[
        "#########", //
        "#...#...#",
        "#...#...#",
        "#..#....#",
        "#..#....#",
        "#.......#",
        "#########",
    ]);
    let guide = find(&map, &query((2.5, 2.5), (5.5, 2.5))).unwrap();
    let open = |cells: &[Cell]| -> Vec<Option<f64>> {
        cells.iter().map(|c| (*c == Cell::Free).then_some(1.0)).collect()
    };
    let weights = open(&map.cells);
    let (from, to) = (2 * 9 + 2, 2 * 9 + 5);
    let honest = reference(9, &weights, from, to, false);
    let cutting = reference(9, &weights, from, to, true);
    assert!(honest > cutting + 0.5, "the map tells the two apart: {honest} {cutting}");
    assert!((guide.cost_s - honest).abs() < 1e-3 * honest, "{} {honest}", guide.cost_s);

    // A single diagonal gap is no way at all.
    let map = Map::draw(&["#####", "#.###", "##..#", "#####"]);
    let error = find(&map, &query((1.5, 1.5), (3.5, 2.5))).unwrap_err();
    assert!(matches!(error, SearchError::Unreachable { .. }), "{error}");
}

#[test]
fn an_enclosed_goal_is_proved_unreachable_and_a_gap_into_the_unknown_is_not() {
    let closed = Map::draw(&[
        "??????????", //
        "?########?",
        "?#......#?",
        "?#......#?",
        "?########?",
        "??????????",
    ]);
    let out = query((3.5, 2.5), (30.5, -12.5));
    assert!(matches!(find(&closed, &out), Err(SearchError::Unreachable { .. })));
    let inward = query((30.5, -12.5), (3.5, 2.5));
    assert!(matches!(find(&closed, &inward), Err(SearchError::Unreachable { .. })));
    let mut gap = closed;
    let at = 4 * 10 + 5;
    (gap.cells[at], gap.lethal[at]) = (Cell::Unknown, false);
    let guide = find(&gap, &out).unwrap();
    assert_eq!(*guide.points.last().unwrap(), out.goal);
    let first_unknown = guide.points[guide.known_until];
    assert_eq!(cell_at(first_unknown, 1.0), CellIndex::new(5, 4));
    let known_only = SearchQuery { through_unknown: false, ..out };
    assert!(find(&gap, &known_only).is_err());
}

#[test]
fn without_a_map_the_way_is_the_straight_line_and_all_of_it_unknown() {
    let map = Map { bounds: CellRect::EMPTY, cells: Vec::new(), lethal: Vec::new() };
    let guide = find(&map, &query((-3.2, 4.1), (22.9, -9.3))).unwrap();
    assert_eq!(guide.known_until, 0);
    let straight = (guide.points[0] - *guide.points.last().unwrap()).norm();
    assert!(guide.length_m < straight * 1.01, "{} {straight}", guide.length_m);
}

#[test]
fn a_way_in_the_open_is_pulled_straight() {
    let map = Map::new(60, vec![Cell::Free; 60 * 60]);
    let guide = find(&map, &query((3.3, 4.4), (55.1, 30.7))).unwrap();
    let straight = (guide.points[0] - *guide.points.last().unwrap()).norm();
    assert!(guide.length_m < straight + 0.01, "{} {straight}", guide.length_m);
    assert_eq!(guide.known_until, guide.points.len());
    assert!(guide.cost_s > straight * 1.03, "the grid's own way has only eight directions");
}

#[test]
fn a_start_inside_an_obstacle_by_a_hair_moves_out_of_it() {
    let map = Map::draw(&["##........", "##........", "##........"]);
    let guide = find(&map, &query((1.95, 1.5), (8.5, 1.5))).unwrap();
    assert_eq!(guide.points[0], Point::new(1.95, 1.5));
    assert!((guide.length_m - 6.55).abs() < 0.05, "{}", guide.length_m);
    // Three cells deep in every direction.
    let deep = Map::new(12, (0..84).map(|at| [Cell::Occupied, Cell::Free][at % 12 / 8]).collect());
    let error = find(&deep, &query((3.5, 3.5), (9.5, 3.5))).unwrap_err();
    assert!(matches!(error, SearchError::StartBlocked { .. }), "{error}");
}

#[test]
fn a_goal_inside_an_obstacle_is_refused_unless_its_radius_reaches_out() {
    let map = Map::draw(&["......####", "......####", "......####"]);
    let ask = query((0.5, 1.5), (7.5, 1.5));
    let error = find(&map, &ask).unwrap_err();
    assert_eq!(error, SearchError::GoalBlocked { x_m: 7.5, y_m: 1.5 });
    let near = SearchQuery { goal_radius_m: 2.0, ..ask };
    let guide = find(&map, &near).unwrap();
    assert_eq!(*guide.points.last().unwrap(), Point::new(5.5, 1.5));
}

#[test]
fn the_search_stops_at_the_first_cell_within_the_goal_radius() {
    let map = Map::new(60, vec![Cell::Free; 60 * 60]);
    for (gx, gy) in [(50.2, 3.4), (41.0, 52.9), (3.5, 40.5), (8.1, 8.2)] {
        let ask = SearchQuery { goal_radius_m: 3.0, ..query((5.5, 5.5), (gx, gy)) };
        let guide = find(&map, &ask).unwrap();
        let exact = find(&map, &query((5.5, 5.5), (gx, gy))).unwrap();
        assert!((guide.points.last().unwrap() - ask.goal).norm() <= 3.0);
        assert!(guide.cost_s < exact.cost_s - 1.0 && guide.cost_s > exact.cost_s - 4.6);
    }
}

#[test]
fn the_view_is_asked_for_each_cell_once_and_only_around_the_search() {
    let mut cells = vec![Cell::Unknown; 200 * 200];
    for y in 80..120 {
        for x in 0..190 {
            cells[y * 200 + x] = Cell::Free;
        }
    }
    let map = Map::new(200, cells);
    let params = SearchParams::default();
    let mut view = Counting::new(|_| 0.5);
    let mut search = GuideSearch::new();
    let inside = query((3.5, 100.5), (180.5, 100.5));
    let guide = search.find(&map.terrain(), &inside, &mut view, &params).unwrap();
    assert_eq!((guide.asked, view.asked.len()), (0, 0), "the known way needs no view");

    let beyond = query((3.5, 100.5), (198.5, 100.5));
    let guide = search.find(&map.terrain(), &beyond, &mut view, &params).unwrap();
    assert_eq!(guide.asked, view.asked.len());
    let mut keys: Vec<(i64, i64)> = view.asked.iter().map(|p| (p.x as i64, p.y as i64)).collect();
    keys.sort_unstable();
    keys.dedup();
    assert_eq!(keys.len(), view.asked.len(), "no cell is asked for twice");
    assert!((10..2000).contains(&guide.asked), "{}", guide.asked);
    assert!(view.questions <= guide.asked / 8, "{} for {}", view.questions, guide.asked);
    assert_eq!(guide.points[guide.known_until].x.floor(), 190.0);
}

/// A wall with two gaps into the unknown, the nearer one below; behind it all is unknown.
fn fork() -> Map {
    let (width, height) = (60, 40);
    let mut cells = vec![Cell::Unknown; width * height];
    for y in 0..height {
        for x in 0..=30 {
            cells[y * width + x] = Cell::Free;
        }
        let gap = (8..12).contains(&y) || (26..30).contains(&y);
        cells[y * width + 30] = if gap { Cell::Free } else { Cell::Occupied };
    }
    for x in 0..=30 {
        cells[x] = Cell::Occupied;
        cells[(height - 1) * width + x] = Cell::Occupied;
    }
    for y in 0..height {
        cells[y * width] = Cell::Occupied;
    }
    Map::new(width, cells)
}

#[test]
fn a_prediction_changes_the_way_with_either_penalty() {
    let map = fork();
    let ask = SearchQuery { v_ref_mps: 4.0, ..query((3.5, 16.5), (55.5, 16.5)) };
    for penalty in [Penalty::Edge, Penalty::Literal] {
        let params = SearchParams { penalty, ..SearchParams::default() };
        let mut search = GuideSearch::new();
        let mut crossing = |phi: &dyn Fn(Point) -> f32| {
            let mut view = Counting::new(phi);
            let guide = search.find(&map.terrain(), &ask, &mut view, &params).unwrap();
            guide.points.iter().find(|p| p.x > 30.5).unwrap().y
        };
        assert!(crossing(&|_| 0.5) < 15.0, "{penalty:?}: the nearer gap");
        // A wall of surely occupied cells behind the lower gap.
        let behind = |p: Point| f32::from(p.y < 22.0 && (31.0..36.0).contains(&p.x));
        assert!(crossing(&behind) > 20.0, "{penalty:?}: round the wall that is foreseen");
    }
}

#[test]
fn the_same_question_has_the_same_answer_whatever_was_asked_before() {
    let map = fork();
    let ask = query((3.5, 16.5), (55.5, 16.5));
    let fresh = find(&map, &ask).unwrap();
    let mut search = GuideSearch::new();
    for penalty in [Penalty::Literal, Penalty::Edge, Penalty::Literal] {
        let other = query((10.5, 3.5), (-40.5, 60.5));
        let params = SearchParams { penalty, ..SearchParams::default() };
        search.find(&map.terrain(), &other, &mut NoPrediction, &params).unwrap();
        let again =
            search.find(&map.terrain(), &ask, &mut NoPrediction, &SearchParams::default()).unwrap();
        assert_eq!(again, fresh);
    }
}

#[test]
fn bad_questions_are_refused() {
    let map = fork();
    let good = query((3.5, 16.5), (55.5, 16.5));
    let bad = [
        SearchQuery { start: Point::new(f64::NAN, 0.0), ..good },
        SearchQuery { goal: Point::new(0.0, f64::INFINITY), ..good },
        SearchQuery { goal: Point::new(1.0e9, 0.0), ..good },
        SearchQuery { goal_radius_m: -1.0, ..good },
        SearchQuery { v_ref_mps: 0.0, ..good },
    ];
    for query in bad {
        assert!(matches!(find(&map, &query), Err(SearchError::BadQuery { .. })), "{query:?}");
    }
    let far = SearchQuery { goal: Point::new(9.0e5, 9.0e5), ..good };
    assert!(matches!(find(&map, &far), Err(SearchError::TooLarge { .. })));
}
