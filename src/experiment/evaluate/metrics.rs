//! Scores of probabilities against what is there.

use serde::Serialize;

/// Probabilities are moved this far away from 0 and 1 before their logarithm is taken: a network in
/// single precision may round to either.
const CLIP: f64 = 1e-6;

/// Bins of the reliability diagram, equally wide.
pub const RELIABILITY_BINS: usize = 20;

/// The area under the curve ranks probabilities by their logits, in steps of 1/256 from -16 to 16.
const RANKS: usize = 8192;
const RANK_STEPS: f64 = 256.0;

/// One bin of a reliability diagram.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Reliability {
    /// Probabilities in it.
    pub count: u64,
    /// Their mean.
    pub predicted: f64,
    /// The share that is occupied.
    pub occupied: f64,
}

/// Scores of one predictor on one set of cells (or edges).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// How many were scored.
    pub count: u64,
    /// The share that is occupied (of edges: closed).
    pub occupied: f64,
    /// Mean negative logarithm of the probability given to what is there, in nats.
    pub log_loss: f64,
    /// Share for which the more likely one of free and occupied is there; 0.5 counts as free.
    pub accuracy: f64,
    /// Area under the receiver operating characteristic: the probability that an occupied cell is
    /// given more than a free one, ties counted half. Absent if there is only one kind.
    pub auc: Option<f64>,
    /// Expected calibration error: the mean distance between probability and share over the bins
    /// of the reliability diagram, weighted by their counts.
    pub ece: f64,
}

/// Sums from which the scores follow.
#[derive(Clone)]
pub struct Tally {
    count: u64,
    occupied: u64,
    loss: f64,
    correct: u64,
    /// Free and occupied ones of each rank.
    ranks: Vec<[u32; 2]>,
    /// Count, sum of the probabilities, occupied ones.
    bins: [(u64, f64, u64); RELIABILITY_BINS],
}

impl Default for Tally {
    fn default() -> Self {
        Self {
            count: 0,
            occupied: 0,
            loss: 0.0,
            correct: 0,
            ranks: vec![[0; 2]; RANKS],
            bins: [(0, 0.0, 0); RELIABILITY_BINS],
        }
    }
}

/// The loss of one probability (of being occupied).
pub fn log_loss(p: f32, occupied: bool) -> f64 {
    let p = f64::from(p).clamp(CLIP, 1.0 - CLIP);
    if occupied { -p.ln() } else { -(-p).ln_1p() }
}

impl Tally {
    /// Adds a probability in `[0, 1]` and what is there.
    pub fn add(&mut self, p: f32, occupied: bool) {
        let exact = f64::from(p);
        self.count += 1;
        self.occupied += u64::from(occupied);
        self.loss += log_loss(p, occupied);
        self.correct += u64::from((exact > 0.5) == occupied);
        let clipped = exact.clamp(CLIP, 1.0 - CLIP);
        let logit = (clipped / (1.0 - clipped)).ln();
        let rank = (logit * RANK_STEPS).round() as i64 + RANKS as i64 / 2;
        self.ranks[rank.clamp(0, RANKS as i64 - 1) as usize][usize::from(occupied)] += 1;
        let bin = ((exact * RELIABILITY_BINS as f64) as usize).min(RELIABILITY_BINS - 1);
        let bin = &mut self.bins[bin];
        *bin = (bin.0 + 1, bin.1 + exact, bin.2 + u64::from(occupied));
    }

    /// The scores; `None` if nothing was added.
    pub fn scores(&self) -> Option<Scores> {
        if self.count == 0 {
            return None;
        }
        let n = self.count as f64;
        let ece = self
            .reliability()
            .into_iter()
            .map(|bin| bin.count as f64 / n * (bin.predicted - bin.occupied).abs());
        Some(Scores {
            count: self.count,
            occupied: self.occupied as f64 / n,
            log_loss: self.loss / n,
            accuracy: self.correct as f64 / n,
            auc: self.auc(),
            ece: ece.sum(),
        })
    }

    /// The reliability diagram, from low to high probabilities; empty bins have count 0.
    pub fn reliability(&self) -> Vec<Reliability> {
        let bin = |(count, sum, occupied): &(u64, f64, u64)| {
            let n = (*count).max(1) as f64;
            Reliability { count: *count, predicted: sum / n, occupied: *occupied as f64 / n }
        };
        self.bins.iter().map(bin).collect()
    }

    /// Mann-Whitney's U over the number of pairs.
    fn auc(&self) -> Option<f64> {
        let occupied = self.occupied as f64;
        let free = self.count as f64 - occupied;
        if occupied == 0.0 || free == 0.0 {
            return None;
        }
        let (mut below, mut won) = (0.0, 0.0);
        for [free, occupied] in &self.ranks {
            let (free, occupied) = (f64::from(*free), f64::from(*occupied));
            won += occupied * (below + 0.5 * free);
            below += free;
        }
        Some(won / (occupied * free))
    }
}

