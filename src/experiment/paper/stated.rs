//! The numbers that the text of Elhafsi et al. (2020) states. Its figures are bars without labels;
//! what only they show is not repeated here.

use super::OURS;

/// Which sentence of the paper a number is from, for captions.
pub const SOURCES: &str = "Elhafsi et al. (2020), section V: “only 2 % worse in relative completion \
    time (105 % vs. 107 %)” at the two lower maximum speeds, “only a 7-8 % deficit to the optimal \
    trajectory across maximum speed values”, “0.5 s (2 Hz) execution time per planning iteration \
    (∼11× faster than [Janson et al.])”, “forward propagation of the CNP model […] 10 ms on average”. \
    The two lower speeds are taken to be 1 and 2 m/s; the text names 3 and 4 m/s only.";

/// Completion time over the optimal one, from and to.
pub fn completion(method: &str, speed_mps: f64) -> Option<[f64; 2]> {
    let [low, high] = [[1.0, 2.0], [3.0, 4.0]].map(|speeds| speeds.contains(&speed_mps));
    match method {
        OURS if low => Some([1.07, 1.07]),
        OURS if high => Some([1.07, 1.08]),
        "janson" if low => Some([1.05, 1.05]),
        _ => None,
    }
}

/// Mean time of a planning step, milliseconds.
pub fn step_ms(method: &str) -> Option<f64> {
    match method {
        OURS => Some(500.0),
        // “∼11× faster than” it.
        "janson" => Some(5500.0),
        _ => None,
    }
}

/// Mean time of a prediction, milliseconds.
pub const PREDICTION_MS: f64 = 10.0;

/// The probability that the paper gives for two methods being equal, in two-tailed t tests.
pub fn p(a: &str, b: &str, speed_mps: f64) -> Option<&'static str> {
    match (a, b) {
        (OURS, "frontier") => Some("< 0.001"),
        (OURS, "map-predictive+oracle") => Some("0.74 to 0.96"),
        (OURS, "janson") if [1.0, 2.0].contains(&speed_mps) => Some("0.042, 0.046"),
        (OURS, "janson") if speed_mps == 3.0 => Some("0.17"),
        (OURS, "janson") if speed_mps == 4.0 => Some("0.46"),
        ("janson+cnp", "janson") => Some("0.12 to 0.43"),
        _ => None,
    }
}

/// What the paper says of sensor and prediction ranges, at 4 m/s.
pub const RANGES: &str =
    "paper: all methods poor at 2.5 m of sensor range; 7.5 m of prediction range does no harm";
