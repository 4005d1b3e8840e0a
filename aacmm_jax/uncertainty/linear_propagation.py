"""How the unknowns follow the rows, and their covariance by the law of propagation (JCGM 100).

Rows are whitened residuals w = R e of the errors e: of the readings and of the seat, which reach them through the arm,
and of what was measured. With A the eliminated derivatives by the head (A~ of `model.elimination`: parameters and
shared geometry), B those by the private geometry of a component, W the weights of a robust loss, G the inverse
information of the head, D^-1 that of a component, and C what couples both (`model.elimination`), the unknowns answer to
errors of the rows as

    dx = -G A W w,    dy = -D^-1 (B W w + C dx),

so that their covariance is that of these linear functions, with Cov(w) as the noise has it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_cholesky, matrix_products, products, squares
from ..core.numpy_or_jax import AnyArray, added_to, namespace
from ..data.noise import Noise
from ..data.observations.observation import Rows
from ..kinematics.chain import ForwardPass, JointKinds
from ..kinematics.jacobian import reading_columns, reading_rotations
from ..model.elimination import arrow_of, followed, pseudo_inverse, sums_by_component, weighted
from ..model.observed import Observed
from ..model.rows import PointRows, PriorRows, RowBlock, Whitening
from .covariance import inverse_information

LEAST_SIGMA = 1e-9  # mm
_LEAST_REDUNDANCY = 0.05  # determinant of a pose's part of the residuals' projector


class ArmErrors(NamedTuple):
    """How errors of a group's poses reach its rows."""

    by_readings: Float[AnyArray, "r n m"]  # mm (or rad) a rad, or a mm of prismatic joints
    by_seat: Float[AnyArray, "r c m"]  # of the tip's position, and of its orientation as far as the tip's lever goes
    kinds: JointKinds | None


def arm_errors(point: PointRows, observed: Observed) -> list[ArmErrors]:
    """Of every group."""
    forward = point.forward
    assert isinstance(forward, ForwardPass)  # a batch needs no covariance of its arms' errors
    xp = namespace(forward)
    readings, rotations = reading_columns(forward), reading_rotations(forward)  # (n, 3, N)
    if observed.counted is not None:
        readings, rotations = (columns * xp.asarray(observed.counted)[:, None] for columns in (readings, rotations))
    # An arm whose tips err by s turns them by about s over its size.
    size = xp.sqrt(xp.mean(xp.sum(forward.tip**2, axis=0)))
    errors = []
    for part, group in zip(point.rows, observed.layout.groups, strict=True):
        by_tip, by_rotation, poses = part.by_tip, part.by_rotation, group.index
        by_readings = products(by_tip, readings[..., poses])
        by_seat = by_tip
        if by_rotation is not None:
            by_readings = by_readings + products(by_rotation, rotations[..., poses])
            by_seat = xp.concatenate([by_tip, by_rotation / size], axis=1)
        errors.append(ArmErrors(by_readings, by_seat, forward.kinds))
    return errors


def covariance_of_noise(errors: ArmErrors, noise: Noise) -> Float[AnyArray, "m r r"]:
    """Of a group's rows by the noise of readings and seat."""
    xp = namespace(errors, noise)
    spread = xp.broadcast_to(noise.of_readings(errors.kinds), (errors.by_readings.shape[1],))
    moved = errors.by_readings * spread[None, :, None]
    tip = errors.by_seat[:, :3]
    return squares(moved) + (noise.seating**2 + 1e-12) * squares(tip)


