//! The file transfer protocol: lists and reads, never writes.
//!
//! What can be read lies on a [`Shelf`] that the shell fills: the component metadata and the folder
//! of logs. Names are looked at here and again there; none leads out of it.

use std::collections::VecDeque;

use super::ftp_sessions::Sessions;
use super::metadata::{Crc, Metadata};
use super::outbox::{Outbox, Peer};
use super::service::Service;
use crate::time::{Duration, Instant};
use crate::wire::mavlink::common::{
    self as c, MavFtpErr as Fault, MavFtpOpcode as Op, MavMessage, MavProtocolCapability,
};
use crate::wire::mavlink::{CharArray, MessageData};

/// Bytes before the data of a packet.
const HEADER: usize = 12;
/// Most bytes of data in a packet.
const DATA: usize = 239;
/// Bytes of a packet on the wire.
const PACKET_BYTES: f64 = 266.0;
/// Longest name.
const PATH_MAX: usize = 200;
/// Answers that are remembered for repetitions.
const ANSWERS_MAX: usize = 64;
/// A repetition later than this is a question of its own.
const REPEAT: Duration = Duration::from_secs(10);
/// Packets of one burst.
const BURST_MAX: u32 = 400;
/// Bursts under way.
const BURSTS_MAX: usize = 16;
/// Room that a burst leaves in the queue of messages.
const ROOM_LEFT: usize = 256;
/// Time between two looks at bursts under way.
const TICK: Duration = Duration::from_millis(10);
/// The largest file that a checksum is made of, bytes.
const CRC_BYTES_MAX: u64 = 16 << 20;

/// What lies in a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ShelfEntry {
    /// A file and its size, bytes.
    File(String, u64),
    /// A folder.
    Folder(String),
}

/// Why something on the shelf cannot be had.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ShelfFault {
    /// There is none of that name.
    #[error("there is no such file")]
    NotFound,
    /// It cannot be read.
    #[error("it cannot be read")]
    Unreadable,
}

/// A file that is open.
pub trait Volume: Send {
    /// Its size, bytes.
    fn size(&self) -> u64;

    /// Fills `into` from `offset` on; says how many bytes there were.
    ///
    /// # Errors
    /// If it cannot be read.
    fn read(&mut self, offset: u64, into: &mut [u8]) -> Result<usize, ShelfFault>;
}

impl Volume for std::io::Cursor<Vec<u8>> {
    fn size(&self) -> u64 {
        self.get_ref().len() as u64
    }

    fn read(&mut self, offset: u64, into: &mut [u8]) -> Result<usize, ShelfFault> {
        let bytes = self.get_ref();
        let rest = usize::try_from(offset).ok().and_then(|at| bytes.get(at..)).unwrap_or(&[]);
        let count = rest.len().min(into.len());
        into[..count].copy_from_slice(&rest[..count]);
        Ok(count)
    }
}

/// Folders and files that may be read. Names are given in parts, none of which is empty, `.`, `..`
/// or holds a slash or a zero byte.
pub trait Shelf: Send {
    /// What is in a folder, in a fixed order.
    ///
    /// # Errors
    /// If there is no such folder.
    fn list(&self, folder: &[&str]) -> Result<Vec<ShelfEntry>, ShelfFault>;

    /// Opens a file.
    ///
    /// # Errors
    /// If there is no such file.
    fn open(&self, file: &[&str]) -> Result<Box<dyn Volume>, ShelfFault>;
}

/// A question.
#[derive(Clone, Debug)]
struct Packet {
    seq: u16,
    session: u8,
    opcode: u8,
    size: usize,
    offset: u32,
    data: Vec<u8>,
}

impl Packet {
    fn of(payload: &[u8; 251]) -> Self {
        let size = usize::from(payload[4]);
        Self {
            seq: u16::from_le_bytes([payload[0], payload[1]]),
            session: payload[2],
            opcode: payload[3],
            size,
            offset: u32::from_le_bytes([payload[8], payload[9], payload[10], payload[11]]),
            data: payload[HEADER..].get(..size).unwrap_or(&[]).to_vec(),
        }
    }
}

/// An answer, without the packet's own numbers.
#[derive(Clone, Debug)]
struct Answer {
    session: u8,
    opcode: Op,
    offset: u32,
    burst_complete: bool,
    data: Vec<u8>,
}

/// A file, or a part of it, being sent in one go.
struct Burst {
    peer: Peer,
    session: u8,
    seq: u16,
    offset: u32,
    size: usize,
    left: u32,
    credit: f64,
    filled: Instant,
}

