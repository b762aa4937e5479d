//! Predictions that need no network: the bars that a network has to clear.
//!
//! Each is a table of shares, counted on training scenes.

use super::view::{Phase, View};
use super::{PredictionError, Probabilities};

/// Distances are told apart in steps of a coarse cell of 0.25 m.
const STEP_M: f32 = 0.25;

/// Distances from here on are one.
const STEPS: usize = 40;

/// What a table's entries are told apart by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Nothing: the share of occupied cells among the unobserved.
    Constant,
    /// Distance to the nearest observed wall.
    WallDistance,
    /// Whether the nearest observed cell is a wall, and its distance.
    NearestLabel,
    /// Both of these.
    NearestLabelAndWall,
    /// Where the cell lies on the maze's own lattice, which no predictor is told: knows where walls
    /// can be, not which are there.
    Lattice,
    /// The same, and where the maze ends.
    LatticeAndBoundary,
}

impl Kind {
    /// All of them, or those that make sense without a maze's lattice.
    pub fn all(maze: bool) -> Vec<Self> {
        let mut kinds =
            vec![Self::Constant, Self::WallDistance, Self::NearestLabel, Self::NearestLabelAndWall];
        if maze {
            kinds.extend([Self::Lattice, Self::LatticeAndBoundary]);
        }
        kinds
    }

    /// The name in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Constant => "prior",
            Self::WallDistance => "wall distance",
            Self::NearestLabel => "nearest label",
            Self::NearestLabelAndWall => "nearest label x wall distance",
            Self::Lattice => "lattice oracle",
            Self::LatticeAndBoundary => "lattice oracle with boundary",
        }
    }

    const fn entries(self) -> usize {
        match self {
            Self::Constant => 1,
            Self::WallDistance => STEPS,
            Self::NearestLabel => 2 * STEPS,
            Self::NearestLabelAndWall => 2 * STEPS * STEPS,
            Self::Lattice => 3,
            Self::LatticeAndBoundary => 6,
        }
    }

    fn entry(self, view: &View, k: usize) -> usize {
        let step = |m: f32| ((m / STEP_M) as usize).min(STEPS - 1);
        let (wall, free) = (view.wall_m[k], view.free_m[k]);
        let nearest = || usize::from(wall < free) * STEPS + step(wall.min(free));
        let lattice = || view.maze.map_or((Phase::Inside, false), |maze| maze.phase(k));
        match self {
            Self::Constant => 0,
            Self::WallDistance => step(wall),
            Self::NearestLabel => nearest(),
            Self::NearestLabelAndWall => nearest() * STEPS + step(wall),
            Self::Lattice => lattice().0 as usize,
            Self::LatticeAndBoundary => {
                let (phase, outer) = lattice();
                2 * phase as usize + usize::from(outer)
            }
        }
    }
}

/// One table.
#[derive(Clone, Debug)]
pub struct Baseline {
    kind: Kind,
    /// All and occupied ones of each entry.
    counts: Vec<[u64; 2]>,
}

impl Baseline {
    /// An empty table; [`fit`](Self::fit) fills it.
    pub fn new(kind: Kind) -> Self {
        Self { kind, counts: vec![[0; 2]; kind.entries()] }
    }

    /// Counts the labels of some cells of a training scene.
    pub fn fit(&mut self, view: &View, cells: &[usize]) {
        for k in cells {
            let count = &mut self.counts[self.kind.entry(view, *k)];
            count[0] += 1;
            count[1] += u64::from(view.truth[*k] == 1);
        }
    }

    /// The share of an entry. Rare entries are drawn to the share of all by some cells of it that
    /// are added: the cells of one scene hang together, so a few of them say little.
    fn share(&self, entry: usize) -> f32 {
        const ADDED: f64 = 20.0;
        let all = self.counts.iter().fold([0, 0], |s, c| [s[0] + c[0], s[1] + c[1]]);
        let prior = (all[1] as f64 + 0.5) / (all[0] as f64 + 1.0);
        let [n, occupied] = self.counts[entry];
        ((occupied as f64 + ADDED * prior) / (n as f64 + ADDED)) as f32
    }
}

impl Probabilities for Baseline {
    fn name(&self) -> String {
        self.kind.name().to_owned()
    }

    fn probabilities(
        &mut self,
        view: &View,
        cells: &[usize],
        out: &mut [f32],
    ) -> Result<(), PredictionError> {
        let shares: Vec<f32> = (0..self.counts.len()).map(|entry| self.share(entry)).collect();
        for (k, p) in cells.iter().zip(out) {
            *p = shares[self.kind.entry(view, *k)];
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::metrics::Tally;
    use super::super::view::tests::scene;
    use super::*;

    fn views(seeds: std::ops::Range<u64>) -> Vec<View> {
        let places = [(11.0, 13.6), (3.6, 8.6), (18.6, 18.6), (21.1, 6.2)];
        seeds.flat_map(|seed| places.map(|(x, y)| View::new(&scene(seed, x, y), 0.25))).collect()
    }

    #[test]
    fn a_baseline_that_knows_more_does_better_on_scenes_it_has_not_seen() {
        let loss = |kind: Kind| {
            let mut baseline = Baseline::new(kind);
            for view in views(0..12) {
                baseline.fit(&view, &view.cells_within(5.0, false));
            }
            let mut tally = Tally::default();
            for view in views(20..26) {
                let cells = view.cells_within(5.0, false);
                let mut p = vec![f32::NAN; cells.len()];
                baseline.probabilities(&view, &cells, &mut p).unwrap();
                for (k, p) in cells.iter().zip(p) {
                    tally.add(p, view.truth[*k] == 1);
                }
            }
            tally.scores().unwrap()
        };
        let prior = loss(Kind::Constant);
        assert_eq!(prior.auc, Some(0.5));
        assert!(prior.ece < 0.02, "{}", prior.ece);
        // Where nothing is told apart the loss is the entropy of the share, nearly.
        let h = |p: f64| -p * p.ln() - (1.0 - p) * (1.0 - p).ln();
        assert!((prior.log_loss - h(prior.occupied)).abs() < 0.002);
        let lattice = loss(Kind::Lattice);
        let boundary = loss(Kind::LatticeAndBoundary);
        assert!(lattice.log_loss < 0.6 * prior.log_loss, "{}", lattice.log_loss);
        assert!(boundary.log_loss < lattice.log_loss, "{}", boundary.log_loss);
        for kind in [Kind::WallDistance, Kind::NearestLabel, Kind::NearestLabelAndWall] {
            assert!(loss(kind).log_loss < prior.log_loss + 0.01, "{kind:?}");
        }
    }

    #[test]
    fn an_entry_never_met_has_the_share_of_all() {
        let view = View::new(&scene(1, 11.0, 13.6), 0.25);
        let cells = view.cells_within(5.0, false);
        let mut baseline = Baseline::new(Kind::WallDistance);
        baseline.fit(&view, &cells);
        let occupied = cells.iter().filter(|k| view.truth[**k] == 1).count() as f32;
        let share = occupied / cells.len() as f32;
        // No wall is observed in these scenes, so all cells are in the last entry.
        assert!((baseline.share(0) - share).abs() < 0.001);
        assert!((baseline.share(STEPS - 1) - share).abs() < 0.001);
    }
}
