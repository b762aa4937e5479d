use super::super::test_networks::{Build, constant, plane, plane_answer, plane_logits, value};
use super::*;

const CONTEXT: &[[f32; 3]] =
    &[[0.125, 0.125, 0.0], [0.375, 0.125, 1.0], [-2.125, 1.375, 1.0], [4.125, -3.375, 0.0]];
const TARGETS: &[[f32; 2]] = &[[0.625, -0.125], [-1.125, 0.625], [0.125, 0.375]];

fn answers(network: &mut Network, context: &[[f32; 3]], targets: &[[f32; 2]]) -> Vec<f32> {
    let mut answers = Answers::default();
    network.encode(context).unwrap();
    network.decode(targets, &mut answers).unwrap();
    answers.probability
}

fn refusal(build: &Build) -> String {
    build.load().err().expect("it does not fit").to_string()
}

#[test]
fn a_network_answers_what_its_formula_says_cut_or_whole_for_any_number_of_points() {
    for cut in ["representation", "something"] {
        let mut network = plane(cut).load().unwrap();
        assert_eq!(network.asks_all_at_once(), cut == "something");
        for points in 1..=CONTEXT.len() {
            for count in 1..=TARGETS.len() {
                let (context, targets) = (&CONTEXT[..points], &TARGETS[..count]);
                for (p, target) in answers(&mut network, context, targets).iter().zip(targets) {
                    let wanted = plane_answer(context, *target);
                    assert!((p - wanted).abs() < 1e-6, "{cut} {points} {count}: {p} {wanted}");
                }
            }
        }
    }
}

#[test]
fn a_scene_is_kept_between_questions() {
    let mut network = plane("representation").load().unwrap();
    let first = answers(&mut network, &CONTEXT[1..3], TARGETS);
    let mut again = Answers::default();
    for (target, p) in TARGETS.iter().zip(first) {
        network.decode(&[*target], &mut again).unwrap();
        assert!((again.probability[0] - p).abs() < 1e-6);
    }
    network.decode(&[], &mut again).unwrap();
    assert!(again.probability.is_empty());
    assert!(network.encode(&[]).unwrap_err().contains("at least one"));
}

#[test]
fn a_representation_may_grow_with_the_context() {
    // The largest label of the context, by a decoder that is handed every label.
    let build = Build::new()
        .ints("last", &[2])
        .ints("flat", &[-1])
        .ints("first", &[0])
        .floats("zero", &[], &[0.0])
        .node("Gather", &["context", "last"], "representation")
        .with("axis", &[1], true)
        .node("ReduceMax", &["representation"], "largest")
        .with("keepdims", &[0], true)
        .node("Gather", &["target", "first"], "xs")
        .with("axis", &[1], true)
        .node("Reshape", &["xs", "flat"], "list")
        .node("Mul", &["list", "zero"], "zeros")
        .node("Add", &["zeros", "largest"], "probability");
    let mut network = build.load().unwrap();
    assert!(network.asks_all_at_once());
    assert_eq!(answers(&mut network, CONTEXT, TARGETS), [1.0; 3]);
    assert_eq!(answers(&mut network, &CONTEXT[..1], &TARGETS[..2]), [0.0; 2]);
}

#[test]
fn familiarity_comes_from_either_half() {
    let scene = plane("representation").node("Neg", &["mean"], "familiarity");
    let each = plane("representation").node("Neg", &["logits"], "familiarity");
    for (mut build, shape, count) in [(scene, &[Some(1)], 1), (each, &[None], 3)] {
        build.graph().output.push(value("familiarity", shape));
        let mut network = build.load().unwrap();
        let mut answers = Answers::default();
        network.encode(&CONTEXT[1..3]).unwrap();
        network.decode(TARGETS, &mut answers).unwrap();
        assert_eq!(answers.familiarity.len(), count);
        let wanted = if count == 1 { -1.0 } else { -(0.625 - 0.25 + 1.0) };
        assert!((answers.familiarity[0] - wanted).abs() < 1e-6, "{answers:?}");
    }
}

#[test]
fn graphs_that_cannot_be_cut_are_refused() {
    let early = Build::new().node("ReduceMean", &["target"], "representation").node(
        "Identity",
        &["representation"],
        "probability",
    );
    assert!(refusal(&early).contains("`representation` depends on `target`"));
    let around = plane_logits("representation").node("Add", &["logits", "mean"], "more").node(
        "Sigmoid",
        &["more"],
        "probability",
    );
    let error = refusal(&around);
    assert!(error.contains("`probability` depends on `context` also past"), "{error}");
    let mut mixed = plane("representation").node("Add", &["logits", "mean"], "familiarity");
    mixed.graph().output.push(value("familiarity", &[None]));
    let error = refusal(&mixed);
    assert!(error.contains("`familiarity` depends on `target`, and on `context`"), "{error}");
}

