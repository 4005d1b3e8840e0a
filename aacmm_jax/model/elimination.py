"""Normal equations in arrow form, and rows from which the private geometry is eliminated.

Let w be whitened rows, A their derivatives by the head x (parameters and shared geometry), and B those by the numbers y
of a component, with a row of A and B for each unknown. The normal equations of 1/2 |w + A^T dx + B^T dy|^2 are
    [A A^T  C^T] [dx]     [A w]
    [C      D  ] [dy] = - [B w]        with D = B B^T and C = B A^T.
For a given head the component is at dy = -D^-1 (B w + C dx). So the rows depend on
the head as A~ = A - C^T D^-1 B, the eliminated derivatives, and their information sum A~ A~^T is the Schur complement
A A^T - C^T D^-1 C of the arrow.

A socket is the case in which B is minus the identity: D is the number m of its poses, so dy is the mean of the
residuals, and the sum over its poses of squared distances from their centroid is what stage 1 minimises.
"""

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.linear_algebra import (
    inverse_cholesky,
    inverse_positive_definite,
    semidefinite_eigen,
)
from ..core.numpy_or_jax import AnyArray, added_to, namespace
from ..data.observations.observation import Rows
from ..kinematics.parameters import Parameters
from ..solver.active_set import QuadraticModel
from ..solver.arrow import Arrow, joined
from .layout import Group
from .observed import Observed
from .robust import Loss
from .rows import PointRows, PriorRows, RowBlock, Whitening, row_blocks, rows_at
from .sockets import counts, means_over_sockets, owner_of, sums_over_sockets, to_poses

_LONG = 40  # poses of a component, from which a product of matrices each is the fastest sum over them
_NULL = 1e-12  # eigenvalues of a component's information below this, of the largest, are zero


class Args(NamedTuple):
    """What a least squares is of besides its unknowns."""

    space: Parameters
    observed: Observed
    whitening: Whitening
    loss: Loss | None = None
    # Where it is given, the components whose rows are linear in them (`Layout.linear`) are no unknowns of the solve:
    # for each head they are where they fit best. These are numbers, at the end of all, that residuals are counted from.
    linear: Float[AnyArray, " l"] | None = None
    # True where it is evaluated in the way that is fastest in a batch, and not differentiated. None otherwise: a traced
    # program would trace False as well.
    batch: bool | None = None

    @property
    def eliminated(self) -> int:
        """How many classes of components the solve has no unknowns of."""
        return 0 if self.linear is None else self.observed.layout.linear


def sums_by_component(
    first: Float[AnyArray, "k r m"], second: Float[AnyArray, "h r m"], sizes: tuple[int, ...]
) -> Float[AnyArray, "K k h"]:
    """Products of both, summed over the rows of each component."""
    xp, count = namespace(first, second), len(sizes)
    if not (count and first.shape[0] and second.shape[0]):  # no component, or nothing but components is free
        return xp.zeros((count, first.shape[0], second.shape[0]))
    if len(set(sizes)) == 1 and (xp is not np or sizes[0] >= _LONG):
        split = (part.reshape(*part.shape[:2], count, -1) for part in (first, second))
        left, right = (xp.moveaxis(part, 2, 0).reshape(count, part.shape[0], -1) for part in split)
        return left @ xp.swapaxes(right, -1, -2)
    if sum(sizes) >= _LONG * count:
        return xp.stack([flat(first[..., poses]) @ flat(second[..., poses]).T for poses in _slices(sizes)])
    products: Any = sum(first[:, None, r] * second[None, :, r] for r in range(first.shape[1]))
    return xp.moveaxis(sums_over_sockets(products, sizes), -1, 0)


def _slices(sizes: tuple[int, ...]) -> list[slice]:
    return [slice(first, end) for first, end in itertools.pairwise(np.cumsum([0, *sizes]).tolist())]


def followed(
    by_own: Float[AnyArray, "k r m"], matrices: Float[AnyArray, "K k h"], sizes: tuple[int, ...]
) -> Float[AnyArray, "h r m"]:
    """The rows by numbers of their component, times a matrix of each component."""
    xp, (k, r, _) = namespace(by_own, matrices), by_own.shape
    if sum(sizes) >= _LONG * len(sizes):
        products = [matrix.T @ flat(by_own[..., poses]) for matrix, poses in zip(matrices, _slices(sizes), strict=True)]
        pieces = [product.reshape(len(product), r, product.shape[1] // r) for product in products]
        return pieces[0] if len(pieces) == 1 else xp.concatenate(pieces, axis=-1)
    owner = owner_of(sizes)
    total: Any = 0.0
    for i in range(k):
        total = total + xp.moveaxis(matrices[owner, i], 0, -1)[:, None] * by_own[i][None]
    return total


def flat(rows: Float[AnyArray, "k r m"]) -> Float[AnyArray, "k _"]:
    """A row for each unknown, over all rows of all poses."""
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2])


