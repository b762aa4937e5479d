//! The control loop against the simulated car.

mod bench;

use std::sync::Arc;

use bench::{Bench, Setup, Trouble, run};
use tokio::sync::oneshot;

use super::control::{Order, Task, Word};
use super::seam::{CommandRefusal, Request};
use crate::autopilot::{Command, Event, Mode, Refusal};
use crate::params::Params;
use crate::tunable::Value;

/// No wall was touched, nothing unseen entered.
fn assert_clean(bench: &Bench) {
    assert_eq!((bench.judge.collisions(), bench.judge.unknown_entries()), (0, 0));
}

#[test]
fn a_goal_given_at_the_start_is_reached_and_the_daemon_ends_there() {
    let mut setup = Setup::default();
    setup.task.until_goal = true;
    let (summary, bench) = run(setup, |_| async {});
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.goal_reached), ("goal", true), "{summary:?}");
    assert_eq!(summary.mode, "disarmed");
    assert!(bench.borrow().speed_mps() < 1e-3);
    assert!(summary.faults.iter().all(|fault| fault.name != "planner late"), "{summary:?}");
    // In virtual time nothing is late, and the plan takes over when it was granted to: at first after
    // 15 ms, soon after a quarter more than the 8 ms that planning takes here, and a millisecond; each
    // time at the next tick.
    assert_eq!((summary.tick_jitter_ms.max, summary.ticks_missed), (0.0, 0));
    let reaction = summary.scan_to_setpoint_ms;
    assert!(reaction.p50 >= 10.9 && reaction.p50 <= 21.1, "{reaction:?}");
    assert!(reaction.max <= 26.0, "{reaction:?}");
    let frames = summary.frames;
    assert!(frames.received > 1000 && frames.sent > 1000, "{frames:?}");
    assert_eq!((frames.lost, frames.refused, frames.unsent), (0, 0, 0));
    let seconds = summary.ticks as f64 / 100.0;
    assert!((seconds - summary.time_s).abs() < 0.1, "{seconds} {}", summary.time_s);
    assert!(summary.age_ms.p50 > 10.0, "{:?}", summary.age_ms);
}

#[test]
fn without_until_goal_it_stays_armed_at_the_goal_until_told_to_end() {
    let (summary, bench) = run(Setup::default(), |hands| async move {
        let mut events = hands.seam.events();
        loop {
            match events.recv().await {
                Ok(Event::GoalReached { .. }) => break,
                Ok(_) => {}
                Err(error) => panic!("{error}"),
            }
        }
        hands.sleep_s(1.0).await;
        let snapshot = hands.seam.snapshots.borrow().clone().unwrap();
        assert_eq!(snapshot.mode, Mode::Standby);
        hands.orders.send(Order::End).await.unwrap();
    });
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.goal_reached), ("goal", true));
}

#[test]
fn a_planner_that_never_comes_back_stops_the_car_and_then_the_daemon_not_the_tick() {
    let mut setup = Setup { trouble: Trouble::Hangs(60), ..Setup::default() };
    setup.params.daemon.planner_limit_s = 3.0;
    let (summary, bench) = run(setup, |hands| async move {
        hands.until("it drives", |bench| bench.speed_mps() > 2.0).await;
        hands.until("it stands", |bench| bench.speed_mps() < 1e-3).await;
        let before = hands.pulse.ticks();
        hands.sleep_s(1.0).await;
        assert_eq!(hands.pulse.ticks() - before, 100);
        let snapshot = hands.seam.snapshots.borrow().clone().unwrap();
        assert!(snapshot.faults.iter().any(|fault| fault.name() == "planner late"));
    });
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.goal_reached), ("planner lost", false));
    let late = summary.faults.iter().find(|fault| fault.name == "planner late").unwrap();
    assert!(late.count == 1 && late.first_s > 1.0, "{late:?}");
}

#[test]
fn a_planning_step_that_is_lost_is_counted_and_the_drive_goes_on() {
    let mut setup = Setup { trouble: Trouble::Lost(30), ..Setup::default() };
    setup.task.until_goal = true;
    let (summary, bench) = run(setup, |_| async {});
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.plans_lost), ("goal", 1));
    assert!(summary.faults.iter().any(|fault| fault.name == "planner late"));
}

