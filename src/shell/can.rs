//! The link to the car: a raw SocketCAN socket that sends one side's frames and receives the other's.
//!
//! The kernel filters by identifier, so foreign traffic costs nothing here; it stamps every frame on
//! arrival, so a process that was held up still knows when the frame came; and it counts what it had
//! to drop. Nothing blocks: a frame that does not fit the queue now is refused.

mod fault;
mod raw;
mod stamps;

use std::collections::VecDeque;
use std::io::IoSliceMut;
use std::os::fd::AsRawFd;
use std::sync::{Mutex, MutexGuard};

use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, ControlMessageOwned, MsgFlags, SockFlag, SockProtocol, SockType, recvmsg, send,
    setsockopt, socket, sockopt,
};
use nix::sys::time::TimeSpec;
use socketcan::socket::{CAN_RAW_FD_FRAMES, SOL_CAN_RAW};
use socketcan::{CanAddr, CanFdSocket, Socket, SocketOptions};
use tokio::io::Interest;
use tokio::io::unix::AsyncFd;

pub use crate::autopilot::BusState;
pub use fault::{BusFault, ErrorClass, ErrorClasses};
use raw::Raw;
use stamps::Stamps;

use super::clock::Clock;
use super::watch::{Descriptor, watched};
use crate::time::{Duration, Instant};
use crate::wire::can::{CanFrame, Layout, Sender, messages};

/// Frames taken from the kernel at a time: the clocks are read once for all of them.
const BATCH: usize = 64;
/// Memory asked for frames that wait to be read: half a second of scans at 40 Hz in classic frames.
/// Without privilege the kernel gives less (`net.core.rmem_max`).
const RECEIVE_BUFFER_BYTES: usize = 4 << 20;

/// What has come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// A frame of the other side.
    Frame {
        /// When it arrived in the kernel, on the process's clock.
        at: Instant,
        /// The frame.
        frame: CanFrame,
    },
    /// An error on the bus.
    Fault(BusFault),
}

/// What a link has carried so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LinkStatistics {
    /// Data frames received.
    pub received: u64,
    /// Frames that the kernel took for sending.
    pub sent: u64,
    /// Frames that it refused.
    pub unsent: u64,
    /// Frames that the kernel dropped because they were not read in time.
    pub dropped: u64,
    /// Error reports.
    pub error_frames: u64,
    /// Error reports of each class, in the order of [`ErrorClass::ALL`]; one report may be of
    /// several.
    pub errors: [u64; ErrorClass::ALL.len()],
    /// The controller's state, as far as its reports tell.
    pub state: BusState,
    /// Its newest error counters of sending and receiving.
    pub counters: Option<[u8; 2]>,
}

/// Why a link cannot be opened or has come to its end.
#[derive(Debug, thiserror::Error)]
pub enum CanLinkError {
    /// The kernel does not know CAN, or this process may not ask for it.
    #[error(
        "this kernel has no CAN sockets: load them with `modprobe can_raw` (a service also needs RestrictAddressFamilies=AF_CAN)"
    )]
    NoCan,
    /// No interface of that name.
    #[error(
        "there is no network interface {interface:?}: `ip -brief link` lists those that exist, `ip link add dev NAME type vcan` makes a virtual one"
    )]
    NoSuchInterface {
        /// The name.
        interface: String,
    },
    /// The interface is of another kind.
    #[error(
        "network interface {interface:?} is no CAN interface: `ip -details link show type can` and `type vcan` list those"
    )]
    NotCan {
        /// The name.
        interface: String,
    },
    /// The interface is down.
    #[error(
        "CAN interface {interface:?} is down: `ip link set {interface} up` (a real bus needs its bit rate first: `ip link set {interface} type can bitrate 1000000 dbitrate 5000000 fd on`)"
    )]
    Down {
        /// The name.
        interface: String,
    },
    /// The interface carries classic frames only.
    #[error(
        "CAN interface {interface:?} carries frames of up to {mtu} bytes, CAN FD needs 72: `ip link set {interface} down; ip link set {interface} mtu 72; ip link set {interface} up` for a virtual one, `type can fd on` for a real one, or choose can.layout = \"classic\""
    )]
    NoFd {
        /// The name.
        interface: String,
        /// Its largest frame, bytes.
        mtu: u32,
    },
    /// The process may not use CAN.
    #[error(
        "CAN sockets are forbidden to this process ({0}): its system-call filter or security module must allow them"
    )]
    Forbidden(#[source] Errno),
    /// The interface was removed while in use.
    #[error("CAN interface {interface:?} has disappeared")]
    Gone {
        /// The name.
        interface: String,
    },
    /// Something else that the kernel refused.
    #[error("CAN interface {interface:?}: cannot {what}: {source}")]
    System {
        /// The name.
        interface: String,
        /// What was asked for.
        what: &'static str,
        /// The kernel's answer.
        source: std::io::Error,
    },
}

