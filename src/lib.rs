//! apexd drives an RC-scale car fast and safely through places it has never seen.
//!
//! The library is a deterministic function of parameters and timestamped inputs:
//!
//! ```text
//! CAN frame -> wire -> localize -> map -> predict -> plan -> control -> guard -> wire -> CAN frame
//! ```
//!
//! Only `shell` knows clocks, sockets, threads and files. `docs/architecture.md` has the module
//! tree and which module may use which.

pub mod autopilot;
pub mod command;
pub mod control;
pub mod experiment;
pub mod fence;
pub mod frames;
pub mod ground;
pub mod guard;
pub mod localize;
pub mod map;
pub mod mapfile;
pub mod odometry;
pub mod params;
pub mod plan;
pub mod predict;
pub mod record;
pub mod scan;
pub mod shell;
pub mod sim;
pub mod tail;
pub mod time;
pub mod tunable;
pub mod units;
pub mod vehicle;
pub mod wire;
