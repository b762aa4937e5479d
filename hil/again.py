"""Names the scenarios that are to be played a second time, and puts their first try aside.

Usage: again.py DIR SCENARIO...

Everything here happens in real time. On a machine with other work a guest is now and then left
without a processor for longer than the car's watchdogs wait: then the car stops, as it should, and
the scenario fails for a reason that is not apexd's. So what failed while the machine itself was late
by more than a control period is played once more, alone. But no machine is slow enough to excuse a
contact or a metre into unknown space: those stay failures.
"""

import json
import sys
from pathlib import Path

import scenario as scenarios

# What a folder of a first try ends in.
FIRST = ".first"
# The daemon's control period, ms.
LATE_MS = 10.0


def touched(folder):
    """Whether the car's truth has a contact or an entry into unknown space."""
    try:
        lines = (folder / "truth.jsonl").read_text().splitlines()
    except OSError:
        return False
    for line in lines:
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if any(entry.get(flag) for flag in ("contact", "unknown_entry", "collisions", "unknown_entries")):
            return True
    return False


def excusable(folder):
    if touched(folder):
        return False
    try:
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        # The guest did not come to play it to its end.
        return True
    if "skipped" in result or result["passed"]:
        return False
    # Where it could not be measured, nobody knows.
    late = result.get("wake_late_ms")
    return late is None or late["max"] > LATE_MS


def main():
    out = Path(sys.argv[1])
    for one in scenarios.all_of(sys.argv[2:]):
        folder = out / one.name
        if excusable(folder):
            if folder.exists():
                folder.rename(out / (one.name + FIRST))
            print(one.name)


if __name__ == "__main__":
    main()
