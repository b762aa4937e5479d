"""What a scenario runs on: the interface, the two processes, the log of the bus."""

import json
import math
import os
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path

# An address that is none of ours; foreign frames of all kinds for a flood.
FOREIGN = ["321#1122334455667788", "18FEF100#FFFF", "7E8##1001122334455667788AABBCC", "35A#R"]


class Broken(Exception):
    """The stage itself failed: nothing can be said about the scenario."""


def call(*command):
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise Broken(f"{' '.join(command)}: {done.stderr.strip()}")
    return done.stdout


class Bus:
    """One CAN interface."""

    def __init__(self, interface):
        self.interface = interface
        flags = int(Path(f"/sys/class/net/{interface}/flags").read_text(), 16)
        if not flags & 1:
            raise Broken(f"{interface} is down")
        self.virtual = "vcan" in call("ip", "-details", "link", "show", "dev", interface)
        self.flooding = None

    def link(self, up):
        call("ip", "link", "set", "dev", self.interface, "up" if up else "down")

    def netem(self, arguments):
        """Loss, delay or corruption by the kernel, for every frame of both sides."""
        base = ("tc", "qdisc")
        if arguments == "off":
            subprocess.run((*base, "del", "dev", self.interface, "root"), capture_output=True)
            return
        call(*base, "replace", "dev", self.interface, "root", "netem", *arguments.split())

    def send(self, frame):
        call("cansend", self.interface, frame)

    def flood(self, rate_hz):
        self.flooding = Flood(self.interface, rate_hz)

    def calm(self):
        """Ends whatever a scenario did to the bus; returns the foreign frames sent."""
        sent = 0
        if self.flooding:
            sent = self.flooding.end()
            self.flooding = None
        if self.virtual:
            self.netem("off")
        self.link(True)
        return sent


class Flood(threading.Thread):
    """Foreign frames at a rate, evenly in bursts of 5 ms."""

    def __init__(self, interface, rate_hz):
        super().__init__(daemon=True)
        import socket

        self.socket = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        self.socket.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        self.socket.bind((interface,))
        self.rate_hz = rate_hz
        self.frames = [wire_form(frame) for frame in FOREIGN]
        self.sent = 0
        self.began = time.monotonic()
        self.ending = threading.Event()
        self.start()

    def run(self):
        while not self.ending.wait(0.005):
            due = int((time.monotonic() - self.began) * self.rate_hz)
            while self.sent < due:
                try:
                    self.socket.send(self.frames[self.sent % len(self.frames)])
                except OSError:
                    time.sleep(0.001)
                    continue
                self.sent += 1

    def end(self):
        self.ending.set()
        self.join()
        self.socket.close()
        self.rate = self.sent / (time.monotonic() - self.began)
        return self.sent


def wire_form(text):
    """A frame in cansend's notation as the kernel's struct can_frame or canfd_frame."""
    identifier, _, data = text.partition("#")
    number = int(identifier, 16) | (0x80000000 if len(identifier) == 8 else 0)
    if data.startswith("#"):
        data = bytes.fromhex(data[2:])
        return number.to_bytes(4, "little") + bytes([len(data), 1, 0, 0]) + data.ljust(64, b"\0")
    if data == "R":
        number, data = number | 0x40000000, ""
    data = bytes.fromhex(data)
    return number.to_bytes(4, "little") + bytes([len(data), 0, 0, 0]) + data.ljust(8, b"\0")


class Truth:
    """The file that the car writes, followed while it grows."""

    def __init__(self, path):
        self.path = path
        self.file = None
        self.rest = ""
        self.world = None
        self.end = None
        self.state = None
        self.turning_rad_s = 0.0
        # Car's time of the first motion, and since when it has been at rest.
        self.moving_since = None
        self.rest_since = None
        self.speed_max = 0.0

    def read(self):
        """Takes in what is new; says whether anything was."""
        if self.file is None:
            if not self.path.exists():
                return False
            self.file = self.path.open()
        text = self.file.read()
        if not text:
            return False
        *lines, self.rest = (self.rest + text).split("\n")
        for line in lines:
            self.take(json.loads(line))
        return bool(lines)

    def take(self, entry):
        kind = entry["kind"]
        if kind == "world":
            self.world = entry
        elif kind == "end":
            self.end = entry
        elif kind == "state":
            before, self.state = self.state, entry
            speed = abs(entry["speed_mps"])
            self.speed_max = max(self.speed_max, speed)
            if speed > 0.05 and self.moving_since is None:
                self.moving_since = entry["t_s"]
            if speed > 0.02:
                self.rest_since = None
            elif self.rest_since is None:
                self.rest_since = entry["t_s"]
            if before and entry["t_s"] > before["t_s"]:
                turned = math.remainder(entry["heading_rad"] - before["heading_rad"], math.tau)
                self.turning_rad_s = turned / (entry["t_s"] - before["t_s"])

    def holds(self, when, since):
        """Whether everything under `when` holds; `since`: the car's time of the last step."""
        state = self.state
        if state is None:
            return False
        now = state["t_s"]
        tests = {
            "speed_mps": lambda x: state["speed_mps"] >= x,
            "turning_rad_s": lambda x: abs(self.turning_rad_s) >= x,
            "moving_s": lambda x: self.moving_since is not None and now - self.moving_since >= x,
            "after_s": lambda x: now - since >= x,
            "rest_s": lambda x: self.rest_since is not None
            and self.moving_since is not None
            and now - self.rest_since >= x,
        }
        return all(tests[name](value) for name, value in when.items())


class Process:
    """A program with its output in files."""

    def __init__(self, name, command, folder, environment=None):
        self.name = name
        self.command = [str(word) for word in command]
        self.output = folder / f"{name}.json"
        self.log = folder / f"{name}.log"
        with self.output.open("wb") as out, self.log.open("wb") as log:
            self.child = subprocess.Popen(
                self.command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=log,
                env={**os.environ, **(environment or {})},
            )

    def running(self):
        return self.child.poll() is None

    def signal(self, number):
        if self.running():
            self.child.send_signal(number)

    def end(self, patience_s=15.0):
        """Asks it to end, then makes it; returns how it ended."""
        self.signal(signal.SIGCONT)
        self.signal(signal.SIGTERM)
        try:
            self.child.wait(patience_s)
        except subprocess.TimeoutExpired:
            self.child.kill()
            self.child.wait()
            return f"had to be killed {patience_s:.0f} s after SIGTERM"
        return self.how()

    def how(self):
        code = self.child.returncode
        return code if code is None or code >= 0 else signal.Signals(-code).name

    def result(self):
        """The JSON object in the last line of its output."""
        lines = [line for line in self.output.read_text().splitlines() if line.strip()]
        try:
            return json.loads(lines[-1])
        except (IndexError, ValueError):
            return None

    def tail(self, lines=5):
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])


class Recorder:
    """candump on the interface. It writes to memory where there is some to spare (in the guest a
    word to the host's disc is slow), and the log is put in its place at the end."""

    def __init__(self, interface, folder):
        self.place = folder / "candump.log"
        scratch = os.environ.get("HIL_SCRATCH")
        self.file = Path(scratch) / "candump.log" if scratch else self.place
        with self.file.open("wb") as out:
            self.child = subprocess.Popen(
                ["candump", "-L", "-D", "-r", "4000000", f"{interface},0:0,#FFFFFFFF"],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.DEVNULL,
            )
        # It has opened its socket when the first frame is there; nothing is sent before.
        time.sleep(0.1)

    def end(self):
        self.child.terminate()
        self.child.wait()
        if self.file != self.place:
            shutil.copyfile(self.file, self.place)
            self.file.unlink()
