//! Feeds a log to a new core and a new planner, and compares what comes out.

use std::io::Read;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use super::container::{End, LogError};
use super::digest::plan_digest;
use super::entry::Entry;
use super::header::{Header, Source};
use super::log::LogReader;
use crate::autopilot::Autopilot;
use crate::map::Grid;
use crate::params::{Faults, Layers, Params};
use crate::plan::{PlanRequest, Planner, Planning, Policy, StepReport};
use crate::predict::{self, PredictError};
use crate::time::{Duration, Instant};
use crate::wire::can::CanFrame;

mod findings;
mod script;

use findings::Findings;
pub use findings::{Comparison, Difference, Ended, SetpointDifference};
use script::Script;

/// Why a log cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// It cannot be read.
    #[error(transparent)]
    Log(#[from] LogError),
    /// There is nothing in it.
    #[error("the log ends before its header")]
    Empty,
    /// It is the continuation of another one.
    #[error("this is part {part} of a log; a replay begins with part 1")]
    NotTheBeginning {
        /// Which part it is.
        part: u32,
    },
    /// Its parameters are none of this version's.
    #[error("its parameters do not fit this version\n{0}")]
    Params(Faults),
    /// Those given instead are none.
    #[error("{0}")]
    Set(Faults),
    /// The predictor cannot be made.
    #[error(transparent)]
    Predictor(#[from] PredictError),
    /// Another network would be asked.
    #[error(
        "the drive had the network with SHA-256 {then}, but predict.model now gives {now}; name the \
         right file with --set predict.model=FILE, or another one to see what it would have done"
    )]
    Network {
        /// That of the drive.
        then: String,
        /// The one there now.
        now: String,
    },
}

/// Replays a log. `next_part` opens a further part by its number; `set` are `section.key=value`
/// assignments over the log's own parameters; `each` is told now and then how many bytes of the
/// present part have been read.
///
/// # Errors
/// If the log cannot be read or replayed.
pub fn replay<R: Read>(
    log: LogReader<R>,
    mut next_part: impl FnMut(u32) -> Result<Option<LogReader<R>>, LogError>,
    set: &[String],
    mut each: impl FnMut(u32, u64),
) -> Result<Comparison, ReplayError> {
    let mut log = log;
    let header = begin(&mut log)?.ok_or(ReplayError::Empty)?;
    if header.part != 1 {
        return Err(ReplayError::NotTheBeginning { part: header.part });
    }
    let mut parts = 1;
    let mut truth = None;
    let mut replay: Option<Replay> = None;
    let mut shown = 0;
    let ended = loop {
        if log.offset() != shown {
            shown = log.offset();
            each(parts, shown);
        }
        let Some((at, entry)) = log.read()? else {
            break match log.end() {
                Some(End::Closed) => Ended::Closed,
                _ => Ended::CutOff,
            };
        };
        match entry {
            Entry::Truth(grid) => truth = Some(*grid),
            Entry::Gap { .. } => break Ended::Gap,
            Entry::Continued => {
                let Some(mut next) = next_part(parts + 1)? else { break Ended::CutOff };
                // What was to be written there never was.
                let Some(theirs) = begin(&mut next)? else { break Ended::CutOff };
                if theirs != (Header { part: parts + 1, ..header.clone() }) {
                    break Ended::CutOff;
                }
                parts += 1;
                (log, shown) = (next, 0);
            }
            entry => {
                let replay = match &mut replay {
                    Some(replay) => replay,
                    none => none.insert(Replay::new(&header, truth.take(), set)?),
                };
                replay.feed(at, entry)?;
            }
        }
    };
    let mut replay = match replay {
        Some(replay) => replay,
        None => Replay::new(&header, truth, set)?,
    };
    replay.finish();
    let time_s = replay.now.seconds_after(replay.made);
    Ok(replay.findings.comparison(time_s, header, parts, ended))
}

/// The header of a log; none if it was cut off before.
fn begin<R: Read>(log: &mut LogReader<R>) -> Result<Option<Header>, LogError> {
    match log.read()? {
        Some((_, Entry::Header(header))) => Ok(Some(*header)),
        Some(_) => Err(LogError::NotALog),
        None => Ok(None),
    }
}

/// A plan that was asked for and has not come back.
struct Pending {
    request: PlanRequest,
    /// Nobody asked for it then; it is answered at this time.
    extra_until: Option<Instant>,
}

/// A core and a planner being fed.
struct Replay {
    set: Vec<String>,
    source: Source,
    seed: u64,
    truth: Option<Arc<Grid>>,
    params: Params,
    /// Parameters that came while a plan was being made: they are for the next one.
    later: Vec<Params>,
    core: Autopilot,
    planner: Box<dyn Planning>,
    script: Script,
    pending: Option<Pending>,
    /// A plan was asked for then, but not now.
    missing: bool,
    /// What the log says was sent since the last input.
    sent: Vec<CanFrame>,
    /// The last input was a tick: what the core sends is fetched after each.
    ticked: bool,
    made: Instant,
    now: Instant,
    findings: Findings,
}

