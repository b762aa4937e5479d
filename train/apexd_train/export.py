"""A checkpoint to one ONNX file, checked against the weights it came from.

    python -m apexd_train.export CHECKPOINT FILE.onnx [--range 7.5] [--world thin]

Inputs `context` [C, 3] and `target` [T, 2], output `probability` [T]; the inner tensor
`representation` separates what follows from the context alone from what also needs targets.
"""

from __future__ import annotations

import argparse
import copy
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from .models import ModelConfig, build
from .trust import Familiarity

OPSET = 13
CHECKED_SIZES = ((0, 3), (1, 1), (93, 2669), (434, 2669), (4000, 17), (7, 10816))
TOLERANCE = 1e-5


class Encoder(nn.Module):
    """Context to representation, and to the familiarity [1] when statistics for it are given."""

    def __init__(self, model: nn.Module, familiarity: nn.Module | None):
        super().__init__()
        self.model, self.familiarity = model, familiarity

    def forward(self, context: Tensor):
        if self.familiarity is None:
            return self.model.encode(context)
        features = self.model.features(self.model.grid_of(context), self.model.worlds(1, context.device))
        return self.model.bordered(self.model.head_on(*features)), self.familiarity(features)


class Decoder(nn.Module):
    def __init__(self, model: nn.Module):
        super().__init__()
        self.model = model

    def forward(self, representation: Tensor, target: Tensor) -> Tensor:
        return torch.sigmoid(self.model.decode(representation, target))


def folded(model: nn.Module) -> nn.Module:
    """A copy in which every batch norm is part of the convolution before it."""
    model = copy.deepcopy(model).eval()  # keeps the kind of world
    for module in list(model.modules()):
        if isinstance(module, nn.Sequential) and len(module) == 2 and isinstance(module[1], nn.BatchNorm2d):
            module[0] = fuse_conv_bn_eval(module[0], module[1])
            del module[1]
    return model


def trace(module: nn.Module, inputs: tuple, names: list[str], outputs: list[str], dynamic: dict, prefix: str):
    import io

    import onnx
    import onnx.compose

    file = io.BytesIO()
    # The tracing exporter; newer versions of torch have another by default.
    legacy = {} if torch.__version__.startswith("1.") else {"dynamo": False}
    torch.onnx.export(module, inputs, file, input_names=names, output_names=outputs, dynamic_axes=dynamic,
                      opset_version=OPSET, do_constant_folding=True, **legacy)
    graph = onnx.load_from_string(file.getvalue())
    graph = onnx.compose.add_prefix(graph, prefix)
    # Everything inside keeps the prefix; the interface gets its plain names.
    for old in [*names, *outputs]:
        rename(graph.graph, prefix + old, old)
    return graph


def rename(graph, old: str, new: str) -> None:
    """Renames one value of a GraphProto."""
    for value in [*graph.input, *graph.output, *graph.value_info]:
        if value.name == old:
            value.name = new
    for node in graph.node:
        node.input[:] = [new if name == old else name for name in node.input]
        node.output[:] = [new if name == old else name for name in node.output]


def to_onnx(model: nn.Module, metadata: dict[str, str], familiarity: nn.Module | None = None):
    """The ModelProto of a module (evaluation mode), with metadata_props."""
    import onnx
    import onnx.compose

    model = folded(model)
    context, target = example(model.config, 50, 20)
    with torch.no_grad():
        representation = model.encode(context)
    outputs = ["representation"] + (["familiarity"] if familiarity is not None else [])
    encoder = trace(Encoder(model, familiarity), (context,), ["context"], outputs, {"context": {0: "C"}}, "c/")
    decoder = trace(Decoder(model), (representation, target), ["representation", "target"], ["probability"],
                    {"target": {0: "T"}, "probability": {0: "T"}}, "t/")
    merged = onnx.compose.merge_models(encoder, decoder, io_map=[("representation", "representation")])
    # Probability first, whatever the order of merging.
    ordered = sorted(merged.graph.output, key=lambda value: value.name != "probability")
    del merged.graph.output[:]
    merged.graph.output.extend(ordered)
    merged.ir_version = 8
    merged.producer_name = "apexd"
    merged.graph.name = model.config.architecture
    onnx.helper.set_model_props(merged, metadata)
    onnx.checker.check_model(merged)
    return merged


