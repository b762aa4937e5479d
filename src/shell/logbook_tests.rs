use std::io::Read;
use std::os::fd::OwnedFd;

use super::*;
use crate::frames::Pose;
use crate::record::{LogReader, Source};

fn header() -> Header {
    Header {
        build: "test".into(),
        source: Source::Run,
        begun_utc: "20260131T235959Z".into(),
        made: Instant::ZERO,
        start: Pose::new(0.0, 0.0, 0.0),
        goal: None,
        seed: 0,
        params: String::new(),
        network: String::new(),
        part: 1,
    }
}

fn limits(part_bytes: u64) -> Limits {
    Limits { part_bytes, kept_bytes: 10_000_000, kept_files: 100 }
}

fn entries(input: impl Read) -> Vec<Entry> {
    let mut log = LogReader::new(input).unwrap();
    let entries = std::iter::from_fn(|| log.read().unwrap()).map(|(_, entry)| entry);
    entries.collect()
}

fn at(i: u32) -> Instant {
    Instant::from_nanos(u64::from(i) * 1000)
}

#[test]
fn a_log_that_grows_too_long_goes_on_in_parts_and_every_piece_is_in_one() {
    let folder = tempfile::tempdir().unwrap();
    let logs = folder.path().join("a/b");
    let place = Place::Folder(logs.clone(), limits(20_000));
    let logbook = Logbook::begin(place, header(), None, WhenFull::Wait).unwrap();
    assert_eq!(logbook.path(), logs.join("20260131T235959Z.mcap"));
    for number in 0..3000 {
        logbook.recorder().note(at(number), Entry::PlanAsked { number });
    }
    let params = Arc::new(Params::default());
    logbook.recorder().note_params(at(3000), params);
    logbook.close().unwrap();
    let mut numbers = Vec::new();
    let mut last = None;
    let parts = std::fs::read_dir(&logs).unwrap().count() as u32;
    assert!(parts > 3, "{parts}");
    for part in 1..=parts {
        let file = shelved::part_of(&logs.join("20260131T235959Z.mcap"), part);
        let entries = entries(File::open(&file).unwrap());
        assert_eq!(entries[0], Entry::Header(Box::new(Header { part, ..header() })));
        assert_eq!(entries.contains(&Entry::Continued), part < parts);
        numbers.extend(entries.iter().filter_map(|entry| match entry {
            Entry::PlanAsked { number } => Some(*number),
            _ => None,
        }));
        last = entries.last().cloned();
    }
    assert_eq!(numbers, (0..3000).collect::<Vec<_>>());
    assert_eq!(last, Some(Entry::Params(params_text(&Params::default()))));
    // The next run of the same second.
    let again =
        Logbook::begin(Place::Folder(logs.clone(), limits(20_000)), header(), None, WhenFull::Wait)
            .unwrap();
    assert_eq!(again.path(), logs.join("20260131T235959Z-2.mcap"));
    again.close().unwrap();
}

#[test]
fn old_parts_make_room_for_new_ones() {
    let folder = tempfile::tempdir().unwrap();
    let limits = Limits { part_bytes: 20_000, kept_bytes: 100_000, kept_files: 100 };
    let place = Place::Folder(folder.path().to_owned(), limits);
    let logbook = Logbook::begin(place, header(), None, WhenFull::Wait).unwrap();
    for number in 0..8000 {
        logbook.recorder().note(at(number), Entry::PlanAsked { number });
    }
    logbook.close().unwrap();
    let lengths = std::fs::read_dir(folder.path()).unwrap().map(|file| file.unwrap().metadata());
    let bytes: u64 = lengths.map(|about| about.unwrap().len()).sum();
    assert!((60_000..=110_000).contains(&bytes), "{bytes}");
    assert!(!folder.path().join("20260131T235959Z.mcap").exists());
}

#[test]
fn where_nothing_can_be_written_it_is_said_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    for place in [
        Place::File(folder.path().join("gone/a.mcap")),
        Place::File("/dev/full".into()),
        Place::Folder(file.join("below"), limits(1_000_000)),
    ] {
        let error =
            Logbook::begin(place, header(), None, WhenFull::Wait).err().unwrap().to_string();
        assert!(error.starts_with("cannot write the log "), "{error}");
    }
}

/// A logbook that writes into a pipe, and the pipe's other end.
fn piped() -> (Logbook, File) {
    let (out, into): (OwnedFd, OwnedFd) = nix::unistd::pipe().unwrap();
    let place = Place::Folder("pipe".into(), limits(u64::MAX));
    let mut writer = Writer {
        place,
        header: header(),
        made: Instant::ZERO,
        path: "pipe".into(),
        log: None,
        error: None,
        gap_said: false,
    };
    writer.open(into.into()).unwrap();
    (Logbook::start(writer, WhenFull::Drop).unwrap(), out.into())
}

#[test]
fn a_disk_that_does_not_keep_up_holds_up_nobody_and_what_is_missing_is_counted() {
    let (logbook, mut out) = piped();
    let recorder = logbook.recorder().clone();
    // More than pipe and queue hold; nobody reads.
    let count = 40_000;
    for number in 0..count {
        recorder.note(at(number), Entry::PlanAsked { number });
    }
    let dropped = recorder.dropped();
    assert!(dropped > 10_000, "{dropped}");
    let reading = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        out.read_to_end(&mut bytes).unwrap();
        bytes
    });
    logbook.close().unwrap();
    drop(recorder);
    let entries = entries(&*reading.join().unwrap());
    let mut next = 0;
    let mut missing = 0;
    for entry in entries {
        match entry {
            Entry::PlanAsked { number } => {
                assert_eq!(number, next, "a gap that is not said");
                next += 1;
            }
            Entry::Gap { count } => {
                missing += count;
                next += count as u32;
            }
            _ => {}
        }
    }
    assert_eq!((missing, next), (dropped, count));
}

#[test]
fn a_disk_that_fails_ends_the_log_and_nothing_else() {
    let (logbook, out) = piped();
    let recorder = logbook.recorder().clone();
    drop(out);
    for number in 0..40_000 {
        recorder.note(at(number), Entry::PlanAsked { number });
    }
    let error = logbook.close().unwrap_err().to_string();
    assert!(error.starts_with("cannot write the log pipe: "), "{error}");
    recorder.note(at(0), Entry::Time);
}
