//! Places where a way to the goal may leave known space, and ways through one of them.

use super::guides::{GuideFailure, Mask};
use super::{Branch, Planner, Policy, Reading};
use crate::map::CellIndex;
use crate::plan::request::{PlanRequest, StepTimes};
use crate::plan::search::{Guide, SearchError, SearchQuery};

/// Exits on the same frontier are this far apart, metres.
const EXIT_SPACING_M: f64 = 0.5;

/// What a guide aims at, all on the way to the goal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Aim {
    /// Nothing else: it goes whichever way is cheapest.
    #[default]
    Anywhere,
    /// To stay in known space.
    Known,
    /// To leave known space at this cell.
    Through(CellIndex),
}

/// Which exits of a frontier are tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sampling {
    /// Its middle.
    Middles,
    /// Its middle and more of them beside it.
    Spread,
}

impl Planner {
    /// The way that the policy proposes from where the new plan takes over.
    pub(super) fn propose(
        &mut self,
        request: &PlanRequest,
        branches: &[Branch],
        times: &mut StepTimes,
        candidates: &mut u32,
    ) -> Result<Guide, GuideFailure> {
        let policy = self.params.plan.policy;
        self.aim = Aim::Anywhere;
        self.hopes = false;
        let via_frontier = self.params.plan.reading == Reading::ViaFrontier;
        let chosen = match policy {
            Policy::Janson | Policy::JansonLite => {
                self.best_weighed(request, branches, times, candidates)
            }
            Policy::MapPredictive if via_frontier => self.cheapest(request, &branches[0], times),
            Policy::MapPredictive | Policy::Frontier | Policy::KnownMap => None,
        };
        if let Some((aim, guide)) = chosen {
            self.aim = aim;
            return Ok(guide);
        }
        self.guide_foreseen(request, &branches[0], Aim::Anywhere, times)
    }

    /// The other reading of the paper's method: the frontier with the least sum of two searches,
    /// unless the goal can be reached through known space for less.
    fn cheapest(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        times: &mut StepTimes,
    ) -> Option<(Aim, Guide)> {
        let ways = self.ways_out(request, here, Sampling::Middles, times);
        // Of equal ones the first.
        ways.into_iter().min_by(|a, b| a.1.cost_s.total_cmp(&b.1.cost_s))
    }

    /// A way to the goal through known space, if there is one, and one through each exit, in the
    /// order of the frontiers.
    pub(super) fn ways_out(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        sampling: Sampling,
        times: &mut StepTimes,
    ) -> Vec<(Aim, Guide)> {
        let exits = self.exits(request, here, sampling);
        let aims = std::iter::once(Aim::Known).chain(exits.into_iter().map(Aim::Through));
        let mut ways = Vec::new();
        for aim in aims {
            if let Ok(guide) = self.guide_foreseen(request, here, aim, times) {
                ways.push((aim, guide));
            }
        }
        ways
    }

    /// Cells from which the disc can leave known space.
    fn exits(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        sampling: Sampling,
    ) -> Vec<CellIndex> {
        let grid = &request.grid;
        let start = grid.cell_at(here.point.position);
        let spacing = EXIT_SPACING_M / grid.resolution_m() - 1e-9;
        let mut exits = Vec::new();
        for frontier in self.frontiers.find(grid, &self.occupied, start, self.keep_m()) {
            let first = exits.len();
            exits.push(frontier.representative);
            if sampling == Sampling::Middles {
                continue;
            }
            for c in frontier.crossings {
                let far = |e: &CellIndex| f64::from(e.ix - c.ix).hypot(f64::from(e.iy - c.iy));
                if exits[first..].iter().all(|e| far(e) >= spacing) {
                    exits.push(c);
                }
            }
        }
        exits
    }

    /// Through known free space to an exit, and from there to the goal through everything that is
    /// not known to be occupied.
    pub(super) fn guide_through(
        &mut self,
        request: &PlanRequest,
        query: SearchQuery,
        exit: CellIndex,
    ) -> Result<Guide, SearchError> {
        let grid = &request.grid;
        let exit = grid.centre(exit);
        let known = SearchQuery { goal: exit, through_unknown: false, ..query };
        let known = self.search(grid, &known, Mask::Lethal)?;
        let beyond = self.search(grid, &SearchQuery { start: exit, ..query }, Mask::Lethal)?;
        Ok(joined(known, beyond))
    }
}

/// Two guides, the second of which starts where the first ends.
fn joined(mut first: Guide, second: Guide) -> Guide {
    if first.known_until == first.points.len() {
        first.known_until += second.known_until - 1;
    }
    first.points.extend_from_slice(&second.points[1..]);
    first.length_m += second.length_m;
    first.cost_s += second.cost_s;
    first.expanded += second.expanded;
    first.asked += second.asked;
    first
}
