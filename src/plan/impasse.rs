//! Places that the search would like to pass and the car cannot get into.
//!
//! The search takes unknown space for passable at a price. Some unknown cells stay unknown however
//! long the car looks at them (holes in walls as seen at grazing angles, slits between pieces of
//! furniture), and some places are known to be free and yet too tight to stop in or to turn. A
//! planner without memory proposes the same way into such a place for ever, and the car stands in
//! front of it.
//!
//! A car without reverse gear also does not get out of every place that it gets into. It stops only
//! where it can turn back onto its tracks in proven room, unless nothing else is left.
//!
//! The rule: when the car stands and [`PATIENCE`] planning steps in a row give no plan, something is
//! done. A standing car sees the same in every scan, so waiting longer shows nothing new.
//!
//! - The place that keeps the car from following its guide is closed to the search: a disc around
//!   it. It opens again as soon as its middle has been proven to be room (seen from elsewhere), and
//!   with a new goal. So the next way is tried.
//! - If the next way is much longer, or there is none, every place is opened and the car plucks up
//!   [`Courage`]: it then stops where there may be room to turn back, and if that does not help
//!   either, where it gets on ahead. Courage ends with a proven stop [`COURAGE_M`] away. So a closed
//!   place never makes a goal unreachable.
//!
//! After [`LASTING`] planning steps in a row without a plan the impasse is *lasting*: whatever is
//! closed, the car gets on in no direction ahead, and turning round is worth its time; a bold car then
//! also goes wherever a bold stop may lead.

use crate::frames::Point;
use crate::map::{CellRect, Grid};

/// Planning steps without a plan until a place is closed.
const PATIENCE: u32 = 3;
/// Planning steps without a plan until an impasse is lasting.
const LASTING: u32 = 4 * PATIENCE;
/// Radius of a closed disc, metres.
const CLOSED_M: f64 = 0.5;
/// Closed discs leave this much room around the car, so that it can leave, metres.
const CAR_ROOM_M: f64 = 0.15;
/// Courage ends this far from where it was plucked up, metres.
const COURAGE_M: f64 = 2.0;

/// What a plan may rely on for its stop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Courage {
    /// On room that is proven.
    #[default]
    Proven,
    /// Also on room for turning back that is not known to be taken.
    Hopeful,
    /// Also on there being several ways on, one after the other.
    Bold,
}

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
    /// Steps in a row without a plan.
    standing_steps: u32,
    closed: Vec<Place>,
    courage: Courage,
    /// Where it was plucked up.
    since: Point,
}

impl Impasses {
    /// To be called first in every step: forgets everything with a new goal.
    pub fn begin(&mut self, goal: Point) {
        if self.goal != Some(goal) {
            *self = Self { goal: Some(goal), ..Self::default() };
        }
    }

    /// What a plan may rely on for its stop.
    pub const fn courage(&self) -> Courage {
        self.courage
    }

    /// Whether the car stands without a plan.
    pub const fn is_standing(&self) -> bool {
        self.standing_steps > 0
    }

