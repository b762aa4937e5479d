//! What a simulated drive needs, checked and put together.

use std::collections::VecDeque;
use std::sync::Arc;

use super::process::Process;
use super::{DIGEST, Rig};
use crate::autopilot::{Autopilot, CoreParams};
use crate::frames::{Point, Pose};
use crate::map::{Cell, CellIndex, CellRect, Grid};
use crate::mapfile::PIXELS_MAX;
use crate::params::Params;
use crate::plan::{Planner, PlannerParams, Planning, Policy, Stopwatch};
use crate::predict::{self, PredictError, PredictParams, PredictorKind};
use crate::sim::account::Account;
use crate::sim::bus::BusParams;
use crate::sim::car::CarParams;
use crate::sim::car_end::{CarEnd, CarEndSetup};
use crate::sim::controller::ControllerParams;
use crate::sim::drive::Trace;
use crate::sim::faults::{FaultPlan, FaultyBus};
use crate::sim::judge::Judge;
use crate::sim::lidar::LidarParams;
use crate::sim::place::{PlaceError, check_place};
use crate::sim::world::World;
use crate::time::{Duration, Instant};
use crate::wire::can::Layout;

/// Time from a planning request to its answer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Latency {
    /// As long as the step took on the wall clock.
    Measured,
    /// So many seconds.
    Fixed(f64),
}

/// Everything a simulated drive needs.
pub struct RigSetup {
    /// The true world.
    pub world: World,
    /// Where the car stands at first, map frame.
    pub start: Pose,
    /// Where it is to go, map frame; without one it waits.
    pub goal: Option<Point>,
    /// The core's parameters.
    pub core: CoreParams,
    /// The planner's parameters.
    pub planner: PlannerParams,
    /// The predictor's parameters.
    pub predict: PredictParams,
    /// The bus.
    pub bus: BusParams,
    /// The lidar.
    pub lidar: LidarParams,
    /// The car's body.
    pub car: CarParams,
    /// The car's controller.
    pub controller: ControllerParams,
    /// Layout of the frames.
    pub layout: Layout,
    /// What goes wrong on the bus.
    pub faults: FaultPlan,
    /// Seed of everything random.
    pub seed: u64,
    /// Time from a planning request to its answer.
    pub latency: Latency,
    /// Simulated seconds after which the drive is given up; ten times a lower bound of the driving
    /// time if not given.
    pub time_limit_s: Option<f64>,
    /// Wall clock for the statistics.
    pub stopwatch: Stopwatch,
    /// Another planner than the product's (tests replace it by wrong ones).
    pub planning: Option<Box<dyn Planning>>,
}

/// Why a drive cannot begin.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SetupError {
    /// Start or goal are where they cannot be.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// The true map does not fit the memory on the planner's grid.
    #[error(
        "the world has {cells:.0} cells of {resolution_m} m, but a true map given to the planner may have at most {allowed}"
    )]
    TruthTooLarge {
        /// Cells that the true map would have.
        cells: f64,
        /// Side of a cell of the planner's grid, metres.
        resolution_m: f64,
        /// Most cells allowed.
        allowed: u64,
    },
    /// The predictor cannot be made.
    #[error(transparent)]
    Predictor(#[from] PredictError),
}

/// Slowest drive that a time limit without a known length assumes, seconds.
const TIME_LIMIT_WITHOUT_WAY_S: f64 = 600.0;

/// Most cells of the true map on the planner's grid: as many as a map file may have.
const TRUTH_CELLS_MAX: u64 = PIXELS_MAX;

impl RigSetup {
    /// A drive with these parameters: seed 1, answers after 20 ms, nothing goes wrong, and no time
    /// is measured.
    pub fn new(params: &Params, world: World, start: Pose, goal: Option<Point>) -> Self {
        Self {
            world,
            start,
            goal,
            core: params.core(),
            planner: params.planner(),
            predict: params.predict.clone(),
            bus: params.bus.clone(),
            lidar: params.lidar.clone(),
            car: params.car.clone(),
            controller: params.controller.clone(),
            layout: params.can.layout,
            faults: FaultPlan::default(),
            seed: 1,
            latency: Latency::Fixed(0.02),
            time_limit_s: None,
            stopwatch: Box::new(|| Duration::ZERO),
            planning: None,
        }
    }

