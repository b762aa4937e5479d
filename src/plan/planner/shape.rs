//! The shape of a plan: a way with a start that the car can drive, smoothed.

use super::lap::Lap;
use super::ways::{Way, join, with_transitions};
use super::{Branch, Planner, Policy, SHAPE_SLACK_M};
use crate::frames::Point;
use crate::map::{Clearance, Grid};
use crate::plan::Path;
use crate::plan::certify::Surfaces;
use crate::plan::foreseen::ShapeField;
use crate::plan::request::{PlanRequest, Rejection, StepTimes};
use crate::plan::search::{Guide, ManoeuvreQuery, Room};
use crate::plan::smooth::SmoothRequest;

/// A shape ends no nearer than this where nothing is known or foreseen, metres.
const FORESEEN_LEAST_M: f64 = 4.0;

/// How tightly a shape may bend where the car is still too fast for the tightest turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bends {
    /// As the committed path at the same place.
    AsCommitted,
    /// As the speed that is left there under braking allows.
    AsSpeedAllows,
}

/// A path from the take-over on.
pub(super) struct Candidate {
    pub(super) path: Path,
    pub(super) reaches_goal: bool,
    /// Length of the way beyond the path's end, metres.
    pub(super) rest_m: f64,
}

impl Planner {
    /// The guide with a start that the car can drive.
    pub(super) fn with_manoeuvre(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        guide: &Guide,
        times: &mut StepTimes,
    ) -> Result<Way, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let vehicle = &self.params.vehicle;
        let query = ManoeuvreQuery {
            pose: branch.pose(),
            speed_mps: branch.speed_mps,
            guide,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: vehicle.acceleration_limit_mps2(),
        };
        let reaches_goal = self.reaches_goal(request, guide);
        let mut search = std::mem::take(&mut self.manoeuvre);
        let room = self.room(&request.grid, self.not_seen(), SHAPE_SLACK_M);
        let found = search.find(&room, &query, &self.params.manoeuvre);
        self.manoeuvre = search;
        times.manoeuvre += lap.take(&self.clock);
        match found {
            Ok(None) => Ok(Way::along(guide.points.clone(), false, reaches_goal)),
            Ok(Some(manoeuvre)) => {
                let mut points: Vec<Point> =
                    manoeuvre.path.points.iter().map(|p| p.position).collect();
                let mut beyond_m = manoeuvre.left_m;
                if let Some(joined) = manoeuvre.joins_at {
                    points.extend_from_slice(&guide.points[joined + 1..]);
                    beyond_m = 0.0;
                }
                let reaches_goal = reaches_goal && manoeuvre.joins_at.is_some();
                let manoeuvre = Some(with_transitions(&manoeuvre.path));
                Ok(Way { points, beyond_m, warm: false, manoeuvre, reaches_goal })
            }
            Err(none) => Err(Rejection::Shape(none.to_string())),
        }
    }

    /// What stops and manoeuvres keep clear of. Up to the last quarter of a cell once shapes have been
    /// fitted into what is foreseen: they lie right before the view opens. Not before, since a car that
    /// drives on to the edge of what it sees is too fast for what comes into view; and for good, since
    /// what a stop promises must be found again.
    pub(super) fn not_seen(&self) -> Surfaces {
        if self.foreseen.has_spoken() { Surfaces::Unseen } else { Surfaces::OccupiedAndUnknown }
    }

    /// Where the car keeps clear of these, with `spare_m` beyond what the certificate asks for.
    pub(super) fn room<'a>(
        &'a self,
        grid: &'a Grid,
        surfaces: Surfaces,
        spare_m: f64,
    ) -> ClearRoom<'a> {
        let field = match surfaces {
            Surfaces::Occupied => &self.occupied,
            Surfaces::OccupiedAndUnknown | Surfaces::Unseen => &self.blocked,
        };
        ClearRoom {
            clearance: Clearance::new(grid, field),
            keep_m: self.keep_m() + spare_m,
            by_quarters: surfaces == Surfaces::Unseen,
        }
    }

    pub(super) fn reaches_goal(&self, request: &PlanRequest, guide: &Guide) -> bool {
        self.params.plan.policy != Policy::Frontier
            || guide
                .points
                .last()
                .is_some_and(|p| (p - request.goal.position).norm() <= request.goal.radius_m)
    }

    /// The way smoothed from the branch point on, with the committed path up to there.
    pub(super) fn shaped(
        &mut self,
        request: &PlanRequest,
        branch: &Branch,
        way: Way,
        bends: Bends,
        times: &mut StepTimes,
    ) -> Result<Candidate, Rejection> {
        let mut lap = Lap::new(&self.clock);
        let keep_m = self.keep_m() + SHAPE_SLACK_M;
        let vehicle = &self.params.vehicle;
        // A car that stands may turn its wheels before it goes; what is joined to the committed path
        // must continue its curvature.
        let takes_over_m = request.committed.trajectory.at(request.takes_over).path.s_m;
        let moving = branch.speed_mps > 0.0 || branch.s_m > takes_over_m;
        let mut smooth = self.params.smooth.clone();
        if !self.foreseen.is_silent() {
            // Beyond what is foreseen the guide keeps no distance from anything.
            let mut along_m = 0.0;
            let open = way.points.windows(2).find(|pair| {
                along_m += (pair[1] - pair[0]).norm();
                along_m > FORESEEN_LEAST_M && self.foreseen.is_open(pair[1])
            });
            if open.is_some() {
                smooth.horizon_m = smooth.horizon_m.min(along_m);
            }
        }
        let end_radius_m = if way.reaches_goal {
            (request.goal.radius_m - self.params.plan.goal_depth_m).max(0.0)
        } else {
            0.0
        };
        let held: Vec<(f64, f64)> = match bends {
            Bends::AsSpeedAllows => Vec::new(),
            Bends::AsCommitted => {
                let committed = request.committed.trajectory.points.iter().map(|p| p.path);
                let ahead = committed.filter(|p| p.s_m >= branch.s_m - 0.1);
                ahead.map(|p| (p.s_m - branch.s_m, p.curvature_pm)).collect()
            }
        };
        let task = SmoothRequest {
            guide: &way.points,
            warm: way.warm,
            start: branch.pose(),
            start_curvature_pm: moving.then_some(branch.point.curvature_pm),
            held: &held,
            start_speed_mps: branch.speed_mps,
            end_radius_m,
            radius_m: keep_m,
            curvature_limit_pm: vehicle.curvature_limit_pm(),
            acceleration_limit_mps2: self.params.speed.friction_use
                * vehicle.acceleration_limit_mps2(),
            speed_max_mps: self.params.speed.speed_max_mps,
        };
        let field = |occupied, blocked, wall_room_m| ShapeField {
            occupied,
            blocked,
            keep_m,
            unknown_room_m: self.params.plan.unknown_room_m,
            wall_room_m,
        };
        let foreseen = (!self.foreseen.is_silent()).then(|| {
            let wall_room_m = self.params.plan.wall_room_m;
            let field = field(self.foreseen.occupied(), self.foreseen.blocked(), wall_room_m);
            self.smoother.smooth(&smooth, &field, &task)
        });
        // What is foreseen may be wrong. Where nothing is, what lies unseen behind a corner keeps
        // shapes off it already.
        let smoothed = foreseen.and_then(Result::ok).map_or_else(
            || {
                let occupied = Clearance::new(&request.grid, &self.occupied);
                let blocked = Clearance::new(&request.grid, &self.blocked);
                let field = field(occupied, blocked, 0.0);
                self.smoother.smooth(&self.params.smooth, &field, &task)
            },
            Ok,
        );
        let (mut path, complete) = match (smoothed, way.manoeuvre) {
            (Ok(smoothed), _) => (smoothed.path, smoothed.complete),
            // The manoeuvre can be driven as it is.
            (Err(_), Some(manoeuvre)) => (manoeuvre, false),
            (Err(error), None) => {
                times.smooth += lap.take(&self.clock);
                return Err(Rejection::Shape(error.to_string()));
            }
        };
        let way_m: f64 = way.points.windows(2).map(|w| (w[1] - w[0]).norm()).sum();
        let rest_m = (way_m - path.length_m()).max(0.0) + way.beyond_m;
        let committed = &request.committed.trajectory;
        let takes_over = committed.at(request.takes_over).path;
        if branch.s_m > takes_over.s_m {
            path = join(committed, takes_over, branch, &path);
        }
        let reaches_goal = complete && way.reaches_goal && self.end_at_goal(request, &mut path);
        times.smooth += lap.take(&self.clock);
        Ok(Candidate { path, reaches_goal, rest_m })
    }
}

/// Room for the car's disc and what the certificate adds.
pub(super) struct ClearRoom<'a> {
    clearance: Clearance<'a>,
    keep_m: f64,
    /// Quarters of cells that have been seen count as well.
    by_quarters: bool,
}

impl Room for ClearRoom<'_> {
    fn fits(&self, centre: Point) -> bool {
        self.clearance.reaches(centre, self.keep_m)
            || (self.by_quarters && self.clearance.is_seen_around(centre, self.keep_m))
    }
}
