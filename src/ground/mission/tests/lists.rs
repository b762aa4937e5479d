//! Lists go up and come down, also over a link that loses some of it.

use super::*;

#[test]
fn a_mission_goes_up_comes_down_is_kept_and_cleared() {
    let mut talk = Talk::new();
    let items = [goal(1), goal(2), goal(3)];
    assert_eq!(talk.upload(Kind::Mission, &items), DONE);
    let sent = talk.hear(&ask_list(MavMissionType::MAV_MISSION_TYPE_MISSION));
    let MavMessage::MISSION_COUNT(data) = &sent[0] else { panic!("a count") };
    assert_eq!((data.count, data.opaque_id), (3, opaque_id(&items)));
    for seq in 0..3 {
        let sent = talk.hear(&ask_item(seq, Kind::Mission));
        let MavMessage::MISSION_ITEM_INT(data) = &sent[0] else { panic!("an item") };
        assert_eq!(Item::of_int(data), items[usize::from(seq)]);
        assert_eq!(data.target_system, STATION.system);
    }
    let sent = talk.hear(&ask_item(3, Kind::Mission));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_INVALID_SEQUENCE));

    let kept = talk.memory.0.lock().unwrap().clone();
    let again = Mission::new(1, None, |name| kept.get(name).cloned());
    assert_eq!(again.goals, items);

    let sent = talk.hear(&clear(MavMissionType::MAV_MISSION_TYPE_ALL));
    assert_eq!(ack(&sent), Some(DONE));
    assert!(talk.service.goals.is_empty());
    assert_eq!(items_of(&talk.memory.0.lock().unwrap()["mission.txt"]), Some(Vec::new()));
    assert_eq!(talk.upload(Kind::Mission, &items), DONE);
    assert_eq!(talk.upload(Kind::Mission, &[]), DONE, "no items: cleared");
    assert!(talk.service.goals.is_empty());
}

#[test]
fn a_list_replaces_the_old_one_only_when_all_of_it_is_there_and_good() {
    let mut talk = Talk::new();
    assert_eq!(talk.upload(Kind::Mission, &[goal(1)]), DONE);
    talk.hear(&count(Kind::Mission, 3));
    talk.hear(&item_message(goal(7), 0, Kind::Mission));
    talk.hear(&item_message(goal(8), 1, Kind::Mission));
    assert_eq!(talk.service.goals, [goal(1)]);
    // What cannot be done ends the upload, with the number of the item in words.
    let takeoff = Item { command: MavCmd::MAV_CMD_NAV_TAKEOFF, ..goal(9) };
    let sent = talk.hear(&item_message(takeoff, 2, Kind::Mission));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    assert!(texts(&sent).contains("item 2: NAV_TAKEOFF"), "{}", texts(&sent));
    assert_eq!(talk.service.goals, [goal(1)]);
    let body = Item { frame: MavFrame::MAV_FRAME_BODY_FRD, ..goal(1) };
    assert_eq!(talk.upload(Kind::Mission, &[body]), Code::MAV_MISSION_UNSUPPORTED_FRAME);
    let global = Item { frame: MavFrame::MAV_FRAME_GLOBAL_INT, ..goal(1) };
    assert_eq!(talk.upload(Kind::Mission, &[global]), Code::MAV_MISSION_UNSUPPORTED_FRAME);
    let place = Geodetic { latitude_deg: 0.0, longitude_deg: 0.0 };
    let origin = Origin { place, altitude_m: 0.0 };
    talk.service.handle_origin(talk.now, &origin, &mut talk.out);
    assert_eq!(talk.upload(Kind::Mission, &[global]), DONE, "now it is known where that is");
    let sent = talk.hear(&count(Kind::Mission, ITEMS_MAX + 1));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_NO_SPACE));
}

