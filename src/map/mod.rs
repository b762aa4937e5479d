//! The occupancy grid: what is known to be free, what is known to be occupied, and the rest.
//!
//! Never holds a prediction. Cells are addressed in whole numbers from the map frame's origin, so
//! that an index keeps its meaning when the grid grows.

mod clearance;
mod distance;
mod fan;
mod frontier;
mod grid;
mod insert;

pub use clearance::{Clearance, clearance_m, segment_clearance_m};
pub use distance::{Blocking, DistanceField};
pub use frontier::{Frontier, FrontierFinder, frontiers};
pub use grid::{Cell, CellIndex, CellRect, Grid, floor_to_index};
pub use insert::{CELLS_MAX, Insertion, MapParams, Mapper, Refusal};
