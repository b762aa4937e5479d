//! Built-in defaults, file, environment, command line: each layer is checked as a whole, then they
//! are put on top of one another.
//!
//! Every layer is checked even where a later one hides its values: a file with a mistake in it is
//! wrong whatever the command line says, and all faults come out at once.

use std::collections::BTreeMap;

use config::{Source, ValueKind};

use super::document::toml_value;
use super::fault::{nearest_key, nearest_section};
use super::{Fault, Faults, Origin, Params, Problem, keys, row};
use crate::tunable::{Allowed, Tunable, TunableError, Value};

/// What the name of every environment variable that sets a parameter begins with; section and key
/// follow, separated by two underscores: `APEXD__VEHICLE__MASS_KG=3`.
pub const ENVIRONMENT_PREFIX: &str = "APEXD__";

/// The layers of a configuration over the built-in defaults. A later layer wins over an earlier
/// one.
#[derive(Debug, Default)]
pub struct Layers {
    layers: Vec<Layer>,
    faults: Vec<Fault>,
}

/// Checked values of one source, by `section.key`.
#[derive(Clone, Debug, Default)]
struct Layer {
    values: BTreeMap<String, (Origin, Value)>,
}

impl Source for Layer {
    fn clone_into_box(&self) -> Box<dyn Source + Send + Sync> {
        Box::new(self.clone())
    }

    fn collect(&self) -> Result<config::Map<String, config::Value>, config::ConfigError> {
        let entry = |(key, (origin, value)): (&String, &(Origin, Value))| {
            let kind = match value {
                Value::Real(v) => ValueKind::Float(*v),
                Value::Integer(v) => ValueKind::I64(*v),
                Value::Bool(v) => ValueKind::Boolean(*v),
                Value::Text(v) => ValueKind::String(v.clone()),
            };
            (key.clone(), config::Value::new(Some(&origin.to_string()), kind))
        };
        Ok(self.values.iter().map(entry).collect())
    }
}

impl Layers {
    /// Nothing but the built-in defaults.
    pub fn new() -> Self {
        Self::default()
    }

    /// The text of a TOML file; `name` is what messages call it.
    pub fn file(&mut self, name: &str, text: &str) -> &mut Self {
        let at = |line| Origin::File { name: name.to_owned(), line };
        let sections = match config::File::from_str(text, config::FileFormat::Toml).collect() {
            Ok(sections) => sections,
            Err(error) => {
                let problem = Problem::Syntax(error.to_string().trim_end().to_owned());
                return self.fault(at(None), "", problem);
            }
        };
        let lines = Lines::of(text);
        let first_fault = self.faults.len();
        let mut layer = Layer::default();
        for (section, value) in in_order(sections) {
            let line = lines.section(&section);
            let ValueKind::Table(entries) = value.kind else {
                let nearest = nearest_key("", &section);
                let known = is_section(&section);
                let problem =
                    if known { Problem::IsSection } else { Problem::OutsideSection { nearest } };
                self.fault(at(line), &section, problem);
                continue;
            };
            if !is_section(&section) {
                let nearest = nearest_section(&section);
                self.fault(at(line), &format!("[{section}]"), Problem::UnknownSection { nearest });
                continue;
            }
            for (name, value) in in_order(entries) {
                let origin = at(lines.key(&section, &name));
                let key = format!("{section}.{name}");
                let Some(row) = row(&key) else {
                    let nearest = nearest_key(&section, &name);
                    self.fault(origin, &key, Problem::UnknownKey { nearest });
                    continue;
                };
                match plain(value.kind) {
                    Ok(value) => self.check(&mut layer, origin, key, &row, &value),
                    Err(value) => {
                        let wanted = row.allowed_text();
                        self.fault(origin, &key, Problem::Kind { value, wanted });
                    }
                }
            }
        }
        self.faults[first_fault..].sort_by_key(|fault| match fault.origin {
            Origin::File { line, .. } => line,
            _ => None,
        });
        self.layers.push(layer);
        self
    }

    /// A file that could not be read.
    pub fn unreadable_file(&mut self, name: &str, error: &dyn std::error::Error) -> &mut Self {
        let origin = Origin::File { name: name.to_owned(), line: None };
        self.fault(origin, "", Problem::Unreadable(error.to_string()))
    }