#[test]
fn told_to_end_at_speed_it_brings_the_car_to_rest_first() {
    let (summary, bench) = run(Setup::default(), |hands| async move {
        hands.until("it drives", |bench| bench.speed_mps() > 2.5).await;
        hands.orders.send(Order::End).await.unwrap();
        hands.sleep_s(0.05).await;
        let (reply, answer) = oneshot::channel();
        let command = Command::Goto(hands.goal);
        hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
        assert_eq!(answer.await.unwrap(), Err(CommandRefusal::Ending));
        assert!(hands.words.try_iter().any(|word| matches!(word, Word::Stopping)));
    });
    assert_clean(&bench.borrow());
    assert!(bench.borrow().speed_mps() < 1e-3);
    assert_eq!((summary.outcome, summary.mode), ("stopped", "disarmed"));
}

#[test]
fn told_twice_it_ends_at_once() {
    let (summary, bench) = run(Setup::default(), |hands| async move {
        hands.until("it drives", |bench| bench.speed_mps() > 2.5).await;
        hands.orders.send(Order::End).await.unwrap();
        hands.sleep_s(0.05).await;
        hands.orders.send(Order::End).await.unwrap();
    });
    assert_eq!(summary.outcome, "cut off");
    assert!(bench.borrow().speed_mps() > 1.0);
}

#[test]
fn a_new_configuration_takes_effect_as_far_as_it_may() {
    let (summary, bench) = run(Setup::default(), |hands| async move {
        let in_force = |hands: &bench::Hands| -> Arc<Params> {
            Arc::clone(&hands.seam.snapshots.borrow().as_ref().unwrap().params)
        };
        hands.until("it drives", |bench| bench.speed_mps() > 2.5).await;
        let mut wanted = (*in_force(&hands)).clone();
        wanted.speed.speed_max_mps = 1.2;
        wanted.vehicle.friction = 0.8;
        wanted.vehicle.mass_kg = 3.0;
        hands.orders.send(Order::Params(Box::new(wanted.clone()))).await.unwrap();
        hands.sleep_s(1.5).await;
        let now = in_force(&hands);
        let values = (now.speed.speed_max_mps, now.vehicle.friction, now.vehicle.mass_kg);
        assert_eq!(values, (1.2, 0.9, 2.5));
        // It keeps driving, slower.
        let mut fastest = 0.0_f64;
        for _ in 0..2000 {
            hands.sleep_s(1e-3).await;
            fastest = fastest.max(hands.bench.borrow().speed_mps());
        }
        assert!((0.8..1.3).contains(&fastest), "{fastest} m/s");

        // One parameter from outside, with an answer.
        for (key, value, said) in [
            ("speed.speed_max_mps", 2.0, None),
            ("vehicle.friction", 0.7, Some("can take effect only at rest")),
            ("vehicle.mass_kg", 3.0, Some("at the next start")),
            ("speed.speed_max_mps", 99.0, Some("allowed is")),
        ] {
            let (reply, answer) = oneshot::channel();
            let (key, value) = (key.to_owned(), Value::Real(value));
            hands.seam.requests.send(Request::SetParameter { key, value, reply }).await.unwrap();
            match (answer.await.unwrap(), said) {
                (Ok(()), None) => {}
                (Err(refusal), Some(said)) if refusal.to_string().contains(said) => {}
                (answer, said) => panic!("{answer:?} instead of {said:?}"),
            }
        }

        // At rest on the way, what waits for that does take effect; what does not still waits.
        let (reply, answer) = oneshot::channel();
        let command = Command::Pause;
        hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
        answer.await.unwrap().unwrap();
        hands.until("it stands", |bench| bench.speed_mps() < 1e-3).await;
        hands.sleep_s(0.2).await;
        hands.orders.send(Order::Params(Box::new(wanted))).await.unwrap();
        hands.sleep_s(0.2).await;
        let now = in_force(&hands);
        assert_eq!((now.vehicle.friction, now.vehicle.mass_kg), (0.8, 2.5));
        let (reply, answer) = oneshot::channel();
        let command = Command::Continue;
        hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
        answer.await.unwrap().unwrap();
        hands.until("it drives again", |bench| bench.speed_mps() > 0.8).await;
        hands.orders.send(Order::End).await.unwrap();
    });
    assert_clean(&bench.borrow());
    assert_eq!(summary.outcome, "stopped");
}

