"""Whether groups of poses contradict the others: F tests of the residuals that each group adds to a least squares.

A group with an error of its own (readings of a joint that were shifted while one socket was recorded) changes the
parameters, so that its residuals show little of the error. The test compares the least squares with and without the
group. The second is one Gauss-Newton step away, by the normal equations less the group's part of them (case deletion:
Cook and Weisberg, "Residuals and Influence in Regression", 1982, section 3.6), so that nothing is identified again.

What an error of its own may be (a joint's zero, a remounted probe) is tested likewise: by unknowns that only the group
has, which must explain what it contradicts.
"""

from collections.abc import Hashable, Mapping, Sequence
from functools import reduce
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

    Blocks of one fixture have the same unknowns of their own. Those whose group is None are never taken out.
    """

    fixture: Hashable
    group: Hashable | None
    residual: Float[np.ndarray, " r"]
    shared: Float[np.ndarray, "r p"]  # by the parameters, and by what several fixtures share
    own: Float[np.ndarray, "r k"]  # by what only this fixture has, such as the position of a socket


class _Gram(NamedTuple):
    """Gram matrix of the derivatives by the parameters, the residual and the derivatives by the fixture's unknowns."""

    matrix: Float[np.ndarray, "m m"]
    rows: int

    @classmethod
    def of(cls, block: Block) -> "_Gram":
        columns = np.concatenate([block.shared, block.residual[:, None], block.own], axis=1)
        return cls(columns.T @ columns, len(columns))

    def plus(self, other: "_Gram") -> "_Gram":
        return _Gram(self.matrix + other.matrix, self.rows + other.rows)

    def less(self, other: "_Gram") -> "_Gram":
        return _Gram(self.matrix - other.matrix, self.rows - other.rows)

    def without_own(self, unknowns: int) -> "_Gram":
        """Less what the fixture's own unknowns account for."""
        size = len(self.matrix) - unknowns
        if not unknowns:
            return self
        inverse, rank = _inverse(self.matrix[size:, size:], np.diag(self.matrix)[size:])
        crossed = self.matrix[size:, :size]
        return _Gram(self.matrix[:size, :size] - crossed.T @ inverse @ crossed, self.rows - rank)


class Fit(NamedTuple):
    """A least squares from its Gram matrix."""

    cost: float  # sum of squares
    degrees_of_freedom: int
    step: np.ndarray

    @classmethod
    def of(cls, gram: _Gram, diagonal: Float[np.ndarray, " p"]) -> "Fit":
        """``diagonal``: that of the whole normal matrix, against which what is left of a column may be rounding."""
        information, gradient = gram.matrix[:-1, :-1], gram.matrix[:-1, -1]
        inverse, rank = _inverse(information, diagonal)
        step = -inverse @ gradient
        cost = float(gram.matrix[-1, -1] + step @ gradient)
        return cls(max(cost, 0.0), gram.rows - rank, step)


