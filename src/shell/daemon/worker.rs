//! Planning, beside the control thread.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use tokio::sync::mpsc;

use crate::plan::{PlanRequest, Planner, PlannerParams, Planning, StepReport};
use crate::predict::{self, PredictError, PredictParams};
use crate::shell::pace;

/// Answers that wait to be fetched: the control thread asks for one thing at a time.
const ANSWERS_MAX: usize = 8;

/// What became of a planning job.
#[derive(Debug)]
pub enum Finished {
    /// It is done.
    Report(StepReport),
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

    /// New values, in force from the next step on.
    fn set_params(&mut self, params: PlanningParams);

    /// The next answer; never, if there is none to come. Dropping the future loses nothing.
    async fn finished(&mut self) -> Finished;
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
}

impl Shared {
    /// Nothing is done under the lock that could panic.
    fn orders(&self) -> MutexGuard<'_, Orders> {
        self.orders.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[derive(Default)]
struct Orders {
    request: Option<PlanRequest>,
    params: Option<PlanningParams>,
    end: bool,
}

/// Makes a planner; called on the worker's own thread.
pub type Build = Box<dyn Fn(&PlanningParams) -> Result<Box<dyn Planning>, PredictError> + Send>;

/// Makes the planner that ships.
pub fn build(params: &PlanningParams) -> Result<Box<dyn Planning>, PredictError> {
    let predictor = predict::build(&params.predict, None, 0)?;
    let begin = pace::now();
    let stopwatch = Box::new(move || begin.elapsed());
    Ok(Box::new(Planner::new(params.planner.clone(), predictor, stopwatch)))
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
                let planner = match build(&params) {
                    Ok(planner) => planner,
                    Err(error) => {
                        let _ = made.send(Err(error));
                        return;
                    }
                };
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
        if let Some(older) = &orders.request {
            request.changed = request.changed.union(&older.changed);
        }
        orders.request = Some(request);
        drop(orders);
        self.shared.news.notify_one();
    }

    fn set_params(&mut self, params: PlanningParams) {
        self.shared.orders().params = Some(params);
        self.shared.news.notify_one();
    }

    async fn finished(&mut self) -> Finished {
        match self.answers.recv().await {
            Some(finished) => finished,
            None => std::future::pending().await,
        }
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
            let (request, params) = {
                let mut orders = self.shared.orders();
                while orders.request.is_none() && orders.params.is_none() && !orders.end {
                    orders = self.shared.news.wait(orders).unwrap_or_else(PoisonError::into_inner);
                }
                if orders.end {
                    return;
                }
                (orders.request.take(), orders.params.take())
            };
            if let Some(params) = params {
                self.change(params);
            }
            let Some(request) = request else { continue };
            let number = request.number;
            let step = catch_unwind(AssertUnwindSafe(|| self.planner.step(&request)));
            let finished = match step {
                Ok(report) => Finished::Report(report),
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
            Ok(planner) => self.planner = planner,
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
