//! The links themselves: sockets and serial lines, one task each. What they receive goes into one
//! bounded queue; what does not fit is dropped and counted, and nothing waits.

use std::collections::HashMap;
use std::io;
use std::net::SocketAddr;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};

use nix::fcntl::OFlag;
use nix::sys::termios::{self, BaudRate, SetArg};
use tokio::io::unix::AsyncFd;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::mpsc;

use super::url::LinkUrl;
use crate::ground::{ChannelId, ChannelInfo};
use crate::shell::pace;

/// Frames that wait to be written to a stream.
const OUT_MAX: usize = 256;
/// Remote addresses on one UDP link.
const REMOTES_MAX: usize = 16;
/// Connections on one TCP link.
const CONNECTIONS_MAX: usize = 8;
/// A remote address that has been silent for this long makes room for another.
const SILENT: std::time::Duration = std::time::Duration::from_secs(30);
/// Between two attempts to connect.
const AGAIN: std::time::Duration = std::time::Duration::from_secs(1);
/// No datagram is longer.
const DATAGRAM_MAX: usize = 65_536;

/// Something came by a link.
pub enum Arrival {
    /// A remote end appeared.
    Opened {
        /// Its number.
        id: ChannelId,
        /// What kind of end it is.
        info: ChannelInfo,
        /// Where to write to it.
        sink: Sink,
        /// Whether what comes is cut into datagrams.
        datagrams: bool,
    },
    /// It sent this.
    Bytes(ChannelId, Vec<u8>),
    /// It is gone.
    Closed(ChannelId),
}

/// Where frames to one remote end go. Never blocks.
#[derive(Clone)]
pub enum Sink {
    /// To an address.
    Datagram(Arc<UdpSocket>, SocketAddr),
    /// To a task that writes them.
    Stream(mpsc::Sender<Vec<u8>>),
}

impl Sink {
    /// Sends a frame; says whether it was taken.
    pub fn send(&self, frame: &[u8]) -> bool {
        match self {
            Self::Datagram(socket, to) => socket.try_send_to(frame, *to).is_ok(),
            Self::Stream(queue) => queue.try_send(frame.to_vec()).is_ok(),
        }
    }
}

/// Where arrivals go.
#[derive(Clone)]
pub struct Inlet {
    queue: mpsc::Sender<Arrival>,
    next: Arc<AtomicU32>,
    dropped: Arc<AtomicU64>,
}

impl Inlet {
    /// An inlet into a queue, and the count of what did not fit.
    pub fn new(queue: mpsc::Sender<Arrival>) -> (Self, Arc<AtomicU64>) {
        let dropped = Arc::new(AtomicU64::new(0));
        let next = Arc::new(AtomicU32::new(1));
        (Self { queue, next, dropped: Arc::clone(&dropped) }, dropped)
    }

    async fn open(&self, info: ChannelInfo, sink: Sink, datagrams: bool) -> ChannelId {
        let id = ChannelId(self.next.fetch_add(1, Ordering::Relaxed));
        // Appearing and going must not be lost: these wait for room.
        let _ = self.queue.send(Arrival::Opened { id, info, sink, datagrams }).await;
        id
    }

    async fn close(&self, id: ChannelId) {
        let _ = self.queue.send(Arrival::Closed(id)).await;
    }

    fn bytes(&self, id: ChannelId, bytes: &[u8]) {
        if self.queue.try_send(Arrival::Bytes(id, bytes.to_vec())).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// Why a link could not be opened.
#[derive(Debug, thiserror::Error)]
#[error("cannot open the link {url}: {error}")]
pub struct LinkError {
    url: String,
    error: io::Error,
}

/// Opens a link and starts its task. Servers and serial lines must be there; clients try for ever.
///
/// # Errors
/// If it cannot be opened.
pub async fn open(url: &LinkUrl, inlet: Inlet) -> Result<(), LinkError> {
    let fail = |error| LinkError { url: url.to_string(), error };
    match url {
        LinkUrl::UdpServer { host, port } => {
            let socket = UdpSocket::bind((host.as_str(), *port)).await.map_err(fail)?;
            tokio::spawn(serve_udp(Arc::new(socket), inlet));
        }
        LinkUrl::UdpClient { host, port } => {
            let to = resolve(host, *port).await.map_err(fail)?;
            let any: SocketAddr =
                if to.is_ipv4() { ([0, 0, 0, 0], 0).into() } else { ([0_u16; 8], 0).into() };
            let socket = UdpSocket::bind(any).await.map_err(fail)?;
            tokio::spawn(call_udp(Arc::new(socket), to, inlet));
        }
        LinkUrl::TcpServer { host, port } => {
            let listener = TcpListener::bind((host.as_str(), *port)).await.map_err(fail)?;
            tokio::spawn(serve_tcp(listener, inlet));
        }
        LinkUrl::TcpClient { host, port } => {
            tokio::spawn(call_tcp(host.clone(), *port, inlet));
        }
        LinkUrl::Serial { device, baud } => {
            let line = open_serial(device, *baud).map_err(fail)?;
            tokio::spawn(serve_serial(line, device.clone(), *baud, inlet));
        }
    }
    tracing::info!("MAVLink at {url}");
    Ok(())
}

async fn resolve(host: &str, port: u16) -> io::Result<SocketAddr> {
    let mut found = tokio::net::lookup_host((host, port)).await?;
    found.next().ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "no such host"))
}

