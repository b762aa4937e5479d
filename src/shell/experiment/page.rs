//! What an experiment came to, as a part of a Markdown page.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use super::store::Session;
use crate::experiment::paper::stated;
use crate::experiment::table::Table;

/// Rows of a table that a page has room for.
const ROWS_MAX: usize = 120;

/// What goes onto the page.
pub struct Page<'a> {
    /// Name of the experiment.
    pub experiment: &'static str,
    /// The result in a sentence, if it has one.
    pub summary: &'a str,
    /// Who has driven.
    pub sessions: &'a [Session],
    /// Drives that are done.
    pub drives: usize,
    /// Drives that were wanted.
    pub total: usize,
    /// The tables.
    pub tables: &'a [Table],
    /// Files of the figures.
    pub images: &'a [PathBuf],
}

/// Why a page could not be written.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A file cannot be read or written.
    #[error("{}: {error}", .path.display())]
    File {
        /// Its path.
        path: PathBuf,
        /// What the operating system says.
        error: std::io::Error,
    },
    /// The page has no place for it.
    #[error("{}: there are no two lines `{begin}` and `{end}` to write between", .path.display())]
    NoPlace {
        /// The page.
        path: PathBuf,
        /// The line before.
        begin: String,
        /// The line after.
        end: String,
    },
}

impl Page<'_> {
    /// Writes it to a file of its own, beside the figures' folder.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), PageError> {
        let text = format!("# {}\n\n{}", self.experiment, self.text("figures/"));
        write(path, &text)
    }

    /// Writes it between its two lines of a page, and its figures to `img/` beside that page.
    ///
    /// # Errors
    /// If a file cannot be read or written, or the page does not have the lines.
    pub fn put_into(&self, path: &Path) -> Result<(), PageError> {
        let page = std::fs::read_to_string(path)
            .map_err(|error| PageError::File { path: path.to_owned(), error })?;
        let [begin, end] = ["begin", "end"]
            .map(|what| format!("<!-- apexd experiment {}: {what} -->", self.experiment));
        let prefix = format!("img/{}-", self.experiment);
        let text = between(&page, &begin, &end, &self.text(&prefix)).ok_or_else(|| {
            PageError::NoPlace { path: path.to_owned(), begin: begin.clone(), end: end.clone() }
        })?;
        let beside = path.parent().unwrap_or(Path::new(""));
        for image in self.images {
            let name = image.file_name().unwrap_or_default().to_string_lossy();
            let to = beside.join(format!("{prefix}{name}"));
            let made = to.parent().map_or(Ok(()), std::fs::create_dir_all);
            made.and_then(|()| std::fs::copy(image, &to).map(drop))
                .map_err(|error| PageError::File { path: to, error })?;
        }
        write(path, &text)
    }

    /// The part itself; `prefix` is what comes before the names of the figures.
    fn text(&self, prefix: &str) -> String {
        let mut text = String::new();
        let commands: BTreeSet<&str> = self.sessions.iter().map(|s| &*s.command).collect();
        for command in commands {
            let _ = writeln!(text, "    {command}");
        }
        let unique = |of: fn(&Session) -> &str| {
            let values: BTreeSet<&str> = self.sessions.iter().map(of).collect();
            values.into_iter().collect::<Vec<_>>().join("; ")
        };
        let date = self.sessions.iter().map(|s| &*s.began).max().unwrap_or_default();
        let jobs = self.sessions.iter().map(|s| s.jobs).max().unwrap_or_default();
        let _ = writeln!(
            text,
            "\n{} of {} drives, last begun {date}, by {}, on {}, up to {jobs} at a time.\n",
            self.drives,
            self.total,
            unique(|s| &s.program),
            unique(|s| &s.machine),
        );
        if !self.summary.is_empty() {
            let _ = writeln!(text, "{}\n", self.summary);
        }
        for table in self.tables {
            let cut = Table {
                rows: table.rows.iter().take(ROWS_MAX).cloned().collect(),
                ..table.clone()
            };
            let _ = writeln!(text, "{}", cut.markdown());
            if table.rows.len() > ROWS_MAX {
                let _ = writeln!(text, "… {} rows in all.\n", table.rows.len());
            }
        }
        for image in self.images {
            let name = image.file_name().unwrap_or_default().to_string_lossy();
            let stem = image.file_stem().unwrap_or_default().to_string_lossy();
            let _ = writeln!(text, "![{}]({prefix}{name})\n", stem.replace('-', " "));
        }
        if self.experiment == crate::experiment::paper::NAME {
            let _ = writeln!(text, "The paper's numbers are from {}", stated::SOURCES);
        }
        text
    }
}

/// The page with what stands between two of its lines replaced.
fn between(page: &str, begin: &str, end: &str, text: &str) -> Option<String> {
    let after = page.find(begin)? + begin.len();
    let before = after + page[after..].find(end)?;
    Some(format!("{}\n\n{}\n{}", &page[..after], text.trim_end(), &page[before..]))
}

fn write(path: &Path, text: &str) -> Result<(), PageError> {
    std::fs::write(path, text).map_err(|error| PageError::File { path: path.to_owned(), error })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_between_the_lines_changes() {
        let page = "before\n<!-- b -->\nold\n<!-- e -->\nafter\n";
        let once = between(page, "<!-- b -->", "<!-- e -->", "new\n").unwrap();
        assert_eq!(once, "before\n<!-- b -->\n\nnew\n<!-- e -->\nafter\n");
        assert_eq!(between(&once, "<!-- b -->", "<!-- e -->", "new\n").unwrap(), once);
        assert_eq!(between(page, "<!-- e -->", "<!-- b -->", "new"), None);
    }
}
