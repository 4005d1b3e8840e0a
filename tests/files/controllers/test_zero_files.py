"""Zero offsets in the files of LeRobot, KUKA and ROS: the readings that follow, what stays, and what is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

import aacmm_jax as aj

from ...conftest import command_line
from ...refusals import assert_refused

FILE = Path(__file__).parents[1] / "six_axis.urdf"
OFFSETS = np.array([0.01, -0.02, 0.003, 0.0, 0.05, -0.001])
MOTORS = {
    name: {"id": i + 1, "drive_mode": 0, "homing_offset": 100 * i - 300, "range_min": 700 + i, "range_max": 3300 - i}
    for i, name in enumerate(["pan", "lift", "elbow", "flex", "roll", "turn", "gripper"])
}
DATA = "&ACCESS RV\r\nDEFDAT $MACHINE PUBLIC\r\nINT $NUM_AX=6\r\n" + "".join(
    f"REAL $MAMES[{i}]={value} ;axis {i}\r\n" if i == 3 else f"$MAMES[{i}]={value}\r\n"
    for i, value in enumerate(["-20.0", "-120.0", "120", "0.0", "1.5E1", "0.0", "0.0"], start=1)
)


def zeros(units=("rad",) * 6) -> aj.files.ZeroOffsets:
    return aj.files.ZeroOffsets(OFFSETS, units, np.zeros(3), 1.0, 0.1, 0.2)


def written(folder: Path, text: str) -> Path:
    path = folder / "file"
    path.write_bytes(text.encode())
    return path


def degrees(motor: dict, encoder: int) -> float:
    """LeRobot's reading of a Feetech motor: 0 in the middle of the range, and 4096 counts a turn."""
    return (encoder - motor["homing_offset"] - (motor["range_min"] + motor["range_max"]) / 2) * 360 / 4096


def test_lerobot_readings_change_by_the_offsets(tmp_path):
    path = written(tmp_path, json.dumps(MOTORS))
    changed = aj.files.lerobot_calibration(path, zeros())
    motors = json.loads(changed.text)
    for offset, name in zip(OFFSETS, MOTORS, strict=False):
        change = degrees(motors[name], 2500) - degrees(MOTORS[name], 2500)
        assert change == pytest.approx(np.degrees(offset), abs=0.5 * 360 / 4096 + 1e-9)
        assert {**motors[name], "homing_offset": 0} == {**MOTORS[name], "homing_offset": 0}
    assert motors["gripper"] == MOTORS["gripper"]
    assert "whole counts of 0.088 deg" in changed.notes[0]
    # Signs and order as recorded, unless the motors are named.
    signed = json.loads(aj.files.lerobot_calibration(path, zeros()._replace(read_as=(-1, 2, 3, 5, -4, 6))).text)
    named = ["-pan", "lift", "elbow", "roll", "-flex", "turn"]
    assert signed == json.loads(aj.files.lerobot_calibration(path, zeros(), named).text)
    assert signed["pan"]["homing_offset"] == -300 + 7  # 0.01 rad are 6.5 counts
    # Exact, where an offset is a whole number of counts; the other way round by a minus; in another order.
    exact = zeros()._replace(offsets=OFFSETS[:2] * 0 + 2 * np.pi / 4096 * np.array([5, 7]), units=("rad",) * 2)
    motors = json.loads(aj.files.lerobot_calibration(path, exact, ["lift", "-pan"]).text)
    assert [motors[name]["homing_offset"] - MOTORS[name]["homing_offset"] for name in ("lift", "pan")] == [-5, 7]


