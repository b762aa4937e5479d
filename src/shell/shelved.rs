//! A folder of logs: names, parts, and which ones make room for new ones.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// What the names of logs end with.
pub const EXTENSION: &str = "mcap";
/// What stands before the number of a further part.
const PART: &str = "-part";
/// No part is shorter because the disk is small, bytes.
const PART_MIN: u64 = 1_000_000;

/// How much is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// A part that is longer is followed by another one, bytes. No more than half of what is kept.
    pub part_bytes: u64,
    /// All files together, bytes.
    pub kept_bytes: u64,
    /// Number of files.
    pub kept_files: usize,
    /// Free space to be left on the disk, bytes.
    pub free_min: u64,
}

/// The file of a further part of a log, by the file of its first one.
pub fn part_of(first: &Path, part: u32) -> PathBuf {
    if part < 2 {
        return first.to_owned();
    }
    let stem = first.file_stem().unwrap_or_default().to_string_lossy();
    let extension = first.extension().unwrap_or_default().to_string_lossy();
    let dot = if extension.is_empty() { "" } else { "." };
    first.with_file_name(format!("{stem}{PART}{part}{dot}{extension}"))
}

/// Deletes the oldest logs until there is room for one more part, and gives the length that it may
/// have, bytes. Nothing else is touched, nor is `kept`.
pub fn make_room(folder: &Path, limits: Limits, kept: Option<&Path>) -> u64 {
    make_room_on(folder, limits, kept, available)
}

/// The same, on a disk whose free space is known.
fn make_room_on(
    folder: &Path,
    limits: Limits,
    kept: Option<&Path>,
    available: impl Fn(&Path) -> u64,
) -> u64 {
    let mut logs = logs(folder);
    // The clock on the wall may have been wrong when a log was begun, and right when it ended.
    logs.sort_by(|a, b| (a.modified, &a.order).cmp(&(b.modified, &b.order)));
    let mut bytes: u64 = logs.iter().map(|log| log.length).sum();
    let mut count = logs.len();
    logs.retain(|log| Some(&*log.path) != kept);
    // What can be had at all is shared by the next part and those before: a part that took all of it
    // would leave nothing of any other run.
    let others: u64 = logs.iter().map(|log| log.length).sum();
    let spare = available(folder).saturating_add(others).saturating_sub(limits.free_min);
    let part_bytes = limits.part_bytes.min(limits.kept_bytes / 2).min((spare / 2).max(PART_MIN));
    // Where all of them together would not be enough, none is worth it.
    let least = if spare == 0 { 0 } else { part_bytes.min(spare).saturating_add(limits.free_min) };
    for log in logs {
        let fits = bytes.saturating_add(part_bytes) <= limits.kept_bytes;
        if fits && count < limits.kept_files && available(folder) >= least {
            break;
        }
        match fs::remove_file(&log.path) {
            Ok(()) => tracing::info!("deleted the log {}", log.path.display()),
            Err(error) => tracing::warn!("cannot delete the log {}: {error}", log.path.display()),
        }
        // One that cannot be deleted is no reason to delete all others.
        bytes = bytes.saturating_sub(log.length);
        count -= 1;
    }
    part_bytes
}

/// Free space, bytes; without end where it cannot be told: nothing is deleted then.
fn available(folder: &Path) -> u64 {
    nix::sys::statvfs::statvfs(folder)
        .map_or(u64::MAX, |disk| disk.blocks_available() * disk.fragment_size())
}

/// A file of a log.
struct Shelved {
    modified: SystemTime,
    order: (String, u32),
    path: PathBuf,
    length: u64,
}

fn logs(folder: &Path) -> Vec<Shelved> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let logs = entries.filter_map(|entry| {
        let order = order(entry.file_name().to_str()?)?;
        let about = entry.metadata().ok().filter(fs::Metadata::is_file)?;
        let modified = about.modified().unwrap_or(SystemTime::UNIX_EPOCH);
        Some(Shelved { modified, order, path: entry.path(), length: about.len() })
    });
    logs.collect()
}

/// Whether there is any part of a log whose first file has this name, without its extension.
pub fn is_taken(folder: &Path, stem: &str) -> bool {
    logs(folder).iter().any(|log| log.order.0 == stem)
}

