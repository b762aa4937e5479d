//! Logs as sequences of entries.

use std::io::{self, Read, Write};

use super::container::{ContainerReader, ContainerWriter, End, LogError};
use super::entry::{Entry, EntryError, TOPICS};
use super::header::FORMAT;
use crate::time::Instant;

/// Writes entries.
#[derive(Debug)]
pub struct LogWriter<W> {
    container: ContainerWriter<W>,
    buffer: Vec<u8>,
}

impl<W: Write> LogWriter<W> {
    /// Begins a log.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn new(out: W) -> io::Result<Self> {
        Ok(Self { container: ContainerWriter::new(out, TOPICS)?, buffer: Vec::new() })
    }

    /// Appends an entry. It may wait in memory until the next [flush](Self::flush).
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn put(&mut self, at: Instant, entry: &Entry) -> io::Result<()> {
        self.buffer.clear();
        let topic = entry.encode(&mut self.buffer);
        self.container.put(topic, at, &self.buffer)
    }

    /// Writes what waits.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        self.container.flush()
    }

    /// Bytes so far.
    pub fn length(&self) -> u64 {
        self.container.length()
    }

    /// What is written to.
    pub const fn get_ref(&self) -> &W {
        self.container.get_ref()
    }

    /// Ends the log.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn close(self) -> io::Result<W> {
        self.container.close()
    }
}

/// Reads entries.
#[derive(Debug)]
pub struct LogReader<R> {
    container: ContainerReader<R>,
}

impl<R: Read> LogReader<R> {
    /// Opens a log.
    ///
    /// # Errors
    /// If it is none.
    pub fn new(input: R) -> Result<Self, LogError> {
        Ok(Self { container: ContainerReader::new(input)? })
    }

    /// The next entry and when it was; none at the end.
    ///
    /// # Errors
    /// If the log is damaged there; nothing behind it is worth reading.
    pub fn read(&mut self) -> Result<Option<(Instant, Entry)>, LogError> {
        loop {
            let offset = self.container.message_offset();
            let Some(message) = self.container.read()? else { return Ok(None) };
            match Entry::decode(message.topic, message.data) {
                Ok(Some(entry)) => return Ok(Some((message.at, entry))),
                Ok(None) => {}
                Err(EntryError::Nonsense(what)) => return Err(LogError::Damaged { offset, what }),
                Err(EntryError::Version(theirs)) => {
                    return Err(LogError::Version { theirs, ours: FORMAT });
                }
            }
        }
    }

    /// Bytes read so far.
    pub const fn offset(&self) -> u64 {
        self.container.offset()
    }

    /// How the log ends, once it has.
    pub const fn end(&self) -> Option<End> {
        self.container.end()
    }
}

#[cfg(test)]
#[path = "log_tests.rs"]
mod tests;
