use std::sync::Arc;

use super::super::test_networks::{Build, constant, plane, plane_answer, value};
use super::*;
use crate::frames::Pose;
use crate::map::{CellIndex, CellRect, Grid};

/// A free room of 4 m by 3 m with a wall along its upper end, and the car in it, off the lattice.
fn room() -> (Arc<Grid>, Pose) {
    let mut grid = Grid::new(0.1);
    for iy in 0..30 {
        for ix in 0..40 {
            let wall = iy >= 28;
            let cell = if wall { Cell::Occupied } else { Cell::Free };
            grid.set(CellIndex::new(ix, iy), cell);
        }
    }
    (Arc::new(grid), Pose::new(1.62, 1.31, 0.4))
}

fn predictor(build: &Build, params: &PredictParams) -> CnpPredictor {
    CnpPredictor::new(build.load().unwrap(), params)
}

fn observe(predictor: &mut CnpPredictor, grid: &Arc<Grid>, pose: Pose, changed: CellRect) {
    let goal = Point::new(9.0, 9.0);
    predictor.observe(&Scene { grid, pose, goal, changed });
}

fn ask(predictor: &mut CnpPredictor, points: &[Point]) -> Vec<f32> {
    let mut out = vec![f32::NAN; points.len()];
    predictor.occupied(points, &mut out);
    out
}

/// The centres of all map cells of a square around the room.
fn around() -> Vec<Point> {
    let at = |k: i32| f64::from(k) * 0.1 + 0.05;
    (-140..160).flat_map(|y| (-150..170).map(move |x| Point::new(at(x), at(y)))).collect()
}

/// What [`plane`] should say about a point of the map, by the definitions alone.
fn expected(grid: &Grid, pose: Pose, p: Point) -> f32 {
    let mut lattice = Lattice::new(0.25);
    lattice.update(grid, grid.bounds());
    let mut crop = Crop::default();
    lattice.crop(pose.position, &mut crop);
    let mut context = Vec::new();
    crop.context(super::super::lattice::ContextSelection::All, &mut context);
    let index = |v: f64, origin: f64| ((v - origin) / 0.25).floor();
    let [x, y] = [index(p.x, crop.origin().x), index(p.y, crop.origin().y)];
    plane_answer(&context, [((x + 0.5) * 0.25) as f32, ((y + 0.5) * 0.25) as f32])
}

#[test]
fn it_answers_for_unknown_cells_near_the_frontier_and_nothing_elsewhere() {
    let (grid, pose) = room();
    for cut in ["representation", "something"] {
        let params = PredictParams { range_m: 2.0, ..PredictParams::default() };
        let mut cnp = predictor(&plane(cut), &params);
        observe(&mut cnp, &grid, pose, grid.bounds());
        let points = [
            Point::new(4.65, 1.05),
            Point::new(2.05, -0.85),
            // Seen free, seen occupied.
            Point::new(2.05, 1.05),
            Point::new(2.05, 2.85),
            // Beyond the range, outside the square.
            Point::new(8.05, 1.05),
            Point::new(40.0, 1.05),
            Point::new(f64::NAN, 1.0),
        ];
        let answers = ask(&mut cnp, &points);
        for (p, answer) in points.iter().zip(&answers).take(2) {
            assert!((answer - expected(&grid, pose, *p)).abs() < 1e-5, "{p}: {answer}");
        }
        assert_eq!(answers[2..], [0.5; 5], "{cut}");
        assert_eq!(cnp.fault(), None);
    }
}

