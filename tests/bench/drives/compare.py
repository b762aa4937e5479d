#!/usr/bin/env python3
"""Drives the same mazes with several planners and compares the times, pair by pair.

    compare.py --seeds 1000000..1000030 --family thin --speed 4 known-map oracle cnp none frontier

A contender is `known-map`, `frontier`, or a predictor of `apexd sil` (also a network's file) for the
policy map-predictive; `POLICY:PREDICTOR` for another one; parameters follow behind an @:

    compare.py known-map none janson:none janson:cnp cnp@plan.reading=via-frontier,search.penalty=literal

The first one is what the others are compared with. Writes a row per drive to --csv and goes on from
there when it exists already; prints, for each contender, the mean of its time over the first one's and
its 95 % bootstrap interval over mazes, candidates and processor time per planning step (the latter with
everything around it, simulation included).
"""

import argparse
import csv
import json
import os
import random
import statistics
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

FIELDS = ["family", "speed_mps", "seed", "contender", "outcome", "time_s", "path_m", "collisions",
          "unknown_entries", "guard_stops", "replans", "plans_rejected", "plan_p50_ms", "plan_p99_ms",
          "predict_p50_ms", "predict_p99_ms", "candidates", "cpu_s"]


def drive(binary, family, speed, seed, contender):
    name, _, settings = contender.partition("@")
    policy, _, predictor = name.rpartition(":")
    if not policy:
        policy = name if name in ("known-map", "frontier") else "map-predictive"
        predictor = "none" if policy != "map-predictive" else name
    command = [binary, "sil", "--maze", str(seed), "--family", family, "--policy", policy,
               "--predictor", predictor, "--speed-max", str(speed), "--json"]
    for setting in filter(None, settings.split(",")):
        command += ["--set", setting]
    if speed > 4:
        command += ["--set", "lidar.rate_hz=40"]
    with tempfile.TemporaryDirectory() as folder:
        command += ["--out", folder]
        with (Path(folder) / "stdout").open("w+") as out, (Path(folder) / "stderr").open("w+") as err:
            process = subprocess.Popen(command, stdout=out, stderr=err)
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            out.seek(0)
            err.seek(0)
            lines, complaint = out.read().strip().splitlines(), err.read()
    if not lines:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}\n{complaint}")
    said = json.loads(lines[-1])
    row = {"family": family, "speed_mps": speed, "seed": seed, "contender": contender}
    row |= {key: said[key] for key in FIELDS[4:12]}
    row |= {f"{part}_{q}_ms": round(said[f"{part}_ms"][q], 3)
            for part in ("plan", "predict") for q in ("p50", "p99")}
    row["candidates"] = round(said["candidates"], 2)
    row["cpu_s"] = round(used.ru_utime + used.ru_stime, 2)
    return row


def interval(ratios, draws=2000):
    """95 % bootstrap interval of the mean."""
    rng = random.Random(1)
    means = sorted(statistics.fmean(rng.choices(ratios, k=len(ratios))) for _ in range(draws))
    return means[int(0.025 * draws)], means[int(0.975 * draws)]


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("contenders", nargs="+")
    options.add_argument("--seeds", default="1000000..1000010", help="first..one past the last")
    options.add_argument("--family", default="thin")
    options.add_argument("--speed", type=float, default=4.0, help="m/s")
    options.add_argument("--jobs", type=int, default=1)
    options.add_argument("--binary", default="target/release/apexd")
    options.add_argument("--csv", type=Path, default=Path("target/drives.csv"))
    args = options.parse_args()
    first, last = map(int, args.seeds.split(".."))
    rows = []
    if args.csv.exists():
        with args.csv.open() as file:
            rows = list(csv.DictReader(file))
    key = lambda r: (r["family"], float(r["speed_mps"]), int(r["seed"]), r["contender"])
    done = {key(r): r for r in rows}
    wanted = [(args.family, args.speed, seed, c) for seed in range(first, last) for c in args.contenders]
    missing = [w for w in wanted if w not in done]
    new = not args.csv.exists()
    with args.csv.open("a", newline="") as file, ThreadPoolExecutor(args.jobs) as pool:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        for row in pool.map(lambda w: drive(args.binary, *w), missing):
            writer.writerow(row)
            file.flush()
            done[key(row)] = row
    print(f"{args.family} {args.speed} m/s, mazes {args.seeds}, times over those of {args.contenders[0]}")
    print("| contender | goal | mean | 95 % interval | rejected | collisions | unknown entries "
          "| candidates | ms of processor a step |")
    print("|---|---|---|---|---|---|---|---|---|")
    for contender in args.contenders:
        mine = [done[(args.family, args.speed, seed, contender)] for seed in range(first, last)]
        base = [done[(args.family, args.speed, seed, args.contenders[0])] for seed in range(first, last)]
        ratios = [float(m["time_s"]) / float(b["time_s"]) for m, b in zip(mine, base)
                  if m["outcome"] == b["outcome"] == "goal"]
        total = lambda name: sum(int(m[name]) for m in mine)
        goals = sum(m["outcome"] == "goal" for m in mine)
        low, high = interval(ratios) if ratios else (float("nan"),) * 2
        mean = statistics.fmean(ratios) if ratios else float("nan")
        print(f"| {contender} | {goals}/{len(mine)} | {mean:.4f} | {low:.4f} to {high:.4f} "
              f"| {100 * total('plans_rejected') / total('replans'):.1f} % "
              f"| {total('collisions')} | {total('unknown_entries')} "
              f"| {statistics.fmean(float(m['candidates']) for m in mine):.1f} "
              f"| {1000 * sum(float(m['cpu_s']) for m in mine) / total('replans'):.1f} |")


if __name__ == "__main__":
    main()
