//! Occupancy maps in the files of ROS `map_server`: a YAML file and the picture it names.
//!
//! Read as <https://wiki.ros.org/map_server> describes the format, with these choices where the
//! tools differ or a car wants the careful reading:
//!
//! - every mode ends in three states. `trinary` (the default) and `scale` share the thresholds;
//!   what `scale` would grade between them is [`MapCell::Unknown`]. In `raw` the pixel value is the
//!   occupancy itself: 0 to 100 per cent against the same thresholds, above 100 unknown;
//! - a pixel that is not fully opaque is unknown; an opaque one counts by the mean of its colour
//!   channels alone;
//! - `negate` missing means 0, the thresholds missing mean 0.65 and 0.196 (what `map_saver`
//!   writes: its unknown, 205, then lies between them); keys that are not named here are left
//!   alone;
//! - `origin` is the pose of the lower left corner of the lower left pixel in the map frame, and
//!   its yaw is honoured.

mod error;
mod metadata;
mod raster;

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

pub use error::MapFileError;

use crate::frames::Pose;

/// Most pixels that a map may have: 8192 by 8192, 410 m square at 0.05 m.
pub const PIXELS_MAX: u64 = 8192 * 8192;

/// Largest YAML file that is read. The longest in the wild have a few hundred bytes; anything
/// above this is some other file, and the YAML reader takes quadratic time on hostile nesting.
const YAML_BYTES_MAX: u64 = 16 * 1024;

/// Largest picture file that is read: [`PIXELS_MAX`] as text ("255 " each).
const IMAGE_BYTES_MAX: u64 = 4 * PIXELS_MAX + 4096;

/// What a map says of one cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum MapCell {
    /// No obstacle.
    Free,
    /// An obstacle.
    Occupied,
    /// Nobody has looked.
    Unknown,
}

/// A map as read from, or written to, a pair of files.
#[derive(Clone, Debug, PartialEq)]
pub struct MapFile {
    /// Side of a cell, metres.
    pub resolution_m: f64,
    /// Lower left corner of cell (0, 0) and direction of the rows, map frame.
    pub origin: Pose,
    /// Cells in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Row by row from the bottom (row 0 touches the origin), `width * height` cells.
    pub cells: Vec<MapCell>,
}

impl MapFile {
    /// The cell in column `ix` of row `iy`, counted from the origin; `None` outside the map.
    pub fn get(&self, ix: usize, iy: usize) -> Option<MapCell> {
        (ix < self.width && iy < self.height).then(|| self.cells[iy * self.width + ix])
    }
}

/// Reads a map: the YAML file at `path` and the picture it names.
///
/// # Errors
/// If a file cannot be read, is not what it should be, is cut off, is larger than
/// [`PIXELS_MAX`], or says something that a map cannot mean.
pub fn load(path: impl AsRef<Path>) -> Result<MapFile, MapFileError> {
    let path = path.as_ref();
    let bytes = read_limited(path, YAML_BYTES_MAX, "a map's YAML file")?;
    let text = std::str::from_utf8(&bytes).map_err(|_| MapFileError::NotAMap {
        path: path.to_owned(),
        reason: "it is not text (give the YAML file, not the picture)".into(),
    })?;
    let metadata = metadata::parse(path, text)?;
    let image = path.parent().unwrap_or(Path::new("")).join(&metadata.image);
    let bytes = read_limited(&image, IMAGE_BYTES_MAX, "a map's picture")?;
    let raster = raster::decode(&image, &bytes)?;
    Ok(MapFile {
        resolution_m: metadata.resolution_m,
        origin: metadata.origin,
        width: raster.width,
        height: raster.height,
        cells: raster.classify(&metadata),
    })
}

/// Writes a map: the YAML file at `path` and, beside it and under the same name, a binary PGM with
/// `map_saver`'s values (254 free, 205 unknown, 0 occupied).
///
/// # Errors
/// If the path does not end in `.yaml` or `.yml`, the map is not one that [`load`] would read
/// back, or a file cannot be written.
pub fn save(path: impl AsRef<Path>, map: &MapFile) -> Result<(), MapFileError> {
    let path = path.as_ref();
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let (true, Some(stem)) =
        (matches!(extension, "yaml" | "yml"), path.file_stem().and_then(|s| s.to_str()))
    else {
        return Err(MapFileError::Invalid {
            path: path.to_owned(),
            key: "the file's name",
            value: path.display().to_string(),
            allowed: "a name that ends in .yaml or .yml",
        });
    };
    let invalid = |key, value: String, allowed| {
        Err(MapFileError::Invalid { path: path.to_owned(), key, value, allowed })
    };
    let pixels = map.width as u64 * map.height as u64;
    if pixels == 0 || pixels > PIXELS_MAX || map.cells.len() as u64 != pixels {
        return invalid(
            "the map's size",
            format!("{} x {} with {} cells", map.width, map.height, map.cells.len()),
            "1 to 67108864 cells, as many as width x height",
        );
    }
    if !metadata::resolution_is_allowed(map.resolution_m) {
        return invalid("resolution", map.resolution_m.to_string(), metadata::RESOLUTION_ALLOWED);
    }
    let image: PathBuf = path.with_extension("pgm");
    let written = |path: &Path, bytes: &[u8]| {
        std::fs::write(path, bytes)
            .map_err(|source| MapFileError::Write { path: path.to_owned(), source })
    };
    written(&image, &raster::encode(map))?;
    written(path, metadata::text(map, &format!("{stem}.pgm")).as_bytes())
}

/// The whole file, unless it holds more than `limit` bytes.
fn read_limited(path: &Path, limit: u64, what: &'static str) -> Result<Vec<u8>, MapFileError> {
    let read = |source| MapFileError::Read { path: path.to_owned(), source };
    let file = File::open(path).map_err(read)?;
    // Not the size that the file system states: a pipe or a device has none.
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(read)?;
    if bytes.len() as u64 > limit {
        return Err(MapFileError::FileTooLarge { path: path.to_owned(), limit, what });
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests;