#[test]
fn items_out_of_turn_are_asked_for_and_silence_ends_an_upload() {
    let mut talk = Talk::new();
    let sent = talk.hear(&count(Kind::Mission, 3));
    assert_eq!(request(&sent), Some(0));
    assert!(talk.hear(&item_message(goal(2), 1, Kind::Mission)).is_empty(), "too early");
    let sent = talk.hear(&item_message(goal(1), 0, Kind::Mission));
    assert_eq!(request(&sent), Some(1));
    assert!(talk.hear(&item_message(goal(1), 0, Kind::Mission)).is_empty(), "once more");
    let mut asked = 0;
    let end = loop {
        talk.now = talk.now.offset_by(0.05);
        talk.service.handle_time(talk.now, &mut talk.out);
        let sent = talk.drain();
        asked += usize::from(request(&sent) == Some(1));
        if let Some(code) = ack(&sent) {
            break code;
        }
        assert!(talk.now < at(60.0));
    };
    assert_eq!(end, Code::MAV_MISSION_OPERATION_CANCELLED);
    assert!(asked >= 5, "{asked}");
    assert!(talk.service.upload.is_none() && talk.service.goals.is_empty());
}

#[test]
fn another_station_does_not_cut_in() {
    let mut talk = Talk::new();
    talk.hear(&count(Kind::Mission, 2));
    let other = Peer { system: 254, ..STATION };
    talk.service.handle(talk.now, other, &count(Kind::Mission, 1), &mut talk.out);
    assert_eq!(ack(&talk.drain()), Some(Code::MAV_MISSION_DENIED));
    talk.service.handle(talk.now, other, &item_message(goal(9), 0, Kind::Mission), &mut talk.out);
    assert!(talk.drain().is_empty());
    let sent = talk.hear(&item_message(goal(1), 0, Kind::Mission));
    assert_eq!(request(&sent), Some(1));
}

#[test]
fn rally_points_and_pieces_of_lists_are_refused_cleanly() {
    let mut talk = Talk::new();
    let rally = MavMissionType::MAV_MISSION_TYPE_RALLY;
    let sent = talk.hear(&ask_list(rally));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    let sent = talk.hear(&MavMessage::MISSION_COUNT(c::MISSION_COUNT_DATA {
        count: 2,
        target_system: 1,
        target_component: 1,
        mission_type: rally,
        opaque_id: 0,
    }));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_UNSUPPORTED));
    assert_eq!(ack(&talk.hear(&clear(rally))), Some(Code::MAV_MISSION_UNSUPPORTED));
    // A kind that the dialect does not know.
    let raw = RawBody { id: c::MISSION_COUNT_DATA::ID, payload: vec![1, 0, 1, 1, 77] };
    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
    let Some((_, crate::wire::mavlink::Body::Raw(sent))) = talk.out.poll_message() else {
        panic!("an answer")
    };
    assert_eq!(sent.payload, [255, 190, Code::MAV_MISSION_UNSUPPORTED as u8, 77]);
    // An unknown command in an item.
    talk.hear(&count(Kind::Mission, 1));
    let mut payload = vec![0; 38];
    payload[30..34].copy_from_slice(&[0xFF, 0x7F, 1, 1]);
    payload[34] = MavFrame::MAV_FRAME_LOCAL_ENU as u8;
    let raw = RawBody { id: c::MISSION_ITEM_INT_DATA::ID, payload };
    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
    assert_eq!(ack(&talk.drain()), Some(Code::MAV_MISSION_UNSUPPORTED));
}

