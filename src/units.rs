//! Physical constants.

/// Standard acceleration of gravity as the paper rounds it (Elhafsi et al. 2020, section V).
pub const GRAVITY_MPS2: f64 = 9.81;
