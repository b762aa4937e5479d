"""The sequence that QGroundControl runs when it meets a vehicle, as a script: what it asks for, in which
order, how long it waits and how often it repeats. The car answers all of it; a car that leaves out any one
answer does not get through.

Read from QGroundControl's sources, each place named where it is played. Where QGroundControl would go on
with less (no modes, no texts for parameters), the script fails: here everything must be there.

Needs the release build of apexd (APEXD_BINARY names another one).
"""

import json
import os
import struct
import tempfile
import time
import unittest
from pathlib import Path

os.environ["MAVLINK20"] = "1"

from pymavlink import mavutil  # noqa: E402
from pymavlink.dialects.v20 import all as mavlink  # noqa: E402

from filtered_link import FilteredLink  # noqa: E402
from metadata_schema import check_general, check_parameters, crc32  # noqa: E402
from vehicle import Vehicle  # noqa: E402

SYSTEM, COMPONENT = 255, 190
HEARTBEAT, ACK, FTP, PARAM_VALUE, COUNT, ITEM = 0, 77, 110, 22, 44, 73
VERSION, MODES, METADATA = 148, 435, 397
MISSION, FENCE, RALLY = 0, 1, 2
FENCE_BIT = mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_FENCE
RALLY_BIT = mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_RALLY

# MAVFTP (FTPManager.cc, MAVLinkFTP.h): header of session, operation, size and so on, 239 bytes of data.
FTP_HEAD = "<HBBBBBBI"
FTP_DATA = 239
RESET, OPEN, READ, BURST = 2, 4, 5, 15
FTP_ACK, FTP_NAK, END_OF_FILE = 128, 129, 6


class Stuck(Exception):
    """A step was not answered."""

    def __init__(self, step, what):
        super().__init__(f"{step}: {what}")
        self.step = step


