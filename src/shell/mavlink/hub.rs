//! The thread that speaks MAVLink: bytes of all links in, through parser and signature check to the
//! vehicle's side; its answers back out; its wishes through the seam to the control loop.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::{mpsc, oneshot};

use super::keys;
use super::link::{Arrival, Sink};
use super::view;
use crate::autopilot::Mode;
use crate::frames::Pose;
use crate::ground::{
    COMPONENT, ChannelId, CoreRequest, Ground, Peer, Refusal, RefusalKind, RequestId, To, Unsigned,
};
use crate::shell::clock::Clock;
use crate::shell::daemon::{ChangeRefusal, Request, Seam};
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::RADIO_STATUS_DATA;
use crate::wire::mavlink::{Body, Header, MessageData, Parser, Signing, encode};

/// Messages of one remote end that are handled in a second; what is more is dropped.
const RATE_PER_S: f64 = 1000.0;
/// So many may come at once.
const BURST: f64 = 500.0;
/// Arrivals that are handled before anything is sent.
const BATCH: usize = 64;
/// Beginning of the time stamps of signatures: 2015-01-01, microseconds after 1970.
const SIGNING_EPOCH_US: u64 = 1_420_070_400_000_000;
/// Between two stores of what was accepted.
const STORE_PERIOD: Duration = Duration::from_secs(15);

/// How the program is to go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Start anew.
    Restart,
    /// Not at all.
    Shutdown,
}

/// Ends the program, or says why not.
pub type Ender = Box<dyn Fn(End) -> Result<(), String> + Send>;

/// Key and the files that go with it.
pub struct KeyKeeper {
    /// Where the key is.
    pub key_file: PathBuf,
    /// Where the time stamps are.
    pub state_file: PathBuf,
    /// The key, once there is one.
    pub signing: Option<Signing>,
}

/// What the links brought and what became of it.
#[derive(Debug, Default)]
pub struct HubCounts {
    /// Frames that were handed on.
    pub frames: AtomicU64,
    /// Frames beyond the rate that is handled.
    pub throttled: AtomicU64,
    /// Frames without a valid signature where one is needed.
    pub refused: AtomicU64,
    /// Frames that a link did not take.
    pub unsent: AtomicU64,
}

struct Remote {
    sink: Sink,
    datagrams: bool,
    parser: Box<Parser>,
    sequence: u8,
    tokens: f64,
    filled: Instant,
}

/// The hub.
pub struct Hub {
    pub ground: Ground,
    pub clock: Clock,
    pub seam: Seam,
    pub start: Pose,
    pub keys: Option<KeyKeeper>,
    pub unsigned: Unsigned,
    pub ender: Ender,
    pub counts: Arc<HubCounts>,
    remotes: BTreeMap<ChannelId, Remote>,
    replies: mpsc::UnboundedSender<(RequestId, Result<(), Refusal>)>,
    answered: mpsc::UnboundedReceiver<(RequestId, Result<(), Refusal>)>,
    next_store: Instant,
    store_failed: bool,
}

impl Hub {
    /// A hub without links.
    pub fn new(
        ground: Ground,
        seam: Seam,
        start: Pose,
        keys: Option<KeyKeeper>,
        unsigned: Unsigned,
        ender: Ender,
    ) -> Self {
        // No more wait than wishes may be under way.
        let (replies, answered) = mpsc::unbounded_channel();
        Self {
            ground,
            clock: Clock::start(),
            seam,
            start,
            keys,
            unsigned,
            ender,
            counts: Arc::new(HubCounts::default()),
            remotes: BTreeMap::new(),
            replies,
            answered,
            next_store: Instant::ZERO,
            store_failed: false,
        }
    }

