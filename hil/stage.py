"""What a scenario runs on: the interface, the two processes, the log of the bus."""

import ctypes
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

# Real-time priority (SCHED_FIFO) of the car. In truth its controller is a computer of its own: whatever
# the daemon computes, its odometry leaves in time. So here it goes before all of the daemon's threads
# (`daemon.priority`), but not before what a scenario burdens the machine with.
CAR_PRIORITY = 60

# Frames of all kinds with identifiers that are none of ours, for a flood.
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
        self.flooding = None
        self.shaped = False
        self.cut = False

    def link(self, up):
        self.cut = not up
        call("ip", "link", "set", "dev", self.interface, "up" if up else "down")

    def netem(self, arguments):
        """Loss, delay or corruption by the kernel, for every frame of both sides."""
        base = ("tc", "qdisc")
        if self.shaped:
            call(*base, "del", "dev", self.interface, "root")
        self.shaped = arguments != "off"
        if not self.shaped:
            return
        call(*base, "add", "dev", self.interface, "root", "netem", *arguments.split())

    def send(self, frame):
        with self.socket() as socket:
            socket.send(wire_form(frame))

    def flood(self, rate_hz, frames=FOREIGN):
        self.flooding = Flood(self.socket(), rate_hz, frames)

    def socket(self):
        """For sending only."""
        opened = socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
        opened.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        opened.bind((self.interface,))
        return opened

    def calm(self):
        """Ends whatever a scenario did to the bus; returns how many foreign frames a second it
        sent."""
        rate_hz = 0.0
        if self.flooding:
            rate_hz = self.flooding.end()
            self.flooding = None
        self.netem("off")
        if self.cut:
            self.link(True)
        return rate_hz


class Flood(threading.Thread):
    """Frames of somebody else at a rate, evenly in bursts of 5 ms."""

    def __init__(self, opened, rate_hz, frames):
        super().__init__(daemon=True)
        self.socket = opened
        self.rate_hz = rate_hz
        self.frames = [wire_form(frame) for frame in frames]
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
        return round(self.sent / (time.monotonic() - self.began), 1)


def wire_form(text):
    """A frame in cansend's notation as the kernel's struct can_frame or canfd_frame. Eight digits of
    identifier: an extended one, or with 2 in front an error frame of the driver."""
    identifier, _, data = text.partition("#")
    number = int(identifier, 16)
    if len(identifier) == 8 and not number & 0x20000000:
        number |= 0x80000000
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
        # What of the script has happened, and the wall clock when the car's clock was at zero.
        self.events = []
        self.wall_zero_s = None
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
            self.state = entry
            speed = abs(entry["speed_mps"])
            self.speed_max = max(self.speed_max, speed)
            if speed > 0.05 and self.moving_since is None:
                self.moving_since = entry["t_s"]
            if speed > 0.02:
                self.rest_since = None
            elif self.rest_since is None:
                self.rest_since = entry["t_s"]
            zero = time.time() - entry["t_s"]
            self.wall_zero_s = zero if self.wall_zero_s is None else min(zero, self.wall_zero_s)
        elif kind == "event":
            self.events.append(entry)

    def holds(self, when, since):
        """Whether everything under `when` holds; `since`: the car's time of the last step."""
        state = self.state
        if state is None:
            return False
        now = state["t_s"]
        tests = {
            "speed_mps": lambda x: state["speed_mps"] >= x,
            "curvature_pm": lambda x: abs(state["curvature_pm"]) >= x,
            "moving_s": lambda x: self.moving_since is not None and now - self.moving_since >= x,
            "after_s": lambda x: now - since >= x,
            "rest_s": lambda x: self.rest_since is not None
            and self.moving_since is not None
            and now - self.rest_since >= x,
        }
        return all(tests[name](value) for name, value in when.items())


class Hog:
    """Takes a share of the processor from everybody, at a real-time priority above the daemon's."""

    PROGRAM = """
import os, sys, time
share, period = float(sys.argv[1]), 0.03
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(70))
while True:
    end = time.monotonic() + share * period
    while time.monotonic() < end:
        pass
    time.sleep((1 - share) * period)
"""

    def __init__(self, share):
        self.child = subprocess.Popen([sys.executable, "-c", self.PROGRAM, str(share)])

    def end(self):
        self.child.kill()
        self.child.wait()


