//! Drives through random mazes: every policy and predictor, no contact, no entry into space that
//! was not seen to be free, and with `none` and `oracle` nobody stuck.
//!
//! The policies that weigh several exits take several times as long, so without a number they drive
//! one maze, at 4 m/s.
//!
//! The default is a handful of mazes a family. `APEXD_CAMPAIGN=full` drives 100 of each family at
//! 4 m/s and 20 at 8 m/s, and prints the table of `docs/experiments.md`; `APEXD_CAMPAIGN=N` drives N
//! at 4 m/s and N/5 at 8 m/s.

use apexd::frames::{Point, Pose};
use apexd::params::Params;
use apexd::plan::Policy;
use apexd::predict::PredictorKind;
use apexd::sim::drive::{Outcome, Summary};
use apexd::sim::maze::{Family, Maze, generate};
use apexd::sim::rig::{Rig, RigSetup};
use apexd::vehicle::VehicleParams;
use rayon::prelude::*;

/// What is driven, and at which speed.
#[derive(Clone, Copy, Debug)]
struct Case {
    family: Family,
    seed: u64,
    policy: Policy,
    predictor: PredictorKind,
    speed_max_mps: f64,
}

/// A drive that has ended.
struct Driven {
    case: Case,
    summary: Summary,
    physical: bool,
}

fn params(case: &Case) -> Params {
    let mut params = Params::default();
    params.plan.policy = case.policy;
    params.predict.kind = case.predictor;
    params.speed.speed_max_mps = case.speed_max_mps;
    params.lidar.rate_hz = if case.speed_max_mps > 6.0 { 40.0 } else { 20.0 };
    params
}

/// R2 and R4: nobody arrives by a shorter way than the shortest, or sooner than at full speed along
/// it, with full force from rest and to rest.
fn is_physical(maze: &Maze, case: &Case, summary: &Summary) -> bool {
    let vehicle = VehicleParams::default();
    // A disc smaller by half a cell's diagonal finds every way on the raster that the car has;
    // straight and diagonal steps make it up to 8.3 per cent longer.
    let radius_m = vehicle.radius_m - 0.071;
    let raster_m = maze.world.path_length_m(maze.start.position, maze.goal, radius_m);
    let goal_m = params(case).autopilot.goal_radius_m;
    let least_m = raster_m.expect("mazes have a way") / 1.083 - goal_m - 0.1;
    let (v, a) = (case.speed_max_mps, vehicle.acceleration_limit_mps2());
    assert!(least_m > v * v / a, "too short to reach full speed");
    summary.path_m >= least_m && summary.time_s >= least_m / v + v / a
}

fn drive(case: Case) -> Driven {
    let maze = generate(case.family, case.seed, 0.1).expect("0.1 m divides the hallway");
    let params = params(&case);
    let mut rig = Rig::new(RigSetup {
        seed: case.seed,
        ..RigSetup::new(&params, maze.world.clone(), maze.start, Some(maze.goal))
    })
    .expect("start and goal of a maze are free");
    rig.drive(|_| {});
    let summary = rig.summary(0.0);
    let physical = summary.outcome != Outcome::Goal || is_physical(&maze, &case, &summary);
    if case.predictor == PredictorKind::Oracle && case.speed_max_mps <= 4.0 {
        // The check can fail.
        let short = Summary { path_m: 0.8 * summary.path_m, ..summary.clone() };
        let sudden = Summary { time_s: 0.6 * summary.time_s, ..summary.clone() };
        assert!(!is_physical(&maze, &case, &short) && !is_physical(&maze, &case, &sudden));
    }
    Driven { case, summary, physical }
}

/// Drives that once did not arrive; from a start (x, y, degrees) to a goal, or the maze's own.
#[test]
fn the_car_arrives_from_where_it_once_did_not() {
    let arrives = |case: Case, drive: Option<([f64; 3], [f64; 2])>, rate_hz: f64| {
        let maze = generate(case.family, case.seed, 0.1).unwrap();
        let mut params = params(&case);
        params.lidar.rate_hz = rate_hz;
        let (start, goal) = drive.map_or((maze.start, maze.goal), |([x, y, degrees], goal)| {
            (Pose::new(x, y, degrees.to_radians()), Point::new(goal[0], goal[1]))
        });
        let setup = RigSetup::new(&params, maze.world, start, Some(goal));
        // Led to and fro by a wrong prediction it may take its time.
        let time_limit_s = (case.predictor == PredictorKind::Inverted).then_some(120.0);
        let mut rig = Rig::new(RigSetup { seed: 1, time_limit_s, ..setup }).unwrap();
        rig.drive(|_| {});
        let summary = rig.summary(0.0);
        assert_eq!(summary.outcome, Outcome::Goal, "{case:?}");
        assert_eq!((summary.collisions, summary.unknown_entries), (0, 0), "{case:?}");
    };
    let case = |family, seed, predictor, speed_max_mps| Case {
        family,
        seed,
        policy: Policy::MapPredictive,
        predictor,
        speed_max_mps,
    };
    // Askew in a hallway: where a full turn of beams closes lies right behind the car.
    let askew = case(Family::Solid, 1_743_449, PredictorKind::None, 6.0);
    arrives(askew, Some(([9.75, 1.83, 166.0], [11.58, 24.0])), 40.0);
    // Two ways, and whichever the car approaches is foreseen to be blocked.
    let torn = case(Family::Thin, 1_136_057, PredictorKind::Inverted, 6.0);
    arrives(torn, Some(([18.75, 2.94, 142.0], [6.08, 9.47])), 10.0);
    // Between posts, with nothing proven but a way that ends before the next one.
    let hemmed = case(Family::Posts, 1_186_804, PredictorKind::None, 2.0);
    arrives(hemmed, Some(([7.65, 11.35, -112.0], [3.76, 15.96])), 20.0);
    // The last plan ends so near to the rim of the goal's disc that the car comes to rest outside.
    let rim = case(Family::Solid, 1_000_002, PredictorKind::None, 8.0);
    arrives(Case { policy: Policy::Frontier, ..rim }, None, 40.0);
}

