//! Turning round onto the way that the car came by.
//!
//! A car without reverse gear gets out of a dead end if it can turn onto its own tracks: they are
//! known to have room, and bends that it drove one way it can drive the other. A half turn alone
//! promises less: in a nook it may end facing the next wall.

use super::dubins::{self, Dubins};
use super::{Room, coarse_first};
use crate::frames::{Pose, wrap_angle};
use crate::plan::{Path, PathPoint};

/// Distance between two looks at the room, and between two samples of the result, metres.
const SAMPLE_M: f64 = 0.03;
/// Shorter pieces are none, metres.
const LEAST_M: f64 = 1e-6;

/// A drivable way from `from` onto the way that the car came by, in the opposite direction: up to
/// three arcs and straights to one of the poses in `behind` (as they were driven, the nearest ones
/// first), each as tight as `radius_m`. Of the first pose that can be reached the shortest way.
/// `None` if none can be reached.
pub fn retreat<R: Room>(room: &R, from: Pose, behind: &[Pose], radius_m: f64) -> Option<Path> {
    behind.iter().find_map(|pose| {
        let heading_rad = wrap_angle(pose.heading_rad + std::f64::consts::PI);
        let to = Pose { heading_rad, ..*pose };
        let mut ways = dubins::ways(from, to, radius_m);
        ways.sort_by(|a, b| a.length_m.total_cmp(&b.length_m));
        let way = ways.iter().find(|way| fits_along(room, from, way))?;
        Some(arcs_path(from, &way.pieces))
    })
}

/// Whether the disc fits at all samples of a way.
fn fits_along<R: Room>(room: &R, from: Pose, way: &Dubins) -> bool {
    let mut end = from;
    let pieces = way.pieces.map(|(curvature_pm, length_m)| {
        let counts = length_m > LEAST_M;
        let steps = if counts { (length_m / SAMPLE_M).ceil() as usize } else { 0 };
        let piece = (end, curvature_pm, length_m, steps);
        if counts {
            end = end.along_arc(length_m, curvature_pm * length_m);
        }
        piece
    });
    room.fits(end.position)
        && coarse_first(|first, stride| {
            pieces.iter().all(|(begin, curvature_pm, length_m, steps)| {
                (first..*steps).step_by(stride).all(|i| {
                    let along = length_m * i as f64 / *steps as f64;
                    room.fits(begin.along_arc(along, curvature_pm * along).position)
                })
            })
        })
}

/// The path along arcs and straights, given as curvature and length in metres. Each sample carries
/// the curvature of the piece that follows it, the last that of the last one.
pub fn arcs_path(from: Pose, pieces: &[(f64, f64)]) -> Path {
    let sample = |pose: Pose, s_m: f64, curvature_pm: f64| {
        let Pose { position, heading_rad } = pose;
        PathPoint { s_m, position, heading_rad, curvature_pm }
    };
    let pieces = pieces.iter().copied().filter(|(_, length_m)| *length_m > LEAST_M);
    let (mut end, mut length, mut last_pm) = (from, 0.0, 0.0);
    for (curvature_pm, length_m) in pieces.clone() {
        end = end.along_arc(length_m, curvature_pm * length_m);
        (length, last_pm) = (length + length_m, curvature_pm);
    }
    let samples = pieces
        .scan((from, 0.0), |(pose, s_m), (curvature_pm, length_m)| {
            let begin = (*pose, *s_m);
            *pose = pose.along_arc(length_m, curvature_pm * length_m);
            *s_m += length_m;
            Some((begin, curvature_pm, length_m))
        })
        .flat_map(move |((pose, s_m), curvature_pm, length_m)| {
            let steps = (length_m / SAMPLE_M).ceil() as u32;
            (0..steps).map(move |i| {
                let along = length_m * f64::from(i) / f64::from(steps);
                sample(pose.along_arc(along, curvature_pm * along), s_m + along, curvature_pm)
            })
        })
        .chain(std::iter::once(sample(end, length, last_pm)));
    Path { points: samples.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Point;
    use std::f64::consts::PI;

    const RADIUS_M: f64 = 0.5;
    const KEEP_M: f64 = 0.25;

    /// A hallway along x of this width about y = 0, closed at x = 0.
    struct Hallway {
        width_m: f64,
    }

    impl Room for Hallway {
        fn fits(&self, p: Point) -> bool {
            p.x <= -KEEP_M && p.y.abs() <= 0.5 * self.width_m - KEEP_M
        }
    }

    fn came_straight(to_x: f64) -> Vec<Pose> {
        (0..10).map(|i| Pose::new(to_x - 0.3 * f64::from(i), 0.0, 0.0)).collect()
    }

    #[test]
    fn a_car_in_a_wide_hallway_gets_back_onto_its_tracks() {
        let room = Hallway { width_m: 2.5 };
        let from = Pose::new(-1.2, 0.0, 0.0);
        let path = retreat(&room, from, &came_straight(-1.2), RADIUS_M).expect("there is room");
        let last = path.points.last().expect("a path has samples");
        assert!(last.position.y.abs() < 1e-6 && last.position.x < -1.1, "{last:?}");
        assert!((last.heading_rad.abs() - PI).abs() < 1e-6);
        for w in path.points.windows(2) {
            let ds = w[1].s_m - w[0].s_m;
            assert!(ds > 0.0 && ds <= SAMPLE_M + 1e-9);
            assert!(room.fits(w[1].position));
            let turned = wrap_angle(w[1].heading_rad - w[0].heading_rad);
            assert!((turned - w[0].curvature_pm * ds).abs() < 1e-9);
            assert!(w[0].curvature_pm.abs() <= 1.0 / RADIUS_M + 1e-9);
        }
    }

    #[test]
    fn nose_on_to_the_end_or_in_a_narrow_hallway_it_does_not() {
        let (wide, narrow) = (Hallway { width_m: 2.5 }, Hallway { width_m: 1.3 });
        let nose_on = Pose::new(-0.5, 0.0, 0.0);
        assert_eq!(retreat(&wide, nose_on, &came_straight(-0.5), RADIUS_M), None);
        let from = Pose::new(-2.0, 0.0, 0.0);
        assert_eq!(retreat(&narrow, from, &came_straight(-2.0), RADIUS_M), None);
    }

    /// A hall, a passage from it, and a nook beside its end: half a turn leads into the nook, facing
    /// its wall.
    struct Nook;

    impl Room for Nook {
        fn fits(&self, p: Point) -> bool {
            let within = |v: f64, low: f64, high: f64| v >= low + KEEP_M && v <= high - KEEP_M;
            let hall = within(p.x, -4.0, 0.0) && within(p.y, -2.0, 2.0);
            let passage = within(p.x, -0.5, 1.6) && within(p.y, -0.35, 0.4);
            let nook = within(p.x, 0.3, 1.6) && within(p.y, -0.35, 1.4);
            hall || passage || nook
        }
    }

    #[test]
    fn room_for_half_a_turn_is_not_enough() {
        let room = Nook;
        let from = Pose::new(0.6, 0.05, 0.0);
        let half_turn = dubins::shortest(from, Pose::new(0.6, 1.05, PI), RADIUS_M);
        let half_turn = arcs_path(from, &half_turn.pieces);
        assert!(half_turn.points.iter().all(|p| room.fits(p.position)), "the example is right");
        let behind: Vec<Pose> =
            (0..10).map(|i| Pose::new(0.6 - 0.3 * f64::from(i), 0.05, 0.0)).collect();
        assert!(retreat(&room, from, &behind, RADIUS_M).is_none());
    }
}
