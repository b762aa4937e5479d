//! Tunable parameters: one declaration gives the struct, its defaults, its limits and its texts.
//!
//! Each module declares its own parameters with [`tunables!`](crate::tunables); the `params` module
//! gathers them into the one table from which files are checked, documentation is written and
//! ground stations are answered.

use std::fmt;

/// A parameter's value, as a file, a command line or a ground station gives it.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// A real number.
    Real(f64),
    /// A whole number.
    Integer(i64),
    /// Yes or no.
    Bool(bool),
    /// A text: a name from a list of choices, or a path.
    Text(String),
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Real(v) => write!(f, "{v:?}"),
            Self::Integer(v) => write!(f, "{v}"),
            Self::Bool(v) => write!(f, "{v}"),
            Self::Text(v) => write!(f, "{v:?}"),
        }
    }
}

/// When a new value takes effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// At once, also while driving.
    Live,
    /// Only accepted while the car is at rest.
    AtRest,
    /// At the next start.
    Restart,
}

/// What a parameter may hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Allowed {
    /// A real number between two bounds, both included.
    Real(f64, f64),
    /// A whole number between two bounds, both included.
    Integer(i64, i64),
    /// `true` or `false`.
    Bool,
    /// One of these names.
    Choice(&'static [&'static str]),
    /// Any text (a path, an address).
    Text,
}

/// One row of the parameter table.
#[derive(Clone, Debug, PartialEq)]
pub struct Tunable {
    /// Name within its section; carries the unit as a suffix.
    pub name: &'static str,
    /// What it does, in a sentence or two.
    pub text: &'static str,
    /// SI unit, empty for a bare number.
    pub unit: &'static str,
    /// Allowed values.
    pub allowed: Allowed,
    /// Value when nobody says otherwise.
    pub default: Value,
    /// When a new value takes effect.
    pub change: Change,
}

/// Why a value was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TunableError {
    /// The section has no such parameter.
    #[error("no such parameter")]
    Unknown,
    /// The value is of the wrong kind.
    #[error("is {value}, but must be {wanted}")]
    WrongType {
        /// The value given.
        value: Value,
        /// What is wanted, in words.
        wanted: String,
    },
    /// The value lies outside its range or list.
    #[error("is {value}, allowed is {wanted}")]
    OutOfRange {
        /// The value given.
        value: Value,
        /// What is allowed, in words.
        wanted: String,
    },
}

impl Tunable {
    /// The allowed values in words: `0.1 to 20 m/s`, `one of edge, literal`.
    pub fn allowed_text(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        match self.allowed {
            Allowed::Real(lo, hi) => format!("{lo} to {hi}{unit}"),
            Allowed::Integer(lo, hi) => format!("a whole number from {lo} to {hi}{unit}"),
            Allowed::Bool => "true or false".into(),
            Allowed::Choice(names) => format!("one of {}", names.join(", ")),
            Allowed::Text => "a text".into(),
        }
    }

    /// The value in this parameter's own kind, or why it is refused. Whole numbers pass as reals.
    pub fn check(&self, value: &Value) -> Result<Value, TunableError> {
        let wrong =
            || TunableError::WrongType { value: value.clone(), wanted: self.allowed_text() };
        let (checked, inside) = match (self.allowed, value) {
            (Allowed::Real(lo, hi), Value::Real(v)) => (Value::Real(*v), (lo..=hi).contains(v)),
            (Allowed::Real(lo, hi), Value::Integer(v)) => {
                (Value::Real(*v as f64), (lo..=hi).contains(&(*v as f64)))
            }
            (Allowed::Integer(lo, hi), Value::Integer(v)) => {
                (Value::Integer(*v), (lo..=hi).contains(v))
            }
            // A ground station may send every number as a float.
            (Allowed::Integer(lo, hi), Value::Real(v)) if v.fract() == 0.0 => {
                (Value::Integer(*v as i64), (lo as f64..=hi as f64).contains(v))
            }
            (Allowed::Bool, Value::Bool(v)) => (Value::Bool(*v), true),
            (Allowed::Choice(names), Value::Text(v)) => {
                (Value::Text(v.clone()), names.contains(&v.as_str()))
            }
            (Allowed::Text, Value::Text(v)) => (Value::Text(v.clone()), true),
            _ => return Err(wrong()),
        };
        if inside {
            Ok(checked)
        } else {
            Err(TunableError::OutOfRange { value: value.clone(), wanted: self.allowed_text() })
        }
    }
}

/// A group of parameters declared with [`tunables!`](crate::tunables).
pub trait Section: Default + Clone {
    /// The section's name in the configuration file.
    const NAME: &'static str;
    /// What the section is about.
    const TEXT: &'static str;
    /// Its rows.
    fn table() -> Vec<Tunable>;
    /// The present value of one parameter.
    fn get(&self, name: &str) -> Option<Value>;
    /// Checks and stores one value.
    fn set(&mut self, name: &str, value: &Value) -> Result<(), TunableError>;
}

