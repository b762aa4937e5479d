//! Predictors that have learned nothing: the yardsticks for one that has.

use std::sync::Arc;

use super::reach::Reach;
use super::{OccupancyView, PredictError, PredictFault, Predictor, SILENT, Scene};
use crate::frames::Point;
use crate::map::{Cell, Grid};

/// Foresees nothing: 0.5 everywhere.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoPrediction;

impl OccupancyView for NoPrediction {
    fn occupied(&mut self, _: &[Point], out: &mut [f32]) {
        out.fill(SILENT);
    }

    fn silent(&self, _: Point, _: Point) -> bool {
        true
    }
}

impl Predictor for NoPrediction {
    fn observe(&mut self, _: &Scene<'_>) {}
}

/// Stands in for a network that cannot be used: foresees nothing, and says why.
#[derive(Clone, Debug)]
pub(super) struct Missing(PredictFault);

impl Missing {
    pub(super) fn new(error: &PredictError) -> Self {
        Self(PredictFault::Failed(error.to_string()))
    }
}

impl OccupancyView for Missing {
    fn occupied(&mut self, _: &[Point], out: &mut [f32]) {
        out.fill(SILENT);
    }

    fn silent(&self, _: Point, _: Point) -> bool {
        true
    }
}

impl Predictor for Missing {
    fn observe(&mut self, _: &Scene<'_>) {}

    fn fault(&self) -> Option<&PredictFault> {
        Some(&self.0)
    }
}

/// Knows the true map within the prediction range of the known map's frontier; answers 0.5 beyond
/// it and where the true map itself knows nothing.
#[derive(Clone, Debug)]
pub struct OraclePredictor {
    truth: Arc<Grid>,
    reach: Reach,
    inverted: bool,
}

impl OraclePredictor {
    /// From the true map in the map frame; `inverted` calls free what is occupied and the other
    /// way round.
    pub fn new(truth: Arc<Grid>, range_m: f64, inverted: bool) -> Self {
        Self { truth, reach: Reach::new(range_m), inverted }
    }
}

impl OccupancyView for OraclePredictor {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        for (point, out) in points.iter().zip(out) {
            let truth = match self.truth.get(self.truth.cell_at(*point)) {
                Cell::Unknown => None,
                cell => Some((cell == Cell::Occupied) != self.inverted),
            };
            *out = truth.filter(|_| self.reach.holds(*point)).map_or(SILENT, f32::from);
        }
    }

    fn silent(&self, low: Point, high: Point) -> bool {
        !self.reach.touches(low, high)
    }

