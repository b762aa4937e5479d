use std::cell::Cell as Shared;
use std::rc::Rc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use super::*;
use crate::frames::Pose;
use crate::map::Grid;

/// A predictor whose answers, duration and faults the test sets.
#[derive(Clone, Default)]
struct Puppet(Arc<PuppetState>);

#[derive(Default)]
struct PuppetState {
    /// Time that an answer takes, and the clock that it moves on.
    answer_ns: AtomicU64,
    observe_ns: AtomicU64,
    clock_ns: AtomicU64,
    answer_bits: AtomicU64,
    limited: std::sync::atomic::AtomicBool,
    fault: Mutex<Option<PredictFault>>,
    seen: Mutex<Vec<CellRect>>,
}

/// A [`Puppet`] as a predictor: the fault is kept here, as `fault` lends it.
struct Strings(Puppet, Option<PredictFault>);

impl OccupancyView for Strings {
    fn occupied(&mut self, _: &[Point], out: &mut [f32]) {
        let state = &self.0.0;
        state.clock_ns.fetch_add(state.answer_ns.load(Ordering::Relaxed), Ordering::Relaxed);
        out.fill(f32::from_bits(state.answer_bits.load(Ordering::Relaxed) as u32));
    }
}

impl Predictor for Strings {
    fn observe(&mut self, scene: &Scene<'_>) {
        let state = &self.0.0;
        state.clock_ns.fetch_add(state.observe_ns.load(Ordering::Relaxed), Ordering::Relaxed);
        state.seen.lock().unwrap().push(scene.changed);
        self.1 = state.fault.lock().unwrap().clone();
    }

    fn fault(&self) -> Option<&PredictFault> {
        self.1.as_ref()
    }

    fn time_limit(&self) -> Option<Duration> {
        self.0.0.limited.load(Ordering::Relaxed).then_some(Duration::from_millis(10))
    }
}

struct Bench {
    puppet: Puppet,
    supervised: Supervised,
    grid: Arc<Grid>,
}

impl Bench {
    fn new() -> Self {
        let puppet = Puppet::default();
        puppet.0.limited.store(true, Ordering::Relaxed);
        let strings = Strings(puppet.clone(), None);
        let bench = Self {
            supervised: Supervised::new(Box::new(strings)),
            puppet,
            grid: Arc::new(Grid::new(0.1)),
        };
        bench.answer(0.25);
        bench
    }

    fn answer(&self, value: f32) {
        self.puppet.0.answer_bits.store(u64::from(value.to_bits()), Ordering::Relaxed);
    }

    fn takes_ms(&self, ms: u64) {
        self.puppet.0.answer_ns.store(ms * 1_000_000, Ordering::Relaxed);
    }

    fn step(&mut self) -> ([f32; 2], PredictReport) {
        self.step_with(CellRect::EMPTY)
    }

    /// One planning step with two questions.
    fn step_with(&mut self, changed: CellRect) -> ([f32; 2], PredictReport) {
        let puppet = self.puppet.clone();
        let clock = move || Duration::from_nanos(puppet.0.clock_ns.load(Ordering::Relaxed));
        let scene = Scene {
            grid: &self.grid,
            pose: Pose::new(0.0, 0.0, 0.0),
            goal: Point::new(1.0, 0.0),
            changed,
        };
        self.supervised.observe(&scene, &clock);
        let mut answers = [f32::NAN; 2];
        for answer in &mut answers {
            let answer = std::slice::from_mut(answer);
            self.supervised.view(&clock).occupied(&[Point::origin()], answer);
        }
        (answers, self.supervised.report())
    }
}

#[test]
fn good_answers_pass_and_their_time_is_told() {
    let mut bench = Bench::new();
    bench.takes_ms(2);
    let (answers, report) = bench.step();
    assert_eq!(answers, [0.25; 2]);
    assert_eq!((report.fault, report.resting), (None, false));
    assert_eq!(report.spent, Duration::from_millis(4));
}

#[test]
fn answers_that_are_no_probabilities_count_as_half_and_end_the_steps_prediction() {
    for bad in [f32::NAN, -0.01, 1.01, f32::INFINITY] {
        let mut bench = Bench::new();
        bench.answer(bad);
        let (answers, report) = bench.step();
        assert_eq!(answers, [0.5; 2], "{bad}");
        let Some(PredictFault::NotAProbability { value }) = report.fault else {
            panic!("{:?}", report.fault);
        };
        assert_eq!(value.to_bits(), bad.to_bits());
        assert!(bench.supervised.view(&|| Duration::ZERO).silent(Point::origin(), Point::origin()));
    }
}

#[test]
fn after_a_fault_it_rests_and_tries_again_and_after_three_it_is_left_alone() {
    let mut bench = Bench::new();
    bench.answer(f32::NAN);
    let mut faults = 0;
    for step in 0..200 {
        let (answers, report) = bench.step();
        assert_eq!(answers, [0.5; 2]);
        let tried = step % (REST_STEPS + 1) == 0 && faults < STRIKES_MAX;
        assert_eq!(report.fault.is_some(), tried, "{step}");
        assert_eq!(report.resting, !tried, "{step}");
        faults += u32::from(tried);
    }
    assert_eq!(faults, STRIKES_MAX);
}

#[test]
fn a_fault_that_passes_costs_a_second_of_prediction() {
    let mut bench = Bench::new();
    *bench.puppet.0.fault.lock().unwrap() = Some(PredictFault::Failed("out of memory".into()));
    assert_eq!(bench.step().1.fault.unwrap().to_string(), "out of memory");
    *bench.puppet.0.fault.lock().unwrap() = None;
    for _ in 0..REST_STEPS {
        assert!(bench.step().1.resting);
    }
    assert_eq!(bench.step().0, [0.25; 2]);
}

