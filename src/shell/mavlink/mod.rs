//! MAVLink links and the thread that serves them, apart from the control loop: a flood, a slow
//! reader or a disk that takes its time must not move the control tick.

mod hub;
mod keys;
mod link;
mod services;
mod shelf;
mod simulated;
mod url;
mod view;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;

use tokio::runtime;
use tokio::sync::{mpsc, oneshot};

pub use hub::{End, Ender};
pub use keys::KeyError;
pub use link::LinkError;
pub use services::services;
pub use simulated::Attended;
pub use url::{LinkUrl, UrlError, parse_list};

use super::daemon::Seam;
use crate::frames::Pose;
use crate::ground::{Ground, MavlinkParams, Service};
use crate::wire::mavlink::Signing;
use hub::{Hub, HubCounts, KeyKeeper};
use link::Inlet;

/// Arrivals that may wait for the hub.
const ARRIVALS_MAX: usize = 1024;

/// Why MAVLink did not begin.
#[derive(Debug, thiserror::Error)]
pub enum MavlinkError {
    /// A link's text is none.
    #[error("mavlink.links: {0}")]
    Url(#[from] UrlError),
    /// A link cannot be opened.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The key cannot be used.
    #[error(transparent)]
    Key(#[from] KeyError),
    /// The time stamps of signatures cannot be read.
    #[error("cannot read the time stamps of signatures {path}: {error}")]
    Stamps {
        /// Their file.
        path: String,
        /// Why.
        error: std::io::Error,
    },
    /// The system gives no thread.
    #[error("cannot start the MAVLink thread: {0}")]
    System(#[from] std::io::Error),
}

/// What the links are joined to.
pub struct Joined {
    /// The control loop.
    pub seam: Seam,
    /// Where the car stood at the start, map frame.
    pub start: Pose,
    /// Services beside the vehicle itself.
    pub services: Vec<Box<dyn Service>>,
    /// Ends the program.
    pub ender: Ender,
}

/// Links being served.
pub struct Mavlink {
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
    counts: Arc<HubCounts>,
    dropped: Arc<AtomicU64>,
}

impl Mavlink {
    /// Opens the links and serves them from a thread of their own until the value is dropped.
    ///
    /// # Errors
    /// If a link or the key cannot be opened.
    pub fn start(
        params: &MavlinkParams,
        urls: &[LinkUrl],
        state_directory: Option<&Path>,
        joined: Joined,
    ) -> Result<Self, MavlinkError> {
        let keys = key_keeper(params, state_directory)?;
        let runtime = runtime::Builder::new_current_thread().enable_all().build()?;
        let (queue, arrivals) = mpsc::channel(ARRIVALS_MAX);
        let (inlet, dropped) = Inlet::new(queue);
        runtime.block_on(async {
            for url in urls {
                link::open(url, inlet.clone()).await?;
            }
            Ok::<(), LinkError>(())
        })?;
        let mut ground = Ground::new(params.clone(), joined.services);
        services::keep_places(&mut ground, state_directory);
        let hub = Hub::new(ground, joined.seam, joined.start, keys, params.unsigned, joined.ender);
        let counts = Arc::clone(&hub.counts);
        let (stop, stopped) = oneshot::channel();
        let thread = std::thread::Builder::new()
            .name("apexd-mavlink".into())
            .spawn(move || runtime.block_on(hub.run(arrivals, stopped)))?;
        Ok(Self { stop: Some(stop), thread: Some(thread), counts, dropped })
    }
}

impl Drop for Mavlink {
    fn drop(&mut self) {
        drop(self.stop.take());
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the MAVLink thread has failed");
        }
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        tracing::info!(
            frames = count(&self.counts.frames),
            throttled = count(&self.counts.throttled),
            refused = count(&self.counts.refused),
            unsent = count(&self.counts.unsent),
            dropped = count(&self.dropped),
            "MAVLink has ended"
        );
    }
}

fn key_keeper(
    params: &MavlinkParams,
    state_directory: Option<&Path>,
) -> Result<Option<KeyKeeper>, MavlinkError> {
    use crate::ground::KeySetup;
    if params.signing_key_file.is_empty() {
        return Ok(None);
    }
    let key_file = Path::new(&params.signing_key_file).to_owned();
    let state_file = match state_directory {
        Some(directory) => directory.join("mavlink-signing.json"),
        None => key_file.with_extension("stamps.json"),
    };
    let key = match keys::read_key(&key_file) {
        Err(KeyError::Unreadable { error, .. })
            if error.kind() == std::io::ErrorKind::NotFound
                && params.key_setup == KeySetup::Trusted =>
        {
            tracing::warn!("no key for signatures yet: everything is accepted until one is set");
            None
        }
        key => Some(key?),
    };
    let stamps = keys::read_state(&state_file).map_err(|error| {
        let path = state_file.display().to_string();
        MavlinkError::Stamps { path, error }
    })?;
    let signing = key.map(|key| Signing::new(key, &stamps));
    Ok(Some(KeyKeeper { key_file, state_file, signing }))
}

#[cfg(test)]
mod tests;
