//! The trained network that ships, and what a drive makes of one that fails.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use apexd::autopilot::{Event, Fault};
use apexd::frames::Point;
use apexd::params::Params;
use apexd::plan::{Planner, PlannerParams, Planning, Stopwatch};
use apexd::predict::{
    Answers, OccupancyView, PredictFault, PredictParams, Predictor, PredictorKind, Scene, load,
};
use apexd::sim::drive::Outcome;
use apexd::sim::maze::{Family, Maze, generate};
use apexd::sim::rig::{Latency, Rig, RigSetup, SetupError};
use apexd::time::Duration;

/// The values of an `.npy` file (version 1, little-endian, rows first) of a known type.
fn npy<const N: usize, T>(name: &str, descr: &str, read: fn([u8; N]) -> T) -> Vec<T> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/cnp-scenes").join(name);
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let text = String::from_utf8_lossy(&bytes[10..header]);
    assert!(text.contains(descr) && text.contains("'fortran_order': False"), "{text}");
    bytes[header..]
        .chunks_exact(N)
        .map(|v| read(v.try_into().expect("chunks have N bytes")))
        .collect()
}

#[test]
fn answers_equal_those_of_pytorch_on_recorded_scenes() {
    const TOLERANCE: f32 = 1e-4;
    let params = PredictParams {
        onnxruntime: std::env::var("APEXD_ONNXRUNTIME").unwrap_or_default(),
        fallback: false,
        ..PredictParams::default()
    };
    let mut network = load(&params).unwrap();
    let context = npy("context.npy", "<f4", f32::from_le_bytes);
    let counts = npy("count.npy", "<i8", i64::from_le_bytes);
    let target = npy("target.npy", "<f4", f32::from_le_bytes);
    let recorded = npy("probability.npy", "<f4", f32::from_le_bytes);
    let (mut context, targets) = (context.as_chunks::<3>().0, target.as_chunks::<2>().0);
    assert!(counts.len() >= 3 && targets.len() >= 100);
    assert_eq!(recorded.len(), counts.len() * targets.len());
    let mut answers = Answers::default();
    let mut worst = 0.0_f32;
    for (count, recorded) in counts.iter().zip(recorded.chunks_exact(targets.len())) {
        let scene;
        (scene, context) = context.split_at(*count as usize);
        network.encode(scene).unwrap();
        network.decode(targets, &mut answers).unwrap();
        let differences = answers.probability.iter().zip(recorded).map(|(a, b)| (a - b).abs());
        worst = differences.fold(worst, f32::max);
        // In another order, one by one.
        for (target, recorded) in targets.iter().zip(recorded).rev().step_by(17) {
            network.decode(&[*target], &mut answers).unwrap();
            worst = worst.max((answers.probability[0] - recorded).abs());
        }
    }
    assert!(context.is_empty());
    println!("largest difference {worst:.1e}");
    assert!(worst < TOLERANCE, "{worst}");
    let spread = recorded.iter().copied().fold(0.0, f32::max);
    assert!(spread > 0.5, "the recorded scenes say something: {spread}");
}

fn maze() -> Maze {
    generate(Family::Thin, 1_000_003, 0.1).expect("0.1 m divides the hallway")
}

fn nothing() -> PredictParams {
    PredictParams { kind: PredictorKind::None, ..PredictParams::default() }
}

fn setup(predict: PredictParams, limit_s: f64) -> RigSetup {
    let maze = maze();
    let params = Params { predict, ..Params::default() };
    RigSetup {
        time_limit_s: Some(limit_s),
        ..RigSetup::new(&params, maze.world, maze.start, Some(maze.goal))
    }
}

/// Drives to the end; the faults of the prediction, with the times they were told at.
fn drive(rig: &mut Rig) -> (Outcome, Vec<(f64, PredictFault)>) {
    let mut faults = Vec::new();
    let outcome = rig.drive(|rig| {
        while let Some(event) = rig.poll_event() {
            if let Event::PredictionFault { at, fault, .. } = event {
                faults.push((at.as_secs_f64(), fault));
            }
        }
    });
    assert_eq!((rig.judge().collisions(), rig.judge().unknown_entries()), (0, 0));
    (outcome, faults)
}

