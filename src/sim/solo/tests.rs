use super::*;
use crate::autopilot::{Autopilot, Command, CoreParams, Mode};
use crate::command::CarStatus;
use crate::plan::{Planner, PlannerParams, Planning, StepReport};
use crate::predict::{self, PredictParams, PredictorKind};
use crate::sim::maze::{Family, generate};
use crate::wire::can::{CarDecoder, DaemonMessage};

fn at(millis: u64) -> Instant {
    Instant::from_nanos(millis * 1_000_000)
}

fn setup(script: &str) -> SoloSetup {
    let maze = generate(Family::Thin, 3, 0.1).unwrap();
    SoloSetup {
        world: maze.world,
        start: maze.start,
        goal: maze.goal,
        goal_radius_m: 0.5,
        margin_m: 0.05,
        vehicle: VehicleParams::default(),
        bus: BusParams::default(),
        lidar: LidarParams::default(),
        car: CarParams::default(),
        controller: ControllerParams::default(),
        layout: Layout::Fd,
        script: Script::parse(script).unwrap(),
        seed: 1,
        time_limit_s: Some(60.0),
        stay: false,
    }
}

/// A socket that takes everything: what left by when.
fn drain(solo: &mut Solo) -> Vec<CanFrame> {
    std::iter::from_fn(|| {
        let frame = solo.next_frame().copied()?;
        solo.handle_sent();
        Some(frame)
    })
    .collect()
}

/// Lets the car stand for so long; what it sent, with the times.
fn stand(solo: &mut Solo, millis: u64) -> Vec<(Instant, CanFrame)> {
    let mut sent = Vec::new();
    for _ in 0..millis {
        solo.step();
        let now = solo.now();
        sent.extend(drain(solo).into_iter().map(|frame| (now, frame)));
    }
    sent
}

fn received(frames: &[(Instant, CanFrame)], layout: Layout) -> Vec<(Instant, CarMessage)> {
    let mut decoder = Decoder::new(layout);
    let decode =
        |(at, frame): &(Instant, CanFrame)| Some((*at, decoder.decode(*at, frame).ok().flatten()?));
    frames.iter().filter_map(decode).collect()
}

fn statuses(frames: &[(Instant, CanFrame)]) -> Vec<(Instant, CarStatus)> {
    let status = |(at, message)| match message {
        CarMessage::Status(status) => Some((at, status)),
        _ => None,
    };
    received(frames, Layout::Fd).into_iter().filter_map(status).collect()
}

/// The daemon's core on the other end, its frames taking 0.3 ms there and back.
struct Daemon {
    core: Autopilot,
    planner: Planner,
    job: Option<(Instant, StepReport)>,
    goal: Point,
}

impl Daemon {
    fn new(setup: &SoloSetup, speed_mps: f64) -> Self {
        let mut core = CoreParams::default();
        core.speed.speed_max_mps = speed_mps;
        let mut planner = PlannerParams::default();
        planner.speed.speed_max_mps = speed_mps;
        let none = PredictParams { kind: PredictorKind::None, ..PredictParams::default() };
        let predictor = predict::build(&none, None, 1).unwrap();
        Self {
            core: Autopilot::new(core, setup.layout, setup.start, Instant::ZERO),
            planner: Planner::new(planner, predictor, Box::new(|| Duration::ZERO)),
            job: None,
            goal: setup.goal,
        }
    }

    fn handle(&mut self, now: Instant, frames: &[CanFrame]) -> Vec<CanFrame> {
        for frame in frames {
            self.core.handle_frame(now, frame);
        }
        if let Some((_, report)) = self.job.take_if(|(at, _)| *at <= now) {
            self.core.handle_job_done(now, report);
        }
        self.core.handle_time(now);
        if self.core.mode() == Mode::Disarmed && self.core.handle_command(now, Command::Arm).is_ok()
        {
            self.core.handle_command(now, Command::Goto(self.goal)).unwrap();
        }
        if let Some(request) = self.core.poll_job() {
            let report = self.planner.step(&request);
            self.job = Some((now.offset_by(0.02), report));
        }
        while self.core.poll_event().is_some() {}
        std::iter::from_fn(|| self.core.poll_frame()).collect()
    }
}

