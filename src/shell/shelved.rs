//! A folder of logs: names, parts, and which ones make room for new ones.

use std::fs;
use std::path::{Path, PathBuf};

/// What the names of logs end with.
pub const EXTENSION: &str = "mcap";
/// What stands before the number of a further part.
const PART: &str = "-part";

/// How much is kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// A part that is longer is followed by another one, bytes.
    pub part_bytes: u64,
    /// All files together, bytes.
    pub kept_bytes: u64,
    /// Number of files.
    pub kept_files: usize,
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

/// Deletes the oldest logs until there is room for one more part. Nothing else is touched.
pub fn make_room(folder: &Path, limits: Limits, next: Option<&Path>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    let mut logs: Vec<((String, u32), PathBuf, u64)> = entries
        .flatten()
        .filter_map(|entry| {
            let order = order(entry.file_name().to_str()?)?;
            let about = entry.metadata().ok().filter(fs::Metadata::is_file)?;
            Some((order, entry.path(), about.len()))
        })
        .collect();
    logs.sort();
    let mut bytes: u64 = logs.iter().map(|(.., length)| length).sum();
    let mut count = logs.len();
    for (_, path, length) in logs {
        let fits = bytes.saturating_add(limits.part_bytes) <= limits.kept_bytes;
        if (fits && count < limits.kept_files) || Some(&*path) == next {
            break;
        }
        match fs::remove_file(&path) {
            Ok(()) => tracing::info!("deleted the log {}", path.display()),
            Err(error) => tracing::warn!("cannot delete the log {}: {error}", path.display()),
        }
        // One that cannot be deleted is no reason to delete all others.
        bytes = bytes.saturating_sub(length);
        count -= 1;
    }
}

/// What a log of ours is sorted by: the time at its start, then the part.
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
        for name in names {
            fs::write(folder.path().join(name), [0; 100]).unwrap();
        }
        fs::create_dir(folder.path().join("20250101T000000Z.mcap")).unwrap();
        let there = || {
            let here = |name: &&&str| folder.path().join(name).exists();
            names.iter().filter(here).copied().collect::<Vec<_>>()
        };
        let limits = |kept_bytes, kept_files| Limits { part_bytes: 100, kept_bytes, kept_files };
        make_room(folder.path(), limits(600, 6), None);
        assert_eq!(there(), names, "there is room");
        make_room(folder.path(), limits(500, 6), None);
        assert_eq!(there(), names[1..], "bytes");
        make_room(folder.path(), limits(500, 3), None);
        assert_eq!(there(), names[3..], "files");
        let own = folder.path().join(names[3]);
        make_room(folder.path(), limits(0, 1), Some(&own));
        assert_eq!(there(), names[3..], "never the one that is about to be written");
        make_room(folder.path(), limits(0, 1), None);
        assert_eq!(there(), ["kept.mcap"]);
        assert!(folder.path().join("20250101T000000Z.mcap").is_dir());
        make_room(&folder.path().join("gone"), limits(0, 1), None);
    }
}