class Connection:
    """One run of the sequence. `hurried`: the step whose waits are cut short, because its answer is known
    to be missing; `pace`: by how much."""

    def __init__(self, port, hurried=None, pace=0.1):
        self.link = mavutil.mavlink_connection(
            f"udpout:127.0.0.1:{port}", source_system=SYSTEM, source_component=COMPONENT, dialect="all")
        self.hurried, self.pace = hurried, pace
        self.step = None
        self.next_beat = 0.0
        self.ftp_number = 0
        self.generic = None
        self.capabilities = 0
        self.modes = {}
        self.parameters = {}
        self.plans = {}
        self.metadata = None

    def wait_s(self, seconds):
        """QGroundControl's own wait. Where a step is to fail, the others must not: on a busy computer
        they get more."""
        if self.hurried is None:
            return seconds
        return seconds * (self.pace if self.step == self.hurried else 4.0)

    def listen(self, until):
        """The next message; none once that time has come."""
        # MAVLinkProtocol.cc, _sendGCSHeartbeat: once a second.
        if time.monotonic() >= self.next_beat:
            self.next_beat = time.monotonic() + 1.0
            self.link.mav.heartbeat_send(
                mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE)
        left = until - time.monotonic()
        if left <= 0.0:
            return None
        message = self.link.recv_match(blocking=True, timeout=min(left, 0.05))
        if message is None:
            return False
        # pymavlink 2.4.50 does not say who sent a message that it does not know.
        known = not message.get_type().startswith("UNKNOWN")
        source = (message.get_srcSystem(), message.get_srcComponent())
        return False if known and source != (1, 1) else message

    def hear(self, seconds, wanted):
        """The first message that `wanted` takes."""
        until = time.monotonic() + self.wait_s(seconds)
        while (message := self.listen(until)) is not None:
            if message and wanted(message):
                return message
        return None

    # ---- the steps, in their order: InitialConnectStateMachine.cc, _createStates

    def run(self):
        """InitialConnectStateMachine.h, _maxRetries: every step is tried once more."""
        for step in (
            self.heartbeat, self.autopilot_version, self.standard_modes, self.component_metadata,
            self.load_parameters, self.mission, self.geofence, self.rally_points,
        ):
            self.step = step.__name__
            try:
                step()
            except Stuck:
                if self.step == self.hurried:
                    raise
                step()
        self.step = None

    def stuck(self, what):
        return Stuck(self.step, what)

    def heartbeat(self):
        """MultiVehicleManager.cc, _vehicleHeartbeatInfo: a vehicle is made of a heartbeat of component 1
        that is no station, gimbal or the like. VehicleLinkManager.h: gone after 3.5 s without one."""
        others = {mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_TYPE_GIMBAL,
                  mavlink.MAV_TYPE_ADSB}
        beat = self.hear(3.5, lambda m: m.get_type() == "HEARTBEAT" and m.type not in others)
        if beat is None:
            raise self.stuck("no heartbeat")
        self.generic = beat.autopilot == mavlink.MAV_AUTOPILOT_GENERIC

    def request(self, number, param=0.0, taken=None, message_s=1.0):
        """MavCommandQueue.cc and .h: an acknowledgement within 1.2 s, three tries, `confirmation` rises.
        RequestMessageCoordinator.cc: the message within 1 s after the acknowledgement, in either order."""
        found = []

        def answer(message):
            if message.get_type() == "COMMAND_ACK":
                return message.command == mavlink.MAV_CMD_REQUEST_MESSAGE
            if taken(message):
                found.append(message)
            return False

        for confirmation in range(3):
            self.link.mav.command_long_send(
                1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, confirmation, number, param, 0, 0, 0, 0, 0)
            ack = self.hear(1.2, answer)
            if ack is None:
                continue
            if ack.result != mavlink.MAV_RESULT_ACCEPTED:
                raise self.stuck(f"request of {number} was answered with {ack.result}")
            if not found and (message := self.hear(message_s, taken)):
                found.append(message)
            if not found:
                raise self.stuck(f"message {number} was acknowledged but never received")
            return found[0]
        raise self.stuck(f"request of {number} was never acknowledged")

    def autopilot_version(self):
        """InitialConnectStateMachine.cc, _stateAutopilotVersion: without it the firmware is taken to do
        next to nothing (_handleAutopilotVersionFailure)."""
        version = self.request(VERSION, taken=lambda m: m.get_type() == "AUTOPILOT_VERSION")
        self.capabilities = version.capabilities
        if not version.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2:
            raise self.stuck("no MAVLink 2")
        if version.flight_sw_version == 0:
            raise self.stuck("no version of the program")

    def standard_modes(self):
        """StandardModes.cc, request and availableModesReceived: all of them are asked for at once, and it
        is done when one comes whose index is their number; InitialConnectStateMachine.h: within 5 s."""
        count = [None]

        def mode(message):
            if message.get_type() != "AVAILABLE_MODES":
                return False
            self.modes[message.mode_index] = message
            count[0] = message.number_modes
            return message.mode_index >= message.number_modes

        self.request(MODES, taken=mode, message_s=5.0)
        if set(self.modes) != set(range(1, count[0] + 1)):
            raise self.stuck(f"modes {sorted(self.modes)} of {count[0]}")
        if not all(mode.mode_name or mode.standard_mode for mode in self.modes.values()):
            raise self.stuck("a mode without a name")

    def component_metadata(self):
        """RequestMetaDataTypeStateMachine.cc: COMPONENT_METADATA (5 s), then the general file, then those
        it names (30 s each) by MAVFTP, each checked by its checksum."""
        found = []

        def metadata(message):
            if message.get_type() == "UNKNOWN_397":
                data = bytes(message.data)
                payload = data[10:10 + data[1]].ljust(108, b"\0")
                found.append((struct.unpack_from("<I", payload, 4)[0],
                              payload[8:].rstrip(b"\0").decode()))
            return bool(found)

        self.request(METADATA, taken=metadata, message_s=5.0)
        crc, uri = found[0]
        general = self.download(uri, crc)
        files = {"general": json.loads(general)}
        for entry in files["general"]["metadataTypes"]:
            files[entry["type"]] = json.loads(self.download(entry["uri"], entry.get("fileCrc")))
        self.metadata = files

    def load_parameters(self):
        """ParameterLoadStateMachine.cc: PARAM_REQUEST_LIST, again after 5 s without any, four times
        (ParameterManager.h, _maxInitialRequestListRetry); after 3 s without a new one the missing ones
        are asked for by index, ten at a time, each five times (_fillIndexBatchQueue)."""
        values, count = {}, None

        def value(message):
            # What was set by somebody comes without an index.
            return message.get_type() == "PARAM_VALUE" and message.param_index != 65535

        for _ in range(1 + 4):
            self.link.mav.param_request_list_send(1, mavlink.MAV_COMP_ID_ALL)
            first = self.hear(5.0, value)
            if first:
                values[first.param_index] = first
                count = first.param_count
                break
        if count is None:
            raise self.stuck("no parameter at all")
        tries = {}
        while len(values) < count:
            message = self.hear(3.0, value)
            if message:
                values[message.param_index] = message
                continue
            missing = [index for index in range(count) if index not in values][:10]
            for index in missing:
                tries[index] = tries.get(index, 0) + 1
                if tries[index] > 5:
                    raise self.stuck(f"parameter {index} of {count} is missing")
                self.link.mav.param_request_read_send(1, 1, b"", index)
        self.parameters = {message.param_id: message for message in values.values()}
        if len(self.parameters) != count:
            raise self.stuck("two parameters of one name")
        # Vehicle.cc, _sendQGCTimeToVehicle: twice, once the parameters are there.
        for _ in range(2):
            self.link.mav.system_time_send(int(time.time() * 1e6), 0)

    def plan(self, kind):
        """PlanManager.cc and .h: MISSION_REQUEST_LIST, then item by item; 1500 ms for the count and
        250 ms for an item, five repetitions each, and MISSION_ACK at the end."""
        def ours(name):
            return lambda m: m.get_type() == name and m.mission_type == kind

        for _ in range(1 + 5):
            self.link.mav.mission_request_list_send(1, 1, kind)
            if count := self.hear(1.5, ours("MISSION_COUNT")):
                break
        else:
            raise self.stuck("no MISSION_COUNT")
        items = []
        for seq in range(count.count):
            for _ in range(1 + 5):
                self.link.mav.mission_request_int_send(1, 1, seq, kind)
                item = self.hear(0.25, lambda m: ours("MISSION_ITEM_INT")(m) and m.seq == seq)
                if item:
                    items.append(item)
                    break
            else:
                raise self.stuck(f"no item {seq} of {count.count}")
        self.link.mav.mission_ack_send(1, 1, mavlink.MAV_MISSION_ACCEPTED, kind)
        self.plans[kind] = items

    def mission(self):
        self.plan(MISSION)

    def geofence(self):
        """GeoFenceManager.h, supported: only with the capability."""
        if self.capabilities & FENCE_BIT:
            self.plan(FENCE)

    def rally_points(self):
        """RallyPointManager.h, supported: only with the capability."""
        if self.capabilities & RALLY_BIT:
            self.plan(RALLY)

    # ---- MAVFTP: FTPManager.cc

    def ftp(self, operation, session=0, offset=0, size=0, data=b""):
        """_sendRequestExpectAck: an answer within 1 s, three repetitions."""
        self.ftp_number = self.ftp_number + 1 & 0xFFFF
        number = self.ftp_number
        head = struct.pack(FTP_HEAD, number, session, operation, size or len(data), 0, 0, 0, offset)
        payload = (head + data).ljust(251, b"\0")
        for _ in range(1 + 3):
            self.link.mav.file_transfer_protocol_send(0, 1, 1, payload)
            answer = self.hear(1.0, lambda m: self.is_answer(m, operation, number + 1 & 0xFFFF))
            if answer:
                return self.answer_of(answer)
        raise self.stuck(f"MAVFTP operation {operation} was not answered")

    @staticmethod
    def is_answer(message, operation, number):
        if message.get_type() != "FILE_TRANSFER_PROTOCOL":
            return False
        got, _, opcode, _, asked, *_ = struct.unpack_from(FTP_HEAD, bytes(message.payload))
        # A burst is answered by many, with rising numbers; numbers are checked by its reader.
        return opcode in (FTP_ACK, FTP_NAK) and asked == operation and (
            got == number or operation == BURST)

    @staticmethod
    def answer_of(message):
        payload = bytes(message.payload)
        number, session, opcode, size, _, complete, _, offset = struct.unpack_from(FTP_HEAD, payload)
        return number, session, opcode, complete, offset, payload[12:12 + size]

    def download(self, uri, crc):
        """download: open, burst, the missing blocks, reset of the sessions."""
        path = uri.removeprefix("mftp://").encode()
        _, session, opcode, _, _, data = self.ftp(OPEN, data=path)
        if opcode != FTP_ACK:
            raise self.stuck(f"{uri} cannot be opened ({data!r})")
        size = struct.unpack("<I", data)[0]
        blocks = {}
        # _burstReadFileWorker: a burst ends with `burst_complete`; the next begins where data end.
        reached = 0
        while reached < size:
            answer = self.ftp(BURST, session, reached, FTP_DATA)
            while answer and answer[2] == FTP_ACK:
                _, _, _, complete, offset, data = answer
                blocks[offset] = data
                reached = max(reached, offset + len(data))
                if complete:
                    break
                message = self.hear(1.0, lambda m: self.is_answer(m, BURST, 0))
                answer = self.answer_of(message) if message else None
            if answer and answer[2] == FTP_NAK:
                if answer[5][:1] != bytes([END_OF_FILE]):
                    raise self.stuck(f"{uri}: refused with {answer[5]!r}")
                break
        # _fillMissingBlocksWorker
        while gap := self.gap(blocks, size):
            offset, length = gap
            _, _, opcode, _, at, data = self.ftp(READ, session, offset, min(length, FTP_DATA))
            if opcode != FTP_ACK:
                raise self.stuck(f"{uri}: block at {offset} was refused")
            blocks[at] = data
        self.ftp(RESET)
        contents = b"".join(blocks[offset] for offset in sorted(blocks))[:size]
        if crc is not None and crc32(contents) != crc:
            raise self.stuck(f"{uri}: wrong checksum")
        return contents

    @staticmethod
    def gap(blocks, size):
        at = 0
        for offset in sorted(blocks):
            if offset > at:
                return at, offset - at
            at = max(at, offset + len(blocks[offset]))
        return (at, size - at) if at < size else None


