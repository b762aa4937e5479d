"""The predictors, behind one interface.

Every model maps what has been seen to the log-odds of occupancy of any set of cells:

    logits(observed, cells, world)  training: observed uint8 [B, S, S] (0 unknown, 1 free, 2 occupied),
                                 cells int64 [B, T] flat indices j * S + i, or None for every cell;
                                 world int64 [B], what kind of world it is; returns float32 [B, T]
                                 (or [B, S * S])
    encode(context)              export: context float32 [C, 3] (x, y in metres, label 0 free,
                                 1 occupied), returns the tensor `representation`
    decode(representation, target)   export: target float32 [T, 2] (m), returns logits [T]

Coordinates are metres relative to the lower left corner of the robot's cell, which is cell
(S / 2, S / 2) of the crop; cell (i, j) spans x from (i - S/2) r to (i + 1 - S/2) r.

The kinds of world look alike through a lidar: behind a wall is the next hallway in one, rock in
another. So the grid models take the kind as a condition, an embedding that is learnt: UNKNOWN_WORLD,
or 1 + the number of the family. Training hides the kind in a share of the scenes. A file is exported
for one kind (or for the unknown), which then is a constant inside of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass
class ModelConfig:
    """What it takes to rebuild a model; stored in every checkpoint."""

    architecture: str = "convcnp"  # literal | setcnp | convcnp | unet
    crop_cells: int = 104
    resolution_m: float = 0.25
    prior: float = 0.1  # occupancy of unobserved cells: initial bias, and the answer off the crop
    channels: tuple[int, ...] = ()  # per level (convcnp, unet) or width (set models); () = default
    bottom_blocks: int = 3  # residual blocks at the coarsest level (convcnp)
    norm: bool = True  # batch normalisation (convcnp, unet); folded at export
    context_points: int = 128  # random context per scene in training, 0 = all (set models)
    extra: dict = field(default_factory=dict)

    def context(self) -> str:
        """Which observed cells the model takes: `all` or `walls-and-frontier`."""
        return "walls-and-frontier" if self.architecture == "setcnp" else "all"


UNKNOWN_WORLD = 0
WORLDS = 5  # unknown, thin, solid, branching, map file


def logit(p: float) -> float:
    return math.log(p / (1.0 - p))


def space_to_depth(x: Tensor) -> Tensor:
    """[B, c, 2 h, 2 w] to [B, 4 c, h, w], in operations that every ONNX runtime has."""
    b, c, h, w = x.shape
    x = x.reshape(b, c, h // 2, 2, w // 2, 2).permute(0, 1, 3, 5, 2, 4)
    return x.reshape(b, 4 * c, h // 2, w // 2)


def depth_to_space(x: Tensor) -> Tensor:
    """[B, 4 c, h, w] to [B, c, 2 h, 2 w], the inverse."""
    b, c, h, w = x.shape
    x = x.reshape(b, c // 4, 2, 2, h, w).permute(0, 1, 4, 2, 5, 3)
    return x.reshape(b, c // 4, 2 * h, 2 * w)


def doubled(x: Tensor) -> Tensor:
    """[B, c, h, w] to [B, c, 2 h, 2 w], every cell repeated (nearest neighbour)."""
    b, c, h, w = x.shape
    x = x.reshape(b, c, h, 1, w, 1)
    x = torch.cat([x, x], 3)
    return torch.cat([x, x], 5).reshape(b, c, 2 * h, 2 * w)


def frontier_cells(observed: Tensor) -> Tensor:
    """Free cells with an unknown cell on one of their four sides: bool [B, S, S]."""
    unknown = F.pad((observed == 0).float(), (1, 1, 1, 1))
    beside = unknown[:, 1:-1, 2:] + unknown[:, 1:-1, :-2] + unknown[:, 2:, 1:-1] + unknown[:, :-2, 1:-1]
    return (observed == 1) & (beside > 0)


def context_of(observed: Tensor, selection: str, points: int, resolution_m: float) -> tuple[Tensor, Tensor]:
    """The observed cells of each scene as points: context [B, C, 3] and mask [B, C].

    With `points` > 0 a random subset of that size (or all, when there are fewer).
    """
    batch, side, _ = observed.shape
    chosen = observed > 0
    if selection == "walls-and-frontier":
        chosen = (observed == 2) | frontier_cells(observed)
    chosen = chosen.reshape(batch, -1)
    count = int(chosen.sum(1).max())
    if points > 0:
        count = min(count, points)
    count = max(count, 1)
    # The highest random keys among the chosen cells: a subset without replacement.
    key = torch.rand(chosen.shape, device=observed.device) + chosen
    key, index = torch.topk(key, count, dim=1)
    mask = key >= 1.0
    x = (index % side - side // 2 + 0.5) * resolution_m
    y = (index // side - side // 2 + 0.5) * resolution_m
    label = (observed.reshape(batch, -1).gather(1, index) == 2).float()
    return torch.stack([x, y, label], 2) * mask[..., None], mask


class GridModel(nn.Module):
    """On-the-grid ConvCNP (Gordon et al. 2020): context scattered on a grid, a network on the grid,
    targets read off its cells. Subclasses give `network`: [B, 2, S, S] -> logits [B, 1, S, S]."""

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.world = UNKNOWN_WORLD  # of what `encode` answers for

    def network(self, grid: Tensor, world: Tensor) -> Tensor:
        raise NotImplementedError

    def worlds(self, count: int, device: torch.device) -> Tensor:
        return torch.full((count,), self.world, dtype=torch.int64, device=device)

    def logits(self, observed: Tensor, cells: Tensor | None = None, world: Tensor | None = None) -> Tensor:
        grid = torch.stack([observed > 0, observed == 2], 1).float()
        grid = grid.to(memory_format=torch.channels_last)
        if world is None:
            world = self.worlds(len(grid), grid.device)
        out = self.network(grid, world).float().flatten(1)
        return out if cells is None else out.gather(1, cells)

    def _padded_index(self, xy: Tensor) -> Tensor:
        """Flat index on the crop with one cell of border, which takes all that lies outside."""
        side = self.config.crop_cells
        cell = torch.floor(xy * (1.0 / self.config.resolution_m)) + (side // 2 + 1)
        cell = cell.clamp(0.0, side + 1.0)
        return (cell[:, 1] * (side + 2) + cell[:, 0]).to(torch.int64)

    def grid_of(self, context: Tensor) -> Tensor:
        """Context [C, 3] scattered on the grid: [1, 2, S, S]."""
        side = self.config.crop_cells
        code = torch.zeros((side + 2) ** 2, device=context.device)
        code = code.scatter(0, self._padded_index(context[:, :2]), context[:, 2] + 1.0)
        code = code.reshape(1, 1, side + 2, side + 2)[:, :, 1:-1, 1:-1]
        return torch.cat([code.clamp(0.0, 1.0), code.clamp(1.0, 2.0) - 1.0], 1)

    def bordered(self, logits: Tensor) -> Tensor:
        """Logits [1, 1, S, S] with a border of the prior, flat: the representation."""
        return F.pad(logits.float(), (1, 1, 1, 1), value=logit(self.config.prior)).reshape(-1)

    def encode(self, context: Tensor) -> Tensor:
        return self.bordered(self.network(self.grid_of(context), self.worlds(1, context.device)))

    def decode(self, representation: Tensor, target: Tensor) -> Tensor:
        return representation.index_select(0, self._padded_index(target))


def world_bias(channels: int) -> nn.Embedding:
    """One bias per channel and kind of world, zero at first."""
    embedding = nn.Embedding(WORLDS, channels)
    nn.init.zeros_(embedding.weight)
    return embedding


class Conv(nn.Sequential):
    """3x3 convolution with an optional batch norm, `same` padding."""

    def __init__(self, cin: int, cout: int, norm: bool, stride: int = 1, dilation: int = 1):
        conv = nn.Conv2d(cin, cout, 3, stride, dilation, dilation, bias=not norm)
        super().__init__(conv, nn.BatchNorm2d(cout)) if norm else super().__init__(conv)


class Residual(nn.Module):
    """x + conv(relu(conv(x))), ReLU after; the second convolution starts small."""

    def __init__(self, channels: int, norm: bool, dilation: int = 1):
        super().__init__()
        self.first = Conv(channels, channels, norm, dilation=dilation)
        self.second = Conv(channels, channels, norm)
        if norm:
            nn.init.zeros_(self.second[1].weight)
        else:
            nn.init.zeros_(self.second[0].weight)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(F.relu(self.first(x))))


class ConvCnp(GridModel):
    """U-Net of residual blocks on a space-to-depth stem: work at S/2, S/4 and S/8 only."""

    def __init__(self, config: ModelConfig):
        super().__init__(config)
        c0, c1, c2 = config.channels or (16, 48, 96)
        norm = config.norm
        self.stem = Conv(8, c0, norm)
        self.in0 = Conv(c0, c0, norm)
        self.down1 = Conv(c0, c1, norm, stride=2)
        self.in1 = Conv(c1, c1, norm)
        self.down2 = Conv(c1, c2, norm, stride=2)
        # 13 x 13 cells of 2 m: with dilations 1, 2 the bottom sees the whole crop.
        self.bottom = nn.Sequential(*[Residual(c2, norm, 1 + k % 2) for k in range(config.bottom_blocks)])
        self.lift1 = nn.Conv2d(c2, 4 * c1, 1)
        self.out1 = Conv(c1, c1, norm)
        self.lift0 = nn.Conv2d(c1, 4 * c0, 1)
        self.out0 = Conv(c0, c0, norm)
        self.head = nn.Conv2d(c0, 4, 1)
        nn.init.constant_(self.head.bias, logit(config.prior))
        self.world0, self.world2 = world_bias(c0), world_bias(c2)

    def features(self, grid: Tensor, world: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What the way down gives at the three levels, the coarsest last."""
        x0 = F.relu(self.stem(space_to_depth(grid)) + self.world0(world)[:, :, None, None])
        x0 = F.relu(self.in0(x0))
        x1 = F.relu(self.down1(x0))
        x1 = F.relu(self.in1(x1))
        x2 = F.relu(self.down2(x1) + self.world2(world)[:, :, None, None])
        return x0, x1, self.bottom(x2)

    def head_on(self, x0: Tensor, x1: Tensor, x2: Tensor) -> Tensor:
        """Logits [B, 1, S, S] from the features."""
        x1 = F.relu(x1 + depth_to_space(self.lift1(x2)))
        x1 = F.relu(self.out1(x1))
        x0 = F.relu(x0 + depth_to_space(self.lift0(x1)))
        x0 = F.relu(self.out0(x0))
        return depth_to_space(self.head(x0))

    def network(self, grid: Tensor, world: Tensor) -> Tensor:
        return self.head_on(*self.features(grid, world))


