"""A link that is flooded changes nothing of a drive: the same setpoints to the last bit.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import json
import subprocess
import sys
import tempfile
import unittest

from vehicle import ROOT, Vehicle, binary, write_hall

RATE_HZ = 20_000
GOAL = ("--goal", "10,2.5")


class Flood(unittest.TestCase):
    def test_a_drive_under_20000_packets_a_second_is_the_same_drive(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        # In virtual time, without a link.
        quiet = subprocess.run(
            [binary(), "sil", "--json", "--out", f"{folder.name}/quiet", "--predictor", "none",
             "--map", str(write_hall(folder.name)), "--start", "2,3,0", *GOAL],
            capture_output=True, text=True, timeout=120)
        self.assertEqual(quiet.returncode, 0, quiet.stderr)
        quiet = json.loads(quiet.stdout.splitlines()[-1])

        # In real time, with one, and the packets from its opening to the end.
        vehicle = Vehicle(folder.name, "-v", *GOAL)
        flood = subprocess.Popen(
            [sys.executable, str(ROOT / "hil/mavlink.py"), str(vehicle.port), str(RATE_HZ)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        try:
            _, flooded = vehicle.finish(180)
            rate_hz = float(flood.communicate("\n", timeout=60)[0])
        finally:
            vehicle.close()
            if flood.poll() is None:
                flood.kill()
            flood.wait()
        self.assertEqual(flooded["outcome"], "goal", "\n".join(vehicle.log))
        self.assertEqual(flooded["digest"], quiet["digest"])
        # It was a flood, and it reached the car: most of it is more than a link may say.
        self.assertGreater(rate_hz, 1000.0)
        [end] = [line for line in vehicle.log if "MAVLink has ended" in line]
        counts = dict(word.split("=") for word in end.split() if "=" in word)
        self.assertGreater(int(counts["throttled"]), 1000, end)
        self.assertGreater(int(counts["frames"]), 100, end)


if __name__ == "__main__":
    unittest.main()
