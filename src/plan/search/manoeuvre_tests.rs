use super::*;
use crate::frames::wrap_angle;
use crate::map::{Cell, CellRect};
use crate::plan::search::{GuideSearch, SearchParams, SearchQuery, Terrain};
use crate::predict::NoPrediction;
use proptest::prelude::*;
use std::f64::consts::{FRAC_PI_2, PI};

const LIMIT_PM: f64 = 2.0;
const GRIP_MPS2: f64 = 8.829;

/// Room by exact rectangles: the disc's centre must lie in one of them.
struct Boxes(Vec<[f64; 4]>);

impl Room for Boxes {
    fn fits(&self, c: Point) -> bool {
        self.0.iter().any(|[x0, y0, x1, y1]| c.x >= *x0 && c.x <= *x1 && c.y >= *y0 && c.y <= *y1)
    }
}

/// A guide along a polyline, known up to some distance.
fn guide(corners: &[(f64, f64)], known_m: f64) -> Guide {
    let mut points = vec![Point::new(corners[0].0, corners[0].1)];
    let mut known_until = 1;
    let mut s = 0.0;
    for corner in &corners[1..] {
        let (from, to) = (*points.last().unwrap(), Point::new(corner.0, corner.1));
        let steps = ((to - from).norm() / 0.1).ceil() as u32;
        for i in 1..=steps {
            points.push(from + (to - from) * (f64::from(i) / f64::from(steps)));
            s += (to - from).norm() / f64::from(steps);
            known_until += usize::from(s <= known_m);
        }
    }
    Guide { points, known_until, length_m: s, cost_s: s, expanded: 0, asked: 0 }
}

fn query(pose: Pose, guide: &Guide) -> ManoeuvreQuery<'_> {
    ManoeuvreQuery {
        pose,
        speed_mps: 0.0,
        guide,
        curvature_limit_pm: LIMIT_PM,
        acceleration_limit_mps2: GRIP_MPS2,
    }
}

fn find<R: Room>(room: &R, query: &ManoeuvreQuery<'_>) -> Result<Option<Manoeuvre>, NoManoeuvre> {
    ManoeuvreSearch::default().find(room, query, &ManoeuvreParams::default())
}

/// Everything that a manoeuvre promises, from its points alone.
fn check<R: Room>(room: &R, query: &ManoeuvreQuery<'_>, found: &Manoeuvre) {
    let points = &found.path.points;
    let (first, last) = (points[0], points[points.len() - 1]);
    assert!((first.position - query.pose.position).norm() < 1e-9);
    assert!(wrap_angle(first.heading_rad - query.pose.heading_rad).abs() < 1e-9);
    assert_eq!(first.s_m, 0.0);
    for pair in points.windows(2) {
        let (a, b) = (pair[0], pair[1]);
        let ds = b.s_m - a.s_m;
        assert!(ds > 0.0 && ds <= 0.05 + 1e-9, "{ds}");
        assert!(a.curvature_pm.abs() <= LIMIT_PM);
        let turn = wrap_angle(b.heading_rad - a.heading_rad);
        assert!((turn - a.curvature_pm * ds).abs() < 1e-9, "heading follows curvature");
        // The chord of an arc, by its own geometry.
        let chord = b.position - a.position;
        let mean = a.heading_rad + 0.5 * turn;
        assert!(wrap_angle(chord.y.atan2(chord.x) - mean).abs() < 1e-6);
        assert!(chord.norm() <= ds + 1e-9 && chord.norm() > 0.99 * ds);
        assert!(room.fits(a.position) || (a.position - query.pose.position).norm() < 0.16);
    }
    assert!(room.fits(last.position));
    if let Some(index) = found.joins_at {
        assert!(index < query.guide.known_until, "it joins where the way is known");
        assert!((query.guide.points[index] - last.position).norm() < 1e-6);
        assert!(wrap_angle(direction(query.guide, index) - last.heading_rad).abs() < 1e-6);
    }
    // No way to the guide's end is shorter than the straight line.
    let end = query.guide.points.last().unwrap();
    assert!(found.left_m >= (end - last.position).norm() - 1e-6, "{} m", found.left_m);
}

/// A corridor of 2.4 m along x that ends at x = 0, the disc's radius and margin taken off.
fn dead_end() -> Boxes {
    Boxes(vec![[-10.0, -0.95, -0.25, 0.95]])
}

#[test]
fn in_a_dead_end_the_car_turns_round() {
    let room = dead_end();
    for (x, y) in [(-1.4, 0.0), (-1.3, 0.3), (-2.0, -0.6), (-1.0, 0.9), (-1.0, -0.9), (-4.0, 0.0)] {
        let back = guide(&[(x, y), (-9.0, 0.0)], 100.0);
        let query = query(Pose::new(x, y, 0.0), &back);
        let found = find(&room, &query).unwrap().expect("the guide leads the other way");
        check(&room, &query, &found);
        let joins_at = found.joins_at.expect("a turn fits");
        // Half a circle, a swing or two, and the way to the join.
        let along = (back.points[joins_at] - query.pose.position).norm();
        let extra = found.path.length_m() - along;
        assert!((1.5..4.5).contains(&extra), "({x}, {y}): {extra} more than {along}");
    }
}