    /// The text that [`kept_text`] made of what ground stations set. What is not acceptable (any
    /// more) is passed over and handed back: it must not keep the program from starting.
    pub fn kept(&mut self, name: &str, text: &str) -> (BTreeMap<String, Value>, Faults) {
        let mut own = Self::new();
        own.file(name, text);
        let mut layer = own.layers.pop().unwrap_or_default();
        let origin = Origin::Kept { name: name.to_owned() };
        layer.values.values_mut().for_each(|(from, _)| *from = origin.clone());
        let values = layer.values.iter().map(|(key, (_, value))| (key.clone(), value.clone()));
        let values = values.collect();
        self.layers.push(layer);
        (values, Faults(own.faults))
    }

    /// Environment variables; those whose names do not begin with [`ENVIRONMENT_PREFIX`] are
    /// passed over.
    pub fn environment(
        &mut self,
        variables: impl IntoIterator<Item = (String, String)>,
    ) -> &mut Self {
        let ours: BTreeMap<String, String> = variables
            .into_iter()
            .filter(|(name, _)| name.starts_with(ENVIRONMENT_PREFIX))
            .collect();
        let mut layer = Layer::default();
        for (variable, text) in ours {
            let source = config::Environment::default()
                .prefix(ENVIRONMENT_PREFIX.trim_end_matches('_'))
                .separator("__")
                .source(Some(config::Map::from([(variable.clone(), text.clone())])));
            let key = source.collect().ok().and_then(|found| found.into_keys().next());
            let key = key.expect("a variable with the prefix is collected");
            let origin = Origin::Environment { variable };
            self.text(&mut layer, origin, &key, &text);
        }
        self.layers.push(layer);
        self
    }

    /// An environment variable with the prefix whose name or value is not text.
    pub fn unreadable_variable(&mut self, variable: &str) -> &mut Self {
        let origin = Origin::Environment { variable: variable.to_owned() };
        self.fault(origin, "", Problem::NotUnicode)
    }

    /// One `--set section.key=value`; `key=value` where only one section has the key.
    pub fn set(&mut self, assignment: &str) -> &mut Self {
        let origin = Origin::Set { assignment: assignment.to_owned() };
        let Some((key, text)) = assignment.split_once('=') else {
            return self.fault(origin, "", Problem::NoAssignment);
        };
        let (key, text) = (key.trim(), text.trim());
        let mut layer = Layer::default();
        match full_key(key, keys()) {
            Ok(full) => self.text(&mut layer, origin, &full, text),
            Err(problem) => {
                self.fault(origin, key, problem);
            }
        }
        self.layers.push(layer);
        self
    }

    /// The value of a command-line option (`--speed-max`) that stands for the parameter `key`.
    pub fn flag(&mut self, flag: &str, key: &str, value: &Value) -> &mut Self {
        let origin = Origin::Flag { flag: flag.to_owned() };
        let row = row(key).expect("an option stands for a parameter that exists");
        let mut layer = Layer::default();
        self.check(&mut layer, origin, key.to_owned(), &row, value);
        self.layers.push(layer);
        self
    }

    /// The validated values, or everything that is wrong.
    pub fn build(&self) -> Result<Params, Faults> {
        if !self.faults.is_empty() {
            return Err(Faults(self.faults.clone()));
        }
        let mut builder = config::Config::builder();
        for layer in &self.layers {
            builder = builder.add_source(layer.clone());
        }
        let merged = builder
            .build()
            .and_then(|config| config.collect())
            .expect("checked layers are plain values and always merge");
        let mut params = Params::default();
        for (section, value) in in_order(merged) {
            for (name, value) in in_order(value.into_table().expect("checked keys have a section"))
            {
                let value = plain(value.kind).expect("checked values are plain");
                params.set(&format!("{section}.{name}"), &value).expect("the value was checked");
            }
        }
        Ok(params)
    }

