//! Logs being written, by a thread of their own: whoever hands something over goes on at once.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;

use super::pace;
use super::shelved::{self, Limits};
use crate::map::Grid;
use crate::params::Params;
use crate::record::{Entry, Header, LogWriter, Readings, Scribe, params_text};
use crate::time::{Duration, Instant};

/// Pieces are handed over together, so many at most: waking the other thread costs more than a piece.
const BATCH_PIECES: usize = 128;
/// Pieces wait no longer than this to be handed over.
const BATCH_TIME: Duration = Duration::from_millis(50);
/// Batches that may wait: three seconds.
const BATCHES_MAX: usize = 64;
/// What waits is written at least this often.
const FLUSH_PERIOD: Duration = Duration::from_millis(100);

/// Why a log is not written, or not any more.
#[derive(Debug, thiserror::Error)]
#[error("cannot write the log {}: {error}", path.display())]
pub struct LogbookError {
    /// Its file.
    pub path: PathBuf,
    /// Why.
    pub error: io::Error,
}

/// Where a log goes.
#[derive(Clone, Debug)]
pub enum Place {
    /// Into one file.
    File(PathBuf),
    /// Into a folder of logs, in parts, the oldest ones making room.
    Folder(PathBuf, Limits),
}

/// What becomes of a piece when the disk does not keep up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhenFull {
    /// Whoever hands it over waits.
    Wait,
    /// It is dropped, and counted.
    Drop,
}

enum Piece {
    Entry(Entry),
    Params(Arc<Params>),
}

enum Message {
    /// So many pieces are missing, then these follow.
    Pieces(u64, Vec<(Instant, Piece)>),
    End,
}

/// A log being written.
pub struct Logbook {
    recorder: Recorder,
    thread: JoinHandle<Result<(), LogbookError>>,
    path: PathBuf,
}

/// Takes what is to be written. Copies write into the same log; they are meant for one thread.
#[derive(Clone)]
pub struct Recorder {
    batch: Arc<Mutex<Batch>>,
    sender: SyncSender<Message>,
    when_full: WhenFull,
    dropped: Arc<AtomicU64>,
}

/// What has not been handed over yet.
#[derive(Default)]
struct Batch {
    pieces: Vec<(Instant, Piece)>,
    /// Pieces dropped since the last one that was not.
    missing: u64,
}

impl Recorder {
    /// A piece of the log.
    pub fn note(&self, at: Instant, entry: Entry) {
        self.put(at, Piece::Entry(entry));
    }

    /// Other parameters.
    pub fn note_params(&self, at: Instant, params: Arc<Params>) {
        self.put(at, Piece::Params(params));
    }

    /// The witness that writes down what happens to a core.
    pub fn scribe(&self, readings: Readings) -> Box<Scribe<impl FnMut(Instant, Entry) + use<>>> {
        let recorder = self.clone();
        Box::new(Scribe::new(readings, move |at, entry| recorder.note(at, entry)))
    }

    /// Counts the pieces dropped so far.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    fn put(&self, at: Instant, piece: Piece) {
        let mut batch = self.batch.lock().unwrap_or_else(PoisonError::into_inner);
        batch.pieces.push((at, piece));
        let since = batch.pieces.first().map_or(at, |(at, _)| *at);
        if batch.pieces.len() >= BATCH_PIECES || at.since(since) >= BATCH_TIME {
            self.hand_over(&mut batch, self.when_full);
        }
    }

    fn hand_over(&self, batch: &mut Batch, when_full: WhenFull) {
        let pieces = std::mem::replace(&mut batch.pieces, Vec::with_capacity(BATCH_PIECES));
        let count = pieces.len() as u64;
        let message = Message::Pieces(batch.missing, pieces);
        let is_sent = match when_full {
            WhenFull::Drop => self.sender.try_send(message).is_ok(),
            WhenFull::Wait => self.sender.send(message).is_ok(),
        };
        if is_sent {
            batch.missing = 0;
        } else {
            batch.missing += count;
            self.dropped.fetch_add(count, Ordering::Relaxed);
        }
    }

    /// Nothing more comes.
    fn end(&self) {
        let mut batch = self.batch.lock().unwrap_or_else(PoisonError::into_inner);
        // Nobody is in a hurry any more.
        self.hand_over(&mut batch, WhenFull::Wait);
        // A thread that is gone has said why.
        let _ = self.sender.send(Message::End);
    }
}

impl Logbook {
    /// Begins a log.
    ///
    /// # Errors
    /// If its file cannot be written.
    pub fn begin(
        place: Place,
        header: Header,
        truth: Option<Grid>,
        when_full: WhenFull,
    ) -> Result<Self, LogbookError> {
        let mut writer = Writer::begin(place, header)?;
        if let Some(truth) = truth {
            writer.put(writer.made, &Entry::Truth(Box::new(truth)));
        }
        Self::start(writer, when_full)
    }

    fn start(writer: Writer, when_full: WhenFull) -> Result<Self, LogbookError> {
        let (sender, messages) = sync_channel(BATCHES_MAX);
        let (batch, dropped) = (Arc::default(), Arc::default());
        let recorder = Recorder { batch, sender, when_full, dropped };
        let path = writer.path.clone();
        let thread = std::thread::Builder::new()
            .name("apexd-record".into())
            .spawn(move || writer.work(&messages))
            .map_err(|error| LogbookError { path: path.clone(), error })?;
        Ok(Self { recorder, thread, path })
    }

    /// Takes what is to be written.
    pub const fn recorder(&self) -> &Recorder {
        &self.recorder
    }

