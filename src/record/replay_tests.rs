//! Simulated drives, written down and replayed.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use super::*;
use crate::autopilot::Command;
use crate::fence::{Fence, circle};
use crate::frames::Point;
use crate::plan::Stopwatch;
use crate::record::{LogWriter, Readings, Scribe, params_text};
use crate::sim::faults::{FaultPlan, FrameFault, Harm};
use crate::sim::maze::{Family, generate};
use crate::sim::rig::{Latency, Rig, RigSetup, grid_of};

type Log = Arc<Mutex<LogWriter<Vec<u8>>>>;

/// What is driven.
struct Drive {
    params: Params,
    latency: Latency,
    stopwatch: Stopwatch,
    faults: FaultPlan,
    seconds: f64,
}

impl Default for Drive {
    fn default() -> Self {
        let mut params = Params::default();
        params.predict.kind = predict::PredictorKind::None;
        params.lidar.beams = 360;
        Self {
            params,
            latency: Latency::Fixed(0.02),
            stopwatch: Box::new(|| Duration::ZERO),
            faults: FaultPlan::default(),
            seconds: 5.0,
        }
    }
}

/// Drives, doing something at every simulated millisecond; gives the log and the digest.
fn record(drive: Drive, mut each: impl FnMut(u64, &mut Rig, &Log)) -> (Vec<u8>, String) {
    let Drive { mut params, latency, stopwatch, faults, seconds } = drive;
    if let Latency::Fixed(seconds) = latency {
        // As the rig has it.
        params.autopilot.plan_budget_s = seconds;
    }
    let maze = generate(Family::Thin, 3, 0.1).unwrap();
    let readings = Readings::default();
    let mut rig = Rig::new(RigSetup {
        faults,
        seed: 7,
        latency,
        time_limit_s: Some(seconds),
        stopwatch: readings.keep(stopwatch),
        ..RigSetup::new(&params, maze.world, maze.start, Some(maze.goal))
    })
    .unwrap();
    rig.keep_snapshot(None);
    let header = Header {
        build: "test".into(),
        source: Source::Sil,
        begun_utc: "20260131T235959Z".into(),
        made: Instant::ZERO,
        start: maze.start,
        goal: Some(maze.goal),
        seed: 7,
        params: params_text(&params),
        network: predict::network_digest(&params.predict),
        part: 1,
    };
    let mut log = LogWriter::new(Vec::new()).unwrap();
    log.put(Instant::ZERO, &Entry::Header(Box::new(header))).unwrap();
    let truth = grid_of(rig.world(), params.map.resolution_m);
    log.put(Instant::ZERO, &Entry::Truth(Box::new(truth))).unwrap();
    let log = Arc::new(Mutex::new(log));
    let theirs = Arc::clone(&log);
    let put = move |at, entry| theirs.lock().unwrap().put(at, &entry).unwrap();
    rig.core_mut().set_witness(Box::new(Scribe::new(readings, put)));
    let mut step = 0;
    rig.drive(|rig| {
        step += 1;
        each(step, rig, &log);
    });
    let digest = rig.summary(1.0).digest;
    drop(rig);
    let log = Arc::into_inner(log).unwrap().into_inner().unwrap();
    (log.close().unwrap(), digest)
}

fn replayed(log: &[u8], set: &[&str]) -> Result<Comparison, ReplayError> {
    let set: Vec<String> = set.iter().map(|text| (*text).to_owned()).collect();
    replay(LogReader::new(log)?, |_| Ok(None), &set, |_, _| {})
}

fn assert_identical(log: &[u8], digest: &str) -> Comparison {
    let comparison = replayed(log, &[]).unwrap();
    assert!(comparison.identical, "{comparison:?}");
    assert_eq!((comparison.frames_differing, comparison.plans_differing), (0, 0));
    assert_eq!(comparison.digest_now, digest, "of every setpoint that the simulator sent");
    assert_eq!(comparison.digest_then, digest);
    assert_eq!((comparison.ended, comparison.parts), (Ended::Closed, 1));
    comparison
}

