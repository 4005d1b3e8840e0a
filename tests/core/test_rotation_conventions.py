"""Conventions of rotations against products of elementary rotations, and their names."""

import numpy as np
import pytest
from scipy.linalg import expm

from aacmm_jax.core.rotation_conventions import conventions, is_convention, numbers_of, rotation_matrices

VECTORS = np.random.default_rng(0).normal(size=(5, 3))


def about(axis: int, angle: float) -> np.ndarray:
    w = np.zeros((3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    w[j, i], w[i, j] = angle, -angle
    return expm(w)


@pytest.mark.parametrize("convention", [name for name in conventions(3) if "vector" not in name])
def test_three_angles(convention):
    axes = convention.removesuffix(" inverse")
    expected = []
    for vector in VECTORS:
        turns = [about("xyz".index(axis), angle) for axis, angle in zip(axes.lower(), vector, strict=True)]
        matrix = turns[0] @ turns[1] @ turns[2] if axes.isupper() else turns[2] @ turns[1] @ turns[0]
        expected.append(matrix.T if "inverse" in convention else matrix)
    np.testing.assert_allclose(rotation_matrices(VECTORS, convention), expected, atol=1e-12)


def test_the_other_conventions():
    vector = VECTORS[:1]
    angle = np.linalg.norm(vector)
    matrix = expm(np.cross(np.eye(3), vector[0]))
    w, xyz = np.array([[np.cos(angle / 2)]]), np.sin(angle / 2) * vector / angle
    for convention, numbers in {
        "vector": vector,
        "quaternion wxyz": np.hstack([w, xyz]),
        "quaternion xyzw": np.hstack([xyz, w]),
        "matrix": matrix.reshape(1, 9),
    }.items():
        assert numbers_of(convention) == numbers.shape[1]
        np.testing.assert_allclose(rotation_matrices(numbers, convention)[0], matrix, atol=1e-12)
        np.testing.assert_allclose(rotation_matrices(numbers, f"{convention} inverse")[0], matrix.T, atol=1e-12)


def test_names():
    assert len(conventions(3)) == 2 * (1 + 24)
    assert len(conventions(4)) == 4
    assert len(conventions(9)) == 2
    assert all(is_convention(name) for count in (3, 4, 9) for name in conventions(count))
    assert not any(map(is_convention, ("xxy", "XyZ", "abc", "euler", "inverse", "xyz  inverse", "")))
