//! The inference runtime: the only file that knows which one it is.
//!
//! Networks run through `ort`. Behind it stands either tract, which is part of this program, or a
//! native ONNX Runtime library that the configuration names. `ort` holds one of them for the whole
//! process; whoever loads the first network chooses.

// A native library is opened by its path and asked for its table of functions: nothing but its
// name says that they are what they should be. And the registers that a runtime leaves behind are
// cleared by an instruction of the processor. No other file of the crate allows this.
#![expect(unsafe_code, reason = "a shared library's functions cannot be checked")]

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ffi::CStr;
use std::panic::AssertUnwindSafe;
use std::sync::{Mutex, OnceLock, PoisonError};

use ort::environment::Environment;
use ort::session::builder::GraphOptimizationLevel;
use ort::session::{Session, SessionInputValue};
use ort::sys::{ORT_API_VERSION, OrtApiBase};
use ort::value::TensorRef;
use tract_onnx::prelude::{Framework, InferenceModelExt, Tensor, TractResult};
use tract_onnx::tract_core::model::IntoRunnable;

use super::model_error::ModelError;

/// Why a runtime cannot be had.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RuntimeError {
    /// The library cannot be opened, or is no ONNX Runtime.
    #[error("cannot use {library:?} as ONNX Runtime: {why}")]
    Library {
        /// Its path.
        library: String,
        /// What is wrong.
        why: String,
    },
    /// The library is too old.
    #[error("{library:?} is ONNX Runtime {version}; wanted is 1.{least} or newer")]
    TooOld {
        /// Its path.
        library: String,
        /// Its version.
        version: String,
        /// Least minor version.
        least: u32,
    },
    /// Another one is in use already.
    #[error("this process already runs networks with {chosen}; it cannot change to {wanted:?}")]
    Chosen {
        /// The one in use.
        chosen: String,
        /// The library asked for; empty for the built-in runtime.
        wanted: String,
    },
}

/// A runtime, chosen for the whole process.
pub(super) struct Runtime {
    library: String,
    name: String,
    environment: Environment,
}

static CHOSEN: OnceLock<Runtime> = OnceLock::new();
static CHOOSING: Mutex<()> = Mutex::new(());

impl Runtime {
    /// The native library of that path, or with an empty path the runtime that is part of this
    /// program.
    pub(super) fn choose(library: &str) -> Result<&'static Self, RuntimeError> {
        let _one_at_a_time = CHOOSING.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(chosen) = CHOSEN.get() {
            return if chosen.library == library {
                Ok(chosen)
            } else {
                Err(RuntimeError::Chosen { chosen: chosen.name.clone(), wanted: library.into() })
            };
        }
        let name = if library.is_empty() {
            ort::set_api(ort_tract::api());
            "tract (built in)".to_owned()
        } else {
            format!("ONNX Runtime {} ({library})", open(library)?)
        };
        let environment = ort::init().with_name("apexd").build().map_err(|error| {
            RuntimeError::Library { library: library.into(), why: error.to_string() }
        })?;
        Ok(CHOSEN.get_or_init(|| Self { library: library.into(), name, environment }))
    }

    /// What it is, for people.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// Runs a network with some inputs, before it is made ready. One that fails here must not be
    /// made ready: called through `ort`, the built-in runtime ends the process where it panics,
    /// which on damaged networks it does.
    ///
    /// # Errors
    /// What the runtime says; also if it panics.
    pub(super) fn rehearse(
        &self,
        onnx: &[u8],
        runs: &[&[Input<'_>]],
    ) -> Result<Vec<Outputs>, ModelError> {
        let fail = |why: String| ModelError::Runtime { runtime: self.name.clone(), why };
        if !self.library.is_empty() {
            let mut program = self.load(onnx)?;
            let mut run = |inputs: &&[Input<'_>]| {
                let mut outputs = Outputs::new();
                program.run(inputs, |name, shape, values| {
                    let shape = shape.iter().map(|axis| *axis as usize).collect();
                    outputs.insert(name.to_owned(), (shape, values.to_vec()));
                })?;
                Ok(outputs)
            };
            return runs.iter().map(&mut run).collect::<Result<_, _>>().map_err(fail);
        }
        let rehearsal = AssertUnwindSafe(|| run_by_tract(onnx, runs));
        match std::panic::catch_unwind(rehearsal) {
            Ok(Ok(outputs)) => Ok(outputs),
            Ok(Err(error)) => Err(fail(format!("{error:#}"))),
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
                Err(fail(format!("it panics: {}", text.unwrap_or("without a word"))))
            }
        }
    }

    /// Makes a network ready to run on one thread.
    pub(super) fn load(&self, onnx: &[u8]) -> Result<Program, ModelError> {
        let load = || {
            // Without a level of optimisation tract runs the graph as it is written.
            Session::builder(&self.environment)?
                .with_optimization_level(GraphOptimizationLevel::Level3)?
                .with_intra_threads(1)?
                .with_inter_threads(1)?
                .commit_from_memory(onnx)
        };
        let session = load().map_err(|error: ort::Error| ModelError::Runtime {
            runtime: self.name.clone(),
            why: error.to_string(),
        })?;
        Ok(Program { session })
    }
}

