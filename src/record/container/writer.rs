//! Logs written, a chunk at a time.

use std::io::{self, Write};

use super::{CHUNK_HEAD, CRC, MAGIC, PROFILE, PutRecord, Topic, code, tail};
use crate::record::bytes::Output;
use crate::time::Instant;

/// A chunk is closed when its content is longer than this, bytes.
const CHUNK_BYTES: usize = 64 << 10;

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

/// Zero stands for no schema.
fn id_of(topic: usize) -> u16 {
    u16::try_from(topic + 1).expect("there are few topics")
}
