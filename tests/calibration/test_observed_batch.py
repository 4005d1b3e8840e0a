"""Batches of calibrations from observations: the same results as one by one."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

from .test_observed import BOX, FRAME, NOISE

SIMULATED = [
    kinds.SimulatedPoints("T", BOX, 15, FRAME, u=0.01),
    kinds.SimulatedSphere("s", (500, 200, 200), 50.0, 15, u=0.001),
]


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters(paper_arm, ("a_2", "a_3", "d_4", "theta_2", "theta_3"))


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def captures(space):
    true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    return [aj.simulate(true, {}, observations=SIMULATED, noise=NOISE, seed=seed) for seed in range(3)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{}, {"noise": NOISE, "robust": "tukey"}],
    ids=["plain", "robust"],
)
def test_as_one_by_one(paper_arm, bounds, captures, options):
    many = aj.calibrate_many(paper_arm, aj.stack_captures(captures), bounds, covariance=True, slots=2, **options)
    assert many.converged.all()
    assert many.method == "joint"
    assert many.k is None
    for i, capture in enumerate(captures):
        one = aj.calibrate(paper_arm, capture, bounds, **options)
        u = np.sqrt(np.diag(one.covariance))
        np.testing.assert_allclose(many.parameters[i], one.parameters, atol=1e-6 * u.min())
        np.testing.assert_allclose(many.u[i], u, rtol=1e-6)
        np.testing.assert_allclose(many.reduced_chi[i], one.observed.reduced_chi_of_all, rtol=1e-6)
        np.testing.assert_allclose(many.stage1.sigma[i], one.observed.sigma, rtol=1e-6)
        assert abs(many.steps[i] - one.steps) < 3


@pytest.mark.exhaustive
def test_starts_bounds_and_arms(paper_arm, space, bounds, captures):
    """A batch of starts and of bounds on one capture, then of arms; a result does not depend on its neighbours."""
    start = np.asarray(space.vector())
    upper = np.stack([np.asarray(bounds.upper)] * 3)
    upper[2, 0] = start[0] - 1.5
    starts = start + np.outer([0.0, 0.3, 0.0], np.asarray(space.scale))
    many = aj.identify_many(paper_arm, captures[0], bounds.lower, upper, starts, space=space, noise=NOISE)
    assert many.hold is None
    assert many.converged.all()
    np.testing.assert_allclose(many.parameters[1], many.parameters[0], atol=1e-7)
    assert many.active[2, 0] == 1
    assert many.parameters[2, 0] == upper[2, 0]
    order = np.array([2, 0, 1])  # of the same size, which is compiled already
    again = aj.identify_many(
        paper_arm, captures[0], bounds.lower, upper[order], starts[order], space=space, noise=NOISE
    )
    np.testing.assert_array_equal(again.parameters, many.parameters[order])
    with pytest.raises(aj.InputError, match="covariance=True"):
        _ = many.u
    arms = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), paper_arm)
    of_arms = aj.identify_many(arms, captures[0], bounds.lower, bounds.upper, space=space, noise=NOISE)
    np.testing.assert_allclose(of_arms.parameters, np.stack([many.parameters[0]] * 2), rtol=1e-9)


@pytest.mark.exhaustive
def test_sockets_with_covariances(paper_arm, space, bounds):
    points = {"A": (400, 200, 300), "B": (500, 300, 100)}
    capture = aj.simulate(paper_arm, points, poses=15, lengths=[("A", "B", 0.001)], noise=NOISE)
    starts = np.stack([np.asarray(space.vector())] * 2)
    many = aj.calibrate_many(paper_arm, capture, bounds, start=starts, covariance=True, noise=NOISE)
    one = aj.calibrate(paper_arm, capture, bounds, method="joint", noise=NOISE)
    np.testing.assert_allclose(many.u[0], np.sqrt(np.diag(one.covariance)), rtol=1e-5)
    with pytest.raises(aj.InputError, match="two-stage"):
        aj.calibrate_many(paper_arm, capture, bounds, start=starts, covariance=True, method="two-stage")
    stage1 = aj.identify_many(paper_arm, capture, bounds, start=starts, covariance=True, noise=NOISE)
    alone = aj.identify(paper_arm, capture, bounds, noise=NOISE)
    np.testing.assert_allclose(stage1.u[0], np.sqrt(np.diag(alone.covariance)), rtol=1e-5)


def test_captures_of_a_batch_have_the_same_observations(captures, paper_arm):
    other = aj.simulate(paper_arm, {}, observations=SIMULATED[:1], noise=NOISE)
    with pytest.raises(aj.InputError, match="lengths and observations"):
        aj.stack_captures([captures[0], other])
