use super::super::Policy;
use super::super::exits::tests::{fill, planner, request};
use super::*;
use crate::map::Cell;
use crate::predict::NoPrediction;

/// Seen all over: 10 m by `width` cells of 0.1 m, walled in.
fn corridor(width: i32) -> Grid {
    let mut grid = Grid::new(0.1);
    fill(&mut grid, -1..101, -1..width + 1, Cell::Occupied);
    fill(&mut grid, 0..100, 0..width, Cell::Free);
    grid
}

/// What a car that stands there does at last, after so many steps without a plan.
fn way_on(grid: Grid, car: Pose, to: Point, bold: bool, steps: u32) -> Option<Plan> {
    let request = request(grid, car, to);
    let mut planner = planner(Policy::MapPredictive, Box::new(NoPrediction));
    planner.impasses.begin(to);
    for _ in 0..if bold { 2 } else { 1 } {
        planner.impasses.take_courage(car.position);
    }
    for _ in 0..steps {
        planner.impasses.count_failure();
    }
    let points = (0..=20).map(|i| car.position + (to - car.position) * (f64::from(i) / 20.0));
    let guide = Guide {
        points: points.collect(),
        known_until: 21,
        length_m: (to - car.position).norm(),
        cost_s: 1.0,
        expanded: 0,
        asked: 0,
    };
    let here = planner.branches(&request)[0];
    planner.way_on(&request, &here, &guide, &mut StepTimes::default())
}

#[test]
fn a_bold_car_nose_on_to_a_corridor_s_wall_drives_along_it_at_last() {
    let (car, behind) = (Pose::new(5.03, 0.42, -0.55), Point::new(1.0, 0.8));
    let plan = way_on(corridor(16), car, behind, true, 12).expect("a quarter turn to the left");
    let turned = plan.trajectory.last().path.heading_rad - car.heading_rad;
    assert!((turned - std::f64::consts::FRAC_PI_2).abs() < 1e-6, "{turned}");
    assert_eq!(plan.trajectory.last().speed_mps, 0.0);
    // Not before it has stood for long, nor while it need not be bold, nor without room.
    assert!(way_on(corridor(16), car, behind, true, 11).is_none());
    assert!(way_on(corridor(16), car, behind, false, 12).is_none());
    let nearer = Pose::new(5.03, 0.31, -0.55);
    assert!(way_on(corridor(16), nearer, behind, true, 12).is_none());
}

#[test]
fn of_several_ways_on_it_takes_the_one_that_faces_the_guide() {
    let car = Pose::new(5.0, 4.0, 0.0);
    let turns_to = |to: Point| {
        let plan = way_on(corridor(80), car, to, true, 12).expect("all ways are free");
        plan.trajectory.last().path.heading_rad.signum()
    };
    assert_eq!(turns_to(Point::new(3.0, 7.5)), 1.0);
    assert_eq!(turns_to(Point::new(3.0, 0.5)), -1.0);
}

#[test]
fn it_prefers_the_way_from_which_more_ways_go_on() {
    // A nook to the left, open space to the right, and the guide leads into the nook.
    let mut grid = corridor(80);
    fill(&mut grid, 0..45, 0..80, Cell::Occupied);
    fill(&mut grid, 45..100, 48..80, Cell::Occupied);
    fill(&mut grid, 50..60, 48..53, Cell::Free);
    let car = Pose::new(5.0, 4.5, 0.0);
    let plan = way_on(grid, car, Point::new(5.5, 5.2), true, 12).expect("there is room");
    assert!(plan.trajectory.last().path.heading_rad <= 0.0);
}
