//! Driving to and fro without seeing anything new.
//!
//! A prediction reaches a few metres from what has been seen near the car. If it takes the way that
//! the car approaches for blocked, the car turns to another way, and out of the prediction's reach
//! the first one is as good as any unknown space again. Where both ways are taken for blocked from
//! near by, the car goes to and fro between them and never finds out: nothing that it sees there is
//! new, so nothing ever changes. (It did, with the truth turned round for a prediction.)
//!
//! The rule: a car that has driven more than twice the longest way that it had to the unknown, and ten
//! metres, without seeing anything new goes by what it has seen alone. To be heeded again, the
//! prediction waits for news; each time for more of it. So a drive wastes no more than a few such
//! detours, whatever is predicted.

use crate::frames::Point;
use crate::map::{Cell, Grid};
use crate::plan::search::Guide;

/// Driven beyond twice the way to the unknown before anything is said, metres: room to turn round.
const PATIENCE_M: f64 = 10.0;
/// How often the map is looked at, metres driven.
const LOOK_M: f64 = 1.0;
/// So much more known space is news, square metres: what comes into view at the ends of a seen room
/// while the car moves about in it is less.
const NEWS_M2: f64 = 2.0;
/// Each time that a prediction has led the car to and fro it takes this many times as much news.
const DEARER: f64 = 4.0;

/// Whether the car gets to see anything new.
#[derive(Clone, Debug, Default)]
pub(super) struct Wandering {
    goal: Option<Point>,
    /// Metres driven, when the map was last looked at, and when there last was news.
    looked_m: f64,
    news_m: f64,
    /// Cells that were known when there last was news.
    known: usize,
    /// The longest way to the unknown that the car has had before it since then, metres.
    reach_m: f64,
    /// What is news while the prediction is not heeded, square metres; `None` while it is.
    penance_m2: Option<f64>,
    /// What it will be next time.
    next_m2: f64,
}

impl Wandering {
    /// Whether the prediction is to be left out of this step. `driven_m` only grows.
    pub(super) fn look(&mut self, goal: Point, grid: &Grid, driven_m: f64) -> bool {
        if self.goal != Some(goal) {
            *self = Self { goal: Some(goal), next_m2: NEWS_M2, ..Self::default() };
            self.take_news(grid, driven_m);
        } else if driven_m - self.looked_m >= LOOK_M {
            self.looked_m = driven_m;
            let area_m2 = grid.resolution_m() * grid.resolution_m();
            let seen_m2 = known_cells(grid).saturating_sub(self.known) as f64 * area_m2;
            let allowed_m = 2.0 * self.reach_m + PATIENCE_M;
            if seen_m2 >= self.penance_m2.unwrap_or(NEWS_M2) {
                self.penance_m2 = None;
                self.take_news(grid, driven_m);
            } else if self.penance_m2.is_none() && driven_m - self.news_m > allowed_m {
                self.next_m2 *= DEARER;
                self.penance_m2 = Some(self.next_m2);
                self.known = known_cells(grid);
            }
        }
        self.penance_m2.is_some()
    }

    /// The way that the car goes now: it may be a long one back from a dead end.
    pub(super) fn follow(&mut self, guide: &Guide) {
        let known = &guide.points[..guide.known_until];
        let known_m = known.windows(2).map(|step| (step[1] - step[0]).norm()).sum();
        self.reach_m = self.reach_m.max(known_m);
    }

    fn take_news(&mut self, grid: &Grid, driven_m: f64) {
        (self.looked_m, self.news_m, self.reach_m) = (driven_m, driven_m, 0.0);
        self.known = known_cells(grid);
    }
}

fn known_cells(grid: &Grid) -> usize {
    grid.cells().iter().filter(|cell| **cell != Cell::Unknown).count()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::CellIndex;

    const GOAL: Point = Point::new(9.0, 0.0);

    /// A grid of which so many square metres are known.
    fn grid(known_m2: u32) -> Grid {
        let mut grid = Grid::new(0.1);
        for i in 0..known_m2 * 100 {
            grid.set(CellIndex::new((i % 100) as i32, (i / 100) as i32), Cell::Free);
        }
        grid
    }

    /// A way of which this much is known.
    fn guide(known_m: f64) -> Guide {
        let points = vec![Point::origin(), Point::new(known_m, 0.0), GOAL];
        Guide { points, known_until: 2, length_m: 9.0, cost_s: 9.0, expanded: 0, asked: 0 }
    }

    /// Where a car that sees nothing new stops heeding, metres driven.
    fn patience_m(wandering: &mut Wandering, grid: &Grid, from_m: f64) -> f64 {
        let at = |i: u32| from_m + f64::from(i) * 0.1;
        at((0..2000).find(|i| wandering.look(GOAL, grid, at(*i))).expect("patience ends"))
    }

    #[test]
    fn who_sees_nothing_new_goes_by_what_is_seen() {
        let mut wandering = Wandering::default();
        assert!(!wandering.look(GOAL, &grid(10), 0.0));
        wandering.follow(&guide(4.0));
        wandering.follow(&guide(8.0));
        let given_up_m = patience_m(&mut wandering, &grid(11), 0.0);
        assert!((26.0..27.2).contains(&given_up_m), "{given_up_m}");
    }

    #[test]
    fn news_keeps_the_prediction_heeded() {
        let mut wandering = Wandering::default();
        for i in 0..100 {
            let heedless = wandering.look(GOAL, &grid(10 + 2 * i), f64::from(i) * 10.0);
            assert!(!heedless, "after {i}0 m");
            wandering.follow(&guide(0.5));
        }
    }

    #[test]
    fn a_long_way_back_through_known_space_is_no_wandering() {
        let mut wandering = Wandering::default();
        wandering.look(GOAL, &grid(10), 0.0);
        // The last news came just before the end of a dead end.
        wandering.follow(&guide(0.5));
        wandering.follow(&guide(40.0));
        assert!(patience_m(&mut wandering, &grid(10), 0.0) > 90.0);
    }

    #[test]
    fn each_time_it_takes_more_to_be_heeded_again() {
        let mut wandering = Wandering::default();
        let (mut driven_m, mut known_m2) = (0.0, 10);
        for needed_m2 in [8, 32] {
            wandering.look(GOAL, &grid(known_m2), driven_m);
            wandering.follow(&guide(1.0));
            driven_m = patience_m(&mut wandering, &grid(known_m2), driven_m);
            assert!(wandering.look(GOAL, &grid(known_m2 + needed_m2 - 1), driven_m + 2.0));
            known_m2 += needed_m2;
            assert!(!wandering.look(GOAL, &grid(known_m2), driven_m + 4.0));
            driven_m += 4.0;
        }
        // A new goal begins anew.
        wandering.follow(&guide(1.0));
        patience_m(&mut wandering, &grid(known_m2), driven_m);
        assert!(!wandering.look(Point::origin(), &grid(known_m2), driven_m + 100.0));
    }
}
