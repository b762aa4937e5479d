//! Looks at a drive after every simulated millisecond.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use apexd::autopilot::{Event, Fault, Mode};
use apexd::control::ControlParams;
use apexd::frames::{Pose, Vector, heading_vector, wrap_angle};
use apexd::map::{Cell, CellIndex, Grid};
use apexd::plan::certify::CertifyParams;
use apexd::plan::{Plan, PlanRequest, StepReport, Trajectory, Verdict};
use apexd::sim::car::CarState;
use apexd::sim::drive::Outcome;
use apexd::sim::rig::Rig;
use apexd::time::Instant;
use apexd::vehicle::VehicleParams;

use super::findings::Findings;
use super::geometry::least_clearance_m;
use super::instants::{self, Worst};
use super::plans::{self, Limits};
use super::trial::Trial;

/// A car slower than this counts as standing, m/s.
const STANDING_MPS: f64 = 0.02;
/// The core's estimate of a braking car's speed may be one odometry frame and its way ahead: what
/// it takes for standing may still move this fast, m/s, and stops within a millimetre.
const ABOUT_TO_STAND_MPS: f64 = 0.12;
/// Where one plan takes over from another they agree to this, metres and m/s: the sample nearest to
/// the seam is left out. (At the planning step the agreement is exact.)
const SEAM: f64 = 1e-3;
/// Beams looked at in a scan: every so many.
const BEAM_STRIDE: usize = 27;

/// Watches one drive.
pub struct Watch {
    pub findings: Findings,
    pub worst: Worst,
    /// What the core said, and when.
    pub events: Vec<(Instant, Event)>,
    limits: Limits,
    scan_period_s: f64,
    latency_s: f64,
    steps: u64,
    state: Option<CarState>,
    velocity: Option<Vector>,
    /// True poses of the last second, newest last.
    poses: VecDeque<Pose>,
    known: Option<Arc<Grid>>,
    scans: u64,
    /// Trajectories that may be driven, by number, and how many steps had given none until then.
    certified: BTreeMap<u32, (Trajectory, u32)>,
    driven: Option<Arc<Plan>>,
    /// Planning steps that gave no plan.
    misses: u32,
    /// Whether anything but walls of the beginning stands in the world.
    static_world: bool,
    /// Whether the setpoints and sensors get through.
    sound_bus: bool,
}

impl Watch {
    pub fn new(trial: &Trial) -> Self {
        let vehicle = VehicleParams::default();
        let margin_m = CertifyParams::default().margin_m;
        Self {
            findings: Findings::default(),
            worst: Worst::default(),
            events: Vec::new(),
            limits: Limits {
                radius_m: vehicle.radius_m,
                certified_m: vehicle.radius_m + margin_m,
                curvature_max_pm: 1.0 / vehicle.turn_radius_m,
                accel_mps2: vehicle.friction * 9.81,
                speed_max_mps: trial.speed_mps,
            },
            scan_period_s: 1.0 / trial.lidar_hz,
            latency_s: trial.latency_s,
            steps: 0,
            state: None,
            velocity: None,
            poses: VecDeque::new(),
            known: None,
            scans: 0,
            certified: BTreeMap::new(),
            driven: None,
            misses: 0,
            static_world: true,
            sound_bus: trial.faults.frames.is_empty() && trial.faults.cuts.is_empty(),
        }
    }

    /// Begins in the middle of a drive: what was planned before counts as seen.
    pub fn join(&mut self, rig: &mut Rig) {
        while rig.poll_event().is_some() {}
        for (_, report) in rig.take_reports() {
            if let Verdict::Plan(plan) = report.verdict {
                self.certified.insert(plan.number, (plan.trajectory, self.misses));
            }
        }
    }

    /// From now on things may stand where free space was seen.
    pub fn world_changes(&mut self) {
        self.static_world = false;
    }

