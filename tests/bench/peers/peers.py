#!/usr/bin/env python3
"""Other programs on the inputs of one planning step: speed profile, smoothing, and both at once.

    peers.py target/peers.json

Reads what `peers-export` wrote, gives the same tasks to trajectory-planning-helpers, toppra, cvxpy
(with Clarabel and ECOS) and casadi (with IPOPT), and prints wall times and results as ratios to
this program's. Times of cvxpy include its translation into cone form; the solver's own are beside
them. The programs smooth in one pass what this one smooths in several.
"""

import argparse
import json
import time

import casadi as ca
import cvxpy as cp
import numpy as np
import toppra
import toppra.algorithm
import toppra.constraint
from trajectory_planning_helpers.calc_vel_profile import calc_vel_profile

toppra.setup_logging("ERROR")


def median_ms(work, repeats):
    """The last result, and the median wall time."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        result = work()
        times.append(1e3 * (time.perf_counter() - begun))
    return result, float(np.median(times))


def travel_time(s, kappa, accel, v_max, edges=1):
    """Time of the fastest profile from rest to rest on a path, friction kept at both ends of an edge.

    The judge of all shapes, this program's too: a forward and a backward pass, written here on its own.
    """
    b = np.minimum(v_max**2, accel / np.maximum(np.abs(kappa), 1e-9))
    b[0] = b[-1] = 0.0
    for order in (range(len(s) - 2, -1, -1), range(1, len(s))):
        step = 1 if order.step == -1 else -1
        for i in order:
            j = i + step
            ds = abs(s[j] - s[i])
            room = lambda c, k: np.sqrt(max(accel**2 - (k * c) ** 2, 0.0))
            low, high = 0.0, b[i]
            fits = lambda c: abs(c - b[j]) <= 2 * ds * min(room(c, kappa[i]), room(b[j], kappa[j])) or c <= b[j]
            if not fits(high):
                for _ in range(40):
                    middle = 0.5 * (low + high)
                    low, high = (middle, high) if fits(middle) else (low, middle)
                b[i] = low
    v = np.sqrt(b)
    return float(np.sum(2 * np.diff(s) / np.maximum(v[1:] + v[:-1], 1e-9)))


def geometry(points):
    """Arc lengths and curvatures (through three points) of a polyline."""
    d = np.diff(points, axis=0)
    lengths = np.linalg.norm(d, axis=1)
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    cross = d[:-1, 0] * d[1:, 1] - d[:-1, 1] * d[1:, 0]
    chord = np.linalg.norm(points[2:] - points[:-2], axis=1)
    kappa = 2 * cross / (lengths[:-1] * lengths[1:] * chord)
    return s, np.concatenate([[kappa[0]], kappa, [kappa[-1]]])


def resampled(points, spacing):
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0, s[-1], int(np.ceil(s[-1] / spacing)) + 1)
    return np.stack([np.interp(at, s, points[:, k]) for k in (0, 1)], 1)


def clearance(record, p):
    """Distance to the corridor's walls."""
    line = np.array(record["line"])
    a, d = line[:-1], np.diff(line, axis=0)
    t = np.clip(np.sum((p - a) * d, axis=1) / np.sum(d * d, axis=1), 0, 1)
    return record["half_width_m"] - np.min(np.linalg.norm(p - (a + d * t[:, None]), axis=1))


# --- speed on a given path -----------------------------------------------------------------------


def speed_tph(s, kappa, accel, v_max):
    ggv = np.array([[0.0, accel, accel], [v_max, accel, accel]])
    machine = np.array([[0.0, 100.0], [v_max, 100.0]])
    v = calc_vel_profile(ax_max_machines=machine, kappa=kappa, el_lengths=np.diff(s), closed=False,
                         drag_coeff=0.0, m_veh=2.5, ggv=ggv, v_max=v_max, dyn_model_exp=2.0,
                         v_start=1e-3, v_end=1e-3)
    return float(np.sum(2 * np.diff(s) / (v[1:] + v[:-1])))