/// Why a frame was not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendFault {
    /// The queue of the interface is full.
    #[error("the send queue is full")]
    Full,
    /// The interface is down or gone.
    #[error("the interface is down")]
    Down,
    /// The interface carries no frames of that length.
    #[error("the interface carries no CAN FD frames")]
    TooLong,
    /// Something else that the kernel refused.
    #[error("the kernel refused the frame: {0}")]
    Other(Errno),
}

/// An open link. May be shared: one task receives, another sends.
#[derive(Debug)]
pub struct CanLink {
    interface: String,
    socket: AsyncFd<Descriptor<CanFdSocket>>,
    clock: Clock,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    stamps: Stamps,
    /// Frames read and not yet asked for.
    ready: VecDeque<Received>,
    /// Frames read whose stamps are not yet understood: the clocks are read after the last.
    batch: Vec<(Option<Duration>, Raw)>,
    /// Where the kernel writes stamps and counts.
    control: Vec<u8>,
    dropped: Option<u32>,
    statistics: LinkStatistics,
}

impl CanLink {
    /// Opens a link on which this process is `side`: it receives the other side's frames of that
    /// layout, nothing else. Needs a tokio runtime.
    ///
    /// # Errors
    /// If the interface is not there, not up or not able to carry the layout's frames.
    pub fn open(
        interface: &str,
        layout: Layout,
        side: Sender,
        clock: &Clock,
    ) -> Result<Self, CanLinkError> {
        let name = || interface.to_owned();
        let system = |what| move |source| CanLinkError::System { interface: name(), what, source };
        probe(interface)?;
        let address = CanAddr::from_iface(interface)
            .map_err(|_| CanLinkError::NoSuchInterface { interface: name() })?;
        let socket = CanFdSocket::open_addr(&address).map_err(|error| {
            if error.raw_os_error() == Some(Errno::ENODEV as i32) {
                CanLinkError::NotCan { interface: name() }
            } else {
                system("open a socket")(error)
            }
        })?;
        // A socket bound to an interface that is down has been told so.
        let pending = socket.as_raw_socket().take_error().map_err(system("ask for its state"))?;
        match pending.as_ref().and_then(std::io::Error::raw_os_error).map(Errno::from_raw) {
            None => {}
            Some(Errno::ENETDOWN) => return Err(CanLinkError::Down { interface: name() }),
            Some(errno) => return Err(system("bind")(errno.into())),
        }
        if layout == Layout::Fd
            && let Some(mtu) = mtu(interface).filter(|mtu| *mtu < raw::FD_BYTES as u32)
        {
            return Err(CanLinkError::NoFd { interface: name(), mtu });
        }
        let fd_frames = i32::from(layout == Layout::Fd);
        socket
            .set_socket_option_int(SOL_CAN_RAW, CAN_RAW_FD_FRAMES, fd_frames)
            .map_err(system("choose CAN FD"))?;
        socket.set_filters(&filters(layout, side)).map_err(system("set filters"))?;
        socket.set_error_filter_accept_all().map_err(system("ask for error frames"))?;
        socket.set_recv_timestamp(true).map_err(system("ask for time stamps"))?;
        setsockopt(&socket, sockopt::RxqOvfl, &1)
            .map_err(|errno| system("ask for the count of dropped frames")(errno.into()))?;
        if setsockopt(&socket, sockopt::RcvBufForce, &RECEIVE_BUFFER_BYTES).is_err() {
            // Without privilege as much as everybody may have.
            socket
                .as_raw_socket()
                .set_recv_buffer_size(RECEIVE_BUFFER_BYTES)
                .map_err(system("make room for frames"))?;
        }
        socket.set_nonblocking(true).map_err(system("make its socket non-blocking"))?;
        let socket = watched(socket, WATCHED).map_err(system("watch its socket"))?;
        let control = nix::cmsg_space!(TimeSpec, u32);
        let link = Self {
            interface: name(),
            socket,
            clock: *clock,
            inner: Mutex::new(Inner { control, ..Inner::default() }),
        };
        // What came between binding and filtering is nobody's.
        let mut inner = link.inner();
        while inner.read(&link.socket).is_ok() {
            inner.batch.clear();
        }
        inner.statistics = LinkStatistics::default();
        drop(inner);
        Ok(link)
    }

