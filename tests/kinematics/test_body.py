"""Distances of segments from segments and boxes: against sampled points, worked cases, and under JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aacmm_jax.kinematics.collisions import distance_from_box, segment_distance

COORDINATE = st.integers(-6, 6).map(lambda x: 20.0 * x)  # on a grid, so that parallel and touching ones come often
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)
FRACTIONS = np.linspace(0, 1, 161)


def column(point) -> np.ndarray:
    return np.array(point, dtype=float)[:, None]


def along(start, end) -> np.ndarray:
    """Points of a segment, close to each other."""
    return column(start).T + FRACTIONS[:, None] * (column(end) - column(start)).T


@given(POINT, POINT, POINT, POINT)
def test_segments(a, b, c, d):
    """No two points are nearer than the distance, and some are as near but for the steps between samples."""
    found = float(segment_distance(*map(column, (a, b, c, d)))[0])
    sampled = np.linalg.norm(along(a, b)[:, None] - along(c, d)[None], axis=-1).min()
    step = (np.linalg.norm(np.subtract(a, b)) + np.linalg.norm(np.subtract(c, d))) / 160 / 2
    assert found - 1e-6 <= sampled <= found + step + 1e-6
    assert found == pytest.approx(float(segment_distance(*map(column, (d, c, a, b)))[0]), abs=1e-5)


@given(POINT, POINT, st.tuples(*[st.sampled_from([10.0, 40.0, 75.0])] * 3))
def test_boxes(a, b, half):
    found = float(distance_from_box(column(a), column(b), column(half))[0])
    points = along(a, b)
    sampled = np.linalg.norm(points - np.clip(points, -np.array(half), np.array(half)), axis=-1).min()
    assert found - 1e-9 <= sampled <= found + np.linalg.norm(np.subtract(a, b)) / 160 / 2 + 1e-9


@pytest.mark.parametrize(
    ("segments", "distance"),
    [
        (((0, 0, 0), (10, 0, 0), (5, -5, 3), (5, 5, 3)), 3.0),  # crossing
        (((0, 0, 0), (10, 0, 0), (4, 4, 0), (14, 4, 0)), 4.0),  # parallel, side by side
        (((0, 0, 0), (10, 0, 0), (13, 4, 0), (20, 4, 0)), 5.0),  # parallel, one after the other
        (((0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0)), 5.0),  # points
        (((0, 0, 0), (10, 0, 0), (5, 0, 0), (5, 9, 0)), 0.0),  # touching
    ],
)
def test_worked_distances(segments, distance):
    assert float(segment_distance(*map(column, segments))[0]) == pytest.approx(distance, abs=1e-12)


def test_under_jax_with_derivatives():
    """The same numbers under jit, and derivatives as differences say."""
    points = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3, 5)) * 100)
    half = np.array([[20.0], [30.0], [10.0]])

    def total(points):
        return jnp.sum(segment_distance(*points)) + jnp.sum(distance_from_box(points[0], points[1], half))

    value, gradient = jax.jit(jax.value_and_grad(total))(points)
    assert float(value) == pytest.approx(float(total(np.asarray(points))), rel=1e-12)
    change = 1e-4 * np.random.default_rng(1).normal(size=points.shape)
    difference = (total(np.asarray(points) + change) - total(np.asarray(points) - change)) / 2
    assert float(jnp.sum(gradient * change)) == pytest.approx(float(difference), rel=1e-4)
