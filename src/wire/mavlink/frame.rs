//! Framing: finds the frames in a stream of bytes, and makes them.

use super::common::MavMessage;
use super::signing::Signing;
use super::{Body, MavlinkVersion, Message};

/// First byte of a frame.
const STX_V1: u8 = 0xFE;
const STX_V2: u8 = 0xFD;
const HEADER_V1: usize = 6;
const HEADER_V2: usize = 10;
const CHECKSUM: usize = 2;
/// Link, time stamp and hash.
pub(super) const SIGNATURE: usize = 13;
/// The only incompatibility flag that is understood.
const FLAG_SIGNED: u8 = 1;
/// The longest frame.
pub const FRAME_MAX: usize = HEADER_V2 + 255 + CHECKSUM + SIGNATURE;

const X25: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_16_MCRF4XX);

/// Who sent a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Header {
    /// The system.
    pub system: u8,
    /// The part of it.
    pub component: u8,
    /// Counts the frames of that part, wrapping.
    pub sequence: u8,
}

/// The signature of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Signature {
    /// Which of the sender's links.
    pub link: u8,
    /// Tens of microseconds since the beginning of 2015.
    pub timestamp: u64,
    /// The first 48 bits of the hash.
    pub hash: [u8; 6],
}

/// A frame with a correct checksum.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    /// Framing that was used.
    pub version: MavlinkVersion,
    /// Who sent it.
    pub header: Header,
    /// Number of the message.
    pub id: u32,
    /// The message.
    pub payload: &'a [u8],
    /// Everything from the first byte to the checksum.
    pub(super) covered: &'a [u8],
    /// The signature, not yet checked.
    pub signature: Option<Signature>,
}

impl Frame<'_> {
    /// What it carries.
    pub fn body(&self) -> Body {
        Body::decode(self.version, self.id, self.payload)
    }
}

/// What a parser has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ParseCounts {
    /// Frames handed on.
    pub frames: u64,
    /// Bytes that belong to no frame.
    pub garbage_bytes: u64,
    /// What looked like a frame but for its checksum.
    pub wrong_checksums: u64,
}

/// Finds frames in bytes that come in pieces. Holds at most one unfinished frame.
#[derive(Clone, Debug)]
pub struct Parser {
    buffer: [u8; 2 * FRAME_MAX],
    filled: usize,
    counts: ParseCounts,
}

impl Default for Parser {
    fn default() -> Self {
        Self::new()
    }
}

/// What the bytes at hand begin with.
enum Look {
    /// More bytes are needed to say.
    Unfinished,
    /// No frame begins with the first byte.
    Garbage,
    /// A frame of so many bytes.
    Frame(usize),
}

impl Parser {
    /// A parser that has seen nothing.
    pub const fn new() -> Self {
        Self {
            buffer: [0; 2 * FRAME_MAX],
            filled: 0,
            counts: ParseCounts { frames: 0, garbage_bytes: 0, wrong_checksums: 0 },
        }
    }

    /// What it has seen.
    pub const fn counts(&self) -> &ParseCounts {
        &self.counts
    }

