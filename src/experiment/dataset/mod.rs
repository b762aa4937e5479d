//! Training and held-out data for the predictor: scenes on the coarse lattice, from the project's
//! own mazes, lidar and mapping.
//!
//! A folder of arrays in numpy's format, of `N` scenes on crops of `S` by `S` coarse cells:
//!
//! | file | type and shape | content |
//! |---|---|---|
//! | `observed.npy` | u8 `[N,S,S]` | 0 unknown, 1 free, 2 occupied; `[row = y, column = x]`, the car's cell at `(S/2, S/2)` |
//! | `truth.npy` | u8 `[N,S,S]` | 0 free, 1 occupied, 255 no target |
//! | `pose.npy` | f32 `[N,3]` | x, y (m, from the lower left corner of the car's cell), heading (rad) |
//! | `frontier.npy` | f32 `[N,8,2]` | centres of the frontier's pieces (m, same frame), nearest first, NaN where there are no more |
//! | `source.npy` | i64 `[N]` | seed of the maze, or place of the map in the manifest's list |
//! | `family.npy` | u8 `[N]` | 0 thin, 1 solid, 2 branching, 3 map file |
//! | `kind.npy` | u8 `[N]` | 0 one scan, 1 the map along a drive |
//! | `lidar.npy` | f32 `[N]` | range of the lidar (m) |
//!
//! `manifest.json` holds every setting and the SHA-256 of every array. The bytes follow from the
//! settings alone, whatever the number of threads.

mod arrays;
mod maps;
mod npy;
mod place;
mod scenes;
mod settings;
mod stored;
mod truth;
mod worlds;

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

pub use maps::{find_maps, map_hash};
pub use npy::{sha256, sha256_of_file};
pub use scenes::{FRONTIER_CELLS_MIN, FRONTIERS, Kind, Scene};
pub use settings::Settings;
pub use stored::{SceneRow, Stored};
pub use truth::{NO_TARGET, Truth};

use crate::mapfile::MapFileError;
use crate::predict::lattice::CROP_CELLS;
use crate::sim::maze::MazeError;
use arrays::Files;
use worlds::Worlds;

/// Mazes from this seed on are held out: no network is trained on them.
pub const HELD_OUT_FROM: u64 = 1_000_000;

/// Number of a map file in `family.npy`; mazes have the number of their [`Family`].
pub const FAMILY_MAP: u8 = 3;

/// Format of the folder.
pub const FORMAT_VERSION: u32 = 1;

/// A map of the data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapEntry {
    /// The YAML file, as it was found.
    pub file: String,
    /// SHA-256 of its cells: three states, size, cell size and origin.
    pub sha256: String,
    /// Scenes taken in it; none if no car fits.
    pub scenes: usize,
}

/// One array of the data set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ArrayEntry {
    /// File in the folder.
    pub file: String,
    /// SHA-256 of the file.
    pub sha256: String,
}

/// `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// [`FORMAT_VERSION`].
    pub format_version: u32,
    /// The program's version.
    pub apexd: String,
    /// Number of scenes.
    pub scenes: usize,
    /// Coarse cells along a side of the crop.
    pub crop_cells: usize,
    /// Everything that was asked for; `resolution_m`, `held_out` and the rest stand at the top
    /// level.
    #[serde(flatten)]
    pub settings: Settings,
    /// The maps, in the order of the numbers in `source.npy`.
    pub maps: Vec<MapEntry>,
    /// The arrays.
    pub arrays: Vec<ArrayEntry>,
}

