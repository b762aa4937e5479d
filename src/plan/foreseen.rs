//! The map with what is foreseen filled in beside the way: for certain, or likely enough.
//!
//! Shapes are fitted into this map, so that they lie right before the view opens. Certificates know
//! nothing of it; nor do stops, but that they go by quarters of cells once anything has been filled in.

use super::bubbles::ClearanceField;
use crate::frames::Point;
use crate::map::{Blocking, Cell, CellIndex, CellRect, Clearance, DistanceField, Grid};
use crate::predict::OccupancyView;
use crate::tunables;

tunables! {
    /// What of a prediction shapes rely on.
    pub struct ForeseenParams in "foreseen" {
        /// Unseen space is taken for free where it is occupied with at most this probability. With 0
        /// only who knows the map is relied on, no network.
        free_at_most: f64 = 0.35, live, in 0.0..=0.5, "";
        /// And for occupied with at least this; with 1 no network is relied on.
        occupied_at_least: f64 = 0.65, live, in 0.5..=1.0, "";
        /// A network is relied on only where scenes have of late looked as familiar to it as this in
        /// the mean: 0.57 in mazes like those that it was trained on, below 0.1 in buildings.
        familiarity_at_least: f64 = 0.3, live, in 0.0..=1.0, "";
        /// A network is relied on only up to this speed limit: a shape drawn into space that turns
        /// out otherwise costs a fast car more than one that fits saves.
        network_speed_mps: f64 = 5.0, live, in 0.0..=20.0, "m/s";
    }
}

impl ForeseenParams {
    /// The same, but relying on nothing that is not certain.
    pub(super) fn of_certainty(&self) -> Self {
        Self { free_at_most: 0.0, occupied_at_least: 1.0, ..self.clone() }
    }

    /// Whether any answer of a view is relied on.
    pub(super) fn rely_on_any_of(&self, view: &dyn OccupancyView) -> bool {
        let (free_at_most, occupied_at_least) = self.limits(view);
        free_at_most.is_some() || occupied_at_least.is_some()
    }

    /// The answers of a view that are relied on: up to the first number free, from the second one on
    /// occupied; none where that asks for certainty and the view never is certain.
    fn limits(&self, view: &dyn OccupancyView) -> (Option<f64>, Option<f64>) {
        let certain = view.is_ever_certain();
        let free = (certain || self.free_at_most > 0.0).then_some(self.free_at_most);
        let occupied = (certain || self.occupied_at_least < 1.0).then_some(self.occupied_at_least);
        (free, occupied)
    }
}

/// How far beside the way predictions matter to its shape, metres: the largest bubble and the car.
const BESIDE_M: f64 = 1.5;
/// Distance between the squares along the way that are looked at, metres: a good part of them is
/// in two.
const STRIDE_M: f64 = 0.75;

/// A copy of the known map with the cells filled in, and its distance fields.
#[derive(Debug)]
pub(super) struct Foreseen {
    grid: Grid,
    occupied: DistanceField,
    blocked: DistanceField,
    /// Holds every cell that is filled in.
    filled: CellRect,
    /// Holds every cell that has changed since the fields were brought up to date.
    stale: CellRect,
    /// Whether the grid is a copy of this step's map.
    is_copied: bool,
    /// Whether the view has been asked about a cell in this step; as the grid's cells.
    asked: Vec<bool>,
    /// The cells that it has been asked about.
    cells: Vec<CellIndex>,
    squares: Vec<CellRect>,
    points: Vec<Point>,
    answers: Vec<f32>,
    has_spoken: bool,
}

impl Foreseen {
    /// Nothing yet. Distances are told apart up to `cap_m`.
    pub(super) fn new(cap_m: f64) -> Self {
        Self {
            grid: Grid::new(1.0),
            occupied: DistanceField::new(Blocking::Occupied, cap_m),
            blocked: DistanceField::new(Blocking::OccupiedOrUnknown, cap_m),
            filled: CellRect::EMPTY,
            stale: CellRect::EMPTY,
            is_copied: false,
            asked: Vec::new(),
            cells: Vec::new(),
            squares: Vec::new(),
            points: Vec::new(),
            answers: Vec::new(),
            has_spoken: false,
        }
    }

    /// Begins a step in which only `changed` of the known map differs from the one before. The copy
    /// waits until something is foreseen: most predictors and whole drives foresee nothing.
    pub(super) fn begin(&mut self, changed: CellRect) {
        self.stale = self.stale.union(&changed).union(&self.filled);
        self.filled = CellRect::EMPTY;
        self.is_copied = false;
        self.cells.clear();
    }

