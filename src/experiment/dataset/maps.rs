//! Maps in folders.

use std::path::{Path, PathBuf};

use super::{DatasetError, sha256};
use crate::mapfile::{self, MapFile, MapFileError};

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