    /// Looks at what has happened since the last millisecond.
    pub fn look(&mut self, rig: &mut Rig) {
        self.steps += 1;
        while let Some(event) = rig.poll_event() {
            self.events.push((rig.now(), event));
        }
        for (request, report) in rig.take_reports() {
            self.look_at_step(rig, &request, &report);
        }
        self.look_at_driven(rig);
        self.look_at_motion(rig);
        if self.static_world && self.sound_bus {
            self.look_at_scan(rig);
        }
    }

    /// After the drive: how it ended and how far it went (R1, R4).
    pub fn look_back(&mut self, rig: &Rig, trial: &Trial) {
        let outcome = rig.outcome();
        let fine = [Outcome::Goal, Outcome::Stuck, Outcome::Timeout].map(Some).contains(&outcome);
        self.findings.check(fine, "R1", || format!("ended in {outcome:?}"));
        let judge = rig.judge();
        self.findings.check(judge.collisions() == 0, "I1", || "the judge saw a contact".into());
        self.findings.check(judge.unknown_entries() == 0, "I2", || {
            format!("the judge saw {} unknown entries", judge.unknown_entries())
        });
        if outcome == Some(Outcome::Goal) {
            // A disc smaller by half a cell's diagonal finds every way on the raster that the car
            // has; straight and diagonal steps make it up to 8.3 per cent longer.
            let radius_m = self.limits.radius_m - 0.071;
            let raster = trial.world.path_length_m(trial.start.position, trial.goal, radius_m);
            let least = raster.map_or(f64::INFINITY, |length| length / 1.083 - 0.5 - 0.1);
            let driven = rig.distance_m();
            self.findings.check(driven >= least, "R4", || {
                format!("{driven:.2} m driven, no way is shorter than {least:.2} m")
            });
        }
    }

    /// P1 to P14 at a planning step.
    fn look_at_step(&mut self, rig: &Rig, request: &PlanRequest, report: &StepReport) {
        self.look_at_knowledge(rig, request);
        match &report.verdict {
            Verdict::Plan(plan) => {
                self.findings.extend(plans::inspect(request, plan, &self.limits));
                self.certified.insert(plan.number, (plan.trajectory.clone(), self.misses));
                while self.certified.len() > 64 {
                    self.certified.pop_first();
                }
            }
            Verdict::Keep | Verdict::Rejected(_) | Verdict::Unreachable => self.misses += 1,
        }
        // The old plan is what is driven if the new one is not adopted.
        if !rig.core().faults().contains(Fault::PathBlocked) {
            let old = &request.committed.trajectory;
            let from = old.at(request.takes_over).path.s_m;
            let r = self.limits.certified_m;
            let (clear, at) = least_clearance_m(old, from, &request.grid, r);
            self.findings.check(clear >= r - 1e-4, "P11", || {
                format!(
                    "{}: plan {} is kept, {clear:.4} m from a cell not known free, {at:.2} m along",
                    rig.now(),
                    request.committed.number
                )
            });
        }
    }

    /// P12.
    fn look_at_knowledge(&mut self, rig: &Rig, request: &PlanRequest) {
        let grid = &request.grid;
        let beam_error_m = self.beam_error_m(rig, request);
        let b = grid.bounds();
        for iy in b.y0..b.y1 {
            let row = grid.row(iy).expect("the row is within the bounds");
            let old_row =
                self.known.as_ref().and_then(|known| Some((known.row(iy)?, known.bounds())));
            for (ix, &now) in (b.x0..).zip(row) {
                let before = old_row
                    .filter(|(_, old)| ix >= old.x0 && ix < old.x1)
                    .map_or(Cell::Unknown, |(row, old)| row[(ix - old.x0) as usize]);
                if before == now {
                    continue;
                }
                // A beam that ends on a wall may, by what the estimated pose is off, be booked to the
                // free cell beside it: then that cell is as near to a true wall. Nothing else turns
                // in a static world.
                let turned = before == Cell::Free && now == Cell::Occupied;
                let reach_m = 0.5_f64.sqrt() * grid.resolution_m() + beam_error_m;
                let touches_wall = || {
                    let centre = grid.centre(CellIndex::new(ix, iy));
                    rig.world().distance_m(centre, 2.0 * reach_m) <= reach_m
                };
                let fine =
                    before == Cell::Unknown || (turned && (!self.static_world || touches_wall()));
                self.findings.check(fine, "P12", || {
                    format!("{}: cell {ix} {iy} turned from {before:?} to {now:?}", rig.now())
                });
                let wrong = now == Cell::Free
                    && self.static_world
                    && rig.world().is_solid(grid.centre(CellIndex::new(ix, iy)));
                self.findings.check(!wrong, "P12", || {
                    format!("{}: cell {ix} {iy} counts as free and is solid", rig.now())
                });
            }
        }
        self.known = Some(Arc::clone(grid));
    }