    /// Fills in what the view is sure of beside the first `horizon_m` of the way. `known` is the
    /// step's map.
    pub(super) fn look(
        &mut self,
        params: &ForeseenParams,
        known: &Grid,
        way: impl Iterator<Item = Point>,
        horizon_m: f64,
        view: &mut dyn OccupancyView,
    ) {
        if !params.rely_on_any_of(view) {
            return;
        }
        let (free_at_most, occupied_at_least) = params.limits(view);
        self.place_squares(known, way, horizon_m, view);
        if self.squares.is_empty() {
            return;
        }
        let bounds = self.grid.bounds();
        if !self.is_copied {
            let same = known.resolution_m() == self.grid.resolution_m();
            self.grid.clone_from(known);
            if same {
                self.grid.grow_to(bounds);
            }
            self.is_copied = true;
        }
        let area = self.squares.iter().fold(CellRect::EMPTY, |area, s| area.union(s));
        self.grid.grow_to(area);
        if self.cells.is_empty() || self.grid.bounds() != bounds {
            self.mark_asked();
        }
        self.points.clear();
        let first = self.cells.len();
        for square in &self.squares {
            for iy in square.y0..square.y1 {
                for ix in square.x0..square.x1 {
                    let c = CellIndex::new(ix, iy);
                    let at = self.grid.offset(c).expect("the grid was grown to hold the squares");
                    if self.grid.cells()[at] == Cell::Unknown && !self.asked[at] {
                        self.asked[at] = true;
                        self.cells.push(c);
                        self.points.push(self.grid.centre(c));
                    }
                }
            }
        }
        self.answers.clear();
        self.answers.resize(self.points.len(), 0.5);
        if !self.points.is_empty() {
            view.occupied(&self.points, &mut self.answers);
        }
        for (c, p) in self.cells[first..].iter().zip(&self.answers) {
            let p = f64::from(*p);
            let cell = if free_at_most.is_some_and(|most| p <= most) {
                Cell::Free
            } else if occupied_at_least.is_some_and(|least| p >= least) {
                Cell::Occupied
            } else {
                continue;
            };
            self.grid.set(*c, cell);
            self.has_spoken = true;
            let one = CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 };
            self.filled = self.filled.union(&one);
            self.stale = self.stale.union(&one);
        }
        self.refresh();
    }

    /// Squares of cells along the way, but for those where the view is silent.
    fn place_squares(
        &mut self,
        known: &Grid,
        way: impl Iterator<Item = Point>,
        horizon_m: f64,
        view: &dyn OccupancyView,
    ) {
        self.squares.clear();
        let reach = (BESIDE_M / known.resolution_m()).ceil() as i32;
        let (mut along_m, mut next_m) = (0.0, 0.0);
        let mut before: Option<Point> = None;
        for p in way {
            along_m += before.map_or(0.0, |before| (p - before).norm());
            before = Some(p);
            if along_m > horizon_m {
                break;
            }
            if along_m < next_m {
                continue;
            }
            next_m = along_m + STRIDE_M;
            let c = known.cell_at(p);
            let one = CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 };
            let square = one.grown(reach);
            let low = known.centre(CellIndex::new(square.x0, square.y0));
            let high = known.centre(CellIndex::new(square.x1, square.y1));
            if !view.silent(low, high) {
                self.squares.push(square);
            }
        }
    }

    fn mark_asked(&mut self) {
        self.asked.clear();
        self.asked.resize(self.grid.cells().len(), false);
        for c in &self.cells {
            self.asked[self.grid.offset(*c).expect("the grid never shrinks in a step")] = true;
        }
    }

    fn refresh(&mut self) {
        let stale = std::mem::take(&mut self.stale);
        self.occupied.update(&self.grid, stale);
        self.blocked.update(&self.grid, stale);
    }

    /// Marks the cells of `grid` (the known map) whose centre is nearer than `least_m` to that of
    /// an obstacle, foreseen or known.
    pub(super) fn mask(&self, grid: &Grid, least_m: f32, lethal: &mut [bool]) {
        if self.is_silent() {
            return;
        }
        let reach = (f64::from(least_m) / grid.resolution_m()).ceil() as i32;
        let area = self.filled.grown(reach).intersection(&grid.bounds());
        for iy in area.y0..area.y1 {
            for ix in area.x0..area.x1 {
                let c = CellIndex::new(ix, iy);
                if self.occupied.distance_m(c) < least_m
                    && let Some(at) = grid.offset(c)
                {
                    lethal[at] = true;
                }
            }
        }
    }

    /// Whether nothing is filled in; then there is nothing to be asked of this map.
    pub(super) const fn is_silent(&self) -> bool {
        self.filled.is_empty()
    }

    /// Whether anything has been filled in in any step so far.
    pub(super) const fn has_spoken(&self) -> bool {
        self.has_spoken
    }

    /// Clearance to what is occupied or foreseen to be.
    pub(super) fn occupied(&self) -> Clearance<'_> {
        Clearance::new(&self.grid, &self.occupied)
    }

    /// Clearance to everything that is neither free nor foreseen to be.
    pub(super) fn blocked(&self) -> Clearance<'_> {
        Clearance::new(&self.grid, &self.blocked)
    }

    /// The map with what is foreseen; only while it is not [silent](Self::is_silent).
    pub(super) const fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Whether a point is neither known nor foreseen.
    pub(super) fn is_open(&self, p: Point) -> bool {
        self.grid.get(self.grid.cell_at(p)) == Cell::Unknown
    }
}