    /// Checks one value that came as text, in the kind that the parameter wants.
    fn text(&mut self, layer: &mut Layer, origin: Origin, key: &str, text: &str) {
        let (section, name) = key.split_once('.').unwrap_or(("", key));
        let Some(row) = row(key) else {
            let problem = if section.is_empty() && is_section(name) {
                Problem::IsSection
            } else if section.is_empty() {
                Problem::OutsideSection { nearest: nearest_key("", name) }
            } else if !is_section(section) {
                Problem::UnknownSection { nearest: nearest_section(section) }
            } else {
                Problem::UnknownKey { nearest: nearest_key(section, name) }
            };
            self.fault(origin, key, problem);
            return;
        };
        self.check(layer, origin, key.to_owned(), &row, &typed(&row, text));
    }

    fn check(
        &mut self,
        layer: &mut Layer,
        origin: Origin,
        key: String,
        row: &Tunable,
        value: &Value,
    ) {
        match row.check(value) {
            Ok(value) => {
                layer.values.insert(key, (origin, value));
            }
            Err(error @ TunableError::Unknown) => {
                unreachable!("checking a known row says: {error}")
            }
            Err(error) => {
                self.fault(origin, &key, Problem::Value(error));
            }
        }
    }

    fn fault(&mut self, origin: Origin, key: &str, problem: Problem) -> &mut Self {
        self.faults.push(Fault { origin, key: key.to_owned(), problem });
        self
    }
}

/// Values as a file that [`Layers::kept`] reads.
pub fn kept_text(values: &BTreeMap<String, Value>) -> String {
    format!("# Set by ground stations; over the configuration file.\n{}", toml_text(values))
}

/// Values as a TOML file that [`Layers::file`] reads, exact to the last bit.
pub fn toml_text(values: &BTreeMap<String, Value>) -> String {
    let mut out = String::new();
    let mut last = "";
    for (key, value) in values {
        let Some((section, name)) = key.split_once('.') else { continue };
        if section != last {
            out.push_str(&format!("\n[{section}]\n"));
            last = section;
        }
        out.push_str(&format!("{name} = {}\n", toml_value(value)));
    }
    out
}

/// The `section.name` that a short form stands for; a key with a section stands for itself.
fn full_key(key: &str, known: Vec<String>) -> Result<String, Problem> {
    if key.contains('.') {
        return Ok(key.to_owned());
    }
    if is_section(key) {
        return Err(Problem::IsSection);
    }
    let suffix = format!(".{key}");
    let mut candidates: Vec<String> =
        known.into_iter().filter(|full| full.ends_with(&suffix)).collect();
    match candidates.len() {
        0 => Err(Problem::UnknownKey { nearest: nearest_key("", key) }),
        1 => Ok(candidates.remove(0)),
        _ => Err(Problem::Ambiguous { candidates }),
    }
}

fn is_section(name: &str) -> bool {
    Params::table().iter().any(|section| section.name == name)
}

/// A text as the kind of value that the row wants, or as a text (which the row then refuses).
fn typed(row: &Tunable, text: &str) -> Value {
    let plain = text.trim();
    let number = || {
        let whole = plain.parse().ok().map(Value::Integer);
        whole.or_else(|| plain.parse().ok().map(Value::Real))
    };
    let typed = match row.allowed {
        Allowed::Real(..) | Allowed::Integer(..) => number(),
        Allowed::Bool => plain.parse().ok().map(Value::Bool),
        Allowed::Choice(_) => Some(Value::Text(plain.to_owned())),
        Allowed::Text => None,
    };
    typed.unwrap_or_else(|| Value::Text(text.to_owned()))
}

/// A value of the `config` crate in the table's terms, or what it is instead.
fn plain(kind: ValueKind) -> Result<Value, String> {
    match kind {
        ValueKind::Boolean(v) => Ok(Value::Bool(v)),
        ValueKind::I64(v) => Ok(Value::Integer(v)),
        ValueKind::Float(v) => Ok(Value::Real(v)),
        ValueKind::String(v) => Ok(Value::Text(v)),
        ValueKind::Array(_) => Err("a list".into()),
        ValueKind::Table(_) => Err("a table".into()),
        ValueKind::Nil => Err("nothing".into()),
        ValueKind::U64(v) => Err(format!("{v}")),
        ValueKind::I128(v) => Err(format!("{v}")),
        ValueKind::U128(v) => Err(format!("{v}")),
    }
}

/// A map in the order of its keys: faults are reported in the same order every time.
fn in_order(map: config::Map<String, config::Value>) -> BTreeMap<String, config::Value> {
    map.into_iter().collect()
}

