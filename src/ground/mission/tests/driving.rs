//! Missions are driven, fences reach the core.

use super::*;

#[test]
fn goals_are_driven_to_in_turn() {
    let mut talk = Talk::new();
    assert!(talk.start(0.0).is_err(), "there is no mission");
    let speed =
        Item { command: MavCmd::MAV_CMD_DO_CHANGE_SPEED, params: [1.0, 1.5, 0.0, 0.0], ..goal(0) };
    let waits = Item { params: [2.0, 0.0, 0.0, 0.0], ..goal(2) };
    talk.upload(Kind::Mission, &[goal(1), speed, waits, goal(3)]);
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [1.0]);
    assert_eq!(talk.service.current_message().mission_state, MissionState::MISSION_STATE_ACTIVE);
    // The word of an arrival elsewhere is about another goal.
    assert_eq!(
        reached(&talk.event(&CoreEvent::GoalReached { position: Point::new(9.0, 9.0) })),
        None
    );
    assert_eq!(reached(&talk.arrive()), Some(0));
    assert_eq!(talk.asked[0], CoreRequest::SpeedLimit(Some(1.5)));
    assert_eq!(talk.goals(), [2.0]);
    assert_eq!(reached(&talk.arrive()), Some(2));
    assert!(talk.goals().is_empty(), "it waits");
    assert_eq!(talk.service.poll_at().unwrap(), talk.service.next_word);
    talk.now = talk.now.offset_by(1.9);
    talk.service.handle_time(talk.now, &mut talk.out);
    talk.drain();
    assert!(talk.goals().is_empty());
    talk.now = talk.now.offset_by(0.2);
    talk.service.handle_time(talk.now, &mut talk.out);
    talk.drain();
    assert_eq!(talk.goals(), [3.0]);
    let sent = talk.arrive();
    assert_eq!(reached(&sent), Some(3));
    assert!(texts(&sent).contains("Mission complete"));
    assert_eq!((talk.mode, talk.asked.pop()), (Mode::Hold, Some(CoreRequest::Hold)));
    assert_eq!(talk.service.run.state, State::Complete);
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [1.0], "from the beginning again");
}

#[test]
fn a_pause_keeps_the_item_and_a_new_start_goes_on_with_it() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    talk.start(0.0).unwrap();
    talk.arrive();
    talk.mode = Mode::Hold;
    talk.now = talk.now.offset_by(5.0);
    talk.look();
    assert_eq!(talk.service.current_message().mission_state, MissionState::MISSION_STATE_PAUSED);
    talk.mode = Mode::Auto;
    talk.look();
    assert_eq!(talk.service.run.state, State::Driving, "continued");
    talk.mode = Mode::Hold;
    talk.look();
    talk.goals();
    talk.start(0.0).unwrap();
    assert_eq!(talk.goals(), [2.0]);
    assert!(talk.start(3.0).is_err());
    talk.start(2.0).unwrap();
    assert_eq!(talk.goals(), [3.0]);
}

#[test]
fn a_mission_is_started_from_any_item_but_not_to_one_before_its_end() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    for last in [1.0, 0.5, -1.0, f32::INFINITY] {
        let denial = talk.start_to(0.0, last).unwrap_err();
        assert_eq!(denial.result, MavResult::MAV_RESULT_DENIED, "{last}: {}", denial.reason);
        assert!(!talk.service.run.is_going());
    }
    // None is meant by zero, by not-a-number, and by the end.
    for last in [0.0, f32::NAN, 2.0, 7.0] {
        talk.start_to(1.0, last).unwrap();
        assert_eq!(talk.goals(), [2.0], "{last}");
    }
    talk.start_to(f32::NAN, f32::NAN).unwrap();
    assert_eq!(talk.goals(), [2.0], "goes on with the present item");
}

#[test]
fn another_item_can_be_chosen_under_way() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2), goal(3)]);
    talk.start(0.0).unwrap();
    talk.goals();
    let choose = |seq| {
        MavMessage::MISSION_SET_CURRENT(c::MISSION_SET_CURRENT_DATA {
            seq,
            target_system: 1,
            target_component: 1,
        })
    };
    let sent = talk.hear(&choose(2));
    assert_eq!(talk.goals(), [3.0]);
    assert!(sent.iter().any(|m| matches!(m, MavMessage::MISSION_CURRENT(data) if data.seq == 2)));
    let sent = talk.hear(&choose(3));
    assert_eq!(ack(&sent), Some(Code::MAV_MISSION_INVALID_SEQUENCE));
    assert_eq!(talk.service.run.current, 2);
}

