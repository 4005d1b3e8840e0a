"""Couplings of joints are found where readings fit an arm with them only, and nowhere else."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import reading_check, reading_search
from aacmm_jax.diagnostics.capture_check import check_capture, search_couplings
from aacmm_jax.diagnostics.reading_check import reading_check_summary
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.capture_calibration import calibrate_capture

BOX, FRAME = [[400, -400, 200], [800, 400, 700]], (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
NOISE = aj.Noise(encoder_arcsec=5, seating=0.01)
ELBOW = {"coupled2_3": -1.0}


def recorded(couplings, seen_by="tracker", poses=40):
    """A robot a little off its nominal one, some of whose joints move with others: the nominal arm, and a capture."""
    nominal = aj.load_arm("ur10e")
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.3, angle=5e-4, seed=1)
    if couplings:
        true = with_corrections(true, list(couplings)).replace(**couplings)
    if seen_by == "tracker":
        points = [kinds.SimulatedPoints("T", BOX, poses, FRAME, u=0.02)]
        return nominal, aj.simulate(true, {}, observations=points, noise=NOISE, seed=1)
    places = {"A": (600, 200, 300), "B": (600, -300, 300), "C": (500, 0, 500)}
    return nominal, aj.simulate(true, places, poses=poses // 3, lengths=[("A", "B", 0.005)], noise=NOISE, seed=1)


@pytest.mark.parametrize(
    ("couplings", "seen_by"),
    [
        ({}, "tracker"),
        ({}, "sockets"),
        (ELBOW, "tracker"),
        (ELBOW, "sockets"),
        pytest.param({"coupled2_3": 1.0}, "sockets", marks=pytest.mark.slow),
        pytest.param({"coupled4_5": -1.0}, "sockets", marks=pytest.mark.slow),
        pytest.param({"coupled2_3": -1.0, "coupled2_4": 1.0}, "tracker", marks=pytest.mark.slow),
    ],
)
def test_full_couplings_are_found(couplings, seen_by):
    assert search_couplings(*recorded(couplings, seen_by)) == couplings


def test_couplings_that_the_data_do_not_show_are_not_named(monkeypatch):
    """Half of a reading is no mechanism; and of readings that belong to no arm, none explains anything."""
    assert search_couplings(*recorded({"coupled2_3": -0.5}, "sockets")) == {}
    q = np.random.default_rng(0).uniform(-2, 2, (2, 20, 6))
    assert search_couplings(aj.load_arm("ur10e"), aj.Capture({"A": q[0], "B": q[1]})) == {}


def test_a_check_names_them(monkeypatch):
    monkeypatch.setattr(reading_search, "_MOST", 2_000)
    monkeypatch.setattr(reading_check, "_REFITTED", 2)
    check = check_capture(*recorded(ELBOW, "sockets"))
    assert (check.explained, check.couplings) == (False, ELBOW)
    said = reading_check_summary(check, "ur10e")["sentence"]
    assert "joint 3 moves by its reading minus that of joint 2 (coupled2_3 = -1)" in said


@pytest.mark.parametrize("model", [None, "coupled=2-3", pytest.param("dh", marks=pytest.mark.slow)])
def test_a_calibration_sets_them_unless_a_model_without_them_is_stated(model):
    """Its mean is 1 or -1, so that the prior of small couplings does not pull to 0, and what it really is is found."""
    nominal, capture = recorded({"coupled2_3": -1.0007}, "sockets")
    record = calibrate_capture(aj.Recording(capture, ArmSpecification(nominal)), model=model)
    said = [sentence for sentence in record.decisions if "coupled joints" in sentence]
    if model == "dh":
        assert not said
        assert record.observed.rms > 50
        return
    assert len(said) == 1
    assert record.observed.rms < 0.05
    name = record.names.index("coupled2_3")
    value, u = record.vectors()["calibrated"][name], np.sqrt(record.covariance[name, name])
    assert abs(value + 1.0007) < min(3 * u, 1e-4)