def weighted(block: RowBlock, weight: Float[AnyArray, " m"] | None) -> RowBlock:
    """The rows times the square roots of weights of their poses."""
    if weight is None:
        return block
    root = namespace(weight).sqrt(weight)[None]
    by_head, by_own = (None if by is None else by * root[None] for by in (block.by_head, block.by_own))
    return RowBlock(block.white * root, by_head, by_own, block.class_index, block.sizes, block.counts)


def _curved(block: RowBlock, along: Float[AnyArray, " m"]) -> RowBlock:
    """Rows whose products have the curvature of a robust loss (`Loss.along`) and the gradient of these."""
    xp = namespace(block.white)
    size = xp.sqrt(xp.sum(block.white**2, axis=0))  # differentiated nowhere, so 0 needs no care (and seeds rest on it)
    direction = block.white / xp.where(size > 0, size, 1.0)[None]
    changed = []
    for by in (block.by_head, block.by_own):
        if by is not None:
            # (1 - (1 - along) u u^T) A, with the direction u of the residual.
            by = by - ((1 - along)[None] * xp.sum(direction[None] * by, axis=1))[:, None] * direction[None]
        changed.append(by)
    by_head, by_own = changed
    return RowBlock(block.white / along[None], by_head, by_own, block.class_index, block.sizes)


def cost_and_weights(
    blocks: list[RowBlock], loss: Loss | None, groups: int
) -> tuple[AnyArray, list[Float[AnyArray, " _"] | None]]:
    """Half the weighted sum of squares, and the weight of every pose; the first ``groups`` blocks are of poses."""
    total: Any = 0.0
    weights: list[Any] = []
    for number, block in enumerate(blocks):
        if loss is None or number >= groups:
            total, weight = total + 0.5 * namespace(block.white).sum(block.white**2), None
        else:
            costs, weight = loss.cost_and_weight(block.white, block.counts)
            total = total + namespace(costs).sum(costs)
        weights.append(weight)
    return total, weights


def arrow_of(
    blocks: list[RowBlock], classes: tuple[tuple[int, int], ...], height: int, prior: PriorRows | None
) -> tuple[Arrow, list[AnyArray]]:
    """The information of rows with their weights, and of each class of components its part of the gradient; ``height``
    is the number of unknowns of the head."""
    xp = namespace([block.white for block in blocks])
    heads = [flat(block.by_head) for block in blocks if block.by_head is not None]
    whole = heads[0] if len(heads) == 1 else xp.concatenate(heads, axis=1)
    head = whole @ whole.T  # A A^T, over the rows of all blocks
    if prior is not None:
        diagonal = np.arange(prior.weight.shape[0])
        head = added_to(head, (diagonal, diagonal), prior.weight**2)
    crossed, squares, slopes = [], [], []
    for number, (count, size) in enumerate(classes):
        # C = B A^T, D = B B^T and the gradient B w, summed over the blocks with components of this class.
        c, d, g = xp.zeros((count, size, height)), xp.zeros((count, size, size)), xp.zeros((count, size))
        for block in blocks:
            if block.class_index != number:
                continue
            if block.by_own is None:
                # Coordinates less those of their point: B is minus the identity at every pose, so that these are sums
                # over the poses of a socket.
                assert block.by_head is not None
                c = c - xp.moveaxis(sums_over_sockets(block.by_head, block.sizes), (0, 1, 2), (2, 1, 0))
                d = d + np.asarray(block.sizes, dtype=float)[:, None, None] * np.eye(block.white.shape[0])
                g = g - sums_over_sockets(block.white, block.sizes).T
                continue
            if block.by_head is not None:
                c = c + sums_by_component(block.by_own, block.by_head, block.sizes)
            both = xp.concatenate([block.by_own, block.white[None]])
            sums = sums_by_component(block.by_own, both, block.sizes)
            d, g = d + sums[..., :-1], g + sums[..., -1]
        crossed.append(c)
        squares.append(d)
        slopes.append(g)
    return Arrow(head, tuple(crossed), tuple(squares)), slopes


