//! The loop and the bus: frames in and out, a link that is gone and comes back.

use super::super::link::Link;
use super::super::timing::Timing;
use super::super::worker::Worker;
use super::Control;
use crate::autopilot::BusHealth;
use crate::shell::can::{BusState, Received, SendFault};
use crate::time::{Duration, Instant};

/// A frame that the bus has not taken after this long is out of date.
const FRAME_LIFE: Duration = Duration::from_millis(20);
/// A full send queue is tried again after this long.
const SEND_AGAIN: Duration = Duration::from_millis(1);
/// After a fault of the socket it is left alone for this long.
const DEAF: Duration = Duration::from_millis(100);
/// Among frames that come without a pause the clock is looked at after so many.
const FRAMES_BLIND: u32 = 8;
/// Scans whose plan is still awaited.
pub(super) const SCANS_MAX: usize = 16;

impl<L: Link, T: Timing, W: Worker> Control<L, T, W> {
    pub(super) fn hear(&mut self, received: Received) {
        let Received::Frame { at, frame } = received else {
            self.report_bus(self.timing.now());
            return;
        };
        self.frames_since_tick += 1;
        let scans = self.core.statistics().scans;
        self.core.handle_frame(at, &frame);
        if self.core.statistics().scans > scans
            && let Some(scan) = self.core.newest_scan()
        {
            self.scans.push_back((scan.stamp, at));
            if self.scans.len() > SCANS_MAX {
                self.scans.pop_front();
            }
        }
        self.fetch(at);
        // As long as frames come without a pause, nobody looks at the alarm.
        self.frames_blind += 1;
        if at >= self.wake_at() || self.frames_blind >= FRAMES_BLIND {
            self.wake();
        }
    }

    /// The link is of no more use for now (the interface has disappeared): it is opened again a
    /// little later.
    pub(super) fn turn_deaf(&mut self, reason: String) {
        if reason != self.deaf_reason {
            tracing::error!("{reason}");
            self.deaf_reason = reason;
        }
        let now = self.timing.now();
        self.deaf_until = Some(now + DEAF);
        self.report_bus(now);
    }

    pub(super) fn open_again(&mut self) {
        match self.link.reopen() {
            Ok(()) => {
                tracing::info!("the link is open again");
                self.deaf_until = None;
                self.deaf_reason.clear();
            }
            Err(error) => self.turn_deaf(error.to_string()),
        }
    }

    pub(super) fn report_bus(&mut self, now: Instant) {
        let statistics = self.link.statistics();
        let deaf = self.deaf_until.is_some();
        let state = if deaf { BusState::Off } else { statistics.state };
        let error_frames = statistics.error_frames;
        let health = BusHealth { state, error_frames, frames_unsent: self.unsent };
        self.core.handle_bus_health(now, health);
    }

    /// Gives the bus what it takes, in order; what has waited too long is dropped.
    pub(super) fn send(&mut self) {
        self.send_at = None;
        while let Some((since, frame)) = self.outbox.front() {
            match self.link.try_send(frame) {
                Ok(()) => {}
                Err(SendFault::Full) => {
                    let now = self.timing.now();
                    if now.since(*since) <= FRAME_LIFE {
                        self.send_at = Some(now + SEND_AGAIN);
                        return;
                    }
                    self.unsent += 1;
                }
                Err(_) => self.unsent += 1,
            }
            self.outbox.pop_front();
        }
    }
}
