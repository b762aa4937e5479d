//! The safety of the closed loop: what must hold at every planning step and at every simulated
//! millisecond, whatever the predictor says, the bus does, or the planner gets wrong.
//!
//! Everything is judged with geometry and dynamics written here, not with those of the code under
//! test. The names in the findings (`P4`, `I2`, ...) are listed in [`findings`].
//!
//! Continuous integration runs a few seeds of each kind; `APEXD_CAMPAIGN=full` runs the same code
//! over many more.

mod appearing;
mod bus_cut;
mod drives;
mod faults;
mod findings;
mod geometry;
mod guard_alone;
mod instants;
mod late;
mod mutations;
mod plans;
mod prediction;
mod replay;
#[allow(dead_code, reason = "the scenarios of the failsafe table use it too")]
mod trial;
mod watch;

/// The number of cases to run: few in continuous integration, many in a campaign.
fn cases(few: u64, many: u64) -> u64 {
    let full = std::env::var("APEXD_CAMPAIGN").is_ok_and(|value| value == "full");
    if full { many } else { few }
}
