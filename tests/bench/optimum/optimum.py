#!/usr/bin/env python3
"""The shortest time in which a friction-limited car can drive through a known maze.

Minimise the time from rest at the start pose to rest anywhere in the goal disc, such that
acceleration stays in the friction circle, speed and curvature below their limits, and the car's
centre at least `keep_m` from every wall. Solved with IPOPT; see README.md for the formulation.
"""

import argparse
import csv
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from world import World

# The end of the drive is not tied to a reference: this many nodes move freely in the open square
# about the goal.
TAIL_NODES = 14
# The reference is renewed until the time changes less than this, relative.
CONVERGED = 1e-4
# The first reference needs no fine nodes.
COARSE = 2.5
REFERENCES_MAX = 12


@dataclass
class Arcs:
    """A drive of circular arcs, on each of which the acceleration along the path is constant."""

    x: np.ndarray
    y: np.ndarray
    psi: np.ndarray
    length: np.ndarray
    v: np.ndarray

    @property
    def duration(self):
        return float(np.sum(2 * self.length / (self.v[1:] + self.v[:-1])))

    @property
    def s(self):
        return np.concatenate([[0.0], np.cumsum(self.length)])

    @property
    def curvature(self):
        return np.diff(self.psi) / self.length

    def at(self, s):
        """Points, headings and speeds at arc lengths, exactly on the arcs."""
        nodes = self.s
        i = np.clip(np.searchsorted(nodes, s, side="right") - 1, 0, len(self.length) - 1)
        along = s - nodes[i]
        turned = self.curvature[i] * along
        middle = self.psi[i] + 0.5 * turned
        chord = along * np.sinc(0.5 * turned / np.pi)
        share = along / self.length[i]
        squared = np.maximum(self.v[i] ** 2 * (1 - share) + self.v[i + 1] ** 2 * share, 0.0)
        points = np.stack([self.x[i] + chord * np.cos(middle), self.y[i] + chord * np.sin(middle)], 1)
        return points, self.psi[i] + turned, np.sqrt(squared)


def centre_line(record):
    """The middle of the lattice route, corners as quarter circles, as a dense polyline."""
    cells = [np.array(c) for c in record["route"]]
    side = 2.5
    centre = lambda c: (c + 0.5) * side
    points = [centre(cells[0])]
    for a, b, c in zip(cells, cells[1:], cells[2:]):
        enter, leave = 0.5 * (centre(a) + centre(b)), 0.5 * (centre(b) + centre(c))
        if np.all(c - b == b - a):
            points += [enter, leave]
            continue
        pivot = enter + leave - centre(b)
        for t in np.linspace(0, np.pi / 2, 41):
            points.append(pivot + (enter - pivot) * np.cos(t) + (leave - pivot) * np.sin(t))
    points.append(centre(cells[-1]))
    return np.array(points)


def driven(record, spacing):
    """The drive to compare, as a first reference."""
    course = np.array(record["course"])
    arcs = arcs_through(resampled(course[:, 1:3], spacing), 1.0)
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course[:, 1:3], axis=0), axis=1))])
    arcs.v = np.maximum(np.interp(arcs.s, s, course[:, 4]), 0.1)
    return arcs


def resampled(points, spacing):
    """A polyline at equal steps, without repeated points."""
    keep = np.concatenate([[True], np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6])
    points = points[keep]
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0, s[-1], max(int(np.ceil(s[-1] / spacing)), 2) + 1)
    return np.stack([np.interp(at, s, points[:, 0]), np.interp(at, s, points[:, 1])], 1)


def arcs_through(points, speed):
    """Arcs along a polyline (headings by central differences): a first reference."""
    d = np.gradient(points, axis=0)
    psi = np.unwrap(np.arctan2(d[:, 1], d[:, 0]))
    length = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return Arcs(points[:, 0], points[:, 1], psi, length, np.full(len(points), speed))


