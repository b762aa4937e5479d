"""Parameters, missions, fences and files by pymavlink against the simulated car.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import json
import math
import os
import struct
import tempfile
import time
import unittest
from pathlib import Path

os.environ["MAVLINK20"] = "1"

from pymavlink import mavftp  # noqa: E402
from pymavlink.dialects.v20 import all as mavlink  # noqa: E402

from metadata_schema import check_general, check_parameters, crc32  # noqa: E402
from test_pymavlink import ACCEPTED, Station  # noqa: E402
from vehicle import Vehicle  # noqa: E402

MISSION = mavlink.MAV_MISSION_TYPE_MISSION
FENCE = mavlink.MAV_MISSION_TYPE_FENCE
RALLY = mavlink.MAV_MISSION_TYPE_RALLY
DONE = mavlink.MAV_MISSION_ACCEPTED
LOCAL = mavlink.MAV_FRAME_LOCAL_NED
WAYPOINT = mavlink.MAV_CMD_NAV_WAYPOINT
REAL = mavlink.MAV_PARAM_TYPE_REAL32
INT = mavlink.MAV_PARAM_TYPE_INT32


def bytewise(value):
    return struct.unpack("<f", struct.pack("<i", value))[0]


def plain(message):
    if message.param_type == INT:
        return struct.unpack("<i", struct.pack("<f", message.param_value))[0]
    return message.param_value


class Services(unittest.TestCase):
    identity = "generic"

    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)
        self.state = Path(self.folder.name) / "state"
        (self.state / "logs").mkdir(parents=True)
        self.vehicle = None
        self.addCleanup(self.stop)
        self.start()

    def start(self, *arguments):
        self.vehicle = Vehicle(
            self.folder.name, "-v", "--set", f"daemon.state_directory={self.state}",
            "--set", f"mavlink.identity={self.identity}", *arguments
        )
        self.station = Station(self.vehicle.port)

    def stop(self):
        self.station.link.close()
        self.vehicle.close()

    def restart(self, *arguments):
        self.station.link.close()
        self.vehicle.end()
        self.stop()
        self.start(*arguments)

    def next(self, *kinds, seconds=20.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.station.listen()
            if message and message.get_type() in kinds:
                return message
        self.fail(f"no {kinds} within {seconds} s; heard: {self.station.texts}")

    def insist(self, command, *params):
        """Again while the car says that waiting helps: the computer may be busy with other tests."""
        end = time.monotonic() + 10.0
        while True:
            result = self.station.long(command, *params)
            if result != mavlink.MAV_RESULT_TEMPORARILY_REJECTED or time.monotonic() > end:
                break
        self.assertEqual(result, ACCEPTED, self.station.texts)

    # ---- parameters

    def read_all(self):
        self.station.link.mav.param_request_list_send(1, 1)
        values = {}
        while True:
            message = self.next("PARAM_VALUE")
            values[message.param_id] = plain(message)
            if len(values) == message.param_count:
                return values

    def set(self, name, value, kind, wanted=None):
        """The answer; again for a while if `wanted` is not it, which a busy computer may cause."""
        raw = bytewise(value) if kind == INT else value
        end = time.monotonic() + 15.0
        while True:
            self.station.link.mav.param_set_send(1, 1, name.encode(), raw, kind)
            message = self.next("PARAM_VALUE")
            self.assertEqual(message.param_id, name)
            if wanted is None or plain(message) == wanted or time.monotonic() > end:
                return plain(message)

    def test_parameters_are_read_set_kept_and_refused(self):
        values = self.read_all()
        self.assertGreater(len(values), 60)
        self.assertTrue(all(len(name) <= 16 for name in values))
        self.assertEqual(values["SPD_SPEED_MAX"], 4.0)
        self.station.link.mav.param_request_read_send(1, 1, b"SPD_SPEED_MAX", -1)
        self.assertEqual(plain(self.next("PARAM_VALUE")), 4.0)

        self.assertEqual(self.set("SPD_SPEED_MAX", 2.5, REAL, wanted=2.5), 2.5)
        self.assertEqual(self.set("PLAN_STOP_RULE", 1, INT, wanted=1), 1)
        self.assertEqual(self.set("VEH_MASS", 3.0, REAL), 3.0)
        self.station.await_(
            lambda: any("next start" in text for text in self.station.texts), "a word")
        self.assertEqual(self.set("SPD_SPEED_MAX", 99.0, REAL), 2.5)
        self.assertEqual(self.set("SPD_SPEED_MAX", math.nan, REAL), 2.5)
        self.assertEqual(self.set("SPD_SPEED_MAX", 2, INT), 2.5)
        self.station.await_(
            lambda: any("allowed is" in text for text in self.station.texts), "a reason")

        self.restart()
        again = self.read_all()
        self.assertEqual(again["SPD_SPEED_MAX"], 2.5)
        self.assertEqual(again["PLAN_STOP_RULE"], 1)
        self.assertEqual(again["VEH_MASS"], 3.0)
        self.assertTrue(any("speed.speed_max_mps = 2.5" in line for line in self.vehicle.log))

        # The command line has the last word.
        self.restart("--speed-max", "1.5")
        self.assertEqual(self.read_all()["SPD_SPEED_MAX"], 1.5)

    # ---- lists

    def upload(self, kind, items):
        mav = self.station.link.mav
        mav.mission_count_send(1, 1, len(items), kind)
        while True:
            message = self.next("MISSION_REQUEST_INT", "MISSION_ACK")
            if message.get_type() == "MISSION_ACK":
                self.assertEqual(message.mission_type, kind)
                return message.type
            frame, command, params, x, y = items[message.seq]
            mav.mission_item_int_send(
                1, 1, message.seq, frame, command, 0, 1, *params, x, y, 0.0, kind)

    def download(self, kind):
        mav = self.station.link.mav
        mav.mission_request_list_send(1, 1, kind)
        count = self.next("MISSION_COUNT").count
        items = []
        for seq in range(count):
            mav.mission_request_int_send(1, 1, seq, kind)
            item = self.next("MISSION_ITEM_INT")
            self.assertEqual(item.seq, seq)
            params = (item.param1, item.param2, item.param3, item.param4)
            items.append((item.frame, item.command, params, item.x, item.y))
        mav.mission_ack_send(1, 1, DONE, kind)
        return items

    def goal(self, north, east, wait=0.0):
        return (LOCAL, WAYPOINT, (wait, 0.0, 0.0, 0.0), round(north * 1e4), round(east * 1e4))

    def begin_mission(self):
        self.insist(mavlink.MAV_CMD_MISSION_START)

    def test_a_mission_of_three_goals_is_driven(self):
        goals = [(5.5, 4.0), (6.5, 7.0), (3.0, 11.0)]
        # A second at each goal, or the car is on its way again before its place is heard.
        items = [self.goal(*goal, wait=1.0) for goal in goals]
        items.insert(1, (LOCAL, mavlink.MAV_CMD_DO_CHANGE_SPEED, (1.0, 1.5, -1.0, 0.0), 0, 0))
        self.assertEqual(self.upload(MISSION, items), DONE)
        self.assertEqual(self.download(MISSION), items)
        # What cannot be done is refused, and what was there stays.
        takeoff = [(LOCAL, mavlink.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, 0.0), 0, 0)]
        self.assertEqual(self.upload(MISSION, takeoff), mavlink.MAV_MISSION_UNSUPPORTED)
        self.assertEqual(self.upload(RALLY, takeoff), mavlink.MAV_MISSION_UNSUPPORTED)
        self.assertEqual(self.download(MISSION), items)

        station = self.station
        self.assertNotEqual(station.long(mavlink.MAV_CMD_MISSION_START), ACCEPTED)
        station.arm()
        self.begin_mission()
        reached = []
        paused = False
        end = time.monotonic() + 120.0
        while len(reached) < 3:
            self.assertLess(time.monotonic(), end, f"{reached}; {station.texts}")
            message = station.listen()
            if message is None:
                continue
            if message.get_type() == "MISSION_ITEM_REACHED":
                reached.append(message.seq)
                at = [goals[0], goals[1], goals[2]][len(reached) - 1]
                self.assertLess(math.dist(station.position(), at), 0.6)
            if reached == [0] and not paused and station.speed() > 0.8:
                paused = True
                self.insist(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0)
                station.await_(lambda: station.speed() < 0.02, "rest")
                station.await_(
                    lambda: station.last["MISSION_CURRENT"].mission_state
                    == mavlink.MISSION_STATE_PAUSED, "pause")
                self.insist(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1)
        self.assertEqual(reached, [0, 2, 3])
        self.assertTrue(paused)
        station.await_(lambda: "Mission complete" in station.texts, "the end")
        station.await_(
            lambda: station.last["MISSION_CURRENT"].mission_state
            == mavlink.MISSION_STATE_COMPLETE, "the end")

        code, figures = self.vehicle.end()
        self.assertEqual((code, figures["collisions"]), (0, 0))

    def test_a_fence_is_driven_round_and_outlasts_a_restart(self):
        # Across the hall but for its northern end, long before the wall.
        def corner(north, east):
            command = mavlink.MAV_CMD_NAV_FENCE_POLYGON_VERTEX_EXCLUSION
            return (LOCAL, command, (4.0, 0.0, 0.0, 0.0), round(north * 1e4), round(east * 1e4))

        fence = [corner(-1, 4.0), corner(-1, 4.5), corner(5.5, 4.5), corner(5.5, 4.0)]
        self.assertEqual(self.upload(FENCE, fence), DONE)
        self.restart()
        self.assertEqual(self.download(FENCE), fence)
        self.assertEqual(self.download(MISSION), [])
        station = self.station
        station.arm()
        # Slowly enough to be heard while it passes.
        self.insist(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 1.0)
        self.assertEqual(station.go(3.0, 6.0), ACCEPTED)
        crossed = []
        end = time.monotonic() + 60.0
        while "Goal reached" not in station.texts:
            self.assertLess(time.monotonic(), end, station.texts)
            message = station.listen()
            if message and message.get_type() == "LOCAL_POSITION_NED":
                if 3.8 < message.y < 4.7:
                    crossed.append(message.x)
        self.assertTrue(crossed)
        self.assertGreater(min(crossed), 5.69)
        station.link.mav.mission_clear_all_send(1, 1, FENCE)
        self.assertEqual(self.next("MISSION_ACK").type, DONE)
        self.assertEqual(self.download(FENCE), [])

    # ---- places

    def place_of(self, kind):
        self.station.last.pop(kind, None)
        number = {"HOME_POSITION": 242, "GPS_GLOBAL_ORIGIN": 49}[kind]
        self.insist(mavlink.MAV_CMD_REQUEST_MESSAGE, number)
        self.station.await_(lambda: kind in self.station.last, kind)
        return self.station.last[kind]

    def test_origin_and_home_outlast_a_restart(self):
        self.station.link.mav.set_gps_global_origin_send(1, 473977420, 85455940, 488000)
        self.station.await_(lambda: "GPS_GLOBAL_ORIGIN" in self.station.last, "origin")
        result = self.station.int(
            mavlink.MAV_CMD_DO_SET_HOME, LOCAL, 40000, 60000, params=(0, 0, 0, 0))
        self.assertEqual(result, ACCEPTED)
        self.restart()
        origin = self.place_of("GPS_GLOBAL_ORIGIN")
        self.assertEqual(
            (origin.latitude, origin.longitude, origin.altitude), (473977420, 85455940, 488000))
        home = self.place_of("HOME_POSITION")
        self.assertEqual((home.x, home.y), (4.0, 6.0))
        self.station.await_(lambda: "GLOBAL_POSITION_INT" in self.station.last, "position")

    # ---- files

    def metadata(self):
        """Checksum and address. pymavlink 2.4.50 does not know the message: read byte by byte."""
        self.station.link.mav.command_long_send(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, 397, 0, 0, 0, 0, 0, 0)
        end = time.monotonic() + 20.0
        while time.monotonic() < end:
            message = self.station.link.recv_match(blocking=True, timeout=0.1)
            if message is not None and message.get_type() == "UNKNOWN_397":
                frame = bytes(message.data)
                payload = frame[10:10 + frame[1]].ljust(108, b"\0")
                crc = struct.unpack_from("<I", payload, 4)[0]
                return crc, payload[8:].rstrip(b"\0").decode()
        self.fail("no COMPONENT_METADATA")

    def test_files_are_listed_and_downloaded_and_metadata_keeps_to_its_schema(self):
        log = bytes(range(256)) * 100
        (self.state / "logs" / "drive.log").write_bytes(log)
        (self.state / "secret").write_text("no")
        metadata_crc, metadata_uri = self.metadata()
        ftp = mavftp.MAVFTP(self.station.link, 1, 1)
        ftp.cmd_list(["/"])
        self.assertEqual(
            {(entry.name, entry.is_dir) for entry in ftp.list_result},
            {("general.json", False), ("parameters.json", False), ("logs", True)})
        ftp.cmd_list(["/logs"])
        self.assertEqual([(e.name, e.size_b) for e in ftp.list_result], [("drive.log", len(log))])

        def get(path):
            got = []
            ftp.cmd_get([path], callback=lambda file: got.append(file.read() if file else None))
            ftp.process_ftp_reply("OpenFileRO", timeout=20)
            return got[0] if got else None

        def get_again(path):
            """The client gives up soon when the computer is busy."""
            return get(path) or get(path) or get(path)

        self.assertEqual(get_again("/logs/drive.log"), log)
        self.assertIsNone(get("/logs/../secret"))

        general_bytes = get_again(metadata_uri.removeprefix("mftp://"))
        self.assertEqual(crc32(general_bytes), metadata_crc)
        general = json.loads(general_bytes)
        entry = check_general(self, general)
        parameter_bytes = get_again(entry["uri"].removeprefix("mftp://"))
        self.assertEqual(crc32(parameter_bytes), entry["fileCrc"])
        parameters = json.loads(parameter_bytes)
        names = check_parameters(self, parameters)
        self.assertEqual(names, set(self.read_all()))


class Px4Services(Services):
    """Parameters and missions as the other autopilot; the rest does not depend on that."""

    identity = "px4"
    test_a_fence_is_driven_round_and_outlasts_a_restart = None
    test_origin_and_home_outlast_a_restart = None
    test_files_are_listed_and_downloaded_and_metadata_keeps_to_its_schema = None

    def begin_mission(self):
        """As QGroundControl does: by the old message, which nobody acknowledges, until the heartbeat shows
        it (PX4FirmwarePlugin.cc, startMission; Vehicle.cc, setFlightMode)."""
        auto, mission = 4, 4
        custom = auto << 16 | mission << 24
        end = time.monotonic() + 30.0
        while self.station.last["HEARTBEAT"].custom_mode != custom:
            self.assertLess(time.monotonic(), end, self.station.texts)
            base = self.station.last["HEARTBEAT"].base_mode
            self.station.link.mav.set_mode_send(
                1, base | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, custom)
            until = time.monotonic() + 1.3
            while time.monotonic() < until and self.station.last["HEARTBEAT"].custom_mode != custom:
                self.station.listen()


if __name__ == "__main__":
    unittest.main()
