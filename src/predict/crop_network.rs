//! A network asked about the cells of a crop.

use super::fault::PredictFault;
use super::lattice::{CROP_CELLS, Crop};
use super::metadata::Metadata;
use super::network::{Answers, Network};
use super::trust::faded;
use super::{Effort, SILENT};

/// The pieces of the frontier from which calibration measures: the nearest eight of at least three
/// cells, as in the data sets.
const FRONTIERS_MAX: usize = 8;
const FRONTIER_CELLS_MIN: usize = 3;

/// A network asked about the cells of a crop: it is given the cells that it wants to see, its
/// answers are checked, calibrated, and faded where the scene is unfamiliar.
pub struct CropNetwork {
    network: Network,
    fade: bool,
    context: Vec<[f32; 3]>,
    /// Context and frontier are those of the scene at hand.
    encoded: bool,
    /// Columns and rows of the centres of the frontier's pieces.
    frontier: Vec<[usize; 2]>,
    targets: Vec<[f32; 2]>,
    answers: Answers,
    effort: Effort,
}

impl CropNetwork {
    /// A network; with `fade` its answers are drawn towards 0.5 as far as it calls a scene
    /// unfamiliar.
    pub fn new(network: Network, fade: bool) -> Self {
        Self {
            network,
            fade,
            context: Vec::new(),
            encoded: false,
            frontier: Vec::new(),
            targets: Vec::new(),
            answers: Answers::default(),
            effort: Effort::default(),
        }
    }

    /// What the network's file says about itself.
    pub const fn metadata(&self) -> &Metadata {
        self.network.metadata()
    }

    /// Whether it is best asked for all cells at once.
    pub(super) const fn asks_all_at_once(&self) -> bool {
        self.network.asks_all_at_once()
    }

    /// What has been worked through since the scene began.
    pub const fn effort(&self) -> Effort {
        self.effort
    }

    /// Begins another scene; it is encoded when it is first asked about.
    pub fn begin(&mut self) {
        self.encoded = false;
        self.effort = Effort::default();
    }

    /// Writes for each cell of the crop (its place in [`Crop::cells`]) the probability that it is
    /// occupied. The crop must be the same until the next scene begins; one without any observed
    /// cell is answered with 0.5.
    ///
    /// # Errors
    /// If the network does not run or gives anything but probabilities; `out` is unspecified then.
    pub fn answer(
        &mut self,
        crop: &Crop,
        cells: &[u32],
        out: &mut Vec<f32>,
    ) -> Result<(), PredictFault> {
        if !self.encoded {
            self.encode(crop)?;
        }
        out.clear();
        if self.context.is_empty() {
            out.resize(cells.len(), SILENT);
            return Ok(());
        }
        self.targets.clear();
        let place = |at: u32| (at as usize % CROP_CELLS, at as usize / CROP_CELLS);
        self.targets.extend(cells.iter().map(|at| {
            let (column, row) = place(*at);
            crop.centre(column, row)
        }));
        self.network.decode(&self.targets, &mut self.answers).map_err(PredictFault::Failed)?;
        self.effort.decoded += cells.len() as u32;
        let familiarity = if self.fade { &self.answers.familiarity[..] } else { &[] };
        let outside = |p: &&f32| !(0.0..=1.0).contains(*p);
        if let Some(value) = self.answers.probability.iter().chain(familiarity).find(outside) {
            return Err(PredictFault::NotAProbability { value: *value });
        }
        let calibration = self.network.metadata().calibration.as_ref();
        for (i, (at, p)) in cells.iter().zip(&self.answers.probability).enumerate() {
            let calibrated = calibration.map_or(*p, |calibration| {
                let distance_m = self.frontier_cells(place(*at)) * crop.resolution_m as f32;
                calibration.calibrated(*p, distance_m)
            });
            let weight = match familiarity {
                [] => 1.0,
                [scene] => *scene,
                each => each[i],
            };
            out.push(faded(calibrated, weight));
        }
        Ok(())
    }

    /// How familiar the crop looks, from 0 to 1; 0 if the network does not say so of whole scenes, or
    /// there is nothing to look at.
    ///
    /// # Errors
    /// If the network does not run.
    pub fn familiarity(&mut self, crop: &Crop) -> Result<f64, PredictFault> {
        if !self.encoded {
            self.encode(crop)?;
        }
        let told = self.network.scene_familiarity().filter(|_| !self.context.is_empty());
        Ok(told.map_or(0.0, f64::from))
    }

    fn encode(&mut self, crop: &Crop) -> Result<(), PredictFault> {
        crop.context(self.network.metadata().context, &mut self.context);
        if !self.context.is_empty() {
            self.network.encode(&self.context).map_err(PredictFault::Failed)?;
            if self.network.metadata().calibration.is_some() {
                self.frontier = crop.frontier_centres(FRONTIER_CELLS_MIN);
                self.frontier.truncate(FRONTIERS_MAX);
            }
        }
        self.effort.context = self.context.len() as u32;
        self.encoded = true;
        Ok(())
    }

    /// Distance from a cell to the nearest piece of the frontier, in cells; infinite if there is
    /// none.
    fn frontier_cells(&self, (column, row): (usize, usize)) -> f32 {
        let square = |c: &[usize; 2]| c[0].abs_diff(column).pow(2) + c[1].abs_diff(row).pow(2);
        let least = self.frontier.iter().map(square).min();
        least.map_or(f32::INFINITY, |least| (least as f32).sqrt())
    }
}
