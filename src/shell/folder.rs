//! The folder that a run leaves behind.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use super::report::ReportError;

/// The folder for a report, made now so that a run does not find out at its end that it cannot
/// write: the one given, or a new one in `runs`, named after the time.
pub fn prepare(given: Option<&Path>) -> Result<PathBuf, ReportError> {
    let fail = |path: &Path, error| ReportError::Write { path: path.to_owned(), error };
    if let Some(folder) = given {
        std::fs::create_dir_all(folder).map_err(|error| fail(folder, error))?;
        return Ok(folder.to_owned());
    }
    let runs = Path::new("runs");
    std::fs::create_dir_all(runs).map_err(|error| fail(runs, error))?;
    let time = now();
    // Two runs may begin within the same second.
    let names = std::iter::once(time.clone()).chain((2..).map(|i| format!("{time}-{i}")));
    for name in names {
        let folder = runs.join(name);
        match std::fs::create_dir(&folder) {
            Ok(()) => return Ok(folder),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
            Err(error) => return Err(fail(&folder, error)),
        }
    }
    unreachable!("there is no end of names")
}

/// Takes a folder away again that nothing was put into.
pub fn discard_if_empty(folder: &Path) {
    // It fails if there is something in it, which is as it should be.
    let _ = std::fs::remove_dir(folder);
}

/// The time of day, UTC, as ISO 8601 writes it in its basic form.
#[expect(clippy::disallowed_methods, reason = "the shell may ask for the time of day")]
pub fn now() -> String {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    utc_text(since.as_secs())
}

/// A moment as ISO 8601 writes it in its basic form: `20260131T235959Z`.
fn utc_text(unix_s: u64) -> String {
    let (days, second) = (unix_s / 86_400, unix_s % 86_400);
    let (year, month, day) = civil_from_days(days);
    let (h, m, s) = (second / 3600, second / 60 % 60, second % 60);
    format!("{year:04}{month:02}{day:02}T{h:02}{m:02}{s:02}Z")
}

/// Year, month and day of a number of days since 1970-01-01 (Howard Hinnant, "chrono-compatible
/// low-level date algorithms", for days that are not negative).
fn civil_from_days(days: u64) -> (u64, u64, u64) {
    let z = days + 719_468;
    let (era, doe) = (z / 146_097, z % 146_097);
    let yoe = (doe - doe / 1_460 + doe / 36_524 - doe / 146_096) / 365;
    let doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
    let mp = (5 * doy + 2) / 153;
    let month = if mp < 10 { mp + 3 } else { mp - 9 };
    (yoe + era * 400 + u64::from(month <= 2), month, doy - (153 * mp + 2) / 5 + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_written_as_the_calendar_has_them() {
        assert_eq!(utc_text(0), "19700101T000000Z");
        assert_eq!(utc_text(951_868_799), "20000229T235959Z");
        assert_eq!(utc_text(951_868_800), "20000301T000000Z");
        assert_eq!(utc_text(1_767_225_599), "20251231T235959Z");
        assert_eq!(utc_text(4_107_542_400), "21000301T000000Z");
    }

    #[test]
    fn a_given_folder_is_made_with_its_parents_and_may_exist() {
        let root = tempfile::tempdir().unwrap();
        let wanted = root.path().join("a/b");
        assert_eq!(prepare(Some(&wanted)).unwrap(), wanted);
        assert_eq!(prepare(Some(&wanted)).unwrap(), wanted);
        std::fs::write(wanted.join("kept"), "").unwrap();
        discard_if_empty(&wanted);
        assert!(wanted.exists());
    }
}
