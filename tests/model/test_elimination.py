"""The arrow form of a problem against one dense least squares of all unknowns, for problems drawn from every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.flatten_util import ravel_pytree

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_jax, to_numpy
from aacmm_jax.data import observations as kinds
from aacmm_jax.kinematics.parameters import Parameters
from aacmm_jax.model.elimination import Args, observed_model, observed_rows, pseudo_inverse
from aacmm_jax.model.layout import layout_of
from aacmm_jax.model.loss_names import LOSSES
from aacmm_jax.model.observed import Observed
from aacmm_jax.model.robust import Loss
from aacmm_jax.model.rows import PriorRows
from aacmm_jax.uncertainty.linear_propagation import propagated
from aacmm_jax.uncertainty.linearisation import Linearisation
from tests.example_counts import example_count

NOISE = aj.Noise(encoder_arcsec=5.0, seating=0.01)
BOX = [[200, -300, 100], [600, 300, 500]]
BAR = {"1": (0, 0, 0), "2": (300, 0, 0), "3": (150, 40, 0)}
EVERY = {
    "sphere": lambda name: kinds.SimulatedSphere(name, (400, 100, 300), 50.0, 9, u=0.001),
    "free sphere": lambda name: kinds.SimulatedSphere(name, (300, 200, 300), 40.0, 8),
    "points": lambda name: kinds.SimulatedPoints(name, BOX, 8, (0, 0, 1.0, 2000, 0, 0), u=0.02),
    "target": lambda name: kinds.SimulatedPoints(name, BOX, 9, u=0.02, target="ball", place=(10.0, 20.0, 60.0)),
    "bar": lambda name: kinds.SimulatedArtefact(name, BAR, 3, (0, 0, 0.7, 300, -200, 300), u=0.001),
}


def problem(arm, parts, seed):
    """Sockets A to D, A and B, B and C joined by lengths, and other observations."""
    sockets = {"A": (400, 200, 300), "B": (300, -200, 200), "C": (500, 0, 250), "D": (350, 100, 400)}
    poses = {"A": 14, "B": 13, "C": 15, "D": 14}
    pairs = [("A", "B", 0.002), ("B", "C", 0.004)]
    capture = aj.simulate(arm, sockets, poses=poses, lengths=pairs, noise=NOISE, seed=seed)
    others = [EVERY[part](f"{part} {number}") for number, part in enumerate(parts)]
    seen = aj.simulate(arm, {}, observations=others, noise=NOISE, seed=seed + 1).observations if others else ()
    capture = aj.Capture(capture.sockets, capture.lengths, seen)
    space = to_numpy(aj.Parameters.free_of(arm, held=("d_1", "a_2")))
    observed = Observed.of(capture, arm)
    geometry = observed.start(space, space.vector())
    random = np.random.default_rng(seed)
    z = np.concatenate([space.vector(), geometry]) + 1e-4 * random.normal(size=len(space.names) + len(geometry))
    prior = PriorRows(np.asarray(space.vector()), 10 / np.asarray(space.scale))
    return Linearisation.at(observed, space, z, noise=to_numpy(NOISE), least=1e-3, prior=prior)


def dense(linear, loss=None):
    """Residuals and their derivatives by JAX."""
    args = to_jax(Args(linear.space, linear.observed, linear.whitening, loss))
    rows = lambda z: ravel_pytree(observed_rows(z, args))[0]  # noqa: E731
    z = jnp.asarray(linear.z)
    return np.asarray(rows(z)), np.asarray(jax.jit(jax.jacfwd(rows))(z))


PARTS = st.lists(st.sampled_from(sorted(EVERY)), max_size=4)


@pytest.mark.slow
@settings(max_examples=example_count(3), deadline=None)
@given(PARTS, st.integers(0, 1000))
def test_the_arrow_is_the_dense_normal_matrix(paper_arm, parts, seed):
    linear = problem(paper_arm, parts, seed)
    model = observed_model(linear.z, Args(linear.space, linear.observed, linear.whitening))
    residual, jacobian = dense(linear)
    assert model.cost == pytest.approx(0.5 * residual @ residual, rel=1e-10)
    size = np.linalg.norm(jacobian, axis=0)
    np.testing.assert_allclose(model.gradient / size, jacobian.T @ residual / size, atol=1e-9 * np.abs(residual).max())
    unit = np.eye(len(linear.z))
    gram = np.stack([model.gram.times(column) for column in unit])
    np.testing.assert_allclose(gram / np.outer(size, size), jacobian.T @ jacobian / np.outer(size, size), atol=1e-10)
    scaled, damping = model.gram.scaled(1 / size), np.array(1e-3)
    fixed = np.random.default_rng(seed).uniform(size=len(size)) < 0.1
    right = np.random.default_rng(seed).normal(size=len(size))
    matrix = (gram / np.outer(size, size) + 1e-3 * unit)[np.ix_(~fixed, ~fixed)]
    expected = np.zeros(len(size))
    expected[~fixed] = np.linalg.solve(matrix, right[~fixed])
    np.testing.assert_allclose(scaled.damped_solution(right, fixed, damping), expected, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_a_robust_cost_is_that_of_its_residuals(paper_arm, loss):
    linear = problem(paper_arm, ["sphere", "points"], 3)
    model = observed_model(linear.z, Args(linear.space, linear.observed, linear.whitening, Loss(loss)))
    residual, jacobian = dense(linear, Loss(loss))
    assert model.cost == pytest.approx(0.5 * residual @ residual, rel=1e-9)
    size = np.linalg.norm(jacobian, axis=0) + 1e-12
    np.testing.assert_allclose(model.gradient / size, jacobian.T @ residual / size, atol=1e-7 * np.abs(residual).max())
    by_weights = observed_model(
        linear.z, Args(linear.space, linear.observed, linear.whitening, Loss(loss)), curved=False
    )
    np.testing.assert_allclose(model.gradient, by_weights.gradient, rtol=1e-6, atol=1e-9 * np.abs(model.gradient).max())
    # No direction has more curvature than by weights alone.
    less = by_weights.gram.diagonal() - model.gram.diagonal()
    assert np.all(less >= -1e-9 * by_weights.gram.diagonal())
    assert less.max() > 0


@pytest.mark.slow
@settings(max_examples=example_count(3), deadline=None)
@given(PARTS, st.integers(0, 1000))
def test_covariances_of_eliminated_geometry_are_the_dense_ones(paper_arm, parts, seed):
    """With rows of variance 1, every part has the covariance of the dense inverse."""
    linear = problem(paper_arm, ["points", *parts], seed)
    _, jacobian = dense(linear)
    steps = linear.steps
    triangle = np.linalg.qr(jacobian * steps, mode="r")
    root = np.linalg.inv(triangle)
    inverse = root @ root.T
    influence = linear.influence()
    unit = [np.moveaxis(np.tile(np.eye(rows.shape[0]), (rows.shape[1], 1, 1)), 0, -1) for rows in
            (block.white for block in linear.blocks[: len(linear.observed.layout.groups)])]  # fmt: skip
    found = propagated(influence, unit, None, None)
    u = np.sqrt(np.diag(inverse)[: linear.height])
    np.testing.assert_allclose(
        found.head / np.outer(u, u), inverse[: linear.height, : linear.height] / np.outer(u, u), atol=1e-4
    )
    first = linear.height
    for matrices in found.components:
        for matrix in matrices:
            index = np.arange(first, first + len(matrix))
            np.testing.assert_allclose(
                matrix, inverse[np.ix_(index, index)], rtol=2e-3, atol=1e-5 * np.diag(matrix).max()
            )
            first = index[-1] + 1
    assert first == len(linear.z)


def test_a_linear_component_is_no_unknown_of_the_solve(paper_arm):
    """Where positions of sockets are left out, cost, gradient and information are those at their best positions."""
    linear = problem(paper_arm, ["free sphere"], 5)
    layout = linear.observed.layout
    count = sum(number * size for number, size in layout.classes[len(layout.classes) - layout.linear :])
    assert count == 3  # of D, which no length joins
    z = linear.with_fitted_geometry()
    whole = observed_model(z, Args(linear.space, linear.observed, linear.whitening))
    away = z.copy()
    away[-count:] += [3.0, -2.0, 1.0]
    args = Args(linear.space, linear.observed, linear.whitening, linear=away[-count:])
    found = observed_model(z[:-count], args)
    part = Args(linear.space, linear.observed, linear.whitening, linear=z[-count:])
    same = observed_model(z[:-count], part)
    assert found.cost == pytest.approx(same.cost, rel=1e-9)
    np.testing.assert_allclose(found.gram.head, same.gram.head, rtol=1e-9)
    kept = slice(len(z) - count)
    np.testing.assert_allclose(found.gradient, same.gradient, rtol=1e-6, atol=1e-6 * np.abs(same.gradient).max())
    assert whole.gradient[kept].shape == found.gradient.shape


def socket(name, poses):
    return kinds.Socket(name, np.zeros((poses, 6)))


@pytest.mark.parametrize(
    ("ends", "classes"),
    [
        pytest.param([], ((6, 3),), id="alone"),
        pytest.param([("0", "1")], ((1, 6), (4, 3)), id="a pair"),
        pytest.param([("0", "1"), ("3", "2")], ((2, 6), (2, 3)), id="two pairs"),
        pytest.param([("0", "1"), ("1", "2"), ("4", "5")], ((1, 9), (1, 6), (1, 3)), id="three in a row"),
    ],
)
def test_lengths_make_one_component_of_their_sockets(ends, classes):
    layout = layout_of([socket(str(i), 4) for i in range(6)], [tuple(f"position of {e}" for e in p) for p in ends])
    assert (layout.shared, layout.classes) == (0, classes)
    assert sorted(np.concatenate(list(layout.positions.values())).tolist()) == list(range(18))


def test_a_large_component_joins_the_shared_geometry():
    """A chain of lengths over 13 sockets has 39 numbers."""
    ends = [(f"position of {i}", f"position of {i + 1}") for i in range(12)]
    layout = layout_of([socket(str(i), 4) for i in range(15)], ends)
    assert (layout.shared, layout.classes) == (39, ((2, 3),))


def test_observations_that_several_use_are_shared(paper_arm):
    observed = problem(paper_arm, ["target", "target"], 1).observed
    assert [name for name, _ in observed.layout.parts[:1]] == ["offset of ball"]
    assert observed.layout.shared == 3
    groups = {group.members for group in observed.layout.groups}
    assert (4, 5) in groups  # both stations at once


@pytest.mark.slow
def test_groups_do_not_change_the_rows(paper_arm):
    """Sockets evaluated at once and one by one."""
    linear = problem(paper_arm, [], 2)
    white = linear.white()
    for number, observation in enumerate(linear.observed.observations):
        alone = aj.Capture({}, (), [observation])
        observed = Observed.of(alone, paper_arm)
        part = linear.observed.positions[f"position of {observation.name}"]
        z = np.concatenate([linear.z[: len(linear.space.names)], linear.z[len(linear.space.names) + part]])
        one = Linearisation.at(observed, Parameters(linear.space.base, linear.space.names), z, noise=NOISE, least=1e-3)
        np.testing.assert_allclose(white[number], one.white()[0], atol=1e-9)


def test_what_is_not_finite_has_no_inverse_and_leaves_the_others():
    inverses = pseudo_inverse(np.stack([np.diag([2.0, 0.0]), np.full((2, 2), np.nan)]))
    np.testing.assert_allclose(inverses[0], np.diag([0.5, 0.0]))
    assert np.all(np.isnan(inverses[1]))