class PacketFlood:
    """Packets of all kinds on the daemon's MAVLink link, from a process of its own."""

    PROGRAM = Path(__file__).parent / "mavlink.py"

    def __init__(self, port, rate_hz):
        self.child = subprocess.Popen(
            # Car and runner are not to wait for it.
            ["nice", "-n", "19", sys.executable, str(self.PROGRAM), str(port), str(rate_hz)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def end(self):
        """How many packets a second were sent; 0 if it does not say."""
        try:
            output, _ = self.child.communicate("\n", timeout=20)
            return round(float(output), 1)
        except (subprocess.TimeoutExpired, ValueError):
            self.child.kill()
            self.child.wait()
            return 0.0


class Pulse:
    """Feels how punctual the machine itself is: a program that goes before everything else on it
    sleeps 5 ms at a time and notes by how much it woke too late. No control tick can be more punctual;
    and where the machine is a guest, the longest delays are those for which its host left it waiting."""

    # Later than this, the daemon's control period, the machine is said to have stalled (ms): in one go, or
    # by several delays in a row. A host that gives its guest a processor for some ms in ten stops nothing
    # for long, but takes as much away.
    STALL_MS = 10.0
    # So many are a row: about as long as the daemon waits for odometry.
    ROW = 10
    PROGRAM = """
import json, os, select, sys, time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(90))
limit, row = float(sys.argv[1]), int(sys.argv[2])
late, stalls, began, before = [], [], 0, time.monotonic()
# The wall clock may be set meanwhile.
wall_zero = time.time() - before
while not select.select([sys.stdin], [], [], 0.005)[0]:
    now = time.monotonic()
    late.append(1e3 * (now - before - 0.005))
    lost = 0.0
    for count, one in enumerate(late[:-1 - min(row, len(late) - began):-1]):
        lost += one
        if lost > limit:
            stalls.append((wall_zero + now, round(lost + 5.0 * count, 3)))
            began = len(late)
            break
    before = time.monotonic()
late.sort()
share = lambda part: round(late[int(part * (len(late) - 1))], 3)
print(json.dumps({"p50": share(0.5), "p99": share(0.99), "max": share(1.0), "stalls": stalls}))
"""

    def __init__(self):
        self.child = subprocess.Popen(
            [sys.executable, "-c", self.PROGRAM, str(self.STALL_MS), str(self.ROW)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def end(self):
        """The lateness in milliseconds, and of every stall the wall clock's time of its end and how long
        it was (ms); None where real-time priority is not to be had."""
        output, _ = self.child.communicate("\n", timeout=10)
        return json.loads(output) if self.child.returncode == 0 else None


class StoppedThread:
    """One thread of a program held still by ptrace, as if it hung."""

    SEIZE, INTERRUPT, DETACH = 0x4206, 0x4207, 17

    def __init__(self, pid, name):
        self.libc = ctypes.CDLL(None, use_errno=True)
        tasks = Path(f"/proc/{pid}/task").iterdir()
        named = {(task / "comm").read_text().strip(): int(task.name) for task in tasks}
        if name not in named:
            raise Broken(f"no thread {name}; there are {sorted(named)}")
        self.tid = named[name]
        self.trace(self.SEIZE)
        self.trace(self.INTERRUPT)
        os.waitpid(self.tid, 0x40000000)

    def trace(self, request):
        if self.libc.ptrace(request, self.tid, None, None):
            raise Broken(f"ptrace: {os.strerror(ctypes.get_errno())}")

    def end(self):
        try:
            self.trace(self.DETACH)
        except Broken:
            # The program has ended meanwhile.
            pass


def go_first(priority):
    """Gives this process real-time priority, where that is to be had."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        pass


class Process:
    """A program with its output in files. With a `priority` it is a real-time one (SCHED_FIFO),
    where that is to be had."""

    def __init__(self, name, command, folder, environment=None, priority=None):
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
                preexec_fn=priority and (lambda: go_first(priority)),
            )

    def running(self):
        return self.child.poll() is None

    def cpu_s(self):
        """Processor time so far, of a process that has not been waited for."""
        try:
            fields = Path(f"/proc/{self.child.pid}/stat").read_text().rsplit(")", 1)[1].split()
        except OSError:
            return None
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

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
                # All standard identifiers below 200 (hex), where ours are, and error frames.
                ["candump", "-L", "-D", "-r", "4000000", f"{interface},0:C0000600,#FFFFFFFF"],
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
