//! A simulated drive in conversation with ground stations: stands in for the daemon's control loop.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::{End, Joined, LinkUrl, Mavlink, MavlinkError, services};
use crate::autopilot::Event;
use crate::frames::Pose;
use crate::params::Params;
use crate::shell::configuration;
use crate::shell::daemon::{CoreSnapshot, InnerSeam, Request, Seam, apply_change};
use crate::shell::load::LoadMeter;
use crate::shell::logbook::Recorder;
use crate::sim::rig::Rig;
use crate::time::{Duration, Instant};

/// Between two snapshots.
const SNAPSHOT_PERIOD: Duration = Duration::from_millis(50);

/// The links of a simulated drive.
pub struct Attended {
    seam: InnerSeam,
    params: Arc<Params>,
    next_snapshot: Instant,
    load: LoadMeter,
    end: Arc<AtomicBool>,
    /// Writes the drive down; the core has its witness.
    pub(in crate::shell) recorder: Option<Recorder>,
    _mavlink: Mavlink,
}

impl Attended {
    /// Opens the links.
    ///
    /// # Errors
    /// If one of them, or the key, cannot be opened.
    pub fn start(params: &Params, urls: &[LinkUrl], start: Pose) -> Result<Self, MavlinkError> {
        let state_directory = configuration::state_directory(params, &[]);
        let (outer, seam) = Seam::new();
        let end = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&end);
        let joined = Joined {
            seam: outer,
            start,
            services: services(
                params,
                state_directory.as_deref(),
                configuration::log_directory(params, &[]),
            ),
            ender: Box::new(move |how| match how {
                End::Shutdown => {
                    told.store(true, Ordering::Relaxed);
                    Ok(())
                }
                End::Restart => Err("a simulated drive cannot begin anew".into()),
            }),
        };
        let mavlink = Mavlink::start(&params.mavlink, urls, state_directory.as_deref(), joined)?;
        Ok(Self {
            seam,
            params: Arc::new(params.clone()),
            next_snapshot: Instant::ZERO,
            load: LoadMeter::default(),
            end,
            recorder: None,
            _mavlink: mavlink,
        })
    }

    /// Something happened in the core.
    pub fn tell(&self, event: &Event) {
        // Nobody may be listening.
        let _ = self.seam.events.send(event.clone());
    }

    /// Lets ground stations see the drive and command it.
    pub fn attend(&mut self, rig: &mut Rig) {
        while let Ok(request) = self.seam.requests.try_recv() {
            self.grant(rig, request);
        }
        if self.end.load(Ordering::Relaxed) {
            rig.interrupt();
        }
        let now = rig.now();
        if now >= self.next_snapshot {
            self.next_snapshot = now + SNAPSHOT_PERIOD;
            let load = self.load.measure(now);
            let snapshot = CoreSnapshot { load, ..CoreSnapshot::of(rig.core(), &self.params, now) };
            self.seam.snapshots.send_replace(Some(Arc::new(snapshot)));
        }
    }

    fn grant(&mut self, rig: &mut Rig, request: Request) {
        let now = rig.now();
        match request {
            Request::Command { command, reply } => {
                let answer = rig.core_mut().handle_command(now, command);
                match &answer {
                    Ok(()) => tracing::info!("{command:?}"),
                    Err(refusal) => tracing::warn!("{command:?} refused: {refusal}"),
                }
                // Who does not wait for the answer does not want it.
                let _ = reply.send(answer.map_err(Into::into));
            }
            Request::SetParameter { key, value, reply } => {
                let at_rest = rig.core().is_at_rest(now);
                let params = Arc::make_mut(&mut self.params);
                let answer = apply_change(params, &key, &value, at_rest);
                if answer == Ok(true) {
                    tracing::info!("{key} = {value}");
                    rig.set_params(params.core(), &params.planner());
                    if let Some(recorder) = &self.recorder {
                        recorder.note_params(now, Arc::clone(&self.params));
                    }
                }
                let _ = reply.send(answer.map(drop));
            }
            Request::SetFence { fence, reply } => {
                rig.core_mut().set_fence(now, fence);
                let _ = reply.send(());
            }
        }
    }
}
