//! A small language for drives: which world, which planner, which car, which faults.

use std::sync::Arc;

use apexd::autopilot::AutopilotParams;
use apexd::frames::{Point, Pose};
use apexd::guard::GuardParams;
use apexd::params::Params;
use apexd::plan::{ForeseenParams, Planner, PlannerParams, Planning, Policy, Reading};
use apexd::predict::{self, PredictParams, Predictor, PredictorKind};
use apexd::sim::car::CarParams;
use apexd::sim::faults::{Cut, FaultPlan, FrameFault, Harm};
use apexd::sim::lidar::LidarParams;
use apexd::sim::maze::{self, Family};
use apexd::sim::rig::{Latency, Rig, RigSetup, grid_of};
use apexd::sim::world::World;
use apexd::time::Duration;
use apexd::wire::can::Layout;

/// The daemon's place on the bus, in order of joining.
pub const DAEMON: usize = 0;
/// The car's place on the bus.
pub const CAR: usize = 1;

/// A drive that can be had as often as one likes.
#[derive(Clone)]
pub struct Trial {
    pub name: String,
    pub world: World,
    pub start: Pose,
    pub goal: Point,
    pub policy: Policy,
    pub reading: Reading,
    pub predictor: PredictorKind,
    pub speed_mps: f64,
    pub lidar_hz: f64,
    pub latency_s: f64,
    pub time_limit_s: Option<f64>,
    pub faults: FaultPlan,
    pub guard: GuardParams,
    pub car: CarParams,
    pub layout: Layout,
    pub control_rate_hz: f64,
    pub seed: u64,
    pub foreseen: ForeseenParams,
}

impl Trial {
    /// The default drive through a maze: 4 m/s, 20 scans a second, nothing foreseen.
    pub fn maze(family: Family, seed: u64) -> Self {
        let maze = maze::generate(family, seed, 0.1).expect("0.1 m divides the hallway");
        Self::in_world(format!("{} {seed}", family.name()), maze.world, maze.start, maze.goal)
    }

    /// The default drive in a world of one's own.
    pub fn in_world(name: String, world: World, start: Pose, goal: Point) -> Self {
        Self {
            name,
            world,
            start,
            goal,
            policy: Policy::MapPredictive,
            reading: Reading::Direct,
            predictor: PredictorKind::None,
            speed_mps: 4.0,
            lidar_hz: 20.0,
            latency_s: 0.02,
            time_limit_s: None,
            faults: FaultPlan::default(),
            guard: GuardParams::default(),
            car: CarParams::default(),
            layout: Layout::Fd,
            control_rate_hz: 100.0,
            seed: 1,
            // Harder than the default: at any speed shapes rely on whatever any predictor says,
            // however unfamiliar the scene.
            foreseen: ForeseenParams {
                free_at_most: 0.45,
                occupied_at_least: 0.55,
                familiarity_at_least: 0.0,
                network_speed_mps: f64::INFINITY,
            },
        }
    }

