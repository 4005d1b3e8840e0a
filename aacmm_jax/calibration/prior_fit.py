"""The last least squares of an identification with a prior; its scales and that of the tips settle with it.

A prior weighs against the data by the ratio of their standard deviations. What of these is not given (that of a tip
coordinate without `Noise`, those of learned groups) follows from the residuals and deviations that it leads to: the
fixed point of MacKay's updates (`uncertainty.evidence`), with the model linearised anew at each least squares.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core._compat import member_numbers
from ..core.linear_algebra import inverse_positive_definite, singular_values, solve_positive_definite
from ..core.numpy_or_jax import AnyArray, namespace, set_at, stop_gradient, while_loop
from ..kinematics.priors import LEAST_STEPS, MIXED, ParameterPrior
from ..model.elimination import Args, observed_model, reduced
from ..model.robust import Loss
from ..model.rows import PriorRows, Whitening
from ..solver.reason import MAX_STEPS, reasons
from ..uncertainty.evidence import (
    Groups,
    PriorModel,
    covariance_of_log_variances,
    effective_parameters,
    eliminated,
    learned_log_variances,
)
from .results import PriorMetrics
from .task import NEAR, Begun, Fit, State, Task, fit, state_at, whitening_at

_ROUNDS = 60  # least squares with new standard deviations; usually 4 to 8
# Largest change of the log of a variance that no further round is worth, where derivatives pass through, and elsewhere.
_TOLERANCE, _BATCH_TOLERANCE = 1e-10, 1e-6
_UNDAMPED = 15  # rounds
_REMEMBERED = 3  # rounds that are extrapolated
_NEAR = 0.5  # change of the log of a variance, below which they are
_MOST_SPREAD = 2 / 3  # variance of the log of a variance that counts: three degrees of freedom
_LEAST_GIVEN = 1e-7  # natural steps: a smaller standard deviation would be a row of infinite weight
_LEAST_LOG = 2 * np.log(LEAST_STEPS)
# Of the steps of the solve: so small that a tight prior does not dominate the damping, but not so small that the value
# of a parameter drowns the test for convergence.
_LEAST_SCALE = 1e-3


class OfPrior(NamedTuple):
    """What the last least squares with a prior found besides the unknowns."""

    rows: PriorRows
    metrics: PriorMetrics
    effective: Float[AnyArray, ""]  # how many unknowns the data determine
    by_scales: Callable[[AnyArray], AnyArray] | None  # `PriorProblem.by_scales`, where scales are learned


def weights(task: Task, begun: Begun, state: State, loss: Loss | None) -> Whitening:
    """Of the next least squares; scales of a prior are those before anything is learned."""
    if task.needs_no_weights:
        return Whitening((None,) * len(task.observed.layout.groups), np.zeros(0), {})
    if (prior := task.free_prior) is None:
        return whitening_at(task, state)
    problem = PriorProblem(task, begun, prior, loss, state)
    return whitening_at(task, state, problem.rows(problem.first_scales()))


def fitted_with_prior(
    task: Task, prior: ParameterPrior, begun: Begun, state: State, z: Float[AnyArray, " z"]
) -> tuple[Float[AnyArray, " z"], State, Fit, OfPrior]:
    """The last least squares with a prior, whose weights agree with what it leads to."""
    problem = PriorProblem(task, begun, prior, task.loss, state)
    scales, solution = _settled(problem, z)
    z, model = solution.parameters, problem.model(scales, solution.parameters)
    effective = effective_parameters(model, problem.sd(scales))
    determined = z.shape[0] - len(prior.index) + namespace(effective).sum(effective)
    by_scales = problem.by_scales(scales, model) if any(prior.learned) else None
    of_prior = OfPrior(problem.rows(scales), problem.metrics(scales, effective), determined, by_scales)
    return z, state_at(task, begun.space, z, effective=determined), solution, of_prior


class PriorProblem(NamedTuple):
    """One least squares with a prior, whose weights are those at a nearly right arm (``reference``).

    The *scales* are the log of a tip coordinate's standard deviation, then the log variance of each group in natural
    steps.
    """

    task: Task
    begun: Begun
    prior: ParameterPrior
    loss: Loss | None
    reference: State

    @property
    def learned(self) -> np.ndarray:
        """Which groups are learned."""
        return np.array(self.prior.learned)

    @property
    def steps(self) -> Any:
        """Natural steps of the unknowns."""
        return self.begun.box[2]

    @property
    def groups(self) -> Groups:
        """The groups, with what is known of them."""
        prior = self.prior
        return Groups(prior.membership, self.first_scales()[1:], self.learned, np.array(prior.expected), _LEAST_LOG)

    def first_scales(self) -> Float[AnyArray, " s"]:
        """The scales before anything is learned; those that are given keep these values."""
        xp, prior = namespace(self.reference.sigma, self.prior), self.prior
        first = np.array([members[0] for members in prior.members])
        variances = 2 * xp.log(xp.maximum((prior.sd / self.steps[: prior.sd.shape[0]])[first], _LEAST_GIVEN))
        return xp.concatenate([_log_sigma(self.reference.sigma), variances])

    def sd(self, scales: Float[AnyArray, " s"]) -> Float[AnyArray, " k"]:
        """Standard deviation of every parameter that has a prior, in natural steps."""
        return namespace(scales).exp(0.5 * (scales[1:] @ namespace(scales).asarray(self.prior.membership)))

    def rows(self, scales: Float[AnyArray, " s"]) -> PriorRows:
        """The rows of the prior with these scales."""
        xp, index = namespace(scales, self.prior), self.prior.index
        weight = 1 / (self.sd(scales) * self.steps[index])
        return PriorRows(self.prior.mean, set_at(xp.zeros_like(self.prior.mean), index, weight))

    def args(self, scales: Float[AnyArray, " s"], prior: PriorRows | None) -> Args:
        """The least squares with these scales."""
        reference = self.reference._replace(sigma=namespace(scales).exp(scales[0]))
        whitening = whitening_at(self.task, reference, prior)
        return Args(self.begun.space, self.task.observed, whitening, self.loss)

    def fit(self, scales: Float[AnyArray, " s"], z: Float[AnyArray, " z"], *, differentiable: bool) -> Fit:
        """The unknowns with these scales."""
        index, steps = self.prior.index, self.steps
        tight = namespace(scales, z).clip(stop_gradient(self.sd(scales)), _LEAST_SCALE, 1.0)
        box = (*self.begun.box[:2], set_at(steps, index, steps[index] * tight))
        return fit(
            self.task, self.args(scales, self.rows(scales)), z, self.begun._replace(box=box), NEAR, differentiable
        )

    def model(self, scales: Float[AnyArray, " s"], z: Float[AnyArray, " z"]) -> PriorModel:
        """The model of the parameters that have a prior, linear at a point."""
        xp, index, (lower, upper, steps) = namespace(scales, z), self.prior.index, self.begun.box
        data: Any = observed_model(z, self.args(scales, None), curved=False)
        pinned = (z <= lower) | (z >= upper)
        deviation = (z[: self.prior.mean.shape[0]] - self.prior.mean)[index] / steps[index]
        gram, gradient = reduced(data.gram.scaled(steps), data.gradient * steps)
        return eliminated(gram, gradient, deviation, index, xp.asarray(pinned)[: gram.shape[0]])

    def log_sigma(self, z: Float[AnyArray, " z"], effective: Float[AnyArray, " k"]) -> Float[AnyArray, " 1"]:
        """The tips' standard deviation by the residuals; as in the reference where the noise is given."""
        if self.task.noise is not None:
            return _log_sigma(self.reference.sigma)
        spent = z.shape[0] - effective.shape[0] + namespace(effective).sum(effective)
        return _log_sigma(state_at(self.task, self.begun.space, z, effective=spent).sigma)

    def updated(self, scales: Float[AnyArray, " s"], z: Float[AnyArray, " z"]) -> Float[AnyArray, " s"]:
        """The scales that the result of the least squares with these scales leads to."""
        xp, model, groups = namespace(scales, z), self.model(scales, z), self.groups
        # Where nothing is expected, every search begins at a broad prior, so that it depends on the data alone.
        variances = learned_log_variances(model, groups, xp.where(groups.expected, scales[1:], groups.first))
        effective = effective_parameters(model, self.sd(xp.concatenate([scales[:1], variances])))
        return xp.concatenate([self.log_sigma(z, effective), variances])

    def mismatch(self, scales: Float[AnyArray, " s"], z: Float[AnyArray, " z"]) -> Float[AnyArray, " s"]:
        """Zero at the fixed point: the equations that `updated` solves."""
        xp, model, sd, variances = namespace(scales, z), self.model(scales, z), self.sd(scales), scales[1:]
        effective, groups = effective_parameters(model, sd), self.groups
        slope = xp.asarray(groups.members) @ ((model.deviation / sd) ** 2 - effective)
        slope = slope + groups.slope(variances)
        smallest = stop_gradient(variances) <= _LEAST_LOG + 1e-9
        of_groups = xp.where(smallest, variances - _LEAST_LOG, slope)
        of_groups = xp.where(xp.asarray(self.learned), of_groups, variances - groups.first)
        return xp.concatenate([scales[:1] - self.log_sigma(z, effective), of_groups])

    def moving(self, scales: Float[AnyArray, " s"]) -> Bool[AnyArray, " g"]:
        """Which groups are learned, and deviate from their mean."""
        return namespace(scales).asarray(self.learned) & (scales[1:] > _LEAST_LOG + 1e-9)

    def by_scales(self, scales: Float[AnyArray, " s"], model: PriorModel) -> Callable[[AnyArray], AnyArray]:
        """What the uncertainty of learned scales adds to the covariance of the unknowns, of the inverse G of their
        information (Kass and Steffey 1989, JASA 84, 717-726).

        The expectation of the covariance, and the covariance of the expectation. A variance that is learned from the
        deviations of few parameters has an inverse gamma distribution, of shape 1 / c where c is the variance of its
        logarithm, so that its expectation is 1 / (1 - c) times what the evidence makes most probable. Where the prior
        is all that is known of a parameter, this is the variance of Student's t, with 2 / c degrees of freedom. Scales
        that are expected have a distribution of their own, and predictions with them are cautious enough as they are
        (the UR10 of `benchmarks/NOTES.md`).
        """
        xp, index = namespace(scales, model), self.prior.index
        covariance = covariance_of_log_variances(model, self.groups, scales[1:], self.moving(scales))
        members, information = xp.asarray(self.prior.membership), 1 / self.sd(scales) ** 2
        pull = (model.deviation * information)[:, None] * members.T
        spread = xp.minimum(xp.diagonal(covariance), _MOST_SPREAD)
        spread = xp.where(xp.asarray(~self.groups.expected), spread, 0.0)
        height = self.prior.mean.shape[0] + self.task.observed.layout.shared
        # Information of the prior, less that of one with the expectation of its variance.
        lost = xp.where(model.pinned, 0.0, information * (spread @ members))
        lost, pull = set_at(xp.zeros(height), index, lost), set_at(xp.zeros((height, pull.shape[1])), index, pull)

        def added(inverse: Float[AnyArray, "h h"]) -> Float[AnyArray, "h h"]:
            moved = inverse @ pull
            # (G^-1 - L)^-1 - G, with the information L that is lost.
            root = xp.where(lost > 0, xp.sqrt(xp.where(lost > 0, lost, 1.0)), 0.0)
            half = inverse * root[None, :]
            left = xp.asarray(np.eye(len(root))) - root[:, None] * half
            return moved @ covariance @ moved.T + half @ inverse_positive_definite(left) @ half.T

        return added

    def metrics(self, scales: Float[AnyArray, " s"], effective: Float[AnyArray, " k"]) -> PriorMetrics:
        """What the result says of the prior."""
        xp, prior = namespace(scales, effective), self.prior
        first = np.array([members[0] for members in prior.members])
        in_units, of_groups = np.array([unit != MIXED for unit in prior.units]), xp.exp(0.5 * scales[1:])
        return PriorMetrics(
            groups=prior.groups,
            learned=prior.learned,
            units=prior.units,
            parameters=tuple(len(members) for members in prior.members),
            sd=xp.where(in_units, of_groups * self.steps[first], of_groups),
            effective=xp.asarray(prior.membership) @ effective,
            supported=~xp.asarray(self.learned) | self.moving(scales),
            names=self.begun.space.names,
            mean=prior.mean,
            weight=self.rows(scales).weight,
        )


