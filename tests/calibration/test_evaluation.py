"""Evaluations of captures with observations: residuals of every kind, with the geometry fitted or kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds

from .test_observed import NOISE, SIMULATED

ALL = [observation for kind in SIMULATED.values() for observation in kind]


@pytest.fixture(scope="module")
def capture(paper_arm):
    points = {"A": (400, 200, 300), "B": (500, 300, 100)}
    return aj.simulate(paper_arm, points, poses=20, lengths=[("A", "B", 0.001)], observations=ALL, noise=NOISE, seed=2)


def test_the_true_arm_has_residuals_of_one_standard_deviation(paper_arm, capture):
    found = aj.evaluate(paper_arm, capture, noise=NOISE)
    assert found.observed.names == ("A", "B", *(observation.name for observation in ALL))
    np.testing.assert_allclose(found.observed.reduced_chi, 1.0, atol=0.3)
    assert float(np.sqrt(np.mean(found.observed.reduced_chi**2))) == pytest.approx(1.0, abs=0.1)
    assert np.abs(found.error / found.u).max() < 3
    assert np.all(np.isnan(found.observed.rms_angle))
    for residuals, rms in zip(found.observed.residuals, found.observed.rms, strict=True):
        assert float(np.sqrt(np.mean(np.sum(residuals**2, axis=0)))) == pytest.approx(float(rms))


@pytest.mark.slow
def test_sockets_and_lengths_are_as_without_observations(paper_arm, capture):
    """Poses of a socket have nearly the same weight."""
    alone = aj.evaluate(paper_arm, aj.Capture(capture.sockets, capture.lengths))
    found = aj.evaluate(paper_arm, capture, noise=NOISE)
    np.testing.assert_allclose(found.repeatability.rms, alone.repeatability.rms, rtol=1e-9)
    np.testing.assert_allclose(found.measured, alone.measured, atol=0.01)
    np.testing.assert_allclose(found.u, alone.u, rtol=0.4)
    np.testing.assert_allclose(found.distances, alone.distances, atol=0.01)


def test_sockets_alone_with_noise_or_known_positions(paper_arm, capture):
    """Residuals are described where something is known of them besides their scatter."""
    sockets = aj.Capture(capture.sockets, capture.lengths)
    alone, weighted = aj.evaluate(paper_arm, sockets), aj.evaluate(paper_arm, sockets, noise=NOISE)
    assert alone.observed is None
    np.testing.assert_allclose(weighted.observed.reduced_chi, 1.0, atol=0.3)
    np.testing.assert_allclose(weighted.measured, alone.measured, atol=0.01)
    moved = {"position of A": np.asarray(alone.repeatability.centroids[0]) + np.array([1.0, 0.0, 0.0])}
    kept = aj.evaluate(paper_arm, sockets, geometry=moved)
    np.testing.assert_array_equal(kept.observed.geometry["position of A"], moved["position of A"])
    assert float(kept.observed.rms[0]) == pytest.approx(np.hypot(1.0, float(alone.repeatability.socket_rms[0])))
    assert float(kept.observed.rms[1]) == pytest.approx(float(alone.repeatability.socket_rms[1]))


def test_without_redundancy_lengths_have_no_uncertainty(paper_arm, capture):
    one_each = aj.Capture({name: q[:1] for name, q in capture.sockets.items()}, capture.lengths)
    found = aj.evaluate(paper_arm, one_each)
    assert np.isnan(found.u).all()
    assert np.isfinite(found.measured).all()
    assert np.isfinite(aj.evaluate(paper_arm, one_each, noise=NOISE).u).all()


@pytest.mark.slow
def test_a_frame_that_is_kept_shows_a_moved_station(paper_arm):
    box = [[200, -300, 100], [600, 300, 500]]

    def seen(x, seed):
        frame = (0.1, 0.2, 0.3, 1000.0 + x, 2000.0, -300.0)
        simulated = kinds.SimulatedPoints("T", box, 60, frame, target="smr", place=(60, 20, 80))
        return aj.simulate(paper_arm, {}, observations=[simulated], noise=NOISE, seed=seed)

    space = aj.Parameters(paper_arm, ("a_2", "a_3", "d_4", "theta_2", "theta_3"))
    calibrated = aj.calibrate(paper_arm, seen(0.0, 1), aj.Bounds.around(paper_arm, space), noise=NOISE)
    geometry = calibrated.observed.geometry
    moved = seen(0.5, 2)
    fitted = aj.evaluate(calibrated.arm, moved)
    kept = aj.evaluate(calibrated.arm, moved, geometry=geometry)
    assert float(fitted.observed.rms[0]) < 0.05
    assert float(kept.observed.rms[0]) == pytest.approx(0.5, rel=0.02)
    assert float(kept.observed.reduced_chi[0]) == pytest.approx(1.0, abs=0.02)
    for name, value in geometry.items():
        np.testing.assert_array_equal(kept.observed.geometry[name], value)
    with pytest.raises(aj.InputError, match="no 'frame of S'"):
        aj.evaluate(paper_arm, moved, geometry={"frame of S": np.zeros(6)})
    with pytest.raises(aj.InputError, match="give \\(6,\\)"):
        aj.evaluate(paper_arm, moved, geometry={"frame of T": np.zeros(3)})


@pytest.mark.slow
def test_a_batch_of_arms_and_derivatives(paper_arm):
    sphere = kinds.SimulatedSphere("s", (400, 0, 300), 50.0, 25, u=0.001)
    capture = aj.simulate(paper_arm, {}, observations=[sphere], noise=NOISE, seed=3)
    arms = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf * 1.0001]), paper_arm)
    found = aj.evaluate(arms, capture)
    for i in range(2):
        one = aj.evaluate(jax.tree.map(lambda leaf, i=i: leaf[i], arms), capture)
        np.testing.assert_allclose(found.observed.rms[i], one.observed.rms, rtol=1e-6)

    def rms(size):
        return aj.evaluate(paper_arm.replace(a=paper_arm.a + size), capture).observed.rms[0]

    numerical = (float(rms(1e-5)) - float(rms(-1e-5))) / 2e-5
    np.testing.assert_allclose(jax.jvp(rms, (0.0,), (1.0,))[1], numerical, rtol=1e-4)
