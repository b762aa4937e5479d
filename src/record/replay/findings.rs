//! What a replay finds to be otherwise than it was.

use serde::Serialize;

use crate::command::ForceSetpoint;
use crate::record::digest::FrameDigest;
use crate::record::header::{Header, Source};
use crate::time::Instant;
use crate::wire::can::{CanFrame, CarDecoder, DaemonMessage, Layout};

/// The first thing that came out otherwise.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// When, seconds on the core's clock.
    pub t_s: f64,
    /// What was compared: `frame` or `plan`.
    pub what: &'static str,
    /// What was there then.
    pub then: String,
    /// What is there now.
    pub now: String,
}

/// How far setpoints differ, at each tick in which both had one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct SetpointDifference {
    /// How many were compared.
    pub compared: u64,
    /// Root of the mean square of the difference of the forces, newtons.
    pub rms_n: f64,
    /// Largest difference, newtons.
    pub max_n: f64,
}

/// Where the log ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Ended {
    /// Where it should.
    Closed,
    /// In the middle: whoever wrote it was killed, or a further part is missing.
    CutOff,
    /// Pieces are missing; nothing can be compared behind them.
    Gap,
}

/// What a replay came to.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// Every frame and every plan is to the last bit what it was.
    pub identical: bool,
    /// Frames sent then.
    pub frames: u64,
    /// How many of them came out otherwise or not at all, and how many came out besides.
    pub frames_differing: u64,
    /// Planning steps that came back then.
    pub plans: u64,
    /// How many of them came to something else.
    pub plans_differing: u64,
    /// The first difference.
    pub first: Option<Difference>,
    /// How far setpoints are apart.
    pub setpoints: SetpointDifference,
    /// Time that the log covers, seconds.
    pub time_s: f64,
    /// Where the log ended.
    pub ended: Ended,
    /// Parts of the log.
    pub parts: u32,
    /// Digest over the frames sent then, as `apexd sil` prints it.
    pub digest_then: String,
    /// The same over the frames now.
    pub digest_now: String,
    /// Version of the program that wrote the log.
    pub build: String,
    /// Who wrote it.
    pub source: Source,
    /// When it was begun, by the clock on the wall.
    pub begun_utc: String,
}

/// What has been found so far.
pub(super) struct Findings {
    frames: u64,
    frames_differing: u64,
    /// Planning steps that came back then.
    pub(super) plans: u64,
    /// How many of them came to something else.
    pub(super) plans_differing: u64,
    first: Option<Difference>,
    /// Of the frames then and now.
    digests: [FrameDigest; 2],
    /// For the frames then and now.
    decoders: [CarDecoder; 2],
    setpoints: SetpointDifference,
}

impl Findings {
    pub(super) fn new(layout: Layout) -> Self {
        Self {
            frames: 0,
            frames_differing: 0,
            plans: 0,
            plans_differing: 0,
            first: None,
            digests: [FrameDigest::new(), FrameDigest::new()],
            decoders: [CarDecoder::new(layout), CarDecoder::new(layout)],
            setpoints: SetpointDifference::default(),
        }
    }

    /// Compares what was sent at one time then with what is sent now.
    pub(super) fn compare(&mut self, at: Instant, then: &[CanFrame], now: &[CanFrame]) {
        self.frames += then.len() as u64;
        for i in 0..then.len().max(now.len()) {
            let (then, now) = (then.get(i), now.get(i));
            if then == now {
                continue;
            }
            self.frames_differing += 1;
            if self.first.is_none() {
                let text = |frame: Option<&CanFrame>| {
                    frame.map_or_else(|| "no frame".into(), |frame| format!("{frame:?}"))
                };
                self.note(at, "frame", text(then), text(now));
            }
        }
        let mut setpoints = [None; 2];
        for (side, frames) in [then, now].into_iter().enumerate() {
            for frame in frames {
                self.digests[side].note(frame);
                if let Ok(Some(DaemonMessage::Setpoint(setpoint))) =
                    self.decoders[side].decode(at, frame)
                {
                    setpoints[side] = Some(setpoint);
                }
            }
        }
        if let [Some(then), Some(now)] = setpoints {
            self.compare_setpoints(then, now);
        }
    }

    fn compare_setpoints(&mut self, then: ForceSetpoint, now: ForceSetpoint) {
        let apart_n =
            (then.longitudinal_n - now.longitudinal_n).hypot(then.lateral_n - now.lateral_n);
        let sum = &mut self.setpoints;
        sum.compared += 1;
        // The sum of squares until the end.
        sum.rms_n += apart_n * apart_n;
        sum.max_n = sum.max_n.max(apart_n);
    }

    /// Keeps a difference if it is the first.
    pub(super) fn note(&mut self, at: Instant, what: &'static str, then: String, now: String) {
        let t_s = at.as_secs_f64();
        self.first.get_or_insert(Difference { t_s, what, then, now });
    }

    /// What it all comes to, at the end of a log that covers so many seconds.
    pub(super) fn comparison(
        self,
        time_s: f64,
        header: Header,
        parts: u32,
        ended: Ended,
    ) -> Comparison {
        let [then, now] = self.digests;
        let mut setpoints = self.setpoints;
        setpoints.rms_n = (setpoints.rms_n / setpoints.compared.max(1) as f64).sqrt();
        Comparison {
            identical: self.first.is_none(),
            frames: self.frames,
            frames_differing: self.frames_differing,
            plans: self.plans,
            plans_differing: self.plans_differing,
            first: self.first,
            setpoints,
            time_s,
            ended,
            parts,
            digest_then: then.text(),
            digest_now: now.text(),
            build: header.build,
            source: header.source,
            begun_utc: header.begun_utc,
        }
    }
}
