//! The safe floor: how much longer a drive along a given path must take for a car that knows the
//! whole map but may only drive where it could still stop within what it has seen.
//!
//! This is the benchmark in the spirit of Janson, Hu and Pavone (2018): an omniscient but safe
//! driver. The path's swept tube is seen point by point as the car moves along it (rays in the true
//! world, up to the lidar's range). With information of age `tau`, the car at arc length `s` with
//! speed `v` knows the tube up to the horizon `H` that was seen from `v tau` behind, so
//!
//! ```text
//! s + v^2 / (2 a) <= H(s - v tau)
//! ```
//!
//! which is a cap on the speed at each place. Braking is taken to be straight, which is the best that
//! the tyres can do: in bends a real car needs more room, so the time found is a lower bound of
//! what is safe on this path. Other paths may see earlier; what is bounded is this one.

use serde::{Deserialize, Serialize};

use crate::frames::{Point, Vector, heading_vector};
use crate::params::Params;
use crate::plan::PathPoint;
use crate::plan::speed::{End, SpeedLimits, SpeedProfiler, SpeedTask};
use crate::sim::drive::Trace;
use crate::sim::world::World;

/// Ages of information that are looked at, seconds.
pub const AGES_S: [f64; 6] = [0.0, 0.02, 0.05, 0.1, 0.25, 0.5];
/// Distance between the points of the path, metres.
const STEP_M: f64 = 0.1;
/// Speeds are found to this, m/s.
const SPEED_TOLERANCE_MPS: f64 = 1e-4;
/// The profile's least cap, m/s.
const LEAST_CAP_MPS: f64 = 1e-3;

/// What a safe drive along a path would take.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SafeFloor {
    /// Time along the path with everything known, seconds.
    pub path_s: f64,
    /// Age of information in seconds, and the safe time over the time with everything known.
    pub ratios: Vec<[f64; 2]>,
}

impl SafeFloor {
    /// The ratio for an age of information, between those that were looked at; beyond them that of
    /// the nearest.
    pub fn ratio(&self, age_s: f64) -> Option<f64> {
        let above = self.ratios.iter().position(|[age, _]| *age >= age_s);
        match above {
            Some(0) => Some(self.ratios[0][1]),
            Some(i) => {
                let ([a, low], [b, high]) = (self.ratios[i - 1], self.ratios[i]);
                Some(low + (high - low) * (age_s - a) / (b - a))
            }
            None => self.ratios.last().map(|[_, ratio]| *ratio),
        }
    }
}

/// The safe floor of the path that was driven; `None` if it is too short to say anything.
pub fn safe_floor(world: &World, trace: &Trace, params: &Params) -> Option<SafeFloor> {
    let path = path(trace);
    if path.len() < 3 {
        return None;
    }
    let limits = SpeedLimits::new(&params.speed, &params.vehicle);
    let seen = Seen::along(world, &path, params, &limits);
    let mut profiler = SpeedProfiler::new();
    let mut time_s = |caps: Option<&[f64]>| {
        let task = SpeedTask { start_speed_mps: 0.0, end: End::Rest, caps_mps: caps };
        profiler.travel_time_s(&path, &limits, &task).ok()
    };
    let path_s = time_s(None)?;
    let ratios = AGES_S
        .iter()
        .map(|age_s| {
            let caps: Vec<f64> =
                (0..path.len()).map(|i| seen.cap_mps(&path, i, *age_s, &limits)).collect();
            Some([*age_s, time_s(Some(&caps))? / path_s])
        })
        .collect::<Option<Vec<_>>>()?;
    Some(SafeFloor { path_s, ratios })
}

/// The driven path at even steps.
fn path(trace: &Trace) -> Vec<PathPoint> {
    let mut path: Vec<PathPoint> = Vec::new();
    for sample in &trace.samples {
        let position = sample.pose.position;
        let s_m = match path.last() {
            None => 0.0,
            Some(last) => {
                let step_m = (position - last.position).norm();
                if step_m < STEP_M {
                    continue;
                }
                last.s_m + step_m
            }
        };
        path.push(PathPoint {
            s_m,
            position,
            heading_rad: sample.pose.heading_rad,
            curvature_pm: sample.curvature_pm,
        });
    }
    path
}

