"""What a predictor has to beat: the prior, and a histogram over two distances.

    python -m apexd_train.baselines TRAINING_DIR ... --held-out DIR [--family F] [--scenes 300]

The histogram knows, of each unobserved cell, how far the nearest observed wall and the nearest
observed free cell are, and answers with the share of occupied cells among such training cells.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import torch

from .data import Scenes, frontier_distance
from .score import choose, summary

EDGES_M = np.concatenate([np.arange(0.3, 3.0, 0.25), [3.5, 4.0, 5.0, 6.0, 8.0]])


def distances(observed: torch.Tensor, resolution_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Of each cell [S, S]: distance (m) to the nearest observed wall, and to the nearest free cell."""
    side = observed.shape[0]
    cells = torch.stack(torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij"), -1)
    cells = cells.reshape(-1, 2).float() * resolution_m
    out = []
    for label in (2, 1):
        seen = cells[(observed == label).reshape(-1)]
        far = torch.full((len(cells),), 100.0)
        out.append((torch.cdist(cells, seen).amin(1) if len(seen) else far).reshape(side, side).numpy())
    return out[0], out[1]


def samples(scenes: Scenes, pick: np.ndarray, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Histogram bins and truth of every target of the scenes."""
    slots, truths = [], []
    for k in pick:
        observed, truth = scenes.observed[k], scenes.truth[k].numpy()
        reach = frontier_distance(scenes.frontier[k:k + 1], scenes.side, scenes.resolution_m)[0].numpy()
        mask = (observed.numpy() == 0) & (truth != 255) & (reach.reshape(truth.shape) <= radius_m)
        wall, free = (np.digitize(d[mask], EDGES_M) for d in distances(observed, scenes.resolution_m))
        slots.append(wall * (len(EDGES_M) + 1) + free)
        truths.append(truth[mask] == 1)
    return np.concatenate(slots), np.concatenate(truths)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("training", nargs="+")
    parser.add_argument("--held-out", required=True)
    parser.add_argument("--family", type=int)
    parser.add_argument("--scenes", type=int, default=300)
    args = parser.parse_args()
    held_out = Scenes(args.held_out)
    for radius in (5.0, 7.5):
        parts = [samples(s, choose(s, args.scenes, args.family, None, None), radius)
                 for s in map(Scenes, args.training)]
        slot, truth = (np.concatenate(part) for part in zip(*parts))
        size = (len(EDGES_M) + 1) ** 2
        prior = truth.mean()
        count, hits = np.bincount(slot, minlength=size), np.bincount(slot, weights=truth, minlength=size)
        table = (hits + 20.0 * prior) / (count + 20.0)
        slot, truth = samples(held_out, choose(held_out, args.scenes, args.family, None, None), radius)
        for name, p in (("prior", np.full(len(slot), prior)), ("two distances", table[slot])):
            print(json.dumps({"baseline": name, "radius_m": radius, **summary(p, truth)}))


if __name__ == "__main__":
    main()
