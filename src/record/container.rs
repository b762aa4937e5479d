//! The container of a log: the part of MCAP (<https://mcap.dev/spec>) that a stream needs.
//!
//! ```text
//! magic, Header, Chunk, Chunk, ..., Chunk, DataEnd, Footer, magic
//! ```
//!
//! A chunk is written at once and carries the CRC of its content, so a log whose writer was killed
//! reads up to its last whole chunk. There is no summary (the format leaves it to the writer): it
//! would cost 16 bytes a message, and `mcap recover` makes one where it is wanted. Nothing is
//! compressed.

use std::io::{self, Read, Write};

use crc::{CRC_32_ISO_HDLC, Crc};

use super::bytes::{Input, Output};
use crate::time::Instant;

/// How every MCAP file begins and ends.
pub const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// What the header calls the contents: the channels of [`super::Entry`].
pub const PROFILE: &str = "apexd";
/// A chunk is closed when its content is longer than this, bytes.
const CHUNK_BYTES: usize = 64 << 10;
/// No content of a chunk is longer than this, bytes: one message may be a map.
pub const CONTENT_MAX: usize = 64 << 20;
/// No header is longer than this, bytes.
const HEADER_MAX: u64 = 1024;
/// A chunk's content stands behind this many bytes: start, end, length, CRC, an empty name of a
/// compression, length again.
const CHUNK_HEAD: usize = 8 + 8 + 8 + 4 + 4 + 8;

static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

mod code {
    pub const HEADER: u8 = 0x01;
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const DATA_END: u8 = 0x0F;
}

/// Why a log cannot be read, or not any further.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// It cannot be read at all.
    #[error("cannot read the log: {0}")]
    Io(#[from] io::Error),
    /// It is something else.
    #[error("this is no log of apexd: it does not begin as one")]
    NotALog,
    /// Something in it is not as it was written.
    #[error("the log is damaged at byte {offset}: {what}")]
    Damaged {
        /// Where the damaged part begins.
        offset: u64,
        /// What does not fit.
        what: String,
    },
    /// It was written by a version that says things this one does not know.
    #[error("the log has format {theirs}, this version reads format {ours}")]
    Version {
        /// The log's.
        theirs: u32,
        /// Ours.
        ours: u32,
    },
}

/// Something that messages are about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Its name.
    pub name: &'static str,
    /// How its messages are written.
    pub encoding: &'static str,
    /// JSON schema of its messages, for readers that draw them; empty if they are not JSON.
    pub schema: &'static str,
}

/// Writes a log. What has been handed over is kept until a chunk is full or it is
/// [flushed](Self::flush).
#[derive(Debug)]
pub struct ContainerWriter<W> {
    out: W,
    content: Vec<u8>,
    /// Earliest and latest time of the chunk's messages, nanoseconds.
    times: Option<[u64; 2]>,
    sequences: Vec<u32>,
    written: u64,
}