#[test]
fn nose_on_to_the_wall_the_car_turns_if_a_turn_of_its_tightest_radius_fits() {
    let room = dead_end();
    // 0.51 m of room ahead of the centre: just what a turn of 0.5 m takes.
    let (x, y) = (-0.25 - 0.51, 0.9);
    let back = guide(&[(x, y), (-9.0, 0.0)], 100.0);
    let near = query(Pose::new(x, y, 0.0), &back);
    let found = find(&room, &near).unwrap().unwrap();
    check(&room, &near, &found);
    assert!(found.joins_at.is_some());
    // At 0.4 m no turn comes parallel to the wall before the disc touches it.
    let (x, y) = (-0.25 - 0.4, 0.9);
    let back = guide(&[(x, y), (-9.0, 0.0)], 100.0);
    match find(&room, &query(Pose::new(x, y, 0.0), &back)) {
        Err(_) => {}
        Ok(found) => assert_eq!(found.unwrap().joins_at, None),
    }
}

#[test]
fn the_way_ahead_needs_no_manoeuvre() {
    let room = dead_end();
    let ahead = guide(&[(-8.0, 0.0), (-3.0, 0.5)], 100.0);
    assert_eq!(find(&room, &query(Pose::new(-8.0, 0.0, 0.3), &ahead)), Ok(None));
    let there = guide(&[(-8.0, 0.0), (-8.1, 0.0)], 100.0);
    assert_eq!(find(&room, &query(Pose::new(-8.0, 0.0, 0.0), &there)), Ok(None), "at the goal");
    assert_ne!(find(&room, &query(Pose::new(-8.0, 0.0, -0.6), &ahead)), Ok(None));
}

#[test]
fn in_a_box_too_small_to_turn_there_is_no_manoeuvre() {
    let room = Boxes(vec![[-0.2, -0.2, 0.2, 0.2], [-9.0, -0.05, -0.2, 0.05]]);
    let back = guide(&[(0.0, 0.0), (-8.0, 0.0)], 100.0);
    let error = find(&room, &query(Pose::new(0.0, 0.0, 0.0), &back)).unwrap_err();
    assert!(error.to_string().contains("heading 0.00"), "{error}");
}

#[test]
fn a_guide_that_is_unknown_at_once_still_gives_a_direction() {
    // Known: a box of 3 m; the guide leaves it through its left side after 0.25 m.
    let room = Boxes(vec![[-1.5, -0.25, 1.5, 1.5]]);
    let left = guide(&[(-1.0, 0.0), (-1.0, -4.0)], 0.25);
    let query = query(Pose::new(-1.0, 0.0, FRAC_PI_2), &left);
    let found = find(&room, &query).unwrap().unwrap();
    check(&room, &query, &found);
    assert_eq!(found.joins_at, None);
    assert!(found.left_m < 6.0, "{} m", found.left_m);
    let end = found.path.points.last().unwrap();
    assert!(end.heading_rad.abs() > 2.0 || end.heading_rad < 0.0, "turned about: {end:?}");
}

/// A slit too narrow for the squares of the plane, askew, and a nook at its end.
struct Slit;

impl Room for Slit {
    fn fits(&self, c: Point) -> bool {
        let slit = (-0.05..1.3).contains(&c.x) && (c.y - 0.4 * c.x).abs() < 0.03;
        slit || ((1.2..1.6).contains(&c.x) && (0.3..0.9).contains(&c.y))
    }
}

#[test]
fn a_way_that_the_plane_does_not_know_is_no_hundred_metres_long() {
    // The guide comes to the nook another way, and the car cannot turn there.
    let around = guide(&[(0.0, 0.0), (0.0, 1.2), (1.4, 0.8), (1.4, -3.0)], 100.0);
    let query = query(Pose::new(0.0, 0.0, 0.4_f64.atan()), &around);
    let found = find(&Slit, &query).unwrap().expect("the guide leads aside");
    check(&Slit, &query, &found);
    assert_eq!(found.joins_at, None);
    assert!(found.path.length_m() > 0.5, "it goes on to the nook");
    assert!((3.0..6.0).contains(&found.left_m), "{} m", found.left_m);
}