def _log_sigma(sigma: Float[AnyArray, ""]) -> Float[AnyArray, " 1"]:
    xp = namespace(sigma)
    return xp.log(xp.maximum(sigma, 1e-9))[None]


class Rounds(NamedTuple):
    """A fixed-point iteration of scales, extrapolated along its last rounds (Anderson 1965; Walker and Ni 2011)."""

    scales: Float[AnyArray, " s"]
    count: AnyArray
    change: AnyArray  # of the scales in the last round
    near: AnyArray  # rounds near the fixed point
    new: Float[AnyArray, " s"]  # what the scales of the last round led to,
    residual: Float[AnyArray, " s"]  # and what it changed; of each round, both less those of the round before:
    of_new: Float[AnyArray, "m s"]
    of_residual: Float[AnyArray, "m s"]

    @classmethod
    def begun(cls, scales: Float[AnyArray, " s"]) -> "Rounds":
        """Before the first round."""
        xp, none = namespace(scales), namespace(scales).zeros((_REMEMBERED, *scales.shape))
        zero = xp.zeros((), dtype=np.int64)
        return cls(scales, zero, xp.asarray(np.inf), zero, scales, scales, none, none)

    def after(self, new: Float[AnyArray, " s"], least: Any = -np.inf) -> "Rounds":
        """One more round, in which the scales led to others; none becomes smaller than its least."""
        xp, residual = namespace(self.scales, new), new - self.scales
        change = xp.max(xp.abs(residual))
        # Rounds far from the fixed point say nothing of it, and are forgotten.
        follows = (change < _NEAR) & (self.near > 0)
        of_new, of_residual = (
            xp.where(follows, xp.concatenate([(present - before)[None], older[:-1]]), 0.0)
            for present, before, older in ((new, self.new, self.of_new), (residual, self.residual, self.of_residual))
        )
        # Where the residual would vanish if it were linear along the rounds, as far as they tell.
        gram = of_residual @ of_residual.T
        gram = gram + (1e-12 * xp.trace(gram) + 1e-300) * xp.asarray(np.eye(_REMEMBERED))
        weights = solve_positive_definite(gram, of_residual @ residual)
        extrapolated = new - xp.where(xp.all(xp.isfinite(weights)), weights, 0.0) @ of_new
        # Few data can lead to and fro between two sets of scales.
        damped = xp.where(self.count < _UNDAMPED, new, 0.5 * (new + self.scales))
        scales = xp.where(change < _NEAR, xp.maximum(extrapolated, least), damped)
        near = xp.where(change < _NEAR, self.near + 1, 0)
        return Rounds(scales, self.count + 1, change, near, new, residual, of_new, of_residual)


