//! What can go wrong with a prediction.

use crate::time::Duration;

/// What can go wrong with a prediction. None of it touches safety: where there is no prediction,
/// unknown space counts as half occupied.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PredictFault {
    /// An answer is not a number in `[0, 1]`.
    #[error("an answer is {value}, which is no probability")]
    NotAProbability {
        /// The answer.
        value: f32,
    },
    /// It took too long.
    #[error("it has taken {:.1} ms, allowed are {:.1} ms", took.as_secs_f64() * 1e3, limit.as_secs_f64() * 1e3)]
    TooSlow {
        /// Time spent in the step when it was stopped.
        took: Duration,
        /// Time allowed in a step.
        limit: Duration,
    },
    /// The network did not run, or there is none.
    #[error("{0}")]
    Failed(String),
}
