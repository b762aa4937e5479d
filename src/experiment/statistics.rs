//! Means, bootstrap intervals, and two-tailed t tests.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use statrs::distribution::{ContinuousCDF, StudentsT};

/// Resamples of a bootstrap.
pub const RESAMPLES: usize = 10_000;
/// Seed of the resampling: the same figures give the same interval.
const SEED: u64 = 1;

/// A mean with its 95 per cent interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Interval {
    /// The mean.
    pub mean: f64,
    /// Lower end.
    pub low: f64,
    /// Upper end.
    pub high: f64,
}

/// What a t test says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TTest {
    /// The statistic.
    pub t: f64,
    /// Degrees of freedom.
    pub freedom: f64,
    /// Two-tailed probability of a statistic at least as far from zero if the means are equal.
    pub p: f64,
}

/// Arithmetic mean; `None` of nothing.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Sample variance (divided by one less than the number); `None` of fewer than two.
pub fn variance(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
    Some(squares / (values.len() - 1) as f64)
}

/// The mean and its 95 per cent interval by the percentile bootstrap (Efron and Tibshirani 1993,
/// chapter 13); `None` of nothing.
pub fn bootstrap(values: &[f64]) -> Option<Interval> {
    let mean = mean(values)?;
    let mut rng = ChaCha8Rng::seed_from_u64(SEED);
    let n = values.len();
    let mut means: Vec<f64> = (0..RESAMPLES)
        .map(|_| {
            let draw = |rng: &mut ChaCha8Rng| {
                // The product of 32 random bits and the number, without the low word: unbiased to
                // one in 2^32 over n.
                let i = (u64::from(rng.next_u32()) * n as u64) >> 32;
                values[i as usize]
            };
            (0..n).map(|_| draw(&mut rng)).sum::<f64>() / n as f64
        })
        .collect();
    means.sort_by(f64::total_cmp);
    let at = |p: f64| means[((p * RESAMPLES as f64) as usize).min(RESAMPLES - 1)];
    Some(Interval { mean, low: at(0.025), high: at(0.975) })
}

/// The paired test of two equally long lists, pair by pair; `None` of fewer than two pairs. If all
/// differences are the same, the test has nothing to go by: `None`.
pub fn paired_t(a: &[f64], b: &[f64]) -> Option<TTest> {
    if a.len() != b.len() {
        return None;
    }
    let differences: Vec<f64> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    let n = differences.len() as f64;
    let error = (variance(&differences)? / n).sqrt();
    two_tailed(mean(&differences)? / error, n - 1.0)
}

/// Welch's test of two lists with variances of their own; `None` of fewer than two values in
/// either, or if neither list varies.
pub fn welch_t(a: &[f64], b: &[f64]) -> Option<TTest> {
    let (n, m) = (a.len() as f64, b.len() as f64);
    let (u, v) = (variance(a)? / n, variance(b)? / m);
    let freedom = (u + v).powi(2) / (u * u / (n - 1.0) + v * v / (m - 1.0));
    two_tailed((mean(a)? - mean(b)?) / (u + v).sqrt(), freedom)
}

fn two_tailed(t: f64, freedom: f64) -> Option<TTest> {
    let student = StudentsT::new(0.0, 1.0, freedom).ok().filter(|_| t.is_finite())?;
    Some(TTest { t, freedom, p: 2.0 * student.cdf(-t.abs()) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Student's sleep data (1908), as R has them.
    const SLEEP: [[f64; 10]; 2] = [
        [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
        [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
    ];

    #[test]
    fn the_tests_agree_with_those_of_r_on_the_sleep_data() {
        let [a, b] = SLEEP;
        // t.test(extra ~ group, data = sleep, paired = TRUE)
        let paired = paired_t(&a, &b).unwrap();
        assert!((paired.t + 4.0621).abs() < 5e-5, "{paired:?}");
        assert_eq!(paired.freedom, 9.0);
        assert!((paired.p - 0.002833).abs() < 5e-7, "{paired:?}");
        // t.test(extra ~ group, data = sleep)
        let welch = welch_t(&a, &b).unwrap();
        assert!((welch.t + 1.8608).abs() < 5e-5, "{welch:?}");
        assert!((welch.freedom - 17.776).abs() < 5e-4, "{welch:?}");
        assert!((welch.p - 0.07939).abs() < 5e-6, "{welch:?}");
    }

    #[test]
    fn critical_values_of_the_tables_have_their_probabilities() {
        for (freedom, t, p) in [
            (1.0, 12.7062, 0.05),
            (5.0, 4.0321, 0.01),
            (29.0, 2.0452, 0.05),
            (1000.0, 3.3003, 0.001),
        ] {
            let found = two_tailed(t, freedom).unwrap().p;
            assert!((found / p - 1.0).abs() < 1e-3, "{freedom}: {found}");
        }
    }

    #[test]
    fn tests_without_anything_to_go_by_say_nothing() {
        assert_eq!(paired_t(&[1.0], &[2.0]), None);
        assert_eq!(paired_t(&[1.0, 2.0], &[2.0]), None);
        assert_eq!(paired_t(&[1.0, 2.0], &[2.0, 3.0]), None, "all differences are alike");
        assert_eq!(welch_t(&[1.0, 1.0], &[2.0, 2.0]), None);
        assert_eq!((mean(&[]), variance(&[1.0]), bootstrap(&[])), (None, None, None));
    }

    #[test]
    fn the_interval_holds_the_true_mean_nineteen_times_out_of_twenty() {
        // Sums of twelve uniform draws, less six: nearly normal, mean 0.
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut normal =
            || (0..12).map(|_| f64::from(rng.next_u32()) / 2f64.powi(32)).sum::<f64>() - 6.0;
        let held = (0..200)
            .filter(|_| {
                let values: Vec<f64> = (0..30).map(|_| normal()).collect();
                let interval = bootstrap(&values).unwrap();
                assert!(interval.low <= interval.mean && interval.mean <= interval.high);
                interval.low <= 0.0 && 0.0 <= interval.high
            })
            .count();
        // The percentile interval of 30 values is a little too short: 94 per cent.
        assert!((176..=198).contains(&held), "{held} of 200");
    }

    #[test]
    fn the_interval_of_equal_values_is_a_point() {
        let interval = bootstrap(&[1.5; 8]).unwrap();
        assert_eq!((interval.low, interval.mean, interval.high), (1.5, 1.5, 1.5));
    }
}
