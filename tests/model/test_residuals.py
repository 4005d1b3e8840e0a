"""Residuals, their weights and their normal equations, by definition and by finite differences."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.noise import tip_covariances
from aacmm_jax.model import residuals
from aacmm_jax.model.measurement import Measurement
from aacmm_jax.model.weights import Weights

NOISE = to_numpy(aj.Noise(encoder_arcsec=np.linspace(2.0, 5.0, 6), seating=0.003))
SIZES = (4, 1, 3)
SIGMA = 0.01


@pytest.fixture(scope="module")
def arm(paper_arm) -> aj.Arm:
    """With arrays of NumPy, which compiles nothing; tests/core/test_numpy_or_jax.py has both libraries."""
    return to_numpy(paper_arm)


@pytest.fixture(scope="module")
def space(arm) -> aj.Parameters:
    return aj.Parameters(arm, ("alpha_2", "a_3", "d_3", "theta_4", "probe_z"))


@pytest.fixture(scope="module")
def measurement(paper_arm) -> Measurement:
    q = np.split(np.random.default_rng(0).uniform(-2, 2, (sum(SIZES), 6)), np.cumsum(SIZES)[:-1])
    lengths = [aj.ReferenceLength("A", "B", 300.0, 0.002), aj.ReferenceLength("B", "C", 500.0, 0.004)]
    return to_numpy(Measurement.of(aj.Capture(dict(zip("ABC", q, strict=True)), lengths), paper_arm))


def blocks(rows: np.ndarray) -> list[np.ndarray]:
    """The rows of each socket."""
    return np.split(np.asarray(rows), np.cumsum(SIZES)[:-1])


def covariances(arm: aj.Arm, measurement: Measurement) -> np.ndarray:
    """Covariance of every tip (N, 3, 3), mm^2."""
    return np.moveaxis(np.asarray(tip_covariances(arm.geometry, measurement.motion, NOISE)), -1, 0)


def test_repeatability_is_the_distance_from_the_centroid(space, measurement):
    tips = blocks(space.base.position(measurement.q))
    expected = np.concatenate([tip - tip.mean(axis=0) for tip in tips])
    np.testing.assert_allclose(
        residuals.repeatability_residual(space.vector(), (space, measurement)), expected, atol=1e-12
    )


def test_weighted_centroids_and_their_covariance(arm, measurement):
    """The centroid by inverse covariances c = (sum of W)^-1 (sum of W t), and (sum of W)^-1 as its covariance."""
    weighted = measurement.weighted(arm.geometry, NOISE)
    tips = np.asarray(arm.position(measurement.q))
    inverses = blocks(np.linalg.inv(covariances(arm, measurement)))
    covariance = np.stack([np.linalg.inv(inverse.sum(axis=0)) for inverse in inverses])
    sums = np.stack([np.einsum("Nab,Nb->a", inverse, tip) for inverse, tip in zip(inverses, blocks(tips), strict=True)])
    np.testing.assert_allclose(
        weighted.centroids(np.asarray(tips)), np.einsum("sab,sb->sa", covariance, sums), rtol=1e-10
    )
    np.testing.assert_allclose(weighted.centroid_covariances(np.asarray(1.0)), covariance, rtol=1e-9, atol=1e-16)


def test_weights_whiten_and_leave_no_shift(arm, measurement):
    """R R^T is the inverse covariance, and what a shift of its socket accounts for is removed from a residual."""
    matrices = covariances(arm, measurement)
    weights = Weights.of(np.moveaxis(np.asarray(matrices), 0, -1), SIZES)
    root = np.moveaxis(np.asarray(weights.root), -1, 0)
    np.testing.assert_allclose(
        np.swapaxes(root, 1, 2) @ root @ matrices, np.broadcast_to(np.eye(3), (8, 3, 3)), atol=1e-9
    )
    shift = np.repeat(np.random.default_rng(1).normal(size=(3, 3)), SIZES, axis=0).T
    assert float(np.max(np.abs(weights.centred(weights.whiten(np.asarray(shift)), SIZES)))) < 1e-9


def test_joint_residual_is_in_standard_deviations(space, measurement):
    """Lengths with a common socket are correlated: the sum of squares is that of the inverse covariance."""
    tips = space.base.position(measurement.q)
    weights = residuals.JointWeights.of(tips, measurement, np.asarray(SIGMA))
    centroids = np.stack([tip.mean(axis=0) for tip in blocks(tips)])
    between = np.stack([centroids[1] - centroids[0], centroids[2] - centroids[1]])
    distance = np.linalg.norm(between, axis=1)
    gradient = np.zeros((2, 3, 3))  # of each length by each centroid
    for row, (start, end) in enumerate(((0, 1), (1, 2))):
        gradient[row, end], gradient[row, start] = between[row] / distance[row], -between[row] / distance[row]
    covariance = np.diag([0.002**2, 0.004**2]) + SIGMA**2 * np.einsum(
        "lsc,s,ksc->lk", gradient, 1 / np.array(SIZES), gradient
    )
    poses, lengths = residuals.joint_residual(space.vector(), (space, measurement, weights.sigma, weights.whitening))
    off = distance - np.array([300.0, 500.0])
    assert float(np.sum(lengths**2)) == pytest.approx(off @ np.linalg.solve(covariance, off), rel=1e-9)
    np.testing.assert_allclose(
        poses, np.asarray(residuals.repeatability_residual(space.vector(), (space, measurement))) / SIGMA, rtol=1e-12
    )


@pytest.mark.parametrize("weighted", [False, True], ids=["plain", "weighted"])
@pytest.mark.parametrize("joint", [False, True], ids=["repeatability", "joint"])
def test_normal_equations_are_the_residual_and_its_finite_differences(arm, space, measurement, joint, weighted):
    """Cost, gradient and Gram matrix against central differences of the residual."""
    if weighted:
        measurement = measurement.weighted(arm.geometry, NOISE)
    args = (space, measurement)
    residual, normal = residuals.repeatability_residual, residuals.repeatability_normal_equations
    if joint:
        weights = residuals.JointWeights.of(arm.position(measurement.q), measurement, np.asarray(SIGMA))
        args = (*args, weights.sigma, weights.whitening)
        residual, normal = residuals.joint_residual, residuals.joint_normal_equations

    def values(vector):
        return np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(residual(vector, args))])

    vector, steps = space.vector(), 0.1 * space.scale
    columns = [
        (8 * (values(vector + step) - values(vector - step)) - values(vector + 2 * step) + values(vector - 2 * step))
        / (12 * steps[i])
        for i, step in enumerate(np.diag(steps))
    ]
    jacobian, value = np.stack(columns, axis=1), np.asarray(values(vector))
    found, scale = normal(vector, args), np.asarray(space.scale)
    assert float(found.cost) == pytest.approx(0.5 * value @ value, rel=1e-9)
    gradient, gram = jacobian.T @ value * scale, jacobian.T @ jacobian * scale[:, None] * scale[None, :]
    np.testing.assert_allclose(found.gradient * scale, gradient, rtol=0, atol=1e-7 * np.abs(gradient).max())
    np.testing.assert_allclose(
        found.gram * scale[:, None] * scale[None, :], gram, rtol=0, atol=1e-7 * np.abs(gram).max()
    )
