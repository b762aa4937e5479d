//! A trained network as something to score.

use super::view::View;
use super::{PredictionError, Probabilities};
use crate::experiment::dataset::FRONTIERS;
use crate::predict::lattice::CROP_CELLS;
use crate::predict::{Answers, Network};

/// What is done with a network's answers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Treatment {
    /// Nothing.
    Raw,
    /// They are calibrated as the network's file says.
    Calibrated,
    /// They are calibrated, and drawn towards 0.5 as far as the network calls the scene
    /// unfamiliar: as on the road.
    Faded,
}

/// A network under a name.
pub struct NetworkScored {
    name: String,
    network: Network,
    treatment: Treatment,
    context: Vec<[f32; 3]>,
    answers: Answers,
}

impl NetworkScored {
    /// A network whose answers are treated in one way.
    pub fn new(name: String, network: Network, treatment: Treatment) -> Self {
        Self { name, network, treatment, context: Vec::new(), answers: Answers::default() }
    }

    /// The treatments that make a difference for a network.
    ///
    /// # Errors
    /// What the network says when it is tried.
    pub fn treatments(network: &mut Network) -> Result<Vec<Treatment>, PredictionError> {
        let mut answers = Answers::default();
        let seen = [[0.125, 0.125, 0.0], [1.125, 0.125, 1.0]];
        network
            .encode(&seen)
            .and_then(|()| network.decode(&[[0.875, 0.125]], &mut answers))
            .map_err(PredictionError::Failed)?;
        let mut treatments = vec![Treatment::Raw];
        if network.metadata().calibration.is_some() {
            treatments.push(Treatment::Calibrated);
        }
        if !answers.familiarity.is_empty() {
            treatments.push(Treatment::Faded);
        }
        Ok(treatments)
    }
}

impl Probabilities for NetworkScored {
    fn name(&self) -> String {
        let treatment = match self.treatment {
            Treatment::Raw => "",
            Treatment::Calibrated => ", calibrated",
            Treatment::Faded => ", faded",
        };
        format!("{}{treatment}", self.name)
    }

    fn resolution_m(&self) -> Option<f64> {
        Some(self.network.metadata().resolution_m)
    }

    fn probabilities(
        &mut self,
        view: &View,
        cells: &[usize],
        out: &mut [f32],
    ) -> Result<(), PredictionError> {
        view.crop.context(self.network.metadata().context, &mut self.context);
        if self.context.is_empty() {
            out.fill(0.5);
            return Ok(());
        }
        let centre = |k: &usize| view.crop.centre(k % CROP_CELLS, k / CROP_CELLS);
        let targets: Vec<[f32; 2]> = cells.iter().map(centre).collect();
        let answers = &mut self.answers;
        self.network
            .encode(&self.context)
            .and_then(|()| self.network.decode(&targets, answers))
            .map_err(PredictionError::Failed)?;
        out.copy_from_slice(&answers.probability);
        let calibration = self.network.metadata().calibration.as_ref();
        if let Some(calibration) = calibration.filter(|_| self.treatment != Treatment::Raw) {
            for (k, p) in cells.iter().zip(&mut *out) {
                *p = calibration.calibrated(*p, from_pieces_m(view, *k));
            }
        }
        if self.treatment == Treatment::Faded {
            for (i, p) in out.iter_mut().enumerate() {
                let weight = match &answers.familiarity[..] {
                    [] => 1.0,
                    [scene] => *scene,
                    each => each[i],
                };
                *p = 0.5 + weight * (*p - 0.5);
            }
        }
        Ok(())
    }
}

/// Distance from a cell to the centre of the nearest piece of the frontier, of the first eight as
/// in the data sets, metres: what calibrations are made by.
fn from_pieces_m(view: &View, k: usize) -> f32 {
    let (column, row) = (k % CROP_CELLS, k / CROP_CELLS);
    let square = |c: &[usize; 2]| c[0].abs_diff(column).pow(2) + c[1].abs_diff(row).pow(2);
    let least = view.centres.iter().take(FRONTIERS).map(square).min();
    least.map_or(f32::INFINITY, |least| (least as f32).sqrt() * view.crop.resolution_m as f32)
}