    /// The interface's name.
    pub fn interface(&self) -> &str {
        &self.interface
    }

    /// Waits for the next frame or error. Dropping the wait loses nothing.
    ///
    /// # Errors
    /// If the interface has disappeared; the link is of no more use then.
    pub async fn receive(&self) -> Result<Received, CanLinkError> {
        loop {
            if let Some(received) = self.try_receive()? {
                return Ok(received);
            }
            let mut ready =
                self.socket.ready(WATCHED).await.map_err(|source| CanLinkError::System {
                    interface: self.interface.clone(),
                    what: "wait for frames",
                    source,
                })?;
            // Cleared before reading: what comes meanwhile wakes again.
            ready.clear_ready();
        }
    }

    /// The next frame or error, if one is there.
    ///
    /// # Errors
    /// As [`receive`](Self::receive).
    pub fn try_receive(&self) -> Result<Option<Received>, CanLinkError> {
        let mut inner = self.inner();
        if inner.ready.is_empty() {
            self.fetch(&mut inner)?;
        }
        Ok(inner.ready.pop_front())
    }

    /// Hands a frame to the kernel; never waits.
    ///
    /// # Errors
    /// If the kernel does not take it now.
    pub fn try_send(&self, frame: &CanFrame) -> Result<(), SendFault> {
        let mut bytes = [0; raw::FD_BYTES];
        let bytes = raw::encode(frame, &mut bytes);
        let result = match send(self.socket.as_raw_fd(), bytes, MsgFlags::MSG_DONTWAIT) {
            Ok(_) => Ok(()),
            Err(Errno::EAGAIN | Errno::ENOBUFS) => Err(SendFault::Full),
            Err(Errno::ENETDOWN | Errno::ENXIO | Errno::ENODEV) => Err(SendFault::Down),
            Err(Errno::EINVAL | Errno::EMSGSIZE) => Err(SendFault::TooLong),
            Err(errno) => Err(SendFault::Other(errno)),
        };
        let statistics = &mut self.inner().statistics;
        match result {
            Ok(()) => statistics.sent += 1,
            Err(_) => statistics.unsent += 1,
        }
        result
    }

