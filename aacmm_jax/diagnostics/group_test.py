"""Whether groups of poses contradict the others: F tests of the residuals that each group adds to a least squares.

A group with an error of its own (readings of a joint that were shifted while one socket was recorded) changes the
parameters, so that its residuals show little of the error. The test compares the least squares with and without the
group. The second is one Gauss-Newton step away, by the normal equations less the group's part of them (case deletion:
Cook and Weisberg, "Residuals and Influence in Regression", 1982, section 3.6), so that nothing is identified again.

What an error of its own may be (a joint's zero, a remounted probe) is tested likewise: by unknowns that only the group
has, which must explain what it contradicts.
"""

from collections.abc import Hashable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import f_tail

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
    own: Float[np.ndarray, "r k"]  # by what only this fixture has, such as the position of a socket


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
            columns = np.concatenate([block.shared, block.residual[:, None], block.own], axis=1)
            whole, size, rank = columns.T @ columns, block.shared.shape[1] + 1, 0
            part = whole[:size, :size]
            if block.own.shape[1]:
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
    blocks: Sequence[Block], *, level: float = 0.01, least_ratio: float = 1.0
) -> list[list[GroupTest]]:
    """Find the groups of poses that contradict the others.

    Several such groups hide each other, so groups are taken out one after the other, always the one with the largest
    ratio, as long as it is significant, up to half of them (after Rosner 1983, Technometrics 25). Found are the last
    one that reaches ``least_ratio`` and all before it.

    ``level`` is the probability of finding any group where nothing is wrong (Bonferroni's bound). Returned are the test
    of each group that was found, without those before it; and after it, as its alternatives, the tests of groups
    without which the others agree as well (of two groups that contradict each other, either).
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
        for group, gram in grams.items():
            if group is None:
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
        own = fit_of([block for block in blocks if block.group in (group, None)])
        others = fit_of([block for block in blocks if block.group != group])
        freedom = own.degrees_of_freedom + others.degrees_of_freedom
        again = sum(block.residual.size for block in blocks if block.group is None)
        added = whole.degrees_of_freedom + again - freedom
        if added > 0 and min(own.degrees_of_freedom, others.degrees_of_freedom) > 0:
            apart = own.cost + others.cost
            tests.append(GroupTest.of(group, added, whole.cost - apart, apart, freedom, others.step))
    return sorted(tests, key=lambda test: -test.ratio)
