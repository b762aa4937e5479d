//! What the core asks of the planner and what comes back.

use std::sync::Arc;

use super::certify::Violation;
use super::{Path, PlannerParams, Trajectory};
use crate::fence::Fence;
use crate::frames::{Point, Pose};
use crate::map::{CellRect, Grid};
use crate::predict::{OccupancyView, PredictReport};
use crate::time::{Duration, Instant};

/// Where to drive: a disc in the map frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Goal {
    /// Centre of the disc, metres.
    pub position: Point,
    /// Its radius, metres; at rest with the car's centre inside it, the goal is reached.
    pub radius_m: f64,
}

/// One planning step.
#[derive(Clone, Debug)]
pub struct PlanRequest {
    /// Counts requests; the plan that comes back carries it.
    pub number: u32,
    /// Everything known at the time of the request.
    pub grid: Arc<Grid>,
    /// The cells that may differ from the previous request's grid.
    pub changed: CellRect,
    /// When the newest scan in the grid was measured.
    pub scan_stamp: Instant,
    /// Pose at that time, map frame.
    pub scan_pose: Pose,
    /// The plan being driven; the new one branches off it.
    pub committed: Arc<Plan>,
    /// When the new plan takes over.
    pub takes_over: Instant,
    /// Where to go.
    pub goal: Goal,
    /// A speed that is not to be exceeded, m/s, besides the one of the parameters; infinite if
    /// there is none. It only ever makes the car slower.
    pub speed_cap_mps: f64,
    /// Where the car may drive at all.
    pub fence: Arc<Fence>,
    /// Whether the way is to lead through space that is known to be free, if there is such a way.
    pub through_known: bool,
}

/// A certified plan.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The request it answers; zero for standing still at the start.
    pub number: u32,
    /// When the newest scan behind it was measured.
    pub scan_stamp: Instant,
    /// The executable part: ends at rest inside known free space.
    pub trajectory: Trajectory,
    /// How the path would go on beyond its end as things are imagined now, arc length continued;
    /// never executed.
    pub beyond: Path,
}

impl Plan {
    /// Standing still at a pose.
    pub fn standing(now: Instant, pose: Pose) -> Self {
        Self {
            number: 0,
            scan_stamp: now,
            trajectory: Trajectory::at_rest(now, pose),
            beyond: Path::default(),
        }
    }
}

/// Why a step gave no plan.
#[derive(Clone, Debug, PartialEq)]
pub enum Rejection {
    /// No drivable shape was found along the way that the search proposes.
    Shape(String),
    /// The speed at the start does not allow it.
    Speed(String),
    /// The finished plan failed the certificate.
    Certificate(Violation),
    /// The search proposes nothing that gets nearer to the goal from here.
    NothingToGain,
}

/// What a planning step came to.
#[derive(Clone, Debug)]
pub enum Verdict {
    /// A certified plan.
    Plan(Box<Plan>),
    /// The committed plan already ends at the goal.
    Keep,
    /// No plan this time; the committed one stays.
    Rejected(Rejection),
    /// Occupied space encloses the car or the goal: there is no way, whatever the unknown holds.
    Unreachable,
}

/// Wall time of the parts of a step, by the clock that the caller injects.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepTimes {
    /// Distance transforms and masks.
    pub field: Duration,
    /// Observing the scene and answering queries.
    pub predict: Duration,
    /// Search, without the answers of the predictor.
    pub search: Duration,
    /// Start manoeuvre.
    pub manoeuvre: Duration,
    /// Bubbles and smoothing.
    pub smooth: Duration,
    /// Speed profile.
    pub speed: Duration,
    /// Certificate and stop placing.
    pub certify: Duration,
    /// The whole step.
    pub total: Duration,
}

/// A step's answer with its figures.
#[derive(Clone, Debug)]
pub struct StepReport {
    /// The request's number.
    pub number: u32,
    /// The request's committed plan, by number: if another one is being driven by now, the answer
    /// starts in the wrong place and is dropped.
    pub base: u32,
    /// When a plan takes over.
    pub takes_over: Instant,
    /// The result.
    pub verdict: Verdict,
    /// Candidate paths that were weighed.
    pub candidates: u32,
    /// Where the wall time went.
    pub times: StepTimes,
    /// How the prediction went.
    pub prediction: PredictReport,
}

/// Whatever answers planning requests.
pub trait Planning: Send {
    /// Answers one request.
    fn step(&mut self, request: &PlanRequest) -> StepReport;

    /// Takes new parameters, in force from the next step on.
    fn set_params(&mut self, _params: &PlannerParams) {}

    /// What the newest step knew of the unknown, to be shown; `None` if there is nothing to show.
    fn view(&mut self) -> Option<Box<dyn OccupancyView + '_>> {
        None
    }
}
