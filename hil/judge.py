"""Says whether a scenario went as it should: by the truth that the car wrote, how the processes ended,
and what the daemon said of itself."""

import json
import re
from datetime import datetime

# Slower than this is at rest (m/s), and a car at rest does not move further than this (m).
REST_MPS = 0.02
CREEP_M = 0.02


def judge(play, ends, broken, wake_late_ms):
    """`wake_late_ms`: what the pulse has felt (stage.Pulse), or None."""
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
        "foreign_hz": play.foreign_hz,
        "packets_hz": play.packets_hz,
        "load": play.load,
        "wake_late_ms": wake_late_ms,
        # Faults that were raised because the machine itself stood still.
        "excused": [],
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
    resting = rest(truth, play.struck_s())
    result["rest"] = resting
    if expect["end"] == "goal":
        if end["outcome"] != "goal":
            failures.append(f"the drive ended with {end['outcome']}, not at the goal")
    elif resting["stopped_t_s"] is None or abs(truth.state["speed_mps"]) > REST_MPS:
        failures.append(f"the car is not at rest: {truth.state['speed_mps']:.2f} m/s")
    if truth.moving_since is None:
        failures.append("the car never moved")

    steps_left = len(s.steps) - len(play.done) - any(step.do == "finish" for step in s.steps)
    if steps_left > 0:
        failures.append(f"{steps_left} steps were never due")

    limit_s = expect.get("stopped_within_s")
    if limit_s is not None and resting["stopped_t_s"] is not None:
        if resting["stop_s"] is None:
            failures.append("nothing happened to the car")
        elif resting["stop_s"] > limit_s:
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


def rest(truth, struck):
    """When the car came to rest first after `struck` (car's time; None: at the very end), how far it
    went until then, and how far it was from there later on."""
    states = states_of(truth.path)
    found = {"stopped_t_s": None, "stop_s": None, "stop_m": None, "crept_m": 0.0}
    if truth.moving_since is None or not states:
        return found
    after = max(truth.moving_since, struck if struck is not None else states[-1]["t_s"])
    still = [s for s in states if s["t_s"] >= after and abs(s["speed_mps"]) <= REST_MPS]
    if not still:
        return found
    stopped = still[0]
    found["stopped_t_s"] = stopped["t_s"]
    if struck is not None:
        between = [s for s in states if struck <= s["t_s"] <= stopped["t_s"]]
        found["stop_s"] = round(stopped["t_s"] - struck, 3)
        found["stop_m"] = round(sum(distance(a, b) for a, b in zip(between, between[1:])), 3)
    later = (s for s in states if s["t_s"] >= stopped["t_s"])
    found["crept_m"] = round(max(distance(stopped, s) for s in later), 3)
    return found


def states_of(path):
    with path.open() as file:
        entries = (json.loads(line) for line in file if line.endswith("\n"))
        return [entry for entry in entries if entry["kind"] == "state"]


def distance(a, b):
    return ((a["x_m"] - b["x_m"]) ** 2 + (a["y_m"] - b["y_m"]) ** 2) ** 0.5


# A fault in the daemon's log: the clock, the name, the core's own time.
RAISED = re.compile(r'^(\S+Z) +(?:WARN|INFO) ([a-z ]+)(?:: .*)? t_s="([\d.]+)"$', re.M)


def raised(log):
    """When each fault was raised, every time, by the wall clock. A line is written after the fact; the
    shortest delay of any line is taken for none."""
    found = [
        (datetime.fromisoformat(stamp.replace("Z", "+00:00")).timestamp(), name, float(t_s))
        for stamp, name, t_s in RAISED.findall(log)
    ]
    zero = min((at - t_s for at, _, t_s in found), default=0.0)
    times = {}
    for _, name, t_s in found:
        if not name.endswith(" is over"):
            times.setdefault(name, []).append(zero + t_s)
    return times


# What a stall of the machine brings about shows so long after it at most, and the two clocks are read
# that far apart (s).
AFTERMATH_S = 0.2
CLOCKS_S = 0.02


def stalled(stalls, at):
    """Whether the machine stood still at this time, or just before."""
    return any(
        end - 1e-3 * late_ms - CLOCKS_S <= at <= end + AFTERMATH_S for end, late_ms in stalls
    )


def daemon_faults(play, daemon, result, failures):
    """Which faults the daemon raised, and how soon after what happened."""
    expect = play.scenario.expect
    log = play.daemons[0].log.read_text(errors="replace")
    struck, zero = play.struck_s(), play.truth.wall_zero_s
    known = result["faults"] = {}
    at = raised(log)
    for fault in (daemon or {}).get("faults", []):
        known[fault["name"]] = None
    for name, (when, *_) in at.items():
        # "at the goal" and the like are in the same form; of a daemon that was killed they are all
        # there is.
        if name in known or daemon is None:
            known[name] = None if struck is None else round(when - zero - struck, 3)
    for name, limit_s in expect.get("faults", {}).items():
        if name not in known:
            failures.append(f"the daemon did not raise: {name}")
        elif limit_s is True:
            continue
        elif known[name] is None:
            failures.append(f"nothing to count the detection of {name} from")
        elif not -0.05 <= known[name] <= limit_s:
            failures.append(f"{name}: raised after {known[name]:.3f} s, not {limit_s} s")
    stalls = (result["wake_late_ms"] or {}).get("stalls", [])
    counts = {fault["name"]: fault["count"] for fault in (daemon or {}).get("faults", [])}
    for name in expect.get("no_faults", []):
        if name not in known:
            continue
        times = at.get(name, [])
        if len(times) == counts.get(name, len(times)) and all(stalled(stalls, when) for when in times):
            result["excused"].append(name)
        else:
            failures.append(f"the daemon raised: {name}")


def look_up(result, path):
    value = result
    for key in path.split("."):
        if not isinstance(value, dict):
            return None
        value = value.get(key)
    return value
