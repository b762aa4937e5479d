//! What of BARN is to be driven.

use super::{Field, NAME};
use crate::experiment::paper::Method;
use crate::experiment::run::{Benchmark, Keep, RunSpec, SpecError, Task, Timing, WorldSpec};
use crate::plan::Policy;
use crate::predict::PredictorKind;
use crate::sim::maze::Family;

/// What is to be driven.
#[derive(Clone, Debug, PartialEq)]
pub struct BarnRequest {
    /// The worlds, each with the map file that it has been written to.
    pub fields: Vec<(Field, String)>,
    /// Methods beside the known map, which is always driven: it tells which worlds can be crossed.
    pub methods: Vec<Method>,
    /// Highest speed, m/s.
    pub speed_max_mps: f64,
    /// How far the lidar sees, metres.
    pub lidar_range_m: f64,
    /// Side of a cell of the car's map, metres.
    pub resolution_m: f64,
    /// Time from a scan to its plan.
    pub latency: Timing,
    /// Parameters for all methods.
    pub set: Vec<String>,
}

impl BarnRequest {
    /// The methods that are driven if nobody says otherwise.
    pub fn usual_methods() -> Vec<Method> {
        ["frontier", "map-predictive+none", "map-predictive+cnp", "map-predictive+oracle", "janson"]
            .map(|text| text.parse().expect("the names are well formed"))
            .into()
    }

    /// The drives, each once.
    ///
    /// # Errors
    /// If this program has no such policy or predictor, or refuses a parameter.
    pub fn tasks(&self) -> Result<Vec<Task>, SpecError> {
        let known_map = Method {
            policy: Policy::KnownMap.name().into(),
            predictor: PredictorKind::None.name().into(),
            set: Vec::new(),
        };
        let mut methods = vec![known_map];
        for method in &self.methods {
            if !methods.contains(method) {
                methods.push(method.clone());
            }
        }
        let mut tasks = Vec::new();
        for method in &methods {
            for (field, file) in &self.fields {
                let spec = self.spec(field, file, method);
                let reference = spec.policy != Policy::KnownMap.name();
                tasks.push(Task {
                    experiment: NAME.into(),
                    spec,
                    keep: Keep { reference, ..Keep::default() },
                    benchmark: Some(Benchmark { world: field.number, path_m: field.path_m }),
                });
            }
            if let Some(task) = tasks.last() {
                task.spec.params()?;
            }
        }
        Ok(tasks)
    }

    fn spec(&self, field: &Field, file: &str, method: &Method) -> RunSpec {
        let resolution = super::resolution_setting(self.resolution_m);
        RunSpec {
            world: WorldSpec::Map { file: file.to_owned() },
            start: Some(field.start),
            goal: Some(field.goal),
            policy: method.policy.clone(),
            predictor: method.predictor.clone(),
            speed_max_mps: self.speed_max_mps,
            lidar_range_m: self.lidar_range_m,
            latency: self.latency,
            set: std::iter::once(&resolution)
                .chain(&self.set)
                .chain(&method.set)
                .cloned()
                .collect(),
            ..RunSpec::maze(Family::Posts, 0)
        }
    }
}