/// All entries of a log, for making another one of them.
fn entries(log: &[u8]) -> Vec<(Instant, Entry)> {
    let mut log = LogReader::new(log).unwrap();
    std::iter::from_fn(|| log.read().unwrap()).collect()
}

fn written(entries: &[(Instant, Entry)]) -> Vec<u8> {
    let mut log = LogWriter::new(Vec::new()).unwrap();
    entries.iter().for_each(|(at, entry)| log.put(*at, entry).unwrap());
    log.close().unwrap()
}

#[test]
fn a_drive_is_repeated_to_the_last_bit() {
    let (log, digest) = record(Drive::default(), |_, _, _| {});
    let comparison = assert_identical(&log, &digest);
    assert!(comparison.frames > 500 && comparison.plans > 80, "{comparison:?}");
    assert!((4.5..7.0).contains(&comparison.time_s), "{comparison:?}");
    assert_eq!(comparison.setpoints.max_n, 0.0);
    assert!(comparison.setpoints.compared > 400, "{comparison:?}");
}

#[test]
fn a_drive_with_everything_that_can_happen_is_repeated_too() {
    let loss = FrameFault {
        harm: Harm::Loss,
        probability: 0.01,
        receiver: None,
        ids: None,
        from_s: 0.0,
        until_s: f64::INFINITY,
    };
    let drive = Drive {
        faults: FaultPlan { frames: vec![loss], ..FaultPlan::default() },
        seconds: 9.0,
        ..Drive::default()
    };
    let mut params = drive.params.clone();
    let (log, digest) = record(drive, |step, rig, log| {
        let now = rig.now();
        match step {
            2000 => rig.stop_process(0.15),
            2500 => {
                let _ = rig.core_mut().handle_command(now, Command::SpeedLimit(Some(1.0)));
            }
            3000 => {
                let here = rig.car().pose.position;
                let outside = vec![circle(here + crate::frames::Vector::new(0.0, 3.0), 0.5, true)];
                let fence = Fence { inside: vec![], outside };
                rig.core_mut().set_fence(now, Arc::new(fence));
            }
            // While a plan is being made, most likely: it is not for that one.
            3510..3540 => {
                params.speed.speed_max_mps = 2.0 + step as f64 * 1e-4;
                let text = params_text(&params);
                log.lock().unwrap().put(now, &Entry::Params(text)).unwrap();
                rig.set_params(params.core(), &params.planner());
            }
            4000 => rig.hang_planner(true),
            5000 => rig.hang_planner(false),
            5500 => rig.restart_controller(),
            6000 => rig.set_emergency_stop(true),
            6500 => rig.set_emergency_stop(false),
            7000 => {
                let _ = rig.core_mut().handle_command(now, Command::Arm);
                let _ = rig.core_mut().handle_command(now, Command::Goto(Point::new(5.0, 5.0)));
            }
            _ => {}
        }
    });
    assert_identical(&log, &digest);
}

#[test]
fn predictions_given_up_by_the_clock_are_given_up_again() {
    // A clock that now and then stands for 30 ms, by its own count.
    let clock = || {
        let count = AtomicU64::new(0);
        Box::new(move || {
            let looks = count.fetch_add(1, Ordering::Relaxed);
            Duration::from_micros(20 * looks + 30_000 * (looks / 1500))
        })
    };
    let mut drive = Drive { latency: Latency::Measured, stopwatch: clock(), ..Drive::default() };
    drive.params.predict.kind = predict::PredictorKind::Cnp;
    drive.seconds = 3.0;
    let (log, digest) = record(drive, |_, _, _| {});
    let kept =
        |entry: &Entry| matches!(entry, Entry::PlanDone { readings, .. } if !readings.is_empty());
    let timed = entries(&log).iter().filter(|(_, entry)| kept(entry)).count();
    assert!(timed > 0, "no prediction took too long");
    assert_identical(&log, &digest);
    // Without the readings it comes out otherwise: the test can fail.
    let mut without = entries(&log);
    for (_, entry) in &mut without {
        if let Entry::PlanDone { readings, .. } = entry {
            readings.clear();
        }
    }
    assert!(!replayed(&written(&without), &[]).unwrap().identical);
}

