"""MAVSDK 4 drives the simulated car: parameters and origin kept over a restart, a mission, pause and continue,
health; both identities.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import math
import tempfile
import time
import unittest
from pathlib import Path

import mavsdk
from mavsdk.plugins.action import Action, ActionError
from mavsdk.plugins.mission import Mission, MissionError, MissionItem, MissionPlan
from mavsdk.plugins.param import Param, ParamError, ParamResult
from mavsdk.plugins.telemetry import FlightMode, Telemetry

from vehicle import Vehicle

# Where the map's origin lies, and the radius that the car turns metres into degrees with.
LATITUDE, LONGITUDE = 47.3977, 8.5456
EARTH_M = 6_378_137.0
# Metres north and east; the last one is behind the wall of the hall.
GOALS = [(5.5, 4.0), (6.5, 7.0), (3.0, 11.0)]
# MAVSDK repeats what is not answered by itself; this is for a computer that is busy with other things.
PATIENCE_S = 60.0


def on_earth(north, east):
    return (
        LATITUDE + math.degrees(north / EARTH_M),
        LONGITUDE + math.degrees(east / (EARTH_M * math.cos(math.radians(LATITUDE)))),
    )


class Client:
    """A connection by MAVSDK, and the newest of what it tells."""

    def __init__(self, port):
        kind = mavsdk.ComponentType.GROUND_STATION
        self.configuration = mavsdk.Configuration.create_with_component_type(kind)
        self.mavsdk = mavsdk.Mavsdk(self.configuration)
        url = f"udpout://127.0.0.1:{port}"
        result = self.mavsdk.add_any_connection(url)
        if result != mavsdk.ConnectionResult.SUCCESS:
            raise AssertionError(f"{url}: {result.name}")
        self.system = self.mavsdk.first_autopilot(PATIENCE_S)
        if self.system is None:
            raise AssertionError(f"MAVSDK found no autopilot within {PATIENCE_S} s")
        self.param = Param(self.system)
        self.action = Action(self.system)
        self.mission = Mission(self.system)
        self.telemetry = Telemetry(self.system)
        self.last = {}
        self.texts = []
        telemetry = self.telemetry
        for name in ("health", "armed", "flight_mode", "position_velocity_ned"):
            getattr(telemetry, f"subscribe_{name}")(self.keep(name))
        telemetry.subscribe_status_text(lambda text, _: self.texts.append(text.text))
        self.mission.subscribe_mission_progress(self.keep("progress"))

    def keep(self, name):
        return lambda value, _: self.last.__setitem__(name, value)

    def await_(self, condition, what, seconds=PATIENCE_S):
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                raise AssertionError(f"no {what} within {seconds} s; heard: {self.texts}")
            time.sleep(0.02)

    def insist(self, call, error):
        """Again until it is accepted, as a person does: the computer may be busy with other tests."""
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                return call()
            except error as refused:
                if time.monotonic() > end:
                    raise AssertionError(f"{refused}; heard: {self.texts}") from None
                time.sleep(0.2)

    def heard(self, name):
        self.await_(lambda: name in self.last, name)
        return self.last[name]

    def place(self):
        position = self.heard("position_velocity_ned").position
        return position.north_m, position.east_m

    def speed(self):
        velocity = self.heard("position_velocity_ned").velocity
        return math.hypot(velocity.north_m_s, velocity.east_m_s)

    def close(self):
        self.mavsdk.destroy()
        self.configuration.destroy()


class Generic(unittest.TestCase):
    identity = "generic"
    # MAVSDK 4.1 takes every autopilot but ArduPilot's for PX4 when it decodes modes.
    modes = {"hold": FlightMode.UNKNOWN, "mission": FlightMode.UNKNOWN}

    def setUp(self):
        mavsdk.log_subscribe(lambda *_: True)
        self.addCleanup(mavsdk.log_unsubscribe)
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)
        self.vehicle = self.client = None
        self.addCleanup(self.stop)
        self.start()

    def start(self):
        settings = {
            "daemon.state_directory": Path(self.folder.name) / "state",
            "mavlink.identity": self.identity,
        }
        words = [word for item in settings.items() for word in ("--set", "{}={}".format(*item))]
        self.vehicle = Vehicle(self.folder.name, "-v", *words)
        self.client = Client(self.vehicle.port)

    def stop(self):
        if self.client:
            self.client.close()
            self.client = None
        if self.vehicle:
            self.vehicle.close()

    def refusal(self):
        """What is said about a value out of range; again where it was not heard in time."""
        end = time.monotonic() + PATIENCE_S
        while True:
            with self.assertRaises(ParamError) as refused:
                self.client.param.set_param_float("SPD_SPEED_MAX", 99.0)
            result = refused.exception.result
            if result != ParamResult.TIMEOUT or time.monotonic() > end:
                return result

    def test_parameters_outlast_a_restart_and_a_mission_is_driven(self):
        # Parameters: all of them, one by name, one set, one refused.
        client = self.client
        every = client.insist(client.param.get_all_params, ParamError)
        reals = {row.name: row.value for row in every.float_params}
        whole = {row.name: row.value for row in every.int_params}
        self.assertGreater(len(reals) + len(whole), 100)
        self.assertEqual(reals["SPD_SPEED_MAX"], 4.0)
        self.assertIn("MAV_FORCED_ARMNG", whole)
        client.insist(lambda: client.param.set_param_float("SPD_SPEED_MAX", 2.5), ParamError)
        client.insist(lambda: client.param.set_param_int("MAV_FORCED_ARMNG", 1), ParamError)
        self.assertEqual(self.refusal(), ParamResult.VALUE_OUT_OF_RANGE)
        client.insist(
            lambda: client.action.set_gps_global_origin(LATITUDE, LONGITUDE, 0.0), ActionError)

        client.close()
        self.client = None
        self.vehicle.end()
        self.stop()
        self.start()
        client = self.client
        speed = client.insist(lambda: client.param.get_param_float("SPD_SPEED_MAX"), ParamError)
        self.assertEqual(speed, 2.5)
        rule = client.insist(lambda: client.param.get_param_int("MAV_FORCED_ARMNG"), ParamError)
        self.assertEqual(rule, 1)

        # Health, with the origin that was kept: what this car has is well; it has none of the sensors of something that flies.
        client.await_(lambda: client.heard("health").is_armable, "health")
        health = client.heard("health")
        self.assertTrue(health.is_local_position_ok)
        client.await_(lambda: client.heard("health").is_home_position_ok, "home")
        self.assertFalse(health.is_gyrometer_calibration_ok)

        # A mission of three goals, each with a speed.
        items = []
        for goal in GOALS:
            latitude, longitude = on_earth(*goal)
            items.append(MissionItem(
                latitude_deg=latitude, longitude_deg=longitude, relative_altitude_m=0.0,
                speed_m_s=0.9, is_fly_through=False))
        client.insist(lambda: client.mission.upload_mission(MissionPlan(items)), MissionError)
        kept = client.insist(client.mission.download_mission, MissionError).mission_items
        self.assertEqual(len(kept), len(GOALS))
        for item, goal in zip(kept, GOALS):
            self.assertAlmostEqual(item.latitude_deg, on_earth(*goal)[0], 6)

        # Arm, start, pause on the way, go on, arrive.
        self.assertFalse(client.heard("armed"))
        client.insist(client.action.arm, ActionError)
        client.await_(lambda: client.last["armed"], "armed heartbeat")
        client.insist(client.mission.start_mission, MissionError)
        client.await_(lambda: client.speed() > 0.5, "motion")
        client.await_(lambda: client.heard("flight_mode") == self.modes["mission"], "mode")
        client.insist(client.mission.pause_mission, MissionError)
        client.await_(lambda: client.speed() < 0.02, "rest")
        client.await_(lambda: client.heard("flight_mode") == self.modes["hold"], "hold")
        self.assertLess(client.heard("progress").current, len(GOALS))
        self.assertGreater(math.dist(client.place(), GOALS[-1]), 1.0)
        client.insist(client.mission.start_mission, MissionError)
        client.await_(lambda: client.speed() > 0.3, "motion")

        seen = []

        def finished():
            progress = client.heard("progress").current
            if seen[-1:] != [progress]:
                seen.append(progress)
            return progress == len(GOALS)

        client.await_(finished, "end of the mission", 180.0)
        self.assertEqual(seen, sorted(seen), "items come in their order")
        client.await_(lambda: client.mission.is_mission_finished(), "end")
        client.await_(lambda: math.dist(client.place(), GOALS[-1]) < 0.6, "last goal")
        client.await_(lambda: "Mission complete" in client.texts, "word")

        # One goal, and there to hold; then home.
        place = on_earth(6.0, 10.0)
        client.insist(
            lambda: client.action.goto_location(*place, 0.0, float("nan")), ActionError)
        client.await_(lambda: math.dist(client.place(), (6.0, 10.0)) < 0.6, "goal")
        client.insist(client.action.hold, ActionError)
        client.insist(client.action.return_to_launch, ActionError)
        client.await_(lambda: math.dist(client.place(), (3.0, 2.0)) < 0.6, "home", 180.0)
        client.insist(client.action.disarm, ActionError)
        client.await_(lambda: not client.last["armed"], "disarmed heartbeat")

        code, figures = self.vehicle.end()
        self.assertEqual(code, 0, figures)
        self.assertEqual((figures["collisions"], figures["unknown_entries"]), (0, 0))


class Px4(Generic):
    identity = "px4"
    modes = {"hold": FlightMode.HOLD, "mission": FlightMode.MISSION}


if __name__ == "__main__":
    unittest.main()
