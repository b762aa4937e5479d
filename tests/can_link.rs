//! The link on a real CAN interface. Not every machine's kernel has one, so these tests are run by
//! name, as root, one after the other:
//!
//! ```text
//! ip link add dev vcan0 type vcan; ip link set vcan0 mtu 72; ip link set vcan0 up
//! cargo test --release --test can_link -- --ignored --test-threads 1
//! ```

#![allow(
    clippy::disallowed_methods,
    clippy::unwrap_used,
    reason = "tests of what depends on the clock"
)]

use std::process::Command;

use apexd::command::ForceSetpoint;
use apexd::shell::can::{BusState, CanLink, CanLinkError, ErrorClass, Received, SendFault};
use apexd::shell::clock::{Alarm, Clock};
use apexd::time::{Duration, Instant};
use apexd::wire::can::{CanFrame, CanId, CarEncoder, CarTime, Encoder, Layout, Sender};
use socketcan::{CanErrorFrame, CanFdSocket, EmbeddedFrame, Frame, Socket, StandardId};

const INTERFACE: &str = "vcan0";

fn ip(arguments: &str) {
    let status = Command::new("ip").args(arguments.split_whitespace()).status().unwrap();
    assert!(status.success(), "ip {arguments}");
}

/// Runs a test on an interface that is up and carries CAN FD.
fn on_the_bus(test: impl AsyncFnOnce(Clock)) {
    ip(&format!("link set {INTERFACE} down"));
    ip(&format!("link set {INTERFACE} mtu 72"));
    ip(&format!("link set {INTERFACE} up"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(test(Clock::start()));
}

fn pair(layout: Layout, clock: &Clock) -> (CanLink, CanLink) {
    let open = |side| CanLink::open(INTERFACE, layout, side, clock).unwrap();
    (open(Sender::Car), open(Sender::Daemon))
}

async fn next(link: &CanLink) -> Received {
    let waited = tokio::time::timeout(Duration::from_secs(5), link.receive()).await;
    waited.expect("something comes within 5 s").unwrap()
}

fn heartbeat(layout: Layout) -> CanFrame {
    CarEncoder::new(layout, 0).encode_heartbeat(CarTime::from_micros(5))
}

#[test]
#[ignore = "needs vcan0 and root"]
fn frames_of_both_layouts_pass_in_both_directions() {
    on_the_bus(async |clock| {
        for &layout in Layout::ALL {
            let (car, daemon) = pair(layout, &clock);
            let setpoint = ForceSetpoint { longitudinal_n: 3.0, ..ForceSetpoint::default() };
            let there = Encoder::new(layout).encode_setpoint(&setpoint).unwrap();
            let back = heartbeat(layout);
            daemon.try_send(&there).unwrap();
            car.try_send(&back).unwrap();
            for (link, frame) in [(&car, there), (&daemon, back)] {
                let Received::Frame { frame: came, .. } = next(link).await else {
                    panic!("an error")
                };
                assert_eq!(came, frame);
                // Nobody hears himself.
                assert_eq!(link.try_receive().unwrap(), None);
                assert_eq!((link.statistics().received, link.statistics().sent), (1, 1));
            }
        }
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn foreign_frames_do_not_get_through_the_kernels_filter() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        let stranger = CanFdSocket::open(INTERFACE).unwrap();
        for id in 0..0x7F0u16 {
            let frame = socketcan::CanFrame::new(StandardId::new(id).unwrap(), &[0; 8]).unwrap();
            stranger.write_frame(&frame).unwrap();
        }
        let remote = socketcan::CanFrame::remote_from_raw_id(0x70, 8).unwrap();
        stranger.write_frame(&remote).unwrap();
        car.try_send(&heartbeat(Layout::Fd)).unwrap();
        let mut came = Vec::new();
        loop {
            let Received::Frame { frame, .. } = next(&daemon).await else { panic!("an error") };
            if frame.fd {
                break;
            }
            came.push(frame.id);
        }
        // Right identifiers in the wrong format are for the decoder to refuse.
        assert_eq!(came, [0x020, 0x050, 0x070, 0x100].map(CanId::standard));
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn a_frame_that_is_read_late_came_when_it_came() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        for wait in [Duration::from_millis(60), Duration::ZERO, Duration::from_millis(20)] {
            let before = clock.now();
            car.try_send(&heartbeat(Layout::Fd)).unwrap();
            let after = clock.now();
            std::thread::sleep(wait);
            let Received::Frame { at, .. } = next(&daemon).await else { panic!("an error") };
            let slack = Duration::from_millis(1);
            assert!(at + slack >= before && at <= after + slack, "{before} {at} {after}");
        }
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn what_the_kernel_drops_is_counted() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        let frame = heartbeat(Layout::Fd);
        for _ in 0..40_000 {
            car.try_send(&frame).unwrap();
        }
        while daemon.try_receive().unwrap().is_some() {}
        // The count comes with the next frame.
        car.try_send(&frame).unwrap();
        next(&daemon).await;
        let statistics = daemon.statistics();
        assert!(statistics.dropped > 0 && statistics.received > 1_000, "{statistics:?}");
        assert_eq!(statistics.dropped + statistics.received, 40_001);
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn error_frames_are_read_and_counted() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        let driver = CanFdSocket::open(INTERFACE).unwrap();
        let say = |id, data: [u8; 8]| {
            let error = CanErrorFrame::new_error(id, &data).unwrap();
            driver.write_frame(&socketcan::CanFrame::from(error)).unwrap();
        };
        say(0x004, [0, 0x20, 0, 0, 0, 0, 0, 0]);
        say(0x040, [0; 8]);
        say(0x208, [0, 0, 0, 0, 0, 0, 17, 4]);
        for (class, state) in [
            (ErrorClass::Controller, Some(BusState::Passive)),
            (ErrorClass::BusOff, Some(BusState::Off)),
            (ErrorClass::Protocol, Some(BusState::Active)),
        ] {
            let Received::Fault(fault) = next(&daemon).await else { panic!("a frame") };
            assert_eq!(
                (fault.classes.iter().collect::<Vec<_>>(), fault.state),
                (vec![class], state)
            );
            assert!(clock.now().since(fault.at) < Duration::from_secs(1));
        }
        let statistics = daemon.statistics();
        assert_eq!((statistics.error_frames, statistics.counters), (3, Some([17, 4])));
        assert_eq!(statistics.errors[ErrorClass::BusOff as usize], 1);
        drop(car);
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn an_interface_that_goes_down_and_comes_back_is_noticed() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        ip(&format!("link set {INTERFACE} down"));
        let Received::Fault(fault) = next(&daemon).await else { panic!("a frame") };
        assert!(fault.classes.contains(ErrorClass::InterfaceDown));
        assert_eq!(daemon.statistics().state, BusState::Off);
        assert_eq!(car.try_send(&heartbeat(Layout::Fd)), Err(SendFault::Down));
        assert_eq!(car.statistics().unsent, 1);
        let error = CanLink::open(INTERFACE, Layout::Fd, Sender::Car, &clock).unwrap_err();
        assert!(matches!(error, CanLinkError::Down { .. }), "{error}");
        ip(&format!("link set {INTERFACE} up"));
        car.try_send(&heartbeat(Layout::Fd)).unwrap();
        assert!(matches!(next(&daemon).await, Received::Frame { .. }));
        assert_eq!(daemon.statistics().state, BusState::Active);
    });
}

#[test]
#[ignore = "needs vcan0 and root"]
fn a_classic_interface_carries_classic_frames_only() {
    on_the_bus(async |clock| {
        ip(&format!("link set {INTERFACE} down"));
        ip(&format!("link set {INTERFACE} mtu 16"));
        ip(&format!("link set {INTERFACE} up"));
        let error = CanLink::open(INTERFACE, Layout::Fd, Sender::Car, &clock).unwrap_err();
        assert!(matches!(error, CanLinkError::NoFd { mtu: 16, .. }), "{error}");
        let (car, daemon) = pair(Layout::Classic, &clock);
        car.try_send(&heartbeat(Layout::Classic)).unwrap();
        assert!(matches!(next(&daemon).await, Received::Frame { .. }));
        assert_eq!(car.try_send(&heartbeat(Layout::Fd)), Err(SendFault::TooLong));
        let lo = CanLink::open("lo", Layout::Classic, Sender::Car, &clock).unwrap_err();
        assert!(matches!(lo, CanLinkError::NotCan { .. }), "{lo}");
    });
}

/// A wait that is given up, as `select!` does, loses no frame.
#[test]
#[ignore = "needs vcan0 and root"]
fn giving_up_a_wait_loses_nothing() {
    on_the_bus(async |clock| {
        let (car, daemon) = pair(Layout::Fd, &clock);
        let alarm = Alarm::new(&clock).unwrap();
        let mut encoder = CarEncoder::new(Layout::Fd, 0);
        let (mut came, mut rung) = (Vec::<Instant>::new(), 0);
        while came.len() < 500 {
            alarm.set(clock.now() + Duration::from_micros(300)).unwrap();
            tokio::select! {
                received = daemon.receive() => match received.unwrap() {
                    Received::Frame { at, .. } => came.push(at),
                    Received::Fault(fault) => panic!("{fault:?}"),
                },
                ringing = alarm.rings() => {
                    ringing.unwrap();
                    rung += 1;
                    if rung <= 250 {
                        let frame = encoder.encode_heartbeat(CarTime::from_micros(rung));
                        car.try_send(&frame).unwrap();
                        car.try_send(&frame).unwrap();
                    }
                    assert!(rung < 10_000, "{} frames came", came.len());
                }
            }
        }
        assert!(came.windows(2).all(|pair| pair[1] >= pair[0]));
    });
}