    /// How far the ends of the newest scan's beams may be off at the most, metres: by the error of
    /// the pose that they were booked from, and by the rounding of ranges on the bus.
    fn beam_error_m(&self, rig: &Rig, request: &PlanRequest) -> f64 {
        const ROUNDING_M: f64 = 1e-3;
        let Some(scan) = rig.core().newest_scan() else { return 0.0 };
        let Some(pose) = self.pose_measured(rig, request.scan_stamp, 0) else { return 0.0 };
        let estimate = request.scan_pose;
        let turn = wrap_angle(estimate.heading_rad - pose.heading_rad).abs();
        (estimate.position - pose.position).norm() + scan.range_max_m * turn + ROUNDING_M
    }

    /// The true pose at which a scan with this stamp was measured, as long as it is remembered; with
    /// `seen`, how many true poses of the present instant have been noted.
    fn pose_measured(&self, rig: &Rig, stamp: Instant, seen: usize) -> Option<Pose> {
        // Scans are measured at whole periods; the stamp is that to less than a millisecond.
        let measured_s = (stamp.as_secs_f64() / self.scan_period_s).round() * self.scan_period_s;
        let ago_ms = ((rig.now().as_secs_f64() - measured_s) * 1e3).round() as usize;
        self.poses.len().checked_sub(seen + ago_ms).and_then(|i| self.poses.get(i)).copied()
    }

    /// P1 and P11 where another plan takes over.
    fn look_at_driven(&mut self, rig: &Rig) {
        let current = rig.core().committed().current();
        let old = self.driven.replace(Arc::clone(current));
        // The clock of the plan under way may be set to meet the car; its number tells plans apart.
        let Some(old) = old.filter(|old| old.number != current.number) else { return };
        let number = current.number;
        let standing = current.trajectory.points.len() == 1;
        let shortened = self.events.iter().any(
            |(_, event)| matches!(event, Event::PlanShortened { number: n, .. } if *n == number),
        );
        let origin = match self.certified.get(&number) {
            Some((certified, _)) => ends_with(&current.trajectory, certified),
            None if standing => rig.car().speed_mps < ABOUT_TO_STAND_MPS,
            None => shortened,
        };
        self.findings.check(origin, "P11", || {
            format!("{}: plan {number} is driven, and no step gave it", rig.now())
        });
        if shortened {
            let grid = rig.core().grid();
            let from = current.trajectory.at(rig.now()).path.s_m;
            let r = self.limits.certified_m;
            let (clear, _) = least_clearance_m(&current.trajectory, from, grid, r);
            self.findings.check(clear >= r - 1e-4, "P11", || {
                format!("{}: shortened plan {number} is {clear:.4} m from the blocked", rig.now())
            });
        }
        if !standing && !shortened {
            let start = current.trajectory.start;
            let (a, b) = (old.trajectory.at(start), current.trajectory.at(start));
            let jump = (a.path.position - b.path.position).norm();
            let faster = (a.speed_mps - b.speed_mps).abs();
            self.findings.check(jump < SEAM && faster < SEAM, "P1", || {
                format!("{}: plan {number} takes over {jump:.4} m, {faster:.4} m/s off", rig.now())
            });
        }
    }

