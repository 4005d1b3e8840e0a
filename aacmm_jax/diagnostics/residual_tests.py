"""Tests of the residuals that a least squares leaves: whether further columns explain them, and quadratic forms.

Rows are whitened: where model and noise are right, errors are independent with one variance. The residual is r = M e,
with M the projector onto what the unknowns of the model cannot explain. Whether they have a further unknown with
columns C is a score test, which needs no new fit: with D = M C, the gain is the drop of r.r that a step along D gives,
r'D (D'D)^+ D'r, and its F ratio has the F distribution exactly (Rao 1948; Breusch and Pagan 1980, Review of Economic
Studies 47). Whether the errors of some rows are larger than those of others, or alike, is seen in a quadratic form
r'A r. Its distribution follows from the traces of MA, (MA)^2 and (MA)^3 by Pearson's three-moment chi-square (Imhof
1961, Biometrika 48, eq. 4.1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.distributions import chi_square_tail, f_tail
from ..core.linear_algebra import inverse_cholesky
from .equations import Block, Rows

LEVEL = 0.01  # of false alarms of one family of tests
SURE = LEVEL / 5  # of those families that say what is wrong, of which there are many
_NULL = 1e-5  # singular values of scaled columns below this, of the largest, are zero
_MANY = 60  # columns, from which singular values are avoided where possible
PRESENT = 1e-6  # part of a direction of a pose that the model leaves, below which nothing is left
_EXPLAINED = 1e-8  # squared part of a column that the model leaves, below which it counts as the model's own


class Residuals(NamedTuple):
    """What a linear least squares leaves of all rows, part after part."""

    slices: tuple[slice, ...]  # rows of each part
    private: tuple[Float[np.ndarray, "r k"], ...]  # orthonormal columns of each part's own unknowns
    basis: Float[np.ndarray, "R q"]  # orthonormal columns of the shared unknowns, less the own
    values: Float[np.ndarray, " R"]

    @classmethod
    def of(cls, parts: Sequence[Block]) -> "Residuals":
        """The least squares of some equations."""
        ends = np.cumsum([len(part.residual) for part in parts])
        slices = tuple(slice(end - len(part.residual), end) for part, end in zip(parts, ends, strict=True))
        values = np.concatenate([part.residual for part in parts])
        empty = cls(slices, tuple(orthonormal(part.private) for part in parts), np.zeros((len(values), 0)), values)
        empty = empty._replace(values=empty.unexplained(values[:, None])[:, 0])
        return empty.extended(np.concatenate([part.shared for part in parts]))

    @property
    def degrees_of_freedom(self) -> int:
        """Rows less unknowns that the rows determine."""
        return len(self.values) - self.basis.shape[1] - sum(columns.shape[1] for columns in self.private)

    @property
    def cost(self) -> float:
        """Sum of squares."""
        return float(self.values @ self.values)

    def unexplained(self, columns: Float[np.ndarray, "R c"]) -> Float[np.ndarray, "R c"]:
        """M times some columns."""
        rest = np.array(columns)
        for rows, private in zip(self.slices, self.private, strict=True):
            rest[rows] -= private @ (private.T @ rest[rows])
        return rest - self.basis @ (self.basis.T @ rest)

    def extended(self, columns: Float[np.ndarray, "R c"]) -> "Residuals":
        """The least squares with further unknowns, whose columns are given: last in ``basis``."""
        added = orthonormal(self.unexplained(columns), columns)
        basis = np.concatenate([self.basis, added], axis=1)
        return self._replace(basis=basis, values=self.values - added @ (added.T @ self.values))


def orthonormal(columns: Float[np.ndarray, "R c"], before: Float[np.ndarray, "R c"] | None = None) -> np.ndarray:
    """A basis of some columns, which were those ``before`` something was taken from them."""
    lengths = np.linalg.norm(columns if before is None else before, axis=0)
    scaled = columns / np.where(lengths > 0, lengths, 1.0)
    if scaled.shape[1] >= _MANY and (basis := _of_full_rank(scaled)) is not None:
        return basis
    vectors, values, _ = np.linalg.svd(scaled, full_matrices=False)
    return vectors[:, values > _NULL * values.max(initial=0.0)]


def _of_full_rank(columns: Float[np.ndarray, "R c"]) -> Float[np.ndarray, "R c"] | None:
    """An orthonormal basis by the Cholesky factor, twice, in a third of the time of singular values (Yamamoto et al.
    2015, ETNA 44, 306-326); None where a singular value could be below `_NULL` of the largest."""
    for _ in range(2):
        whitening = inverse_cholesky(columns.T @ columns)
        size = np.linalg.norm(whitening) * np.linalg.norm(columns)  # at least the largest over the smallest
        if not size * _NULL < 1:
            return None
        columns = columns @ whitening.T
    return columns


class ScoreTest(NamedTuple):
    """Whether further unknowns explain residuals."""

    gain: float  # drop of the sum of squares
    ratio: float  # F
    degrees_of_freedom: tuple[int, int]
    probability: float  # of this ratio or a larger one, where the model is right
    coefficients: Float[np.ndarray, " c"]


class Candidates(NamedTuple):
    """Columns of further unknowns, and what the model leaves of them."""

    parts: tuple[slice, ...]  # columns of each candidate
    lengths: Float[np.ndarray, " c"]  # of the columns before anything was taken from them
    projected: Float[np.ndarray, "R c"]  # over these lengths

    @classmethod
    def of(cls, left: Residuals, candidates: Sequence[Float[np.ndarray, "R _"]]) -> "Candidates":
        """Candidates, each given by its columns."""
        columns = np.concatenate([np.zeros((len(left.values), 0)), *candidates], axis=1)
        ends = np.cumsum([candidate.shape[1] for candidate in candidates])
        lengths = np.linalg.norm(columns, axis=0)
        lengths = np.where(lengths > 0, lengths, 1.0)
        parts = tuple(slice(end - c.shape[1], end) for end, c in zip(ends, candidates, strict=True))
        return cls(parts, lengths, left.unexplained(columns / lengths))

    def less(self, added: Float[np.ndarray, "R a"]) -> "Candidates":
        """What is left of them by a model with further orthonormal columns."""
        return self._replace(projected=self.projected - added @ (added.T @ self.projected))

    def tests(self, left: Residuals, least: float = 0.0) -> list[ScoreTest]:
        """Each against the model. A column of which the model leaves less than ``least`` counts as the model's own."""
        norms = np.linalg.norm(self.projected, axis=0)
        present = (norms**2 > _EXPLAINED) & (self.lengths * norms > least)
        columns, score = np.where(present, self.projected, 0.0), np.where(present, left.values @ self.projected, 0.0)
        starts, widths = (
            np.array([(part.start, part.stop - part.start) for part in self.parts], dtype=int).reshape(-1, 2).T
        )
        gains, ranks, steps = np.zeros(len(widths)), np.zeros(len(widths), dtype=int), np.zeros(len(score))
        for width in np.unique(widths[widths > 0]):  # all of one width at once
            among = widths == width
            index = starts[among][:, None] + np.arange(width)
            of_each = np.moveaxis(columns[:, index], 0, 1)
            values, vectors = np.linalg.eigh(of_each.swapaxes(1, 2) @ of_each)
            seen = values > _EXPLAINED
            along = np.where(seen, np.einsum("nab,na->nb", vectors, score[index]), 0.0)
            over = along / np.where(seen, values, 1.0)
            gains[among], ranks[among] = np.sum(along * over, axis=1), seen.sum(axis=1)
            steps[index] = np.einsum("nab,nb->na", vectors, over)
        steps, tests, available, cost = steps / self.lengths, [], left.degrees_of_freedom, left.cost
        for part, gain, added in zip(self.parts, gains.tolist(), ranks.tolist(), strict=True):
            freedom = available - added
            test = ScoreTest(0.0, 0.0, (added, freedom), 1.0, steps[part])
            if added and freedom > 0:
                ratio = gain / added / max((cost - gain) / freedom, 1e-300)
                test = ScoreTest(gain, ratio, (added, freedom), f_tail(ratio, added, freedom), steps[part])
            tests.append(test)
        return tests


