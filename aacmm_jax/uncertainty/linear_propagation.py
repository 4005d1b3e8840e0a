"""Covariance of a problem's unknowns, by the law of propagation (JCGM 100).

Rows are whitened residuals w = R e of the errors e: of the readings and of the seat, which reach them through the arm,
and of what was measured. The head of the unknowns (parameters and shared geometry) follows them as dx = -G A W w, with
A the eliminated derivatives, W the weights of a robust loss and 1/G the information; a component of private geometry as
-D^-1 (B W w + C dx).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import AnyArray, added_to, namespace
from ..data.noise import Noise
from ..data.observations.observation import Rows
from ..model.elimination import arrow_of, followed, pseudo_inverse, sums_by_component, weighted
from ..model.rows import PriorRows, RowBlock, Whitening
from .covariance import inverse_information
from .tip_errors import ArmErrors, products

_LEAST_REDUNDANCY = 0.05  # determinant of a pose's part of the residuals' projector


class UnknownsCovariance(NamedTuple):
    """Covariance of the head, and of the numbers of each component, natural steps."""

    head: Float[AnyArray, "h h"]
    components: list[Float[AnyArray, "_ _ _"]]


class Influence(NamedTuple):
    """How the unknowns follow the rows at one point; natural steps, 0 for what is fixed."""

    blocks: list[RowBlock]  # of poses, then of relations; whitened, not weighted
    weights: list[Float[AnyArray, " _"] | None]  # by a robust loss
    fixed: Bool[AnyArray, " h"]  # numbers of the head that follow nothing
    rows: list[Float[AnyArray, "h _ _"]]  # A of every block
    parts: list[Float[AnyArray, "_ _"]]  # steps of the components' numbers, class by class
    information: Float[AnyArray, "h h"]  # 1/G, with that of a prior
    inverse: Float[AnyArray, "h h"]  # G
    lost: Float[AnyArray, "h h"]  # projector onto what the data leave open
    determined: Bool[AnyArray, " h"]  # numbers of the head that are determined one by one
    own: list[Float[AnyArray, "_ _ _"]]  # D^-1, class by class
    follow: list[Float[AnyArray, "_ _ h"]]  # D^-1 C
    open: list[Bool[AnyArray, "_ _"]]  # numbers of components that their rows leave open

    @classmethod
    def of(
        cls,
        blocks: list[RowBlock],
        weights: list[Float[AnyArray, " _"] | None],
        classes: tuple[tuple[int, int], ...],
        steps: Float[AnyArray, " z"],
        prior: PriorRows | None,
        fixed: Bool[AnyArray, " h"],
    ) -> "Influence":
        """At a point; ``fixed`` numbers of the head do not follow anything."""
        xp = namespace([block.white for block in blocks], steps)
        counted = [weighted(block, weight) for block, weight in zip(blocks, weights, strict=True)]
        arrow, _ = arrow_of(counted, classes, fixed.shape[0], prior)
        arrow = arrow.scaled(steps)
        head, parts = arrow.split(steps)
        own = [pseudo_inverse(matrix) for matrix in arrow.own]
        follow = [inverse @ crossed for inverse, crossed in zip(own, arrow.crossed, strict=True)]
        rows = []
        for block in blocks:
            mine: Any = 0.0 if block.by_head is None else block.by_head * head[:, None, None]
            if block.of >= 0:
                assert block.by_own is not None
                mine = mine - followed(block.by_own, parts[block.of][..., None] * follow[block.of], block.sizes)
            rows.append(mine)
        information: Any = 0.0
        for mine, weight in zip(rows, weights, strict=True):
            flat = _flat(mine if weight is None else mine * xp.sqrt(weight)[None, None])
            information = information + flat @ flat.T
        if prior is not None:
            index = np.arange(prior.weight.shape[0])
            information = added_to(information, (index, index), (prior.weight * head[index]) ** 2)
        inverse, lost, determined = inverse_information(information, fixed)
        left = [_left_open(matrix, inverse_) for matrix, inverse_ in zip(arrow.own, own, strict=True)]
        return cls(blocks, weights, fixed, rows, parts, information, inverse, lost, determined, own, follow, left)

    def covariance(self) -> UnknownsCovariance:
        """Of the unknowns, where every row has the variance 1 that its weight says."""
        transposed = [namespace(one).swapaxes(one, -1, -2) for one in self.follow]
        each = zip(self.own, self.follow, transposed, strict=True)
        return UnknownsCovariance(self.inverse, [own + one @ self.inverse @ other for own, one, other in each])

    def weighted(self, number: int, rows: Float[AnyArray, "k r m"]) -> Float[AnyArray, "k r m"]:
        """Rows of a block as a robust loss counts them: the influence of its poses."""
        weight = self.weights[number]
        return rows if weight is None else rows * weight[None, None]

    def weighted_rows(self, number: int) -> Float[AnyArray, "h r m"]:
        """A W of a block."""
        return self.weighted(number, self.rows[number])

    def own_rows(self, number: int) -> Float[AnyArray, "k r m"] | None:
        """B of a block in natural steps; None where it has no private geometry."""
        block = self.blocks[number]
        if block.of < 0:
            return None
        assert block.by_own is not None
        steps = self.parts[block.of]
        owner = np.repeat(np.arange(len(block.sizes)), block.sizes)
        return block.by_own * (steps[0][:, None, None] if len(block.sizes) == 1 else steps.T[:, None, owner])


def rows_of_functions(
    influence: Influence,
    head: Float[AnyArray, "q h"],
    components: Sequence[Float[AnyArray, "q _ _"]],
) -> list[Float[AnyArray, "q _ _"]]:
    """How linear functions of the unknowns follow the whitened rows of every block; ``head`` and ``components`` are
    their derivatives by the unknowns, natural steps."""
    xp = namespace(influence.inverse, head)
    for part, follow in zip(components, influence.follow, strict=True):
        head = head - xp.einsum("qKk,Kkh->qh", part, follow)
    gain, found = -head @ influence.inverse, []
    for number, block in enumerate(influence.blocks):
        a, own = influence.weighted_rows(number), influence.own_rows(number)
        rows = (gain @ _flat(a)).reshape(-1, *a.shape[1:])
        if own is not None:
            each = xp.einsum("qKk,Kkl->Klq", components[block.of], influence.own[block.of])
            rows = rows - followed(influence.weighted(number, own), each, block.sizes)
        found.append(rows)
    return found


def variances_of_functions(
    influence: Influence, head: Float[AnyArray, "q h"], components: list[Float[AnyArray, "q _ _"]]
) -> Float[AnyArray, " q"]:
    """Of linear functions of the unknowns, where every row has the variance 1 that its weight says; ``head`` and
    ``components`` are their derivatives, natural steps."""
    xp = namespace(influence.inverse, head)
    alone = xp.zeros(head.shape[0])
    for part, own, follow in zip(components, influence.own, influence.follow, strict=True):
        head = head - xp.einsum("qKk,Kkh->qh", part, follow)
        alone = alone + xp.einsum("qKk,Kkl,qKl->q", part, own, part)
    return alone + xp.einsum("qh,hg,qg->q", head, influence.inverse, head)


def covariance_of_rows(
    rows: list[Float[AnyArray, "q _ _"]], covariances: list[Float[AnyArray, "_ _ _"]]
) -> Float[AnyArray, "q q"]:
    """Covariance of functions that follow rows so; relations, which come after the poses, have variance 1."""
    total: Any = 0.0
    for number, one in enumerate(rows):
        by = products(one, covariances[number]) if number < len(covariances) else one
        total = total + _flat(by) @ _flat(one).T
    return total


def covariance_with(
    influence: Influence, rows: list[Float[AnyArray, "1 _ _"]], covariances: list[Float[AnyArray, "_ _ _"]]
) -> tuple[Float[AnyArray, " h"], list[Float[AnyArray, "_ _"]]]:
    """Covariance of the unknowns with a function that follows the rows so; natural steps."""
    xp = namespace(influence.inverse, rows)
    of_head, of_own = xp.zeros(influence.inverse.shape[0]), [xp.zeros(one.shape[:2]) for one in influence.own]
    for number, (block, one) in enumerate(zip(influence.blocks, rows, strict=True)):
        by = products(one, covariances[number]) if number < len(covariances) else one
        of_head = of_head + _flat(influence.weighted_rows(number)) @ by.reshape(-1)
        own = influence.own_rows(number)
        if own is not None:
            sums = sums_by_component(influence.weighted(number, own), by, block.sizes)
            of_own[block.of] = of_own[block.of] + sums[..., 0]
    head = -influence.inverse @ of_head
    each = zip(influence.own, influence.follow, of_own, strict=True)
    return head, [-(own @ part[..., None])[..., 0] - follow @ head for own, follow, part in each]


def _left_open(matrix: Float[AnyArray, "K k k"], inverse: Float[AnyArray, "K k k"]) -> Bool[AnyArray, "K k"]:
    """Numbers of components that are not determined."""
    xp = namespace(matrix, inverse)
    seen = xp.diagonal(matrix @ inverse, axis1=-2, axis2=-1)
    return seen < 1 - 1e-6


def _flat(rows: Float[AnyArray, "h r m"]) -> Float[AnyArray, "h _"]:
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2])


def row_covariances(
    rows: list[Rows], errors: list[ArmErrors], whitening: Whitening, noise: Noise
) -> list[Float[AnyArray, "_ _ _"]]:
    """Covariance of the whitened rows of every pose, by the noise and by what was measured."""
    found = []
    for part, error, root in zip(rows, errors, whitening.roots, strict=True):
        xp = namespace(root, error.by_seat, noise)
        each = xp.moveaxis(root, 0, -1)
        spread = xp.broadcast_to(noise.of_readings(error.kinds), (error.by_readings.shape[1],))
        seat = products(each, xp.swapaxes(error.by_seat, 0, 1)) * noise.seating
        readings = products(each, xp.swapaxes(error.by_readings * spread[None, :, None], 0, 1))
        measured = products(products(each, xp.moveaxis(part.measured, 0, -1)), each)
        found.append(measured + products(seat, seat) + products(readings, readings))
    return found


def alone(influence: Influence, groups: int) -> list[Float[AnyArray, "_ _ _"]]:
    """Covariance of every pose's whitened rows from its own residual, as it were without the pose in the fit."""
    found = []
    for number, block in enumerate(influence.blocks[:groups]):
        xp, a = namespace(influence.inverse, block.white), influence.weighted_rows(number)
        moved = (influence.inverse @ _flat(a)).reshape(a.shape)
        leverage = xp.einsum("zam,zbm->mab", a, moved)
        own = influence.own_rows(number)
        if own is not None:
            own = influence.weighted(number, own)
            per_pose = influence.own[block.of][np.repeat(np.arange(len(block.sizes)), block.sizes)]
            leverage = leverage + xp.einsum("kam,mkl,lbm->mab", own, per_pose, own)
        identity = xp.asarray(np.eye(a.shape[1]))
        # Where a pose determines its own geometry nearly alone, its residual says nothing: it has the common variance.
        whitening = inverse_cholesky(identity[None] - leverage)
        determinant = 1 / xp.prod(xp.diagonal(whitening, axis1=1, axis2=2), axis=1) ** 2
        enough = determinant > _LEAST_REDUNDANCY
        whitening = xp.where(enough[:, None, None], whitening, identity)
        left = xp.einsum("mba,mbc,cm->ma", whitening, whitening, block.white)
        own = xp.where(enough[:, None, None], left[:, :, None] * left[:, None, :], identity)
        found.append(xp.moveaxis(own, 0, -1))
    return found


