//! One drive of an experiment as plain data: what is driven, and what came of it.

mod execute;
mod figures;
mod record;
mod spec;

pub use execute::{Driven, RunError, Tools, execute, place};
pub use figures::{Figures, Histogram, WallTimes};
pub use record::{Drive, Record};
pub use spec::{Benchmark, Keep, RunSpec, SpecError, Task, Timing, WorldSpec};

#[cfg(test)]
mod tests;
