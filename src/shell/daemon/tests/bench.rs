//! The control loop against the simulated car, in virtual time: the async runtime's clock stands
//! still until everybody waits.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Arc;

use tokio::sync::{Notify, mpsc};
use tokio::time::Instant as RuntimeInstant;

use crate::autopilot::Autopilot;
use crate::frames::{Point, Pose};
use crate::params::Params;
use crate::plan::{PlanRequest, Planning};
use crate::record::{Header, Readings, Source, params_text};
use crate::shell::can::{BusState, CanLinkError, LinkStatistics, Received, SendFault};
use crate::shell::daemon::control::{Control, Order, Outside, Pulse, Task, Word};
use crate::shell::daemon::link::Link;
use crate::shell::daemon::seam::Seam;
use crate::shell::daemon::statistics::Summary;
use crate::shell::daemon::timing::Timing;
use crate::shell::daemon::worker::{self, Finished, PlanningParams, ThreadWorker, Worker};
use crate::shell::logbook::{Logbook, Place, WhenFull};
use crate::sim::account::Account;
use crate::sim::bus::{BusParams, NodeId};
use crate::sim::car_end::{CarEnd, CarEndSetup};
use crate::sim::faults::{FaultPlan, FaultyBus};
use crate::sim::judge::Judge;
use crate::sim::maze::{self, Family};
use crate::sim::world::World;
use crate::time::{Duration, Instant};
use crate::wire::can::{CanFrame, Layout};

const STEP: Duration = Duration::from_millis(1);

/// The car in its world.
pub struct Bench {
    world: World,
    account: Account,
    pub judge: Judge,
    bus: FaultyBus,
    daemon: NodeId,
    car_node: NodeId,
    pub car: CarEnd,
    now: Instant,
    inbox: VecDeque<Received>,
    last_scan: Option<u16>,
    decoder: crate::wire::can::Decoder,
    /// The interface is gone.
    pub gone: bool,
    /// The send queue is full.
    pub full: bool,
    statistics: LinkStatistics,
}

impl Bench {
    /// The fastest that it may get.
    pub fn speed_mps(&self) -> f64 {
        self.car.state().speed_mps
    }

    /// One millisecond.
    fn step(&mut self) {
        let end = self.now + STEP;
        while let Some(at) = self.bus.poll_at().filter(|at| *at <= end) {
            self.bus.advance(at);
            while let Some((at, frame)) = self.bus.receive(self.car_node) {
                self.car.handle_frame(at, &frame);
            }
            while let Some((at, frame)) = self.bus.receive(self.daemon) {
                self.deliver(at, frame);
            }
        }
        self.now = end;
        self.car.step(end, STEP.as_secs_f64(), &self.world);
        while let Some(frame) = self.car.poll_frame() {
            let _ = self.bus.send(end, self.car_node, frame);
        }
        self.judge.observe(&self.world, &self.account, self.car.state().pose.position);
    }

    fn deliver(&mut self, at: Instant, frame: CanFrame) {
        if self.gone {
            return;
        }
        // The account follows what the daemon can make of the frames, with a decoder of its own.
        if let Ok(Some(crate::wire::can::CarMessage::Scan(scan))) = self.decoder.decode(at, &frame)
            && self.last_scan != Some(scan.sequence)
        {
            self.last_scan = Some(scan.sequence);
            if let Some((pose, ranges)) = self.car.take_sent_scan(scan.sequence) {
                self.account.delivered(&self.world, self.car.fan(), pose, &ranges);
            }
        }
        self.statistics.received += 1;
        self.inbox.push_back(Received::Frame { at, frame });
    }
}

pub struct BenchLink {
    bench: Rc<RefCell<Bench>>,
    news: Rc<Notify>,
}

impl Link for BenchLink {
    async fn receive(&self) -> Result<Received, CanLinkError> {
        loop {
            if self.bench.borrow().gone {
                return Err(CanLinkError::Gone { interface: "bench".into() });
            }
            let next = self.bench.borrow_mut().inbox.pop_front();
            match next {
                Some(received) => return Ok(received),
                None => self.news.notified().await,
            }
        }
    }

    fn try_send(&self, frame: &CanFrame) -> Result<(), SendFault> {
        let mut bench = self.bench.borrow_mut();
        if bench.gone {
            return Err(SendFault::Down);
        }
        if bench.full {
            return Err(SendFault::Full);
        }
        let (now, node) = (bench.now, bench.daemon);
        bench.statistics.sent += 1;
        bench.bus.send(now, node, *frame).map_err(|_| SendFault::Full)
    }

    fn statistics(&self) -> LinkStatistics {
        self.bench.borrow().statistics
    }

