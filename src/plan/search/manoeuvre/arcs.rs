//! The arcs that states are expanded by, and how tight they may be.

use crate::frames::chord_m;

/// Distance between two samples of a path, and between two looks at the room, metres.
const SAMPLE_M: f64 = 0.05;

/// How tight the car may turn after some distance, braking with half of what the tyres transmit.
#[derive(Clone, Copy)]
pub(super) struct Turning {
    pub(super) curvature_pm: f64,
    pub(super) v2: f64,
    pub(super) acceleration: f64,
}

impl Turning {
    pub(super) fn at(&self, s_m: f64) -> f64 {
        let v2 = self.v2 - self.acceleration * s_m;
        if v2 <= 0.0 {
            return self.curvature_pm;
        }
        // sqrt(1 - 0.5^2) of the circle is left for turning; a tenth of that stays unused.
        self.curvature_pm.min(0.78 * self.acceleration / v2)
    }
}

/// The beginning of an arc, or all of it, seen from where it begins.
#[derive(Clone, Copy)]
pub(super) struct Piece {
    pub(super) chord_m: f64,
    pub(super) turn_rad: f64,
}

/// An arc that states are expanded by.
pub(super) struct Arc {
    pub(super) curvature_pm: f64,
    pub(super) whole: Piece,
    /// As far as each look at the room before its end.
    pub(super) within: Vec<Piece>,
}

impl Arc {
    fn new(curvature_pm: f64, length_m: f64) -> Self {
        let parts = parts_of(length_m);
        let pieces = (1..=parts as u32).map(|i| {
            let s = length_m * f64::from(i) / parts;
            let turn_rad = curvature_pm * s;
            Piece { chord_m: chord_m(s, turn_rad), turn_rad }
        });
        let mut within: Vec<_> = pieces.collect();
        let whole = within.pop().expect("an arc has at least one part");
        Self { curvature_pm, whole, within }
    }

    /// The arcs from a state, the tightest of them given.
    pub(super) fn fan(tightest_pm: f64, length_m: f64) -> [Self; 5] {
        [0.0, 0.5, -0.5, 1.0, -1.0].map(|share| Self::new(share * tightest_pm, length_m))
    }
}

/// In how many parts an arc is looked at.
pub(super) fn parts_of(length_m: f64) -> f64 {
    (length_m / SAMPLE_M - 1e-9).ceil().max(1.0)
}