/// Why a data set cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder is in use.
    #[error("{} is not empty; --force writes into it all the same", .path.display())]
    NotEmpty {
        /// The folder.
        path: PathBuf,
    },
    /// The file system refuses.
    #[error("{}: {error}", .path.display())]
    File {
        /// File or folder.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// No worlds.
    #[error("there is no world to take scenes in: give --seeds, --maps or both")]
    NoWorlds,
    /// Mazes that are kept for scoring.
    #[error(
        "seeds {from} to {last} reach into those from {HELD_OUT_FROM} up, which are held out; \
         data for scoring are made with --held-out"
    )]
    HeldOut {
        /// First seed.
        from: u64,
        /// Last seed.
        last: u64,
    },
    /// Mazes that networks are trained on.
    #[error(
        "--held-out takes seeds from {HELD_OUT_FROM} up, but the first one given is {from}: a \
         network may have been trained on it"
    )]
    NotHeldOut {
        /// First seed.
        from: u64,
    },
    /// A setting is out of range.
    #[error("{name} is {value}, but must be {allowed}")]
    Setting {
        /// The setting.
        name: &'static str,
        /// Its value.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// A maze cannot be made.
    #[error(transparent)]
    Maze(#[from] MazeError),
    /// A map cannot be read.
    #[error(transparent)]
    Map(#[from] MapFileError),
    /// A folder given for maps has none.
    #[error("{} holds no map (a YAML file of ROS map_server)", .path.display())]
    NoMaps {
        /// The folder.
        path: PathBuf,
    },
    /// A file of a data set is not what it should be.
    #[error("{}: {why}", .path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong, and what is wanted.
        why: String,
    },
    /// No scene came about.
    #[error("no car with a clearance of {clearance_m} m fits into any of the worlds")]
    NoRoom {
        /// The clearance, metres.
        clearance_m: f64,
    },
}

/// Makes a data set in a folder; `progress` hears now and then how many scenes of how many are
/// done.
///
/// # Errors
/// If the settings are impossible, a map cannot be read, or the folder cannot be written.
pub fn generate(
    settings: &Settings,
    map_folders: &[PathBuf],
    out: &Path,
    force: bool,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Manifest, DatasetError> {
    let worlds = Worlds::new(settings, map_folders)?;
    prepare_folder(out, force)?;

    let mut files = Files::create(out)?;
    let mut entries: Vec<MapEntry> = Vec::new();
    let mut scenes = 0;
    worlds.for_each(progress, &mut |world| {
        scenes += world.scenes.len();
        entries.extend(world.entry);
        files.push((world.family, world.number), &world.scenes)
    })?;
    if scenes == 0 {
        return Err(DatasetError::NoRoom { clearance_m: settings.clearance_m });
    }
    let manifest = Manifest {
        format_version: FORMAT_VERSION,
        apexd: env!("CARGO_PKG_VERSION").to_owned(),
        scenes,
        crop_cells: CROP_CELLS,
        settings: settings.clone(),
        maps: entries,
        arrays: files.finish()?,
    };
    let path = out.join("manifest.json");
    let text = serde_json::to_string_pretty(&manifest).expect("a manifest is plain data");
    std::fs::write(&path, text + "\n").map_err(|error| DatasetError::File { path, error })?;
    Ok(manifest)
}

/// Makes the scenes that [`generate`] would write, and hands them out one by one, with the maps'
/// entries at the end.
///
/// # Errors
/// If the settings are impossible, a map cannot be read, or no car fits anywhere.
pub fn scenes(
    settings: &Settings,
    map_folders: &[PathBuf],
    progress: &(dyn Fn(usize, usize) + Sync),
    take: &mut dyn FnMut(SceneRow),
) -> Result<Vec<MapEntry>, DatasetError> {
    let worlds = Worlds::new(settings, map_folders)?;
    let (mut count, mut entries) = (0, Vec::new());
    worlds.for_each(progress, &mut |world| {
        count += world.scenes.len();
        entries.extend(world.entry);
        let (family, source) = (world.family, world.number);
        for Scene { observed, truth, .. } in world.scenes {
            take(SceneRow { observed, truth, family, source });
        }
        Ok(())
    })?;
    if count == 0 {
        return Err(DatasetError::NoRoom { clearance_m: settings.clearance_m });
    }
    Ok(entries)
}

fn prepare_folder(out: &Path, force: bool) -> Result<(), DatasetError> {
    let fail = |error| DatasetError::File { path: out.to_owned(), error };
    std::fs::create_dir_all(out).map_err(fail)?;
    if !force && std::fs::read_dir(out).map_err(fail)?.next().is_some() {
        return Err(DatasetError::NotEmpty { path: out.to_owned() });
    }
    // The manifest comes last: without one, a data set is not finished.
    match std::fs::remove_file(out.join("manifest.json")) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => Err(fail(error)),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests;