def _settled(problem: PriorProblem, z: Float[AnyArray, " z"]) -> tuple[Float[AnyArray, " s"], Fit]:
    """The scales at their fixed point, and the least squares with them.

    The derivative of the scales is that of an implicit function, exact where the fixed point is reached.
    """
    xp, differentiable = namespace(z, problem.task), problem.task.differentiable
    tolerance = _TOLERANCE if xp is np or differentiable else _BATCH_TOLERANCE
    # Constants of differentiation, which passes through the fixed point alone.
    constant, begin = stop_gradient((problem, z))
    least = np.concatenate([[-np.inf], np.where(problem.learned, _LEAST_LOG, -np.inf)])

    def again(state: tuple[Rounds, AnyArray, AnyArray]) -> tuple[Rounds, AnyArray, AnyArray]:
        rounds, z, evaluations = state
        solution = constant.fit(rounds.scales, z, differentiable=False)
        new = constant.updated(rounds.scales, solution.parameters)
        return rounds.after(new, least), solution.parameters, evaluations + solution.steps

    def solve(_: Any, first: Float[AnyArray, " s"]) -> tuple[Any, tuple[Any, Any, Any]]:
        rounds, last, evaluations = while_loop(
            lambda state: (state[0].count < _ROUNDS) & (state[0].change > tolerance),
            again,
            (Rounds.begun(stop_gradient(first)), begin, xp.zeros((), dtype=np.int64)),
        )
        # As a float: custom_root gives this a tangent of its own type, which an integer must not have.
        return rounds.scales, (last, xp.asarray(evaluations, dtype=float), rounds.change)

    def mismatch(scales: Float[AnyArray, " s"]) -> Float[AnyArray, " s"]:
        return problem.mismatch(scales, problem.fit(scales, stop_gradient(z), differentiable=True).parameters)

    def solve_linear(derivative: Callable, right: Float[AnyArray, " s"]) -> Float[AnyArray, " s"]:
        left, values, transposed = singular_values(jax.jacfwd(derivative)(right))
        large = values > 1e-14 * values[0]
        return transposed @ (xp.where(large, 1 / xp.where(large, values, 1.0), 0.0) * (left.T @ right))

    first = stop_gradient(problem.first_scales())
    if xp is np or not differentiable:
        scales, (last, evaluations, change) = solve(None, first)
    else:
        scales, (last, evaluations, change) = jax.lax.custom_root(mismatch, first, solve, solve_linear, has_aux=True)
    solution = problem.fit(scales, stop_gradient(last), differentiable=differentiable)
    reason = xp.where(change > 1e-4, MAX_STEPS, member_numbers(solution.result))
    steps = xp.asarray(evaluations, dtype=np.int64) + solution.steps
    return scales, solution._replace(steps=steps, result=reasons(reason))
