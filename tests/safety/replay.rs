//! Drives that begin like an earlier one, without planning it again.
//!
//! A drive is a function of its setup, so up to the moment of a disturbance its planning steps are
//! those of the undisturbed drive. They are recorded once and answered from the record as long as
//! every request is the recorded one, grid included; from the first that differs on, the planner
//! answers.

use std::sync::{Arc, Mutex};

use apexd::map::Grid;
use apexd::plan::{PlanRequest, Planner, Planning, StepReport};
use apexd::time::Instant;

use super::findings::Findings;
use super::trial::Trial;
use super::watch::Watch;

/// What tells one request from another.
#[derive(Clone, Debug, PartialEq)]
struct Key {
    number: u32,
    committed: u32,
    scan_stamp: Instant,
    takes_over: Instant,
    grid: u64,
}

impl Key {
    fn of(request: &PlanRequest) -> Self {
        Self {
            number: request.number,
            committed: request.committed.number,
            scan_stamp: request.scan_stamp,
            takes_over: request.takes_over,
            grid: fingerprint(&request.grid),
        }
    }
}

/// FNV-1a over the cells.
fn fingerprint(grid: &Grid) -> u64 {
    let step = |hash: u64, value: u64| (hash ^ value).wrapping_mul(0x0100_0000_01b3);
    let width = grid.bounds().width() as u64;
    grid.cells().iter().fold(step(0xcbf2_9ce4_8422_2325, width), |hash, c| step(hash, *c as u64))
}

type Log = Vec<(Key, StepReport)>;

struct Recorder {
    planner: Planner,
    log: Arc<Mutex<Log>>,
}

impl Planning for Recorder {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        let report = self.planner.step(request);
        self.log.lock().expect("no test panics here").push((Key::of(request), report.clone()));
        report
    }
}

/// A drive that was driven once.
pub struct Recording {
    trial: Trial,
    log: Arc<Log>,
    /// When it ended, seconds.
    pub ended_s: f64,
    /// What was found to be wrong with it.
    pub findings: Findings,
    /// Speed and curvature at every millisecond.
    pub course: Vec<(f64, f64)>,
}

impl Recording {
    /// Drives a trial to its end under watch and keeps the planning steps.
    pub fn of(trial: Trial) -> Self {
        let log = Arc::new(Mutex::new(Log::new()));
        let recorder = Recorder { planner: trial.planner(), log: Arc::clone(&log) };
        let mut rig = trial.rig_with(Box::new(recorder));
        let mut watch = Watch::new(&trial);
        let mut course = Vec::new();
        rig.drive(|rig| {
            watch.look(rig);
            course.push((rig.car().speed_mps, rig.car().curvature_pm));
        });
        watch.look_back(&rig, &trial);
        let ended_s = rig.now().as_secs_f64();
        drop(rig);
        let log = std::mem::take(&mut *log.lock().expect("the drive has ended"));
        Self { trial, log: Arc::new(log), ended_s, findings: watch.findings, course }
    }

    pub const fn trial(&self) -> &Trial {
        &self.trial
    }

    /// A planner that answers like the recorded one for as long as it is asked the same.
    pub fn replay(&self) -> Box<dyn Planning> {
        let trial = self.trial.clone();
        Box::new(Replay { log: Arc::clone(&self.log), next: 0, trial, live: None })
    }
}

struct Replay {
    log: Arc<Log>,
    next: usize,
    trial: Trial,
    live: Option<Planner>,
}

impl Planning for Replay {
    fn step(&mut self, request: &PlanRequest) -> StepReport {
        if let Some(live) = &mut self.live {
            return live.step(request);
        }
        match self.log.get(self.next) {
            Some((key, report)) if *key == Key::of(request) => {
                self.next += 1;
                report.clone()
            }
            _ => self.live.insert(self.trial.planner()).step(request),
        }
    }
}
