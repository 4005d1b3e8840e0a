"""Checks of readings: commanded and measured readings in one table, found by their names and compared by calibrating
from both; and what a check prints for a manifest, which makes its readings those of the arm."""

import json
import math
import re
import shutil

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics.reading_fit import Explanation
from aacmm_jax.files.manifest import read_manifest
from aacmm_jax.files.reading_checks import angles_toml
from aacmm_jax.files.reading_sets import reading_sets
from aacmm_jax.pipeline.reading_sets import compare_reading_sets, reading_sets_sentence
from tests.conftest import EXAMPLES


def numbered(*patterns: str, first: int = 1) -> list[str]:
    return [pattern.format(i) for pattern in patterns for i in range(first, first + 3)]


@pytest.mark.parametrize(
    ("header", "commanded", "measured"),
    [
        (numbered("q_cmd_{}", "q_{}"), 0, 3),
        (numbered("target_q_{}", "actual_q_{}", "actual_qd_{}", "actual_current_{}", first=0), 0, 3),
        (["time", *numbered("q{}_meas [rad]", "q{}_des [rad]")], 4, 1),
        (numbered("A{}_ist", "A{}_soll"), 3, 0),
        (numbered("qMeas{}", "qCmd{}"), 3, 0),
        (numbered("J{} [deg]", "J{} actual [deg]"), 0, 3),
        (numbered("q_{}", "qd_{}"), None, None),
        ([*numbered("q_cmd_{}"), "q_1", "q_2"], None, None),
        (numbered("q_{}"), None, None),
        ([], None, None),
    ],
)
def test_roles_by_name(header, commanded, measured):
    found = reading_sets(header, 3)
    if commanded is None:
        assert not found
    else:
        assert found == {
            "commanded": list(range(commanded, commanded + 3)), "measured": list(range(measured, measured + 3)),
        }  # fmt: skip


@pytest.fixture
def both(tmp_path):
    """A robot with a tracker; commanded readings differ from the measured ones by 0.03 deg."""
    source = EXAMPLES / "simulated_robot"
    lines = (source / "tracker.csv").read_text().splitlines()
    table = np.array([line.split(",") for line in lines[1:]], dtype=float)
    commanded = table[:, :6] + np.random.default_rng(0).normal(0, 0.03, (len(table), 6))
    header = [*(f"q_cmd_{i} [deg]" for i in range(1, 7)), *(f"q_{i} [deg]" for i in range(1, 7))]
    header += lines[0].split(",")[6:]
    np.savetxt(tmp_path / "t.csv", np.hstack([commanded, table]), delimiter=",", header=",".join(header), comments="")
    shutil.copy(source / "robot.urdf", tmp_path)
    return tmp_path


def manifest(folder, pattern):
    path = folder / "m.toml"
    path.write_text(
        'arm = "robot.urdf"\ntip = "tool0"\n[[points]]\nfile = "t.csv"\ntarget = "ball"\nu = 0.02\n'
        f'columns = {{ q = "{pattern}", points = ["x", "y", "z"] }}\n'
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("pattern", "other"), [("q_cmd_*", "measured"), ("q_[0-9]*", "commanded")])
def test_a_manifest_s_recording_has_the_other_ones(both, pattern, other):
    recording = aj.files.read_manifest(manifest(both, pattern))
    assert recording.other_readings.role == other
    assert recording.other_readings.capture.readings.shape == recording.capture.readings.shape
    assert not np.array_equal(recording.other_readings.capture.readings, recording.capture.readings)


@pytest.mark.slow
def test_the_better_ones_are_named_with_both_figures(both):
    path = manifest(both, "q_cmd_*")
    recording = aj.files.read_manifest(path)
    commanded, measured = compare_reading_sets(recording)
    assert [(row["role"], row["taken"]) for row in (commanded, measured)] == [("commanded", True), ("measured", False)]
    assert measured["rms_mm"] == pytest.approx(0.045, abs=0.002)
    assert commanded["rms_mm"] > 0.3
    said = reading_sets_sentence((commanded, measured), 80)
    assert (
        f"a calibration with the measured readings leaves residuals of 0.045 mm RMS, and a calibration with "
        f"the commanded readings leaves {commanded['rms_mm']:.3g}" in said
    )
    (line,) = measured["lines"]
    assert line == (
        'columns = {q = ["q_1 [deg]", "q_2 [deg]", "q_3 [deg]", "q_4 [deg]", "q_5 [deg]", "q_6 [deg]"], '
        'points = ["x", "y", "z"]} in [[points]]'
    )
    path.write_text(re.sub("^columns = .*$", line.split(" in [[")[0], path.read_text(), flags=re.MULTILINE))
    again = compare_reading_sets(aj.files.read_manifest(path))
    assert [row["taken"] for row in again] == [False, True]
    assert "the manifest uses the readings that fit better" in reading_sets_sentence(again, 80)
    one = aj.files.read_manifest(EXAMPLES / "simulated_robot" / "tracker.toml")  # whose table has one set
    assert not compare_reading_sets(one)


