"""Encoders that are noisier than stated, or than the others, are found, and their noise replaces the stated one."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.record import record_of
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import model_tests
from aacmm_jax.files import load_calibration, save_calibration
from aacmm_jax.summaries.calibration import calibration_summary

ARCSEC = aj.units.ARCSEC
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
LENGTHS = [("A", "B", 0.002), ("C", "D", 0.002), ("A", "C", 0.002)]
STATED = aj.Noise(encoder_arcsec=2.0, seating=0.005)


def noisy(joint, factor=5.0, joints=6):
    return aj.Noise(encoder_arcsec=2.0 * np.where(np.arange(1, joints + 1) == joint, factor, 1.0), seating=0.005)


@pytest.fixture(scope="module")
def captured(paper_arm):
    """Sockets, or a tracker's points, read by encoders of which one may be noisier."""
    made = {}

    def make(joint, tracker=False):
        if (joint, tracker) not in made:
            noise = STATED if joint is None else noisy(joint)
            if tracker:
                station = kinds.SimulatedPoints("tracker", [[200, -300, 100], [600, 300, 500]], 60, u=0.003)
                made[joint, tracker] = aj.simulate(paper_arm, {}, observations=[station], noise=noise, seed=3)
            else:
                made[joint, tracker] = aj.simulate(paper_arm, SOCKETS, poses=20, lengths=LENGTHS, noise=noise, seed=2)
        return made[joint, tracker]

    return make


def calibrated(arm, capture, **options):
    bounds = aj.Bounds.around(arm, aj.Parameters.free_of(arm), length=10.0, angle=0.0175)
    return aj.calibrate(arm, capture, bounds, undetermined="ignore", **options)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("method", "given", "joint", "tracker"),
    [
        ("two-stage", False, 2, False),
        ("joint", True, 2, True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("two-stage", True, 3, False),
                ("joint", True, 2, False),
                ("joint", False, 3, False),
                ("joint", False, 2, True),
            )
        ),
    ],
)
def test_its_noise_is_estimated_and_weights_the_poses(paper_arm, captured, method, given, joint, tracker):
    capture = captured(joint, tracker)
    options = {"method": method, "noise": STATED if given else None}
    result, kept = (calibrated(paper_arm, capture, replace_noise=x, **options) for x in (True, False))
    (found,) = result.noisy_encoders
    assert found.joint == joint
    assert found.probability < 0.01
    # Three standard uncertainties, which are those of a variance with some 40 to 80 degrees of freedom.
    assert abs(found.found - 10 * ARCSEC) < 3 * found.u
    assert 0.05 < found.u / found.found < 0.2
    arcsec = np.asarray(result.noise.encoder_arcsec)
    assert arcsec[joint - 1] == pytest.approx(found.found / ARCSEC)
    others = np.delete(arcsec, joint - 1)
    assert others == pytest.approx(2.0 if given else np.full(5, others[0]), rel=1e-6)
    if not tracker:  # whose 60 points hardly tell encoders from the tip
        assert others == pytest.approx(2.0, rel=0.4)
    assert found.expected == pytest.approx(others[0] * ARCSEC)
    assert (result.given_noise is None) == (not given)
    assert result.noise_model == kept.noise_model
    assert float(result.degrees_of_freedom) == float(kept.degrees_of_freedom)
    # The same as if that noise had been stated.
    weighted = calibrated(paper_arm, capture, method=method, noise=result.noise, replace_noise=False)
    assert np.asarray(result.parameters) == pytest.approx(np.asarray(weighted.parameters), rel=1e-9, abs=1e-12)
    assert np.asarray(result.covariance) == pytest.approx(np.asarray(weighted.covariance), rel=1e-6, abs=1e-18)
    assert kept.noisy_encoders == ()
    assert result.weighting_noise is result.noise
    assert kept.weighting_noise is kept.given_noise


@pytest.mark.slow
@pytest.mark.parametrize("given", [True, False])
def test_where_none_is_noisier_or_the_model_is_wrong_nothing_is_replaced(paper_arm, captured, given):
    noise = STATED if given else None
    assert calibrated(paper_arm, captured(None), noise=noise).noisy_encoders == ()
    q = np.asarray(captured(None).q)
    eccentric = q - 10 * ARCSEC * np.cos(q + 0.5) * (np.arange(6) == 1)
    parts = dict(zip(captured(None).names, np.split(eccentric, 4), strict=True))
    assert calibrated(paper_arm, aj.Capture(parts, captured(None).lengths), noise=noise).noisy_encoders == ()


@pytest.mark.slow
def test_a_seat_that_is_noisier_than_stated_is_no_encoder(paper_arm):
    noise = aj.Noise(encoder_arcsec=2.0, seating=0.03)
    capture = aj.simulate(paper_arm, SOCKETS, poses=20, lengths=LENGTHS, noise=noise, seed=4)
    result = calibrated(paper_arm, capture, noise=STATED)
    tests = model_tests(result, capture)
    assert result.noisy_encoders == ()
    assert tests.misfit.ratio > 1.5
    assert tests.noisy_joint.probability > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"noise_model": "common"}, {"robust": "huber"}, {"replace_noise": False}])
def test_what_has_another_noise_model_keeps_it(paper_arm, captured, options):
    assert calibrated(paper_arm, captured(3), **options).noisy_encoders == ()


@pytest.mark.slow
def test_file_summary_and_warning(paper_arm, captured, tmp_path):
    capture = captured(3)
    result = calibrated(paper_arm, capture, noise=STATED)
    record = record_of(result, aj.Recording(capture, aj.files.load_specification("cheng2018-simulation")))
    save_calibration(tmp_path / "calibration.h5", record)
    loaded = load_calibration(tmp_path / "calibration.h5")
    assert loaded.noisy_encoders == result.noisy_encoders
    assert np.asarray(loaded.noise.encoder_arcsec) == pytest.approx(np.asarray(result.noise.encoder_arcsec))
    summary = calibration_summary(loaded)
    (row,) = summary["uncertainty"]["noisy_encoders"]
    assert (row["joint"], row["unit"], row["expected"]) == (3, "arcsec", pytest.approx(2.0))
    (said,) = (text for text in summary["warnings"] if text.startswith("Readings of joint 3"))
    assert "times as much as given" in said
    assert not any("Residuals are larger where" in text for text in summary["warnings"])  # it is explained


@pytest.mark.slow
def test_an_encoder_whose_noise_poses_do_not_determine_keeps_that_of_the_others(mukca):
    """One placement, whose poses hardly see one joint: its noise would be above ten degrees."""
    recording = aj.files.read_manifest(mukca / "panda_3_bis.toml")
    bounds, capture = recording.nominal.bounds(), recording.capture.select("front/*")
    result = aj.calibrate(bounds.space.base, capture, bounds, undetermined="ignore")
    assert result.noisy_encoders == ()