/// Drives to the end with a daemon that is there as long as `alive` says.
fn drive(
    mut setup: SoloSetup,
    speed_mps: f64,
    mut alive: impl FnMut(&Solo) -> bool,
) -> (Solo, Vec<Record>) {
    setup.time_limit_s = setup.time_limit_s.or(Some(60.0));
    let mut daemon = Daemon::new(&setup, speed_mps);
    let mut solo = Solo::new(setup).unwrap();
    let mut records = Vec::new();
    while solo.outcome().is_none() {
        solo.step();
        let now = solo.now();
        let frames = drain(&mut solo);
        if alive(&solo) {
            for frame in daemon.handle(now, &frames) {
                solo.handle_frame(now, frame);
            }
        }
        records.extend(std::iter::from_fn(|| solo.poll_record()));
    }
    (solo, records)
}

fn states(records: &[Record]) -> Vec<StateRecord> {
    let state = |record: &Record| match record {
        Record::State(state) => Some(*state),
        Record::Event { .. } => None,
    };
    records.iter().filter_map(state).collect()
}

#[test]
fn the_core_drives_it_to_the_goal_and_nothing_is_touched_or_invented() {
    let (solo, records) = drive(setup(""), 3.0, |_| true);
    let summary = solo.summary();
    assert_eq!(summary.outcome, Outcome::Goal, "{summary:?}");
    assert_eq!((summary.collisions, summary.unknown_entries), (0, 0), "{summary:?}");
    assert!(summary.min_clearance_m > 0.0 && summary.path_m > 5.0, "{summary:?}");
    assert!(summary.at_rest && summary.goal_distance_m <= 0.5);
    assert!(summary.scans_delivered + 2 >= summary.scans, "{summary:?}");
    // Over one second after the last motion, told every 10 ms.
    let states = states(&records);
    assert!((solo.now().as_secs_f64() - states.last().unwrap().t_s).abs() < 0.011);
    assert!(states.windows(2).all(|pair| (pair[1].t_s - pair[0].t_s - 0.01).abs() < 1e-9));
    let standing = states.iter().rev().take_while(|state| state.speed_mps <= 1e-3).count();
    assert!((99..=102).contains(&standing), "{standing}");
    assert!(states.iter().all(|state| !state.contact && !state.unknown_entry));
}

#[test]
fn a_daemon_that_dies_at_speed_leaves_a_car_that_stops_where_it_was_shown_the_way() {
    let (mut limit, mut died) = (setup(""), None);
    limit.time_limit_s = Some(15.0);
    let (solo, records) = drive(limit, 3.0, |solo| {
        if died.is_none() && solo.state().speed_mps > 2.0 {
            died = Some(solo.now());
        }
        died.is_none()
    });
    let summary = solo.summary();
    assert_eq!((summary.collisions, summary.unknown_entries), (0, 0), "{summary:?}");
    assert_eq!(summary.outcome, Outcome::Timeout);
    assert!(summary.at_rest);
    let died_s = died.unwrap().as_secs_f64();
    let lost = states(&records).into_iter().find(|state| state.setpoint_lost).unwrap();
    assert!((0.1..0.13).contains(&(lost.t_s - died_s)), "{} after {died_s}", lost.t_s);
}

#[test]
fn a_box_set_down_on_the_way_is_seen_and_not_touched() {
    let script = "[[event]]\nspeed_mps = 1.5\n\
                  drop_box = { ahead_m = 2.5, length_m = 0.2, width_m = 0.3 }";
    let mut setup = setup(script);
    setup.time_limit_s = Some(12.0);
    let before = setup.world.clone();
    let (solo, records) = drive(setup, 3.0, |_| true);
    let event = records.iter().find(|record| matches!(record, Record::Event { .. })).unwrap();
    assert!(
        matches!(event, Record::Event { event: 1, over: false, what, .. } if what.contains("box"))
    );
    assert_ne!(solo.world, before);
    assert_eq!(solo.summary().collisions, 0, "{:?}", solo.summary());
}

