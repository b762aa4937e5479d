//! From a map, a goal and a view of the unknown to a plan that always ends at rest in known free
//! space.

pub mod certify;
mod path;
pub mod speed;
#[cfg(test)]
mod test_paths;
pub mod bubbles;
mod path;
pub mod smooth;
pub mod search;

pub use path::{Path, PathPoint, Trajectory, TrajectoryPoint};
