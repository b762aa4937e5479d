"""Scenario files: what is read from hil/scenarios/*.toml, checked key by key."""

import fnmatch
import re
import tomllib
from dataclasses import dataclass, replace
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
    # Foreign frames a second; error frames a second; one frame in cansend's notation.
    "flood": int,
    "errors": int,
    "send": str,
    # Share of the processor taken away; name of a thread of the daemon that is held still.
    "hog": float,
    "stop thread": str,
    # What the daemon's configuration file says from now on (TOML).
    "config": str,
    # A goal by MAVLink, x and y in the map frame.
    "goal": str,
    # A ground station is heard, once; it terminates the drive.
    "mavlink heartbeat": None,
    "mavlink terminate": None,
    # Packets a second on the daemon's MAVLink link, of all kinds.
    "mavlink flood": int,
    "mavlink calm": None,
    # Seconds by which the machine's clock is set forward.
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
    # Speed reached (m/s), curvature driven, to either side (1/m), time since the first motion (s), time
    # since the last step (s), at rest for so long (s).
    when: dict


WHEN = {"speed_mps", "curvature_pm", "moving_s", "after_s", "rest_s"}


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
    # Only in a guest of its own: the scenario does to the machine what one does to no other.
    guest: bool = False


EXPECT = {
    # How the drive ends by the car's own account: "goal", or "rest" for a car that came to rest.
    "end",
    # Names of faults that the daemon must have raised, each with the longest time in seconds from the
    # first thing that happened (a step, or an event of the car's script) until then: here ten times
    # the limit of the failsafe table; `true` where nothing happens that it could be counted from.
    "faults",
    # Names of faults that it must not raise.
    "no_faults",
    # The car is at rest at most so long after the first thing that happened (s).
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
        if kind is not None and do.startswith((word + " ", word + "\n")):
            try:
                value = kind(do[len(word) + 1 :])
            except ValueError:
                raise Mistake(f"{where}: {do!r}: not a {kind.__name__}") from None
            break
    else:
        raise Mistake(f"{where}: unknown action {do!r}; known: {', '.join(ACTIONS)}")
    when = take(table, "when", dict, {}, where)
    if table or set(when) - WHEN:
        unknown = sorted(set(table) | set(when) - WHEN)
        raise Mistake(f"{where}: unknown {unknown}; known: do, when, {', '.join(sorted(WHEN))}")
    return Step(word, value, {key: float(when[key]) for key in when})


def read(path):
    """The scenarios of one file: one, or one for each maze of a list."""
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
        ("car", car, {"set", "script", "seed", "stay"}),
        ("daemon", daemon, {"set", "small_disk", "goal", "config"}),
    ):
        if set(part) - known:
            raise Mistake(f"{where}: unknown {sorted(set(part) - known)} in {name}")
    scenario = Scenario(
        name=path.stem,
        title=take(table, "title", str, path.stem, where),
        speed_mps=take(table, "speed_mps", float, 3.0, where),
        limit_s=take(table, "limit_s", float, 60.0, where),
        cost_s=take(table, "cost_s", float, 10.0, where),
        guest=take(table, "guest", bool, False, where),
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
    if "config" not in daemon and any(step.do == "config" for step in scenario.steps):
        raise Mistake(f"{where}: a step changes the configuration file, and daemon.config has none")
    if not isinstance(world.get("maze"), list):
        return [scenario]
    return [
        replace(scenario, name=f"{path.stem}-{maze}", world={**world, "maze": maze})
        for maze in world["maze"]
    ]


def all_of(names=()):
    """The scenarios with these names (a name may end in *), or every one there is."""
    every = [one for path in sorted(FOLDER.glob("*.toml")) for one in read(path)]
    if not names:
        return every
    chosen = []
    for name in names:
        found = [one for one in every if fnmatch.fnmatchcase(one.name, name)]
        if not found:
            raise Mistake(f"no scenario {name}; there are: {', '.join(one.name for one in every)}")
        chosen += [one for one in found if one not in chosen]
    return chosen