impl Replay {
    fn new(header: &Header, truth: Option<Grid>, set: &[String]) -> Result<Self, ReplayError> {
        let params = parsed(&header.params, set)?;
        check_network(header, &params)?;
        let truth = truth.map(Arc::new);
        let script = Script::default();
        let planner = build(&params, truth.clone(), header.seed, &script)?;
        let layout = params.can.layout;
        let mut core = Autopilot::new(params.core(), layout, header.start, header.made);
        if let Some(truth) = truth.as_ref().filter(|_| params.plan.policy == Policy::KnownMap) {
            core.preload_map(Grid::clone(truth));
        }
        Ok(Self {
            set: set.to_vec(),
            source: header.source,
            seed: header.seed,
            truth,
            params,
            later: Vec::new(),
            core,
            planner,
            script,
            pending: None,
            missing: false,
            sent: Vec::new(),
            ticked: false,
            made: header.made,
            now: header.made,
            findings: Findings::new(layout),
        })
    }

    fn feed(&mut self, at: Instant, entry: Entry) -> Result<(), ReplayError> {
        match entry {
            Entry::Sent(frame) => {
                self.sent.push(frame);
                return Ok(());
            }
            Entry::PlanAsked { number } => {
                self.ask(number);
                return Ok(());
            }
            Entry::Event(_) | Entry::State(_) => return Ok(()),
            _ => {}
        }
        self.compare_frames();
        self.now = at;
        match entry {
            Entry::Received(frame) => self.core.handle_frame(at, &frame),
            Entry::Time => {
                self.answer_extra(at);
                self.core.handle_time(at);
                self.ticked = true;
            }
            Entry::Command(command) => {
                // What it said to that shows in what it does.
                let _ = self.core.handle_command(at, command);
            }
            Entry::Bus(health) => self.core.handle_bus_health(at, health),
            Entry::Host(health) => self.core.handle_host_health(at, health),
            Entry::Fence(fence) => self.core.set_fence(at, Arc::new(*fence)),
            Entry::Params(text) => {
                let params = parsed(&text, &self.set)?;
                self.core.set_params(params.core());
                self.later.push(params);
                if self.pending.is_none() {
                    self.renew_params();
                }
            }
            Entry::PlanDone { number, digest, readings } => {
                self.findings.plans += 1;
                self.answer(at, number, digest, &readings);
            }
            Entry::PlanLost { number } => {
                // Whoever lost it has made a new planner.
                self.pending = None;
                self.renew_planner();
                self.renew_params();
                self.core.handle_job_lost(at, number);
            }
            Entry::Sent(_) | Entry::PlanAsked { .. } | Entry::Event(_) | Entry::State(_) => {}
            Entry::Header(_) | Entry::Truth(_) | Entry::Gap { .. } | Entry::Continued => {}
        }
        Ok(())
    }

    /// Nothing more comes in. What was sent last may not have been written down.
    fn finish(&mut self) {
        let now = self.drain();
        let known = now.len().min(self.sent.len());
        let then = std::mem::take(&mut self.sent);
        self.findings.compare(self.now, &then, &now[..known]);
    }

    // ---- frames

    fn drain(&mut self) -> Vec<CanFrame> {
        std::iter::from_fn(|| self.core.poll_frame()).collect()
    }

    /// Compares what was sent up to here, if anything was: whoever fetches frames fetches all.
    fn compare_frames(&mut self) {
        if !std::mem::take(&mut self.ticked) && self.sent.is_empty() {
            return;
        }
        let then = std::mem::take(&mut self.sent);
        let now = self.drain();
        self.findings.compare(self.now, &then, &now);
        // Jobs are fetched along with frames.
        if let Some(request) = self.core.poll_job() {
            self.note_plan("none was asked for".into(), format!("request {}", request.number));
            self.findings.plans_differing += 1;
            let until = self.now.offset_by(self.params.autopilot.plan_budget_s);
            self.hold(request, Some(until));
        }
    }

    // ---- plans

    /// Notes that a plan came out otherwise.
    fn note_plan(&mut self, then: String, now: String) {
        self.findings.note(self.now, "plan", then, now);
    }

    /// The log says that a plan was asked for here.
    fn ask(&mut self, number: u32) {
        match self.core.poll_job() {
            Some(request) => {
                if request.number != number {
                    let now = format!("request {}", request.number);
                    self.note_plan(format!("request {number}"), now);
                }
                self.hold(request, None);
            }
            None => {
                self.note_plan(format!("request {number}"), "none was asked for".into());
                self.missing = true;
            }
        }
    }

