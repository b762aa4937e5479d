"""Speaks the car's CAN interface from params/car.dbc alone, with the package cantools.

Usage: can_dbc.py CAR.DBC < requests > answers; one JSON object a line each way.
  {"check": {id, fd, data, signals}}  decodes a frame and compares; answers {"ok": true}
  {"make": {message, counter, signals}}  answers a protected frame {id, fd, data}
  {"scan": {...}}, {"odometry": {...}}  answer all frames of one message
Exits with 1 at the first disagreement. tests/can_interop.rs is the other end.

The end-to-end protection is written here from the AUTOSAR specification, bit by bit.
"""

import itertools
import json
import sys

import cantools


def crc(data, width, polynomial, value):
    """Plain shift register, most significant bit first, no final inversion."""
    top = 1 << (width - 1)
    for byte in data:
        value ^= byte << (width - 8)
        for _ in range(8):
            value = (value << 1 ^ polynomial if value & top else value << 1) & ((1 << width) - 1)
    return value


def protection(message, data):
    """The CRC that a frame must carry: profile 11 in Data ID mode "both", or profile 5."""
    data_id = message.dbc.attributes["E2EDataId"].value
    low, high = data_id & 0xFF, data_id >> 8
    if message.is_fd:
        return crc(bytes(data[2:]) + bytes([low, high]), 16, 0x1021, 0xFFFF)
    return crc(bytes([low, high]) + bytes(data[1:]), 8, 0x1D, 0)


class Car:
    def __init__(self, path):
        self.database = cantools.database.load_file(path)
        self.counters = {}
        for message in self.database.messages:
            profile = message.dbc.attributes["E2EProfile"].value
            # The number of the choice: None, P05, P11A.
            assert profile == (1 if message.is_fd else 2), f"{message.name}: {profile}"
            assert bool(message.is_fd) == (not message.name.endswith("Classic")), message.name
            streams = ("LidarScan", "BrakingTail")
            assert bool(message.cycle_time) != message.name.startswith(streams), message.name

    def check(self, request):
        message = self.database.get_message_by_frame_id(request["id"])
        data = bytes.fromhex(request["data"])
        assert message.is_fd == request["fd"] and message.length == len(data), message.name
        got = message.decode(data)
        assert got["Crc"] == protection(message, data), f"{message.name}: CRC"
        for name, expected in request["signals"].items():
            value = got[name]
            if isinstance(expected, str):
                right = str(value) == expected
            else:
                right = expected[0] <= float(value) <= expected[1]
            assert right, f"{message.name}.{name}: {value}, expected {expected}"
        return [{"ok": True}]

    def make(self, name, signals, counter=None):
        message = self.database.get_message_by_name(name)
        if counter is None:
            counter = self.counters.get(name, 0)
            self.counters[name] = (counter + 1) % (256 if message.is_fd else 15)
        data = bytearray(message.encode({"Crc": 0, "Counter": counter, **signals}))
        value = protection(message, data)
        if message.is_fd:
            data[0:2] = value.to_bytes(2, "little")
        else:
            data[0] = value
        return {"id": message.frame_id, "fd": message.is_fd, "data": data.hex()}

    def scan(self, r):
        name = "LidarScan" + r["layout"]
        ranges = r["ranges"]
        if not r["layout"]:
            yield self.make(name, {
                "Part": "Head", "Last": 0, "Boot": r["boot"], "Scan": r["scan"],
                "Stamp": r["stamp"], "BeamCount": len(ranges), "RangeMax": r["range_max"],
                "AngleFirst": r["angle_first"], "AngleStep": r["angle_step"]})
            for first in range(0, len(ranges), 28):
                block = ranges[first:first + 28]
                block += ["Invalid"] * (28 - len(block))
                yield self.make(name, {
                    "Part": "Block", "Last": int(first + 28 >= len(ranges)), "Boot": r["boot"],
                    "Scan": r["scan"], "FirstBeam": first,
                    **{f"Range{i:02}": value for i, value in enumerate(block)}})
            return
        sealed = b""
        heads = [
            {"Part": 12, "Stamp": r["stamp"], "Scan": r["scan"]},
            {"Part": 13, "AngleFirst": r["angle_first"], "BeamCount": len(ranges),
             "Boot": r["boot"]},
            {"Part": 14, "AngleStep": r["angle_step"], "RangeMax": r["range_max"]}]
        blocks = []
        for i, first in enumerate(range(0, len(ranges), 3)):
            block = ranges[first:first + 3] + ["Invalid"] * 2
            blocks.append({"Part": i % 11, **{f"Range{j:02}": block[j] for j in range(3)}})
        for signals in itertools.chain(heads, blocks):
            frame = self.make(name, signals)
            sealed += bytes.fromhex(frame["data"])[2:]
            yield frame
        seal = crc(sealed, 16, 0x1021, 0xFFFF)
        yield self.make(name, {
            "Part": 15, "EndScan": r["scan"], "EndBeamCount": len(ranges), "Seal": seal})

    def odometry(self, r):
        name = "CarOdometry" + r.pop("layout")
        if not name.endswith("Classic"):
            yield self.make(name, r)
            return
        parts = [("Stamp", "WheelSpeedLeft"), ("Travelled", "WheelSpeedRight"),
                 ("Turned", "SteeringAngle"), ("StampAgain", "YawRate")]
        r["StampAgain"] = r["Stamp"]
        for i, names in enumerate(parts):
            yield self.make(name, {"Part": i, "Boot": r["Boot"], **{n: r[n] for n in names}})

    def answer(self, request):
        [(kind, body)] = request.items()
        if kind == "check":
            return self.check(body)
        if kind == "make":
            return [self.make(body["message"], body["signals"], body["counter"])]
        return getattr(self, {"scan": "scan", "odometry": "odometry"}[kind])(body)


def main():
    car = Car(sys.argv[1])
    for line in sys.stdin:
        try:
            for answer in car.answer(json.loads(line)):
                print(json.dumps(answer))
        except AssertionError as error:
            sys.exit(f"can_dbc.py: {error}\n  request: {line.strip()}")


if __name__ == "__main__":
    main()
