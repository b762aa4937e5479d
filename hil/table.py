"""The results of all scenarios in a folder as a table and as one JSON file.

Usage: table.py DIR SCENARIO... ; exits with 1 unless every scenario named has passed.
"""

import json
import sys
from pathlib import Path

import scenario as scenarios
from again import TRIES, earlier, read, stood_still


def verdict(result):
    return "ok" if result["passed"] else "FAILED"


COLUMNS = [
    ("scenario", "<26", lambda r: r["name"]),
    ("", "<6", verdict),
    ("end", "<12", lambda r: r["car"]["outcome"]),
    ("time s", ">6", lambda r: f"{r['car']['time_s']:.1f}"),
    ("max m/s", ">7", lambda r: f"{r['speed_max_mps']:.2f}"),
    ("clear m", ">7", lambda r: f"{r['car']['min_clearance_m']:.3f}"),
    ("stop s", ">6", lambda r: f"{r['rest']['stop_s']:.2f}"),
    ("stop m", ">6", lambda r: f"{r['rest']['stop_m']:.2f}"),
    ("plan99", ">6", lambda r: f"{r['daemon']['plan_ms']['p99']:.1f}"),
    ("act99", ">6", lambda r: f"{r['daemon']['scan_to_setpoint_ms']['p99']:.1f}"),
    ("jit99", ">6", lambda r: f"{r['daemon']['tick_jitter_ms']['p99']:.2f}"),
    ("cpu", ">5", lambda r: f"{r['daemon']['cpu']['mean']:.2f}"),
    ("wake99", ">6", lambda r: f"{r['wake_late_ms']['p99']:.2f}"),
    ("stall", ">5", lambda r: f"{longest_stall_ms(r['wake_late_ms']):.0f}"),
    ("faults (s until raised)", "<", lambda r: faults(r["faults"])),
]
LEGEND = (
    "clear: least distance to an obstacle; stop: from the first thing done to rest; ms, 99th "
    "percentile: plan: a planning step,\nact: last frame of a scan to the first setpoint of the plan "
    "made from it, jit: lateness of control ticks; cpu: cores, the daemon "
    "alone; wake:\nlateness of a program that goes before all others; stall: the same at worst, in one go "
    "or by several delays in a\nrow: the machine itself did not run"
)


def longest_stall_ms(late):
    """Of one delay or of several in a row."""
    return max([late["max"], *(late_ms for _, late_ms in late["stalls"])])


def faults(raised):
    """Those raised after something happened, in this order; then those without a time."""
    timed = sorted((after, name) for name, after in raised.items() if (after or -1) > -0.05)
    words = [f"{name} {after:.2f}" for after, name in timed]
    return ", ".join(words + [name for name, after in raised.items() if after is None])


def cell(row, make):
    try:
        return make(row)
    except (KeyError, TypeError):
        return "-"


def tell(failures):
    for failure in failures:
        print("    " + str(failure).replace("\n", "\n    "))


def stall(result):
    """The longest stall of the machine in words."""
    late = (result or {}).get("wake_late_ms")
    known = f"up to {longest_stall_ms(late):.0f} ms" if late else "nobody knows how long"
    return f"the machine stood still for {known}"


def main():
    out = Path(sys.argv[1])
    results, missing, skipped, unjudged = [], [], [], []
    for one in scenarios.all_of(sys.argv[2:]):
        folder = out / one.name
        result = read(folder)
        if result is None:
            missing.append(one.name)
            continue
        result["earlier"] = [read(aside) for aside in earlier(folder)]
        tries = [folder, *earlier(folder)]
        if "skipped" in result:
            skipped.append(result)
        elif not result["passed"] and len(tries) == TRIES and all(map(stood_still, tries)):
            unjudged.append(result)
        else:
            results.append(result)
    print(" ".join(f"{title:{form}}" for title, form, _ in COLUMNS).rstrip())
    for row in results + unjudged:
        print(" ".join(f"{cell(row, make):{form}}" for _, form, make in COLUMNS).rstrip())
        tell(row["failures"])
        if row.get("excused"):
            print(f"    raised because {stall(row)}: {', '.join(row['excused'])}")
        for number, aside in enumerate(row["earlier"], 1):
            print(f"    try {number} ({stall(aside)}):")
            tell(aside["failures"] if aside else ["it was not played to its end"])
        if row in unjudged:
            print(f"    not judged: {stall(row)}, and did in every try")
    for name in missing:
        print(f"{name:26} FAILED\n    it was not played to its end")
    for row in skipped:
        print(f"{row['name']:26} not played: {row['skipped']}")
    print(LEGEND)
    failed = sum(not row["passed"] for row in results) + len(missing)
    passed = len(results) + len(missing) - failed
    (out / "results.json").write_text(
        json.dumps(
            {
                "passed": passed,
                "failed": failed,
                "skipped": len(skipped) + len(unjudged),
                "scenarios": results + unjudged,
            },
            indent=1,
        )
        + "\n"
    )
    repeated = sum(bool(row["earlier"]) for row in results)
    if repeated:
        print(f"\n{repeated} played again")
    if unjudged:
        print(f"\n{len(unjudged)} not judged: this machine stood still too often for real time")
    print(f"\nHIL: {passed} passed, {failed} failed, {len(skipped) + len(unjudged)} skipped")
    sys.exit(1 if failed or not passed else 0)


if __name__ == "__main__":
    main()
