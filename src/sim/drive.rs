//! What is kept of a simulated drive: the summary a script reads and the trace a person looks at.

use serde::{Deserialize, Serialize};

use crate::frames::{Point, Pose};

/// How a drive ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// True centre within the goal radius and at rest.
    Goal,
    /// At rest for 5 s without a certified plan longer than 0.1 m.
    Stuck,
    /// The time limit passed.
    Timeout,
    /// The footprint touched an obstacle.
    Collision,
    /// The known map proves that no way exists.
    Unreachable,
    /// A person ended the drive before its time.
    Interrupted,
}

/// Spread of a wall-clock or age figure, in milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Median.
    pub p50: f64,
    /// 99th percentile (nearest rank).
    pub p99: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    /// Median, 99th percentile and maximum of the figures; zeros if there are none.
    pub fn of(figures: &[f64]) -> Self {
        if figures.is_empty() {
            return Self::default();
        }
        let mut sorted = figures.to_vec();
        sorted.sort_by(f64::total_cmp);
        let rank = |p: f64| sorted[((p * sorted.len() as f64).ceil() as usize).max(1) - 1];
        Self { p50: rank(0.5), p99: rank(0.99), max: sorted[sorted.len() - 1] }
    }
}

/// The figures of one drive, as `apexd sil --json` prints them.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// How it ended.
    pub outcome: Outcome,
    /// Seconds from the first motion to rest.
    pub time_s: f64,
    /// Length of the true path, metres.
    pub path_m: f64,
    /// Instants at which the true footprint touched the true world.
    pub collisions: u64,
    /// Instants at which the true footprint overlapped space that no delivered beam had shown free.
    pub unknown_entries: u64,
    /// Smallest true distance to an obstacle, less the car's radius, metres.
    pub min_clearance_m: f64,
    /// Planning steps.
    pub replans: u64,
    /// Plans that did not pass the certificate.
    pub plans_rejected: u64,
    /// Times the guard took over.
    pub guard_stops: u64,
    /// Mean number of candidate paths a planning step weighed.
    pub candidates: f64,
    /// Wall time of a planning step.
    pub plan_ms: Spread,
    /// Wall time of its prediction part.
    pub predict_ms: Spread,
    /// Observed cells that the predictor encoded, mean over the planning steps.
    pub predict_context: f64,
    /// Cells that it decoded, mean over the planning steps.
    pub predict_decoded: f64,
    /// Planning steps in which the prediction failed.
    pub prediction_faults: u64,
    /// Age of the newest scan in the plan being driven.
    pub age_ms: Spread,
    /// Simulated time over wall time.
    pub realtime_factor: f64,
    /// Hash over every setpoint sent, hexadecimal.
    pub digest: String,
}

/// The true state of the car at one moment, with what it was told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TraceSample {
    /// Seconds since the start of the simulation.
    pub t_s: f64,
    /// True pose, map frame.
    pub pose: Pose,
    /// True speed, m/s.
    pub speed_mps: f64,
    /// True curvature, 1/m.
    pub curvature_pm: f64,
    /// Longitudinal force set, newtons.
    pub longitudinal_n: f64,
    /// Lateral force set, newtons.
    pub lateral_n: f64,
}

/// Where one adopted plan would have come to rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanMark {
    /// When it was adopted, seconds since the start of the simulation.
    pub t_s: f64,
    /// Where it ends, map frame.
    pub stop: Point,
}

/// The course of a drive, for pictures.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Trace {
    /// Every 10 ms of simulated time.
    pub samples: Vec<TraceSample>,
    /// Every adopted plan.
    pub plans: Vec<PlanMark>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_use_the_nearest_rank() {
        let figures: Vec<f64> = (1..=100).rev().map(f64::from).collect();
        assert_eq!(Spread::of(&figures), Spread { p50: 50.0, p99: 99.0, max: 100.0 });
        assert_eq!(Spread::of(&[7.0]), Spread { p50: 7.0, p99: 7.0, max: 7.0 });
        assert_eq!(Spread::of(&[]), Spread::default());
    }
}
