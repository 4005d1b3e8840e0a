"""Kits as TOML: every kind that can be simulated, and refusals that say what to do."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.observations.simulated import simulated_kinds
from aacmm_jax.files.kits import target_tables

from ..refusals import assert_refused

KIT = """
[[artefact]]
name = "bar"
points = { a = [0.0, 0.0, 0.0], b = [300.0, 0.0, 0.0] }
u = 0.001
places = 3
turned = "vertical"
half_angle_deg = 45
normal = [0, 1, 1]

[[touched_sphere]]
name = "ball"
centre = [300, 0, 300]
diameter = 50.0
u = 0.001

[[planes]]
name = "gauge block"
corner = [0, 0, 0]
sides = [[100, 0, 0], [0, 50, 0]]
distance = 150.0

[[points]]
name = "tracker"
box = [[200, -300, 100], [600, 300, 500]]
frame = [0.1, 0.2, 0.3, 1000, 2000, -300]
u = 0.02
poses = 7
target = "reflector"
place = [0, 10, 40]
"""


def test_what_a_kit_says(tmp_path):
    (tmp_path / "kit.toml").write_text(KIT)
    found = {item.simulated.name: item for item in aj.files.read_kit(tmp_path / "kit.toml")}
    assert set(found) == {"bar", "ball", "gauge block", "tracker"}
    bar, tracker = found["bar"], found["tracker"].simulated
    assert (bar.places, bar.turned, bar.simulated.u) == (3, "vertical", 0.001)
    assert bar.simulated.points == {"a": (0, 0, 0), "b": (300, 0, 0)}
    assert (bar.half_angle, bar.normal) == (math.radians(45), (0, 1, 1))
    assert not found["ball"].has_cone
    assert (found["ball"].places, tracker.poses, tracker.target) == (0, 7, "reflector")
    np.testing.assert_array_equal(tracker.offset, [0, 10, 40])
    np.testing.assert_array_equal(found["gauge block"].simulated.sides, [[100, 0, 0], [0, 50, 0]])


CAMERA = """
[[camera]]
name = "webcam"
image_size = [640, 480]
intrinsics = { fx = 600, fy = 601, cx = 320, cy = 240, k1 = -0.1 }
u = { fx = 2.0 }
[[target]]
name = "board"
kind = "checkerboard"
squares = [4, 3]
size = 30.0
bar = { nominal = 100.0, measured = 101.0, u = 0.05 }
[[pixels]]
name = "images"
camera = "webcam"
target = "board"
on_arm = "target"
mount = [60, 0, 20, 0, 0, 0]
frame = [3.1, 0, 0, 400, 200, 300]
distance = [250, 500]
tilt_deg = 45
"""


def test_a_camera_of_a_kit(tmp_path):
    (tmp_path / "kit.toml").write_text(KIT + CAMERA)
    item = aj.files.read_kit(tmp_path / "kit.toml")[-1]
    seen = item.simulated
    assert (item.places, seen.name, seen.camera, seen.board, seen.on_arm) == (0, "images", "webcam", "board", False)
    np.testing.assert_array_equal(seen.intrinsics, [600, 601, 320, 240, -0.1, 0, 0, 0])
    np.testing.assert_array_equal(seen.u_intrinsics, [2, 0, 0, 0, 0, 0, 0, 0])
    assert (seen.tilt, seen.u, seen.u_scale) == pytest.approx((math.pi / 4, 0.3, 0.05 / 100))
    assert np.ptp(seen.points, axis=0) == pytest.approx([2 * 30.3, 30.3, 0])  # the inner corners of the printed board
    assert target_tables(tmp_path / "kit.toml")[0]["squares"] == [4, 3]


def test_every_kind_that_can_be_simulated_has_a_table():
    known = {"artefact", "touched_sphere", "touched_cylinder", "planes", "points", "transforms", "distances", "socket"}
    assert set(simulated_kinds()) == known | {"pixels", "contact_sphere", "contact_plane"}


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("", ["contains no artefact and no instrument", "[[artefact]]"]),
        ('[[bar]]\nname = "b"', ["bar"]),
        (KIT.replace("diameter = 50.0", 'diameter = "50"'), ["touched_sphere", "diameter"]),
        (
            KIT.replace("centre = [300, 0, 300]", "centre = [300, 0]"),
            ["[[touched_sphere]] 'ball'", "centre", "(2,); give (3,)"],
        ),
        (KIT.replace("centre = [300, 0, 300]\n", ""), ["touched_sphere", "centre", "missing"]),
        (KIT.replace('turned = "vertical"', 'turned = "up"'), ["turned"]),
        (KIT.replace("places = 3", "places = -1"), ["places"]),
        (KIT.replace("normal = [0, 1, 1]", "normal = [0, 0, 0]"), ["'bar'", "normal is (0, 0, 0)"]),
        (KIT.replace("half_angle_deg = 45", "half_angle_deg = 0"), ["half_angle_deg"]),
        (KIT.replace("b = [300.0, 0.0, 0.0]", "b = [300.0, 0.0]"), ["artefact", "points"]),
        (KIT.replace("frame = [0.1,", "frame = [nan,"), ["frame"]),
        (
            CAMERA.replace("intrinsics", "# ").replace("u = {", "# "),
            ["[[pixels]] 'images'", "'webcam' has no intrinsics"],
        ),
        (CAMERA.replace('target = "board"', 'target = "bord"'), ["[[pixels]] 'images'", "'bord' has no [[target]]"]),
        (CAMERA.replace("[250, 500]", "[500, 250]"), ["[[pixels]] 'images'", "distance", "least and the largest"]),
    ],
)
def test_refused(tmp_path, text, parts):
    (tmp_path / "kit.toml").write_text(text)
    assert_refused(lambda: aj.files.read_kit(tmp_path / "kit.toml"), tmp_path / "kit.toml", *parts)
