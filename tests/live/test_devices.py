"""Devices that are no lines: a bus of servos, a camera, and the simulated arm, whose truth is known."""

import contextlib
import json
import os
import threading
import time
import tty
from collections import Counter

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.live.devices import device_kinds
from aacmm_jax.live.devices.servos import counts_in, crc_of_dynamixel, request
from tests.live import killed

SETUP = killed.setup()


def samples_of(device, wanted: int, seconds: float = 20.0):
    """So many samples of a device."""
    found, until = [], time.monotonic() + seconds
    while len(found) < wanted and time.monotonic() < until:
        found += device.read()
    return found


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("nothing", "does not begin with a kind of device"),
        ("lines:a", "does not begin with a kind of device"),
        ("../serial:a", "does not begin with a kind of device"),
        ("simulated:panda", "names an arm"),
        ("simulated:?sped=3", "no option 'sped'; did you mean 'speed'"),
        ("simulated:?speed=nan", "give a number"),
        ("simulated:?speed=0", "above 0"),
        ("simulated:?speed", "give a number"),
        ("tcp:host", "no port from 1 to 65535"),
        ("tcp:host:99999", "no port from 1 to 65535"),
        ("udp:127.0.0.1:5?speed=1", "speed"),
        ("serial:/dev/x?baud=fast", "give a number such as 115200"),
        ("servos:absent.toml", "absent.toml"),
        ("bag:absent?rate=3", "no option 'rate'"),
        ("bag:absent", "absent"),
        ("camera:0", "names no target of the kit"),
    ],
)
def test_texts_that_describe_no_device_are_refused(text, says):
    with pytest.raises(aj.InputError, match=says):
        aj.live.open_device(text, SETUP)


def test_the_kinds_of_devices():
    assert device_kinds() == ("bag", "camera", "file", "serial", "servos", "simulated", "tcp", "udp")


# The simulated arm


def test_a_simulated_arm_is_the_same_for_the_same_seed_and_rests_in_its_seat():
    q, place = np.full(6, 0.2), SETUP.place("A")

    def read(seed):
        device = aj.live.open_device(f"simulated:?seed={seed}&speed=200&bad=0&tremor=20", SETUP)
        device.asked(place, q)
        return device, np.array([sample.q for sample in samples_of(device, 700)[:700]])

    (device, first), (_, again), (_, other) = read(1), read(1), read(2)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01
    held = first[-100:]  # held in its seat by a trembling hand
    tips = np.asarray(device.true.position(held))
    noise = np.hypot(device.seating, 700 * device.encoder.max())
    assert np.linalg.norm(tips.mean(axis=0) - device.positions["A"]) < 5 * noise
    assert held.std(axis=0).max() > 3 * device.encoder.max()


@pytest.mark.slow
def test_a_simulated_operator_makes_mistakes():
    device = aj.live.open_device("simulated:?seed=3&speed=1000&bad=0.5&off=2", SETUP)
    off = []
    for i in range(40):
        device._place = SETUP.place("A")
        q, seated = device._there(np.full(6, 0.02 * i))
        off.append(np.linalg.norm(device.true.position(q) - device.positions["A"]) > 1)
        assert seated
    assert 8 < sum(off) < 32


# A bus of servos


def test_packets_are_those_of_the_protocols():
    # ROBOTIS e-Manual: protocol 1.0, reading the present temperature of servo 1; protocol 2.0, the present position.
    assert request(1, 1, 43, 1) == bytes.fromhex("FF FF 01 04 02 2B 01 CC")
    assert request(2, 1, 132, 4) == bytes.fromhex("FF FF FD 00 01 07 00 02 84 00 04 00 1D 15")
    assert counts_in(bytes.fromhex("FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"), 2, 1, 4, True) == 166
    assert counts_in(bytes.fromhex("FF FF 01 03 00 20 DB"), 1, 1, 1, False) == 32
    for bad, reason in (
        ("FF FF 01 03 00 21 DB", "checksum"),
        ("FF FF 01 03", "short"),
        ("FF FF 02 03 00 20 DA", "checksum"),
    ):
        assert counts_in(bytes.fromhex(bad), 1, 1, 1, False) == reason
    assert counts_in(bytes([255, 255, 1, 4, 0, 5, 0x80]) + bytes([~(1 + 4 + 5 + 0x80) & 255]), 1, 1, 2, False) == -5


