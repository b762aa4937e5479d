//! Scenes of one place: what the car has mapped, and what is there.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::Settings;
use super::place::Place;
use crate::frames::{Point, Pose, Vector};
use crate::map::{Cell, CellRect, MapParams, Mapper};
use crate::predict::lattice::{Crop, Lattice};
use crate::scan::Scan;
use crate::sim::lidar::{Lidar, LidarParams};
use crate::time::Instant;

/// Frontier centres kept of a scene.
pub const FRONTIERS: usize = 8;

/// Cells that a piece of the frontier has at least; smaller ones are specks between grazing beams.
pub const FRONTIER_CELLS_MIN: usize = 3;

/// Radius around the start of a map that is free because the car stands there, metres: the car's
/// radius and the margin of the certificate, as in the closed loop.
const FOOTPRINT_M: f64 = 0.25;

/// Scans along a drive are this far apart, metres: 20 Hz at 4 to 8 m/s, and every other one.
const SPACING_M: std::ops::Range<f64> = 0.2..0.5;

/// One scene a this many metres of a drive, on average.
const SCENE_EVERY_M: f64 = 5.0;

/// How a scene's map came about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// One scan.
    Scan = 0,
    /// The scans along a drive.
    Drive = 1,
}

/// One scene, as it is stored.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// 0 unknown, 1 free, 2 occupied; row by row.
    pub observed: Vec<u8>,
    /// 0 free, 1 occupied, 255 no target; row by row.
    pub truth: Vec<u8>,
    /// x, y (metres, robot-cell frame), heading (rad).
    pub pose: [f32; 3],
    /// Frontier centres, robot-cell frame, metres, nearest first; NaN where there are no more.
    pub frontiers: [[f32; 2]; FRONTIERS],
    /// How the map came about.
    pub kind: Kind,
    /// The lidar's range, metres.
    pub lidar_range_m: f32,
}

/// Takes scenes in a place.
pub struct Surveyor<'a> {
    settings: &'a Settings,
    mapper: Mapper,
    lattice: Lattice,
    crop: Crop,
    scan: Scan,
}

impl<'a> Surveyor<'a> {
    /// A surveyor whose map has cells of `map_resolution_m`.
    pub fn new(settings: &'a Settings, map_resolution_m: f64) -> Self {
        let params = MapParams { resolution_m: map_resolution_m, ..MapParams::default() };
        Self {
            settings,
            mapper: Mapper::new(&params),
            lattice: Lattice::new(settings.resolution_m),
            crop: Crop::default(),
            scan: Scan {
                stamp: Instant::ZERO,
                sequence: 0,
                angle_first_rad: 0.0,
                angle_step_rad: 0.0,
                range_max_m: 0.0,
                ranges_m: Vec::new(),
            },
        }
    }

    /// `count` scenes of a place: first those of one scan, then those along drives.
    pub fn survey(&mut self, place: &mut Place, count: usize, rng: &mut ChaCha8Rng) -> Vec<Scene> {
        let mut scenes = Vec::with_capacity(count);
        let along = (0..count).filter(|_| rng.random_bool(self.settings.along_drive)).count();
        while scenes.len() < count - along {
            let pose = Pose { position: place.random_point(rng), heading_rad: random_heading(rng) };
            let mut lidar = self.lidar(rng);
            self.begin(pose.position);
            let _ = self.take_scan(place, &mut lidar, pose);
            scenes.push(self.record(place, &lidar, pose, Kind::Scan));
        }
        while scenes.len() < count {
            self.drive(place, count, &mut scenes, rng);
        }
        scenes
    }

