"""Errors that an uncertainty predicts for unseen data, and how improbable those found are."""

import math

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.prediction import unseen_errors
from aacmm_jax.core.distributions import chance
from aacmm_jax.data import observations as kinds
from aacmm_jax.data.noise import tip_covariances
from aacmm_jax.kinematics.chain import joint_motion
from aacmm_jax.uncertainty.arm_uncertainty import Uncertainty

SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300)}
LENGTHS = [("A", "B", 0.002), ("B", "C", 0.003)]
NAMES = ("alpha_2", "a_2", "a_3", "d_4", "theta_2", "theta_3", "probe_x", "probe_z")
SEAT = aj.Noise(seating=0.01)


@pytest.fixture(scope="module")
def capture(paper_arm):
    poses = {"A": 7, "B": 5, "C": 1}
    return aj.simulate(paper_arm, SOCKETS, poses=poses, lengths=LENGTHS, noise=SEAT, seed=1)


def uncertainty_of(arm, noise, of_noise=np.inf):
    """Parameters known to about 20 um at the tip, with correlations."""
    space = aj.Parameters(arm, NAMES)
    root = 0.01 * np.asarray(space.scale)[:, None] * np.random.default_rng(0).normal(size=(len(NAMES), len(NAMES)))
    none = np.zeros((len(NAMES), len(NAMES)))
    return Uncertainty(arm, root @ root.T, none, noise, None, NAMES, of_noise)


@pytest.mark.slow
def test_sums_of_squares_are_those_of_the_whole_covariance(paper_arm, capture):
    """V of all poses of two sockets as one matrix, from which their weighted means are taken."""
    noise = aj.Noise(encoder_arcsec=3, seating=0.01)
    uncertainty = uncertainty_of(paper_arm, noise)
    found = unseen_errors(uncertainty, capture)
    slopes = np.asarray(paper_arm.jacobian(capture.q, NAMES)).reshape(-1, len(NAMES))
    own = np.moveaxis(
        np.asarray(tip_covariances(paper_arm.geometry, joint_motion(paper_arm.geometry, capture.q), noise)), -1, 0
    )
    errors = slopes @ np.asarray(uncertainty.covariance) @ slopes.T
    for pose, block in enumerate(own):
        errors[3 * pose : 3 * pose + 3, 3 * pose : 3 * pose + 3] += block
    weight = np.linalg.inv(own)
    total = np.array([weight[capture.owner == a].sum(axis=0) for a in range(len(capture.sizes))])
    share = [np.linalg.solve(total[a], weight[i]) for i, a in enumerate(capture.owner)]
    tips = np.block([[share[i] * float(a == b) for i, b in enumerate(capture.owner)] for a in range(len(total))])
    back = np.kron(np.array([[float(a == b) for a in range(len(total))] for b in capture.owner]), np.eye(3))
    project = np.eye(39) - back @ tips
    both = (project @ errors @ project.T)[:36, :36]
    seen = found.of(["A", "B", "C"])
    assert seen.count == 12
    assert seen.predicted == pytest.approx(math.sqrt(np.trace(both) / 12), rel=1e-9)
    assert seen.degrees_of_freedom == pytest.approx(np.trace(both) ** 2 / np.sum(both**2), rel=1e-9)
    # Lengths between the means, which have one socket in common.
    tips = tips.reshape(-1, 3, 39)
    centroids = tips @ np.asarray(paper_arm.position(capture.q)).ravel()
    rows = []
    for start, end in ((0, 1), (1, 2)):
        between = centroids[end] - centroids[start]
        rows.append(between / np.linalg.norm(between) @ (tips[end] - tips[start]))
    expected = np.array(rows) @ errors @ np.array(rows).T + np.diag([0.002**2, 0.003**2])
    np.testing.assert_allclose(found.length_covariance, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(
        found.length_error, np.asarray(aj.evaluate(paper_arm, capture, noise=noise).error), atol=1e-9
    )


def test_sockets_as_observations_are_judged_alike(paper_arm, capture):
    """Where all poses have the same weight, whichever code eliminates the positions."""
    uncertainty = uncertainty_of(paper_arm, SEAT, 40.0)
    sockets = [kinds.Socket(name, q) for name, q in capture.sockets.items()]
    one, other = (unseen_errors(uncertainty, c) for c in (capture, aj.Capture({}, capture.lengths, sockets)))
    for names in (["A"], ["B"], ["A", "B", "C"]):
        np.testing.assert_allclose(one.of(names)[:6], other.of(names)[:6], rtol=1e-6)
    np.testing.assert_allclose(one.length_error, other.length_error, atol=1e-9)
    np.testing.assert_allclose(one.length_covariance, other.length_covariance, rtol=1e-5)
    np.testing.assert_allclose(one.of_lengths()[:5], other.of_lengths()[:5], rtol=1e-5)
    assert one.of(["C"]).count == 0
    assert math.isnan(one.of(["C"]).probability)


def test_what_is_open_has_no_prediction(paper_arm, capture):
    uncertainty = uncertainty_of(paper_arm, SEAT)
    free = Uncertainty(paper_arm, uncertainty.covariance, np.eye(len(NAMES)), SEAT, None, NAMES, np.inf)
    found = unseen_errors(free, capture)
    assert found.of(["A", "B"]).predicted == math.inf
    assert math.isnan(found.of(["A", "B"]).probability)
    assert found.of_lengths().count == 0


def test_chance():
    """Against tables: 95 % of chi-square with 10 degrees of freedom lie below 18.307, of F(5, 10) below 3.3258."""
    assert chance(math.sqrt(1.8307), 1.0, 10, math.inf) == pytest.approx(0.05, abs=1e-5)
    assert chance(math.sqrt(3.3258), 1.0, 5, 10) == pytest.approx(0.05, abs=1e-5)
    assert math.isnan(chance(1.0, math.inf, 5, 10))


@pytest.mark.slow
def test_honest_data_are_as_improbable_as_chance_makes_them(paper_arm):
    """Arms drawn as the covariance says, and a capture of each: sockets of few poses share the errors of parameters."""
    noise = aj.Noise(encoder_arcsec=1, seating=0.005)
    uncertainty = uncertainty_of(paper_arm, noise)
    space, random = aj.Parameters(paper_arm, NAMES), np.random.default_rng(5)
    vector, root = np.asarray(space.vector()), np.linalg.cholesky(np.asarray(uncertainty.covariance))
    poses, lengths = [], []
    for seed in range(30):
        true = space.arm(vector + root @ random.normal(size=len(vector)))
        capture = aj.simulate(true, SOCKETS, poses=6, lengths=LENGTHS, noise=noise, seed=seed)
        found = unseen_errors(uncertainty, capture)
        poses.append(found.of(SOCKETS).probability)
        lengths.append(found.of_lengths().probability)
    for probabilities in (poses, lengths):
        # The mean of 30 uniform numbers has a standard deviation of 0.053.
        assert np.mean(probabilities) == pytest.approx(0.5, abs=0.16)
        assert min(probabilities) > 1e-4
        assert np.mean(np.array(probabilities) < 0.1) < 0.3
