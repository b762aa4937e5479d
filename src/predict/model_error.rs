//! Why a network cannot be used.

/// Why a network cannot be used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("it cannot be read: {why}")]
    Unreadable {
        /// What the operating system says.
        why: String,
    },
    /// The file is not an ONNX model, or a damaged one.
    #[error("it is no intact ONNX file: {why}")]
    Corrupt {
        /// What is wrong.
        why: String,
    },
    /// Weights lie in another file.
    #[error("tensor {tensor:?} lies in another file; a network must be one file")]
    ExternalData {
        /// The tensor.
        tensor: String,
    },
    /// The file does not say what it must.
    #[error("its metadata lack {key:?}; wanted is {wanted}")]
    MissingMetadata {
        /// The missing entry.
        key: &'static str,
        /// What is wanted there.
        wanted: String,
    },
    /// The file says something that does not fit.
    #[error("its metadata say {key} = {value:?}; wanted is {wanted}")]
    BadMetadata {
        /// The entry.
        key: &'static str,
        /// What it says.
        value: String,
        /// What is wanted.
        wanted: String,
    },
    /// Inputs or outputs are not the agreed ones.
    #[error("its {what}: {found}; wanted is {wanted}")]
    Interface {
        /// Which of them.
        what: &'static str,
        /// What the file has.
        found: String,
        /// What is wanted.
        wanted: &'static str,
    },
    /// The graph cannot be cut into encoder and decoder.
    #[error("it cannot be cut at `representation`: {why}")]
    Cut {
        /// What is in the way.
        why: String,
    },
    /// The runtime refuses it or fails on it.
    #[error("{runtime} does not run it: {why}")]
    Runtime {
        /// The inference runtime.
        runtime: String,
        /// What it says.
        why: String,
    },
}
