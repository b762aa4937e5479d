//! The way to go, as a polyline: to the goal over known and foreseen map, or to a frontier.

use super::exits::Aim;
use super::{Branch, Planner, Policy, SHAPE_SLACK_M, SHORTEST_PLAN_M};
use crate::frames::Point;
use crate::map::{Clearance, Grid};
use crate::plan::bubbles::ClearanceField;
use crate::plan::foreseen::ShapeField;
use crate::plan::request::{PlanRequest, StepTimes};
use crate::plan::search::{Guide, Penalty, SearchError, SearchParams, SearchQuery, Terrain};

/// How often a guide is sought anew because obstacles are foreseen in its way.
const GUIDES_MAX: usize = 4;

/// Which cells the centre of the disc is kept off.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mask {
    /// Those too near to occupied space, and closed places.
    Lethal,
    /// Those too near to anything that is not known to be free.
    Tight,
}

/// Why there is no guide.
pub(super) enum GuideFailure {
    Unreachable,
    Nothing,
}

impl Planner {
    /// The guide from where the new plan takes over. If there is one, it keeps its distance from
    /// obstacles that are foreseen beside it, as its shape will have to.
    pub(super) fn guide_foreseen(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        aim: Aim,
        times: &mut StepTimes,
    ) -> Result<Guide, GuideFailure> {
        if !self.params.plan.policy.is_predictive() {
            return self.guide(request, branch, aim, times);
        }
        let plan = &request.committed;
        let under_way = plan.trajectory.points.iter().map(|p| p.path);
        let under_way = under_way.chain(plan.beyond.points.iter().copied());
        let ahead = under_way.skip_while(|p| p.s_m < branch.s_m).map(|p| p.position);
        self.look_beside(&request.grid, ahead, times);
        for _ in 0..GUIDES_MAX {
            let was_silent = self.foreseen.is_silent();
            let found = self.guide_round_foreseen(request, branch, aim, times);
            let Ok(guide) = found else {
                if was_silent {
                    return found;
                }
                break;
            };
            self.look_beside(&request.grid, guide.points.iter().copied(), times);
            if self.foreseen.is_silent() || self.clears_foreseen(&guide) {
                return Ok(guide);
            }
        }
        // What is foreseen to be in the way everywhere may not be there.
        self.guide(request, branch, aim, times)
    }

    /// The guide if all obstacles foreseen so far were known.
    fn guide_round_foreseen(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        aim: Aim,
        times: &mut StepTimes,
    ) -> Result<Guide, GuideFailure> {
        if self.foreseen.is_silent() {
            return self.guide(request, branch, aim, times);
        }
        let known = self.lethal.clone();
        let least_m = self.mask_radius_m(&request.grid) as f32;
        self.foreseen.mask(&request.grid, least_m, &mut self.lethal);
        let found = self.guide(request, branch, aim, times);
        self.lethal = known;
        found
    }

    /// Whether a guide keeps off what is foreseen, up to a cell's size.
    fn clears_foreseen(&self, guide: &Guide) -> bool {
        let walls = self.foreseen.occupied();
        let least_m = 0.8 * self.keep_m();
        guide.points.iter().skip(1).all(|p| walls.reaches(*p, least_m))
    }

    /// Takes in what is foreseen beside a way.
    fn look_beside(
        &mut self,
        grid: &Grid,
        way: impl Iterator<Item = Point>,
        times: &mut StepTimes,
    ) {
        let part = self.own_lap();
        let mut view = self.predictor.view(&self.clock);
        let horizon_m = self.params.smooth.horizon_m;
        self.foreseen.look(&self.relied_on, grid, way, horizon_m, &mut view);
        times.field += self.own_time(part);
    }

