"""Normal equations in arrow form, and rows from which the private geometry is eliminated.

With A the derivatives of whitened rows w by the head (parameters and shared geometry) and B those by the numbers of a
component, the least squares for a given head has the component at -D^-1 (B w + C dx), where D = B B^T and C = B A^T. So
the rows depend on the head as A~ = A - C^T D^-1 B, the eliminated derivatives, and their information is
sum A~ A~^T, the Schur complement of the arrow.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import inverse_positive_definite, semidefinite_eigen
from ..core.numpy_or_jax import AnyArray, added_to, namespace
from ..kinematics.parameters import Parameters
from ..solver.active_set import QuadraticModel
from ..solver.arrow import Arrow, joined
from .observed import Observed
from .robust import Loss
from .rows import PriorRows, RowBlock, Whitening, relation_residuals, row_blocks, rows_at

_LONG = 40  # poses of a component, from which a product of matrices each is the fastest sum over them
_NULL = 1e-12  # eigenvalues of a component's information below this, of the largest, are zero

Args = tuple[Parameters, Observed, Whitening, Loss | None]


def sums_by_component(
    one: Float[AnyArray, "k r m"], other: Float[AnyArray, "h r m"], sizes: tuple[int, ...]
) -> Float[AnyArray, "K k h"]:
    """Products of both, summed over the rows of each component."""
    xp, count = namespace(one, other), len(sizes)
    if not count:
        return xp.zeros((0, one.shape[0], other.shape[0]))
    if len(set(sizes)) == 1 and (xp is not np or sizes[0] >= _LONG):
        first, second = (_by_component(part, count) for part in (one, other))
        return first @ xp.swapaxes(second, -1, -2)
    if sum(sizes) >= _LONG * count:
        ends = np.cumsum(sizes)
        pieces = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        return xp.stack([_flat(one[..., of]) @ _flat(other[..., of]).T for of in pieces])
    products = sum(one[:, None, r] * other[None, :, r] for r in range(one.shape[1]))
    return xp.moveaxis(_summed(products, sizes), -1, 0)


def _by_component(rows: Float[AnyArray, "k r m"], count: int) -> Float[AnyArray, "K k _"]:
    """Rows of components with as many poses each, component by component."""
    k, r, m = rows.shape
    split = namespace(rows).moveaxis(rows.reshape(k, r, count, m // count), 2, 0)
    return split.reshape(count, k, -1)


def _summed(values: Float[AnyArray, "... m"], sizes: tuple[int, ...]) -> Float[AnyArray, "... K"]:
    """Sums over the poses of each component, of which some may have none."""
    some = [size for size in sizes if size]
    xp = namespace(values)
    if xp is np:
        sums = np.add.reduceat(values, np.concatenate([[0], np.cumsum(some)[:-1]]), axis=-1)
    else:
        owner = np.repeat(np.arange(len(some)), some)
        sums = values @ xp.asarray((owner[:, None] == np.arange(len(some))[None, :]).astype(float))
    if len(some) == len(sizes):
        return sums
    whole = xp.zeros((*values.shape[:-1], len(sizes)))
    return added_to(whole, (..., np.flatnonzero(sizes)), sums)


def followed(
    by_own: Float[AnyArray, "k r m"], each: Float[AnyArray, "K k h"], sizes: tuple[int, ...]
) -> Float[AnyArray, "h r m"]:
    """The rows by numbers of their component, times a matrix of each component."""
    xp, k = namespace(by_own, each), by_own.shape[0]
    if sum(sizes) >= _LONG * len(sizes):
        ends, r = np.cumsum(sizes), by_own.shape[1]
        pieces = [
            (each[i].T @ _flat(by_own[..., end - size : end])).reshape(-1, r, size)
            for i, (end, size) in enumerate(zip(ends, sizes, strict=True))
        ]
        return pieces[0] if len(pieces) == 1 else xp.concatenate(pieces, axis=-1)
    owner = np.repeat(np.arange(len(sizes)), sizes)
    total: Any = 0.0
    for i in range(k):
        mine = xp.moveaxis(each[:, i], 0, -1)  # (h, K)
        mine = np.repeat(mine, sizes, axis=-1) if xp is np else mine[:, owner]
        total = total + mine[:, None] * by_own[i][None]
    return total


def _flat(rows: Float[AnyArray, "k r m"]) -> Float[AnyArray, "k _"]:
    return rows.reshape(rows.shape[0], -1)


def weighted(block: RowBlock, weight: Float[AnyArray, " m"] | None) -> RowBlock:
    """The rows times the square roots of weights of their poses."""
    if weight is None:
        return block
    root = namespace(weight).sqrt(weight)
    return RowBlock(
        block.white * root,
        None if block.by_head is None else block.by_head * root,
        None if block.by_own is None else block.by_own * root,
        block.of,
        block.sizes,
    )


def cost_and_weights(
    blocks: list[RowBlock], loss: Loss | None, groups: int
) -> tuple[AnyArray, list[Float[AnyArray, " m"] | None]]:
    """Half the weighted sum of squares, and the weight of every pose; the first ``groups`` blocks are of poses."""
    total: Any = 0.0
    weights: list[Any] = []
    for number, block in enumerate(blocks):
        if loss is None or number >= groups:
            total, weight = total + 0.5 * namespace(block.white).sum(block.white**2), None
        else:
            each, weight = loss.cost_and_weight(block.white)
            total = total + namespace(each).sum(each)
        weights.append(weight)
    return total, weights


def arrow_of(
    blocks: list[RowBlock], classes: tuple[tuple[int, int], ...], height: int, prior: PriorRows | None
) -> tuple[Arrow, list[tuple[AnyArray, AnyArray]]]:
    """The information of rows with their weights; and of each class of components, its part of the gradient.

    ``height`` is the number of unknowns of the head.
    """
    xp = namespace([block.white for block in blocks])
    heads = [_flat(block.by_head) for block in blocks if block.by_head is not None]
    whole = heads[0] if len(heads) == 1 else xp.concatenate(heads, axis=1)
    head = whole @ whole.T
    if prior is not None:
        own = np.arange(prior.weight.shape[0])
        head = added_to(head, (own, own), prior.weight**2)
    crossed, own, slopes = [], [], []
    for number, (count, size) in enumerate(classes):
        c, d, g = xp.zeros((count, size, height)), xp.zeros((count, size, size)), xp.zeros((count, size))
        for block in blocks:
            if block.of != number:
                continue
            assert block.by_own is not None
            if block.by_head is not None:
                c = c + sums_by_component(block.by_own, block.by_head, block.sizes)
            both = xp.concatenate([block.by_own, block.white[None]])
            sums = sums_by_component(block.by_own, both, block.sizes)
            d, g = d + sums[..., :-1], g + sums[..., -1]
        crossed.append(c)
        own.append(d)
        slopes.append(g)
    return Arrow(head, tuple(crossed), tuple(own)), slopes


def observed_model(z: Float[AnyArray, " z"], args: Args) -> QuadraticModel:
    """Cost, gradient and information of `observed_rows`."""
    space, observed, whitening, loss = args
    layout, p = observed.layout, len(space.names)
    blocks = row_blocks(space, observed, z, rows_at(space, observed, z), whitening)
    cost, weights = cost_and_weights(blocks, loss, len(layout.groups))
    blocks = [weighted(block, weight) for block, weight in zip(blocks, weights, strict=True)]
    arrow, slopes = arrow_of(blocks, layout.classes, p + layout.shared, whitening.prior)
    xp = namespace(arrow)
    slope: Any = sum(
        (_flat(block.by_head) @ block.white.reshape(-1) for block in blocks if block.by_head is not None),
        xp.zeros(p + layout.shared),
    )
    if whitening.prior is not None:
        residual = whitening.prior.residual(z)
        cost = cost + 0.5 * xp.sum(residual**2)
        slope = added_to(slope, np.arange(p), whitening.prior.weight * residual)
    return QuadraticModel(cost, joined(slope, *slopes), arrow)


def observed_rows(z: Float[AnyArray, " z"], args: Args) -> tuple[AnyArray, ...]:
    """Whitened residuals of observations, lengths, certified values and the prior; half their sum of squares is what
    is minimised."""
    space, observed, whitening, loss = args
    found = []
    for rows, root in zip(rows_at(space, observed, z).rows, whitening.roots, strict=True):
        white = namespace(rows.values, root).einsum("mab,bm->am", root, rows.values)
        found.append(white if loss is None else loss.transformed(white))
    length, certified = relation_residuals(observed, observed.split(z[len(space.names) :]), whitening)
    prior = () if whitening.prior is None else (whitening.prior.residual(z),)
    return (*found, length, *certified.values(), *prior)


def reduced(arrow: Arrow, gradient: Float[AnyArray, " z"]) -> tuple[Float[AnyArray, "h h"], Float[AnyArray, " h"]]:
    """Information and gradient of the head, with the components eliminated."""
    xp = namespace(arrow, gradient)
    slope, parts = arrow.split(gradient)
    head = arrow.head
    for crossed, own, part in zip(arrow.crossed, arrow.own, parts, strict=True):
        inverse = pseudo_inverse(own)
        follow = inverse @ crossed
        head = head - xp.einsum("Kkh,Kkg->hg", crossed, follow)
        slope = slope - xp.einsum("Kkh,Kk->h", follow, part)
    return head, slope


def pseudo_inverse(matrices: Float[AnyArray, "K k k"]) -> Float[AnyArray, "K k k"]:
    """Inverses on the directions that are determined, 0 on the others."""
    xp, size = namespace(matrices), matrices.shape[-1]
    if xp is np:
        values, vectors = np.linalg.eigh(matrices)
        known = values > _NULL * np.maximum(values[:, -1:], 1e-300)
        return (vectors * np.where(known, 1 / np.where(known, values, 1.0), 0.0)[:, None]) @ vectors.swapaxes(-1, -2)
    # Only a basis comes from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(matrices)
    known = values > _NULL * values[:, :1]
    seen = xp.where(known[:, None, :], vectors, 0.0)
    transposed = xp.swapaxes(seen, -1, -2)
    inner = transposed @ matrices @ seen + xp.where(known, 0.0, 1.0)[..., None] * np.eye(size)
    return seen @ inverse_positive_definite(inner) @ transposed
