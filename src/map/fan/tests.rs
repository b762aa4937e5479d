//! What a fan of beams proves to be free, and what it does not.

use super::*;
use crate::time::Instant;

#[test]
fn the_fast_angle_agrees_with_the_exact_one() {
    for i in 0..100_000 {
        let angle = TAU * f64::from(i) / 100_000.0;
        let (sin, cos) = angle.sin_cos();
        let error = f64::from(angle_of((3.0 * cos) as f32, (3.0 * sin) as f32)) - angle;
        assert!(error.abs() < 2e-5 || (error.abs() - TAU).abs() < 2e-5, "{angle} {error}");
    }
}

#[test]
fn the_silhouette_holds_every_corner_between_its_two() {
    for (x, y) in [(3, 2), (3, 0), (3, -2), (0, 2), (0, -2), (-3, 2), (-3, 0), (-3, -2)] {
        let centre = Vector::new(f64::from(x), f64::from(y));
        let half = Vector::new(0.5, 0.5);
        let (low, high) = (centre - half, centre + half);
        let corners = [low, Vector::new(high.x, low.y), high, Vector::new(low.x, high.y)];
        let (a, b) = silhouette(low, high).unwrap();
        for c in corners {
            assert!(corners[a].perp(&c) >= 0.0 && c.perp(&corners[b]) >= 0.0, "{centre}");
        }
    }
    assert_eq!(silhouette(Vector::new(-1.0, -1.0), Vector::new(1.0, 1.0)), None);
}

fn limits() -> Limits {
    Limits { spacing_m: 0.05, straight_m: 0.005, range_m: 100.0 }
}

/// A scan whose range in each direction (map frame) is given.
fn scan(count: usize, first: f64, step: f64, range: impl Fn(f64) -> f64) -> Scan {
    let angle = |i: usize| first + step * i as f64;
    Scan {
        stamp: Instant::ZERO,
        sequence: 0,
        angle_first_rad: first,
        angle_step_rad: step,
        range_max_m: 7.5,
        ranges_m: (0..count).map(|i| range(angle(i)) as f32).collect(),
    }
}

fn square(x: f64, y: f64) -> (Vector, Vector) {
    let half = Vector::new(0.04, 0.04);
    (Vector::new(x, y) - half, Vector::new(x, y) + half)
}

#[test]
fn a_fan_covers_what_lies_within_its_range_and_no_more() {
    let mut fan = Fan::default();
    for step in [TAU / 1080.0, -TAU / 1080.0] {
        let scan = scan(1080, 0.3, step, |_| 3.0);
        fan.set(&Pose::new(5.0, 1.0, 0.7), &scan, &limits());
        for i in 0..360 {
            let (sin, cos) = f64::from(i).to_radians().sin_cos();
            for (distance, free) in [(0.2, true), (2.9, true), (3.0, false), (4.0, false)] {
                let (low, high) = square(distance * cos, distance * sin);
                assert_eq!(fan.covers(low, high), free, "{i} degrees, {distance} m");
            }
        }
        let (low, high) = square(0.0, 0.01);
        assert!(fan.covers(low, high), "the square around the sensor");
    }
}

#[test]
fn a_glance_never_contradicts_the_exact_test() {
    let mut fan = Fan::default();
    let (mut yes, mut no) = (0, 0);
    let layouts = [(1080, 0.3, TAU / 1080.0), (900, -2.0, 0.005), (718, 0.1, TAU / 718.4)];
    for (count, first, step) in layouts {
        let range = |angle: f64| 3.0 + (7.0 * angle).sin() + 0.5 * (31.0 * angle).sin().signum();
        fan.set(&Pose::new(0.0, 0.0, 0.4), &scan(count, first, step, range), &limits());
        for iy in -50..50 {
            for ix in -50..50 {
                let (x, y) = (0.1 * f64::from(ix) + 0.03, 0.1 * f64::from(iy) + 0.02);
                let (low, high) = square(x, y);
                let exact = fan.covers(low, high);
                match fan.glance(x as f32, y as f32, 0.0566) {
                    Some(true) => assert!(exact, "({x}, {y})"),
                    Some(false) => no += 1,
                    None => continue,
                }
                yes += usize::from(exact);
                if count == 1080 && exact {
                    assert_ne!(fan.glance(x as f32, y as f32, 0.0566), Some(false));
                }
            }
        }
    }
    assert!(yes > 3000 && no > 3000, "{yes} {no}");
}

#[test]
fn behind_an_edge_the_gap_between_its_two_beams_is_not_proven() {
    let mut fan = Fan::default();
    // The beam at 0 is the last one on an edge 2 m away.
    let range = |angle: f64| if angle < 0.001 { 2.0 } else { 7.5 };
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(1000, -2.91, 0.00582, range), &limits());
    // At 3 m the next beam passes 0.0175 m above.
    for (lowest, free) in [(-0.01, false), (0.01, false), (0.019, true)] {
        let (low, high) = square(3.0, lowest + 0.04);
        assert_eq!(fan.covers(low, high), free, "{lowest}");
    }
}