class Bus(threading.Thread):
    """Answers as servos do, with an answer in ten spoilt."""

    def __init__(self, counts, protocol=1):
        super().__init__(daemon=True)
        self.protocol, self.length = protocol, {1: 8, 2: 14}[protocol]  # bytes of a request
        self.counts, self.spoilt, self.asked = counts, Counter(), 0
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def run(self):
        with contextlib.suppress(OSError):  # until the bus is closed
            self._answer()

    def _answer(self):
        waiting = b""
        while True:
            waiting += os.read(self.master, 100)
            while len(waiting) >= self.length:
                packet, waiting = waiting[: self.length], waiting[self.length :]
                self.asked += 1
                answer = self._packet(packet[2 if self.protocol == 1 else 4])
                if self.asked % 10 == 0:
                    self.spoilt["checksum"] += 1
                    answer = answer[:-1] + bytes([answer[-1] ^ 1])
                os.write(self.master, answer)

    def _packet(self, servo):
        counts = int(self.counts[servo])
        if self.protocol == 1:
            body = bytes([servo, 4, 0]) + counts.to_bytes(2, "little")
            return b"\xff\xff" + body + bytes([~sum(body) & 255])
        body = b"\xff\xff\xfd\x00" + bytes([servo, 8, 0, 0x55, 0]) + counts.to_bytes(4, "little", signed=True)
        return body + crc_of_dynamixel(body).to_bytes(2, "little")


def test_servos_on_a_bus_are_read_and_bad_answers_counted(tmp_path):
    bus = Bus({i: 2048 + 100 * i for i in range(1, 7)})
    bus.start()
    table = tmp_path / "bus.toml"
    table.write_text(f'port = "{bus.path}"\nids = [1, 2, 3, 4, 5, 6]\n')
    device = aj.live.open_device(f"servos:{table}", SETUP)
    samples = samples_of(device, 20)
    np.testing.assert_allclose(samples[-1].q, 100 * np.arange(1, 7) * 2 * np.pi / 4096)
    assert device.bad["wrong checksum"] >= 5
    assert device.lines == len(samples) + sum(device.bad.values())
    os.close(bus.slave)
    os.close(bus.master)
    assert samples_of(device, 1, 0.5) == []
    assert "trying again" in device.message
    device.close()


@pytest.mark.parametrize("unit", ["counts", "deg"])
def test_zeros_of_servos_are_those_of_lerobot_s_calibration(tmp_path, unit):
    (bus := Bus(dict.fromkeys(range(1, 7), 2100))).start()
    motors = {f"m{i}": {"id": i, "drive_mode": 0, "homing_offset": 7, "range_min": 1000 + i, "range_max": 3000 + i}
              for i in range(1, 7)}  # fmt: skip
    (tmp_path / "motors.json").write_text(json.dumps(motors))
    (tmp_path / "bus.toml").write_text(
        f'port = "{bus.path}"\nids = [1, 2, 3, 4, 5, 6]\nangles = {{ unit = "{unit}", calibration = "motors.json" }}\n'
    )
    if unit != "counts":
        with pytest.raises(aj.InputError, match="servos answer in counts"):
            aj.live.open_device(f"servos:{tmp_path / 'bus.toml'}", SETUP)
        return
    device = aj.live.open_device(f"servos:{tmp_path / 'bus.toml'}", SETUP)
    q = samples_of(device, 1)[-1].q
    np.testing.assert_allclose(q, (100 - np.arange(1, 7)) * 2 * np.pi / 4096)
    assert (device.recorded_as.names[0], device.recorded_as.unit) == ("servo 1", "counts")
    np.testing.assert_allclose(device.recorded_as.joint_values(np.full((1, 6), 2100.0))[0], q)
    assert [source.split()[0] for source in device.sources] == ["motors.json"]
    device.close()


# A camera

CAMERA = """
[[camera]]
name = "webcam"
image_size = [640, 480]
intrinsics = { fx = 600, fy = 600, cx = 319.5, cy = 239.5 }
[[target]]
name = "board"
kind = "charuco"
squares = [7, 5]
size = 30
marker = 22
[[pixels]]
name = "eye"
camera = "webcam"
target = "board"
distance = [250, 500]
"""


@pytest.mark.slow
def test_a_camera_finds_the_target_of_a_kit(tmp_path):
    cv2 = pytest.importorskip("cv2")
    kit = tmp_path / "kit.toml"
    kit.write_text(CAMERA + "mount = [60, 0, 20, 0, 0, 0]\nframe = [3.14159, 0, 0, 300, 0, 0]\n")
    setup = aj.live.read_setup("ur10e", kit=kit)
    board, facing = setup.targets["board"], np.eye(4)
    facing[:3, 3] = -105.0, -75.0, 400.0
    image = np.asarray(aj.camera.render(board, facing, "pinhole", [600.0, 600.0, 319.5, 239.5], (640, 480)))
    video = tmp_path / "seen.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (640, 480))
    for _ in range(3):
        writer.write(np.repeat(image[:, :, None], 3, axis=2).astype(np.uint8))
    writer.release()
    device = aj.live.open_device(f"camera:{video}", setup)
    (sample, *_) = samples_of(device, 1)
    found = aj.camera.detect(image, board)
    np.testing.assert_array_equal(sample.measured["ids"], found.ids)
    np.testing.assert_allclose(sample.measured["corners"], found.corners, atol=0.3)
    device.close()


def test_the_checksum_of_dynamixel_is_that_of_its_manual():
    assert crc_of_dynamixel(bytes.fromhex("FF FF FD 00 01 07 00 02 84 00 04 00")) == 0x151D
