"""Fewer rows say the same as all corners: sum of squares, gradient, information, and weights."""

import jax
import numpy as np
import pytest

from aacmm_jax.core.linear_algebra import inverse_cholesky
from aacmm_jax.core.numpy_or_jax import to_numpy

from .test_observations import ALL, POSES, TIPS, unknowns_of

CAMERAS = [name for name, one in ALL.items() if one.reduces]


def columns_of(rows):
    """All derivatives, and the residual last: (columns, rows, poses)."""
    by = [np.moveaxis(rows.by_tip, 1, 0), np.moveaxis(rows.by_rotation, 1, 0), *rows.by_unknowns.values()]
    return np.concatenate([*by, rows.values[None]])


def products(columns):
    """Over the rows of each pose, scaled."""
    whole = np.einsum("arm,brm->mab", columns, columns)
    scale = 1 / np.sqrt(np.einsum("maa->ma", whole) + 1e-300)
    return whole * scale[:, :, None] * scale[:, None, :]


@pytest.mark.parametrize("name", CAMERAS)
def test_squares_gradient_and_information_are_those_of_all_corners(name):
    observation = to_numpy(ALL[name])
    unknowns = unknowns_of(observation)
    whole, few = observation.residual(TIPS, unknowns), observation.residual_with_errors(TIPS, unknowns)
    order = list(few.by_unknowns)
    whole = whole._replace(by_unknowns={part: whole.by_unknowns[part] for part in order})
    np.testing.assert_allclose(products(columns_of(few)), products(columns_of(whole)), atol=1e-7)
    assert np.all(few.by_tip[-1] == 0)


@pytest.mark.parametrize("name", CAMERAS)
def test_weights_are_those_of_the_whole_covariance(name):
    """Whitened rows have the squares of generalised least squares, whose covariance has the arm's errors of a pose."""
    observation = to_numpy(ALL[name])
    unknowns = unknowns_of(observation)
    whole, few = observation.residual(TIPS, unknowns), observation.residual_with_errors(TIPS, unknowns)
    errors = np.random.default_rng(0).normal(size=(6, 6)) * np.repeat([0.5, 1e-3], 3)[:, None]
    of_few, of_whole = (np.einsum("crm,cd->mrd", columns_of(rows)[:6], errors) for rows in (few, whole))
    root = inverse_cholesky(few.measured + of_few @ of_few.swapaxes(1, 2))
    white = observation.reduced(whole, None, (few.basis, root))
    seen = np.repeat(observation.seen, observation.corners.shape[2], axis=1)
    for pose in range(POSES):
        covariance = np.diag(observation.u[pose].ravel() ** 2) + of_whole[pose] @ of_whole[pose].T
        y, kept = whole.values[:, pose], seen[pose]
        expected = y[kept] @ np.linalg.solve(covariance[np.ix_(kept, kept)], y[kept])
        assert np.sum(white.values[:, pose] ** 2) == pytest.approx(expected, rel=1e-6)
    np.testing.assert_allclose(
        np.sum((root @ few.values.T[..., None])[..., 0] ** 2, axis=1), np.sum(white.values**2, 0)
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_the_gradient_is_that_of_the_squares_under_jit(name):
    """The basis turns with the unknowns, but the sum of squares is that of all corners."""
    observation = to_numpy(ALL[name])
    unknowns = {part: value for part, value in unknowns_of(observation).items() if part in observation.unknowns}
    few = observation.residual_with_errors(TIPS, unknowns)

    def half(unknowns):
        return 0.5 * (observation.residual_with_errors(TIPS, unknowns).values ** 2).sum()

    for part, slope in jax.jit(jax.grad(half))(unknowns).items():
        expected = np.einsum("krm,rm->k", few.by_unknowns[part], few.values)
        np.testing.assert_allclose(slope[:, 0], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("name", CAMERAS)
def test_rows_count_as_many_as_there_are_corners(name):
    observation = to_numpy(ALL[name])
    measured = observation.corners.shape[2] * observation.seen.sum(axis=1)
    np.testing.assert_array_equal(observation.pose_equations, measured)
    some = observation.select([2, 3])
    np.testing.assert_array_equal(some.pose_equations, measured[2:4])