def ftp_answer_to(operation):
    def drop(frame, _):
        return frame.number == FTP and frame.payload[3 + 3] in (FTP_ACK, FTP_NAK) \
            and frame.payload[3 + 5] == operation
    return drop


def ack_of(number):
    return lambda frame, asked: frame.number == ACK and asked == number


def message(number):
    return lambda frame, _: frame.number == number


def plan_message(number, kind, type_at):
    return lambda frame, _: frame.number == number and frame.payload[type_at] == kind


def last_mode(frame, _):
    # number_modes and mode_index are the ninth and the tenth byte.
    return frame.number == MODES and frame.payload[8] == frame.payload[9]


def parameter(index):
    # The index is a 16-bit number after the value and the count.
    return lambda frame, _: frame.number == PARAM_VALUE \
        and int.from_bytes(frame.payload[6:8], "little") == index


# What is left out, and the step that must notice. The last byte of both plan messages is the kind of plan.
LEFT_OUT = {
    "the heartbeat": (message(HEARTBEAT), "heartbeat"),
    "the acknowledgement of AUTOPILOT_VERSION": (ack_of(VERSION), "autopilot_version"),
    "AUTOPILOT_VERSION": (message(VERSION), "autopilot_version"),
    "the acknowledgement of AVAILABLE_MODES": (ack_of(MODES), "standard_modes"),
    "AVAILABLE_MODES": (message(MODES), "standard_modes"),
    "the last mode": (last_mode, "standard_modes"),
    "the acknowledgement of COMPONENT_METADATA": (ack_of(METADATA), "component_metadata"),
    "COMPONENT_METADATA": (message(METADATA), "component_metadata"),
    "MAVFTP's answer to open": (ftp_answer_to(OPEN), "component_metadata"),
    "MAVFTP's answer to burst": (ftp_answer_to(BURST), "component_metadata"),
    "MAVFTP's answer to reset": (ftp_answer_to(RESET), "component_metadata"),
    "all parameters": (message(PARAM_VALUE), "load_parameters"),
    "one parameter": (parameter(7), "load_parameters"),
    "the mission's count": (plan_message(COUNT, MISSION, 4), "mission"),
    "the mission's items": (plan_message(ITEM, MISSION, 37), "mission"),
    "the fence's count": (plan_message(COUNT, FENCE, 4), "geofence"),
    "the fence's items": (plan_message(ITEM, FENCE, 37), "geofence"),
}


