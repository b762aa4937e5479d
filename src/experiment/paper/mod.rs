//! The experiments of Elhafsi, Ivanovic, Janson and Pavone (2020), "Map-Predictive Motion Planning
//! in Unknown Environments", section V, and the same at higher speeds and with a planner that has no
//! half second to wait.

mod analysis;
mod optima;
mod request;
pub mod stated;
mod tables;

pub use analysis::{Analysis, Comparison, Completion, FloorRow, RangeRow, StepRow};
pub use optima::{Optima, OptimaError};
pub use request::{Method, MethodError, Pace, PaperRequest, Sweep};
pub use tables::tables;

/// Name of the experiment in its records.
pub const NAME: &str = "paper";

/// The method that the paper proposes.
pub const OURS: &str = "map-predictive+cnp";

#[cfg(test)]
mod tests;
