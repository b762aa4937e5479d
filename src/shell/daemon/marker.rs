//! A file that is there while the daemon runs: found at the start, it tells of a run that ended
//! without saying so.

use std::path::{Path, PathBuf};

/// The file's name in the state directory.
const NAME: &str = "running";

/// The file of this run; [`remove`](Self::remove) it only when the car stands.
#[derive(Debug)]
pub struct Marker {
    file: PathBuf,
    /// The run before left one.
    pub after_crash: bool,
}

impl Marker {
    /// Looks for the file of an earlier run and leaves its own.
    pub fn set(directory: &Path) -> std::io::Result<Self> {
        let file = directory.join(NAME);
        let after_crash = file.try_exists()?;
        if after_crash {
            // Another user's, say, of a run by hand: it cannot be written over, but taken away. Where
            // it can't be, it is a mark all the same.
            let _ = std::fs::remove_file(&file);
        }
        match std::fs::write(&file, format!("{}\n", std::process::id())) {
            Err(error) if !after_crash => Err(error),
            _ => Ok(Self { file, after_crash }),
        }
    }

    /// The run has ended as it should.
    pub fn remove(self) -> std::io::Result<()> {
        std::fs::remove_file(self.file)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_did_not_end_is_noticed_and_one_that_did_is_not() {
        let directory = tempfile::tempdir().unwrap();
        let first = Marker::set(directory.path()).unwrap();
        assert!(!first.after_crash);
        drop(first);
        let second = Marker::set(directory.path()).unwrap();
        assert!(second.after_crash);
        second.remove().unwrap();
        // One that cannot be written: a folder stands in its place.
        std::fs::create_dir(directory.path().join(NAME)).unwrap();
        assert!(Marker::set(directory.path()).unwrap().after_crash);
        std::fs::remove_dir(directory.path().join(NAME)).unwrap();
        assert!(!Marker::set(directory.path()).unwrap().after_crash);
        assert!(Marker::set(&directory.path().join("none")).is_err());
    }
}