class UNet(GridModel):
    """The plain peer: two 3x3 convolutions a level, max pooling, concatenated skips, full resolution."""

    def __init__(self, config: ModelConfig):
        super().__init__(config)
        widths = config.channels or (16, 32, 64, 64)
        self.pairs = nn.ModuleList()
        cin = 2
        for width in widths:
            self.pairs.append(self._pair(cin, width, config.norm))
            cin = width
        self.ups = nn.ModuleList()
        for width in reversed(widths[:-1]):
            self.ups.append(self._pair(cin + width, width, config.norm))
            cin = width
        self.head = nn.Conv2d(cin, 1, 1)
        nn.init.constant_(self.head.bias, logit(config.prior))
        self.worlds_in = nn.ModuleList(world_bias(width) for width in widths)

    @staticmethod
    def _pair(cin: int, cout: int, norm: bool) -> nn.Sequential:
        return nn.Sequential(Conv(cin, cout, norm), nn.ReLU(), Conv(cout, cout, norm), nn.ReLU())

    def network(self, grid: Tensor, world: Tensor) -> Tensor:
        skips, x = [], grid
        for level, (pair, bias) in enumerate(zip(self.pairs, self.worlds_in)):
            x = pair(x if level == 0 else F.max_pool2d(x, 2)) + bias(world)[:, :, None, None]
            skips.append(x)
        skips.pop()
        for up in self.ups:
            x = up(torch.cat([doubled(x), skips.pop()], 1))
        return self.head(x)


