//! A network's file as a document: what it declares about itself, and its graph cut in two.
//!
//! An ONNX file holds one graph from `context` and `target` to `probability`. A tensor named
//! `representation` separates what depends on the context alone from the rest; cut there, the graph
//! becomes an encoder, run once a scan, and a decoder, run for whatever is asked. Nothing here runs
//! a network.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use prost::Message;
use tract_onnx::pb::tensor_proto::{DataLocation, DataType};
use tract_onnx::pb::tensor_shape_proto::{Dimension, dimension};
use tract_onnx::pb::type_proto;
use tract_onnx::pb::{
    GraphProto, ModelProto, NodeProto, TensorProto, TensorShapeProto, TypeProto, ValueInfoProto,
};

use super::model_error::ModelError;

/// Observed cells: x, y (robot-cell frame, metres), 0 for free or 1 for occupied.
pub(super) const CONTEXT: &str = "context";
/// Points asked for: x, y (robot-cell frame, metres).
pub(super) const TARGET: &str = "target";
/// Probability that each target is occupied.
pub(super) const PROBABILITY: &str = "probability";
/// The tensor at which the graph is cut.
pub(super) const REPRESENTATION: &str = "representation";
/// Optional output: how familiar the scene (one value) or each target looks.
pub(super) const FAMILIARITY: &str = "familiarity";

/// A network as its file has it.
#[derive(Clone, Debug)]
pub(super) struct Document {
    model: ModelProto,
    graph: GraphProto,
}

/// What of a graph runs when.
#[derive(Clone, Debug)]
pub(super) enum Halves {
    /// The graph cannot be cut: it runs as one.
    Whole {
        /// The network.
        network: Vec<u8>,
    },
    /// Encoder and decoder.
    Cut {
        /// From `context` to `representation`.
        encoder: Vec<u8>,
        /// From `representation` and `target` on; wants the shape of `representation`.
        decoder: Box<Decoder>,
    },
}

/// A decoder that still wants to know the shape of its input.
#[derive(Clone, Debug)]
pub(super) struct Decoder {
    model: ModelProto,
    /// It only looks answers up: asking for all of them costs next to nothing.
    pub(super) looks_up: bool,
}

/// Operators that do work for every target; without them a decoder looks its answers up.
const WORKING_OPS: &[&str] =
    &["MatMul", "Gemm", "Conv", "ConvTranspose", "Einsum", "LSTM", "GRU", "RNN", "MatMulInteger"];

impl Document {
    /// Reads a file's bytes.
    pub(super) fn parse(bytes: &[u8]) -> Result<Self, ModelError> {
        let mut model = ModelProto::decode(bytes)
            .map_err(|error| ModelError::Corrupt { why: error.to_string() })?;
        let Some(graph) = model.graph.take().filter(|graph| !graph.node.is_empty()) else {
            return Err(ModelError::Corrupt { why: "it holds no graph".into() });
        };
        if model.opset_import.is_empty() {
            return Err(ModelError::Corrupt { why: "it names no operator set".into() });
        }
        let document = Self { model, graph };
        document.check_tensors()?;
        document.check_order()?;
        document.check_interface()?;
        Ok(document)
    }

    /// What the file says about itself.
    pub(super) fn metadata(&self) -> BTreeMap<&str, &str> {
        self.model.metadata_props.iter().map(|p| (p.key.as_str(), p.value.as_str())).collect()
    }

    /// Whether it tells how familiar a scene looks.
    pub(super) fn tells_familiarity(&self) -> bool {
        self.graph.output.iter().any(|output| output.name == FAMILIARITY)
    }

