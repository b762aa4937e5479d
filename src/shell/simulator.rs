//! The simulated drive behind `apexd sil`: world and rig from what was asked for, the record of the
//! drive from the rig.

use std::path::Path;

use super::logbook::{self, Logbook, LogbookError, WhenFull};
use super::mavlink::Attended;
use super::place::{MAZE_RESOLUTION_M, Place, warn_of_load};
use super::report::{DriveRecord, outline};
use super::sil::{Progress, RunError, SilRequest, Simulator, input};
use super::{folder, pace};
use crate::autopilot::{Action, Event};
use crate::frames::{Point, Pose};
use crate::mapfile;
use crate::plan::Policy;
use crate::predict::{self, PredictorKind};
use crate::record::{Header, Readings, Source, params_text};
use crate::sim::maze::{self, Family};
use crate::sim::rig::{Latency, Rig, RigSetup, grid_of};
use crate::sim::world::World;
use crate::time::Instant;

/// Simulated time between two looks at the progress, seconds.
const PROGRESS_PERIOD_S: f64 = 0.1;

/// Drives over the virtual bus in this process.
pub struct RigSimulator;

impl Simulator for RigSimulator {
    fn drive(
        &self,
        request: &SilRequest,
        progress: &mut dyn FnMut(&Progress),
    ) -> Result<DriveRecord, RunError> {
        let mut wanted = request.place.clone();
        if request.is_attended() {
            // Nobody looks at it: the ground station says where to go.
            wanted.goal = wanted.start.map(|start| start.position);
        }
        let place = wanted.place()?;
        warn_of_load(&request.params);
        let truth = walls(&place.world);
        let start = place.start;
        let mut goal = if request.is_attended() { None } else { Some(place.needed_goal()?) };
        let mut attended = if request.links.is_empty() {
            None
        } else {
            Some(Attended::start(&request.params, &request.links, start).map_err(input)?)
        };
        let readings = Readings::default();
        let given = goal;
        let mut rig = Rig::new(setup(request, place, goal, &readings)).map_err(input)?;
        rig.keep_snapshot(request.snapshot_s);
        let logbook = match &request.log {
            Some(path) => Some(begin_log(path, request, &rig, start, given).map_err(input)?),
            None => None,
        };
        if let Some(logbook) = &logbook {
            rig.core_mut().set_witness(logbook.recorder().scribe(readings));
            if let Some(attended) = &mut attended {
                attended.recorder = Some(logbook.recorder().clone());
            }
        }

        let begin = pace::now();
        let mut next_progress_s = 0.0;
        pace::drive(&mut rig, request.realtime, |rig| {
            while let Some(event) = rig.poll_event() {
                log(&event);
                attended.iter().for_each(|attended| attended.tell(&event));
            }
            if let Some(attended) = &mut attended {
                attended.attend(rig);
                goal = rig.core().goal().map(|goal| goal.position).or(goal);
            }
            let now_s = rig.now().as_secs_f64();
            if now_s >= next_progress_s {
                next_progress_s = now_s + PROGRESS_PERIOD_S;
                progress(&Progress {
                    time_s: now_s,
                    speed_mps: rig.car().speed_mps,
                    distance_m: rig.distance_m(),
                    remaining_m: goal.map_or(0.0, |goal| remaining_m(rig, goal)),
                    replans: rig.core().statistics().replans,
                });
            }
        })
        .map_err(|error| RunError::Failed(error.into()))?;
        let wall_s = begin.elapsed().as_secs_f64();
        if let Some(logbook) = logbook {
            logbook.close().map_err(|error| RunError::Failed(error.into()))?;
        }

        let vehicle = &request.params.vehicle;
        Ok(DriveRecord {
            title: request.title(),
            summary: rig.summary(wall_s),
            trace: rig.trace().clone(),
            grid: rig.core().grid().clone(),
            truth,
            snapshot: rig.snapshot().cloned(),
            start,
            goal: goal.unwrap_or(start.position),
            goal_radius_m: request.params.autopilot.goal_radius_m,
            speed_limit_mps: request.params.speed.speed_max_mps,
            force_limit_n: vehicle.mass_kg * vehicle.acceleration_limit_mps2(),
        })
    }

    fn write_maze(&self, seed: u64, family: Family, out: &Path) -> Result<(), RunError> {
        let maze = maze::generate(family, seed, MAZE_RESOLUTION_M).map_err(input)?;
        mapfile::save(out, &maze.to_map_file()).map_err(input)
    }
}

