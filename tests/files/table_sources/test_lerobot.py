"""LeRobot's data sets, and its calibration files, from which its numbers become angles."""

import json

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest

import aacmm_jax as aj
from aacmm_jax.files.text_table import TextTable
from tests.files.table_sources.damage import refused_when_damaged
from tests.refusals import assert_refused

NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
ARM = "so100"  # five joints
RNG = np.random.default_rng(0)
COUNTS = RNG.integers(900, 3200, (20, 6))
MOTORS = {
    name: {"id": i, "drive_mode": i % 2, "homing_offset": 100 * i - 300, "range_min": 700 + 11 * i,
           "range_max": 3400 - 17 * i}
    for i, name in enumerate(NAMES, start=1)
}  # fmt: skip
MIDDLES = np.array([(motor["range_min"] + motor["range_max"]) / 2 for motor in MOTORS.values()])
RANGES = np.array([motor["range_max"] - motor["range_min"] for motor in MOTORS.values()])
ANGLES = (COUNTS - MIDDLES) * 2 * np.pi / 4096
FLIPPED = np.array([-1 if motor["drive_mode"] else 1 for motor in MOTORS.values()])
# What LeRobot reads, by the unit in which it does: normalised as its MotorsBus does.
READ = {
    "counts": COUNTS,
    "deg": (COUNTS - MIDDLES) * 360 / 4095,
    "percent": FLIPPED * ((COUNTS - MIDDLES) / RANGES * 200),
}


def data_set(folder, state, *, names=NAMES, version=3):
    """A folder as LeRobot has it, in two files."""
    feature = {"dtype": "float32", "shape": [6], "names": names}
    (folder / "meta" / "episodes").mkdir(parents=True)
    info = {"codebase_version": f"v{version}.0", "features": {"observation.state": feature, "action": feature}}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    pyarrow.parquet.write_table(pyarrow.table({"episode_index": [0, 1]}), folder / "meta" / "episodes" / "f.parquet")
    for i, rows in enumerate(np.array_split(np.arange(len(state)), 2)):
        path = folder / "data" / "chunk-000" / f"file-{i:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        values = pyarrow.array(state[rows].tolist(), pyarrow.list_(pyarrow.float64(), 6))
        columns = {"observation.state": values, "action": values, "timestamp": rows / 30.0, "frame_index": rows}
        pyarrow.parquet.write_table(pyarrow.table({**columns, "episode_index": np.full(len(rows), i)}), path)
    return folder


def read(tmp_path, unit, more=""):
    (tmp_path / "motors.json").write_text(json.dumps(MOTORS))
    (tmp_path / "capture.toml").write_text(
        f'arm = "{ARM}"\n[angles]\nunit = "{unit}"\ncalibration = "motors.json"\n'
        f"columns = {json.dumps(NAMES[:5])}\n{more}"
        '[[socket]]\nfile = "set"\nname = "divot"\ngroup = "episode_index"\n'
    )
    return aj.files.read_manifest(tmp_path / "capture.toml")


@pytest.mark.slow
@pytest.mark.parametrize("unit", READ)
def test_every_number_that_lerobot_reads_is_the_same_angle(tmp_path, unit):
    data_set(tmp_path / "set", READ[unit])
    recording = read(tmp_path, unit)
    sockets = recording.capture.sockets
    assert list(sockets) == ["divot/0", "divot/1"]
    found = np.concatenate([sockets["divot/0"], sockets["divot/1"]])
    np.testing.assert_allclose(found, ANGLES[:, :5], atol=1e-12)
    assert any(source.startswith("motors.json") for source in recording.sources)