/// Half the width of the 95 % interval of a mean over cells that come in clusters (worlds): sum and
/// count of each cluster. The ratio estimator with the normal quantile (Cochran, "Sampling
/// Techniques", 1977, section 6.4); `None` for fewer than two clusters.
pub fn clustered_interval(clusters: &[(f64, u64)]) -> Option<f64> {
    if clusters.len() < 2 {
        return None;
    }
    let n: f64 = clusters.iter().map(|(_, n)| *n as f64).sum();
    let mean = clusters.iter().map(|(sum, _)| sum).sum::<f64>() / n;
    let squares: f64 = clusters.iter().map(|(sum, n)| (sum - mean * *n as f64).powi(2)).sum();
    let w = clusters.len() as f64;
    Some(1.96 * (squares * w / (w - 1.0)).sqrt() / n)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tally(pairs: &[(f32, bool)]) -> Tally {
        let mut tally = Tally::default();
        for (p, occupied) in pairs {
            tally.add(*p, *occupied);
        }
        tally
    }

    #[test]
    fn a_small_case_by_hand() {
        let scores =
            tally(&[(0.9, true), (0.6, false), (0.6, true), (0.2, false), (0.2, true)]).scores();
        let scores = scores.unwrap();
        assert_eq!((scores.count, scores.occupied), (5, 0.6));
        // -(ln 0.9 + ln 0.4 + ln 0.6 + ln 0.8 + ln 0.2) / 5
        let log_loss = (0.105_361 + 0.916_291 + 0.510_826 + 0.223_144 + 1.609_438) / 5.0;
        assert!((scores.log_loss - log_loss).abs() < 1e-5, "{}", scores.log_loss);
        assert_eq!(scores.accuracy, 0.6);
        // Of the six pairs of an occupied and a free one: 0.9 wins 2; 0.6 ties 1 and wins 1; 0.2
        // loses 1 and ties 1.
        assert!((scores.auc.unwrap() - 4.0 / 6.0).abs() < 1e-12);
        // Bins: 0.9 alone, |0.9 - 1|; 0.6 twice, |0.6 - 0.5|; 0.2 twice, |0.2 - 0.5|.
        let ece = (0.1 + 2.0 * 0.1 + 2.0 * 0.3) / 5.0;
        assert!((scores.ece - ece).abs() < 1e-6, "{}", scores.ece);
    }

    #[test]
    fn certain_answers_have_a_finite_loss_and_half_counts_as_free() {
        let wrong = tally(&[(1.0, false), (0.0, true)]).scores().unwrap();
        assert!((wrong.log_loss - 13.8155).abs() < 1e-3, "{}", wrong.log_loss);
        assert_eq!((wrong.accuracy, wrong.auc), (0.0, Some(0.0)));
        let half = tally(&[(0.5, false), (0.5, false), (0.5, true)]).scores().unwrap();
        assert!((half.accuracy - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!(half.auc, Some(0.5));
        assert!((half.log_loss - 2f64.ln()).abs() < 1e-9);
    }

    #[test]
    fn one_kind_alone_has_no_ranking_and_nothing_has_no_scores() {
        assert_eq!(tally(&[(0.3, true)]).scores().unwrap().auc, None);
        assert!(tally(&[]).scores().is_none());
    }

    #[test]
    fn the_ranking_agrees_with_counting_pairs() {
        let pairs: Vec<(f32, bool)> =
            (0..300).map(|k| ((k * 37 % 101) as f32 / 101.0, k * 53 % 7 < 3)).collect();
        let (mut won, mut all) = (0.0, 0.0);
        for (p, _) in pairs.iter().filter(|(_, occupied)| *occupied) {
            for (q, _) in pairs.iter().filter(|(_, occupied)| !*occupied) {
                all += 1.0;
                won += if p > q {
                    1.0
                } else if p == q {
                    0.5
                } else {
                    0.0
                };
            }
        }
        let auc = tally(&pairs).scores().unwrap().auc.unwrap();
        assert!((auc - won / all).abs() < 1e-9, "{auc} {}", won / all);
    }

    #[test]
    fn intervals_of_clusters_of_one_are_those_of_single_values() {
        let values = [0.2, 0.5, 0.9, 0.1];
        let clusters: Vec<(f64, u64)> = values.iter().map(|v| (*v, 1)).collect();
        let mean = values.iter().sum::<f64>() / 4.0;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 3.0;
        let wanted = 1.96 * (variance / 4.0).sqrt();
        assert!((clustered_interval(&clusters).unwrap() - wanted).abs() < 1e-12);
        assert_eq!(clustered_interval(&clusters[..1]), None);
    }
}