/// What the name of a log of ours says: what all its parts are named after, and which it is.
fn order(name: &str) -> Option<(String, u32)> {
    let stem = name.strip_suffix(EXTENSION)?.strip_suffix('.')?;
    let (start, part) = match stem.split_once(PART) {
        Some((start, part)) => (start, part.parse().ok()?),
        None => (stem, 1),
    };
    let time = start.as_bytes().get(..16)?;
    let is_time = time.iter().enumerate().all(|(i, byte)| match i {
        8 => *byte == b'T',
        15 => *byte == b'Z',
        _ => byte.is_ascii_digit(),
    });
    let again = &start[16..];
    let is_ours = again.is_empty()
        || again.strip_prefix('-').is_some_and(|number| number.parse::<u32>().is_ok());
    (is_time && is_ours).then(|| (start.to_owned(), part))
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    #[test]
    fn only_names_that_we_give_are_ours() {
        for (name, wanted) in [
            ("20260131T235959Z.mcap", Some(("20260131T235959Z", 1))),
            ("20260131T235959Z-2.mcap", Some(("20260131T235959Z-2", 1))),
            ("20260131T235959Z-part12.mcap", Some(("20260131T235959Z", 12))),
            ("20260131T235959Z-2-part3.mcap", Some(("20260131T235959Z-2", 3))),
            ("20260131T235959Z.mcap.bak", None),
            ("20260131T235959Z", None),
            ("notes.mcap", None),
            ("20260131T235959Zé.mcap", None),
            ("2026013éT35959Z.mcap", None),
            ("20260131T235959Z-partx.mcap", None),
        ] {
            let wanted = wanted.map(|(start, part)| (start.to_owned(), part));
            assert_eq!(order(name), wanted, "{name}");
        }
        let first = Path::new("logs/20260131T235959Z.mcap");
        assert_eq!(part_of(first, 1), first);
        assert_eq!(part_of(first, 2), Path::new("logs/20260131T235959Z-part2.mcap"));
        assert_eq!(part_of(Path::new("drive"), 2), Path::new("drive-part2"));
    }

    #[test]
    fn the_oldest_logs_make_room_and_nothing_else_does() {
        let folder = tempfile::tempdir().unwrap();
        let names = [
            "20260101T000000Z.mcap",
            "20260102T000000Z.mcap",
            "20260102T000000Z-part2.mcap",
            "20260102T000000Z-part10.mcap",
            "20260103T000000Z.mcap",
            "kept.mcap",
        ];
        for (day, name) in (0..).zip(names) {
            write(&folder.path().join(name), day);
        }
        fs::create_dir(folder.path().join("20250101T000000Z.mcap")).unwrap();
        let there = || {
            let here = |name: &&&str| folder.path().join(name).exists();
            names.iter().filter(here).copied().collect::<Vec<_>>()
        };
        let limits = |kept_bytes, kept_files| Limits {
            part_bytes: 100,
            kept_bytes,
            kept_files,
            free_min: 0,
        };
        make_room(folder.path(), limits(600, 6), None);
        assert_eq!(there(), names, "there is room");
        make_room(folder.path(), limits(500, 6), None);
        assert_eq!(there(), names[1..], "bytes");
        make_room(folder.path(), limits(500, 3), None);
        assert_eq!(there(), names[3..], "files");
        let own = folder.path().join(names[3]);
        make_room(folder.path(), limits(0, 1), Some(&own));
        assert_eq!(there(), [names[3], "kept.mcap"], "never the one that is being written");
        make_room(folder.path(), limits(0, 1), None);
        assert_eq!(there(), ["kept.mcap"]);
        assert!(folder.path().join("20250101T000000Z.mcap").is_dir());
        make_room(&folder.path().join("gone"), limits(0, 1), None);
    }

    /// A log of 100 bytes, last written on that day.
    fn write(path: &Path, day: u64) {
        fs::write(path, [0; 100]).unwrap();
        let modified = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(86_400 * day);
        File::options().write(true).open(path).unwrap().set_modified(modified).unwrap();
    }

    /// How many of ten logs are left on a disk with so much free besides, and how long a part may be.
    fn left(free: u64, limits: Limits) -> (usize, u64) {
        let folder = tempfile::tempdir().unwrap();
        for i in 0..10 {
            write(&folder.path().join(format!("2026010{i}T000000Z.mcap")), 10 - i);
        }
        let available = |folder: &Path| free + 100 * (10 - logs(folder).len() as u64);
        let part = make_room_on(folder.path(), limits, None, available);
        let left = logs(folder.path());
        // The one begun first, by its name, was written last.
        assert!(left.is_empty() || is_taken(folder.path(), "20260100T000000Z"));
        (left.len(), part)
    }

    #[test]
    fn logs_make_room_on_a_disk_that_others_fill() {
        let limits = |part_bytes, free_min| Limits {
            part_bytes,
            kept_bytes: 1_000_000_000,
            kept_files: 100,
            free_min,
        };
        assert_eq!(left(600, limits(100, 500)), (10, 100), "there is room");
        assert_eq!(left(300, limits(100, 500)), (7, 100));
        assert_eq!(left(0, limits(100, 500)), (4, 100));
        assert_eq!(left(0, limits(100, 1100)), (10, 100), "all of them would not be enough");
        assert_eq!(left(u64::MAX / 2, limits(100_000_000, 0)), (10, 100_000_000));
        assert_eq!(left(10_000_000, limits(100_000_000, 0)), (10, 5_000_500), "a small disk");
        let half = Limits { kept_bytes: 1200, ..limits(1200, 0) };
        assert_eq!(left(u64::MAX / 2, half), (6, 600), "half of what is kept is of others");
    }

    #[test]
    fn a_name_is_taken_as_long_as_any_part_is_there() {
        let folder = tempfile::tempdir().unwrap();
        let stem = "20260131T235959Z";
        assert!(!is_taken(folder.path(), stem));
        fs::write(folder.path().join("20260131T235959Z-part3.mcap"), "").unwrap();
        assert!(is_taken(folder.path(), stem));
        assert!(!is_taken(folder.path(), "20260131T235959Z-2"));
    }
}