    /// The graph, cut where it can be.
    pub(super) fn halves(&self) -> Result<Halves, ModelError> {
        let mut outputs = vec![PROBABILITY];
        if self.tells_familiarity() {
            outputs.push(FAMILIARITY);
        }
        if !self.graph.node.iter().any(|n| n.output.iter().any(|o| o == REPRESENTATION)) {
            return Ok(Halves::Whole { network: self.part(&[CONTEXT, TARGET], &outputs, None) });
        }
        let reaches = |from: &str, input: &str, stop: &[&str]| {
            self.needed_for(&[from], stop).1.contains(input)
        };
        if reaches(REPRESENTATION, TARGET, &[]) {
            let why = format!("`{REPRESENTATION}` depends on `{TARGET}`");
            return Err(ModelError::Cut { why });
        }
        if reaches(PROBABILITY, CONTEXT, &[REPRESENTATION]) {
            let why =
                format!("`{PROBABILITY}` depends on `{CONTEXT}` also past `{REPRESENTATION}`");
            return Err(ModelError::Cut { why });
        }
        let familiarity = outputs.get(1).map(|name| {
            let past = reaches(name, CONTEXT, &[REPRESENTATION]);
            (past, past && reaches(name, TARGET, &[REPRESENTATION]))
        });
        if let Some((_, true)) = familiarity {
            let why = format!(
                "`{FAMILIARITY}` depends on `{TARGET}`, and on `{CONTEXT}` past `{REPRESENTATION}`"
            );
            return Err(ModelError::Cut { why });
        }
        let (mut first, mut second) = (vec![REPRESENTATION], vec![PROBABILITY]);
        match familiarity {
            Some((true, _)) => first.push(FAMILIARITY),
            Some((false, _)) => second.push(FAMILIARITY),
            None => {}
        }
        let encoder = self.part(&[CONTEXT], &first, None);
        let decoder = self.part_model(&[REPRESENTATION, TARGET], &second, Some(REPRESENTATION));
        let nodes = decoder.graph.as_ref().map_or(&[][..], |graph| &graph.node);
        let looks_up = !nodes.iter().any(|n| WORKING_OPS.contains(&n.op_type.as_str()));
        let decoder = Box::new(Decoder { model: decoder, looks_up });
        Ok(Halves::Cut { encoder, decoder })
    }

    /// Weights in other files would be looked for beside whatever file this one was read from.
    fn check_tensors(&self) -> Result<(), ModelError> {
        let external = |t: &&TensorProto| {
            !t.external_data.is_empty() || t.data_location == Some(DataLocation::External as i32)
        };
        let constants = self.graph.node.iter().flat_map(|n| &n.attribute);
        let constants = constants.flat_map(|a| a.t.iter().chain(&a.tensors));
        let mut tensors = self.graph.initializer.iter().chain(constants);
        if let Some(tensor) = tensors.find(external) {
            return Err(ModelError::ExternalData { tensor: tensor.name.clone() });
        }
        for tensor in &self.graph.initializer {
            let elements = tensor
                .dims
                .iter()
                .try_fold(1_i64, |n, d| if *d < 0 { None } else { n.checked_mul(*d) });
            let stored = stored_elements(tensor);
            if elements.is_none() || stored.is_some_and(|stored| Some(stored) != elements) {
                let why = format!(
                    "tensor {:?} of shape {:?} holds {} values",
                    tensor.name,
                    tensor.dims,
                    stored.unwrap_or(0)
                );
                return Err(ModelError::Corrupt { why });
            }
        }
        Ok(())
    }

    /// Every tensor is made before it is used, once.
    fn check_order(&self) -> Result<(), ModelError> {
        let graph = &self.graph;
        let inputs = graph.input.iter().map(|v| v.name.as_str());
        let mut known: BTreeSet<&str> =
            inputs.chain(graph.initializer.iter().map(|t| t.name.as_str())).collect();
        for node in &graph.node {
            if let Some(missing) =
                node.input.iter().find(|i| !i.is_empty() && !known.contains(i.as_str()))
            {
                let why = format!(
                    "operator {} ({}) uses tensor {missing:?}, which nothing before it makes",
                    node.name, node.op_type
                );
                return Err(ModelError::Corrupt { why });
            }
            for output in node.output.iter().filter(|o| !o.is_empty()) {
                if !known.insert(output) {
                    let why = format!("tensor {output:?} is made twice");
                    return Err(ModelError::Corrupt { why });
                }
            }
        }
        let missing = graph.output.iter().find(|o| !known.contains(o.name.as_str()));
        missing.map_or(Ok(()), |output| {
            Err(ModelError::Corrupt { why: format!("nothing makes output {:?}", output.name) })
        })
    }

