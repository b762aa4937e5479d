//! The simulated lidar: exact ray casting into the true world, and seeded noise.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, Normal};

use super::world::World;
use crate::frames::{Pose, Vector, heading_vector};
use crate::scan::Scan;
use crate::time::Instant;

crate::tunables! {
    /// The simulated lidar: where it looks, how far, how often, how well.
    pub struct LidarParams in "lidar" {
        /// Beams in one scan.
        beams: u32 = 1080, restart, in 8..=4096, "";
        /// Angle that a scan sweeps, centred on straight ahead; a full turn closes the circle.
        field_of_view_rad: f64 = std::f64::consts::TAU, restart, in 0.1..=6.29, "rad";
        /// Distance beyond which nothing is seen.
        range_m: f64 = 7.5, restart, in 0.5..=100.0, "m";
        /// Scans in a second.
        rate_hz: f64 = 20.0, restart, in 1.0..=100.0, "Hz";
        /// Standard deviation of the Gaussian error of a range; 0 for none.
        noise_m: f64 = 0.0, restart, in 0.0..=1.0, "m";
    }
}

/// The directions of a scan's beams, and how far they reach.
#[derive(Clone, Debug, PartialEq)]
pub struct BeamFan {
    angle_first_rad: f64,
    angle_step_rad: f64,
    range_max_m: f64,
    /// Unit vectors in the body frame.
    directions: Vec<Vector>,
}

impl BeamFan {
    /// The fan that the parameters describe: beams from right to left, centred on straight ahead.
    /// A full turn has its last beam one step short of the first; a part of a turn has beams at
    /// both of its ends.
    pub fn new(params: &LidarParams) -> Self {
        let beams = params.beams.max(2);
        let turn = std::f64::consts::TAU;
        // The parameter's upper limit is a full turn rounded up.
        let (sweep, gaps) = if params.field_of_view_rad < turn - 1e-6 {
            (params.field_of_view_rad, beams - 1)
        } else {
            (turn, beams)
        };
        let (angle_first_rad, angle_step_rad) = (-0.5 * sweep, sweep / f64::from(gaps));
        let direction = |k| heading_vector(angle_first_rad + angle_step_rad * f64::from(k));
        let directions = (0..beams).map(direction).collect();
        Self { angle_first_rad, angle_step_rad, range_max_m: params.range_m, directions }
    }

    /// Direction of beam 0 in the body frame, radians.
    pub const fn angle_first_rad(&self) -> f64 {
        self.angle_first_rad
    }

    /// Angle from one beam to the next, radians, counter-clockwise.
    pub const fn angle_step_rad(&self) -> f64 {
        self.angle_step_rad
    }

    /// How far the beams reach, metres.
    pub const fn range_max_m(&self) -> f64 {
        self.range_max_m
    }

    /// Number of beams.
    pub fn beams(&self) -> usize {
        self.directions.len()
    }

    /// A scan by this fan: what each beam measured, metres, all at one instant.
    pub fn scan(&self, stamp: Instant, sequence: u16, ranges_m: Vec<f32>) -> Scan {
        Scan {
            stamp,
            sequence,
            angle_first_rad: self.angle_first_rad,
            angle_step_rad: self.angle_step_rad,
            range_max_m: self.range_max_m,
            ranges_m,
        }
    }

    /// The beams' unit vectors in the map frame, for a lidar at `pose`.
    pub(super) fn map_directions(&self, pose: Pose) -> impl Iterator<Item = Vector> {
        let forward = heading_vector(pose.heading_rad);
        self.directions.iter().map(move |d| {
            Vector::new(d.x * forward.x - d.y * forward.y, d.x * forward.y + d.y * forward.x)
        })
    }
}

/// A lidar at the body origin.
#[derive(Clone, Debug)]
pub struct Lidar {
    fan: BeamFan,
    noise: Option<(Normal<f64>, ChaCha8Rng)>,
}

impl Lidar {
    /// A lidar whose noise follows from `seed`.
    pub fn new(params: &LidarParams, seed: u64) -> Self {
        let noise = (params.noise_m > 0.0).then(|| {
            let normal = Normal::new(0.0, params.noise_m)
                .expect("a checked parameter is a finite standard deviation");
            (normal, ChaCha8Rng::seed_from_u64(seed))
        });
        Self { fan: BeamFan::new(params), noise }
    }

