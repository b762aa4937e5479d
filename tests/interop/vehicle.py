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
        self.log, self.output = [], []
        self.readers = [
            threading.Thread(target=self._read, args=pair, daemon=True)
            for pair in ((self.process.stderr, self.log), (self.process.stdout, self.output))
        ]
        for reader in self.readers:
            reader.start()

    @staticmethod
    def _read(stream, lines):
        for line in stream:
            lines.append(line.rstrip())

    def finish(self, seconds=60):
        """Waits for the drive to end; exit code and figures of it."""
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise
        for reader in self.readers:
            reader.join()
        figures = [line for line in self.output if line.startswith("{")]
        if not figures:
            raise AssertionError("no figures; the log:\n" + "\n".join(self.log))
        return self.process.returncode, json.loads(figures[-1])

    def end(self):
        """Interrupts the drive; exit code and figures of it."""
        self.process.terminate()
        return self.finish()

    def close(self):
        """Ends it in whatever state it is."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for reader in self.readers:
            reader.join()
        self.process.stdout.close()
        self.process.stderr.close()
