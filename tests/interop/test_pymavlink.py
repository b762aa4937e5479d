"""A ground station by pymavlink drives the simulated car: telemetry, arming, goals, refusals.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import math
import os
import tempfile
import time
import unittest

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil  # noqa: E402
from pymavlink.dialects.v20 import all as mavlink  # noqa: E402

from vehicle import Vehicle  # noqa: E402

NAN = float("nan")
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED
DENIED = mavlink.MAV_RESULT_DENIED
FAILED = mavlink.MAV_RESULT_FAILED
UNSUPPORTED = mavlink.MAV_RESULT_UNSUPPORTED
REJECTED = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
# pymavlink 2.4.50 has an older name for it, or none.
WRONG_FRAME = 9
REPOSITION = mavlink.MAV_CMD_DO_REPOSITION
# Behind the wall of the hall: metres north and east.
GOAL = (2.5, 10.0)


class Station:
    """What a script of ten lines does, and a memory of what was said."""

    def __init__(self, port):
        self.link = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=255, dialect="all"
        )
        self.texts = []
        self.last = {}
        self.counts = {}
        self.next_beat = 0.0
        self.silent = False
        self.await_(lambda: "HEARTBEAT" in self.last, "a heartbeat")
        self.link.target_system = 1
        self.link.target_component = 1

    def listen(self, seconds=0.05):
        if not self.silent and time.monotonic() >= self.next_beat:
            self.next_beat = time.monotonic() + 1.0
            self.link.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0
            )
        message = self.link.recv_match(blocking=True, timeout=seconds)
        if message is None or message.get_srcSystem() != 1:
            return None
        kind = message.get_type()
        self.last[kind] = message
        self.counts[kind] = self.counts.get(kind, 0) + 1
        if kind == "STATUSTEXT":
            self.texts.append(message.text)
        return message

    def await_(self, condition, what, seconds=30.0):
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise AssertionError(f"no {what} within {seconds} s; heard: {self.texts}")
            self.listen()

    def ack(self, command, seconds=20.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.listen()
            if message and message.get_type() == "COMMAND_ACK" and message.command == command:
                return message.result
        raise AssertionError(f"no acknowledgement of {command}")

    def long(self, command, *params):
        params = (list(params) + [0.0] * 7)[:7]
        self.link.mav.command_long_send(1, 1, command, 0, *params)
        return self.ack(command)

    def int(self, command, frame, x, y, z=0.0, params=(-1.0, 1.0, 0.0, NAN)):
        self.link.mav.command_int_send(1, 1, frame, command, 0, 0, *params, x, y, z)
        return self.ack(command)

    def go(self, north, east):
        frame = mavlink.MAV_FRAME_LOCAL_NED
        return self.int(REPOSITION, frame, round(north * 1e4), round(east * 1e4))

    def position(self):
        self.last.pop("LOCAL_POSITION_NED", None)
        self.await_(lambda: "LOCAL_POSITION_NED" in self.last, "a position")
        here = self.last["LOCAL_POSITION_NED"]
        return here.x, here.y

    def speed(self):
        here = self.last["LOCAL_POSITION_NED"]
        return math.hypot(here.vx, here.vy)

    def armed(self):
        return bool(self.last["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def arm(self):
        """As a person does: again until the checks pass."""
        end = time.monotonic() + 30.0
        while self.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) != ACCEPTED:
            if time.monotonic() > end:
                raise AssertionError(f"not armed: {self.texts}")
        self.await_(self.armed, "armed heartbeat")


class Drive(unittest.TestCase):
    identity = "generic"

    settings = ()

    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.vehicle = Vehicle(
            self.folder.name, "--set", f"mavlink.identity={self.identity}", *self.settings
        )
        self.addCleanup(self.folder.cleanup)
        self.addCleanup(self.stop)
        self.station = Station(self.vehicle.port)

    def stop(self):
        if getattr(self, "station", None):
            self.station.link.close()
        self.vehicle.close()

    def end(self):
        code, figures = self.vehicle.end()
        self.assertEqual(code, 0, figures)
        self.assertEqual(figures["outcome"], "interrupted")
        self.assertEqual(figures["collisions"], 0)
        self.assertEqual(figures["unknown_entries"], 0)
        return figures


class Generic(Drive):
    def test_a_station_drives_the_car(self):
        station = self.station
        beat = station.last["HEARTBEAT"]
        self.assertEqual(beat.type, mavlink.MAV_TYPE_GROUND_ROVER)
        self.assertEqual(beat.autopilot, mavlink.MAV_AUTOPILOT_GENERIC)
        self.assertFalse(station.armed())
        wanted = {"SYS_STATUS", "ATTITUDE", "LOCAL_POSITION_NED", "ODOMETRY", "VFR_HUD",
                  "OBSTACLE_DISTANCE", "BATTERY_STATUS", "EXTENDED_SYS_STATE", "CURRENT_MODE"}
        station.await_(lambda: wanted <= station.last.keys(), "telemetry")
        self.assertNotIn("GLOBAL_POSITION_INT", station.last)

        # Before arming nothing moves, and the station is told why.
        north, east = station.position()
        self.assertEqual(station.go(north, east + 1.5), FAILED)
        station.await_(lambda: any("not armed" in text for text in station.texts), "a reason")

        station.arm()
        health = station.last["SYS_STATUS"].onboard_control_sensors_health
        station.await_(
            lambda: station.last["SYS_STATUS"].onboard_control_sensors_health
            & mavlink.MAV_SYS_STATUS_PREARM_CHECK, f"health ({health:#x})")

        # What makes no sense is refused with a reason.
        for frame in (mavlink.MAV_FRAME_BODY_FRD, 77):
            result = station.int(REPOSITION, frame, 1, 1)
            self.assertEqual(result, WRONG_FRAME)
        self.assertEqual(station.int(REPOSITION, mavlink.MAV_FRAME_GLOBAL, 1, 1), FAILED)
        self.assertEqual(station.long(REPOSITION, math.inf, 1, 0, NAN, NAN, NAN, NAN), DENIED)
        self.assertEqual(station.long(31000), UNSUPPORTED)
        self.assertEqual(station.long(42424), UNSUPPORTED)
        self.assertEqual(station.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196), DENIED)
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 99), DENIED)

        # Slowly; the way there is the car's own business.
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 1.5), ACCEPTED)
        goal = GOAL
        self.assertEqual(station.go(*goal), ACCEPTED)
        station.await_(lambda: station.last["HEARTBEAT"].custom_mode == 15, "guided mode")
        station.await_(lambda: station.speed() > 1.0, "motion")
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 0), ACCEPTED)
        station.await_(lambda: station.speed() < 0.02, "rest")
        self.assertEqual(station.last["HEARTBEAT"].custom_mode, 4)
        self.assertGreater(math.dist(station.position(), goal), 2.0)
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_PAUSE_CONTINUE, 1), ACCEPTED)
        fastest = [0.0]

        def arrived():
            fastest[0] = max(fastest[0], station.speed())
            return "Goal reached" in station.texts

        station.await_(arrived, "arrival", 60.0)
        self.assertLess(fastest[0], 1.6)
        self.assertLess(math.dist(station.position(), goal), 0.5)

        # Back to where it began.
        station.texts.clear()
        self.assertEqual(station.long(mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH), ACCEPTED)
        station.await_(lambda: station.last["HEARTBEAT"].custom_mode == 11, "return mode")
        station.await_(lambda: "Goal reached" in station.texts, "return", 90.0)
        self.assertLess(math.dist(station.position(), (north, east)), 0.55)

        # The end, until the next start.
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_FLIGHTTERMINATION, 1), ACCEPTED)
        station.await_(
            lambda: station.last["HEARTBEAT"].system_status == mavlink.MAV_STATE_FLIGHT_TERMINATION,
            "termination")
        self.assertEqual(station.go(*goal), FAILED)
        self.assertEqual(station.long(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1), FAILED)
        self.end()

    def test_messages_come_when_asked_for(self):
        station = self.station
        request = mavlink.MAV_CMD_REQUEST_MESSAGE
        self.assertEqual(station.long(request, 148), ACCEPTED)
        station.await_(lambda: "AUTOPILOT_VERSION" in station.last, "version")
        capabilities = station.last["AUTOPILOT_VERSION"].capabilities
        self.assertTrue(capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT)
        self.assertEqual(station.long(request, 435, 0), ACCEPTED)
        station.await_(lambda: station.counts.get("AVAILABLE_MODES") == 4, "modes")
        self.assertEqual(station.long(request, 9999), UNSUPPORTED)
        self.assertEqual(station.long(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 30, -1), ACCEPTED)
        time.sleep(0.3)
        while station.listen(0.0):
            pass
        station.counts.clear()
        end = time.monotonic() + 2.0
        while time.monotonic() < end:
            station.listen()
        self.assertNotIn("ATTITUDE", station.counts)
        self.assertGreater(station.counts["LOCAL_POSITION_NED"], 10)
        station.link.mav.timesync_send(0, 12345)
        station.await_(
            lambda: "TIMESYNC" in station.last and station.last["TIMESYNC"].ts1 == 12345,
            "time")
        self.end()


class Silence(Drive):
    settings = ("--set", "mavlink.station_lost=stop", "--set", "mavlink.station_timeout_s=2")

    def test_a_link_that_dies_stops_the_car_and_one_that_comes_back_lets_it_go_on(self):
        station = self.station
        station.arm()
        # Slowly: it is still on its way when nobody is heard any more.
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_CHANGE_SPEED, 1, 0.5), ACCEPTED)
        self.assertEqual(station.go(*GOAL), ACCEPTED)
        station.await_(lambda: station.speed() > 0.3, "motion")
        station.silent = True
        station.await_(
            lambda: any("Failsafe: ground station lost" in text for text in station.texts),
            "failsafe")
        station.await_(lambda: station.speed() < 0.02, "rest")
        station.await_(
            lambda: station.last["HEARTBEAT"].system_status == mavlink.MAV_STATE_CRITICAL, "state")
        self.assertGreater(math.dist(station.position(), GOAL), 1.0)
        station.silent = False
        station.await_(lambda: station.speed() > 0.3, "motion")
        self.end()


class Px4(Drive):
    identity = "px4"

    def test_modes_are_those_of_the_other_autopilot(self):
        station = self.station
        beat = station.last["HEARTBEAT"]
        self.assertEqual(beat.autopilot, mavlink.MAV_AUTOPILOT_PX4)
        self.assertEqual(mavutil.mode_string_v10(beat), "LOITER")
        station.await_(lambda: "EXTENDED_SYS_STATE" in station.last, "state")
        landed = mavlink.MAV_LANDED_STATE_ON_GROUND
        self.assertEqual(station.last["EXTENDED_SYS_STATE"].landed_state, landed)
        station.arm()
        # Without that QGroundControl offers neither go-to nor pause.
        station.await_(
            lambda: station.last["EXTENDED_SYS_STATE"].landed_state
            == mavlink.MAV_LANDED_STATE_IN_AIR, "state of what may move")
        self.assertEqual(station.long(mavlink.MAV_CMD_DO_SET_MODE, 1, 6), ACCEPTED)
        station.await_(
            lambda: mavutil.mode_string_v10(station.last["HEARTBEAT"]) == "OFFBOARD", "mode", 2.0)
        # As QGroundControl holds.
        result = station.long(REPOSITION, -1, 1, 0, NAN, NAN, NAN, NAN)
        self.assertEqual(result, ACCEPTED)
        station.await_(
            lambda: mavutil.mode_string_v10(station.last["HEARTBEAT"]) == "LOITER", "mode", 2.0)
        # A place on the earth, and a goal there.
        self.assertEqual(
            station.int(mavlink.MAV_CMD_DO_SET_GLOBAL_ORIGIN, mavlink.MAV_FRAME_GLOBAL,
                        473977420, 85455940, 488.0, (0, 0, 0, 0)), ACCEPTED)
        station.await_(lambda: "GLOBAL_POSITION_INT" in station.last, "place")
        here = station.last["GLOBAL_POSITION_INT"]
        self.assertEqual(
            station.int(REPOSITION, mavlink.MAV_FRAME_GLOBAL, here.lat, here.lon, 488.0), ACCEPTED)
        station.await_(lambda: "Goal reached" in station.texts, "arrival", 20.0)
        self.end()


if __name__ == "__main__":
    unittest.main()
