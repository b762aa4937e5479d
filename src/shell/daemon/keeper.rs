//! The daemon's housekeeping, beside the control thread: the service manager, the configuration
//! file, the disk. Whatever may block happens here.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError};

use sd_notify::NotifyState;
use tokio::sync::mpsc;

use super::control::{Order, Pulse, Word};
use crate::params::{Faults, Params};
use crate::shell::pace;
use crate::time::Duration;

/// It looks round this often.
const PERIOD: Duration = Duration::from_millis(100);
/// File and disk are looked at this often, in rounds.
const FILE_ROUNDS: u64 = 10;
/// Ticks after which the core counts as running.
const READY_TICKS: u64 = 10;

/// Reads the configuration anew, all its layers.
pub type Load = Box<dyn Fn() -> Result<Params, Faults> + Send>;

/// The housekeeper.
pub struct Keeper {
    /// Orders to the control loop.
    pub orders: mpsc::Sender<Order>,
    /// Word from it.
    pub words: Receiver<Word>,
    /// Its sign of life.
    pub pulse: Arc<Pulse>,
    /// Reads the configuration.
    pub load: Load,
    /// The file that is watched.
    pub config: Option<PathBuf>,
    /// Directories whose disks are watched.
    pub watched: Vec<PathBuf>,
    /// Least free space, bytes.
    pub disk_free_min: u64,
    /// Ticks a second.
    pub tick_rate_hz: f64,
}

impl Keeper {
    /// Keeps house until the control loop is gone.
    pub fn run(mut self) {
        let mut watchdog = Watchdog::new(self.tick_rate_hz);
        let mut file = self.config.as_deref().map(Watched::new);
        let mut ready = false;
        let mut full = None;
        let mut rounds = 0u64;
        loop {
            match self.words.recv_timeout(PERIOD) {
                Ok(Word::Reload) => {
                    tracing::info!("told to read the configuration again");
                    self.reload();
                }
                Ok(Word::Status(text)) => notify(&NotifyState::Status(&text)),
                Ok(Word::Stopping) => notify(&NotifyState::Stopping),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => return,
            }
            let ticks = self.pulse.ticks();
            if !ready && ticks >= READY_TICKS {
                ready = true;
                notify(&NotifyState::Ready);
            }
            if watchdog.feed(pace::now(), ticks) {
                notify(&NotifyState::Watchdog);
            }
            rounds += 1;
            if !rounds.is_multiple_of(FILE_ROUNDS) {
                continue;
            }
            if file.as_mut().is_some_and(Watched::has_settled) {
                tracing::info!("the configuration file has changed");
                self.reload();
            }
            let full_one = |directory: &PathBuf| is_full(directory, self.disk_free_min);
            let now_full = (!self.watched.is_empty()).then(|| self.watched.iter().any(full_one));
            if now_full != full {
                full = now_full;
                // It is said again the next time, if there is no room now.
                if self.orders.try_send(Order::DiskFull(full == Some(true))).is_err() {
                    full = None;
                }
            }
        }
    }

    fn reload(&mut self) {
        match (self.load)() {
            Ok(params) => {
                self.disk_free_min = disk_free_min(&params);
                if self.orders.try_send(Order::Params(Box::new(params))).is_err() {
                    tracing::error!("the control loop takes no configuration");
                }
            }
            Err(faults) => {
                tracing::error!("bad configuration, everything stays as it is\n{faults}");
            }
        }
    }
}

/// Least free space, bytes.
pub fn disk_free_min(params: &Params) -> u64 {
    u64::from(params.daemon.disk_free_min_mb) * 1_000_000
}

/// Whether there is less free space than that, or none can be told.
fn is_full(directory: &Path, free_min: u64) -> bool {
    match nix::sys::statvfs::statvfs(directory) {
        Ok(disk) => {
            let available = disk.blocks_available() * disk.fragment_size();
            // A disk without any room is full whatever the limit.
            available < free_min.max(1)
        }
        Err(error) => {
            tracing::warn!("cannot tell the free space of {}: {error}", directory.display());
            true
        }
    }
}

