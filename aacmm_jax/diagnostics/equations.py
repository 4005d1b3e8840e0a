"""The equations of a calibration at its solution, and whether groups of poses contradict the others: F tests of the
residuals that each group adds to a least squares.

A group with an error of its own (readings of a joint that were shifted while one socket was recorded) changes the
parameters, so that its residuals show little of the error. The test compares the least squares with and without the
group. The second is one Gauss-Newton step away, by the normal equations less the group's part of them (case deletion:
Cook and Weisberg, "Residuals and Influence in Regression", 1982, section 3.6), so that nothing is identified again.

What an error of its own may be (a joint's zero, a remounted probe) is tested likewise: by unknowns that only the group
has, which must explain what it contradicts.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration.record import CalibrationRecord
from ..calibration.task import without_lengths
from ..core.distributions import f_tail
from ..core.numpy_or_jax import to_numpy
from ..data.noise import Noise
from ..kinematics.arm import by_joint, is_length, parameter_names, value_of, without_corrections
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..uncertainty.linearisation import Linearisation

_NULL = 1e-10  # eigenvalues of the scaled normal matrix below this, of the largest, are zero
_AS_WELL = 2.0  # ratio of the variances of what remains, up to which two groups explain a contradiction equally well


class GroupTest(NamedTuple):
    """One group against those that remain."""

    group: Hashable
    ratio: float  # F: mean square that the group adds, over the mean square of the others without it
    degrees_of_freedom: tuple[int, int]
    probability: float  # of this ratio or a larger one, where nothing is wrong
    variance: float  # of the others without it, in units of what was expected
    step: Float[np.ndarray, " p"]  # from the given parameters to those of the others alone

    @classmethod
    def of(cls, group: Hashable, added: int, gain: float, cost: float, freedom: int, step: np.ndarray) -> "GroupTest":
        """By the sum of squares that ``added`` equations or unknowns account for, and that of the rest."""
        variance = max(cost / freedom, 1e-300)
        ratio = max(gain, 0.0) / added / variance
        return cls(group, ratio, (added, freedom), f_tail(ratio, added, freedom), variance, step)


class Block(NamedTuple):
    """Equations of one fixture and one group: residuals in standard deviations, and their derivatives.

    Those whose group is None are never taken out.
    """

    fixture: Hashable
    group: Hashable | None
    residual: Float[np.ndarray, " r"]
    shared: Float[np.ndarray, "r p"]  # by the parameters, and by what several fixtures share
    private: Float[np.ndarray, "r k"]  # by what only this fixture has, such as the position of a socket


class Fit(NamedTuple):
    """A least squares from its Gram matrix."""

    cost: float  # sum of squares
    degrees_of_freedom: int
    step: np.ndarray


class _Gram(NamedTuple):
    """Gram matrix of the derivatives by the parameters and the residual, less what the fixtures' own unknowns account
    for, and how many rows are left."""

    matrix: Float[np.ndarray, "m m"]
    rows: int

    @classmethod
    def of(cls, blocks: Iterable[Block]) -> "_Gram":
        matrix, rows = np.zeros((0, 0)), 0
        for block in blocks:
            columns = np.concatenate([block.shared, block.residual[:, None], block.private], axis=1)
            whole, size, rank = columns.T @ columns, block.shared.shape[1] + 1, 0
            part = whole[:size, :size]
            if block.private.shape[1]:
                inverse, rank = _inverse(whole[size:, size:], np.diag(whole)[size:])
                part = part - whole[:size, size:] @ inverse @ whole[size:, :size]
            matrix, rows = (part + matrix if rows else part), rows + len(columns) - rank
        return cls(matrix, rows)

    def fit(self, diagonal: Float[np.ndarray, " p"] | None = None) -> Fit:
        """``diagonal``: that of the whole normal matrix, against which what is left of a column may be rounding."""
        information, gradient = self.matrix[:-1, :-1], self.matrix[:-1, -1]
        inverse, rank = _inverse(information, np.diag(information) if diagonal is None else diagonal)
        step = -inverse @ gradient
        cost = float(self.matrix[-1, -1] + step @ gradient)
        return Fit(max(cost, 0.0), self.rows - rank, step)


def _inverse(matrix: Float[np.ndarray, "p p"], diagonal: Float[np.ndarray, " p"]) -> tuple[np.ndarray, int]:
    """The pseudo-inverse of a normal matrix whose columns are first scaled, and its rank."""
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    present = values > _NULL * values.max(initial=0.0)
    rows = (scale[:, None] * vectors)[:, present]
    return (rows / values[present]) @ rows.T, int(present.sum())


def fit_of(blocks: Iterable[Block]) -> Fit:
    """The least squares of some of the equations."""
    return _Gram.of(blocks).fit()


def _groups(blocks: Sequence[Block]) -> list[Hashable]:
    return list(dict.fromkeys(block.group for block in blocks if block.group is not None))


def contradicting_groups(
    blocks: Sequence[Block],
    *,
    level: float = 0.01,
    least_ratio: float = 1.0,
    scales: Sequence[frozenset[Hashable]] = (),
) -> list[list[GroupTest]]:
    """Find the groups of poses that contradict the others.

    Several such groups hide each other, so groups are taken out one after the other, always the one with the largest
    ratio, as long as it is significant, up to half of them (after Rosner 1983, Technometrics 25). Found are the last
    one that reaches ``least_ratio`` and all before it.

    ``level`` is the probability of finding any group where nothing is wrong (Bonferroni's bound). Returned are the test
    of each group that was found, without those before it; and after it, as its alternatives, the tests of groups
    without which the others agree as well (of two groups that contradict each other, either).

    ``scales`` are the groups that each reference length joins, where lengths alone fix the scale. A group that all of
    them need is not tested: without it the arm could shrink, and the residuals of the others with it to nothing.
    """
    grams = {group: _Gram.of(block for block in blocks if block.group == group) for group in (*_groups(blocks), None)}
    contradicting: list[list[GroupTest]] = []
    number = 0
    for _ in range((len(grams) - 1) // 2):
        # Every group that is left against the others; not those that add no equation, or leave none to compare.
        left = [gram for gram in grams.values() if gram.rows]
        whole = _Gram(np.sum([gram.matrix for gram in left], axis=0), sum(gram.rows for gram in left))
        diagonal, tests = np.diag(whole.matrix)[:-1], []
        everything = whole.fit(diagonal)
        scales = [groups for groups in scales if groups <= grams.keys()]
        for group, gram in grams.items():
            if group is None or (scales and all(group in groups for groups in scales)):
                continue
            others = _Gram(whole.matrix - gram.matrix, whole.rows - gram.rows).fit(diagonal)
            added, freedom = everything.degrees_of_freedom - others.degrees_of_freedom, others.degrees_of_freedom
            if added > 0 and freedom > 0:
                gain = everything.cost - others.cost
                tests.append(GroupTest.of(group, added, gain, others.cost, freedom, others.step))
        significant = [test for test in tests if test.probability * len(tests) < level]
        if not significant:
            break
        worst = max(significant, key=lambda test: test.ratio)
        alternatives = [test for test in significant if test is not worst and test.ratio >= least_ratio]
        contradicting.append([worst, *(test for test in alternatives if test.variance < _AS_WELL * worst.variance)])
        del grams[worst.group]
        if worst.ratio >= least_ratio:
            number = len(contradicting)
    return contradicting[:number]


def different_groups(blocks: Sequence[Block]) -> list[GroupTest]:
    """Each group against the others by parameters of its own, the largest ratio first.

    A group that is larger than the number of parameters adds many residuals, among which an error of its own is
    diluted; that it needs other parameters than the others is not (Chow 1960, Econometrica 28). What belongs to no
    group counts with both sides: it relates unknowns that only one of them has.
    """
    whole, tests = fit_of(blocks), []
    for group in _groups(blocks):
        alone = fit_of([block for block in blocks if block.group in (group, None)])
        others = fit_of([block for block in blocks if block.group != group])
        freedom = alone.degrees_of_freedom + others.degrees_of_freedom
        again = sum(block.residual.size for block in blocks if block.group is None)
        added = whole.degrees_of_freedom + again - freedom
        if added > 0 and min(alone.degrees_of_freedom, others.degrees_of_freedom) > 0:
            apart = alone.cost + others.cost
            tests.append(GroupTest.of(group, added, whole.cost - apart, apart, freedom, others.step))
    return sorted(tests, key=lambda test: -test.ratio)


PRIOR = "prior"  # name of its rows
PROBE = ("probe_x", "probe_y", "probe_z")
LEAST_U = 1e-6  # mm: smallest standard deviation of a length or certified value
_MOST_POSES = 2000  # that tests of residuals look at: more would only find errors that do not matter
_CHUNK = 100  # poses of one observation that are kept together
EXACT = 1e-6  # mm: smaller residuals are rounding errors of a simulation without noise


class Rows(NamedTuple):
    """The m poses of one observation, r rows each, in standard deviations and natural steps."""

    name: str
    residual: Float[np.ndarray, "m r"]
    shared: Float[np.ndarray, "m r s"]  # derivatives by the parameters, and by the geometry of several observations
    private: Float[np.ndarray, "m r k"]  # by the geometry of this observation alone
    extra: Float[np.ndarray, "m r e"]  # by what may be wrong in some of the poses: `Equations.extra`
    # What makes of the residual a vector in mm whose length is the tip's distance from the geometry.
    in_mm: Float[np.ndarray, "m c r"]
    by_tip: Float[np.ndarray, "m r 3"]  # derivatives by the tip's position
    measured: Float[np.ndarray, "m r r"]  # errors of what was measured, by independent ones of its rows
    poses: Int[np.ndarray, " m"]  # their numbers among all poses: sockets first, then other observations

    def block(self, group: str | None, extra: Sequence[int] = (), concerned: bool = True) -> Block:
        """For the test; with columns of ``extra`` after the shared ones, which are 0 where it is not concerned."""
        shared = np.concatenate([self.shared, self.extra[..., list(extra)] * concerned], axis=2)
        flat = (array.reshape(self.residual.size, array.shape[2]) for array in (shared, self.private))
        return Block(self.name, group, self.residual.ravel(), *flat)

    def at(self, poses: "slice | np.ndarray") -> "Rows":
        """Some of the poses."""
        return Rows(self.name, *(part[poses] for part in self[1:]))

    def whitened(self, covariance: Float[np.ndarray, "m r r"]) -> "Rows":
        """The same poses in standard deviations of another noise, whose covariance is given in those of the present."""
        factor = np.linalg.cholesky(0.5 * (covariance + covariance.swapaxes(1, 2)))
        root = np.linalg.inv(factor)
        columns = {name: root @ getattr(self, name) for name in ("shared", "private", "extra", "by_tip", "measured")}
        residual = np.einsum("mab,mb->ma", root, self.residual)
        return self._replace(residual=residual, in_mm=self.in_mm @ factor, **columns)

    def squares(self, step: Float[np.ndarray, " s"]) -> Float[np.ndarray, " m"]:
        """Squared distance of each pose from the geometry, mm^2, after a step; its own geometry follows."""
        moved = self.residual + self.shared @ step
        private = self.private.reshape(self.residual.size, self.private.shape[2])
        moved = moved - self.private @ (np.linalg.pinv(private) @ moved.ravel())
        return np.sum(np.einsum("mcr,mr->mc", self.in_mm, moved) ** 2, axis=1)


class Equations(NamedTuple):
    """All equations of a calibration."""

    rows: list[Rows]  # of the observations, sockets first; sockets with one pose are not among them
    relations: list[Block]  # of reference lengths and certified values, which belong to no group
    extra: tuple[str, ...]  # zeros of the joints, the probe, and other parameters that are no unknowns
    steps: Float[np.ndarray, " e"]  # their natural steps, rad and mm
    anchor: str | None  # the length among these that is kept, because with it the arm and its residuals could shrink

    def blocks(self, members: Sequence[str] = (), names: Sequence[str] = ()) -> list[Block]:
        """All in one group; with some of ``extra`` as unknowns that only certain observations have."""
        columns = [self.extra.index(name) for name in names]
        blocks = [rows.block("", columns, rows.name in members) for rows in self.rows]
        return [*blocks, *wider(self.relations, len(columns))]

    def grouped(self, groups: Mapping[str, str | None]) -> list[Block]:
        """By the group of each observation."""
        return [*(rows.block(groups[rows.name]) for rows in self.rows), *self.relations]


def equations_of(record: CalibrationRecord) -> Equations:
    """The equations of a calibration, linear at its solution; as weighted by its robust loss."""
    kinds = by_joint(record.calibrated.arm, "theta", "d")  # where a reading is added
    extra = (*(f"{kind}_{i}" for i, kind in enumerate(kinds, start=1)), *PROBE)
    in_solve = lengths_in_solve(record)
    # The length that the equations keep: none where anything but repeatability says what the scale is.
    scaled = record.prior is not None or any(o.fixes_scale for o in record.recording.capture.observations)
    anchor = None if in_solve else record.hold if scaled else scale_anchor_of(record)
    names = tuple(name for name in record.names if name != anchor)
    of_arm = parameter_names(without_corrections(record.calibrated.arm))
    extra += tuple(name for name in of_arm if name not in (*names, *extra))
    every = (*names, *(name for name in extra if name not in names))
    linear = linearisation_of(record, every, noise=record.noise, lengths=in_solve)
    observed, p, free = linear.observed, len(every), len(names)
    steps, columns = np.asarray(linear.steps), np.array([every.index(name) for name in extra])
    # The geometry that several observations, reference lengths or certified values depend on.
    related = {end for ends in observed.ends for end in ends} | observed.certified().keys()
    private = [observed.positions[part] for part in observed.blocks if part in related]
    common = np.unique(np.concatenate([np.arange(observed.layout.shared), *private]).astype(int))
    rows = []
    for part in linear.parts():
        part = part.without_rest()
        weight = np.sqrt(np.asarray(part.weight))
        root = weight[:, None, None] * np.asarray(part.root)
        by = np.moveaxis(np.asarray(part.by_head) * weight, (0, 1, 2), (2, 1, 0)) * steps[: linear.height]
        by_private = np.moveaxis(np.asarray(part.by_private) * weight, (0, 1, 2), (2, 1, 0)) * steps[p + part.private]
        among = np.isin(part.private, common)
        # A socket with one pose shows no scatter; only lengths in the solve need it.
        if not in_solve and len(weight) == 1 and np.sum(~among) == 3:
            continue
        to_rows = np.moveaxis(np.linalg.pinv(root), 0, -1)
        in_mm = np.asarray(part.observation.in_mm(to_rows, np.asarray(part.by_tip)))
        shared = np.zeros((*by.shape[:2], free + len(common)))
        shared[..., :free] = by[..., :free]
        shared[..., free : free + observed.layout.shared] = by[..., p:]
        shared[..., free + np.searchsorted(common, part.private[among])] = by_private[..., among]
        rows.append(
            Rows(
                part.observation.name,
                (np.asarray(part.white) * weight).T,
                shared,
                by_private[..., ~among],
                by[..., columns],
                np.moveaxis(in_mm, -1, 0),
                root @ np.moveaxis(np.asarray(part.by_tip), -1, 0),
                root @ _root_of(np.asarray(part.measured)),
                np.arange(part.poses.start, part.poses.stop),
            )
        )
    derivatives, residual, u = linear.relations()
    u = np.maximum(u, LEAST_U)
    chosen = np.concatenate([np.arange(free), p + common])
    relations = [Block("", None, residual / u, (derivatives * steps)[:, chosen] / u[:, None], np.zeros((len(u), 0)))]
    if record.prior is not None:
        mean, weight = np.asarray(record.prior.mean), np.asarray(record.prior.weight)
        stated = np.flatnonzero(weight)
        residual = weight[stated] * (np.asarray(linear.z)[:free] - mean)[stated]
        by = np.eye(len(chosen))[stated] * (weight * steps[:free])[stated][:, None]
        relations.append(Block(PRIOR, None, residual, by, np.zeros((len(stated), 0))))
    natural = np.array([1.0 if is_length(name) else 1e-3 for name in extra])
    return Equations(rows, relations if len(u) else relations[1:], extra, natural, anchor)


def _root_of(covariance: Float[np.ndarray, "m r r"]) -> Float[np.ndarray, "m r r"]:
    """A matrix R with R R' the covariance, which may be singular; each column is of the unit of its row."""
    sd = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, :, None]
    safe = np.where(sd > 0, sd, 1.0)
    values, vectors = np.linalg.eigh(covariance / safe / safe.swapaxes(1, 2))
    return sd * (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.swapaxes(1, 2)


def in_chunks(equations: Equations) -> tuple[list[Rows], list[Block]]:
    """The equations of poses in chunks, or of very many an even choice of these, and those of relations.

    Unknowns of an observation that is divided become shared ones.
    """
    added = sum(rows.private.shape[2] for rows in equations.rows if len(rows.poses) > _CHUNK)
    chunks, position = [], 0
    for rows in equations.rows:
        shared = np.pad(rows.shared, ((0, 0), (0, 0), (0, added)))
        if len(rows.poses) <= _CHUNK:
            chunks.append(rows._replace(shared=shared))
            continue
        width = rows.private.shape[2]
        shared[..., rows.shared.shape[2] + position :][..., :width] = rows.private
        position += width
        whole = rows._replace(shared=shared, private=rows.private[..., :0])
        chunks += [whole.at(slice(start, start + _CHUNK)) for start in range(0, len(rows.poses), _CHUNK)]
    step = -(-sum(len(rows.poses) for rows in chunks) // _MOST_POSES)
    return chunks[:: max(step, 1)], wider(equations.relations, added)


def residual_rms(rows: Sequence[Rows]) -> float:
    """Root mean square of a coordinate of the residuals, mm."""
    squares = [np.einsum("mcr,mr->mc", part.in_mm, part.residual).ravel() ** 2 for part in rows]
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def wider(relations: Sequence[Block], added: int) -> list[Block]:
    """Relations where there are further shared unknowns, of which they say nothing."""
    return [block._replace(shared=np.pad(block.shared, ((0, 0), (0, added)))) for block in relations]


def linearisation_of(
    record: CalibrationRecord, names: Sequence[str], *, noise: Noise | None, lengths: bool = True
) -> Linearisation:
    """A calibration linear at its solution, by some parameters, weighted by the noise, or where that is None by the
    scatter of its tips; with reference lengths as relations, or without."""
    capture = record.recording.capture if lengths else without_lengths(record.recording.capture)
    arm = record.calibrated.arm
    observed, arm, noise = to_numpy((Observed.of(capture, arm), arm, noise))
    space, metrics = Parameters(arm, tuple(names)), record.observed
    geometry = [np.asarray(metrics.geometry[part]) for part in observed.blocks]
    z, sigma = np.concatenate([np.asarray(space.vector()), *geometry]), np.asarray(metrics.sigma)
    linear = Linearisation.at(observed, space, z, noise=noise, sigma=sigma, least=LEAST_U)
    weights = [np.asarray(weight) for weight in metrics.weights]
    if all(np.all(weight == 1) for weight in weights):
        return linear
    of_groups = [np.concatenate([weights[number] for number in group.members]) for group in observed.layout.groups]
    return linear._replace(weights=[*of_groups, *linear.weights[len(of_groups) :]])


def lengths_in_solve(record: CalibrationRecord) -> bool:
    """Whether reference lengths took part in the least squares, and not only as the scale afterwards."""
    return record.final_method == "joint" and bool(record.recording.capture.lengths)


def scale_anchor_of(record: CalibrationRecord) -> str | None:
    """The length that is kept, because residuals of sockets vanish where the whole arm shrinks."""
    lengths = [name for name in record.names if is_length(name)]
    if record.hold is not None or record.scale_set_by or not lengths:
        return record.hold
    return max(lengths, key=lambda name: abs(value_of(record.calibrated.arm, name)))
