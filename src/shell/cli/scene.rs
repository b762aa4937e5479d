//! The options of the commands that make scenes for predictors and score on them: `apexd dataset`
//! and `apexd evaluate`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::value::{family, positive, seeds, share};
use crate::experiment::dataset::{HELD_OUT_FROM, Settings};
use crate::experiment::evaluate::{Request, SceneSource, SetRequest};
use crate::sim::maze::Family;

/// Options of `apexd dataset`.
#[derive(Args, Debug)]
pub struct DatasetArgs {
    /// Folder to write; must be empty.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: PathBuf,
    /// Write into the folder even if it is not empty.
    #[arg(long, help_heading = "Output")]
    pub force: bool,
    /// Print the manifest as one JSON object instead of the summary.
    #[arg(long, help_heading = "Output")]
    pub json: bool,

    /// Kinds of maze, separated by commas.
    #[arg(
        long,
        value_parser = family(),
        value_delimiter = ',',
        default_value = Family::Thin.name(),
        help_heading = "Worlds"
    )]
    pub families: Vec<Family>,
    /// Mazes of each kind, from seed A to the one before B. Seeds from 1000000 up are held out.
    #[arg(long, value_name = "A..B", value_parser = seeds, help_heading = "Worlds")]
    pub seeds: Option<[u64; 2]>,
    /// A folder with ROS map_server maps, searched with everything below it, or one YAML file; may
    /// be repeated.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "Worlds")]
    pub maps: Vec<PathBuf>,
    /// Make data for scoring, from mazes that no network is trained on (the folder is marked, and
    /// training refuses it).
    #[arg(long, help_heading = "Worlds")]
    pub held_out: bool,
    /// Scenes in each maze and in each map.
    #[arg(long, value_name = "N", default_value_t = 50, help_heading = "Scenes")]
    pub scenes_per_world: usize,
    /// What the scenes are like.
    #[command(flatten)]
    pub scenes: SceneArgs,
}

impl DatasetArgs {
    /// What these options ask for.
    pub fn settings(&self) -> Settings {
        Settings {
            held_out: self.held_out,
            ..self.scenes.settings(
                &self.families,
                self.seeds.unwrap_or([0, 0]),
                self.scenes_per_world,
            )
        }
    }
}

/// How the scenes of a data set are made.
#[derive(Args, Clone, Debug)]
pub struct SceneArgs {
    /// Side of a world cell of the mazes, metres. If it equals --resolution, everything is done on
    /// the lattice itself: maps are brought to it, and the car's map has cells of that size.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.1,
        help_heading = "Scenes")]
    pub world_resolution: f64,
    /// Side of a cell of the lattice that a network sees, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.25,
        help_heading = "Scenes")]
    pub resolution: f64,
    /// How far the lidar sees, metres; of several each scene draws one.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "7.5", help_heading = "Scenes")]
    pub lidar_range: Vec<f64>,
    /// Beams of a scan.
    #[arg(long, value_name = "N", default_value_t = 1080, help_heading = "Scenes")]
    pub beams: u32,
    /// Share of the scenes whose map has been built along a drive; the others have one scan.
    #[arg(long, value_name = "FRACTION", value_parser = share, default_value_t = 0.5,
        help_heading = "Scenes")]
    pub along_drive: f64,
    /// Longest drive, metres; drives of each order of magnitude up to it are equally frequent.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 160.0,
        help_heading = "Scenes")]
    pub drive_max: f64,
    /// Least distance of the poses from a wall, metres.
    #[arg(long, value_name = "METRES", value_parser = positive, default_value_t = 0.3,
        help_heading = "Scenes")]
    pub clearance: f64,
    /// Seed of poses and drives.
    #[arg(long, default_value_t = 1, help_heading = "Scenes")]
    pub seed: u64,
}

impl SceneArgs {
    /// Scenes in some mazes.
    fn settings(&self, families: &[Family], seeds: [u64; 2], scenes_per_world: usize) -> Settings {
        Settings {
            families: families.iter().map(|family| family.name().to_owned()).collect(),
            seeds,
            scenes_per_world,
            resolution_m: self.resolution,
            world_resolution_m: self.world_resolution,
            lidar_ranges_m: self.lidar_range.clone(),
            beams: self.beams,
            along_drive: self.along_drive,
            drive_max_m: self.drive_max,
            clearance_m: self.clearance,
            held_out: seeds[0] >= HELD_OUT_FROM,
            seed: self.seed,
        }
    }
}

