//! What is to be smoothed: the guide, or the path that is being driven as far as the guide still
//! goes the same way; and how paths are cut and joined.

use super::shape::Candidate;
use super::{Branch, Planner, SHORTEST_EDGE_M, SHORTEST_PLAN_M};
use crate::frames::{Point, Pose};
use crate::map::Clearance;
use crate::plan::request::PlanRequest;
use crate::plan::search::Guide;
use crate::plan::{Path, PathPoint, Trajectory};

/// A new path changes over from the committed one to the guide within this, metres and seconds.
const BLEND_LEAST_M: f64 = 1.5;
const BLEND_S: f64 = 0.8;
/// Walls thinner than this may be looked through when ways are compared, metres.
const SIGHT_M: f64 = 0.05;
/// An old path shorter than this says nothing about the way, metres.
const OLD_WAY_LEAST_M: f64 = 0.3;
/// With this much of it left, the old path need not lead on to be driven further, metres.
const PLENTY_M: f64 = 8.0;

/// What is to be smoothed.
pub(super) struct Way {
    pub(super) points: Vec<Point>,
    /// Length of the way beyond the last point, metres.
    pub(super) beyond_m: f64,
    /// The points are an earlier shape.
    pub(super) warm: bool,
    /// The drivable start, in case smoothing finds nothing.
    pub(super) manoeuvre: Option<Path>,
    pub(super) reaches_goal: bool,
}

impl Way {
    /// A way that its points lead along to its end.
    pub(super) const fn along(points: Vec<Point>, warm: bool, reaches_goal: bool) -> Self {
        Self { points, beyond_m: 0.0, warm, manoeuvre: None, reaches_goal }
    }
}

/// The path that is being driven, with its imagined part.
pub(super) struct OldWay {
    pub(super) candidate: Candidate,
    /// The guide goes the same way at first, and there is more of the old path than its
    /// executable part.
    pub(super) agrees: bool,
    /// How far the guide goes the same way, if it does so for more than the first metres.
    pub(super) follows: Option<Fork>,
}

/// Where a guide leaves a path.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Fork {
    /// The last point of the guide that is near the path.
    pub(super) guide: usize,
    /// A line that leads from the path over to the guide up to there.
    pub(super) blend: Vec<Point>,
    /// If the guide stays near the whole path: its first point beyond the path's end.
    pub(super) whole: Option<usize>,
}

impl Planner {
    /// The committed path carried on into its imagined part, from the take-over on, and whether
    /// the guide still goes the same way.
    pub(super) fn old_way(&self, request: &PlanRequest, guide: &Guide) -> Option<OldWay> {
        let plan = &request.committed;
        let start = plan.trajectory.at(request.takes_over).path;
        let stop = plan.trajectory.last().path;
        let known = plan.trajectory.points.iter().map(|p| p.path);
        let mut path = rest_of(known.chain(plan.beyond.points.iter().copied()), start)?;
        let clearance = Clearance::new(&request.grid, &self.occupied);
        // What has turned out to be in the way since.
        let keep_m = self.keep_m();
        let blocked = path.points.iter().position(|p| !clearance.reaches(p.position, keep_m));
        if let Some(first) = blocked {
            path.points.truncate(first);
        }
        let length_m = path.length_m();
        if path.points.len() < 2 || length_m < OLD_WAY_LEAST_M {
            return None;
        }
        let blend_m = BLEND_LEAST_M + BLEND_S * plan.trajectory.at(request.takes_over).speed_mps;
        let sees = |a, b| clearance.segment(a, b, SIGHT_M) > 0.0;
        let follows = same_way(&path, &guide.points, blend_m, sees);
        let reaches_goal = blocked.is_none()
            && path.points.last().is_some_and(|p| {
                (p.position - request.goal.position).norm() <= request.goal.radius_m
            });
        let leads_on = length_m > (stop.s_m - start.s_m + SHORTEST_PLAN_M).min(PLENTY_M);
        let rest_m = (guide.length_m - length_m).max(0.0);
        let candidate = Candidate { path, reaches_goal, rest_m };
        let agrees = follows.is_some() && (leads_on || reaches_goal);
        Some(OldWay { candidate, agrees, follows })
    }

