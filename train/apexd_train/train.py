"""From data to a network.

    python -m apexd_train.train --data DIR [DIR ...] --out RUN --export params/cnp.onnx --hours 2

Resumes from RUN/last.pt when it exists (also onto other data: `--data` may change); an interrupt
or a termination signal saves first. Writes RUN/log.csv, RUN/curves.png, RUN/last.pt, and the ONNX file at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import dataclasses
import json
import math
import signal
import time
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from .data import Sampler, Scenes, frontier_distance, target_weights
from .models import ModelConfig, build
from .optimiser import optimisers
from .score import choose, score


def parser() -> argparse.ArgumentParser:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--data", nargs="+", required=True, help="dataset folders")
    p.add_argument("--share", nargs="+", type=float, help="share of each folder in a batch (default: by size)")
    p.add_argument("--validation", nargs="*", default=[], help="held-out folders to score now and then")
    p.add_argument("--out", required=True, help="folder of checkpoints, log and curves")
    p.add_argument("--export", help="ONNX file to write at the end")
    p.add_argument("--architecture", default="convcnp", choices=["literal", "setcnp", "convcnp", "unet"])
    p.add_argument("--channels", type=int, nargs="*", default=[])
    p.add_argument("--bottom-blocks", type=int, default=3)
    p.add_argument("--no-norm", action="store_true")
    p.add_argument("--context-points", type=int, default=128, help="set models: random context per scene, 0 all")
    p.add_argument("--targets", type=int, default=256, help="set models: targets per scene")
    p.add_argument("--batch", type=int, default=16)
    budget = p.add_mutually_exclusive_group(required=True)
    budget.add_argument("--iterations", type=int)
    budget.add_argument("--hours", type=float, help="wall-clock budget, over all resumed runs")
    p.add_argument("--optimiser", default="adamw", choices=["adamw", "muon"])
    p.add_argument("--pause-at", type=int, help="save and leave at this iteration, to be resumed")
    p.add_argument("--lr", type=float, default=1e-3)
    p.add_argument("--warmup", type=int, default=200)
    p.add_argument("--weight-decay", type=float, default=0.01)
    p.add_argument("--clip", type=float, default=1.0)
    p.add_argument("--ema", type=float, default=0.998)
    p.add_argument("--radius", type=float, default=7.5, help="targets within this of a frontier cluster, m")
    p.add_argument("--near", type=float, default=0.0, help="cells within this weigh --near-weight, m")
    p.add_argument("--near-weight", type=float, default=1.0)
    p.add_argument("--far-weight", type=float, default=0.0, help="weight beyond the radius (grid models)")
    p.add_argument("--hide-world", type=float, default=0.25, help="share of scenes with the kind of world hidden")
    p.add_argument("--no-augment", action="store_true", help="no D4 symmetries")
    p.add_argument("--initial", help="checkpoint whose weights to start from (fine-tuning)")
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    p.add_argument("--precision", default="bf16", choices=["bf16", "f32"])
    p.add_argument("--threads", type=int, default=1, help="CPU threads of torch")
    p.add_argument("--log-every", type=int, default=200)
    p.add_argument("--checkpoint-minutes", type=float, default=3.0)
    p.add_argument("--score-minutes", type=float, default=10.0)
    p.add_argument("--score-scenes", type=int, default=200)
    return p


class Ema:
    """Exponential moving average of all weights and buffers, faster at the start."""

    def __init__(self, model: nn.Module, decay: float):
        self.decay = decay
        self.state = {k: v.detach().clone() for k, v in model.state_dict().items()}

    @torch.no_grad()
    def update(self, model: nn.Module, iteration: int) -> None:
        decay = min(self.decay, (1 + iteration) / (10 + iteration))
        for key, value in model.state_dict().items():
            if value.dtype.is_floating_point:
                self.state[key].lerp_(value, 1.0 - decay)
            else:
                self.state[key].copy_(value)


class Trainer:
    """Model, optimiser, sampler, schedule: everything that a checkpoint holds."""

    def __init__(self, args: argparse.Namespace):
        self.args = args
        self.device = torch.device(args.device)
        torch.manual_seed(args.seed)
        self.generator = torch.Generator(self.device).manual_seed(args.seed)
        folders = [Scenes(folder, self.device) for folder in args.data]
        for scenes in folders:
            scenes.refuse_held_out()
        self.folders = folders
        self.validation = [Scenes(folder, self.device) for folder in args.validation]
        self.sampler = Sampler(folders, args.share or [len(s) for s in folders], self.generator,
                               not args.no_augment)
        config = ModelConfig(
            args.architecture, folders[0].side, folders[0].resolution_m, round(folders[0].prior(), 4),
            tuple(args.channels), args.bottom_blocks, not args.no_norm, args.context_points)
        self.model = build(config)
        self.before: list[dict] = []  # the trainings that the first weights come from
        if args.initial:
            first = torch.load(args.initial, map_location="cpu", weights_only=False)
            config = ModelConfig(**first["config"])
            self.model = build(config)
            self.before = [*first.get("before", []), {
                key: first[key] for key in ("iteration", "seconds", "cpu_seconds", "data")}]
            missing = self.model.load_state_dict(first["ema"], strict=False)
            if missing.unexpected_keys:
                raise ValueError(f"{args.initial}: does not fit, {missing}")
        self.config = config
        # The layout that convolutions like best, on CPU and GPU.
        self.model.to(self.device, memory_format=torch.channels_last)
        self.ema = Ema(self.model, args.ema)
        self.optimisers = optimisers(self.model, args.optimiser, args.lr, args.weight_decay)
        self.iteration, self.seconds, self.cpu_seconds = 0, 0.0, 0.0
        self.history: list[dict] = []

    def progress(self) -> float:
        if self.args.iterations:
            return self.iteration / self.args.iterations
        return self.seconds / (self.args.hours * 3600.0)

    def rate(self) -> float:
        """Learning rate: linear warm-up, then a cosine to a hundredth."""
        warm = min(1.0, (self.iteration + 1) / self.args.warmup)
        cosine = 0.5 * (1.0 + math.cos(math.pi * min(1.0, self.progress())))
        return self.args.lr * warm * (0.01 + 0.99 * cosine)

    def loss(self) -> Tensor:
        """Weighted BCE of one batch, sampled on the device."""
        args = self.args
        observed, truth, frontier, world = self.sampler.batch(args.batch, args.hide_world)
        distance = frontier_distance(frontier, self.config.crop_cells, self.config.resolution_m)
        grid = hasattr(self.model, "network")
        weight = target_weights(observed, truth, distance, args.radius, args.near, args.near_weight,
                                args.far_weight if grid else 0.0)
        occupied = (truth == 1).flatten(1).float()
        cells = None
        if not grid:
            # Targets drawn in proportion to their weight, so each counts the same.
            some = weight.sum(1, keepdim=True) > 0
            cells = torch.multinomial(torch.where(some, weight, torch.ones_like(weight)), args.targets,
                                      replacement=True, generator=self.generator)
            occupied, weight = occupied.gather(1, cells), some.float().expand(-1, args.targets)
        cast = contextlib.nullcontext()
        if args.precision == "bf16":
            cast = torch.autocast(self.device.type, dtype=torch.bfloat16)
        with cast:
            logits = self.model.logits(observed, cells, world)
        losses = F.binary_cross_entropy_with_logits(logits, occupied, reduction="none")
        return (losses * weight).sum() / weight.sum().clamp(min=1.0)

    def step(self) -> Tensor:
        self.model.train()
        self.model.zero_grad(set_to_none=True)
        loss = self.loss()
        loss.backward()
        nn.utils.clip_grad_norm_(self.model.parameters(), self.args.clip)
        for optimiser in self.optimisers:
            for group in optimiser.param_groups:
                group["lr"] = self.rate()
            optimiser.step()
        self.iteration += 1
        self.ema.update(self.model, self.iteration)
        return loss.detach()

    def averaged(self) -> nn.Module:
        model = build(self.config)
        model.load_state_dict(self.ema.state)
        return model.to(self.device).eval()

    def save(self, path: Path) -> None:
        rng = {"sampler": self.generator.get_state(), "torch": torch.get_rng_state()}
        if self.device.type == "cuda":
            rng["cuda"] = torch.cuda.get_rng_state()
        state = {
            "config": dataclasses.asdict(self.config), "model": self.model.state_dict(),
            "ema": self.ema.state, "optimisers": [o.state_dict() for o in self.optimisers], "rng": rng,
            "iteration": self.iteration, "seconds": self.seconds, "cpu_seconds": self.cpu_seconds,
            "before": self.before, "history": self.history, "args": vars(self.args),
            "data": [{"folder": str(s.folder), "sha256": s.sha256, "scenes": len(s)} for s in self.folders],
            "lidar_m": sorted({float(round(x, 3)) for s in self.folders for x in set(s.lidar.tolist())}),
        }
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        partial.replace(path)

    def resume(self, path: Path) -> None:
        state = torch.load(path, map_location="cpu", weights_only=False)
        if state["config"]["architecture"] != self.config.architecture:
            raise ValueError(f"{path} is a {state['config']['architecture']}, not a {self.config.architecture}")
        self.config = ModelConfig(**state["config"])
        self.model = build(self.config).to(self.device, memory_format=torch.channels_last)
        self.model.load_state_dict(state["model"])
        args = self.args
        self.optimisers = optimisers(self.model, args.optimiser, args.lr, args.weight_decay)
        for optimiser, saved in zip(self.optimisers, state["optimisers"]):
            optimiser.load_state_dict(saved)
        self.ema.state = {k: v.to(self.device) for k, v in state["ema"].items()}
        self.iteration, self.history, self.before = state["iteration"], state["history"], state["before"]
        self.seconds, self.cpu_seconds = state["seconds"], state["cpu_seconds"]
        self.generator.set_state(state["rng"]["sampler"])
        torch.set_rng_state(state["rng"]["torch"])
        if "cuda" in state["rng"] and self.device.type == "cuda":
            torch.cuda.set_rng_state(state["rng"]["cuda"])

    def validate(self) -> dict:
        """Log loss of the averaged weights on every validation folder and family, the kind known or not."""
        model, out = self.averaged(), {}
        for scenes in self.validation:
            for family in sorted(set(scenes.family.tolist())):
                pick = choose(scenes, self.args.score_scenes, family, None, None)
                for world in (0, family + 1) if hasattr(model, "network") else (0,):
                    s = score(model, scenes, pick, with_edges=False, world=world)
                    for radius in ("R5", "R7.5"):
                        out[f"{scenes.folder.name} f{family} w{world} {radius}"] = round(s[radius]["log_loss"], 5)
        return out

    def write(self, out: Path) -> None:
        """Checkpoint, log and curves."""
        self.save(out / "last.pt")
        fields = list(dict.fromkeys(key for row in self.history for key in row))
        with open(out / "log.csv", "w", newline="") as file:
            writer = csv.DictWriter(file, fields)
            writer.writeheader()
            writer.writerows(self.history)
        curves(self.history, out / "curves.png")


def curves(history: list[dict], path: Path) -> None:
    """The picture of a run: training and held-out log loss against processor time."""
    try:
        import matplotlib
    except ImportError:
        return  # the CSV has it all
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 5))
    names = dict.fromkeys(key for row in history for key in row if key == "loss" or " R" in key)
    for name in names:
        rows = [row for row in history if name in row]
        axes.plot([row["cpu_seconds"] / 60.0 for row in rows], [row[name] for row in rows],
                  lw=0.7 if name == "loss" else 1.5, marker=None if name == "loss" else ".",
                  label="training loss" if name == "loss" else name)
    axes.set(xlabel="processor time (min)", ylabel="log loss per unobserved cell")
    losses = sorted(row[name] for name in names for row in history if name in row)
    if losses:
        axes.set_ylim(losses[0] * 0.95, losses[int(len(losses) * 0.9)] * 1.1)
    axes.legend()
    axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def load_model(checkpoint: Path) -> nn.Module:
    """The averaged weights of a checkpoint, as a module on the CPU, ready to predict."""
    state = torch.load(checkpoint, map_location="cpu", weights_only=False)
    model = build(ModelConfig(**state["config"]))
    model.load_state_dict(state["ema"])
    return model.eval()


def train(args: argparse.Namespace) -> Trainer:
    torch.set_num_threads(args.threads)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(args)
    if (out / "last.pt").exists():
        trainer.resume(out / "last.pt")
        print(f"resumed at iteration {trainer.iteration}, {trainer.seconds:.0f} s", flush=True)
    parameters = sum(p.numel() for p in trainer.model.parameters())
    print(f"{trainer.config}: {parameters} parameters, {sum(map(len, trainer.folders))} scenes", flush=True)
    mark, cpu_mark = time.monotonic(), time.process_time()
    saved = scored = trainer.seconds
    total, count = 0.0, 0
    paused = []  # by a signal: finish the step, save, leave

    def pause(number: int, frame: object) -> None:
        paused.append(number)

    handlers = {number: signal.signal(number, pause) for number in (signal.SIGTERM, signal.SIGINT)}
    while trainer.progress() < 1.0 and not paused:
        total, count = total + trainer.step(), count + 1
        now, cpu_now = time.monotonic(), time.process_time()
        trainer.seconds += now - mark
        trainer.cpu_seconds += cpu_now - cpu_mark
        mark, cpu_mark = now, cpu_now
        if args.pause_at and trainer.iteration >= args.pause_at:
            paused.append(0)
        last = trainer.progress() >= 1.0 or bool(paused)
        if trainer.iteration % args.log_every == 0 or last:
            row = {"iteration": trainer.iteration, "scenes": trainer.iteration * args.batch,
                   "seconds": round(trainer.seconds, 1), "cpu_seconds": round(trainer.cpu_seconds, 1),
                   "rate": trainer.rate(), "loss": round(float(total) / count, 5)}
            total, count = 0.0, 0
            if trainer.progress() >= 1.0 or trainer.seconds - scored >= args.score_minutes * 60.0:
                row.update(trainer.validate())
                scored = trainer.seconds
                # Scoring counts as wall-clock time, not as training's processor time.
                cpu_mark = time.process_time()
            trainer.history.append(row)
            print(json.dumps(row), flush=True)
            if not math.isfinite(row["loss"]):
                raise FloatingPointError(f"the loss is {row['loss']} at iteration {trainer.iteration}")
        if trainer.seconds - saved >= args.checkpoint_minutes * 60.0:
            trainer.write(out)
            saved = trainer.seconds
    trainer.write(out)
    for number, handler in handlers.items():
        signal.signal(number, handler)
    if args.export and trainer.progress() >= 1.0:
        from .export import export

        export(out / "last.pt", Path(args.export))
    return trainer


if __name__ == "__main__":
    train(parser().parse_args())
