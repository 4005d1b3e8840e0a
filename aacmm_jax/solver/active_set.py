"""The active set: which unknowns sit on a bound, and the damped step that keeps to the box.

An unknown on a bound with the gradient pushing outwards is pinned: it is left out of the step (Bertsekas 1982). The step of
the others is clipped to the box, and what the model predicts is computed for the *clipped* step.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from ..core.linear_algebra import solve_positive_definite

Flat = Float[Array, "*slots p"]
Number = Float[Array, "*slots"]


class QuadraticModel(eqx.Module):
    """The quadratic model of the cost at one point: all that a step needs from one evaluation of f and its Jacobian J."""

    cost: Float[Array, "*slots"]  # |f|^2 / 2
    gradient: Float[Array, "*slots p"]  # J^T f
    gram: Float[Array, "*slots p p"]  # J^T J

    def finite(self) -> Bool[Array, "*slots"]:
        """Whether every number of it is finite."""
        sums = jnp.sum(self.gradient, axis=-1) + jnp.sum(self.gram, axis=(-2, -1))
        return jnp.isfinite(self.cost) & jnp.isfinite(sums)


class Box(eqx.Module):
    """The bounds as flat vectors, and the natural step of each unknown (None: the columns of J decide, as in MINPACK)."""

    lower: Flat
    upper: Flat
    scale: Flat | None

    @classmethod
    def of(cls, y: PyTree[Array], lower: PyTree, upper: PyTree, scale: PyTree) -> "Box":
        """Bounds and scale in any form that `expand` takes, but scale may be None as a whole."""
        trees = expand(y, lower, -jnp.inf), expand(y, upper, jnp.inf), scale if scale is None else expand(y, scale, 1.0)
        return cls(*(tree if tree is None else ravel_pytree(tree)[0] for tree in trees))

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


def propose(y: Flat, model: QuadraticModel, box: Box, scale: Flat, damping: Number) -> Step:
    """The damped step on the unpinned unknowns, clipped to the box.

    Solves (S J^T J S + damping I) z = -S J^T f with S = diag(scale) and y + S z as the unclipped trial. Unknowns that the
    step would carry through a bound are put on it and the rest solved again, once: without that, strongly coupled
    unknowns zigzag along a bound.
    """
    pinned = box.pinned(y, model.gradient)
    gram = scale[..., :, None] * model.gram * scale[..., None, :]
    downhill = -scale * model.gradient
    identity = jnp.eye(y.shape[-1], dtype=bool).reshape((1,) * (y.ndim - 1) + (y.shape[-1],) * 2)

    def solve(fixed: Bool[Array, "*slots p"], right: Flat) -> Flat:
        inside = ~fixed
        matrix = jnp.where(inside[..., :, None] & inside[..., None, :], gram, 0.0)
        matrix = matrix + jnp.where(identity, jnp.where(fixed, 1.0, damping[..., None])[..., None, :], 0.0)
        return scale * solve_positive_definite(matrix, jnp.where(fixed, 0.0, right))

    def solve_again(step: Flat) -> Flat:
        landed = box.clip(y + step)
        through = landed != y + step
        shift = jnp.where(through, landed - y, 0.0)
        return jnp.where(through, shift, solve(pinned | through, downhill - _times(gram, shift / scale)))

    step = solve(pinned, downhill)
    length = norm(step / scale)
    # One test for all slots: solving again changes nothing in a slot whose step stays inside.
    step = jax.lax.cond(jnp.any(box.clip(y + step) != y + step), solve_again, lambda s: s, step)
    trial = box.clip(y + step)
    step = trial - y
    predicted = -jnp.sum(step * (model.gradient + 0.5 * _times(model.gram, step)), axis=-1)
    # A failed factorisation shows as NaN: stay, predict nothing, and let the damping grow.
    usable = jnp.isfinite(predicted)
    return choose(
        usable, Step(trial, predicted, length), Step(y, jnp.zeros_like(predicted), jnp.full_like(length, jnp.inf))
    )


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
    """A tree like ``y``, from one like it whose leaves broadcast, or from a number for all; None stands for ``absent``."""

    def leaf_of(leaf: Array, value: object) -> Array:
        return jnp.broadcast_to(jnp.asarray(absent if value is None else value, dtype=jnp.float64), leaf.shape)

    if given is None or (jax.tree_util.all_leaves([given]) and jnp.ndim(given) == 0):
        return jax.tree.map(lambda leaf: leaf_of(leaf, given), y)
    return jax.tree.map(leaf_of, y, given)
