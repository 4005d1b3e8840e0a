"""The active set: which unknowns sit on a bound, and the damped step that keeps to the box.

An unknown on a bound with the gradient pushing outwards is pinned: it is left out of the step (Bertsekas 1982). The
step of the others is clipped to the box, and what the model predicts is computed for the *clipped* step.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ..core.linear_algebra import solve_positive_definite

Flat = Float[Array, "*slots p"]
Number = Float[Array, "*slots"]

_MAX_RAISES = 200  # of the damping, for one step


class QuadraticModel(eqx.Module):
    """The quadratic model of the cost at one point: what a step needs of one evaluation of f and its Jacobian J."""

    cost: Float[Array, "*slots"]  # |f|^2 / 2
    gradient: Float[Array, "*slots p"]  # J^T f
    gram: Float[Array, "*slots p p"]  # J^T J

    def finite(self) -> Bool[Array, "*slots"]:
        """Whether every number of it is finite."""
        sums = jnp.sum(self.gradient, axis=-1) + jnp.sum(self.gram, axis=(-2, -1))
        return jnp.isfinite(self.cost) & jnp.isfinite(sums)


class Box(eqx.Module):
    """The bounds as flat vectors, and the natural step of each unknown (None: from the columns of J, as in MINPACK)."""

    lower: Flat
    upper: Flat
    scale: Flat | None

    @classmethod
    def of(cls, y: PyTree[Array], lower: PyTree, upper: PyTree, scale: PyTree) -> "Box":
        """Bounds and scale in any form that `expand` takes, but scale may be None as a whole."""

        def flat(given: PyTree, absent: float) -> Flat:
            return ravel_pytree(expand(y, given, absent))[0]

        return cls(flat(lower, -jnp.inf), flat(upper, jnp.inf), None if scale is None else flat(scale, 1.0))

    def clip(self, y: Flat) -> Flat:
        """The nearest point of the box."""
        return jnp.clip(y, self.lower, self.upper)

    def pinned(self, y: Flat, gradient: Flat) -> Bool[Array, "*slots p"]:
        """Unknowns on a bound with the gradient pushing outwards."""
        return ((y <= self.lower) & (gradient >= 0)) | ((y >= self.upper) & (gradient <= 0))

    def optimality(self, y: Flat, model: QuadraticModel) -> Number:
        """Largest projected coordinate step as a cosine: sqrt(h) |y - clip(y - g / h)| / |f|, with h = diag(J^T J).

        Away from bounds it is MINPACK's cosine between the residual and a column of J; it does not depend on units.
        """
        h = diagonal(model.gram)
        safe = jnp.where(h > 0, h, 1.0)
        step = jnp.where(h > 0, jnp.sqrt(safe) * jnp.abs(y - self.clip(y - model.gradient / safe)), 0.0)
        return jnp.max(step, axis=-1) / jnp.sqrt(2 * jnp.maximum(model.cost, jnp.finfo(jnp.float64).tiny))


class Step(eqx.Module):
    """What is tried next."""

    trial: Flat
    predicted: Number  # decrease of the cost that the model predicts for the trial
    length: Number  # of the damped step before it was clipped to the box, scaled


def propose(
    y: Flat, model: QuadraticModel, box: Box, scale: Flat, damping: Number, radius: Number | None
) -> tuple[Step, Number]:
    """The damped step on the unpinned unknowns, clipped to the box; and its damping.

    Where there is a ``radius``, the damping is raised until the step before clipping is no longer (scaled).

    Solves (S J^T J S + damping I) z = -S J^T f with S = diag(scale) and y + S z as the unclipped trial. Unknowns that
    the step would carry through a bound are put on it and the rest solved again, once: without that, strongly coupled
    unknowns zigzag along a bound.
    """
    pinned = box.pinned(y, model.gradient)
    gram, downhill = scale[..., :, None] * model.gram * scale[..., None, :], -scale * model.gradient
    if radius is None:
        z = _damped(gram, downhill, pinned, damping)
    else:
        z, damping = _solve_within(gram, downhill, pinned, damping, radius)
    step, length = scale * z, norm(z)

    def solve_again(step: Flat) -> Flat:
        landed = box.clip(y + step)
        through = landed != y + step
        shift = jnp.where(through, landed - y, 0.0)
        return jnp.where(
            through, shift, scale * _damped(gram, downhill - _times(gram, shift / scale), pinned | through, damping)
        )

    # One test for all slots: solving again changes nothing in a slot whose step stays inside.
    step = jax.lax.cond(jnp.any(box.clip(y + step) != y + step), solve_again, lambda s: s, step)
    trial = box.clip(y + step)
    step = trial - y
    predicted = -jnp.sum(step * (model.gradient + 0.5 * _times(model.gram, step)), axis=-1)
    # A failed factorisation shows as NaN: stay, predict nothing, and let the damping grow.
    usable = jnp.isfinite(predicted)
    nowhere = Step(y, jnp.zeros_like(predicted), jnp.full_like(length, jnp.inf))
    return choose(usable, Step(trial, predicted, length), nowhere), damping


def _solve_within(
    gram: Float[Array, "*slots p p"], right: Flat, fixed: Bool[Array, "*slots p"], damping: Number, radius: Number
) -> tuple[Flat, Number]:
    """`_damped` with the damping raised as far as z needs it to be no longer than ``radius``; and that damping."""

    def too_long(state: tuple[Array, Flat, Number]) -> Bool[Array, ""]:
        count, z, _ = state
        return (count < _MAX_RAISES) & jnp.any(~(norm(z) <= radius))

    def raised(state: tuple[Array, Flat, Number]) -> tuple[Array, Flat, Number]:
        count, z, damping = state
        ratio = norm(z) / radius
        # The length falls at most inversely to the damping, so the root does not go past the radius by much. A failed
        # factorisation shows as NaN.
        factor = jnp.where(jnp.isfinite(ratio), jnp.maximum(jnp.sqrt(ratio), 1.05), 10.0)
        damping = jnp.where((count == 0) | (ratio <= 1), damping, factor * damping)
        return count + 1, _damped(gram, right, fixed, damping), damping

    nothing = jnp.full_like(right, jnp.nan)
    return jax.lax.while_loop(too_long, raised, (jnp.zeros((), dtype=jnp.int32), nothing, damping))[1:]


def _damped(gram: Float[Array, "*slots p p"], right: Flat, fixed: Bool[Array, "*slots p"], damping: Number) -> Flat:
    """Solution of (gram + damping I) z = right on the unknowns that are not fixed; 0 for those that are."""
    p = gram.shape[-1]
    identity = jnp.eye(p, dtype=bool).reshape((1,) * (gram.ndim - 2) + (p, p))
    inside = ~fixed
    matrix = jnp.where(inside[..., :, None] & inside[..., None, :], gram, 0.0)
    matrix = matrix + jnp.where(identity, jnp.where(fixed, 1.0, damping[..., None])[..., None, :], 0.0)
    return solve_positive_definite(matrix, jnp.where(fixed, 0.0, right))


def choose(predicate: Bool[Array, "*slots"], new: PyTree, old: PyTree) -> PyTree:
    """Slot by slot, the new tree or the old one."""

    def pick(one: Array, other: Array) -> Array:
        return jnp.where(predicate.reshape(predicate.shape + (1,) * (one.ndim - predicate.ndim)), one, other)

    return jax.tree.map(pick, new, old)


def diagonal(matrix: Float[Array, "*slots p p"]) -> Flat:
    """Diagonals of a batch of matrices."""
    return jnp.diagonal(matrix, axis1=-2, axis2=-1)


def norm(vector: Flat) -> Number:
    """Euclidean lengths of a batch of vectors."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1))


def _times(matrix: Float[Array, "*slots p p"], vector: Flat) -> Flat:
    return (matrix @ vector[..., None])[..., 0]


def expand(y: PyTree[Array], given: PyTree, absent: float) -> PyTree[Array]:
    """A tree like ``y``, from one like it whose leaves broadcast, or from a number for all; None means ``absent``."""

    def leaf_of(leaf: Array, value: object) -> Array:
        return jnp.broadcast_to(jnp.asarray(absent if value is None else value, dtype=jnp.float64), leaf.shape)

    if given is None or (jax.tree_util.all_leaves([given]) and jnp.ndim(given) == 0):
        return jax.tree.map(lambda leaf: leaf_of(leaf, given), y)
    return jax.tree.map(leaf_of, y, given)
