//! Links with a real other end: sockets of this computer and a pseudo-terminal.

use std::io::{Read, Write};
use std::net::{TcpStream, UdpSocket};
use std::os::unix::fs::PermissionsExt;
use std::sync::Mutex;
use std::time::Duration;

use super::*;
use crate::autopilot::{Autopilot, Command, CoreParams};
use crate::ground::{KeySetup, Unsigned};
use crate::params::Params;
use crate::shell::clock::Clock;
use crate::shell::daemon::{CoreSnapshot, Request};
use crate::shell::pace;
use crate::wire::can::Layout;
use crate::wire::mavlink::common::{
    COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavMessage, MavModeFlag, MavResult,
    MavState, MavType,
};
use crate::wire::mavlink::{Body, Header, Parser, Signing, SigningState, encode};

/// A control loop that obeys everything and remembers it.
struct Loop {
    commands: Arc<Mutex<Vec<Command>>>,
    _end: std::sync::mpsc::Sender<()>,
}

fn control_loop() -> (Seam, Loop) {
    let (outer, mut inner) = Seam::new();
    let commands = Arc::new(Mutex::new(Vec::new()));
    let (end, ended) = std::sync::mpsc::channel();
    let heard = Arc::clone(&commands);
    std::thread::spawn(move || {
        let clock = Clock::start();
        let start = Pose::new(0.0, 0.0, 0.0);
        let core = Autopilot::new(CoreParams::default(), Layout::Fd, start, clock.now());
        let params = Arc::new(Params::default());
        // Ends when the other end is dropped.
        while ended.recv_timeout(Duration::from_millis(5))
            == Err(std::sync::mpsc::RecvTimeoutError::Timeout)
        {
            let snapshot = CoreSnapshot::of(&core, &params, clock.now());
            inner.snapshots.send_replace(Some(Arc::new(snapshot)));
            while let Ok(request) = inner.requests.try_recv() {
                if let Request::Command { command, reply } = request {
                    heard.lock().unwrap().push(command);
                    let _ = reply.send(Ok(()));
                }
            }
        }
    });
    (outer, Loop { commands, _end: end })
}

fn start(params: &MavlinkParams, url: &LinkUrl) -> (Mavlink, Loop) {
    let (seam, control) = control_loop();
    let joined = Joined {
        seam,
        start: Pose::new(0.0, 0.0, 0.0),
        services: Vec::new(),
        ender: Box::new(|_| Err("not here".into())),
    };
    (Mavlink::start(params, std::slice::from_ref(url), None, joined).unwrap(), control)
}

/// A port that nobody uses just now.
fn free_port() -> u16 {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A ground station on a stream or a socket.
struct Station<S: FnMut(&[u8]), R: FnMut(&mut [u8]) -> usize> {
    send: S,
    receive: R,
    parser: Parser,
    sequence: u8,
    signing: Option<Signing>,
    heard: Vec<(Body, bool)>,
}

impl<S: FnMut(&[u8]), R: FnMut(&mut [u8]) -> usize> Station<S, R> {
    fn new(send: S, receive: R) -> Self {
        let parser = Parser::new();
        Self { send, receive, parser, sequence: 0, signing: None, heard: Vec::new() }
    }

    fn frame(&mut self, message: MavMessage) -> Vec<u8> {
        self.sequence = self.sequence.wrapping_add(1);
        let header = Header { system: 255, component: 190, sequence: self.sequence };
        let (_, wall) = Clock::start().both();
        let stamp = (wall.as_micros() as u64 - 1_420_070_400_000_000) / 10;
        let signing = self.signing.as_mut().map(|signing| (signing, 0, stamp));
        encode(header, &message.into(), signing)
    }

    fn say(&mut self, message: MavMessage) {
        let frame = self.frame(message);
        (self.send)(&frame);
    }

    /// Listens until something wanted comes, but not for ever.
    fn await_message(&mut self, wanted: impl Fn(&MavMessage) -> bool) -> Option<MavMessage> {
        let begin = pace::now();
        let mut buffer = vec![0; 65_536];
        while begin.elapsed() < Duration::from_secs(3) {
            let length = (self.receive)(&mut buffer);
            let heard = &mut self.heard;
            self.parser.push(&buffer[..length], |frame| {
                heard.push((frame.body(), frame.signature.is_some()));
            });
            for (body, _) in self.heard.drain(..) {
                if let Body::Message(message) = body
                    && wanted(&message)
                {
                    return Some(*message);
                }
            }
        }
        None
    }

    /// Makes itself known and waits until the vehicle is alive.
    fn greet(&mut self) {
        self.say(heartbeat());
        let beat = self.await_message(|m| matches!(m, MavMessage::HEARTBEAT(_)));
        assert!(beat.is_some(), "no heartbeat");
    }

    fn command(&mut self, command: MavCmd, param1: f32) -> Option<MavResult> {
        self.say(command_long(command, param1));
        let ack = self.await_message(
            |message| matches!(message, MavMessage::COMMAND_ACK(ack) if ack.command == command),
        );
        ack.map(|ack| match ack {
            MavMessage::COMMAND_ACK(ack) => ack.result,
            _ => unreachable!(),
        })
    }
}

fn command_long(command: MavCmd, param1: f32) -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        param1,
        command,
        target_system: 1,
        target_component: 1,
        ..Default::default()
    })
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype: MavType::MAV_TYPE_GCS,
        autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
        base_mode: MavModeFlag::empty(),
        system_status: MavState::MAV_STATE_ACTIVE,
        mavlink_version: 3,
    })
}