def _inverse(matrix: Float[np.ndarray, "p p"], diagonal: Float[np.ndarray, " p"]) -> tuple[np.ndarray, int]:
    """The pseudo-inverse of a normal matrix whose columns are first scaled, and its rank."""
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
    present = values > _NULL * values.max(initial=0.0)
    rows = (scale[:, None] * vectors)[:, present]
    return (rows / values[present]) @ rows.T, int(present.sum())


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
    parts = _Parts.of(blocks)
    removed: list[Hashable] = []
    contradicting: list[list[GroupTest]] = []
    number = 0
    for _ in range(len(parts.groups) // 2):
        tests = parts.tests(removed)
        significant = [test for test in tests if test.probability * len(tests) < level]
        if not significant:
            break
        worst = max(significant, key=lambda test: test.ratio)
        alternatives = [test for test in significant if test is not worst and test.ratio >= least_ratio]
        contradicting.append([worst, *(test for test in alternatives if test.variance < _AS_WELL * worst.variance)])
        removed.append(worst.group)
        if worst.ratio >= least_ratio:
            number = len(contradicting)
    return contradicting[:number]


def fit_of(blocks: Sequence[Block]) -> Fit:
    """The least squares of some of the equations."""
    parts = _Parts.of(blocks)
    whole = reduce(_Gram.plus, parts.eliminated([]).values())
    return Fit.of(whole, np.diag(whole.matrix)[:-1])


def different_groups(blocks: Sequence[Block]) -> list[GroupTest]:
    """Each group against the others by parameters of its own, the largest ratio first.

    A group that is larger than the number of parameters adds many residuals, among which an error of its own is
    diluted; that it needs other parameters than the others is not (Chow 1960, Econometrica 28). What belongs to no
    group counts with both sides: it relates unknowns that only one of them has.
    """
    whole, tests = fit_of(blocks), []
    for group in _Parts.of(blocks).groups:
        own = fit_of([block for block in blocks if block.group in (group, None)])
        others = fit_of([block for block in blocks if block.group != group])
        freedom = own.degrees_of_freedom + others.degrees_of_freedom
        again = sum(block.residual.size for block in blocks if block.group is None)
        added = whole.degrees_of_freedom + again - freedom
        if added > 0 and min(own.degrees_of_freedom, others.degrees_of_freedom) > 0:
            apart = own.cost + others.cost
            tests.append(GroupTest.of(group, added, whole.cost - apart, apart, freedom, others.step))
    return sorted(tests, key=lambda test: -test.ratio)


class _Parts(NamedTuple):
    """Gram matrices by fixture and group."""

    grams: Mapping[Hashable, Mapping[Hashable | None, _Gram]]
    unknowns: Mapping[Hashable, int]  # own ones of each fixture

    @classmethod
    def of(cls, blocks: Sequence[Block]) -> "_Parts":
        grams: dict[Hashable, dict[Hashable | None, _Gram]] = {}
        for block in blocks:
            of_fixture, gram = grams.setdefault(block.fixture, {}), _Gram.of(block)
            of_fixture[block.group] = of_fixture[block.group].plus(gram) if block.group in of_fixture else gram
        return cls(grams, {block.fixture: block.own.shape[1] for block in blocks})

    @property
    def groups(self) -> list[Hashable]:
        return [g for g in dict.fromkeys(g for of in self.grams.values() for g in of) if g is not None]

    def eliminated(self, without: Sequence[Hashable]) -> dict[Hashable, _Gram]:
        """The sum over each fixture's groups, less what its unknowns account for."""
        sums = {}
        for fixture, grams in self.grams.items():
            kept = [gram for group, gram in grams.items() if group is None or group not in without]
            if kept:
                sums[fixture] = reduce(_Gram.plus, kept).without_own(self.unknowns[fixture])
        return sums

    def tests(self, removed: Sequence[Hashable]) -> list[GroupTest]:
        """Every group that is left against the others; not those that add no equation, or leave none to compare."""
        whole = self.eliminated(removed)
        if not whole:
            return []
        total = reduce(_Gram.plus, whole.values())
        diagonal = np.diag(total.matrix)[:-1]
        everything, tests = Fit.of(total, diagonal), []
        touched: dict[Hashable, list[Hashable]] = {}
        for fixture in whole:
            for group in self.grams[fixture]:
                if group is not None and group not in removed:
                    touched.setdefault(group, []).append(fixture)
        for group, fixtures in touched.items():
            part = _Parts({fixture: self.grams[fixture] for fixture in fixtures}, self.unknowns)
            rest = reduce(_Gram.less, (whole[fixture] for fixture in fixtures), total)
            rest = reduce(_Gram.plus, part.eliminated([*removed, group]).values(), rest)
            others = Fit.of(rest, diagonal)
            added, freedom = everything.degrees_of_freedom - others.degrees_of_freedom, others.degrees_of_freedom
            if added > 0 and freedom > 0:
                gain = everything.cost - others.cost
                tests.append(GroupTest.of(group, added, gain, others.cost, freedom, others.step))
        return tests
