"""Arms that send lines to a real pseudo-terminal or socket, with everything that goes wrong on a cable."""

import array
import contextlib
import fcntl
import os
import socket
import termios
import threading
import time
import tty
from collections import Counter
from pathlib import Path

import numpy as np

from aacmm_jax.live.devices.line_format import CHECKSUMS

RATE = 100.0


def checked_line(q: np.ndarray, number: int, checksum: str = "xor") -> bytes:
    """A line in degrees with its number and checksum, as the option strings below describe it."""
    text = ",".join([str(number), *(f"{x:.5f}" for x in np.degrees(q))])
    compute, digits = CHECKSUMS[checksum]
    return f"{text}*{compute(text.encode()):0{digits}X}\n".encode()


def columns(joints: int) -> str:
    return ",".join(["number", *(f"q_{i + 1}" for i in range(joints))])


class Pty:
    """A pseudo-terminal at a path that stays the same when the cable is pulled and put back."""

    kind = "serial"

    def __init__(self, folder: Path):
        self.where, self._master = str(folder / "ttyArm"), -1
        self.plug()

    def plug(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        with contextlib.suppress(FileNotFoundError):
            os.remove(self.where)
        os.symlink(os.ttyname(self._slave), self.where)

    def send(self, data: bytes) -> None:
        until = time.monotonic() + 5
        while data and time.monotonic() < until:  # a computer that is busy reads late
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._master, data) :]
            if data:
                time.sleep(0.002)

    def unplug(self) -> None:
        # What is not read when a pseudo-terminal is closed is lost with it, and nobody could count it.
        until, waiting = time.monotonic() + 5, array.array("i", [1])
        while waiting[0] and time.monotonic() < until:
            fcntl.ioctl(self._slave, termios.FIONREAD, waiting)
            time.sleep(0.05)
        os.close(self._slave)
        os.close(self._master)

    close = unplug


class Server:
    """A server on a port of its own that drops its client when the cable is pulled."""

    kind = "tcp"

    def __init__(self, _: Path):
        self._server = socket.create_server(("127.0.0.1", 0))
        self._server.settimeout(0.01)
        self.where, self._client = f"127.0.0.1:{self._server.getsockname()[1]}", None

    def plug(self) -> None:
        pass

    def send(self, data: bytes) -> None:
        if self._client is None:
            with contextlib.suppress(TimeoutError):
                self._client = self._server.accept()[0]
        if self._client is not None:
            self._client.sendall(data)

    def unplug(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None

    def close(self) -> None:
        self.unplug()
        self._server.close()


class Growing:
    """A file that a recorder writes, which begins anew where the cable is pulled."""

    kind = "file"

    def __init__(self, folder: Path):
        self.where = str(folder / "recorder.csv")
        self.plug()

    def plug(self) -> None:
        Path(self.where).write_bytes(b"")

    def send(self, data: bytes) -> None:
        with open(self.where, "ab") as file:
            file.write(data)

    def close(self) -> None:
        pass


class Feeder(threading.Thread):
    """Takes an arm to poses one after the other, a line each 10 ms, and counts what it spoils.

    ``sent`` are the poses that were held, ``spoilt`` the bad lines by kind. Lines are spoilt only while the device is
    ``connected``, since nobody sees others.
    """

    def __init__(self, source, poses, connected, *, hold=1.6, move=0.4, unplug_every=5.0, spoil=0.05, noise=1e-5):
        super().__init__(daemon=True)
        self.source, self.poses, self.connected = source, poses, connected
        self.hold, self.move, self.unplug_every, self.spoil, self.noise = hold, move, unplug_every, spoil, noise
        self.spoilt, self.number, self.random, self.error = Counter(), 0, np.random.default_rng(1), None
        self.done = threading.Event()

    def run(self):
        try:
            self._run()
        except Exception as error:
            self.error = error
        self.done.set()

    def _run(self):
        q, began, unplugged = self.poses[0], time.monotonic(), time.monotonic()
        for goal in self.poses:
            steps = int(self.move * RATE)
            path = [q + (goal - q) * (i + 1) / steps for i in range(steps)] + [goal] * int(self.hold * RATE)
            for step in path:
                now = time.monotonic()
                if self.unplug_every and now - unplugged > self.unplug_every:
                    unplugged = now
                    self._pull()
                self._send(step)
                began += 1 / RATE
                time.sleep(max(0.0, began - time.monotonic()))
            # A pose is held until it could be read for as long as it takes.
            waited = time.monotonic()
            while not self.connected() and time.monotonic() - waited < 5:
                self._send(goal)
                time.sleep(1 / RATE)
            for _ in range(int(0.8 * RATE)):
                self._send(goal)
                time.sleep(1 / RATE)
            q, began = goal, time.monotonic()

    def _pull(self):
        if self.connected() and self.random.uniform() < 0.7:
            self.source.send(checked_line(self.poses[0], self.number + 1)[:17])  # half a line
            self.spoilt["half"] += 1
        time.sleep(0.3)
        self.source.unplug()
        until = time.monotonic() + 5
        while self.connected() and time.monotonic() < until:  # nobody counts what is sent before it is noticed
            time.sleep(0.01)
        time.sleep(0.2)
        self.source.plug()

    def _send(self, q):
        self.number += 1
        line = checked_line(q + self.noise * self.random.normal(size=len(q)), self.number)
        if self.connected() and self.random.uniform() < self.spoil:
            kind = str(self.random.choice(["checksum", "garbage", "binary", "cut"]))
            bad = {
                "checksum": line[:-4] + b"\x2a00\n" if not line.endswith(b"*00\n") else b"1*FF\n",
                "garbage": b"ERROR overflow in encoder board 3\n",
                "binary": bytes(self.random.integers(128, 256, 40, dtype=np.uint8)) + b"\n",
                "cut": line[: len(line) // 2] + b"\n",
            }[kind]
            self.spoilt[kind] += 1
            self.source.send(bad)
        self.source.send(line)