def propagated(
    influence: Influence,
    covariances: list[Float[AnyArray, "_ _ _"]],
    shared_readings: Float[AnyArray, "h h"] | None,
    prior: PriorRows | None,
    added: Float[AnyArray, "h h"] | None,
) -> UnknownsCovariance:
    """Covariance of the unknowns, from that of every pose's whitened rows; relations have variance 1.

    ``shared_readings`` is what readings that several poses share add to the sum over poses (`of_shared_readings`);
    ``added`` is added to the head's.
    """
    xp, inverse = namespace(influence.inverse, covariances), influence.inverse
    total = xp.zeros_like(inverse) if shared_readings is None else shared_readings
    if prior is not None:
        total = total + _of_prior(influence)
    own_total = [xp.zeros_like(matrix) for matrix in influence.own]
    crossed = [xp.zeros_like(matrix) for matrix in influence.follow]
    for number, block in enumerate(influence.blocks):
        a, b = influence.weighted_rows(number), influence.own_rows(number)
        poses = number < len(covariances)
        by = products(a, covariances[number]) if poses else a
        total = total + _flat(by) @ _flat(a).T
        if b is not None:
            b = influence.weighted(number, b)
            own_by = products(b, covariances[number]) if poses else b
            own_total[block.of] = own_total[block.of] + sums_by_component(own_by, b, block.sizes)
            crossed[block.of] = crossed[block.of] + sums_by_component(own_by, a, block.sizes)
    head = inverse @ total @ inverse
    head = head if added is None else head + added
    components = []
    for own, follow, middle, both in zip(influence.own, influence.follow, own_total, crossed, strict=True):
        turned = xp.swapaxes(follow, -1, -2)
        mixed = own @ both @ inverse @ turned
        components.append(own @ middle @ own - mixed - xp.swapaxes(mixed, -1, -2) + follow @ head @ turned)
    return UnknownsCovariance(head, components)


