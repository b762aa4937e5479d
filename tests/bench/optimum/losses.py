#!/usr/bin/env python3
"""Where a drive loses time against the optimum: its speeds, its tyres, its shape, its end.

For each file the driven path is taken as it is and given the fastest speeds that the whole friction
circle allows, and those that a share of it allows. What the drive takes longer than the second is
lost in control and replanning, the step to the first is the share, and what the first takes longer
than the optimum is the shape (and length) of the path.
"""

import argparse
import json
from pathlib import Path

import numpy as np


def fastest(s, curvature, grip, v_max):
    """Time from rest to rest along a fixed path: backward and forward pass on v squared."""
    k = np.abs(curvature)
    cap = np.minimum(grip / np.maximum(k, 1e-9), v_max**2)
    # Both ends of an edge bear the edge's larger curvature.
    edge = np.maximum(k[1:], k[:-1])
    b = cap.copy()
    b[0] = b[-1] = 0.0

    def reach(before, i):
        room = grip**2 - (edge[i] * before) ** 2
        return before + 2 * np.sqrt(max(room, 0.0)) * (s[i + 1] - s[i])

    for i in range(len(s) - 2, -1, -1):
        b[i] = min(b[i], reach(b[i + 1], i))
    for i in range(len(s) - 1):
        b[i + 1] = min(b[i + 1], reach(b[i], i))
    v = np.sqrt(b)
    return float(np.sum(2 * np.diff(s) / np.maximum(v[1:] + v[:-1], 1e-3)))


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("files", nargs="+", type=Path)
    options.add_argument("--optima", type=Path, required=True, help="folder written with --save")
    options.add_argument("--share", type=float, default=0.95, help="of the friction circle")
    args = options.parse_args()
    print("seed  optimum  driven ratio |  path m  over optimum | lost: shape  share  control | end m")
    total = []
    for file in args.files:
        record = json.loads(file.read_text())
        best = np.load(args.optima / f"{file.stem}.npz")
        if record["summary"]["outcome"] != "goal":
            continue
        optimum = float(np.sum(2 * best["length"] / (best["v"][1:] + best["v"][:-1])))
        course = np.array(record["course"])
        t, x, y, v, k = course[:, 0], course[:, 1], course[:, 2], course[:, 4], course[:, 5]
        steps = np.hypot(np.diff(x), np.diff(y))
        moved = np.concatenate([[True], steps > 1e-5])
        s = np.concatenate([[0.0], np.cumsum(steps)])
        at = np.arange(0.0, s[-1], 0.02)
        k = np.interp(at, s[moved], k[moved])
        grip, v_max = record["acceleration_limit_mps2"], record["speed_max_mps"]
        full, part = (fastest(at, k, share * grip, v_max) for share in (1.0, args.share))
        driven = record["summary"]["time_s"]
        parts = np.array([full - optimum, part - full, driven - part]) / optimum
        end = np.hypot(x[-1] - record["goal"][0], y[-1] - record["goal"][1])
        total.append([driven / optimum, *parts, s[-1] / best["length"].sum()])
        print(
            f"{record['seed']:4d} {optimum:8.3f} {driven:7.3f} {driven / optimum:.4f} | {s[-1]:7.2f} "
            f"{s[-1] / best['length'].sum():12.4f}  | {100 * parts[0]:9.2f}% {100 * parts[1]:5.2f}% "
            f"{100 * parts[2]:6.2f}%  | {end:.3f}"
        )
    mean = np.mean(total, axis=0)
    print(
        f"mean ratio {mean[0]:.4f}, length {mean[4]:.4f}; shape {100 * mean[1]:.2f}%, "
        f"share {100 * mean[2]:.2f}%, control {100 * mean[3]:.2f}%"
    )


if __name__ == "__main__":
    main()
