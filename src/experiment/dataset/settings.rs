//! What scenes are asked for.

use serde::{Deserialize, Serialize};

use super::{DatasetError, HELD_OUT_FROM};
use crate::sim::maze::{self, Family};

/// What scenes are to be like, and from which worlds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Kinds of maze, by name.
    pub families: Vec<String>,
    /// The first seed of the mazes, and the one after the last; equal for no mazes.
    pub seeds: [u64; 2],
    /// Scenes taken in each maze, and in each map.
    pub scenes_per_world: usize,
    /// Side of a coarse cell, metres.
    pub resolution_m: f64,
    /// Side of a cell of the mazes, metres. If it equals the coarse cell's, maps are brought to it
    /// too and the car's own map has such cells; else these have the mapper's own size.
    pub world_resolution_m: f64,
    /// Ranges of the lidar, metres; each scene's is drawn from them.
    pub lidar_ranges_m: Vec<f64>,
    /// Beams of a scan.
    pub beams: u32,
    /// Probability that a scene's map is one along a drive.
    pub along_drive: f64,
    /// Longest drive, metres.
    pub drive_max_m: f64,
    /// Clearance of the poses from the nearest wall, metres.
    pub clearance_m: f64,
    /// Whether these are for scoring, not for training.
    pub held_out: bool,
    /// Seed of poses and drives.
    pub seed: u64,
}

impl Settings {
    /// Checks the numbers, and gives the families.
    pub(super) fn check(&self) -> Result<Vec<Family>, DatasetError> {
        let refuse =
            |name, value: String, allowed| Err(DatasetError::Setting { name, value, allowed });
        let mut families = Vec::new();
        for name in &self.families {
            match Family::from_name(name) {
                Some(family) if !families.contains(&family) => families.push(family),
                Some(_) => return refuse("a family", name.clone(), "named once"),
                None => return refuse("a family", name.clone(), "thin, solid or branching"),
            }
        }
        let [from, end] = self.seeds;
        if end < from || end >= 1 << 48 {
            return refuse("the range of seeds", format!("{from}..{end}"), "ascending, below 2^48");
        }
        if from < end && self.held_out && from < HELD_OUT_FROM {
            return Err(DatasetError::NotHeldOut { from });
        }
        if from < end && !self.held_out && end > HELD_OUT_FROM {
            return Err(DatasetError::HeldOut { from, last: end - 1 });
        }
        let within = |v: f64, low: f64, high: f64| v >= low && v <= high;
        if !(1..=100_000).contains(&self.scenes_per_world) {
            let value = self.scenes_per_world.to_string();
            return refuse("the number of scenes a world", value, "1 to 100000");
        }
        if !within(self.resolution_m, 0.1, 1.0) {
            let value = self.resolution_m.to_string();
            return refuse("the resolution", value, "0.1 to 1 m");
        }
        if !within(self.along_drive, 0.0, 1.0) {
            let value = self.along_drive.to_string();
            return refuse("the share along drives", value, "0 to 1");
        }
        if !within(self.drive_max_m, 1.0, 1000.0) {
            return refuse("the longest drive", self.drive_max_m.to_string(), "1 to 1000 m");
        }
        if !within(self.clearance_m, 0.2, 1.0) {
            return refuse("the clearance", self.clearance_m.to_string(), "0.2 to 1 m");
        }
        if !(64..=4096).contains(&self.beams) {
            return refuse("the number of beams", self.beams.to_string(), "64 to 4096");
        }
        if self.lidar_ranges_m.is_empty() {
            return refuse("the list of lidar ranges", "empty".into(), "one range or more");
        }
        if let Some(range) = self.lidar_ranges_m.iter().find(|r| !within(**r, 1.0, 30.0)) {
            return refuse("the lidar range", range.to_string(), "1 to 30 m");
        }
        if from < end {
            // Said before the first scene, and not after an hour.
            maze::generate(Family::Solid, from, self.world_resolution_m)?;
        }
        Ok(if from < end { families } else { Vec::new() })
    }
}