def covariance_of_sigma(errors: ArmErrors, sigma: Float[AnyArray, ""]) -> Float[AnyArray, "m r r"]:
    """Of a group's rows, where every coordinate of a tip scatters by ``sigma``, mm."""
    return namespace(errors, sigma).maximum(sigma, LEAST_SIGMA) ** 2 * squares(errors.by_seat)


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
    prior: Float[AnyArray, "h h"]  # information of the prior
    information: Float[AnyArray, "h h"]  # 1/G, with that of the prior
    inverse: Float[AnyArray, "h h"]  # G
    null_projector: Float[AnyArray, "h h"]  # projector onto what the data leave open
    determined: Bool[AnyArray, " h"]  # numbers of the head that are determined one by one
    d_inverses: list[Float[AnyArray, "_ _ _"]]  # D^-1, class by class
    follow: list[Float[AnyArray, "_ _ h"]]  # D^-1 C
    undetermined: list[Bool[AnyArray, "_ _"]]  # numbers of components that their rows leave open

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
        xp, height = namespace([block.white for block in blocks], steps), fixed.shape[0]
        counted = [weighted(block, weight) for block, weight in zip(blocks, weights, strict=True)]
        arrow = arrow_of(counted, classes, height, prior)[0].scaled(steps)
        head, parts = arrow.split(steps)
        d_inverses = [pseudo_inverse(matrix) for matrix in arrow.private]
        follow = [inverse @ crossed for inverse, crossed in zip(d_inverses, arrow.crossed, strict=True)]
        rows = []
        for block in blocks:
            eliminated: Any = 0.0 if block.by_head is None else block.by_head * head[:, None, None]
            if block.class_index >= 0:
                assert block.by_own is not None
                by_component = parts[block.class_index][..., None] * follow[block.class_index]
                eliminated = eliminated - followed(block.by_own, by_component, block.sizes)
            rows.append(eliminated)
        of_prior = xp.zeros((height, height))
        if prior is not None:
            index = np.arange(prior.weight.shape[0])
            of_prior = added_to(of_prior, (index, index), (prior.weight * head[index]) ** 2)
        # Summed anew from the eliminated rows: the Schur complement of the arrow would lose digits by cancellation.
        information = of_prior
        for eliminated, weight in zip(rows, weights, strict=True):
            flat = _flat(eliminated if weight is None else eliminated * xp.sqrt(weight)[None, None])
            information = information + flat @ flat.T
        inverse, null_projector, determined = inverse_information(information, fixed)
        # D D^-1 has ones on the diagonal where a number is determined.
        seen = [
            xp.diagonal(matrix @ inverted, axis1=-2, axis2=-1)
            for matrix, inverted in zip(arrow.private, d_inverses, strict=True)
        ]
        undetermined = [values < 1 - 1e-6 for values in seen]
        return cls(
            blocks,
            weights,
            fixed,
            rows,
            parts,
            of_prior,
            information,
            inverse,
            null_projector,
            determined,
            d_inverses,
            follow,
            undetermined,
        )

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
        if block.class_index < 0:
            return None
        assert block.by_own is not None
        steps = self.parts[block.class_index]
        owner = np.repeat(np.arange(len(block.sizes)), block.sizes)
        return block.by_own * (steps[0][:, None, None] if len(block.sizes) == 1 else steps.T[:, None, owner])

    def sums(
        self, rows: Sequence[Float[AnyArray, "q _ _"]]
    ) -> tuple[Float[AnyArray, "h q"], list[Float[AnyArray, "_ _ q"]]]:
        """A W r^T and, of each component, B W r^T, summed over all rows r, of which every block has q."""
        xp, count = namespace(self.inverse, rows), rows[0].shape[0]
        head = xp.zeros((self.inverse.shape[0], count))
        components = [xp.zeros((*inverse.shape[:2], count)) for inverse in self.d_inverses]
        for number, (block, values) in enumerate(zip(self.blocks, rows, strict=True)):
            head = head + _flat(self.weighted_rows(number)) @ _flat(values).T
            private = self.own_rows(number)
            if private is not None:
                of_block = sums_by_component(self.weighted(number, private), values, block.sizes)
                components[block.class_index] = components[block.class_index] + of_block
        return head, components

    def response(
        self, rows: Sequence[Float[AnyArray, "q _ _"]]
    ) -> tuple[Float[AnyArray, "h q"], list[Float[AnyArray, "_ _ q"]]]:
        """How the head and the components answer to q sets of errors of all rows: dx and dy of the module's equations.

        Where ``rows`` are the residuals, this is the step of Gauss and Newton; where they are functions of the rows
        times Cov(w), it is the unknowns' covariance with these functions.
        """
        sums, of_components = self.sums(rows)
        head, triples = -self.inverse @ sums, zip(self.d_inverses, self.follow, of_components, strict=True)
        return head, [-(d_inverse @ part) - follow @ head for d_inverse, follow, part in triples]

    def eliminated(
        self, head: Float[AnyArray, "q h"], components: Sequence[Float[AnyArray, "q _ _"]]
    ) -> Float[AnyArray, "q h"]:
        """Derivatives by the head of functions of all unknowns, with the components where the head has them."""
        xp = namespace(self.inverse, head)
        for part, follow in zip(components, self.follow, strict=True):
            head = head - xp.einsum("qKk,Kkh->qh", part, follow)
        return head


def rows_of_functions(
    influence: Influence,
    head: Float[AnyArray, "q h"],
    components: Sequence[Float[AnyArray, "q _ _"]],
) -> list[Float[AnyArray, "q _ _"]]:
    """How linear functions of the unknowns follow the whitened rows of every block; ``head`` and ``components`` are
    their derivatives by the unknowns, natural steps."""
    xp = namespace(influence.inverse, head)
    gain, rows = -influence.eliminated(head, components) @ influence.inverse, []
    for number, block in enumerate(influence.blocks):
        a, private = influence.weighted_rows(number), influence.own_rows(number)
        of_block = (gain @ _flat(a)).reshape(-1, *a.shape[1:])
        if private is not None:
            k = block.class_index
            by_component = xp.einsum("qKk,Kkl->Klq", components[k], influence.d_inverses[k])
            of_block = of_block - followed(influence.weighted(number, private), by_component, block.sizes)
        rows.append(of_block)
    return rows


