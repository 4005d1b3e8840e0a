"""The active set: which unknowns sit on a bound, and the damped step that keeps to the box.

An unknown on a bound with the gradient pushing outwards is pinned: it is left out of the step (Bertsekas 1982). The
step of the others is clipped to the box, and what the model predicts is computed for the *clipped* step.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree

from ..core.numpy_or_jax import AnyArray, cond, namespace, while_loop
from .arrow import Arrow

Mask = Bool[AnyArray, "*slots p"]
Flat = Float[AnyArray, "*slots p"]
Number = Float[AnyArray, "*slots"]

_MAX_RAISES = 200  # of the damping, for one step


class QuadraticModel(NamedTuple):
    """The quadratic model of the cost at one point: all that a step needs from one evaluation of f and its Jacobian
    J.

    Example:
        >>> import jax.numpy as jnp
        >>> def residual(y, target):
        ...     return y - target
        >>> def normal(y, target):
        ...     return aj.solver.QuadraticModel(0.5 * ((y - target) ** 2).sum(), y - target, jnp.eye(2))
        >>> print(aj.least_squares(residual, jnp.zeros(2), jnp.array([1.0, 3.0]), upper=2.0, normal=normal).value)
        [1. 2.]
    """

    cost: Float[AnyArray, "*slots"]  # |f|^2 / 2
    gradient: Float[AnyArray, "*slots p"]  # J^T f
    gram: Arrow | Float[AnyArray, "*slots p p"]  # J^T J

    def finite(self) -> Bool[AnyArray, "*slots"]:
        """Whether every number of it is finite."""
        xp = namespace(self)
        sums = xp.sum(self.gradient, axis=-1) + Arrow.of(self.gram).sum()
        return xp.isfinite(self.cost) & xp.isfinite(sums)


class Box(NamedTuple):
    """The bounds as flat vectors, and the natural step of each unknown (None: the columns of J decide, as in
    MINPACK)."""

    lower: Flat
    upper: Flat
    scale: Flat | None

    def clip(self, y: Flat) -> Flat:
        """The nearest point of the box."""
        return namespace(y).clip(y, self.lower, self.upper)

    def pinned(self, y: Flat, gradient: Flat) -> Mask:
        """Unknowns on a bound with the gradient pushing outwards."""
        return ((y <= self.lower) & (gradient >= 0)) | ((y >= self.upper) & (gradient <= 0))

    def optimality(self, y: Flat, model: QuadraticModel) -> Number:
        """Largest projected coordinate step as a cosine: sqrt(h) |y - clip(y - g / h)| / |f|, with h = diag(J^T J).

        Away from bounds it is MINPACK's cosine between the residual and a column of J; it does not depend on units.
        """
        h, xp = Arrow.of(model.gram).diagonal(), namespace(y)
        safe = xp.where(h > 0, h, 1.0)
        step = xp.where(h > 0, xp.sqrt(safe) * xp.abs(y - self.clip(y - model.gradient / safe)), 0.0)
        return xp.max(step, axis=-1) / xp.sqrt(2 * xp.maximum(model.cost, np.finfo(np.float64).tiny))


class Step(NamedTuple):
    """What is tried next."""

    trial: Flat
    predicted: Number  # decrease of the cost that the model predicts for the trial
    length: Number  # of the damped step before it was clipped to the box, scaled


def propose(
    y: Flat, model: QuadraticModel, box: Box, scale: Flat, damping: Number, radius: Number | None
) -> tuple[Step, Number]:
    """The damped step on the unpinned unknowns, clipped to the box; and the damping, raised until the step before
    clipping is no longer than ``radius`` (scaled), where there is one.

    Solves (S J^T J S + damping I) z = -S J^T f with S = diag(scale) and y + S z as the unclipped trial. Unknowns that
    the step would carry through a bound are put on it and the rest solved again, once: without that, strongly coupled
    unknowns zigzag along a bound.
    """
    xp, pinned = namespace(y), box.pinned(y, model.gradient)
    gram, downhill = Arrow.of(model.gram).scaled(scale), -scale * model.gradient
    if radius is None:
        z = gram.damped_solution(downhill, pinned, damping)
    else:
        z, damping = _solve_within(gram, downhill, pinned, damping, radius)
    step, length = scale * z, norm(z)

    def solve_again(step: Flat) -> Flat:
        landed = box.clip(y + step)
        through = landed != y + step
        shift = xp.where(through, landed - y, 0.0)
        rest = downhill - gram.times(shift / scale)
        return xp.where(through, shift, scale * gram.damped_solution(rest, pinned | through, damping))

    # One test for all slots: solving again changes nothing in a slot whose step stays inside.
    step = cond(xp.any(box.clip(y + step) != y + step), solve_again, lambda s: s, step)
    trial = box.clip(y + step)
    step = trial - y
    predicted = -xp.sum(step * (model.gradient + 0.5 * Arrow.of(model.gram).times(step)), axis=-1)
    # A failed factorisation shows as NaN: stay, predict nothing, and let the damping grow.
    usable = xp.isfinite(predicted)
    nowhere = Step(y, xp.zeros_like(predicted), xp.full_like(length, np.inf))
    return choose(usable, Step(trial, predicted, length), nowhere), damping


def _solve_within(gram: Arrow, right: Flat, fixed: Mask, damping: Number, radius: Number) -> tuple[Flat, Number]:
    """The damped solution, with the damping raised as far as it needs to be no longer than ``radius``; and that
    damping."""

    xp = namespace(gram)

    def too_long(state: tuple[Any, Flat, Number]) -> Any:
        count, z, _ = state
        return (count < _MAX_RAISES) & xp.any(~(norm(z) <= radius))

    def raised(state: tuple[Any, Flat, Number]) -> tuple[Any, Flat, Number]:
        count, z, damping = state
        ratio = norm(z) / radius
        # The length falls at most inversely to the damping, so the root does not go past the radius by much. A failed
        # factorisation shows as NaN.
        factor = xp.where(xp.isfinite(ratio), xp.maximum(xp.sqrt(ratio), 1.05), 10.0)
        damping = xp.where((count == 0) | (ratio <= 1), damping, factor * damping)
        return count + 1, gram.damped_solution(right, fixed, damping), damping

    nothing = xp.full_like(right, np.nan)
    return while_loop(too_long, raised, (xp.zeros((), dtype=np.int32), nothing, damping))[1:]


def choose(predicate: Bool[AnyArray, "*slots"], new: PyTree, old: PyTree) -> PyTree:
    """Slot by slot, the new tree or the old one."""
    if namespace(predicate) is np and predicate.ndim == 0:
        return new if predicate else old

    def pick(first: Any, second: Any) -> Any:
        return jnp.where(predicate.reshape(predicate.shape + (1,) * (first.ndim - predicate.ndim)), first, second)

    return jax.tree.map(pick, new, old)


def norm(vector: Flat) -> Number:
    """Euclidean lengths of a batch of vectors."""
    xp = namespace(vector)
    return xp.sqrt(xp.sum(vector**2, axis=-1))