#[test]
fn what_cannot_be_reached_or_is_refused_is_told_and_ends_the_drive() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2)]);
    talk.start(0.0).unwrap();
    let fault = CoreFault { name: UNREACHABLE, detection: "", action: FaultAction::FinishesPlan };
    assert_eq!(crate::autopilot::Fault::GoalUnreachable.name(), UNREACHABLE);
    let sent = talk.event(&CoreEvent::FaultRaised(fault));
    assert!(texts(&sent).contains("item 0 cannot be reached"), "{}", texts(&sent));
    assert_eq!((talk.mode, talk.service.run.state), (Mode::Hold, State::Paused));

    talk.start(0.0).unwrap();
    talk.refusal = Some(Refusal::new(RefusalKind::Failed, "the car is not armed"));
    let sent = talk.arrive();
    assert!(texts(&sent).contains("item 1: the car is not armed"), "{}", texts(&sent));
    assert_eq!((talk.mode, talk.service.run.state), (Mode::Hold, State::Paused));
}

#[test]
fn a_start_that_the_core_refuses_is_no_start() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1)]);
    talk.start(0.0).unwrap();
    // The commander keeps the mode as it was.
    talk.mode = Mode::Hold;
    talk.service.run.state = State::Asked;
    talk.service.starting = Some(talk.now);
    talk.look();
    assert_eq!(talk.service.run.state, State::Asked, "the answer may still come");
    talk.now = talk.now.offset_by(3.0);
    talk.look();
    assert_eq!(talk.service.run.state, State::Paused);
}

#[test]
fn a_new_mission_stops_the_car_on_the_old_one() {
    let mut talk = Talk::new();
    talk.upload(Kind::Mission, &[goal(1), goal(2)]);
    talk.start(0.0).unwrap();
    talk.asked.clear();
    assert_eq!(talk.upload(Kind::Mission, &[goal(5)]), DONE);
    assert_eq!((talk.mode, &talk.asked[..]), (Mode::Hold, &[CoreRequest::Hold][..]));
    assert_eq!(talk.service.current_message().seq, 0);
}

#[test]
fn a_fence_reaches_the_core_also_after_a_restart() {
    let mut talk = Talk::new();
    assert_eq!(talk.upload(Kind::Fence, &square()), DONE);
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(!fence.allows(Point::new(1.5, 1.5)) && fence.allows(Point::new(0.0, 0.0)));
    assert_eq!(talk.upload(Kind::Fence, &square()[..3]), Code::MAV_MISSION_INVALID_PARAM1);
    assert!(talk.asked.is_empty());

    let kept = talk.memory.0.lock().unwrap().clone();
    let mut again = Talk::new();
    again.service = Mission::new(1, None, |name| kept.get(name).cloned());
    again.look();
    assert!(matches!(&again.asked[..], [CoreRequest::SetFence(same)] if *same == fence));
    again.hear(&clear(MavMissionType::MAV_MISSION_TYPE_FENCE));
    assert!(matches!(&again.asked[1..], [CoreRequest::SetFence(none)] if none.is_empty()));
}

#[test]
fn a_fence_on_the_earth_keeps_the_car_where_it_is_until_the_map_has_a_place() {
    let place = Geodetic { latitude_deg: 0.0, longitude_deg: 0.0 };
    let global = square().map(|item| Item { frame: MavFrame::MAV_FRAME_GLOBAL_INT, ..item });
    let mut talk = Talk::new();
    talk.service = Mission::new(1, None, |name| (name == "fence.txt").then(|| text_of(&global)));
    let sent = talk.look();
    assert!(texts(&sent).contains("Fence: the car stays"), "{}", texts(&sent));
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(!fence.allows(Point::new(0.0, 0.0)));
    let origin = Origin { place, altitude_m: 0.0 };
    talk.service.handle_origin(talk.now, &origin, &mut talk.out);
    talk.drain();
    let Some(CoreRequest::SetFence(fence)) = talk.asked.pop() else { panic!("a fence") };
    assert!(fence.allows(Point::new(50.0, 0.0)));
}
