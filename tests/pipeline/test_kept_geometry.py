"""An evaluation that keeps the target's offset and the instrument's frame as the calibration found them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data.observations import MeasuredPoints

OFFSET = np.array([40.0, -20.0, 90.0])  # mm
FRAME = Rotation.random(random_state=3), np.array([1500.0, -800.0, 300.0])
FREE = ("a_2", "theta_2", "theta_3", "d_4")


def measured(random, true, poses, moved=(0.0, 0.0, 0.0), name="tracker"):
    """Points of a reflector, of which encoders and tracker are noisy; with another offset."""
    q = random.uniform(-2.0, 2.0, (poses, 6))
    transforms = np.asarray(true.pose(q))
    tips = transforms[:, :3, 3] + transforms[:, :3, :3] @ (OFFSET + moved)
    points = FRAME[0].apply(tips) + FRAME[1] + 0.02 * random.normal(size=tips.shape)
    q = q + 5e-5 * random.normal(size=q.shape)
    return aj.Capture({}, [], [MeasuredPoints(name, q, points, station="station", target="reflector", u=0.02)])


def calibrated(seed, poses=12):
    random, nominal = np.random.default_rng(seed), aj.files.load_specification("ur10e")
    a, theta = np.array(nominal.arm.a), np.array(nominal.arm.theta)
    a[1] += 0.5
    theta[1:3] += 1e-3, -1e-3
    true = nominal.arm.replace(a=a, theta=theta)
    others = [name for name in nominal.space().names if name not in FREE]
    nominal = nominal._replace(held=(*nominal.space().held, *others), free=())
    recording = aj.Recording(measured(random, true, poses), nominal)
    options = {"model": "dh", "cross_validate": False, "shared_errors": False, "automatic": False}
    noise = aj.Noise(encoder_arcsec=10.3, seating=1e-6)
    record = aj.calibrate_capture(recording, noise=noise, **options)
    return record, true, random


@pytest.fixture(scope="module")
def record():
    return calibrated(0)


def evaluated(record, capture, keep):
    return aj.evaluate_capture(record, aj.Recording(capture, record.recording.nominal), keep=keep)


@pytest.mark.slow
@pytest.mark.parametrize("keep", [("target",), ("frame",), ("target", "frame")])
def test_what_is_kept_is_that_of_the_calibration(tmp_path, record, keep):
    evaluation = evaluated(record[0], measured(record[2], record[1], 10), keep)
    found = evaluation.evaluations(evaluation.recording.capture)["calibrated"].observed.geometry
    kept = evaluation.uncertainty.kept
    assert len(kept.parts) == len(keep)
    for name, values in kept.parts.items():
        np.testing.assert_allclose(found[name], record[0].observed.geometry[name])
        np.testing.assert_allclose(found[name], values)
    aj.files.save_evaluation(tmp_path / "e.h5", evaluation)
    again = aj.files.load_evaluation(tmp_path / "e.h5")
    for field in ("values", "follow", "covariance"):
        np.testing.assert_array_equal(getattr(again.uncertainty.kept, field), getattr(kept, field))
    tables = [aj.residuals_of(each) for each in (evaluation, again)]
    np.testing.assert_allclose(tables[0].u, tables[1].u)
    errors = aj.calibration.unseen_errors(evaluation.uncertainty, evaluation.recording.capture)
    np.testing.assert_allclose(np.sqrt(np.mean(tables[0].u ** 2)), errors.of(errors.parts).predicted, rtol=1e-6)


@pytest.mark.slow
def test_its_uncertainty_is_that_of_the_calibration(record):
    """By the parameters and for given parameters, together."""
    evaluation = evaluated(record[0], measured(record[2], record[1], 10), ("target", "frame"))
    kept, covariance = evaluation.uncertainty.kept, np.asarray(evaluation.uncertainty.covariance)
    whole = kept.follow @ covariance @ kept.follow.T + kept.covariance
    for name in kept.parts:
        index = [i for i, part in enumerate(kept.names) if part == name]
        np.testing.assert_allclose(whole[np.ix_(index, index)], record[0].observed.geometry_covariance[name], rtol=1e-3)


@pytest.mark.slow
def test_a_remounted_target_contradicts_one_that_is_kept(record):
    moved = measured(record[2], record[1], 10, moved=(0.0, 0.5, 0.0))
    for keep, holds in (((), True), (("frame",), True), (("target",), False)):
        evaluation = evaluated(record[0], moved, keep)
        errors = aj.calibration.unseen_errors(evaluation.uncertainty, moved)
        assert (errors.of(errors.parts).probability > 0.01) == holds, keep


@pytest.mark.slow
def test_a_kept_frame_needs_fewer_poses(record):
    two = measured(record[2], record[1], 2)
    with pytest.raises(aj.InputError):
        evaluated(record[0], two, ("target",))
    assert evaluated(record[0], two, ("target", "frame")).independent


@pytest.mark.slow
def test_errors_with_kept_geometry_are_as_predicted():
    """Few poses to calibrate with, so that the uncertainty of what is kept matters."""
    ratios = {("target",): [], ("frame",): [], ("target", "frame"): []}
    for seed in range(30):
        record, true, random = calibrated(seed, poses=8)
        capture = measured(random, true, 20)
        for keep, found in ratios.items():
            uncertainty = evaluated(record, capture, keep).uncertainty
            errors = aj.calibration.unseen_errors(uncertainty, capture)
            agreement = errors.of(errors.parts)
            found.append((agreement.rms / agreement.predicted) ** 2)
    for keep, found in ratios.items():
        assert abs(np.mean(found) - 1) < 3 * np.std(found) / np.sqrt(len(found)) + 0.02, keep


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("keep", ["target", "frame"])
def test_what_is_not_there_cannot_be_kept(record, keep):
    nominal = record[0].recording.nominal
    sockets = aj.simulate(record[1], {"A": (400, 200, 300)}, poses=5, seed=1)
    with pytest.raises(aj.InputError, match=f"--keep {keep}"):
        aj.evaluate_capture(record[0], aj.Recording(sockets, nominal), keep=(keep,))
    with pytest.raises(aj.InputError, match="--keep"):
        aj.evaluate_points(aj.acceptance.Measured({"A": np.eye(3)}), keep=(keep,))