def perceptron(sizes: list[int]) -> nn.Sequential:
    """Linear layers with ReLU between them, none after the last."""
    layers: list[nn.Module] = []
    for cin, cout in zip(sizes, sizes[1:]):
        layers += [nn.Linear(cin, cout), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


class SetCnp(nn.Module):
    """CNP (Garnelo et al. 2018): r = mean of h(x_i, y_i), logit = g(x, r); h and g with 4 layers.

    `literal`: raw coordinates in metres, every observed cell, as Elhafsi et al. 2020 describe it.
    `setcnp`: sinusoids of the coordinates, walls and frontier only, and a canonical frame: flips and
    a swap of the axes bring the mean of the seen walls into the sector x >= y >= 0. The frame is
    part of the representation: r followed by the 2x2 matrix that turns a target into it.
    """

    PERIODS_M = (20.0, 10.0, 5.0, 2.5, 1.25, 0.625)

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.config = config
        self.world = UNKNOWN_WORLD  # no condition: the paper's network has none
        self.plain = config.architecture == "literal"
        (width,) = config.channels or (256,)
        inputs = 2 if self.plain else 2 + 4 * len(self.PERIODS_M)
        self.h = perceptron([inputs + 1] + [width] * 4)
        self.g = perceptron([inputs + width] + [width] * 4 + [1])
        nn.init.constant_(self.g[-1].bias, logit(config.prior))

    def features(self, xy: Tensor) -> Tensor:
        if self.plain:
            return xy
        phase = torch.cat([xy * (2.0 * math.pi / period) for period in self.PERIODS_M], -1)
        return torch.cat([xy / 5.0, torch.sin(phase), torch.cos(phase)], -1)

    def frame(self, context: Tensor, weight: Tensor) -> Tensor:
        """Matrix M [B, 2, 2] of the canonical frame: x' = M x; weight [B, C] is 1 for points in use."""
        wall = (context[..., 2] * weight)[..., None]
        mean = (context[..., :2] * wall).sum(1) / wall.sum(1).clamp(min=1.0)
        sign = (mean >= 0).float() * 2.0 - 1.0
        swap = (mean[:, 1].abs() > mean[:, 0].abs()).float()
        sx, sy = sign[:, 0], sign[:, 1]
        rows = [sx * (1.0 - swap), sy * swap, sx * swap, sy * (1.0 - swap)]
        return torch.stack(rows, 1).reshape(-1, 2, 2)

    def _encode(self, context: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        frame = self.frame(context, weight)
        xy = context[..., :2]
        if not self.plain:
            xy = torch.matmul(xy, frame.transpose(1, 2))
        embedded = self.h(torch.cat([self.features(xy), context[..., 2:]], -1)) * weight[..., None]
        return embedded.sum(1) / weight.sum(1, keepdim=True).clamp(min=1.0), frame

    def _decode(self, r: Tensor, frame: Tensor, target: Tensor) -> Tensor:
        xy = target if self.plain else torch.matmul(target, frame.transpose(1, 2))
        # First layer split: W_x x + (W_r r + b), the bracket once per scene.
        first, features = self.g[0], self.features(xy)
        n = features.shape[-1]
        inner = F.linear(features, first.weight[:, :n])
        inner = inner + F.linear(r, first.weight[:, n:], first.bias)[:, None]
        return self.g[1:](inner)[..., 0]

    def logits(self, observed: Tensor, cells: Tensor | None = None, world: Tensor | None = None) -> Tensor:
        config, side = self.config, self.config.crop_cells
        points = config.context_points if self.training else 0
        context, mask = context_of(observed, config.context(), points, config.resolution_m)
        r, frame = self._encode(context, mask.float())
        if cells is None:
            cells = torch.arange(side * side, device=observed.device)[None]
        x, y = (cells % side - side // 2 + 0.5), (cells // side - side // 2 + 0.5)
        target = torch.stack([x, y], -1) * config.resolution_m
        return self._decode(r, frame, target.expand(observed.shape[0], -1, -1)).float()

    def encode(self, context: Tensor) -> Tensor:
        weight = context[None, :, 2] * 0.0 + 1.0
        r, frame = self._encode(context[None], weight)
        return torch.cat([r.reshape(-1), frame.reshape(-1)])

    def decode(self, representation: Tensor, target: Tensor) -> Tensor:
        width = self.g[0].weight.shape[0]
        r, frame = representation[:width], representation[width : width + 4]
        return self._decode(r[None], frame.reshape(1, 2, 2), target[None])[0]


ARCHITECTURES = {"literal": SetCnp, "setcnp": SetCnp, "convcnp": ConvCnp, "unet": UNet}


def build(config: ModelConfig) -> nn.Module:
    """The model of a configuration, with fresh weights from torch's global generator."""
    return ARCHITECTURES[config.architecture](config)
