//! Planning, beside the control thread.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use tokio::sync::mpsc;

use crate::plan::{PlanRequest, Planner, PlannerParams, Planning, StepReport};
use crate::predict::{self, PredictError, PredictParams};
use crate::record::Readings;
use crate::shell::pace;

/// Answers that wait to be fetched: the control thread asks for one thing at a time.
const ANSWERS_MAX: usize = 8;

/// What became of a planning job.
#[derive(Debug)]
pub enum Finished {
    /// It is done.
    Report(Box<StepReport>),
    /// It never will be.
    Lost {
        /// Number of its request.
        number: u32,
        /// Why, for the log.
        reason: String,
    },
}

/// Parameters of planner and predictor.
#[derive(Clone, Debug)]
pub struct PlanningParams {
    /// The planner's.
    pub planner: PlannerParams,
    /// The predictor's.
    pub predict: PredictParams,
}

/// Does planning jobs without holding up who asks for them.
pub trait Worker {
    /// Asks for a step. One that has not been begun gives way to it.
    fn submit(&mut self, request: PlanRequest);

    /// New values, in force from the next request on: steps asked for before are made without them.
    fn set_params(&mut self, params: PlanningParams);

    /// The next answer; never, if there is none to come. Dropping the future loses nothing.
    async fn finished(&mut self) -> Finished;

    /// Whether a predictor was asked for and cannot be had.
    fn is_predictor_missing(&self) -> bool;
}

/// A planner on a thread of its own. A step that panics is reported and a new planner made; one
/// that never comes back holds up nobody, not even the end of the program.
pub struct ThreadWorker {
    shared: Arc<Shared>,
    answers: mpsc::Receiver<Finished>,
}

#[derive(Default)]
struct Shared {
    orders: Mutex<Orders>,
    news: Condvar,
    predictor_missing: AtomicBool,
}

impl Shared {
    /// Nothing is done under the lock that could panic.
    fn orders(&self) -> MutexGuard<'_, Orders> {
        self.orders.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[derive(Default)]
struct Orders {
    /// In the order in which they came, so that a replay can follow it.
    waiting: VecDeque<Order>,
    end: bool,
}

enum Order {
    Step(Box<PlanRequest>),
    Params(Box<PlanningParams>),
}

/// A planner that has been made.
pub struct Made {
    /// The planner.
    pub planner: Box<dyn Planning>,
    /// A predictor was asked for and cannot be had.
    pub predictor_missing: bool,
}

/// Makes a planner; called on the worker's own thread.
pub type Build = Box<dyn Fn(&PlanningParams) -> Result<Made, PredictError> + Send>;

/// Makes the planner that ships; what its clock shows is kept.
pub fn build(params: &PlanningParams, readings: &Readings) -> Result<Made, PredictError> {
    let predictor = predict::build(&params.predict, None, 0)?;
    let predictor_missing = predictor.fault().is_some();
    let begin = pace::now();
    let stopwatch = readings.keep(Box::new(move || begin.elapsed()));
    let planner = Box::new(Planner::new(params.planner.clone(), predictor, stopwatch));
    Ok(Made { planner, predictor_missing })
}

/// Why there is no worker.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The predictor cannot be made.
    #[error(transparent)]
    Predictor(#[from] PredictError),
    /// The system gives no thread.
    #[error("cannot start the planning thread: {0}")]
    Thread(std::io::Error),
    /// Making the planner failed without a word.
    #[error("the planner could not be made: it panicked")]
    Panicked,
}

impl ThreadWorker {
    /// Starts the thread and waits until its planner is made.
    pub fn start(params: PlanningParams, build: Build) -> Result<Self, WorkerError> {
        let shared = Arc::new(Shared::default());
        let (answer, answers) = mpsc::channel(ANSWERS_MAX);
        let (made, when_made) = std::sync::mpsc::sync_channel(1);
        let theirs = Arc::clone(&shared);
        std::thread::Builder::new()
            .name("apexd-plan".into())
            .spawn(move || {
                let Made { planner, predictor_missing } = match build(&params) {
                    Ok(done) => done,
                    Err(error) => {
                        let _ = made.send(Err(error));
                        return;
                    }
                };
                theirs.predictor_missing.store(predictor_missing, Ordering::Relaxed);
                let _ = made.send(Ok(()));
                Desk { params, build, planner, shared: theirs, answer }.work();
            })
            .map_err(WorkerError::Thread)?;
        when_made.recv().map_err(|_| WorkerError::Panicked)??;
        Ok(Self { shared, answers })
    }
}

impl Drop for ThreadWorker {
    fn drop(&mut self) {
        self.shared.orders().end = true;
        self.shared.news.notify_one();
    }
}

impl Worker for ThreadWorker {
    fn submit(&mut self, mut request: PlanRequest) {
        let mut orders = self.shared.orders();
        orders.waiting.retain(|order| match order {
            Order::Step(older) => {
                request.changed = request.changed.union(&older.changed);
                false
            }
            Order::Params(_) => true,
        });
        orders.waiting.push_back(Order::Step(Box::new(request)));
        drop(orders);
        self.shared.news.notify_one();
    }

