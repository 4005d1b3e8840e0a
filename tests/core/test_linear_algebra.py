"""Small factorisations against NumPy: well and badly conditioned, scaled, repeated and zero eigenvalues, batches,
derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from aacmm_jax.core import linear_algebra
from tests.example_counts import example_count

pytestmark = pytest.mark.optimised
EPSILON = np.finfo(float).eps
SIZES = (1, 3, 21)  # few, so that few programs are compiled
DECOMPOSED, INVERTED = jax.jit(linear_algebra.singular_values), jax.jit(linear_algebra.inverse_positive_definite)
SOLVED, WHITENED = jax.jit(linear_algebra.solve_positive_definite), jax.jit(linear_algebra.inverse_cholesky)
EIGEN = jax.jit(linear_algebra.semidefinite_eigen)


@st.composite
def spectra(draw, smallest=-16):
    """Eigenvalues, some of them equal or 0, and a seed for the directions."""
    size = draw(st.sampled_from(SIZES))
    exponents = st.sampled_from([smallest, smallest / 2, 0.0]) | st.floats(smallest, 0)
    values = 10.0 ** np.array(draw(st.lists(exponents, min_size=size, max_size=size)))
    return values, draw(st.integers(0, 2**32 - 1))


def symmetric(values, seed):
    basis = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
    matrix = (basis * values) @ basis.T
    return (matrix + matrix.T) / 2


@pytest.mark.slow
@settings(max_examples=example_count(50))
@given(spectra(), st.booleans())
def test_eigenvalues_and_eigenvectors(spectrum, singular):
    values, seed = spectrum
    if singular:
        values = np.where(np.arange(len(values)) % 2, 0.0, values)
    matrix = symmetric(values, seed)
    found, vectors = map(np.asarray, EIGEN(matrix))
    size = 100 * EPSILON * np.max(values)
    np.testing.assert_allclose(found, np.sort(np.abs(np.linalg.eigvalsh(matrix)))[::-1], rtol=0, atol=size)
    assert np.all(np.diff(found) <= 0)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(values)), rtol=0, atol=100 * EPSILON)
    # Of a singular matrix rounding may make an eigenvalue negative; its singular value is then its size.
    np.testing.assert_allclose((vectors * found) @ vectors.T, matrix, rtol=0, atol=3 * size)


@pytest.mark.slow
@settings(max_examples=example_count(40))
@given(st.sampled_from(SIZES), st.integers(0, 2**32 - 1), st.floats(0, 60))
def test_singular_values_keep_their_relative_accuracy_whatever_the_scale_of_columns(size, seed, decades):
    """Columns of very different size have singular values just as different; each keeps its leading digits."""
    random = np.random.default_rng(seed)
    orthogonal = np.linalg.qr(random.normal(size=(size, size)))[0]
    scale = 10.0 ** np.sort(random.uniform(-decades, decades, size=size))
    u, s, v = map(np.asarray, DECOMPOSED(orthogonal * scale))
    np.testing.assert_allclose(s, scale[::-1], rtol=100 * EPSILON)
    np.testing.assert_allclose(v.T @ v, np.eye(size), rtol=0, atol=100 * EPSILON)
    np.testing.assert_allclose(u.T @ u, np.eye(size), rtol=0, atol=100 * EPSILON)
    np.testing.assert_allclose((u * s) @ v.T / scale, orthogonal, rtol=0, atol=200 * EPSILON)


def test_singular_matrices():
    """Columns that repeat, that are 0, and a matrix of zeros."""
    random = np.random.default_rng(0)
    matrix = random.normal(size=(6, 6))
    matrix[:, 3], matrix[:, 4] = matrix[:, 1], 0.0
    u, s, v = map(np.asarray, DECOMPOSED(matrix))
    np.testing.assert_allclose(s, np.linalg.svd(matrix, compute_uv=False), rtol=0, atol=10 * EPSILON * s[0])
    np.testing.assert_allclose((u * s) @ v.T, matrix, rtol=0, atol=30 * EPSILON * s[0])
    assert np.all(np.asarray(DECOMPOSED(np.zeros((6, 6)))[1]) == 0)


@pytest.mark.slow
@settings(max_examples=example_count(50))
@given(spectra(smallest=-12), st.floats(-10, 10))
def test_inverse_solution_and_whitening(spectrum, decades):
    """Errors relative to the condition number that is left after scaling the diagonal to 1, which Cholesky does not
    see."""
    values, seed = spectrum
    unit = 10.0 ** np.random.default_rng(seed).uniform(-abs(decades), abs(decades), size=len(values))
    core = symmetric(values, seed)
    matrix = unit[:, None] * core * unit[None, :]
    root = np.sqrt(np.diagonal(matrix))
    condition = np.linalg.cond(matrix / root[:, None] / root[None, :])
    tolerance = 100 * EPSILON * condition
    whitening = np.asarray(WHITENED(matrix))
    assert np.all(np.triu(whitening, 1) == 0)
    np.testing.assert_allclose(whitening @ matrix @ whitening.T, np.eye(len(values)), rtol=0, atol=tolerance)
    inverse = root[:, None] * np.asarray(INVERTED(matrix)) * root[None, :]
    expected = np.linalg.inv(matrix / root[:, None] / root[None, :])
    np.testing.assert_allclose(inverse, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))
    right = np.random.default_rng(seed).normal(size=len(values))
    solution = root * np.asarray(SOLVED(matrix, root * right))
    np.testing.assert_allclose(
        solution, expected @ right, rtol=0, atol=tolerance * np.max(np.abs(expected)) * len(values)
    )


def test_what_is_not_positive_definite_gives_nan_and_spoils_no_other():
    matrices = np.stack([np.diag([1.0, pivot, 1.0, 1.0]) for pivot in (1.0, -1.0, 0.0)])
    inverse = np.asarray(INVERTED(matrices))
    np.testing.assert_array_equal(inverse[0], np.eye(4))
    assert np.isnan(inverse[1]).any()
    assert not np.isfinite(inverse[2]).all()
    solution = np.asarray(SOLVED(matrices, np.ones((3, 4))))
    np.testing.assert_array_equal(solution[0], np.ones(4))
    assert not np.isfinite(solution[1:]).all(axis=1).any()


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(3,), (2, 2)])
def test_batches_and_vmap_equal_single_matrices(batch):
    random = np.random.default_rng(1)
    rows = random.normal(size=(*batch, 9, 6))
    matrices, rights = np.swapaxes(rows, -1, -2) @ rows, random.normal(size=(*batch, 6))
    expected = np.linalg.solve(matrices, rights[..., None])[..., 0]
    mapped = linear_algebra.solve_positive_definite
    for _ in batch:
        mapped = jax.vmap(mapped)
    for solve in (SOLVED, jax.jit(mapped)):
        np.testing.assert_allclose(solve(matrices, rights), expected, rtol=1e-10)
    values, vectors = EIGEN(matrices)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrices)[..., ::-1], rtol=1e-11)
    np.testing.assert_allclose(matrices @ vectors, vectors * values[..., None, :], rtol=0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("function", ["inverse_cholesky", "inverse_positive_definite", "solve_positive_definite"])
def test_derivatives(function):
    random = np.random.default_rng(2)
    rows = random.normal(size=(2, 9, 5))
    other = (random.normal(size=(2, 5)),) if function == "solve_positive_definite" else ()

    @jax.jit
    def from_rows(rows, *other):
        return getattr(linear_algebra, function)(jnp.swapaxes(rows, -1, -2) @ rows, *other)

    check_grads(from_rows, (rows, *other), order=1, modes=("fwd", "rev"), rtol=1e-6)
