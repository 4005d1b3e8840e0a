"""Errors that poses share, as random effects: how large they are by the residuals, and what they do to a calibration.

The model of a calibration leaves residuals r = M e of whitened errors e, M the projector onto what its unknowns cannot
explain (`residual_tests`). Errors that poses share are e = w + sum_g Z_g c_g: independent ones w of one variance s, and
columns Z_g (the tips of all poses of a visit move alike; a joint turns by an unknown coefficient times a known
function) times coefficients of variance v_g. The likelihood of r depends on the variances through D_g = M Z_g alone
(REML: Patterson and Thompson 1971, Biometrika 58, 545-554). The calibration stays as it is. Its parameters follow a
shared error as they follow any other error of the tips, z = K c, so its covariance grows by K v K^T.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray
from .evidence import Groups, PriorModel, learned_log_variances
from .residual_tests import Residuals
from .shared_kinds import PLACES, SUCCESSIVE, VISITS

_ROUNDS = 40  # of the variance of independent errors; usually 5
_TOLERANCE = 1e-6
NULL = 1e-6  # eigenvalues of an effect's information below this, of the largest, are zero
_GRID = 240  # standard deviations at which the likelihood of one effect is computed
_LARGEST = 30.0  # standard deviation of an effect, of that of a tip coordinate
_LEAST_LOG = 2 * np.log(1e-4)  # smallest log variance of a learned group, in natural steps


class SharedErrors(eqx.Module):
    """Errors that poses share and the model of a calibration does not have, as its residuals show them.

    Its covariance contains them. Functions of the readings that joints follow besides the model ("gravity",
    "harmonics=1") move other poses too: a tip errs by J dz + sum of J_joint phi(q) c, with dz = ``follow`` c.
    """

    kinds: tuple[str, ...] = eqx.field(static=True)  # "visits", "successive poses", "places", and groups of functions
    units: tuple[str, ...] = eqx.field(static=True)  # of each standard deviation
    names: tuple[str, ...] = eqx.field(static=True)  # coefficients of the functions, as of `kinematics.corrections`
    sd: Float[AnyArray, " g"]  # of each kind
    moments: Float[AnyArray, "k k"]  # second moments of the coefficients about 0, which the calibrated arm has
    follow: Float[AnyArray, "p k"]  # derivatives of the parameters by the coefficients, mm and rad
    correlation_length: Float[AnyArray, ""]  # of successive poses, where visits are not marked; NaN otherwise

    def without_functions(self) -> "SharedErrors | None":
        """Those that move the tips of poses alike."""
        own = [i for i, kind in enumerate(self.kinds) if kind in (PLACES, VISITS, SUCCESSIVE)]
        kinds, units = tuple(self.kinds[i] for i in own), tuple(self.units[i] for i in own)
        return SharedErrors(
            kinds,
            units,
            (),
            self.sd[np.array(own, dtype=int)],
            np.zeros((0, 0)),
            self.follow[:, :0],
            self.correlation_length,
        )

    def sd_of(self, *kinds: str) -> Float[AnyArray, ""] | float:
        """Standard deviation of a tip coordinate by effects of some kinds, mm; 0 without."""
        return sum((self.sd[i] ** 2 for i, kind in enumerate(self.kinds) if kind in kinds), 0.0) ** 0.5


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
        found = self._replace(
            columns=np.concatenate([self.columns, columns], axis=1),
            variances=np.concatenate([self.variances, variances]),
        )
        if self.given:
            return found
        d, r = found.columns * np.sqrt(found.variances), self.left.values
        values, vectors = np.linalg.eigh(d.T @ d)
        seen, values = (vectors.T @ (d.T @ r)) ** 2, np.maximum(values, 0.0)
        variance = self.variance
        for _ in range(_ROUNDS):
            explained = float(np.sum(seen / (variance + values)))
            new = max(self.left.cost - explained, 1e-12 * self.left.cost) / self.left.degrees_of_freedom
            change, variance = abs(np.log(new / variance)), new
            if change < _TOLERANCE:
                break
        return found._replace(variance=variance)


class OneVariance(NamedTuple):
    """An effect of one variance: every coefficient is a displacement of the tip, mm."""

    variance: float  # posterior mean, mm^2
    log_likelihood: float  # its maximum over that without the effect


def one_variance(effects: Effects, columns: Float[np.ndarray, "R c"], low: float, usual: float) -> OneVariance:
    """The variance of one more effect: its posterior mean.

    The mean and not the maximum, because intervals with the mean cover what those of Student's t do: the variance of t
    is that of the normal distribution times the mean of the variance. Beforehand the logarithm of the standard
    deviation is uniform between ``low`` and ``usual`` and less and less probable above, as few data say nothing of it.

    Args:
        effects: What is known.
        columns: Of the effect, as far as the model does not explain them.
        low: Standard deviation below which the effect is nothing, mm.
        usual: Standard deviation above which it is improbable, mm.
    """
    information = effects.product(columns, columns)
    values, vectors = np.linalg.eigh(information)
    known = values > NULL * max(values.max(initial=0.0), 1e-300)
    values, r = values[known], effects.left.values[:, None]
    squares = (vectors[:, known].T @ effects.product(columns, r)[:, 0]) ** 2
    total, freedom = float(effects.product(r, r)[0, 0]), effects.left.degrees_of_freedom
    sd = np.exp(np.linspace(np.log(low), np.log(_LARGEST * usual), _GRID))
    ratio = sd**2 / effects.variance
    explained = np.sum(ratio[:, None] * squares / (1 + ratio[:, None] * values), axis=1)
    cost = total - explained
    log_sum = np.sum(np.log1p(ratio[:, None] * values), axis=1)
    if effects.given:
        likelihood, variance = -0.5 * (cost - total + log_sum), np.ones(_GRID)
    else:
        likelihood, variance = -0.5 * (freedom * np.log(cost / total) + log_sum), cost / freedom
    weight = likelihood - np.maximum(np.log(sd / usual), 0.0)
    weight = np.exp(weight - weight.max())
    mean = float(np.sum(weight * ratio * variance) / np.sum(weight))
    return OneVariance(mean, float(np.max(likelihood)))


def group_deviations(
    effects: Effects, columns: Float[np.ndarray, "R k"], members: Float[np.ndarray, "g k"]
) -> Float[np.ndarray, " g"]:
    """Standard deviations of groups of effects at which the residuals are most probable, natural steps.

    Each group is expected, to a factor of 4.5, to explain an equal share of the residuals: else groups of which the
    data say little would be as large as anybody fears, or collapse (`benchmarks/NOTES.md`).

    Args:
        effects: What is known.
        columns: Of all groups in natural steps, as far as the model does not explain them.
        members: 1 where a column belongs to a group.
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
    return np.exp(0.5 * logs)


def second_moments(
    effects: Effects, columns: Float[np.ndarray, "R k"], sd: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "k k"]:
    """Second moments about 0 of the coefficients of an effect, given the residuals and their own standard deviations.

    A calibration without the effect has the error that these coefficients make, whose mean square is this.
    """
    variance, r = effects.variance, effects.left.values[:, None]
    inner = effects.product(columns, columns) / variance + np.diag(1 / sd**2)
    covariance = np.linalg.inv(inner)
    mean = covariance @ effects.product(columns, r) / variance
    return covariance + mean @ mean.T