#[test]
fn scans_count_as_delivered_only_if_all_of_their_frames_left_unharmed() {
    let stood = |script: &str| {
        let mut solo = Solo::new(setup(script)).unwrap();
        stand(&mut solo, 1_040);
        (solo.summary(), solo.account().shown_cells())
    };
    let nothing = Solo::new(setup("")).unwrap().account().shown_cells();
    let (summary, shown) = stood("");
    assert_eq!((summary.scans, summary.scans_delivered), (20, 20));
    assert!(shown > 10 * nothing);
    let frame_loss = |p: f64| {
        format!("[[event]]\n[event.bus]\nframes = [{{ harm = \"loss\", probability = {p} }}]")
    };
    // Every frame to the daemon: no scan is whole, nothing is shown.
    let (summary, shown) = stood(&frame_loss(1.0));
    assert_eq!((summary.scans, summary.scans_delivered, shown), (20, 0, nothing));
    // A few percent of the frames: most scans lose one.
    let (summary, _) = stood(&frame_loss(0.03));
    assert!((1..15).contains(&summary.scans_delivered), "{summary:?}");
    assert!(summary.faults.lost > 10);
    let flip = "[[event]]\n[event.bus]\nframes = \
                [{ harm = { flip = { bits = 1 } }, probability = 1.0, ids = [256, 256] }]";
    assert_eq!(stood(flip).0.scans_delivered, 0);
    // Frames of the daemon do not matter.
    let other = frame_loss(1.0).replace("1 }]", "1.0, receiver = 1 }]");
    assert_eq!(stood(&other).0.scans_delivered, 20, "{other}");
}

#[test]
fn a_scan_that_a_full_socket_keeps_half_of_is_not_delivered() {
    let mut solo = Solo::new(setup("")).unwrap();
    let mut taken = 0;
    for _ in 0..1_000 {
        solo.step();
        // The socket takes the first thousand bytes' worth and then nothing any more.
        while taken < 60 && solo.next_frame().is_some() {
            solo.handle_sent();
            taken += 1;
        }
    }
    assert!(solo.summary().scans_delivered <= 1, "{:?}", solo.summary());
    assert!(solo.next_frame().is_some_and(|frame| frame.id.raw() < 0x100), "urgent ones first");
    assert_eq!(solo.poll_at(), solo.now() + STEP, "what is left is tried again");
}

#[test]
fn urgent_frames_overtake_a_scan_and_frames_leave_as_a_bus_would_carry_them() {
    let mut fast = setup("");
    fast.lidar.rate_hz = 40.0;
    let mut solo = Solo::new(fast).unwrap();
    let sent = stand(&mut solo, 1_000);
    let scan_frames = sent.iter().filter(|(_, frame)| frame.id.raw() == 0x100).count();
    assert!(scan_frames > 1_000, "{scan_frames}");
    for (now, frames) in sent.chunk_by(|a, b| a.0 == b.0).map(|chunk| (chunk[0].0, chunk)) {
        // 64 bytes take 170 microseconds; short ones are shorter.
        assert!(frames.len() <= 14, "{} frames in the step to {now}", frames.len());
        let scans = frames.iter().filter(|(_, frame)| frame.id.raw() == 0x100).count();
        assert!(scans <= 7, "{scans} frames of a scan in the step to {now}");
    }
    // Odometry is measured each 10 ms and leaves within two steps, scan or no scan.
    let odometry: Vec<u64> = sent
        .iter()
        .filter(|(_, frame)| frame.id.raw() == 0x050)
        .map(|(at, _)| at.as_nanos() / 1_000_000)
        .collect();
    assert_eq!(odometry.len(), 99);
    for (i, millis) in odometry.into_iter().enumerate() {
        let measured = 10 * (i as u64 + 1);
        assert!((measured..=measured + 2).contains(&millis), "{millis} for {measured}");
    }
}

