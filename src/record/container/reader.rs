//! Logs read, a chunk at a time, as far as they are whole.

use std::io::{self, Read};

use super::{CHUNK_HEAD, CONTENT_MAX, CRC, LogError, MAGIC, PROFILE, code, tail};
use crate::record::bytes::Input;
use crate::time::Instant;

/// No header is longer than this, bytes.
const HEADER_MAX: u64 = 1024;

/// One message.
#[derive(Clone, Debug, PartialEq)]
pub struct Message<'a> {
    /// Name of its topic.
    pub topic: &'a str,
    /// When.
    pub at: Instant,
    /// What.
    pub data: &'a [u8],
}

/// How a log ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// As it should.
    Closed,
    /// In the middle of something: its writer was killed, or still writes.
    CutOff {
        /// Where the unfinished part begins.
        offset: u64,
    },
}

/// Reads a log, chunk by chunk.
#[derive(Debug)]
pub struct ContainerReader<R> {
    input: R,
    /// Where the next record begins.
    offset: u64,
    content: Vec<u8>,
    /// Where in the content the next record begins.
    at: usize,
    /// Where the chunk begins, and its content.
    chunk_offset: u64,
    content_offset: u64,
    /// Earliest and latest time of the chunk's messages, as it says and as they say.
    times: [Option<[u64; 2]>; 2],
    channels: Vec<(u16, String)>,
    end: Option<End>,
}

/// How much of what was wanted could be read.
enum Got {
    All,
    Part,
}

impl<R: Read> ContainerReader<R> {
    /// Opens a log.
    ///
    /// # Errors
    /// If it is none.
    pub fn new(mut input: R) -> Result<Self, LogError> {
        let mut begin = [0; MAGIC.len() + 9];
        if matches!(fill(&mut input, &mut begin)?, Got::Part) || begin[..8] != MAGIC {
            return Err(LogError::NotALog);
        }
        let length = u64::from_le_bytes(begin[9..].try_into().expect("eight bytes"));
        if begin[8] != code::HEADER || length > HEADER_MAX {
            return Err(LogError::NotALog);
        }
        let mut header = vec![0; length as usize];
        if matches!(fill(&mut input, &mut header)?, Got::Part) {
            return Err(LogError::NotALog);
        }
        let mut fields = Input::new(&header);
        if fields.text() != Some(PROFILE) || fields.text().is_none() || !fields.is_empty() {
            return Err(LogError::NotALog);
        }
        Ok(Self {
            input,
            offset: begin.len() as u64 + length,
            content: Vec::new(),
            at: 0,
            chunk_offset: 0,
            content_offset: 0,
            times: [None; 2],
            channels: Vec::new(),
            end: None,
        })
    }

    /// Bytes read so far.
    pub const fn offset(&self) -> u64 {
        self.offset
    }

    /// Where the next message begins, or the chunk that holds it.
    pub const fn message_offset(&self) -> u64 {
        if self.at == self.content.len() {
            self.offset
        } else {
            self.content_offset + self.at as u64
        }
    }

