//! The simulated car alone: the car's end of a bus whose other end is somebody else's business.
//!
//! The loop around it hands in the frames that came and sends those that are asked for; time passes
//! in steps of 1 ms. In between lies the same virtual bus as in the rig, so frames leave one after
//! the other as on a wire, the urgent ones first, and the same faults can strike them.
//!
//! What the daemon has been shown is judged by the frames that really left: they go through a
//! decoder of the daemon's kind, and a scan counts as delivered when it comes out whole.

use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;

use super::account::Account;
use super::bus::{BusParams, NodeId};
use super::car::{CarParams, CarState};
use super::car_end::{CarEnd, CarEndSetup};
use super::controller::ControllerParams;
use super::drive::Outcome;
use super::faults::{FaultCounts, FaultPlan, FaultyBus};
use super::judge::{Judge, Verdict};
use super::lidar::LidarParams;
use super::place::{PlaceError, check_place};
use super::script::{DropBox, Script, ScriptEvent};
use super::world::World;
use crate::frames::{Point, Pose, heading_vector};
use crate::time::{Duration, Instant};
use crate::vehicle::VehicleParams;
use crate::wire::can::{CanFrame, CarMessage, Decoder, Layout};

/// Physics and the judge run at this period.
pub const STEP: Duration = Duration::from_millis(1);
/// The truth is told this often, in steps.
const STATE_STEPS: u64 = 10;
/// The longest time without a step.
const NAP: Duration = Duration::from_millis(10);
/// At rest at the goal for this long the drive is over, seconds.
const GOAL_REST_S: f64 = 1.0;
/// Below this speed the car counts as standing, m/s: the controller holds it there.
const REST_SPEED_MPS: f64 = 1e-3;

/// What a drive of the car alone needs.
#[derive(Clone, Debug)]
pub struct SoloSetup {
    /// The true world.
    pub world: World,
    /// Where the car stands at first, map frame.
    pub start: Pose,
    /// Where the drive is over, map frame.
    pub goal: Point,
    /// How near to the goal counts as there, metres.
    pub goal_radius_m: f64,
    /// What is known to be free around the car at the start beyond its radius, metres.
    pub margin_m: f64,
    /// The vehicle.
    pub vehicle: VehicleParams,
    /// The bus.
    pub bus: BusParams,
    /// The lidar.
    pub lidar: LidarParams,
    /// The car's body.
    pub car: CarParams,
    /// Its controller.
    pub controller: ControllerParams,
    /// Layout of the frames.
    pub layout: Layout,
    /// What happens under way.
    pub script: Script,
    /// Seed of everything random.
    pub seed: u64,
    /// The drive is over so many seconds after the first motion, or after the start without one.
    pub time_limit_s: Option<f64>,
    /// Go on at the goal and after a contact.
    pub stay: bool,
}

/// One line of the truth.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Record {
    /// Every 10 ms.
    State(StateRecord),
    /// Something of the script has happened, or is over.
    Event {
        /// Seconds since the start.
        t_s: f64,
        /// Which event, counted from 1.
        event: usize,
        /// What.
        what: String,
        /// Whether it is over now.
        over: bool,
    },
}

/// The car as it truly is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StateRecord {
    /// Seconds since the start.
    pub t_s: f64,
    /// True position, map frame, metres.
    pub x_m: f64,
    /// True position, map frame, metres.
    pub y_m: f64,
    /// True heading, radians.
    pub heading_rad: f64,
    /// True speed, m/s.
    pub speed_mps: f64,
    /// Curvature driven, 1/m.
    pub curvature_pm: f64,
    /// The footprint has touched the world since the last line.
    pub contact: bool,
    /// It has overlapped space not shown free since the last line.
    pub unknown_entry: bool,
    /// The controller stops the car because no setpoints come.
    pub setpoint_lost: bool,
    /// The button is pressed.
    pub emergency_stop: bool,
}

/// The figures of the drive.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SoloSummary {
    /// How it ended.
    pub outcome: Outcome,
    /// Instants at which the true footprint touched the true world.
    pub collisions: u64,
    /// Instants at which it overlapped space that no delivered beam had shown free.
    pub unknown_entries: u64,
    /// Smallest true distance to an obstacle, less the car's radius, metres.
    pub min_clearance_m: f64,
    /// Length of the true path, metres.
    pub path_m: f64,
    /// Seconds from the first to the last motion.
    pub time_s: f64,
    /// Whether the car stands.
    pub at_rest: bool,
    /// Distance to the goal, metres.
    pub goal_distance_m: f64,
    /// Scans measured.
    pub scans: u64,
    /// Scans all of whose frames left unharmed.
    pub scans_delivered: u64,
    /// Frames that found no room in the queue.
    pub frames_unsent: u64,
    /// How often faults struck.
    pub faults: FaultCounts,
}