/// How far along the path its tube is seen from each of its points.
struct Seen {
    /// For each point the number of the last one up to which the tube is seen from there or from a
    /// point before.
    horizon: Vec<usize>,
}

impl Seen {
    fn along(world: &World, path: &[PathPoint], params: &Params, limits: &SpeedLimits) -> Self {
        let n = path.len();
        let oldest_s = AGES_S[AGES_S.len() - 1];
        let v = limits.speed_max_mps;
        // Farther than this no speed looks.
        let ahead_m = v * v / (2.0 * braking_mps2(limits)) + v * oldest_s + 10.0 * STEP_M;
        let ahead = (ahead_m / STEP_M).ceil() as usize;
        let range_m = params.lidar.range_m;
        let tube: Vec<[Point; 3]> = path
            .iter()
            .map(|p| {
                let along = heading_vector(p.heading_rad);
                let left = Vector::new(-along.y, along.x) * params.vehicle.radius_m;
                [p.position - left, p.position, p.position + left]
            })
            .collect();
        let mut unseen = vec![[true; 3]; n];
        let mut first_unseen = 0;
        let mut horizon = Vec::with_capacity(n);
        for (j, from) in path.iter().enumerate() {
            for i in first_unseen.max(j)..(j + ahead + 1).min(n) {
                for (k, point) in tube[i].iter().enumerate() {
                    if unseen[i][k] && sees(world, from.position, *point, range_m) {
                        unseen[i][k] = false;
                    }
                }
            }
            // Where the car is its own footprint is known.
            unseen[j] = [false; 3];
            while first_unseen < n && unseen[first_unseen] == [false; 3] {
                first_unseen += 1;
            }
            horizon.push(first_unseen.saturating_sub(1).max(j));
        }
        Self { horizon }
    }

