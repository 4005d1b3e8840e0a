"""Rotation vectors, their derivatives and fitted frames, against SciPy's rotations and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aacmm_jax.core.rotations import (
    fitted_frame,
    inverse_frame,
    rotation_and_derivative,
    rotation_matrix,
    rotation_vector,
)


@pytest.fixture(params=[1e-9, 1e-4, 0.5, 3.1, np.pi - 1e-7])
def vectors(request):
    directions = np.random.default_rng(0).normal(size=(10, 3))
    return request.param * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_matrix_and_vector(vectors):
    for w in vectors:
        matrix = rotation_matrix(w)
        np.testing.assert_allclose(matrix, Rotation.from_rotvec(w).as_matrix(), atol=1e-13)
        np.testing.assert_allclose(rotation_matrix(rotation_vector(matrix)), matrix, atol=1e-12)
        assert np.linalg.norm(rotation_vector(matrix)) <= np.pi + 1e-12
        np.testing.assert_allclose(rotation_vector(jnp.asarray(matrix)), rotation_vector(matrix), atol=1e-9)


def test_derivative(vectors):
    step = 1e-6
    for w in vectors:
        for k in range(3):
            shift = step * np.eye(3)[k]
            change = rotation_matrix(w + shift) @ rotation_matrix(w - shift).T
            numerical = Rotation.from_matrix(change).as_rotvec() / (2 * step)
            np.testing.assert_allclose(rotation_and_derivative(w)[1][:, k], numerical, atol=1e-8)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("library", [np, jnp], ids=["numpy", "jax"])
def test_vectors_that_are_columns(vectors, library):
    """One matrix each, of many vectors at once as of one."""
    columns = library.asarray(vectors.T)
    for i, matrices in enumerate(rotation_and_derivative(columns)):
        expected = np.stack([rotation_and_derivative(w)[i] for w in vectors], axis=-1)
        np.testing.assert_allclose(matrices, expected, atol=1e-15)
        single = rotation_and_derivative(vectors[0][:, None])[i]
        np.testing.assert_array_equal(single[..., 0], rotation_and_derivative(vectors[0])[i])
    np.testing.assert_allclose(rotation_matrix(columns), rotation_and_derivative(columns)[0], atol=1e-15)


compiled_frame = jax.jit(fitted_frame)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("plane", [False, True])
def test_fitted_frame(vectors, plane):
    """Exact where there is an exact frame, also of points in a plane; never a mirror image."""
    points = np.random.default_rng(1).normal(size=(3, 7)) * 100
    points[2] *= not plane
    for w in vectors:
        target = rotation_matrix(w) @ points + np.array([[10.0], [-2000.0], [30.0]])
        for frame in (fitted_frame(points, target), np.asarray(compiled_frame(points, target))):
            np.testing.assert_allclose(rotation_matrix(frame[:3]) @ points + frame[3:, None], target, atol=1e-8)
    mirrored = fitted_frame(points, points * np.array([[1.0], [1.0], [-1.0]]) if not plane else -points)
    assert np.linalg.det(rotation_matrix(mirrored[:3])) > 0


def test_the_inverse_of_a_frame_and_its_derivatives():
    frame = np.array([0.3, -0.2, 0.5, 100.0, 200.0, -50.0])
    inverse, derivative = inverse_frame(frame)
    np.testing.assert_allclose(inverse_frame(inverse)[0], frame, atol=1e-12)
    step = 1e-6 * np.eye(6)
    differences = [(inverse_frame(frame + d)[0] - inverse_frame(frame - d)[0]) / 2e-6 for d in step]
    np.testing.assert_allclose(derivative, np.transpose(differences), atol=1e-6)