    /// Its beams.
    pub const fn fan(&self) -> &BeamFan {
        &self.fan
    }

    /// Measures all beams at one moment from the true pose. Metres to the first solid surface, with
    /// noise; infinite where nothing is seen within the range.
    pub fn scan(&mut self, world: &World, pose: Pose) -> Vec<f32> {
        let range_max = self.fan.range_max_m / world.resolution_m();
        let start = world.to_local(pose.position);
        let noise = &mut self.noise;
        let measure = |direction: Vector| {
            let direction = world.to_local_direction(direction);
            let Some(cells) = world.traverse(start, direction, range_max, |_| {}) else {
                return f32::INFINITY;
            };
            let exact = cells * world.resolution_m();
            let measured = match noise {
                Some((normal, rng)) => (exact + normal.sample(rng)).max(0.0),
                None => exact,
            };
            if measured < self.fan.range_max_m { measured as f32 } else { f32::INFINITY }
        };
        self.fan.map_directions(pose).map(measure).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Point;
    use crate::sim::maze::{Family, generate};

    #[test]
    fn a_scan_is_what_rays_cast_one_by_one_say() {
        let maze = generate(Family::Thin, 4, 0.1).unwrap();
        let params = LidarParams::default();
        let mut lidar = Lidar::new(&params, 0);
        let pose = Pose { heading_rad: 0.8, ..maze.start };
        let ranges = lidar.scan(&maze.world, pose);
        assert_eq!(ranges.len(), 1080);
        let mut returns = 0;
        for (k, range) in ranges.iter().enumerate() {
            let angle =
                0.8 + lidar.fan().angle_first_rad() + lidar.fan().angle_step_rad() * k as f64;
            let exact = maze.world.raycast(pose.position, angle, params.range_m);
            if range.is_finite() {
                assert!((f64::from(*range) - exact).abs() < 1e-5, "beam {k}");
                returns += 1;
            } else {
                assert_eq!(exact, params.range_m, "beam {k}");
            }
        }
        assert!(returns > 900, "{returns} beams met a wall");
    }

    #[test]
    fn a_full_turn_closes_and_a_part_of_one_is_centred_ahead() {
        let scan = |params: &LidarParams| {
            let fan = BeamFan::new(params);
            fan.scan(Instant::ZERO, 0, vec![1.0; fan.beams()])
        };
        assert!(scan(&LidarParams::default()).is_full_circle());
        let rounded = LidarParams { field_of_view_rad: 6.29, ..LidarParams::default() };
        assert_eq!(scan(&rounded), scan(&LidarParams::default()));
        let half = LidarParams { field_of_view_rad: 3.0, beams: 271, ..LidarParams::default() };
        let half = scan(&half);
        assert!(!half.is_full_circle());
        assert!((half.angle_rad(0) + 1.5).abs() < 1e-12);
        assert!((half.angle_rad(135)).abs() < 1e-12);
        assert!((half.angle_rad(270) - 1.5).abs() < 1e-12);
    }

    #[test]
    fn noise_follows_from_the_seed_and_has_the_size_that_was_asked_for() {
        let world = World::new(0.1, Pose::new(0.0, 0.0, 0.0), 100, 100, &vec![false; 100 * 100]);
        let pose = Pose { position: Point::new(5.0, 5.0), heading_rad: 0.0 };
        let params = LidarParams { noise_m: 0.03, beams: 4096, ..LidarParams::default() };
        let exact =
            Lidar::new(&LidarParams { noise_m: 0.0, ..params.clone() }, 1).scan(&world, pose);
        let mut lidar = Lidar::new(&params, 1);
        let first = lidar.scan(&world, pose);
        assert_eq!(first, Lidar::new(&params, 1).scan(&world, pose));
        assert_ne!(first, lidar.scan(&world, pose), "a second scan has errors of its own");
        assert_ne!(first, Lidar::new(&params, 2).scan(&world, pose));
        let errors: Vec<f64> = first.iter().zip(&exact).map(|(a, b)| f64::from(a - b)).collect();
        let n = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / n;
        let deviation = (errors.iter().map(|e| (e - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!(mean.abs() < 0.002 && (deviation - 0.03).abs() < 0.002, "{mean} {deviation}");
    }
}
