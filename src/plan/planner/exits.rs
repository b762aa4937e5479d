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

/// A way to the goal that keeps to an aim.
#[derive(Clone, Debug)]
pub(super) struct WayOut {
    pub(super) aim: Aim,
    pub(super) guide: Guide,
    /// How far the exit may be from the best one that it stands for, metres.
    pub(super) doubt_m: f64,
}

/// An exit that is passed at no more than this is the one of the plan under way, metres: less than
/// half a hallway's width.
const SAME_EXIT_M: f64 = 1.2;

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
        if let Some(WayOut { aim, guide, .. }) = chosen {
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
    ) -> Option<WayOut> {
        let mut ways = self.ways_out(request, here, Sampling::Middles, times);
        let costs: Vec<(usize, f64)> =
            ways.iter().enumerate().map(|(i, way)| (i, way.guide.cost_s)).collect();
        let chosen = self.choose(request, &ways, &costs)?;
        Some(ways.swap_remove(chosen))
    }

    /// The way with the least cost, of equal ones the first. But the plan under way keeps its exit
    /// as long as no other costs less by more than is in doubt: each exit stands for those around
    /// it, and with the car, the map and the exits moving a little at every step, two that are as
    /// good would win by turns.
    pub(super) fn choose(
        &self,
        request: &PlanRequest,
        ways: &[WayOut],
        costs: &[(usize, f64)],
    ) -> Option<usize> {
        let best = costs.iter().min_by(|a, b| a.1.total_cmp(&b.1))?;
        let under_way = costs.iter().filter(|(i, _)| self.is_under_way(request, ways[*i].aim));
        let kept = under_way.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or(best);
        let keeps = kept.1 - best.1 <= self.doubt_s(&ways[kept.0]);
        Some(if keeps { kept.0 } else { best.0 })
    }

    /// The time that an exit may lose on the best one that it stands for.
    pub(super) fn doubt_s(&self, way: &WayOut) -> f64 {
        way.doubt_m / self.params.speed.speed_max_mps
    }

    /// Whether the committed path, as it is imagined to go on, leaves known space through an exit.
    fn is_under_way(&self, request: &PlanRequest, aim: Aim) -> bool {
        let Aim::Through(exit) = aim else { return false };
        let exit = request.grid.centre(exit);
        let plan = &request.committed;
        let from_m = plan.trajectory.at(request.takes_over).path.s_m;
        let path = plan.trajectory.points.iter().map(|p| p.path);
        path.chain(plan.beyond.points.iter().copied())
            .filter(|p| p.s_m > from_m)
            .any(|p| (p.position - exit).norm() <= SAME_EXIT_M)
    }

    /// A way to the goal through known space, if there is one, and one through each exit, in the
    /// order of the frontiers.
    pub(super) fn ways_out(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        sampling: Sampling,
        times: &mut StepTimes,
    ) -> Vec<WayOut> {
        let exits = self.exits(request, here, sampling);
        let exits = exits.into_iter().map(|(exit, doubt_m)| (Aim::Through(exit), doubt_m));
        let mut ways = Vec::new();
        for (aim, doubt_m) in std::iter::once((Aim::Known, 0.0)).chain(exits) {
            if let Ok(guide) = self.guide_foreseen(request, here, aim, times) {
                ways.push(WayOut { aim, guide, doubt_m });
            }
        }
        ways
    }

    /// Cells from which the disc can leave known space, each with its distance from the farthest
    /// one that it stands for, metres.
    fn exits(
        &mut self,
        request: &PlanRequest,
        here: &Branch,
        sampling: Sampling,
    ) -> Vec<(CellIndex, f64)> {
        let grid = &request.grid;
        let start = grid.cell_at(here.point.position);
        let spacing = EXIT_SPACING_M / grid.resolution_m() - 1e-9;
        let mut exits = Vec::new();
        for frontier in self.frontiers.find(grid, &self.occupied, start, self.keep_m()) {
            let middle = frontier.representative;
            let far =
                |a: CellIndex, b: CellIndex| f64::from(a.ix - b.ix).hypot(f64::from(a.iy - b.iy));
            if sampling == Sampling::Middles {
                let reach = frontier.crossings.iter().map(|c| far(*c, middle)).fold(0.0, f64::max);
                exits.push((middle, reach * grid.resolution_m()));
                continue;
            }
            let first = exits.len();
            exits.push((middle, EXIT_SPACING_M));
            for c in frontier.crossings {
                if exits[first..].iter().all(|(e, _)| far(*e, c) >= spacing) {
                    exits.push((c, EXIT_SPACING_M));
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

#[cfg(test)]
#[path = "exits_tests.rs"]
pub(super) mod tests;
