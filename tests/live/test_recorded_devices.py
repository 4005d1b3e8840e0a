"""From each kind of device to a written capture, by the command in a process of its own."""

import json
import os
import re
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj

from .line_sources import Pty, Server, checked_line, columns
from .test_devices import CAMERA, Bus

ARM = "cheng2018-simulation"
POINTS = {"A": [400.0, 200.0, 300.0], "B": [450.0, -150.0, 250.0]}
SOCKETS = "".join(f'[[socket]]\nname = "{name}"\npoint = {point}\n' for name, point in POINTS.items())
LENGTH = '[[length]]\nfrom = "A"\nto = "B"\nvalue = 357.1\nu = 0.002\n'
TRACKER = '[[points]]\nname = "tracker"\nbox = [[-900, -900, -900], [900, 900, 900]]\nu = 0.02\n'
STEPS, HOLD = 40, 0.01  # readings of a motion, and s between readings


def seated(each: int = 2) -> tuple[list[str], np.ndarray]:
    """Poses in the sockets, in turn, and the names of these."""
    arm, random, names = aj.load_arm(ARM), np.random.default_rng(3), [*POINTS] * each
    poses: list[np.ndarray] = []
    while len(poses) < len(names):
        q, arrived = aj.kinematics.project_to_targets(
            arm, random.uniform(-1, 1, (1, arm.joints)), np.array([POINTS[names[len(poses)]]])
        )
        poses += [np.asarray(q)[0]] if arrived[0] else []
    return names, np.array(poses)


