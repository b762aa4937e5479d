//! Trajectories for the tests of `control` and `guard`: bends like clothoids, a speed profile on the
//! friction circle by forward-backward integration on a fine grid.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::frames::{Pose, wrap_angle};
use crate::plan::{PathPoint, Trajectory, TrajectoryPoint};
use crate::time::Instant;

/// Grid of the profile, metres.
const DS: f64 = 0.01;
/// Every so many grid points become a sample.
const EVERY: usize = 4;

/// A random winding path of about `length_m`, driven as fast as `accel` and `speed_max_mps` allow,
/// from `start_speed` (or less, if the path does not let it) to rest.
pub fn trajectory(
    seed: u64,
    start: Pose,
    at: Instant,
    length_m: f64,
    speed_max_mps: f64,
    accel: f64,
) -> Trajectory {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = (length_m / DS) as usize / EVERY * EVERY;
    // Curvature: plateaus joined by ramps of 0.2 to 0.6 m.
    let mut curvature = vec![0.0; n + 1];
    let (mut i, mut now, mut side) = (0, 0.0, 1.0);
    while i <= n {
        side = if rng.random_bool(0.7) { -side } else { side };
        let target = if rng.random_bool(0.3) { 0.0 } else { side * rng.random_range(0.2..1.9) };
        let ramp = (rng.random_range(0.2..0.6) / DS) as usize;
        let turn: f64 = rng.random_range(0.3..1.6);
        let plateau: f64 =
            if target == 0.0 { rng.random_range(0.3..4.0) } else { turn / f64::abs(target) };
        for j in 0..ramp + (plateau / DS) as usize {
            if i > n {
                break;
            }
            let u = ((j + 1) as f64 / ramp as f64).min(1.0);
            curvature[i] = now + u * (target - now);
            i += 1;
        }
        now = target;
    }
    profile(&curvature, start, at, speed_max_mps, accel)
}

/// The fastest profile over curvatures at every [`DS`], from rest to rest.
pub fn profile(
    curvature: &[f64],
    start: Pose,
    at: Instant,
    speed_max_mps: f64,
    accel: f64,
) -> Trajectory {
    let n = curvature.len() - 1;
    let mut b: Vec<f64> = curvature
        .iter()
        .map(|k| (accel / k.abs().max(1e-9)).min(speed_max_mps * speed_max_mps))
        .collect();
    (b[0], b[n]) = (0.0, 0.0);
    let room = |k: f64, b: f64| (accel * accel - (k * b).powi(2)).max(0.0).sqrt();
    for i in (0..n).rev() {
        b[i] = b[i].min(b[i + 1] + 2.0 * DS * room(curvature[i + 1], b[i + 1]));
    }
    for i in 0..n {
        b[i + 1] = b[i + 1].min(b[i] + 2.0 * DS * room(curvature[i], b[i]));
    }
    let mut points: Vec<TrajectoryPoint> = Vec::new();
    let (mut pose, mut t) = (start, 0.0);
    for i in 0..=n {
        if i > 0 {
            // Four sub-arcs a grid step make the path exact to a micrometre.
            for j in 0..4 {
                let u = (f64::from(j) + 0.5) / 4.0;
                let k = curvature[i - 1] + u * (curvature[i] - curvature[i - 1]);
                pose = pose.along_arc(DS / 4.0, k * DS / 4.0);
            }
        }
        if i % EVERY != 0 && i != n {
            continue;
        }
        let speed = b[i].sqrt();
        if let Some(last) = points.last_mut() {
            let ds = i as f64 * DS - last.path.s_m;
            t += 2.0 * ds / (speed + last.speed_mps);
            last.accel_mps2 = (b[i] - last.speed_mps.powi(2)) / (2.0 * ds);
        }
        points.push(TrajectoryPoint {
            path: PathPoint {
                s_m: i as f64 * DS,
                position: pose.position,
                heading_rad: wrap_angle(pose.heading_rad),
                curvature_pm: curvature[i],
            },
            t_s: t,
            speed_mps: speed,
            accel_mps2: 0.0,
        });
    }
    Trajectory { start: at, points }
}
