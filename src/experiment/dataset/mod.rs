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

mod npy;
mod place;
mod scenes;
mod stored;
mod truth;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use npy::{sha256, sha256_of_file};
pub use scenes::{FRONTIER_CELLS_MIN, FRONTIERS, Kind, Scene};
pub use stored::{SceneRow, Stored};
pub use truth::{NO_TARGET, Truth};

use crate::frames::Point;
use crate::mapfile::{self, MapFile, MapFileError};
use crate::predict::lattice::CROP_CELLS;
use crate::sim::maze::{self, Family, MazeError};
use crate::sim::world::World;
use npy::Element;
use place::Place;
use scenes::Surveyor;

/// Mazes from this seed on are held out: no network is trained on them.
pub const HELD_OUT_FROM: u64 = 1_000_000;

/// Number of a map file in `family.npy`; mazes have the number of their [`Family`].
pub const FAMILY_MAP: u8 = 3;

/// Format of the folder.
pub const FORMAT_VERSION: u32 = 1;

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

/// A world that scenes are to be taken in.
enum Source {
    Maze(Family, u64),
    Map(usize),
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
    let (sources, maps) = worlds(settings, map_folders)?;
    prepare_folder(out, force)?;

    let mut files = Files::create(out)?;
    let mut entries: Vec<MapEntry> = Vec::new();
    let mut scenes = 0;
    for_each_world(settings, &sources, &maps, progress, &mut |source, found, entry| {
        scenes += found.len();
        entries.extend(entry);
        files.push(source, &found)
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
    let (sources, maps) = worlds(settings, map_folders)?;
    let (mut count, mut entries) = (0, Vec::new());
    for_each_world(settings, &sources, &maps, progress, &mut |source, found, entry| {
        count += found.len();
        entries.extend(entry);
        for Scene { observed, truth, .. } in found {
            let (family, source) = (source.family(), source.number());
            take(SceneRow { observed, truth, family, source });
        }
        Ok(())
    })?;
    if count == 0 {
        return Err(DatasetError::NoRoom { clearance_m: settings.clearance_m });
    }
    Ok(entries)
}

/// The worlds that the settings name, checked.
fn worlds(
    settings: &Settings,
    map_folders: &[PathBuf],
) -> Result<(Vec<Source>, Vec<(PathBuf, MapFile)>), DatasetError> {
    let families = check(settings)?;
    let maps = find_maps(map_folders)?;
    let mut sources = Vec::new();
    for seed in settings.seeds[0]..settings.seeds[1] {
        sources.extend(families.iter().map(|family| Source::Maze(*family, seed)));
    }
    sources.extend((0..maps.len()).map(Source::Map));
    if sources.is_empty() { Err(DatasetError::NoWorlds) } else { Ok((sources, maps)) }
}

/// Takes the scenes of all worlds on all threads, and hands them out in order.
fn for_each_world(
    settings: &Settings,
    sources: &[Source],
    maps: &[(PathBuf, MapFile)],
    progress: &(dyn Fn(usize, usize) + Sync),
    take: &mut dyn FnMut(&Source, Vec<Scene>, Option<MapEntry>) -> Result<(), DatasetError>,
) -> Result<(), DatasetError> {
    let total = sources.len() * settings.scenes_per_world;
    let done = AtomicUsize::new(0);
    // A hundred or two megabytes at a time.
    let batch = (8192 / settings.scenes_per_world).clamp(2, 256);
    for batch in sources.chunks(batch) {
        let made: Result<Vec<_>, DatasetError> = batch
            .par_iter()
            .map(|source| {
                let (found, entry) = survey(settings, source, maps)?;
                let made = settings.scenes_per_world;
                progress(done.fetch_add(made, Ordering::Relaxed) + made, total);
                Ok((source, found, entry))
            })
            .collect();
        for (source, found, entry) in made? {
            take(source, found, entry)?;
        }
    }
    Ok(())
}

/// Checks the numbers, and gives the families.
fn check(settings: &Settings) -> Result<Vec<Family>, DatasetError> {
    let refuse = |name, value: String, allowed| Err(DatasetError::Setting { name, value, allowed });
    let mut families = Vec::new();
    for name in &settings.families {
        match Family::from_name(name) {
            Some(family) if !families.contains(&family) => families.push(family),
            Some(_) => return refuse("a family", name.clone(), "named once"),
            None => return refuse("a family", name.clone(), "thin, solid or branching"),
        }
    }
    let [from, end] = settings.seeds;
    if end < from || end >= 1 << 48 {
        return refuse("the range of seeds", format!("{from}..{end}"), "ascending, below 2^48");
    }
    if from < end && settings.held_out && from < HELD_OUT_FROM {
        return Err(DatasetError::NotHeldOut { from });
    }
    if from < end && !settings.held_out && end > HELD_OUT_FROM {
        return Err(DatasetError::HeldOut { from, last: end - 1 });
    }
    let within = |v: f64, low: f64, high: f64| v >= low && v <= high;
    if !(1..=100_000).contains(&settings.scenes_per_world) {
        let value = settings.scenes_per_world.to_string();
        return refuse("the number of scenes a world", value, "1 to 100000");
    }
    if !within(settings.resolution_m, 0.1, 1.0) {
        let value = settings.resolution_m.to_string();
        return refuse("the resolution", value, "0.1 to 1 m");
    }
    if !within(settings.along_drive, 0.0, 1.0) {
        let value = settings.along_drive.to_string();
        return refuse("the share along drives", value, "0 to 1");
    }
    if !within(settings.drive_max_m, 1.0, 1000.0) {
        return refuse("the longest drive", settings.drive_max_m.to_string(), "1 to 1000 m");
    }
    if !within(settings.clearance_m, 0.2, 1.0) {
        return refuse("the clearance", settings.clearance_m.to_string(), "0.2 to 1 m");
    }
    if !(64..=4096).contains(&settings.beams) {
        return refuse("the number of beams", settings.beams.to_string(), "64 to 4096");
    }
    if settings.lidar_ranges_m.is_empty() {
        return refuse("the list of lidar ranges", "empty".into(), "one range or more");
    }
    if let Some(range) = settings.lidar_ranges_m.iter().find(|r| !within(**r, 1.0, 30.0)) {
        return refuse("the lidar range", range.to_string(), "1 to 30 m");
    }
    if from < end {
        // Said before the first scene, and not after an hour.
        maze::generate(Family::Solid, from, settings.world_resolution_m)?;
    }
    Ok(if from < end { families } else { Vec::new() })
}

/// All maps in some folders, with the names of their files: a YAML file that is something else is
/// passed over.
pub fn find_maps(folders: &[PathBuf]) -> Result<Vec<(PathBuf, MapFile)>, DatasetError> {
    let mut maps = Vec::new();
    for folder in folders {
        let mut files = Vec::new();
        if folder.is_file() {
            files.push(folder.clone());
        } else {
            collect_yaml(folder, &mut files)?;
        }
        let before = maps.len();
        for file in files {
            match mapfile::load(&file) {
                Ok(map) => maps.push((file, map)),
                Err(MapFileError::NotAMap { .. }) => {
                    tracing::info!(file = %file.display(), "not a map, passed over");
                }
                Err(error) => return Err(error.into()),
            }
        }
        if maps.len() == before {
            return Err(DatasetError::NoMaps { path: folder.clone() });
        }
    }
    Ok(maps)
}

fn collect_yaml(folder: &Path, files: &mut Vec<PathBuf>) -> Result<(), DatasetError> {
    let fail = |error| DatasetError::File { path: folder.to_owned(), error };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        paths.push(entry.map_err(fail)?.path());
    }
    paths.sort();
    for path in paths {
        if path.is_dir() {
            collect_yaml(&path, files)?;
        } else if path.extension().is_some_and(|e| e == "yaml" || e == "yml") {
            files.push(path);
        }
    }
    Ok(())
}

fn prepare_folder(out: &Path, force: bool) -> Result<(), DatasetError> {
    let fail = |error| DatasetError::File { path: out.to_owned(), error };
    std::fs::create_dir_all(out).map_err(fail)?;
    if !force && std::fs::read_dir(out).map_err(fail)?.next().is_some() {
        return Err(DatasetError::NotEmpty { path: out.to_owned() });
    }
    Ok(())
}

/// The scenes of one world, and its entry if it is a map.
fn survey(
    settings: &Settings,
    source: &Source,
    maps: &[(PathBuf, MapFile)],
) -> Result<(Vec<Scene>, Option<MapEntry>), DatasetError> {
    let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
    rng.set_stream(u64::from(source.family()) << 48 | source.number() as u64);
    let on_lattice = settings.world_resolution_m == settings.resolution_m;
    let place = |map: &MapFile, inside: Option<Point>| {
        Place::new(map, settings.resolution_m, settings.clearance_m, inside)
    };
    let mut place = match source {
        Source::Maze(family, seed) => {
            let maze = maze::generate(*family, *seed, settings.world_resolution_m)?;
            place(&maze.to_map_file(), Some(maze.start.position))
        }
        Source::Map(k) => {
            let map = &maps[*k].1;
            if on_lattice {
                let coarse = Truth::new(map, &World::from_map(map), settings.resolution_m);
                place(&coarse.to_map(), None)
            } else {
                place(map, None)
            }
        }
    };
    let map_resolution_m = if on_lattice {
        settings.resolution_m
    } else {
        crate::map::MapParams::default().resolution_m
    };
    let scenes = place.as_mut().map_or_else(Vec::new, |place| {
        Surveyor::new(settings, map_resolution_m).survey(place, settings.scenes_per_world, &mut rng)
    });
    let entry = match source {
        Source::Maze(..) => None,
        Source::Map(k) => {
            let (file, map) = &maps[*k];
            let file = file.display().to_string();
            if scenes.is_empty() {
                tracing::warn!(file, "no car fits into this map, it is left out");
            }
            Some(MapEntry { file, sha256: map_hash(map), scenes: scenes.len() })
        }
    };
    Ok((scenes, entry))
}

/// A hash of what a map says.
pub fn map_hash(map: &MapFile) -> String {
    let mut bytes = Vec::with_capacity(map.cells.len() + 64);
    let origin = map.origin;
    for v in [map.resolution_m, origin.position.x, origin.position.y, origin.heading_rad] {
        bytes.extend_from_slice(&v.to_le_bytes());
    }
    for v in [map.width, map.height] {
        bytes.extend_from_slice(&(v as u64).to_le_bytes());
    }
    bytes.extend(map.cells.iter().map(|cell| *cell as u8));
    sha256(&bytes)
}

impl Source {
    const fn family(&self) -> u8 {
        match self {
            Self::Maze(family, _) => *family as u8,
            Self::Map(_) => FAMILY_MAP,
        }
    }

