//! Wall times of planning steps, in a form that can be joined over many drives.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::plan::StepTimes;
use crate::time::Duration;

/// Counts over steps of a geometric scale. What lies in one step differs by 3.1 per cent, so a
/// percentile read off it is wrong by 1.6 per cent at most.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Histogram(BTreeMap<i32, u64>);

/// Steps in which the scale doubles.
const PER_OCTAVE: f64 = 22.5;
/// What is not above zero is counted here.
const ZERO: i32 = i32::MIN;

impl Histogram {
    /// Counts a figure.
    pub fn add(&mut self, value: f64) {
        let step = if value > 0.0 { (value.log2() * PER_OCTAVE).floor() as i32 } else { ZERO };
        *self.0.entry(step).or_default() += 1;
    }

    /// Counts all that another one has counted.
    pub fn join(&mut self, other: &Self) {
        for (step, count) in &other.0 {
            *self.0.entry(*step).or_default() += count;
        }
    }

    /// Number of figures.
    pub fn count(&self) -> u64 {
        self.0.values().sum()
    }

    /// The figure below which the share `p` lies (nearest rank); `None` if nothing was counted.
    pub fn quantile(&self, p: f64) -> Option<f64> {
        let rank = ((p * self.count() as f64).ceil() as u64).max(1);
        let mut below = 0;
        self.0.iter().find_map(|(step, count)| {
            below += count;
            let middle = || ((f64::from(*step) + 0.5) / PER_OCTAVE).exp2();
            (below >= rank).then(|| if *step == ZERO { 0.0 } else { middle() })
        })
    }
}

/// Figures of one kind, in milliseconds.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Sum of all of them.
    pub sum: f64,
    /// Largest of them.
    pub max: f64,
    /// How they are spread.
    pub spread: Histogram,
}

impl Figures {
    fn add(&mut self, duration: Duration) {
        let ms = duration.as_secs_f64() * 1e3;
        self.sum += ms;
        self.max = self.max.max(ms);
        self.spread.add(ms);
    }

    /// Adds those of another drive.
    pub fn join(&mut self, other: &Self) {
        self.sum += other.sum;
        self.max = self.max.max(other.max);
        self.spread.join(&other.spread);
    }

    /// Mean, milliseconds.
    pub fn mean(&self) -> f64 {
        self.sum / self.spread.count().max(1) as f64
    }
}

/// Wall times of the planning steps of a drive, or of several.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WallTimes {
    /// The whole step.
    pub total: Figures,
    /// Prediction.
    pub predict: Figures,
    /// Sums of the parts, milliseconds, in the order of [`WallTimes::PARTS`].
    pub parts_ms: [f64; 8],
}

impl WallTimes {
    /// Names of the parts of a step.
    pub const PARTS: [&str; 8] = [
        "distances",
        "prediction",
        "search",
        "manoeuvre",
        "smoothing",
        "speed",
        "certificate",
        "rest",
    ];

    /// Counts a step.
    pub fn add(&mut self, times: &StepTimes) {
        self.total.add(times.total);
        self.predict.add(times.predict);
        let parts = [
            times.field,
            times.predict,
            times.search,
            times.manoeuvre,
            times.smooth,
            times.speed,
            times.certify,
        ]
        .map(|part| part.as_secs_f64() * 1e3);
        let rest = (times.total.as_secs_f64() * 1e3 - parts.iter().sum::<f64>()).max(0.0);
        for (sum, part) in self.parts_ms.iter_mut().zip(parts.into_iter().chain([rest])) {
            *sum += part;
        }
    }

    /// Adds those of another drive.
    pub fn join(&mut self, other: &Self) {
        self.total.join(&other.total);
        self.predict.join(&other.predict);
        for (sum, part) in self.parts_ms.iter_mut().zip(other.parts_ms) {
            *sum += part;
        }
    }

    /// Mean of each part over the steps, milliseconds.
    pub fn means_ms(&self) -> [f64; 8] {
        self.parts_ms.map(|sum| sum / self.total.spread.count().max(1) as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_joined_histograms_are_those_of_all_figures() {
        let (mut low, mut high) = (Histogram::default(), Histogram::default());
        for i in 1..=1000 {
            (if i <= 400 { &mut low } else { &mut high }).add(f64::from(i) * 0.01);
        }
        low.join(&high);
        assert_eq!(low.count(), 1000);
        for (p, wanted) in [(0.5, 5.0), (0.99, 9.9), (0.01, 0.1), (1.0, 10.0)] {
            let found = low.quantile(p).unwrap();
            assert!((found / wanted - 1.0).abs() < 0.032, "{p}: {found}");
        }
        assert_eq!(Histogram::default().quantile(0.5), None);
        let mut zeros = Histogram::default();
        zeros.add(0.0);
        assert_eq!(zeros.quantile(0.5), Some(0.0));
    }

    #[test]
    fn the_parts_and_the_rest_make_up_the_step() {
        let ms = Duration::from_millis;
        let times = StepTimes {
            field: ms(1),
            predict: ms(2),
            search: ms(3),
            total: ms(10),
            ..StepTimes::default()
        };
        let mut wall = WallTimes::default();
        wall.add(&times);
        wall.add(&times);
        assert_eq!(wall.means_ms(), [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0, 4.0]);
        assert_eq!((wall.total.mean(), wall.total.max), (10.0, 10.0));
    }
}
