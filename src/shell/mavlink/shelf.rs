//! The folder of logs, to be read by ground stations. Links in it lead nowhere: what lies outside
//! stays outside.

use std::fs::{self, File};
use std::os::unix::fs::{FileExt, OpenOptionsExt};
use std::path::PathBuf;

use crate::ground::{Shelf, ShelfEntry, ShelfFault, Volume};

/// The name under which the folder is shown.
const NAME: &str = "logs";
/// More entries of a folder are not shown.
const ENTRIES_MAX: usize = 2000;

/// A shelf with one folder, or none.
pub struct Folders {
    logs: Option<PathBuf>,
}

impl Folders {
    /// With that folder, which need not be there yet.
    pub const fn new(logs: Option<PathBuf>) -> Self {
        Self { logs }
    }

    /// Where a name is, looked at part by part: no part may be a link.
    fn find(&self, parts: &[&str]) -> Result<PathBuf, ShelfFault> {
        let Some((&NAME, inner)) = parts.split_first() else { return Err(ShelfFault::NotFound) };
        let mut path = self.logs.clone().ok_or(ShelfFault::NotFound)?;
        for part in inner {
            let plain = !part.is_empty() && !part.starts_with('.') && !part.contains(['/', '\0']);
            if !plain {
                return Err(ShelfFault::NotFound);
            }
            path.push(part);
            let kind = fs::symlink_metadata(&path).map_err(|_| ShelfFault::NotFound)?.file_type();
            if !kind.is_dir() && !kind.is_file() {
                return Err(ShelfFault::NotFound);
            }
        }
        Ok(path)
    }
}

impl Shelf for Folders {
    fn list(&self, folder: &[&str]) -> Result<Vec<ShelfEntry>, ShelfFault> {
        if folder.is_empty() {
            let there = self.logs.as_ref().is_some_and(|logs| logs.is_dir());
            return Ok(there.then(|| ShelfEntry::Folder(NAME.into())).into_iter().collect());
        }
        let path = self.find(folder)?;
        let mut entries = Vec::new();
        for entry in fs::read_dir(path).map_err(|_| ShelfFault::NotFound)?.flatten() {
            let (Ok(name), Ok(about)) = (entry.file_name().into_string(), entry.metadata()) else {
                continue;
            };
            // Neither hidden ones nor any that would break the list's own form.
            if name.starts_with('.') || name.contains(['\t', '\n']) {
                continue;
            }
            if about.is_dir() {
                entries.push(ShelfEntry::Folder(name));
            } else if about.is_file() {
                entries.push(ShelfEntry::File(name, about.len()));
            }
            if entries.len() >= ENTRIES_MAX {
                break;
            }
        }
        let name = |entry: &ShelfEntry| match entry {
            ShelfEntry::File(name, _) | ShelfEntry::Folder(name) => name.clone(),
        };
        entries.sort_by_key(name);
        Ok(entries)
    }

    fn open(&self, file: &[&str]) -> Result<Box<dyn Volume>, ShelfFault> {
        let path = self.find(file)?;
        let not_through_links = nix::fcntl::OFlag::O_NOFOLLOW | nix::fcntl::OFlag::O_NONBLOCK;
        let file = fs::OpenOptions::new()
            .read(true)
            .custom_flags(not_through_links.bits())
            .open(path)
            .map_err(|_| ShelfFault::NotFound)?;
        let about = file.metadata().map_err(|_| ShelfFault::Unreadable)?;
        if !about.is_file() {
            return Err(ShelfFault::NotFound);
        }
        Ok(Box::new(Log { file, size: about.len() }))
    }
}

/// An open log.
struct Log {
    file: File,
    size: u64,
}

impl Volume for Log {
    fn size(&self) -> u64 {
        self.size
    }

    fn read(&mut self, offset: u64, into: &mut [u8]) -> Result<usize, ShelfFault> {
        self.file.read_at(into, offset).map_err(|_| ShelfFault::Unreadable)
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn logs_are_shown_and_read_and_nothing_else_is() {
        let folder = tempfile::tempdir().unwrap();
        let logs = folder.path().join("logs");
        fs::create_dir_all(logs.join("day")).unwrap();
        fs::write(folder.path().join("secret"), "key").unwrap();
        fs::write(logs.join("a.log"), "one two").unwrap();
        fs::write(logs.join(".hidden"), "x").unwrap();
        symlink(folder.path().join("secret"), logs.join("link")).unwrap();
        symlink(folder.path(), logs.join("up")).unwrap();
        let shelf = Folders::new(Some(logs));
        assert_eq!(shelf.list(&[]).unwrap(), [ShelfEntry::Folder("logs".into())]);
        assert_eq!(
            shelf.list(&["logs"]).unwrap(),
            [ShelfEntry::File("a.log".into(), 7), ShelfEntry::Folder("day".into())]
        );
        let mut log = shelf.open(&["logs", "a.log"]).unwrap();
        let mut bytes = [0; 16];
        assert_eq!((log.size(), log.read(4, &mut bytes)), (7, Ok(3)));
        assert_eq!(&bytes[..3], b"two");
        assert_eq!(log.read(99, &mut bytes), Ok(0));
        for path in [
            &["logs", "link"][..],
            &["logs", "up", "secret"],
            &["logs", "..", "secret"],
            &["logs", ".hidden"],
            &["logs", "day"],
            &["logs", "a.log", "x"],
            &["logs", "/etc/passwd"],
            &["etc", "passwd"],
            &["logs"],
            &[],
        ] {
            assert!(shelf.open(path).is_err(), "{path:?}");
        }
        assert!(shelf.list(&["logs", "up"]).is_err());
        assert_eq!(Folders::new(None).list(&[]), Ok(Vec::new()));
        assert!(Folders::new(None).list(&["logs"]).is_err());
    }
}
