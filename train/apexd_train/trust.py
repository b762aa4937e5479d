"""How far to trust a prediction: calibration by distance, and a signal for contexts unlike the training's.

    python -m apexd_train.trust RUN/last.pt --calibrate DIR --fit DIR [DIR ...] --like DIR ... --unlike DIR ...

Writes RUN/calibration.json (temperatures by distance from the frontier, fitted on scenes of training
seeds that the network has not seen) and RUN/familiarity.pt (statistics of pooled features), both
for the unknown kind of world (key 0) and for each known one (key 1 + family), and prints how well two
signals tell `--like` from `--unlike` scenes for the kind `--world`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from .data import Scenes, frontier_distance
from .score import DISTANCE_BINS_M, auc, calibration_error, choose, log_loss, predict
from .train import load_model


def pooled(features: tuple[Tensor, ...]) -> Tensor:
    """Means over the grid of the two coarser levels' features: [B, c1 + c2]."""
    return torch.cat([level.mean((2, 3)) for level in features[1:]], 1)


class Familiarity(nn.Module):
    """1 for contexts like those of the training, 0 for others, 0.5 at the 99th percentile of the former.

    A sigmoid of log d^2, with d the Mahalanobis distance of the pooled features from the training's,
    by way of all principal components of the standardised features.
    """

    FLOOR = 1e-5  # of the largest variance: keeps noise in idle directions from counting

    def __init__(self, inputs: int):
        super().__init__()
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("whiten", torch.zeros(inputs, inputs))
        self.register_buffer("threshold", torch.zeros(()))
        self.register_buffer("width", torch.ones(()))

    def log_distance(self, x: Tensor) -> Tensor:
        """Of pooled features [B, inputs]."""
        z = (x - self.mean) @ self.whiten
        return torch.log((z * z).mean(1) + 1e-6)

    def score(self, x: Tensor) -> Tensor:
        return torch.sigmoid((self.threshold - self.log_distance(x)) / self.width)

    def forward(self, features: tuple[Tensor, ...]) -> Tensor:
        return self.score(pooled(features))

    @staticmethod
    def fit(x: Tensor) -> "Familiarity":
        """From pooled features [N, inputs] of training scenes."""
        out = Familiarity(x.shape[1])
        out.mean.copy_(x.mean(0))
        spread = x.std(0) + 1e-4
        scaled = ((x - out.mean) / spread).double()
        values, vectors = torch.linalg.eigh(scaled.T @ scaled / len(scaled))
        whiten = vectors / (values.clamp(min=0.0) + Familiarity.FLOOR * values[-1]).sqrt()
        out.whiten.copy_((whiten / spread[:, None]).float())
        s = out.log_distance(x)
        half, tail = torch.quantile(s, 0.5), torch.quantile(s, 0.99)
        out.threshold.copy_(tail)
        out.width.copy_((tail - half) / 3.0)
        return out


def pooled_features(model: nn.Module, observed: Tensor, world: int, batch: int = 32) -> Tensor:
    """Pooled features of scenes [N, S, S] for a kind of world: [N, 2 c]."""
    out, model.world = [], world
    with torch.no_grad():
        for part in observed.split(batch):
            grid = torch.stack([part > 0, part == 2], 1).float()
            out.append(pooled(model.features(grid, model.worlds(len(grid), grid.device))))
    return torch.cat(out)


def calibration(model: nn.Module, scenes: Scenes, pick: np.ndarray, world: int) -> dict:
    """Temperatures by distance from the nearest frontier cluster: logit / temperature is calibrated."""
    index = torch.from_numpy(pick)
    observed, truth = scenes.observed[index], scenes.truth[index]
    distance = frontier_distance(scenes.frontier[index], scenes.side, scenes.resolution_m)
    distance = distance.reshape(observed.shape).numpy()
    p = np.clip(predict(model, observed, world=world).astype(np.float64), 1e-6, 1 - 1e-6)
    logit = np.log(p / (1 - p))
    target, y = ((observed == 0) & (truth != 255)).numpy(), (truth == 1).numpy()
    out = {"distance": "nearest frontier cluster", "edges_m": list(DISTANCE_BINS_M), "temperature": [],
           "log_loss": [], "log_loss_after": [], "ece": [], "cells": []}
    for low, high in zip(DISTANCE_BINS_M, DISTANCE_BINS_M[1:]):
        mask = target & (distance >= low) & (distance < high)
        z, label = logit[mask], y[mask]
        tried = np.geomspace(0.6, 1.7, 41)
        losses = [log_loss(1 / (1 + np.exp(-z / t)), label) for t in tried] if len(z) else [0.0] * 41
        best = int(np.argmin(losses))
        out["temperature"].append(round(float(tried[best]) if len(z) > 1000 else 1.0, 3))
        out["log_loss"].append(round(log_loss(p[mask], label), 5) if len(z) else None)
        out["log_loss_after"].append(round(float(losses[best]), 5) if len(z) else None)
        out["ece"].append(round(calibration_error(p[mask], label), 5) if len(z) else None)
        out["cells"].append(int(mask.sum()))
    return out


