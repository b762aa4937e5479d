//! Experiments on the whole: data for the predictor and its scores.

pub mod dataset;
pub mod evaluate;