    fn set_params(&mut self, params: PlanningParams) {
        self.shared.orders().waiting.push_back(Order::Params(Box::new(params)));
        self.shared.news.notify_one();
    }

    async fn finished(&mut self) -> Finished {
        match self.answers.recv().await {
            Some(finished) => finished,
            None => std::future::pending().await,
        }
    }

    fn is_predictor_missing(&self) -> bool {
        self.shared.predictor_missing.load(Ordering::Relaxed)
    }
}

/// The worker's own side.
struct Desk {
    params: PlanningParams,
    build: Build,
    planner: Box<dyn Planning>,
    shared: Arc<Shared>,
    answer: mpsc::Sender<Finished>,
}

impl Desk {
    fn work(mut self) {
        loop {
            let order = {
                let mut orders = self.shared.orders();
                loop {
                    if orders.end {
                        return;
                    }
                    match orders.waiting.pop_front() {
                        Some(order) => break order,
                        None => {
                            let news = &self.shared.news;
                            orders = news.wait(orders).unwrap_or_else(PoisonError::into_inner);
                        }
                    }
                }
            };
            let request = match order {
                Order::Step(request) => request,
                Order::Params(params) => {
                    self.change(*params);
                    continue;
                }
            };
            let number = request.number;
            let step = catch_unwind(AssertUnwindSafe(|| self.planner.step(&request)));
            let finished = match step {
                Ok(report) => Finished::Report(Box::new(report)),
                Err(panic) => {
                    self.renew();
                    Finished::Lost { number, reason: panic_text(&*panic) }
                }
            };
            // A full queue means that the control thread has given up on these answers.
            if let Err(mpsc::error::TrySendError::Closed(_)) = self.answer.try_send(finished) {
                return;
            }
        }
    }

    fn change(&mut self, params: PlanningParams) {
        let same_predictor = params.predict == self.params.predict;
        self.params = params;
        if same_predictor {
            self.planner.set_params(&self.params.planner);
        } else {
            self.renew();
        }
    }