class Capturing:
    """``aacmm live --terminal``, and how many poses it has said that it took."""

    def __init__(self, folder, device: str, kit: str, *more: str):
        (folder / "kit.toml").write_text(kit)
        line = [sys.executable, "-m", "aacmm_jax", "live", ARM, "--terminal", "--device", device, "--kit", "kit.toml"]
        self.process = subprocess.Popen(
            [*line, "-o", "capture.h5", "--capture-only", *more], cwd=folder, text=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        self.folder, self.places, self.said = folder, [], []
        self._listening = threading.Thread(target=self._listen, daemon=True)
        self._listening.start()

    def _listen(self):
        for line in self.process.stdout:
            self.said.append(line)
            self.places += re.findall(r"^pose \d+ in (.*)$", line, re.M)

    def waits(self, count: int) -> bool:
        """Whether fewer poses than these are taken, and may still be."""
        assert self.process.poll() is None, "".join(self.said)
        return len(self.places) < count

    def written(self) -> "aj.Capture":
        """The capture, after `f`, as the command and Python show it."""
        try:
            self.process.stdin.write("f")
            self.process.stdin.close()
            assert self.process.wait(60) == 0, "".join(self.said)
        finally:
            self.process.kill()
            self._listening.join(10)
            self.process.stdout.close()
        shown = subprocess.run(
            [sys.executable, "-m", "aacmm_jax", "show", "capture.h5"], cwd=self.folder, capture_output=True, text=True
        )
        assert shown.returncode == 0, shown.stderr
        return aj.files.load_capture(self.folder / "capture.h5").capture


def driven(capturing: Capturing, poses: np.ndarray, send, at: np.ndarray | None = None, taken: int = 0) -> None:
    """Go from ``at`` from pose to pose, and rest in each until it is taken, and a little longer."""
    at = poses[0] if at is None else at
    for number, goal in enumerate(poses, start=taken + 1):
        for q in np.linspace(at, goal, STEPS):
            send(q)
            time.sleep(HOLD)
        until, rested = time.monotonic() + 60, 0
        while rested < STEPS:
            assert time.monotonic() < until, f"pose {number} was not taken: {''.join(capturing.said)}"
            send(goal)
            time.sleep(HOLD)
            rested += not capturing.waits(number)
        at = goal


class Datagrams:
    """One a reading, with a checksum; what is no line comes in between."""

    kit = SOCKETS + LENGTH

    def __init__(self, folder):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.address = free.getsockname()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.device = f"udp:127.0.0.1:{self.address[1]}?columns={columns(6)}&checksum=xor&checksum_after=*"
        self.stream, self.sent, self.number, self.unheard = folder / "stream", bytearray(), 0, 0

    def send(self, q):
        if not (self.stream.exists() and self.stream.stat().st_size):
            self.unheard = len(self.sent)  # a socket that is not open yet gets nothing
        self.number = number = self.number + 1
        for line in [b"restarted\n"] * (number % 50 == 0) + [checked_line(q, number)]:
            self.socket.sendto(line, self.address)
            self.sent += line

    def end(self):
        self.socket.close()


class Recorder:
    """A recorder's table that grows a piece at a time, is rotated, and ends within a line."""

    kit = SOCKETS + LENGTH
    device = "file:recorder.csv"

    def __init__(self, folder):
        self.path, self.stream, self.sent, self.rows = folder / "recorder.csv", folder / "stream", bytearray(), 0

    def send(self, q):
        if self.rows == 150:
            until = time.monotonic() + 60
            while not self.stream.exists() or self.stream.stat().st_size < 0.9 * len(self.sent):  # it is read
                assert time.monotonic() < until
                time.sleep(0.01)
            os.replace(self.path, self.path.with_suffix(".1"))
        header = (
            b"" if self.path.exists() else b"time_s," + ",".join(f"q_{i}_deg" for i in range(1, 7)).encode() + b"\n"
        )
        self.rows += 1
        line = f"{0.01 * self.rows:.2f},{','.join(f'{x:.5f}' for x in np.degrees(q))}\n".encode()
        for piece in (header + line[:17], line[17:]):  # half a line waits for its end
            with open(self.path, "ab") as file:
                file.write(piece)
            self.sent += piece

    def end(self):
        with open(self.path, "ab") as file:
            file.write(b"9.99,12.3")
        self.sent += b"9.99,12.3\n"  # each line of the stream is whole
        time.sleep(0.5)


class Cable:
    """Lines on a real cable, a bad one in fifty; the cable is pulled once."""

    kit = SOCKETS + LENGTH

    def __init__(self, source):
        self.source, self.sent, self.number = source, bytearray(), 0
        self.device = f"{source.kind}:{source.where}?columns={columns(6)}&checksum=xor&checksum_after=*"

    def send(self, q):
        self.number = number = self.number + 1
        if number == 120:
            self.source.unplug()
            time.sleep(0.3)
            self.source.plug()
        for line in [b"encoder 3?\n"] * (number % 50 == 0) + [checked_line(q, number)]:
            self.source.send(line)
            self.sent += line

    def end(self):
        time.sleep(0.5)
        self.source.close()


class Servos:
    """A bus of servos, an answer in ten spoilt."""

    kit, protocol = SOCKETS, 1
    device = "servos:bus.toml"

    def __init__(self, folder):
        self.bus = Bus(dict.fromkeys(range(1, 7), 2048), self.protocol)
        self.bus.start()
        (folder / "bus.toml").write_text(
            f'port = "{self.bus.path}"\nids = [1, 2, 3, 4, 5, 6]\nprotocol = {self.protocol}\n'
        )

    def send(self, q):
        counts = np.round(2048 + q * 4096 / (2 * np.pi)).astype(int)
        if self.protocol == 1:
            counts = np.where(counts < 0, 0x8000 | -counts, counts)
        self.bus.counts.update(enumerate(counts, start=1))


class ServosOfProtocol2(Servos):
    """The same, with negative numbers in two's complement."""

    protocol = 2


class Simulated:
    """Goes where it is asked to."""

    kit = SOCKETS + LENGTH
    device = "simulated:?speed=20&bad=0"
    send = None

    def __init__(self, folder):
        pass


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        Datagrams,
        Recorder,
        Servos,
        ServosOfProtocol2,
        Simulated,
        pytest.param(lambda folder: Cable(Pty(folder)), id="Serial"),
        pytest.param(lambda folder: Cable(Server(folder)), id="Tcp"),
    ],
)
def test_a_device_gives_a_capture_and_the_stream_has_every_sample(tmp_path, kind):
    source = kind(tmp_path)
    capturing = Capturing(tmp_path, source.device, source.kit, "--keep-stream", "stream")
    places, poses = seated()
    if source.send is None:
        while capturing.waits(len(poses)) or set(capturing.places) != {*POINTS}:
            time.sleep(0.05)
    else:
        driven(capturing, poses, source.send)
        getattr(source, "end", lambda: None)()
        assert capturing.places == places
    capture = capturing.written()
    stream = (tmp_path / "stream").read_bytes()
    if source.send is not None:
        resolution = 2 * np.pi / 4096 if isinstance(source, Servos) else 1e-6
        for name in POINTS:
            wanted = poses[[place == name for place in places]]
            np.testing.assert_allclose(capture.sockets[name], wanted, atol=resolution)
    if "length" in source.kit:
        assert [(x.start, x.end, float(x.value), float(x.u)) for x in capture.lengths] == [("A", "B", 357.1, 0.002)]
    if kind is Recorder:
        assert stream == source.sent
    elif kind is Datagrams:  # what came before the socket was open is lost
        assert len(stream) > 0.5 * (len(source.sent) - getattr(source, "unheard", 0))
        assert source.sent.endswith(stream)
    elif isinstance(source, Cable):  # what was on the cable when it was pulled, or before it was there, is lost
        lines, sent = stream.splitlines(), bytes(source.sent).splitlines()
        assert len(lines) > 0.8 * len(sent[sent.index(lines[0]) :])
        assert {*lines[:-1]} <= {*sent}
        assert lines[-1] == sent[-1]
    else:
        samples = [json.loads(line) for line in stream.splitlines()]
        rows = np.array([sample["q"] for sample in samples])
        assert np.all(np.diff([sample["time"] for sample in samples]) > 0)
        for q in np.asarray(capture.readings)[:, :6]:
            assert np.min(np.max(np.abs(rows - q), axis=1)) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kit", "kind"),
    [(SOCKETS, "sqlite3"), (TRACKER, "sqlite3"), (TRACKER, "mcap"), (TRACKER, "rosbag1")],
    ids=["sockets", "tracker", "mcap", "ROS 1"],
)
def test_a_recording_that_is_played_back_gives_a_capture(tmp_path, kit, kind):
    pytest.importorskip("rosbags")
    from tests.files.table_sources.ros_recordings import record

    places, poses = seated()
    record(tmp_path, kind, ARM, poses)
    tables = "?speed=2" + "&table=/tracker" * (kit == TRACKER)
    capturing = Capturing(tmp_path, f"bag:session{'.bag' * (kind == 'rosbag1')}{tables}", kit)
    while capturing.waits(len(poses)):
        time.sleep(0.05)
    time.sleep(1.0)  # it rests in the last pose, which is not taken again
    capture = capturing.written()
    if kit == SOCKETS:
        assert capturing.places == places
        for name in POINTS:
            wanted = poses[[place == name for place in places]]
            np.testing.assert_allclose(capture.sockets[name], wanted, atol=1e-5)
    else:
        (seen,) = capture.observations
        np.testing.assert_allclose(seen.q, poses, atol=1e-5)
        tips = np.asarray(aj.load_arm(ARM).position(poses))
        np.testing.assert_allclose(seen.points, tips, atol=0.02)