    pub(super) fn build(mut self) -> Result<Rig, SetupError> {
        let radius_m = self.core.vehicle.radius_m;
        check_place(&self.world, self.start, self.goal, radius_m)?;
        if let Latency::Fixed(seconds) = self.latency {
            self.core.autopilot.plan_budget_s = seconds.max(1e-3);
            // The wall clock would decide what is driven.
            self.predict.time_limit_s = f64::INFINITY;
        }
        let time_limit_s = self.time_limit_s.unwrap_or_else(|| self.default_time_limit_s());

        let resolution_m = self.core.map.resolution_m;
        let needs_truth = self.planner.plan.policy == Policy::KnownMap
            || matches!(self.predict.kind, PredictorKind::Oracle | PredictorKind::Inverted);
        if needs_truth {
            self.check_truth_size()?;
        }
        let truth = needs_truth.then(|| Arc::new(grid_of(&self.world, resolution_m)));
        let mut core = Autopilot::new(self.core.clone(), self.layout, self.start, Instant::ZERO);
        let mut account =
            Account::new(&self.world, self.start.position, radius_m + self.core.certify.margin_m);
        if let Some(truth) = truth.as_ref().filter(|_| self.planner.plan.policy == Policy::KnownMap)
        {
            core.preload_map(Grid::clone(truth));
            account.show_all(&self.world);
        }
        let planner: Box<dyn Planning> = match self.planning {
            Some(planning) => planning,
            None => {
                let predictor = predict::build(&self.predict, truth, self.seed)?;
                Box::new(Planner::new(self.planner, predictor, self.stopwatch))
            }
        };
        let mut bus = FaultyBus::new(&self.bus, self.faults);
        let daemon_node = bus.join();
        let car_node = bus.join();
        let car = CarEnd::new(&CarEndSetup {
            start: self.start,
            vehicle: &self.core.vehicle,
            car: &self.car,
            controller: &self.controller,
            lidar: &self.lidar,
            layout: self.layout,
            seed: self.seed,
        });
        Ok(Rig {
            judge: Judge::new(radius_m),
            account,
            bus,
            daemon_node,
            car_node,
            planner,
            car,
            goal: self.goal,
            goal_radius_m: self.core.autopilot.goal_radius_m,
            latency: self.latency,
            time_limit_s,
            now: Instant::ZERO,
            steps: 0,
            job: None,
            process: Process::default(),
            started: None,
            moved_m: 0.0,
            last_useful: Instant::ZERO,
            outcome: None,
            interrupted: false,
            scans_seen: 0,
            events: VecDeque::new(),
            plan_ms: Vec::new(),
            predict_ms: Vec::new(),
            predict_effort: [0; 2],
            reports: None,
            album: None,
            trace: Trace::default(),
            digest: DIGEST.digest(),
            core,
            world: self.world,
        })
    }

    fn check_truth_size(&self) -> Result<(), SetupError> {
        let resolution_m = self.core.map.resolution_m;
        let [low, high] = self.world.bounds();
        let cells = ((high.x - low.x) / resolution_m) * ((high.y - low.y) / resolution_m);
        if cells <= TRUTH_CELLS_MAX as f64 {
            return Ok(());
        }
        Err(SetupError::TruthTooLarge { cells, resolution_m, allowed: TRUTH_CELLS_MAX })
    }

    /// Ten times the way's length at full speed and the time to get going and to stop.
    fn default_time_limit_s(&self) -> f64 {
        let vehicle = &self.core.vehicle;
        let speed = self.planner.speed.speed_max_mps;
        self.goal
            .and_then(|goal| self.world.path_length_m(self.start.position, goal, vehicle.radius_m))
            .map_or(TIME_LIMIT_WITHOUT_WAY_S, |length_m| {
                10.0 * (length_m / speed + speed / vehicle.acceleration_limit_mps2() + 1.0)
            })
    }
}

/// The true world on a grid of the map frame: a cell is occupied if any part of it is solid, as far
/// as samples at half the world's resolution show it.
pub fn grid_of(world: &World, resolution_m: f64) -> Grid {
    let mut grid = Grid::new(resolution_m);
    let (width, height) = (world.width() as i64, world.height() as i64);
    let corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)];
    let cells = corners.map(|(x, y)| grid.cell_at(world.cell_centre(x, y)));
    let rect = cells
        .iter()
        .fold(CellRect::EMPTY, |rect, c| {
            rect.union(&CellRect { x0: c.ix, y0: c.iy, x1: c.ix + 1, y1: c.iy + 1 })
        })
        .grown(2);
    grid.grow_to(rect);
    let parts = (2.0 * resolution_m / world.resolution_m()).ceil().max(1.0) as i32;
    for iy in rect.y0..rect.y1 {
        for ix in rect.x0..rect.x1 {
            let solid = (0..parts * parts).any(|k| {
                let part = |i: i32| (f64::from(i) + 0.5) / f64::from(parts);
                world.is_solid(Point::new(
                    (f64::from(ix) + part(k % parts)) * resolution_m,
                    (f64::from(iy) + part(k / parts)) * resolution_m,
                ))
            });
            let cell = if solid { Cell::Occupied } else { Cell::Free };
            grid.set(CellIndex::new(ix, iy), cell);
        }
    }
    grid
}
