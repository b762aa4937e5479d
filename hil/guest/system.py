"""Inside the guest of hil/system, systemd being process 1: installs the package, drives, breaks things,
and looks at what systemd and the car made of it.

Usage: system.py FOLDER
"""

import json
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import again
import judge
from stage import CAR_PRIORITY, Broken, Process, Pulse, Recorder, Truth

CAN = "vcan0"
UNIT = "apexd.service"
# One slow processor is shared with systemd, journald and the recorder: with six times the frames some
# machines report overload, which is another test's subject.
LIGHT_LIDAR = ["--set", "lidar.beams=360", "--set", "lidar.rate_hz=10"]
DROP_IN = Path("/etc/systemd/system/apexd.service.d/test.conf")
CONFIG = Path("/etc/apexd/car.toml")
RUNNING_MARK = Path("/var/lib/apexd/running")


class Failed(Exception):
    """A check did not hold."""


def run(*command, check=True):
    done = subprocess.run(command, capture_output=True, text=True)
    if check and done.returncode:
        raise Failed(f"{' '.join(command)}: {done.stderr.strip() or done.stdout.strip()}")
    return done.stdout


def show(what, unit=UNIT):
    return run("systemctl", "show", "--value", "-p", what, unit).strip()


def check(holds, words):
    if not holds:
        raise Failed(words)


def wait(what, words, patience_s=20.0):
    """The first true answer of `what`."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        answer = what()
        if answer:
            return answer
        time.sleep(0.01)
    raise Failed(f"{words}: not within {patience_s:.0f} s")


class Journal:
    """What the service wrote from a moment on."""

    def __init__(self):
        self.cursor = re.search(r"-- cursor: (.*)", run("journalctl", "-n0", "--show-cursor"))[1]

    def text(self):
        return run("journalctl", "-o", "cat", "-u", UNIT, f"--after-cursor={self.cursor}")

    def has(self, pattern):
        return re.search(pattern, self.text())


class Drive:
    """A car on the bus and the service driving it."""

    # What a failed check would leave behind.
    running = []

    def __init__(self, folder, maze, extra=""):
        folder.mkdir()
        self.folder = folder
        self.journal = Journal()
        self.truth = Truth(folder / "truth.jsonl")
        self.recorder = Recorder(CAN, folder)
        car = ["/usr/bin/apexd", "car", "--can", CAN, "--truth", self.truth.path, "--maze", maze]
        car += ["--time-limit", "120", "--json", *LIGHT_LIDAR]
        self.car = Process("car", car, folder, priority=CAR_PRIORITY)
        Drive.running += [self.car.child, self.recorder.child]
        wait(lambda: self.truth.read() and self.truth.world, "the car writes its truth")
        world = self.truth.world
        x, y, heading = world["start"]
        start = f"{x:.6f},{y:.6f},{math.degrees(heading):.6f}"
        goal = ",".join(f"{value:.6f}" for value in world["goal"])
        DROP_IN.parent.mkdir(exist_ok=True)
        # As one does for an interface of another name; and a drive, since nobody asks for one here.
        DROP_IN.write_text(
            f"[Unit]\nWants=apexd-can@{CAN}.service\nAfter=apexd-can@{CAN}.service\n"
            "[Service]\nExecStart=\n"
            f"ExecStart=/usr/bin/apexd run --config {CONFIG} --start={start} --goal={goal}"
            f" --set guard.scan_age_max_s=0.4\n{extra}"
        )
        run("systemctl", "daemon-reload")
        run("systemctl", "start", UNIT)

    def reach(self, speed_mps):
        def fast():
            self.truth.read()
            check(self.car.running(), f"the car ended: {self.car.tail()}")
            return self.truth.state and self.truth.state["speed_mps"] >= speed_mps

        wait(fast, f"the car drives {speed_mps} m/s", 40.0)
        return self.truth.state["t_s"]

    def follow(self, seconds):
        """Takes in the truth for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)
            self.truth.read()

    def at_rest(self):
        def resting():
            self.truth.read()
            return self.truth.holds({"rest_s": 0.3}, 0)

        wait(resting, "the car comes to rest")

    def end(self):
        """Ends service and car; the car's own account."""
        run("systemctl", "stop", UNIT)
        run("systemctl", "reset-failed", UNIT, check=False)
        self.car.end(5.0)
        self.recorder.end()
        Drive.running.clear()
        self.truth.read()
        (self.folder / "journal.log").write_text(self.journal.text())
        end = self.truth.end
        check(end is not None, "the truth has no end")
        check(not end["collisions"], f"{end['collisions']} collisions")
        check(not end["unknown_entries"], f"{end['unknown_entries']} unknown entries")
        return end