@pytest.mark.slow
def test_a_camera_beside_a_recorder_gives_a_capture(tmp_path):
    cv2 = pytest.importorskip("cv2")
    arm, intrinsics, size = aj.load_arm(ARM), [600.0, 600.0, 319.5, 239.5], (640, 480)
    facing = np.eye(4)
    facing[:3, 3] = -105.0, -75.0, 400.0
    middle = np.array([0.3, 0.4, -0.5, 0.6, 0.7, 0.2])
    poses = middle + np.array([[0.0], [0.06], [-0.05], [0.1]]) * np.array([1, -1, 1, 1, -1, 2])
    still = np.asarray(arm.pose(middle)) @ facing  # the board; the camera is in the last frame
    frame = [*Rotation.from_matrix(still[:3, :3]).as_rotvec().tolist(), *still[:3, 3].tolist()]
    source = Recorder(tmp_path)
    kit = CAMERA + f"mount = [0, 0, 0, 0, 0, 0]\nframe = {frame}\n"
    (tmp_path / "kit.toml").write_text(kit)
    board = aj.live.read_setup(ARM, kit=tmp_path / "kit.toml").targets["board"]
    seen = []
    for q in poses:
        transform = np.linalg.inv(np.asarray(arm.pose(q))) @ still
        seen.append(np.asarray(aj.camera.render(board, transform, "pinhole", intrinsics, size)))

    def film(image):
        writer = cv2.VideoWriter(str(tmp_path / "next.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, size)
        for _ in range(3):  # it is soon over, and opened again
            writer.write(np.repeat(image[:, :, None], 3, axis=2).astype(np.uint8))
        writer.release()
        os.replace(tmp_path / "next.avi", tmp_path / "seen.avi")

    film(seen[0])
    capturing = Capturing(
        tmp_path, source.device, kit, "--device", "camera:seen.avi?rate=20", "--keep-stream", "stream"
    )
    for i, image in enumerate(seen):
        film(image)
        driven(capturing, poses[i : i + 1], source.send, poses[max(i - 1, 0)], i)
    source.end()
    capture = capturing.written()
    (pixels,) = capture.observations
    np.testing.assert_allclose(pixels.q, poses, atol=1e-6)
    for i, image in enumerate(seen):
        found, known = aj.camera.detect(image, board), np.asarray(pixels.ids[i]) >= 0
        np.testing.assert_array_equal(np.asarray(pixels.ids[i])[known], found.ids)
        np.testing.assert_allclose(np.asarray(pixels.corners[i])[known], found.corners, atol=0.3)
