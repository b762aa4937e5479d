//! Drives that went wrong, with the commands that repeat them.

use super::run::Record;
use super::table::{Cell, Table};

/// Drives that did not arrive or were not safe.
pub fn failures(records: &[&Record]) -> Table {
    let mut table = Table::new(
        "failures",
        "Drives that did not reach the goal or were not safe, and how to repeat them.",
        &["outcome", "known map", "collisions", "unknown entries", "s", "digest", "command"],
    );
    let name = |outcome| format!("{outcome:?}").to_lowercase();
    for record in records {
        let drive = &record.drive;
        if record.arrived() && drive.collisions == 0 && drive.unknown_entries == 0 {
            continue;
        }
        table.push(vec![
            Cell::text(name(drive.outcome)),
            record.reference.as_ref().map_or(Cell::Empty, |r| Cell::text(name(r.outcome))),
            drive.collisions.into(),
            drive.unknown_entries.into(),
            Cell::Real(drive.time_s, 1),
            Cell::text(&drive.digest),
            Cell::text(format!("`{}`", record.command)),
        ]);
    }
    table
}
