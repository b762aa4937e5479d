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

use std::io;

use crc::{CRC_32_ISO_HDLC, Crc};

use super::bytes::Output;

mod reader;
mod writer;

pub use reader::{ContainerReader, End};
pub use writer::ContainerWriter;

/// How every MCAP file begins and ends.
pub const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// What the header calls the contents: the channels of [`super::Entry`].
pub const PROFILE: &str = "apexd";
/// No content of a chunk is longer than this, bytes: one message may be a map.
pub const CONTENT_MAX: usize = 64 << 20;
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

/// Everything behind the last chunk.
fn tail() -> Vec<u8> {
    let mut end = Vec::new();
    end.put_record(code::DATA_END, &[0; 4]); // every chunk has a CRC of its own
    end.put_record(code::FOOTER, &[0; 20]); // no summary
    end.extend_from_slice(&MAGIC);
    end
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
    use super::reader::Message;
    use super::*;
    use crate::time::Instant;

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
