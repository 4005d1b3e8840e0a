"""Many residuals of a pose as fewer rows that say the same.

The residuals y of a pose (corners of an image) depend on few numbers: the pose itself, three of position and three of
rotation, and what is unknown of the instrument. With the derivatives A by these n numbers (a column each), y over the
standard deviations, and Q an orthonormal basis of the columns of A, the rows Q^T y have the same derivatives A^T y of
half the sum of squares, and the same information A^T A. What is left, |y - Q Q^T y|, is one more row, whose derivative
is 0, so that the sum of squares is the same too. The rows are those of the Cholesky factor of the products of (A y).

The arm's own errors move the pose and nothing else, so that they reach the first rows of Q^T y alone. A least squares
keeps weights while its unknowns move, and so Q of the weights must stay too: the weights W of Q^T y are applied as
y + Q (W - I) Q^T y before the reduction.
"""

import numpy as np
from jaxtyping import Float

from ...core.linear_algebra import inverse_cholesky
from ...core.numpy_or_jax import AnyArray, namespace
from .observation import Rows

MOVED = 6  # rows that errors of the arm reach: the first ones, since the derivatives by the pose come first
_RIDGE = 1e-13  # of scaled products: a column that others imitate to better than its root adds nothing


def reduced_rows(
    rows: Rows,
    weight: Float[AnyArray, "m s"],
    own: tuple[str, ...],
    shift: Float[AnyArray, "r m"] | None = None,
    weights: tuple[Float[AnyArray, "m s n"], Float[AnyArray, "m r r"]] | None = None,
) -> Rows:
    """Rows of n + 1 numbers a pose, of rows of s.

    Args:
        rows: The residuals, all of which depend on the tip, its rotation and the unknowns ``own`` of the instrument;
            all other unknowns move the target as the tip and the rotation do.
        weight: One over the standard deviation of each residual; 0 of one that is absent.
        own: Names of these unknowns.
        shift: Errors that are added to reduced rows.
        weights: Basis and inverse Cholesky factor of the covariance of reduced rows, by which these are then whitened;
            without them they are in the unit of the residuals, with the variance ``measured``.
    """
    assert rows.by_rotation is not None
    xp = namespace(rows.values, weight)
    columns = [xp.moveaxis(rows.by_tip, 1, 0), xp.moveaxis(rows.by_rotation, 1, 0)]
    columns += [rows.by_unknowns[name] for name in own]
    others = {name: by for name, by in rows.by_unknowns.items() if name not in own}
    n = sum(len(column) for column in columns)
    whole = xp.concatenate([*columns, *others.values(), rows.values[None]])
    whole = xp.transpose(whole, (2, 1, 0)) * weight[:, :, None]  # (m, s, all)
    # The usual standard deviation of a pose's residuals, so that rows have their unit.
    known = xp.where(weight > 0, 1.0, 0.0)
    spread = xp.sqrt(xp.sum(known / xp.where(weight > 0, weight, 1.0) ** 2, axis=1) / xp.sum(known, axis=1))
    if weights is not None:
        basis, root = weights
        change = root[:, :n, :n] * spread[:, None, None] - xp.asarray(np.eye(n))[None]
        along = xp.swapaxes(basis, 1, 2) @ whole
        if shift is not None:
            errors = xp.moveaxis(shift[:n], 0, 1) / spread[:, None]
            zero = xp.zeros((*errors.shape, whole.shape[2] - 1))
            added = xp.concatenate([zero, errors[:, :, None]], axis=2)
            whole, along = whole + basis @ added, along + added
        whole = whole + basis @ (change @ along)
    first = whole[:, :, :n]
    products = xp.swapaxes(first, 1, 2) @ whole
    sizes = xp.sqrt(xp.einsum("mii->mi", products[:, :, :n])) + 1e-300
    scaled = products[:, :, :n] / (sizes[:, :, None] * sizes[:, None, :]) + _RIDGE * xp.asarray(np.eye(n))[None]
    inverse = inverse_cholesky(scaled) / sizes[:, None, :]
    combined = inverse @ products  # (m, n, all)
    square = xp.sum(whole[:, :, -1] ** 2, axis=1) - xp.sum(combined[:, :, -1] ** 2, axis=1)
    left = xp.sqrt(xp.maximum(square, 1e-20))
    bottom = xp.concatenate([xp.zeros((len(left), 1, whole.shape[2] - 1)), left[:, None, None]], axis=2)
    reduced = xp.concatenate([combined, bottom], axis=1)
    if weights is None:
        reduced = reduced * spread[:, None, None]
        if shift is not None:
            reduced = xp.concatenate([reduced[:, :, :-1], reduced[:, :, -1:] + xp.moveaxis(shift, 0, 1)[..., None]], 2)
    reduced = xp.transpose(reduced, (2, 1, 0))  # (all, n + 1, m)
    ends = np.cumsum([len(column) for column in (*columns, *others.values())]).tolist()
    parts = [reduced[end - len(column) : end] for end, column in zip(ends, (*columns, *others.values()), strict=True)]
    variance = (spread**2)[:, None, None] if weights is None else xp.ones((len(left), 1, 1))
    return Rows(
        values=reduced[-1],
        by_tip=xp.swapaxes(parts[0], 0, 1),
        by_rotation=xp.swapaxes(parts[1], 0, 1),
        by_unknowns=dict(zip((*own, *others), parts[2:], strict=True)),
        measured=variance * xp.asarray(np.eye(n + 1))[None],
        basis=first @ xp.swapaxes(inverse, 1, 2) if weights is None else None,
    )
