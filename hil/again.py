"""Names the scenarios that are to be played a second time, and puts their first try aside.

Usage: again.py DIR SCENARIO...

Everything here happens in real time. On a machine with other work a guest is now and then left
without a processor for longer than the car's watchdogs wait: then the car stops, as it should, and
the scenario fails for a reason that is not apexd's. So what failed is played once more, alone. But
no machine is slow enough to excuse a contact or a metre into unknown space: those stay failures.
"""

import json
import sys
from pathlib import Path

import scenario as scenarios

# What a folder of a first try ends in.
FIRST = ".first"


def excusable(folder):
    try:
        result = json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return True
    if "skipped" in result or result["passed"]:
        return False
    car = result.get("car") or {}
    return not any(car.get(count) for count in ("collisions", "unknown_entries"))


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
