//! From a map, a goal and a view of the unknown to a plan that always ends at rest in known free
//! space.

pub mod bubbles;
pub mod certify;
mod fenced;
mod foreseen;
mod impasse;
mod path;
mod planner;
mod request;
pub mod search;
mod shorten;
pub mod smooth;
pub mod speed;
#[cfg(test)]
mod test_paths;
mod visibility;

pub use fenced::FencePainter;
pub use foreseen::ForeseenParams;
pub use path::{Path, PathPoint, Trajectory, TrajectoryPoint};
pub use planner::{
    JansonParams, PlanParams, Planner, PlannerParams, Policy, Reading, SHORTEST_PLAN_M, StopRule,
    Stopwatch,
};
pub use request::{Goal, Plan, PlanRequest, Planning, Rejection, StepReport, StepTimes, Verdict};
pub use shorten::shorten;
