//! What is sent regularly, and how often, on each channel.

use crate::time::Instant;
use crate::wire::mavlink::MessageData;
use crate::wire::mavlink::common as c;

/// A message that can be sent regularly.
#[derive(Clone, Copy, Debug)]
struct Kind {
    id: u32,
    /// Default period, seconds; zero: only when asked for.
    period_s: f64,
    /// Bytes on the wire, for slow links.
    bytes: usize,
}

const fn kind<D: MessageData>(period_s: f64) -> Kind {
    Kind { id: D::ID, period_s, bytes: D::ENCODED_LEN + 12 }
}

/// What can be sent regularly. Heartbeats are not among them: they are the vehicle's own business.
const KINDS: &[Kind] = &[
    kind::<c::SYS_STATUS_DATA>(0.5),
    kind::<c::EXTENDED_SYS_STATE_DATA>(1.0),
    kind::<c::CURRENT_MODE_DATA>(2.0),
    kind::<c::SYSTEM_TIME_DATA>(1.0),
    kind::<c::ATTITUDE_DATA>(0.1),
    kind::<c::ATTITUDE_QUATERNION_DATA>(0.0),
    kind::<c::LOCAL_POSITION_NED_DATA>(0.1),
    kind::<c::ODOMETRY_DATA>(0.2),
    kind::<c::GLOBAL_POSITION_INT_DATA>(0.2),
    kind::<c::VFR_HUD_DATA>(0.25),
    kind::<c::OBSTACLE_DISTANCE_DATA>(0.2),
    kind::<c::POSITION_TARGET_LOCAL_NED_DATA>(0.2),
    kind::<c::NAV_CONTROLLER_OUTPUT_DATA>(0.5),
    kind::<c::TRAJECTORY_REPRESENTATION_WAYPOINTS_DATA>(0.5),
    kind::<c::BATTERY_STATUS_DATA>(1.0),
    kind::<c::HOME_POSITION_DATA>(5.0),
    kind::<c::GPS_GLOBAL_ORIGIN_DATA>(5.0),
];

/// Share of a slow link that telemetry may use; the rest is for answers.
const SHARE: f64 = 0.6;
/// Nothing is sent more often, seconds: the core is looked at 20 times a second.
const PERIOD_MIN_S: f64 = 0.02;
/// Nor more seldom.
const PERIOD_MAX_S: f64 = 3600.0;

/// How often a message is sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Interval {
    /// As often as it is by default.
    Default,
    /// Never.
    Never,
    /// Each so many seconds.
    Seconds(f64),
}

/// Why an interval was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IntervalFault {
    /// This message is never sent regularly.
    #[error("this message is not sent regularly")]
    NoStream,
    /// Out of range.
    #[error("the interval must be 20 ms to 1 h")]
    Range,
}

#[derive(Clone, Debug)]
struct Stream {
    kind: Kind,
    /// `None`: switched off.
    period_s: Option<f64>,
    due: Instant,
}

/// The regular messages of one channel.
#[derive(Clone, Debug)]
pub struct Streams {
    streams: Vec<Stream>,
    bytes_per_s: Option<f64>,
    /// Everything is this many times as seldom as asked for.
    stretch: f64,
}

impl Streams {
    /// The defaults, thinned out for a slow link.
    pub fn new(now: Instant, bytes_per_s: Option<f64>) -> Self {
        let default = |kind: &Kind| (kind.period_s > 0.0).then_some(kind.period_s);
        let streams =
            KINDS.iter().map(|kind| Stream { kind: *kind, period_s: default(kind), due: now });
        let mut streams = Self { streams: streams.collect(), bytes_per_s, stretch: 1.0 };
        streams.fit();
        streams
    }

    /// Sets how often a message is sent.
    ///
    /// # Errors
    /// If it cannot be sent regularly, or not that often.
    pub fn set(&mut self, now: Instant, id: u32, interval: Interval) -> Result<(), IntervalFault> {
        let stream = self.streams.iter_mut().find(|stream| stream.kind.id == id);
        let stream = stream.ok_or(IntervalFault::NoStream)?;
        stream.period_s = match interval {
            Interval::Never => None,
            Interval::Default => (stream.kind.period_s > 0.0).then_some(stream.kind.period_s),
            Interval::Seconds(period_s) if (PERIOD_MIN_S..=PERIOD_MAX_S).contains(&period_s) => {
                Some(period_s)
            }
            Interval::Seconds(_) => return Err(IntervalFault::Range),
        };
        stream.due = now;
        self.fit();
        Ok(())
    }

    /// How often a message is sent, seconds: zero if never, `None` if it cannot be.
    pub fn period_s(&self, id: u32) -> Option<f64> {
        let stream = self.streams.iter().find(|stream| stream.kind.id == id)?;
        Some(stream.period_s.map_or(0.0, |period_s| period_s * self.stretch))
    }

    /// The messages that are due; after a pause none is made up for.
    pub fn take_due(&mut self, now: Instant, mut send: impl FnMut(u32)) {
        for stream in &mut self.streams {
            let Some(period_s) = stream.period_s else { continue };
            if now >= stream.due {
                send(stream.kind.id);
                let next = stream.due.offset_by(period_s * self.stretch);
                stream.due = if next > now { next } else { now.offset_by(period_s * self.stretch) };
            }
        }
    }

    fn fit(&mut self) {
        let rate = |s: &Stream| s.period_s.map_or(0.0, |period_s| s.kind.bytes as f64 / period_s);
        let wanted: f64 = self.streams.iter().map(rate).sum();
        self.stretch = self.bytes_per_s.map_or(1.0, |room| (wanted / (room * SHARE)).max(1.0));
    }
}