    const fn number(&self) -> i64 {
        match self {
            Self::Maze(_, seed) => *seed as i64,
            Self::Map(k) => *k as i64,
        }
    }
}

/// The arrays while they are written.
struct Files {
    folder: PathBuf,
    /// In the order of [`ARRAYS`].
    writers: Vec<npy::Writer>,
}

/// File, element type and shape of a row.
const ARRAYS: [(&str, &str, &[usize]); 8] = [
    ("observed.npy", u8::DESCR, &[CROP_CELLS, CROP_CELLS]),
    ("truth.npy", u8::DESCR, &[CROP_CELLS, CROP_CELLS]),
    ("pose.npy", f32::DESCR, &[3]),
    ("frontier.npy", f32::DESCR, &[FRONTIERS, 2]),
    ("source.npy", i64::DESCR, &[]),
    ("family.npy", u8::DESCR, &[]),
    ("kind.npy", u8::DESCR, &[]),
    ("lidar.npy", f32::DESCR, &[]),
];

impl Files {
    fn create(folder: &Path) -> Result<Self, DatasetError> {
        let mut writers = Vec::new();
        for (name, descr, shape) in ARRAYS {
            let path = folder.join(name);
            let writer = npy::Writer::create(&path, descr, shape);
            writers.push(writer.map_err(|error| DatasetError::File { path, error })?);
        }
        Ok(Self { folder: folder.to_owned(), writers })
    }