#[test]
fn where_the_surface_is_not_straight_half_a_beam_spacing_is_kept_off() {
    let mut fan = Fan::default();
    let mut scan = scan(1080, 0.0, TAU / 1080.0, |_| 3.0);
    for range in scan.ranges_m.iter_mut().step_by(2) {
        *range = 3.05;
    }
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan, &limits());
    // 3 m less half of 0.0175 m is 2.991 m.
    for (far, free) in [(2.985, true), (2.995, false)] {
        let (low, high) = square(far - 0.04, 0.0);
        assert_eq!(fan.covers(low, high), free, "{far}");
    }
}

#[test]
fn a_silent_beam_breaks_the_fan_where_it_points() {
    let mut fan = Fan::default();
    let mut scan = scan(1080, 0.0, TAU / 1080.0, |_| 3.0);
    scan.ranges_m[0] = f32::NAN;
    scan.ranges_m[270] = 0.0;
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan, &limits());
    for (x, y, free) in [
        (2.0, 0.0, false),
        (2.0, 0.049, false),
        (2.0, 0.056, true),
        (0.0, 2.0, false),
        (0.0, -2.0, true),
        (0.0, 0.0, false),
    ] {
        let (low, high) = square(x, y);
        assert_eq!(fan.covers(low, high), free, "({x}, {y})");
    }
}

#[test]
fn a_partial_fan_ends_at_its_outer_beams() {
    let mut fan = Fan::default();
    let step = 0.005;
    for (first, step) in [(-0.5, step), (0.5, -step)] {
        fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(201, first, step, |_| 3.0), &limits());
        for (angle, free) in [(0.0, true), (0.45, true), (-0.45, true), (0.5, false)] {
            for sign in [1.0, -1.0] {
                let (low, high) = square(2.0 * f64::cos(angle), sign * 2.0 * f64::sin(angle));
                assert_eq!(fan.covers(low, high), free, "{angle}");
            }
        }
        for (x, y) in [(-2.0, 0.0), (0.0, 2.0), (0.0, 0.0), (-2.0, -0.5)] {
            let (low, high) = square(x, y);
            assert!(!fan.covers(low, high));
        }
    }
}

#[test]
fn a_turn_and_one_beam_is_still_a_full_circle() {
    let mut fan = Fan::default();
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(1081, 0.0, TAU / 1080.0, |_| 3.0), &limits());
    let (low, high) = square(2.0, 0.0);
    assert!(fan.full && fan.covers(low, high));
}

#[test]
fn a_turn_of_rounded_steps_closes() {
    for beams in [360, 720, 1080, 2048, 4096] {
        let step = (TAU / f64::from(beams) * 1e9).round() / 1e9;
        let wide_gap = TAU / (f64::from(beams) + 0.009);
        for step in [step, -step, step - 1e-9, step + 1e-9, wide_gap] {
            let scan = scan(beams as usize, -0.5 * TAU, step, |_| 0.9);
            assert!(scan.is_full_circle());
            let mut fan = Fan::default();
            fan.set(&Pose::new(0.0, 0.0, 0.0), &scan, &limits());
            let (low, high) = square(-0.8, 0.0);
            assert!(fan.full && fan.covers(low, high), "{beams} beams of {step} rad");
            // Nor does the quick answer deny anything where the turn closes.
            for i in -200..=200 {
                let y = i as f32 * 1e-5;
                assert_ne!(fan.glance(-0.8, y, 0.05), Some(false), "{beams} of {step} rad, {y} m");
            }
        }
    }
}

#[test]
fn beams_too_far_apart_prove_nothing() {
    let mut fan = Fan::default();
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(360, 0.0, TAU / 360.0, |_| 7.5), &limits());
    // 0.05 m at one beam a degree: 2.86 m.
    let (near, far) = (square(2.7, 0.0), square(2.9, 0.0));
    assert!(fan.covers(near.0, near.1) && !fan.covers(far.0, far.1));
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(5, 0.0, TAU / 5.0, |_| 7.5), &limits());
    assert!(!fan.covers(Vector::new(-0.01, -0.01), Vector::new(0.01, 0.01)));
}

#[test]
fn floor_along_a_grazed_wall_is_proven_and_the_shadow_of_an_edge_is_not() {
    let mut fan = Fan::default();
    // A wall along y = -1; beyond x = 4 it has ended.
    let range = |angle: f64| {
        let wall = -1.0 / angle.sin();
        if wall > 0.0 && wall * angle.cos() < 4.0 { wall } else { 7.5 }
    };
    fan.set(&Pose::new(0.0, 0.0, 0.0), &scan(1080, 0.0, TAU / 1080.0, range), &limits());
    let (low, high) = square(3.5, -0.95);
    assert!(fan.covers(low, high), "the cell on the wall");
    let (low, high) = square(3.5, -1.0);
    assert!(!fan.covers(low, high), "half a cell into the wall");
    let (low, high) = square(4.3, -1.05);
    assert!(!fan.covers(low, high), "behind the wall's end");
}
