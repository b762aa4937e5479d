//! From a map, a goal and a view of the unknown to a plan that always ends at rest in known free
//! space.

mod path;
pub mod search;

pub use path::{Path, PathPoint, Trajectory, TrajectoryPoint};
