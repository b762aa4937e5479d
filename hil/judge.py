"""Says whether a scenario went as it should: by the truth that the car wrote, how the processes ended,
and what the daemon said of itself."""

import re
from datetime import datetime, timezone

# Slower than this is at rest (m/s), and a car at rest does not move further than this (m).
REST_MPS = 0.02
CREEP_M = 0.02


def judge(play, ends, broken):
    s, truth = play.scenario, play.truth
    expect = s.expect
    failures = [broken] if broken else []
    end = truth.end
    daemon = play.daemons[0].result() if play.daemons else None
    result = {
        "name": s.name,
        "title": s.title,
        "passed": False,
        "failures": failures,
        "speed_mps": s.speed_mps,
        "speed_max_mps": truth.speed_max,
        "car": end,
        "daemon": daemon,
        "daemon_ends": ends,
        "steps": play.done,
        "foreign_frames": play.foreign,
    }
    if broken:
        return result

    # What holds whatever happens.
    if end is None:
        failures.append(f"the car's truth has no end; its log says: {play.car.tail(3)}")
        return result
    for count in ("collisions", "unknown_entries"):
        if end[count]:
            failures.append(f"{count}: {end[count]}")
    resting = rest(truth, play.done)
    result["rest"] = resting
    if expect["end"] == "goal":
        if end["outcome"] != "goal":
            failures.append(f"the drive ended with {end['outcome']}, not at the goal")
    elif resting["stopped_t_s"] is None:
        failures.append(f"the car is not at rest: {truth.state['speed_mps']:.2f} m/s")
    if truth.moving_since is None:
        failures.append("the car never moved")

    steps_left = len(s.steps) - len(play.done) - any(step.do == "finish" for step in s.steps)
    if steps_left > 0:
        failures.append(f"{steps_left} steps were never due")

    limit_s = expect.get("stopped_within_s")
    if limit_s is not None and resting["stopped_t_s"] is not None:
        if resting["stop_s"] > limit_s:
            failures.append(f"at rest after {resting['stop_s']:.2f} s, not {limit_s} s")
    if expect.get("stays") and resting["crept_m"] > CREEP_M:
        failures.append(f"moved {resting['crept_m']:.2f} m after it had come to rest")

    if "daemon_exit" in expect and ends[:1] != [expect["daemon_exit"]]:
        failures.append(f"the daemon ended with {ends[:1]}, not {expect['daemon_exit']}")
    daemon_faults(play, daemon, result, failures)

    for key, number in (("log", 0), ("restarted_log", 1)):
        for wanted in expect.get(key, []):
            log = play.daemons[number].log.read_text() if number < len(play.daemons) else ""
            if not re.search(wanted, log):
                failures.append(f"the daemon's log {number + 1} does not have {wanted!r}")
    for path, (lowest, highest) in expect.get("figures", {}).items():
        value = look_up(result, path)
        if not isinstance(value, (int, float)) or not lowest <= value <= highest:
            failures.append(f"{path} = {value}, not within {lowest} to {highest}")
    result["passed"] = not failures
    return result


def rest(truth, done):
    """When the car came to rest after the first thing done to it, and how it went on."""
    struck = done[0]["t_s"] if done else None
    states = states_of(truth)
    stopped = None
    for state in states:
        if struck is not None and state["t_s"] < struck:
            continue
        if abs(state["speed_mps"]) > REST_MPS:
            stopped = None if struck is None else stopped
        elif stopped is None and (truth.moving_since or 1e9) < state["t_s"]:
            stopped = state
    found = {"stopped_t_s": None, "stop_s": None, "stop_m": None, "crept_m": 0.0}
    if stopped is None:
        return found
    found["stopped_t_s"] = stopped["t_s"]
    if struck is not None:
        at = min(states, key=lambda state: abs(state["t_s"] - struck))
        between = [s for s in states if struck <= s["t_s"] <= stopped["t_s"]]
        found["stop_s"] = stopped["t_s"] - struck
        found["stop_m"] = path(between) if between else distance(at, stopped)
    found["crept_m"] = max(distance(stopped, s) for s in states if s["t_s"] >= stopped["t_s"])
    return found


def states_of(truth):
    import json

    with truth.path.open() as file:
        entries = (json.loads(line) for line in file if line.endswith("\n"))
        return [entry for entry in entries if entry["kind"] == "state"]


def distance(a, b):
    return ((a["x_m"] - b["x_m"]) ** 2 + (a["y_m"] - b["y_m"]) ** 2) ** 0.5


def path(states):
    return sum(distance(a, b) for a, b in zip(states, states[1:]))


def daemon_faults(play, daemon, result, failures):
    """Which faults the daemon raised, and how soon after what was done to it."""
    expect = play.scenario.expect
    wanted = expect.get("faults", {})
    raised = {}
    log = play.daemons[0].log.read_text(errors="replace")
    for stamp, name in re.findall(r"^(\S+Z)\s+\w+ .*?fault raised: ([a-z -]+?)\s*$", log, re.M):
        at = datetime.fromisoformat(stamp.replace("Z", "+00:00")).timestamp()
        raised.setdefault(name, at)
    result["faults"] = {}
    for name, at in raised.items():
        cause = play.cause(name)
        result["faults"][name] = None if cause is None else round(at - cause, 4)
    if daemon:
        for fault in daemon.get("faults", []):
            result["faults"].setdefault(fault["name"], None)
    for name, limit_s in wanted.items():
        if name not in result["faults"]:
            failures.append(f"the daemon did not raise: {name}")
            continue
        after_s = result["faults"][name]
        if after_s is None:
            failures.append(f"nothing to measure the detection of {name} from")
        elif not -0.02 <= after_s <= limit_s:
            failures.append(f"{name}: raised after {after_s:.3f} s, not {limit_s} s")
    for name in expect.get("no_faults", []):
        if name in result["faults"]:
            failures.append(f"the daemon raised: {name}")


def look_up(result, path):
    value = result
    for key in path.split("."):
        if not isinstance(value, dict):
            return None
        value = value.get(key)
    return value


def now():
    return datetime.now(timezone.utc).timestamp()