def _shifts(block: RowBlock) -> Float[AnyArray, "h _"]:
    """What components that follow the head take from its information: a product of this with its transpose."""
    assert block.by_head is not None
    height, xp = block.by_head.shape[0], namespace(block.by_head)
    if block.by_own is None:
        # D = m: the outer product of the sum of the rows' derivatives, over m.
        shifts = sums_over_sockets(block.by_head, block.sizes) / np.sqrt(counts(block.sizes, 3))
        return shifts.reshape(height, math.prod(shifts.shape[1:]))  # without parameters: nothing, by so many
    sums = sums_by_component(block.by_own, xp.concatenate([block.by_own, block.by_head]), block.sizes)
    size = block.by_own.shape[0]
    # With D = L L^T: C^T D^-1 C = (L^-1 C)^T (L^-1 C).
    shifts = xp.moveaxis(inverse_cholesky(sums[..., :size]) @ sums[..., size:], -1, 0)
    return shifts.reshape(height, math.prod(shifts.shape[1:]))


def _fitted(block: RowBlock) -> RowBlock:
    """With the component where it fits these residuals best."""
    xp, white = namespace(block.white), block.white
    # Twice: the rounding error that one pass leaves in a mean (1e-13 mm) would otherwise be multiplied by the sums of
    # the derivatives, and exceed the gradient near a perfect fit.
    for _ in range(2):
        if block.by_own is None:
            white = white - to_poses(means_over_sockets(white, block.sizes), block.sizes)
        else:
            sums = sums_by_component(block.by_own, xp.concatenate([block.by_own, white[None]]), block.sizes)
            # w - B^T D^-1 B w: the projection onto what the component cannot follow.
            step = inverse_positive_definite(sums[..., :-1]) @ sums[..., -1:]
            white = white - followed(block.by_own, step, block.sizes)[0]
    return RowBlock(white, block.by_head, block.by_own, block.class_index, block.sizes)


def _blocks(z: Float[AnyArray, " z"], args: Args) -> list[RowBlock]:
    """The rows at a point; those of components without unknowns are where these fit best."""
    space, observed, whitening, _, linear, batch = args
    whole = z if linear is None else namespace(z, linear).concatenate([z, linear])
    point = rows_at(space, observed, whole, batch is not None, bool(whitening.bases))
    blocks = row_blocks(space, observed, whole, point, whitening)
    first = len(observed.layout.classes) - args.eliminated
    return [_fitted(block) if block.class_index >= first else block for block in blocks]


def observed_model(z: Float[AnyArray, " z"], args: Args, *, curved: bool = True) -> QuadraticModel:
    """Cost and gradient of `observed_rows`, and their information: with a robust loss the curvature of the cost, as far
    as it is positive, or that of the weighted rows where it is not to be ``curved``."""
    layout, p, prior = args.observed.layout, len(args.space.names), args.whitening.prior
    plain = _blocks(z, args)
    cost, weights = cost_and_weights(plain, args.loss, len(layout.groups))
    blocks = [weighted(block, weight) for block, weight in zip(plain, weights, strict=True)]
    if args.loss is not None and curved:
        for number in range(len(layout.groups)):
            blocks[number] = _curved(blocks[number], args.loss.along(plain[number].white, plain[number].counts))
    kept = len(layout.classes) - args.eliminated
    arrow, slopes = arrow_of(blocks, layout.classes[:kept], p + layout.shared, prior)
    xp = namespace(arrow)
    # Residuals of components without unknowns are at right angles to these.
    slope: Any = sum(
        (flat(block.by_head) @ block.white.reshape(-1) for block in blocks if block.by_head is not None),
        xp.zeros(p + layout.shared),
    )
    if prior is not None:
        residual = prior.residual(z)
        cost = cost + 0.5 * xp.sum(residual**2)
        slope = added_to(slope, np.arange(p), prior.weight * residual)
    head = arrow.head
    for block in blocks[: len(layout.groups)]:
        if block.class_index >= kept:
            shifts = _shifts(block)
            head = head - shifts @ shifts.T
    return QuadraticModel(cost, joined(slope, *slopes), arrow._replace(head=head))


def observed_rows(z: Float[AnyArray, " z"], args: Args) -> tuple[AnyArray, ...]:
    """Whitened residuals of observations, lengths, certified values and the prior: half their squares are minimised."""
    blocks, prior = _blocks(z, args), args.whitening.prior
    rows = [block.white for block in blocks]
    if args.loss is not None:
        for number in range(len(args.observed.layout.groups)):
            rows[number] = args.loss.transformed(rows[number], blocks[number].counts)
    return tuple(rows) if prior is None else (*rows, prior.residual(z))