#[test]
fn steps_made_late_all_at_once_send_the_same_as_steps_made_in_time() {
    let frames = |nap: bool| {
        let mut solo = Solo::new(setup("")).unwrap();
        let mut sent = Vec::new();
        while solo.now() < at(500) {
            let until = if nap { solo.poll_at() } else { solo.now() + STEP };
            while solo.now() < until {
                solo.step();
            }
            sent.extend(drain(&mut solo));
        }
        sent
    };
    assert_eq!(frames(true), frames(false));
}

#[test]
fn it_sleeps_while_there_is_nothing_to_send() {
    let mut solo = Solo::new(setup("")).unwrap();
    let mut wakes = 0;
    while solo.now() < at(1_000) {
        let until = solo.poll_at();
        assert!(until > solo.now() && until <= solo.now() + NAP);
        while solo.now() < until {
            solo.step();
        }
        drain(&mut solo);
        wakes += 1;
    }
    // Each 10 ms one to measure and one to send, and 20 scans of some 7 ms.
    assert!((200..350).contains(&wakes), "{wakes}");
}

#[test]
fn a_silent_sensor_says_nothing_and_comes_back_without_a_gap_in_its_counter() {
    let script = "[[event]]\nsilence = [\"odometry\", \"scan\"]\nfor_s = 0.3";
    let mut solo = Solo::new(setup(script)).unwrap();
    let sent = stand(&mut solo, 600);
    let messages = received(&sent, Layout::Fd);
    let times = |class: fn(&CarMessage) -> bool| -> Vec<f64> {
        messages.iter().filter(|(_, m)| class(m)).map(|(at, _)| at.as_secs_f64()).collect()
    };
    let odometry = times(|m| matches!(m, CarMessage::Odometry(_)));
    let scans = times(|m| matches!(m, CarMessage::Scan(_)));
    assert!(odometry[0] > 0.3 && odometry[0] < 0.32, "{odometry:?}");
    assert!(scans[0] > 0.3 && scans.len() >= 5, "{scans:?}");
    assert!(times(|m| matches!(m, CarMessage::Status(_))).len() >= 29);
    let mut decoder = Decoder::new(Layout::Fd);
    for (at, frame) in &sent {
        let _ = decoder.decode(*at, frame);
    }
    assert_eq!(decoder.stats().lost, 0);
}

#[test]
fn late_scans_keep_their_order_and_their_stamps() {
    let script = "[[event]]\nscan_delay_s = 0.12\nfor_s = 0.4";
    let mut solo = Solo::new(setup(script)).unwrap();
    let sent = stand(&mut solo, 1_000);
    let scans: Vec<(f64, u16, CarTimeMicros)> = received(&sent, Layout::Fd)
        .into_iter()
        .filter_map(|(at, message)| match message {
            CarMessage::Scan(scan) => {
                Some((at.as_secs_f64(), scan.sequence, scan.time.as_micros()))
            }
            _ => None,
        })
        .collect();
    assert!(scans.windows(2).all(|pair| pair[1].1 == pair[0].1 + 1), "{scans:?}");
    assert!(scans.windows(2).all(|pair| pair[1].2 - pair[0].2 == 50_000));
    let ages: Vec<f64> =
        scans.iter().map(|(at, sequence, _)| at - 0.05 * (f64::from(*sequence) + 1.0)).collect();
    assert!(ages[0] > 0.12 && ages[0] < 0.135, "{ages:?}");
    assert!(ages.last().unwrap() < &0.02, "{ages:?}");
}

type CarTimeMicros = u64;

