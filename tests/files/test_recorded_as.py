"""How readings are written in the tables of a recording, kept for programs and corrected commands."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import DEG
from aacmm_jax.diagnostics.reading_fit import Explanation
from aacmm_jax.files.controllers.tables import python_program
from aacmm_jax.pipeline.data_corrections import recorded_as_corrected

READINGS = np.array([[10.0, -20.0, 30.0, 40.0, -50.0], [-11.0, -61.0, 25.0, 44.0, 70.0], [3.0, -35.0, 52.0, 50.0, 5.0]])
COLUMNS = ["pan.pos", "lift.pos", "elbow.pos", "wrist.pos", "roll.pos"]
OFFSETS = [0.0, -101.0, 90.0, 37.0, 0.0]
MOTORS = {
    name: {"id": i, "drive_mode": i % 2, "homing_offset": 5 * i, "range_min": 800 + i, "range_max": 3300 - i}
    for i, name in enumerate(["pan", "lift", "elbow", "wrist", "roll", "gripper"], start=1)
}


@pytest.mark.parametrize(
    ("angles", "unit"),
    [
        ('unit = "deg"', "deg"),
        (f'unit = "deg"\nsign = [-1, 1, 1, -1, 1]\noffset = {OFFSETS}', "deg"),
        (f'unit = "deg"\ncalibration = "motors.json"\nsign = [-1, 1, 1, 1, 1]\noffset = {OFFSETS}', "deg"),
        ('unit = "percent"\ncalibration = "motors.json"\nsign = -1', "percent"),
        ('unit = "counts"\ncounts_per_turn = 4096\noffset = 20\ncoupled = { 3 = -2 }', "counts"),
        ('unit = "rad"', "rad"),
    ],
)
def test_readings_of_a_table_become_the_joint_values_of_the_capture(tmp_path, angles, unit):
    given = READINGS if unit != "rad" else np.radians(READINGS)
    np.savetxt(tmp_path / "r.csv", given, delimiter=",", header=",".join(COLUMNS), comments="")
    (tmp_path / "motors.json").write_text(json.dumps(MOTORS))
    text = f'arm = "so100"\n[angles]\n{angles}\n[[socket]]\nname = "A"\nfile = "r.csv"\n'
    (tmp_path / "m.toml").write_text(text)
    recording = aj.files.read_manifest(tmp_path / "m.toml")
    aj.files.save_capture(tmp_path / "c.h5", recording)
    written = aj.files.load_capture(tmp_path / "c.h5").recorded_as
    q = np.asarray(recording.capture.sockets["A"])
    assert (written.names, written.unit) == (tuple(COLUMNS), unit)
    np.testing.assert_allclose(written.joint_values(given), q, atol=1e-12)
    np.testing.assert_allclose(written.readings(q), given, atol=1e-9)
    program: dict = {}
    exec(python_program(recording.nominal.arm, title="arm", recorded_as=written), program)
    assert (program["COLUMNS"], program["UNIT"]) == (COLUMNS, unit)
    tips = [program["position_of_readings"](row.tolist()) for row in given]
    np.testing.assert_allclose(tips, recording.nominal.arm.position(q), atol=1e-9)


EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MANIFEST = """arm = "so100"
angles = { unit = "deg", calibration = "MOTORS", columns = "*_*.pos" }
target = [{ name = "board", kind = "charuco", squares = [7, 5], size = 20.0, marker = 15.0, dictionary = "4x4_50" }]
camera = [{ name = "webcam", image_size = [640, 480] }]
pixels = [{ camera = "webcam", target = "board", file = "TABLE", images = "IMAGES" }]
"""


@pytest.mark.slow
def test_readings_that_a_calibration_corrected_are_taken_as_recorded(tmp_path):
    """LeRobot's zeros and directions are not the model's, and nobody stated them."""
    folder = EXAMPLES / "webcam"
    files = {"MOTORS": folder / "motors.json", "TABLE": folder / "lerobot.csv", "IMAGES": folder / "webcam" / "*.jpg"}
    text = MANIFEST
    for name, path in files.items():
        text = text.replace(name, path.as_posix())
    (tmp_path / "m.toml").write_text(text)
    record = aj.calibrate_capture(aj.files.read_manifest(tmp_path / "m.toml"), model="dh")
    assert any("readings were corrected" in sentence for sentence in record.decisions)
    program: dict = {}
    arm, recorded = record.calibrated.arm, record.recording
    exec(python_program(arm, title="arm", recorded_as=recorded.recorded_as), program)
    with open(folder / "lerobot.csv", encoding="utf-8") as table:
        rows = [[float(row[name]) for name in program["COLUMNS"]] for row in csv.DictReader(table)]
    tips = [program["position_of_readings"](row) for row in rows]
    np.testing.assert_allclose(tips, arm.position(recorded.capture.observations[0].q), atol=1e-9)


def test_corrected_readings_are_written_as_before():
    """By hand: the second column is joint 1 and counts the other way, and readings are in degrees, not in rad."""
    written = aj.data.RecordedAs(("a", "b"), "rad", np.diag([1.0, -1.0]), np.array([0.25, 0.5]))
    explanation = Explanation((1, 0), (-1, 1), (0.0, 7.0), DEG, length=1.0, rms=0.0, rms_fitted=0.0, outside=0)
    corrected = recorded_as_corrected(written, explanation)
    assert (corrected.names, corrected.unit) == (("a", "b"), "deg")
    # b = 20 was read as 0.5 - 20, and a = 10 as 10.25.
    np.testing.assert_allclose(corrected.joint_values(np.array([[10.0, 20.0]])), [[19.5 * DEG, 10.25 * DEG]])


def test_nothing_is_known_of_the_readings_of_a_simulation():
    arm = aj.load_arm("so100")
    capture = aj.simulate(arm, {"A": (0, -200, 150)}, poses=3, seed=0)
    recording = aj.Recording(capture, aj.kinematics.ArmSpecification(arm, "arm"))
    assert recording.recorded_as is None
    assert "position_of_readings" not in python_program(arm, title="arm")
