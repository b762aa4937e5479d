//! What is scored, and where its scenes come from.

use std::path::PathBuf;

use super::EvaluateError;
use crate::experiment::dataset::{self, HELD_OUT_FROM, MapEntry, SceneRow, Settings, Stored};

/// Scenes to score on.
#[derive(Clone, Debug, PartialEq)]
pub enum SceneSource {
    /// Scenes made now.
    Made {
        /// How, and in which mazes.
        settings: Settings,
        /// Maps.
        maps: Vec<PathBuf>,
    },
    /// A data set written before.
    Stored {
        /// Its folder.
        folder: PathBuf,
        /// Most scenes to take of it.
        most: usize,
    },
}

/// One table: scenes to score on, and scenes to fit the baselines on.
#[derive(Clone, Debug, PartialEq)]
pub struct SetRequest {
    /// The scenes' name in tables.
    pub name: String,
    /// What is scored.
    pub scenes: SceneSource,
    /// What the baselines are fitted on; the scored scenes themselves if nothing is given, which
    /// flatters the baselines.
    pub fit: Option<SceneSource>,
}

/// What is scored, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Request {
    /// The tables.
    pub sets: Vec<SetRequest>,
    /// Radii of the discs around the frontier, metres.
    pub radii_m: Vec<f64>,
    /// Scenes of each set to keep for pictures.
    pub pictures: usize,
}

/// What a source of scenes is.
pub(super) struct Origin {
    pub settings: Settings,
    pub maps: Vec<MapEntry>,
    pub manifest_sha256: Option<String>,
    pub held_out: Option<bool>,
    pub text: String,
}

impl SceneSource {
    /// Number of scenes, at most.
    pub(super) fn count(&self) -> Result<usize, EvaluateError> {
        Ok(match self {
            Self::Made { settings, maps } => {
                let mazes = (settings.seeds[1] - settings.seeds[0]) as usize;
                let maps = dataset::find_maps(maps)?.len();
                (mazes * settings.families.len() + maps) * settings.scenes_per_world
            }
            Self::Stored { folder, most } => Stored::open(folder)?.manifest.scenes.min(*most),
        })
    }

    /// Training mazes in which scenes are taken as in these, to fit baselines on; `None` if these
    /// are not of mazes alone, or cannot be read.
    pub fn alike(&self, seeds: [u64; 2]) -> Option<Self> {
        let (settings, any_maps) = match self {
            Self::Made { settings, maps } => (settings.clone(), !maps.is_empty()),
            Self::Stored { folder, .. } => {
                let manifest = Stored::open(folder).ok()?.manifest;
                (manifest.settings, !manifest.maps.is_empty())
            }
        };
        let mazes = settings.seeds[0] < settings.seeds[1] && !any_maps;
        let scenes_per_world = settings.scenes_per_world.min(50);
        let settings = Settings { seeds, held_out: false, scenes_per_world, ..settings };
        mazes.then(|| Self::Made { settings, maps: Vec::new() })
    }

    /// The side of the scenes' cells, metres.
    pub fn resolution_m(&self) -> Result<f64, EvaluateError> {
        Ok(match self {
            Self::Made { settings, .. } => settings.resolution_m,
            Self::Stored { folder, .. } => Stored::open(folder)?.manifest.settings.resolution_m,
        })
    }

    /// Hands out all scenes, and says what they are.
    pub(super) fn for_each(
        &self,
        progress: &(dyn Fn(usize, usize) + Sync),
        take: &mut dyn FnMut(SceneRow),
    ) -> Result<Origin, EvaluateError> {
        match self {
            Self::Made { settings, maps } => {
                let entries = dataset::scenes(settings, maps, progress, take)?;
                let [from, end] = settings.seeds;
                let mazes = from < end;
                let held_out = mazes.then_some(from >= HELD_OUT_FROM);
                let held_out = if entries.is_empty() { held_out } else { None };
                let mut text = Vec::new();
                if mazes {
                    let families = settings.families.join(", ");
                    text.push(format!("{families} mazes, seeds {from}..{end}"));
                }
                if !entries.is_empty() {
                    text.push(format!("{} maps", entries.len()));
                }
                Ok(Origin {
                    settings: settings.clone(),
                    maps: entries,
                    manifest_sha256: None,
                    held_out,
                    text: text.join(" and "),
                })
            }
            Self::Stored { folder, most } => {
                let stored = Stored::open(folder)?;
                let total = stored.manifest.scenes.min(*most);
                let mut done = 0;
                stored.scenes(*most, &mut |row| {
                    take(row);
                    done += 1;
                    progress(done, total);
                })?;
                Ok(Origin {
                    held_out: Some(stored.manifest.settings.held_out),
                    settings: stored.manifest.settings,
                    maps: stored.manifest.maps,
                    text: format!("data set {}", &stored.manifest_sha256[..12]),
                    manifest_sha256: Some(stored.manifest_sha256),
                })
            }
        }
    }
}
