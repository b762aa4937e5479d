"""Starts `apexd sil` with a MAVLink link and waits for it; for the tests with other clients."""

import json
import os
import socket
import subprocess
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def binary():
    return str(os.environ.get("APEXD_BINARY", ROOT / "target/release/apexd"))


def write_hall(folder):
    """A hall of 14 m by 8 m with a wall across it that leaves 3 m, as a map_server map."""
    cell = 0.1
    width, height = 140, 80

    def solid(x, y):
        edge = x < 2 or y < 2 or x >= width - 2 or y >= height - 2
        return edge or (69 <= x < 71 and y < 50)

    rows = bytes(0 if solid(x, height - 1 - y) else 254 for y in range(height) for x in range(width))
    folder = Path(folder)
    (folder / "hall.pgm").write_bytes(b"P5\n%d %d\n255\n" % (width, height) + rows)
    yaml = folder / "hall.yaml"
    yaml.write_text(
        f"image: hall.pgm\nresolution: {cell}\norigin: [0.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.25\n"
    )
    return yaml


class Vehicle:
    """A simulated car that waits for goals in a hall, at 2 m east and 3 m north."""

    def __init__(self, folder, *arguments):
        self.port = free_port()
        command = [
            binary(), "sil", "--mavlink", f"udpin:127.0.0.1:{self.port}", "--json",
            "--out", str(Path(folder) / "report"), "--predictor", "none",
            "--map", str(write_hall(folder)), "--start", "2,3,0", *arguments,
        ]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.log = []
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        for line in self.process.stderr:
            self.log.append(line.rstrip())

    def end(self):
        """Interrupts the drive; the figures of it."""
        self.process.terminate()
        try:
            output, _ = self.process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        lines = [line for line in output.splitlines() if line.startswith("{")]
        if not lines:
            raise AssertionError("no figures; the log:\n" + "\n".join(self.log))
        return self.process.returncode, json.loads(lines[-1])