def speed_toppra(s, points, accel, v_max, sides=32):
    # A third joint, the arc length, carries the speed limit; friction is a polygon inside the circle.
    path = toppra.SplineInterpolator(s, np.column_stack([points, s]))
    angles = 2 * np.pi * np.arange(sides) / sides
    normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(sides)])
    friction = toppra.constraint.SecondOrderConstraint(
        lambda q, qd, qdd: qdd, lambda q: normals,
        lambda q: np.full(sides, accel * np.cos(np.pi / sides)), 3)
    limits = np.array([[-99.0, 99.0], [-99.0, 99.0], [-v_max, v_max]])
    speed = toppra.constraint.JointVelocityConstraint(limits)
    solver = toppra.algorithm.TOPPRA([speed, friction], path, gridpoints=s, solver_wrapper="seidel")
    _, sd, _ = solver.compute_parameterization(0, 0, return_data=True)
    return float(np.sum(2 * np.diff(s) / np.maximum(sd[1:] + sd[:-1], 1e-9)))


def speed_cvxpy(s, kappa, accel, v_max, solver):
    ds = np.diff(s)
    n = len(s)
    b, root, t = cp.Variable(n), cp.Variable(n), cp.Variable(n - 1)
    a = cp.multiply(1 / (2 * ds), b[1:] - b[:-1])
    at = lambda end: cp.norm(cp.vstack([a, cp.multiply(kappa[end], b[end])]), 2, axis=0) <= accel
    constraints = [b >= 0, b <= v_max**2, b[0] == 0, b[-1] == 0, root <= cp.sqrt(b),
                   t >= cp.inv_pos(root[1:] + root[:-1]), at(slice(0, n - 1)), at(slice(1, n))]
    problem = cp.Problem(cp.Minimize(cp.sum(cp.multiply(2 * ds, t))), constraints)
    problem.solve(solver=solver)
    return problem.value, 1e3 * problem.solver_stats.solve_time


# --- smoothing -----------------------------------------------------------------------------------


def smooth_cvxpy(record, solver, spacing=0.095, length_weight=0.1):
    """The quadratic program of Zhu, Schmerling and Pavone (2015) with a price on length."""
    p = resampled(np.array(record["guide"]), spacing)
    d = float(np.mean(np.linalg.norm(np.diff(p, axis=0), axis=1)))
    radii = np.array([max(clearance(record, q) - record["radius_m"], 1e-3) for q in p])
    q = cp.Variable(p.shape)
    bends = 2 * q[1:-1] - q[:-2] - q[2:]
    heading = np.array([np.cos(record["heading_rad"]), np.sin(record["heading_rad"])])
    constraints = [q[0] == p[0], q[-1] == p[-1], q[1] == p[0] + d * heading,
                   cp.norm(q[2:-1] - p[2:-1], 2, axis=1) <= radii[2:-1],
                   cp.norm(bends, 2, axis=1) <= d * d / record["turn_radius_m"]]
    length = cp.sum_squares(q[1:] - q[:-1]) / d**2
    cost = cp.sum_squares(bends) / d**4 + length_weight * length
    problem = cp.Problem(cp.Minimize(cost), constraints)
    problem.solve(solver=solver)
    return q.value, 1e3 * problem.solver_stats.solve_time


# --- path and speed at once ----------------------------------------------------------------------


