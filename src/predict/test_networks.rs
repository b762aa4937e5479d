//! Small networks, written as ONNX files node by node.

use prost::Message;
use tract_onnx::pb::attribute_proto::AttributeType;
use tract_onnx::pb::tensor_proto::DataType;
use tract_onnx::pb::tensor_shape_proto::{Dimension, dimension};
use tract_onnx::pb::{
    AttributeProto, GraphProto, ModelProto, NodeProto, OperatorSetIdProto, StringStringEntryProto,
    TensorProto, TensorShapeProto, TypeProto, ValueInfoProto, type_proto,
};

use super::model_error::ModelError;
use super::network::Network;
use super::runtime::Runtime;

/// A network under construction.
#[derive(Clone)]
pub struct Build(pub ModelProto);

impl Build {
    /// Inputs, outputs and metadata as agreed, and no nodes.
    pub fn new() -> Self {
        let entries = [
            ("format_version", "1"),
            ("architecture", "test"),
            ("frame", "robot-cell"),
            ("resolution_m", "0.25"),
            ("crop_cells", "104"),
            ("lidar_range_m", "7.5"),
            ("prediction_range_m", "5"),
            ("context", "all"),
            ("trained_on", "0000000000000000000000000000000000000000000000000000000000000000"),
        ];
        let entry = |(key, value): (&str, &str)| StringStringEntryProto {
            key: key.into(),
            value: value.into(),
        };
        let graph = GraphProto {
            name: "test".into(),
            input: vec![value("context", &[None, Some(3)]), value("target", &[None, Some(2)])],
            output: vec![value("probability", &[None])],
            ..GraphProto::default()
        };
        Self(ModelProto {
            ir_version: 8,
            opset_import: vec![OperatorSetIdProto { domain: String::new(), version: 13 }],
            graph: Some(graph),
            metadata_props: entries.map(entry).to_vec(),
            ..ModelProto::default()
        })
    }

    pub fn graph(&mut self) -> &mut GraphProto {
        self.0.graph.as_mut().unwrap()
    }

    /// Sets one entry of the metadata.
    pub fn metadata(mut self, key: &str, text: &str) -> Self {
        self.0.metadata_props.retain(|entry| entry.key != key);
        let entry = StringStringEntryProto { key: key.into(), value: text.into() };
        self.0.metadata_props.push(entry);
        self
    }

    pub fn node(mut self, op: &str, inputs: &[&str], output: &str) -> Self {
        self.graph().node.push(NodeProto {
            op_type: op.into(),
            name: output.into(),
            input: inputs.iter().map(|name| (*name).into()).collect(),
            output: vec![output.into()],
            ..NodeProto::default()
        });
        self
    }

    /// Gives the newest node a list of whole numbers, or a single one.
    pub fn with(mut self, name: &str, ints: &[i64], single: bool) -> Self {
        let kind = if single { AttributeType::Int } else { AttributeType::Ints };
        let attribute = AttributeProto {
            name: name.into(),
            r#type: kind as i32,
            i: if single { ints[0] } else { 0 },
            ints: if single { Vec::new() } else { ints.to_vec() },
            ..AttributeProto::default()
        };
        self.graph().node.last_mut().unwrap().attribute.push(attribute);
        self
    }

    pub fn floats(mut self, name: &str, dims: &[i64], values: &[f32]) -> Self {
        self.graph().initializer.push(TensorProto {
            name: name.into(),
            dims: dims.to_vec(),
            data_type: DataType::Float as i32,
            float_data: values.to_vec(),
            ..TensorProto::default()
        });
        self
    }

    pub fn ints(mut self, name: &str, values: &[i64]) -> Self {
        self.graph().initializer.push(TensorProto {
            name: name.into(),
            dims: vec![values.len() as i64],
            data_type: DataType::Int64 as i32,
            int64_data: values.to_vec(),
            ..TensorProto::default()
        });
        self
    }

    pub fn bytes(&self) -> Vec<u8> {
        self.0.encode_to_vec()
    }

    pub fn load(&self) -> Result<Network, ModelError> {
        Network::load(&self.bytes(), Runtime::choose("").unwrap())
    }
}

/// The type and shape of a tensor of floats.
pub fn value(name: &str, shape: &[Option<i64>]) -> ValueInfoProto {
    let axis = |length: &Option<i64>| Dimension {
        value: Some(match length {
            Some(length) => dimension::Value::DimValue(*length),
            None => dimension::Value::DimParam(format!("{name}_n")),
        }),
        ..Dimension::default()
    };
    let tensor = type_proto::Tensor {
        elem_type: DataType::Float as i32,
        shape: Some(TensorShapeProto { dim: shape.iter().map(axis).collect() }),
    };
    let r#type = Some(TypeProto {
        value: Some(type_proto::Value::TensorType(tensor)),
        ..TypeProto::default()
    });
    ValueInfoProto { name: name.into(), r#type, ..ValueInfoProto::default() }
}

/// Where the answers of [`plane`] come from: sigmoid(x + 2 y + mean of the context's labels).
pub fn plane_answer(context: &[[f32; 3]], [x, y]: [f32; 2]) -> f32 {
    let mean = context.iter().map(|c| f64::from(c[2])).sum::<f64>() / context.len() as f64;
    let logit = f64::from(x) + 2.0 * f64::from(y) + mean;
    (1.0 / (1.0 + (-logit).exp())) as f32
}

/// A conditional neural process without hidden layers; `cut` names the tensor between its halves.
pub fn plane(cut: &str) -> Build {
    plane_logits(cut).node("Sigmoid", &["logits"], "probability")
}

/// [`plane`] as far as the tensor `logits`.
pub fn plane_logits(cut: &str) -> Build {
    Build::new()
        .floats("label", &[3, 1], &[0.0, 0.0, 1.0])
        .floats("slope", &[2, 1], &[1.0, 2.0])
        .ints("flat", &[-1])
        .node("MatMul", &["context", "label"], "labels")
        .node("ReduceMean", &["labels"], "mean")
        .with("axes", &[0], false)
        .with("keepdims", &[0], true)
        .node("Identity", &["mean"], cut)
        .node("MatMul", &["target", "slope"], "slopes")
        .node("Add", &["slopes", cut], "column")
        .node("Reshape", &["column", "flat"], "logits")
}

/// A network that answers one number everywhere, looked up by the target.
pub fn constant(answer: f32) -> Build {
    Build::new()
        .floats("zero", &[], &[0.0])
        .floats("answer", &[], &[answer])
        .ints("column", &[0])
        .node("ReduceSum", &["context"], "sum")
        .with("keepdims", &[0], true)
        .node("Mul", &["sum", "zero"], "nothing")
        .node("Add", &["nothing", "answer"], "representation")
        .node("Gather", &["target", "column"], "xs")
        .with("axis", &[1], true)
        .node("Squeeze", &["xs", "one"], "list")
        .ints("one", &[1])
        .node("Mul", &["list", "zero"], "zeros")
        .node("Add", &["zeros", "representation"], "probability")
}