    fn check_interface(&self) -> Result<(), ModelError> {
        let graph = &self.graph;
        let initialised: BTreeSet<&str> =
            graph.initializer.iter().map(|t| t.name.as_str()).collect();
        let inputs: Vec<&ValueInfoProto> =
            graph.input.iter().filter(|v| !initialised.contains(v.name.as_str())).collect();
        let names = |values: &[&ValueInfoProto]| {
            values.iter().map(|v| v.name.clone()).collect::<Vec<_>>().join(", ")
        };
        let find = |values: &[&ValueInfoProto], name: &str| {
            values.iter().find(|v| v.name == name).map(|v| Shape::of(v))
        };
        let wrong = |what: &'static str, found: String, wanted: &'static str| {
            Err(ModelError::Interface { what, found, wanted })
        };
        const CONTEXT_WANTED: &str = "float32 [any number, 3] (x, y, occupied)";
        const TARGET_WANTED: &str = "float32 [any number, 2] (x, y)";
        const PROBABILITY_WANTED: &str = "float32 [any number]";
        const FAMILIARITY_WANTED: &str = "float32, one value or one for each target";
        if inputs.len() != 2 {
            return wrong("inputs", names(&inputs), "`context` and `target`");
        }
        for (name, width, wanted) in [(CONTEXT, 3, CONTEXT_WANTED), (TARGET, 2, TARGET_WANTED)] {
            match find(&inputs, name) {
                None => return wrong("inputs", names(&inputs), "`context` and `target`"),
                Some(shape) if !shape.is_points(width) => {
                    return wrong(
                        if name == CONTEXT { "input `context`" } else { "input `target`" },
                        shape.text(),
                        wanted,
                    );
                }
                Some(_) => {}
            }
        }
        let outputs: Vec<&ValueInfoProto> = graph.output.iter().collect();
        let Some(shape) = find(&outputs, PROBABILITY) else {
            return wrong("outputs", names(&outputs), "`probability`, perhaps `familiarity`");
        };
        if !shape.is_list() {
            return wrong("output `probability`", shape.text(), PROBABILITY_WANTED);
        }
        if let Some(shape) = find(&outputs, FAMILIARITY)
            && !shape.is_float_up_to_rank_one()
        {
            return wrong("output `familiarity`", shape.text(), FAMILIARITY_WANTED);
        }
        if outputs.iter().any(|o| o.name != PROBABILITY && o.name != FAMILIARITY) {
            return wrong("outputs", names(&outputs), "`probability`, perhaps `familiarity`");
        }
        Ok(())
    }

    /// The nodes (by index) and the other tensors (inputs, weights) that some tensors depend on,
    /// not looking beyond `stop`.
    fn needed_for(&self, outputs: &[&str], stop: &[&str]) -> (BTreeSet<usize>, BTreeSet<String>) {
        let mut makers: HashMap<&str, usize> = HashMap::new();
        for (i, node) in self.graph.node.iter().enumerate() {
            makers.extend(node.output.iter().map(|output| (output.as_str(), i)));
        }
        let (mut nodes, mut leaves) = (BTreeSet::new(), BTreeSet::new());
        let mut open: Vec<String> = outputs.iter().map(|name| (*name).to_owned()).collect();
        while let Some(name) = open.pop() {
            let maker = makers.get(name.as_str()).filter(|_| !stop.contains(&name.as_str()));
            match maker {
                None => {
                    leaves.insert(name);
                }
                Some(maker) if nodes.insert(*maker) => {
                    let node = &self.graph.node[*maker];
                    open.extend(used_by(node));
                }
                Some(_) => {}
            }
        }
        (nodes, leaves)
    }

    fn part(&self, inputs: &[&str], outputs: &[&str], stop: Option<&str>) -> Vec<u8> {
        self.part_model(inputs, outputs, stop).encode_to_vec()
    }

    /// The part of the graph from some tensors to others. A type that the file does not declare is
    /// float32 of unknown shape.
    fn part_model(&self, inputs: &[&str], outputs: &[&str], stop: Option<&str>) -> ModelProto {
        let (nodes, leaves) = self.needed_for(outputs, stop.as_slice());
        let whole = &self.graph;
        let values = || whole.input.iter().chain(&whole.output).chain(&whole.value_info);
        let declared = |name: &str| {
            values().find(|v| v.name == name).cloned().unwrap_or_else(|| value_info(name, None))
        };
        let graph = GraphProto {
            node: nodes.iter().map(|i| whole.node[*i].clone()).collect(),
            name: whole.name.clone(),
            initializer: whole
                .initializer
                .iter()
                .filter(|t| leaves.contains(&t.name))
                .cloned()
                .collect(),
            sparse_initializer: whole.sparse_initializer.clone(),
            input: inputs.iter().map(|name| declared(name)).collect(),
            output: outputs.iter().map(|name| declared(name)).collect(),
            ..GraphProto::default()
        };
        ModelProto { graph: Some(graph), metadata_props: Vec::new(), ..self.model.clone() }
    }
}