def whole_nlp(record, spacing=0.2):
    """Shortest time over offsets from a reference line and speeds, with IPOPT."""
    reference = resampled(np.array([[p["x"], p["y"]] for p in record["path"]]), spacing)
    tangent = np.gradient(reference, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])

    def room(i, sign):
        free = 0.0
        while free < 1.5 and clearance(record, reference[i] + sign * (free + 0.02) * normal[i]) >= record["radius_m"]:
            free += 0.02
        return free

    n = len(reference)
    high = np.array([room(i, 1) for i in range(n)])
    low = -np.array([room(i, -1) for i in range(n)])
    low[:2] = high[:2] = low[-1:] = high[-1:] = 0.0
    opti = ca.Opti()
    e, v = opti.variable(n), opti.variable(n)
    x, y = reference[:, 0] + e * normal[:, 0], reference[:, 1] + e * normal[:, 1]
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    length = ca.sqrt(dx**2 + dy**2)
    chord = ca.sqrt((x[2:] - x[:-2]) ** 2 + (y[2:] - y[:-2]) ** 2)
    kappa = 2 * (dx[:-1] * dy[1:] - dy[:-1] * dx[1:]) / (length[:-1] * length[1:] * chord)
    along = (v[1:] ** 2 - v[:-1] ** 2) / (2 * length)
    opti.minimize(ca.sum1(2 * length / (v[1:] + v[:-1])))
    opti.subject_to(opti.bounded(low, e, high))
    opti.subject_to(opti.bounded(1e-3, v, record["speed_max_mps"]))
    opti.subject_to([v[0] == 1e-3, v[-1] == 1e-3])
    opti.subject_to(opti.bounded(-1 / record["turn_radius_m"], kappa, 1 / record["turn_radius_m"]))
    accel2 = record["accel_limit_mps2"] ** 2
    lateral = kappa * v[1:-1] ** 2
    opti.subject_to(along[:-1] ** 2 + lateral**2 <= accel2)
    opti.subject_to(along[1:] ** 2 + lateral**2 <= accel2)
    opti.set_initial(e, 0)
    opti.set_initial(v, 1.0)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes"})
    solution = opti.solve()
    return np.column_stack([solution.value(x), solution.value(y)])


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("task", help="what peers-export wrote")
    options.add_argument("--repeats", type=int, default=5)
    args = options.parse_args()
    with open(args.task) as file:
        record = json.load(file)
    path = record["path"]
    s, kappa = (np.array([p[key] for p in path]) for key in ("s", "curvature"))
    points = np.array([[p["x"], p["y"]] for p in path])
    accel, v_max = record["accel_limit_mps2"], record["speed_max_mps"]
    print(f"path of {s[-1]:.1f} m, {len(s)} samples, up to {v_max} m/s\n")
    print("| task | program | ms | times ours | solver alone, ms | drive, s | over ours |")
    print("|---|---|---|---|---|---|---|")

    def row(task, name, ms, ours_ms, alone, time_s, ours_s):
        alone = "" if alone is None else f"{alone:.1f}"
        print(f"| {task} | {name} | {ms:.3f} | {ms / ours_ms:.0f} | {alone} | {time_s:.3f} | {time_s / ours_s:.4f} |")

    ours_ms, ours_s = record["speed_ms"], record["time_s"]
    row("speed", "apexd", ours_ms, ours_ms, None, ours_s, ours_s)
    for name, work in [
        ("trajectory-planning-helpers", lambda: speed_tph(s, kappa, accel, v_max)),
        ("toppra, 32 sides", lambda: speed_toppra(s, points, accel, v_max)),
    ]:
        time_s, ms = median_ms(work, args.repeats)
        row("speed", name, ms, ours_ms, None, time_s, ours_s)
    for solver in (cp.CLARABEL, cp.ECOS):
        (time_s, alone), ms = median_ms(lambda: speed_cvxpy(s, kappa, accel, v_max, solver), args.repeats)
        row("speed", f"cvxpy with {solver}", ms, ours_ms, alone, time_s, ours_s)

    judge = lambda shape: travel_time(*geometry(resampled(shape, 0.05)), accel, v_max)
    ours_ms, ours_s = record["smooth_ms"], judge(points)
    row("smoothing", f"apexd, {record['passes']} passes", ours_ms, ours_ms, None, ours_s, ours_s)
    for solver in (cp.CLARABEL, cp.ECOS):
        (shape, alone), ms = median_ms(lambda: smooth_cvxpy(record, solver), args.repeats)
        row("smoothing", f"cvxpy with {solver}, 1 pass", ms, ours_ms, alone, judge(shape), ours_s)

    ours_ms = record["smooth_ms"] + record["speed_ms"]
    row("both", "apexd", ours_ms, ours_ms, None, ours_s, ours_s)
    shape, ms = median_ms(lambda: whole_nlp(record), 2)
    row("both", "casadi with IPOPT", ms, ours_ms, None, judge(shape), ours_s)


if __name__ == "__main__":
    main()