class Optimum:
    def __init__(self, record, spacing, grip_share=1.0, log=None):
        self.record = record
        self.world = World(record)
        self.spacing = spacing
        self.grip = grip_share * record["acceleration_limit_mps2"]
        self.v_max = record["speed_max_mps"]
        self.k_max = 1 / record["turn_radius_m"]
        self.keep = record["keep_m"]
        self.goal = np.array(record["goal"])
        self.goal_radius = record["goal_radius_m"]
        self.log = log or (lambda *_: None)

    # --- reference -------------------------------------------------------------------------------

    def stations(self, drive):
        """Arc lengths of the nodes on the reference: the start, every place where the clearance
        has a local minimum (that is where a path touches a corner), even steps in between, and
        where the square about the goal is entered for good."""
        s = np.arange(0.0, drive.s[-1], 0.005)
        points = drive.at(s)[0]
        x0, y0, x1, y1 = self.goal_box(0.05)
        inside = (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
        end = s[np.nonzero(~inside)[0][-1] + 1]
        s = np.arange(0.0, end, 0.005)
        clearance = self.world.distance(drive.at(s)[0])
        dip = (clearance[1:-1] < clearance[:-2]) & (clearance[1:-1] <= clearance[2:])
        touch = s[1:-1][dip & (clearance[1:-1] < self.keep + 0.05)]
        fixed = [0.0]
        for place in touch:
            if place - fixed[-1] > 0.4 * self.spacing and end - place > 0.4 * self.spacing:
                fixed.append(place)
        fixed.append(end)
        out = [np.array([0.0])]
        for a, b in zip(fixed, fixed[1:]):
            n = max(int(np.ceil((b - a) / self.spacing - 1e-9)), 1)
            out.append(np.linspace(a, b, n + 1)[1:])
        return np.concatenate(out)

    def reference(self, drive):
        s = self.stations(drive)
        points, psi, v = drive.at(s)
        normal = np.stack([-np.sin(psi), np.cos(psi)], 1)
        # The last solution may be a hair too near; look for the free interval from the nearest
        # point on the normal that is free.
        shift = np.zeros(len(s))
        lack = self.keep - self.world.distance(points)
        for i in np.nonzero(lack > 0)[0]:
            for d in np.arange(0.0005, 0.4, 0.0005):
                tries = points[i] + np.outer([d, -d], normal[i])
                free = self.world.distance(tries) >= self.keep
                if free.any():
                    shift[i] = d if free[0] else -d
                    break
        base = points + shift[:, None] * normal
        high = shift + self.world.reach(base, normal, self.keep, 2.5)
        low = shift - self.world.reach(base, -normal, self.keep, 2.5)
        # Normals of neighbouring nodes must not cross within the bounds.
        step = np.diff(s)
        turn = np.diff(psi) / step
        turn = np.maximum.reduce([np.abs(np.append(turn, 0)), np.abs(np.append(0, turn))]) * np.sign(
            np.append(turn, 0) + np.append(0, turn)
        )
        room = 0.85 / np.maximum(np.abs(turn), 1e-6)
        self.clipped = (turn > 0) & (high > room), (turn < 0) & (-low > room)
        high = np.where(turn > 0, np.minimum(high, np.maximum(room, shift)), high)
        low = np.where(turn < 0, np.maximum(low, np.minimum(-room, shift)), low)
        return s, points, psi, normal, low, high, v

    # --- program ---------------------------------------------------------------------------------

    def solve(self, drive, near=False, shortest=False):
        """The best drive about a reference, which is `near` if it is a solution already. With
        `shortest`, the shortest path instead."""
        s, points, psi0, normal, low, high, v0 = self.reference(drive)
        n, m = len(s), TAIL_NODES
        total = n + m
        tail_s = np.linspace(s[-1], drive.s[-1], m + 1)[1:]
        tail_points, tail_psi, tail_v = drive.at(tail_s)
        box = self.goal_box()

        offset, x_t, y_t = ca.MX.sym("n", n), ca.MX.sym("x", m), ca.MX.sym("y", m)
        chi, v = ca.MX.sym("chi", total), ca.MX.sym("v", total)
        length, tail_step = ca.MX.sym("l", n - 1), ca.MX.sym("h")
        x = ca.vertcat(points[:, 0] + offset * normal[:, 0], x_t)
        y = ca.vertcat(points[:, 1] + offset * normal[:, 1], y_t)
        psi_ref = np.concatenate([psi0, tail_psi])
        psi = psi_ref + chi
        lengths = ca.vertcat(length, ca.repmat(tail_step, m, 1))

        turned = psi[1:] - psi[:-1]
        middle = 0.5 * (psi[1:] + psi[:-1])
        t2 = turned**2
        chord = lengths * (1 - t2 / 24 + t2**2 / 1920 - t2**3 / 322560)
        g_x = x[1:] - x[:-1] - chord * ca.cos(middle)
        g_y = y[1:] - y[:-1] - chord * ca.sin(middle)
        curvature = turned / lengths
        accel = (v[1:] ** 2 - v[:-1] ** 2) / (2 * lengths)
        friction0 = (accel**2 + (curvature * v[:-1] ** 2) ** 2) / self.grip**2
        friction1 = (accel**2 + (curvature * v[1:] ** 2) ** 2) / self.grip**2
        duration = ca.sum1(2 * lengths / (v[1:] + v[:-1]))
        to_goal = (x[-1] - self.goal[0]) ** 2 + (y[-1] - self.goal[1]) ** 2

        unknowns = [offset, x_t, y_t, chi, v, length, tail_step]
        g = [g_x, g_y, to_goal / self.goal_radius**2]
        k = total - 1
        lbg, ubg = [np.zeros(2 * k), [0.0]], [np.zeros(2 * k), [1.0]]
        if shortest:
            cost = ca.sum1(lengths) + 1e-9 * ca.sumsqr(v)
        else:
            cost = duration
            g += [curvature, friction0, friction1]
            lbg += [np.full(k, -self.k_max), np.zeros(2 * k)]
            ubg += [np.full(k, self.k_max), np.ones(2 * k)]

        low, high = low.copy(), high.copy()
        low[0] = high[0] = 0.0
        chi_low, chi_high = np.full(total, -1.2), np.full(total, 1.2)
        v_low, v_high = np.full(total, 0.05), np.full(total, self.v_max)
        v_low[0] = v_high[0] = v_low[-1] = v_high[-1] = 0.0
        if not shortest:
            chi_low[0] = chi_high[0] = 0.0
        first_l, tail_l = np.diff(s), (drive.s[-1] - s[-1]) / m
        lbx = [low, np.full(m, box[0]), np.full(m, box[1]), chi_low, v_low, 0.02 * first_l, [1e-3]]
        ubx = [high, np.full(m, box[2]), np.full(m, box[3]), chi_high, v_high, 8 * first_l, [0.3]]
        start = [np.zeros(n), tail_points[:, 0], tail_points[:, 1], np.zeros(total)]
        start += [np.clip(np.concatenate([v0, tail_v]), v_low, v_high), first_l, [tail_l]]
        options = {
            "ipopt.print_level": 0,
            "print_time": False,
            "expand": True,
            "ipopt.max_iter": 1500,
            "ipopt.tol": 1e-8,
            "ipopt.bound_relax_factor": 1e-9,
            "ipopt.sb": "yes",
        }
        if near:
            options |= {
                "ipopt.mu_init": 1e-4,
                "ipopt.bound_push": 1e-4,
                "ipopt.bound_frac": 1e-4,
            }
        else:
            options["ipopt.mu_strategy"] = "adaptive"
        program = {"x": ca.vertcat(*unknowns), "f": cost, "g": ca.vertcat(*g)}
        solver = ca.nlpsol("solver", "ipopt", program, options)
        begun = time.process_time()
        flat = lambda parts: np.concatenate([np.asarray(p, float) for p in parts])
        result = solver(x0=flat(start), lbx=flat(lbx), ubx=flat(ubx), lbg=flat(lbg), ubg=flat(ubg))
        stats = solver.stats()
        out = ca.Function("out", [program["x"]], [x, y, psi, lengths, v])(result["x"])
        solution = Arcs(*[np.array(o).ravel() for o in out])
        self.log(
            f"    {stats['return_status']}, {stats['iter_count']} iterations, "
            f"{time.process_time() - begun:.1f} s: {solution.duration:.4f} s, "
            f"{solution.s[-1]:.3f} m, offset <= {np.abs(np.array(result['x'][:n])).max():.3f}"
        )
        self.success = stats["success"]
        return solution

    def goal_box(self, inset=0.0):
        """An open square about the goal that holds the disc: x and y from, x and y to."""
        g = np.repeat(self.goal[None], 4, axis=0)
        way = np.array([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
        reach = np.minimum(self.world.reach(g, way, self.keep, 1.2), 0.95) - inset
        return (
            self.goal[0] - reach[2],
            self.goal[1] - reach[3],
            self.goal[0] + reach[0],
            self.goal[1] + reach[1],
        )

    def run(self, origin="route", shortest=False):
        """The optimum, from the middle of the hallway or from the drive."""
        if origin == "route":
            line = resampled(centre_line(self.record), self.spacing)
            drive = arcs_through(line, min(self.v_max, 2.0))
        else:
            drive = driven(self.record, self.spacing)
        x, y, heading = self.record["start"]
        drive.psi += 2 * np.pi * np.round((heading - drive.psi[0]) / (2 * np.pi))
        drive.x[0], drive.y[0], drive.psi[0] = x, y, heading
        fine, settled, near, failures = self.spacing, [], False, 0
        try:
            for turn in range(REFERENCES_MAX):
                # Other nodes after a failure: the solver then seldom fails again.
                self.spacing = fine * (COARSE if turn == 0 else 0.94**failures)
                better = self.solve(drive, near and failures == 0, shortest)
                if not self.success and turn > 0 and failures < 3:
                    failures += 1
                    continue
                drive, near, failures = better, self.success, 0
                measure = drive.s[-1] if shortest else drive.duration
                if near and any(abs(measure - m) < CONVERGED * m for m in settled):
                    return drive
                if near and turn > 0:
                    settled.append(measure)
        finally:
            self.spacing = fine
        raise RuntimeError("the reference has not settled")


def check(record, drive, grip_share=1.0):
    """Every limit, from the arcs alone, at steps of 2 mm. Returns the worst figures."""
    world = World(record)
    s = np.append(np.arange(0.0, drive.s[-1], 0.002), drive.s[-1])
    points, _, _ = drive.at(s)
    k, v, l = drive.curvature, drive.v, drive.length
    accel = np.diff(v**2) / (2 * l)
    # On an arc both curvature and acceleration are constant and the speed is monotonous.
    use = np.hypot(accel, k * np.maximum(v[1:], v[:-1]) ** 2)
    middle = 0.5 * (drive.psi[1:] + drive.psi[:-1])
    chord = l * np.sinc(0.5 * np.diff(drive.psi) / np.pi)
    gap = np.hypot(
        np.diff(drive.x) - chord * np.cos(middle), np.diff(drive.y) - chord * np.sin(middle)
    )
    x, y, heading = record["start"]
    return {
        "clearance_lack_m": float(record["keep_m"] - world.distance(points).min()),
        "friction_use": float(use.max() / (grip_share * record["acceleration_limit_mps2"])),
        "curvature_pm": float(np.abs(k).max()),
        "speed_mps": float(v.max()),
        "gap_m": float(gap.max()),
        "start_error": float(
            max(abs(drive.x[0] - x), abs(drive.y[0] - y), abs(drive.psi[0] - heading), v[0])
        ),
        "end_m": float(np.hypot(drive.x[-1] - record["goal"][0], drive.y[-1] - record["goal"][1])),
        "end_speed_mps": float(v[-1]),
    }


def violations(record, figures):
    """What a checked drive breaks beyond rounding."""
    limits = {
        "clearance_lack_m": 1e-3,
        "friction_use": 1 + 1e-6,
        "curvature_pm": (1 + 1e-6) / record["turn_radius_m"],
        "speed_mps": record["speed_max_mps"] * (1 + 1e-6),
        "gap_m": 1e-6,
        "start_error": 1e-6,
        "end_m": record["goal_radius_m"] * (1 + 1e-6),
        "end_speed_mps": 1e-6,
    }
    return [f"{key} is {figures[key]:.6g}, allowed {limits[key]:.6g}" for key in limits
            if not figures[key] <= limits[key]]


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("files", nargs="+", type=Path, help="written by the optimum-export example")
    options.add_argument("--spacing", type=float, default=0.1, help="metres between nodes")
    options.add_argument("--from", dest="origin", choices=["route", "drive"], default="route",
                         help="first reference: middle of the hallway, or the drive itself")
    options.add_argument("--grip", type=float, default=1.0, help="share of the friction circle")
    options.add_argument("--shortest", action="store_true", help="also the shortest path: a bound")
    options.add_argument("--csv", type=Path, help="table to write")
    options.add_argument("--save", type=Path, help="folder for the optimal drives (npz)")
    options.add_argument("--verbose", action="store_true")
    args = options.parse_args()
    rows, failed = [], False
    for file in args.files:
        record = json.loads(file.read_text())
        optimum = Optimum(record, args.spacing, args.grip, print if args.verbose else None)
        begun = time.process_time()
        drive = optimum.run(args.origin)
        figures = check(record, drive, args.grip)
        broken = violations(record, figures)
        failed |= bool(broken)
        summary = record["summary"]
        known = summary["time_s"] if summary["outcome"] == "goal" else float("nan")
        row = {
            "seed": record["seed"],
            "speed_max_mps": record["speed_max_mps"],
            "optimum_s": round(drive.duration, 4),
            "optimum_m": round(float(drive.s[-1]), 3),
            "known_map_s": round(known, 3),
            "known_map_m": round(summary["path_m"], 3),
            "ratio": round(known / drive.duration, 5),
            "clearance_lack_mm": round(1e3 * figures["clearance_lack_m"], 3),
        }
        if args.shortest:
            length = optimum.run(args.origin, shortest=True).s[-1]
            v, grip = record["speed_max_mps"], args.grip * record["acceleration_limit_mps2"]
            row["bound_s"] = round(float(length / v + v / grip), 4)
        rows.append(row)
        print(f"{file.name}: {row} ({time.process_time() - begun:.0f} s)", flush=True)
        for text in broken:
            print(f"    BROKEN: {text}", flush=True)
        if args.csv:
            with args.csv.open("w", newline="") as out:
                writer = csv.DictWriter(out, rows[0].keys(), lineterminator="\n")
                writer.writeheader()
                writer.writerows(rows)
        if args.save:
            args.save.mkdir(parents=True, exist_ok=True)
            np.savez_compressed(args.save / f"{file.stem}.npz", x=drive.x, y=drive.y,
                                psi=drive.psi, length=drive.length, v=drive.v)
    ratios = np.array([row["ratio"] for row in rows])
    arrived = ratios[~np.isnan(ratios)]
    if len(arrived):
        print(f"{len(arrived)} of {len(ratios)} drives arrived; ratio mean {arrived.mean():.4f}, "
              f"worst {arrived.max():.4f}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