#[test]
fn a_drive_without_its_network_goes_on_and_says_so() {
    let model = "/nowhere/at all.onnx".to_owned();
    let missing = PredictParams { kind: PredictorKind::Cnp, model, ..PredictParams::default() };
    let mut rig = Rig::new(setup(missing.clone(), 6.0)).unwrap();
    let (_, faults) = drive(&mut rig);
    assert_eq!(faults.len(), 3, "it is tried three times: {faults:?}");
    assert!(faults[0].1.to_string().contains("/nowhere/at all.onnx"), "{faults:?}");
    assert!(rig.core().faults().contains(Fault::NoPrediction));
    let summary = rig.summary(0.0);
    assert_eq!(summary.prediction_faults, 3);
    let mut none = Rig::new(setup(nothing(), 6.0)).unwrap();
    drive(&mut none);
    assert_eq!(summary.digest, none.summary(0.0).digest, "it drives as without prediction");
    assert!(!none.core().faults().contains(Fault::NoPrediction));
    // Unless that is not wanted.
    let strict = PredictParams { fallback: false, ..missing };
    let error = Rig::new(setup(strict, 6.0)).err().unwrap();
    assert!(matches!(error, SetupError::Predictor(_)));
    assert!(error.to_string().contains("it cannot be read"), "{error}");
}

/// A clock that only a slow predictor moves on.
#[derive(Clone, Default)]
struct Clock(Arc<AtomicU64>);

impl Clock {
    fn stopwatch(&self) -> Stopwatch {
        let clock = self.clone();
        Box::new(move || Duration::from_nanos(clock.0.load(Ordering::Relaxed)))
    }
}

/// Takes a second for every question.
struct Ponderer(Clock);

impl OccupancyView for Ponderer {
    fn occupied(&mut self, _: &[Point], out: &mut [f32]) {
        self.0.0.fetch_add(1_000_000_000, Ordering::Relaxed);
        out.fill(0.3);
    }
}

impl Predictor for Ponderer {
    fn observe(&mut self, _: &Scene<'_>) {}

    fn time_limit(&self) -> Option<Duration> {
        Some(Duration::from_millis(10))
    }
}

#[test]
fn a_predictor_that_takes_a_second_holds_up_one_plan_and_no_more() {
    let clock = Clock::default();
    let ponderer = Box::new(Ponderer(clock.clone()));
    let planner = Planner::new(PlannerParams::default(), ponderer, clock.stopwatch());
    let planning: Box<dyn Planning> = Box::new(planner);
    let mut rig = Rig::new(RigSetup {
        latency: Latency::Measured,
        stopwatch: clock.stopwatch(),
        planning: Some(planning),
        ..setup(nothing(), 12.0)
    })
    .unwrap();
    let (_, faults) = drive(&mut rig);
    let [(at_s, PredictFault::TooSlow { took, .. })] = &faults[..] else { panic!("{faults:?}") };
    assert_eq!(*took, Duration::from_secs(1));
    assert!(*at_s < 1.5, "{at_s}");
    // The car stood where that plan begins, and began it late.
    assert_eq!(rig.core().statistics().plans_late, 0);
    assert_eq!(clock.0.load(Ordering::Relaxed), 1_000_000_000, "it is asked once");
    assert!(rig.core().faults().contains(Fault::NoPrediction));
    assert!(rig.distance_m() > 25.0, "{} m", rig.distance_m());
}

#[test]
fn with_a_fixed_latency_the_wall_clock_decides_nothing() {
    // A clock that runs a second with every look at it.
    let clock = Clock::default();
    let racing = clock.clone();
    let stopwatch: Stopwatch = Box::new(move || {
        Duration::from_nanos(racing.0.fetch_add(1_000_000_000, Ordering::Relaxed))
    });
    let cnp = PredictParams { kind: PredictorKind::Cnp, ..PredictParams::default() };
    let mut fast = Rig::new(setup(cnp.clone(), 3.0)).unwrap();
    let mut slow = Rig::new(RigSetup { stopwatch, ..setup(cnp, 3.0) }).unwrap();
    let (fast_end, slow_end) = (drive(&mut fast), drive(&mut slow));
    assert_eq!((fast_end.1, slow_end.1), (vec![], vec![]));
    assert_eq!(fast.summary(0.0).digest, slow.summary(0.0).digest);
    assert!(slow.summary(0.0).predict_ms.p50 >= 1000.0);
}

#[test]
fn every_network_that_ships_is_accepted() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("params");
    let is_network = |path: &PathBuf| path.extension().is_some_and(|e| e == "onnx");
    let files = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let networks: Vec<PathBuf> = files.filter(is_network).collect();
    assert!(!networks.is_empty());
    for network in networks {
        let model = network.to_str().unwrap().to_owned();
        let params = PredictParams { model, fallback: false, ..PredictParams::default() };
        load(&params).unwrap_or_else(|error| panic!("{error}"));
    }
}