def variances_of_functions(
    influence: Influence, head: Float[AnyArray, "q h"], components: list[Float[AnyArray, "q _ _"]]
) -> Float[AnyArray, " q"]:
    """Of linear functions of the unknowns, where every row has the variance 1 that its weight says; ``head`` and
    ``components`` are their derivatives, natural steps."""
    xp, by_head = namespace(influence.inverse, head), influence.eliminated(head, components)
    variances = xp.einsum("qh,hg,qg->q", by_head, influence.inverse, by_head)
    for part, inverse in zip(components, influence.d_inverses, strict=True):
        variances = variances + xp.einsum("qKk,Kkl,qKl->q", part, inverse, part)
    return variances


def by_covariances(
    rows: Sequence[Float[AnyArray, "q _ _"]], covariances: Sequence[Float[AnyArray, "_ _ _"]]
) -> list[Float[AnyArray, "q _ _"]]:
    """Rows times the covariance of every pose's; relations, which come after the poses, have variance 1."""
    count = len(covariances)
    of_poses = [products(part, covariance) for part, covariance in zip(rows[:count], covariances, strict=True)]
    return [*of_poses, *rows[count:]]


def covariance_of_rows(
    rows: list[Float[AnyArray, "q _ _"]], covariances: list[Float[AnyArray, "_ _ _"]]
) -> Float[AnyArray, "q q"]:
    """Covariance of functions that follow rows so."""
    pairs = zip(by_covariances(rows, covariances), rows, strict=True)
    return sum(
        (_flat(moved) @ _flat(plain).T for moved, plain in pairs), namespace(rows).zeros((rows[0].shape[0],) * 2)
    )


def _flat(rows: Float[AnyArray, "h r m"]) -> Float[AnyArray, "h _"]:
    return rows.reshape(rows.shape[0], rows.shape[1] * rows.shape[2])


def _of_measured(rows: Rows, whitening: Float[AnyArray, "r r m"]) -> Float[AnyArray, "r r m"]:
    """The part of the whitened rows' covariance that what was measured has."""
    return products(products(whitening, namespace(whitening).moveaxis(rows.measured, 0, -1)), whitening)


def row_errors(
    rows: Rows, errors: ArmErrors, root: Float[AnyArray, "m r r"] | None, spread: Float[AnyArray, "*n"]
) -> tuple[Float[AnyArray, "r n m"], Float[AnyArray, "r c m"], Float[AnyArray, "r r m"]]:
    """How what errs reaches the whitened rows of a group: the readings, each over its standard deviation ``spread``;
    the seat, mm; and the covariance of what was measured."""
    assert root is not None  # only rows of a stage without covariances have none
    xp = namespace(root, errors.by_seat, spread)
    whitening = xp.moveaxis(root, 0, -1)
    readings = errors.by_readings * xp.broadcast_to(spread, (errors.by_readings.shape[1],))[None, :, None]
    of_readings, of_seat = (matrix_products(whitening, matrices) for matrices in (readings, errors.by_seat))
    return of_readings, of_seat, _of_measured(rows, whitening)


def row_covariances(
    rows: list[Rows], errors: list[ArmErrors], whitening: Whitening, noise: Noise
) -> list[Float[AnyArray, "_ _ _"]]:
    """Covariance of the whitened rows of every pose, by the noise and by what was measured."""
    covariances = []
    for part, error, root in zip(rows, errors, whitening.roots, strict=True):
        readings, seat, measured = row_errors(part, error, root, noise.of_readings(error.kinds))
        covariances.append(measured + noise.seating**2 * products(seat, seat) + products(readings, readings))
    return covariances


def alone(influence: Influence, groups: int) -> list[Float[AnyArray, "_ _ _"]]:
    """Covariance of every pose's whitened rows from its own residual, as it were without the pose in the fit.

    With H the leverage of a pose (its part of the projector onto what the unknowns explain), a residual has the
    variance 1 - H of its error, so the error is estimated as (1 - H)^-1 w (the jackknife; MacKinnon and White 1985).
    """
    covariances = []
    for number, block in enumerate(influence.blocks[:groups]):
        xp, a = namespace(influence.inverse, block.white), influence.weighted_rows(number)
        moved = (influence.inverse @ _flat(a)).reshape(a.shape)
        leverage = xp.einsum("zam,zbm->mab", a, moved)
        private = influence.own_rows(number)
        if private is not None:
            private = influence.weighted(number, private)
            per_pose = influence.d_inverses[block.class_index][np.repeat(np.arange(len(block.sizes)), block.sizes)]
            leverage = leverage + xp.einsum("kam,mkl,lbm->mab", private, per_pose, private)
        identity = xp.asarray(np.eye(a.shape[1]))
        # Where a pose determines its own geometry nearly alone, its residual is nearly 0 whatever its variance is: it
        # has the common variance.
        whitening = inverse_cholesky(identity[None] - leverage)
        determinant = 1 / xp.prod(xp.diagonal(whitening, axis1=1, axis2=2), axis=1) ** 2
        enough = (determinant > _LEAST_REDUNDANCY)[:, None, None]
        whitening = xp.where(enough, whitening, identity)
        error = xp.einsum("mba,mbc,cm->ma", whitening, whitening, block.white)
        squares = xp.where(enough, error[:, :, None] * error[:, None, :], identity)
        covariances.append(xp.moveaxis(squares, 0, -1))
    return covariances


