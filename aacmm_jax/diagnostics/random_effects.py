"""Errors that poses share, as random effects: how large they are by the residuals.

The model of a calibration leaves residuals r = M e of whitened errors e, M the projector onto what its unknowns cannot
explain (`residual_tests`). Errors that poses share are e = w + sum_g Z_g c_g: independent ones w of one variance s, and
columns Z_g (the tips of all poses of a visit move alike; a joint turns by an unknown coefficient times a known
function) times coefficients of variance v_g. The likelihood of r depends on the variances through D_g = M Z_g alone
(REML: Patterson and Thompson 1971, Biometrika 58, 545-554). The calibration stays as it is. Its parameters follow a
shared error as they follow any other error of the tips, z = K c, so its covariance grows by K v K^T.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..uncertainty.evidence import Groups, PriorModel, covariance_of_log_variances, learned_log_variances
from .residual_tests import Residuals

_ROUNDS = 40  # of the variance of independent errors; usually 5
_TOLERANCE = 1e-6
NULL = 1e-6  # eigenvalues of an effect's information below this, of the largest, are zero
# Standard deviations at which the likelihood of one effect is computed: how many, and between which parts of the usual.
_GRID, _RANGE = 80, (0.01, 100.0)
_LEAST_LOG = 2 * np.log(1e-4)  # smallest log variance of a learned group, in natural steps


class Effects(NamedTuple):
    """Effects that are known so far next to independent errors: columns, and the variance of each coefficient.

    Whatever a further effect is compared with has the covariance ``variance`` I + D diag(variances) D^T.
    """

    left: Residuals
    given: bool  # whether the variance of independent errors is 1, as given
    columns: Float[np.ndarray, "R k"]
    variances: Float[np.ndarray, " k"]
    variance: float  # of independent errors

    @classmethod
    def none(cls, left: Residuals, given: bool) -> "Effects":
        """Nothing but independent errors."""
        variance = 1.0 if given else left.cost / left.degrees_of_freedom
        return cls(left, given, np.zeros((len(left.values), 0)), np.zeros(0), variance)

    def product(self, one: Float[np.ndarray, "R a"], other: Float[np.ndarray, "R b"]) -> Float[np.ndarray, "a b"]:
        """one^T (I + D diag(variances / variance) D^T)^-1 other."""
        if not len(self.variances):
            return one.T @ other
        d = self.columns * np.sqrt(self.variances / self.variance)
        return one.T @ other - (one.T @ d) @ np.linalg.solve(np.eye(d.shape[1]) + d.T @ d, d.T @ other)

    def joined(self, columns: Float[np.ndarray, "R c"], variances: Float[np.ndarray, " c"]) -> "Effects":
        """With a further effect, whose columns the model has not explained; the variance of independent errors is the
        one with which the residuals are as large as they should be."""
        effects = self._replace(
            columns=np.concatenate([self.columns, columns], axis=1),
            variances=np.concatenate([self.variances, variances]),
        )
        if self.given:
            return effects
        d, r = effects.columns * np.sqrt(effects.variances), self.left.values
        values, vectors = np.linalg.eigh(d.T @ d)
        seen, values = (vectors.T @ (d.T @ r)) ** 2, np.maximum(values, 0.0)
        variance = self.variance
        for _ in range(_ROUNDS):
            explained = float(np.sum(seen / (variance + values)))
            new = max(self.left.cost - explained, 1e-12 * self.left.cost) / self.left.degrees_of_freedom
            change, variance = abs(np.log(new / variance)), new
            if change < _TOLERANCE:
                break
        return effects._replace(variance=variance)


class OneVariance(NamedTuple):
    """An effect of one variance, every coefficient a displacement of the tip: how large the variance may be."""

    variance: float  # as stated, mm^2
    ratios: Float[np.ndarray, " k"]  # of those that are possible to that one
    weights: Float[np.ndarray, " k"]  # their probabilities
    log_likelihood: float  # its maximum over that without the effect


def one_variance(effects: Effects, columns: Float[np.ndarray, "R c"], usual: float) -> OneVariance:
    """The variance of one more effect, with its posterior distribution.

    Beforehand the standard deviation has a half-Cauchy distribution: as probable anywhere below what is ``usual``, and
    less and less above, which few data would not exclude (Gelman 2006, Bayesian Analysis 1, 515-534, section 7, for
    just such effects of a few groups). What residuals show is the sum of the effect and of the independent errors in
    its place; stated is the geometric mean of that sum, less the errors. Intervals do not follow from it alone, but
    from the whole distribution (`degrees_of_freedom`).

    ``columns`` are those of the effect, as far as the model does not explain them; ``usual`` is in mm.
    """
    information = effects.product(columns, columns)
    values, vectors = np.linalg.eigh(information)
    present = values > NULL * max(values.max(initial=0.0), 1e-300)
    values, r = values[present], effects.left.values[:, None]
    squares = (vectors[:, present].T @ effects.product(columns, r)[:, 0]) ** 2
    total, freedom = float(effects.product(r, r)[0, 0]), effects.left.degrees_of_freedom
    ratio = (usual * np.geomspace(*_RANGE, _GRID)) ** 2 / effects.variance
    explained = np.sum(ratio[:, None] * squares / (1 + ratio[:, None] * values), axis=1)
    cost = total - explained
    log_sum = np.sum(np.log1p(ratio[:, None] * values), axis=1)
    # Of the effect, and of what independent errors add to the mean of a coefficient's tips.
    variance = ratio if effects.given else ratio * cost / freedom
    of_errors = variance / ratio / np.mean(values)
    of_cost = cost - total if effects.given else freedom * np.log(cost / total)
    likelihood = -0.5 * (of_cost + log_sum)
    weight = likelihood + 0.5 * np.log(variance) - np.log1p(variance / usual**2)
    weight = np.exp(weight - weight.max())
    weight = weight / weight.sum()
    stated = float(np.exp(weight @ np.log(variance + of_errors)) - weight @ of_errors)
    stated = max(stated, float(variance[0]))
    return OneVariance(stated, variance / stated, weight, float(np.max(likelihood)))


def group_deviations(
    effects: Effects, columns: Float[np.ndarray, "R k"], members: Float[np.ndarray, "g k"]
) -> tuple[Float[np.ndarray, " g"], Float[np.ndarray, " g"]]:
    """Standard deviations of groups of effects at which the residuals are most probable, natural steps, and the degrees
    of freedom that the residuals and what is expected beforehand give each: 2 over the variance of its log variance.

    Each group is expected, to a factor of 4.5, to explain an equal share of the residuals: else groups of which the
    data say little would be as large as anybody fears, or collapse (`benchmarks/NOTES.md`). ``columns`` are those of
    all groups in natural steps, as far as the model does not explain them; ``members`` is 1 where a column is a
    group's.
    """
    r, freedom = effects.left.values[:, None], effects.left.degrees_of_freedom
    information, right = effects.product(columns, columns), effects.product(columns, r)[:, 0]
    total, none = float(effects.product(r, r)[0, 0]), np.zeros(columns.shape[1])
    variance, every = effects.variance, np.ones(len(members), dtype=bool)
    sizes = np.maximum(members @ np.diag(information), 1e-300) / freedom
    logs = np.log(total / freedom / (sizes * len(members)))
    groups = Groups(members, logs, every, every, _LEAST_LOG)
    for _ in range(_ROUNDS):
        model = PriorModel(information / variance, right / variance, none, none.astype(bool))
        logs = learned_log_variances(model, groups, logs)
        if effects.given:
            break
        inner = information + np.diag(variance * np.exp(-logs @ groups.members))
        new = max((total - right @ np.linalg.solve(inner, right)) / freedom, 1e-300)
        change, variance = abs(np.log(new / variance)), new
        if change < _TOLERANCE:
            break
    curved = covariance_of_log_variances(model, groups, logs, logs > _LEAST_LOG + 1e-9)
    spread = np.diag(curved)
    return np.exp(0.5 * logs), 2 / np.where(spread > 0, spread, 1e-9)


class Moments(NamedTuple):
    """Second moments about 0 of the coefficients of an effect, and their derivatives by log variances of groups."""

    matrix: Float[np.ndarray, "k k"]
    by_group: Float[np.ndarray, "g k k"]

    def in_units(self, steps: Float[np.ndarray, " k"]) -> "Moments":
        """Of coefficients in units of their own, of those in ``steps``."""
        both = steps[:, None] * steps
        return Moments(self.matrix * both, self.by_group * both)


def second_moments(
    effects: Effects, columns: Float[np.ndarray, "R k"], sd: Float[np.ndarray, " g"], members: Float[np.ndarray, "g k"]
) -> Moments:
    """Second moments of the coefficients of groups, given the residuals and the groups' standard deviations.

    A calibration without the effect has the error that these coefficients make, whose mean square is this.
    """
    variance, r = effects.variance, effects.left.values[:, None]
    weights = members / sd[:, None] ** 2
    inner = effects.product(columns, columns) / variance + np.diag(weights.sum(axis=0))
    covariance = np.linalg.inv(inner)
    mean = covariance @ effects.product(columns, r) / variance
    grown = [covariance @ (weight[:, None] * covariance) for weight in weights]
    moved = [covariance @ (weight[:, None] * mean) for weight in weights]
    by_group = [one + step @ mean.T + mean @ step.T for one, step in zip(grown, moved, strict=True)]
    return Moments(covariance + mean @ mean.T, np.array(by_group))
