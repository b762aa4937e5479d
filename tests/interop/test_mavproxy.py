"""MAVProxy without a window connects, shows and sets a parameter, arms, changes mode, asks the state.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import re
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import unittest
from pathlib import Path

from vehicle import Vehicle

PATIENCE_S = 60.0
# A command that shows nothing of what is waited for is given again after so long.
AGAIN_S = 5.0
MODULES = "link,cmdlong,mode,arm,param,wp,misc"


class Generic(unittest.TestCase):
    identity = "generic"
    first_mode, other_mode = "HOLD", "GUIDED"
    choose = {"HOLD": "mode HOLD", "GUIDED": "mode GUIDED"}

    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)
        self.vehicle = Vehicle(
            self.folder.name, "-v", "--set", f"daemon.state_directory={self.folder.name}/state",
            "--set", f"mavlink.identity={self.identity}")
        program = Path(sysconfig.get_path("scripts")) / "mavproxy.py"
        self.proxy = subprocess.Popen(
            [sys.executable, "-u", str(program), "--master", f"udpout:127.0.0.1:{self.vehicle.port}",
             "--default-modules", MODULES, "--state-basedir", self.folder.name],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            cwd=self.folder.name)
        self.addCleanup(self.stop)
        self.said = []
        # Where in what was said the present command began.
        self.mark = 0
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self):
        for line in self.proxy.stdout:
            self.said.append(line.rstrip())

    def stop(self):
        self.vehicle.close()
        if self.proxy.poll() is None:
            self.proxy.kill()
        self.proxy.wait()
        self.reader.join()
        for pipe in (self.proxy.stdin, self.proxy.stdout):
            try:
                pipe.close()
            except BrokenPipeError:
                pass

    def await_(self, pattern, seconds=PATIENCE_S):
        """Whether a line like that was said since the last command."""
        end = time.monotonic() + seconds
        while True:
            found = [m for line in self.said[self.mark:] if (m := re.search(pattern, line))]
            if found or time.monotonic() > end or self.proxy.poll() is not None:
                return found[0] if found else None
            time.sleep(0.02)

    def wanted(self, pattern, *commands):
        """Gives commands until a line like that is said."""
        self.mark = len(self.said)
        end = time.monotonic() + PATIENCE_S
        found = None
        while not found and time.monotonic() < end:
            for command in commands:
                self.proxy.stdin.write(command + "\n")
                self.proxy.stdin.flush()
            found = self.await_(pattern, AGAIN_S)
        self.assertTrue(found, f"no {pattern!r} after {commands}:\n" + "\n".join(self.said))
        return found

    def test_the_basic_commands_work(self):
        self.assertTrue(self.await_(r"online system 1"), self.said)
        self.assertTrue(self.await_(rf"Mode {self.first_mode}\b"), self.said)
        self.assertTrue(self.await_(r"Received \d+ parameters"), self.said)

        self.wanted(r"SPD_SPEED_MAX +4\.0", "param show SPD_SPEED_MAX")
        self.wanted(r"SPD_SPEED_MAX += 2\.5|SPD_SPEED_MAX +2\.5",
                    "param set SPD_SPEED_MAX 2.5", "param show SPD_SPEED_MAX")
        # What the car says, not what MAVProxy remembers.
        self.wanted(r"PARAM_VALUE \{param_id : SPD_SPEED_MAX, param_value : 2\.5",
                    "param fetch SPD_SPEED_MAX", "status PARAM_VALUE")

        self.wanted(r"(?<!DIS)ARMED", "arm throttle")
        beat = self.wanted(r"HEARTBEAT \{type : 10,.* base_mode : (\d+)", "status HEARTBEAT")
        self.assertTrue(int(beat[1]) & 128, beat[0])
        self.wanted(r"SYS_STATUS \{onboard_control_sensors_present", "status SYS_STATUS")
        for mode in (self.other_mode, self.first_mode):
            self.wanted(rf"Mode {mode}\b", self.choose[mode])
        self.wanted(r"DISARMED", "disarm")
        self.wanted(r"link 1 OK", "link")

        code, figures = self.vehicle.end()
        self.assertEqual(code, 0, figures)
        self.assertEqual(figures["path_m"], 0.0)


class Px4(Generic):
    identity = "px4"
    first_mode, other_mode = "LOITER", "OFFBOARD"
    # By name MAVProxy 1.8.75 cannot set any mode of PX4 ("required argument is not a float").
    choose = {"LOITER": "long DO_SET_MODE 1 4 3", "OFFBOARD": "long DO_SET_MODE 1 6 0"}


if __name__ == "__main__":
    unittest.main()
