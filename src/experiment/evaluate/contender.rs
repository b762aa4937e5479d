//! What one predictor has gathered.

use std::collections::BTreeMap;

use super::metrics::{Tally, clustered_interval, log_loss};
use super::request::SetRequest;
use super::scores::{Band, Difference, EdgeScores, RadiusScores, Scored};
use super::view::Edge;
use super::{EDGE_NEAR_M, EvaluateError};

/// Distances from the frontier that are told apart, metres.
const BANDS_M: [f64; 7] = [0.0, 0.5, 1.25, 2.5, 5.0, 7.5, f64::INFINITY];

/// The tallies of one predictor.
pub(super) struct Contender {
    pub name: String,
    /// One a radius.
    radii: Vec<RadiusTally>,
    edges: [Tally; BANDS_M.len() - 1],
    near: Tally,
}

#[derive(Default)]
struct RadiusTally {
    all: Tally,
    bands: [Tally; BANDS_M.len() - 1],
    worlds: BTreeMap<(u8, i64), (f64, u64)>,
}

impl Contender {
    /// Nothing tallied yet.
    pub fn new(name: String, radii: usize) -> Self {
        Self {
            name,
            radii: (0..radii).map(|_| RadiusTally::default()).collect(),
            edges: Default::default(),
            near: Tally::default(),
        }
    }

    /// Adds a cell's probability, and whether it is occupied.
    pub fn add_cell(
        &mut self,
        radius: usize,
        world: (u8, i64),
        from_frontier_m: f64,
        p: f32,
        is: bool,
    ) {
        let tally = &mut self.radii[radius];
        tally.all.add(p, is);
        tally.bands[band(from_frontier_m)].add(p, is);
        let world = tally.worlds.entry(world).or_default();
        *world = (world.0 + log_loss(p, is), world.1 + 1);
    }

    /// Adds an edge's probability of being closed.
    pub fn add_edge(&mut self, edge: &Edge, p: f32) {
        self.edges[band(edge.from_frontier_m)].add(p, edge.closed);
        if edge.from_frontier_m <= EDGE_NEAR_M {
            self.near.add(p, edge.closed);
        }
    }
}

fn band(distance_m: f64) -> usize {
    let last = BANDS_M.len() - 2;
    (0..last).find(|k| distance_m < BANDS_M[k + 1]).unwrap_or(last)
}

fn bands(tallies: &[Tally]) -> Vec<Band> {
    let band = |(k, tally): (usize, &Tally)| {
        let to_m = Some(BANDS_M[k + 1]).filter(|m| m.is_finite());
        Some(Band { from_m: BANDS_M[k], to_m, scores: tally.scores()? })
    };
    tallies.iter().enumerate().filter_map(band).collect()
}

/// The scores within each radius.
pub(super) fn radius_scores(
    set: &SetRequest,
    radii_m: &[f64],
    contenders: &[Contender],
) -> Result<Vec<RadiusScores>, EvaluateError> {
    let first = contenders.first();
    let scored = |radius: usize, contender: &Contender| {
        let tally = &contender.radii[radius];
        let clusters: Vec<(f64, u64)> = tally.worlds.values().copied().collect();
        Some(Scored {
            name: contender.name.clone(),
            scores: tally.all.scores()?,
            log_loss_ci95: clustered_interval(&clusters),
            against_first: against(tally, first.filter(|f| f.name != contender.name), radius),
            by_distance: bands(&tally.bands),
            reliability: tally.all.reliability(),
        })
    };
    let mut result = Vec::new();
    for (k, radius_m) in radii_m.iter().enumerate() {
        let predictors: Option<Vec<Scored>> = contenders.iter().map(|c| scored(k, c)).collect();
        let Some(predictors) = predictors else {
            return Err(EvaluateError::NothingToScore {
                set: set.name.clone(),
                radius_m: *radius_m,
            });
        };
        result.push(RadiusScores { radius_m: *radius_m, predictors });
    }
    Ok(result)
}

/// Log loss less that of another predictor on the same cells, world by world.
fn against(tally: &RadiusTally, other: Option<&Contender>, radius: usize) -> Option<Difference> {
    let other = &other?.radii[radius];
    let pairs: Vec<(f64, u64)> = tally
        .worlds
        .values()
        .zip(other.worlds.values())
        .map(|((a, n), (b, _))| (a - b, *n))
        .collect();
    let n: u64 = pairs.iter().map(|(_, n)| n).sum();
    let mean = pairs.iter().map(|(d, _)| d).sum::<f64>() / n as f64;
    Some(Difference { mean, ci95: clustered_interval(&pairs) })
}

/// The scores on edges, if there were any near the frontier.
pub(super) fn edge_scores(contender: &Contender) -> Option<EdgeScores> {
    let near = contender.near.scores()?;
    let by_distance = bands(&contender.edges);
    Some(EdgeScores { name: contender.name.clone(), near, by_distance })
}
