"""Scenes of `apexd dataset`: a folder of .npy arrays and manifest.json.

Arrays (N scenes, S x S coarse cells, the robot's cell at [S/2, S/2], index [row = y, column = x]):
observed uint8 (0 unknown, 1 free, 2 occupied), truth uint8 (0 free, 1 occupied, 255 no target),
frontier float32 [N, 8, 2] (m, from the lower left corner of the robot's cell, NaN padded),
source int64 (maze seed or map index), family, kind uint8, lidar float32 (m).
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

HELD_OUT_SEED = 1_000_000
MAP_FILE_FAMILY = 3


class HeldOutError(ValueError):
    """Held-out scenes were given for training."""


class Scenes:
    """One dataset folder. Arrays stay memory-mapped on the CPU or lie on the GPU."""

    def __init__(self, folder: str | Path, device: torch.device | str = "cpu"):
        self.folder = Path(folder)
        text = (self.folder / "manifest.json").read_bytes()
        self.manifest = json.loads(text)
        self.sha256 = hashlib.sha256(text).hexdigest()
        self.resolution_m = float(self.manifest["resolution_m"])
        self.source, self.family, self.kind, self.lidar = (
            np.load(self.folder / f"{name}.npy") for name in ("source", "family", "kind", "lidar")
        )
        device = torch.device(device)
        self.observed = self._array("observed", np.uint8, device)
        self.truth = self._array("truth", np.uint8, device)
        self.frontier = self._array("frontier", np.float32, device)
        # What the models call the world: 1 + family.
        self.world = torch.from_numpy(self.family.astype(np.int64) + 1).to(device)
        self.side = self.observed.shape[1]
        if self.observed.shape != self.truth.shape or self.side != self.observed.shape[2]:
            raise ValueError(f"{folder}: observed {self.observed.shape}, truth {self.truth.shape}")

    def _array(self, name: str, dtype: type, device: torch.device) -> Tensor:
        array = np.load(self.folder / f"{name}.npy", mmap_mode="c")
        if array.dtype != dtype:
            raise ValueError(f"{self.folder}/{name}.npy is {array.dtype}, not {np.dtype(dtype)}")
        return torch.from_numpy(array).to(device)

    def __len__(self) -> int:
        return self.observed.shape[0]

    def held_out(self) -> bool:
        """Whether any scene is of a held-out seed, or the whole folder is marked so."""
        mazes = self.source[self.family != MAP_FILE_FAMILY]
        return bool(self.manifest.get("held_out")) or bool((mazes >= HELD_OUT_SEED).any())

    def refuse_held_out(self) -> None:
        if self.held_out():
            raise HeldOutError(
                f"{self.folder} holds held-out scenes (maze seeds from {HELD_OUT_SEED:,}, or a manifest "
                "marked held_out): they are for scoring only"
            )

    def prior(self, scenes: int = 2000) -> float:
        """Share of occupied cells among the unobserved targets of the first scenes."""
        step = max(1, len(self) // scenes)
        observed, truth = self.observed[::step], self.truth[::step]
        target = (observed == 0) & (truth != 255)
        return float((truth[target] == 1).float().mean().clamp(0.01, 0.99))


def symmetries(side: int, device: torch.device | str = "cpu") -> Tensor:
    """The eight symmetries of the square about the centre of the robot's cell, as index maps.

    int64 [8, S * S]: new[k] = old[index[k]]; S * S stands for "off the crop" (the crop has one row
    and column more on its low sides). Element e: bit 0 flips x, bit 1 flips y, bit 2 swaps after.
    """
    half = side // 2
    j, i = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    maps = []
    for element in range(8):
        x, y = i - half, j - half
        if element & 4:
            x, y = y, x
        if element & 2:
            y = -y
        if element & 1:
            x = -x
        inside = (x >= -half) & (x < half) & (y >= -half) & (y < half)
        flat = (y + half) * side + x + half
        maps.append(torch.where(inside, flat, torch.full_like(flat, side * side)).reshape(-1))
    return torch.stack(maps).to(device)


def apply_symmetry(cells: Tensor, index: Tensor, outside: int) -> Tensor:
    """cells [B, S, S] under index [B, S * S]; `outside` fills what comes from off the crop."""
    batch, side, _ = cells.shape
    flat = torch.nn.functional.pad(cells.reshape(batch, -1), (0, 1), value=outside)
    return flat.gather(1, index).reshape(batch, side, side)


def turn_points(points: Tensor, element: Tensor, resolution_m: float) -> Tensor:
    """points [B, K, 2] (m, from the corner of the robot's cell) under element [B] of D4."""
    half = resolution_m / 2.0
    x, y = points[..., 0] - half, points[..., 1] - half
    e = element[:, None]
    x = torch.where((e & 1) > 0, -x, x)
    y = torch.where((e & 2) > 0, -y, y)
    swap = (e & 4) > 0
    return torch.stack([torch.where(swap, y, x), torch.where(swap, x, y)], -1) + half


def frontier_distance(frontier: Tensor, side: int, resolution_m: float) -> Tensor:
    """Distance (m) of every cell centre to the nearest frontier cluster: [B, S * S], inf without one."""
    axis = (torch.arange(side, device=frontier.device) - side // 2 + 0.5) * resolution_m
    best = None
    for k in range(frontier.shape[1]):
        point = frontier[:, k]
        dx2 = (axis[None] - point[:, :1]) ** 2
        dy2 = (axis[None] - point[:, 1:]) ** 2
        square = torch.nan_to_num(dy2[:, :, None] + dx2[:, None, :], nan=float("inf"))
        best = square if best is None else torch.minimum(best, square)
    return best.sqrt().flatten(1)


class Sampler:
    """Random batches over several folders, drawn with `shares`, on the folders' device.

    All randomness comes from one generator, whose state is part of a checkpoint.
    """

    def __init__(self, folders: list[Scenes], shares: list[float], generator: torch.Generator,
                 augment: bool = True):
        self.folders, self.generator, self.augment = folders, generator, augment
        self.device = folders[0].observed.device
        self.shares = torch.tensor(shares, dtype=torch.float64) / sum(shares)
        self.maps = symmetries(folders[0].side, self.device)

    def batch(self, size: int, hide_world: float = 0.25) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """observed [B, S, S], truth [B, S, S], frontier [B, 8, 2], world [B].

        The kind of world is hidden (0) with the given probability.
        """
        g, device = self.generator, self.device
        counts = (self.shares * size).floor().long()
        extra = torch.rand(size - int(counts.sum()), generator=g, device=device).cpu().double()
        left = (self.shares * size - counts).cumsum(0)
        for u in extra:  # the fractional parts, so that shares hold on average
            slot = int(torch.searchsorted(left, u * left[-1]).clamp(max=len(counts) - 1))
            counts[slot] += 1
        parts = []
        for scenes, count in zip(self.folders, counts.tolist()):
            pick = torch.randint(len(scenes), (count,), generator=g, device=device)
            parts.append((scenes.observed[pick], scenes.truth[pick], scenes.frontier[pick],
                          scenes.world[pick]))
        observed, truth, frontier, world = (torch.cat(part) for part in zip(*parts))
        world = world * (torch.rand(size, generator=g, device=device) >= hide_world)
        if self.augment:
            element = torch.randint(8, (size,), generator=g, device=device)
            index = self.maps[element]
            observed = apply_symmetry(observed, index, 0)
            truth = apply_symmetry(truth, index, 255)
            frontier = turn_points(frontier, element, self.folders[0].resolution_m)
        return observed, truth, frontier, world


def target_weights(observed: Tensor, truth: Tensor, distance_m: Tensor, radius_m: float,
                   near_m: float = 0.0, near_weight: float = 1.0, far_weight: float = 0.0) -> Tensor:
    """Loss weights [B, S * S]: unobserved cells with a truth, by distance to the frontier alone.

    1 within `radius_m`, `near_weight` within `near_m`, `far_weight` beyond. A weight that depends on
    position only leaves the best answer, the probability, where it is.
    """
    weight = torch.where(distance_m <= radius_m, 1.0, far_weight)
    weight = torch.where(distance_m <= near_m, near_weight, weight)
    return weight * ((observed == 0) & (truth != 255)).flatten(1)
