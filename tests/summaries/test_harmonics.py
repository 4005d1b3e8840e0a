"""Hundreds of coefficients of harmonics: which a table lists, and what it says of the others joint by joint."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.record import function_of_joint
from aacmm_jax.cli import views
from aacmm_jax.cli.display import display
from aacmm_jax.report.calibration import calibration_report
from aacmm_jax.summaries.calibration import calibration_summary
from aacmm_jax.summaries.result_tables import harmonics_by_joint, listed_apart


def rows(*names):
    return [{"parameter": name, "unit": "rad", "calibrated": 1e-3 * (i + 1), "u": 1e-4} for i, name in enumerate(names)]


def test_few_coefficients_are_listed_one_by_one():
    few = rows("a_1", "cos1_1", "sin1_1", "compliance2_2")
    assert listed_apart(few) == (few, [])


def test_many_coefficients_are_listed_by_joint():
    harmonics = rows(*(f"{function}{order}_3" for order in range(1, 31) for function in ("cos", "sin")))
    others = rows("theta_2", "gear_1")
    listed, apart = listed_apart([*others, *harmonics])
    assert (listed, apart) == (others, harmonics)
    (found,) = harmonics_by_joint(apart)
    assert (found["joint"], found["coefficients"], found["orders"]) == (3, 60, "1 to 30")
    assert found["largest"]["parameter"] == "sin30_3"
    turn = np.linspace(0, 2 * math.pi, 1000, endpoint=False)
    wave = sum(
        row["calibrated"] * (np.cos if row["parameter"].startswith("cos") else np.sin)((1 + i // 2) * turn)
        for i, row in enumerate(harmonics)
    )
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(wave**2)))


def test_orders_with_gaps_are_named():
    assert harmonics_by_joint(rows("cos1_2", "sin1_2", "cos5_2"))[0]["orders"] == "1, 5"


@pytest.fixture(scope="module")
def record():
    """A calibration with 62 coefficients of joint 2, most of which only their prior determines."""
    nominal = aj.files.load_specification("cheng2018-simulation")
    arm = aj.kinematics.with_corrections(nominal.arm, [f"{f}{k}_2" for k in range(1, 32) for f in ("cos", "sin")])
    nominal = nominal._replace(arm=arm)
    capture = aj.simulate(
        arm.replace(coefficients=[3e-4] + [0.0] * 61), {"A": (400, 200, 300), "B": (700, 100, 300)}, poses=25,
        lengths=[aj.ReferenceLength("A", "B", value=316.22777, u=0.002)], encoder_arcsec=1, seed=1,
    )  # fmt: skip
    space = aj.Parameters.free_of(arm, held=("theta_1",))
    prior = aj.Prior({"harmonics": 1e-4, "lengths": 0.5, "angles": 1e-3})
    result = aj.calibrate(arm, capture, aj.Bounds.around(arm, space), method="joint", prior=prior, shared_errors=False)
    return aj.calibration.record_of(result, aj.Recording(capture, nominal))


@pytest.mark.slow
def test_the_report_shows_functions_and_folds_coefficients(record):
    report, summary = calibration_report(record), calibration_summary(record)
    blocks = {getattr(block, "title", block): block for section in report.sections
              for block in section.blocks}  # fmt: skip
    names = [row[0].text for row in blocks["Parameters"].cells]
    assert "a_1" in names
    assert not any(name.startswith("cos") for name in names)
    assert blocks["Coefficients of harmonics"].folded
    assert len(blocks["Coefficients of harmonics"].rows) == 62
    assert len(blocks["Non-geometric errors of the joints"].plots) == 1
    assert len(blocks["Position of every parameter within its bounds"].table.rows) == len(names)
    observability = next(section for section in report.sections if section.id == "observability")
    if summary["uncertainty"]["rank"] < len(summary["parameters"]):
        assert "Together with the priors, they determine all parameters" in observability.blocks[0]


@pytest.mark.slow
def test_the_terminal_prints_a_row_a_joint(record, capsys):
    display(views.calibration(calibration_summary(record)))
    shown = capsys.readouterr().out
    assert "sin7_2 " not in shown
    assert "1 to 31" in shown


@pytest.mark.slow
def test_the_function_of_a_joint_is_known_where_it_was_measured(record):
    q = np.asarray(record.recording.capture.readings)
    found = function_of_joint(record, 2, q)
    true = 3e-4 * (np.cos(found.reading) - np.cos(q[:, 1]).mean())
    inside = (found.reading > q[:, 1].min()) & (found.reading < q[:, 1].max())
    assert np.mean(np.abs(found.value - true)[inside] < 2 * found.expanded[inside]) > 0.95
    assert function_of_joint(record, 1, q) is None