    /// The planner has a request. One that has not been answered gives way to it.
    fn hold(&mut self, mut request: PlanRequest, extra_until: Option<Instant>) {
        if let Some(older) = self.pending.take() {
            request.changed = request.changed.union(&older.request.changed);
            // They were for the one after it, which this is.
            self.renew_params();
        }
        self.pending = Some(Pending { request, extra_until });
    }

    /// The log says that a plan came back here.
    fn answer(&mut self, at: Instant, number: u32, digest: u64, readings: &[Duration]) {
        let missing = std::mem::take(&mut self.missing);
        let Some(pending) = self.pending.take() else {
            self.findings.plans_differing += 1;
            if !missing {
                self.note_plan(format!("plan {number}"), "no plan".into());
            }
            return;
        };
        let Some(report) = self.step(&pending.request, readings) else {
            self.findings.plans_differing += 1;
            self.note_plan(format!("plan {number}"), "the planner panicked".into());
            self.core.handle_job_lost(at, pending.request.number);
            return;
        };
        if plan_digest(&report) != digest {
            self.findings.plans_differing += 1;
            let now = format!("another one: {}", summary(&report));
            self.note_plan(format!("plan {number}"), now);
        }
        self.core.handle_job_done(at, report);
    }

    /// Answers a plan that nobody asked for then.
    fn answer_extra(&mut self, at: Instant) {
        let due = |pending: &mut Pending| pending.extra_until.is_some_and(|until| until <= at);
        let Some(pending) = self.pending.take_if(due) else { return };
        match self.step(&pending.request, &[]) {
            Some(report) => self.core.handle_job_done(at, report),
            None => self.core.handle_job_lost(at, pending.request.number),
        }
    }

    /// One planning step; none if the planner panics.
    fn step(&mut self, request: &PlanRequest, readings: &[Duration]) -> Option<StepReport> {
        self.script.show(readings);
        let report = catch_unwind(AssertUnwindSafe(|| self.planner.step(request))).ok();
        if report.is_none() {
            self.renew_planner();
        }
        self.renew_params();
        report
    }

    /// Parameters that came in the meantime take effect on the planner, one after another, as they
    /// do in the program that wrote the log.
    fn renew_params(&mut self) {
        for params in std::mem::take(&mut self.later) {
            let same_predictor = params.predict == self.params.predict;
            self.params = params;
            if same_predictor || self.source == Source::Sil {
                self.planner.set_params(&self.params.planner());
            } else {
                self.renew_planner();
            }
        }
    }

    /// A new planner; it learns the whole map from the next request.
    fn renew_planner(&mut self) {
        match build(&self.params, self.truth.clone(), self.seed, &self.script) {
            Ok(planner) => self.planner = planner,
            // As in the daemon.
            Err(error) => tracing::error!("keeping the old planner: {error}"),
        }
    }
}

/// Parameters of a log with others over them.
fn parsed(text: &str, set: &[String]) -> Result<Params, ReplayError> {
    let mut layers = Layers::new();
    let params = layers.file("the log", text).build().map_err(ReplayError::Params)?;
    if set.is_empty() {
        return Ok(params);
    }
    for assignment in set {
        layers.set(assignment);
    }
    layers.build().map_err(ReplayError::Set)
}

/// The network must be the one of the drive, unless another one is asked for.
fn check_network(header: &Header, params: &Params) -> Result<(), ReplayError> {
    let then = parsed(&header.params, &[])?;
    let asked =
        (then.predict.kind, &then.predict.model) != (params.predict.kind, &params.predict.model);
    let now = predict::network_digest(&params.predict);
    if asked || now == header.network {
        return Ok(());
    }
    let name = |digest: &str| if digest.is_empty() { "none" } else { digest }.to_owned();
    Err(ReplayError::Network { then: name(&header.network), now: name(&now) })
}

/// The planner that wrote the log had one like this.
fn build(
    params: &Params,
    truth: Option<Arc<Grid>>,
    seed: u64,
    script: &Script,
) -> Result<Box<dyn Planning>, PredictError> {
    // What took too long then is in the log; nothing else does.
    let predictor = predict::build(&params.predict, truth, seed)?;
    Ok(Box::new(Planner::new(params.planner(), predictor, script.stopwatch())))
}

/// What a planning step came to, for a person.
fn summary(report: &StepReport) -> String {
    use crate::plan::Verdict;
    match &report.verdict {
        Verdict::Plan(plan) => {
            let end = plan.trajectory.last();
            format!("{:.3} m in {:.3} s", end.path.s_m, end.t_s)
        }
        Verdict::Keep => "keep the plan".into(),
        Verdict::Rejected(rejection) => format!("none: {rejection:?}"),
        Verdict::Unreachable => "the goal is out of reach".into(),
    }
}

#[cfg(test)]
#[path = "replay_tests.rs"]
mod tests;
