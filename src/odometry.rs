//! Dead reckoning: where the body origin has been during the last moments, from odometry alone.
//!
//! Everything that needs a pose "when that scan was measured" or "when the car had travelled so
//! far" asks an [`OdometryTrack`].

use std::collections::VecDeque;

use crate::frames::{Pose, wrap_angle};
use crate::scan::Odometry;
use crate::time::Instant;

/// Readings further apart than this say nothing about the acceleration at the newest one.
const ACCEL_GAP_MAX_S: f64 = 0.05;
/// The motion is carried on beyond the newest reading for this long; then the car is taken to
/// stand (whoever drives on older odometry than that has to look at its age).
const EXTRAPOLATION_MAX_S: f64 = 0.2;
/// Totals that run back, or on at more than this speed, come from a controller that was restarted.
const PLAUSIBLE_SPEED_MPS: f64 = 30.0;
/// A place that lies so little before the oldest reading is there, rounded by the bus, metres. (A car
/// that has stood for longer than the memory has only one place to remember.)
const ROUNDING_M: f64 = 1e-4;
/// Slack of the same test for short intervals, metres.
const PLAUSIBLE_STEP_M: f64 = 0.1;

/// What became of a reading.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// It was taken up.
    Taken,
    /// It is not newer than the newest one, or not finite, and was dropped.
    Dropped,
    /// The totals jumped: the controller was restarted, and what happened in between is unknown.
    /// The track goes on from the last pose and has forgotten what was before.
    Restarted,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    odometry: Odometry,
    pose: Pose,
}

/// The poses of the last moments, by exact arcs through the differences of the odometry's totals.
#[derive(Clone, Debug)]
pub struct OdometryTrack {
    entries: VecDeque<Entry>,
    span_s: f64,
    /// Pose at the next first reading; `None`: the odometry's own frame.
    start: Option<Pose>,
}

impl OdometryTrack {
    /// A track that begins at `start` with the first reading and remembers `span_s` seconds.
    pub fn from_pose(start: Pose, span_s: f64) -> Self {
        Self { entries: VecDeque::new(), span_s, start: Some(start) }
    }

    /// A track in the odometry's own frame: the heading is the wrapped `turned_rad`, the first
    /// reading lies at the origin.
    pub fn in_own_frame(span_s: f64) -> Self {
        Self { entries: VecDeque::new(), span_s, start: None }
    }

    /// Takes up a reading. Lost readings before it cost (nearly) nothing, since totals are used.
    pub fn push(&mut self, odometry: &Odometry) -> Reading {
        let values = [
            odometry.travelled_m,
            odometry.turned_rad,
            odometry.speed_mps,
            odometry.yaw_rate_rps,
            odometry.steering_curvature_pm,
        ];
        if values.iter().any(|v| !v.is_finite()) {
            return Reading::Dropped;
        }
        let Some(last) = self.entries.back().copied() else {
            let pose = self.start.unwrap_or_else(|| own_frame_origin(odometry));
            self.entries.push_back(Entry { odometry: *odometry, pose });
            return Reading::Taken;
        };
        let dt = odometry.stamp.seconds_after(last.odometry.stamp);
        if dt <= 0.0 {
            return Reading::Dropped;
        }
        let distance = odometry.travelled_m - last.odometry.travelled_m;
        let plausible = PLAUSIBLE_SPEED_MPS * dt + PLAUSIBLE_STEP_M;
        if distance < -PLAUSIBLE_STEP_M || distance > plausible {
            let pose = match self.start {
                Some(_) => last.pose,
                None => own_frame_origin(odometry),
            };
            self.entries.clear();
            self.entries.push_back(Entry { odometry: *odometry, pose });
            return Reading::Restarted;
        }
        let turn = odometry.turned_rad - last.odometry.turned_rad;
        let pose = last.pose.along_arc(distance, turn);
        self.entries.push_back(Entry { odometry: *odometry, pose });
        while self.entries.len() > 2
            && odometry.stamp.seconds_after(self.entries[0].odometry.stamp) > self.span_s
        {
            self.entries.pop_front();
        }
        Reading::Taken
    }

    /// Forgets the readings: the next one belongs to other totals. The track goes on from the last
    /// pose.
    pub fn begin_anew(&mut self) {
        if let Some(last) = self.entries.back() {
            self.start = self.start.map(|_| last.pose);
        }
        self.entries.clear();
    }

    /// The newest reading and the pose there.
    pub fn newest(&self) -> Option<(Odometry, Pose)> {
        self.entries.back().map(|e| (e.odometry, e.pose))
    }

    /// Moves the newest pose (and with it the whole track) to where it is now known to be.
    pub fn correct(&mut self, newest: Pose) {
        let Some(last) = self.entries.back().map(|e| e.pose) else {
            self.start = Some(newest);
            return;
        };
        let turn = newest.heading_rad - last.heading_rad;
        for entry in &mut self.entries {
            entry.pose = Pose {
                position: newest.to_map(last.to_body(entry.pose.position)),
                heading_rad: wrap_angle(entry.pose.heading_rad + turn),
            };
        }
    }

