"""Captures drawn anew: every kind of observation scatters as it should, by one piece of code, and each kind of shared
error has the covariance over the poses that it states."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.redrawn import draw_shared, truth_of
from aacmm_jax.calibration.sampling import Repeated
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data import observations as kinds
from aacmm_jax.model.observed import Observed
from aacmm_jax.uncertainty.covariance import SharedErrors
from aacmm_jax.uncertainty.degrees_of_freedom import Law
from aacmm_jax.uncertainty.linearisation import Linearisation
from aacmm_jax.uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS

from .test_observed import NOISE, SIMULATED

FEW = ("a_2", "d_4", "theta_3")


@pytest.fixture(scope="module")
def bounds(paper_arm):
    return aj.Bounds.around(paper_arm, aj.Parameters(paper_arm, FEW))


def calibrated(arm, bounds, simulated, sockets=(), lengths=(), **options):
    true = aj.perturbed_arm(bounds.space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    given = {"poses": 6, "noise": NOISE, "seed": 4, "lengths": lengths, "observations": simulated}
    capture = aj.simulate(true, dict(sockets), **given)
    return capture, aj.calibrate(arm, capture, bounds, noise=NOISE, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=() if kind == "spheres" else pytest.mark.slow) for kind in SIMULATED]
)
def test_residuals_scatter_as_the_weights_say(paper_arm, bounds, kind):
    """Whitened residuals of drawn data, by the arm and the geometry about which they are drawn, have variance 1."""
    capture, result = calibrated(paper_arm, bounds, SIMULATED[kind])
    truth = truth_of(result, capture)
    batch = truth.drawn(10, NOISE, np.random.default_rng(0))[0]
    space = to_numpy(aj.Parameters(result.arm, FEW))  # NumPy compiles nothing
    z = np.concatenate([result.parameters, *(truth.geometry[name] for name in truth.observed.blocks)])
    squares = []
    for trial in range(10):
        one = jax.tree.map(lambda leaf, trial=trial: leaf[trial], batch)
        linear = Linearisation.at(to_numpy(Observed.of(one, space.base)), space, z, noise=to_numpy(NOISE), least=1e-4)
        squares += [white.ravel() ** 2 for white in linear.white()]
    squares = np.concatenate(squares)
    assert np.mean(squares) == pytest.approx(1.0, abs=5 * np.sqrt(2 / squares.size))


@pytest.mark.slow
def test_certified_values_are_drawn_once_for_all_that_share_them(paper_arm, bounds):
    capture, result = calibrated(paper_arm, bounds, SIMULATED["bars"])
    batch = truth_of(result, capture).drawn(300, NOISE, np.random.default_rng(0))[0]
    name = "coordinates of bar"
    values = [observation.drawn[name] for observation in batch.observations]
    assert len(values) == 3
    for other in values[1:]:
        np.testing.assert_array_equal(values[0], other)
    np.testing.assert_allclose(values[0].mean(axis=0), result.observed.geometry[name], atol=5e-3 / np.sqrt(300))
    np.testing.assert_allclose(values[0].std(axis=0), 0.001, rtol=0.2)


@pytest.fixture(scope="module")
def mixed(paper_arm, bounds):
    """Two sockets at a known distance, a tracker that saw the same arm, and a plate that all share."""
    few = [one.changed(poses=12) for one in SIMULATED["points"]] + [one.changed(poses=3) for one in SIMULATED["bars"]]
    sockets = {"A": (400, 100, 300), "B": (400, 100, 500)}
    return calibrated(paper_arm, bounds, few, sockets, [("A", "B", 0.002)])


# One program is compiled for a capture: a sphere, and exhaustively a mixture of kinds.
@pytest.fixture(scope="module", params=["sphere", pytest.param("mixed", marks=pytest.mark.exhaustive)])
def repeated(request, paper_arm, bounds):
    if request.param == "mixed":
        return request.getfixturevalue("mixed")
    return calibrated(paper_arm, bounds, SIMULATED["spheres"][:1])


@pytest.mark.slow
def test_bootstrap_of_observations(repeated):
    """Poses are drawn within what they owe, and the result scatters about as the noise says."""
    capture, result = repeated
    sampled = aj.bootstrap(result, capture, trials=100)
    assert sampled.failed == 0
    assert sampled.quantities[: len(FEW)] == FEW
    assert "k" not in sampled.quantities
    ratio = sampled.u / sampled.linear_u
    assert 0.6 < np.median(ratio) < 1.3
    assert "every parameter and lengths" in " ".join(sampled.sentences()) or not sampled.agrees.all()


@pytest.mark.slow
def test_drawn_solves_scatter_as_the_linear_result(repeated):
    """The Monte Carlo's own trials, fewer than its adaptive blocks."""
    capture, result = repeated
    truth = truth_of(result, capture)
    found, failed = Repeated.of(result, capture, None).solved(truth.drawn(200, NOISE, np.random.default_rng(1))[0])
    assert failed == 0
    u = np.sqrt(np.diag(result.covariance))
    ratio = found[:, : len(FEW)].std(axis=0, ddof=1) / u
    np.testing.assert_allclose(ratio, 1.0, atol=4 / np.sqrt(2 * 200))
    assert np.abs(found[:, : len(FEW)].mean(axis=0) - result.parameters).max() < 4 * u.max() / np.sqrt(200)