def score_tests(left: Residuals, candidates: Sequence[Float[np.ndarray, "R _"]], least: float = 0.0) -> list[ScoreTest]:
    """Each candidate, given by its columns, against the model, whatever the level of the noise is.

    A column of which the model leaves less than ``least`` counts as the model's own; a candidate that the model
    explains itself has the probability 1.
    """
    return Candidates.of(left, candidates).tests(left, least)


class Consistency(NamedTuple):
    """Relations between unknowns (reference lengths) against what the other equations and each other say of them."""

    square: float  # chi-square
    degrees_of_freedom: int
    shifts: Float[np.ndarray, " l"]  # of each from what all others say
    gains: Float[np.ndarray, " l"]  # drop of the square without it; 0 where nothing else says anything of it


def consistency(
    parts: Sequence[Block],
    relations: Block,
    covariance: Float[np.ndarray, "l l"],
    open_direction: tuple[Float[np.ndarray, " R"], Float[np.ndarray, " l"]] | None = None,
) -> Consistency:
    """What relations add to a least squares of other equations; whatever those leave open, the relations determine.

    ``covariance`` is that of the relations' own errors, and ``open_direction`` the derivatives of the equations and of
    the relations by an unknown that only the relations determine, such as the scale.
    """
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    whitened = relations._replace(residual=root @ relations.residual, shared=root @ relations.shared)
    without, whole = Residuals.of(parts), Residuals.of([*parts, whitened])
    if open_direction is not None:
        # Of the equations, what their other unknowns imitate: of the rest they must say nothing.
        of_equations, of_relations = open_direction[0][:, None], root @ open_direction[1]
        column = np.concatenate([of_equations - without.unexplained(of_equations), of_relations[:, None]])
        if np.linalg.norm(whole.unexplained(column)) > _NULL * np.linalg.norm(of_relations):
            whole = whole.extended(column)
    # An error of each, which explains all that it alone says.
    tests = score_tests(whole, [np.pad(column, (len(without.values), 0))[:, None] for column in root.T])
    return Consistency(
        whole.cost - without.cost,
        whole.degrees_of_freedom - without.degrees_of_freedom,
        np.array([float(np.sum(test.coefficients)) for test in tests]),
        np.array([test.gain for test in tests]),
    )


