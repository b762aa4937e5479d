//! Bubbles: discs of free space around the points of a path, within which smoothing may move them.
//!
//! After Algorithm 1 of Zhu, Schmerling, Pavone, "A convex optimization approach to smooth
//! trajectories for motion planning with car-like robots" (2015, arXiv 1506.01085). Their rule to
//! copy a neighbour's bubble saves look-ups that are cheap here, so every point gets its own.

use crate::frames::{Point, Vector};

/// How far a point is from the nearest obstacle.
pub trait ClearanceField {
    /// Distance from `p` (map frame) to the nearest obstacle surface, metres; 0 inside obstacles.
    /// May be capped at a distance beyond the largest bubble plus the car's radius.
    fn clearance_m(&self, p: Point) -> f64;

    /// Unit vector along which clearance grows fastest, zero where there is none (inside the cap,
    /// on a ridge). The default takes central differences over 6 cm, which smooths the facets of
    /// a grid's distance transform.
    fn away(&self, p: Point) -> Vector {
        const STEP_M: f64 = 0.03;
        let along = |v: Vector| self.clearance_m(p + v) - self.clearance_m(p - v);
        let slope = Vector::new(along(Vector::new(STEP_M, 0.0)), along(Vector::new(0.0, STEP_M)));
        let norm = slope.norm();
        // A slope below a tenth is a ridge (or the cap): no side is better.
        if norm > 0.2 * STEP_M { slope / norm } else { Vector::zeros() }
    }
}

/// A disc in which the car's centre keeps its distance from every obstacle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bubble {
    /// Map frame, metres.
    pub centre: Point,
    /// Metres; not positive where nothing fits.
    pub radius_m: f64,
}

/// Sizes of bubbles, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BubbleSizes {
    /// Where a bubble about the point itself is smaller than this, its centre moves away from the
    /// obstacle until this radius fits or another obstacle is as near.
    pub wanted_m: f64,
    /// No bubble is larger.
    pub max_m: f64,
}

/// By how much a moved bubble may miss the point that it is for. Moving straight away from one wall
/// gains exactly the distance moved; in a corner between two it gains less.
const SLIP_M: f64 = 0.05;
/// A bubble smaller than this holds its point to no purpose: then the largest one found is taken
/// wherever it is.
const USEFUL_M: f64 = 0.05;

/// The bubble for the path point `p`: every point in it has at least `keep_m` of clearance.
///
/// A moved bubble still holds `p`, within 5 cm, unless there is next to no room about `p` itself.
pub fn bubble_at(
    field: &impl ClearanceField,
    p: Point,
    keep_m: f64,
    sizes: &BubbleSizes,
) -> Bubble {
    let own = field.clearance_m(p) - keep_m;
    let mut best = Bubble { centre: p, radius_m: own.min(sizes.max_m) };
    let wanted = sizes.wanted_m.min(sizes.max_m);
    if own >= wanted {
        return best;
    }
    let away = field.away(p);
    if away == Vector::zeros() {
        return best;
    }
    let mut largest = best;
    let mut consider = |shift: f64| {
        let centre = p + away * shift;
        let radius_m = (field.clearance_m(centre) - keep_m).min(sizes.max_m);
        let bubble = Bubble { centre, radius_m };
        if radius_m > best.radius_m && (own < 0.0 || radius_m >= shift - SLIP_M) {
            best = bubble;
        }
        if radius_m > largest.radius_m {
            largest = bubble;
        }
        radius_m
    };
    // Moving away from one wall gains as much radius as distance, until the opposite wall takes
    // over and the radius falls as fast: the peak of that tent follows from one look-up.
    let full = wanted - own;
    let at_full = consider(full);
    if at_full < wanted - 1e-3 {
        let peak = (0.5 * (at_full + full - own)).clamp(0.0, full);
        for shift in [peak, 0.5 * peak, 0.25 * peak] {
            consider(shift);
        }
    }
    if best.radius_m < USEFUL_M { largest } else { best }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Free between two walls along x, at y = 0 and y = width.
    struct Corridor {
        width_m: f64,
    }

    impl ClearanceField for Corridor {
        fn clearance_m(&self, p: Point) -> f64 {
            p.y.min(self.width_m - p.y).max(0.0)
        }
    }

    const SIZES: BubbleSizes = BubbleSizes { wanted_m: 0.6, max_m: 0.8 };

    #[test]
    fn a_point_in_the_open_keeps_its_place() {
        let bubble = bubble_at(&Corridor { width_m: 4.0 }, Point::new(1.0, 2.0), 0.25, &SIZES);
        assert_eq!(bubble, Bubble { centre: Point::new(1.0, 2.0), radius_m: 0.8 });
    }

    #[test]
    fn near_a_wall_the_centre_moves_off_until_the_wanted_radius_fits() {
        let bubble = bubble_at(&Corridor { width_m: 4.0 }, Point::new(1.0, 0.3), 0.25, &SIZES);
        assert!((bubble.radius_m - 0.6).abs() < 1e-9, "{bubble:?}");
        assert!((bubble.centre - Point::new(1.0, 0.85)).norm() < 1e-9);
    }

    #[test]
    fn in_a_narrow_corridor_the_centre_moves_to_the_middle() {
        let bubble = bubble_at(&Corridor { width_m: 1.0 }, Point::new(1.0, 0.3), 0.25, &SIZES);
        assert!((bubble.centre.y - 0.5).abs() < 1e-9, "{bubble:?}");
        assert!((bubble.radius_m - 0.25).abs() < 1e-9);
    }

    #[test]
    fn every_point_of_a_bubble_has_the_clearance_and_the_point_lies_in_it() {
        let field = Corridor { width_m: 1.7 };
        for i in 0..=100 {
            let p = Point::new(0.0, 0.25 + 1.2 * f64::from(i) / 100.0);
            let bubble = bubble_at(&field, p, 0.25, &SIZES);
            assert!(
                (p - bubble.centre).norm() <= bubble.radius_m + SLIP_M + 1e-9,
                "{p} {bubble:?}"
            );
            for side in [-1.0, 1.0] {
                let edge = bubble.centre + Vector::new(0.0, side * bubble.radius_m);
                assert!(field.clearance_m(edge) >= 0.25 - 1e-9);
            }
        }
    }

    #[test]
    fn in_a_corner_the_bubble_moves_out_of_it() {
        struct Corner;
        impl ClearanceField for Corner {
            fn clearance_m(&self, p: Point) -> f64 {
                p.x.min(p.y).max(0.0)
            }
        }
        let bubble = bubble_at(&Corner, Point::new(0.251, 0.2512), 0.25, &SIZES);
        assert!(bubble.radius_m > 0.05, "{bubble:?}");
        let low = bubble.centre - Vector::new(bubble.radius_m, bubble.radius_m);
        assert!(low.x >= 0.25 - 1e-9 && low.y >= 0.25 - 1e-9);
    }

    #[test]
    fn a_point_too_near_the_wall_gets_a_bubble_beside_it() {
        let bubble = bubble_at(&Corridor { width_m: 2.0 }, Point::new(0.0, 0.1), 0.25, &SIZES);
        assert!(bubble.radius_m > 0.5);
        assert!(bubble.centre.y - bubble.radius_m >= 0.25 - 1e-9);
    }
}