    fn is_ever_certain(&self) -> bool {
        true
    }
}

impl Predictor for OraclePredictor {
    fn observe(&mut self, scene: &Scene<'_>) {
        self.reach.update(scene.grid, scene.changed);
    }
}

/// A number in `[0, 1)` for each cell of the grid, which depends on the seed and the cell alone.
#[derive(Clone, Copy, Debug)]
pub struct RandomPredictor {
    seed: u64,
    resolution_m: f64,
}

impl RandomPredictor {
    /// One drive's draws.
    pub fn new(seed: u64) -> Self {
        Self { seed, resolution_m: 0.1 }
    }
}

impl OccupancyView for RandomPredictor {
    fn occupied(&mut self, points: &[Point], out: &mut [f32]) {
        let cell = |v: f64| (v / self.resolution_m).floor() as i64 as u64;
        for (p, out) in points.iter().zip(out) {
            let hash = mix(mix(mix(self.seed) ^ cell(p.x)) ^ cell(p.y));
            // The upper 24 bits fill the mantissa.
            *out = (hash >> 40) as f32 / (1_u32 << 24) as f32;
        }
    }
}

impl Predictor for RandomPredictor {
    fn observe(&mut self, scene: &Scene<'_>) {
        self.resolution_m = scene.grid.resolution_m();
    }
}

/// SplitMix64 (Steele, Lea and Flood 2014): spreads a number over all 64 bits.
fn mix(v: u64) -> u64 {
    let v = v.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let v = (v ^ (v >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let v = (v ^ (v >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    v ^ (v >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::Pose;
    use crate::map::{CellIndex, CellRect};
    use crate::predict::{PredictParams, PredictorKind, build};

    /// Truth: 20 m by 4 m of free space with a wall at x = 4 m and one at x = 15 m; known: the
    /// first two metres.
    fn world() -> (Arc<Grid>, Arc<Grid>) {
        let (mut truth, mut known) = (Grid::new(0.1), Grid::new(0.1));
        for iy in 0..40 {
            for ix in 0..200 {
                let wall = ix == 40 || ix == 150;
                let cell = if wall { Cell::Occupied } else { Cell::Free };
                truth.set(CellIndex::new(ix, iy), cell);
                if ix < 20 {
                    known.set(CellIndex::new(ix, iy), Cell::Free);
                }
            }
        }
        (Arc::new(truth), Arc::new(known))
    }

    fn ask(kind: PredictorKind, seed: u64, points: &[Point]) -> Vec<f32> {
        let (truth, known) = world();
        let params = PredictParams { kind, ..PredictParams::default() };
        let mut predictor = build(&params, Some(truth), seed).unwrap();
        let (pose, goal) = (Pose::new(1.0, 2.0, 0.0), Point::new(19.0, 2.0));
        predictor.observe(&Scene { grid: &known, pose, goal, changed: known.bounds() });
        let mut out = vec![f32::NAN; points.len()];
        predictor.occupied(points, &mut out);
        out
    }

    #[test]
    fn the_oracle_knows_the_truth_near_the_frontier_only() {
        let points = [
            Point::new(4.05, 2.0),
            Point::new(5.0, 2.0),
            Point::new(15.05, 2.0),
            Point::new(12.0, 2.0),
            Point::new(4.0, -1.0),
        ];
        assert_eq!(ask(PredictorKind::Oracle, 0, &points), [1.0, 0.0, 0.5, 0.5, 0.5]);
        assert_eq!(ask(PredictorKind::Inverted, 0, &points), [0.0, 1.0, 0.5, 0.5, 0.5]);
        assert_eq!(ask(PredictorKind::None, 0, &points), [0.5; 5]);
    }

    #[test]
    fn random_answers_belong_to_the_cell_and_the_seed_and_fill_the_unit_interval() {
        let points: Vec<Point> = (0..4000)
            .map(|i| Point::new(f64::from(i % 80) * 0.1, f64::from(i / 80) * -0.1))
            .collect();
        let points: Vec<Point> =
            points.iter().map(|p| Point::new(p.x + 0.03, p.y + 0.03)).collect();
        let within: Vec<Point> =
            points.iter().map(|p| Point::new(p.x + 0.05, p.y + 0.06)).collect();
        let first = ask(PredictorKind::Random, 7, &points);
        assert_eq!(first, ask(PredictorKind::Random, 7, &within));
        assert_ne!(first, ask(PredictorKind::Random, 8, &points));
        let mean = first.iter().sum::<f32>() / first.len() as f32;
        assert!((mean - 0.5).abs() < 0.02, "{mean}");
        for tenth in 0..10 {
            let low = tenth as f32 / 10.0;
            let share = first.iter().filter(|v| (low..low + 0.1).contains(*v)).count();
            assert!((300..500).contains(&share), "{tenth}: {share}");
        }
    }

    #[test]
    fn an_oracle_without_a_true_map_is_refused() {
        let params = PredictParams { kind: PredictorKind::Oracle, ..PredictParams::default() };
        let error = build(&params, None, 0).err().unwrap();
        assert_eq!(error, PredictError::NoTruth { kind: PredictorKind::Oracle });
        assert!(error.to_string().contains("\"oracle\""), "{error}");
    }

    #[test]
    fn a_scene_with_nothing_new_keeps_the_answers() {
        let (truth, known) = world();
        let mut oracle = OraclePredictor::new(truth, 5.0, false);
        let (pose, goal) = (Pose::new(1.0, 2.0, 0.0), Point::new(19.0, 2.0));
        let mut scene = Scene { grid: &known, pose, goal, changed: known.bounds() };
        oracle.observe(&scene);
        scene.changed = CellRect::EMPTY;
        oracle.observe(&scene);
        let mut out = [0.5];
        oracle.occupied(&[Point::new(4.05, 2.0)], &mut out);
        assert_eq!(out, [1.0]);
    }
}