#[test]
fn at_speed_the_first_turn_is_no_tighter_than_the_tyres_hold() {
    let room = Boxes(vec![[-3.0, -6.0, 8.0, 6.0]]);
    let left = guide(&[(0.0, 0.0), (0.0, 5.5)], 100.0);
    for speed_mps in [1.0, 2.0, 3.0, 4.0] {
        let query = ManoeuvreQuery { speed_mps, ..query(Pose::new(0.0, 0.0, 0.0), &left) };
        let found = find(&room, &query).unwrap().unwrap();
        check(&room, &query, &found);
        assert!(found.joins_at.is_some());
        // Braking with half the grip leaves sqrt(3)/2 of it for turning.
        for p in &found.path.points {
            let v2 = (speed_mps * speed_mps - GRIP_MPS2 * p.s_m).max(0.0);
            assert!(v2 * p.curvature_pm.abs() <= 0.867 * GRIP_MPS2, "{speed_mps} {p:?}");
        }
    }
}

#[test]
fn a_mask_has_no_room_outside_its_bounds() {
    let bounds = CellRect { x0: -1, y0: 2, x1: 1, y1: 4 };
    let blocked = [false, true, true, false];
    let room = MaskRoom { resolution_m: 0.5, bounds, blocked: &blocked };
    let fits = |x, y| room.fits(Point::new(x, y));
    assert!(fits(-0.25, 1.25) && fits(0.25, 1.75));
    assert!(!fits(0.25, 1.25) && !fits(-0.25, 1.75));
    assert!(!fits(-0.51, 1.25) && !fits(0.51, 1.75) && !fits(0.25, 2.01) && !fits(-0.25, 0.99));
}

#[test]
fn a_start_that_the_mask_blocks_by_a_hair_can_be_left() {
    let room = dead_end();
    let (x, y) = (-5.0, 0.96);
    let back = guide(&[(x, y), (-9.0, 0.0)], 100.0);
    let query = query(Pose::new(x, y, -0.1), &back);
    assert!(!room.fits(query.pose.position));
    let found = find(&room, &query).unwrap().unwrap();
    check(&room, &query, &found);
    assert!(found.joins_at.is_some());
}

/// A maze piece on a grid: corridor of 2.4 m along x with a side corridor, walls one cell thick.
fn tee() -> (CellRect, Vec<Cell>, Vec<bool>) {
    let (width, height) = (120, 80);
    let cell = |x: i32, y: i32| {
        let corridor = (1..25).contains(&y) && (1..119).contains(&x);
        let side = (50..74).contains(&x) && (1..79).contains(&y);
        if corridor || side { Cell::Free } else { Cell::Occupied }
    };
    let cells: Vec<Cell> = (0..width * height).map(|at| cell(at % width, at / width)).collect();
    let blocked = (0..width * height)
        .map(|at| {
            let (x, y) = (at % width, at / width);
            (-3..=3_i32).any(|dy| {
                (-3..=3_i32).any(|dx| {
                    let gap = |d: i32| (f64::from(d.abs()) * 0.1 - 0.05).max(0.0);
                    let inside = (0..width).contains(&(x + dx)) && (0..height).contains(&(y + dy));
                    gap(dx).hypot(gap(dy)) < 0.25 && (!inside || cell(x + dx, y + dy) != Cell::Free)
                })
            })
        })
        .collect();
    (CellRect { x0: 0, y0: 0, x1: width, y1: height }, cells, blocked)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]
    #[test]
    fn in_corridors_every_heading_finds_a_start_that_keeps_its_promises(
        x in 1.5..10.5, y in 0.8..1.7, heading in -PI..PI, goal in 0..3_usize,
    ) {
        let (bounds, cells, blocked) = tee();
        let terrain = Terrain { resolution_m: 0.1, bounds, cells: &cells, lethal: &blocked };
        let goal = [Point::new(0.8, 1.3), Point::new(11.3, 1.3), Point::new(6.2, 7.2)][goal];
        let ask = SearchQuery {
            start: Point::new(x, y), goal, goal_radius_m: 0.0, v_ref_mps: 4.0, through_unknown: true,
        };
        let guide = GuideSearch::new()
            .find(&terrain, &ask, &mut NoPrediction, &SearchParams::default())
            .unwrap();
        let room = MaskRoom { resolution_m: 0.1, bounds, blocked: &blocked };
        let query = query(Pose::new(x, y, heading), &guide);
        match find(&room, &query) {
            Ok(Some(found)) => {
                check(&room, &query, &found);
                // Within 1.2 m of an end wall it depends on the heading.
                let roomy = (2.2..9.7).contains(&x);
                prop_assert!(found.joins_at.is_some() || !roomy, "{found:?}");
            }
            Ok(None) => {
                let ahead = guide.points.iter().find(|p| (*p - ask.start).norm() >= 1.0);
                if let Some(ahead) = ahead {
                    let to = ahead - ask.start;
                    prop_assert!(wrap_angle(to.y.atan2(to.x) - heading).abs() <= 0.3501);
                }
            }
            Err(error) => prop_assert!(!(2.2..9.7).contains(&x), "{error}"),
        }
    }
}