def disagreement(first: nn.Module, second: nn.Module, scenes: Scenes, pick: np.ndarray,
                 world: int) -> np.ndarray:
    """Mean |p - q| of two networks over unobserved cells within 7.5 m of the frontier, per scene."""
    index = torch.from_numpy(pick)
    observed = scenes.observed[index]
    distance = frontier_distance(scenes.frontier[index], scenes.side, scenes.resolution_m)
    mask = ((observed == 0) & (distance.reshape(observed.shape) <= 7.5)).numpy()
    gap = np.abs(predict(first, observed, world=world) - predict(second, observed, world=world)) * mask
    return gap.sum((1, 2)) / np.maximum(mask.sum((1, 2)), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--calibrate", required=True, help="folder of unseen training-range scenes")
    parser.add_argument("--fit", nargs="+", required=True, help="training folders, for the statistics")
    parser.add_argument("--like", nargs="*", default=[])
    parser.add_argument("--unlike", nargs="*", default=[])
    parser.add_argument("--second", type=Path, help="another checkpoint, for the disagreement of two networks")
    parser.add_argument("--world", type=int, default=0, help="kind of world: 0 unknown, 1 + family")
    parser.add_argument("--scenes", type=int, default=400)
    args = parser.parse_args()
    model = load_model(args.checkpoint)
    out = args.checkpoint.parent
    scenes = Scenes(args.calibrate)
    training = [Scenes(folder) for folder in args.fit]
    for folder in training:
        folder.refuse_held_out()
    temperatures, statistics = {}, {}
    for family in [None, *sorted(set(scenes.family.tolist()))]:
        world = 0 if family is None else family + 1
        pick = choose(scenes, args.scenes, family, None, None)
        temperatures[world] = calibration(model, scenes, pick, world)
        print(json.dumps({"world": world, **temperatures[world]}))
        features = [pooled_features(model, t.observed[choose(t, 1000, family, None, None)], world)
                    for t in training if family is None or (t.family == family).any()]
        statistics[world] = Familiarity.fit(torch.cat(features))
    (out / "calibration.json").write_text(json.dumps(temperatures))
    torch.save({world: f.state_dict() for world, f in statistics.items()}, out / "familiarity.pt")
    familiarity = statistics[args.world]
    second = load_model(args.second) if args.second else None
    values: dict[str, list] = {"like": [], "unlike": []}
    for group, folders in (("like", args.like), ("unlike", args.unlike)):
        for folder in folders:
            scenes = Scenes(folder)
            known = args.world - 1 if group == "like" and args.world else None
            pick = choose(scenes, args.scenes, known, None, None)
            x = pooled_features(model, scenes.observed[pick], args.world)
            s, f = familiarity.log_distance(x), familiarity.score(x)
            d = disagreement(model, second, scenes, pick, args.world) if second is not None else np.zeros(len(pick))
            values[group].append((folder, s.numpy(), d))
            print(json.dumps({"folder": folder, "group": group, "familiarity": [
                round(float(q), 3) for q in np.quantile(f.numpy(), [0.05, 0.5, 0.95])],
                "disagreement": round(float(d.mean()), 4)}))
    for like in values["like"]:
        for unlike in values["unlike"]:
            y = np.r_[np.zeros(len(like[1]), bool), np.ones(len(unlike[1]), bool)]
            print(json.dumps({"like": like[0], "unlike": unlike[0],
                              "auroc_features": auc(np.r_[like[1], unlike[1]], y),
                              "auroc_disagreement": auc(np.r_[like[2], unlike[2]], y)}))


if __name__ == "__main__":
    main()
