//! How the values of options are read.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};

use crate::frames::{Point, Pose};
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::maze::Family;
use crate::sim::rig::Latency;
use crate::wire::can::Layout;

/// Reads a value by its name; `--help` and the error on any other name list them all.
fn choice<T: Copy + Send + Sync + 'static>(
    all: &'static [T],
    name: fn(T) -> &'static str,
    text: fn(T) -> &'static str,
) -> impl TypedValueParser<Value = T> {
    let names = all
        .iter()
        .map(|value| PossibleValue::new(name(*value)).help(text(*value).trim_end_matches('.')));
    PossibleValuesParser::new(names.collect::<Vec<_>>()).map(move |given| {
        let named = all.iter().find(|value| name(**value) == given);
        *named.expect("only names of the list get through")
    })
}

pub(super) fn family() -> impl TypedValueParser<Value = Family> {
    choice(Family::ALL, Family::name, Family::text)
}

pub(super) fn layout() -> impl TypedValueParser<Value = Layout> {
    choice(Layout::ALL, Layout::name, Layout::text)
}

pub(super) fn policy() -> impl TypedValueParser<Value = Policy> {
    choice(Policy::ALL, Policy::name, Policy::text)
}

/// A predictor by its name, or a network by its file.
#[derive(Clone, Debug, PartialEq)]
pub enum PredictorChoice {
    /// One of those that have a name.
    Kind(PredictorKind),
    /// The trained network of an ONNX file.
    Network(String),
}

pub(super) fn predictor(text: &str) -> Result<PredictorChoice, String> {
    if let Some(kind) = PredictorKind::from_name(text) {
        return Ok(PredictorChoice::Kind(kind));
    }
    if text.ends_with(".onnx") {
        return Ok(PredictorChoice::Network(text.to_owned()));
    }
    Err(format!("wanted is one of {}, or a file FILE.onnx", PredictorKind::NAMES.join(", ")))
}

/// A range of seeds, its upper end left out.
pub(super) fn seeds(text: &str) -> Result<[u64; 2], String> {
    let ends = text.split_once("..").and_then(|(a, b)| Some([a.parse().ok()?, b.parse().ok()?]));
    match ends {
        Some([from, end]) if from < end => Ok([from, end]),
        _ => Err("wanted are two whole numbers A..B, the second one larger, as in 0..2000".into()),
    }
}

/// A number from 0 to 1.
pub(super) fn share(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|v| (0.0..=1.0).contains(v));
    number.ok_or_else(|| "wanted is a number from 0 to 1".into())
}

/// `N` numbers separated by commas.
fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let parsed: Option<Vec<f64>> = text
        .split(',')
        .map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite()))
        .collect();
    parsed?.try_into().ok()
}

pub(super) fn pose(text: &str) -> Result<Pose, String> {
    let [x, y, degrees] = numbers(text).ok_or(
        "wanted are three numbers X,Y,DEG: metres, metres and degrees, as in 1.25,1.25,90",
    )?;
    Ok(Pose::new(x, y, crate::frames::wrap_angle(degrees.to_radians())))
}

pub(super) fn point(text: &str) -> Result<Point, String> {
    let [x, y] =
        numbers(text).ok_or("wanted are two numbers X,Y: metres and metres, as in 23.75,23.75")?;
    Ok(Point::new(x, y))
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v > 0.0);
    value.ok_or_else(|| "wanted is a number above zero".to_owned())
}

pub(super) fn not_negative(text: &str) -> Result<f64, String> {
    let value = text.trim().parse::<f64>().ok().filter(|v| v.is_finite() && *v >= 0.0);
    value.ok_or_else(|| "wanted is a number of seconds, zero or more".to_owned())
}

pub(super) fn latency(text: &str) -> Result<Latency, String> {
    if text == "measured" {
        return Ok(Latency::Measured);
    }
    let seconds = text.trim().parse::<f64>().ok().filter(|v| (0.0..=1.0).contains(v));
    seconds
        .map(Latency::Fixed)
        .ok_or_else(|| "wanted is `measured` or a number of seconds from 0 to 1".to_owned())
}