def test_sign_and_offset_apply_as_to_other_readings(tmp_path):
    data_set(tmp_path / "set", READ["counts"])
    sockets = read(tmp_path, "counts", "sign = [-1, 1, 1, 1, 1]\noffset = 1024\n").capture.sockets
    turned = ANGLES[:10, :5] - np.pi / 2
    np.testing.assert_allclose(sockets["divot/0"], turned * [-1, 1, 1, 1, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("names", "header"),
    [
        (NAMES, NAMES),
        ({"motors": [f"{name}.pos" for name in NAMES]}, [f"{name}.pos" for name in NAMES]),
        (None, [f"observation.state_{i}" for i in range(1, 7)]),
    ],
)
def test_columns_have_the_names_of_the_motors(tmp_path, names, header):
    data_set(tmp_path / "set", READ["deg"], names=names)
    table = TextTable(tmp_path / "set")
    assert table.header == ["episode_index", "frame_index", "timestamp", *header]
    np.testing.assert_array_equal(table.numbers(range(3, 9)), READ["deg"])
    if names is NAMES:
        assert TextTable(tmp_path / "set", tables=["action"]).header[3:] == [f"action {name}" for name in NAMES]


def test_one_file_has_numbered_columns(tmp_path):
    data_set(tmp_path / "set", READ["deg"])
    assert TextTable(tmp_path / "set/data/chunk-000/file-001.parquet").header[-1] == "observation.state_6"


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda text: text.replace("3383", "1"), ["the range of motor 'shoulder_pan' is empty"]),
        (lambda text: text.replace('"drive_mode": 1', '"drive_mode": 2', 1), ["motors.shoulder_pan.drive_mode"]),
        (lambda text: text.replace('"id": 2, ', ""), ["'motors.shoulder_lift.id' is missing"]),
        (lambda text: text[:-9], ["not valid JSON"]),
        (lambda text: '{"homing_offset": [1, 2], "motor_names": ["a", "b"]}', ["not a calibration of LeRobot"]),
        (lambda text: json.dumps({"a": MOTORS["gripper"]}), ["has 1 motors (a), but the arm has 5 joints"]),
    ],
)
def test_a_wrong_calibration_is_one_sentence(tmp_path, monkeypatch, change, parts):
    data_set(tmp_path / "set", READ["counts"])
    text = change(json.dumps(MOTORS))
    monkeypatch.setattr(json, "dumps", lambda value, dumps=json.dumps: text if value is MOTORS else dumps(value))
    assert_refused(lambda: read(tmp_path, "counts"), "motors.json", *parts)


@pytest.mark.parametrize(
    ("line", "part"),
    [
        ('angles = { unit = "percent" }', "add calibration"),
        ('angles = { unit = "rad", calibration = "m.json" }', "unit must be 'counts', 'deg' or 'percent'"),
        ('angles = { unit = "counts", counts_per_turn = 9, calibration = "m.json" }', "without counts_per_turn"),
    ],
)
def test_keys_that_do_not_belong_together(tmp_path, line, part):
    (tmp_path / "capture.toml").write_text(f'arm = "{ARM}"\n{line}\n[[socket]]\nfile = "a.csv"\n')
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "capture.toml"), part)


def test_a_feature_that_is_not_there_is_one_sentence(tmp_path):
    data_set(tmp_path / "set", READ["deg"])
    assert_refused(lambda: TextTable(tmp_path / "set", tables=["state"]), "no feature 'state'", "'observation.state'")


def table(tmp_path, end, more=""):
    """A recording of a text table with LeRobot's names, without columns stated."""
    header = ",".join(f"{name}.pos{end}" for name in NAMES)
    np.savetxt(tmp_path / "set.csv", READ["deg"], delimiter=",", header=header, comments="")
    (tmp_path / "motors.json").write_text(json.dumps(MOTORS))
    angles = '[angles]\nunit = "deg"\ncalibration = "motors.json"\n'
    (tmp_path / "capture.toml").write_text(f'arm = "{ARM}"\n{angles}[[socket]]\nname = "A"\nfile = "set.csv"\n{more}')
    return aj.files.read_manifest(tmp_path / "capture.toml")


@pytest.mark.parametrize("end", ["", " [deg]"])
def test_motors_of_a_shipped_arm_are_its_joints(tmp_path, end):
    np.testing.assert_allclose(table(tmp_path, end).capture.sockets["A"], ANGLES[:, :5], atol=1e-12)


@pytest.mark.parametrize(
    ("end", "more", "part"),
    [
        (" [rad]", "", "says rad, but the manifest says deg"),
        ("", 'units = { q = "deg" }\n', "remove the unit of the table"),
    ],
)
def test_units_that_differ_from_those_of_the_calibration(tmp_path, end, more, part):
    assert_refused(lambda: table(tmp_path, end, more), part)


@pytest.mark.slow
def test_damage_is_one_sentence_or_other_cells(tmp_path):
    data_set(tmp_path / "set", READ["deg"])
    assert len(refused_when_damaged(tmp_path / "set/data/chunk-000/file-000.parquet")) > 5
