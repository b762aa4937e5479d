//! The parameter table for people and scripts: a complete commented file, Markdown, JSON and plain
//! text, all from the same rows.

use std::fmt::Write;

use super::{ENVIRONMENT_PREFIX, Params, SectionTable, id_of};
use crate::tunable::{Allowed, Change, Tunable, Value};

/// Width to which comments are wrapped.
const WIDTH: usize = 96;

/// When a new value takes effect, in words.
fn change_text(change: Change) -> &'static str {
    match change {
        Change::Live => "at once",
        Change::AtRest => "at rest",
        Change::Restart => "at the next start",
    }
}

/// A value as TOML writes it.
pub(super) fn toml_value(value: &Value) -> String {
    match value {
        Value::Real(v) => toml::Value::Float(*v).to_string(),
        Value::Integer(v) => v.to_string(),
        Value::Bool(v) => v.to_string(),
        Value::Text(v) => toml::Value::String(v.clone()).to_string(),
    }
}

/// Allowed values and effect of one parameter, in one line.
fn limits_text(row: &Tunable) -> String {
    format!(
        "{}, default {}; takes effect {}.",
        capitalised(&row.allowed_text()),
        toml_value(&row.default),
        change_text(row.change)
    )
}

fn capitalised(text: &str) -> String {
    let mut chars = text.chars();
    chars.next().map_or_else(String::new, |first| first.to_uppercase().chain(chars).collect())
}

/// A complete configuration file: every parameter of `params` with its text, unit, range and
/// default above it.
pub fn toml_file(title: &str, params: &Params) -> String {
    let mut out = String::new();
    comment(&mut out, title);
    for section in Params::table() {
        out.push('\n');
        comment(&mut out, section.text);
        let _ = writeln!(out, "[{}]", section.name);
        for row in &section.rows {
            let key = format!("{}.{}", section.name, row.name);
            let value = params.get(&key).expect("every row of the table has a value");
            out.push('\n');
            comment(&mut out, row.text);
            comment(&mut out, &limits_text(row));
            let _ = writeln!(out, "{} = {}", row.name, toml_value(&value));
        }
    }
    out
}

/// The text as comment lines, wrapped.
fn comment(out: &mut String, text: &str) {
    let mut line = String::from("#");
    for word in text.split_whitespace() {
        if line.len() + 1 + word.len() > WIDTH && line.len() > 1 {
            let _ = writeln!(out, "{line}");
            line = String::from("#");
        }
        line.push(' ');
        line.push_str(word);
    }
    let _ = writeln!(out, "{line}");
}

/// The table as a Markdown page.
pub fn markdown() -> String {
    let mut out = String::from(
        "# Parameters\n\n\
         Every tunable parameter, as `apexd params --markdown` prints it. Values come from, each \
         over the one before:\n\n",
    );
    let _ = write!(
        out,
        "1. the defaults below,\n\
         2. a TOML file, `--config FILE` (`params/rc-car.toml` is a complete one),\n\
         3. what ground stations have set, kept in the state directory (`parameters.toml`),\n\
         4. environment variables, `{ENVIRONMENT_PREFIX}SECTION__KEY=value`,\n\
         5. `--set section.key=value` on the command line (`--set key=value` where only one \
         section has the key).\n\n\
         `apexd check FILE` says what is wrong with a file. A new value takes effect *at once*, \
         only while the car is *at rest*, or *at the next start*. Ground \
         stations know a parameter by its MAVLink id; those without one they do not see.\n"
    );
    for section in Params::table() {
        let _ = write!(out, "\n## `[{}]`\n\n{}\n\n", section.name, section.text);
        out.push_str("| parameter | default | allowed | takes effect | MAVLink id | meaning |\n");
        out.push_str("|---|---|---|---|---|---|\n");
        for row in &section.rows {
            let _ = writeln!(
                out,
                "| `{}` | {} | {} | {} | {} | {} |",
                row.name,
                cell(&toml_value(&row.default)),
                cell(&row.allowed_text()),
                change_text(row.change),
                id_of(section.name, row.name, &row.allowed)
                    .map_or_else(String::new, |id| format!("`{id}`")),
                cell(row.text)
            );
        }
    }
    out
}

/// A text that does not end its table cell.
fn cell(text: &str) -> String {
    text.replace('|', "\\|")
}

/// The table for a terminal.
pub fn plain_text() -> String {
    let table = Params::table();
    let rows = || table.iter().flat_map(|section| section.rows.iter());
    let width = |of: &dyn Fn(&Tunable) -> String| {
        rows().map(|row| of(row).chars().count()).max().unwrap_or(0)
    };
    let name = width(&|row| row.name.to_owned());
    let default = width(&|row| toml_value(&row.default));
    let allowed = width(&|row| row.allowed_text());
    let mut out = String::new();
    for (i, section) in table.iter().enumerate() {
        if i > 0 {
            out.push('\n');
        }
        let _ = writeln!(out, "[{}]  {}", section.name, section.text);
        for row in &section.rows {
            let _ = writeln!(
                out,
                "  {:name$}  {:>default$}  {:allowed$}  {:17}  {}",
                row.name,
                toml_value(&row.default),
                row.allowed_text(),
                change_text(row.change),
                row.text
            );
        }
    }
    out
}