/// Options of `apexd evaluate`.
#[derive(Args, Debug)]
pub struct EvaluateArgs {
    /// Kinds of maze to score on, separated by commas; a table for each.
    #[arg(long, value_parser = family(), value_delimiter = ',', help_heading = "What is scored")]
    pub family: Vec<Family>,
    /// Mazes of each kind, from seed A to the one before B.
    #[arg(long, value_name = "A..B", value_parser = seeds, default_value = "1000000..1000030",
        help_heading = "What is scored")]
    pub seeds: [u64; 2],
    /// A folder with ROS map_server maps to score on, searched with everything below it, or one
    /// YAML file; may be repeated, a table for each.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "What is scored")]
    pub maps: Vec<PathBuf>,
    /// A folder that `apexd dataset` has written to score on; may be repeated, a table for each.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "What is scored")]
    pub dataset: Vec<PathBuf>,
    /// Networks to score (ONNX files), beside the baselines.
    #[arg(long, value_name = "FILE.onnx", num_args = 1.., help_heading = "What is scored")]
    pub model: Vec<PathBuf>,
    /// Shared library of ONNX Runtime that runs them; if not given, the runtime that is part of
    /// the program [parameter predict.onnxruntime].
    #[arg(long, value_name = "FILE", help_heading = "What is scored")]
    pub onnxruntime: Option<PathBuf>,
    /// Cells up to this far from the centre of a piece of the frontier, metres; several give
    /// several tables.
    #[arg(long, value_name = "METRES", value_parser = positive, value_delimiter = ',',
        default_value = "7.5,5", help_heading = "What is scored")]
    pub radius: Vec<f64>,

    /// Scenes in each maze and in each map.
    #[arg(long, value_name = "N", default_value_t = 20, help_heading = "Scenes")]
    pub scenes_per_world: usize,
    /// Most scenes of a data set, evenly spread over it.
    #[arg(long, value_name = "N", default_value_t = 2000, help_heading = "Scenes")]
    pub scenes_max: usize,
    /// What the scenes are like (those of data sets are as they are).
    #[command(flatten)]
    pub scenes: SceneArgs,

    /// Fit the baselines of mazes on these training mazes.
    #[arg(long, value_name = "A..B", value_parser = seeds, default_value = "0..60",
        help_heading = "Baselines")]
    pub fit_seeds: [u64; 2],
    /// Fit the baselines of maps on these maps; on the scored ones if not given.
    #[arg(long, value_name = "DIR", num_args = 1.., help_heading = "Baselines")]
    pub fit_maps: Vec<PathBuf>,
    /// Fit the baselines of data sets on this one; if not given, on training mazes made in the same
    /// way, or on the scored scenes if these are of maps.
    #[arg(long, value_name = "DIR", help_heading = "Baselines")]
    pub fit_dataset: Option<PathBuf>,

    /// Folder for pictures, reliability diagrams and the scores as evaluation.json.
    #[arg(long, value_name = "DIR", help_heading = "Output")]
    pub out: Option<PathBuf>,
    /// Write a model card beside each network: FILE.md for FILE.onnx. Scenes that networks are
    /// trained on are refused.
    #[arg(long, requires = "model", help_heading = "Output")]
    pub card: bool,
    /// Scenes of each table to draw.
    #[arg(long, value_name = "N", default_value_t = 4, help_heading = "Output")]
    pub pictures: usize,
    /// Print the scores as one JSON object instead of tables.
    #[arg(long, help_heading = "Output")]
    pub json: bool,
}

impl EvaluateArgs {
    /// What these options ask for.
    pub fn request(&self) -> Request {
        let made = |families: &[Family], seeds, maps: &[PathBuf]| SceneSource::Made {
            settings: self.scenes.settings(families, seeds, self.scenes_per_world),
            maps: maps.to_vec(),
        };
        let mut sets: Vec<SetRequest> = self
            .family
            .iter()
            .map(|family| SetRequest {
                name: format!("{} mazes", family.name()),
                scenes: made(&[*family], self.seeds, &[]),
                fit: Some(made(&[*family], self.fit_seeds, &[])),
            })
            .collect();
        sets.extend(self.maps.iter().map(|folder| SetRequest {
            name: format!("maps {}", last_name(folder)),
            scenes: made(&[], [0, 0], std::slice::from_ref(folder)),
            fit: (!self.fit_maps.is_empty()).then(|| made(&[], [0, 0], &self.fit_maps)),
        }));
        sets.extend(self.dataset.iter().map(|folder| {
            let stored = |folder: &Path| SceneSource::Stored {
                folder: folder.to_owned(),
                most: self.scenes_max,
            };
            let scenes = stored(folder);
            let fit = match &self.fit_dataset {
                Some(folder) => Some(stored(folder)),
                None => scenes.alike(self.fit_seeds),
            };
            SetRequest { name: format!("data set {}", last_name(folder)), scenes, fit }
        }));
        Request { sets, radii_m: self.radius.clone(), pictures: self.pictures }
    }
}

/// The last part of a path, without the extension of a file.
fn last_name(path: &Path) -> String {
    path.file_stem().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into())
}
