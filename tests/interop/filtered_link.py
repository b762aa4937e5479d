"""A UDP link that leaves out what it is told to: between a station and the car, datagram by datagram."""

import select
import socket
import struct
import threading


class Frame:
    """As much of a MAVLink 2 message as it takes to choose by; the payload with its zeros back."""

    def __init__(self, data):
        self.number = int.from_bytes(data[7:10], "little")
        self.payload = data[10:10 + data[1]].ljust(255, b"\0")


def frames(datagram):
    while len(datagram) >= 12 and datagram[0] == 0xFD:
        length = datagram[1] + (25 if datagram[2] & 1 else 12)
        yield datagram[:length]
        datagram = datagram[length:]


class FilteredLink:
    """`port` is the car's for whoever sends there. `drop(frame, asked)` says which of the car's messages
    are left out; `asked` is the message that the station requested last."""

    def __init__(self, car_port):
        self.near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.near.bind(("127.0.0.1", 0))
        self.port = self.near.getsockname()[1]
        self.far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.far.connect(("127.0.0.1", car_port))
        self.station = None
        self.asked = None
        self.lock = threading.Lock()
        self.drop = lambda frame, asked: False
        self.dropped = 0
        self.ending = False
        self.thread = threading.Thread(target=self.run, daemon=True)
        self.thread.start()

    def leave_out(self, drop):
        with self.lock:
            self.drop, self.dropped, self.asked = drop, 0, None

    def run(self):
        while not self.ending:
            ready, _, _ = select.select([self.near, self.far], [], [], 0.2)
            for end in ready:
                try:
                    datagram, sender = end.recvfrom(4096)
                    with self.lock:
                        self.pass_on(end, datagram, sender)
                except ConnectionError:
                    # The other side is not there yet, or not any more.
                    continue

    def pass_on(self, end, datagram, sender):
        if end is self.near:
            self.station = sender
            for data in frames(datagram):
                frame = Frame(data)
                # COMMAND_LONG with REQUEST_MESSAGE: the first parameter is the message's number.
                if frame.number == 76 and int.from_bytes(frame.payload[28:30], "little") == 512:
                    self.asked = int(struct.unpack_from("<f", frame.payload)[0])
            self.far.send(datagram)
            return
        for data in frames(datagram):
            if self.drop(Frame(data), self.asked):
                self.dropped += 1
            elif self.station:
                self.near.sendto(data, self.station)

    def close(self):
        self.ending = True
        self.thread.join()
        self.near.close()
        self.far.close()