class FormTest(NamedTuple):
    """A quadratic form of residuals over its expectation."""

    ratio: float
    probability: float  # of this value or a larger one, where the noise is as stated
    degrees_of_freedom: float  # of a chi-square variable with the same relative variance


Kernels = Sequence[Float[np.ndarray, "_ _ _"] | None]


def form_test(left: Residuals, kernels: Kernels, relative: bool) -> FormTest:
    """Whether a quadratic form r'A r of the residuals is larger than independent errors make it.

    A is block by block: the symmetric ones (m, r, r) of each part stand for its m r rows, one for each pose or one for
    all (``alike``). Parts without any, and those that follow, have no part in it. Where it is ``relative``, the form
    is compared with the variance of all residuals instead of 1.
    """
    freedom, (value, traces) = left.degrees_of_freedom, _value_and_traces(left, kernels)
    t1, t2, t3 = traces
    if relative:
        # r'A r > x r'r, which is r'(A - x I) r > 0.
        x = value / max(left.cost, 1e-300)
        shifted = (t1 - x * freedom, t2 - 2 * x * t1 + x**2 * freedom)
        shifted = (*shifted, t3 - 3 * x * t2 + 3 * x**2 * t1 - x**3 * freedom)
        probability, expected = _tail(0.0, shifted), t1 * left.cost / max(freedom, 1)
    else:
        probability, expected = _tail(value, traces), t1
    ratio = value / expected if expected > 0 else float("nan")
    return FormTest(ratio, probability, t1**2 / max(t2, 1e-300))


def alike(
    columns: Float[np.ndarray, "m r c"], poses: Float[np.ndarray, "m m"] | Bool[np.ndarray, "m m"]
) -> Float[np.ndarray, "1 R R"]:
    """The block of shared errors by some columns each, as much as ``poses`` says of each two."""
    flat, rows = columns.reshape(-1, columns.shape[2]), columns.shape[1]
    return (np.kron(poses, np.ones((rows, rows))) * (flat @ flat.T))[None]


def in_succession(poses: int) -> Float[np.ndarray, "m m"]:
    """For `alike`: half a correlation with the pose before and half with the one after."""
    return (np.eye(poses, k=1) + np.eye(poses, k=-1)) / 2


def chance_above_zero(left: Residuals, kernels: Kernels) -> float:
    """Probability that independent errors make a form positive: with A - x B for A, where x is the ratio of r'A r to
    r'B r that was found, that of a larger ratio."""
    return _tail(0.0, _value_and_traces(left, kernels)[1])