    /// Drives along one random way, and stops for some scenes, of which the last lies at its end.
    fn drive(
        &mut self,
        place: &mut Place,
        count: usize,
        scenes: &mut Vec<Scene>,
        rng: &mut ChaCha8Rng,
    ) {
        let mut lidar = self.lidar(rng);
        // As many of each order of magnitude: what a map gains at first is worth more than later.
        let length_m = rng.random_range(0.0..=self.settings.drive_max_m.ln()).exp();
        let way = place.random_way(length_m, rng.random_range(SPACING_M), rng);
        let wanted = (length_m / SCENE_EVERY_M).round().clamp(1.0, 8.0) as usize;
        let last = way.len() - 1;
        let mut stops: Vec<usize> = (1..wanted).map(|_| rng.random_range(0..=last)).collect();
        stops.push(last);
        stops.sort_unstable();
        stops.dedup();
        self.begin(way[0]);
        let mut changed = CellRect::EMPTY;
        for (k, position) in way.iter().enumerate() {
            let (from, to) = (way[k.saturating_sub(2)], way[(k + 2).min(last)]);
            let ahead: Vector = to - from;
            let heading_rad =
                if ahead.norm() > 1e-6 { ahead.y.atan2(ahead.x) } else { random_heading(rng) };
            let pose = Pose { position: *position, heading_rad };
            changed = changed.union(&self.take_scan(place, &mut lidar, pose));
            if stops.binary_search(&k).is_ok() && scenes.len() < count {
                self.lattice.update(self.mapper.grid(), changed);
                changed = CellRect::EMPTY;
                scenes.push(self.record(place, &lidar, pose, Kind::Drive));
            }
        }
    }

    fn lidar(&self, rng: &mut ChaCha8Rng) -> Lidar {
        let ranges = &self.settings.lidar_ranges_m;
        let range_m = ranges[rng.random_range(0..ranges.len())];
        let beams = self.settings.beams;
        Lidar::new(&LidarParams { beams, range_m, ..LidarParams::default() }, 0)
    }

    /// Forgets everything but the place where the car stands.
    fn begin(&mut self, position: Point) {
        self.mapper.clear();
        self.lattice = Lattice::new(self.settings.resolution_m);
        let _ = self.mapper.mark_footprint(position, FOOTPRINT_M);
    }

    /// Inserts a scan, and says where the map has changed.
    fn take_scan(&mut self, place: &Place, lidar: &mut Lidar, pose: Pose) -> CellRect {
        self.scan.angle_first_rad = lidar.fan().angle_first_rad();
        self.scan.angle_step_rad = lidar.fan().angle_step_rad();
        self.scan.range_max_m = lidar.fan().range_max_m();
        self.scan.ranges_m = lidar.scan(&place.world, pose);
        let insertion = self.mapper.insert(&pose, &self.scan);
        assert!(insertion.refused.is_none(), "a scan of {pose:?}: {:?}", insertion.refused);
        insertion.changed
    }

    fn record(&mut self, place: &Place, lidar: &Lidar, pose: Pose, kind: Kind) -> Scene {
        if kind == Kind::Scan {
            self.lattice.update(self.mapper.grid(), self.mapper.grid().bounds());
        }
        self.lattice.crop(pose.position, &mut self.crop);
        let crop = &self.crop;
        let observed = crop.cells.iter().map(|cell| match cell {
            Cell::Unknown => 0,
            Cell::Free => 1,
            Cell::Occupied => 2,
        });
        let mut frontiers = [[f32::NAN; 2]; FRONTIERS];
        let centres = crop.frontier_centres(FRONTIER_CELLS_MIN);
        for (slot, [column, row]) in frontiers.iter_mut().zip(centres) {
            *slot = crop.centre(column, row);
        }
        let within = pose.position - crop.origin();
        Scene {
            observed: observed.collect(),
            truth: place.truth.crop(crop.car),
            pose: [within.x as f32, within.y as f32, pose.heading_rad as f32],
            frontiers,
            kind,
            lidar_range_m: lidar.fan().range_max_m() as f32,
        }
    }
}

fn random_heading(rng: &mut ChaCha8Rng) -> f64 {
    rng.random_range(-std::f64::consts::PI..std::f64::consts::PI)
}