#[test]
fn every_answer_is_that_of_its_coarse_cell_in_whatever_order_it_is_asked_for() {
    let (grid, pose) = room();
    let params = PredictParams::default();
    let points = around();
    let mut at_once = predictor(&plane("something"), &params);
    observe(&mut at_once, &grid, pose, grid.bounds());
    let all = ask(&mut at_once, &points);
    assert!(all.iter().filter(|p| **p != 0.5).count() > 5000);
    let mut in_tiles = predictor(&plane("representation"), &params);
    observe(&mut in_tiles, &grid, pose, grid.bounds());
    // Backwards, by sevens.
    for (points, answers) in points.rchunks(7).zip(all.rchunks(7)) {
        assert_eq!(ask(&mut in_tiles, points), answers);
    }
    assert_eq!(in_tiles.effort(), at_once.effort());
    let again = ask(&mut in_tiles, &points);
    assert_eq!(again, all);
    assert_eq!(in_tiles.effort(), at_once.effort(), "nothing is decoded twice");
}

#[test]
fn a_decoder_that_works_for_every_target_is_asked_for_little() {
    let (grid, pose) = room();
    let params = PredictParams::default();
    let mut cnp = predictor(&plane("representation"), &params);
    observe(&mut cnp, &grid, pose, grid.bounds());
    assert_eq!(cnp.effort(), Effort::default());
    ask(&mut cnp, &[Point::new(2.05, 1.05)]);
    assert_eq!(cnp.effort(), Effort::default(), "what is known needs no network");
    ask(&mut cnp, &[Point::new(4.65, 1.05)]);
    let Effort { context, decoded } = cnp.effort();
    // 16 by 12 coarse cells, the last rows of which the wall fills.
    assert_eq!(context, 192);
    assert!((1..=64).contains(&decoded), "{decoded}");
}

#[test]
fn what_it_calls_silent_is_silent() {
    let (grid, pose) = room();
    for resolution in ["0.25", "0.3"] {
        let build = plane("something").metadata("resolution_m", resolution);
        let params = PredictParams { range_m: 3.0, ..PredictParams::default() };
        let mut cnp = predictor(&build, &params);
        observe(&mut cnp, &grid, pose, grid.bounds());
        let (mut silent, mut not) = (0, 0);
        for y in (-140..160).step_by(8) {
            for x in (-150..170).step_by(8) {
                let corner = |k: i32| f64::from(k) * 0.1;
                let low = Point::new(corner(x), corner(y));
                let high = Point::new(corner(x + 8), corner(y + 8));
                let inside = (0..64).map(|k| {
                    let at = |v: f64, k: i32| v + f64::from(k) * 0.1 + 0.05;
                    Point::new(at(low.x, k % 8), at(low.y, k / 8))
                });
                let answers = ask(&mut cnp, &inside.collect::<Vec<_>>());
                if cnp.silent(low, high) {
                    silent += 1;
                    assert_eq!(answers, [0.5; 64], "{low} {high}");
                } else {
                    not += 1;
                }
            }
        }
        assert!(silent > 1000 && not > 100, "{silent} {not}");
    }
}

#[test]
fn a_new_scene_is_answered_anew_and_as_by_a_fresh_start() {
    let (grid, pose) = room();
    let params = PredictParams::default();
    let points = around();
    let mut cnp = predictor(&plane("something"), &params);
    observe(&mut cnp, &grid, pose, grid.bounds());
    let before = ask(&mut cnp, &points);
    let mut grown = Grid::clone(&grid);
    for iy in 5..20 {
        for ix in 40..55 {
            grown.set(CellIndex::new(ix, iy), Cell::Free);
        }
    }
    let (grown, pose) = (Arc::new(grown), Pose::new(3.9, 1.2, 0.0));
    observe(&mut cnp, &grown, pose, CellRect { x0: 40, y0: 5, x1: 55, y1: 20 });
    let after = ask(&mut cnp, &points);
    assert_ne!(before, after);
    let mut fresh = predictor(&plane("something"), &params);
    observe(&mut fresh, &grown, pose, grown.bounds());
    assert_eq!(ask(&mut fresh, &points), after);
}

#[test]
fn the_range_is_no_longer_than_the_one_trained_for() {
    let (grid, pose) = room();
    let build = plane("representation").metadata("prediction_range_m", "1");
    let mut cnp = predictor(&build, &PredictParams::default());
    observe(&mut cnp, &grid, pose, grid.bounds());
    let [near, far] = ask(&mut cnp, &[Point::new(4.65, 1.05), Point::new(6.65, 1.05)])[..] else {
        panic!("two answers");
    };
    assert!(near != 0.5 && far == 0.5, "{near} {far}");
}