/// Tells the service manager, if there is one.
fn notify(state: &NotifyState<'_>) {
    // Without a manager nothing is sent, and one that does not listen cannot be helped.
    let _ = sd_notify::notify(std::slice::from_ref(state));
}

/// Feeds the service manager's watchdog as long as the control tick runs at half its rate or more.
struct Watchdog {
    period: Option<Duration>,
    tick_rate_hz: f64,
    last: Option<(std::time::Instant, u64)>,
}

impl Watchdog {
    fn new(tick_rate_hz: f64) -> Self {
        // Three times in the time that it may go hungry.
        let period = sd_notify::watchdog_enabled().map(|limit| limit / 3);
        Self { period, tick_rate_hz, last: None }
    }

    /// Whether it is to be fed now.
    fn feed(&mut self, now: std::time::Instant, ticks: u64) -> bool {
        let Some(period) = self.period else { return false };
        let Some((at, before)) = self.last else {
            self.last = Some((now, ticks));
            return ticks > 0;
        };
        let passed = now.saturating_duration_since(at);
        if passed < period {
            return false;
        }
        self.last = Some((now, ticks));
        (ticks - before) as f64 >= 0.5 * passed.as_secs_f64() * self.tick_rate_hz
    }
}

/// What tells one state of a file from another.
type Mark = Option<(u64, i64, i64, u64)>;

/// A file whose changes are noticed once they have settled, so that none is read half-written.
struct Watched {
    file: PathBuf,
    known: Mark,
    newest: Mark,
}

impl Watched {
    fn new(file: &Path) -> Self {
        let mark = mark(file);
        Self { file: file.to_owned(), known: mark, newest: mark }
    }

    /// Whether it has changed, and then stayed the same from the look before to this one.
    fn has_settled(&mut self) -> bool {
        let now = mark(&self.file);
        let settled = now == self.newest && now != self.known && now.is_some();
        self.newest = now;
        if settled {
            self.known = now;
        }
        settled
    }
}

fn mark(file: &Path) -> Mark {
    let about = std::fs::metadata(file).ok()?;
    Some((about.ino(), about.mtime(), about.mtime_nsec(), about.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_of_the_file_is_noticed_once_it_has_settled() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("car.toml");
        std::fs::write(&file, "a").unwrap();
        let mut watched = Watched::new(&file);
        assert!(!watched.has_settled());
        std::fs::write(&file, "ab").unwrap();
        assert!(!watched.has_settled(), "it may not be complete yet");
        assert!(watched.has_settled());
        assert!(!watched.has_settled(), "only once");
        std::fs::remove_file(&file).unwrap();
        assert!(!watched.has_settled() && !watched.has_settled(), "nothing to read");
        std::fs::write(&file, "ab").unwrap();
        assert!(!watched.has_settled());
        assert!(watched.has_settled(), "another file of the same name");
    }

    #[test]
    fn the_watchdog_is_fed_only_while_the_tick_keeps_its_pace() {
        let begin = pace::now();
        let at = |ms| begin + Duration::from_millis(ms);
        let period = Some(Duration::from_millis(1000));
        let mut watchdog = Watchdog { period, tick_rate_hz: 100.0, last: None };
        assert!(!watchdog.feed(at(0), 0), "nothing has ticked yet");
        assert!(!watchdog.feed(at(500), 50), "not due");
        assert!(watchdog.feed(at(1000), 100));
        assert!(!watchdog.feed(at(2000), 149), "half the ticks are missing");
        assert!(watchdog.feed(at(3000), 249));
        assert!(!watchdog.feed(at(4000), 249), "it has stopped");
        let mut nobody = Watchdog { period: None, tick_rate_hz: 100.0, last: None };
        assert!(!nobody.feed(at(1000), 100));
    }

    #[test]
    fn a_disk_is_full_below_the_limit_or_when_it_is_gone() {
        let directory = tempfile::tempdir().unwrap();
        assert!(!is_full(directory.path(), 1));
        assert!(is_full(directory.path(), u64::MAX));
        assert!(is_full(&directory.path().join("gone"), 1));
    }
}
