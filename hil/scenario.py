"""Scenario files: what is read from hil/scenarios/*.toml, checked key by key."""

import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

FOLDER = Path(__file__).parent / "scenarios"

# What a step may do; a word with a value takes one.
ACTIONS = {
    "kill daemon": None,
    "stop daemon": None,
    "continue daemon": None,
    "terminate daemon": None,
    "reload daemon": None,
    "start daemon": None,
    "kill car": None,
    "link down": None,
    "link up": None,
    "netem": str,
    "flood": int,
    "send": str,
    "clock": float,
    "fill disk": None,
    "finish": None,
}


class Mistake(Exception):
    """Something is wrong with a scenario file."""


@dataclass
class Step:
    """Waits until everything under `when` holds, then does something."""

    do: str
    value: object
    # Speed reached (m/s), turning at least this fast (rad/s), time since the first motion (s), time
    # since the last step (s), at rest for so long (s).
    when: dict


WHEN = {"speed_mps", "turning_rad_s", "moving_s", "after_s", "rest_s"}


@dataclass
class Scenario:
    name: str
    title: str
    speed_mps: float
    limit_s: float
    world: dict
    car: dict
    daemon: dict
    steps: list
    expect: dict
    cost_s: float = 0.0
    about: str = ""
    needs: list = field(default_factory=list)


EXPECT = {
    # How the drive ends by the car's own account: "goal", or "rest" for a car that came to rest.
    "end",
    # Names of faults that the daemon must have raised, each with the longest time that its detection
    # may take here, in seconds (ten times the limit of the failsafe table).
    "faults",
    # Names of faults that it must not raise.
    "no_faults",
    # The car is at rest at most so long after the last step that asks for it (s).
    "stopped_within_s",
    # From that rest on the car must not move again.
    "stays",
    # How the daemon's first process ends: an exit code or the name of a signal.
    "daemon_exit",
    # Text that the daemon's log must have, and the log of the daemon started anew.
    "log",
    "restarted_log",
    # Limits of figures: {"name": [lowest, highest]}.
    "figures",
}


def take(table, key, kind, default, where):
    value = table.pop(key, default)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if value is not None and not isinstance(value, kind):
        raise Mistake(f"{where}: {key} = {value!r} is no {kind.__name__}")
    return value


def step(table, where):
    do = table.pop("do", None)
    if not isinstance(do, str):
        raise Mistake(f"{where}: a step needs `do`")
    for word in sorted(ACTIONS, key=len, reverse=True):
        kind = ACTIONS[word]
        if do == word and kind is None:
            value = None
            break
        if kind is not None and do.startswith(word + " "):
            try:
                value = kind(do[len(word) + 1 :])
            except ValueError:
                raise Mistake(f"{where}: {do!r}: not a {kind.__name__}") from None
            break
    else:
        raise Mistake(f"{where}: unknown action {do!r}; known: {', '.join(ACTIONS)}")
    unknown = set(table) - WHEN
    if unknown:
        raise Mistake(f"{where}: unknown {sorted(unknown)}; known: do, {', '.join(sorted(WHEN))}")
    return Step(word, value, {key: float(table[key]) for key in table})


def read(path):
    """The scenario of one file."""
    where = path.name
    try:
        table = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise Mistake(f"{where}: {error}") from None
    if not re.fullmatch(r"[a-z0-9-]+", path.stem):
        raise Mistake(f"{where}: a name is made of a-z, 0-9 and -")
    expect = take(table, "expect", dict, {}, where)
    unknown = set(expect) - EXPECT
    if unknown:
        raise Mistake(f"{where}: unknown expectations {sorted(unknown)}")
    if expect.get("end") not in ("goal", "rest"):
        raise Mistake(f'{where}: expect.end must be "goal" or "rest"')
    world = take(table, "world", dict, {}, where)
    car = take(table, "car", dict, {}, where)
    daemon = take(table, "daemon", dict, {}, where)
    for name, part, known in (
        ("world", world, {"maze", "family", "map", "start", "goal"}),
        ("car", car, {"set", "script", "seed"}),
        ("daemon", daemon, {"set", "small_disk"}),
    ):
        if set(part) - known:
            raise Mistake(f"{where}: unknown {sorted(set(part) - known)} in {name}")
    scenario = Scenario(
        name=path.stem,
        title=take(table, "title", str, path.stem, where),
        speed_mps=take(table, "speed_mps", float, 3.0, where),
        limit_s=take(table, "limit_s", float, 60.0, where),
        cost_s=take(table, "cost_s", float, 10.0, where),
        needs=take(table, "needs", list, [], where),
        world=world,
        car=car,
        daemon=daemon,
        steps=[
            step(entry, f"{where}, step {number + 1}")
            for number, entry in enumerate(take(table, "step", list, [], where))
        ],
        expect=expect,
    )
    if table:
        raise Mistake(f"{where}: unknown {sorted(table)}")
    return scenario


def all_of(names=()):
    """The scenarios with these names (a name may end in *), or every one there is."""
    files = {path.stem: path for path in sorted(FOLDER.glob("*.toml"))}
    chosen = list(files)
    if names:
        chosen = []
        for name in names:
            pattern = re.compile(re.escape(name).replace(r"\*", ".*") + r"\Z")
            found = [stem for stem in files if pattern.match(stem)]
            if not found:
                raise Mistake(f"no scenario {name}; there are: {', '.join(files)}")
            chosen += [stem for stem in found if stem not in chosen]
    return [read(files[stem]) for stem in chosen]