def stopped_for_good(drive, struck):
    """The car stopped soon and stayed. 1.5 s: along a braking tail."""
    found = judge.rest(drive.truth, struck)
    check(found["stopped_t_s"] is not None, "the car is not at rest")
    check(found["stop_s"] < 1.5, f"at rest only after {found['stop_s']:.2f} s")
    check(found["crept_m"] < judge.CREEP_M, f"moved {found['crept_m']:.2f} m after its stop")
    return f"at rest after {found['stop_s']:.2f} s and {found['stop_m']:.2f} m"


def restarted(before):
    """systemd started the daemon anew after process `before`, and it is up."""

    def anew():
        pid = int(show("MainPID"))
        return pid not in (0, before) and show("ActiveState") == "active"

    wait(anew, "systemd restarts the daemon", 20.0)


# --- the checks, in this order --------------------------------------------------------------------


def installs(out):
    """The package installs, with its user, and starts nothing."""
    run("dpkg", "--force-unsafe-io", "-i", "/hil/apexd.deb")
    check(run("id", "-un", "apexd").strip() == "apexd", "no user apexd")
    check(show("ActiveState") == "inactive", "the service was started by being installed")
    for path in (
        "/usr/share/man/man1/apexd-run.1.gz",
        "/usr/share/bash-completion/completions/apexd",
        "/usr/share/apexd/cnp.onnx",
        "/usr/share/apexd/car.dbc",
    ):
        # Debian's smallest variant may leave documentation out on purpose; this one does not.
        check(Path(path).exists(), f"{path} is missing")
    check(str(CONFIG) in run("dpkg-query", "-W", "-f=${Conffiles}", "apexd"), "no conffile")
    run("/usr/bin/apexd", "check", str(CONFIG))
    text, count = re.subn(r'(?m)^interface = "v?can0"$', f'interface = "{CAN}"', CONFIG.read_text())
    check(count == 1, f"{count} places for the interface in {CONFIG}")
    CONFIG.write_text(text)
    # The bus must be there before the car is.
    run("systemctl", "mask", "apexd-can@can0.service")
    run("systemctl", "start", f"apexd-can@{CAN}.service")


def refuses_bad_configuration(out):
    """A bad configuration ends the service with 78, and it is not tried again."""
    good = CONFIG.read_text()
    CONFIG.write_text(good + "\n[nonsense]\nx = 1\n")
    try:
        run("systemctl", "start", UNIT, check=False)
        wait(lambda: show("ActiveState") == "failed", "the service fails")
        check(show("ExecMainStatus") == "78", f"exit code {show('ExecMainStatus')}")
        time.sleep(1.5)
        check(show("NRestarts") == "0", f"restarted {show('NRestarts')} times")
    finally:
        CONFIG.write_text(good)
        run("systemctl", "reset-failed", UNIT, check=False)


def drives_and_stops(out):
    """systemctl stop at speed: the daemon brings the car to rest, then ends well."""
    drive = Drive(out / "stop", 1)
    pid = show("MainPID")
    status = Path(f"/proc/{pid}/status").read_text()
    user = run("id", "-u", "apexd").strip()
    check(re.search(rf"(?m)^Uid:\s+{user}\s", status), "it does not run as apexd")
    check(re.search(r"(?m)^CapEff:\s+0+$", status), "it has capabilities")
    check(re.search(r"(?m)^VmLck:\s+[1-9]\d+ kB", status), "its memory is not locked")
    policies = {
        os.sched_getscheduler(int(task.name)) for task in Path(f"/proc/{pid}/task").iterdir()
    }
    check(os.SCHED_FIFO in policies, "no thread has real-time priority")
    told = drive.reach(2.5)
    run("systemctl", "stop", UNIT)
    # It ends only when the car stands. Before that it may have stopped for a fault and gone on.
    drive.truth.read()
    ended = drive.truth.state
    check(ended["speed_mps"] < 0.05, "the daemon left a car that moves")
    check(show("Result") == "success", f"the service ended with {show('Result')}")
    drive.follow(0.5)
    stopped_for_good(drive, ended["t_s"])
    # It drives its plan to the end, which is gentler than a braking tail.
    states = judge.states_of(drive.truth.path)
    stop_s = max(s["t_s"] for s in states if abs(s["speed_mps"]) > judge.REST_MPS) - told
    check(stop_s < 6.0, f"at rest only {stop_s:.2f} s after the daemon was told to end")
    drive.end()
    return f"at rest after {stop_s:.2f} s"