/// The file service.
pub struct Ftp {
    shelf: Box<dyn Shelf>,
    metadata: Metadata,
    sessions: Sessions,
    bursts: Vec<Burst>,
    answers: VecDeque<(Instant, Peer, Packet, [u8; 251])>,
}

impl Ftp {
    /// Serves what is on the shelf, besides the metadata.
    pub fn new(shelf: Box<dyn Shelf>) -> Self {
        Self {
            shelf,
            metadata: Metadata::default(),
            sessions: Sessions::default(),
            bursts: Vec::new(),
            answers: VecDeque::new(),
        }
    }

    /// Files that are open.
    pub fn open_files(&self) -> usize {
        self.sessions.count()
    }

    fn list(&self, packet: &Packet) -> Result<Vec<u8>, Fault> {
        let parts = parts_of(&packet.data)?;
        let mut entries = if parts.is_empty() {
            let file = |(name, bytes): &(&str, Vec<u8>)| {
                ShelfEntry::File((*name).to_owned(), bytes.len() as u64)
            };
            self.metadata.files.iter().map(file).collect()
        } else {
            Vec::new()
        };
        entries.extend(self.shelf.list(&parts).map_err(fault_of)?);
        let mut data = Vec::new();
        for entry in entries.iter().skip(packet.offset as usize) {
            let line = match entry {
                ShelfEntry::File(name, size) => format!("F{name}\t{size}\0"),
                ShelfEntry::Folder(name) => format!("D{name}\0"),
            };
            // A name that fits no packet is passed over as what it is: not for this protocol.
            let line = if line.len() > DATA { "S\0".to_owned() } else { line };
            if data.len() + line.len() > DATA {
                break;
            }
            data.extend(line.into_bytes());
        }
        if data.is_empty() { Err(Fault::MAV_FTP_ERR_EOF) } else { Ok(data) }
    }

    fn open(&self, path: &[u8]) -> Result<Box<dyn Volume>, Fault> {
        let parts = parts_of(path)?;
        if let [name] = parts[..]
            && let Some((_, bytes)) = self.metadata.files.iter().find(|(own, _)| *own == name)
        {
            return Ok(Box::new(std::io::Cursor::new(bytes.clone())));
        }
        if parts.is_empty() {
            return Err(Fault::MAV_FTP_ERR_FILENOTFOUND);
        }
        self.shelf.open(&parts).map_err(fault_of)
    }

    fn checksum(&self, path: &[u8]) -> Result<u32, Fault> {
        let mut volume = self.open(path)?;
        if volume.size() > CRC_BYTES_MAX {
            return Err(Fault::MAV_FTP_ERR_FAIL);
        }
        let (mut crc, mut at, mut piece) = (Crc::default(), 0, vec![0; 1 << 16]);
        while at < CRC_BYTES_MAX {
            let count = volume.read(at, &mut piece).map_err(fault_of)?;
            if count == 0 {
                break;
            }
            crc.update(&piece[..count]);
            at += count as u64;
        }
        Ok(crc.finish())
    }

    fn read(&mut self, now: Instant, peer: Peer, packet: &Packet) -> Result<Vec<u8>, Fault> {
        let session = self.sessions.get(now, peer, packet.session);
        let session = session.ok_or(Fault::MAV_FTP_ERR_INVALIDSESSION)?;
        piece(&mut *session.volume, packet.offset, packet.size)
    }

