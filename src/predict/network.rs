//! A trained network: its file checked, cut into encoder and decoder, and ready to run.

use super::document::{
    CONTEXT, Document, FAMILIARITY, Halves, PROBABILITY, REPRESENTATION, TARGET,
};
use super::lattice::{CROP_CELLS, Crop};
use super::metadata::Metadata;
use super::model_error::ModelError;
use super::runtime::{Input, Program, Runtime};

/// A trained network. [`encode`](Self::encode) takes in a scene; [`decode`](Self::decode) then
/// answers for any number of points of it.
pub struct Network {
    metadata: Metadata,
    parts: Parts,
    /// How familiar the scene looks, if the encoder says so.
    scene_familiarity: Option<f32>,
}

enum Parts {
    Cut { encoder: Program, decoder: Program, representation: Tensor, looks_up: bool },
    Whole { network: Program, context: Vec<[f32; 3]> },
}

#[derive(Default)]
struct Tensor {
    shape: Vec<usize>,
    values: Vec<f32>,
}

/// A network's answers for some targets.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Answers {
    /// For each target the probability that it is occupied, as the network gives it: whether these
    /// are probabilities is for the caller to look at.
    pub probability: Vec<f32>,
    /// How familiar the scene looks: nothing, one value, or one for each target.
    pub familiarity: Vec<f32>,
}

impl Network {
    /// Reads an ONNX file's bytes, checks them, and makes the network ready to run.
    ///
    /// # Errors
    /// Says what does not fit, and what would.
    pub(super) fn load(bytes: &[u8], runtime: &Runtime) -> Result<Self, ModelError> {
        let document = Document::parse(bytes)?;
        let metadata = Metadata::parse(&document.metadata())?;
        let every = every_cell(metadata.resolution_m);
        let scenes = [PROBE_CONTEXT[..1].to_vec(), PROBE_CONTEXT.to_vec(), every];
        let shapes = scenes.each_ref().map(|scene| [scene.len(), 3]);
        let context = |k: usize| {
            let values = scenes[k].as_flattened();
            Input { name: CONTEXT, shape: &shapes[k], values }
        };
        let every: Vec<[f32; 2]> = scenes[2].iter().map(|[x, y, _]| [*x, *y]).collect();
        let shape = [every.len(), 2];
        let target = Input { name: TARGET, shape: &shape, values: every.as_flattened() };
        let parts = match document.halves()? {
            Halves::Whole { network } => {
                runtime.rehearse(&network, &[&[context(0), target], &[context(1), target]])?;
                Parts::Whole { network: runtime.load(&network)?, context: Vec::new() }
            }
            Halves::Cut { encoder, decoder } => {
                let runs = [[context(0)], [context(1)], [context(2)]];
                let seen = runtime.rehearse(&encoder, &runs.each_ref().map(|run| &run[..]))?;
                let representation = |k: usize| {
                    let why = || format!("nothing gives `{REPRESENTATION}`");
                    seen[k].get(REPRESENTATION).ok_or_else(|| ModelError::Cut { why: why() })
                };
                let ((one, _), (two, values)) = (representation(0)?, representation(1)?);
                // The file need not say how large the representation is; two scenes show it.
                if one.len() != two.len() {
                    let why =
                        format!("`{REPRESENTATION}` has {} axes, then {}", one.len(), two.len());
                    return Err(ModelError::Cut { why });
                }
                let same = |(a, b): (&usize, &usize)| (a == b).then_some(*a as i64);
                let shape: Vec<Option<i64>> = one.iter().zip(two).map(same).collect();
                let looks_up = decoder.looks_up;
                let decoder = decoder.with_shape(&shape);
                let input = Input { name: REPRESENTATION, shape: two, values };
                runtime.rehearse(&decoder, &[&[input, target]])?;
                Parts::Cut {
                    encoder: runtime.load(&encoder)?,
                    decoder: runtime.load(&decoder)?,
                    representation: Tensor::default(),
                    looks_up,
                }
            }
        };
        let mut network = Self { metadata, parts, scene_familiarity: None };
        network
            .probe()
            .map_err(|why| ModelError::Runtime { runtime: runtime.name().into(), why })?;
        Ok(network)
    }

    /// What its file says about itself.
    pub const fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// Whether it is best asked for all points at once: its decoder only looks answers up, or it
    /// encodes the scene anew for every question.
    pub(super) const fn asks_all_at_once(&self) -> bool {
        match &self.parts {
            Parts::Cut { looks_up, .. } => *looks_up,
            Parts::Whole { .. } => true,
        }
    }