    /// Runs until it is told to stop.
    pub async fn run(
        mut self,
        mut arrivals: mpsc::Receiver<Arrival>,
        mut stop: oneshot::Receiver<()>,
    ) {
        let mut events = self.seam.events();
        let mut snapshots = self.seam.snapshots.clone();
        let mut control_alive = true;
        self.note_clock();
        self.store(false);
        loop {
            let due = self.clock.deadline(self.ground.poll_at());
            tokio::select! {
                _ = &mut stop => break,
                Some(arrival) = arrivals.recv() => {
                    self.take(arrival);
                    for _ in 1..BATCH {
                        match arrivals.try_recv() {
                            Ok(arrival) => self.take(arrival),
                            Err(_) => break,
                        }
                    }
                }
                Some((id, answer)) = self.answered.recv() => {
                    self.ground.handle_reply(self.clock.now(), id, &answer);
                }
                event = events.recv(), if control_alive => match event {
                    Ok(event) => {
                        if let Some(event) = view::event(&event) {
                            self.ground.handle_event(self.clock.now(), &event);
                        }
                    }
                    Err(tokio::sync::broadcast::error::RecvError::Lagged(missed)) => {
                        tracing::debug!("{missed} events missed");
                    }
                    Err(tokio::sync::broadcast::error::RecvError::Closed) => control_alive = false,
                },
                changed = snapshots.changed(), if control_alive => {
                    control_alive = changed.is_ok();
                    let snapshot = snapshots.borrow_and_update().clone();
                    if let Some(snapshot) = snapshot.filter(|_| control_alive) {
                        self.ground.set_params(&snapshot.params.mavlink);
                        self.ground.handle_params(&snapshot.params);
                        let view = view::view(&snapshot, self.start);
                        self.ground.handle_core(self.clock.now(), view);
                    }
                }
                () = tokio::time::sleep_until(due) => {
                    self.note_clock();
                    self.ground.handle_time(self.clock.now());
                }
            }
            // No signature leaves that is not accounted for.
            self.store(false);
            self.give();
        }
        self.store(true);
    }

    // ---- in

    fn take(&mut self, arrival: Arrival) {
        let now = self.clock.now();
        match arrival {
            Arrival::Opened { id, info, sink, datagrams } => {
                if !self.ground.handle_channel_open(now, id, info) {
                    tracing::warn!("too many links at once: one is not served");
                    return;
                }
                let parser = Box::default();
                let remote =
                    Remote { sink, datagrams, parser, sequence: 0, tokens: BURST, filled: now };
                self.remotes.insert(id, remote);
                self.ground.handle_time(now);
            }
            Arrival::Closed(id) => {
                self.ground.handle_channel_closed(id);
                self.remotes.remove(&id);
            }
            Arrival::Bytes(id, bytes) => self.take_bytes(now, id, &bytes),
        }
    }

