//! Drives beside fences. The simulated world knows none of them: only the plan keeps the car out.

use crate::autopilot::{CoreParams, Fault};
use crate::fence::{Fence, Polygon};
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::predict::PredictorKind;
use crate::sim::drive::Outcome;
use crate::sim::rig::{Rig, RigSetup};
use crate::sim::world::World;
use std::sync::Arc;

const START: Pose = Pose { position: Point::new(2.0, 4.0), heading_rad: 0.0 };
const GOAL: Point = Point::new(16.0, 4.0);

/// An empty hall of 18 m by 8 m.
fn hall(time_limit_s: f64) -> Rig {
    let (columns, rows) = (180, 80);
    let edge = |x: usize, y: usize| x == 0 || y == 0 || x + 1 == columns || y + 1 == rows;
    let solid: Vec<bool> = (0..columns * rows).map(|i| edge(i % columns, i / columns)).collect();
    let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), columns, rows, &solid);
    let mut params = Params::default();
    params.predict.kind = PredictorKind::None;
    Rig::new(RigSetup {
        time_limit_s: Some(time_limit_s),
        ..RigSetup::new(&params, world, START, Some(GOAL))
    })
    .unwrap()
}

fn rectangle(x: [f64; 2], y: [f64; 2]) -> Polygon {
    vec![
        Point::new(x[0], y[0]),
        Point::new(x[1], y[0]),
        Point::new(x[1], y[1]),
        Point::new(x[0], y[1]),
    ]
}

fn set(rig: &mut Rig, fence: &Fence) {
    let now = rig.now();
    rig.core_mut().set_fence(now, Arc::new(fence.clone()));
}

/// Whether any part of the car is where it must not be.
fn is_out(rig: &Rig, fence: &Fence) -> bool {
    let centre = rig.car().pose.position;
    let radius_m = CoreParams::default().vehicle.radius_m;
    (0..24).any(|i| {
        let (sin, cos) = (f64::from(i) * std::f64::consts::TAU / 24.0).sin_cos();
        !fence.allows(Point::new(centre.x + radius_m * cos, centre.y + radius_m * sin))
    })
}

#[test]
fn a_car_drives_round_what_it_must_stay_out_of() {
    let mut rig = hall(60.0);
    let fence = Fence { inside: Vec::new(), outside: vec![rectangle([8.0, 9.0], [-1.0, 5.5])] };
    set(&mut rig, &fence);
    let (mut out, mut high) = (0, 0.0f64);
    let outcome = rig.drive(|rig| {
        out += usize::from(is_out(rig, &fence));
        high = high.max(rig.car().pose.position.y);
    });
    assert_eq!((outcome, out), (Outcome::Goal, 0));
    assert!(high > 5.7, "the way round leads by {high} m");
}

#[test]
fn a_car_stays_inside_and_does_not_reach_a_goal_that_lies_outside() {
    let mut rig = hall(25.0);
    let fence =
        Fence { inside: vec![vec![rectangle([1.0, 10.0], [1.0, 7.0])]], outside: Vec::new() };
    set(&mut rig, &fence);
    let mut out = 0;
    let mut unreachable = false;
    rig.drive(|rig| {
        out += usize::from(is_out(rig, &fence));
        unreachable |= rig.core().faults().contains(Fault::GoalUnreachable);
    });
    assert_eq!(out, 0);
    assert!(unreachable, "and says so");
}

#[test]
fn a_fence_across_the_plan_under_way_stops_the_car_before_it_and_its_end_lets_it_go_on() {
    let mut rig = hall(60.0);
    let fence = Fence { inside: Vec::new(), outside: vec![rectangle([9.0, 9.5], [-1.0, 9.0])] };
    while rig.car().pose.position.x <= 5.0 {
        rig.step();
        assert!(rig.now().as_secs_f64() < 20.0, "it never gets there");
    }
    assert!(rig.car().speed_mps > 1.5, "{}", rig.car().speed_mps);
    let before = rig.core().statistics().plans_revoked;
    set(&mut rig, &fence);
    let shortened = rig.core().statistics().plans_revoked - before;
    let mut out = 0;
    for _ in 0..3000 {
        rig.step();
        out += usize::from(is_out(&rig, &fence));
    }
    let (x, speed_mps) = (rig.car().pose.position.x, rig.car().speed_mps);
    assert!(!rig.core().faults().contains(Fault::PathBlocked));
    set(&mut rig, &Fence::default());
    // The goal was given up as unreachable.
    rig.set_goal(GOAL);
    let outcome = rig.drive(|_| {});
    assert_eq!((out, shortened), (0, 1));
    assert!(speed_mps < 0.02 && x < 8.8, "at {x} m with {speed_mps} m/s");
    assert_eq!(outcome, Outcome::Goal);
}

#[test]
fn a_fence_around_a_car_that_stands_moves_nothing_and_is_no_obstacle() {
    let mut rig = hall(8.0);
    let fence = Fence { inside: Vec::new(), outside: vec![rectangle([1.0, 3.0], [3.0, 5.0])] };
    set(&mut rig, &fence);
    rig.drive(|rig| assert!(!rig.core().faults().contains(Fault::PathBlocked)));
    assert!((rig.car().pose.position - START.position).norm() < 0.01);
}
