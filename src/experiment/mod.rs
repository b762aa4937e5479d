//! Experiments on the whole: data for the predictor and its scores; the experiments of Elhafsi et
//! al. (2020), random drives and BARN's worlds, with statistics and tables.

pub mod barn;
pub mod campaign;
pub mod dataset;
pub mod evaluate;
pub mod failures;
pub mod floor;
pub mod paper;
pub mod results;
pub mod run;
pub mod statistics;
pub mod table;
