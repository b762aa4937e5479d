//! Tables that are written as CSV, JSON and Markdown.

use std::fmt::Write;

use serde_json::{Map, Value, json};

/// What stands in one place of a table.
#[derive(Clone, Debug, PartialEq)]
pub enum Cell {
    /// Nothing: not measured, or it makes no sense.
    Empty,
    /// Words.
    Text(String),
    /// A count.
    Count(u64),
    /// A figure, shown to people with so many decimals.
    Real(f64, usize),
}

impl Cell {
    /// Words.
    pub fn text(text: impl Into<String>) -> Self {
        Self::Text(text.into())
    }

    /// A figure with three decimals, or nothing.
    pub fn ratio(value: Option<f64>) -> Self {
        Self::real(value, 3)
    }

    /// A figure, or nothing if there is none or it is not finite.
    pub fn real(value: Option<f64>, decimals: usize) -> Self {
        value.filter(|v| v.is_finite()).map_or(Self::Empty, |v| Self::Real(v, decimals))
    }

    /// As people read it.
    pub fn shown(&self) -> String {
        match self {
            Self::Empty => String::new(),
            Self::Text(text) => text.clone(),
            Self::Count(count) => count.to_string(),
            Self::Real(value, decimals) => format!("{value:.decimals$}"),
        }
    }

    fn json(&self) -> Value {
        match self {
            Self::Empty => Value::Null,
            Self::Text(text) => json!(text),
            Self::Count(count) => json!(count),
            Self::Real(value, _) => json!(value),
        }
    }
}

impl From<u64> for Cell {
    fn from(count: u64) -> Self {
        Self::Count(count)
    }
}

impl From<usize> for Cell {
    fn from(count: usize) -> Self {
        Self::Count(count as u64)
    }
}

/// Rows of cells under names.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// Name of its files.
    pub name: &'static str,
    /// What it shows, in a sentence.
    pub title: String,
    /// Names of the columns.
    pub columns: Vec<String>,
    /// Rows, each as long as there are columns.
    pub rows: Vec<Vec<Cell>>,
}

impl Table {
    /// An empty table.
    pub fn new(name: &'static str, title: impl Into<String>, columns: &[&str]) -> Self {
        let columns = columns.iter().map(|c| (*c).to_owned()).collect();
        Self { name, title: title.into(), columns, rows: Vec::new() }
    }

    /// Adds a row.
    ///
    /// # Panics
    /// If it is not as long as there are columns.
    pub fn push(&mut self, row: Vec<Cell>) {
        assert_eq!(row.len(), self.columns.len(), "a row of the table {}", self.name);
        self.rows.push(row);
    }

    /// As RFC 4180 has it, with all decimals.
    pub fn csv(&self) -> String {
        let line = |fields: Vec<String>| {
            let quoted = fields.into_iter().map(|field| {
                if field.contains([',', '"', '\n', '\r']) {
                    format!("\"{}\"", field.replace('"', "\"\""))
                } else {
                    field
                }
            });
            quoted.collect::<Vec<_>>().join(",") + "\n"
        };
        let mut text = line(self.columns.clone());
        for row in &self.rows {
            let fields = row.iter().map(|cell| match cell {
                Cell::Real(value, _) => value.to_string(),
                other => other.shown(),
            });
            text += &line(fields.collect());
        }
        text
    }

    /// A list of objects, one a row.
    pub fn json(&self) -> Value {
        let row = |row: &Vec<Cell>| {
            let pairs = self.columns.iter().cloned().zip(row.iter().map(Cell::json));
            Value::Object(pairs.collect::<Map<_, _>>())
        };
        Value::Array(self.rows.iter().map(row).collect())
    }

    /// A Markdown table, with its title above it.
    pub fn markdown(&self) -> String {
        let mut text = format!("{}\n\n", self.title);
        let line = |cells: &mut dyn Iterator<Item = String>| {
            let cells: Vec<String> = cells.map(|c| c.replace('|', "\\|")).collect();
            format!("| {} |\n", cells.join(" | "))
        };
        text += &line(&mut self.columns.iter().cloned());
        let _ = writeln!(text, "|{}", "---|".repeat(self.columns.len()));
        for row in &self.rows {
            text += &line(&mut row.iter().map(Cell::shown));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let mut table = Table::new("t", "A title.", &["name", "n", "mean"]);
        table.push(vec![Cell::text("a, \"b\" | c"), 3u64.into(), Cell::Real(1.0625, 3)]);
        table.push(vec![Cell::text("d"), Cell::Empty, Cell::real(Some(f64::NAN), 1)]);
        table
    }

    #[test]
    fn csv_quotes_what_would_be_taken_for_its_own_signs() {
        assert_eq!(table().csv(), "name,n,mean\n\"a, \"\"b\"\" | c\",3,1.0625\nd,,\n");
    }

    #[test]
    fn json_has_numbers_as_numbers_and_nothing_as_null() {
        let wanted = json!([
            {"name": "a, \"b\" | c", "n": 3, "mean": 1.0625},
            {"name": "d", "n": null, "mean": null},
        ]);
        assert_eq!(table().json(), wanted);
    }

    #[test]
    fn markdown_has_a_line_a_row_and_rounds() {
        let text = table().markdown();
        assert_eq!(text.lines().count(), 6, "{text}");
        assert!(text.contains("| a, \"b\" \\| c | 3 | 1.062 |"), "{text}");
    }
}