    fn take_bytes(&mut self, now: Instant, id: ChannelId, bytes: &[u8]) {
        let Some(remote) = self.remotes.get_mut(&id) else { return };
        let since_s = now.seconds_after(remote.filled);
        remote.filled = now;
        remote.tokens = (remote.tokens + RATE_PER_S * since_s).min(BURST);
        let (ground, counts, unsigned) = (&mut self.ground, &self.counts, self.unsigned);
        let mut signing = self.keys.as_mut().and_then(|keys| keys.signing.as_mut());
        let stamp = signing_now(&self.clock);
        let tokens = &mut remote.tokens;
        let take = |frame: crate::wire::mavlink::Frame<'_>| {
            if *tokens < 1.0 {
                counts.throttled.fetch_add(1, Ordering::Relaxed);
                return;
            }
            *tokens -= 1.0;
            if let Some(signing) = signing.as_deref_mut() {
                let free = frame.signature.is_none()
                    && match unsigned {
                        Unsigned::Refuse => false,
                        Unsigned::Radio => frame.id == RADIO_STATUS_DATA::ID,
                        Unsigned::Accept => true,
                    };
                if !free && let Err(fault) = signing.check(&frame, stamp) {
                    tracing::debug!(system = frame.header.system, "signature: {fault}");
                    counts.refused.fetch_add(1, Ordering::Relaxed);
                    return;
                }
            }
            counts.frames.fetch_add(1, Ordering::Relaxed);
            let Header { system, component, .. } = frame.header;
            ground.handle_body(now, Peer { channel: id, system, component }, &frame.body());
        };
        if remote.datagrams {
            remote.parser.push_datagram(bytes, take);
        } else {
            remote.parser.push(bytes, take);
        }
    }

    fn note_clock(&mut self) {
        let (now, wall) = self.clock.both();
        self.ground.handle_clock(now, wall.as_micros() as u64);
    }

    // ---- out

    fn give(&mut self) {
        while let Some((id, request)) = self.ground.poll_request() {
            if let Some(answer) = self.ask(id, request) {
                self.ground.handle_reply(self.clock.now(), id, &answer);
            }
        }
        while let Some((to, body)) = self.ground.poll_message() {
            match to {
                To::Everyone => {
                    let all: Vec<ChannelId> = self.remotes.keys().copied().collect();
                    for id in all {
                        self.send(id, &body);
                    }
                }
                To::Channel(id) => self.send(id, &body),
            }
        }
    }

    fn send(&mut self, id: ChannelId, body: &Body) {
        let Some(remote) = self.remotes.get_mut(&id) else { return };
        let header = Header {
            system: self.ground.system(),
            component: COMPONENT,
            sequence: remote.sequence,
        };
        let stamp = signing_now(&self.clock);
        let signing = self.keys.as_mut().and_then(|keys| keys.signing.as_mut());
        let frame = encode(header, body, signing.map(|signing| (signing, id.0 as u8, stamp)));
        if remote.sink.send(&frame) {
            remote.sequence = remote.sequence.wrapping_add(1);
        } else {
            self.counts.unsent.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Passes a wish on; an answer that is known at once is returned.
    fn ask(&mut self, id: RequestId, request: CoreRequest) -> Option<Result<(), Refusal>> {
        let request = match request {
            CoreRequest::SetParameter { key, value } => {
                let (reply, answer) = oneshot::channel();
                return self.pass(id, Request::SetParameter { key, value, reply }, async {
                    let refused = |refusal: ChangeRefusal| Refusal::failed(refusal.to_string());
                    answer.await.ok().map(|answer| answer.map_err(refused))
                });
            }
            CoreRequest::SetFence(fence) => {
                let (reply, answer) = oneshot::channel();
                return self.pass(id, Request::SetFence { fence, reply }, async {
                    answer.await.ok().map(Ok)
                });
            }
            other => other,
        };
        let Some(command) = view::command(&request) else {
            return Some(self.do_oneself(request));
        };
        let (reply, answer) = oneshot::channel();
        if self.seam.requests.try_send(Request::Command { command, reply }).is_err() {
            let reason = "the control loop takes no more commands";
            return Some(Err(Refusal::new(RefusalKind::Temporary, reason)));
        }
        let (replies, snapshots) = (self.replies.clone(), self.seam.snapshots.clone());
        tokio::spawn(async move {
            // Who drops the question says nothing; the commander's patience ends by itself.
            if let Ok(answer) = answer.await {
                let driving =
                    snapshots.borrow().as_ref().is_some_and(|core| core.mode == Mode::Drive);
                let _ = replies.send((id, view::answer(command, driving, answer)));
            }
        });
        None
    }

    /// Passes a wish on to the control loop; its answer comes later.
    fn pass(
        &self,
        id: RequestId,
        request: Request,
        answer: impl Future<Output = Option<Result<(), Refusal>>> + Send + 'static,
    ) -> Option<Result<(), Refusal>> {
        if self.seam.requests.try_send(request).is_err() {
            let reason = "the control loop takes no more commands";
            return Some(Err(Refusal::new(RefusalKind::Temporary, reason)));
        }
        let replies = self.replies.clone();
        tokio::spawn(async move {
            if let Some(answer) = answer.await {
                let _ = replies.send((id, answer));
            }
        });
        None
    }

    fn do_oneself(&mut self, request: CoreRequest) -> Result<(), Refusal> {
        let unsupported = |reason: &str| Err(Refusal::new(RefusalKind::Unsupported, reason));
        match request {
            CoreRequest::Restart => (self.ender)(End::Restart).map_err(Refusal::failed),
            CoreRequest::Shutdown => (self.ender)(End::Shutdown).map_err(Refusal::failed),
            CoreRequest::SigningKey(key) => {
                let Some(keys) = &mut self.keys else {
                    return Err(Refusal::failed(
                        "there is no file to keep the key in (mavlink.signing_key_file)",
                    ));
                };
                keys::write_key(&keys.key_file, &key)
                    .map_err(|error| Refusal::failed(format!("the key cannot be kept: {error}")))?;
                let stamps = match &mut keys.signing {
                    Some(signing) => signing.take_state(signing_now(&self.clock)),
                    None => keys::read_state(&keys.state_file).unwrap_or_default(),
                };
                keys.signing = Some(Signing::new(key, &stamps));
                tracing::info!("a new key for signatures was set");
                Ok(())
            }
            CoreRequest::Storage(_) => unsupported("parameters are not stored here"),
            _ => unsupported("nobody does this"),
        }
    }

    /// Keeps what signatures need over a restart.
    fn store(&mut self, at_end: bool) {
        let now = self.clock.now();
        let stamp = signing_now(&self.clock);
        let Some(keys) = &mut self.keys else { return };
        let Some(signing) = &mut keys.signing else { return };
        let news = signing.has_news() && (at_end || now >= self.next_store);
        if !news && !signing.is_store_due(stamp) {
            return;
        }
        self.next_store = now + STORE_PERIOD;
        match keys::write_state(&keys.state_file, &signing.take_state(stamp)) {
            Ok(()) => self.store_failed = false,
            Err(error) if !self.store_failed => {
                self.store_failed = true;
                tracing::error!("cannot keep {}: {error}", keys.state_file.display());
            }
            Err(_) => {}
        }
    }
}

/// The time for signatures.
fn signing_now(clock: &Clock) -> u64 {
    let (_, wall) = clock.both();
    (wall.as_micros() as u64).saturating_sub(SIGNING_EPOCH_US) / 10
}