impl Decoder {
    /// The decoder for a representation of this shape; `None` for an axis whose length varies.
    pub(super) fn with_shape(mut self, shape: &[Option<i64>]) -> Vec<u8> {
        let inputs = self.model.graph.iter_mut().flat_map(|graph| &mut graph.input);
        for input in inputs.filter(|input| input.name == REPRESENTATION) {
            *input = value_info(REPRESENTATION, Some(shape));
        }
        self.model.encode_to_vec()
    }
}

/// The tensors that a node uses, those of graphs inside it included.
fn used_by(node: &NodeProto) -> Vec<String> {
    let mut used: Vec<String> = node.input.iter().filter(|i| !i.is_empty()).cloned().collect();
    let inner = node.attribute.iter().flat_map(|a| a.g.iter().chain(&a.graphs));
    for graph in inner {
        used.extend(graph.node.iter().flat_map(used_by));
    }
    used
}

/// How many values a tensor's data hold; `None` where that cannot be told from the bytes.
fn stored_elements(tensor: &TensorProto) -> Option<i64> {
    let size = match DataType::try_from(tensor.data_type) {
        Ok(DataType::Float | DataType::Int32 | DataType::Uint32) => 4,
        Ok(DataType::Double | DataType::Int64 | DataType::Uint64) => 8,
        Ok(DataType::Float16 | DataType::Bfloat16 | DataType::Int16 | DataType::Uint16) => 2,
        Ok(DataType::Int8 | DataType::Uint8 | DataType::Bool) => 1,
        _ => return None,
    };
    if !tensor.raw_data.is_empty() {
        let bytes = tensor.raw_data.len();
        return Some(if bytes % size == 0 { (bytes / size) as i64 } else { -1 });
    }
    let lists = [
        tensor.float_data.len(),
        tensor.int32_data.len(),
        tensor.int64_data.len(),
        tensor.double_data.len(),
        tensor.uint64_data.len(),
    ];
    Some(lists.iter().sum::<usize>() as i64)
}

fn value_info(name: &str, shape: Option<&[Option<i64>]>) -> ValueInfoProto {
    let dimension = |(axis, length): (usize, &Option<i64>)| Dimension {
        value: Some(match length {
            Some(length) => dimension::Value::DimValue(*length),
            None => dimension::Value::DimParam(format!("{name}_{axis}")),
        }),
        ..Dimension::default()
    };
    let shape = shape
        .map(|shape| TensorShapeProto { dim: shape.iter().enumerate().map(dimension).collect() });
    let tensor = type_proto::Tensor { elem_type: DataType::Float as i32, shape };
    ValueInfoProto {
        name: name.to_owned(),
        r#type: Some(TypeProto {
            value: Some(type_proto::Value::TensorType(tensor)),
            ..TypeProto::default()
        }),
        ..ValueInfoProto::default()
    }
}

/// The declared type and shape of a tensor.
struct Shape {
    element: Option<DataType>,
    /// Fixed lengths; `None` for an axis of any length, or for an unknown rank.
    axes: Option<Vec<Option<i64>>>,
}

impl Shape {
    fn of(value: &ValueInfoProto) -> Self {
        let Some(TypeProto { value: Some(type_proto::Value::TensorType(tensor)), .. }) =
            &value.r#type
        else {
            return Self { element: None, axes: None };
        };
        let length = |d: &Dimension| match &d.value {
            Some(dimension::Value::DimValue(length)) => Some(*length),
            _ => None,
        };
        Self {
            element: DataType::try_from(tensor.elem_type).ok(),
            axes: tensor.shape.as_ref().map(|shape| shape.dim.iter().map(length).collect()),
        }
    }

    fn is_points(&self, width: i64) -> bool {
        self.element == Some(DataType::Float)
            && self.axes.as_deref() == Some(&[None, Some(width)][..])
    }

    fn is_list(&self) -> bool {
        self.element == Some(DataType::Float) && self.axes.as_deref() == Some(&[None][..])
    }

    fn is_float_up_to_rank_one(&self) -> bool {
        self.element == Some(DataType::Float) && self.axes.as_ref().is_some_and(|a| a.len() <= 1)
    }

    fn text(&self) -> String {
        let element = match self.element {
            Some(DataType::Float) => "float32".to_owned(),
            Some(element) => element.as_str_name().to_lowercase(),
            None => "no tensor".to_owned(),
        };
        let Some(axes) = &self.axes else { return format!("{element} of unknown shape") };
        let axis = |a: &Option<i64>| a.map_or_else(|| "any number".to_owned(), |a| a.to_string());
        format!("{element} [{}]", axes.iter().map(axis).collect::<Vec<_>>().join(", "))
    }
}
