"""What is wrong with recorded readings, in words."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import reading_check, reading_search
from aacmm_jax.diagnostics.capture_check import check_capture
from aacmm_jax.diagnostics.reading_check import explanation_words, reading_check_summary
from aacmm_jax.diagnostics.reading_fit import Explanation
from aacmm_jax.files.reading_checks import units_toml

DEG = math.pi / 180
SIX = tuple(range(6))


@pytest.mark.parametrize(
    ("order", "signs", "offsets", "units", "words"),
    [
        (SIX, (1,) * 6, (0,) * 6, (1, 1), ""),
        (
            (0, 1, 2, 3, 5, 4),
            (1, 1, -1, 1, 1, 1),
            (0, math.pi / 2, 0, 0, 0, 0),
            (1, 1),
            "columns 5 and 6 are exchanged; column 3 has the opposite sign; the zero of joint 2 is 90 deg off",
        ),
        # The sign of a column that was moved is that of the column.
        ((0, 1, 2, 3, 5, 4), (1, 1, 1, 1, 1, -1), (0,) * 6, (1, 1), "columns 5 and 6 are exchanged; column 5 has"),
        (SIX, (-1, 1, -1, 1, -1, 1), (0,) * 6, (1, 1), "columns 1, 3 and 5 have the opposite sign"),
        ((5, 4, 3, 2, 1, 0), (1,) * 6, (0,) * 6, (1, 1), "the columns are in reverse order"),
        (
            (1, 0, 3, 2, 4, 5),
            (1,) * 6,
            (0,) * 6,
            (1, 1),
            "columns 1 and 2 are exchanged; columns 3 and 4 are exchanged",
        ),
        ((1, 2, 0, 3, 4, 5), (1,) * 6, (0,) * 6, (1, 1), "joints 1, 2 and 3 are in columns 2, 3 and 1"),
        (
            SIX,
            (1,) * 6,
            (0, 0, -math.pi, 0, 1.5 * math.pi, 0),
            (1, 1),
            "joint 3 is 180 deg off; the zero of joint 5 is -90",
        ),
        (SIX, (1,) * 6, (0,) * 6, (DEG, 1), "the readings are in degrees, but were read as radians"),
        (SIX, (1,) * 6, (0,) * 6, (1 / DEG, 1000.0), "in radians, but were read as degrees; the positions are in m"),
    ],
)
def test_words(order, signs, offsets, units, words):
    said = explanation_words(Explanation(order, signs, offsets, *units, 1.0, 1.0, 0))
    assert words in said
    assert bool(said) == bool(words)


@pytest.mark.slow
def test_a_capture_of_a_tracker_and_what_cannot_be_checked(paper_arm, monkeypatch):
    monkeypatch.setattr(reading_search, "_MOST", 20_000)
    monkeypatch.setattr(reading_check, "_REFITTED", 6)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 6))
    points = np.asarray(paper_arm.position(q)) + np.array([1000.0, 0, 0])
    parts = [kinds.MeasuredPoints(name, q[rows] * [1, 1, 1, -1, 1, 1], points[rows], station="s")
             for name, rows in (("one", slice(0, 12)), ("two", slice(12, 20)))]  # fmt: skip
    found = check_capture(paper_arm, aj.Capture({}, observations=parts))
    assert found.poses == 20
    summary = reading_check_summary(found, "paper's")
    assert summary["sentence"].startswith("Column 4 has the opposite sign. Correcting this")
    assert summary["found"]["signs"] == [1, 1, 1, -1, 1, 1]
    assert summary["tip"] == ""
    with pytest.raises(aj.InputError, match="at least two"):
        check_capture(paper_arm, aj.Capture({"A": q[:1], "B": q[1:2]}))


@pytest.mark.parametrize(
    ("target", "part"),
    [("reflector", "A calibration identifies the position of the target"), ("", 'write target = "reflector"')],
)
def test_an_offset_of_the_target_is_named(paper_arm, monkeypatch, target, part):
    monkeypatch.setattr(reading_search, "_MOST", 2000)
    monkeypatch.setattr(reading_check, "_REFITTED", 2)
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (30, 6))
    seen = paper_arm.replace(probe=np.asarray(paper_arm.probe) + np.array([30.0, -40.0, 46.0]))
    points = np.asarray(seen.position(q)) + np.array([1000.0, 0, 0])
    capture = aj.Capture({}, observations=[kinds.MeasuredPoints("one", q, points, target=target)])
    summary = reading_check_summary(check_capture(paper_arm, capture), "paper's")
    assert summary["fits"]
    assert summary["given"]["rms_mm"] > 30
    assert summary["rms_with_tip_mm"] < 1e-9
    assert part in summary["tip"]


@pytest.mark.parametrize(("taken", "length", "unit"), [("mm", 1000, "m"), ("m", 1e-3, "mm"), ("inch", 1 / 25.4, "mm")])
def test_the_unit_found_depends_on_the_unit_taken(taken, length, unit):
    one = Explanation(SIX, (1,) * 6, (0,) * 6, 1.0, length, 1.0, 1.0, 0)
    assert explanation_words(one, taken) == f"the positions are in {unit}, but were read as {taken}"
    assert units_toml(one, taken) == f'units = {{ points = "{unit}" }}\n'
