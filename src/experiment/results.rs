//! Files of results: one JSON object a line, in the order in which drives ended.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use super::run::Record;

/// Results by the key of their task.
#[derive(Clone, Debug, Default)]
pub struct Results(BTreeMap<String, Record>);

/// Why results do not fit together.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ResultsError {
    /// A line is not a result.
    #[error("line {line}: {why}")]
    Line {
        /// Its number, from 1.
        line: usize,
        /// What is wrong with it.
        why: String,
    },
    /// One drive came out in two ways.
    #[error(
        "the same drive came out in two ways: digest {} (by {}) and {} (by {}); it is {command}",
        digests[0], programs[0], digests[1], programs[1]
    )]
    Contradiction {
        /// The digests of both.
        digests: [String; 2],
        /// The programs that drove.
        programs: [String; 2],
        /// The command that repeats the drive.
        command: String,
    },
}

impl Results {
    /// Takes in a result; a second one of the same task must agree.
    ///
    /// # Errors
    /// If it does not.
    pub fn add(&mut self, record: Record) -> Result<(), ResultsError> {
        match self.0.entry(record.key.clone()) {
            Entry::Vacant(place) => {
                place.insert(record);
                Ok(())
            }
            Entry::Occupied(place) if place.get().agrees_with(&record) => Ok(()),
            Entry::Occupied(place) => {
                let other = place.get();
                Err(ResultsError::Contradiction {
                    digests: [other.drive.digest.clone(), record.drive.digest],
                    programs: [other.program.clone(), record.program],
                    command: record.command,
                })
            }
        }
    }

    /// Takes in the lines of a file that `wanted` picks. A last line without an end was being
    /// written when its writer was stopped: it is left out.
    ///
    /// # Errors
    /// If a line is not a result, or contradicts another.
    pub fn add_lines(
        &mut self,
        text: &str,
        wanted: impl Fn(&Record) -> bool,
    ) -> Result<(), ResultsError> {
        for (i, line) in whole_lines(text).lines().enumerate().filter(|(_, l)| !l.is_empty()) {
            let record: Record = serde_json::from_str(line)
                .map_err(|error| ResultsError::Line { line: i + 1, why: error.to_string() })?;
            if wanted(&record) {
                self.add(record)?;
            }
        }
        Ok(())
    }

    /// Whether a task has been done.
    pub fn contains(&self, key: &str) -> bool {
        self.0.contains_key(key)
    }

    /// Number of results.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The results, in an order that follows from their tasks.
    pub fn iter(&self) -> impl Iterator<Item = &Record> {
        self.0.values()
    }
}

/// The text up to the end of its last whole line.
pub fn whole_lines(text: &str) -> &str {
    text.rfind('\n').map_or("", |end| &text[..=end])
}