    /// The way for a car that is headed along the guide: the old path where that is still right
    /// (smoothing then starts from a shape that is already good), the guide otherwise.
    pub(super) fn straight_on(
        &self,
        request: &PlanRequest,
        guide: &Guide,
        old: Option<&OldWay>,
    ) -> Way {
        let reaches_goal = self.reaches_goal(request, guide);
        match old {
            // All the way as before, through known space: the old shape, and the guide beyond its
            // end. In unknown space the shape has to change with what is seen.
            Some(OldWay { candidate, follows: Some(Fork { whole: Some(next), .. }), .. })
                if guide.known_until >= *next =>
            {
                let old = candidate.path.points.iter().step_by(2);
                let mut points: Vec<Point> = old.map(|p| p.position).collect();
                points.extend_from_slice(&guide.points[*next..]);
                Way::along(points, true, reaches_goal)
            }
            Some(OldWay { follows: Some(fork), .. }) => {
                let mut points = fork.blend.clone();
                points.extend_from_slice(&guide.points[fork.guide + 1..]);
                Way::along(points, false, reaches_goal)
            }
            _ => Way::along(guide.points.clone(), false, reaches_goal),
        }
    }
}

/// Whether the guide starts out in another direction than the car.
pub(super) fn leaves_heading(pose: Pose, guide: &Guide, skip_turn_rad: f64) -> bool {
    aside_rad(pose, guide).is_some_and(|aside_rad| aside_rad > skip_turn_rad)
}

/// How far to the side of a pose's heading the guide goes on from there, radians. `None` where it
/// ends too near to tell.
pub(super) fn aside_rad(pose: Pose, guide: &Guide) -> Option<f64> {
    const LOOK_M: f64 = 1.0;
    const TOO_NEAR_M: f64 = 0.3;
    let from = |p: &Point| (p - pose.position).norm();
    let nearest = (0..guide.points.len())
        .min_by(|a, b| from(&guide.points[*a]).total_cmp(&from(&guide.points[*b])))?;
    let rest = &guide.points[nearest..];
    let ahead = rest.iter().find(|p| from(p) >= LOOK_M).or(rest.last());
    ahead.filter(|p| from(p) >= TOO_NEAR_M).map(|p| {
        let body = pose.to_body(*p);
        body.y.atan2(body.x).abs()
    })
}

/// How far a guide goes the same way as a path from the same start: within one hallway's width, and
/// nothing in between (`sees`). `None` if they part within the first metres. The blend changes over
/// from the path to the guide within `blend_m`.
fn same_way(
    path: &Path,
    guide: &[Point],
    blend_m: f64,
    sees: impl Fn(Point, Point) -> bool,
) -> Option<Fork> {
    /// Guides are polylines pulled taut around corners, paths swing wide.
    const APART_M: f64 = 1.2;
    const AGREE_M: f64 = 2.0;
    const LOOK_EVERY_M: f64 = 0.25;
    let points = &path.points;
    let mut at = 0;
    let (mut along_m, mut looked_m) = (0.0, 0.0);
    let mut fork = Fork { guide: 0, blend: vec![points[0].position], whole: None };
    let mut blending = true;
    for (i, p) in guide.iter().enumerate().skip(1) {
        along_m += (p - guide[i - 1]).norm();
        if along_m < looked_m + LOOK_EVERY_M && i + 1 < guide.len() {
            continue;
        }
        looked_m = along_m;
        let distance = |k: usize| (points[k].position - p).norm_squared();
        // The nearest point of the path, never going back, looking a metre or two ahead.
        let window = at..points.len().min(at + 40);
        at = window.min_by(|a, b| distance(*a).total_cmp(&distance(*b))).unwrap_or(at);
        if distance(at) > APART_M * APART_M || !sees(points[at].position, *p) {
            return (along_m > AGREE_M).then_some(fork);
        }
        if blending {
            fork.guide = i;
            let share = (along_m / blend_m).min(1.0);
            let blended = points[at].position + (p - points[at].position) * share;
            if fork.blend.last().is_none_or(|last| (blended - last).norm() > 0.1) {
                fork.blend.push(blended);
            }
            blending = share < 1.0;
        }
        if at + 1 == points.len() {
            fork.whole = Some(i);
            return Some(fork);
        }
    }
    fork.whole = Some(guide.len());
    Some(fork)
}

