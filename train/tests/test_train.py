"""Tests on small synthetic scenes: no dataset needed, a few seconds in all."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from apexd_train import data, export, score, trust
from apexd_train.models import ModelConfig, build, context_of, depth_to_space, space_to_depth
from apexd_train.optimiser import orthogonal
from apexd_train.train import load_model, parser, train

SIDE = 16


def write_scenes(folder: Path, count: int = 40, seed: int = 0, source: int = 5) -> Path:
    """Corridors along x at a random row: observed near the robot, walls on both sides."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    truth = np.zeros((count, SIDE, SIDE), np.uint8)
    for k in range(count):
        truth[k, rng.integers(4, 7)] = truth[k, rng.integers(10, 13)] = 1
    truth[:, :, -1] = 255
    observed = np.zeros_like(truth)
    observed[:, :, 5:11] = truth[:, :, 5:11] + 1
    frontier = np.full((count, 8, 2), np.nan, np.float32)
    frontier[:, 0] = (0.625, 0.125)
    np.save(folder / "observed.npy", observed)
    np.save(folder / "truth.npy", truth)
    np.save(folder / "frontier.npy", frontier)
    np.save(folder / "source.npy", np.full(count, source, np.int64))
    np.save(folder / "family.npy", np.zeros(count, np.uint8))
    np.save(folder / "kind.npy", np.zeros(count, np.uint8))
    np.save(folder / "lidar.npy", np.full(count, 5.0, np.float32))
    manifest = {"format_version": 1, "resolution_m": 0.25, "crop_cells": SIDE}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


def options(folder: Path, out: Path, *more: str):
    common = ["--data", str(folder), "--out", str(out), "--device", "cpu", "--batch", "4", "--log-every", "5",
              "--channels", "8", "8", "8", "--bottom-blocks", "1", "--warmup", "2"]
    return parser().parse_args([*common, *more])


@pytest.mark.parametrize("architecture", ["literal", "setcnp", "convcnp", "unet"])
def test_the_exported_file_answers_as_the_weights_do_at_any_number_of_points(architecture):
    torch.manual_seed(1)
    model = build(ModelConfig(architecture)).eval()
    for module in model.modules():  # norms that do something, so that folding is tested
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.normal_(module.weight)
            torch.nn.init.uniform_(module.running_var, 0.5, 2.0)
            torch.nn.init.normal_(module.running_mean)
    proto = export.to_onnx(model, {"format_version": "1"})
    assert export.check(model, proto) <= export.TOLERANCE
    made = [name for node in proto.graph.node for name in node.output]
    assert "representation" in made
    # What makes the representation needs no target; what follows needs no context.
    before = made.index("representation")
    assert all("target" not in node.input for node in proto.graph.node[: before + 1])
    assert all("context" not in node.input for node in proto.graph.node[before + 1 :])


def test_familiarity_is_exported_and_high_where_the_statistics_come_from():
    torch.manual_seed(4)
    model = build(ModelConfig("convcnp", SIDE, channels=(8, 8, 16), bottom_blocks=1)).eval()
    rng = torch.Generator().manual_seed(1)
    corridors = torch.zeros(200, SIDE, SIDE, dtype=torch.uint8)
    for k, row in enumerate(torch.randint(2, 8, (200,), generator=rng)):
        corridors[k, row:row + 6, 4:12] = 1
        corridors[k, row, 4:12] = corridors[k, row + 5, 4:12] = 2
    noise = torch.randint(0, 3, (20, SIDE, SIDE), generator=rng).to(torch.uint8)
    familiarity = trust.Familiarity.fit(trust.pooled_features(model, corridors, 0))
    like = familiarity.score(trust.pooled_features(model, corridors, 0))
    unlike = familiarity.score(trust.pooled_features(model, noise, 0))
    assert like.median() > 0.9 and unlike.max() < 0.1
    proto = export.to_onnx(model, {"format_version": "1"}, familiarity)
    assert [output.name for output in proto.graph.output] == ["probability", "familiarity"]
    assert export.check(model, proto, familiarity) <= export.TOLERANCE


def test_a_world_told_changes_the_answer_and_is_a_constant_of_the_file():
    torch.manual_seed(5)
    model = build(ModelConfig("convcnp", SIDE, channels=(8, 8, 8), bottom_blocks=1)).eval()
    torch.nn.init.normal_(model.world0.weight)
    context, target = export.example(model.config, 30, 40)
    answers = []
    for world in (0, 2):
        model.world = world
        proto = export.to_onnx(model, {"format_version": "1"})
        assert export.check(model, proto) <= export.TOLERANCE
        answers.append(export.runner(proto)(context.numpy(), target.numpy())[0])
    assert np.abs(answers[0] - answers[1]).max() > 1e-3