impl<W: Write> ContainerWriter<W> {
    /// Begins a log with these topics, which are known by their place in the list from then on.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn new(mut out: W, topics: &[Topic]) -> io::Result<Self> {
        let mut header = Vec::new();
        header.put_text(PROFILE);
        header.put_text(concat!("apexd ", env!("CARGO_PKG_VERSION")));
        let mut begin = MAGIC.to_vec();
        begin.put_record(code::HEADER, &header);
        out.write_all(&begin)?;
        let mut content = Vec::with_capacity(2 * CHUNK_BYTES);
        for (i, topic) in topics.iter().enumerate() {
            let id = id_of(i);
            let schema_id = if topic.schema.is_empty() { 0 } else { id };
            if schema_id > 0 {
                let mut schema = Vec::new();
                schema.put_u16(schema_id);
                schema.put_text(topic.name);
                schema.put_text("jsonschema");
                schema.put_text(topic.schema);
                content.put_record(code::SCHEMA, &schema);
            }
            let mut channel = Vec::new();
            channel.put_u16(id);
            channel.put_u16(schema_id);
            channel.put_text(topic.name);
            channel.put_text(topic.encoding);
            channel.put_u32(0); // nothing more to say about it
            content.put_record(code::CHANNEL, &channel);
        }
        let written = begin.len() as u64;
        Ok(Self { out, content, times: None, sequences: vec![0; topics.len()], written })
    }

    /// Appends a message about the topic at a place of the list.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn put(&mut self, topic: usize, at: Instant, data: &[u8]) -> io::Result<()> {
        let sequence = &mut self.sequences[topic];
        let nanos = at.as_nanos();
        self.content.push(code::MESSAGE);
        self.content.put_u64(22 + data.len() as u64);
        self.content.put_u16(id_of(topic));
        self.content.put_u32(*sequence);
        self.content.put_u64(nanos);
        self.content.put_u64(nanos);
        self.content.extend_from_slice(data);
        *sequence = sequence.wrapping_add(1);
        let [first, last] = self.times.unwrap_or([nanos; 2]);
        self.times = Some([first.min(nanos), last.max(nanos)]);
        if self.content.len() >= CHUNK_BYTES { self.flush() } else { Ok(()) }
    }

    /// Writes what has been kept.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn flush(&mut self) -> io::Result<()> {
        let Some([first, last]) = self.times.take() else { return Ok(()) };
        let length = self.content.len() as u64;
        let mut chunk = Vec::with_capacity(9 + CHUNK_HEAD + self.content.len());
        chunk.push(code::CHUNK);
        chunk.put_u64(CHUNK_HEAD as u64 + length);
        chunk.put_u64(first);
        chunk.put_u64(last);
        chunk.put_u64(length);
        chunk.put_u32(CRC.checksum(&self.content));
        chunk.put_text(""); // not compressed
        chunk.put_u64(length);
        chunk.extend_from_slice(&self.content);
        self.content.clear();
        self.out.write_all(&chunk)?;
        self.out.flush()?;
        self.written += chunk.len() as u64;
        Ok(())
    }

    /// Bytes so far, with what is still kept.
    pub fn length(&self) -> u64 {
        self.written + self.content.len() as u64
    }

    /// What is written to.
    pub const fn get_ref(&self) -> &W {
        &self.out
    }

    /// Ends the log.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn close(mut self) -> io::Result<W> {
        self.flush()?;
        self.out.write_all(&tail())?;
        self.out.flush()?;
        Ok(self.out)
    }
}

/// Everything behind the last chunk.
fn tail() -> Vec<u8> {
    let mut end = Vec::new();
    end.put_record(code::DATA_END, &[0; 4]); // every chunk has a CRC of its own
    end.put_record(code::FOOTER, &[0; 20]); // no summary
    end.extend_from_slice(&MAGIC);
    end
}

/// Zero stands for no schema.
fn id_of(topic: usize) -> u16 {
    u16::try_from(topic + 1).expect("there are few topics")
}

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

trait PutRecord {
    fn put_record(&mut self, kind: u8, body: &[u8]);
}

impl PutRecord for Vec<u8> {
    fn put_record(&mut self, kind: u8, body: &[u8]) {
        self.push(kind);
        self.put_u64(body.len() as u64);
        self.extend_from_slice(body);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_of_others_do_no_harm() {
        let topics = [
            Topic { name: "/a", encoding: "x", schema: "" },
            Topic { name: "/b", encoding: "json", schema: "{}" },
        ];
        let mut log = ContainerWriter::new(Vec::new(), &topics).unwrap();
        let at = Instant::from_nanos;
        log.put(1, at(5), b"{}").unwrap();
        log.put(0, at(3), b"").unwrap();
        let bytes = log.close().unwrap();
        let mut reader = ContainerReader::new(&*bytes).unwrap();
        let message = reader.read().unwrap().unwrap();
        assert_eq!(message, Message { topic: "/b", at: at(5), data: b"{}" });
        let message = reader.read().unwrap().unwrap();
        assert_eq!(message, Message { topic: "/a", at: at(3), data: b"" });
        assert_eq!(reader.read().unwrap(), None);
        assert_eq!(reader.read().unwrap(), None, "again");
        assert_eq!((reader.end(), reader.offset()), (Some(End::Closed), bytes.len() as u64));
    }
}