/// Number of mazes a family at 4 m/s, and at 8 m/s.
fn size() -> (u64, u64) {
    match std::env::var("APEXD_CAMPAIGN").as_deref() {
        Ok("full") => (100, 20),
        Ok(n) => n.parse().map(|n: u64| (n, n.div_ceil(5))).expect("a number, or full"),
        Err(_) => (2, 1),
    }
}

/// Drives, prints one row, and gives the drives.
fn row(
    policy: Policy,
    predictor: PredictorKind,
    speed_max_mps: f64,
    families: &[Family],
    mazes: u64,
) -> Vec<Driven> {
    let cases: Vec<Case> = families
        .iter()
        .flat_map(|family| {
            let family = *family;
            (1..=mazes).map(move |seed| Case { family, seed, policy, predictor, speed_max_mps })
        })
        .collect();
    let driven: Vec<Driven> = cases.into_par_iter().map(drive).collect();
    let count = |f: &dyn Fn(&Summary) -> u64| driven.iter().map(|d| f(&d.summary)).sum::<u64>();
    let with = |o: Outcome| driven.iter().filter(|d| d.summary.outcome == o).count();
    println!(
        "| {} | {} | {speed_max_mps} | {} | {} | {} | {} | {} | {} | {} | {:.1} % |",
        policy.name(),
        predictor.name(),
        driven.len(),
        with(Outcome::Goal),
        with(Outcome::Stuck),
        with(Outcome::Timeout),
        count(&|s| s.collisions),
        count(&|s| s.unknown_entries),
        count(&|s| s.guard_stops),
        100.0 * count(&|s| s.plans_rejected) as f64 / count(&|s| s.replans).max(1) as f64,
    );
    for d in driven.iter().filter(|d| d.summary.outcome != Outcome::Goal) {
        let (case, outcome) = (&d.case, d.summary.outcome);
        println!("  {outcome:?}: {case:?}");
    }
    driven
}

#[test]
fn mazes_are_driven_safely_whatever_is_predicted() {
    let (at_4, at_8) = size();
    println!(
        "| policy | predictor | m/s | drives | goal | stuck | timeout | collisions | unknown entries | guard stops | rejected |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|---|");
    let mut failures = Vec::new();
    let mut paths: Vec<(PredictorKind, Vec<f64>)> = Vec::new();
    let mut times_s: Vec<(PredictorKind, f64)> = Vec::new();
    for (speed, mazes) in [(4.0, at_4), (8.0, at_8)] {
        for (policy, predictor) in [
            (Policy::MapPredictive, PredictorKind::None),
            (Policy::MapPredictive, PredictorKind::Oracle),
            (Policy::MapPredictive, PredictorKind::Random),
            (Policy::MapPredictive, PredictorKind::Inverted),
            (Policy::Frontier, PredictorKind::None),
            (Policy::Janson, PredictorKind::None),
            (Policy::Janson, PredictorKind::Inverted),
            (Policy::JansonLite, PredictorKind::None),
        ] {
            let families = &[Family::Thin, Family::Solid, Family::Branching];
            let weighs = matches!(policy, Policy::Janson | Policy::JansonLite);
            let driven = if weighs && std::env::var_os("APEXD_CAMPAIGN").is_none() {
                if speed > 4.0 || predictor != PredictorKind::None {
                    continue;
                }
                row(policy, predictor, speed, &families[..1], 1)
            } else {
                row(policy, predictor, speed, families, mazes)
            };
            let safe = |s: &Summary| s.collisions == 0 && s.unknown_entries == 0;
            for d in &driven {
                if !safe(&d.summary) {
                    failures.push(format!("unsafe: {:?}", d.case));
                }
                if !d.physical {
                    failures.push(format!("too good to be true: {:?}, {:?}", d.case, d.summary));
                }
                let honest = matches!(predictor, PredictorKind::None | PredictorKind::Oracle);
                let must_arrive =
                    policy == Policy::MapPredictive || policy != Policy::Frontier && honest;
                if must_arrive && d.summary.outcome != Outcome::Goal {
                    failures.push(format!("{:?}: {:?}", d.summary.outcome, d.case));
                }
            }
            if policy == Policy::MapPredictive && speed == 4.0 {
                paths.push((predictor, driven.iter().map(|d| d.summary.path_m).collect()));
                times_s.push((predictor, driven.iter().map(|d| d.summary.time_s).sum()));
            }
        }
    }
    // R3: who foresees the truth is hardly slower than who foresees nothing, whatever these few mazes.
    let time_s = |kind| times_s.iter().find(|(k, _)| *k == kind).expect("was driven").1;
    let (oracle_s, none_s) = (time_s(PredictorKind::Oracle), time_s(PredictorKind::None));
    assert!(oracle_s <= 1.05 * none_s, "{oracle_s} s with the truth, {none_s} s without");
    // A predictor that changes nothing would make all of this worthless.
    let (none, others) = paths.split_first().expect("the first row is none");
    for (predictor, path_m) in others {
        if *predictor != PredictorKind::Oracle {
            assert_ne!(&none.1, path_m, "{predictor:?} makes no difference");
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
