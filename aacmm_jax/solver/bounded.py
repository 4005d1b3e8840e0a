"""Box-bounded nonlinear least squares on Optimistix's extension points: the solver, its adjoint, and one entry function."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree
from optimistix.internal import implicit_jvp

from ..core.arrays import is_concrete
from ..core.errors import InputError
from .levenberg_marquardt import Box, Flat, Model, Progress, Reason, Rules, advance, begin, either


def flat_box(y: PyTree[Array], lower: PyTree, upper: PyTree, scale: PyTree) -> Box:
    """Bounds and scale as flat vectors; None, scalars and leaves that broadcast against y's are spread over it."""

    def flat(tree: PyTree, fill: float) -> Flat:
        if tree is None or isinstance(tree, (int, float)):
            filled = fill if tree is None else float(tree)
            tree = jax.tree.map(lambda leaf: jnp.full(leaf.shape, filled), y)
        else:
            tree = jax.tree.map(
                lambda leaf, b: jnp.broadcast_to(jnp.asarray(b, dtype=jnp.float64), leaf.shape), y, tree
            )
        return ravel_pytree(tree)[0]

    return Box(flat(lower, -jnp.inf), flat(upper, jnp.inf), None if scale is None else flat(scale, 1.0))


class BoundedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within a box, as an Optimistix least-squares solver.

    The box comes in ``options``: ``lower``, ``upper`` (PyTrees like y, scalars, or None) and ``scale``, the natural step of
    each unknown (None: chosen from the columns of the Jacobian). ``normal``, a function of (y, args), may supply the `Model`
    where it can be had cheaper than from the Jacobian of the residual. ``stats`` of the solution holds ``reason``,
    ``num_accepted_steps``, ``cost``, ``gradient`` and ``optimality``.

    Use it through `least_squares`, which also brings the adjoint that knows the bounds.
    """

    rtol: float = 1e-14  # on the step to come, relative to |y| (both scaled)
    atol: float = 0.0  # on the step, scaled
    gtol: float = 1e-10  # on the projected gradient: cosine between the residual and a column of J
    initial_damping: float = 1e-3  # relative to the largest curvature
    # Optimistix asks for a norm; every test here is written out, since it scales by unknowns.
    norm: Callable[[PyTree], Array] = optx.max_norm

    @property
    def rules(self) -> Rules:
        """Tolerances and damping, as the steps take them."""
        return Rules(self.rtol, self.atol, self.gtol, self.initial_damping)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        flat, _ = ravel_pytree(y)
        return begin(flat, _box(y, options))

    def step(self, fn, y, args, options, state, tags):
        _, unravel = ravel_pytree(y)
        normal = options.get("normal")
        if normal is None:
            evaluated, aux = _evaluate(fn, unravel, state.trial, args)
        else:
            evaluated, aux = normal(unravel(state.trial), args), None
        state = advance(state, evaluated, _box(y, options), self.rules)
        return unravel(state.y), state, aux

    def terminate(self, fn, y, args, options, state, tags):
        failed = optx.RESULTS.where(
            state.reason == Reason.stalled, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        failed = optx.RESULTS.where(state.reason == Reason.nonfinite, optx.RESULTS.nonfinite, failed)
        return state.reason != Reason.running, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        # Optimistix itself stops, before any step, where y is not finite.
        unfinished = either(result == optx.RESULTS.nonfinite, Reason.nonfinite, Reason.max_steps)
        stats = {
            "reason": either(state.reason == Reason.running, unfinished, state.reason),
            "num_accepted_steps": state.accepted,
            "cost": state.model.cost,
            "gradient": state.model.gradient,
            "optimality": state.optimality,
        }
        return y, aux, stats


def _box(y: PyTree[Array], options: dict[str, Any]) -> Box:
    return flat_box(y, options.get("lower"), options.get("upper"), options.get("scale"))


def _evaluate(fn: Callable, unravel: Callable, flat: Flat, args: PyTree) -> tuple[Model, PyTree]:
    def residual(point: Flat) -> tuple[Array, tuple[Array, PyTree]]:
        out, aux = fn(unravel(point), args)
        value = ravel_pytree(out)[0]
        return value, (value, aux)

    jacobian, (value, aux) = jax.jacfwd(residual, has_aux=True)(flat)
    return Model(0.5 * jnp.dot(value, value), jacobian.T @ value, jacobian.T @ jacobian), aux


class _EquilibratedSVD(lx.AbstractLinearSolver):
    """Pseudo-inverse after rows and columns are brought to size 1, so that no unit makes a direction look undetermined."""

    rcond: float = 1e-14

    def init(self, operator, options):
        matrix = operator.as_matrix()
        row = _inverse(jnp.max(jnp.abs(matrix), axis=1))
        column = _inverse(jnp.max(jnp.abs(row[:, None] * matrix), axis=0))
        row = row * _inverse(jnp.max(jnp.abs(row[:, None] * matrix * column[None, :]), axis=1))
        u, s, vt = jnp.linalg.svd(row[:, None] * matrix * column[None, :], full_matrices=False)
        structures = eqxi.Static((operator.in_structure(), operator.out_structure()))
        return (u, s, vt), row, column, structures

    def compute(self, state, vector, options):
        (u, s, vt), row, column, structures = state
        known = s > self.rcond * s[0]
        inverse = jnp.where(known, 1 / jnp.where(known, s, 1.0), 0.0)
        solution = column * (vt.T @ (inverse * (u.T @ (row * ravel_pytree(vector)[0]))))
        like = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), structures.value[0])
        return ravel_pytree(like)[1](solution), lx.RESULTS.successful, {}

    def assume_full_rank(self):
        return False

    def transpose(self, state, options):
        (u, s, vt), row, column, structures = state
        inside, outside = structures.value
        return ((vt.T, s, u.T), column, row, eqxi.Static((outside, inside))), options

    def conj(self, state, options):
        return state, options


def _inverse(size: Array) -> Array:
    return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 1.0)


class BoundedAdjoint(optx.AbstractAdjoint):
    """Implicit differentiation of the stationarity of a box-bounded minimum: y = clip(y - gradient).

    Optimistix's own implicit adjoint takes the gradient to vanish, which is false on an active bound: there the solution
    follows the bound. Exact (full Hessian, not Gauss-Newton's), forward and reverse.
    """

    linear_solver: lx.AbstractLinearSolver = _EquilibratedSVD()

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        del rewrite_fn
        inputs = (*inputs, _while_loop)
        # Optimistix wants a plain global function, not one that a run-time type checker has wrapped.
        return implicit_jvp(primal_fn, inspect.unwrap(_stationarity), inputs, tags, self.linear_solver)


def _while_loop(cond_fun, body_fun, init_val, *, max_steps):
    return eqxi.while_loop(cond_fun, body_fun, init_val, max_steps=max_steps, kind="lax")


def _stationarity(y: PyTree[Array], solved: PyTree, inputs: PyTree) -> Flat:
    """Zero at a bounded minimum: the gradient where an unknown is free, its distance from the bound where pinned."""
    del solved
    fn, _, _, args, options, *_ = inputs
    flat, unravel = ravel_pytree(y)
    box = _box(y, options)

    def cost(point: Flat) -> Array:
        value = ravel_pytree(fn(unravel(point), args)[0])[0]
        return 0.5 * jnp.dot(value, value)

    gradient = jax.grad(cost)(flat)
    fixed_point, fixed_gradient = jax.lax.stop_gradient((flat, gradient))
    pinned = box.pinned(fixed_point, fixed_gradient)
    nearer_lower = fixed_point - box.lower <= box.upper - fixed_point
    # An absent bound is infinite; it is never the nearer one of a pinned unknown, but must not make NaN in the other branch.
    bound = jnp.where(
        nearer_lower,
        jnp.where(jnp.isfinite(box.lower), box.lower, 0.0),
        jnp.where(jnp.isfinite(box.upper), box.upper, 0.0),
    )
    return jnp.where(pinned, flat - bound, gradient)


def least_squares(
    fn: Callable[[PyTree, PyTree], PyTree],
    y0: PyTree[Array],
    args: PyTree = None,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    scale: PyTree = None,
    normal: Callable[[PyTree, PyTree], Model] | None = None,
    solver: BoundedLevenbergMarquardt = BoundedLevenbergMarquardt(),
    max_steps: int = 1000,
    throw: bool = True,
) -> optx.Solution:
    """Minimise 1/2 |fn(y, args)|^2 within lower <= y <= upper.

    ``y0`` is any PyTree of floats; ``lower``, ``upper`` and ``scale`` are PyTrees like it, scalars, or None (no bound;
    scaling by the Jacobian's columns). ``y0`` is clipped to the box. Returns an `optimistix.Solution`; its
    ``stats["reason"]`` says which test ended the solve. Differentiable with respect to args and both bounds. ``normal``, a
    global function of (y, args), may supply cost, gradient and Gram matrix of fn as a `Model`.

    With ``throw=False`` a failure is only data (``result``), as a batch needs it.
    """
    options = {"lower": lower, "upper": upper, "scale": scale, "normal": normal}
    _check_box(y0, lower, upper)
    y0 = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.float64), y0)
    return optx.least_squares(
        fn,
        solver,
        y0,
        args,
        options,
        max_steps=max_steps,
        adjoint=BoundedAdjoint(),
        throw=throw,
    )


def _check_box(y0: PyTree, lower: PyTree, upper: PyTree) -> None:
    """Refuse a lower bound above its upper one, where both can be looked at now."""
    if not is_concrete(*jax.tree.leaves((y0, lower, upper))):
        return
    with jax.ensure_compile_time_eval():
        box = flat_box(jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype=jnp.float64), y0), lower, upper, None)
        wrong = np.flatnonzero(~(np.asarray(box.lower) <= np.asarray(box.upper)))
    if len(wrong):
        i = wrong[0]
        raise InputError(
            f"lower bound {float(box.lower[i]):g} of unknown {i + 1} is above its upper bound {float(box.upper[i]):g}; "
            "exchange or widen them."
        )
