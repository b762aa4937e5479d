"""As much of MAVLink 2 as it takes to be a ground station that is heard, to send the car somewhere else
(COMMAND_INT with DO_REPOSITION), to terminate its drive, and to flood its link.

Usage, for a flood of its own process: mavlink.py PORT RATE; it ends when its input does, and says how many
packets a second the kernel took.
"""

import ctypes
import random
import select
import socket
import struct
import sys
import time

HEARTBEAT, HEARTBEAT_EXTRA = 0, 50
COMMAND_LONG, COMMAND_LONG_EXTRA = 76, 152
COMMAND_INT, COMMAND_INT_EXTRA = 75, 158
DO_FLIGHTTERMINATION = 185
DO_REPOSITION = 192
LOCAL_ENU = 4
# Change to the mode that drives to goals, whichever was on.
CHANGE_MODE = 1.0


def crc_x25(data):
    crc = 0xFFFF
    for byte in data:
        low = (byte ^ crc) & 0xFF
        low ^= low << 4 & 0xFF
        crc = crc >> 8 ^ low << 8 ^ low << 3 ^ low >> 4
    return crc


def message(number, extra, payload):
    """A frame from the ground station 255, component 190."""
    payload = payload.rstrip(b"\0") or b"\0"
    head = struct.pack("<BBBBBB", len(payload), 0, 0, 0, 255, 190) + number.to_bytes(3, "little")
    return b"\xfd" + head + payload + struct.pack("<H", crc_x25(head + payload + bytes([extra])))


def reposition(x_m, y_m):
    """A new goal, map frame."""
    payload = struct.pack(
        "<ffffiifHBBBBB",
        -1.0, CHANGE_MODE, 0.0, float("nan"),
        round(x_m * 1e4), round(y_m * 1e4), 0.0,
        DO_REPOSITION, 1, 1, LOCAL_ENU, 0, 0,
    )
    return message(COMMAND_INT, COMMAND_INT_EXTRA, payload)


def heartbeat():
    """A ground station is there."""
    return message(HEARTBEAT, HEARTBEAT_EXTRA, struct.pack("<IBBBBB", 0, 6, 8, 0, 4, 3))


def termination():
    """The drive is over, for good."""
    payload = struct.pack("<7fHBBB", 1.0, 0, 0, 0, 0, 0, 0, DO_FLIGHTTERMINATION, 1, 1, 0)
    return message(COMMAND_LONG, COMMAND_LONG_EXTRA, payload)


def send(data, port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.sendto(data, ("127.0.0.1", port))


def noise(count=20, seed=1):
    """Packets of all kinds: heartbeats of ever new stations, questions that have an answer, commands with
    anything in them, frames with a wrong checksum, plain bytes. None of them can start a drive."""
    chance = random.Random(seed)
    made = []
    for i in range(count):
        kind = i % 5
        if kind == 0:
            made.append(heartbeat())
        elif kind == 1:
            # REQUEST_MESSAGE of AUTOPILOT_VERSION.
            ask = struct.pack("<7fHBBB", 148.0, 0, 0, 0, 0, 0, 0, 512, 1, 1, 0)
            made.append(message(COMMAND_LONG, COMMAND_LONG_EXTRA, ask))
        elif kind == 2:
            # Numbers of commands that mean nothing.
            command = chance.randrange(50_000, 60_000)
            params = [chance.uniform(-1e6, 1e6) for _ in range(7)]
            nonsense = struct.pack("<7fHBBB", *params, command, 1, 1, 0)
            made.append(message(COMMAND_LONG, COMMAND_LONG_EXTRA, nonsense))
        elif kind == 3:
            frame = bytearray(reposition(1.0, 1.0))
            frame[-1] ^= 0xFF
            made.append(bytes(frame))
        else:
            made.append(chance.randbytes(chance.randrange(1, 280)))
    return made


class Packets:
    """Many datagrams by one call of the kernel: in a guest a call costs more than the packet."""

    class Part(ctypes.Structure):
        _fields_ = [("base", ctypes.c_char_p), ("length", ctypes.c_size_t)]

    class Header(ctypes.Structure):
        # struct mmsghdr of a 64-bit Linux; the padding is the compiler's.
        _fields_ = [
            ("name", ctypes.c_void_p), ("name_length", ctypes.c_uint32),
            ("parts", ctypes.c_void_p), ("count", ctypes.c_size_t),
            ("control", ctypes.c_void_p), ("control_length", ctypes.c_size_t),
            ("flags", ctypes.c_int), ("sent", ctypes.c_uint),
        ]

    def __init__(self, datagrams):
        self.count = len(datagrams)
        self.parts = (self.Part * self.count)(*((data, len(data)) for data in datagrams))
        self.headers = (self.Header * self.count)()
        size = ctypes.sizeof(self.Part)
        for i, header in enumerate(self.headers):
            header.parts = ctypes.addressof(self.parts) + i * size
            header.count = 1
        self.libc = ctypes.CDLL(None, use_errno=True)

    def send(self, opened, most):
        """How many of them were sent, `most` at most."""
        most = min(most, self.count)
        return max(0, self.libc.sendmmsg(opened.fileno(), self.headers, most, 0))


def flood(port, rate_hz):
    packets = Packets(noise())
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    opened.connect(("127.0.0.1", port))
    began, sent = time.monotonic(), 0
    while not select.select([sys.stdin], [], [], 0.002)[0]:
        # What could not be sent in time is not sent later all at once.
        due = int((time.monotonic() - began) * rate_hz)
        left = min(due - sent, rate_hz // 20)
        while left > 0:
            done = packets.send(opened, left)
            if not done:
                break
            sent, left = sent + done, left - done
    print(sent / (time.monotonic() - began))


if __name__ == "__main__":
    flood(int(sys.argv[1]), int(sys.argv[2]))
