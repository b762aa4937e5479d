//! Files in conversation with a ground station, over a link that loses some of it.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;
use crate::ground::lossy::{Lossy, STATION, at, station};
use crate::ground::metadata::crc32;

/// A shelf with one folder of two logs.
struct Logs(BTreeMap<&'static str, Vec<u8>>);

impl Shelf for Logs {
    fn list(&self, folder: &[&str]) -> Result<Vec<ShelfEntry>, ShelfFault> {
        match folder {
            [] => Ok(vec![ShelfEntry::Folder("logs".into())]),
            ["logs"] => {
                let file = |(name, bytes): (&&str, &Vec<u8>)| {
                    ShelfEntry::File((*name).to_owned(), bytes.len() as u64)
                };
                Ok(self.0.iter().map(file).collect())
            }
            _ => Err(ShelfFault::NotFound),
        }
    }

    fn open(&self, file: &[&str]) -> Result<Box<dyn Volume>, ShelfFault> {
        let ["logs", name] = file else { return Err(ShelfFault::NotFound) };
        let bytes = self.0.get(name).ok_or(ShelfFault::NotFound)?;
        Ok(Box::new(std::io::Cursor::new(bytes.clone())))
    }
}

fn long_log() -> Vec<u8> {
    (0..20_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

struct Talk {
    service: Ftp,
    out: Outbox,
    now: Instant,
    seq: u16,
}

impl Talk {
    fn new() -> Self {
        let logs = BTreeMap::from([("a.log", b"short".to_vec()), ("b.log", long_log())]);
        let service = Ftp::new(Box::new(Logs(logs)));
        Self { service, out: Outbox::default(), now: at(0.0), seq: 0 }
    }

    fn hear(&mut self, message: &MavMessage) -> Vec<[u8; 251]> {
        self.service.handle(self.now, STATION, message, &mut self.out);
        answers(&mut self.out)
    }

    fn ask(&mut self, op: Op, session: u8, offset: u32, data: &[u8]) -> Result<Vec<u8>, u8> {
        self.seq += 1;
        let sent = self.hear(&packet(self.seq, op as u8, session, offset, data));
        assert_eq!(sent.len(), 1);
        let seq = u16::from_le_bytes([sent[0][0], sent[0][1]]);
        assert_eq!((seq, sent[0][5]), (self.seq + 1, op as u8));
        content(&sent[0])
    }

    fn open(&mut self, path: &str) -> Result<(u8, u32), u8> {
        self.seq += 1;
        let op = Op::MAV_FTP_OPCODE_OPENFILERO as u8;
        let sent = self.hear(&packet(self.seq, op, 0, 0, path.as_bytes()));
        let size = content(&sent[0])?;
        Ok((sent[0][2], u32::from_le_bytes(size.try_into().unwrap())))
    }
}

fn answers(out: &mut Outbox) -> Vec<[u8; 251]> {
    let payload = |message: MavMessage| match message {
        MavMessage::FILE_TRANSFER_PROTOCOL(data) => data.payload,
        other => panic!("{other:?}"),
    };
    station(out).into_iter().map(payload).collect()
}

fn packet(seq: u16, opcode: u8, session: u8, offset: u32, data: &[u8]) -> MavMessage {
    let mut payload = [0; 251];
    payload[..2].copy_from_slice(&seq.to_le_bytes());
    (payload[2], payload[3], payload[4]) = (session, opcode, data.len() as u8);
    payload[8..12].copy_from_slice(&offset.to_le_bytes());
    payload[12..12 + data.len()].copy_from_slice(data);
    message(payload)
}

/// A question for so many bytes, without data of its own.
fn read(seq: u16, op: Op, session: u8, offset: u32, size: u8) -> MavMessage {
    let mut payload = [0; 251];
    payload[..2].copy_from_slice(&seq.to_le_bytes());
    (payload[2], payload[3], payload[4]) = (session, op as u8, size);
    payload[8..12].copy_from_slice(&offset.to_le_bytes());
    message(payload)
}

fn message(payload: [u8; 251]) -> MavMessage {
    MavMessage::FILE_TRANSFER_PROTOCOL(c::FILE_TRANSFER_PROTOCOL_DATA {
        target_network: 0,
        target_system: 1,
        target_component: 1,
        payload,
    })
}

fn content(payload: &[u8; 251]) -> Result<Vec<u8>, u8> {
    let data = payload[12..12 + usize::from(payload[4])].to_vec();
    if payload[3] == Op::MAV_FTP_OPCODE_ACK as u8 { Ok(data) } else { Err(data[0]) }
}

const LIST: Op = Op::MAV_FTP_OPCODE_LISTDIRECTORY;
const NOT_FOUND: u8 = Fault::MAV_FTP_ERR_FILENOTFOUND as u8;
const EOF: u8 = Fault::MAV_FTP_ERR_EOF as u8;

#[test]
fn folders_are_listed_until_their_end() {
    let mut talk = Talk::new();
    let root = String::from_utf8(talk.ask(LIST, 0, 0, b"/").unwrap()).unwrap();
    let lines: Vec<&str> = root.split_terminator('\0').collect();
    assert!(lines[0].starts_with("Fgeneral.json\t") && lines[1].starts_with("Fparameters.json\t"));
    assert_eq!(lines[2], "Dlogs");
    assert_eq!(talk.ask(LIST, 0, 3, b"/"), Err(EOF));
    let logs = talk.ask(LIST, 0, 0, b"/logs").unwrap();
    assert_eq!(String::from_utf8(logs).unwrap(), "Fa.log\t5\0Fb.log\t20000\0");
    assert_eq!(talk.ask(LIST, 0, 1, b"logs/").unwrap(), b"Fb.log\t20000\0");
    assert_eq!(talk.ask(LIST, 0, 0, b"/nothing"), Err(NOT_FOUND));
}

#[test]
fn a_file_is_opened_read_checked_and_closed() {
    let mut talk = Talk::new();
    let (session, size) = talk.open("/logs/b.log").unwrap();
    assert_eq!(size, 20_000);
    let op = Op::MAV_FTP_OPCODE_READFILE;
    let mut got = Vec::new();
    loop {
        talk.seq += 1;
        let sent = talk.hear(&read(talk.seq, op, session, got.len() as u32, 239));
        match content(&sent[0]) {
            Ok(data) => got.extend(data),
            Err(fault) => break assert_eq!(fault, EOF),
        }
    }
    assert_eq!(got, long_log());
    let crc = talk.ask(Op::MAV_FTP_OPCODE_CALCFILECRC, 0, 0, b"/logs/b.log").unwrap();
    assert_eq!(crc, crc32(&long_log()).to_le_bytes());
    let close = Op::MAV_FTP_OPCODE_TERMINATESESSION;
    assert_eq!(talk.ask(close, session, 0, &[]), Ok(Vec::new()));
    let gone = Err(Fault::MAV_FTP_ERR_INVALIDSESSION as u8);
    assert_eq!(talk.ask(close, session, 0, &[]), gone);
    assert_eq!(talk.ask(op, session, 0, &[]), gone);
}

#[test]
fn metadata_is_served_with_the_checksum_that_the_message_tells() {
    let mut talk = Talk::new();
    let asked = talk.service.message(c::COMPONENT_METADATA_DATA::ID);
    let Some(MavMessage::COMPONENT_METADATA(data)) = asked else { panic!("where it is") };
    let uri = data.uri.to_str().unwrap().trim_end_matches('\0').to_owned();
    let path = uri.strip_prefix("mftp://").unwrap();
    let crc = talk.ask(Op::MAV_FTP_OPCODE_CALCFILECRC, 0, 0, path.as_bytes()).unwrap();
    assert_eq!(crc, data.file_crc.to_le_bytes());
    let (_, size) = talk.open(path).unwrap();
    let mut bytes = vec![0; size as usize];
    let mut volume = talk.service.open(path.as_bytes()).unwrap();
    assert_eq!(volume.read(0, &mut bytes), Ok(size as usize));
    assert_eq!(crc32(&bytes), data.file_crc);
}

#[test]
fn no_name_leads_off_the_shelf() {
    let mut talk = Talk::new();
    for path in [
        "/../etc/passwd",
        "..",
        "/logs/../../etc/passwd",
        "//etc/passwd",
        "/logs//a.log",
        "/logs/./a.log",
        "/logs/a.log\0/../x",
        "\\etc",
        "/logs/.hidden",
        "/etc/passwd",
        "",
        "logs\\a.log",
    ] {
        assert_eq!(talk.open(path), Err(NOT_FOUND), "{path:?}");
    }
    assert_eq!(talk.open(&format!("/logs/{}", "x".repeat(230))), Err(NOT_FOUND));
    assert!(talk.open("/logs/a.log\0").is_ok(), "a zero at the end only ends the name");
    assert_eq!(talk.ask(LIST, 0, 0, b"/logs/.."), Err(NOT_FOUND));
    assert_eq!(talk.ask(LIST, 0, 0, &[0xFF, 0xFE]), Err(NOT_FOUND));
}

#[test]
fn nothing_is_ever_written() {
    let mut talk = Talk::new();
    let guarded = Err(Fault::MAV_FTP_ERR_FILEPROTECTED as u8);
    for op in [
        Op::MAV_FTP_OPCODE_CREATEFILE,
        Op::MAV_FTP_OPCODE_WRITEFILE,
        Op::MAV_FTP_OPCODE_REMOVEFILE,
        Op::MAV_FTP_OPCODE_CREATEDIRECTORY,
        Op::MAV_FTP_OPCODE_REMOVEDIRECTORY,
        Op::MAV_FTP_OPCODE_OPENFILEWO,
        Op::MAV_FTP_OPCODE_TRUNCATEFILE,
        Op::MAV_FTP_OPCODE_RENAME,
    ] {
        assert_eq!(talk.ask(op, 0, 0, b"/logs/a.log"), guarded);
    }
    talk.seq += 1;
    let sent = talk.hear(&packet(talk.seq, 77, 0, 0, &[]));
    assert_eq!(content(&sent[0]), Err(Fault::MAV_FTP_ERR_UNKNOWNCOMMAND as u8));
    // An answer is no question.
    assert!(talk.hear(&packet(1, 128, 0, 0, &[])).is_empty());
}

#[test]
fn the_same_question_again_gets_the_same_answer() {
    let mut talk = Talk::new();
    let open = packet(7, Op::MAV_FTP_OPCODE_OPENFILERO as u8, 0, 0, b"/logs/a.log");
    let first = talk.hear(&open);
    assert_eq!(talk.hear(&open), first);
    assert_eq!(talk.service.open_files(), 1, "and opens nothing more");
    // Once it is closed the same question opens it anew.
    let session = first[0][2];
    assert_eq!(talk.ask(Op::MAV_FTP_OPCODE_TERMINATESESSION, session, 0, &[]), Ok(Vec::new()));
    assert_eq!(talk.hear(&open).len(), 1);
    assert_eq!(talk.service.open_files(), 1);
    // Another question with the same number is another question.
    let other = packet(7, Op::MAV_FTP_OPCODE_OPENFILERO as u8, 0, 0, b"/logs/b.log");
    assert_ne!(talk.hear(&other), first);
}

#[test]
fn open_files_are_few_and_are_closed_when_forgotten() {
    let mut talk = Talk::new();
    for _ in 0..4 {
        assert!(talk.open("/logs/a.log").is_ok());
    }
    let none = Err(Fault::MAV_FTP_ERR_NOSESSIONSAVAILABLE as u8);
    assert_eq!(talk.open("/logs/a.log"), none);
    talk.now = talk.now.offset_by(61.0);
    assert!(talk.open("/logs/a.log").is_ok());
    assert_eq!(talk.service.open_files(), 1);
    assert_eq!(talk.ask(Op::MAV_FTP_OPCODE_RESETSESSION, 0, 0, &[]), Ok(Vec::new()));
    assert_eq!(talk.service.open_files(), 0);
    for system in 1..=40 {
        let peer = Peer { system, ..STATION };
        let open = packet(9, Op::MAV_FTP_OPCODE_OPENFILERO as u8, 0, 0, b"/logs/a.log");
        talk.service.handle(talk.now, peer, &open, &mut talk.out);
    }
    assert_eq!(talk.service.open_files(), 32);
}

/// Downloads by bursts as ground stations do: what is missing after a burst is read by itself.
fn download(seed: u64) -> Vec<u8> {
    let mut talk = Talk::new();
    let mut link = Lossy::new(seed);
    let (session, size) = talk.open("/logs/b.log").unwrap();
    let pieces = (size as usize).div_ceil(239);
    let mut got: BTreeMap<usize, Vec<u8>> = BTreeMap::new();
    let (mut seq, mut next_ask) = (100, 0.0);
    for step in 0.. {
        let seconds = f64::from(step) * 0.02;
        assert!(seconds < 60.0, "{} of {pieces}", got.len());
        talk.now = at(seconds);
        if seconds >= next_ask {
            next_ask = seconds + 0.5;
            let missing: Vec<usize> = (0..pieces).filter(|i| !got.contains_key(i)).collect();
            if missing.is_empty() {
                return got.into_values().flatten().collect();
            }
            seq += 1;
            if missing.len() > 20 {
                let offset = missing[0] as u32 * 239;
                link.up(read(seq, Op::MAV_FTP_OPCODE_BURSTREADFILE, session, offset, 239));
            } else {
                for piece in missing {
                    seq += 1;
                    let offset = piece as u32 * 239;
                    link.up(read(seq, Op::MAV_FTP_OPCODE_READFILE, session, offset, 239));
                }
            }
        }
        for message in link.arrived_up() {
            talk.service.handle(talk.now, STATION, &message, &mut talk.out);
        }
        talk.service.handle_time(talk.now, &mut talk.out);
        station(&mut talk.out).into_iter().for_each(|message| link.down(message));
        for answer in link.arrived_down() {
            let MavMessage::FILE_TRANSFER_PROTOCOL(data) = answer else { continue };
            let p = data.payload;
            let offset = u32::from_le_bytes([p[8], p[9], p[10], p[11]]) as usize;
            if let Ok(data) = content(&p) {
                got.insert(offset / 239, data);
            }
        }
    }
    unreachable!("the loop has no end")
}

#[test]
fn a_burst_ends_with_the_file() {
    let mut talk = Talk::new();
    let (session, _) = talk.open("/logs/b.log").unwrap();
    let mut sent = talk.hear(&read(50, Op::MAV_FTP_OPCODE_BURSTREADFILE, session, 19_000, 200));
    for step in 1..50 {
        talk.now = at(f64::from(step) * 0.02);
        talk.service.handle_time(talk.now, &mut talk.out);
        sent.extend(answers(&mut talk.out));
    }
    let bytes: Vec<u8> = sent.iter().filter_map(|p| content(p).ok()).flatten().collect();
    assert_eq!(bytes, long_log()[19_000..]);
    let last = sent.last().unwrap();
    assert_eq!((content(last), last[6]), (Err(EOF), 1));
    for (i, p) in sent.iter().enumerate() {
        assert_eq!(usize::from(u16::from_le_bytes([p[0], p[1]])), 51 + i);
        assert_eq!(p[6] == 1, i + 1 == sent.len());
    }
    assert_eq!(talk.service.poll_at(), None);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn a_file_comes_whole_over_a_link_that_loses_repeats_and_mixes(seed in any::<u64>()) {
        prop_assert!(download(seed) == long_log());
    }

    /// Whatever comes: nothing panics, and what is remembered stays bounded.
    #[test]
    fn nonsense_opens_nothing_for_ever(
        payloads in prop::collection::vec((any::<[u8; 32]>(), any::<[u8; 32]>(), 0u8..20), 1..200),
    ) {
        let mut talk = Talk::new();
        for (head, tail, opcode) in payloads {
            let mut payload = [0; 251];
            payload[..32].copy_from_slice(&head);
            payload[219..].copy_from_slice(&tail);
            payload[3] = opcode;
            let sent = talk.hear(&message(payload));
            prop_assert!(sent.len() <= 8);
            prop_assert!(talk.service.open_files() <= 32);
            prop_assert!(talk.service.answers.len() <= ANSWERS_MAX);
            prop_assert!(talk.service.bursts.len() <= BURSTS_MAX);
        }
    }
}