#[test]
fn button_and_battery_are_in_the_status_and_in_the_truth() {
    let script = "[[event]]\nemergency_stop = true\nbattery_v = 8.5\nfor_s = 0.2";
    let mut solo = Solo::new(setup(script)).unwrap();
    let sent = stand(&mut solo, 400);
    // A status told at the last moment is a millisecond under way.
    for (at, status) in statuses(&sent).into_iter().filter(|(at, _)| *at != self::at(201)) {
        let struck = at.as_secs_f64() < 0.2;
        assert_eq!(status.emergency_stop, struck, "{at}");
        assert!((status.battery_v - if struck { 8.5 } else { 11.1 }).abs() < 0.1);
    }
    let records: Vec<Record> = std::iter::from_fn(|| solo.poll_record()).collect();
    let events: Vec<&Record> =
        records.iter().filter(|r| matches!(r, Record::Event { .. })).collect();
    assert!(matches!(events[0], Record::Event { over: false, .. }));
    assert!(matches!(events[1], Record::Event { over: true, t_s, .. } if *t_s == 0.2));
    let states = states(&records);
    assert_eq!(states.iter().filter(|state| state.emergency_stop).count(), 20);
}

#[test]
fn a_frame_counts_when_it_came_not_when_it_was_read() {
    let mut solo = Solo::new(setup("")).unwrap();
    let mut encoder = crate::wire::can::Encoder::new(Layout::Fd);
    let setpoint = crate::command::ForceSetpoint { drive: false, ..Default::default() };
    // Both are there before the first step; the second one is from later.
    solo.handle_frame(at(1), encoder.encode_setpoint(&setpoint).unwrap());
    solo.handle_frame(at(300), encoder.encode_setpoint(&setpoint).unwrap());
    let sent = stand(&mut solo, 420);
    for (at, status) in statuses(&sent) {
        let age = at.as_secs_f64() - if at.as_secs_f64() < 0.302 { 0.001 } else { 0.3 };
        let told = status.setpoint_age_s;
        assert!((told - age).abs() < 0.006 || told >= 0.25, "{at}: {told} for {age}");
    }
    assert!(statuses(&sent).last().unwrap().1.setpoint_age_s < 0.13);
}

#[test]
fn classic_frames_carry_a_small_lidar() {
    let mut classic = setup("");
    classic.layout = Layout::Classic;
    (classic.lidar.beams, classic.lidar.rate_hz) = (360, 10.0);
    let mut solo = Solo::new(classic).unwrap();
    let sent = stand(&mut solo, 1_080);
    assert_eq!((solo.summary().scans, solo.summary().scans_delivered), (10, 10));
    assert!(sent.iter().all(|(_, frame)| !frame.fd && frame.data().len() == 8));
    // A daemon's decoder would hear nothing of another layout; the car's hears no car.
    let mut decoder = CarDecoder::new(Layout::Classic);
    let heard = sent.iter().filter_map(|(at, frame)| decoder.decode(*at, frame).ok().flatten());
    assert_eq!(heard.collect::<Vec<DaemonMessage>>(), []);
}

#[test]
fn a_bend_goes_on_as_a_circle() {
    let pose = Pose::new(1.0, 2.0, 0.0);
    let straight = along_arc(pose, 0.0, 3.0);
    assert_eq!(straight, Pose::new(4.0, 2.0, 0.0));
    let quarter = along_arc(pose, 0.5, std::f64::consts::PI);
    assert!((quarter.position - Point::new(3.0, 4.0)).norm() < 1e-12, "{quarter:?}");
    assert!((quarter.heading_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    let nearly = along_arc(pose, 1e-9, 3.0);
    assert!((nearly.position - straight.position).norm() < 1e-6);
}

#[test]
fn an_impossible_start_is_refused() {
    let mut wall = setup("");
    wall.start = Pose::new(-100.0, 0.0, 0.0);
    assert!(matches!(Solo::new(wall), Err(PlaceError::OutsideMap { which: "start", .. })));
}
