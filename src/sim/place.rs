//! Whether a drive can begin and end where it is wished to.

use super::world::World;
use crate::frames::{Point, Pose};

/// Why a drive cannot begin there or end there.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlaceError {
    /// The car does not fit where it is to start.
    #[error(
        "the start ({x_m:.2}, {y_m:.2}) m is {distance_m:.2} m from the nearest wall (space that a map file calls unknown counts as one), but a car of radius {radius_m} m needs at least that much"
    )]
    StartBlocked {
        /// Metres.
        x_m: f64,
        /// Metres.
        y_m: f64,
        /// Distance to the nearest wall, metres.
        distance_m: f64,
        /// The car's radius, metres.
        radius_m: f64,
    },
    /// The goal is inside a wall.
    #[error(
        "the goal ({x_m:.2}, {y_m:.2}) m is inside a wall (space that a map file calls unknown counts as one); it must be in the open"
    )]
    GoalBlocked {
        /// Metres.
        x_m: f64,
        /// Metres.
        y_m: f64,
    },
    /// Start or goal are not on the map.
    #[error(
        "the {which} ({:.2}, {:.2}) m is outside the map, which reaches from ({:.2}, {:.2}) to ({:.2}, {:.2}) m",
        at[0], at[1], low[0], low[1], high[0], high[1]
    )]
    OutsideMap {
        /// `start` or `goal`.
        which: &'static str,
        /// Where it is, metres.
        at: [f64; 2],
        /// Lower left corner of the map, metres.
        low: [f64; 2],
        /// Its upper right corner, metres.
        high: [f64; 2],
    },
}

/// Checks start and goal of a car of that radius.
///
/// # Errors
/// If one of them lies off the map, the car does not fit at the start, or the goal is in a wall.
pub fn check_place(
    world: &World,
    start: Pose,
    goal: Option<Point>,
    radius_m: f64,
) -> Result<(), PlaceError> {
    let inside = |which, point: Point| {
        if world.contains(point) {
            return Ok(());
        }
        let [low, high] = world.bounds().map(|corner| [corner.x, corner.y]);
        Err(PlaceError::OutsideMap { which, at: [point.x, point.y], low, high })
    };
    inside("start", start.position)?;
    if let Some(goal) = goal {
        inside("goal", goal)?;
    }
    let distance_m = world.distance_m(start.position, 2.0 * radius_m);
    let Point { coords: at } = start.position;
    if distance_m < radius_m {
        return Err(PlaceError::StartBlocked { x_m: at.x, y_m: at.y, distance_m, radius_m });
    }
    if let Some(goal) = goal.filter(|goal| world.is_solid(*goal)) {
        return Err(PlaceError::GoalBlocked { x_m: goal.x, y_m: goal.y });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn start_and_goal_must_lie_in_the_open() {
        let mut solid = vec![false; 100 * 100];
        solid[50 * 100 + 50] = true;
        let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), 100, 100, &solid);
        let check = |start: [f64; 2], goal: [f64; 2]| {
            let start = Pose::new(start[0], start[1], 0.0);
            check_place(&world, start, Some(Point::new(goal[0], goal[1])), 0.2)
        };
        assert_eq!(check([2.0, 2.0], [8.0, 8.0]), Ok(()));
        let outside =
            |at, which| PlaceError::OutsideMap { which, at, low: [0.0, 0.0], high: [10.0, 10.0] };
        assert_eq!(check([-1.0, 2.0], [8.0, 8.0]), Err(outside([-1.0, 2.0], "start")));
        assert_eq!(check([2.0, 2.0], [8.0, 11.0]), Err(outside([8.0, 11.0], "goal")));
        let blocked = check([4.9, 5.05], [8.0, 8.0]).unwrap_err();
        assert!(matches!(blocked, PlaceError::StartBlocked { distance_m, .. }
            if (distance_m - 0.1).abs() < 1e-9));
        let goal = check([2.0, 2.0], [5.05, 5.05]);
        assert_eq!(goal, Err(PlaceError::GoalBlocked { x_m: 5.05, y_m: 5.05 }));
    }
}