    /// Takes in a scene: x, y (robot-cell frame, metres) and 0 for free or 1 for occupied, of at
    /// least one observed coarse cell.
    ///
    /// # Errors
    /// What the runtime says.
    pub fn encode(&mut self, context: &[[f32; 3]]) -> Result<(), String> {
        if context.is_empty() {
            return Err("a scene needs at least one observed cell".into());
        }
        match &mut self.parts {
            Parts::Cut { encoder, representation, .. } => {
                self.scene_familiarity = encode(encoder, context, representation)?;
            }
            Parts::Whole { context: kept, .. } => {
                kept.clear();
                kept.extend_from_slice(context);
            }
        }
        Ok(())
    }

    /// How familiar the scene encoded last looks, if the encoder says so.
    pub const fn scene_familiarity(&self) -> Option<f32> {
        self.scene_familiarity
    }

    /// Answers for points of the scene encoded last (x, y in its robot-cell frame, metres); at
    /// least one.
    ///
    /// # Errors
    /// What the runtime says, or that it gives another number of answers.
    pub fn decode(&mut self, targets: &[[f32; 2]], answers: &mut Answers) -> Result<(), String> {
        answers.probability.clear();
        answers.familiarity.clear();
        answers.familiarity.extend(self.scene_familiarity);
        if targets.is_empty() {
            return Ok(());
        }
        let shape = [targets.len(), 2];
        let target = Input { name: TARGET, shape: &shape, values: targets.as_flattened() };
        let read = |name: &str, _: &[i64], values: &[f32]| match name {
            PROBABILITY => answers.probability.extend_from_slice(values),
            FAMILIARITY => answers.familiarity.extend_from_slice(values),
            _ => {}
        };
        match &mut self.parts {
            Parts::Cut { decoder, representation, .. } => {
                let Tensor { shape, values } = representation;
                decoder.run(&[Input { name: REPRESENTATION, shape, values }, target], read)?;
            }
            Parts::Whole { network, context } => {
                let shape = [context.len(), 3];
                let context =
                    Input { name: CONTEXT, shape: &shape, values: context.as_flattened() };
                network.run(&[context, target], read)?;
            }
        }
        let (wanted, given) = (targets.len(), answers.probability.len());
        if given != wanted {
            return Err(format!("it gives {given} probabilities for {wanted} targets"));
        }
        let familiarities = answers.familiarity.len();
        if familiarities > 1 && familiarities != wanted {
            return Err(format!("it gives {familiarities} familiarities for {wanted} targets"));
        }
        Ok(())
    }

    /// Runs once with two and once with one target: a network that cannot is refused before the
    /// drive and not in its midst.
    fn probe(&mut self) -> Result<(), String> {
        let mut answers = Answers::default();
        self.encode(PROBE_CONTEXT)?;
        self.decode(&[[0.875, 0.125], [-1.125, 3.125]], &mut answers)?;
        self.decode(&[[0.875, 0.125]], &mut answers)
    }
}

/// Every cell of the crop, every third one occupied: there is no other place to ask for.
fn every_cell(resolution_m: f64) -> Vec<[f32; 3]> {
    let crop = Crop { resolution_m, ..Crop::default() };
    let cell = |at: usize| {
        let [x, y] = crop.centre(at % CROP_CELLS, at / CROP_CELLS);
        [x, y, f32::from(u8::from(at.is_multiple_of(3)))]
    };
    (0..CROP_CELLS * CROP_CELLS).map(cell).collect()
}

/// A free cell and an occupied one.
const PROBE_CONTEXT: &[[f32; 3]] = &[[0.125, 0.125, 0.0], [1.125, 0.125, 1.0]];

/// Runs the encoder; its familiarity, if it gives any.
fn encode(
    encoder: &mut Program,
    context: &[[f32; 3]],
    representation: &mut Tensor,
) -> Result<Option<f32>, String> {
    let shape = [context.len(), 3];
    let input = Input { name: CONTEXT, shape: &shape, values: context.as_flattened() };
    let mut familiarity = None;
    representation.shape.clear();
    representation.values.clear();
    encoder.run(&[input], |name, shape, values| match name {
        REPRESENTATION => {
            representation.shape.extend(shape.iter().map(|axis| *axis as usize));
            representation.values.extend_from_slice(values);
        }
        FAMILIARITY => familiarity = values.first().copied(),
        _ => {}
    })?;
    if representation.values.is_empty() {
        return Err(format!("its `{REPRESENTATION}` is empty"));
    }
    Ok(familiarity)
}

#[cfg(test)]
#[path = "network_tests.rs"]
mod tests;