def test_kuka_axes_get_the_offsets_at_mastering(tmp_path):
    changed = aj.files.kuka_machine_data(written(tmp_path, DATA), zeros(), ["-1", "2", "3", "4", "5", "6"])
    was, now = (
        [float(line.split("=")[1].split(";")[0]) for line in text.splitlines() if "$MAMES" in line]
        for text in (DATA, changed.text)
    )
    np.testing.assert_allclose(
        np.subtract(now, was), np.degrees([-1, 1, 1, 1, 1, 1, 0] * np.append(OFFSETS, 0)), atol=1e-6
    )
    assert changed.text.count("\r\n") == DATA.count("\r\n")
    assert "REAL $MAMES[3]=120.171887 ;axis 3\r\n" in changed.text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ros_calibration_as_yourdfpy_reads_it(tmp_path):
    text = FILE.read_text().replace('<axis xyz="0 1 0"/>', '<axis xyz="0 1 0"/><calibration falling="0.25"/>', 1)
    (tmp_path / "robot.urdf").write_text(text)
    robot = aj.files.load_specification(tmp_path / "robot.urdf", tip="tool0")
    changed = aj.files.ros_calibration(robot.urdf, zeros())
    (tmp_path / "out.urdf").write_text(changed.text)
    before, after = (
        {joint.name: joint for joint in yourdfpy.URDF.load(str(tmp_path / name), load_meshes=False).robot.joints}
        for name in ("robot.urdf", "out.urdf")
    )
    found = []
    for i in range(1, 7):
        old, new = (joints[f"joint_{i}"].calibration for joints in (before, after))
        edges = [0.0 if one is None else (one.rising or one.falling or 0.0) for one in (old, new)]
        found.append(edges[1] - edges[0])
    np.testing.assert_allclose(found, OFFSETS, atol=1e-15)
    assert sum(joint.calibration is not None and joint.calibration.falling == 0.25 for joint in before.values()) == 1
    again = aj.files.load_specification(tmp_path / "out.urdf", tip="tool0")
    np.testing.assert_array_equal(again.arm.pose(OFFSETS), robot.arm.pose(OFFSETS))  # origins stay


FAR = json.dumps({name: {**motor, "homing_offset": 2047} for name, motor in MOTORS.items()})


@pytest.mark.parametrize(
    ("change", "text", "more", "parts"),
    [
        ("lerobot_calibration", "{", (zeros(),), ["not valid JSON"]),
        ("lerobot_calibration", json.dumps({"pan": MOTORS["pan"]}), (zeros(),), ["6 joints need as many names"]),
        ("lerobot_calibration", json.dumps(MOTORS), (zeros(), ["pan"] * 6), ["6 joints need as many names"]),
        ("lerobot_calibration", json.dumps(MOTORS), (zeros(), ["x"]), ["no motor 'x'", "pan, lift"]),
        ("lerobot_calibration", json.dumps(MOTORS), (zeros(("mm",) * 6),), ["prismatic"]),
        ("lerobot_calibration", FAR, (zeros(),), ["beyond the 2047 counts"]),
        ("kuka_machine_data", "$MAMES", (zeros(),), ["has no line $MAMES[1]"]),
        ("kuka_machine_data", "$MAMES[1]=2\n", (zeros(),), ["6 joints need as many names", "--motors"]),
    ],
)
def test_refusals(tmp_path, change, text, more, parts):
    path = written(tmp_path, text)
    assert_refused(lambda: getattr(aj.files, change)(path, *more), *parts)


@pytest.mark.slow
def test_export_by_the_command_line(tmp_path):
    sockets = ("--socket", "A=600,100,500", "--socket", "B=300,-200,600", "--length", "A,B,0.002")
    (tmp_path / "robot.urdf").write_text(FILE.read_text())
    wrong = ("--deviate-angle-deg", 0.2, "--poses", 15)
    command_line(tmp_path, "simulate", "robot.urdf", "--tip", "tool0", *sockets, *wrong, "-o", "capture.h5")
    command_line(tmp_path, "calibrate", "capture.h5", "-o", "calibration.h5")
    (tmp_path / "motors.json").write_text(json.dumps(MOTORS))
    (tmp_path / "machine.dat").write_bytes(DATA.replace("REAL ", "").encode())
    export = ("export", "calibration.h5", "--format")
    files = {"lerobot": ["--file", "motors.json"], "kuka": ["--file", "machine.dat"], "ros-calibration": []}
    for name, more in files.items():
        said = command_line(tmp_path, *export, name, *more, "-o", f"{name}.out").stdout
        assert (
            "With these zero offsets, the tips of the nominal and the calibrated arm differ in the recorded poses by"
            in said
        )
        assert "over all joint limits by" in said
        assert ("not recorded with motors.json" in said) == (name == "lerobot")
    assert (tmp_path / "kuka.out").read_bytes().count(b"\r\n") == DATA.count("\r\n")
    offsets = command_line(tmp_path, *export, "offsets").stdout
    second = float(next(line for line in offsets.splitlines() if line.startswith("2,")).split(",")[1])
    kuka = (tmp_path / "kuka.out").read_text().splitlines()
    assert second
    assert float(next(line for line in kuka if "[2]" in line).split("=")[1]) == pytest.approx(-120 + second, abs=1e-6)
    assert "--file is needed" in command_line(tmp_path, *export, "kuka", expect=2).stderr
    assert "--file is needed" in command_line(tmp_path, *export, "csv", "--motors", "a", expect=2).stderr