@pytest.mark.exhaustive
def test_monte_carlo_of_observations(mixed):
    capture, result = mixed
    sampled = aj.monte_carlo(result, capture, most=20_000)
    np.testing.assert_allclose(sampled.u, sampled.linear_u, rtol=0.03)


@pytest.mark.slow
def test_what_cannot_be_drawn(paper_arm, bounds, mixed):
    capture, result = mixed
    plate = [SIMULATED["plate"][0].changed(poses=1)]
    singles, of_singles = calibrated(paper_arm, bounds, plate)
    with pytest.raises(aj.InputError, match="one pose per point"):
        aj.bootstrap(of_singles, singles)
    with pytest.raises(aj.InputError, match="does not contain the placement plate"):
        aj.monte_carlo(result, singles)
    points = capture.observations[0]
    twice = kinds.MeasuredPoints("again", points.q, points.points + 0.01, u=0.01)
    both = aj.Capture({}, (), [points, twice])
    with pytest.raises(aj.InputError, match="exactly the same readings"):
        aj.bootstrap(aj.calibrate(paper_arm, both, bounds, noise=NOISE), both)


def test_a_robust_loss_is_for_the_bootstrap(paper_arm, bounds, mixed):
    capture, _ = mixed
    result = aj.calibrate(paper_arm, capture, bounds, noise=NOISE, robust="tukey")
    with pytest.raises(aj.InputError, match="reduced the weight of poses"):
        aj.monte_carlo(result, capture)
    with pytest.raises(aj.InputError, match="reduced the weight of poses"):
        aj.bootstrap(result, capture)


POSES, SD, CORRELATION = (3, 2), 0.1, 2.0
OWNER = np.repeat([0, 1], POSES)
SAME = OWNER[:, None] == OWNER
EXPECTED = {
    PLACES: SAME,
    VISITS: np.array([0, 0, 1, 2, 2])[:, None] == [0, 0, 1, 2, 2],
    SUCCESSIVE: SAME * np.exp(-np.abs(np.arange(5)[:, None] - np.arange(5)) / CORRELATION),
}


@pytest.mark.parametrize("kind", EXPECTED)
def test_covariance_over_the_poses(paper_arm, kind):
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    sockets = {"A": q[:3], "B": q[3:]}
    capture = aj.Capture(sockets, [aj.ReferenceLength("A", "B", value=200.0)], visits={"A": [0, 0, 1], "B": [1, 1]})
    law = Law(np.array([np.inf]), np.array([[0.5, 1.5]]), np.array([[0.5, 0.5]]))
    none = np.zeros((0, 0))
    shared = SharedErrors(
        (kind,), ("mm",), (), np.array([SD]), none, none, np.array(CORRELATION), np.zeros((1, 0, 0)), none[None], law
    )
    drawn = draw_shared(shared, paper_arm, capture, 40_000, np.random.default_rng(1))
    assert drawn is not None
    assert not drawn.joints.any()
    tips = np.moveaxis(drawn.tips, 1, 2).reshape(-1, 5)
    np.testing.assert_allclose(tips.T @ tips / len(tips), SD**2 * EXPECTED[kind], atol=0.02 * SD**2)