def test_alike_is_said():
    sets = [
        {"role": "commanded", "lines": ["a"], "rms_mm": 0.31, "taken": True},
        {"role": "measured", "lines": ["b"], "rms_mm": 0.30, "taken": False},
    ]
    assert "both fit equally well" in reading_sets_sentence(sets, 80)
    assert reading_sets_sentence(sets[:1], 80) == ""


Q = np.random.default_rng(0).uniform(-1.4, 1.4, (8, 6))  # rad, of the arm
ORDER, SIGNS, ZEROS = (0, 1, 2, 4, 3, 5), (1, 1, -1, 1, 1, 1), (0.0, -math.pi / 2, 0.0, 0.5 * math.pi, 0.0, 0.0)
PLAIN = tuple(range(6))
NAMES = ",".join(f"J{i}{{unit}}" for i in range(1, 7))


def explanation(order, offsets, angle=1.0):
    return Explanation(tuple(order), SIGNS, tuple(offsets), angle, 1.0, 0.1, 0.1, 0)


def recorded(order, offsets):
    """Columns that are read as the explanation has them, rad."""
    columns = np.zeros_like(Q)
    columns[:, list(order)] = (Q - np.array(offsets)) * np.array(SIGNS)
    return columns


COUNTS = 4096 / (2 * math.pi)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("header", "size", "angles", "socket"),
    [
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", ""),
        (NAMES.format(unit=" [rad]"), 1.0, "", ""),
        (NAMES.format(unit=""), 180 / math.pi, 'unit = "deg"', ""),
        (NAMES.format(unit=""), COUNTS, 'unit = "counts"\ncounts_per_turn = 4096', ""),
        (NAMES.format(unit=""), 180 / math.pi * 4096 / 4095, 'unit = "deg"\ncalibration = "motors.json"', ""),
        (NAMES.format(unit=""), COUNTS, 'unit = "counts"\ncalibration = "motors.json"\noffset = -5', ""),
        (NAMES.format(unit=""), 100 / math.pi, 'unit = "percent"\ncalibration = "motors.json"', ""),
        (NAMES.format(unit=""), 180 / math.pi, 'unit = "rad"', 'units = { q = "deg" }'),
        (
            NAMES.format(unit=" [deg]"),
            180 / math.pi,
            'unit = "deg"\ncolumns = ["J1", "J2", "J3", "J4", "J5", "J6"]',
            "",
        ),
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", 'columns = "J*"'),
        (NAMES.format(unit=" [deg]"), 180 / math.pi, "", 'columns = { q = ["J1", "J2", "J3", "J4", "J5", "J6"] }'),
    ],
)
@pytest.mark.parametrize("order", [PLAIN, ORDER])
def test_the_table_pasted_into_the_manifest(tmp_path, header, size, angles, socket, order):
    np.savetxt(tmp_path / "a.csv", recorded(order, ZEROS) * size, delimiter=",", header=header, comments="")
    motor = {"drive_mode": 0, "homing_offset": 0, "range_min": -2043, "range_max": 2053}
    (tmp_path / "motors.json").write_text(json.dumps({f"J{i}": {"id": i, **motor} for i in range(1, 7)}))
    manifest = tmp_path / "m.toml"

    def write(table, line):
        text = f'arm = "cheng2018-simulation"\n{table}\n[[socket]]\nname = "A"\nfile = "a.csv"\n{line}\n'
        manifest.write_text(text)
        return np.asarray(read_manifest(manifest).capture.q)

    write(f"[angles]\n{angles}" if angles else "", socket)
    printed = angles_toml(explanation(order, ZEROS), None, manifest)
    assert ("In [[socket]] (a.csv), replace the picked columns with:" in printed) == (
        "columns" in socket and order != PLAIN
    )
    line = printed.split("\n# columns")[1].strip() if "\n# columns" in printed else socket.removeprefix("columns")
    line = f"columns {line}" if "columns" in socket else socket
    assert ("calibration" in printed) == ("calibration" in angles and order == PLAIN)
    np.testing.assert_allclose(write(printed, line), Q, atol=1e-8)


@pytest.mark.parametrize(
    ("table", "angles", "part"),
    [
        (NAMES.format(unit=" [rad]"), "", "a.csv pose 1 joint 1 is 90 rad, more than four revolutions"),
        (NAMES.format(unit=""), '[angles]\nunit = "rad"\n', 'correct the header, or write unit = "deg" in [angles].'),
    ],
)
def test_degrees_read_as_rad(tmp_path, table, angles, part):
    np.savetxt(tmp_path / "a.csv", np.full((2, 6), 90.0), delimiter=",", header=table, comments="")
    manifest = tmp_path / "m.toml"
    manifest.write_text(f'arm = "cheng2018-simulation"\n{angles}[[socket]]\nname = "A"\nfile = "a.csv"\n')
    with pytest.raises(aj.InputError) as refused:
        read_manifest(manifest)
    assert part in str(refused.value)
    assert "numpy" not in str(refused.value)
