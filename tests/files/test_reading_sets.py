"""Commanded and measured readings in one table: found by their names, and compared by calibrating from both."""

import re
import shutil

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.reading_checks import compare_reading_sets, reading_sets, reading_sets_sentence
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
def test_the_better_ones_are_named_with_both_figures(both):
    path = manifest(both, "q_cmd_*")
    recording = aj.files.read_manifest(path)
    commanded, measured = compare_reading_sets(path, recording)
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
    again = compare_reading_sets(path, aj.files.read_manifest(path))
    assert [row["taken"] for row in again] == [False, True]
    assert "the manifest uses the readings that fit better" in reading_sets_sentence(again, 80)
    assert not compare_reading_sets(EXAMPLES / "simulated_robot" / "tracker.toml", recording)  # whose table has one set


def test_alike_is_said():
    sets = [
        {"role": "commanded", "lines": ["a"], "rms_mm": 0.31, "taken": True},
        {"role": "measured", "lines": ["b"], "rms_mm": 0.30, "taken": False},
    ]
    assert "both fit equally well" in reading_sets_sentence(sets, 80)
    assert reading_sets_sentence(sets[:1], 80) == ""