#[test]
fn drives_that_know_the_truth_find_it_in_the_log() {
    let mut oracle = Drive { seconds: 2.0, ..Drive::default() };
    oracle.params.predict.kind = predict::PredictorKind::Oracle;
    let mut known = Drive { seconds: 2.0, ..Drive::default() };
    known.params.plan.policy = Policy::KnownMap;
    for drive in [oracle, known] {
        let (log, digest) = record(drive, |_, _, _| {});
        assert_identical(&log, &digest);
        let mut without = entries(&log);
        without.retain(|(_, entry)| !matches!(entry, Entry::Truth(_)));
        match replayed(&written(&without), &[]) {
            Err(ReplayError::Predictor(PredictError::NoTruth { .. })) => {}
            Ok(comparison) => assert!(!comparison.identical),
            Err(error) => panic!("{error}"),
        }
    }
}

#[test]
fn other_parameters_are_found_out_and_measured() {
    let (log, _) = record(Drive { seconds: 3.0, ..Drive::default() }, |_, _, _| {});
    for set in ["speed.speed_max_mps=3", "certify.margin_m=0.08", "vehicle.mass_kg=2.6"] {
        let comparison = replayed(&log, &[set]).unwrap();
        assert!(!comparison.identical, "{set}");
        let first = comparison.first.unwrap();
        assert!(first.t_s >= 0.0 && first.then != first.now, "{set}: {first:?}");
        assert!(comparison.setpoints.max_n > 0.1, "{set}: {:?}", comparison.setpoints);
        assert!(comparison.setpoints.rms_n <= comparison.setpoints.max_n);
    }
    let same = replayed(&log, &["speed.speed_max_mps=4"]).unwrap();
    assert!(same.identical, "as it was anyway");
    let wrong = replayed(&log, &["speed.speed_max_mps=fast"]);
    assert!(matches!(wrong, Err(ReplayError::Set(_))), "{wrong:?}");
}

#[test]
fn a_single_frame_that_is_another_one_is_found() {
    let (log, _) = record(Drive { seconds: 2.0, ..Drive::default() }, |_, _, _| {});
    let whole = entries(&log);
    let sent = |entry: &Entry| matches!(entry, Entry::Sent(_));
    let place = whole.iter().rposition(|(at, e)| sent(e) && at.as_secs_f64() < 1.5).unwrap();
    let (at, Entry::Sent(frame)) = &whole[place] else { unreachable!() };
    let compared = |entries: &[(Instant, Entry)]| replayed(&written(entries), &[]).unwrap();

    let mut flipped = *frame;
    flipped.data_mut()[0] ^= 1;
    let mut changed = whole.clone();
    changed[place].1 = Entry::Sent(flipped);
    let comparison = compared(&changed);
    assert_eq!((comparison.frames_differing, comparison.plans_differing), (1, 0));
    let first = comparison.first.unwrap();
    assert_eq!((first.t_s, first.what), (at.as_secs_f64(), "frame"));
    assert_eq!((first.then, first.now), (format!("{flipped:?}"), format!("{frame:?}")));

    let mut missing = whole.clone();
    missing.remove(place);
    let mut doubled = whole.clone();
    doubled.insert(place, whole[place].clone());
    for entries in [missing, doubled] {
        let comparison = compared(&entries);
        assert!(!comparison.identical && comparison.frames_differing <= 3, "{comparison:?}");
        assert_eq!(comparison.first.unwrap().t_s, at.as_secs_f64());
    }

    let mut plan = whole.clone();
    let (at, digest) = plan
        .iter_mut()
        .rev()
        .find_map(|(at, entry)| match entry {
            Entry::PlanDone { digest, .. } => Some((*at, digest)),
            _ => None,
        })
        .unwrap();
    *digest ^= 1;
    let comparison = compared(&plan);
    assert_eq!((comparison.frames_differing, comparison.plans_differing), (0, 1));
    let first = comparison.first.unwrap();
    assert_eq!((first.t_s, first.what), (at.as_secs_f64(), "plan"));

    // An input that is missing shows in what comes out.
    let mut unheard = whole.clone();
    let received = |entry: &Entry| matches!(entry, Entry::Received(_));
    let place = whole.iter().rposition(|(at, e)| received(e) && at.as_secs_f64() < 1.0).unwrap();
    unheard.drain(place - 20..place);
    assert!(!compared(&unheard).identical);
}