    /// The guide from a branch point over the map as it is masked now.
    pub(super) fn guide(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        aim: Aim,
        times: &mut StepTimes,
    ) -> Result<Guide, GuideFailure> {
        let query = SearchQuery {
            start: branch.point.position,
            goal: request.goal.position,
            goal_radius_m: 0.0,
            v_ref_mps: self.params.speed.speed_max_mps.min(request.speed_cap_mps),
            through_unknown: true,
        };
        let part = self.own_lap();
        let found = match (aim, self.params.plan.policy) {
            (Aim::Anywhere, Policy::Frontier) => self.naive_guide(request, query),
            (Aim::Anywhere, _) => {
                let known = request.through_known.then(|| {
                    let query = SearchQuery { through_unknown: false, ..query };
                    self.search(&request.grid, &query, Mask::Tight).ok()
                });
                known.flatten().map_or_else(|| self.search(&request.grid, &query, Mask::Lethal), Ok)
            }
            (Aim::Known, _) => {
                let query = SearchQuery { through_unknown: false, ..query };
                self.search(&request.grid, &query, Mask::Lethal)
            }
            (Aim::Through(exit), _) => self.guide_through(request, query, exit),
        };
        times.search += self.own_time(part);
        let mut guide = found.map_err(|error| match error {
            SearchError::Unreachable { .. } | SearchError::GoalBlocked { .. }
                if aim == Aim::Anywhere && self.params.plan.policy != Policy::Frontier =>
            {
                GuideFailure::Unreachable
            }
            _ => GuideFailure::Nothing,
        })?;
        self.keep_off_walls(&request.grid, &mut guide);
        Ok(guide)
    }

    /// One search over the known map and what the predictor says of the rest.
    pub(super) fn search(
        &mut self,
        grid: &Grid,
        query: &SearchQuery,
        mask: Mask,
    ) -> Result<Guide, SearchError> {
        let lethal = match mask {
            Mask::Lethal => &self.lethal,
            Mask::Tight => &self.tight,
        };
        let terrain = Terrain {
            resolution_m: grid.resolution_m(),
            bounds: grid.bounds(),
            cells: grid.cells(),
            lethal,
        };
        let mut params = self.params.search.clone();
        if self.hopes {
            params = SearchParams { penalty: Penalty::Edge, alpha: 0.0, ..params };
        }
        let mut view = self.predictor.view(&self.clock);
        self.guide.find(&terrain, query, &mut view, &params)
    }

    /// Moves the guide's points that are nearer to a wall than shapes may be, by the part of a cell
    /// that is missing: cell centres are as near as the certificate allows at the least, and where
    /// shapes and manoeuvres ask for a little more, a way along a wall would lead nowhere.
    fn keep_off_walls(&self, grid: &Grid, guide: &mut Guide) {
        const SPARE_M: f64 = 0.02;
        let keep_m = self.keep_m() + SHAPE_SLACK_M;
        let field = ShapeField {
            occupied: Clearance::new(grid, &self.occupied),
            blocked: Clearance::new(grid, &self.blocked),
            keep_m,
            unknown_room_m: self.params.plan.unknown_room_m,
            wall_room_m: 0.0,
        };
        for p in guide.points.iter_mut().skip(1) {
            let clearance_m = field.clearance_m(*p);
            if clearance_m < keep_m + SPARE_M {
                let moved = *p + field.away(*p) * (keep_m + SPARE_M - clearance_m);
                if field.clearance_m(moved) > clearance_m {
                    *p = moved;
                }
            }
        }
    }

    /// The naive baseline: to the goal, or to the frontier whose centroid is nearest to it, through
    /// known space alone.
    fn naive_guide(
        &mut self,
        request: &PlanRequest,
        query: SearchQuery,
    ) -> Result<Guide, SearchError> {
        let grid = &request.grid;
        let mut query = SearchQuery { through_unknown: false, ..query };
        let found = self.search(grid, &query, Mask::Tight);
        if !matches!(found, Err(SearchError::Unreachable { .. } | SearchError::GoalBlocked { .. }))
        {
            return found;
        }
        let start = grid.cell_at(query.start);
        let mut frontiers = self.frontiers.find(grid, &self.occupied, start, self.keep_m());
        let to_goal = |p: Point| (p - request.goal.position).norm();
        frontiers.sort_by(|a, b| to_goal(a.centroid).total_cmp(&to_goal(b.centroid)));
        let mut last = SearchError::Unreachable { expanded: 0 };
        for frontier in &frontiers {
            query.goal = grid.centre(frontier.representative);
            // The disc cannot stand on the frontier itself.
            query.goal_radius_m = self.keep_m() + 2.0 * grid.resolution_m();
            match self.search(grid, &query, Mask::Tight) {
                Ok(guide) if guide.length_m > SHORTEST_PLAN_M => return Ok(guide),
                Ok(_) => {}
                Err(error) => last = error,
            }
        }
        Err(last)
    }
}