    /// The next message; none at the end of the log, which [`end`](Self::end) tells more about.
    ///
    /// # Errors
    /// If the log is damaged there; nothing behind it is worth reading.
    pub fn read(&mut self) -> Result<Option<Message<'_>>, LogError> {
        let (channel, at, data) = loop {
            if self.end.is_some() {
                return Ok(None);
            }
            if self.at == self.content.len() {
                self.finish_chunk()?;
                self.read_chunk()?;
                continue;
            }
            if let Some(found) = self.read_message()? {
                break found;
            }
        };
        let found = self.channels.iter().find(|(id, _)| *id == channel);
        let Some((_, topic)) = found else {
            return Err(self.damaged(format!("a message on channel {channel}, which is unknown")));
        };
        Ok(Some(Message { topic, at, data: &self.content[data] }))
    }

    /// How the log ends, once it has.
    pub const fn end(&self) -> Option<End> {
        self.end
    }

    /// The next record within the chunk, if it is a message.
    fn read_message(&mut self) -> Result<Option<(u16, Instant, std::ops::Range<usize>)>, LogError> {
        let mut fields = Input::new(&self.content[self.at..]);
        let whole = fields.len();
        let record = fields.u8().zip(fields.u64()).and_then(|(kind, length)| {
            let length = usize::try_from(length).ok()?;
            Some((kind, fields.take(length)?))
        });
        let Some((kind, body)) = record else {
            return Err(self.damaged("a record is longer than its chunk".into()));
        };
        let end = self.at + (whole - fields.len());
        let mut fields = Input::new(body);
        match kind {
            code::MESSAGE => {
                let head = fields.u16().zip(fields.u32()).zip(fields.u64()).zip(fields.u64());
                let Some((((channel, _sequence), nanos), _)) = head else {
                    return Err(self.damaged("a message is too short".into()));
                };
                let [first, last] = self.times[1].unwrap_or([nanos; 2]);
                self.times[1] = Some([first.min(nanos), last.max(nanos)]);
                let data = end - fields.len()..end;
                self.at = end;
                return Ok(Some((channel, Instant::from_nanos(nanos), data)));
            }
            code::CHANNEL => {
                let channel = fields.u16().zip(fields.u16()).zip(fields.text());
                let Some(((id, _), topic)) = channel else {
                    return Err(self.damaged("a channel is too short".into()));
                };
                let topic = topic.to_owned();
                self.channels.retain(|(other, _)| *other != id);
                self.channels.push((id, topic));
            }
            // A reader passes over what it does not know, the format says.
            _ => {}
        }
        self.at = end;
        Ok(None)
    }

    /// The chunk has been read: its head must have told the truth.
    fn finish_chunk(&mut self) -> Result<(), LogError> {
        let [said, found] = std::mem::take(&mut self.times);
        if said == found.or(said) {
            return Ok(());
        }
        let what = "a chunk's times are not those of its messages".into();
        Err(LogError::Damaged { offset: self.chunk_offset, what })
    }

    /// The next chunk, or the end.
    fn read_chunk(&mut self) -> Result<(), LogError> {
        let begin = self.offset;
        let damaged = |what: &str| LogError::Damaged { offset: begin, what: what.into() };
        let mut kind = [0];
        if matches!(fill(&mut self.input, &mut kind)?, Got::Part) {
            self.end = Some(End::CutOff { offset: begin });
            return Ok(());
        }
        if kind[0] == code::DATA_END {
            return self.read_tail();
        }
        if kind[0] != code::CHUNK {
            return Err(damaged("neither a chunk nor the end"));
        }
        let mut head = [0; 8 + CHUNK_HEAD];
        if matches!(fill(&mut self.input, &mut head)?, Got::Part) {
            self.end = Some(End::CutOff { offset: begin });
            return Ok(());
        }
        let mut fields = Input::new(&head);
        let mut number = || fields.u64().expect("the head is long enough");
        let (record, first, last, length) = (number(), number(), number(), number());
        let crc = fields.u32().expect("the head is long enough");
        let compression = fields.u32().expect("the head is long enough");
        let again = fields.u64().expect("the head is long enough");
        if compression != 0 {
            return Err(damaged("a chunk is compressed, or its head is damaged"));
        }
        if length != again || record.checked_sub(CHUNK_HEAD as u64) != Some(length) {
            return Err(damaged("a chunk's lengths contradict each other"));
        }
        if length > CONTENT_MAX as u64 {
            return Err(damaged(&format!("a chunk of {length} bytes, allowed are {CONTENT_MAX}")));
        }
        self.content.clear();
        self.at = 0;
        // Memory is taken for what is there, not for what is announced.
        let got = self.input.by_ref().take(length).read_to_end(&mut self.content)?;
        if (got as u64) < length {
            self.content.clear();
            self.end = Some(End::CutOff { offset: begin });
            return Ok(());
        }
        if CRC.checksum(&self.content) != crc {
            self.content.clear();
            return Err(damaged("a chunk's content is not what its checksum says"));
        }
        self.chunk_offset = begin;
        self.content_offset = begin + 1 + head.len() as u64;
        self.offset = self.content_offset + length;
        self.times[0] = Some([first, last]);
        Ok(())
    }

    fn read_tail(&mut self) -> Result<(), LogError> {
        let begin = self.offset;
        let wanted = &tail()[1..];
        let mut rest = Vec::new();
        // One byte more than there may be.
        self.input.by_ref().take(wanted.len() as u64 + 1).read_to_end(&mut rest)?;
        if rest == wanted {
            self.offset += 1 + rest.len() as u64;
            self.end = Some(End::Closed);
        } else if wanted.starts_with(&rest) {
            self.end = Some(End::CutOff { offset: begin });
        } else {
            let what = "the end is not what it must be".into();
            return Err(LogError::Damaged { offset: begin, what });
        }
        Ok(())
    }

    fn damaged(&self, what: String) -> LogError {
        LogError::Damaged { offset: self.content_offset + self.at as u64, what }
    }
}

/// Reads as much as there is, at most to the end of the buffer.
fn fill(input: &mut impl Read, buffer: &mut [u8]) -> io::Result<Got> {
    let mut done = 0;
    while done < buffer.len() {
        match input.read(&mut buffer[done..]) {
            Ok(0) => return Ok(Got::Part),
            Ok(n) => done += n,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(Got::All)
}
