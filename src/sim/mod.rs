//! The simulated world, car and bus. Geometry of its own: nothing here uses `map`, `plan` or
//! `guard`, so a mistake there cannot cancel itself here. Only `rig` joins it to the core.

pub mod account;
pub mod bus;
pub mod car;
pub mod car_end;
pub mod controller;
pub mod drive;
pub mod faults;
pub mod judge;
pub mod lidar;
pub mod maze;
pub mod place;
pub mod rig;
pub mod script;
pub mod solo;
pub mod world;
