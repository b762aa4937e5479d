//! Why a plan is refused, in numbers and in words.

use crate::map::{Cell, CellIndex};

/// Why a plan is not safe to drive.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Violation {
    /// No samples.
    #[error("the trajectory has no samples")]
    Empty,
    /// Infinite, or not a number.
    #[error("sample {sample}: {what} is {value}")]
    NotFinite {
        /// Index of the sample.
        sample: usize,
        /// Which number.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// Arc length or time stands still or runs backwards, or time does not start at zero.
    #[error("sample {sample}: {what} {value} does not follow {before}")]
    NotIncreasing {
        /// Index of the later sample.
        sample: usize,
        /// `arc length` or `time`.
        what: &'static str,
        /// Value there.
        value: f64,
        /// Value one sample before (zero before the first).
        before: f64,
    },
    /// Arc length and positions disagree.
    #[error("sample {sample}: {chord_m} m from the one before, along the path {arc_m} m")]
    Chord {
        /// Index of the later sample.
        sample: usize,
        /// Distance between the positions, metres.
        chord_m: f64,
        /// Difference of the arc lengths, metres.
        arc_m: f64,
    },
    /// A heading does not fit the direction to the neighbouring sample.
    #[error(
        "sample {sample}: heading {angle_rad:.4} rad off the path, allowed {allowed_rad:.4} rad"
    )]
    Tangent {
        /// Index of the sample.
        sample: usize,
        /// Angle between heading and chord, radians.
        angle_rad: f64,
        /// What the tightest turn explains, radians.
        allowed_rad: f64,
    },
    /// Tighter than the car can turn.
    #[error("sample {sample}: {how} curvature {curvature_pm:.4}/m, at most {allowed_pm:.4}/m")]
    Curvature {
        /// Index of the sample.
        sample: usize,
        /// `given`, or `measured` as the circle through three positions.
        how: &'static str,
        /// The curvature, 1/m.
        curvature_pm: f64,
        /// What is allowed, tolerance included, 1/m.
        allowed_pm: f64,
    },
    /// Headings turn by something else than the curvatures say.
    #[error(
        "after sample {sample}: headings turn by {turned_pm:.4}/m, curvatures by {given_pm:.4}/m"
    )]
    CurvatureMismatch {
        /// Index of the earlier sample.
        sample: usize,
        /// Mean curvature by the headings, 1/m.
        turned_pm: f64,
        /// Mean of the curvatures at both ends, 1/m.
        given_pm: f64,
    },
    /// Negative or too fast.
    #[error("sample {sample}: speed {speed_mps} m/s, allowed 0 to {allowed_mps} m/s")]
    Speed {
        /// Index of the sample.
        sample: usize,
        /// Its speed, m/s.
        speed_mps: f64,
        /// The largest allowed, m/s.
        allowed_mps: f64,
    },
    /// Time, speed, acceleration and arc length do not describe one motion.
    #[error("after sample {sample}: {what} is {value}, arc length and speeds give {expected}")]
    Motion {
        /// Index of the earlier sample.
        sample: usize,
        /// `duration` or `acceleration`.
        what: &'static str,
        /// Value given, SI units.
        value: f64,
        /// Value expected, SI units.
        expected: f64,
    },
    /// More force than the tyres hold.
    #[error(
        "after sample {sample}: {accel_mps2:.3} m/s^2 asked of tyres that hold {allowed_mps2:.3} m/s^2"
    )]
    Friction {
        /// Index of the earlier sample.
        sample: usize,
        /// Largest acceleration up to the next sample, m/s^2.
        accel_mps2: f64,
        /// What the tyres hold, m/s^2.
        allowed_mps2: f64,
    },
    /// The disc touches a cell that is not known to be free.
    #[error("at {s_m:.3} m: {distance_m:.4} m to {state:?} cell ({}, {}), needed {needed_m:.4} m", .cell.ix, .cell.iy)]
    Swept {
        /// Arc length at the start of the edge, metres.
        s_m: f64,
        /// Distance from the edge's chord to the cell, metres.
        distance_m: f64,
        /// Radius plus the curve's bulge over its chord, metres.
        needed_m: f64,
        /// The cell touched.
        cell: CellIndex,
        /// What is known of it.
        state: Cell,
    },
    /// It does not end at rest.
    #[error("ends at {speed_mps} m/s instead of at rest")]
    NotAtRest {
        /// Speed at the last sample, m/s.
        speed_mps: f64,
    },
    /// It does not start where it is taken over.
    #[error(
        "starts {offset_m:.4} m, {turn_rad:.4} rad and {speed_mps:.4} m/s off the state it is to continue"
    )]
    Start {
        /// Distance, metres.
        offset_m: f64,
        /// Heading difference without sign, radians.
        turn_rad: f64,
        /// Speed difference without sign, m/s.
        speed_mps: f64,
    },
}