/// Opens a native library, has `ort` use it, and returns its version.
fn open(path: &str) -> Result<String, RuntimeError> {
    let fail = |why: String| RuntimeError::Library { library: path.to_owned(), why };
    // SAFETY: opening a library runs its initialisers. The configuration names it, and whoever
    // writes the configuration decides what this process runs anyway.
    let library = unsafe { libloading::Library::new(path) }.map_err(|e| fail(e.to_string()))?;
    // SAFETY: this symbol has this type in every ONNX Runtime (`onnxruntime_c_api.h`).
    let base =
        unsafe { library.get::<unsafe extern "C" fn() -> *const OrtApiBase>(b"OrtGetApiBase") }
            .map_err(|error| fail(error.to_string()))?;
    // SAFETY: it takes nothing and returns a table that lives as long as the library, or null.
    let base = unsafe { base().as_ref() }.ok_or_else(|| fail("it has no table".into()))?;
    // SAFETY: the function returns a static string.
    let version =
        unsafe { CStr::from_ptr((base.GetVersionString)()) }.to_string_lossy().into_owned();
    // SAFETY: any number is a valid argument; the answer is null for a version it does not have.
    let api = unsafe { (base.GetApi)(ORT_API_VERSION) };
    if api.is_null() {
        let library = path.to_owned();
        return Err(RuntimeError::TooOld { library, version, least: ORT_API_VERSION });
    }
    // SAFETY: a table of at least the version asked for begins with the fields of that version.
    ort::set_api(unsafe { api.read() });
    // The functions must stay where they are until the process ends.
    std::mem::forget(library);
    Ok(version)
}

/// The outputs of a run by name: shape and values.
pub(super) type Outputs = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

/// What `ort` has the built-in runtime do, without `ort` in between.
fn run_by_tract(onnx: &[u8], runs: &[&[Input<'_>]]) -> TractResult<Vec<Outputs>> {
    let model = tract_onnx::onnx().model_for_read(&mut &*onnx)?;
    let names: Vec<String> = model
        .output_outlets()?
        .iter()
        .map(|o| model.outlet_label(*o).unwrap_or("").into())
        .collect();
    let plan = model.into_optimized()?.into_runnable()?;
    let run = |inputs: &&[Input<'_>]| {
        let tensor = |input: &Input<'_>| Tensor::from_shape(input.shape, input.values);
        let tensors = inputs.iter().map(|i| Ok(tensor(i)?.into())).collect::<TractResult<_>>()?;
        let mut outputs = Outputs::new();
        for (name, value) in names.iter().zip(plan.run(tensors)?) {
            let values = value.to_plain_array_view::<f32>()?.iter().copied().collect();
            outputs.insert(name.clone(), (value.shape().to_vec(), values));
        }
        Ok(outputs)
    };
    runs.iter().map(run).collect()
}

/// Tells the processor that the upper parts of its vector registers hold nothing.
///
/// tract's kernels for AVX and AVX-512 leave them in use. Whatever the thread does next with the
/// narrow instructions that this program is compiled to then drags them along: smoothing took 1.6
/// times as long after a prediction as without one (Zen 4).
fn clear_upper_registers() {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx") {
        // SAFETY: the processor has the instruction. No function keeps values in these registers
        // over a call.
        unsafe { std::arch::x86_64::_mm256_zeroupper() }
    }
}

/// A network (or a part of one) that is ready to run.
pub(super) struct Program {
    session: Session,
}

/// One input: its name, its shape and its values, row by row.
#[derive(Clone, Copy)]
pub(super) struct Input<'a> {
    pub(super) name: &'a str,
    pub(super) shape: &'a [usize],
    pub(super) values: &'a [f32],
}

impl Program {
    /// Runs it; `read` is given name, shape and values of every output.
    ///
    /// # Errors
    /// What the runtime says.
    pub(super) fn run(
        &mut self,
        inputs: &[Input<'_>],
        mut read: impl FnMut(&str, &[i64], &[f32]),
    ) -> Result<(), String> {
        let mut run = || {
            let mut values: Vec<(Cow<'_, str>, SessionInputValue<'_>)> = Vec::new();
            for input in inputs {
                let tensor = TensorRef::from_array_view((input.shape, input.values))?;
                values.push((input.name.into(), tensor.into()));
            }
            let outputs = self.session.run(values);
            clear_upper_registers();
            let outputs = outputs?;
            for (name, value) in &outputs {
                let (shape, values) = value.try_extract_tensor::<f32>()?;
                read(name, shape, values);
            }
            Ok(())
        };
        run().map_err(|error: ort::Error| error.to_string())
    }
}