/// A drive of the car alone.
pub struct Solo {
    world: World,
    account: Account,
    judge: Judge,
    bus: FaultyBus,
    daemon_node: NodeId,
    car_node: NodeId,
    car: CarEnd,
    /// Reads what left as the daemon does.
    mirror: Decoder,
    goal: Point,
    goal_radius_m: f64,
    battery_v: f64,
    time_limit_s: f64,
    stay: bool,
    now: Instant,
    steps: u64,
    incoming: VecDeque<(Instant, CanFrame)>,
    /// Frames to be sent, by urgency and age.
    outgoing: BTreeMap<(u32, u64), CanFrame>,
    outgoing_max: usize,
    order: u64,
    unsent: u64,
    scans_delivered: u64,
    /// Events that have not struck, with their numbers.
    waiting: Vec<(usize, ScriptEvent)>,
    /// Events that are undone at some time.
    undo: Vec<(Instant, usize, ScriptEvent)>,
    started: Option<Instant>,
    last_motion: Option<Instant>,
    moved_m: f64,
    since_record: Verdict,
    outcome: Option<Outcome>,
    records: VecDeque<Record>,
}

impl Solo {
    /// The car at rest at its start.
    ///
    /// # Errors
    /// If it cannot stand there, or the goal is in a wall.
    pub fn new(setup: SoloSetup) -> Result<Self, PlaceError> {
        let radius_m = setup.vehicle.radius_m;
        check_place(&setup.world, setup.start, Some(setup.goal), radius_m)?;
        let account = Account::new(&setup.world, setup.start.position, radius_m + setup.margin_m);
        let car = CarEnd::new(&CarEndSetup {
            start: setup.start,
            vehicle: &setup.vehicle,
            car: &setup.car,
            controller: &setup.controller,
            lidar: &setup.lidar,
            layout: setup.layout,
            seed: setup.seed,
        });
        let faults = FaultPlan { seed: setup.seed, ..FaultPlan::default() };
        let mut bus = FaultyBus::new(&setup.bus, faults);
        let daemon_node = bus.join();
        let car_node = bus.join();
        let waiting = setup.script.event.into_iter().enumerate();
        Ok(Self {
            account,
            judge: Judge::new(radius_m),
            bus,
            daemon_node,
            car_node,
            car,
            mirror: Decoder::new(setup.layout),
            goal: setup.goal,
            goal_radius_m: setup.goal_radius_m,
            battery_v: setup.controller.battery_v,
            time_limit_s: setup.time_limit_s.unwrap_or(f64::INFINITY),
            stay: setup.stay,
            now: Instant::ZERO,
            steps: 0,
            incoming: VecDeque::new(),
            outgoing: BTreeMap::new(),
            outgoing_max: setup.bus.queue_frames as usize,
            order: 0,
            unsent: 0,
            scans_delivered: 0,
            waiting: waiting.map(|(i, event)| (i + 1, event)).collect(),
            undo: Vec::new(),
            started: None,
            last_motion: None,
            moved_m: 0.0,
            since_record: Verdict::default(),
            outcome: None,
            records: VecDeque::new(),
            world: setup.world,
        })
    }

    /// The time up to which everything has happened.
    pub const fn now(&self) -> Instant {
        self.now
    }

    /// The true state.
    pub const fn state(&self) -> &CarState {
        self.car.state()
    }

    /// What the frames that left have shown.
    pub const fn account(&self) -> &Account {
        &self.account
    }

    /// How the drive ended, once it has.
    pub const fn outcome(&self) -> Option<Outcome> {
        self.outcome
    }

    /// A frame that came at that time, for the step that ends then or next.
    pub fn handle_frame(&mut self, at: Instant, frame: CanFrame) {
        self.incoming.push_back((at, frame));
    }

    /// The most urgent frame that is to be sent now.
    pub fn next_frame(&self) -> Option<&CanFrame> {
        self.outgoing.first_key_value().map(|(_, frame)| frame)
    }

    /// The frame that [`next_frame`](Self::next_frame) gives has left.
    pub fn handle_sent(&mut self) {
        let Some((_, frame)) = self.outgoing.pop_first() else { return };
        // What the daemon would drop, this one drops.
        let Ok(Some(CarMessage::Scan(scan))) = self.mirror.decode(self.now, &frame) else {
            return;
        };
        if let Some((pose, ranges_m)) = self.car.take_sent_scan(scan.sequence) {
            self.scans_delivered += 1;
            self.account.delivered(&self.world, self.car.fan(), pose, &ranges_m);
        }
    }

