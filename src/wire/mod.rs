//! Bytes to typed values and back. Nothing here knows a socket or a clock.

pub mod can;
pub mod mavlink;