    /// What the link has carried so far.
    pub fn statistics(&self) -> LinkStatistics {
        self.inner().statistics
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        // Nobody panics while holding it; and what it holds stays sound if somebody did.
        self.inner.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Takes what the kernel has, up to a batch.
    fn fetch(&self, inner: &mut Inner) -> Result<(), CanLinkError> {
        let mut down = false;
        while inner.batch.len() < BATCH {
            match inner.read(&self.socket) {
                Ok(()) | Err(Errno::EINTR) => {}
                Err(Errno::EAGAIN) => break,
                Err(Errno::ENETDOWN) => down = true,
                Err(Errno::ENODEV) => {
                    return Err(CanLinkError::Gone { interface: self.interface.clone() });
                }
                Err(errno) => {
                    return Err(CanLinkError::System {
                        interface: self.interface.clone(),
                        what: "receive",
                        source: errno.into(),
                    });
                }
            }
        }
        if inner.batch.is_empty() && !down {
            return Ok(());
        }
        let (now, wall) = self.clock.both();
        inner.sort(now, wall);
        if down {
            inner.report(BusFault::interface_down(now));
        }
        Ok(())
    }
}

impl Inner {
    /// Reads one frame into the batch.
    fn read(&mut self, socket: &AsyncFd<Descriptor<CanFdSocket>>) -> Result<(), Errno> {
        let mut bytes = [0; raw::FD_BYTES];
        let mut slices = [IoSliceMut::new(&mut bytes)];
        let flags = MsgFlags::MSG_DONTWAIT;
        let control = Some(&mut self.control[..]);
        let message = recvmsg::<()>(socket.as_raw_fd(), &mut slices, control, flags)?;
        let mut stamp = None;
        for control in message.cmsgs().into_iter().flatten() {
            match control {
                ControlMessageOwned::ScmTimestampns(time) => {
                    let seconds = u64::try_from(time.tv_sec()).unwrap_or(0);
                    let nanos = u32::try_from(time.tv_nsec()).unwrap_or(0);
                    stamp = Some(Duration::new(seconds, nanos.min(999_999_999)));
                }
                ControlMessageOwned::RxqOvfl(total) => {
                    // The kernel's count since the socket was made, wrapping.
                    let new = total.wrapping_sub(self.dropped.unwrap_or(0));
                    self.statistics.dropped += u64::from(new);
                    self.dropped = Some(total);
                }
                _ => {}
            }
        }
        let length = message.bytes;
        self.batch.push((stamp, raw::decode(&bytes[..length], Instant::ZERO)));
        Ok(())
    }

    /// Makes the batch ready, with times on the monotonic clock.
    fn sort(&mut self, now: Instant, wall: Duration) {
        self.stamps.read(now, wall);
        for (stamp, raw) in std::mem::take(&mut self.batch) {
            let at = stamp.map_or(now, |stamp| self.stamps.at(now, stamp));
            match raw {
                Raw::Frame(frame) => {
                    self.statistics.received += 1;
                    // A controller that is off the bus hears nothing.
                    if self.statistics.state == BusState::Off {
                        self.statistics.state = BusState::Active;
                    }
                    self.ready.push_back(Received::Frame { at, frame });
                }
                Raw::Fault(fault) => self.report(BusFault { at, ..fault }),
                Raw::Other => {}
            }
        }
    }

