//! How far to trust a prediction.

use serde::Deserialize;

/// Calibration of a network by distance from the frontier.
///
/// A network's file gives it as JSON, as `calibration`:
///
/// ```json
/// { "edges_m": [0.0, 1.25, 2.5, 5.0], "temperature": [1.0, 0.9, 1.2] }
/// ```
///
/// Within a ring around the frontier the log-odds of the network's answers are divided by the
/// ring's temperature (Guo et al. 2017): above 1 draws them towards 0.5, below 1 away from it.
/// The distance is that from the centre of a coarse cell to the nearest of the frontier's pieces,
/// each of which stands at its cell nearest to its centroid; the first and the last ring reach
/// beyond their outer edges. Other entries are for people.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    edges_m: Vec<f32>,
    temperatures: Vec<f32>,
}

#[derive(Deserialize)]
struct CalibrationText {
    #[serde(default)]
    edges_m: Vec<f32>,
    #[serde(default)]
    temperature: Vec<f32>,
}

/// Temperatures beyond these say that something went wrong.
const TEMPERATURES: std::ops::RangeInclusive<f32> = 0.1..=10.0;

impl Calibration {
    /// Reads the JSON; nothing if it has no temperatures.
    ///
    /// # Errors
    /// In words, what is wanted instead.
    pub(super) fn parse(text: &str) -> Result<Option<Self>, String> {
        let CalibrationText { edges_m, temperature } = serde_json::from_str(text)
            .map_err(|error| format!("JSON with lists edges_m and temperature ({error})"))?;
        if edges_m.is_empty() && temperature.is_empty() {
            return Ok(None);
        }
        let rising = edges_m.windows(2).all(|w| w[0] < w[1]) && edges_m.iter().all(|e| *e >= 0.0);
        if edges_m.len() != temperature.len() + 1 || !rising {
            return Err("JSON with rising edges_m, one more than temperatures".into());
        }
        if !temperature.iter().all(|t| TEMPERATURES.contains(t)) {
            let (low, high) = (TEMPERATURES.start(), TEMPERATURES.end());
            return Err(format!("JSON with temperatures from {low} to {high}"));
        }
        Ok(Some(Self { edges_m, temperatures: temperature }))
    }

    /// The calibrated probability for an answer at a distance from the frontier, metres.
    pub fn calibrated(&self, p: f32, distance_m: f32) -> f32 {
        let inner = &self.edges_m[1..self.edges_m.len() - 1];
        let ring = inner.partition_point(|edge| *edge <= distance_m);
        let log_odds = (p / (1.0 - p)).ln() / self.temperatures[ring];
        1.0 / (1.0 + (-log_odds).exp())
    }
}

/// A probability faded towards knowing nothing: with weight 0 it is 0.5, with weight 1 as it was.
pub(super) fn faded(p: f32, weight: f32) -> f32 {
    0.5 + weight * (p - 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_odds_are_divided_by_the_temperature_of_the_ring() {
        let text = r#"{"edges_m": [0, 1, 2.5], "temperature": [1, 2], "ece": [0.1, null]}"#;
        let calibration = Calibration::parse(text).unwrap().unwrap();
        for (distance_m, p, wanted) in [
            (0.0, 0.8, 0.8),
            (0.99, 0.2, 0.2),
            // Odds of 4 become odds of 2.
            (1.0, 0.8, 2.0 / 3.0),
            (2.4, 0.2, 1.0 / 3.0),
            (99.0, 0.8, 2.0 / 3.0),
            (f32::INFINITY, 0.8, 2.0 / 3.0),
            (1.5, 0.5, 0.5),
            (1.5, 0.0, 0.0),
            (1.5, 1.0, 1.0),
        ] {
            let found = calibration.calibrated(p, distance_m);
            assert!((found - wanted).abs() < 1e-6, "{distance_m} {p}: {found}");
        }
    }

    #[test]
    fn what_is_no_calibration_is_refused_in_words() {
        assert_eq!(Calibration::parse("{}"), Ok(None));
        assert_eq!(Calibration::parse(r#"{"note": "none yet"}"#), Ok(None));
        for text in [
            "[",
            r#"{"edges_m": [0, 1]}"#,
            r#"{"temperature": [1]}"#,
            r#"{"edges_m": [0, 1], "temperature": [1, 1]}"#,
            r#"{"edges_m": [0, 1, 1], "temperature": [1, 1]}"#,
            r#"{"edges_m": [-1, 1], "temperature": [1]}"#,
            r#"{"edges_m": [0, 1], "temperature": [0]}"#,
            r#"{"edges_m": [0, 1], "temperature": [11]}"#,
            r#"{"edges_m": [0, 1], "temperature": ["hot"]}"#,
        ] {
            assert!(Calibration::parse(text).unwrap_err().contains("JSON"), "{text}");
        }
    }

    #[test]
    fn fading_ends_at_one_half() {
        assert_eq!(faded(0.9, 0.0), 0.5);
        assert_eq!(faded(1.0, 0.5), 0.75);
        assert_eq!(faded(0.25, 1.0), 0.25);
    }
}