def propagated(
    influence: Influence,
    covariances: list[Float[AnyArray, "_ _ _"]],
    shared_readings: Float[AnyArray, "h h"] | None,
    added: Float[AnyArray, "h h"] | None,
) -> UnknownsCovariance:
    """Covariance of the unknowns, from that of every pose's whitened rows; relations have variance 1.

    ``shared_readings`` is what readings that several poses share add to the sum over poses (`of_shared_readings`);
    ``added`` is added to the head's.
    """
    xp, inverse = namespace(influence.inverse, covariances), influence.inverse
    moved = by_covariances([influence.weighted_rows(number) for number in range(len(influence.blocks))], covariances)
    total, crossed = influence.sums(moved)
    total = total + influence.prior + (0.0 if shared_readings is None else shared_readings)
    head = inverse @ total @ inverse + (0.0 if added is None else added)
    middle = [xp.zeros_like(matrix) for matrix in influence.d_inverses]
    for number, block in enumerate(influence.blocks):
        private = influence.own_rows(number)
        if private is not None:
            private = influence.weighted(number, private)
            times = products(private, covariances[number]) if number < len(covariances) else private
            middle[block.class_index] = middle[block.class_index] + sums_by_component(times, private, block.sizes)
    # Of dy = -D^-1 (B W w + C dx): both parts, and twice what they have in common.
    components = []
    for d_inverse, follow, square, both in zip(influence.d_inverses, influence.follow, middle, crossed, strict=True):
        turned = xp.swapaxes(follow, -1, -2)
        mixed = d_inverse @ both @ inverse @ turned
        separate = follow @ head @ turned + d_inverse @ square @ d_inverse
        components.append(separate - mixed - xp.swapaxes(mixed, -1, -2))
    return UnknownsCovariance(head, components)


def of_stated(influence: Influence, rows: list[Rows], whitening: Whitening) -> Float[AnyArray, "h h"]:
    """The part of the head's covariance that rests on what is stated: of relations, a prior, and measured values."""
    pairs = zip(rows, whitening.roots, strict=True)
    measured = [_of_measured(part, namespace(root).moveaxis(root, 0, -1)) for part, root in pairs]
    weighted_rows = [influence.weighted_rows(number) for number in range(len(influence.blocks))]
    total = covariance_of_rows(weighted_rows, measured) + influence.prior
    return influence.inverse @ total @ influence.inverse


def of_shared_readings(
    rows: list[Float[AnyArray, "q _ _"]],
    errors: list[ArmErrors],
    whitening: Whitening,
    noise: Noise,
    reading: list[np.ndarray],
) -> Float[AnyArray, "q q"] | None:
    """What poses with one reading add to a sum over poses of what follows their rows, since they share its errors.

    With s_i what pose i of a reading adds, it is (sum s_i)(sum s_i)^T - sum s_i s_i^T. ``reading`` is the number of the
    reading of each pose of each group; None where all are different.
    """
    counts = np.bincount(np.concatenate(reading))
    if counts.max() < 2:
        return None
    moved, owners = [], []
    for part, error, root, numbers in zip(rows, errors, whitening.roots, reading, strict=False):
        poses = np.flatnonzero(counts[numbers] > 1)
        if root is None or not len(poses):
            continue
        xp = namespace(root, error.by_readings)
        spread = xp.broadcast_to(noise.of_readings(error.kinds), (error.by_readings.shape[1],))
        readings = xp.einsum("mab,bnm->anm", root[poses], error.by_readings[..., poses] * spread[None, :, None])
        moved.append(xp.einsum("ham,anm->hnm", part[..., poses], readings))
        owners.append(numbers[poses])
    xp = namespace(moved)
    of_poses, owner = xp.concatenate(moved, axis=2), np.unique(np.concatenate(owners), return_inverse=True)[1]
    sums = of_poses @ xp.asarray((owner[:, None] == np.arange(owner.max() + 1)[None, :]).astype(float))
    return _flat(sums) @ _flat(sums).T - _flat(of_poses) @ _flat(of_poses).T