    /// Pose at a moment: between readings with linearly changing speed and yaw rate, beyond the
    /// newest one with its acceleration and curvature. `None` before the oldest reading.
    pub fn pose_at(&self, at: Instant) -> Option<Pose> {
        let next = self.entries.partition_point(|e| e.odometry.stamp <= at);
        let a = self.entries.get(next.checked_sub(1)?)?;
        let tau = at.seconds_after(a.odometry.stamp);
        let Some(b) = self.entries.get(next) else {
            let (distance, _) = self.carried_on(tau)?;
            return Some(a.pose.along_arc(distance, distance * curvature(&a.odometry)));
        };
        let dt = b.odometry.stamp.seconds_after(a.odometry.stamp);
        let u = tau / dt;
        let total = |rate0: f64, rate1: f64, difference: f64| {
            // Linear rate plus what is missing for the difference of the totals.
            let trapezoid = 0.5 * (rate0 + rate1) * dt;
            rate0 * tau + 0.5 * (rate1 - rate0) * tau * u + (difference - trapezoid) * u
        };
        let (o0, o1) = (&a.odometry, &b.odometry);
        let distance = total(o0.speed_mps, o1.speed_mps, o1.travelled_m - o0.travelled_m);
        let turn = total(o0.yaw_rate_rps, o1.yaw_rate_rps, o1.turned_rad - o0.turned_rad);
        Some(a.pose.along_arc(distance, turn))
    }

    /// Speed at a moment from the newest reading on, m/s; `None` without a reading.
    pub fn speed_at(&self, at: Instant) -> Option<f64> {
        let newest = self.entries.back()?;
        Some(self.carried_on(at.seconds_after(newest.odometry.stamp))?.1)
    }

    /// Pose where the odometry stood at `travelled_m`; carried on along the present curvature for
    /// distances not reached yet, `None` before the oldest reading.
    pub fn pose_at_travelled(&self, travelled_m: f64) -> Option<Pose> {
        let next = self.entries.partition_point(|e| e.odometry.travelled_m <= travelled_m);
        let oldest = self.entries.front()?;
        if next == 0 && oldest.odometry.travelled_m - travelled_m <= ROUNDING_M {
            return Some(oldest.pose);
        }
        let a = self.entries.get(next.checked_sub(1)?)?;
        let distance = travelled_m - a.odometry.travelled_m;
        let Some(b) = self.entries.get(next) else {
            return Some(a.pose.along_arc(distance, distance * curvature(&a.odometry)));
        };
        let turn = b.odometry.turned_rad - a.odometry.turned_rad;
        let length = b.odometry.travelled_m - a.odometry.travelled_m;
        Some(a.pose.along_arc(distance, turn * distance / length))
    }

    /// Distance travelled since the newest reading, and the speed then.
    fn carried_on(&self, tau_s: f64) -> Option<(f64, f64)> {
        let newest = &self.entries.back()?.odometry;
        let tau = tau_s.clamp(0.0, EXTRAPOLATION_MAX_S);
        let accel = self
            .entries
            .len()
            .checked_sub(2)
            .map(|i| &self.entries[i].odometry)
            .map(|o| (newest.speed_mps - o.speed_mps, newest.stamp.seconds_after(o.stamp)))
            .filter(|(_, dt)| *dt <= ACCEL_GAP_MAX_S)
            .map_or(0.0, |(dv, dt)| dv / dt);
        let v = newest.speed_mps.max(0.0);
        // Constant acceleration, but never into reverse.
        let tau = if accel < 0.0 { tau.min(v / -accel) } else { tau };
        Some(((v + 0.5 * accel * tau) * tau, (v + accel * tau).max(0.0)))
    }
}

fn own_frame_origin(odometry: &Odometry) -> Pose {
    Pose::new(0.0, 0.0, wrap_angle(odometry.turned_rad))
}