    fn report(&mut self, fault: BusFault) {
        let statistics = &mut self.statistics;
        statistics.error_frames += 1;
        for class in fault.classes.iter() {
            statistics.errors[class as usize] += 1;
        }
        statistics.state = fault.state.unwrap_or(statistics.state);
        statistics.counters = fault.counters.or(statistics.counters);
        self.ready.push_back(Received::Fault(fault));
    }
}

/// Frames and the news that the interface went down.
const WATCHED: Interest = Interest::READABLE.add(Interest::ERROR);

/// Whether this process may have CAN sockets at all.
fn probe(interface: &str) -> Result<(), CanLinkError> {
    let flags = SockFlag::SOCK_CLOEXEC;
    match socket(AddressFamily::Can, SockType::Raw, flags, SockProtocol::CanRaw) {
        Ok(_) => Ok(()),
        Err(Errno::EAFNOSUPPORT | Errno::EPROTONOSUPPORT) => Err(CanLinkError::NoCan),
        Err(errno @ (Errno::EPERM | Errno::EACCES)) => Err(CanLinkError::Forbidden(errno)),
        Err(errno) => Err(CanLinkError::System {
            interface: interface.to_owned(),
            what: "open a socket",
            source: errno.into(),
        }),
    }
}

/// Largest frame of an interface, bytes; `None` where the kernel does not show it.
fn mtu(interface: &str) -> Option<u32> {
    std::fs::read_to_string(format!("/sys/class/net/{interface}/mtu")).ok()?.trim().parse().ok()
}

/// The identifiers of the other side: standard data frames of exactly these.
fn filters(layout: Layout, side: Sender) -> Vec<(u32, u32)> {
    let mask = raw::STANDARD_MASK | raw::EXTENDED | raw::REMOTE;
    messages()
        .iter()
        .filter(|message| message.layout == layout && message.sender != side)
        .map(|message| (u32::from(message.id), mask))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::can::CanId;

    #[test]
    fn filters_name_the_other_sides_identifiers_of_the_layout_and_no_others() {
        let passes = |filters: &[(u32, u32)], id: u32| {
            filters.iter().any(|(want, mask)| id & mask == want & mask)
        };
        for &layout in Layout::ALL {
            for side in [Sender::Car, Sender::Daemon] {
                let filters = filters(layout, side);
                for message in messages() {
                    let ours = message.layout == layout && message.sender != side;
                    let id = u32::from(message.id);
                    assert_eq!(passes(&filters, id), ours, "{} for {side:?}", message.name);
                    assert!(!passes(&filters, id | raw::EXTENDED));
                    assert!(!passes(&filters, id | raw::REMOTE));
                }
            }
        }
    }

    fn frame(id: u16) -> CanFrame {
        CanFrame::new(CanId::standard(id), false, &[1]).unwrap()
    }

    fn fault(state: Option<BusState>) -> Raw {
        let classes = ErrorClasses::default().with(ErrorClass::Controller);
        Raw::Fault(BusFault { at: Instant::ZERO, classes, state, counters: Some([1, 2]) })
    }

    #[test]
    fn a_batch_is_handed_out_in_order_with_the_times_of_the_stamps() {
        let (now, wall) = (Instant::from_nanos(9_000_000_000), Duration::from_secs(1_700_000_000));
        let mut inner = Inner {
            batch: vec![
                (Some(wall - Duration::from_millis(3)), Raw::Frame(frame(1))),
                (Some(wall - Duration::from_millis(2)), fault(Some(BusState::Passive))),
                (None, Raw::Frame(frame(2))),
                (None, Raw::Other),
            ],
            ..Inner::default()
        };
        inner.sort(now, wall);
        let times: Vec<f64> = inner
            .ready
            .iter()
            .map(|received| match received {
                Received::Frame { at, .. } => at.seconds_after(now),
                Received::Fault(fault) => fault.at.seconds_after(now),
            })
            .collect();
        assert_eq!(times, [-0.003, -0.002, 0.0]);
        assert!(inner.batch.is_empty());
        let statistics = inner.statistics;
        assert_eq!((statistics.received, statistics.error_frames), (2, 1));
        assert_eq!(statistics.errors[ErrorClass::Controller as usize], 1);
        assert_eq!(statistics.errors.iter().sum::<u64>(), 1);
        assert_eq!((statistics.state, statistics.counters), (BusState::Passive, Some([1, 2])));
    }

    #[test]
    fn a_frame_ends_bus_off_and_nothing_less() {
        let mut inner = Inner::default();
        let mut state = |raw| {
            inner.batch.push((None, raw));
            inner.sort(Instant::ZERO, Duration::ZERO);
            inner.statistics.state
        };
        assert_eq!(state(fault(Some(BusState::Off))), BusState::Off);
        assert_eq!(state(fault(None)), BusState::Off);
        assert_eq!(state(Raw::Other), BusState::Off);
        assert_eq!(state(Raw::Frame(frame(1))), BusState::Active);
        assert_eq!(state(fault(Some(BusState::Passive))), BusState::Passive);
        assert_eq!(state(Raw::Frame(frame(1))), BusState::Passive);
    }

    #[test]
    fn a_link_that_cannot_be_opened_says_why_and_what_to_do() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        let _inside = runtime.enter();
        let clock = Clock::start();
        let error = CanLink::open("nocan0", Layout::Fd, Sender::Car, &clock).unwrap_err();
        match &error {
            CanLinkError::NoCan => assert!(error.to_string().contains("modprobe can_raw")),
            CanLinkError::NoSuchInterface { interface } => {
                assert_eq!(interface, "nocan0");
                assert!(error.to_string().contains("ip link add"));
            }
            CanLinkError::Forbidden(_) => assert!(error.to_string().contains("must allow")),
            other => panic!("{other}"),
        }
    }
}
