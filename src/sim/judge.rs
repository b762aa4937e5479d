//! Contact with the true world and entry into space that was not shown free, judged at every
//! simulated step with the simulator's own geometry.

use super::account::Account;
use super::world::World;
use crate::frames::Point;

/// What one step amounts to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Verdict {
    /// The footprint overlaps a solid cell.
    pub contact: bool,
    /// The footprint overlaps a cell that has not been shown free.
    pub unknown_entry: bool,
}

/// Watches the true position of a car whose footprint is a disc.
#[derive(Clone, Debug, PartialEq)]
pub struct Judge {
    radius_m: f64,
    collisions: u64,
    unknown_entries: u64,
    distance_min_m: f64,
}

impl Judge {
    /// A judge of a car of this radius.
    pub const fn new(radius_m: f64) -> Self {
        Self { radius_m, collisions: 0, unknown_entries: 0, distance_min_m: f64::INFINITY }
    }

    /// Looks at one instant.
    pub fn observe(&mut self, world: &World, account: &Account, position: Point) -> Verdict {
        // Beyond this neither the answer nor the minimum changes.
        let of_interest = self.distance_min_m.max(self.radius_m);
        let distance = world.distance_m(position, of_interest);
        self.distance_min_m = self.distance_min_m.min(distance);
        let verdict = Verdict {
            contact: distance < self.radius_m,
            unknown_entry: account.entered_unknown(world, position, self.radius_m),
        };
        self.collisions += u64::from(verdict.contact);
        self.unknown_entries += u64::from(verdict.unknown_entry);
        verdict
    }

    /// Instants of contact.
    pub const fn collisions(&self) -> u64 {
        self.collisions
    }

    /// Instants in space that was not shown free.
    pub const fn unknown_entries(&self) -> u64 {
        self.unknown_entries
    }

    /// Smallest distance to an obstacle so far, less the radius, metres; infinite before the first
    /// instant, minus the radius once the centre has been inside an obstacle.
    pub fn min_clearance_m(&self) -> f64 {
        self.distance_min_m - self.radius_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Pose;
    use crate::sim::lidar::{Lidar, LidarParams};

    /// A hall of 10 m by 4 m with a wall across at x = 6 m, seen from (1, 2).
    fn hall() -> (World, Account) {
        let mut solid = vec![false; 100 * 40];
        for iy in 0..40 {
            solid[iy * 100 + 60] = true;
        }
        let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), 100, 40, &solid);
        let pose = Pose::new(1.0, 2.0, 0.0);
        let mut lidar = Lidar::new(&LidarParams::default(), 0);
        let mut account = Account::new(&world, pose.position, 0.2);
        let ranges = lidar.scan(&world, pose);
        account.delivered(&world, lidar.fan(), pose, &ranges);
        (world, account)
    }

    #[test]
    fn a_drive_into_the_wall_touches_it_where_the_disc_meets_it() {
        let (world, account) = hall();
        let mut judge = Judge::new(0.2);
        let mut contacts = Vec::new();
        for step in 0..=4_900 {
            let x = 1.0 + 0.001 * f64::from(step);
            let verdict = judge.observe(&world, &account, Point::new(x, 2.0));
            // The wall itself is never shown, so touching it is entering the unknown as well.
            assert_eq!(verdict.contact, verdict.unknown_entry, "at {x}");
            if verdict.contact {
                contacts.push(x);
            }
        }
        assert!((contacts[0] - 5.801).abs() < 1e-6, "{}", contacts[0]);
        assert_eq!(judge.collisions(), contacts.len() as u64);
        assert_eq!(judge.unknown_entries(), judge.collisions());
        assert!((judge.min_clearance_m() - (0.1 - 0.2)).abs() < 1e-9);
    }

    #[test]
    fn free_space_that_was_not_shown_is_entered_without_contact() {
        let (world, account) = hall();
        let mut judge = Judge::new(0.2);
        let verdict = judge.observe(&world, &account, Point::new(8.0, 2.0));
        assert_eq!(verdict, Verdict { contact: false, unknown_entry: true });
        assert!((judge.min_clearance_m() - 1.7).abs() < 1e-9);
        let verdict = judge.observe(&world, &account, Point::new(3.0, 2.5));
        assert_eq!(verdict, Verdict::default());
        assert!((judge.min_clearance_m() - 1.3).abs() < 1e-9);
        judge.observe(&world, &account, Point::new(3.0, 2.0));
        assert!((judge.min_clearance_m() - 1.3).abs() < 1e-9, "the minimum stays");
        assert_eq!((judge.collisions(), judge.unknown_entries()), (0, 1));
    }

    #[test]
    fn a_thing_set_down_in_shown_space_is_touched() {
        let (mut world, account) = hall();
        let mut judge = Judge::new(0.2);
        world.fill_disc(Point::new(4.0, 2.0), 0.3);
        let verdict = judge.observe(&world, &account, Point::new(3.55, 2.0));
        assert_eq!(verdict, Verdict { contact: true, unknown_entry: false });
    }
}