def of_stated(
    influence: Influence, rows: list[Rows], whitening: Whitening, prior: PriorRows | None
) -> Float[AnyArray, "h h"]:
    """The part of the head's covariance that rests on what is stated: of relations, a prior, and measured values."""
    xp, inverse = namespace(influence.inverse), influence.inverse
    total = xp.zeros_like(inverse) if prior is None else _of_prior(influence)
    for number in range(len(influence.blocks)):
        by = a = influence.weighted_rows(number)
        if number < len(rows):
            each = xp.moveaxis(whitening.roots[number], 0, -1)
            by = products(a, products(products(each, xp.moveaxis(rows[number].measured, 0, -1)), each))
        total = total + _flat(by) @ _flat(a).T
    return inverse @ total @ inverse


def _of_prior(influence: Influence) -> Float[AnyArray, "h h"]:
    """The information of the prior, whose errors have variance 1 in its own rows."""
    of_rows = (_information(influence, number) for number in range(len(influence.blocks)))
    return influence.information - sum(of_rows, namespace(influence.inverse).zeros_like(influence.inverse))


def _information(influence: Influence, number: int) -> Float[AnyArray, "h h"]:
    flat = _flat(influence.rows[number])
    return flat @ _flat(influence.weighted_rows(number)).T


def of_shared_readings(
    rows: list[Float[AnyArray, "q _ _"]],
    errors: list[ArmErrors],
    whitening: Whitening,
    noise: Noise,
    reading: list[np.ndarray],
) -> Float[AnyArray, "q q"] | None:
    """What poses with one reading add to a sum over poses of what follows their rows, since they share its errors.

    ``reading`` is the number of the reading of each pose of each group; None where all are different.
    """
    counts = np.bincount(np.concatenate(reading))
    if counts.max() < 2:
        return None
    moved, owners = [], []
    for one, error, root, mine in zip(rows, errors, whitening.roots, reading, strict=False):
        poses = np.flatnonzero(counts[mine] > 1)
        if root is None or not len(poses):
            continue
        xp = namespace(root, error.by_readings)
        spread = xp.broadcast_to(noise.of_readings(error.kinds), (error.by_readings.shape[1],))
        readings = xp.einsum("mab,bnm->anm", root[poses], error.by_readings[..., poses] * spread[None, :, None])
        moved.append(xp.einsum("ham,anm->hnm", one[..., poses], readings))
        owners.append(mine[poses])
    xp = namespace(moved)
    each, owner = xp.concatenate(moved, axis=2), np.unique(np.concatenate(owners), return_inverse=True)[1]
    sums = each @ xp.asarray((owner[:, None] == np.arange(owner.max() + 1)[None, :]).astype(float))
    return _flat(sums) @ _flat(sums).T - _flat(each) @ _flat(each).T