    fn reopen(&mut self) -> Result<(), CanLinkError> {
        if self.bench.borrow().gone {
            return Err(CanLinkError::NoSuchInterface { interface: "bench".into() });
        }
        self.bench.borrow_mut().statistics.state = BusState::Active;
        Ok(())
    }
}

#[derive(Clone, Copy)]
pub struct VirtualTiming(RuntimeInstant);

impl Timing for VirtualTiming {
    fn now(&self) -> Instant {
        Instant::ZERO + self.0.elapsed()
    }

    async fn until(&mut self, at: Instant) {
        tokio::time::sleep_until(self.0 + at.since(Instant::ZERO)).await;
    }
}

/// What goes wrong in planning.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trouble {
    None,
    /// The step with that count never comes back.
    Hangs(u64),
    /// The step with that count panics.
    Lost(u64),
}

/// Plans in line, and hands the answer out after the latency.
pub struct InlineWorker {
    planner: Box<dyn Planning>,
    latency: Duration,
    trouble: Trouble,
    steps: u64,
    answer: Option<(RuntimeInstant, Finished)>,
}

impl Worker for InlineWorker {
    fn submit(&mut self, request: PlanRequest) {
        self.steps += 1;
        let number = request.number;
        let finished = match self.trouble {
            Trouble::Hangs(at) if at <= self.steps => return,
            Trouble::Lost(at) if at == self.steps => {
                Finished::Lost { number, reason: "on purpose".into() }
            }
            _ => Finished::Report(Box::new(self.planner.step(&request))),
        };
        self.answer = Some((RuntimeInstant::now() + self.latency, finished));
    }

    fn set_params(&mut self, params: PlanningParams) {
        self.planner.set_params(&params.planner);
    }

    async fn finished(&mut self) -> Finished {
        match &self.answer {
            Some((at, _)) => tokio::time::sleep_until(*at).await,
            None => std::future::pending().await,
        }
        self.answer.take().expect("it has just been there").1
    }

    fn is_predictor_missing(&self) -> bool {
        false
    }
}

/// Either kind of worker.
enum BenchWorker {
    Inline(InlineWorker),
    Thread(ThreadWorker),
}

impl Worker for BenchWorker {
    fn submit(&mut self, request: PlanRequest) {
        match self {
            Self::Inline(worker) => worker.submit(request),
            Self::Thread(worker) => worker.submit(request),
        }
    }

    fn set_params(&mut self, params: PlanningParams) {
        match self {
            Self::Inline(worker) => worker.set_params(params),
            Self::Thread(worker) => worker.set_params(params),
        }
    }

    async fn finished(&mut self) -> Finished {
        match self {
            Self::Inline(worker) => worker.finished().await,
            Self::Thread(worker) => worker.finished().await,
        }
    }

    fn is_predictor_missing(&self) -> bool {
        match self {
            Self::Inline(worker) => worker.is_predictor_missing(),
            Self::Thread(worker) => worker.is_predictor_missing(),
        }
    }
}

/// What a test does beside the loop.
pub struct Hands {
    pub bench: Rc<RefCell<Bench>>,
    pub orders: mpsc::Sender<Order>,
    pub words: std::sync::mpsc::Receiver<Word>,
    pub seam: Seam,
    pub pulse: Arc<Pulse>,
    pub goal: Point,
}

impl Hands {
    /// Waits until something is so; fails after a minute of virtual time.
    pub async fn until(&self, what: &str, mut is_so: impl FnMut(&Bench) -> bool) {
        for _ in 0..60_000 {
            if is_so(&self.bench.borrow()) {
                return;
            }
            tokio::time::sleep(STEP).await;
        }
        panic!("never: {what}");
    }

    pub async fn sleep_s(&self, seconds: f64) {
        tokio::time::sleep(Duration::from_secs_f64(seconds)).await;
    }
}

/// How a test sets the bench up.
pub struct Setup {
    pub params: Params,
    pub trouble: Trouble,
    pub task: Task,
    /// Send the car to the maze's goal.
    pub to_goal: bool,
    pub faults: FaultPlan,
    /// Write the drive down there.
    pub record: Option<Place>,
    /// By the clock on the wall, with the planner on a thread of its own.
    pub in_real_time: bool,
}

impl Default for Setup {
    fn default() -> Self {
        let mut params = Params::default();
        params.predict.kind = crate::predict::PredictorKind::None;
        params.lidar.beams = 360;
        params.speed.speed_max_mps = 3.0;
        Self {
            params,
            trouble: Trouble::None,
            task: Task { time_limit_s: Some(120.0), ..Task::default() },
            to_goal: true,
            faults: FaultPlan::default(),
            record: None,
            in_real_time: false,
        }
    }
}

