"""Effective parameters of a prior, and its standard deviations as learned from the data by their evidence.

The model is linear in the parameters x that have a prior, in natural steps, with everything else eliminated: data of
information A, and a prior of standard deviations s about the mean. With K = diag(s) A diag(s), the posterior covariance
of (x - mean) / s is V = (I + K)^-1, its expectation m = V diag(s) A (x_data - mean), and gamma_i = (V K)_ii is how much
of parameter i the data determine. The log evidence has the derivative (sum of m_i^2 - sum of gamma_i) / 2 by the log
variance of a group, so the learned variance is that at which both sums are equal (MacKay 1992, Neural Computation 4,
415-447; Bishop 2006, Pattern Recognition and Machine Learning, section 3.5.2).

A parameter on a bound keeps its m, and counts in V and gamma as if it were free. So the learned variance does not jump
where a parameter reaches its bound; else there may be none that leads to itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_cholesky, inverse_positive_definite, solve_positive_definite
from ..core.numpy_or_jax import AnyArray, cond, namespace, while_loop
from .covariance import inverse_information

_ROUNDS = 300
_TOLERANCE = 1e-12  # of a log variance
_NOTHING = 1e-9  # effective parameters of a group, below which the data say nothing of it
_FACTOR = 3.0  # largest change of a log variance in one step
_EXPECTED_VARIANCE = 9.0  # of a log variance that is expected
_LEAST_CURVATURE = 1e-9
_DAMPING = 0.01  # of Fisher scoring, after the first step that fails
_ROUNDING = 1e-10  # of the log evidence, relative


class PriorModel(NamedTuple):
    """The k parameters that have a prior, in natural steps, with everything else eliminated from the information."""

    information: Float[AnyArray, "k k"]  # of the data
    right: Float[AnyArray, " k"]  # information times (x_data - mean), with the pinned where they are; 0 for these
    deviation: Float[AnyArray, " k"]  # x - mean at the point where the model is linear
    pinned: Bool[AnyArray, " k"]  # on a bound, where the deviation is known


def eliminated(
    gram: Float[AnyArray, "z z"],
    gradient: Float[AnyArray, " z"],
    deviation: Float[AnyArray, " k"],
    index: np.ndarray,
    pinned: Bool[AnyArray, " z"],
) -> PriorModel:
    """The model of the parameters of an index, from the information and the gradient of all data in natural steps."""
    xp, size = namespace(gram, gradient), gram.shape[0]
    others = np.setdiff1d(np.arange(size), index)
    inverse = xp.zeros((0, 0))
    if len(others):
        inverse = inverse_information(gram[np.ix_(others, others)], pinned[others])[0]
    crossed, pinned_here = gram[np.ix_(index, others)], pinned[index]
    information = gram[np.ix_(index, index)] - crossed @ inverse @ crossed.T
    slope = gradient[index] - crossed @ (inverse @ gradient[others])
    information = 0.5 * (information + information.T)
    free = xp.where(pinned_here, 0.0, deviation)
    return PriorModel(information, xp.where(pinned_here, 0.0, information @ free - slope), deviation, pinned_here)


def _posterior(
    model: PriorModel, sd: Float[AnyArray, " k"]
) -> tuple[Float[AnyArray, "k k"], Float[AnyArray, " k"], Float[AnyArray, ""]]:
    """V, gamma, and the log determinant of I + K."""
    xp = namespace(model, sd)
    relative = sd[:, None] * model.information * sd[None, :]
    whitening = inverse_cholesky(xp.asarray(np.eye(sd.shape[0])) + relative)
    covariance = whitening.T @ whitening
    # Not 1 - V_ii, which loses what little the data say of a parameter with a small standard deviation.
    effective = xp.sum(covariance * relative, axis=1)
    return covariance, effective, -2 * xp.sum(xp.log(xp.diagonal(whitening)))


def effective_parameters(model: PriorModel, sd: Float[AnyArray, " k"]) -> Float[AnyArray, " k"]:
    """How much of each parameter the data determine, 0 to 1, with a prior of these standard deviations."""
    return _posterior(model, sd)[1]


def _given_pinned(covariance: Float[AnyArray, "k k"], pinned: Bool[AnyArray, " k"]) -> Float[AnyArray, "k k"]:
    """The covariance of the others where pinned parameters are known; 0 for these."""
    xp = namespace(covariance, pinned)
    both, unit = pinned[:, None] & pinned[None, :], xp.asarray(np.eye(len(pinned)))
    inverse = xp.where(both, inverse_positive_definite(xp.where(both, covariance, unit)), 0.0)
    return xp.where(pinned[:, None] | pinned[None, :], 0.0, covariance - covariance @ inverse @ covariance)


class Groups(NamedTuple):
    """Groups of parameters with one standard deviation each, and what is known of these."""

    members: Float[np.ndarray, "g k"]  # 1 where a parameter belongs to a group
    first: Float[AnyArray, " g"]  # log variances that are given, expected, or begun with
    learned: np.ndarray  # whether a log variance is learned
    expected: np.ndarray  # and expected to be about that
    least: float  # smallest log variance of a learned group

    def slope(self, at: Float[AnyArray, " g"]) -> Float[AnyArray, " g"]:
        """What expectations add to the derivative of twice the log evidence by log variances."""
        return (at - self.first) * (self.expected * -2 / _EXPECTED_VARIANCE)


class _Evidence(NamedTuple):
    """Twice the log evidence but for a constant, and its derivatives by log variances."""

    value: Float[AnyArray, ""]
    slope: Float[AnyArray, " g"]
    second: Float[AnyArray, "g g"]
    fisher: Float[AnyArray, "g g"]  # expectation of -second over data
    spent: Float[AnyArray, " g"]  # sum of gamma

    @classmethod
    def at(cls, model: PriorModel, groups: Groups, now: Float[AnyArray, " g"]) -> "_Evidence":
        xp, pinned = namespace(model, now), model.pinned
        members, unit = xp.asarray(groups.members), xp.asarray(np.eye(groups.members.shape[1]))
        sd = xp.exp(0.5 * (now @ members))
        covariance, effective, log_determinant = _posterior(model, sd)
        of_free = cond(xp.any(pinned), _given_pinned, lambda covariance, _: covariance, covariance, pinned)
        scaled = sd * model.right
        mean = xp.where(pinned, model.deviation / sd, of_free @ scaled)
        by_group = mean[:, None] * members.T
        follow = 2 * of_free @ by_group - by_group
        second = members @ (mean[:, None] * follow) + members @ covariance**2 @ members.T
        second = second - xp.asarray(np.eye(len(members))) * (members @ xp.diagonal(covariance))[:, None]
        informed = (unit - covariance) ** 2 + unit * xp.where(pinned, 1.0, 0.0)[:, None]
        spent, away = members @ effective, (now - groups.first) * groups.expected.astype(float)
        certain = xp.asarray(np.diag(groups.expected * 2 / _EXPECTED_VARIANCE))
        of_pinned = xp.sum(xp.where(pinned, mean**2, 0.0))
        return cls(
            value=scaled @ mean - log_determinant - of_pinned - xp.sum(away**2) / _EXPECTED_VARIANCE,
            slope=members @ mean**2 - spent + groups.slope(now),
            second=second - certain,
            fisher=members @ informed @ members.T + certain,
            spent=spent,
        )


def covariance_of_log_variances(
    model: PriorModel, groups: Groups, at: Float[AnyArray, " g"], moving: Bool[AnyArray, " g"]
) -> Float[AnyArray, "g g"]:
    """Covariance of learned log variances, by the curvature of the log evidence at its maximum; 0 for the others.

    A log variance that the evidence hardly determines counts as one of variance 4, that of a standard deviation known
    to a factor of e; an expected one as it is expected.
    """
    xp = namespace(model, at)
    beforehand = xp.asarray(np.diag(np.where(groups.expected, 0.0, 0.25)))
    unit, both = xp.asarray(np.eye(len(groups.members))), moving[:, None] & moving[None, :]
    curvature = xp.where(both, beforehand - 0.5 * _Evidence.at(model, groups, at).second, unit)
    return xp.where(both, inverse_positive_definite(curvature), 0.0)


class _Search(NamedTuple):
    count: AnyArray
    now: Float[AnyArray, " g"]
    evidence: _Evidence
    damping: AnyArray
    change: AnyArray  # of a log variance in the last step; of Newton's its square, which is about what is left after it


def learned_log_variances(
    model: PriorModel, groups: Groups, start: Float[AnyArray, " g"] | None = None
) -> Float[AnyArray, " g"]:
    """Log variances of groups at which the evidence is largest, from ``start`` or ``groups.first``; those that are not
    learned stay as they are given.

    Fisher scoring, damped where the evidence would fall, until Newton's steps are short (the second derivatives follow
    from dV = -V dK V).
    """
    start = groups.first if start is None else start
    xp = namespace(model, start)
    learn, unit = xp.asarray(groups.learned), xp.asarray(np.eye(len(groups.learned)))
    alone = xp.asarray(~groups.expected)

    def again(state: _Search) -> _Search:
        count, now, evidence, damping, _ = state
        # Where the least is reached and the evidence still falls, it stays.
        moving = learn & ~((now <= groups.least) & (evidence.slope <= 0))
        both, slope = moving[:, None] & moving[None, :], xp.where(moving, evidence.slope, 0.0)
        newton = solve_positive_definite(xp.where(both, -evidence.second, unit), slope)
        damped = evidence.fisher + unit * (damping * xp.diagonal(evidence.fisher) + _LEAST_CURVATURE)[:, None]
        scoring = solve_positive_definite(xp.where(both, damped, unit), slope)
        scoring = xp.where(alone & (evidence.spent <= _NOTHING), -_FACTOR, xp.clip(scoring, -_FACTOR, _FACTOR))
        near = xp.all(xp.isfinite(newton)) & (xp.max(xp.abs(newton)) <= 1.0) & (damping <= 0)
        step = xp.where(moving, xp.where(near, newton, scoring), 0.0)
        after = xp.where(learn, xp.maximum(now + step, groups.least), now)
        new = _Evidence.at(model, groups, after)
        better = new.value >= evidence.value - _ROUNDING * (1 + xp.abs(evidence.value))
        size = xp.max(xp.abs(after - now))
        size = xp.where(near, size**2, size)
        # A short step after which the evidence seems to fall is at its rounding.
        change = xp.where(better | (size <= _TOLERANCE), size, np.inf)
        eased = xp.where(damping <= _DAMPING, 0.0, 0.1 * damping)
        damping = xp.where(better, eased, xp.maximum(10 * damping, _DAMPING))
        evidence = _Evidence(*(xp.where(better, *pair) for pair in zip(new, evidence, strict=True)))
        return _Search(count + 1, xp.where(better, after, now), evidence, damping, change)

    first = _Search(xp.asarray(0), start, _Evidence.at(model, groups, start), xp.asarray(0.0), xp.asarray(np.inf))
    return while_loop(lambda state: (state.count < _ROUNDS) & (state.change > _TOLERANCE), again, first).now