    /// The file of its first part.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes what waits and ends the log.
    ///
    /// # Errors
    /// If it, or something before, could not be written.
    pub fn close(self) -> Result<(), LogbookError> {
        self.recorder.end();
        let dropped = self.recorder.dropped();
        if dropped > 0 {
            tracing::warn!("{dropped} pieces are missing in the log {}", self.path.display());
        }
        match self.thread.join() {
            Ok(ended) => ended,
            Err(_) => {
                let error = io::Error::other("its thread has failed");
                Err(LogbookError { path: self.path, error })
            }
        }
    }
}

/// The thread's own side.
struct Writer {
    place: Place,
    header: Header,
    made: Instant,
    path: PathBuf,
    log: Option<LogWriter<File>>,
    error: Option<LogbookError>,
    gap_said: bool,
}

impl Writer {
    fn begin(place: Place, header: Header) -> Result<Self, LogbookError> {
        let (path, file) = match &place {
            Place::File(path) => (path.clone(), File::create(path)),
            Place::Folder(folder, limits) => {
                let fail = |error| LogbookError { path: folder.clone(), error };
                fs::create_dir_all(folder).map_err(fail)?;
                shelved::make_room(folder, *limits, None);
                new_file(folder, &header.begun_utc).map_err(fail)?
            }
        };
        let mut writer = Self {
            place,
            made: header.made,
            header,
            path,
            log: None,
            error: None,
            gap_said: false,
        };
        match file.and_then(|file| writer.open(file)) {
            Ok(()) => Ok(writer),
            Err(error) => Err(LogbookError { path: writer.path, error }),
        }
    }

    /// The file of the present part, with its header on the disk.
    fn open(&mut self, file: File) -> io::Result<()> {
        let mut log = LogWriter::new(file)?;
        log.put(self.made, &Entry::Header(Box::new(self.header.clone())))?;
        log.flush()?;
        self.log = Some(log);
        Ok(())
    }

    fn work(mut self, messages: &Receiver<Message>) -> Result<(), LogbookError> {
        let mut flushed = pace::now();
        let mut newest = self.made;
        loop {
            match messages.recv_timeout(FLUSH_PERIOD) {
                Ok(Message::Pieces(missing, pieces)) => {
                    self.put_gap(missing, pieces.first().map_or(newest, |(at, _)| *at));
                    for (at, piece) in pieces {
                        newest = at;
                        match piece {
                            Piece::Entry(entry) => self.put(at, &entry),
                            Piece::Params(params) => {
                                self.put(at, &Entry::Params(params_text(&params)));
                            }
                        }
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Ok(Message::End) => break,
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if flushed.elapsed() >= FLUSH_PERIOD {
                flushed = pace::now();
                self.flush();
            }
        }
        if let Some(log) = self.log.take()
            && let Err(error) = log.close().and_then(|file| settle(&file))
        {
            self.fail(error);
        }
        self.error.map_or(Ok(()), Err)
    }

    fn put_gap(&mut self, missing: u64, at: Instant) {
        if missing == 0 {
            return;
        }
        if !self.gap_said {
            self.gap_said = true;
            tracing::warn!(
                "the disk does not keep up: {missing} pieces are missing in the log {}; it cannot be \
                 replayed beyond",
                self.path.display()
            );
        }
        self.put(at, &Entry::Gap { count: missing });
    }

    fn put(&mut self, at: Instant, entry: &Entry) {
        // Without a log what comes is thrown away: it has been said why there is none.
        let Some(log) = &mut self.log else { return };
        let put = log.put(at, entry);
        let length = log.length();
        match put {
            Err(error) => self.fail(error),
            Ok(()) => {
                if let Place::Folder(folder, limits) = &self.place
                    && length >= limits.part_bytes
                {
                    let (folder, limits) = (folder.clone(), *limits);
                    if let Err(error) = self.turn_over(at, &folder, limits) {
                        self.fail(error);
                    }
                }
            }
        }
    }

    /// Goes on in the next part.
    fn turn_over(&mut self, at: Instant, folder: &Path, limits: Limits) -> io::Result<()> {
        let Some(mut log) = self.log.take() else { return Ok(()) };
        log.put(at, &Entry::Continued)?;
        settle(&log.close()?)?;
        self.header.part += 1;
        let first = self.path.clone();
        let next = shelved::part_of(&first, self.header.part);
        shelved::make_room(folder, limits, Some(&next));
        let file = OpenOptions::new().write(true).create_new(true).open(next)?;
        self.open(file)
    }

    fn flush(&mut self) {
        let Some(log) = &mut self.log else { return };
        if let Err(error) = log.flush() {
            self.fail(error);
        }
    }

    fn fail(&mut self, error: io::Error) {
        let error = LogbookError { path: self.path.clone(), error };
        tracing::error!("{error}; nothing more is recorded");
        self.log = None;
        self.error.get_or_insert(error);
    }
}

/// Makes sure that what was written is on the disk, if it goes to one at all.
fn settle(file: &File) -> io::Result<()> {
    match file.sync_data() {
        Err(error) if error.kind() == io::ErrorKind::InvalidInput => Ok(()),
        done => done,
    }
}

/// A file named after the time. Two programs may begin within the same second.
fn new_file(folder: &Path, time: &str) -> io::Result<(PathBuf, io::Result<File>)> {
    let names = std::iter::once(time.to_owned()).chain((2..).map(|i| format!("{time}-{i}")));
    for name in names {
        let path = folder.join(format!("{name}.{}", shelved::EXTENSION));
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(error),
            file => return Ok((path, file)),
        }
    }
    unreachable!("there is no end of names")
}

#[cfg(test)]
#[path = "logbook_tests.rs"]
mod tests;