/// Conversion between a field's own type and [`Value`]; implemented for the field types in use.
pub trait Field: Sized {
    /// The field's value in the table's terms.
    fn to_value(&self) -> Value;
    /// The field from a value that [`Tunable::check`] has passed.
    fn from_checked(value: &Value) -> Option<Self>;
}

impl Field for f64 {
    fn to_value(&self) -> Value {
        Value::Real(*self)
    }
    fn from_checked(value: &Value) -> Option<Self> {
        if let Value::Real(v) = value { Some(*v) } else { None }
    }
}

impl Field for u32 {
    fn to_value(&self) -> Value {
        Value::Integer(i64::from(*self))
    }
    fn from_checked(value: &Value) -> Option<Self> {
        if let Value::Integer(v) = value { Self::try_from(*v).ok() } else { None }
    }
}

impl Field for bool {
    fn to_value(&self) -> Value {
        Value::Bool(*self)
    }
    fn from_checked(value: &Value) -> Option<Self> {
        if let Value::Bool(v) = value { Some(*v) } else { None }
    }
}

impl Field for String {
    fn to_value(&self) -> Value {
        Value::Text(self.clone())
    }
    fn from_checked(value: &Value) -> Option<Self> {
        if let Value::Text(v) = value { Some(v.clone()) } else { None }
    }
}

/// Declares an enumeration whose values have names in configuration files:
/// `choices! { /// doc pub enum Penalty { /// doc Edge = "edge", /// doc Literal = "literal" } }`.
#[macro_export]
macro_rules! choices {
    ($(#[$meta:meta])* pub enum $name:ident { $($(#[doc = $doc:literal])* $variant:ident = $text:literal),+ $(,)? }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $name { $($(#[doc = $doc])* $variant),+ }
        impl $name {
            /// The values, in order of declaration.
            pub const ALL: &'static [Self] = &[$(Self::$variant),+];
            /// The names, in order of declaration.
            pub const NAMES: &'static [&'static str] = &[$($text),+];
            /// The name in configuration files and on the command line.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $text),+ }
            }
            /// What it stands for, in a sentence.
            pub const fn text(self) -> &'static str {
                match self { $(Self::$variant => concat!($($doc),*).trim_ascii()),+ }
            }
            /// The value of that name.
            pub fn from_name(name: &str) -> Option<Self> {
                match name { $($text => Some(Self::$variant),)+ _ => None }
            }
        }
        impl $crate::tunable::Field for $name {
            fn to_value(&self) -> $crate::tunable::Value {
                $crate::tunable::Value::Text(self.name().to_owned())
            }
            fn from_checked(value: &$crate::tunable::Value) -> Option<Self> {
                if let $crate::tunable::Value::Text(v) = value { Self::from_name(v) } else { None }
            }
        }
    };
}

