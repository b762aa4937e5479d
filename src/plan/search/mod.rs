//! Where to go: the cheapest way over the grid, through known and unknown space, and the first
//! metres of it in a form that a car without reverse can drive.

mod astar;
mod boards;
mod buckets;
mod dubins;
mod jump;
mod literal;
mod manoeuvre;
mod pull;
mod retreat;
mod window;

pub use astar::{GuideSearch, SearchError};
pub use manoeuvre::{
    Manoeuvre, ManoeuvreParams, ManoeuvreQuery, ManoeuvreSearch, MaskRoom, NoManoeuvre, Room,
};
pub use retreat::{arcs_path, retreat};

use crate::frames::Point;
use crate::map::{Cell, CellIndex, CellRect, floor_to_index};
use crate::{choices, tunables};

choices! {
    /// How the probability `phi` that an unknown cell is occupied enters the search
    /// (Elhafsi et al. 2020, section IV).
    pub enum Penalty {
        /// As a cost of travelling, which is what the paper's objective asks for: a step through
        /// an unknown cell costs `length * (1/v_ref + alpha / (1 - phi + eps))` seconds.
        Edge = "edge",
        /// As the paper's text says: the heuristic of an unknown cell is multiplied by
        /// `alpha / (1 - phi + eps)`, the cost of a step is its length.
        Literal = "literal",
    }
}

tunables! {
    /// The grid search that guides the planner through known and unknown space.
    pub struct SearchParams in "search" {
        /// How the predicted occupancy of unknown space enters the search.
        penalty: Penalty = Penalty::Edge, live, one of;
        /// Weight of the penalty for unknown space: seconds per metre with `edge`, a plain factor
        /// with `literal`.
        alpha: f64 = 0.25, live, in 0.0..=10.0, "";
        /// Keeps the penalty finite where a prediction says that a cell is surely occupied.
        eps: f64 = 0.01, live, in 0.0001..=1.0, "";
        /// Width of the unknown strip around the map, the start and the goal through which the
        /// search may pass.
        border_m: f64 = 5.0, live, in 0.5..=50.0, "m";
    }
}

/// What the search knows of the ground: a rectangle of cells, everything outside is unknown.
#[derive(Clone, Copy, Debug)]
pub struct Terrain<'a> {
    /// Side of a cell, metres.
    pub resolution_m: f64,
    /// The cells that are stored.
    pub bounds: CellRect,
    /// What is known of them, row by row from `bounds.y0`, each row from `bounds.x0`.
    pub cells: &'a [Cell],
    /// Whether the disc's centre may not be there, because something occupied is closer to the
    /// cell than the disc's radius; same layout.
    pub lethal: &'a [bool],
}

/// Between what a way is wanted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SearchQuery {
    /// Where the car is, map frame, metres.
    pub start: Point,
    /// Where it is to go, map frame, metres.
    pub goal: Point,
    /// A cell centre at most this far from the goal is as good as the goal, metres; zero means
    /// the goal's own cell.
    pub goal_radius_m: f64,
    /// Speed that turns known-free metres into seconds, usually the speed limit, m/s.
    pub v_ref_mps: f64,
    /// Whether the way may lead through unknown cells.
    pub through_unknown: bool,
}

/// The cheapest way over the grid, pulled taut, in points at most one cell apart.
#[derive(Clone, Debug, PartialEq)]
pub struct Guide {
    /// From the start (exactly) to the goal (exactly if its own cell was reached), map frame,
    /// metres.
    pub points: Vec<Point>,
    /// The first point in an unknown cell; the number of points if the whole way is known.
    pub known_until: usize,
    /// Length of the points' polyline, metres.
    pub length_m: f64,
    /// What the search minimised, seconds: travel time at the reference speed, with
    /// [`Penalty::Edge`] plus the penalty for unknown space. Of the grid's path before it is
    /// pulled taut.
    pub cost_s: f64,
    /// How many cells the search expanded; those that it jumped over do not count.
    pub expanded: usize,
    /// For how many unknown cells the view was asked.
    pub asked: usize,
}

/// Asks whether something holds for every index from `first` on in steps of `stride`, in rounds that
/// together ask for each index once: every sixteenth first, then the ones halfway in between, and so
/// on. What fails somewhere fails early. Index 0 comes late: that is where one is.
fn coarse_first(mut holds: impl FnMut(usize, usize) -> bool) -> bool {
    [(8, 16), (4, 8), (0, 16), (2, 4), (1, 2)]
        .into_iter()
        .all(|(first, stride)| holds(first, stride))
}

/// The cell that holds a point.
fn cell_at(p: Point, resolution_m: f64) -> CellIndex {
    CellIndex::new(floor_to_index(p.x / resolution_m), floor_to_index(p.y / resolution_m))
}

#[cfg(test)]
mod tests {
    use super::coarse_first;

    #[test]
    fn coarse_first_asks_for_each_index_once_and_gives_up_where_one_fails() {
        for count in 0..70 {
            let mut asked = Vec::new();
            assert!(coarse_first(|first, stride| {
                asked.extend((first..count).step_by(stride));
                true
            }));
            asked.sort_unstable();
            assert!(asked.into_iter().eq(0..count));
            for bad in 0..count {
                assert!(!coarse_first(|first, stride| (first..count)
                    .step_by(stride)
                    .all(|i| i != bad)));
            }
        }
    }
}