def killed_at_speed(out):
    """kill -9 at speed: the car stops along its braking tail; the daemon comes back disarmed."""
    drive = Drive(out / "kill", 2)
    pid = int(show("MainPID"))
    struck = drive.reach(2.5)
    os.kill(pid, 9)
    drive.at_rest()
    restarted(pid)
    # It was started with a goal; it must not go there.
    drive.follow(4.0)
    words = stopped_for_good(drive, struck)
    check(int(show("NRestarts")) == 1, f"restarted {show('NRestarts')} times")
    check(drive.journal.has("previous run ended unexpectedly; disarmed"), "it does not say why")
    drive.end()
    return words


def hung_at_speed(out):
    """SIGSTOP at speed: the car stops along its braking tail; the watchdog ends the daemon."""
    drive = Drive(out / "hang", 3)
    pid = int(show("MainPID"))
    struck = drive.reach(2.5)
    began = time.monotonic()
    os.kill(pid, 19)
    wait(lambda: int(show("MainPID")) != pid, "the watchdog fires", 15.0)
    fired_s = time.monotonic() - began
    restarted(pid)
    drive.follow(4.0)
    words = stopped_for_good(drive, struck)
    everything = run("journalctl", "-o", "cat", f"--after-cursor={drive.journal.cursor}")
    check(re.search(r"apexd\.service: Watchdog timeout", everything), "no word of the watchdog")
    check(drive.journal.has("previous run ended unexpectedly; disarmed"), "it does not say why")
    drive.end()
    return f"{words}; ended by the watchdog after {fired_s:.1f} s"


def reaches_the_goal(out):
    """A drive to the goal, under systemd, from a clean start."""
    drive = Drive(out / "goal", 4)
    wait(lambda: drive.truth.read() and drive.truth.end, "the car reaches the goal", 90.0)
    end = drive.end()
    check(end["outcome"] == "goal", f"the drive ended with {end['outcome']}")
    return f"{end['path_m']:.1f} m in {end['time_s']:.1f} s"


def exposure(out):
    """systemd's own opinion of the sandbox."""
    text = run("systemd-analyze", "security", "--no-pager", UNIT)
    (out / "security.txt").write_text(text)
    score = re.search(r"exposure level for apexd.service: ([\d.]+)", text)[1]
    check(float(score) <= 2.0, f"exposure {score}")
    return f"exposure {score}"


CHECKS = [
    installs,
    exposure,
    refuses_bad_configuration,
    drives_and_stops,
    killed_at_speed,
    hung_at_speed,
    reaches_the_goal,
]


def attempt(one, folder):
    """What the check says, how it failed if it did, and whether the machine stood still meanwhile."""
    folder.mkdir(exist_ok=True)
    pulse = Pulse()
    words, failure = None, None
    try:
        words = one(folder)
    except (Failed, Broken, OSError, ValueError, KeyError, TypeError) as error:
        failure = f"{type(error).__name__}: {error}"
        subprocess.run(["systemctl", "stop", UNIT], check=False)
        subprocess.run(["systemctl", "reset-failed", UNIT], check=False)
        for process in Drive.running:
            process.kill()
        Drive.running.clear()
        # What a try left half done must not disarm the next.
        RUNNING_MARK.unlink(missing_ok=True)
    try:
        late = pulse.end()
    except subprocess.TimeoutExpired:
        late = None
    return words, failure, late is None or bool(late["stalls"])


def main():
    out = Path(sys.argv[1])
    # For the same reason as in hil/guest/init.
    Path("/proc/sys/kernel/sched_rt_runtime_us").write_text("-1")
    passed = failed = 0
    for one in CHECKS:
        began = time.monotonic()
        for number in range(1, again.TRIES + 1):
            folder = out if number == 1 else out / f"try-{number}"
            words, failure, stood_still = attempt(one, folder)
            # Now, since the guest may be ended before the last check.
            (out / "all-journal.log").write_text(run("journalctl", "-b", check=False))
            # As with the scenarios: a machine that stood still cannot judge, but nothing excuses a contact.
            if not failure or not stood_still or any(map(again.touched, folder.iterdir())):
                break
            print(f"       the machine stood still in try {number}: {failure}", flush=True)
        passed, failed = (passed, failed + 1) if failure else (passed + 1, failed)
        word, title = "FAILED" if failure else "ok    ", one.__doc__.split("\n")[0]
        print(f"{word} {title} ({time.monotonic() - began:.0f} s)", flush=True)
        if failure or words:
            print(f"       {failure or words}", flush=True)
    print(f"system: {passed} passed, {failed} failed", flush=True)


if __name__ == "__main__":
    main()
