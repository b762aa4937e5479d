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


class Vehicle:
    """A simulated car that waits for goals."""

    def __init__(self, folder, *arguments):
        self.port = free_port()
        binary = os.environ.get("APEXD_BINARY", ROOT / "target/release/apexd")
        command = [
            str(binary), "sil", "--mavlink", f"udpin:127.0.0.1:{self.port}", "--json",
            "--out", str(folder), "--predictor", "none", *arguments,
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
