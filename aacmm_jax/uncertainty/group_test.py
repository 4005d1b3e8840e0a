"""Whether groups of poses contradict the others: F tests of the residuals that each group adds to a least squares.

A group with an error of its own (readings of a joint that were shifted while one socket was recorded) changes the
parameters, so that its residuals show little of the error. The test compares the least squares with and without the
group. The second is one Gauss-Newton step away, by the normal equations less the group's part of them (case deletion:
Cook and Weisberg, "Residuals and Influence in Regression", 1982, section 3.6), so that nothing is identified again.
"""

from collections.abc import Hashable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.distributions import f_tail

_NULL = 1e-10  # eigenvalues of the normal matrix below this, of the largest, are zero
_AS_WELL = 2.0  # ratio of the variances of what remains, up to which two groups explain a contradiction equally well


class GroupTest(NamedTuple):
    """One group against those that remain."""

    group: Hashable
    ratio: float  # F: mean square that the group adds, over the mean square of the others without it
    degrees_of_freedom: tuple[int, int]
    probability: float  # of this ratio or a larger one, where nothing is wrong
    variance: float  # of the others without it, in units of what was expected
    step: Float[np.ndarray, " p"]  # from the given parameters to those of the others alone


class _Gram(NamedTuple):
    """Gram matrix of the derivatives by the parameters, the residual and the derivatives by the fixture's unknowns."""

    matrix: Float[np.ndarray, "m m"]
    rows: int

    def plus(self, other: "_Gram") -> "_Gram":
        return _Gram(self.matrix + other.matrix, self.rows + other.rows)

    def less(self, other: "_Gram") -> "_Gram":
        return _Gram(self.matrix - other.matrix, self.rows - other.rows)


class _Fit(NamedTuple):
    cost: float  # sum of squares
    degrees_of_freedom: int
    step: np.ndarray

    @classmethod
    def of(cls, gram: _Gram) -> "_Fit":
        information, gradient = gram.matrix[:-1, :-1], gram.matrix[:-1, -1]
        values, vectors = np.linalg.eigh(information)
        known = values > _NULL * values.max(initial=0.0)
        step = -vectors[:, known] @ ((vectors[:, known].T @ gradient) / values[known])
        cost = float(gram.matrix[-1, -1] + step @ gradient)
        return cls(max(cost, 0.0), gram.rows - int(known.sum()), step)


def contradicting_groups(
    residual: Float[np.ndarray, "N c"],
    jacobian: Float[np.ndarray, "N c p"],
    by_fixture: Float[np.ndarray, "N c k"],
    fixtures: Sequence[Hashable],
    groups: Sequence[Hashable],
    *,
    level: float = 0.01,
    least_ratio: float = 1.0,
) -> list[list[GroupTest]]:
    """Find the groups of poses that contradict the others.

    Several such groups hide each other, so groups are taken out one after the other, always the one with the largest
    ratio, as long as it is significant, up to half of them (after Rosner 1983, Technometrics 25). Found are the last
    one that reaches ``least_ratio`` and all before it.

    Args:
        residual: Residual of every pose in units of its standard deviation, at parameters near the solution.
        jacobian: Its derivatives by the free parameters.
        by_fixture: Its derivatives by the unknowns of the fixture that held the tip (the position of a socket).
        fixtures: The fixture of every pose.
        groups: The group of every pose.
        level: Probability of finding any group where nothing is wrong (Bonferroni's bound).
        least_ratio: The smallest ratio of a group that is found.

    Returns:
        The test of each group that was found, without those before it; and after it, as its alternatives, the tests of
        groups without which the others agree as well (of two groups that contradict each other, either).
    """
    poses: dict[tuple[Hashable, Hashable], list[int]] = {}
    for pose, both in enumerate(zip(fixtures, groups, strict=True)):
        poses.setdefault(both, []).append(pose)
    parts: dict[Hashable, dict[Hashable, _Gram]] = {}
    columns = np.concatenate([jacobian, residual[:, :, None], by_fixture], axis=2)
    for (fixture, group), chosen in poses.items():
        rows = columns[chosen].reshape(-1, columns.shape[2])
        parts.setdefault(fixture, {})[group] = _Gram(rows.T @ rows, len(rows))
    removed: list[Hashable] = []
    found: list[list[GroupTest]] = []
    number = 0
    for _ in range(len(dict.fromkeys(groups)) // 2):
        tests = _tests(parts, removed, by_fixture.shape[2])
        significant = [test for test in tests if test.probability * len(tests) < level]
        if not significant:
            break
        worst = max(significant, key=lambda test: test.ratio)
        alternatives = [test for test in significant if test is not worst and test.ratio >= least_ratio]
        found.append([worst, *(test for test in alternatives if test.variance < _AS_WELL * worst.variance)])
        removed.append(worst.group)
        if worst.ratio >= least_ratio:
            number = len(found)
    return found[:number]


def _tests(
    parts: Mapping[Hashable, Mapping[Hashable, _Gram]], removed: Sequence[Hashable], unknowns: int
) -> list[GroupTest]:
    """Every group that is left against the others; not those that add no equation, or leave none to compare."""

    def eliminated(fixture: Hashable, *without: Hashable) -> _Gram | None:
        """The sum over a fixture's groups, less what its unknowns account for."""
        grams = [gram for group, gram in parts[fixture].items() if group not in (*removed, *without)]
        if not grams:
            return None
        matrix, rows = reduce(_Gram.plus, grams)
        size = len(matrix) - unknowns
        crossed = matrix[size:, :size]
        accounted = crossed.T @ np.linalg.solve(matrix[size:, size:], crossed)
        return _Gram(matrix[:size, :size] - accounted, rows - unknowns)

    whole = {fixture: gram for fixture in parts if (gram := eliminated(fixture)) is not None}
    if not whole:
        return []
    total = reduce(_Gram.plus, whole.values())
    everything, tests = _Fit.of(total), []
    for group in dict.fromkeys(group for fixture in whole for group in parts[fixture] if group not in removed):
        rest = total
        for fixture in whole:
            if group in parts[fixture]:
                kept, rest = eliminated(fixture, group), rest.less(whole[fixture])
                rest = rest if kept is None else rest.plus(kept)
        others = _Fit.of(rest)
        added, spare = everything.degrees_of_freedom - others.degrees_of_freedom, others.degrees_of_freedom
        if added > 0 and spare > 0:
            variance = max(others.cost / spare, 1e-300)
            ratio = max(everything.cost - others.cost, 0.0) / added / variance
            tests.append(GroupTest(group, ratio, (added, spare), f_tail(ratio, added, spare), variance, others.step))
    return tests
