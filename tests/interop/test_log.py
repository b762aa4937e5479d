"""Reads the log of a drive with the reference implementation of MCAP, and finds in it what the drive
itself says; replays what daemons on a bus have written.

Needs the program, in APEXD_BINARY or target/release/apexd, and for the latter the results of hil/run,
in APEXD_HIL or target/hil.
"""

import collections
import json
import os
import pathlib
import subprocess
import tempfile
import unittest

import cantools
import fastcrc
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

ROOT = pathlib.Path(__file__).parents[2]
BINARY = os.environ.get("APEXD_BINARY", ROOT / "target/release/apexd")
HIL = pathlib.Path(os.environ.get("APEXD_HIL", ROOT / "target/hil"))
EXTENDED, FD = 1 << 31, 1 << 30


class Log(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.log = pathlib.Path(folder.name) / "drive.mcap"
        command = [BINARY, "sil", "--maze", "3", "--time-limit", "4", "--predictor", "none"]
        command += ["--json", "--out", folder.name, "--log", cls.log]
        done = subprocess.run(command, stdout=subprocess.PIPE, timeout=600, check=False)
        cls.summary = json.loads(done.stdout)
        cls.messages = collections.defaultdict(list)
        with cls.log.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages(log_time_order=False):
                cls.messages[channel.topic].append(message)

    def test_every_chunk_has_the_right_checksum(self):
        with self.log.open("rb") as file:
            records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
        chunks = [record for record in records if isinstance(record, Chunk)]
        self.assertGreater(len(chunks), 2)
        with self.log.open("rb") as file:
            read = sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages())
        self.assertEqual(read, sum(map(len, self.messages.values())))

    def test_the_frames_sent_give_the_digest_of_the_drive(self):
        data = b"".join(message.data[4:] for message in self.messages["/can/sent"])
        self.assertEqual(f"{fastcrc.crc64.xz(data):016x}", self.summary["digest"])

    def test_every_frame_is_one_of_the_database(self):
        database = cantools.database.load_file(ROOT / "params/car.dbc")
        known = {(message.frame_id, message.is_fd): message for message in database.messages}
        seen = collections.Counter()
        for topic in ("/can/received", "/can/sent"):
            for message in self.messages[topic]:
                word = int.from_bytes(message.data[:4], "little")
                self.assertFalse(word & EXTENDED)
                kind = known[word & ~FD, bool(word & FD)]
                self.assertEqual(len(message.data) - 4, kind.length)
                kind.decode(message.data[4:])
                seen[kind.name] += 1
        self.assertGreater(len(seen), 5, seen)

    def test_states_are_json_by_their_schema_in_order_of_time(self):
        with self.log.open("rb") as file:
            schemas = {
                channel.topic: (channel.message_encoding, schema)
                for schema, channel, _ in make_reader(file).iter_messages(log_time_order=False)
            }
        for topic in ("/core/state", "/core/event"):
            encoding, schema = schemas[topic]
            self.assertEqual((encoding, schema.encoding), ("json", "jsonschema"))
            named = json.loads(schema.data)["properties"]
            for message in self.messages[topic]:
                self.assertLessEqual(set(json.loads(message.data)), set(named))
        times = [message.log_time for message in self.messages["/core/state"]]
        self.assertEqual(times, sorted(times))
        states = [json.loads(message.data) for message in self.messages["/core/state"]]
        self.assertIn("drive", {state["mode"] for state in states})
        self.assertGreater(max(state.get("speed_mps", 0.0) for state in states), 1.0)
        header = json.loads(self.messages["/apexd/header"][0].data)
        self.assertEqual((header["source"], header["part"]), ("sil", 1))


class DaemonLogs(unittest.TestCase):
    """Written in real time by a daemon with its threads, some of them killed."""

    def test_what_daemons_did_on_a_bus_is_repeated_to_the_last_bit(self):
        logs = [log for log in sorted(HIL.glob("**/*.mcap")) if "-part" not in log.stem]
        if not logs:
            self.skipTest(f"no logs in {HIL}")
        for log in logs:
            with self.subTest(log=log.relative_to(HIL)):
                command = [BINARY, "replay", log, "--json"]
                done = subprocess.run(command, stdout=subprocess.PIPE, timeout=600, check=False)
                found = json.loads(done.stdout)
                self.assertTrue(found["identical"], found)
                if found["ended"] == "closed":
                    self.assertGreater(found["frames"], 0)


if __name__ == "__main__":
    unittest.main()
