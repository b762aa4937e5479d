//! From a map, a goal and a view of the unknown to a plan that always ends at rest in known free
//! space.

pub mod bubbles;
mod path;
pub mod smooth;

pub use path::{Path, PathPoint, Trajectory, TrajectoryPoint};
