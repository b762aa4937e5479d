"""Held-out scores: log loss, accuracy, AUC, calibration error, and the edge metric.

    python -m apexd_train.score CHECKPOINT_OR_ONNX DATA [--scenes 600] [--lidar 5] [--family 0] [--kind 0]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from .data import Scenes, frontier_distance
from .models import frontier_cells

HALLWAY_M = 2.5
DISTANCE_BINS_M = (0.0, 0.5, 1.25, 2.5, 5.0, 7.5)


def log_loss(p: np.ndarray, y: np.ndarray) -> float:
    p = np.clip(p.astype(np.float64), 1e-6, 1 - 1e-6)
    return float(-np.mean(np.where(y, np.log(p), np.log1p(-p))))


def auc(p: np.ndarray, y: np.ndarray) -> float:
    """Area under the ROC curve, ties counted half."""
    if y.all() or not y.any():
        return float("nan")
    values, inverse, counts = np.unique(p, return_inverse=True, return_counts=True)
    rank = np.cumsum(counts) - (counts - 1) / 2.0
    positive = int(y.sum())
    total = rank[inverse][y].sum() - positive * (positive + 1) / 2.0
    return float(total / (positive * (len(y) - positive)))


def calibration_error(p: np.ndarray, y: np.ndarray, bins: int = 15) -> float:
    """Expected calibration error over equal bins of probability."""
    slot = np.minimum((p * bins).astype(int), bins - 1)
    gap = np.bincount(slot, weights=p.astype(np.float64) - y, minlength=bins)
    return float(np.abs(gap).sum() / len(p))


def summary(p: np.ndarray, y: np.ndarray) -> dict:
    y = y.astype(bool)
    return {
        "cells": int(len(y)), "occupied": float(y.mean()), "log_loss": log_loss(p, y),
        "accuracy": float(((p > 0.5) == y).mean()), "auc": auc(p, y), "ece": calibration_error(p, y),
    }


def predict(model, observed: torch.Tensor, batch: int = 32, world: int | None = None) -> np.ndarray:
    """Probability of every cell: float32 [N, S, S]. `model` is a module or an onnxruntime session.

    `world`: the kind of world the module is told, by default the unknown.
    """
    out = []
    if not isinstance(model, torch.nn.Module):
        return predict_onnx(model, observed.cpu().numpy())
    model.eval()
    model.world = world or 0
    with torch.no_grad():
        for part in observed.split(batch):
            logits = [model.logits(part)] if hasattr(model, "network") else [
                model.logits(one[None]) for one in part]
            out.append(torch.sigmoid(torch.cat(logits)).cpu().numpy())
    side = observed.shape[1]
    return np.concatenate(out).reshape(-1, side, side)


def predict_onnx(session, observed: np.ndarray) -> np.ndarray:
    meta = session.get_modelmeta().custom_metadata_map
    r, side = float(meta["resolution_m"]), observed.shape[1]
    axis = ((np.arange(side) - side // 2 + 0.5) * r).astype(np.float32)
    grid = np.stack(np.meshgrid(axis, axis), -1)
    chosen = observed > 0
    if meta["context"] == "walls-and-frontier":
        chosen = (observed == 2) | frontier_cells(torch.from_numpy(observed)).numpy()
    out = []
    for scene, mask in zip(observed, chosen):
        label = (scene[mask] == 2).astype(np.float32)
        context = np.concatenate([grid[mask], label[:, None]], 1)
        p = session.run(["probability"], {"context": context, "target": grid.reshape(-1, 2)})[0]
        out.append(p.reshape(side, side))
    return np.stack(out)


def geodesic_m(observed: np.ndarray, truth: np.ndarray, limit_m: float, resolution_m: float) -> np.ndarray:
    """Distance (m) from the frontier through free unobserved cells, inf beyond `limit_m`: [N, S, S]."""
    frontier = frontier_cells(torch.from_numpy(observed)).numpy()
    open_ = (observed == 0) & (truth == 0)
    d = np.where(frontier, 0.0, np.inf).astype(np.float32)
    steps = [(dy, dx, np.float32(np.hypot(dy, dx) * resolution_m))
             for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
    for _ in range(int(np.ceil(limit_m / resolution_m)) + 1):
        padded = np.pad(d, ((0, 0), (1, 1), (1, 1)), constant_values=np.inf)
        height, width = d.shape[1:]
        best = d
        for dy, dx, cost in steps:
            best = np.minimum(best, padded[:, 1 + dy:1 + dy + height, 1 + dx:1 + dx + width] + cost)
        d = np.where(open_, best, d)
    return np.where(d <= limit_m, d, np.inf)


def edges(p: np.ndarray, observed: np.ndarray, truth: np.ndarray, distance_m: np.ndarray,
          resolution_m: float, near_m: float = 2.5) -> dict:
    """The edge metric: are the unseen walls within `near_m` of the frontier there or not?

    An edge is a lattice edge of the maze whose wall cells (posts apart) are all unobserved and
    within 5 m of a frontier cluster, and which has a free unobserved cell within `near_m` of the
    frontier, by way of free unobserved cells, beside it. Its score is the mean probability.
    """
    n = round(HALLWAY_M / resolution_m)
    geodesic = geodesic_m(observed, truth, near_m, resolution_m)
    score, closed, gap = [], [], []
    for k in range(len(p)):
        for turn in (False, True):
            t, o, q, d, g = (a[k].T if turn else a[k] for a in (truth, observed, p, distance_m, geodesic))
            # Lattice phases: where walls are densest, modulo the hallway's width.
            wall = (t == 1)
            column = int(np.argmax([wall[:, c::n].mean() for c in range(n)]))
            row = int(np.argmax([wall[c::n, :].mean() for c in range(n)]))
            for c in range(column, t.shape[1] - 1, n):
                for r0 in range(row, t.shape[0] - n, n):
                    cells = slice(r0 + 1, r0 + n)
                    truths = t[cells, c]
                    if c == 0 or (o[cells, c] != 0).any() or (truths == 255).any():
                        continue
                    # The outer wall has no target on its far side.
                    if (t[cells, c - 1] == 255).any() or (t[cells, c + 1] == 255).any():
                        continue
                    if (d[cells, c] > 5.0).any():
                        continue
                    near = min(g[cells, c - 1].min(), g[cells, c + 1].min())
                    if near <= near_m:
                        score.append(q[cells, c].mean())
                        closed.append(truths.mean() > 0.5)
                        gap.append(near)
    if not score:
        return {"edges": 0}
    score, closed = np.array(score), np.array(closed)
    bins = []
    for low, high in ((0.0, 0.5), (0.5, 1.25), (1.25, near_m + 1e-6)):
        some = (np.array(gap) >= low) & (np.array(gap) < high)
        if some.any():
            bins.append({"from_m": low, "edges": int(some.sum()), "auc": auc(score[some], closed[some]),
                         "accuracy": float(((score > 0.5) == closed)[some].mean())})
    return {"by_distance": bins, "edges": len(score), "closed": float(closed.mean()), "auc": auc(score, closed),
            "accuracy": float(((score > 0.5) == closed).mean()), "log_loss": log_loss(score, closed)}


def score(model, scenes: Scenes, pick: np.ndarray, radii_m: tuple[float, ...] = (5.0, 7.5),
          with_edges: bool = True, p: np.ndarray | None = None, world: int | None = None) -> dict:
    """All scores of the scenes `pick` (indices)."""
    index = torch.from_numpy(np.asarray(pick))
    observed, truth = scenes.observed[index], scenes.truth[index]
    distance = frontier_distance(scenes.frontier[index], scenes.side, scenes.resolution_m)
    distance = distance.reshape(observed.shape).cpu().numpy()
    p = predict(model, observed, world=world) if p is None else p
    observed, truth = observed.cpu().numpy(), truth.cpu().numpy()
    target = (observed == 0) & (truth != 255)
    out = {"scenes": len(pick)}
    for radius in radii_m:
        mask = target & (distance <= radius)
        out[f"R{radius:g}"] = summary(p[mask], truth[mask] == 1)
    out["by_distance"] = []
    for low, high in zip(DISTANCE_BINS_M, DISTANCE_BINS_M[1:]):
        mask = target & (distance >= low) & (distance < high)
        if mask.any():
            out["by_distance"].append({"from_m": low, "to_m": high, **summary(p[mask], truth[mask] == 1)})
    if with_edges:
        out["near_edges"] = edges(p, observed, truth, distance, scenes.resolution_m)
    return out


def choose(scenes: Scenes, count: int, family: int | None, kind: int | None, lidar_m: float | None) -> np.ndarray:
    """Indices of up to `count` scenes, spread evenly over those that match."""
    keep = np.ones(len(scenes), bool)
    if family is not None:
        keep &= scenes.family == family
    if kind is not None:
        keep &= scenes.kind == kind
    if lidar_m is not None:
        keep &= np.abs(scenes.lidar - lidar_m) < 0.01
    index = np.flatnonzero(keep)
    if len(index) == 0:
        raise ValueError(f"{scenes.folder}: no scene of family {family}, kind {kind}, lidar {lidar_m}")
    return index[np.linspace(0, len(index) - 1, min(count, len(index))).astype(int)]


def load(path: str):
    """A module (EMA weights) from a checkpoint, or an onnxruntime session from an .onnx file."""
    if path.endswith(".onnx"):
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    from .train import load_model

    return load_model(Path(path))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("data")
    parser.add_argument("--scenes", type=int, default=600)
    parser.add_argument("--family", type=int)
    parser.add_argument("--kind", type=int)
    parser.add_argument("--lidar", type=float)
    parser.add_argument("--world", type=int, default=0, help="kind of world to tell: 0 unknown, 1 + family")
    args = parser.parse_args()
    scenes = Scenes(args.data)
    pick = choose(scenes, args.scenes, args.family, args.kind, args.lidar)
    result = score(load(args.model), scenes, pick, with_edges=args.family in (None, 0, 2), world=args.world)
    print(json.dumps({"model": args.model, "data": args.data, "world": args.world, **result}))


if __name__ == "__main__":
    main()
