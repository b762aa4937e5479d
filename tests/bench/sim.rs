//! What the simulator itself costs, without a planner: one scan, its entry in the account, one step
//! of the judge. At 20 scans and 1000 steps a second they may take 5 per cent of simulated time.

use std::hint::black_box;

use apexd::frames::{Point, Pose};
use apexd::sim::account::Account;
use apexd::sim::judge::Judge;
use apexd::sim::lidar::{Lidar, LidarParams};
use apexd::sim::maze::{Family, Maze, generate};
use criterion::{Criterion, criterion_group, criterion_main};

/// A pose in every fourth cell of the route, off its centre.
fn poses(maze: &Maze) -> Vec<Pose> {
    let place = |(i, j): &(u8, u8)| {
        Pose::new(2.5 * f64::from(*i) + 1.4, 2.5 * f64::from(*j) + 1.1, 0.3 * f64::from(*i))
    };
    maze.route.iter().step_by(4).map(place).collect()
}

fn sim(c: &mut Criterion) {
    for resolution_m in [0.1, 0.05] {
        let maze = generate(Family::Thin, 1, resolution_m).expect("it divides the hallway");
        let poses = poses(&maze);
        let mut lidar = Lidar::new(&LidarParams::default(), 0);
        let mut account = Account::new(&maze.world, maze.start.position, 0.2);
        let scans: Vec<_> = poses.iter().map(|pose| lidar.scan(&maze.world, *pose)).collect();

        let mut group = c.benchmark_group(format!("sim at {resolution_m} m"));
        let mut k = 0;
        let mut next = move |n: usize| {
            k = (k + 1) % n;
            k
        };
        group.bench_function("scan", |b| {
            b.iter(|| black_box(lidar.scan(&maze.world, poses[next(poses.len())])));
        });
        group.bench_function("account", |b| {
            b.iter(|| {
                let k = next(poses.len());
                account.delivered(&maze.world, lidar.fan(), poses[k], &scans[k]);
            });
        });
        // A drive along the first hallways, 4 mm a step.
        let mut judge = Judge::new(0.2);
        let mut step = 0;
        group.bench_function("judge", |b| {
            b.iter(|| {
                step = (step + 1) % 600;
                let ahead = Point::new(0.004 * f64::from(step), 0.1);
                black_box(judge.observe(&maze.world, &account, maze.start.to_map(ahead)))
            });
        });
        group.bench_function("maze", |b| {
            b.iter(|| black_box(generate(Family::Thin, 1, resolution_m)));
        });
        group.finish();
    }
}

criterion_group!(benches, sim);
criterion_main!(benches);
