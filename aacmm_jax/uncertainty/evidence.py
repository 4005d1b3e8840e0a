"""Effective parameters of a prior, and its standard deviations as learned from the data by their evidence.

The model is linear in the parameters x that have a prior, in natural steps, with everything else eliminated: data of
information A, and a prior of standard deviations s about the mean. With K = diag(s) A diag(s), the posterior covariance
of (x - mean) / s is V = (I + K)^-1, its expectation m = V diag(s) A (x_data - mean), and gamma_i = (V K)_ii is how much
of parameter i the data determine. The log evidence has the derivative (sum of m_i^2 - sum of gamma_i) / 2 by the log
variance of a group, so the learned variance is that at which both sums are equal (MacKay 1992, Neural Computation 4,
415-447; Bishop 2006, Pattern Recognition and Machine Learning, section 3.5.2).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.linear_algebra import inverse_positive_definite, solve_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace, while_loop
from .covariance import inverse_information

_ROUNDS = 300
_TOLERANCE = 1e-12  # of a log variance
_NOTHING = 1e-9  # effective parameters of a group, below which the data say nothing of it
_FACTOR = 10.0  # largest change of a log variance in one step


class PriorModel(NamedTuple):
    """The k parameters that have a prior, in natural steps, with everything else eliminated from the information."""

    information: Float[AnyArray, "k k"]  # of the data; 0 for pinned parameters
    right: Float[AnyArray, " k"]  # information times (x_data - mean)
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
    inverse = inverse_information(gram[np.ix_(others, others)], pinned[others])[0]
    crossed, own = gram[np.ix_(index, others)], pinned[index]
    information = gram[np.ix_(index, index)] - crossed @ inverse @ crossed.T
    slope = gradient[index] - crossed @ (inverse @ gradient[others])
    information = xp.where(own[:, None] | own[None, :], 0.0, 0.5 * (information + information.T))
    free = xp.where(own, 0.0, deviation)
    return PriorModel(information, xp.where(own, 0.0, information @ free - slope), deviation, own)


class _Posterior(NamedTuple):
    covariance: Float[AnyArray, "k k"]  # V
    effective: Float[AnyArray, " k"]  # gamma


def _posterior(model: PriorModel, sd: Float[AnyArray, " k"]) -> _Posterior:
    xp = namespace(model, sd)
    relative = sd[:, None] * model.information * sd[None, :]
    covariance = inverse_positive_definite(xp.asarray(np.eye(sd.shape[0])) + relative)
    # Not 1 - V_ii, which loses what little the data say of a parameter with a small standard deviation.
    return _Posterior(covariance, xp.where(model.pinned, 1.0, xp.sum(covariance * relative, axis=1)))


def effective_parameters(model: PriorModel, sd: Float[AnyArray, " k"]) -> Float[AnyArray, " k"]:
    """How much of each parameter the data determine, 0 to 1, with a prior of these standard deviations.

    One on a bound counts in full, as does one without a prior.
    """
    return _posterior(model, sd).effective


class _Evidence(NamedTuple):
    """What the log evidence is made of, group by group; its derivatives by log variances are half of these."""

    squares: Float[AnyArray, " g"]  # sum of m^2
    spent: Float[AnyArray, " g"]  # sum of gamma
    second: Float[AnyArray, "g g"]  # derivatives of squares - spent


def _evidence(model: PriorModel, members: Float[np.ndarray, "g k"], now: Float[AnyArray, " g"]) -> _Evidence:
    xp = namespace(model, now)
    groups = xp.asarray(members)
    sd = xp.exp(0.5 * (now @ groups))
    covariance, effective = _posterior(model, sd)
    mean = xp.where(model.pinned, model.deviation / sd, covariance @ (sd * model.right))
    by_group = mean[:, None] * groups.T
    follow = xp.where(model.pinned[:, None], -by_group, 2 * covariance @ by_group - by_group)
    second = groups @ (mean[:, None] * follow) + groups @ covariance**2 @ groups.T
    second = second - xp.asarray(np.eye(len(members))) * (groups @ xp.diagonal(covariance))[:, None]
    return _Evidence(groups @ mean**2, groups @ effective, second)


def covariance_of_log_variances(
    model: PriorModel, members: Float[np.ndarray, "g k"], at: Float[AnyArray, " g"], moving: Bool[AnyArray, " g"]
) -> Float[AnyArray, "g g"]:
    """Covariance of learned log variances, by the curvature of the log evidence at its maximum; 0 for the others.

    A log variance that the evidence hardly determines counts as one of variance 4, that of a standard deviation known
    to a factor of e.
    """
    xp = namespace(model, at)
    unit, both = xp.asarray(np.eye(len(members))), moving[:, None] & moving[None, :]
    curvature = xp.where(both, 0.25 * unit - 0.5 * _evidence(model, members, at).second, unit)
    return xp.where(both, inverse_positive_definite(curvature), 0.0)


def learned_log_variances(
    model: PriorModel,
    members: Float[np.ndarray, "g k"],
    start: Float[AnyArray, " g"],
    learned: np.ndarray,
    least: float,
) -> Float[AnyArray, " g"]:
    """Log variances of groups at which the evidence is largest; those that are not learned stay as they start.

    MacKay's fixed point, s^2 = sum of deviation^2 / effective parameters, until Newton's steps on the log evidence are
    short. Its second derivatives follow from dV = -V dK V.

    Args:
        model: of the parameters, in natural steps.
        members: 1 where a parameter belongs to a group ``(g, k)``.
        start: log variance of each group ``(g,)``.
        learned: which groups are learned ``(g,)``.
        least: smallest log variance of a learned group.
    """
    xp = namespace(model, start)
    learn, unit = xp.asarray(learned), xp.asarray(np.eye(len(learned)))

    def again(state: tuple) -> tuple:
        count, now, _ = state
        squares, spent, second = _evidence(model, members, now)
        slope = squares - spent
        # Where the least is reached and the evidence still falls, it stays.
        moving = learn & ~((now <= least) & (slope <= 0))
        both = moving[:, None] & moving[None, :]
        newton = solve_positive_definite(xp.where(both, -second, unit), xp.where(moving, slope, 0.0))
        ratio = xp.log(xp.maximum(squares, 1e-300) / xp.maximum(spent, 1e-300))
        fixed_point = xp.where(spent > _NOTHING, xp.clip(ratio, -_FACTOR, _FACTOR), -_FACTOR)
        near = xp.all(xp.isfinite(newton)) & (xp.max(xp.abs(newton)) <= 1.0)
        step = xp.where(moving, xp.where(near, newton, fixed_point), 0.0)
        after = xp.where(learn, xp.maximum(now + step, least), now)
        return count + 1, after, xp.max(xp.abs(after - now))

    def unfinished(state: tuple) -> AnyArray:
        return (state[0] < _ROUNDS) & (state[2] > _TOLERANCE)

    return while_loop(unfinished, again, (xp.asarray(0), start, xp.asarray(np.inf)))[1]