#[test]
fn answers_are_calibrated_by_the_distance_from_the_frontier() {
    let (grid, pose) = room();
    let text = r#"{"edges_m": [0, 3, 6], "temperature": [1, 2]}"#;
    let build = constant(0.9).metadata("calibration", text);
    let mut cnp = predictor(&build, &PredictParams::default());
    observe(&mut cnp, &grid, pose, grid.bounds());
    // One piece of frontier goes round the room except for the wall; its centre is in the middle
    // of the lower edge.
    let points = [Point::new(2.05, -0.45), Point::new(2.05, -4.45)];
    for (p, wanted) in ask(&mut cnp, &points).iter().zip([0.9, 0.75]) {
        assert!((p - wanted).abs() < 1e-6, "{p} {wanted}");
    }
}

#[test]
fn predictions_fade_in_unfamiliar_scenes_where_that_is_wanted() {
    let (grid, pose) = room();
    let p = Point::new(4.65, 1.05);
    for (familiarity, fade, wanted) in
        [(0.25, true, 0.6), (0.25, false, 0.9), (1.0, true, 0.9), (0.0, true, 0.5)]
    {
        let mut build = constant(0.9).floats("how_familiar", &[1], &[familiarity]).node(
            "Add",
            &["how_familiar", "nothing"],
            "familiarity",
        );
        build.graph().output.push(value("familiarity", &[Some(1)]));
        let params = PredictParams { fade, ..PredictParams::default() };
        let mut cnp = predictor(&build, &params);
        observe(&mut cnp, &grid, pose, grid.bounds());
        let answer = ask(&mut cnp, &[p])[0];
        assert!((answer - wanted).abs() < 1e-6, "{familiarity} {fade}: {answer}");
    }
    let mut build = constant(0.9).floats("how_familiar", &[1], &[f32::NAN]).node(
        "Add",
        &["how_familiar", "nothing"],
        "familiarity",
    );
    build.graph().output.push(value("familiarity", &[Some(1)]));
    let mut cnp = predictor(&build, &PredictParams { fade: true, ..PredictParams::default() });
    observe(&mut cnp, &grid, pose, grid.bounds());
    assert_eq!(ask(&mut cnp, &[p]), [0.5]);
    assert!(matches!(cnp.fault(), Some(PredictFault::NotAProbability { .. })));
}

#[test]
fn answers_that_are_no_probabilities_silence_it_until_the_next_scene() {
    let (grid, pose) = room();
    for bad in [f32::NAN, 1.5, -0.1, f32::INFINITY] {
        let mut cnp = predictor(&constant(bad), &PredictParams::default());
        observe(&mut cnp, &grid, pose, grid.bounds());
        let p = Point::new(4.65, 1.05);
        assert_eq!(cnp.fault(), None);
        assert_eq!(ask(&mut cnp, &[p]), [0.5]);
        let Some(PredictFault::NotAProbability { value }) = cnp.fault() else {
            panic!("{:?}", cnp.fault());
        };
        assert_eq!(value.to_bits(), bad.to_bits());
        assert!(cnp.silent(p, p));
        observe(&mut cnp, &grid, pose, CellRect::EMPTY);
        assert_eq!(cnp.fault(), None);
    }
}

#[test]
fn before_the_first_scene_nothing_is_foreseen() {
    let mut cnp = predictor(&plane("representation"), &PredictParams::default());
    assert_eq!(ask(&mut cnp, &[Point::new(0.1, 0.1)]), [0.5]);
    let empty = Arc::new(Grid::new(0.1));
    observe(&mut cnp, &empty, Pose::new(0.0, 0.0, 0.0), CellRect::EMPTY);
    assert_eq!(ask(&mut cnp, &[Point::new(0.1, 0.1)]), [0.5]);
    assert_eq!(cnp.fault(), None);
}
