//! What the planner foresaw at one moment, for pictures.

use std::sync::Arc;

use crate::frames::{Point, Pose};
use crate::map::{Cell, CellIndex, CellRect, Grid};
use crate::plan::{PlanRequest, Planning, StepReport, Verdict};

/// The known map, the prediction and the plan of one planning step.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// Seconds since the first motion.
    pub t_s: f64,
    /// Where the car was by its own estimate, map frame.
    pub pose: Pose,
    /// What it knew.
    pub grid: Arc<Grid>,
    /// The cells around the car that are shown.
    pub window: CellRect,
    /// For each cell of the window, row by row from the lowest one, the probability that it is
    /// occupied: 0 or 1 where that is known.
    pub occupied: Vec<f32>,
    /// The plan that the step led to, up to its end in known space, map frame.
    pub path: Vec<Point>,
    /// How it was imagined to go on.
    pub beyond: Vec<Point>,
}

/// The window reaches this far from the car, metres: half of what a network sees.
const REACH_M: f64 = 13.0;
/// So many are kept at most; then every other one goes.
const KEPT_MAX: usize = 16;

impl Snapshot {
    fn take(
        t_s: f64,
        request: &PlanRequest,
        report: &StepReport,
        planner: &mut dyn Planning,
    ) -> Option<Self> {
        let grid = &request.grid;
        let centre = grid.cell_at(request.scan_pose.position);
        let reach = (REACH_M / grid.resolution_m()).round() as i32;
        let window =
            CellRect { x0: centre.ix, y0: centre.iy, x1: centre.ix + 1, y1: centre.iy + 1 }
                .grown(reach);
        let mut occupied = Vec::with_capacity(window.width() * window.height());
        let (mut places, mut points) = (Vec::new(), Vec::new());
        for iy in window.y0..window.y1 {
            for ix in window.x0..window.x1 {
                let cell = CellIndex::new(ix, iy);
                let known = match grid.get(cell) {
                    Cell::Free => 0.0,
                    Cell::Occupied => 1.0,
                    Cell::Unknown => {
                        places.push(occupied.len());
                        points.push(grid.centre(cell));
                        0.5
                    }
                };
                occupied.push(known);
            }
        }
        let mut answers = vec![0.5; points.len()];
        planner.view()?.occupied(&points, &mut answers);
        for (place, answer) in places.into_iter().zip(answers) {
            occupied[place] = answer;
        }
        let plan = match &report.verdict {
            Verdict::Plan(plan) => plan,
            _ => &*request.committed,
        };
        Some(Self {
            t_s,
            pose: request.scan_pose,
            grid: Arc::clone(grid),
            window,
            occupied,
            path: plan.trajectory.points.iter().map(|p| p.path.position).collect(),
            beyond: plan.beyond.points.iter().map(|p| p.position).collect(),
        })
    }
}

/// Takes snapshots during a drive, so that one can be chosen at its end.
#[derive(Debug)]
pub(super) struct Album {
    wanted_s: Option<f64>,
    every_s: f64,
    next_s: f64,
    kept: Vec<Snapshot>,
}

impl Album {
    /// For a snapshot at a time of the drive, seconds from the first motion, or halfway.
    pub(super) const fn new(wanted_s: Option<f64>) -> Self {
        Self { wanted_s, every_s: 0.5, next_s: 0.0, kept: Vec::new() }
    }

    /// Another planning step is done.
    pub(super) fn step(
        &mut self,
        t_s: f64,
        request: &PlanRequest,
        report: &StepReport,
        planner: &mut dyn Planning,
    ) {
        // The last one kept is too early as long as the time wanted has not come.
        let passed = self.wanted_s.is_some_and(|wanted| {
            t_s >= wanted && self.kept.last().is_none_or(|last| last.t_s < wanted)
        });
        if t_s < self.next_s && !passed {
            return;
        }
        self.next_s = t_s + self.every_s;
        self.kept.extend(Snapshot::take(t_s, request, report, planner));
        if self.kept.len() > KEPT_MAX {
            let wanted = self.wanted_s.unwrap_or(f64::INFINITY);
            let near = |snapshot: &Snapshot| (snapshot.t_s - wanted).abs() < 0.5;
            let mut odd = false;
            self.kept.retain(|snapshot| {
                odd = !odd;
                odd || near(snapshot)
            });
            self.every_s *= 2.0;
        }
    }

    /// Those that are kept so far, in order.
    pub(super) fn kept(&self) -> &[Snapshot] {
        &self.kept
    }

    /// The snapshot nearest to the time wanted, or to half of the drive's duration.
    pub(super) fn chosen(&self, duration_s: f64) -> Option<&Snapshot> {
        let wanted_s = self.wanted_s.unwrap_or(0.5 * duration_s);
        let away = |snapshot: &&Snapshot| (snapshot.t_s - wanted_s).abs();
        self.kept.iter().min_by(|a, b| away(a).total_cmp(&away(b)))
    }
}
