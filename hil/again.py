"""Names the scenarios that are to be played once more, and puts their last try aside.

Usage: again.py DIR SCENARIO...

Everything here happens in real time. On a machine with other work a guest is now and then left
without a processor for longer than the car's watchdogs wait: then the car stops, as it should, and
the scenario fails for a reason that is not apexd's. So what failed while the machine itself was late
by more than a control period is played once more, alone, up to three times in all; a machine that
stood still in each of them cannot judge the scenario. But no machine is slow enough to excuse a
contact or a metre into unknown space: those stay failures.
"""

import json
import sys
from pathlib import Path

import scenario as scenarios

TRIES = 3


def earlier(folder):
    """The folders of the tries that were put aside, first one first."""
    asides = (folder.with_name(f"{folder.name}.try-{number}") for number in range(1, TRIES))
    return [aside for aside in asides if aside.exists()]


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


def read(folder):
    """The result in a folder, None if there is none."""
    try:
        return json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return None


def stood_still(folder):
    """Whether the machine stood still in a try that failed, and nothing was touched in it."""
    result = read(folder)
    return bool(result and (result["wake_late_ms"] or {}).get("stalls")) and not touched(folder)


def excusable(folder):
    """Whether a try is to be repeated."""
    result = read(folder)
    if result is None:
        # The guest did not come to play it to its end.
        return not touched(folder)
    if "skipped" in result or result["passed"]:
        return False
    # Where it could not be measured, nobody knows.
    return stood_still(folder) or (result["wake_late_ms"] is None and not touched(folder))


def main():
    out = Path(sys.argv[1])
    for one in scenarios.all_of(sys.argv[2:]):
        folder = out / one.name
        tries = len(earlier(folder)) + 1
        if tries < TRIES and excusable(folder):
            folder.mkdir(exist_ok=True)
            folder.rename(folder.with_name(f"{one.name}.try-{tries}"))
            print(one.name)


if __name__ == "__main__":
    main()
