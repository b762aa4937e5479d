//! The failsafe table, row by row, in virtual time: each fault is brought about on the bus, in the
//! process, or in what the computer says about itself, never by telling the core that it has one.
//! Asserted are the time of detection, the action, where the car ends up by the simulator's own
//! judge, and what clears the fault. Then every scenario is played with the row's detector switched
//! off, and must fail: a test that cannot fail shows nothing.

#[path = "../safety/trial.rs"]
#[allow(dead_code)]
mod trial;

mod arming;
mod bench;
mod link;
mod planners;
mod play;
mod quiet;
mod rows;
