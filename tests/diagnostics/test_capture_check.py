"""Couplings of joints are found where readings fit an arm with them only, and nowhere else."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import reading_check, reading_search
from aacmm_jax.diagnostics.capture_check import check_capture, fits_as_recorded, search_couplings
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


@pytest.mark.first_rows(2)
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


@pytest.mark.slow
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


# What a table has in place of the readings, and what the check finds: order, signs, zeros in deg, factor of the unit.
WITH_COUPLING = {
    "zeros": (lambda q: q - [0, 0, 0.65, 0.4, 0, 0], None, None, [0, 0, 37.2, 22.9, 0, 0], 1),
    "sign": (lambda q: q * [1, 1, -1, 1, 1, 1], None, (1, 1, -1, 1, 1, 1), [0] * 6, 1),
    "order": (lambda q: q[:, [0, 1, 2, 3, 5, 4]], (0, 1, 2, 3, 5, 4), None, [0] * 6, 1),
    "unit": (np.degrees, None, None, [0] * 6, np.pi / 180),
    "sign and zero": (lambda q: (q - [0, 0.5, 0, 0, 0, 0]) * [1, 1, 1, -1, 1, 1], None, (1, 1, 1, -1, 1, 1),
                      [0, 28.6, 0, 0, 0, 0], 1),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("mistake", WITH_COUPLING)
def test_a_coupling_beside_other_mistakes(monkeypatch, mistake):
    monkeypatch.setattr(reading_search, "_MOST", 2_000)
    monkeypatch.setattr(reading_check, "_REFITTED", 2)
    change, order, signs, zeros, factor = WITH_COUPLING[mistake]
    nominal, capture = recorded(ELBOW, "sockets")
    check = check_capture(nominal, aj.Capture({name: change(np.asarray(q)) for name, q in capture.sockets.items()}))
    assert check.couplings == ELBOW
    assert (check.best.order, check.best.signs) == (order or (0, 1, 2, 3, 4, 5), signs or (1,) * 6)
    np.testing.assert_allclose(np.degrees(check.best.offsets), zeros, atol=1)
    assert check.best.angle == pytest.approx(factor)
    sentence = reading_check_summary(check, "ur10e")["sentence"]
    assert "coupled2_3 = -1" in sentence
    assert "In addition, " in sentence


@pytest.mark.slow
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


def photographed(on_arm):
    """Images by a camera on an arm near the nominal one, or of a board on it: the nominal arm, and the observation."""
    nominal = aj.load_arm("ur10e")
    true = aj.perturbed_arm(aj.Parameters.free_of(nominal), length=0.3, angle=5e-3, seed=1)
    board = aj.camera.target_of("charuco", squares=[6, 5], size=30.0, marker=22.0)
    eye = kinds.SimulatedPixels(
        "eye", 20, "webcam", "board", board.points, (600.0, 610.0, 319.5, 239.5), (640, 480), on_arm=on_arm,
        frame=(np.pi, 0, 0, -700, -200, 0) if on_arm else (1.2, 1.2, -1.2, -1200, -200, 400),
        mount=(60, 0, 20, 0, 0, 0), distance=(250, 400), u=0.2,
    )  # fmt: skip
    return nominal, aj.simulate(true, {}, observations=[eye], noise=NOISE, seed=1).observations[0]


def columns(*order):
    return lambda q: q[:, list(order)]


MISREAD = {
    "exchanged": (columns(0, 1, 2, 3, 5, 4), ((0, 1, 2, 3, 5, 4), (1,) * 6)),
    "sign": (lambda q: q * [1, 1, -1, 1, 1, 1], (tuple(range(6)), (1, 1, -1, 1, 1, 1))),
}


@pytest.mark.slow
@pytest.mark.parametrize("on_arm", [True, False])
def test_readings_fit_what_a_camera_saw_or_do_not(on_arm):
    nominal, eye = photographed(on_arm)
    assert fits_as_recorded(nominal, aj.Capture({}, observations=[eye]))
    for wrong, _ in MISREAD.values():
        assert not fits_as_recorded(nominal, aj.Capture({}, observations=[eye.changed(q=wrong(np.asarray(eye.q)))]))


@pytest.mark.slow
@pytest.mark.parametrize("on_arm", [True, False])
@pytest.mark.parametrize("mistake", MISREAD)
def test_what_a_camera_saw_shows_the_order_and_signs_of_the_columns(on_arm, mistake):
    nominal, eye = photographed(on_arm)
    wrong, found = MISREAD[mistake]
    check = check_capture(nominal, aj.Capture({}, observations=[eye.changed(q=wrong(np.asarray(eye.q)))]))
    assert check.explained
    assert check.best[:2] == found


@pytest.mark.slow
def test_a_calibration_by_a_camera_survives_two_images_that_are_exchanged():
    _, eye = photographed(True)
    order = np.array([0, 1, 2, 4, 3, *range(5, 20)])
    capture = aj.Capture({}, observations=[eye.changed(q=np.asarray(eye.q)[order])])
    specification = aj.files.load_specification("ur10e", capture=capture)
    record = aj.calibrate_capture(aj.Recording(capture, specification), cross_validate=False)
    assert record.converged
    assert "pose 4" in record.removed[0].group
    assert "exchanged" in record.removed[0].group