/// On which line of a TOML text each section and each key stands.
struct Lines {
    sections: BTreeMap<String, usize>,
    keys: BTreeMap<(String, String), usize>,
}

impl Lines {
    fn of(text: &str) -> Self {
        let line_of = |offset: usize| {
            text.as_bytes()[..offset.min(text.len())].iter().filter(|b| **b == b'\n').count() + 1
        };
        let mut lines = Self { sections: BTreeMap::new(), keys: BTreeMap::new() };
        let Ok(document) = toml::de::DeTable::parse(text) else { return lines };
        for (section, value) in document.get_ref() {
            let name = section.get_ref().to_string();
            lines.sections.insert(name.clone(), line_of(section.span().start));
            if let toml::de::DeValue::Table(entries) = value.get_ref() {
                for key in entries.keys() {
                    let line = line_of(key.span().start);
                    lines.keys.insert((name.clone(), key.get_ref().to_string()), line);
                }
            }
        }
        lines
    }

    fn section(&self, section: &str) -> Option<usize> {
        self.sections.get(section).copied()
    }

    fn key(&self, section: &str, key: &str) -> Option<usize> {
        self.keys.get(&(section.to_owned(), key.to_owned())).copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(layers: &Layers) -> Vec<String> {
        layers.build().unwrap_err().0.iter().map(ToString::to_string).collect()
    }

    fn variables(pairs: &[(&str, &str)]) -> Vec<(String, String)> {
        pairs.iter().map(|(name, value)| ((*name).into(), (*value).into())).collect()
    }

    #[test]
    fn a_later_layer_wins_over_an_earlier_one() {
        let text = "[vehicle]\nmass_kg = 3\nfriction = 0.8\nradius_m = 0.3\n";
        let mut layers = Layers::new();
        layers.file("a.toml", text);
        layers.environment(variables(&[
            ("APEXD__VEHICLE__FRICTION", "0.7"),
            ("APEXD__VEHICLE__RADIUS_M", "0.25"),
            ("APEXD_BLESS", "1"),
            ("PATH", "/bin"),
        ]));
        layers.set("vehicle.radius_m = 0.1").set("vehicle.track_m=0.3");
        let vehicle = layers.build().unwrap().vehicle;
        assert_eq!((vehicle.mass_kg, vehicle.friction), (3.0, 0.7));
        assert_eq!((vehicle.radius_m, vehicle.track_m), (0.1, 0.3));
        assert_eq!(vehicle.wheelbase_m, Params::default().vehicle.wheelbase_m);
    }

    #[test]
    fn no_layer_gives_the_defaults() {
        assert_eq!(Layers::new().build(), Ok(Params::default()));
        assert_eq!(Layers::new().file("empty.toml", "").build(), Ok(Params::default()));
    }

    #[test]
    fn every_fault_is_reported_at_once_with_source_line_value_and_range() {
        let mut layers = Layers::new();
        let text = "[vehicle]\nmas_kg = 3\nmass_kg = 99\nfriction = \"high\"\nradius_m = [1]\n\n\
                    [vehicel]\nmass_kg = 1\n";
        layers.file("a.toml", text);
        layers.environment(variables(&[("APEXD__VEHICLE__TRACK_M", "wide"), ("APEXD__X", "1")]));
        // This hides the file's own mass, whose fault is reported all the same.
        layers.set("vehicle.mass_kg=0.01").set("vehicle.mass_kg=2").set("mass").set("vehicle=1");
        assert_eq!(
            said(&layers),
            [
                "a.toml:2: vehicle.mas_kg: no such parameter; did you mean vehicle.mass_kg?".into(),
                "a.toml:3: vehicle.mass_kg is 99, allowed is 0.1 to 50 kg".into(),
                "a.toml:4: vehicle.friction is \"high\", but must be 0.05 to 2".into(),
                "a.toml:5: vehicle.radius_m is a list, but must be 0.02 to 2 m".into(),
                layers.faults[4].to_string(),
                "environment variable APEXD__VEHICLE__TRACK_M: vehicle.track_m is \"wide\", but \
                 must be 0.05 to 2 m"
                    .into(),
                layers.faults[6].to_string(),
                "--set vehicle.mass_kg=0.01: vehicle.mass_kg is 0.01, allowed is 0.1 to 50 kg"
                    .into(),
                "--set mass: must have the form section.key=value".into(),
                "--set vehicle=1: vehicle is a section; give its parameters one by one".into(),
            ]
        );
        let section = layers.faults[4].to_string();
        assert!(
            section.starts_with("a.toml:7: [vehicel]: no such section; did you mean [vehicle]?"),
            "{section}"
        );
        let outside = layers.faults[6].to_string();
        assert!(
            outside.starts_with(
                "environment variable APEXD__X: x stands outside any section; did you mean "
            ),
            "{outside}"
        );
    }

    #[test]
    fn a_short_name_stands_for_the_only_parameter_that_has_it() {
        let known = || ["vehicle.mass_kg", "car.mass_kg", "car.lag_s"].map(str::to_owned).to_vec();
        assert_eq!(full_key("lag_s", known()), Ok("car.lag_s".into()));
        assert_eq!(full_key("map.x", known()), Ok("map.x".into()));
        let candidates = ["vehicle.mass_kg", "car.mass_kg"].map(str::to_owned).to_vec();
        assert_eq!(full_key("mass_kg", known()), Err(Problem::Ambiguous { candidates }));
        assert!(matches!(full_key("kg", known()), Err(Problem::UnknownKey { .. })));
        assert_eq!(full_key("vehicle", known()), Err(Problem::IsSection));

        let unique = keys()
            .into_iter()
            .find(|key| {
                let suffix = format!(".{}", key.split_once('.').unwrap().1);
                keys().iter().filter(|other| other.ends_with(&suffix)).count() == 1
            })
            .unwrap();
        let (name, value) = (unique.split_once('.').unwrap().1, row(&unique).unwrap().default);
        let mut layers = Layers::new();
        layers.set(&format!("{name}={value}"));
        assert_eq!(layers.build(), Ok(Params::default()));
    }

    #[test]
    fn a_parameter_outside_its_section_is_pointed_to_its_place() {
        let mut layers = Layers::new();
        layers.file("a.toml", "wheelbase_m = 3\nvehicle = 2");
        let said = said(&layers);
        assert_eq!(
            said[0],
            "a.toml:1: wheelbase_m stands outside any section; did you mean vehicle.wheelbase_m?"
        );
        assert_eq!(said.len(), 2);
    }

    #[test]
    fn text_that_is_not_toml_is_refused_with_its_place() {
        let mut layers = Layers::new();
        layers.file("a.toml", "[vehicle]\nmass_kg = = 2\n");
        let said = said(&layers);
        assert!(said[0].starts_with("a.toml: is not valid TOML: "), "{said:?}");
        assert!(said[0].contains("line 2"), "{said:?}");
    }

    #[test]
    fn numbers_that_are_no_numbers_are_refused() {
        let mut layers = Layers::new();
        layers.file("a.toml", "[vehicle]\nmass_kg = nan\nfriction = inf\n");
        layers.set("track_m=NaN").set("radius_m=").set("wheelbase_m=99999999999999999999");
        assert_eq!(said(&layers).len(), 5);
    }

    #[test]
    fn a_whole_number_is_a_real_and_no_fault() {
        let mut layers = Layers::new();
        layers.flag("--mass", "vehicle.mass_kg", &Value::Integer(4));
        assert_eq!(layers.build().unwrap().vehicle.mass_kg, 4.0);
        layers.flag("--mass", "vehicle.mass_kg", &Value::Real(-4.0));
        assert_eq!(said(&layers), ["--mass: vehicle.mass_kg is -4.0, allowed is 0.1 to 50 kg"]);
    }

    proptest::proptest! {
        #[test]
        fn no_input_whatever_makes_it_panic(
            text in ".{0,60}",
            key in "[a-z._A-Z ]{0,12}",
            value in ".{0,12}",
        ) {
            let mut layers = Layers::new();
            layers.file("a", &text).file("b", &format!("[vehicle]\n{key} = {value}"));
            layers.set(&text).set(&format!("{key}={value}"));
            layers.environment([(format!("APEXD__{key}"), value.clone())]);
            layers.environment([(format!("APEXD__VEHICLE__{key}"), value)]);
            let _ = layers.build();
        }
    }
}