const fn info(trusted: bool) -> ChannelInfo {
    ChannelInfo { trusted, bytes_per_s: None }
}

async fn serve_udp(socket: Arc<UdpSocket>, inlet: Inlet) {
    let mut buffer = vec![0; DATAGRAM_MAX];
    let mut remotes: HashMap<SocketAddr, (ChannelId, std::time::Instant)> = HashMap::new();
    loop {
        let (length, from) = match socket.recv_from(&mut buffer).await {
            Ok(received) => received,
            // What one remote end does (an unreachable port) does not concern the others.
            Err(error) => {
                tracing::debug!("UDP: {error}");
                tokio::task::yield_now().await;
                continue;
            }
        };
        let now = pace::now();
        if let Some((id, heard)) = remotes.get_mut(&from) {
            *heard = now;
            inlet.bytes(*id, &buffer[..length]);
            continue;
        }
        if remotes.len() >= REMOTES_MAX {
            let silent = remotes
                .iter()
                .filter(|(_, (_, heard))| now.duration_since(*heard) >= SILENT)
                .min_by_key(|(_, (_, heard))| *heard)
                .map(|(address, (id, _))| (*address, *id));
            // Nobody is pushed out by a newcomer.
            let Some((address, id)) = silent else { continue };
            remotes.remove(&address);
            inlet.close(id).await;
        }
        let sink = Sink::Datagram(Arc::clone(&socket), from);
        let id = inlet.open(info(from.ip().is_loopback()), sink, true).await;
        remotes.insert(from, (id, now));
        inlet.bytes(id, &buffer[..length]);
    }
}

async fn call_udp(socket: Arc<UdpSocket>, to: SocketAddr, inlet: Inlet) {
    let mut buffer = vec![0; DATAGRAM_MAX];
    let sink = Sink::Datagram(Arc::clone(&socket), to);
    let id = inlet.open(info(to.ip().is_loopback()), sink, true).await;
    loop {
        match socket.recv_from(&mut buffer).await {
            Ok((length, from)) if from == to => inlet.bytes(id, &buffer[..length]),
            Ok(_) => {}
            Err(error) => {
                tracing::debug!("UDP {to}: {error}");
                tokio::task::yield_now().await;
            }
        }
    }
}

async fn serve_tcp(listener: TcpListener, inlet: Inlet) {
    let places = Arc::new(tokio::sync::Semaphore::new(CONNECTIONS_MAX));
    loop {
        match listener.accept().await {
            Ok((stream, from)) => {
                // Beyond the limit a connection is closed at once.
                let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
                let inlet = inlet.clone();
                tokio::spawn(async move {
                    talk_tcp(stream, from, &inlet).await;
                    drop(place);
                });
            }
            Err(error) => {
                tracing::warn!("TCP: {error}");
                tokio::time::sleep(AGAIN).await;
            }
        }
    }
}

async fn call_tcp(host: String, port: u16, inlet: Inlet) {
    loop {
        match TcpStream::connect((host.as_str(), port)).await {
            Ok(stream) => {
                if let Ok(to) = stream.peer_addr() {
                    tracing::info!("connected to {host}:{port}");
                    talk_tcp(stream, to, &inlet).await;
                    tracing::info!("the connection to {host}:{port} has ended");
                }
            }
            Err(error) => tracing::debug!("TCP {host}:{port}: {error}"),
        }
        tokio::time::sleep(AGAIN).await;
    }
}

async fn talk_tcp(stream: TcpStream, remote: SocketAddr, inlet: &Inlet) {
    // Small frames shall not wait for each other.
    let _ = stream.set_nodelay(true);
    let (mut reader, mut writer) = stream.into_split();
    let (queue, mut frames) = mpsc::channel::<Vec<u8>>(OUT_MAX);
    let id = inlet.open(info(remote.ip().is_loopback()), Sink::Stream(queue), false).await;
    let mut buffer = [0; 4096];
    loop {
        tokio::select! {
            read = reader.read(&mut buffer) => match read {
                Ok(0) | Err(_) => break,
                Ok(length) => inlet.bytes(id, &buffer[..length]),
            },
            frame = frames.recv() => {
                let Some(frame) = frame else { break };
                // A remote end that takes nothing for so long is as good as gone.
                let written = tokio::time::timeout(SILENT, writer.write_all(&frame)).await;
                if !matches!(written, Ok(Ok(()))) {
                    break;
                }
            }
        }
    }
    inlet.close(id).await;
}

