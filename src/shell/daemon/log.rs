//! The log: lines go to standard error through a queue, so that a slow reader holds up nobody. What
//! the queue has no room for is dropped and counted.

use std::io::IsTerminal;

use tracing::level_filters::LevelFilter;
use tracing_appender::non_blocking::{ErrorCounter, NonBlockingBuilder, WorkerGuard};

/// Lines that may wait.
const LINES_MAX: usize = 4096;

/// Writes what waits when it is dropped.
pub struct Log {
    counter: ErrorCounter,
    _guard: WorkerGuard,
}

impl Log {
    /// Sets up the log: what is done, with one `-v` why, with two everything.
    pub fn new(verbose: u8) -> Self {
        let level = match verbose {
            0 => LevelFilter::INFO,
            1 => LevelFilter::DEBUG,
            _ => LevelFilter::TRACE,
        };
        let (writer, guard) = NonBlockingBuilder::default()
            .lossy(true)
            .buffered_lines_limit(LINES_MAX)
            .thread_name("apexd-log")
            .finish(std::io::stderr());
        let counter = writer.error_counter();
        let log = tracing_subscriber::fmt()
            .with_max_level(level)
            .with_target(verbose > 0)
            .with_ansi(std::io::stderr().is_terminal())
            .with_writer(writer)
            .finish();
        // A second log in one process (tests) is not worth a word: the first one serves.
        let _ = tracing::subscriber::set_global_default(log);
        Self { counter, _guard: guard }
    }

    /// Counts the lines dropped so far.
    pub fn dropped(&self) -> impl Fn() -> u64 + Send + 'static {
        let counter = self.counter.clone();
        move || counter.dropped_lines() as u64
    }
}
