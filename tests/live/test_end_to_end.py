"""From ``aacmm live --device simulated:...`` to a calibrated arm, in a real browser with real clicks and keys.

What the page writes is compared with the true arm, which the same seed simulates again.
"""

import os
import re
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics.arm import joint_limits

from ..prismatic_arms import PLATE_FOR_SCARA, SCARA
from .test_page import browser, shown  # noqa: F401 - fixtures

SOCKETS = "".join(
    f'[[socket]]\nname = "{name}"\npoint = {point}\nposes = 10\n\n'
    for name, point in {
        "A": [400, 200, 300],
        "B": [450, -250, 150],
        "C": [300, 100, 600],
        "D": [550, 0, 400],
    }.items()
)
BAR = """
[[artefact]]
name = "bar"
points = { a = [0, 0, 0], b = [300, 0, 0] }
frame = [0, 0, 0.5, 350, 0, 250]
poses = 8
u = 0.001

[[artefact]]
name = "raised bar"
points = { a = [0, 0, 0], b = [300, 0, 0] }
frame = [0, -0.9, 1.5, 500, -150, 200]
poses = 8
u = 0.001
"""
TRACKER = """
[[points]]
name = "tracker"
box = [[300, -500, 200], [800, 500, 800]]
poses = 40
u = 0.02
"""
CAMERA = (
    (Path(__file__).parents[2] / "examples" / "webcam" / "kit.toml")
    .read_text()
    .replace("mount = [3, 18, 46, 1.75, 0.04, -0.03]", "mount = [-60, 0, -40, 0.8, 0, 0]")
    .replace("frame = [3.14159265, 0.03, 0, -72, -205, 3]", "frame = [0, 0, 0, 280, -40, 0]")
)


def so101(folder: Path) -> tuple[object, ...]:
    files = [file for file in metadata.files("example-robot-data") or () if file.name == "so101.urdf"]
    if not files:
        pytest.skip("the SO-101 of example-robot-data is not installed")
    return (files[0].locate(), "--base", "base_link", "--tip", "gripper_frame_link")


def scara(folder: Path) -> tuple[object, ...]:
    aj.files.save_arm(SCARA, folder / "scara.toml", name="SCARA")
    return (folder / "scara.toml",)


ARMS = {
    "measuring arm": (("cheng2018-simulation",), BAR, "place=10", 22),
    "Panda in sockets": (("panda",), SOCKETS, "", 20),
    "UR with a tracker": (("ur10e",), TRACKER, "", 16),
    "SO-101 with a camera": (so101, CAMERA, "length=1&angle=0.01", 18),
    "SCARA": (scara, PLATE_FOR_SCARA, "", 20),
}


class Running:
    """``aacmm live`` in a process of its own, as a terminal has it."""

    def __init__(self, folder: Path, *arguments: object):
        line = [sys.executable, "-u", "-m", "aacmm_jax", "live", *map(str, arguments), "--no-browser"]
        self.process = subprocess.Popen(
            line,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        said = ""
        while not (address := re.search(r"http://\S+#\S+", said)):
            more = self.process.stdout.readline()
            assert more, said
            said += more
        self.address = address[0]

    def end(self) -> str:
        self.process.send_signal(signal.SIGINT)
        try:
            said = self.process.communicate(timeout=60)[0]
        finally:
            self.process.kill()
        assert self.process.returncode == 0, said
        return said


SLOWEST = ("SO-101 with a camera",)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.exhaustive if n in SLOWEST else pytest.mark.slow) for n in ARMS]
)
def test_a_new_user_gets_a_calibrated_arm(name, shown, tmp_path):  # noqa: F811
    arm, kit, options, poses = ARMS[name]
    arguments = arm(tmp_path) if callable(arm) else arm
    (tmp_path / "kit.toml").write_text(kit)
    device = f"simulated:?seed=3&speed=5&{options}".rstrip("&")
    running = Running(tmp_path, *arguments, "--device", device, "--kit", "kit.toml", "-o", "capture.h5")
    try:
        page = shown(running.address)
        page.wait_for_function(ROWS_AT_LEAST, arg=poses // 2, timeout=400_000)
        picture(page, name, "during")
        # One pose is excluded and included again, the last one undone, and a session and a temperature noted.
        page.keyboard.press("a")  # a new pose would be the one that X is about
        page.wait_for_selector("#auto[aria-pressed=false]")
        page.click("#poses tr:last-child")
        page.keyboard.press("x")
        page.wait_for_selector("#poses tr.excluded")
        page.keyboard.press("x")
        page.wait_for_selector("#poses tr.excluded", state="detached")
        page.keyboard.press("a")
        page.fill("#celsius", "21.5")
        page.keyboard.press("Enter")
        page.wait_for_function(ROWS_AT_LEAST, arg=poses, timeout=400_000)
        page.click("#auto")
        page.wait_for_selector("#auto[aria-pressed=false]")
        page.keyboard.press("f")
        page.click("text=Write and calibrate")
        page.wait_for_selector("#paths li:nth-child(3)", timeout=400_000)
        picture(page, name, "after")
        page.set_viewport_size({"width": 400, "height": 900})
        page.emulate_media(color_scheme="dark")
        picture(page, name, "narrow")
        assert page.evaluate("document.documentElement.scrollWidth") <= 400
        assert page.said == []
    finally:
        said = running.end()
    assert "capture.h5" in said
    assert (tmp_path / "capture-calibration.html").stat().st_size > 100_000
    record = aj.files.load_calibration(tmp_path / "capture-calibration.h5")
    true = true_arm(arguments, tmp_path, device)
    before, after = (error_of(given.arm, true, kit) for given in (record.recording.nominal, record.calibrated))
    assert after < 0.5 * before


ROWS_AT_LEAST = "count => document.querySelectorAll('#poses tr').length >= count"


def picture(page, name: str, when: str) -> None:
    """A screenshot to look at, where a folder is named for them."""
    if folder := os.environ.get("AACMM_SCREENSHOTS"):
        page.screenshot(path=Path(folder) / f"{name.replace(' ', '-')}-{when}.png", full_page=when != "during")


def true_arm(arguments: tuple[object, ...], folder: Path, device: str) -> "aj.Arm":
    base, tip = (arguments[2], arguments[4]) if len(arguments) > 1 else (None, None)
    setup = aj.live.read_setup(str(arguments[0]), kit=folder / "kit.toml", base=base, tip=tip)
    return aj.live.open_device(device, setup).true


def error_of(arm: "aj.Arm", true: "aj.Arm", kit: str) -> float:
    """RMS error of distances between tips, mm, which no frame changes; sockets alone do not determine their scale."""
    rng = np.random.default_rng(0)
    limits = np.asarray(joint_limits(true, None))
    q = rng.uniform(limits[:, 0], limits[:, 1], (400, arm.joints))
    tips = [np.asarray(each.position(q)) for each in (arm, true)]
    lengths = [np.linalg.norm(tip[::2] - tip[1::2], axis=1) for tip in tips]
    scale = lengths[0] @ lengths[1] / (lengths[0] @ lengths[0]) if kit == SOCKETS else 1.0
    return float(np.sqrt(np.mean((scale * lengths[0] - lengths[1]) ** 2)))