    /// An empty hall of `width_m` by `depth_m`, lower left corner at the origin.
    pub fn hall(width_m: f64, depth_m: f64, start: Pose, goal: Point) -> Self {
        let cells = |m: f64| (m / 0.1).round() as usize;
        let (columns, rows) = (cells(width_m), cells(depth_m));
        let edge = |x: usize, y: usize| x == 0 || y == 0 || x + 1 == columns || y + 1 == rows;
        let solid: Vec<bool> =
            (0..columns * rows).map(|i| edge(i % columns, i / columns)).collect();
        let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), columns, rows, &solid);
        Self::in_world(format!("hall {width_m} x {depth_m}"), world, start, goal)
    }

    pub fn policy(mut self, policy: Policy) -> Self {
        self.policy = policy;
        self
    }

    pub fn predictor(mut self, kind: PredictorKind) -> Self {
        self.predictor = kind;
        self
    }

    /// 8 m/s with 40 scans a second.
    pub fn fast(mut self) -> Self {
        (self.speed_mps, self.lidar_hz) = (8.0, 40.0);
        self
    }

    pub fn latency(mut self, seconds: f64) -> Self {
        self.latency_s = seconds;
        self
    }

    /// Classic frames: 360 beams 10 times a second, and a guard that puts up with that.
    pub fn classic(mut self) -> Self {
        (self.layout, self.lidar_hz) = (Layout::Classic, 10.0);
        self.guard.scan_age_max_s = 0.4;
        self
    }

    /// Ends the drive after so many simulated seconds.
    pub fn for_s(mut self, seconds: f64) -> Self {
        self.time_limit_s = Some(seconds);
        self
    }

    /// Cuts a node off the bus from a moment on.
    pub fn cut(mut self, node: usize, from_s: f64) -> Self {
        self.faults.cuts.push(Cut { node, from_s, until_s: f64::INFINITY });
        self
    }

    /// Something happens to frames for `receiver` with these identifiers.
    pub fn harm(
        mut self,
        harm: Harm,
        probability: f64,
        receiver: Option<usize>,
        ids: Option<(u16, u16)>,
        from_s: f64,
        until_s: f64,
    ) -> Self {
        self.faults.seed = self.seed;
        self.faults.frames.push(FrameFault { harm, probability, receiver, ids, from_s, until_s });
        self
    }

    /// What tells this drive from others.
    pub fn label(&self) -> String {
        format!(
            "{}, {}, {}, {} m/s, {} Hz",
            self.name,
            self.policy.name(),
            self.predictor.name(),
            self.speed_mps,
            self.lidar_hz
        )
    }

    pub fn planner_params(&self) -> PlannerParams {
        let mut params = PlannerParams::default();
        params.plan.policy = self.policy;
        params.plan.reading = self.reading;
        params.speed.speed_max_mps = self.speed_mps;
        params.foreseen = self.foreseen.clone();
        params
    }

    /// The product's planner for this drive.
    pub fn planner(&self) -> Planner {
        let truth = matches!(self.predictor, PredictorKind::Oracle | PredictorKind::Inverted)
            .then(|| Arc::new(grid_of(&self.world, 0.1)));
        let params = PredictParams { kind: self.predictor, ..PredictParams::default() };
        let predictor = predict::build(&params, truth, self.seed).expect("the truth is given");
        self.planner_with(predictor)
    }

    /// The product's planner with another predictor.
    pub fn planner_with(&self, predictor: Box<dyn Predictor>) -> Planner {
        Planner::new(self.planner_params(), predictor, Box::new(|| Duration::ZERO))
    }

    /// The drive, ready to begin.
    pub fn rig(&self) -> Rig {
        self.rig_with(Box::new(self.planner()))
    }

    /// The car stands at the start and nobody tells it to go anywhere.
    pub fn idle_rig(&self) -> Rig {
        self.rig_to(None, Box::new(self.planner()))
    }

    /// The same with another planner.
    pub fn rig_with(&self, planning: Box<dyn Planning>) -> Rig {
        self.rig_to(Some(self.goal), planning)
    }

    fn rig_to(&self, goal: Option<Point>, planning: Box<dyn Planning>) -> Rig {
        let setup = RigSetup { goal, ..self.setup_with(planning) };
        let mut rig = Rig::new(setup).expect("start and goal are free");
        rig.keep_reports();
        rig
    }

    /// What that is made of.
    pub fn setup_with(&self, planning: Box<dyn Planning>) -> RigSetup {
        let planner = self.planner_params();
        let params = Params {
            autopilot: AutopilotParams {
                control_rate_hz: self.control_rate_hz,
                ..AutopilotParams::default()
            },
            speed: planner.speed.clone(),
            guard: self.guard.clone(),
            lidar: LidarParams {
                rate_hz: self.lidar_hz,
                beams: if self.layout == Layout::Classic { 360 } else { 1080 },
                ..LidarParams::default()
            },
            car: self.car.clone(),
            ..Params::default()
        };
        RigSetup {
            planner,
            layout: self.layout,
            faults: self.faults.clone(),
            seed: self.seed,
            latency: Latency::Fixed(self.latency_s),
            time_limit_s: self.time_limit_s,
            planning: Some(planning),
            ..RigSetup::new(&params, self.world.clone(), self.start, Some(self.goal))
        }
    }
}