/// The clearance that shapes are fitted into.
pub(super) struct ShapeField<'a> {
    /// To what is occupied.
    pub(super) occupied: Clearance<'a>,
    /// To what is occupied or unknown.
    pub(super) blocked: Clearance<'a>,
    /// Clearance that the certificate asks for, metres.
    pub(super) keep_m: f64,
    /// Granted beside unknown space beyond that, metres.
    pub(super) unknown_room_m: f64,
    /// Kept from walls beyond that where there is room, metres.
    pub(super) wall_room_m: f64,
}

impl ClearanceField for ShapeField<'_> {
    fn clearance_m(&self, p: Point) -> f64 {
        let floor_m = self.keep_m + self.unknown_room_m;
        let mut clearance_m = self.blocked.at(p);
        if clearance_m < floor_m {
            clearance_m = self.occupied.at(p).min(floor_m);
        }
        // In narrow places half of what there is.
        let spare_m = (clearance_m - self.keep_m).max(0.0);
        clearance_m - self.wall_room_m.min(0.5 * spare_m)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Says of each cell what a number made from its place says, and counts the questions.
    struct Oddly {
        salt: i64,
        certain: bool,
        asked: Vec<Point>,
    }

    impl Oddly {
        fn probability(salt: i64, p: Point) -> f32 {
            let (x, y) = ((p.x * 10.0).floor() as i64, (p.y * 10.0).floor() as i64);
            [0.0, 0.0625, 0.125, 0.5, 0.9375, 1.0][(x * 7 + y * 13 + salt).rem_euclid(6) as usize]
        }
    }

    impl OccupancyView for Oddly {
        fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
            for (p, out) in points.iter().zip(out) {
                *out = Self::probability(self.salt, *p);
                self.asked.push(*p);
            }
        }

        fn is_ever_certain(&self) -> bool {
            self.certain
        }
    }

    /// Must not be asked.
    struct Nothing {
        silent: bool,
        certain: bool,
    }

    impl OccupancyView for Nothing {
        fn occupied(&mut self, _: &[Point], _: &mut [f32]) {
            panic!("there is nothing to be asked for");
        }

        fn silent(&self, _: Point, _: Point) -> bool {
            self.silent
        }

        fn is_ever_certain(&self) -> bool {
            self.certain
        }
    }

    fn some_map(cells: &[u8]) -> Grid {
        let mut grid = Grid::new(0.1);
        for (i, c) in cells.iter().enumerate() {
            let c = [Cell::Unknown, Cell::Free, Cell::Free, Cell::Occupied][usize::from(*c)];
            grid.set(CellIndex::new(i as i32 % 30, i as i32 / 30), c);
        }
        grid
    }

    fn line(a: Point, b: Point) -> Vec<Point> {
        (0..=40).map(|i| a + (b - a) * (f64::from(i) / 40.0)).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn clearances_are_those_of_the_map_filled_in_anew(
            maps in prop::collection::vec(prop::collection::vec(0_u8..4, 900), 1..6),
            ends in prop::collection::vec((-1.0..4.0, -1.0..4.0, -1.0..4.0, -1.0..4.0), 2..5),
            salt in 0_i64..6,
            silent in 0_usize..3,
            limits in prop::sample::select(&[(0.0, 1.0), (0.1, 0.9), (0.2, 0.8), (0.0, 0.9), (0.1, 1.0)]),
            certain: bool,
        ) {
            let (free_at_most, occupied_at_least) = limits;
            let free_trusted = certain || free_at_most > 0.0;
            let occupied_trusted = certain || occupied_at_least < 1.0;
            // Then nothing is copied: the test below.
            prop_assume!(free_trusted || occupied_trusted);
            let params =
                ForeseenParams { free_at_most, occupied_at_least, ..Default::default() };
            let mut foreseen = Foreseen::new(1.5);
            let mut map = some_map(&maps[0]);
            for (step, news) in maps.iter().enumerate() {
                // Only some rows change, but for the first time.
                let changed = if step == 0 {
                    map.bounds()
                } else {
                    let y0 = step as i32 * 7 % 25;
                    CellRect { x0: 0, y0, x1: 30, y1: y0 + 5 }
                };
                let news = some_map(news);
                for iy in changed.y0..changed.y1 {
                    for ix in changed.x0..changed.x1 {
                        map.set(CellIndex::new(ix, iy), news.get(CellIndex::new(ix, iy)));
                    }
                }
                foreseen.begin(changed);
                if step % 3 == silent {
                    continue; // the copy lags behind
                }
                let mut view = Oddly { salt: salt + step as i64, certain, asked: Vec::new() };
                for (ax, ay, bx, by) in &ends {
                    let way = line(Point::new(*ax, *ay), Point::new(*bx, *by));
                    foreseen.look(&params, &map, way.into_iter(), 20.0, &mut view);
                }
                let mut literal = map.clone();
                literal.grow_to(foreseen.grid.bounds());
                for p in &view.asked {
                    let cell = match Oddly::probability(view.salt, *p) {
                        p if free_trusted && f64::from(p) <= free_at_most => Cell::Free,
                        p if occupied_trusted && f64::from(p) >= occupied_at_least => {
                            Cell::Occupied
                        }
                        _ => Cell::Unknown,
                    };
                    prop_assert_eq!(map.get(map.cell_at(*p)), Cell::Unknown);
                    literal.set(map.cell_at(*p), cell);
                }
                prop_assert_eq!(foreseen.grid.cells(), literal.cells());
                for (ours, blocking) in [
                    (&foreseen.occupied, Blocking::Occupied),
                    (&foreseen.blocked, Blocking::OccupiedOrUnknown),
                ] {
                    let mut fresh = DistanceField::new(blocking, 1.5);
                    fresh.update(&literal, literal.bounds());
                    prop_assert_eq!(ours.values(), fresh.values());
                }
                let mut once = view.asked.clone();
                once.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
                once.dedup();
                prop_assert_eq!(once.len(), view.asked.len(), "a cell was asked for twice");
            }
        }
    }

    #[test]
    fn a_view_that_is_silent_or_never_certain_leaves_the_map_as_it_is() {
        for (silent, certain) in [(true, true), (false, false)] {
            let map = some_map(&[0; 900]);
            let mut foreseen = Foreseen::new(1.5);
            foreseen.begin(map.bounds());
            let way = line(Point::new(0.0, 0.0), Point::new(3.0, 3.0)).into_iter();
            let mut view = Nothing { silent, certain };
            let params = ForeseenParams::default().of_certainty();
            foreseen.look(&params, &map, way, 20.0, &mut view);
            assert!(foreseen.is_silent());
            let mut lethal = vec![false; map.cells().len()];
            foreseen.mask(&map, 0.3, &mut lethal);
            assert!(!lethal.contains(&true));
        }
    }

    #[test]
    fn room_is_kept_from_walls_but_only_half_of_what_there_is() {
        // Free for 0 < x < 3, walls on either side.
        let mut map = Grid::new(0.1);
        for iy in 0..30 {
            for ix in -1..31 {
                let wall = !(0..30).contains(&ix);
                let cell = if wall { Cell::Occupied } else { Cell::Free };
                map.set(CellIndex::new(ix, iy), cell);
            }
        }
        let mut fields = [Blocking::Occupied, Blocking::OccupiedOrUnknown]
            .map(|blocking| DistanceField::new(blocking, 1.5));
        for field in &mut fields {
            field.update(&map, map.bounds());
        }
        let field = ShapeField {
            occupied: Clearance::new(&map, &fields[0]),
            blocked: Clearance::new(&map, &fields[1]),
            keep_m: 0.25,
            unknown_room_m: 0.3,
            wall_room_m: 0.1,
        };
        let at = |x: f64| field.clearance_m(Point::new(x, 1.5));
        for (distance, expected) in
            [(1.0, 0.9), (0.45, 0.35), (0.35, 0.3), (0.25, 0.25), (0.2, 0.2)]
        {
            assert!((at(distance) - expected).abs() < 1e-6, "{} at {distance}", at(distance));
        }
    }
}
