//! The log of a drive: written, read, replayed.
//!
//! The core is a deterministic function of parameters and timestamped inputs, and so is the planner
//! of the jobs that the core asks for. So a log holds the parameters and every input in order, and
//! of what came out only what a replay is compared with: the frames sent, and a digest of each plan.

mod bytes;
mod container;
mod digest;
mod entry;
mod header;
mod log;
mod replay;
mod scribe;

pub use container::{End, LogError};
pub use digest::plan_digest;
pub use entry::Entry;
pub use header::{FORMAT, Header, Source, params_text};
pub use log::{LogReader, LogWriter};
pub use replay::{Comparison, Difference, Ended, ReplayError, SetpointDifference, replay};
pub use scribe::{Readings, Scribe};