    fn look_at_motion(&mut self, rig: &Rig) {
        let state = *rig.car();
        let before = self.state.replace(state);
        self.poses.push_back(state.pose);
        if self.poses.len() > 1000 {
            self.poses.pop_front();
        }
        let Some(before) = before else { return };
        let (worst, findings) = (&mut self.worst, &mut self.findings);
        // Before the first scan nothing is known but that the car stands where it stands.
        if rig.distance_m() == 0.0 {
            return;
        }
        let velocity =
            instants::motion(rig, &before, &state, self.velocity, &self.limits, worst, findings);
        self.velocity = Some(velocity);
        if let Some(sample) = rig.trace().samples.last() {
            let force =
                sample.longitudinal_n.hypot(sample.lateral_n) / VehicleParams::default().mass_kg;
            findings.check(force <= self.limits.accel_mps2 * (1.0 + 1e-6), "I3", || {
                format!("{}: {force:.4} m/s^2 asked for", rig.now())
            });
        }
        let driving = rig.core().mode() == Mode::Drive && self.sound_bus;
        if !driving || state.speed_mps < STANDING_MPS {
            return;
        }
        if self.steps.is_multiple_of(5) {
            instants::tracking(rig, worst, findings);
        }
        if self.steps.is_multiple_of(20) {
            instants::can_stop(rig, &self.limits, worst, findings);
        }
        let plan = rig.core().committed().current();
        let Some((_, before)) = self.certified.get(&plan.number) else { return };
        let misses = self.misses - before;
        let age = rig.now().seconds_after(plan.scan_stamp);
        // A scan's way over the bus and the control period come on top.
        let allowed = self.scan_period_s * f64::from(1 + misses) + self.latency_s + 0.02;
        worst.late_s = worst.late_s.max(age - allowed);
        findings.check(age <= allowed || !self.static_world, "I10", || {
            format!("{}: the plan rests on a scan {age:.3} s old, {misses} misses", rig.now())
        });
    }

    /// I9, for the scan that arrived last.
    fn look_at_scan(&mut self, rig: &Rig) {
        let arrived = rig.core().statistics().scans;
        if arrived == self.scans {
            return;
        }
        self.scans = arrived;
        let Some(scan) = rig.core().newest_scan() else { return };
        let Some(pose) = self.pose_measured(rig, scan.stamp, 1) else { return };
        for (k, range) in scan.ranges_m.iter().enumerate().step_by(BEAM_STRIDE) {
            let range = f64::from(*range);
            let direction = heading_vector(pose.heading_rad + scan.angle_rad(k));
            let sound = range.is_nan() || range == f64::INFINITY || range <= scan.range_max_m;
            let reach = range.min(scan.range_max_m) - 0.005;
            let steps = (reach / 0.02).max(0.0) as u32;
            let walled = (0..=steps)
                .map(|i| pose.position + direction * (0.02 * f64::from(i)))
                .find(|p| rig.world().is_solid(*p));
            self.findings.check(sound && walled.is_none(), "I9", || {
                format!("{}: beam {k} of {range:.3} m passes {walled:?}", rig.now())
            });
        }
    }
}

/// Whether what is driven is what was certified, after a stretch of the way behind.
fn ends_with(driven: &Trajectory, certified: &Trajectory) -> bool {
    let Some(behind) = driven.points.len().checked_sub(certified.points.len()) else {
        return false;
    };
    driven.points[behind..].iter().zip(&certified.points).all(|(a, b)| {
        a.path.position == b.path.position
            && a.path.heading_rad == b.path.heading_rad
            && a.speed_mps == b.speed_mps
            && a.accel_mps2 == b.accel_mps2
    })
}

/// Control parameters that the tolerances rest on have the values they were set for.
#[test]
fn the_tolerances_rest_on_the_trackers_own() {
    assert!(ControlParams::default().overspeed_mps < 0.1);
}
