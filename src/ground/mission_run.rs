//! A mission being driven: which item is next, and what the core is asked for.

use super::core::CoreRequest;
use super::mission_items::{Fault, Item};
use crate::frames::Point;
use crate::time::{Duration, Instant};
use crate::wire::mavlink::Origin;
use crate::wire::mavlink::common::MavCmd;

/// How far a mission has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// It has not been started.
    NotStarted,
    /// The core has been asked for the goal of the present item.
    Asked,
    /// On the way to that goal.
    Driving,
    /// At that goal, until it is time to go on.
    Waiting(Instant),
    /// Interrupted.
    Paused,
    /// The last item is done.
    Complete,
}

/// What to do next.
#[derive(Clone, Debug, PartialEq)]
pub enum Next {
    /// Ask the core for this.
    Ask(Vec<CoreRequest>),
    /// There is nothing left.
    End,
}

/// Where a mission stands.
#[derive(Clone, Debug)]
pub struct Run {
    /// The present item.
    pub current: usize,
    /// What is being done about it.
    pub state: State,
    /// How often each jump was made.
    jumps: Vec<u32>,
    goal: Option<Point>,
}

impl Run {
    /// A mission of so many items that has not been started.
    pub fn new(items: usize) -> Self {
        Self { current: 0, state: State::NotStarted, jumps: vec![0; items], goal: None }
    }

    /// Whether items are being done.
    pub const fn is_going(&self) -> bool {
        matches!(self.state, State::Asked | State::Driving | State::Waiting(_))
    }

    /// The goal of the present item.
    pub const fn goal(&self) -> Option<Point> {
        self.goal
    }

    /// Forgets how often each jump was made.
    pub fn forget_jumps(&mut self) {
        self.jumps.fill(0);
    }

    /// Does the items from `from` on until one of them is a goal.
    ///
    /// # Errors
    /// If that goal is nowhere, or none is ever come to; with the number of the item.
    pub fn seek(
        &mut self,
        items: &[Item],
        from: usize,
        origin: Option<&Origin>,
    ) -> Result<Next, (usize, Fault)> {
        let mut at = from;
        let mut requests = Vec::new();
        // Each jump leads on at most once without a goal in between.
        let mut jumped = vec![false; items.len()];
        while let Some(item) = items.get(at) {
            match item.command {
                MavCmd::MAV_CMD_DO_CHANGE_SPEED => {
                    match item.params[1] {
                        -1.0 => {}
                        -2.0 => requests.push(CoreRequest::SpeedLimit(None)),
                        speed => requests.push(CoreRequest::SpeedLimit(Some(f64::from(speed)))),
                    }
                    // Of several in a row only the last one counts.
                    if requests.len() > 1 {
                        requests.remove(0);
                    }
                    at += 1;
                }
                MavCmd::MAV_CMD_DO_JUMP => {
                    let [target, repeats, ..] = item.params;
                    if repeats >= 0.0 && self.jumps[at] >= repeats as u32 {
                        at += 1;
                        continue;
                    }
                    if std::mem::replace(&mut jumped[at], true) {
                        let reason = "the jump goes round without a goal";
                        return Err((at, Fault::new(super::mission::INVALID, reason)));
                    }
                    self.jumps[at] = self.jumps[at].saturating_add(1);
                    at = target as usize;
                }
                _ => {
                    let point = item.place(origin).map_err(|fault| (at, fault))?;
                    requests.push(CoreRequest::Goto { point, through_known: false });
                    (self.current, self.goal, self.state) = (at, Some(point), State::Asked);
                    return Ok(Next::Ask(requests));
                }
            }
        }
        (self.state, self.goal) = (State::Complete, None);
        self.current = items.len().saturating_sub(1);
        Ok(Next::End)
    }

    /// How long to stay at the goal of an item.
    pub fn wait(item: &Item) -> Duration {
        Duration::from_secs_f64(f64::from(item.params[0].max(0.0)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::mavlink::common::MavFrame;

    fn item(command: MavCmd, a: f32, b: f32, x: i32) -> Item {
        let frame = MavFrame::MAV_FRAME_LOCAL_ENU;
        Item { command, frame, params: [a, b, 0.0, 0.0], x, y: 0, z: 0.0, goes_on: true }
    }

    fn goal(x: i32) -> Item {
        item(MavCmd::MAV_CMD_NAV_WAYPOINT, 0.0, 0.0, x * 10_000)
    }

    fn jump(to: f32, repeats: f32) -> Item {
        item(MavCmd::MAV_CMD_DO_JUMP, to, repeats, 0)
    }

    /// The x of every goal in the order in which they are driven to.
    fn driven(items: &[Item], at_most: usize) -> Vec<i32> {
        let mut run = Run::new(items.len());
        let mut from = 0;
        let mut found = Vec::new();
        while found.len() < at_most {
            match run.seek(items, from, None).unwrap() {
                Next::Ask(_) => found.push(run.goal().unwrap().x as i32),
                Next::End => break,
            }
            from = run.current + 1;
        }
        found
    }

    #[test]
    fn goals_are_driven_in_turn_and_jumps_repeat_as_often_as_they_say() {
        assert_eq!(driven(&[goal(1), goal(2), goal(3)], 9), [1, 2, 3]);
        assert_eq!(driven(&[goal(1), goal(2), jump(0.0, 2.0), goal(3)], 9), [1, 2, 1, 2, 1, 2, 3]);
        assert_eq!(driven(&[goal(1), goal(2), jump(1.0, -1.0)], 5), [1, 2, 2, 2, 2]);
        assert_eq!(driven(&[jump(2.0, 1.0), goal(1), goal(2)], 9), [2]);
        assert_eq!(driven(&[goal(1), jump(0.0, 0.0), goal(2)], 9), [1, 2]);
    }

    #[test]
    fn jumps_that_only_lead_to_jumps_are_found_out() {
        let items = [goal(1), jump(2.0, -1.0), jump(1.0, -1.0)];
        let mut run = Run::new(items.len());
        assert!(matches!(run.seek(&items, 0, None), Ok(Next::Ask(_))));
        assert_eq!(run.seek(&items, 1, None).unwrap_err().0, 1);
        let mut run = Run::new(1);
        assert!(run.seek(&[jump(0.0, -1.0)], 0, None).is_err());
    }

    #[test]
    fn a_change_of_speed_comes_before_the_goal_behind_it() {
        let speed = |v| item(MavCmd::MAV_CMD_DO_CHANGE_SPEED, 1.0, v, 0);
        let items = [speed(1.0), speed(2.0), goal(1), speed(-2.0), goal(2), speed(1.5)];
        let mut run = Run::new(items.len());
        let Ok(Next::Ask(requests)) = run.seek(&items, 0, None) else { panic!("a goal") };
        assert_eq!(requests[0], CoreRequest::SpeedLimit(Some(2.0)));
        assert!(matches!(requests[1], CoreRequest::Goto { .. }));
        assert_eq!(run.current, 2);
        let Ok(Next::Ask(requests)) = run.seek(&items, 3, None) else { panic!("a goal") };
        assert_eq!(requests[0], CoreRequest::SpeedLimit(None));
        assert_eq!(run.seek(&items, 5, None), Ok(Next::End));
        assert_eq!(run.state, State::Complete);
    }
}
