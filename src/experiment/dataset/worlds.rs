//! The worlds of a data set, and the scenes taken in each.

use std::path::PathBuf;
use std::sync::atomic::{AtomicUsize, Ordering};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

use super::maps::{find_maps, map_hash};
use super::place::Place;
use super::scenes::Surveyor;
use super::{DatasetError, FAMILY_MAP, MapEntry, Scene, Settings, Truth};
use crate::frames::Point;
use crate::map::MapParams;
use crate::mapfile::MapFile;
use crate::sim::maze::{self, Family};
use crate::sim::world::World;

/// A world that scenes are to be taken in.
enum Source {
    Maze(Family, u64),
    Map(usize),
}

/// The worlds that settings name.
pub(super) struct Worlds<'a> {
    settings: &'a Settings,
    sources: Vec<Source>,
    maps: Vec<(PathBuf, MapFile)>,
}

/// What has been taken in one world.
pub(super) struct Surveyed {
    /// As in `family.npy`.
    pub family: u8,
    /// As in `source.npy`.
    pub number: i64,
    /// The scenes; none in a map that no car fits into.
    pub scenes: Vec<Scene>,
    /// The entry of a map.
    pub entry: Option<MapEntry>,
}

impl<'a> Worlds<'a> {
    /// Checks the settings, and reads the maps.
    pub fn new(settings: &'a Settings, map_folders: &[PathBuf]) -> Result<Self, DatasetError> {
        let families = settings.check()?;
        let maps = find_maps(map_folders)?;
        let mut sources = Vec::new();
        for seed in settings.seeds[0]..settings.seeds[1] {
            sources.extend(families.iter().map(|family| Source::Maze(*family, seed)));
        }
        sources.extend((0..maps.len()).map(Source::Map));
        if sources.is_empty() {
            return Err(DatasetError::NoWorlds);
        }
        Ok(Self { settings, sources, maps })
    }

    /// Takes the scenes of all worlds on all threads, and hands them out world by world, in order.
    pub fn for_each(
        &self,
        progress: &(dyn Fn(usize, usize) + Sync),
        take: &mut dyn FnMut(Surveyed) -> Result<(), DatasetError>,
    ) -> Result<(), DatasetError> {
        let each = self.settings.scenes_per_world;
        let total = self.sources.len() * each;
        let done = AtomicUsize::new(0);
        // One or two hundred megabytes at a time, but work for every thread.
        let batch = (8192 / each).max(rayon::current_num_threads()).clamp(2, 256);
        for batch in self.sources.chunks(batch) {
            let surveyed: Result<Vec<Surveyed>, DatasetError> = batch
                .par_iter()
                .map(|source| {
                    let surveyed = self.survey(source)?;
                    progress(done.fetch_add(each, Ordering::Relaxed) + each, total);
                    Ok(surveyed)
                })
                .collect();
            for world in surveyed? {
                take(world)?;
            }
        }
        Ok(())
    }

    fn survey(&self, source: &Source) -> Result<Surveyed, DatasetError> {
        let settings = self.settings;
        let (family, number) = (source.family(), source.number());
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        rng.set_stream(u64::from(family) << 48 | number as u64);
        let on_lattice = settings.world_resolution_m == settings.resolution_m;
        let place = |map: &MapFile, inside: Option<Point>| {
            Place::new(map, settings.resolution_m, settings.clearance_m, inside)
        };
        let mut place = match source {
            Source::Maze(family, seed) => {
                let maze = maze::generate(*family, *seed, settings.world_resolution_m)?;
                place(&maze.to_map_file(), Some(maze.start.position))
            }
            Source::Map(k) if on_lattice => {
                let map = &self.maps[*k].1;
                let coarse = Truth::new(map, &World::from_map(map), settings.resolution_m);
                place(&coarse.to_map(), None)
            }
            Source::Map(k) => place(&self.maps[*k].1, None),
        };
        let map_resolution_m =
            if on_lattice { settings.resolution_m } else { MapParams::default().resolution_m };
        let scenes = place.as_mut().map_or_else(Vec::new, |place| {
            let mut surveyor = Surveyor::new(settings, map_resolution_m);
            surveyor.survey(place, settings.scenes_per_world, &mut rng)
        });
        let entry = match source {
            Source::Maze(..) => None,
            Source::Map(k) => {
                let (file, map) = &self.maps[*k];
                let file = file.display().to_string();
                if scenes.is_empty() {
                    tracing::warn!(file, "no car fits into this map, it is left out");
                }
                Some(MapEntry { file, sha256: map_hash(map), scenes: scenes.len() })
            }
        };
        Ok(Surveyed { family, number, scenes, entry })
    }
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
