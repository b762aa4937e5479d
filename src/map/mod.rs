//! The occupancy grid: what is known to be free, what is known to be occupied, and the rest.
//!
//! Never holds a prediction. Cells are addressed in whole numbers from the map frame's origin, so
//! that an index keeps its meaning when the grid grows.

mod grid;

pub use grid::{Cell, CellIndex, CellRect, Grid};