/// Begins the log of a drive.
fn begin_log(
    path: &Path,
    request: &SilRequest,
    rig: &Rig,
    start: Pose,
    goal: Option<Point>,
) -> Result<Logbook, LogbookError> {
    let mut params = request.params.clone();
    if let Latency::Fixed(seconds) = request.latency {
        // As the rig has it.
        params.autopilot.plan_budget_s = seconds.max(1e-3);
    }
    let needs_truth = params.plan.policy == Policy::KnownMap
        || matches!(params.predict.kind, PredictorKind::Oracle | PredictorKind::Inverted);
    let truth = needs_truth.then(|| grid_of(rig.world(), params.map.resolution_m));
    let header = Header {
        build: env!("CARGO_PKG_VERSION").to_owned(),
        source: Source::Sil,
        begun_utc: folder::now(),
        made: Instant::ZERO,
        start,
        goal,
        seed: request.seed,
        params: params_text(&params),
        network: predict::network_digest(&params.predict),
        part: 1,
    };
    Logbook::begin(logbook::Place::File(path.to_owned()), header, truth, WhenFull::Wait)
}

fn setup(request: &SilRequest, place: Place, goal: Option<Point>, readings: &Readings) -> RigSetup {
    let begin = pace::now();
    RigSetup {
        seed: request.seed,
        latency: request.latency,
        // Nobody but the ground station knows how long it will take.
        time_limit_s: request.time_limit_s.or(request.is_attended().then_some(f64::INFINITY)),
        stopwatch: match request.log {
            Some(_) => readings.keep(Box::new(move || begin.elapsed())),
            None => Box::new(move || begin.elapsed()),
        },
        ..RigSetup::new(&request.params, place.world, place.start, goal)
    }
}

/// Where solid and free touch, map frame.
pub(super) fn walls(world: &World) -> Vec<[Point; 2]> {
    let solid = |x: usize, y: usize| world.is_cell_solid(x as i64, y as i64);
    let (origin, resolution_m) = (world.origin(), world.resolution_m());
    outline(world.width(), world.height(), solid, |p| origin.to_map(p * resolution_m))
}

/// What is left of the newest plan, how the path is imagined to go on, and from there straight to
/// the goal.
fn remaining_m(rig: &Rig, goal: Point) -> f64 {
    let plan = rig.core().committed().newest();
    let stop = plan.trajectory.last().path;
    let mut from = stop.position;
    let mut length_m = stop.s_m - plan.trajectory.at(rig.now()).path.s_m;
    for point in plan.beyond.points.iter().map(|p| p.position).chain([goal]) {
        length_m += (point - from).norm();
        from = point;
    }
    length_m
}

/// What the core has to say, for the log.
pub(super) fn log(event: &Event) {
    let seconds = |at: &crate::time::Instant| format!("{:.3}", at.as_secs_f64());
    match event {
        Event::ModeChanged { at, from, to } => {
            tracing::info!(t_s = seconds(at), "{} -> {}", from.name(), to.name());
        }
        Event::FaultRaised { at, fault } if fault.row().action == Action::Report => {
            tracing::info!(t_s = seconds(at), "{}", fault.name());
        }
        Event::FaultRaised { at, fault } => {
            tracing::warn!(t_s = seconds(at), "{}: {}", fault.name(), fault.row().detection);
        }
        Event::FaultCleared { at, fault } => {
            tracing::info!(t_s = seconds(at), "{} is over", fault.name());
        }
        Event::PlanAdopted { number, stop, length_m } => {
            tracing::trace!(number, x_m = stop.x, y_m = stop.y, length_m, "plan adopted");
        }
        Event::PlanRejected { number, rejection } => {
            tracing::debug!(number, ?rejection, "no plan");
        }
        Event::PredictionPassedOver { at, number } => tracing::info!(
            t_s = seconds(at),
            number,
            "the prediction has led to and fro and is left out until there is something new to see"
        ),
        Event::PredictionFault { at, number, fault } => {
            tracing::warn!(t_s = seconds(at), number, "no prediction: {fault}");
        }
        Event::PlanLate { number } => tracing::info!(number, "plan came too late"),
        Event::PlanShortened { at, number } => {
            tracing::info!(t_s = seconds(at), number, "plan cut short: something stands on it");
        }
        Event::GoalReached { at, position } => {
            tracing::info!(t_s = seconds(at), x_m = position.x, y_m = position.y, "at the goal");
        }
    }
}