#[test]
fn good_steps_make_up_for_faults() {
    let mut bench = Bench::new();
    for round in 0..10 {
        bench.answer(f32::NAN);
        assert!(bench.step().1.fault.is_some(), "{round}");
        bench.answer(0.25);
        for _ in 0..REST_STEPS + FORGIVEN_AFTER_STEPS {
            bench.step();
        }
    }
    // Without as many of them it is over after the third.
    for round in 0..5 {
        bench.answer(f32::NAN);
        assert_eq!(bench.step().1.fault.is_some(), round < 3, "{round}");
        bench.answer(0.25);
        for _ in 0..REST_STEPS + FORGIVEN_AFTER_STEPS / 2 {
            bench.step();
        }
    }
}

#[test]
fn a_slow_step_goes_on_without_prediction() {
    let mut bench = Bench::new();
    bench.takes_ms(11);
    let (answers, report) = bench.step();
    assert_eq!(answers, [0.25, 0.5], "the second question comes too late");
    let fault = report.fault.unwrap();
    assert_eq!(fault.to_string(), "it has taken 11.0 ms, allowed are 10.0 ms");
    assert_eq!(report.spent, Duration::from_millis(11));
    bench.takes_ms(1);
    for _ in 0..REST_STEPS {
        assert_eq!(bench.step().1.spent, Duration::ZERO);
    }
    assert_eq!(bench.step().0, [0.25; 2]);
}

#[test]
fn a_network_that_takes_a_second_is_asked_once_and_never_again() {
    for observe in [false, true] {
        let mut bench = Bench::new();
        let time = if observe { &bench.puppet.0.observe_ns } else { &bench.puppet.0.answer_ns };
        time.store(1_000_000_000, Ordering::Relaxed);
        let (_, report) = bench.step();
        assert_eq!(report.spent, Duration::from_secs(1));
        assert!(matches!(report.fault, Some(PredictFault::TooSlow { .. })));
        for _ in 0..1000 {
            let (answers, report) = bench.step();
            assert_eq!((answers, report.spent, report.resting), ([0.5; 2], Duration::ZERO, true));
        }
    }
}

#[test]
fn without_a_limit_no_step_is_too_slow() {
    let mut bench = Bench::new();
    bench.puppet.0.limited.store(false, Ordering::Relaxed);
    bench.supervised = Supervised::new(Box::new(Strings(bench.puppet.clone(), None)));
    bench.takes_ms(1000);
    let (answers, report) = bench.step();
    assert_eq!((answers, report.fault), ([0.25; 2], None));
}

#[test]
fn what_changes_while_it_rests_is_told_afterwards() {
    let mut bench = Bench::new();
    let rect = |x: i32| CellRect { x0: x, y0: 0, x1: x + 1, y1: 1 };
    bench.answer(f32::NAN);
    bench.step_with(rect(0));
    bench.answer(0.25);
    for x in 1..=REST_STEPS as i32 + 1 {
        bench.step_with(rect(x));
    }
    let seen = bench.puppet.0.seen.lock().unwrap();
    let all_missed = CellRect { x0: 1, y0: 0, x1: REST_STEPS as i32 + 2, y1: 1 };
    assert_eq!(*seen, [rect(0), all_missed]);
}

#[test]
fn the_clock_is_read_only_around_the_predictors_work() {
    let reads = Rc::new(Shared::new(0));
    let count = Rc::clone(&reads);
    let clock = move || {
        count.set(count.get() + 1);
        Duration::ZERO
    };
    let mut bench = Bench::new();
    let (grid, pose) = (Arc::clone(&bench.grid), Pose::new(0.0, 0.0, 0.0));
    let scene = Scene { grid: &grid, pose, goal: Point::origin(), changed: CellRect::EMPTY };
    bench.supervised.observe(&scene, &clock);
    bench.supervised.view(&clock).occupied(&[Point::origin()], &mut [0.0]);
    assert_eq!(reads.get(), 4);
}

#[test]
fn a_step_without_the_predictor_is_no_fault_and_misses_nothing() {
    let mut bench = Bench::new();
    let scene = |changed| Scene {
        grid: &bench.grid,
        pose: Pose::new(0.0, 0.0, 0.0),
        goal: Point::new(1.0, 0.0),
        changed,
    };
    let missed = CellRect { x0: 0, y0: 0, x1: 2, y1: 2 };
    bench.supervised.pass_over(&scene(missed));
    let mut answer = [f32::NAN];
    bench.supervised.view(&|| Duration::ZERO).occupied(&[Point::origin()], &mut answer);
    let report = bench.supervised.report();
    assert_eq!((answer, report.fault, report.resting), ([SILENT], None, false));
    assert!(bench.puppet.0.seen.lock().unwrap().is_empty());

    let (answers, _) = bench.step_with(CellRect { x0: 5, y0: 0, x1: 6, y1: 1 });
    assert_eq!(answers, [0.25; 2]);
    let seen = bench.puppet.0.seen.lock().unwrap();
    assert_eq!(*seen, [CellRect { x0: 0, y0: 0, x1: 6, y1: 2 }]);
}

#[test]
fn a_predictor_that_is_off_for_good_stays_so_while_it_is_passed_over() {
    let mut bench = Bench::new();
    bench.takes_ms(1000);
    bench.step();
    let scene = Scene {
        grid: &bench.grid,
        pose: Pose::new(0.0, 0.0, 0.0),
        goal: Point::new(1.0, 0.0),
        changed: CellRect::EMPTY,
    };
    bench.supervised.pass_over(&scene);
    let report = bench.supervised.report();
    assert!(report.resting && report.passed_over);
}