    /// The frame that [`next_frame`](Self::next_frame) gives is lost: nobody is there to take it.
    pub fn handle_lost(&mut self) {
        if self.outgoing.pop_first().is_some() {
            self.unsent += 1;
        }
    }

    /// When the next step is due that has something to send. Earlier ones may be made then as well:
    /// nobody can tell.
    pub fn poll_at(&self) -> Instant {
        let soonest = self.now + STEP;
        if !self.outgoing.is_empty() {
            return soonest;
        }
        let on_grid = |at: Instant| {
            let step = STEP.as_nanos() as u64;
            Instant::from_nanos(at.as_nanos().div_ceil(step).saturating_mul(step))
        };
        let output = self.car.next_output(self.now, STEP);
        let bus = self.bus.poll_at().map_or(output, on_grid);
        output.min(bus).min(self.now + NAP).max(soonest)
    }

    /// One millisecond.
    pub fn step(&mut self) {
        let end = self.now + STEP;
        while self.incoming.front().is_some_and(|(at, _)| *at <= end) {
            if let Some((at, frame)) = self.incoming.pop_front() {
                // A full queue loses the frame, as a real controller's would.
                let _ = self.bus.send(at, self.daemon_node, frame);
            }
        }
        self.bus.advance(end);
        while let Some((at, frame)) = self.bus.receive(self.car_node) {
            self.car.handle_frame(at, &frame);
        }
        self.follow_script();

        self.now = end;
        self.steps += 1;
        let before = self.car.state().pose.position;
        self.car.step(end, STEP.as_secs_f64(), &self.world);
        let position = self.car.state().pose.position;
        self.moved_m += (position - before).norm();
        while let Some(frame) = self.car.poll_frame() {
            if self.bus.send(end, self.car_node, frame).is_err() {
                self.unsent += 1;
            }
        }
        while let Some((_, frame)) = self.bus.receive(self.daemon_node) {
            self.enqueue(frame);
        }
        let verdict = self.judge.observe(&self.world, &self.account, position);
        self.since_record.contact |= verdict.contact;
        self.since_record.unknown_entry |= verdict.unknown_entry;
        self.judge_outcome(verdict.contact);
        if self.steps.is_multiple_of(STATE_STEPS) {
            self.record();
        }
    }

    /// The next line of the truth.
    pub fn poll_record(&mut self) -> Option<Record> {
        self.records.pop_front()
    }

    /// The figures so far; a drive that has not ended counts as interrupted, unless the car stands
    /// at its goal.
    pub fn summary(&self) -> SoloSummary {
        let seconds = |from: Option<Instant>, to: Option<Instant>| {
            from.zip(to).map_or(0.0, |(from, to)| to.seconds_after(from))
        };
        let outcome = if self.judge.collisions() > 0 {
            Outcome::Collision
        } else if let Some(outcome) = self.outcome {
            outcome
        } else if self.is_at_goal() {
            Outcome::Goal
        } else {
            Outcome::Interrupted
        };
        SoloSummary {
            outcome,
            collisions: self.judge.collisions(),
            unknown_entries: self.judge.unknown_entries(),
            min_clearance_m: self.judge.min_clearance_m(),
            path_m: self.moved_m,
            time_s: seconds(self.started, self.last_motion),
            at_rest: !self.is_moving(),
            goal_distance_m: (self.car.state().pose.position - self.goal).norm(),
            scans: self.car.scans(),
            scans_delivered: self.scans_delivered,
            frames_unsent: self.unsent,
            faults: *self.bus.counts(),
        }
    }

    fn is_moving(&self) -> bool {
        self.car.state().speed_mps > REST_SPEED_MPS
    }

    /// Stands at the goal, having come from elsewhere.
    fn is_at_goal(&self) -> bool {
        let distance_m = (self.car.state().pose.position - self.goal).norm();
        self.started.is_some() && !self.is_moving() && distance_m <= self.goal_radius_m
    }

    fn enqueue(&mut self, frame: CanFrame) {
        if self.outgoing.len() >= self.outgoing_max {
            self.unsent += 1;
            return;
        }
        self.order += 1;
        self.outgoing.insert((frame.id.arbitration_rank(), self.order), frame);
    }

