//! What can be wrong with a map file.

use std::path::PathBuf;

/// Why a map could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum MapFileError {
    /// The file could not be opened or read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// The YAML file or the picture.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file could not be written.
    #[error("cannot write {path}: {source}")]
    Write {
        /// The YAML file or the picture.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file holds more bytes than a map can need.
    #[error("{path} has more than {limit} bytes, the most that {what} may have")]
    FileTooLarge {
        /// The YAML file or the picture.
        path: PathBuf,
        /// Most bytes allowed.
        limit: u64,
        /// What it was read as.
        what: &'static str,
    },
    /// The YAML file is not one.
    #[error(
        "{path} is not a map file: {reason}; wanted is the YAML file of a ROS map_server map with \
         the keys image, resolution and origin"
    )]
    NotAMap {
        /// The file.
        path: PathBuf,
        /// What it is instead.
        reason: String,
    },
    /// A key that every map needs is not there.
    #[error("{path}: {key} is missing; it must be {allowed}")]
    Missing {
        /// The YAML file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What it may be.
        allowed: &'static str,
    },
    /// A value that a map cannot have.
    #[error("{path}: {key} is {value}, but must be {allowed}")]
    Invalid {
        /// The YAML file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What it says.
        value: String,
        /// What it may be.
        allowed: &'static str,
    },
    /// The picture cannot be decoded.
    #[error("{path}: {reason}")]
    Image {
        /// The picture.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The picture has more pixels than are read.
    #[error("{path} has {width} x {height} pixels; at most {limit} are read")]
    TooManyPixels {
        /// The picture.
        path: PathBuf,
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Most pixels allowed.
        limit: u64,
    },
}
