use proptest::prelude::*;

use super::*;
use crate::frames::Pose;
use crate::record::{Header, Source};
use crate::time::Instant;

/// One of each kind, with what is hard about it.
pub fn samples() -> Vec<Entry> {
    let frame = |id, fd, data: &[u8]| CanFrame::new(id, fd, data).unwrap();
    let square =
        |side: f64| [(0.0, 0.0), (side, 0.0), (side, side)].map(|(x, y)| Point::new(x, y)).to_vec();
    let mut grid = Grid::new(0.1);
    grid.set(CellIndex::new(-70, 3), Cell::Occupied);
    grid.set(CellIndex::new(5, -1), Cell::Free);
    let header = Header {
        build: "1.2.3".into(),
        source: Source::Run,
        begun_utc: "20260131T235959Z".into(),
        made: Instant::from_nanos(u64::MAX),
        start: Pose::new(0.1, -1.0 / 3.0, 1e-300),
        goal: Some(Point::new(f64::MAX, 5e-324)),
        seed: u64::MAX,
        params: "[speed]\n".into(),
        network: "ab".into(),
        part: 3,
    };
    vec![
        Entry::Header(Box::new(header)),
        Entry::Truth(Box::new(grid)),
        Entry::Truth(Box::new(Grid::new(0.05))),
        Entry::Received(frame(CanId::standard(0x7FF), true, &[7; 64])),
        Entry::Received(frame(CanId::extended(0x1FFF_FFFF), false, &[])),
        Entry::Sent(frame(CanId::extended(5), true, &[1, 2, 3])),
        Entry::Time,
        Entry::Command(Command::Arm),
        Entry::Command(Command::Disarm),
        Entry::Command(Command::Goto(Point::new(0.1, -0.2))),
        Entry::Command(Command::Pause),
        Entry::Command(Command::Continue),
        Entry::Command(Command::Return(Point::new(f64::INFINITY, -0.0))),
        Entry::Command(Command::SpeedLimit(Some(1.5))),
        Entry::Command(Command::SpeedLimit(None)),
        Entry::Command(Command::StationLost(true)),
        Entry::Command(Command::Terminate),
        Entry::Bus(BusHealth { state: BusState::Active, error_frames: 0, frames_unsent: u64::MAX }),
        Entry::Bus(BusHealth { state: BusState::Passive, ..BusHealth::default() }),
        Entry::Bus(BusHealth { state: BusState::Off, error_frames: 300, frames_unsent: 1 }),
        Entry::Host(HostHealth { disk_full: true, predictor_missing: false }),
        Entry::Host(HostHealth { disk_full: false, predictor_missing: true }),
        Entry::Fence(Box::default()),
        Entry::Fence(Box::new(Fence {
            inside: vec![vec![square(2.0), square(3.0)], vec![]],
            outside: vec![square(1.0), vec![]],
        })),
        Entry::Params("[vehicle]\nmass_kg = 2.5\n".into()),
        Entry::PlanAsked { number: u32::MAX },
        Entry::PlanDone { number: 1, digest: u64::MAX, readings: vec![] },
        Entry::PlanDone {
            number: 2,
            digest: 0,
            readings: [0, 127, 128, u64::MAX].map(Duration::from_nanos).to_vec(),
        },
        Entry::PlanLost { number: 3 },
        Entry::Gap { count: 9 },
        Entry::Continued,
        Entry::Event(r#"{"event":"mode"}"#.into()),
        Entry::State("{}".into()),
    ]
}

fn written(entry: &Entry) -> (&'static str, Vec<u8>) {
    let mut bytes = Vec::new();
    let topic = entry.encode(&mut bytes);
    (TOPICS[topic].name, bytes)
}

#[test]
fn every_kind_comes_back_as_it_was_written() {
    for entry in samples() {
        let (topic, bytes) = written(&entry);
        assert_eq!(Entry::decode(topic, &bytes), Ok(Some(entry)));
    }
}

#[test]
fn every_kind_of_input_is_among_the_samples() {
    // A new kind belongs into the list above.
    let mut tags: Vec<u8> = samples()
        .iter()
        .map(written)
        .filter(|(topic, _)| *topic == TOPICS[INPUT].name)
        .map(|(_, bytes)| bytes[0])
        .collect();
    tags.sort_unstable();
    tags.dedup();
    assert_eq!(tags, (tag::TIME..=tag::TRUTH).collect::<Vec<u8>>());
    let unknown = Entry::decode(TOPICS[INPUT].name, &[tag::TRUTH + 1]);
    assert!(matches!(unknown, Err(EntryError::Nonsense(_))));
}

#[test]
fn what_is_cut_short_or_too_long_is_refused_and_other_topics_are_passed_over() {
    for entry in samples() {
        let (topic, bytes) = written(&entry);
        if matches!(entry, Entry::Event(_) | Entry::State(_) | Entry::Received(_) | Entry::Sent(_))
        {
            continue; // these have no length of their own
        }
        for length in 0..bytes.len() {
            let read = Entry::decode(topic, &bytes[..length]);
            let empty_map = matches!(read, Ok(Some(Entry::Truth(_))));
            assert!(read.is_err() || empty_map, "{entry:?} {length}");
        }
        let longer = [&*bytes, &[0]].concat();
        assert!(Entry::decode(topic, &longer).is_err(), "{entry:?}");
    }
    assert_eq!(Entry::decode("/somebody/else", &[1, 2]), Ok(None));
}

#[test]
fn a_header_of_another_version_is_told_from_a_damaged_one() {
    let text = br#"{"format":2,"whatever":true}"#;
    assert_eq!(Entry::decode("/apexd/header", text), Err(EntryError::Version(2)));
    for text in [&b"{"[..], b"{}", br#"{"format":1}"#, br#"{"format":-1}"#] {
        let read = Entry::decode("/apexd/header", text);
        assert!(matches!(read, Err(EntryError::Nonsense(_))), "{read:?}");
    }
}

#[test]
fn counts_and_sizes_beyond_what_is_there_take_no_memory() {
    let mut fence = vec![tag::FENCE];
    fence.put_u32(u32::MAX);
    let mut readings = vec![tag::PLAN_DONE];
    readings.put_u32(1);
    readings.put_u64(1);
    readings.put_u32(u32::MAX);
    let map = |edges: [i32; 4]| {
        let mut bytes = vec![tag::TRUTH];
        bytes.put_f64(0.1);
        edges.into_iter().for_each(|edge| bytes.put_i32(edge));
        bytes
    };
    let large = map([i32::MIN, i32::MIN, i32::MAX, i32::MAX]);
    let wide = map([0, 0, i32::MAX, 1]);
    let far = map([i32::MAX - 64, 0, i32::MAX, 64]);
    for bytes in [fence, readings, large, wide, far] {
        assert!(Entry::decode(TOPICS[INPUT].name, &bytes).is_err());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]
    #[test]
    fn no_bytes_whatever_make_it_panic(
        place in 0..TOPICS.len(),
        tag in 0..16u8,
        bytes in prop::collection::vec(any::<u8>(), 0..80),
    ) {
        let _ = Entry::decode(TOPICS[place].name, &bytes);
        let _ = Entry::decode(TOPICS[INPUT].name, &[&[tag], &*bytes].concat());
    }
}
