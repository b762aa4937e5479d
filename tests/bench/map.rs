//! What a scan costs: insertion, distance fields, clearances and frontiers.
#![allow(missing_docs)]

use std::f64::consts::TAU;
use std::hint::black_box;

use apexd::frames::{Point, Pose, heading_vector};
use apexd::map::{
    Blocking, CellRect, Clearance, DistanceField, FrontierFinder, MapParams, Mapper, clearance_m,
    segment_clearance_m,
};
use apexd::scan::Scan;
use apexd::time::Instant;
use criterion::{BatchSize, Criterion, criterion_group, criterion_main};

/// Corridors 2.5 m wide, 10 by 10 of them, every second wall open in turn: a winding way.
fn wall_at(p: Point) -> bool {
    const CELL_M: f64 = 2.5;
    let (x, y) = (p.x.rem_euclid(CELL_M), p.y.rem_euclid(CELL_M));
    let (column, row) = ((p.x / CELL_M).floor() as i64, (p.y / CELL_M).floor() as i64);
    let outside = !(0..10).contains(&column) || !(0..10).contains(&row);
    let left = x < 0.1 && (column + 2 * row).rem_euclid(3) == 0;
    let below = y < 0.1 && (column.rem_euclid(4) != row.rem_euclid(3));
    outside || left || below
}

fn scan(pose: &Pose, beams: usize) -> Scan {
    let step = TAU / beams as f64;
    let range = |i: usize| {
        let direction = heading_vector(pose.heading_rad + step * i as f64);
        let hit = (0..7500).find(|k| wall_at(pose.position + direction * (f64::from(*k) * 1e-3)));
        hit.map_or(7.5, |k| f64::from(k) * 1e-3) as f32
    };
    Scan {
        stamp: Instant::ZERO,
        sequence: 0,
        angle_first_rad: 0.0,
        angle_step_rad: step,
        range_max_m: 7.5,
        ranges_m: (0..beams).map(range).collect(),
    }
}

fn open_floor(beams: usize) -> Scan {
    Scan { ranges_m: vec![7.5; beams], ..scan(&Pose::new(1.25, 1.25, 0.0), beams) }
}

/// 4 m/s at 20 Hz through the middle of the lowest corridors.
fn drive() -> Vec<(Pose, Scan)> {
    (0..100)
        .map(|i| Pose::new(1.25 + 0.2 * f64::from(i), 1.25, 0.01 * f64::from(i)))
        .map(|pose| (pose, scan(&pose, 1080)))
        .collect()
}

fn insertion(c: &mut Criterion) {
    let drive = drive();
    for resolution_m in [0.1, 0.05] {
        let params = MapParams { resolution_m, ..Default::default() };
        let name = format!("insert {resolution_m} m");
        let floor = open_floor(1080);
        c.bench_function(&format!("{name} open floor, first scan"), |b| {
            let mut mapper = Mapper::new(&params);
            mapper.insert(&drive[0].0, &floor);
            b.iter_batched(
                || {
                    let mut fresh = mapper.clone();
                    fresh.clear();
                    fresh
                },
                |mut mapper| mapper.insert(&drive[0].0, black_box(&floor)),
                BatchSize::LargeInput,
            );
        });
        c.bench_function(&format!("{name} per scan of a drive"), |b| {
            let mut at = drive.len();
            let mut mapper = Mapper::new(&params);
            b.iter(|| {
                if at == drive.len() {
                    mapper.clear();
                    at = 0;
                }
                at += 1;
                mapper.insert(&drive[at - 1].0, black_box(&drive[at - 1].1))
            });
        });
    }
}

fn distances(c: &mut Criterion) {
    let drive = drive();
    let mut mapper = Mapper::new(&MapParams::default());
    for (pose, scan) in &drive {
        mapper.insert(pose, scan);
    }
    let mut grid = mapper.grid().clone();
    grid.grow_to(CellRect { x0: 0, y0: 0, x1: 250, y1: 250 });
    for blocking in [Blocking::Occupied, Blocking::OccupiedOrUnknown] {
        let mut field = DistanceField::new(blocking, 1.5);
        field.update(&grid, CellRect::EMPTY);
        let window = CellRect { x0: 40, y0: 20, x1: 220, y1: 200 };
        c.bench_function(&format!("distance {blocking:?} 180x180 changed"), |b| {
            b.iter(|| field.update(black_box(&grid), window));
        });
        c.bench_function(&format!("distance {blocking:?} all {:?}", grid.bounds()), |b| {
            b.iter(|| {
                let mut field = DistanceField::new(blocking, 1.5);
                field.update(black_box(&grid), CellRect::EMPTY);
                field
            });
        });
        let points: Vec<_> = (0..400).map(|i| Point::new(1.0 + 0.05 * f64::from(i), 0.6)).collect();
        let fast = Clearance::new(&grid, &field);
        c.bench_function(&format!("400 clearances {blocking:?} to 0.35 m"), |b| {
            let clearance = |p: &Point| clearance_m(&grid, *p, blocking, 0.35);
            b.iter(|| points.iter().map(clearance).sum::<f64>());
        });
        c.bench_function(&format!("400 segment clearances {blocking:?} to 0.35 m"), |b| {
            let clearance = |p: &[Point]| segment_clearance_m(&grid, p[0], p[1], blocking, 0.35);
            b.iter(|| points.windows(2).map(clearance).sum::<f64>());
        });
        c.bench_function(&format!("400 segment clearances {blocking:?} with field"), |b| {
            let clearance = |p: &[Point]| fast.segment(p[0], p[1], 0.35);
            b.iter(|| points.windows(2).map(clearance).sum::<f64>());
        });
        c.bench_function(&format!("400 clearances {blocking:?} with field"), |b| {
            b.iter(|| points.iter().map(|p| fast.at(*p)).sum::<f64>());
        });
    }
    let mut field = DistanceField::new(Blocking::Occupied, 1.5);
    field.update(&grid, CellRect::EMPTY);
    let start = grid.cell_at(Point::new(1.25, 1.25));
    let mut finder = FrontierFinder::default();
    c.bench_function("frontiers", |b| b.iter(|| finder.find(&grid, &field, start, 0.2)));
}

criterion_group!(benches, insertion, distances);
criterion_main!(benches);
