use super::super::entry::tests::samples;
use super::*;
use crate::record::LogError;

/// A log of several chunks, with every kind of entry in it.
fn sample() -> (Vec<u8>, Vec<(Instant, Entry)>) {
    let mut log = LogWriter::new(Vec::new()).unwrap();
    let mut entries = Vec::new();
    for (i, entry) in samples().into_iter().enumerate() {
        let at = Instant::from_nanos(i as u64 * 1_000_003);
        log.put(at, &entry).unwrap();
        entries.push((at, entry));
        if i % 7 == 0 {
            log.flush().unwrap();
        }
    }
    let length = log.length();
    let bytes = log.close().unwrap();
    assert!(length < bytes.len() as u64 && bytes.len() < length as usize + 200, "{length}");
    (bytes, entries)
}

/// Where the first chunk begins.
fn first_chunk(bytes: &[u8]) -> usize {
    17 + u64::from_le_bytes(bytes[9..17].try_into().unwrap()) as usize
}

type Read = (Vec<(Instant, Entry)>, Result<End, LogError>);

fn read(bytes: &[u8]) -> Read {
    let mut entries = Vec::new();
    let mut log = match LogReader::new(bytes) {
        Ok(log) => log,
        Err(error) => return (entries, Err(error)),
    };
    loop {
        match log.read() {
            Ok(Some(entry)) => entries.push(entry),
            Ok(None) => return (entries, Ok(log.end().unwrap())),
            Err(error) => return (entries, Err(error)),
        }
    }
}

#[test]
fn a_log_comes_back_as_it_was_written() {
    let (bytes, entries) = sample();
    let (found, end) = read(&bytes);
    assert_eq!(found, entries);
    assert_eq!(end.unwrap(), End::Closed);
}

#[test]
fn a_log_cut_off_anywhere_reads_up_to_its_last_whole_chunk() {
    let (bytes, entries) = sample();
    let mut most = 0;
    for length in 0..bytes.len() {
        let (found, end) = read(&bytes[..length]);
        assert_eq!(found, entries[..found.len()], "{length}");
        assert!(found.len() >= most, "{length}");
        most = found.len();
        match end {
            Ok(End::CutOff { offset }) => assert!(offset <= length as u64, "{length}"),
            Err(LogError::NotALog) => assert!(length < first_chunk(&bytes), "{length}"),
            other => panic!("{length}: {other:?}"),
        }
    }
    assert_eq!(most, entries.len(), "the last chunk does not need the end of the file");
}

#[test]
fn no_flipped_bit_goes_unnoticed() {
    let (bytes, entries) = sample();
    // The header names who wrote it, which nobody needs; a length of its own guards it.
    let library = bytes.windows(6).position(|window| window == b"apexd ").unwrap();
    let library = library..library + concat!("apexd ", env!("CARGO_PKG_VERSION")).len();
    for place in (0..bytes.len()).filter(|place| !library.contains(place)) {
        for bit in 0..8 {
            let mut flipped = bytes.clone();
            flipped[place] ^= 1 << bit;
            let (found, end) = read(&flipped);
            assert_eq!(found, entries[..found.len()], "byte {place}");
            match end {
                Err(LogError::Damaged { offset, .. }) => {
                    assert!(offset <= place as u64, "byte {place}, said at {offset}");
                }
                Err(LogError::NotALog) => assert!(place < first_chunk(&bytes), "byte {place}"),
                other => panic!("byte {place}: {other:?}"),
            }
        }
    }
}

#[test]
fn a_damaged_chunk_is_named_by_where_it_begins() {
    let (mut bytes, _) = sample();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    let error = read(&bytes).1.unwrap_err();
    let LogError::Damaged { offset, .. } = error else { panic!("{error}") };
    assert!(error.to_string().contains(&format!("at byte {offset}")), "{error}");
    assert_eq!(bytes[offset as usize], 0x06, "a chunk begins there");
}

#[test]
fn lengths_that_are_absurd_take_no_memory() {
    let (bytes, _) = sample();
    let chunk = first_chunk(&bytes);
    // The record's length, the content's, and once more.
    let set = |length: u64| {
        let mut absurd = bytes.clone();
        absurd[chunk + 1..][..8].copy_from_slice(&(length.wrapping_add(40)).to_le_bytes());
        absurd[chunk + 25..][..8].copy_from_slice(&length.to_le_bytes());
        absurd[chunk + 41..][..8].copy_from_slice(&length.to_le_bytes());
        absurd
    };
    for length in [u64::MAX, u64::MAX - 40, 1 << 40, (64 << 20) + 1] {
        let (found, end) = read(&set(length));
        assert!(found.is_empty());
        assert!(matches!(end, Err(LogError::Damaged { .. })), "{length}: {end:?}");
    }
    // As much as is allowed, but not there: it looks cut off.
    let (_, end) = read(&set(64 << 20));
    assert!(matches!(end, Ok(End::CutOff { .. })), "{end:?}");
}

#[test]
fn what_is_no_log_is_said_to_be_none() {
    for bytes in [&b""[..], b"\x89MCAP0\r\n", &[0; 4096], b"{\"a\":1}\n and so on, for long enough"]
    {
        assert!(matches!(read(bytes).1, Err(LogError::NotALog)), "{bytes:?}");
    }
}

#[test]
fn chunks_are_written_as_they_fill_up() {
    let mut log = LogWriter::new(Vec::new()).unwrap();
    let entry = samples().remove(3);
    for i in 0..3000 {
        log.put(Instant::from_nanos(i), &entry).unwrap();
    }
    assert!(log.get_ref().len() > 200_000, "{}", log.get_ref().len());
    let (found, end) = read(log.get_ref());
    assert!(found.len() > 2000 && matches!(end, Ok(End::CutOff { .. })));
}
