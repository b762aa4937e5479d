//! Places that the search would like to pass and the car cannot get into.
//!
//! The search takes unknown space for passable at a price. Some unknown cells stay unknown however
//! long the car looks at them (holes in walls as seen at grazing angles, slits between pieces of
//! furniture), and some places are known to be free and yet too tight to stop in or to turn. A
//! planner without memory proposes the same way into such a place for ever, and the car stands in
//! front of it.
//!
//! The rule: when the car stands and [`PATIENCE`] planning steps in a row give no plan, the place
//! where the guide first leaves proven room, if it is within [`NEAR_M`], is closed to the search:
//! a disc around it. A standing car sees the same in every scan, so waiting longer shows nothing
//! new. The closed place opens again as soon as its middle has been proven to be room (seen from
//! elsewhere), and with a new goal. If closed places leave no way at all, or nothing near can be
//! closed, they are all opened and the car is *bold* until it has got [`BOLD_M`] away: it may then
//! stop where it cannot turn round. A bold car that still gets no plan although the way ahead has
//! room (it cannot turn into it, or no shape is found) has the place a little way ahead closed
//! instead. So a closed place never makes a goal unreachable.

use crate::frames::Point;
use crate::map::{CellRect, Grid};

/// Planning steps without a plan until a place is closed.
const PATIENCE: u32 = 3;
/// Farther ahead much may change before the car gets there, metres.
const NEAR_M: f64 = 3.0;
/// Radius of a closed disc, metres.
const CLOSED_M: f64 = 0.5;
/// Closed discs leave this much room around the car, so that it can leave, metres.
const CAR_ROOM_M: f64 = 0.15;
/// Boldness ends this far from where it began, metres.
const BOLD_M: f64 = 2.0;

/// A closed disc.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    centre: Point,
    radius_m: f64,
    /// Nobody has looked yet whether its middle is room.
    fresh: bool,
    /// Its middle was not room when it was closed: if it is one day, that is news.
    unproven: bool,
}

/// The memory of one drive to one goal.
#[derive(Clone, Debug, Default)]
pub struct Impasses {
    goal: Option<Point>,
    failed_steps: u32,
    closed: Vec<Place>,
    bold_from: Option<Point>,
}

impl Impasses {
    /// To be called first in every step: forgets everything with a new goal, and boldness with
    /// distance.
    pub fn begin(&mut self, goal: Point, car: Point) {
        if self.goal != Some(goal) {
            *self = Self { goal: Some(goal), ..Self::default() };
        }
        self.bold_from = self.bold_from.filter(|from| (car - from).norm() < BOLD_M);
    }

    /// Whether the car may stop where it cannot turn round.
    pub const fn is_bold(&self) -> bool {
        self.bold_from.is_some()
    }

    /// Closes cells to the search, and opens the places whose middle is room by now. `tight` marks
    /// the cells in which the car's centre is not proven to have room; both in the grid's layout.
    pub fn mask(&mut self, grid: &Grid, tight: &[bool], lethal: &mut [bool]) {
        let open = |p: Point| grid.offset(grid.cell_at(p)).is_some_and(|i| !tight[i]);
        for place in self.closed.iter_mut().filter(|place| place.fresh) {
            (place.fresh, place.unproven) = (false, !open(place.centre));
        }
        self.closed.retain(|place| !(place.unproven && open(place.centre)));
        let bounds = grid.bounds();
        for place in &self.closed {
            let cell = grid.cell_at(place.centre);
            let reach = (place.radius_m / grid.resolution_m()).ceil() as i32;
            let rect = CellRect { x0: cell.ix, y0: cell.iy, x1: cell.ix + 1, y1: cell.iy + 1 };
            let rect = rect.grown(reach).intersection(&bounds);
            for iy in rect.y0..rect.y1 {
                for ix in rect.x0..rect.x1 {
                    let c = crate::map::CellIndex::new(ix, iy);
                    let inside = (grid.centre(c) - place.centre).norm() <= place.radius_m;
                    if let Some(offset) = grid.offset(c).filter(|_| inside) {
                        lethal[offset] = true;
                    }
                }
            }
        }
    }

    /// The step gave a plan, or the car is moving.
    pub const fn record_progress(&mut self) {
        self.failed_steps = 0;
    }

    /// The car stands at `car` and the step gave no plan; `ahead` is where the guide first leaves
    /// proven room, `onward` where it is a little way ahead.
    pub fn record_failure(&mut self, car: Point, ahead: Option<Point>, onward: Option<Point>) {
        self.failed_steps += 1;
        if self.failed_steps < PATIENCE {
            return;
        }
        self.failed_steps = 0;
        let away = |p: Point| (p, (p - car).norm());
        let onward = onward.filter(|_| self.is_bold()).map(away);
        let near = ahead.map(away).filter(|(_, d)| *d <= NEAR_M).or(onward);
        let radius = |distance: f64| CLOSED_M.min(distance - CAR_ROOM_M);
        match near.filter(|(_, distance)| radius(*distance) > 0.0) {
            Some((centre, distance)) => {
                let radius_m = radius(distance);
                self.closed.push(Place { centre, radius_m, fresh: true, unproven: false });
            }
            None => {
                self.give_up(car);
            }
        }
    }