    /// Answers a question; a burst is answered later.
    fn answer(&mut self, now: Instant, peer: Peer, packet: &Packet) -> Option<Answer> {
        let mut session = packet.session;
        let is = |op: Op| packet.opcode == op as u8;
        let result = if packet.size > DATA {
            Err(Fault::MAV_FTP_ERR_INVALIDDATASIZE)
        } else if is(Op::MAV_FTP_OPCODE_NONE) {
            Ok(Vec::new())
        } else if is(Op::MAV_FTP_OPCODE_TERMINATESESSION) {
            self.stop_bursts(peer, Some(packet.session));
            match self.sessions.close(peer, packet.session) {
                true => Ok(Vec::new()),
                false => Err(Fault::MAV_FTP_ERR_INVALIDSESSION),
            }
        } else if is(Op::MAV_FTP_OPCODE_RESETSESSION) {
            self.stop_bursts(peer, None);
            self.sessions.reset(peer);
            Ok(Vec::new())
        } else if is(Op::MAV_FTP_OPCODE_LISTDIRECTORY) {
            self.list(packet)
        } else if is(Op::MAV_FTP_OPCODE_OPENFILERO) {
            self.open(&packet.data).and_then(|volume| {
                let size = u32::try_from(volume.size()).map_err(|_| Fault::MAV_FTP_ERR_FAIL)?;
                session = self
                    .sessions
                    .open(now, peer, volume)
                    .ok_or(Fault::MAV_FTP_ERR_NOSESSIONSAVAILABLE)?;
                Ok(size.to_le_bytes().to_vec())
            })
        } else if is(Op::MAV_FTP_OPCODE_READFILE) {
            self.read(now, peer, packet)
        } else if is(Op::MAV_FTP_OPCODE_CALCFILECRC) {
            self.checksum(&packet.data).map(|crc| crc.to_le_bytes().to_vec())
        } else if is(Op::MAV_FTP_OPCODE_BURSTREADFILE) {
            match self.begin_burst(now, peer, packet) {
                Ok(()) => return None,
                Err(fault) => Err(fault),
            }
        } else if packet.opcode <= Op::MAV_FTP_OPCODE_RENAME as u8 {
            // Everything else that the protocol has, writes.
            Err(Fault::MAV_FTP_ERR_FILEPROTECTED)
        } else {
            Err(Fault::MAV_FTP_ERR_UNKNOWNCOMMAND)
        };
        let (opcode, data) = match result {
            Ok(data) => (Op::MAV_FTP_OPCODE_ACK, data),
            Err(fault) => (Op::MAV_FTP_OPCODE_NAK, vec![fault as u8]),
        };
        Some(Answer { session, opcode, offset: packet.offset, burst_complete: false, data })
    }

    fn begin_burst(&mut self, now: Instant, peer: Peer, packet: &Packet) -> Result<(), Fault> {
        if self.sessions.get(now, peer, packet.session).is_none() {
            return Err(Fault::MAV_FTP_ERR_INVALIDSESSION);
        }
        self.stop_bursts(peer, Some(packet.session));
        if self.bursts.len() >= BURSTS_MAX {
            return Err(Fault::MAV_FTP_ERR_NOSESSIONSAVAILABLE);
        }
        self.bursts.push(Burst {
            peer,
            session: packet.session,
            seq: packet.seq,
            offset: packet.offset,
            size: if packet.size == 0 { DATA } else { packet.size },
            left: BURST_MAX,
            credit: 4.0,
            filled: now,
        });
        Ok(())
    }

    fn stop_bursts(&mut self, peer: Peer, session: Option<u8>) {
        let other = |burst: &Burst| {
            burst.peer != peer || session.is_some_and(|number| burst.session != number)
        };
        self.bursts.retain(other);
    }

    /// Sends as much of a burst as may be sent now; says whether there is more.
    fn go_on(&mut self, now: Instant, burst: &mut Burst, out: &mut Outbox) -> bool {
        let rate = out.transfer_rate(burst.peer.channel) / PACKET_BYTES;
        burst.credit += now.seconds_after(burst.filled).max(0.0) * rate;
        // What was not sent in time is not sent all at once later.
        burst.credit = burst.credit.min((rate * 0.1).max(1.0));
        burst.filled = now;
        while burst.credit >= 1.0 && out.room() > ROOM_LEFT {
            burst.credit -= 1.0;
            burst.left -= 1;
            let result = match self.sessions.get(now, burst.peer, burst.session) {
                Some(session) => piece(&mut *session.volume, burst.offset, burst.size),
                None => Err(Fault::MAV_FTP_ERR_INVALIDSESSION),
            };
            let last = burst.left == 0 || result.is_err();
            let (opcode, data) = match result {
                Ok(data) => (Op::MAV_FTP_OPCODE_ACK, data),
                Err(fault) => (Op::MAV_FTP_OPCODE_NAK, vec![fault as u8]),
            };
            let length = data.len() as u32;
            let session = burst.session;
            let answer =
                Answer { session, opcode, offset: burst.offset, burst_complete: last, data };
            burst.seq = burst.seq.wrapping_add(1);
            let payload = payload_of(&answer, burst.seq, Op::MAV_FTP_OPCODE_BURSTREADFILE as u8);
            send(burst.peer, payload, out);
            burst.offset = burst.offset.saturating_add(length);
            if last {
                return false;
            }
        }
        true
    }
}