def with_linear_geometry(z: Float[AnyArray, " n"], args: Args) -> tuple[Float[AnyArray, " z"], PointRows]:
    """All unknowns, with the components that the solve has no unknowns of where they fit best; and the rows there."""
    space, observed, whitening, _, linear, batch = args
    if linear is None:
        return z, rows_at(space, observed, z)
    xp, layout = namespace(z, linear), observed.layout
    whole = xp.concatenate([z, linear])
    first = len(layout.classes) - layout.linear
    fitted = [xp.zeros(shape) for shape in layout.classes[first:]]
    point = rows_at(space, observed, whole, batch is not None)
    rows_of_groups = list(point.rows)
    for number, (group, root) in enumerate(zip(layout.groups, whitening.roots, strict=True)):
        if group.class_index >= first:
            rows = point.rows[number]
            fitted[group.class_index - first] = shift = _of_rows(rows, root, group)[1]
            rows_of_groups[number] = rows._replace(values=rows.values - to_poses(shift.T, group.sizes))
    return xp.concatenate([z, linear + joined(xp.zeros(0), *fitted)]), point._replace(rows=rows_of_groups)


def _of_rows(
    rows: Rows, root: Float[AnyArray, "m 3 3"] | None, group: Group
) -> tuple[Float[AnyArray, "K 3 3"], Float[AnyArray, "K 3"]]:
    """Information on positions from tips less positions, and what these lack: a weighted mean of the residuals."""
    xp = namespace(rows.values)
    if root is None:
        number = np.asarray(group.sizes, dtype=float)[:, None, None]
        return xp.asarray(number * np.eye(3)), means_over_sockets(rows.values, group.sizes).T
    weight = xp.moveaxis(xp.swapaxes(root, -1, -2) @ root, 0, -1)
    right = sums_over_sockets(xp.einsum("abm,bm->am", weight, rows.values), group.sizes).T
    information = xp.moveaxis(sums_over_sockets(weight, group.sizes), -1, 0)
    return information, (inverse_positive_definite(information) @ right[..., None])[..., 0]


def own_covariances(observed: Observed, point: PointRows, whitening: Whitening) -> list[Float[AnyArray, "_ 3 3"]]:
    """Covariances of the positions of sockets by a given arm, as entries of a list of all classes."""
    layout = observed.layout
    covariances: list[Any] = [namespace(whitening).zeros((0, 3, 3))] * len(layout.classes)
    for group, stack, rows, root in zip(layout.groups, observed.stacks, point.rows, whitening.roots, strict=True):
        if group.class_index >= 0 and stack.linear:
            covariances[group.class_index] = inverse_positive_definite(_of_rows(rows, root, group)[0])
    return covariances


def reduced(arrow: Arrow, gradient: Float[AnyArray, " z"]) -> tuple[Float[AnyArray, "h h"], Float[AnyArray, " h"]]:
    """Information and gradient of the head, with the components eliminated."""
    xp = namespace(arrow, gradient)
    # A A^T - C^T D^-1 C, and the slope of the cost where the components follow the head.
    head, (slope, parts) = arrow.head, arrow.split(gradient)
    for crossed, information, part in zip(arrow.crossed, arrow.private, parts, strict=True):
        follow = pseudo_inverse(information) @ crossed
        head = head - xp.einsum("Kkh,Kkg->hg", crossed, follow)
        slope = slope - xp.einsum("Kkh,Kk->h", follow, part)
    return head, slope


def pseudo_inverse(matrices: Float[AnyArray, "K k k"]) -> Float[AnyArray, "K k k"]:
    """Inverses on the directions that are determined, 0 on the others."""
    xp, size = namespace(matrices), matrices.shape[-1]
    if xp is np:
        finite = np.all(np.isfinite(matrices), axis=(1, 2), keepdims=True)  # LAPACK raises where one of them is not
        values, vectors = np.linalg.eigh(np.where(finite, matrices, 0.0))
        large = values > _NULL * np.maximum(values[:, -1:], 1e-300)
        inverses = np.where(large, 1 / np.where(large, values, 1.0), 0.0)[:, None]
        return np.where(finite, vectors * inverses @ vectors.swapaxes(-1, -2), np.nan)
    # Only a basis comes from the eigenvectors: their derivative is infinite where eigenvalues repeat.
    values, vectors = semidefinite_eigen(matrices)
    large = values > _NULL * values[:, :1]
    seen = xp.where(large[:, None, :], vectors, 0.0)
    transposed = xp.swapaxes(seen, -1, -2)
    inner = transposed @ matrices @ seen + xp.where(large, 0.0, 1.0)[..., None] * np.eye(size)[None]
    return seen @ inverse_positive_definite(inner) @ transposed