    /// The search found no way. Opens every closed place; says whether there was one, so that the
    /// search is worth repeating.
    pub fn give_up(&mut self, car: Point) -> bool {
        self.bold_from = Some(car);
        let any = !self.closed.is_empty();
        self.closed.clear();
        any
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::{Cell, CellIndex};

    const GOAL: Point = Point::new(9.0, 0.0);
    const CAR: Point = Point::new(0.0, 0.0);
    const HOLE: Point = Point::new(1.05, 0.05);

    fn grid() -> Grid {
        let mut grid = Grid::new(0.1);
        for i in -20..20 {
            grid.set(CellIndex::new(i, 0), Cell::Free);
        }
        grid
    }

    fn closed(impasses: &mut Impasses, grid: &Grid, tight: bool) -> Vec<Point> {
        let tight = vec![tight; grid.cells().len()];
        let mut lethal = vec![false; grid.cells().len()];
        impasses.mask(grid, &tight, &mut lethal);
        let bounds = grid.bounds();
        let cells =
            (bounds.y0..bounds.y1).flat_map(|y| (bounds.x0..bounds.x1).map(move |x| (x, y)));
        cells
            .zip(&lethal)
            .filter(|(_, lethal)| **lethal)
            .map(|((x, y), _)| grid.centre(CellIndex::new(x, y)))
            .collect()
    }

    fn fail(impasses: &mut Impasses, ahead: Option<Point>) {
        for _ in 0..PATIENCE {
            impasses.record_failure(CAR, ahead, None);
        }
    }

    #[test]
    fn a_place_is_closed_only_after_several_failures_in_a_row() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        for _ in 1..PATIENCE {
            impasses.record_failure(CAR, Some(HOLE), None);
        }
        impasses.record_progress();
        impasses.record_failure(CAR, Some(HOLE), None);
        assert!(closed(&mut impasses, &grid, true).is_empty());
        fail(&mut impasses, Some(HOLE));
        let cells = closed(&mut impasses, &grid, true);
        assert!(cells.len() > 30, "{}", cells.len());
        assert!(cells.iter().all(|p| (p - HOLE).norm() <= CLOSED_M));
    }

    #[test]
    fn the_car_itself_is_never_inside_a_closed_place() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        fail(&mut impasses, Some(Point::new(0.35, 0.0)));
        let cells = closed(&mut impasses, &grid, true);
        assert!(!cells.is_empty());
        assert!(cells.iter().all(|p| (p - CAR).norm() >= CAR_ROOM_M - 1e-9), "{cells:?}");
    }

    #[test]
    fn what_turns_out_to_be_room_opens_again() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        fail(&mut impasses, Some(HOLE));
        assert!(!closed(&mut impasses, &grid, true).is_empty());
        assert!(closed(&mut impasses, &grid, false).is_empty());
        assert!(closed(&mut impasses, &grid, true).is_empty(), "it stays open");
    }

    #[test]
    fn a_new_goal_opens_everything() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        fail(&mut impasses, Some(HOLE));
        impasses.begin(GOAL, CAR);
        assert!(!closed(&mut impasses, &grid, true).is_empty());
        impasses.begin(HOLE, CAR);
        assert!(closed(&mut impasses, &grid, true).is_empty());
    }

    #[test]
    fn with_nothing_near_to_close_the_car_is_bold_until_it_has_got_away() {
        let mut impasses = Impasses::default();
        impasses.begin(GOAL, CAR);
        fail(&mut impasses, Some(Point::new(NEAR_M + 0.1, 0.0)));
        assert!(impasses.is_bold());
        impasses.begin(GOAL, Point::new(BOLD_M - 0.1, 0.0));
        assert!(impasses.is_bold());
        impasses.begin(GOAL, Point::new(BOLD_M + 0.1, 0.0));
        assert!(!impasses.is_bold());
    }

    #[test]
    fn a_bold_car_without_a_plan_has_the_way_ahead_closed() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        for _ in 0..PATIENCE {
            impasses.record_failure(CAR, None, Some(HOLE));
        }
        assert!(impasses.is_bold() && closed(&mut impasses, &grid, false).is_empty());
        for _ in 0..PATIENCE {
            impasses.record_failure(CAR, None, Some(HOLE));
        }
        assert!(!closed(&mut impasses, &grid, false).is_empty());
    }

    #[test]
    fn closed_places_never_make_a_goal_unreachable() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL, CAR);
        fail(&mut impasses, Some(HOLE));
        assert!(impasses.give_up(CAR), "the search is worth repeating");
        assert!(closed(&mut impasses, &grid, true).is_empty());
        assert!(impasses.is_bold());
        assert!(!impasses.give_up(CAR));
    }
}