    /// A new planner; it learns the whole map from the next request.
    fn renew(&mut self) {
        match (self.build)(&self.params) {
            Ok(Made { planner, predictor_missing }) => {
                self.planner = planner;
                self.shared.predictor_missing.store(predictor_missing, Ordering::Relaxed);
            }
            Err(error) => tracing::error!("keeping the old planner: {error}"),
        }
    }
}

/// What a panic said.
pub fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned())
        .unwrap_or_else(|| "a panic without words".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::{Point, Pose};
    use crate::map::{CellRect, Grid};
    use crate::plan::{Goal, Plan, Rejection, Verdict};
    use crate::time::{Duration, Instant};

    /// Panics at request 2, never comes back from request 4.
    struct Moody(f64);

    impl Planning for Moody {
        fn step(&mut self, request: &PlanRequest) -> StepReport {
            match request.number {
                2 => panic!("number two"),
                4 => loop {
                    std::thread::park();
                },
                number => StepReport {
                    number,
                    base: request.changed.x1 as u32,
                    takes_over: request.takes_over,
                    verdict: Verdict::Rejected(Rejection::Speed(self.0.to_string())),
                    candidates: 0,
                    times: Default::default(),
                    prediction: Default::default(),
                },
            }
        }

        fn set_params(&mut self, params: &PlannerParams) {
            self.0 = params.speed.speed_max_mps;
        }
    }

    fn request(number: u32) -> PlanRequest {
        let pose = Pose::new(0.0, 0.0, 0.0);
        PlanRequest {
            number,
            grid: Arc::new(Grid::new(0.1)),
            changed: CellRect { x0: 0, y0: 0, x1: number as i32, y1: 1 },
            scan_stamp: Instant::ZERO,
            scan_pose: pose,
            committed: Arc::new(Plan::standing(Instant::ZERO, pose)),
            takes_over: Instant::ZERO,
            goal: Goal { position: Point::new(1.0, 0.0), radius_m: 0.5 },
            speed_cap_mps: f64::INFINITY,
            through_known: false,
            fence: Default::default(),
        }
    }

    fn params() -> PlanningParams {
        PlanningParams { planner: PlannerParams::default(), predict: PredictParams::default() }
    }

    fn moody() -> ThreadWorker {
        let build = |params: &PlanningParams| {
            let speed_max_mps = params.planner.speed.speed_max_mps;
            Ok(Made { planner: Box::new(Moody(speed_max_mps)), predictor_missing: false })
        };
        ThreadWorker::start(params(), Box::new(build)).unwrap()
    }

    fn told(finished: &Finished) -> (u32, String) {
        match finished {
            Finished::Report(report) => match &report.verdict {
                Verdict::Rejected(Rejection::Speed(text)) => (report.number, text.clone()),
                other => panic!("{other:?}"),
            },
            Finished::Lost { number, reason } => (*number, reason.clone()),
        }
    }

    #[tokio::test]
    async fn a_step_that_panics_is_reported_and_the_next_one_done() {
        let mut worker = moody();
        for (number, text) in [(1, "4"), (2, "number two"), (3, "4")] {
            worker.submit(request(number));
            assert_eq!(told(&worker.finished().await), (number, text.to_owned()));
        }
    }

    #[tokio::test]
    async fn new_values_are_in_force_from_the_next_step_on() {
        let mut worker = moody();
        let mut slower = params();
        slower.planner.speed.speed_max_mps = 1.5;
        worker.set_params(slower.clone());
        worker.submit(request(1));
        assert_eq!(told(&worker.finished().await), (1, "1.5".to_owned()));
        slower.planner.speed.speed_max_mps = 2.5;
        slower.predict.range_m = 3.0;
        worker.set_params(slower);
        worker.submit(request(3));
        assert_eq!(told(&worker.finished().await), (3, "2.5".to_owned()), "a new predictor");
    }

    #[tokio::test]
    async fn a_step_asked_for_before_new_values_came_is_made_without_them() {
        let mut worker = moody();
        let mut slower = params();
        slower.planner.speed.speed_max_mps = 1.5;
        // Both come before the worker has looked.
        let waiting = [
            Order::Step(Box::new(request(1))),
            Order::Params(Box::new(slower)),
            Order::Step(Box::new(request(3))),
        ];
        worker.shared.orders().waiting.extend(waiting);
        worker.shared.news.notify_one();
        assert_eq!(told(&worker.finished().await), (1, "4".to_owned()));
        assert_eq!(told(&worker.finished().await), (3, "1.5".to_owned()));
    }

    #[tokio::test]
    async fn a_step_that_never_ends_holds_up_nobody_and_later_ones_give_way_to_the_newest() {
        let mut worker = moody();
        worker.submit(request(4));
        // Until it has been begun.
        while !worker.shared.orders().waiting.is_empty() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        worker.submit(request(9));
        worker.submit(request(7));
        let wait = Duration::from_millis(50);
        assert!(tokio::time::timeout(wait, worker.finished()).await.is_err());
        let waiting = std::mem::take(&mut worker.shared.orders().waiting);
        let [Order::Step(waiting)] = &*Vec::from(waiting) else { panic!("one is enough") };
        assert_eq!((waiting.number, waiting.changed.x1), (7, 9), "no change is forgotten");
        drop(worker);
    }

    #[test]
    fn a_planner_that_cannot_be_made_is_said_at_the_start() {
        let fails = |_: &PlanningParams| {
            Err(PredictError::NoTruth { kind: crate::predict::PredictorKind::Oracle })
        };
        let error = ThreadWorker::start(params(), Box::new(fails)).err().unwrap();
        assert!(error.to_string().contains("needs the true map"), "{error}");
        let panics = |_: &PlanningParams| panic!("no");
        let error = ThreadWorker::start(params(), Box::new(panics)).err().unwrap();
        assert!(matches!(error, WorkerError::Panicked));
    }

    #[test]
    fn a_network_that_is_missing_is_known_from_the_start() {
        let mut wanted = params();
        wanted.predict.model = "/nowhere/net.onnx".into();
        assert!(build(&wanted, &Readings::default()).unwrap().predictor_missing);
        wanted.predict.kind = crate::predict::PredictorKind::None;
        assert!(!build(&wanted, &Readings::default()).unwrap().predictor_missing);
    }
}