    /// Takes up bytes of a stream and hands out the frames that they complete.
    pub fn push(&mut self, mut bytes: &[u8], mut take: impl FnMut(Frame<'_>)) {
        while !bytes.is_empty() {
            let piece = bytes.len().min(self.buffer.len() - self.filled);
            self.buffer[self.filled..self.filled + piece].copy_from_slice(&bytes[..piece]);
            self.filled += piece;
            bytes = &bytes[piece..];
            self.scan(false, &mut take);
        }
    }

    /// Takes up a datagram: what begins in it ends in it.
    pub fn push_datagram(&mut self, bytes: &[u8], mut take: impl FnMut(Frame<'_>)) {
        self.push(bytes, &mut take);
        self.scan(true, &mut take);
    }

    fn scan(&mut self, is_all: bool, take: &mut impl FnMut(Frame<'_>)) {
        let mut at = 0;
        while at < self.filled {
            let bytes = &self.buffer[at..self.filled];
            match look(bytes, &mut self.counts) {
                Look::Frame(length) => {
                    self.counts.frames += 1;
                    take(frame(&bytes[..length]));
                    at += length;
                }
                Look::Unfinished if !is_all => break,
                Look::Unfinished | Look::Garbage => {
                    self.counts.garbage_bytes += 1;
                    at += 1;
                }
            }
        }
        self.buffer.copy_within(at..self.filled, 0);
        self.filled -= at;
    }
}

fn look(bytes: &[u8], counts: &mut ParseCounts) -> Look {
    let byte = |at: usize| bytes.get(at).copied();
    let (header, id, signature) = match byte(0) {
        Some(STX_V1) => {
            let Some(id) = byte(5) else { return Look::Unfinished };
            (HEADER_V1, u32::from(id), 0)
        }
        Some(STX_V2) => {
            // A flag that is not understood means that the rest cannot be either.
            match byte(2) {
                Some(flags) if flags & !FLAG_SIGNED != 0 => return Look::Garbage,
                _ => {}
            }
            let (Some(a), Some(b), Some(c)) = (byte(7), byte(8), byte(9)) else {
                return Look::Unfinished;
            };
            let signed = bytes[2] & FLAG_SIGNED != 0;
            (HEADER_V2, u32::from_le_bytes([a, b, c, 0]), if signed { SIGNATURE } else { 0 })
        }
        _ => return Look::Garbage,
    };
    // Without its definition a message cannot be checked; its length is not to be believed then.
    if MavMessage::default_message_from_id(id).is_none() {
        return Look::Garbage;
    }
    let covered = header + usize::from(bytes[1]);
    let length = covered + CHECKSUM + signature;
    if bytes.len() < length {
        return Look::Unfinished;
    }
    let sent = u16::from_le_bytes([bytes[covered], bytes[covered + 1]]);
    if checksum(&bytes[1..covered], id) != sent {
        counts.wrong_checksums += 1;
        return Look::Garbage;
    }
    Look::Frame(length)
}

fn checksum(covered: &[u8], id: u32) -> u16 {
    let mut digest = X25.digest();
    digest.update(covered);
    digest.update(&[MavMessage::extra_crc(id)]);
    digest.finalize()
}

/// The parts of a whole frame whose checksum is correct.
fn frame(bytes: &[u8]) -> Frame<'_> {
    let payload_length = usize::from(bytes[1]);
    if bytes[0] == STX_V1 {
        return Frame {
            version: MavlinkVersion::V1,
            header: Header { sequence: bytes[2], system: bytes[3], component: bytes[4] },
            id: u32::from(bytes[5]),
            payload: &bytes[HEADER_V1..HEADER_V1 + payload_length],
            covered: &bytes[..HEADER_V1 + payload_length + CHECKSUM],
            signature: None,
        };
    }
    let end = HEADER_V2 + payload_length;
    let signature = bytes.get(end + CHECKSUM..end + CHECKSUM + SIGNATURE).map(|s| Signature {
        link: s[0],
        timestamp: u64::from_le_bytes([s[1], s[2], s[3], s[4], s[5], s[6], 0, 0]),
        hash: [s[7], s[8], s[9], s[10], s[11], s[12]],
    });
    Frame {
        version: MavlinkVersion::V2,
        header: Header { sequence: bytes[4], system: bytes[5], component: bytes[6] },
        id: u32::from_le_bytes([bytes[7], bytes[8], bytes[9], 0]),
        payload: &bytes[HEADER_V2..end],
        covered: &bytes[..end + CHECKSUM],
        signature,
    }
}

/// A MAVLink 2 frame; signed with a time stamp after `now` (see [`Signing::sign`]) if there is a
/// key.
pub fn encode(header: Header, body: &Body, signing: Option<(&mut Signing, u8, u64)>) -> Vec<u8> {
    let mut bytes = vec![0; HEADER_V2 + 255];
    let length = match body {
        Body::Message(message) => message.ser(MavlinkVersion::V2, &mut bytes[HEADER_V2..]),
        Body::Raw(raw) => {
            let payload = &raw.payload[..raw.payload.len().min(255)];
            bytes[HEADER_V2..HEADER_V2 + payload.len()].copy_from_slice(payload);
            payload.len()
        }
    };
    bytes.truncate(HEADER_V2 + length);
    let id = body.id().to_le_bytes();
    let flags = if signing.is_some() { FLAG_SIGNED } else { 0 };
    bytes[..HEADER_V2].copy_from_slice(&[
        STX_V2,
        length as u8,
        flags,
        0,
        header.sequence,
        header.system,
        header.component,
        id[0],
        id[1],
        id[2],
    ]);
    let sum = checksum(&bytes[1..], body.id());
    bytes.extend(sum.to_le_bytes());
    if let Some((signing, link, now)) = signing {
        let signature = signing.sign(&bytes, link, now);
        bytes.extend(signature);
    }
    bytes
}