#[test]
fn after_a_crash_it_stays_disarmed_whatever_the_goal_until_somebody_arms() {
    let mut setup = Setup::default();
    setup.task.after_crash = true;
    let (summary, bench) = run(setup, |hands| async move {
        hands.sleep_s(3.0).await;
        let status = hands.words.try_iter().find_map(|word| match word {
            Word::Status(text) if text.contains("previous run ended unexpectedly") => Some(text),
            _ => None,
        });
        assert!(status.is_some());
        assert!(hands.bench.borrow().speed_mps() < 1e-3);
        let (reply, answer) = oneshot::channel();
        let command = Command::Goto(hands.goal);
        hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
        assert_eq!(answer.await.unwrap(), Err(CommandRefusal::Core(Refusal::NotArmed)));
        for command in [Command::Arm, Command::Goto(hands.goal)] {
            let (reply, answer) = oneshot::channel();
            hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
            answer.await.unwrap().unwrap();
        }
        hands.until("it drives", |bench| bench.speed_mps() > 1.0).await;
        hands.orders.send(Order::End).await.unwrap();
    });
    assert_clean(&bench.borrow());
    assert_eq!(summary.outcome, "stopped");
}

#[test]
fn what_it_waits_for_before_arming_is_said_by_name() {
    let setup = Setup::default();
    let (_, _) = run(setup, |hands| async move {
        hands.bench.borrow_mut().car.set_emergency_stop(true);
        hands.sleep_s(1.6).await;
        let said: Vec<String> = hands
            .words
            .try_iter()
            .filter_map(|word| match word {
                Word::Status(text) => Some(text),
                _ => None,
            })
            .collect();
        assert!(said.iter().any(|text| text.starts_with("waiting to arm: ")), "{said:?}");
        assert!(said.iter().any(|text| text.contains("emergency stop")), "{said:?}");
        hands.bench.borrow_mut().car.set_emergency_stop(false);
        hands.until("it drives", |bench| bench.speed_mps() > 1.0).await;
        hands.orders.send(Order::End).await.unwrap();
    });
}

#[test]
fn an_interface_that_disappears_stops_the_car_and_is_opened_again() {
    let (summary, bench) = run(Setup::default(), |hands| async move {
        hands.until("it drives", |bench| bench.speed_mps() > 2.0).await;
        hands.bench.borrow_mut().gone = true;
        hands.until("it stands", |bench| bench.speed_mps() < 1e-3).await;
        hands.sleep_s(1.0).await;
        hands.bench.borrow_mut().gone = false;
        let before = hands.bench.borrow().car.state().pose;
        hands.sleep_s(2.0).await;
        assert_eq!(hands.bench.borrow().car.state().pose, before, "nobody has armed it");
        hands.orders.send(Order::End).await.unwrap();
    });
    assert_clean(&bench.borrow());
    assert!(summary.faults.iter().any(|fault| fault.name == "odometry late"), "{summary:?}");
    assert!(summary.frames.unsent > 0);
}

#[test]
fn a_send_queue_that_is_full_for_a_moment_loses_nothing() {
    let mut setup = Setup::default();
    setup.task.until_goal = true;
    let (summary, bench) = run(setup, |hands| async move {
        for _ in 0..200 {
            hands.bench.borrow_mut().full = true;
            hands.sleep_s(0.005).await;
            hands.bench.borrow_mut().full = false;
            hands.sleep_s(0.03).await;
        }
    });
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.frames.unsent), ("goal", 0));
    assert!(summary.queues.to_send.max >= 1.0);
}

#[test]
fn when_the_time_is_up_it_ends_with_the_car_at_rest() {
    let task = Task { time_limit_s: Some(2.0), ..Task::default() };
    let setup = Setup { task, ..Setup::default() };
    let (summary, bench) = run(setup, |_| async {});
    assert_clean(&bench.borrow());
    assert_eq!((summary.outcome, summary.goal_reached), ("timeout", false));
    assert!(bench.borrow().speed_mps() < 1e-3);
    assert!((2.0..8.0).contains(&summary.time_s), "{}", summary.time_s);
}

/// Replays what the bench has written down.
fn replayed(log: &std::path::Path) -> crate::record::Comparison {
    use crate::record::{LogReader, replay};
    let open = |path: &std::path::Path| {
        LogReader::new(std::io::BufReader::new(std::fs::File::open(path).unwrap())).unwrap()
    };
    let next = |part| {
        let path = crate::shell::shelved::part_of(log, part);
        Ok(path.exists().then(|| open(&path)))
    };
    replay(open(log), next, &[], |_, _| {}).unwrap()
}

