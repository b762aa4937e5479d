"""As much of MAVLink 2 as it takes to send the car somewhere else: COMMAND_INT with DO_REPOSITION."""

import socket
import struct

COMMAND_INT, COMMAND_INT_EXTRA = 75, 158
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


def send(data, port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.sendto(data, ("127.0.0.1", port))