/// Runs the loop against the car; `beside` goes on at the same time. Gives the summary and the car.
pub fn run<F: Future<Output = ()>>(
    setup: Setup,
    beside: impl FnOnce(Hands) -> F,
) -> (Summary, Rc<RefCell<Bench>>) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .start_paused(!setup.in_real_time)
        .build()
        .unwrap();
    runtime.block_on(async {
        let Setup { params, trouble, mut task, to_goal, faults, record, in_real_time } = setup;
        let maze = maze::generate(Family::Thin, 3, 0.1).unwrap();
        if to_goal {
            task.goal = Some(maze.goal);
        }
        let mut bus = FaultyBus::new(&BusParams::default(), faults);
        let (daemon, car_node) = (bus.join(), bus.join());
        let car = CarEnd::new(&CarEndSetup {
            start: maze.start,
            vehicle: &params.vehicle,
            car: &params.car,
            controller: &params.controller,
            lidar: &params.lidar,
            layout: Layout::Fd,
            seed: 1,
        });
        let radius_m = params.vehicle.radius_m;
        let start: Pose = maze.start;
        let keep_m = radius_m + params.certify.margin_m;
        let bench = Rc::new(RefCell::new(Bench {
            account: Account::new(&maze.world, start.position, keep_m),
            world: maze.world,
            judge: Judge::new(radius_m),
            bus,
            daemon,
            car_node,
            car,
            now: Instant::ZERO,
            inbox: VecDeque::new(),
            last_scan: None,
            decoder: crate::wire::can::Decoder::new(Layout::Fd),
            gone: false,
            full: false,
            statistics: LinkStatistics::default(),
        }));
        let begun = RuntimeInstant::now();
        let timing = VirtualTiming(begun);
        let news = Rc::new(Notify::new());
        let planning =
            PlanningParams { planner: params.planner(), predict: params.predict.clone() };
        let readings = Readings::default();
        let made = timing.now();
        let logbook = record.map(|place| {
            let header = Header {
                build: "test".into(),
                source: Source::Run,
                begun_utc: "20260131T235959Z".into(),
                made,
                start,
                goal: task.goal,
                seed: 0,
                params: params_text(&params),
                network: crate::predict::network_digest(&params.predict),
                part: 1,
            };
            Logbook::begin(place, header, None, WhenFull::Wait).unwrap()
        });
        let kept = readings.clone();
        let worker = if in_real_time {
            let build = move |params: &PlanningParams| worker::build(params, &kept);
            BenchWorker::Thread(ThreadWorker::start(planning, Box::new(build)).unwrap())
        } else {
            BenchWorker::Inline(InlineWorker {
                planner: worker::build(&planning, &kept).unwrap().planner,
                latency: Duration::from_millis(8),
                trouble,
                steps: 0,
                answer: None,
            })
        };
        let (orders, when_ordered) = mpsc::channel(16);
        let (say, words) = std::sync::mpsc::channel();
        let (seam, inner) = Seam::new();
        let pulse = Arc::new(Pulse::default());
        let outside = Outside {
            orders: when_ordered,
            seam: inner,
            words: say,
            pulse: Arc::clone(&pulse),
            log_dropped: Box::new(|| 0),
            recorder: logbook.as_ref().map(|logbook| logbook.recorder().clone()),
        };
        let mut core = Autopilot::new(params.core(), Layout::Fd, start, made);
        if let Some(logbook) = &logbook {
            core.set_witness(logbook.recorder().scribe(readings));
        }
        let link = BenchLink { bench: Rc::clone(&bench), news: Rc::clone(&news) };
        let hands = Hands { bench: Rc::clone(&bench), orders, words, seam, pulse, goal: maze.goal };
        let control = Control::new(core, params, link, timing, worker, outside, task).run();
        let physics = async {
            loop {
                let next = bench.borrow().now + STEP;
                tokio::time::sleep_until(begun + next.since(Instant::ZERO)).await;
                bench.borrow_mut().step();
                news.notify_one();
            }
        };
        let beside = async {
            beside(hands).await;
            std::future::pending::<()>().await;
        };
        tokio::pin!(control, physics, beside);
        let summary = tokio::select! {
            biased;
            () = &mut physics => unreachable!("physics has no end"),
            summary = &mut control => summary,
            () = &mut beside => unreachable!("it waits for the loop"),
        };
        if let Some(logbook) = logbook {
            logbook.close().unwrap();
        }
        (summary, Rc::clone(&bench))
    })
}