#[test]
fn a_log_that_ends_early_is_compared_up_to_there() {
    let (log, _) = record(Drive { seconds: 2.0, ..Drive::default() }, |_, _, _| {});
    let cut = replayed(&log[..log.len() / 2], &[]).unwrap();
    assert!(cut.identical && cut.frames > 50, "{cut:?}");
    assert_eq!(cut.ended, Ended::CutOff);
    // Anywhere within what was sent at once.
    let whole = entries(&log);
    for length in whole.len() - 60..whole.len() {
        assert!(replayed(&written(&whole[..length]), &[]).unwrap().identical, "{length}");
    }
    let only_header = replayed(&written(&whole[..1]), &[]).unwrap();
    assert_eq!((only_header.identical, only_header.frames), (true, 0));
    assert!(matches!(replayed(&written(&[]), &[]), Err(ReplayError::Empty)));

    let mut gap = whole.clone();
    gap.insert(whole.len() / 2, (whole[whole.len() / 2].0, Entry::Gap { count: 3 }));
    let gap = replayed(&written(&gap), &[]).unwrap();
    assert_eq!((gap.identical, gap.ended), (true, Ended::Gap));
}

#[test]
fn a_log_in_parts_is_one_log() {
    let (log, digest) = record(Drive { seconds: 2.0, ..Drive::default() }, |_, _, _| {});
    let whole = entries(&log);
    let Entry::Header(header) = whole[0].1.clone() else { panic!("it begins with a header") };
    let at = whole.len() / 2;
    let end = (whole[at].0, Entry::Continued);
    let first = written(&[&whole[..at], &[end]].concat());
    let second = |header: Header| {
        written(&[&[(Instant::ZERO, Entry::Header(Box::new(header)))], &whole[at..]].concat())
    };
    let both = |second: Option<&[u8]>| {
        let next = |part| {
            assert_eq!(part, 2);
            second.map(LogReader::new).transpose()
        };
        replay(LogReader::new(&*first).unwrap(), next, &[], |_, _| {}).unwrap()
    };
    let right = second(Header { part: 2, ..*header.clone() });
    let comparison = both(Some(&right));
    assert_eq!((comparison.identical, comparison.parts), (true, 2));
    assert_eq!((comparison.digest_now, comparison.ended), (digest, Ended::Closed));
    assert_eq!(both(None).ended, Ended::CutOff);
    let other = second(Header { part: 2, seed: 1, ..*header });
    assert_eq!(both(Some(&other)).ended, Ended::CutOff, "of another drive");
    assert!(matches!(replayed(&right, &[]), Err(ReplayError::NotTheBeginning { part: 2 })));
}

#[test]
fn another_network_or_other_parameters_are_refused() {
    let (log, _) = record(Drive { seconds: 0.1, ..Drive::default() }, |_, _, _| {});
    let with = |change: &dyn Fn(&mut Header)| {
        let mut entries = entries(&log);
        let Entry::Header(header) = &mut entries[0].1 else { panic!("it begins with a header") };
        change(header);
        replayed(&written(&entries), &[])
    };
    assert!(with(&|_| {}).unwrap().identical);
    let refused = with(&|header| header.network = "ab".into());
    assert!(matches!(refused, Err(ReplayError::Network { .. })), "{refused:?}");
    let refused = with(&|header| header.params = "[speed]\nspeed_min_mps = 1\n".into());
    let error = refused.unwrap_err().to_string();
    assert!(error.contains("speed.speed_min_mps: no such parameter"), "{error}");
}
