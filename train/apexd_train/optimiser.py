"""Muon (Jordan et al. 2024): momentum made orthogonal, for hidden weight matrices; AdamW for the rest."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def orthogonal(matrix: Tensor, steps: int = 5) -> Tensor:
    """About U V^T of the singular value decomposition, by Newton-Schulz iterations in bfloat16."""
    a, b, c = 3.4445, -4.7750, 2.0315
    x = matrix.bfloat16()
    x = x / (x.norm() + 1e-7)
    tall = x.shape[0] > x.shape[1]
    x = x.T if tall else x
    for _ in range(steps):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.T if tall else x).to(matrix.dtype)


class Muon(torch.optim.Optimizer):
    """Convolutions count as matrices [out, in * height * width]. The step is scaled so that its
    root mean square is like Adam's (0.2 lr), as Liu et al. 2025 propose; so one rate serves both."""

    def __init__(self, parameters, lr: float, weight_decay: float, momentum: float = 0.95):
        super().__init__(parameters, dict(lr=lr, weight_decay=weight_decay, momentum=momentum))

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is None:
                    continue
                state = self.state[p]
                if not state:
                    state["momentum"] = torch.zeros_like(p)
                average = state["momentum"]
                average.lerp_(p.grad, 1.0 - group["momentum"])
                update = p.grad.lerp(average, group["momentum"])
                matrix = update.reshape(len(update), -1)
                update = orthogonal(matrix).reshape(p.shape)
                p.mul_(1.0 - group["lr"] * group["weight_decay"])
                p.add_(update, alpha=-group["lr"] * 0.2 * max(matrix.shape) ** 0.5)


def optimisers(model: nn.Module, name: str, lr: float, weight_decay: float) -> list[torch.optim.Optimizer]:
    """`adamw`: one AdamW. `muon`: Muon for hidden matrices and AdamW for all else."""
    if name == "adamw":
        return [torch.optim.AdamW(model.parameters(), lr, weight_decay=weight_decay)]
    # Few rows: heads and embeddings, no hidden matrices.
    matrices = [p for p in model.parameters() if p.dim() > 1 and len(p) > 8]
    chosen = set(map(id, matrices))
    others = [p for p in model.parameters() if id(p) not in chosen]
    return [Muon(matrices, lr, weight_decay), torch.optim.AdamW(others, lr, weight_decay=weight_decay)]