def test_export_and_training_path_agree_on_a_scene(tmp_path):
    scenes = data.Scenes(write_scenes(tmp_path / "d"))
    for architecture in ("literal", "setcnp", "convcnp"):
        torch.manual_seed(2)
        model = build(ModelConfig(architecture, SIDE)).eval()
        observed = scenes.observed[:1]
        context, mask = context_of(observed, model.config.context(), 0, 0.25)
        axis = (torch.arange(SIDE) - SIDE // 2 + 0.5) * 0.25
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        target = torch.stack([x.reshape(-1), y.reshape(-1)], 1)
        with torch.no_grad():
            whole = model.logits(observed)[0]
            points = model.decode(model.encode(context[0][mask[0]]), target)
        assert torch.allclose(whole, points, atol=1e-4)


def test_padding_of_the_context_changes_nothing():
    torch.manual_seed(3)
    model = build(ModelConfig("setcnp", SIDE)).eval()
    observed = torch.zeros(2, SIDE, SIDE, dtype=torch.uint8)
    observed[0, 4:9, 4:9] = 1
    observed[0, 4, 4:9] = 2
    observed[1, 2:14, 2:14] = 1
    observed[1, 2, 2:14] = 2
    with torch.no_grad():
        together = model.logits(observed)
        alone = torch.cat([model.logits(observed[:1]), model.logits(observed[1:])])
    assert torch.allclose(together, alone, atol=1e-5)


def test_the_eight_symmetries_turn_cells_and_points_alike():
    index = data.symmetries(SIDE)
    for element in range(8):
        cells = torch.zeros(1, SIDE, SIDE, dtype=torch.uint8)
        cells[0, 9, 11] = 1  # row 9, column 11
        turned = data.apply_symmetry(cells, index[element][None], 0)
        point = torch.tensor([[[(11 - 8 + 0.5) * 0.25, (9 - 8 + 0.5) * 0.25]]])
        moved = data.turn_points(point, torch.tensor([element]), 0.25)[0, 0]
        i, j = (torch.floor(moved / 0.25).long() + 8).tolist()
        assert turned.sum() == 1 and turned[0, j, i] == 1
    assert len({tuple(row.tolist()) for row in index}) == 8


def test_symmetries_fill_what_lies_off_the_crop_with_no_target(tmp_path):
    truth = torch.zeros(1, SIDE, SIDE, dtype=torch.uint8)
    turned = data.apply_symmetry(truth, data.symmetries(SIDE)[1][None], 255)
    assert (turned[0, :, 0] == 255).all() and (turned[0, :, 1:] == 0).all()


def test_only_unobserved_cells_with_a_truth_near_the_frontier_count(tmp_path):
    scenes = data.Scenes(write_scenes(tmp_path / "d"))
    distance = data.frontier_distance(scenes.frontier[:3], SIDE, 0.25)
    weight = data.target_weights(scenes.observed[:3], scenes.truth[:3], distance, 1.0).reshape(3, SIDE, SIDE)
    assert (weight[scenes.observed[:3] > 0] == 0).all() and (weight[scenes.truth[:3] == 255] == 0).all()
    assert (weight.reshape(3, -1)[distance > 1.0] == 0).all() and weight.sum() > 0
    nothing = data.frontier_distance(torch.full((1, 8, 2), float("nan")), SIDE, 0.25)
    assert torch.isinf(nothing).all()


def test_held_out_scenes_are_refused_for_training(tmp_path):
    folder = write_scenes(tmp_path / "d", source=data.HELD_OUT_SEED)
    with pytest.raises(data.HeldOutError, match="held-out"):
        train(options(folder, tmp_path / "run", "--iterations", "1"))
    marked = write_scenes(tmp_path / "marked")
    (marked / "manifest.json").write_text('{"resolution_m": 0.25, "held_out": true}')
    with pytest.raises(data.HeldOutError):
        data.Scenes(marked).refuse_held_out()


@pytest.mark.parametrize("optimiser", ["adamw", "muon"])
def test_a_resumed_run_ends_with_the_same_weights_as_one_without_a_stop(tmp_path, optimiser):
    folder = write_scenes(tmp_path / "d")
    more = ["--optimiser", optimiser, "--ema", "0.9"]
    whole = train(options(folder, tmp_path / "whole", "--iterations", "8", *more))
    stopped = train(options(folder, tmp_path / "parts", "--iterations", "8", "--pause-at", "4", *more))
    assert stopped.iteration == 4
    resumed = train(options(folder, tmp_path / "parts", "--iterations", "8", *more))
    assert resumed.iteration == 8
    for key, value in whole.ema.state.items():
        assert torch.equal(value, resumed.ema.state[key]), key


def test_training_learns_and_exports_in_one_command(tmp_path):
    folder = write_scenes(tmp_path / "d", 64)
    file = tmp_path / "cnp.onnx"
    run = train(options(folder, tmp_path / "run", "--iterations", "150", "--lr", "1e-2", "--export", str(file)))
    assert run.history[-1]["loss"] < 0.6 * run.history[0]["loss"]
    assert (tmp_path / "run" / "log.csv").exists()
    scenes = data.Scenes(folder)
    pick = np.arange(16)
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(file))
    meta = session.get_modelmeta().custom_metadata_map
    assert meta["format_version"] == "1" and meta["frame"] == "robot-cell" and meta["trained_on"] == scenes.sha256
    by_file = score.score(session, scenes, pick, with_edges=False)
    by_weights = score.score(load_model(tmp_path / "run" / "last.pt"), scenes, pick, with_edges=False)
    assert abs(by_file["R5"]["log_loss"] - by_weights["R5"]["log_loss"]) < 1e-4


def test_scores_of_known_answers():
    y = np.array([1, 1, 0, 0], bool)
    assert score.auc(np.array([0.9, 0.8, 0.2, 0.1]), y) == 1.0
    assert score.auc(np.array([0.5, 0.5, 0.5, 0.5]), y) == 0.5
    assert score.log_loss(np.array([0.5] * 4), y) == pytest.approx(np.log(2))
    assert score.calibration_error(np.array([0.5] * 4), y) == 0.0
    assert score.calibration_error(np.array([0.9] * 4), y) == pytest.approx(0.4)


def test_orthogonal_step_has_singular_values_near_one():
    torch.manual_seed(0)
    singular = torch.linalg.svdvals(orthogonal(torch.randn(24, 90)).float())
    assert singular.min() > 0.5 and singular.max() < 1.5


def test_space_to_depth_and_back():
    x = torch.randn(2, 3, 8, 12)
    assert torch.equal(depth_to_space(space_to_depth(x)), x)