/// A serial line in raw mode.
fn open_serial(device: &Path, baud: u32) -> io::Result<AsyncFd<std::fs::File>> {
    let rate = baud_rate(baud).ok_or_else(|| {
        let text = format!("{baud} baud is none of the usual rates");
        io::Error::new(io::ErrorKind::InvalidInput, text)
    })?;
    let line = std::fs::OpenOptions::new()
        .read(true)
        .write(true)
        .custom_flags((OFlag::O_NOCTTY | OFlag::O_NONBLOCK | OFlag::O_CLOEXEC).bits())
        .open(device)?;
    let mut settings = termios::tcgetattr(&line)?;
    termios::cfmakeraw(&mut settings);
    termios::cfsetspeed(&mut settings, rate)?;
    settings.control_flags |= termios::ControlFlags::CLOCAL | termios::ControlFlags::CREAD;
    termios::tcsetattr(&line, SetArg::TCSANOW, &settings)?;
    watched(line)
}

#[expect(
    deprecated,
    reason = "a file that owns its descriptor meets what the unsafe successor asks for"
)]
fn watched(line: std::fs::File) -> io::Result<AsyncFd<std::fs::File>> {
    AsyncFd::new(line)
}

const fn baud_rate(baud: u32) -> Option<BaudRate> {
    Some(match baud {
        9_600 => BaudRate::B9600,
        19_200 => BaudRate::B19200,
        38_400 => BaudRate::B38400,
        57_600 => BaudRate::B57600,
        115_200 => BaudRate::B115200,
        230_400 => BaudRate::B230400,
        460_800 => BaudRate::B460800,
        500_000 => BaudRate::B500000,
        921_600 => BaudRate::B921600,
        1_000_000 => BaudRate::B1000000,
        1_500_000 => BaudRate::B1500000,
        2_000_000 => BaudRate::B2000000,
        _ => return None,
    })
}

/// Serves a line for as long as the program runs; one that was unplugged is opened again.
async fn serve_serial(
    first: AsyncFd<std::fs::File>,
    device: std::path::PathBuf,
    baud: u32,
    inlet: Inlet,
) {
    let mut line = Some(first);
    loop {
        if let Some(line) = line.take() {
            let error = talk_serial(&line, baud, &inlet).await;
            tracing::warn!("{}: {error}", device.display());
        }
        tokio::time::sleep(AGAIN).await;
        line = open_serial(&device, baud).ok();
    }
}

async fn talk_serial(line: &AsyncFd<std::fs::File>, baud: u32, inlet: &Inlet) -> io::Error {
    let (queue, mut frames) = mpsc::channel::<Vec<u8>>(OUT_MAX);
    // Start and stop bit make ten of eight.
    let info = ChannelInfo { trusted: true, bytes_per_s: Some(f64::from(baud) / 10.0) };
    let id = inlet.open(info, Sink::Stream(queue), false).await;
    let mut buffer = [0; 4096];
    let error = loop {
        tokio::select! {
            read = read_serial(line, &mut buffer) => match read {
                Ok(0) => break io::ErrorKind::UnexpectedEof.into(),
                Ok(length) => inlet.bytes(id, &buffer[..length]),
                Err(error) => break error,
            },
            frame = frames.recv() => {
                let Some(frame) = frame else { break io::ErrorKind::BrokenPipe.into() };
                if let Err(error) = write_serial(line, &frame).await {
                    break error;
                }
            }
        }
    };
    inlet.close(id).await;
    error
}

async fn read_serial(line: &AsyncFd<std::fs::File>, buffer: &mut [u8]) -> io::Result<usize> {
    loop {
        let mut ready = line.readable().await?;
        if let Ok(read) = ready.try_io(|line| io::Read::read(&mut line.get_ref(), buffer)) {
            return read;
        }
    }
}

async fn write_serial(line: &AsyncFd<std::fs::File>, mut frame: &[u8]) -> io::Result<()> {
    while !frame.is_empty() {
        let mut ready = line.writable().await?;
        if let Ok(written) = ready.try_io(|line| io::Write::write(&mut line.get_ref(), frame)) {
            frame = &frame[written?..];
        }
    }
    Ok(())
}
