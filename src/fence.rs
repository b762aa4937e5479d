//! Where a person wants the car to stay: polygons on the map, told apart from anything that a
//! sensor sees.

use crate::frames::Point;

/// A closed polygon, map frame, without its first corner repeated.
pub type Polygon = Vec<Point>;

/// Where the car may drive.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fence {
    /// Places to stay in. The car must be inside all polygons of at least one group; without any
    /// group it may be anywhere.
    pub inside: Vec<Vec<Polygon>>,
    /// Places to stay out of.
    pub outside: Vec<Polygon>,
}

impl Fence {
    /// Whether there is no fence at all.
    pub const fn is_empty(&self) -> bool {
        self.inside.is_empty() && self.outside.is_empty()
    }

    /// Whether a point is where the car may be.
    pub fn allows(&self, p: Point) -> bool {
        let inside = self.inside.is_empty()
            || self.inside.iter().any(|group| group.iter().all(|polygon| contains(polygon, p)));
        inside && !self.outside.iter().any(|polygon| contains(polygon, p))
    }
}

/// Whether a point lies inside a polygon (even-odd rule).
pub fn contains(polygon: &[Point], p: Point) -> bool {
    edges(polygon).filter(|edge| crossing_x(edge, p.y).is_some_and(|x| x > p.x)).count() % 2 == 1
}

/// The edges of a closed polygon.
pub fn edges(polygon: &[Point]) -> impl Iterator<Item = [Point; 2]> + '_ {
    polygon.iter().zip(polygon.iter().cycle().skip(1)).map(|(a, b)| [*a, *b])
}

/// Where an edge crosses the horizontal line through `y`; its upper end does not belong to it.
pub fn crossing_x([a, b]: &[Point; 2], y: f64) -> Option<f64> {
    ((a.y <= y) != (b.y <= y)).then(|| a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x))
}

/// A circle as a polygon around it (`outer`) or inside it: nowhere more than 2 % of the radius off.
pub fn circle(centre: Point, radius_m: f64, outer: bool) -> Polygon {
    const CORNERS: u32 = 16;
    let step = std::f64::consts::TAU / f64::from(CORNERS);
    let reach_m = if outer { radius_m / (step / 2.0).cos() } else { radius_m };
    (0..CORNERS)
        .map(|i| {
            let (sin, cos) = (f64::from(i) * step).sin_cos();
            Point::new(centre.x + reach_m * cos, centre.y + reach_m * sin)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(x: f64, y: f64, side: f64) -> Polygon {
        [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)]
            .map(|(dx, dy)| Point::new(x + dx, y + dy))
            .to_vec()
    }

    #[test]
    fn a_polygon_holds_what_is_inside_it_also_where_it_is_not_convex() {
        let notch = [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (2.0, 1.0), (0.0, 4.0)]
            .map(|(x, y)| Point::new(x, y));
        assert!(contains(&notch, Point::new(0.5, 2.0)));
        assert!(contains(&notch, Point::new(3.5, 2.0)));
        assert!(!contains(&notch, Point::new(2.0, 2.0)));
        assert!(!contains(&notch, Point::new(-1.0, 0.0)));
        assert!(!contains(&notch, Point::new(5.0, 4.0)));
    }

    #[test]
    fn all_polygons_of_one_group_and_none_of_those_to_stay_out_of() {
        let fence = Fence {
            inside: vec![
                vec![square(0.0, 0.0, 4.0), square(2.0, 0.0, 4.0)],
                vec![square(8.0, 0.0, 2.0)],
            ],
            outside: vec![square(8.5, 0.5, 0.5)],
        };
        assert!(fence.allows(Point::new(3.0, 1.0)), "in both of a group");
        assert!(!fence.allows(Point::new(1.0, 1.0)), "in one of a group");
        assert!(fence.allows(Point::new(9.5, 1.5)), "in the other group");
        assert!(!fence.allows(Point::new(8.7, 0.7)), "in a hole");
        assert!(Fence::default().allows(Point::new(99.0, 99.0)));
    }

    #[test]
    fn a_circle_becomes_a_polygon_on_the_safe_side() {
        let centre = Point::new(3.0, -2.0);
        for i in 0..100 {
            let (sin, cos) = (f64::from(i) * 0.0628).sin_cos();
            let at = |r: f64| Point::new(centre.x + r * cos, centre.y + r * sin);
            assert!(contains(&circle(centre, 2.0, true), at(1.999)));
            assert!(!contains(&circle(centre, 2.0, true), at(2.041)));
            assert!(!contains(&circle(centre, 2.0, false), at(2.001)));
            assert!(contains(&circle(centre, 2.0, false), at(1.96)));
        }
    }
}
