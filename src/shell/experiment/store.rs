//! The folder of an experiment.
//!
//! `results.jsonl` (with shards `results-I-of-N.jsonl`) gets a line for each drive as soon as it has
//! ended, `sessions.jsonl` one for each time the program worked on it.

use std::fs::{File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use crate::experiment::results::{Results, ResultsError, whole_lines};
use crate::experiment::run::Record;

/// What may go wrong with the folder.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file cannot be read or written.
    #[error("{}: {error}", .path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// Results make no sense, or contradict each other.
    #[error("{}: {error}", .path.display())]
    Results {
        /// Their file.
        path: PathBuf,
        /// What is wrong.
        error: Box<ResultsError>,
    },
}

/// One time that the program worked on an experiment.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Session {
    /// The command line, without what only says where results go.
    pub command: String,
    /// Name, version and hash of the program.
    pub program: String,
    /// Processor, cores, system.
    pub machine: String,
    /// When it began, UTC.
    pub began: String,
    /// Drives at a time.
    pub jobs: usize,
}

/// Where the results of a running experiment go.
pub struct Store {
    path: PathBuf,
    file: Mutex<File>,
}

impl Store {
    /// Opens the file for the results of a shard, or of all drives. What an interrupted writer left
    /// of a line is cut off.
    ///
    /// # Errors
    /// If the file cannot be read or written.
    pub fn open(folder: &Path, shard: Option<[u64; 2]>) -> Result<Self, StoreError> {
        let path = folder.join(format!("results{}.jsonl", suffix(shard)));
        let fail = |error| StoreError::File { path: path.clone(), error };
        let file =
            OpenOptions::new().create(true).read(true).append(true).open(&path).map_err(fail)?;
        let text = std::fs::read_to_string(&path).map_err(fail)?;
        file.set_len(whole_lines(&text).len() as u64).map_err(fail)?;
        Ok(Self { file: Mutex::new(file), path })
    }

    /// Writes a result down.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn append(&self, record: &Record) -> Result<(), StoreError> {
        let line = serde_json::to_string(record).expect("a record is plain data") + "\n";
        // A writer that panicked has written a whole line or none.
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let written = file.write_all(line.as_bytes()).and_then(|()| file.flush());
        written.map_err(|error| StoreError::File { path: self.path.clone(), error })
    }
}

fn suffix(shard: Option<[u64; 2]>) -> String {
    shard.map_or_else(String::new, |[i, n]| format!("-{i}-of-{n}"))
}

/// The results in a folder that `wanted` picks.
///
/// # Errors
/// If a file cannot be read, makes no sense or contradicts another.
pub fn read_results(
    results: &mut Results,
    folder: &Path,
    wanted: &dyn Fn(&Record) -> bool,
) -> Result<(), StoreError> {
    for path in files(folder, "results", ".jsonl")? {
        let text = read(&path)?;
        results
            .add_lines(&text, wanted)
            .map_err(|error| StoreError::Results { path, error: Box::new(error) })?;
    }
    Ok(())
}

/// The sessions noted in a folder.
///
/// # Errors
/// If a file cannot be read.
pub fn read_sessions(folder: &Path) -> Result<Vec<Session>, StoreError> {
    let mut sessions = Vec::new();
    for path in files(folder, "sessions", ".jsonl")? {
        let text = read(&path)?;
        // A session that cannot be read any longer is no reason to refuse the results.
        sessions.extend(whole_lines(&text).lines().filter_map(|l| serde_json::from_str(l).ok()));
    }
    Ok(sessions)
}

/// Notes a session.
///
/// # Errors
/// If the file cannot be written.
pub fn note_session(
    folder: &Path,
    shard: Option<[u64; 2]>,
    session: &Session,
) -> Result<(), StoreError> {
    let path = folder.join(format!("sessions{}.jsonl", suffix(shard)));
    let line = serde_json::to_string(session).expect("a session is plain data") + "\n";
    let file = OpenOptions::new().create(true).append(true).open(&path);
    file.and_then(|mut file| file.write_all(line.as_bytes()))
        .map_err(|error| StoreError::File { path, error })
}

/// Files of a folder by the beginning and the end of their names, in order.
///
/// # Errors
/// If the folder cannot be read.
pub fn files(folder: &Path, begin: &str, end: &str) -> Result<Vec<PathBuf>, StoreError> {
    let fail = |error| StoreError::File { path: folder.to_owned(), error };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(fail)? {
        let path = entry.map_err(fail)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if name.starts_with(begin) && name.ends_with(end) {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

fn read(path: &Path) -> Result<String, StoreError> {
    std::fs::read_to_string(path).map_err(|error| StoreError::File { path: path.to_owned(), error })
}
