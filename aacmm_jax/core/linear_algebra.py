"""Factorisations of small matrices (up to about 40 rows) by array operations, for any leading batch axes.

jaxlib's batched LAPACK calls split their batch over the thread pool whose threads they block, so that independent ones
in one program can wait for each other forever (measured on two cores with four). Nothing here calls LAPACK for arrays
of JAX; for NumPy's it is the better choice.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .numpy_or_jax import AnyArray, namespace

Square = Float[AnyArray, "*batch p p"]
Rows = Float[AnyArray, "*batch p"]
_EPSILON = float(np.finfo(np.float64).eps)
# Rows of matrices whose factors are written out entry by entry. With six, XLA fuses pivots into more than one place and
# rounds them differently there, which costs four digits.
_UNROLLED = 3
_LARGE = 60  # rows from which the inverse of a triangle is worth the import of SciPy: a quarter of the time for 400
_MAX_SWEEPS = 30  # of Jacobi rotations; matrices of 40 rows need about 10


def length_and_direction(vectors: Float[AnyArray, "k m"]) -> tuple[Float[AnyArray, " m"], Float[AnyArray, "k m"]]:
    """Lengths of vectors that are columns, and unit vectors along them, with finite derivatives; of 0, both are 0."""
    xp = namespace(vectors)
    square = xp.sum(vectors**2, axis=0)
    size = xp.sqrt(xp.where(square == 0, 1.0, square))
    return xp.where(square == 0, 0.0, size), vectors / size[None]


def products_by_column(
    matrices: Float[AnyArray, "r c p"], columns: Float[AnyArray, "c *k m"]
) -> Float[AnyArray, "r *k m"]:
    """Matrices times columns: one matrix for each of the m (p = m), or one for all (p = 1).

    In JAX as sums over a few components: XLA computes many products of small matrices several times as slowly.
    """
    if matrices.shape[2] == 1 and namespace(matrices, columns) is np:
        flat = matrices[:, :, 0] @ columns.reshape(len(columns), -1)
        return flat.reshape(len(flat), *columns.shape[1:])
    rows, components, p = matrices.shape
    matrices = matrices.reshape(rows, components, *(1,) * (columns.ndim - 2), p)
    first, *others = (matrices[:, i] * columns[i][None] for i in range(components))
    return sum(others, first)


def squares(rows: Float[AnyArray, "r c m"]) -> Float[AnyArray, "m r r"]:
    """A matrix a pose times its own transpose."""
    return namespace(rows).moveaxis(products(rows, rows), -1, 0)


def products(left: Float[AnyArray, "r c m"], right: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r s m"]:
    """A matrix a pose times the transpose of another, as sums: XLA computes many products of small matrices several
    times as slowly."""
    first, *others = (left[:, None, c] * right[None, :, c] for c in range(left.shape[1]))
    return sum(others, first)


def matrix_products(left: Float[AnyArray, "r s m"], right: Float[AnyArray, "s c m"]) -> Float[AnyArray, "r c m"]:
    """The product of two matrices a pose."""
    return products(left, namespace(right).swapaxes(right, 0, 1))


def rows_times(rows: Float[AnyArray, "*batch p"], matrix: Float[AnyArray, "p q"]) -> Float[AnyArray, "*batch q"]:
    """Every row times a matrix, by one product: NumPy computes a batch of products of few rows one by one."""
    flat = rows.reshape(math.prod(rows.shape[:-1]), matrix.shape[0])
    return (flat @ matrix).reshape(*rows.shape[:-1], matrix.shape[1])


def quadratic_forms(rows: Float[AnyArray, "*batch p"], matrix: Float[AnyArray, "p p"]) -> Float[AnyArray, "*batch"]:
    """x^T M x of every row x; einsum of all three would go through p^2 entries a row."""
    return namespace(rows, matrix).sum(rows_times(rows, matrix) * rows, axis=-1)


def solve_positive_definite(matrix: Square, right: Rows) -> Rows:
    """Solution x of matrix x = right by Cholesky; NaN where the matrix is not positive definite to working
    precision."""
    if namespace(matrix, right) is jnp:
        return _solve(matrix, right)
    whitening = inverse_cholesky(matrix)
    return (np.swapaxes(whitening, -1, -2) @ (whitening @ right[..., None]))[..., 0]


@jax.custom_jvp
def _solve(matrix: Float[Array, "*batch p p"], right: Float[Array, "*batch p"]) -> Float[Array, "*batch p"]:
    p = matrix.shape[-1]
    # Rows of a multiple of four numbers: others take up to half as long again (22 of them, measured).
    filled = jnp.zeros((*right.shape, -(p + 1) % 4))
    rows = _triangular(jnp.concatenate([matrix, right[..., None], filled], axis=-1))

    def substitute(i: Array, solution: Array) -> Array:
        k = p - 1 - i
        row = lax.dynamic_index_in_dim(rows, k, -2, keepdims=False)
        value = -jnp.sum(row * solution, axis=-1, keepdims=True) / lax.dynamic_slice_in_dim(row, k, 1, -1)
        return lax.dynamic_update_slice_in_dim(solution, value, k, -1)

    # The right side is column p of the triangle, so its factor is -1 throughout.
    start = jnp.zeros(rows.shape[:-2] + rows.shape[-1:]).at[..., p].set(-1.0)
    return lax.fori_loop(0, p, substitute, start)[..., :p]


@_solve.defjvp
def _solve_jvp(primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    (matrix, right), (d_matrix, d_right) = primals, tangents
    solution = _solve(matrix, right)
    change = d_right - (d_matrix @ solution[..., None])[..., 0]
    return solution, (inverse_positive_definite(matrix) @ change[..., None])[..., 0]


def inverse_cholesky(matrix: Square) -> Square:
    """W, lower triangular with W matrix W^T = I: the inverse of the Cholesky factor. It whitens what has this
    covariance."""
    if namespace(matrix) is jnp:
        return _inverse_cholesky(matrix)
    if matrix.ndim > 2 and 0 < matrix.shape[-1] <= _UNROLLED:  # LAPACK takes 1 us for each
        with np.errstate(all="ignore"):
            return _inverse_cholesky_by_entries(matrix)
    try:
        factor = np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(matrix, np.nan)
        return np.stack([inverse_cholesky(part) for part in matrix])
    if matrix.ndim == 2 and len(matrix) > _LARGE:
        from scipy.linalg import get_lapack_funcs

        (inverse_of_triangle,) = get_lapack_funcs(("trtri",), (factor,))
        return np.tril(inverse_of_triangle(factor, lower=True)[0])
    return np.tril(np.linalg.inv(factor))


@jax.custom_jvp
def _inverse_cholesky(matrix: Float[Array, "*batch p p"]) -> Float[Array, "*batch p p"]:
    p = matrix.shape[-1]
    if not p:
        return matrix
    if p <= _UNROLLED:
        return jnp.asarray(_inverse_cholesky_by_entries(matrix))
    identity = jnp.broadcast_to(jnp.eye(p), matrix.shape)
    return jnp.tril(_triangular(jnp.concatenate([matrix, identity], axis=-1))[..., p:])


def _inverse_cholesky_by_entries(matrix: Square) -> Square:
    """The same, entry by entry: for many very small matrices several times as fast as loops over their rows."""
    p, xp = matrix.shape[-1], namespace(matrix)
    factor: list[list[Any]] = []  # rows of the Cholesky factor, left of the diagonal
    inverse: list[list[Any]] = []  # rows of W, up to the diagonal
    for i in range(p):
        row: list[Any] = []
        for k in range(i):
            rest = matrix[..., i, k] - sum(row[j] * factor[k][j] for j in range(k))
            row.append(rest * inverse[k][k])
        pivot = matrix[..., i, i] - sum(value**2 for value in row)
        scale = 1 / np.sqrt(pivot) if xp is np else lax.rsqrt(pivot)
        substituted = [-scale * sum(row[k] * inverse[k][j] for k in range(j, i)) for j in range(i)]
        factor.append(row)
        inverse.append([*substituted, scale])
    zero = xp.zeros(matrix.shape[:-2])
    return xp.stack([xp.stack([*row, *[zero] * (p - len(row))], axis=-1) for row in inverse], axis=-2)


@_inverse_cholesky.defjvp
def _inverse_cholesky_jvp(primals: tuple[Array], tangents: tuple[Any]) -> tuple[Array, Array]:
    # With L = W^-1: dL = L half(W dA W^T), hence dW = -half(W dA W^T) W.
    whitening = _inverse_cholesky(primals[0])
    change = whitening @ tangents[0] @ jnp.swapaxes(whitening, -1, -2)
    half = 0.5 * (jnp.tril(change) + jnp.tril(change, -1))
    return whitening, -half @ whitening


def inverse_positive_definite(matrix: Square) -> Square:
    """Inverse of a symmetric positive definite matrix; NaN where it is not."""
    whitening, p = inverse_cholesky(matrix), matrix.shape[-1]
    if namespace(matrix) is jnp and p <= _UNROLLED:
        return sum((whitening[..., k, :, None] * whitening[..., k, None, :] for k in range(p)), jnp.zeros_like(matrix))
    return namespace(matrix).swapaxes(whitening, -1, -2) @ whitening


def _triangular(augmented: Float[Array, "*batch p m"]) -> Float[Array, "*batch p m"]:
    """``[A B]`` to ``[U L^-1 B]``, where U = L^T and A = L U; below the diagonal of U stand rounding errors.

    Row by row, each with one product of a vector and the rows so far: the loop over rows of batches is what the CPU
    does fastest (as fast as LAPACK at 16 matrices of 20 rows; updates of the whole rest after each row take five times
    as long).
    """

    def row(j: Array, rows: Array) -> Array:
        column = lax.dynamic_index_in_dim(rows, j, -1, keepdims=False)
        fresh = lax.dynamic_index_in_dim(augmented, j, -2, keepdims=False) - (column[..., None, :] @ rows)[..., 0, :]
        fresh = fresh * lax.rsqrt(lax.dynamic_slice_in_dim(fresh, j, 1, -1))
        return lax.dynamic_update_index_in_dim(rows, fresh, j, -2)

    return lax.fori_loop(0, augmented.shape[-2], row, jnp.zeros_like(augmented))


def singular_values(
    matrix: Float[Array, "*batch m p"],
) -> tuple[Float[Array, "*batch m p"], Float[Array, "*batch p"], Float[Array, "*batch p p"]]:
    """U, s, V with matrix = U diag(s) V^T, s in descending order; for m >= p. Not differentiable where values repeat.

    Columns of U that belong to s = 0 are 0. One-sided Jacobi: pairs of columns are rotated until all are orthogonal,
    p/2 disjoint pairs at a time (Hestenes 1958; Demmel and Veselic 1992 for its accuracy, which scaling of columns does
    not spoil).
    """
    height, p = matrix.shape[-2:]
    partners = jnp.asarray(_round_robin(p))
    order = jnp.arange(p)

    def rotate(step: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        stacked, largest_cosine = state
        partner = partners[step]
        other = stacked[..., partner]
        columns = stacked[..., :height, :]
        norm = jnp.sqrt(jnp.sum(columns**2, axis=-2))
        norm = jnp.where(norm > 0, norm, 1.0)
        # Divided by one norm after the other: the product of two squares may underflow.
        cosine = jnp.sum(columns * other[..., :height, :], axis=-2) / norm / norm[..., partner]
        alone, before = (jnp.broadcast_to(mask, norm.shape) for mask in (partner == order, order < partner))
        cosine = jnp.where(alone, 0.0, cosine)
        rotated = jnp.abs(cosine) > 0.5 * _EPSILON
        ratio = norm[..., partner] / norm
        cotangent = (ratio - 1 / ratio) / (2 * jnp.where(rotated, cosine, 1.0))  # of twice the angle
        sign = jnp.where((cotangent > 0) | ((cotangent == 0) & before), 1.0, -1.0)
        tangent = jnp.where(rotated, sign / (jnp.abs(cotangent) + jnp.hypot(1.0, cotangent)), 0.0)
        stacked = lax.rsqrt(1 + tangent**2)[..., None, :] * (stacked - tangent[..., None, :] * other)
        return stacked, jnp.maximum(largest_cosine, jnp.max(jnp.abs(cosine), axis=-1))

    def sweep(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, stacked, _ = state
        return count + 1, *lax.fori_loop(0, len(partners), rotate, (stacked, jnp.zeros(matrix.shape[:-2])))

    def more(state: tuple[Array, Array, Array]) -> Array:
        count, _, largest_cosine = state
        return (count < _MAX_SWEEPS) & jnp.any(largest_cosine > p * _EPSILON)

    identity = jnp.broadcast_to(jnp.eye(p), (*matrix.shape[:-2], p, p))
    start = jnp.concatenate([matrix, identity], axis=-2)
    _, stacked, _ = lax.while_loop(more, sweep, (jnp.zeros((), dtype=jnp.int32), start, jnp.ones(matrix.shape[:-2])))
    values = jnp.linalg.norm(stacked[..., :height, :], axis=-2)
    descending = jnp.argsort(-values, axis=-1)
    values = jnp.take_along_axis(values, descending, axis=-1)
    stacked = jnp.take_along_axis(stacked, descending[..., None, :], axis=-1)
    left = stacked[..., :height, :] / jnp.where(values > 0, values, 1.0)[..., None, :]
    return left, values, stacked[..., height:, :]


def semidefinite_eigen(matrix: Square) -> tuple[Rows, Square]:
    """Eigenvalues in descending order and eigenvectors (columns) of a symmetric positive semidefinite matrix.

    Its singular values are its eigenvalues. No derivative passes: that of an eigenvector is infinite where values
    repeat.
    """
    if namespace(matrix) is np:
        values, vectors = np.linalg.eigh(matrix) if np.isfinite(matrix).all() else (matrix[..., 0], matrix)
        return values[..., ::-1], vectors[..., ::-1]
    _, values, vectors = singular_values(lax.stop_gradient(jnp.asarray(matrix)))
    return values, vectors


def independent_columns(
    columns: Float[np.ndarray, "r p"], least: Float[np.ndarray, " p"], basis: Float[np.ndarray, "r b"] | None = None
) -> list[int]:
    """The columns of which more than ``least`` is left once those before them, and a basis, have imitated them."""
    basis, chosen = np.zeros((len(columns), 0)) if basis is None else basis, []
    for i, rest in enumerate(columns.T):
        for _ in range(2):  # Gram-Schmidt; twice is enough for orthogonality to rounding (Giraud et al. 2005)
            rest = rest - basis @ (basis.T @ rest)
        size = np.linalg.norm(rest)
        if size > least[i] and basis.shape[1] < len(columns):
            chosen.append(i)
            basis = np.hstack([basis, rest[:, None] / size])
    return chosen


def _round_robin(p: int) -> np.ndarray:
    """The partner of each column in each round of a tournament in which every pair meets once; a column alone meets
    itself."""
    even = p + p % 2
    seats = list(range(even))
    rounds = np.tile(np.arange(even), (even - 1, 1))
    for row in rounds:
        for a, b in zip(seats[: even // 2], reversed(seats[even // 2 :]), strict=True):
            row[a], row[b] = b, a
        seats[1:] = [seats[-1], *seats[1:-1]]
    if p % 2:
        rounds = np.where(rounds == p, np.arange(even), rounds)
    return rounds[:, :p]