/// Curvature that is being driven: from the rates, or from the steering when they are too small.
fn curvature(odometry: &Odometry) -> f64 {
    const SPEED_MIN_MPS: f64 = 0.1;
    if odometry.speed_mps > SPEED_MIN_MPS {
        odometry.yaw_rate_rps / odometry.speed_mps
    } else {
        odometry.steering_curvature_pm
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at_ms(ms: u64) -> Instant {
        Instant::from_nanos(1_000_000_000 + ms * 1_000_000)
    }

    /// Speeding up from rest at 2 m/s^2 round a circle of 2 m radius.
    fn reading(ms: u64) -> Odometry {
        let t = ms as f64 * 1e-3;
        let travelled = t * t;
        Odometry {
            stamp: at_ms(ms),
            travelled_m: 10.0 + travelled,
            turned_rad: -3.0 + 0.5 * travelled,
            speed_mps: 2.0 * t,
            yaw_rate_rps: t,
            steering_curvature_pm: 0.5,
        }
    }

    fn truth(t_s: f64) -> Pose {
        Pose::new(1.0, 2.0, 0.3).along_arc(t_s * t_s, 0.5 * t_s * t_s)
    }

    fn assert_near(a: Pose, b: Pose, tol: f64) {
        assert!((a.position - b.position).norm() < tol, "{a:?} {b:?}");
        assert!(wrap_angle(a.heading_rad - b.heading_rad).abs() < tol, "{a:?} {b:?}");
    }

    #[test]
    fn poses_between_and_beyond_readings_follow_the_arc_in_spite_of_lost_readings() {
        let mut track = OdometryTrack::from_pose(Pose::new(1.0, 2.0, 0.3), 1.0);
        for ms in (0..=900).step_by(10).filter(|ms| ms % 70 != 0 || *ms == 0) {
            assert_eq!(track.push(&reading(ms)), Reading::Taken);
        }
        for i in 0..900 {
            assert_near(track.pose_at(at_ms(i)).unwrap(), truth(i as f64 * 1e-3), 1e-9);
        }
        assert_near(track.pose_at(at_ms(925)).unwrap(), truth(0.925), 1e-9);
        assert!((track.speed_at(at_ms(925)).unwrap() - 1.85).abs() < 1e-9);
        assert_near(track.pose_at_travelled(10.0 + 0.555f64.powi(2)).unwrap(), truth(0.555), 1e-9);
        assert_eq!(track.pose_at(Instant::from_nanos(5)), None);
        assert_eq!(track.pose_at_travelled(9.9), None);
    }

    #[test]
    fn the_track_forgets_what_is_older_than_its_span() {
        let mut track = OdometryTrack::in_own_frame(0.1);
        for ms in (0..=500).step_by(10) {
            track.push(&reading(ms));
        }
        assert!(track.pose_at(at_ms(401)).is_some());
        assert_eq!(track.pose_at(at_ms(380)), None);
        let (odometry, pose) = track.newest().unwrap();
        assert!((wrap_angle(odometry.turned_rad) - pose.heading_rad).abs() < 1e-9);
    }

    #[test]
    fn old_and_broken_readings_are_dropped_and_a_restart_is_noticed() {
        let mut track = OdometryTrack::from_pose(Pose::new(0.0, 0.0, 0.0), 1.0);
        track.push(&reading(100));
        track.push(&reading(110));
        assert_eq!(track.push(&reading(110)), Reading::Dropped);
        assert_eq!(track.push(&reading(90)), Reading::Dropped);
        let broken = Odometry { yaw_rate_rps: f64::NAN, ..reading(120) };
        assert_eq!(track.push(&broken), Reading::Dropped);
        let pose = track.newest().unwrap().1;
        let fresh = Odometry { travelled_m: 0.0, turned_rad: 0.0, ..reading(120) };
        assert_eq!(track.push(&fresh), Reading::Restarted);
        assert_eq!(track.newest().unwrap().1, pose);
    }

    #[test]
    fn a_place_rounded_by_the_bus_is_remembered_by_a_car_that_has_stood_for_long() {
        let mut track = OdometryTrack::from_pose(Pose::new(1.0, 2.0, 0.3), 0.1);
        for ms in (0..=500).step_by(10) {
            track.push(&Odometry { stamp: at_ms(ms), speed_mps: 0.0, ..reading(0) });
        }
        let place = track.newest().unwrap().1;
        assert_eq!(track.pose_at_travelled(10.0 - 5e-6), Some(place));
        assert_eq!(track.pose_at_travelled(9.999), None);
    }

    #[test]
    fn a_correction_moves_the_whole_track_rigidly() {
        let mut track = OdometryTrack::from_pose(Pose::new(1.0, 2.0, 0.3), 1.0);
        for ms in (0..=500).step_by(10) {
            track.push(&reading(ms));
        }
        let before = track.pose_at(at_ms(250)).unwrap();
        let newest = track.newest().unwrap().1;
        let moved = Pose::new(-3.0, 7.0, 2.9);
        track.correct(moved);
        assert_near(track.newest().unwrap().1, moved, 1e-12);
        let after = track.pose_at(at_ms(250)).unwrap();
        let (a, b) = (newest.to_body(before.position), moved.to_body(after.position));
        assert!((a - b).norm() < 1e-12);
    }

    #[test]
    fn a_braking_car_is_not_carried_on_into_reverse() {
        let mut track = OdometryTrack::from_pose(Pose::new(0.0, 0.0, 0.0), 1.0);
        for (ms, speed, travelled) in [(0, 0.2, 0.0), (10, 0.1, 0.0015)] {
            track.push(&Odometry {
                stamp: at_ms(ms),
                travelled_m: travelled,
                turned_rad: 0.0,
                speed_mps: speed,
                yaw_rate_rps: 0.0,
                steering_curvature_pm: 0.0,
            });
        }
        assert_eq!(track.speed_at(at_ms(60)).unwrap(), 0.0);
        let x = track.pose_at(at_ms(60)).unwrap().position.x;
        assert!((x - 0.002).abs() < 1e-9, "{x}");
    }
}
