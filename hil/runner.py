"""Plays scenarios on one CAN interface, one after the other: the car and the daemon as two processes.

Usage: runner.py --can IFACE --binary PATH --out DIR [SCENARIO...]

Every scenario gets a folder in DIR, made first: of several runners on the same DIR each takes what
no other has taken. In it: candump.log, truth.jsonl, car.log, daemon.log, result.json.
"""

import argparse
import json
import math
import os
import signal
import sys
import time
from pathlib import Path

import judge
import mavlink
import scenario as scenarios
from stage import (
    CAR_PRIORITY,
    Broken,
    Bus,
    Hog,
    PacketFlood,
    Process,
    Pulse,
    Recorder,
    StoppedThread,
    Truth,
    call,
)

POLL_S = 0.01
# The daemon has this long from its start until the car moves.
START_S = 20.0
# Of the daemon's MAVLink link, where a scenario needs one.
PORT = 14570


class Play:
    """One scenario under way."""

    def __init__(self, scenario, bus, binary, folder):
        self.scenario = scenario
        self.bus = bus
        self.binary = binary
        self.folder = folder
        self.truth = Truth(folder / "truth.jsonl")
        self.config = folder / "daemon.toml"
        self.car = None
        self.daemons = []
        # What was done when: the step's words, the car's time, its speed.
        self.done = []
        self.foreign_hz = 0.0
        self.packets = None
        self.packets_hz = 0.0
        # What weighs on the computer, to be taken off again; a small disk that is mounted.
        self.burdens = []
        self.began = time.monotonic()
        self.cpu_began = time.process_time()
        # Processor time over wall time of the others.
        self.load = {}
        self.disk = None

    @property
    def daemon(self):
        return self.daemons[-1]

    def start_car(self):
        s = self.scenario
        command = [self.binary, "car", "--can", self.bus.interface, "--truth", self.truth.path]
        for key in ("maze", "family"):
            if key in s.world:
                command += [f"--{key}", str(s.world[key])]
        if "map" in s.world:
            command += ["--map", scenarios.FOLDER / s.world["map"]]
        if "start" in s.world:
            command += ["--start=" + ",".join(map(str, s.world["start"]))]
        if "goal" in s.world:
            command += ["--goal=" + ",".join(map(str, s.world["goal"]))]
        if s.car.get("stay"):
            command += ["--stay"]
        if "script" in s.car:
            script = self.folder / "script.toml"
            script.write_text(s.car["script"])
            command += ["--script", script]
        command += ["--seed", str(s.car.get("seed", 1))]
        for setting in s.car.get("set", []):
            command += ["--set", setting]
        command += ["--time-limit", str(s.limit_s), "--json"]
        self.car = Process("car", command, self.folder, priority=CAR_PRIORITY)

    def start_daemon(self, drive=True):
        s = self.scenario
        world = self.truth.world
        x, y, heading = world["start"]
        state = self.truth.state
        if state:
            x, y, heading = state["x_m"], state["y_m"], state["heading_rad"]
        command = [self.binary, "run", "--can", self.bus.interface]
        if "config" in s.daemon:
            if not self.daemons:
                self.config.write_text(s.daemon["config"])
            command += ["--config", self.config]
        command += [f"--start={x:.6f},{y:.6f},{math.degrees(heading):.6f}"]
        if drive:
            goal = s.daemon.get("goal", world["goal"])
            command += ["--goal=" + ",".join(f"{value:.6f}" for value in goal)]
        command += ["--set", f"speed.speed_max_mps={s.speed_mps}"]
        if any(step.do == "goal" or step.do.startswith("mavlink ") for step in s.steps):
            command += ["--set", f"mavlink.links=udpin:127.0.0.1:{PORT}"]
        for setting in s.daemon.get("set", []):
            command += ["--set", setting]
        command += ["--json"]
        number = len(self.daemons) + 1
        name = "daemon" if number == 1 else f"daemon-{number}"
        state = self.folder / "state"
        state.mkdir(exist_ok=True)
        if s.daemon.get("small_disk") and self.disk is None:
            call("mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(state))
            self.disk = state
        environment = {"STATE_DIRECTORY": str(state)}
        self.daemons.append(Process(name, command, self.folder, environment))

    def act(self, step):
        state = self.truth.state
        do, value = step.do, step.value
        if do == "start daemon":
            self.start_daemon(drive=False)
        elif do.endswith("daemon"):
            self.daemon.signal(
                {
                    "kill daemon": signal.SIGKILL,
                    "stop daemon": signal.SIGSTOP,
                    "continue daemon": signal.SIGCONT,
                    "terminate daemon": signal.SIGTERM,
                    "reload daemon": signal.SIGHUP,
                }[do]
            )
        elif do == "kill car":
            self.car.signal(signal.SIGKILL)
        elif do == "link down":
            self.bus.link(False)
        elif do == "link up":
            self.bus.link(True)
        elif do == "netem":
            self.bus.netem(value)
        elif do == "flood":
            self.bus.flood(value)
        elif do == "errors":
            # Bus errors as a driver reports them: a protocol error, somewhere in the data.
            self.bus.flood(value, ["20000008#0000000A00000000"])
        elif do == "hog":
            self.burdens.append(Hog(value))
        elif do == "stop thread":
            self.burdens.append(StoppedThread(self.daemon.child.pid, value))
        elif do == "fill disk":
            with open(self.disk / "filler", "wb") as file:
                os.posix_fallocate(file.fileno(), 0, 31 << 20)
        elif do == "send":
            self.bus.send(value)
        elif do == "config":
            self.config.write_text(value)
        elif do == "goal":
            x, y = map(float, value.split())
            mavlink.send(mavlink.reposition(x, y), PORT)
        elif do == "mavlink heartbeat":
            mavlink.send(mavlink.heartbeat(), PORT)
        elif do == "mavlink terminate":
            mavlink.send(mavlink.termination(), PORT)
        elif do == "mavlink flood":
            self.packets = PacketFlood(PORT, value)
        elif do == "mavlink calm":
            self.end_packets()
        elif do == "clock":
            time.clock_settime(time.CLOCK_REALTIME, time.time() + value)
        self.done.append(
            {
                "do": do if value is None else f"{do} {value}",
                "t_s": state["t_s"] if state else 0.0,
                "speed_mps": state["speed_mps"] if state else 0.0,
                "curvature_pm": state["curvature_pm"] if state else 0.0,
            }
        )

    def struck_s(self):
        """The car's time when the first thing happened, by a step or by its script."""
        events = [event["t_s"] for event in self.truth.events if not event["over"]]
        return min([step["t_s"] for step in self.done] + events, default=None)

    def wait_for_car(self):
        patience = time.monotonic() + 10.0
        while self.truth.world is None or self.truth.state is None:
            if not self.car.running():
                raise Broken(f"the car ended at once: {self.car.how()}\n{self.car.tail()}")
            if time.monotonic() > patience:
                raise Broken("the car wrote no truth within 10 s")
            time.sleep(POLL_S)
            self.truth.read()

    def play(self):
        s = self.scenario
        self.start_car()
        self.wait_for_car()
        self.start_daemon()
        began = time.monotonic()
        pending = list(s.steps)
        since = 0.0
        while True:
            time.sleep(POLL_S)
            news = self.truth.read()
            waited = time.monotonic() - began
            while pending and news and self.truth.holds(pending[0].when, since):
                step = pending.pop(0)
                if step.do == "finish":
                    return
                self.act(step)
                since = self.truth.state["t_s"]
            if self.truth.end is not None or not self.car.running():
                return
            if self.truth.moving_since is None and waited > START_S:
                raise Broken(
                    f"the car did not move within {START_S:.0f} s\n{self.daemon.tail(8)}"
                )
            struck = self.struck_s() is not None or not (s.steps or "script" in s.car)
            if struck and not pending and s.expect["end"] == "rest":
                if self.truth.holds({"rest_s": 1.0}, 0):
                    return
            if waited > s.limit_s:
                return

    def end_packets(self):
        if self.packets:
            self.packets_hz = self.packets.end()
            self.packets = None

    def clean_up(self):
        """Ends what runs; returns how the daemons ended."""
        spent = {"car": self.car.cpu_s() if self.car else None, "runner": time.process_time() - self.cpu_began}
        wall = time.monotonic() - self.began
        self.load = {name: round(cpu / wall, 3) for name, cpu in spent.items() if cpu is not None}
        self.foreign_hz = self.bus.calm()
        for burden in self.burdens:
            burden.end()
        ends = [daemon.end() for daemon in self.daemons]
        if self.car:
            self.car.end(5.0)
        self.end_packets()
        if self.disk:
            call("umount", str(self.disk))
        self.truth.read()
        return ends


def run_one(scenario, bus, binary, folder):
    began = time.monotonic()
    play = Play(scenario, bus, binary, folder)
    recorder = Recorder(bus.interface, folder)
    pulse = Pulse()
    ends, broken = [], None
    try:
        play.play()
    except (Broken, OSError) as error:
        broken = str(error)
    finally:
        try:
            ends = play.clean_up()
        finally:
            recorder.end()
            wake_late_ms = pulse.end()
    try:
        result = judge.judge(play, ends, broken, wake_late_ms)
    except (KeyError, TypeError, ValueError) as error:
        result = {
            "name": scenario.name,
            "title": scenario.title,
            "passed": False,
            "failures": [f"cannot be judged: {type(error).__name__}: {error}", *filter(None, [broken])],
            "wake_late_ms": wake_late_ms,
        }
    result["wall_s"] = round(time.monotonic() - began, 2)
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n")
    return result


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--can", required=True)
    parser.add_argument("--binary", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("scenario", nargs="*")
    arguments = parser.parse_args()
    try:
        chosen = scenarios.all_of(arguments.scenario)
        bus = Bus(arguments.can)
    except (scenarios.Mistake, Broken, OSError) as error:
        sys.exit(f"hil: {error}")
    # The long ones first, so that several runners end at about the same time.
    chosen.sort(key=lambda one: (-one.cost_s, one.name))
    for scenario in chosen:
        folder = arguments.out / scenario.name
        try:
            os.mkdir(folder)
        except FileExistsError:
            continue
        if scenario.guest and "HIL_GUEST" not in os.environ:
            result = {"name": scenario.name, "skipped": "only in a guest, not on a real machine"}
            (folder / "result.json").write_text(json.dumps(result) + "\n")
            continue
        result = run_one(scenario, bus, arguments.binary, folder)
        word = "ok    " if result["passed"] else "FAILED"
        print(f"{word} {scenario.name} ({result['wall_s']:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