fn udp_station(port: u16) -> Station<impl FnMut(&[u8]), impl FnMut(&mut [u8]) -> usize> {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.connect(("127.0.0.1", port)).unwrap();
    socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let other = socket.try_clone().unwrap();
    Station::new(
        move |bytes| drop(socket.send(bytes)),
        move |buffer| other.recv(buffer).unwrap_or(0),
    )
}

const ARM: MavCmd = MavCmd::MAV_CMD_COMPONENT_ARM_DISARM;

#[test]
fn stations_on_one_port_each_hear_the_vehicle_and_bad_datagrams_stop_nobody() {
    let port = free_port();
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let (_mavlink, control) = start(&MavlinkParams::default(), &url);
    let mut stations = [udp_station(port), udp_station(port)];
    for station in &mut stations {
        for junk in [&b""[..], b"\xFD", &[0xFD; 300], &[0; 2000], b"\xFE\x09\0\0\0\0"] {
            (station.send)(junk);
        }
        station.greet();
    }
    let [first, second] = &mut stations;
    assert_eq!(first.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    assert_eq!(second.command(ARM, 0.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    let commands = control.commands.lock().unwrap().clone();
    assert_eq!(commands, [Command::Arm, Command::Disarm]);
}

#[test]
fn a_station_connects_by_tcp_and_may_come_again() {
    let port = free_port();
    let url = LinkUrl::TcpServer { host: "127.0.0.1".into(), port };
    let (_mavlink, _control) = start(&MavlinkParams::default(), &url);
    for _ in 0..2 {
        let stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let (mut writer, mut reader) = (stream.try_clone().unwrap(), stream);
        let mut station = Station::new(
            move |bytes| writer.write_all(bytes).unwrap(),
            move |buffer| reader.read(buffer).unwrap_or(0),
        );
        station.greet();
        assert_eq!(station.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    }
}

#[test]
fn the_vehicle_calls_a_station() {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    let url = LinkUrl::TcpClient { host: "127.0.0.1".into(), port };
    let (_mavlink, _control) = start(&MavlinkParams::default(), &url);
    let (stream, _) = listener.accept().unwrap();
    stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let mut reader = stream;
    let mut station = Station::new(|_| {}, move |buffer| reader.read(buffer).unwrap_or(0));
    assert!(station.await_message(|m| matches!(m, MavMessage::HEARTBEAT(_))).is_some());

    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
    let port = socket.local_addr().unwrap().port();
    let url = LinkUrl::UdpClient { host: "127.0.0.1".into(), port };
    let (_other, _loop) = start(&MavlinkParams::default(), &url);
    let mut station = Station::new(|_| {}, move |buffer| socket.recv(buffer).unwrap_or(0));
    assert!(station.await_message(|m| matches!(m, MavMessage::HEARTBEAT(_))).is_some());
}

#[test]
fn a_serial_line_carries_the_same() {
    let ends = nix::pty::openpty(None, None).unwrap();
    let fd = std::os::fd::AsRawFd::as_raw_fd(&ends.slave);
    let device = std::fs::read_link(format!("/proc/self/fd/{fd}")).unwrap();
    let url = LinkUrl::Serial { device, baud: 57_600 };
    let (_mavlink, _control) = start(&MavlinkParams::default(), &url);
    let master = std::fs::File::from(ends.master);
    let (mut writer, mut reader) = (master.try_clone().unwrap(), master);
    let mut station = Station::new(
        move |bytes| writer.write_all(bytes).unwrap(),
        move |buffer| reader.read(buffer).unwrap_or(0),
    );
    station.greet();
    assert_eq!(station.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
}

#[test]
fn a_link_that_cannot_be_opened_is_named() {
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let (seam, _control) = control_loop();
    let joined = Joined {
        seam,
        start: Pose::new(0.0, 0.0, 0.0),
        services: Vec::new(),
        ender: Box::new(|_| Ok(())),
    };
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let error = Mavlink::start(&MavlinkParams::default(), std::slice::from_ref(&url), None, joined);
    let said = error.err().unwrap().to_string();
    assert!(said.contains(&url.to_string()), "{said}");
}

/// Parameters with a key, and the folder that holds it.
fn keyed(key: &[u8; 32]) -> (MavlinkParams, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key");
    keys::write_key(&path, key).unwrap();
    let signing_key_file = path.display().to_string();
    (MavlinkParams { signing_key_file, ..MavlinkParams::default() }, folder)
}

#[test]
fn only_who_has_the_key_moves_anything_and_only_once() {
    let key = [3; 32];
    let (params, folder) = keyed(&key);
    let port = free_port();
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let replayed;
    {
        let (_mavlink, control) = start(&params, &url);
        let mut stranger = udp_station(port);
        stranger.greet();
        stranger.say(command_long(ARM, 1.0));
        let mut thief = udp_station(port);
        thief.signing = Some(Signing::new([4; 32], &SigningState::default()));
        thief.say(command_long(ARM, 1.0));
        let mut friend = udp_station(port);
        friend.signing = Some(Signing::new(key, &SigningState::default()));
        let frame = friend.frame(command_long(ARM, 1.0));
        for _ in 0..3 {
            (friend.send)(&frame);
        }
        replayed = frame;
        let acks = |m: &MavMessage| matches!(m, MavMessage::COMMAND_ACK(_));
        assert!(friend.await_message(acks).is_some());
        // Once answered, everything before has been handled.
        assert_eq!(friend.command(ARM, 0.0), Some(MavResult::MAV_RESULT_ACCEPTED));
        let commands = control.commands.lock().unwrap().clone();
        assert_eq!(commands, [Command::Arm, Command::Disarm]);
    }
    // What was recorded is of no use after a restart either.
    let (_mavlink, control) = start(&params, &url);
    let mut friend = udp_station(port);
    (friend.send)(&replayed);
    friend.signing = Some(Signing::new(key, &SigningState::default()));
    friend.greet();
    assert_eq!(friend.command(ARM, 0.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    assert_eq!(*control.commands.lock().unwrap(), [Command::Disarm]);
    let stamps = folder.path().join("key.stamps.json");
    assert_eq!(stamps.metadata().unwrap().permissions().mode() & 0o777, 0o600);
}

#[test]
fn everything_that_is_sent_with_a_key_is_signed() {
    let key = [3; 32];
    let (params, _folder) = keyed(&key);
    let params = MavlinkParams { unsigned: Unsigned::Accept, ..params };
    let port = free_port();
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let (_mavlink, _control) = start(&params, &url);
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
    let mut station = udp_station(port);
    socket.send_to(&station.frame(heartbeat()), ("127.0.0.1", port)).unwrap();
    let mut verifier = Signing::new(key, &SigningState::default());
    let mut buffer = [0; 2048];
    let mut count = 0;
    while count < 20 {
        let length = socket.recv(&mut buffer).unwrap();
        Parser::new().push(&buffer[..length], |frame| {
            assert_eq!(verifier.check(&frame, 0), Ok(()));
            count += 1;
        });
    }
}

#[test]
fn a_key_is_set_from_this_computer_if_that_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key");
    let params = MavlinkParams {
        signing_key_file: path.display().to_string(),
        key_setup: KeySetup::Trusted,
        ..MavlinkParams::default()
    };
    let port = free_port();
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let (_mavlink, _control) = start(&params, &url);
    let mut station = udp_station(port);
    station.greet();
    assert_eq!(station.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    let setup = crate::wire::mavlink::common::SETUP_SIGNING_DATA {
        initial_timestamp: 0,
        target_system: 1,
        target_component: 1,
        secret_key: [5; 32],
    };
    station.say(MavMessage::SETUP_SIGNING(setup));
    // From now on the other hand is not heard any more.
    let mut refused = None;
    for _ in 0..20 {
        refused = station.command(ARM, 1.0);
        if refused.is_none() {
            break;
        }
    }
    assert_eq!(refused, None);
    assert_eq!(keys::read_key(&path).unwrap(), [5; 32]);
    station.signing = Some(Signing::new([5; 32], &SigningState::default()));
    assert_eq!(station.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
}

#[test]
fn a_flood_is_throttled_and_the_next_command_is_answered() {
    let port = free_port();
    let url = LinkUrl::UdpServer { host: "127.0.0.1".into(), port };
    let (mavlink, control) = start(&MavlinkParams::default(), &url);
    let mut station = udp_station(port);
    station.greet();
    assert_eq!(station.command(ARM, 1.0), Some(MavResult::MAV_RESULT_ACCEPTED));
    let begin = pace::now();
    for i in 0..20_000 {
        // Each of them is a command of its own.
        let frame = station.frame(command_long(ARM, if i % 2 == 0 { 1.0 } else { 0.0 }));
        (station.send)(&frame);
    }
    let took_s = begin.elapsed().as_secs_f64();
    // What the full socket lost is said again, as every client does.
    let mut other = udp_station(port);
    let answer = (0..3).find_map(|_| other.command(ARM, 1.0));
    assert_eq!(answer, Some(MavResult::MAV_RESULT_ACCEPTED));
    let obeyed = control.commands.lock().unwrap().len() as f64;
    let allowed = 2.0 * 500.0 + 1000.0 * (took_s + 10.0);
    assert!(obeyed < allowed, "{obeyed} commands obeyed in {took_s} s");
    let frames = mavlink.counts.frames.load(Ordering::Relaxed) as f64;
    assert!(frames < allowed, "{frames} frames handled in {took_s} s");
}