/// Uploads as a ground station does: says the count again while nothing comes, answers what is
/// asked for; then reads it back, asking again for what does not come.
fn transfer(seed: u64, items: &[Item], kind: Kind) -> (Mission, Vec<Item>) {
    let mut talk = Talk::new();
    let mut link = Lossy::new(seed);
    let (mut accepted, mut heard) = (false, 0.0);
    let mut got: Vec<Item> = Vec::new();
    let mut wanted = None;
    link.up(count(kind, items.len() as u16));
    let mut asked_any = false;
    for step in 0.. {
        let seconds = f64::from(step) * 0.02;
        assert!(seconds < 120.0, "accepted: {accepted}, read: {}", got.len());
        talk.now = at(seconds);
        for message in link.arrived_up() {
            talk.service.handle(talk.now, STATION, &message, &mut talk.out);
        }
        talk.service.handle_time(talk.now, &mut talk.out);
        talk.drain().into_iter().for_each(|message| link.down(message));
        for message in link.arrived_down() {
            match message {
                MavMessage::MISSION_REQUEST_INT(data) if !accepted => {
                    (heard, asked_any) = (seconds, true);
                    let item = items[usize::from(data.seq)];
                    link.up(item_message(item, data.seq, kind));
                }
                MavMessage::MISSION_ACK(data) if data.mavtype == DONE => {
                    (accepted, heard) = (true, seconds);
                }
                MavMessage::MISSION_COUNT(data) => wanted = Some(usize::from(data.count)),
                MavMessage::MISSION_ITEM_INT(data) if usize::from(data.seq) == got.len() => {
                    (got, heard) = ([&got[..], &[Item::of_int(&data)]].concat(), 0.0);
                }
                _ => {}
            }
        }
        if accepted && wanted == Some(got.len()) {
            return (talk.service, got);
        }
        if seconds - heard >= 0.3 {
            heard = seconds;
            match (accepted, wanted) {
                (false, _) if !asked_any => link.up(count(kind, items.len() as u16)),
                // The answer to the last item was lost: once more.
                (false, _) => {
                    let last = items.len() as u16 - 1;
                    link.up(item_message(items[usize::from(last)], last, kind));
                }
                (true, None) => link.up(ask_list(kind.number())),
                (true, Some(_)) => link.up(ask_item(got.len() as u16, kind)),
            }
        }
    }
    unreachable!("the loop has no end")
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_list_goes_both_ways_whole_over_a_link_that_loses_repeats_and_mixes(
        seed in any::<u64>(),
        length in 1usize..40,
        fence in any::<bool>(),
    ) {
        let (items, kind) = if fence {
            (square().repeat(length.div_ceil(4)), Kind::Fence)
        } else {
            ((0..length as i32).map(goal).collect(), Kind::Mission)
        };
        let (service, got) = transfer(seed, &items, kind);
        prop_assert_eq!(service.items(kind), &items);
        prop_assert_eq!(got, items);
    }

    /// Whatever comes: nothing panics, nothing is taken that was not sent whole, nobody is driven
    /// anywhere, and what is remembered stays bounded.
    #[test]
    fn nonsense_changes_nothing(
        payloads in prop::collection::vec((0usize..12, any::<[u8; 38]>()), 1..300),
    ) {
        let mut talk = Talk::new();
        talk.upload(Kind::Mission, &[goal(1)]);
        talk.asked.clear();
        let ids = [
            c::MISSION_ITEM_INT_DATA::ID, c::MISSION_ITEM_DATA::ID, c::MISSION_REQUEST_DATA::ID,
            c::MISSION_REQUEST_INT_DATA::ID, c::MISSION_REQUEST_LIST_DATA::ID,
            c::MISSION_ACK_DATA::ID, c::MISSION_SET_CURRENT_DATA::ID,
            c::MISSION_WRITE_PARTIAL_LIST_DATA::ID, c::MISSION_REQUEST_PARTIAL_LIST_DATA::ID,
            c::MISSION_CURRENT_DATA::ID, c::MISSION_ITEM_REACHED_DATA::ID, c::COMMAND_ACK_DATA::ID,
        ];
        for (which, payload) in payloads {
            talk.now = talk.now.offset_by(0.01);
            match crate::wire::mavlink::Body::decode(
                crate::wire::mavlink::MavlinkVersion::V2, ids[which], &payload,
            ) {
                crate::wire::mavlink::Body::Message(message) => {
                    talk.hear(&message);
                }
                crate::wire::mavlink::Body::Raw(raw) => {
                    talk.service.handle_raw(talk.now, STATION, &raw, &mut talk.out);
                    talk.drain();
                }
            }
            talk.service.handle_time(talk.now, &mut talk.out);
            talk.drain();
        }
        prop_assert_eq!(&talk.service.goals, &[goal(1)]);
        prop_assert_eq!(&talk.asked, &[]);
        prop_assert!(talk.service.upload.is_none());
    }
}
