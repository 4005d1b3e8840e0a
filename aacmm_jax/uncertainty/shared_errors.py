"""Errors that poses share, as random effects: what a calibration keeps of them (`diagnostics.shared_errors`)."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, namespace
from .degrees_of_freedom import Components, Law


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
    # What each kind adds to the covariance of the parameters, or, of functions, to the moments of the coefficients when
    # the logarithm of its variance grows; and how well the variances are known.
    added: Float[AnyArray, "e p p"]
    by_group: Float[AnyArray, "f k k"]
    law: Law  # of all kinds

    def without_functions(self) -> "SharedErrors":
        """Those that move the tips of poses alike."""
        count = len(self.added)
        return SharedErrors(
            kinds=self.kinds[:count],
            units=self.units[:count],
            names=(),
            sd=self.sd[:count],
            moments=np.zeros((0, 0)),
            follow=self.follow[:, :0],
            correlation_length=self.correlation_length,
            added=self.added,
            by_group=np.zeros((0, 0, 0)),
            law=Law(*(of[:count] for of in self.law)),
        )

    @property
    def of_tips(self) -> Components | None:
        """What errors of the tip add to the covariance of the parameters."""
        count = len(self.added)
        return Components(self.kinds[:count], self.added, Law(*(of[:count] for of in self.law))) if count else None

    @property
    def of_functions(self) -> Components:
        """By how much the covariance of parameters and coefficients grows with the logarithm of each variance."""
        xp, count = namespace(self), len(self.added)
        by_coefficients = xp.concatenate([self.follow, xp.asarray(np.eye(len(self.names)))])
        grown = by_coefficients @ self.by_group @ by_coefficients.T
        return Components(self.kinds[count:], grown, Law(*(of[count:] for of in self.law)))

    def sd_of(self, *kinds: str) -> Float[AnyArray, ""] | float:
        """Standard deviation of a tip coordinate by effects of some kinds, mm; 0 without."""
        return sum((self.sd[i] ** 2 for i, kind in enumerate(self.kinds) if kind in kinds), 0.0) ** 0.5
<<<<<<< HEAD


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

    def product(self, left: Float[np.ndarray, "R a"], right: Float[np.ndarray, "R b"]) -> Float[np.ndarray, "a b"]:
        """one^T (I + D diag(variances / variance) D^T)^-1 other."""
        if not len(self.variances):
            return left.T @ right
        d = self.columns * np.sqrt(self.variances / self.variance)
        return left.T @ right - (left.T @ d) @ np.linalg.solve(np.eye(d.shape[1]) + d.T @ d, d.T @ right)

    def joined(self, columns: Float[np.ndarray, "R c"], variances: Float[np.ndarray, " c"]) -> "Effects":
        """With a further effect, whose columns the model has not explained; the variance of independent errors is the
        one with which the residuals are as large as they should be."""
        both = self._replace(
            columns=np.concatenate([self.columns, columns], axis=1),
            variances=np.concatenate([self.variances, variances]),
        )
        if self.given:
            return both
        d, r = both.columns * np.sqrt(both.variances), self.left.values
        values, vectors = np.linalg.eigh(d.T @ d)
        seen, values = (vectors.T @ (d.T @ r)) ** 2, np.maximum(values, 0.0)
        variance = self.variance
        for _ in range(_ROUNDS):
            explained = float(np.sum(seen / (variance + values)))
            new = max(self.left.cost - explained, 1e-12 * self.left.cost) / self.left.degrees_of_freedom
            change, variance = abs(np.log(new / variance)), new
            if change < _TOLERANCE:
                break
        return both._replace(variance=variance)


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

    Args:
        effects: What is known.
        columns: Of the effect, as far as the model does not explain them.
        usual: Standard deviation above which it is improbable, mm.
    """
    information = effects.product(columns, columns)
    values, vectors = np.linalg.eigh(information)
    determined = values > NULL * max(values.max(initial=0.0), 1e-300)
    values, r = values[determined], effects.left.values[:, None]
    squares = (vectors[:, determined].T @ effects.product(columns, r)[:, 0]) ** 2
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
    by_group = [of_spread + step @ mean.T + mean @ step.T for of_spread, step in zip(grown, moved, strict=True)]
    return Moments(covariance + mean @ mean.T, np.array(by_group))
=======
>>>>>>> main