def _value_and_traces(left: Residuals, kernels: Kernels) -> tuple[float, tuple[float, float, float]]:
    """r'A r, and the traces of the first powers of MA, with M = I - Q Q' and the columns Q of all unknowns.

    With G_k = Q' A^k Q, tr (MA)^2 = tr A^2 - 2 tr G_2 + tr G_1^2, and tr (MA)^3 = tr A^3 - 3 tr G_3 + 3 tr G_1 G_2 -
    tr G_1^3. Q is [O B] with the parts' own columns O, of which those of different parts do not meet in G.
    """
    width = left.basis.shape[1]
    shared = np.zeros((3, width, width))  # B' A^k B
    mixed = np.zeros((width, width))  # B' A O O' A B
    value = t1 = t2 = t3 = 0.0
    for rows, private, kernel in zip(left.slices, left.private, kernels, strict=False):
        if kernel is None:
            continue
        poses, size = kernel.shape[:2]
        k2 = kernel @ kernel
        r, basis = left.values[rows].reshape(poses, size), left.basis[rows]
        o = private.reshape(poses, size, -1)
        value += float(np.einsum("ma,mab,mb->", r, kernel, r))
        ko, k2o = (kernel @ o).reshape(private.shape), (k2 @ o).reshape(private.shape)
        kb, k2b = ((k @ basis.reshape(poses, size, -1)).reshape(basis.shape) for k in (kernel, k2))
        shared += np.stack([basis.T @ kb, basis.T @ k2b, kb.T @ k2b])
        d1, d2, d3, e1, e2 = private.T @ ko, private.T @ k2o, ko.T @ k2o, private.T @ kb, private.T @ k2b
        mixed += e1.T @ e1
        t1 += float(np.einsum("maa->", kernel)) - float(np.trace(d1))
        t2 += float(np.sum(kernel**2)) - 2 * float(np.trace(d2)) + float(np.sum(d1**2)) + 2 * float(np.sum(e1**2))
        t3 += float(np.sum(kernel * k2)) - 3 * float(np.trace(d3))
        t3 += 3 * float(np.sum(d1 * d2)) + 6 * float(np.sum(e1 * e2))
        t3 -= float(np.trace(d1 @ d1 @ d1)) + 3 * float(np.sum((d1 @ e1) * e1))
    g1, g2, g3 = shared
    t1 -= float(np.trace(g1))
    t2 += float(np.sum(g1**2)) - 2 * float(np.trace(g2))
    t3 += 3 * float(np.sum(g1 * g2)) - 3 * float(np.trace(g3))
    t3 -= float(np.trace(g1 @ g1 @ g1)) + 3 * float(np.sum(mixed * g1))
    return value, (t1, t2, t3)


def _tail(value: float, traces: tuple[float, float, float]) -> float:
    """Probability that a quadratic form of normal errors exceeds a value, from its first three cumulants."""
    t1, t2, t3 = traces
    if t2 <= 0:
        return 1.0
    if abs(t3) < 1e-3 * t2**1.5:
        t3 = 1e-3 * t2**1.5  # as good as normal
    freedom = t2**3 / t3**2
    argument = freedom + np.sign(t3) * (value - t1) * np.sqrt(freedom / t2)
    upper = chi_square_tail(max(float(argument), 0.0), freedom)
    return upper if t3 > 0 else 1 - upper


class Studentised(NamedTuple):
    """The residuals of one part in units of their own standard deviations, pose by pose."""

    values: Float[np.ndarray, "m r"]  # 0 in directions of which the model leaves nothing
    root: Float[np.ndarray, "m r r"]  # B^(1/2), with the covariance B of a pose's residuals
    present: Float[np.ndarray, " m"]  # directions of each pose


def studentised(part: Rows, left: Residuals, rows: slice, private: Float[np.ndarray, "R k"]) -> Studentised:
    """The residuals of the poses of one part, each in units of its own standard deviations."""
    columns = np.concatenate([private, left.basis[rows]], axis=1).reshape(*part.residual.shape, -1)
    block = np.eye(columns.shape[1]) - columns @ columns.swapaxes(1, 2)
    values, vectors = np.linalg.eigh(block)
    present = values > PRESENT
    roots = np.sqrt(np.where(present, values, 0.0))
    along = np.einsum("mab,ma->mb", vectors, left.values[rows].reshape(part.residual.shape))
    along = np.where(present, along / np.where(present, roots, 1.0), 0.0)
    root = (vectors * roots[:, None, :]) @ vectors.swapaxes(1, 2)
    return Studentised(np.einsum("mab,mb->ma", vectors, along), root, present.sum(axis=1))
