"""The adjoint: exact derivatives of a box-bounded minimum by implicit differentiation, also on active bounds."""

import inspect

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..core import _compat
from ..core.linear_algebra import singular_values
from .active_set import Box, Flat


class EquilibratedPseudoInverse(lx.AbstractLinearSolver):
    """Pseudo-inverse of a square operator whose rows and columns are first scaled to size 1.

    So no choice of units makes a direction look undetermined.
    """

    rcond: float = 1e-14

    def init(self, operator, options):
        matrix = operator.as_matrix()
        row = _inverse(jnp.max(jnp.abs(matrix), axis=1))
        column = _inverse(jnp.max(jnp.abs(row[:, None] * matrix), axis=0))
        row = row * _inverse(jnp.max(jnp.abs(row[:, None] * matrix * column[None, :]), axis=1))
        decomposed = singular_values(row[:, None] * matrix * column[None, :])
        structures = _compat.Static((operator.in_structure(), operator.out_structure()))
        return decomposed, row, column, structures

    def compute(self, state, vector, options):
        (u, s, v), row, column, structures = state
        determined = s > self.rcond * s[0]
        inverse = jnp.where(determined, 1 / jnp.where(determined, s, 1.0), 0.0)
        solution = column * (v @ (inverse * (u.T @ (row * ravel_pytree(vector)[0]))))
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structures.value[0])
        return ravel_pytree(like)[1](solution), lx.RESULTS.successful, {}

    def assume_full_rank(self):
        return False

    def transpose(self, state, options):
        (u, s, v), row, column, structures = state
        inside, outside = structures.value
        return ((v, s, u), column, row, _compat.Static((outside, inside))), options

    def conj(self, state, options):
        return state, options


def _inverse(size: Array) -> Array:
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 1.0)


class BoundedAdjoint(optx.AbstractAdjoint):
    """Implicit differentiation of the stationarity of a box-bounded minimum: y = clip(y - gradient).

    Optimistix's own implicit adjoint takes the gradient to vanish, which is false on an active bound: there the
    solution follows the bound. Exact (full Hessian, not Gauss-Newton's), forward and reverse.
    """

    linear_solver: lx.AbstractLinearSolver = EquilibratedPseudoInverse()

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        del rewrite_fn
        inputs = (*inputs, _compat.while_loop)
        # Optimistix wants a plain global function, not one that a run-time type checker has wrapped.
        return _compat.implicit_jvp(primal_fn, inspect.unwrap(stationarity), inputs, tags, self.linear_solver)


def stationarity(y: PyTree[Array], solved: PyTree, inputs: PyTree) -> Flat:
    """Zero at a bounded minimum: the gradient where an unknown is free, its distance from the bound where pinned."""
    del solved
    fn, _, _, args, options, *_ = inputs
    flat, unravel = ravel_pytree(y)
    box = box_of(y, options)

    def cost(point: Array) -> Array:
        value = ravel_pytree(fn(unravel(point), args)[0])[0]
        return 0.5 * jnp.dot(value, value)

    gradient = jax.grad(cost)(flat)
    point, slope = jax.lax.stop_gradient((flat, gradient))
    nearer_lower = point - box.lower <= box.upper - point
    # An absent bound is infinite; it is never the nearer one of a pinned unknown, but must not make NaN in the other
    # branch.
    lower, upper = (jnp.where(jnp.isfinite(bound), bound, 0.0) for bound in (box.lower, box.upper))
    return jnp.where(box.pinned(point, slope), flat - jnp.where(nearer_lower, lower, upper), gradient)


def box_of(y: PyTree[Array], options: dict) -> Box:
    """The box that the options of a solve describe."""
    return Box.of(y, options.get("lower"), options.get("upper"), options.get("scale"))