    /// Whether the car has stood for long without a plan.
    pub const fn is_lasting(&self) -> bool {
        self.standing_steps >= LASTING
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

    /// The step gave a plan that stops where the car can turn back; courage ends some way from
    /// where it was plucked up.
    pub fn record_progress(&mut self, car: Point) {
        self.standing_steps = 0;
        if (car - self.since).norm() >= COURAGE_M {
            self.courage = Courage::Proven;
        }
    }

    /// The step gave another plan, or the car is moving.
    pub const fn record_gamble(&mut self) {
        self.standing_steps = 0;
    }

    /// The car stands and the step gave no plan; says whether it is time to do something about it.
    pub const fn count_failure(&mut self) -> bool {
        self.standing_steps += 1;
        self.standing_steps.is_multiple_of(PATIENCE)
    }

    /// Closes a place for a car that stands at `car`, if the disc leaves it some room.
    pub fn close(&mut self, car: Point, centre: Point) -> bool {
        let radius_m = CLOSED_M.min((centre - car).norm() - CAR_ROOM_M);
        if radius_m > 0.0 {
            self.closed.push(Place { centre, radius_m, fresh: true, unproven: false });
        }
        radius_m > 0.0
    }

    /// Opens every place.
    pub fn open(&mut self) {
        self.closed.clear();
    }

    /// The search found no way. If that is for closed places, opens them all, takes courage, and
    /// says so: the search is worth repeating.
    pub fn blame_closed(&mut self, car: Point) -> bool {
        let any = !self.closed.is_empty();
        if any {
            self.take_courage(car);
        }
        any
    }

    /// Opens every place and relies on less from here on.
    pub fn take_courage(&mut self, car: Point) {
        self.courage = match self.courage {
            Courage::Proven => Courage::Hopeful,
            Courage::Hopeful | Courage::Bold => Courage::Bold,
        };
        self.since = car;
        self.open();
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

    #[test]
    fn something_is_to_be_done_only_after_several_failures_in_a_row() {
        let mut impasses = Impasses::default();
        impasses.begin(GOAL);
        for _ in 1..PATIENCE {
            assert!(!impasses.count_failure());
        }
        impasses.record_progress(CAR);
        assert!(!impasses.count_failure());
        impasses.record_progress(CAR);
        for round in 0..LASTING / PATIENCE {
            assert!(!impasses.is_lasting(), "{round}");
            for i in 1..=PATIENCE {
                assert_eq!(impasses.count_failure(), i == PATIENCE);
            }
        }
        assert!(impasses.is_lasting());
        impasses.record_progress(CAR);
        assert!(!impasses.is_lasting());
    }

    #[test]
    fn a_closed_place_is_a_disc() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL);
        assert!(impasses.close(CAR, HOLE));
        let cells = closed(&mut impasses, &grid, true);
        assert!(cells.len() > 30, "{}", cells.len());
        assert!(cells.iter().all(|p| (p - HOLE).norm() <= CLOSED_M));
    }

    #[test]
    fn the_car_itself_is_never_inside_a_closed_place() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL);
        assert!(impasses.close(CAR, Point::new(0.35, 0.0)));
        let cells = closed(&mut impasses, &grid, true);
        assert!(!cells.is_empty());
        assert!(cells.iter().all(|p| (p - CAR).norm() >= CAR_ROOM_M - 1e-9), "{cells:?}");
    }

    #[test]
    fn what_turns_out_to_be_room_opens_again() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL);
        assert!(impasses.close(CAR, HOLE));
        assert!(!closed(&mut impasses, &grid, true).is_empty());
        assert!(closed(&mut impasses, &grid, false).is_empty());
        assert!(closed(&mut impasses, &grid, true).is_empty(), "it stays open");
    }

    #[test]
    fn a_new_goal_opens_everything() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL);
        assert!(impasses.close(CAR, HOLE));
        impasses.begin(GOAL);
        assert!(!closed(&mut impasses, &grid, true).is_empty());
        impasses.begin(HOLE);
        assert!(closed(&mut impasses, &grid, true).is_empty());
    }

    #[test]
    fn a_place_too_near_to_leave_the_car_room_is_not_closed() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        assert!(!impasses.close(CAR, Point::new(0.1, 0.0)));
        assert!(closed(&mut impasses, &grid, true).is_empty());
    }

    #[test]
    fn courage_grows_and_ends_with_a_proven_stop_some_way_off() {
        let mut impasses = Impasses::default();
        impasses.begin(GOAL);
        for courage in [Courage::Proven, Courage::Hopeful, Courage::Bold] {
            assert_eq!(impasses.courage(), courage);
            impasses.take_courage(CAR);
        }
        assert_eq!(impasses.courage(), Courage::Bold);
        impasses.record_progress(Point::new(COURAGE_M - 0.1, 0.0));
        impasses.record_gamble();
        assert_eq!(impasses.courage(), Courage::Bold);
        impasses.record_progress(Point::new(COURAGE_M + 0.1, 0.0));
        assert_eq!(impasses.courage(), Courage::Proven);
    }

    #[test]
    fn closed_places_never_make_a_goal_unreachable() {
        let (grid, mut impasses) = (grid(), Impasses::default());
        impasses.begin(GOAL);
        assert!(!impasses.blame_closed(CAR), "nothing is closed");
        assert_eq!(impasses.courage(), Courage::Proven);
        assert!(impasses.close(CAR, HOLE));
        assert!(impasses.blame_closed(CAR), "the search is worth repeating");
        assert!(closed(&mut impasses, &grid, true).is_empty());
        assert_eq!(impasses.courage(), Courage::Hopeful);
    }
}