/// The table as one JSON object: `{"sections": [{"name", "text", "parameters": [...]}]}`.
pub fn json() -> serde_json::Value {
    let sections: Vec<serde_json::Value> = Params::table().iter().map(json_section).collect();
    serde_json::json!({ "sections": sections })
}

fn json_section(section: &SectionTable) -> serde_json::Value {
    let rows: Vec<serde_json::Value> = section.rows.iter().map(json_row).collect();
    serde_json::json!({ "name": section.name, "text": section.text, "parameters": rows })
}

fn json_row(row: &Tunable) -> serde_json::Value {
    let default = match &row.default {
        Value::Real(v) => serde_json::json!(v),
        Value::Integer(v) => serde_json::json!(v),
        Value::Bool(v) => serde_json::json!(v),
        Value::Text(v) => serde_json::json!(v),
    };
    let mut json = serde_json::json!({
        "name": row.name,
        "text": row.text,
        "unit": row.unit,
        "default": default,
        "change": match row.change {
            Change::Live => "live",
            Change::AtRest => "at_rest",
            Change::Restart => "restart",
        },
    });
    let (kind, limits) = match row.allowed {
        Allowed::Real(min, max) => ("real", serde_json::json!({ "min": min, "max": max })),
        Allowed::Integer(min, max) => ("integer", serde_json::json!({ "min": min, "max": max })),
        Allowed::Bool => ("bool", serde_json::json!({})),
        Allowed::Choice(names) => ("choice", serde_json::json!({ "choices": names })),
        Allowed::Text => ("text", serde_json::json!({})),
    };
    json["type"] = kind.into();
    if let (Some(object), serde_json::Value::Object(limits)) = (json.as_object_mut(), limits) {
        object.extend(limits);
    }
    json
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{Layers, keys};

    const TITLE: &str = "An RC-scale car: every parameter there is, at its default. Copy this file, \
                         change what differs and try it with `apexd check FILE`. It is written by \
                         the program's own tests (`APEXD_BLESS=1 cargo test params`).";

    /// Compares a file of the repository with what it must hold; with APEXD_BLESS=1 writes it.
    fn is_up_to_date(path: &str, wanted: &str) {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        if std::env::var_os("APEXD_BLESS").is_some_and(|value| value == "1") {
            std::fs::write(&path, wanted).unwrap();
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert!(
            found == wanted,
            "{} is out of date: run APEXD_BLESS=1 cargo test params",
            path.display()
        );
    }

    #[test]
    fn the_markdown_page_is_up_to_date() {
        is_up_to_date("docs/parameters.md", &markdown());
    }

    #[test]
    fn the_car_file_is_up_to_date_loads_and_is_complete() {
        let path = "params/rc-car.toml";
        let text = toml_file(TITLE, &Params::default());
        is_up_to_date(path, &text);
        assert_eq!(Layers::new().file(path, &text).build(), Ok(Params::default()));
        let parsed: toml::Table = text.parse().unwrap();
        for key in keys() {
            let (section, name) = key.split_once('.').unwrap();
            assert!(parsed[section].as_table().unwrap().contains_key(name), "{key} is missing");
        }
    }

    #[test]
    fn a_written_file_reads_back_as_the_same_values() {
        let mut params = Params::default();
        params.vehicle.mass_kg = 3.25;
        params.vehicle.friction = 1.0 / 3.0;
        let text = toml_file("Changed.", &params);
        assert_eq!(Layers::new().file("changed", &text).build(), Ok(params));
    }

    #[test]
    fn texts_are_written_as_toml_reads_them() {
        for text in ["", "a \"b\"", "c:\\d", "tab\there", "\u{1f697}\u{0}"] {
            let line = format!("x = {}", toml_value(&Value::Text(text.into())));
            let table: toml::Table = line.parse().unwrap();
            assert_eq!(table["x"].as_str(), Some(text));
        }
        assert_eq!(toml_value(&Value::Real(2.0)), "2.0");
    }

    #[test]
    fn every_form_names_every_parameter() {
        let (markdown, plain, json) = (markdown(), plain_text(), json().to_string());
        for key in keys() {
            let name = key.split_once('.').unwrap().1;
            assert!(markdown.contains(&format!("| `{name}` |")), "{name}");
            assert!(plain.contains(&format!("  {name} ")), "{name}");
            assert!(json.contains(&format!("\"name\":\"{name}\"")), "{name}");
        }
    }

    #[test]
    fn the_json_row_holds_kind_and_bounds() {
        let row = json_row(&crate::params::row("vehicle.mass_kg").unwrap());
        assert_eq!((&row["name"], &row["type"]), (&"mass_kg".into(), &"real".into()));
        assert_eq!((&row["min"], &row["max"]), (&0.1.into(), &50.0.into()));
        assert_eq!((&row["default"], &row["change"]), (&2.5.into(), &"restart".into()));
    }
}