    /// The highest safe speed at point `i` with information of that age.
    fn cap_mps(&self, path: &[PathPoint], i: usize, age_s: f64, limits: &SpeedLimits) -> f64 {
        let safe = |v: f64| {
            let from_m = path[i].s_m - v * age_s;
            let j = path[..=i].partition_point(|p| p.s_m <= from_m).saturating_sub(1);
            let end = self.horizon[j];
            end + 1 == path.len()
                || path[i].s_m + v * v / (2.0 * braking_mps2(limits)) <= path[end].s_m
        };
        let (mut low, mut high) = (0.0, limits.speed_max_mps);
        if safe(high) {
            return high;
        }
        while high - low > SPEED_TOLERANCE_MPS {
            let middle = 0.5 * (low + high);
            if safe(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        low.max(LEAST_CAP_MPS)
    }
}

fn braking_mps2(limits: &SpeedLimits) -> f64 {
    limits.accel_limit_mps2.min(limits.brake_max_mps2)
}

fn sees(world: &World, from: Point, to: Point, range_m: f64) -> bool {
    let way = to - from;
    let distance_m = way.norm();
    distance_m <= range_m
        && world.raycast(from, way.y.atan2(way.x), distance_m) >= distance_m - 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Pose;
    use crate::sim::drive::TraceSample;

    /// A straight drive of `length_m` along map x through an open hall.
    fn straight(length_m: f64) -> (World, Trace) {
        let (width, height) = ((length_m / 0.1) as usize + 60, 60);
        let edge = |i: usize| {
            let (x, y) = (i % width, i / width);
            x == 0 || y == 0 || x + 1 == width || y + 1 == height
        };
        let solid: Vec<bool> = (0..width * height).map(edge).collect();
        let world = World::new(0.1, Pose::new(-2.0, -3.0, 0.0), width, height, &solid);
        let samples = (0..=(length_m / 0.02) as usize)
            .map(|i| TraceSample {
                t_s: 0.0,
                pose: Pose::new(i as f64 * 0.02, 0.0, 0.0),
                speed_mps: 1.0,
                curvature_pm: 0.0,
                longitudinal_n: 0.0,
                lateral_n: 0.0,
            })
            .collect();
        (world, Trace { samples, plans: Vec::new() })
    }

    fn with(speed_mps: f64, range_m: f64) -> Params {
        let mut params = Params::default();
        params.speed.speed_max_mps = speed_mps;
        params.lidar.range_m = range_m;
        params
    }

    #[test]
    fn on_a_straight_the_speed_is_what_range_and_age_leave() {
        let (world, trace) = straight(60.0);
        let params = with(20.0, 5.0);
        let path = path(&trace);
        let limits = SpeedLimits::new(&params.speed, &params.vehicle);
        let seen = Seen::along(&world, &path, &params, &limits);
        let a = braking_mps2(&limits);
        for age_s in [0.0, 0.1, 0.5] {
            // v age + v^2 / 2a = range, less what the tube's edge is farther away than its middle
            // and the steps of the path.
            let wanted = a * (-age_s + (age_s * age_s + 2.0 * 5.0 / a).sqrt());
            let found = seen.cap_mps(&path, 300, age_s, &limits);
            assert!(found <= wanted && found > 0.93 * wanted, "{age_s}: {found} of {wanted}");
        }
    }

    #[test]
    fn the_floor_rises_with_age_and_is_one_where_sight_is_no_limit() {
        let (world, trace) = straight(40.0);
        let far = safe_floor(&world, &trace, &with(2.0, 10.0)).unwrap();
        assert!(far.ratios.iter().all(|[_, ratio]| (ratio - 1.0).abs() < 1e-3), "{far:?}");
        let near = safe_floor(&world, &trace, &with(8.0, 3.0)).unwrap();
        assert!(near.ratios.windows(2).all(|w| w[1][1] >= w[0][1]), "{near:?}");
        assert!(near.ratios[0][1] > 1.01 && near.ratios[5][1] > 1.3, "{near:?}");
        assert!(near.ratio(0.3).unwrap() > near.ratio(0.25).unwrap());
        assert_eq!(near.ratio(9.0), Some(near.ratios[5][1]));
    }

    #[test]
    fn a_corner_hides_what_lies_behind_it() {
        // A hallway along x that turns up at x = 5 m: from far away the tube beyond is not seen.
        let (width, height) = (80, 80);
        let free = |x: usize, y: usize| {
            (1..60).contains(&x) && (1..21).contains(&y)
                || (40..60).contains(&x) && (1..79).contains(&y)
        };
        let solid: Vec<bool> = (0..width * height).map(|i| !free(i % width, i / width)).collect();
        let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), width, height, &solid);
        let sample = |x: f64, y: f64, heading_rad: f64| TraceSample {
            t_s: 0.0,
            pose: Pose::new(x, y, heading_rad),
            speed_mps: 1.0,
            curvature_pm: 0.0,
            longitudinal_n: 0.0,
            lateral_n: 0.0,
        };
        let up = std::f64::consts::FRAC_PI_2;
        let mut samples: Vec<TraceSample> =
            (0..=80).map(|i| sample(1.0 + 0.05 * f64::from(i), 1.0, 0.0)).collect();
        samples.extend((1..=100).map(|i| sample(5.0, 1.0 + 0.05 * f64::from(i), up)));
        let trace = Trace { samples, plans: Vec::new() };
        let params = with(8.0, 20.0);
        let path = path(&trace);
        let limits = SpeedLimits::new(&params.speed, &params.vehicle);
        let seen = Seen::along(&world, &path, &params, &limits);
        let end = path[seen.horizon[0]].position;
        assert!(end.y < 3.0, "{end:?} is seen from the start");
        assert_eq!(seen.horizon[path.len() / 2], path.len() - 1);
    }
}