def example(config: ModelConfig, points: int, targets: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Random distinct observed cells and random targets, some of them off the crop."""
    rng = np.random.default_rng(seed)
    side, r = config.crop_cells, config.resolution_m
    flat = rng.choice(side * side, min(points, side * side), replace=False)
    x, y = (flat % side - side // 2 + 0.5) * r, (flat // side - side // 2 + 0.5) * r
    context = np.stack([x, y, rng.integers(0, 2, len(flat))], 1).astype(np.float32)
    target = rng.uniform(-0.55 * side * r, 0.55 * side * r, (targets, 2)).astype(np.float32)
    return torch.from_numpy(context), torch.from_numpy(target)


def runner(proto):
    """A function (context, target) -> outputs: onnxruntime, or onnx's numpy reference without it."""
    try:
        import onnxruntime
    except ImportError:
        from onnx.reference import ReferenceEvaluator

        reference = ReferenceEvaluator(proto)
        return lambda c, t: reference.run(None, {"context": c, "target": t})
    session = onnxruntime.InferenceSession(proto.SerializeToString(), providers=["CPUExecutionProvider"])
    return lambda c, t: session.run(None, {"context": c, "target": t})


def check(model: nn.Module, proto, familiarity: nn.Module | None = None) -> float:
    """Largest difference between the file and the weights over several numbers of points."""
    encode, run, worst = Encoder(model, familiarity), runner(proto), 0.0
    for seed, (points, targets) in enumerate(CHECKED_SIZES):
        context, target = example(model.config, points, targets, seed)
        with torch.no_grad():
            encoded = encode(context)
            representation, *rest = encoded if familiarity is not None else (encoded,)
            expected = [torch.sigmoid(model.decode(representation, target)), *rest]
        for got, want in zip(run(context.numpy(), target.numpy()), expected, strict=True):
            if got.shape != tuple(want.shape):
                raise ValueError(f"C = {points}, T = {targets}: shape {got.shape}, not {tuple(want.shape)}")
            worst = max(worst, float(np.abs(got - want.numpy()).max()))
    return worst


def metadata_of(state: dict, range_m: float | None) -> dict[str, str]:
    config, args = ModelConfig(**state["config"]), state["args"]
    training = {
        "iterations": state["iteration"], "scenes": state["iteration"] * args["batch"],
        "seconds": round(state["seconds"]), "cpu_seconds": round(state["cpu_seconds"]),
        "device": args["device"], "dataset_scenes": sum(d["scenes"] for d in state["data"]),
        "loss_radius_m": args["radius"], "precision": args["precision"], "batch": args["batch"],
        "before": [{k: round(v) for k, v in b.items() if k != "data"} for b in state.get("before", [])],
    }
    return {
        "format_version": "1", "architecture": config.architecture, "frame": "robot-cell",
        "resolution_m": f"{config.resolution_m:g}", "crop_cells": str(config.crop_cells),
        "lidar_range_m": ",".join(f"{x:g}" for x in state["lidar_m"]),
        "prediction_range_m": f"{range_m or args['radius']:g}", "context": config.context(),
        "trained_on": ",".join(d["sha256"] for d in state["data"]),
        "training": json.dumps(training), "calibration": "{}",
    }


WORLD_NAMES = ("unknown", "thin", "solid", "branching", "map")


def export(checkpoint: Path, file: Path, range_m: float | None = None, world: int = 0) -> float:
    """Writes `file`; returns the largest difference to the weights.

    Takes calibration.json and familiarity.pt (see trust.py) from the checkpoint's folder, if there.
    """
    state = torch.load(checkpoint, map_location="cpu", weights_only=False)
    model = build(ModelConfig(**state["config"]))
    model.load_state_dict(state["ema"])
    model.eval()
    model.world = world
    metadata = metadata_of(state, range_m)
    metadata["world"] = WORLD_NAMES[world]
    calibration, statistics = (checkpoint.parent / name for name in ("calibration.json", "familiarity.pt"))
    familiarity = None
    if statistics.exists():
        saved = torch.load(statistics, map_location="cpu", weights_only=False)[world]
        familiarity = Familiarity(len(saved["mean"]))
        familiarity.load_state_dict(saved)
    if calibration.exists():
        metadata["calibration"] = json.dumps(json.loads(calibration.read_text())[str(world)])
    proto = to_onnx(model, metadata, familiarity)
    worst = check(model, proto, familiarity)
    if not worst <= TOLERANCE:
        raise ValueError(f"{file}: differs from the weights by {worst:.2g}, more than {TOLERANCE:g}")
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_bytes(proto.SerializeToString())
    partial.replace(file)
    print(f"{file}: {file.stat().st_size} bytes, within {worst:.1e} of the weights", flush=True)
    return worst


def record(checkpoint: Path, world: int, data: Path, folder: Path, scenes: int = 4, targets: int = 500) -> None:
    """Scenes with the weights' own answers, for tests of other runtimes, as .npy files.

    context.npy float32 [sum of C, 3] and count.npy int64 [n] (C of each scene), target.npy float32
    [T, 2] (some off the crop), probability.npy float32 [n, T].
    """
    from .data import Scenes
    from .models import context_of
    from .train import load_model

    model, source = load_model(checkpoint), Scenes(data)
    model.world = world
    contexts, answers = [], []
    _, target = example(model.config, 1, targets, seed=7)
    for k in np.linspace(0, len(source) - 1, scenes).astype(int):
        context, mask = context_of(source.observed[k:k + 1], model.config.context(), 0, model.config.resolution_m)
        contexts.append(context[0][mask[0]])
        with torch.no_grad():
            answers.append(torch.sigmoid(model.decode(model.encode(contexts[-1]), target)))
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "context.npy", torch.cat(contexts).numpy())
    np.save(folder / "count.npy", np.array([len(c) for c in contexts], np.int64))
    np.save(folder / "target.npy", target.numpy())
    np.save(folder / "probability.npy", torch.stack(answers).numpy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("file", type=Path)
    parser.add_argument("--range", type=float, help="prediction range to declare, m (default: the loss radius)")
    parser.add_argument("--world", choices=WORLD_NAMES, default="unknown", help="kind of world to answer for")
    parser.add_argument("--record", nargs=2, type=Path, metavar=("DATA", "FOLDER"),
                        help="also write a few scenes of DATA with the answers to FOLDER")
    args = parser.parse_args()
    world = WORLD_NAMES.index(args.world)
    export(args.checkpoint, args.file, args.range, world)
    if args.record:
        record(args.checkpoint, world, *args.record)


if __name__ == "__main__":
    main()