/// The part of a path from a point on it on, arc length from zero; `None` if nothing is left.
fn rest_of(points: impl Iterator<Item = PathPoint>, from: PathPoint) -> Option<Path> {
    let mut rest = vec![PathPoint { s_m: 0.0, ..from }];
    rest.extend(
        points
            .filter(|p| p.s_m > from.s_m + SHORTEST_EDGE_M)
            .map(|p| PathPoint { s_m: p.s_m - from.s_m, ..p }),
    );
    (rest.len() > 1).then_some(Path { points: rest })
}

/// The committed path from `from` to the branch point, then `path`; arc length from zero. Where the
/// two do not bend alike there (a manoeuvre as it was found), the curvature changes linearly over
/// two millimetres.
pub(super) fn join(committed: &Trajectory, from: PathPoint, branch: &Branch, path: &Path) -> Path {
    const HALF_M: f64 = 1e-3;
    const ALIKE_PM: f64 = 1e-3;
    let first = path.points[0];
    let alike = (first.curvature_pm - branch.point.curvature_pm).abs() < ALIKE_PM;
    let gap_m = if alike { 0.0 } else { HALF_M };
    let before = committed.points.iter().map(|p| p.path);
    let before = before.filter(|p| p.s_m < branch.s_m - gap_m - SHORTEST_EDGE_M);
    let mut joined = rest_of(before, from)
        .unwrap_or_else(|| Path { points: vec![PathPoint { s_m: 0.0, ..from }] });
    let length_m = branch.s_m - from.s_m;
    let mut points = path.points.iter();
    if !alike && length_m > gap_m + SHORTEST_EDGE_M {
        let last = committed.at_distance(branch.s_m - gap_m).path;
        joined.points.push(PathPoint { s_m: length_m - gap_m, ..last });
        points.next();
        let turn = Pose { position: first.position, heading_rad: first.heading_rad };
        let turn = turn.along_arc(gap_m, first.curvature_pm * gap_m);
        joined.points.push(PathPoint {
            s_m: length_m + gap_m,
            position: turn.position,
            heading_rad: turn.heading_rad,
            curvature_pm: first.curvature_pm,
        });
    }
    let beyond = points.filter(|p| alike || p.s_m > gap_m + SHORTEST_EDGE_M);
    joined.points.extend(beyond.map(|p| PathPoint { s_m: p.s_m + length_m, ..*p }));
    joined
}

/// Arcs of constant curvature, each sample with the curvature of the piece that follows it, as a
/// path whose curvature changes linearly over two millimetres where pieces meet.
pub(super) fn with_transitions(arcs: &Path) -> Path {
    const HALF_M: f64 = 1e-3;
    let step = |p: &PathPoint, ds: f64, curvature_pm: f64| {
        let pose = Pose { position: p.position, heading_rad: p.heading_rad };
        let moved = pose.along_arc(ds, ds * curvature_pm);
        PathPoint {
            s_m: p.s_m + ds,
            position: moved.position,
            heading_rad: moved.heading_rad,
            curvature_pm,
        }
    };
    let points = &arcs.points;
    let mut path = Path::default();
    for (i, p) in points.iter().enumerate() {
        let before = if i > 0 { points[i - 1].curvature_pm } else { p.curvature_pm };
        let last = i + 1 == points.len();
        if last || before == p.curvature_pm {
            path.points.push(PathPoint { curvature_pm: before, ..*p });
        } else {
            path.points.push(step(p, -HALF_M, before));
            path.points.push(step(p, HALF_M, p.curvature_pm));
        }
    }
    path
}