/// Declares a parameter struct and its table in one place:
///
/// ```
/// apexd::tunables! {
///     /// An example.
///     pub struct ExampleParams in "example" {
///         /// How fast.
///         speed_max_mps: f64 = 4.0, live, in 0.1..=20.0, "m/s";
///         /// How many.
///         count: u32 = 3, at_rest, in 1..=10, "";
///         /// Whether.
///         enabled: bool = true, restart;
///         /// Which file.
///         path: String = "", restart;
///     }
/// }
/// use apexd::tunable::Section;
/// assert_eq!(ExampleParams::table()[0].text, "How fast.");
/// ```
///
/// A choice field is written `kind: Penalty = Penalty::Edge, live, one of;` with `Penalty` from
/// [`choices!`](crate::choices).
#[macro_export]
macro_rules! tunables {
    ($(#[doc = $sdoc:literal])* pub struct $name:ident in $section:literal {
        $( $(#[doc = $doc:literal])* $field:ident : $ty:ident = $default:expr, $change:ident $(, in $lo:literal ..= $hi:literal, $unit:literal)? $(, one $of:ident)? ; )+
    }) => {
        $(#[doc = $sdoc])*
        #[derive(Clone, Debug, PartialEq)]
        pub struct $name {
            $( $(#[doc = $doc])* pub $field: $ty, )+
        }
        impl Default for $name {
            fn default() -> Self {
                Self { $( $field: $crate::tunables!(@default $ty, $default), )+ }
            }
        }
        impl $crate::tunable::Section for $name {
            const NAME: &'static str = $section;
            const TEXT: &'static str = concat!($($sdoc),*).trim_ascii();
            fn table() -> Vec<$crate::tunable::Tunable> {
                let defaults = Self::default();
                vec![ $( $crate::tunable::Tunable {
                    name: stringify!($field),
                    text: concat!($($doc),*).trim_ascii(),
                    unit: $crate::tunables!(@unit $($unit)?),
                    allowed: $crate::tunables!(@allowed $ty $(, $lo, $hi)? $(, $of)?),
                    default: $crate::tunable::Field::to_value(&defaults.$field),
                    change: $crate::tunables!(@change $change),
                } ),+ ]
            }
            fn get(&self, name: &str) -> Option<$crate::tunable::Value> {
                match name {
                    $( stringify!($field) => Some($crate::tunable::Field::to_value(&self.$field)), )+
                    _ => None,
                }
            }
            fn set(&mut self, name: &str, value: &$crate::tunable::Value) -> Result<(), $crate::tunable::TunableError> {
                let row = Self::table().into_iter().find(|row| row.name == name)
                    .ok_or($crate::tunable::TunableError::Unknown)?;
                let checked = row.check(value)?;
                match name {
                    $( stringify!($field) => {
                        self.$field = $crate::tunable::Field::from_checked(&checked)
                            .expect("a checked value converts to its field's type");
                    } )+
                    _ => return Err($crate::tunable::TunableError::Unknown),
                }
                Ok(())
            }
        }
    };
    (@default String, $default:expr) => { String::from($default) };
    (@default $ty:ident, $default:expr) => { $default };
    (@unit) => { "" };
    (@unit $unit:literal) => { $unit };
    (@allowed f64, $lo:literal, $hi:literal) => { $crate::tunable::Allowed::Real($lo, $hi) };
    (@allowed u32, $lo:literal, $hi:literal) => { $crate::tunable::Allowed::Integer($lo, $hi) };
    (@allowed bool) => { $crate::tunable::Allowed::Bool };
    (@allowed String) => { $crate::tunable::Allowed::Text };
    (@allowed $ty:ident, $of:ident) => { $crate::tunable::Allowed::Choice($ty::NAMES) };
    (@change live) => { $crate::tunable::Change::Live };
    (@change at_rest) => { $crate::tunable::Change::AtRest };
    (@change restart) => { $crate::tunable::Change::Restart };
}

#[cfg(test)]
mod tests {
    use super::*;

    choices! {
        /// A shape.
        pub enum Shape {
            /// Four corners.
            Square = "square",
            /// None.
            Round = "round",
        }
    }

    tunables! {
        /// Things to
        /// try out.
        pub struct Trial in "trial" {
            /// How fast.
            speed_mps: f64 = 4.0, live, in 0.1..=20.0, "m/s";
            /// How many
            /// of them.
            count: u32 = 3, at_rest, in 1..=10, "";
            /// Which one.
            shape: Shape = Shape::Round, restart, one of;
            /// Where.
            path: String = "here", restart;
        }
    }

    #[test]
    fn a_declaration_gives_defaults_and_a_table() {
        let table = Trial::table();
        assert_eq!(Trial::TEXT, "Things to try out.");
        assert_eq!(table[1].text, "How many of them.");
        assert_eq!(table[2].allowed, Allowed::Choice(&["square", "round"]));
        assert_eq!(Trial::default().get("path"), Some(Value::Text("here".into())));
        assert_eq!(table[2].change, Change::Restart);
    }

    #[test]
    fn every_choice_has_a_name_that_leads_back_to_it_and_a_text() {
        for shape in Shape::ALL {
            assert_eq!(Shape::from_name(shape.name()), Some(*shape));
        }
        assert_eq!(Shape::ALL.iter().map(|shape| shape.name()).collect::<Vec<_>>(), Shape::NAMES);
        assert_eq!(Shape::Square.text(), "Four corners.");
    }

    #[test]
    fn values_are_checked_by_kind_and_range() {
        let mut trial = Trial::default();
        trial.set("speed_mps", &Value::Integer(2)).unwrap();
        assert_eq!(trial.speed_mps, 2.0);
        let error = trial.set("speed_mps", &Value::Real(99.0)).unwrap_err();
        assert_eq!(error.to_string(), "is 99.0, allowed is 0.1 to 20 m/s");
        assert!(trial.set("speed_mps", &Value::Real(f64::NAN)).is_err());
        assert!(matches!(
            trial.set("count", &Value::Text("x".into())),
            Err(TunableError::WrongType { .. })
        ));
        assert!(trial.set("shape", &Value::Text("oval".into())).is_err());
        trial.set("shape", &Value::Text("square".into())).unwrap();
        assert_eq!(trial.shape, Shape::Square);
        assert_eq!(trial.set("sped", &Value::Real(1.0)), Err(TunableError::Unknown));
        assert_eq!(trial.speed_mps, 2.0);
    }
}