#[test]
fn what_the_daemon_does_is_repeated_from_its_log_whatever_happens_on_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let record = Some(crate::shell::logbook::Place::File(log.clone()));
    let mut setup = Setup { record, ..Setup::default() };
    setup.task.until_goal = true;
    let params = setup.params.clone();
    let (summary, bench) = run(setup, |hands| async move {
        let tell = async |command| {
            let (reply, answer) = oneshot::channel();
            hands.seam.requests.send(Request::Command { command, reply }).await.unwrap();
            answer.await.unwrap()
        };
        hands.until("it drives", |bench| bench.speed_mps() > 2.0).await;
        let (reply, answer) = oneshot::channel();
        let (key, value) = ("speed.speed_max_mps".to_owned(), Value::Real(2.5));
        hands.seam.requests.send(Request::SetParameter { key, value, reply }).await.unwrap();
        answer.await.unwrap().unwrap();
        hands.sleep_s(0.5).await;
        tell(Command::Pause).await.unwrap();
        hands.until("it stands", |bench| bench.speed_mps() < 1e-3).await;
        let (reply, answer) = oneshot::channel();
        let far = crate::frames::Point::new(-50.0, -50.0);
        let outside = vec![crate::fence::circle(far, 1.0, true)];
        let fence = Arc::new(crate::fence::Fence { inside: vec![], outside });
        hands.seam.requests.send(Request::SetFence { fence, reply }).await.unwrap();
        answer.await.unwrap();
        tell(Command::Continue).await.unwrap();
        hands.until("it drives on", |bench| bench.speed_mps() > 1.0).await;
        // The send queue is full for a while, then the interface is gone for a while.
        hands.bench.borrow_mut().full = true;
        hands.sleep_s(0.1).await;
        hands.bench.borrow_mut().full = false;
        hands.until("it drives again", |bench| bench.speed_mps() > 1.0).await;
        hands.bench.borrow_mut().gone = true;
        hands.sleep_s(0.3).await;
        hands.bench.borrow_mut().gone = false;
        hands.orders.send(Order::DiskFull(true)).await.unwrap();
        hands.sleep_s(1.0).await;
        hands.orders.send(Order::DiskFull(false)).await.unwrap();
        let mut changed = params.clone();
        changed.control = crate::control::ControlParams::default();
        changed.speed.speed_max_mps = 2.0;
        hands.orders.send(Order::Params(Box::new(changed))).await.unwrap();
        hands.sleep_s(1.0).await;
        let _ = tell(Command::Arm).await;
        let _ = tell(Command::Goto(hands.goal)).await;
        hands.sleep_s(4.0).await;
        let _ = hands.orders.send(Order::End).await;
    });
    assert_clean(&bench.borrow());
    let comparison = replayed(&log);
    assert!(comparison.identical, "{comparison:?}");
    assert_eq!(comparison.ended, crate::record::Ended::Closed);
    // What the bus did not take was said all the same.
    assert!(comparison.frames >= summary.frames.sent, "{comparison:?} {summary:?}");
    assert_eq!((comparison.plans, summary.record_dropped), (summary.replans, 0));
}

#[test]
fn a_long_run_is_repeated_from_the_parts_of_its_log() {
    let folder = tempfile::tempdir().unwrap();
    let limits = crate::shell::shelved::Limits {
        part_bytes: 300_000,
        kept_bytes: 1_000_000_000,
        kept_files: 1000,
        free_min: 0,
    };
    let place = crate::shell::logbook::Place::Folder(folder.path().to_owned(), limits);
    let mut setup = Setup { record: Some(place), ..Setup::default() };
    setup.task.until_goal = true;
    let (summary, _) = run(setup, |_| async {});
    assert_eq!(summary.record_dropped, 0, "the disk of a test keeps up");
    let comparison = replayed(&folder.path().join("20260131T235959Z.mcap"));
    assert!(comparison.identical && comparison.parts > 2, "{comparison:?}");
    assert_eq!(comparison.plans, summary.replans);
}

#[test]
fn a_run_by_the_clock_with_its_threads_is_repeated_from_its_log() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let record = Some(crate::shell::logbook::Place::File(log.clone()));
    let mut setup = Setup { record, in_real_time: true, ..Setup::default() };
    setup.params.predict.kind = crate::predict::PredictorKind::Cnp;
    // Now and then too little.
    setup.params.predict.time_limit_s = 0.004;
    setup.task.time_limit_s = Some(4.0);
    let (summary, _) = run(setup, |hands| async move {
        // While plans are being made, most likely.
        for i in 0..30 {
            hands.sleep_s(0.08).await;
            let (reply, answer) = oneshot::channel();
            let value = Value::Real(2.0 + 0.01 * f64::from(i));
            let key = "speed.speed_max_mps".to_owned();
            hands.seam.requests.send(Request::SetParameter { key, value, reply }).await.unwrap();
            answer.await.unwrap().unwrap();
        }
    });
    let comparison = replayed(&log);
    assert!(comparison.identical, "{comparison:?}");
    assert_eq!(comparison.plans, summary.replans);
    assert!(comparison.time_s > 3.0, "{comparison:?}");
}