#[test]
fn inputs_and_outputs_other_than_the_agreed_ones_are_refused_with_what_is_wanted() {
    type Change = fn(&mut Build);
    let cases: [(Change, &str); 10] = [
        (|b| b.graph().input[0] = value("context", &[None, Some(4)]), "float32 [any number, 4]"),
        (|b| b.graph().input[0] = value("context", &[Some(9), Some(3)]), "float32 [9, 3]"),
        (|b| b.graph().input[1] = value("target", &[None]), "float32 [any number]"),
        (|b| b.graph().input[0].r#type = None, "input `context`: no tensor of unknown shape"),
        (|b| b.graph().output[0] = value("probability", &[None, None]), "[any number, any number]"),
        (|b| b.graph().input.push(value("goal", &[Some(2)])), "context, target, goal"),
        (|b| b.graph().output.push(value("logits", &[None])), "probability, logits"),
        (|b| b.graph().output[0].name = "logits".into(), "outputs: logits"),
        (
            |b| {
                b.graph().output.push(value("familiarity", &[None, Some(2)]));
                let logits = b.clone().node("Neg", &["logits"], "familiarity");
                *b = logits;
            },
            "one value or one for each",
        ),
        (
            |b| {
                let Some(kind) = &mut b.graph().input[0].r#type else { return };
                let Some(tract_onnx::pb::type_proto::Value::TensorType(t)) = &mut kind.value else {
                    return;
                };
                t.elem_type = tract_onnx::pb::tensor_proto::DataType::Double as i32;
            },
            "double [any number, 3]",
        ),
    ];
    for (change, wanted) in cases {
        let mut build = plane("representation");
        change(&mut build);
        let error = refusal(&build);
        assert!(error.contains(wanted) && error.contains("wanted is"), "{wanted}: {error}");
    }
}

#[test]
fn files_that_are_no_networks_are_refused() {
    let load = |bytes: &[u8]| {
        let runtime = Runtime::choose("").unwrap();
        Network::load(bytes, runtime).err().map(|error| error.to_string()).unwrap_or_default()
    };
    assert!(load(b"").contains("no graph"));
    assert!(load(b"%PDF-1.7 and so on").contains("no intact ONNX file"));
    let mut no_opset = plane("representation");
    no_opset.0.opset_import.clear();
    assert!(refusal(&no_opset).contains("operator set"));
    let undefined = plane("representation").node("Relu", &["nowhere"], "more");
    assert!(refusal(&undefined).contains("\"nowhere\", which nothing before it makes"));
    let twice = plane("representation").node("Relu", &["logits"], "mean");
    assert!(refusal(&twice).contains("\"mean\" is made twice"));
    let mut missing = plane("representation");
    missing.graph().node.pop();
    assert!(refusal(&missing).contains("nothing makes output \"probability\""));
    let short = plane("representation").floats("weights", &[7, 9], &[1.0; 10]);
    assert!(refusal(&short).contains("\"weights\" of shape [7, 9] holds 10 values"));
    let mut external = plane("representation");
    let location = tract_onnx::pb::tensor_proto::DataLocation::External as i32;
    external.graph().initializer[0].data_location = Some(location);
    assert!(refusal(&external).contains("\"label\" lies in another file"));
}

#[test]
fn what_the_runtime_cannot_run_is_refused_before_the_drive() {
    let unknown = plane_logits("representation").node("Zauberei", &["logits"], "probability");
    let error = refusal(&unknown);
    assert!(error.contains("tract (built in) does not run it"), "{error}");
    // Two answers for each target.
    let two = plane_logits("representation")
        .node("Concat", &["logits", "logits"], "probability")
        .with("axis", &[0], true);
    let error = refusal(&two);
    assert!(error.contains("4 probabilities for 2 targets"), "{error}");
}

#[test]
fn a_cut_off_file_is_refused_at_any_length() {
    let bytes = plane("representation").bytes();
    let runtime = Runtime::choose("").unwrap();
    for length in 0..bytes.len() {
        let cut = Network::load(&bytes[..length], runtime);
        // The last entries are metadata, all of which are needed.
        assert!(cut.is_err(), "{length} of {} bytes", bytes.len());
    }
}

#[test]
fn a_damaged_file_never_brings_the_program_down() {
    let bytes = plane("representation").bytes();
    let runtime = Runtime::choose("").unwrap();
    for at in 0..bytes.len() {
        for flip in [0x01, 0x10, 0xff] {
            let mut damaged = bytes.clone();
            damaged[at] ^= flip;
            if let Ok(mut network) = Network::load(&damaged, runtime) {
                let mut answers = Answers::default();
                let _ = network.encode(CONTEXT);
                let _ = network.decode(TARGETS, &mut answers);
            }
        }
    }
}

#[test]
fn any_answer_is_passed_on_as_it_is() {
    for answer in [f32::NAN, -3.0, f32::INFINITY, 0.25] {
        let mut network = constant(answer).load().unwrap();
        assert!(network.asks_all_at_once());
        let given = answers(&mut network, CONTEXT, TARGETS);
        assert!(given.iter().all(|p| p.to_bits() == answer.to_bits()), "{answer}: {given:?}");
    }
}