    fn push(&mut self, source: &Source, scenes: &[Scene]) -> Result<(), DatasetError> {
        let [observed, truth, pose, frontier, number, family, kind, lidar] = &mut self.writers[..]
        else {
            unreachable!("there are eight arrays")
        };
        let mut put = |scene: &Scene| -> std::io::Result<()> {
            observed.push(&scene.observed)?;
            truth.push(&scene.truth)?;
            pose.push(&scene.pose)?;
            frontier.push(scene.frontiers.as_flattened())?;
            number.push(&[source.number()])?;
            family.push(&[source.family()])?;
            kind.push(&[scene.kind as u8])?;
            lidar.push(&[scene.lidar_range_m])
        };
        let path = &self.folder;
        scenes
            .iter()
            .try_for_each(&mut put)
            .map_err(|error| DatasetError::File { path: path.clone(), error })
    }

    fn finish(self) -> Result<Vec<ArrayEntry>, DatasetError> {
        let folder = self.folder;
        let finish = |(writer, (name, ..)): (npy::Writer, (&str, &str, &[usize]))| {
            let sha256 = writer.finish();
            let fail = |error| DatasetError::File { path: folder.join(name), error };
            Ok(ArrayEntry { file: name.to_owned(), sha256: sha256.map_err(fail)? })
        };
        self.writers.into_iter().zip(ARRAYS).map(finish).collect()
    }
}

#[cfg(test)]
mod tests;