class Sequence(unittest.TestCase):
    identity = "generic"

    def setUp(self):
        self.folder = tempfile.TemporaryDirectory()
        self.addCleanup(self.folder.cleanup)
        state = Path(self.folder.name) / "state"
        state.mkdir()
        # Goal and fence, kept by an earlier run: text form of ground stations.
        head = "QGC WPL 110\n"
        row = "{}\t0\t1\t{}\t{}\t0\t0\t0\t{}\t{}\t0\t1\n"
        (state / "mission.txt").write_text(
            head + "".join(row.format(i, 16, 0, 5.0 + i, 3.0) for i in range(3)))
        fence = [(0.5, 0.5), (0.5, 13.5), (7.5, 13.5), (7.5, 0.5)]
        (state / "fence.txt").write_text(
            head + "".join(row.format(i, 5001, 4, *corner) for i, corner in enumerate(fence)))
        self.vehicle = Vehicle(
            self.folder.name, "-v", "--set", f"daemon.state_directory={state}",
            "--set", f"mavlink.identity={self.identity}")
        self.between = FilteredLink(self.vehicle.port)
        self.addCleanup(self.stop)
        # The car is there when it has been heard once, whatever is left out later.
        end = time.monotonic() + 60.0
        while not self.is_there():
            self.assertLess(time.monotonic(), end, self.vehicle.log)

    def is_there(self):
        connection = Connection(self.between.port)
        try:
            connection.step = "heartbeat"
            connection.heartbeat()
        except Stuck:
            return False
        finally:
            connection.link.close()
        return True

    def stop(self):
        self.between.close()
        self.vehicle.close()

    def connect(self, hurried=None):
        connection = Connection(self.between.port, hurried)
        try:
            connection.run()
        finally:
            connection.link.close()
        return connection

    def test_the_whole_sequence_is_answered(self):
        connection = self.connect()
        self.assertEqual(connection.generic, self.identity == "generic")
        self.assertEqual(len(connection.modes), 4)
        self.assertFalse(connection.capabilities & RALLY_BIT)
        self.assertEqual(len(connection.plans[MISSION]), 3)
        self.assertEqual(len(connection.plans[FENCE]), 4)
        entry = check_general(self, connection.metadata["general"])
        names = check_parameters(self, connection.metadata[entry["type"]])
        self.assertEqual(names, set(connection.parameters))


class Px4Sequence(Sequence):
    identity = "px4"


class Incomplete(Sequence):
    def test_no_answer_may_be_left_out(self):
        for what, (drop, step) in LEFT_OUT.items():
            with self.subTest(what):
                self.between.leave_out(drop)
                # Heartbeats come once a second: to leave one out there has to be one.
                with self.assertRaises(Stuck) as stuck:
                    self.connect(hurried=None if step == "heartbeat" else step)
                self.assertEqual(stuck.exception.step, step, stuck.exception)
                self.assertGreater(self.between.dropped, 0)
        # It was not for anything else.
        self.between.leave_out(lambda frame, asked: False)
        self.connect()

    # What it has from its parent is tried there.
    test_the_whole_sequence_is_answered = None


if __name__ == "__main__":
    unittest.main()