    fn judge_outcome(&mut self, contact: bool) {
        if self.is_moving() {
            self.started.get_or_insert(self.now);
            self.last_motion = Some(self.now);
        }
        let since = |at: Option<Instant>| self.now.seconds_after(at.unwrap_or(Instant::ZERO));
        self.outcome = self.outcome.or_else(|| {
            if contact && !self.stay {
                Some(Outcome::Collision)
            } else if self.is_at_goal() && since(self.last_motion) >= GOAL_REST_S && !self.stay {
                Some(Outcome::Goal)
            } else if since(self.started) > self.time_limit_s {
                Some(if self.is_at_goal() { Outcome::Goal } else { Outcome::Timeout })
            } else {
                None
            }
        });
    }

    fn record(&mut self) {
        let state = self.car.state();
        let status = self.car.status(self.now);
        let verdict = std::mem::take(&mut self.since_record);
        self.records.push_back(Record::State(StateRecord {
            t_s: rounded(self.now.as_secs_f64()),
            x_m: rounded(state.pose.position.x),
            y_m: rounded(state.pose.position.y),
            heading_rad: rounded(state.pose.heading_rad),
            speed_mps: rounded(state.speed_mps),
            curvature_pm: rounded(state.curvature_pm),
            contact: verdict.contact,
            unknown_entry: verdict.unknown_entry,
            setpoint_lost: status.setpoint_lost,
            emergency_stop: status.emergency_stop,
        }));
    }

    fn follow_script(&mut self) {
        if self.waiting.is_empty() && self.undo.is_empty() {
            return;
        }
        let now = self.now;
        for (_, number, event) in
            self.undo.extract_if(.., |(at, ..)| *at <= now).collect::<Vec<_>>()
        {
            self.take_back(&event);
            self.tell(number, event.text(), true);
        }
        let moved_s = self.started.map(|at| now.seconds_after(at));
        let state = *self.car.state();
        let strikes =
            |event: &ScriptEvent| event.strikes(moved_s, state.speed_mps, state.curvature_pm);
        for (number, event) in
            self.waiting.extract_if(.., |(_, event)| strikes(event)).collect::<Vec<_>>()
        {
            self.strike(&event);
            self.tell(number, event.text(), false);
            if let Some(for_s) = event.for_s {
                self.undo.push((now.offset_by(for_s), number, event));
            }
        }
    }

    fn tell(&mut self, event: usize, what: String, over: bool) {
        let t_s = rounded(self.now.as_secs_f64());
        self.records.push_back(Record::Event { t_s, event, what, over });
    }

    fn strike(&mut self, event: &ScriptEvent) {
        if let Some(pressed) = event.emergency_stop {
            self.car.set_emergency_stop(pressed);
        }
        if let Some(thing) = event.drop_box {
            self.drop_box(thing);
        }
        if let Some(volts) = event.battery_v {
            self.car.set_battery_v(volts);
        }
        for class in event.silence.iter().flatten() {
            self.car.set_silent(*class, true);
        }
        if let Some(seconds) = event.scan_delay_s {
            self.car.set_scan_delay(Instant::ZERO.offset_by(seconds).since(Instant::ZERO));
        }
        if let Some(plan) = &event.bus {
            let end = event.for_s.map(|for_s| self.now.offset_by(for_s));
            self.bus.add(plan, self.now, end);
        }
    }

    /// What goes wrong on the bus ends by its own window.
    fn take_back(&mut self, event: &ScriptEvent) {
        if let Some(pressed) = event.emergency_stop {
            self.car.set_emergency_stop(!pressed);
        }
        if event.battery_v.is_some() {
            self.car.set_battery_v(self.battery_v);
        }
        for class in event.silence.iter().flatten() {
            self.car.set_silent(*class, false);
        }
        if event.scan_delay_s.is_some() {
            self.car.set_scan_delay(Duration::ZERO);
        }
    }

    fn drop_box(&mut self, thing: DropBox) {
        let state = self.car.state();
        let centre = along_arc(state.pose, state.curvature_pm, thing.ahead_m);
        self.world.fill_rect(centre, thing.length_m, thing.width_m);
    }
}

/// The pose after so many metres of a circle's arc.
fn along_arc(pose: Pose, curvature_pm: f64, way_m: f64) -> Pose {
    let turn = curvature_pm * way_m;
    // The chord: 2 sin(turn / 2) / curvature long, halfway turned.
    let half = 0.5 * turn;
    let chord_m = if half.abs() < 1e-6 { way_m } else { way_m * half.sin() / half };
    Pose {
        position: pose.position + heading_vector(pose.heading_rad + half) * chord_m,
        heading_rad: pose.heading_rad + turn,
    }
}

/// To a millionth: what is below is not worth a line's length.
fn rounded(value: f64) -> f64 {
    (value * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests;