impl Service for Ftp {
    fn handle(&mut self, now: Instant, from: Peer, message: &MavMessage, out: &mut Outbox) {
        let MavMessage::FILE_TRANSFER_PROTOCOL(data) = message else { return };
        let packet = Packet::of(&data.payload);
        // Answers of others, sent to all.
        if packet.opcode >= Op::MAV_FTP_OPCODE_ACK as u8 {
            return;
        }
        let again = self.answers.iter().rev().find(|(at, peer, asked, _)| {
            now.since(*at) < REPEAT && *peer == from && is_same(asked, &packet)
        });
        if let Some((.., payload)) = again {
            return send(from, *payload, out);
        }
        let Some(answer) = self.answer(now, from, &packet) else {
            return self.handle_time(now, out);
        };
        let payload = payload_of(&answer, packet.seq.wrapping_add(1), packet.opcode);
        if self.answers.len() >= ANSWERS_MAX {
            self.answers.pop_front();
        }
        self.answers.push_back((now, from, packet, payload));
        send(from, payload, out);
    }

    fn handle_time(&mut self, now: Instant, out: &mut Outbox) {
        self.sessions.expire(now);
        let mut bursts = std::mem::take(&mut self.bursts);
        bursts.retain_mut(|burst| self.go_on(now, burst, out));
        self.bursts = bursts;
    }

    fn poll_at(&self) -> Option<Instant> {
        self.bursts.iter().map(|burst| burst.filled + TICK).min()
    }

    fn capabilities(&self) -> MavProtocolCapability {
        MavProtocolCapability::MAV_PROTOCOL_CAPABILITY_FTP
    }

    fn message(&self, id: u32) -> Option<MavMessage> {
        (id == c::COMPONENT_METADATA_DATA::ID).then(|| {
            MavMessage::COMPONENT_METADATA(c::COMPONENT_METADATA_DATA {
                time_boot_ms: 0,
                file_crc: self.metadata.crc(),
                uri: CharArray::from(Metadata::uri().as_str()),
            })
        })
    }
}

/// Whether a question is one that has been answered. A number alone does not say: they wrap, and
/// begin anew with every program.
fn is_same(a: &Packet, b: &Packet) -> bool {
    a.seq == b.seq
        && a.session == b.session
        && a.opcode == b.opcode
        && a.offset == b.offset
        && a.size == b.size
        && a.data == b.data
}

/// A piece of a file.
fn piece(volume: &mut dyn Volume, offset: u32, size: usize) -> Result<Vec<u8>, Fault> {
    let mut data = vec![0; size.min(DATA)];
    let count = volume.read(u64::from(offset), &mut data).map_err(fault_of)?;
    data.truncate(count);
    if data.is_empty() { Err(Fault::MAV_FTP_ERR_EOF) } else { Ok(data) }
}

fn payload_of(answer: &Answer, seq: u16, asked: u8) -> [u8; 251] {
    let mut payload = [0; 251];
    payload[..2].copy_from_slice(&seq.to_le_bytes());
    payload[2] = answer.session;
    payload[3] = answer.opcode as u8;
    payload[4] = answer.data.len() as u8;
    payload[5] = asked;
    payload[6] = u8::from(answer.burst_complete);
    payload[8..12].copy_from_slice(&answer.offset.to_le_bytes());
    payload[HEADER..HEADER + answer.data.len()].copy_from_slice(&answer.data);
    payload
}

fn send(to: Peer, payload: [u8; 251], out: &mut Outbox) {
    let data = c::FILE_TRANSFER_PROTOCOL_DATA {
        target_network: 0,
        target_system: to.system,
        target_component: to.component,
        payload,
    };
    out.send(to, MavMessage::FILE_TRANSFER_PROTOCOL(data));
}

const fn fault_of(fault: ShelfFault) -> Fault {
    match fault {
        ShelfFault::NotFound => Fault::MAV_FTP_ERR_FILENOTFOUND,
        ShelfFault::Unreadable => Fault::MAV_FTP_ERR_FAIL,
    }
}

/// The parts of a name. A slash at its beginning stands for the shelf itself.
fn parts_of(path: &[u8]) -> Result<Vec<&str>, Fault> {
    let refused = Fault::MAV_FTP_ERR_FILENOTFOUND;
    // Some end their names with zeros.
    let end = path.iter().rposition(|byte| *byte != 0).map_or(0, |at| at + 1);
    let text = std::str::from_utf8(&path[..end]).map_err(|_| refused)?;
    if text.len() > PATH_MAX || text.contains(['\0', '\\']) {
        return Err(refused);
    }
    let text = text.strip_prefix('/').unwrap_or(text);
    let text = text.strip_suffix('/').unwrap_or(text);
    if text.is_empty() || text == "." {
        return Ok(Vec::new());
    }
    let parts: Vec<&str> = text.split('/').collect();
    let strange = |part: &&str| part.is_empty() || part.starts_with('.');
    if parts.iter().any(strange) { Err(refused) } else { Ok(parts) }
}

#[cfg(test)]
mod tests;
