"""Box-bounded nonlinear least squares with exact derivatives, also where bounds are active.

The minimum is found by the steps of `levenberg_marquardt`, which are not differentiated, and then takes its derivatives
from its stationarity, y = clip(y - gradient), by the implicit function theorem. A common implicit adjoint takes the
gradient to vanish, which is false on an active bound: there the solution follows the bound. Exact (full Hessian, not
Gauss-Newton's), forward and reverse.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..core.arguments import Count, checked
from ..core.arrays import as_array, is_concrete
from ..core.errors import InputError
from ..core.jax_setup import check_x64
from ..core.linear_algebra import singular_values
from ..core.numpy_or_jax import stop_gradient
from .active_set import Box, Flat, QuadraticModel
from .levenberg_marquardt import Progress, Rules, minimise
from .reason import MAX_STEPS, NONFINITE, STALLED, Reason, reasons

_UNDETERMINED = 1e-14  # of the largest singular value


class BoundedLevenbergMarquardt(Rules):
    """Tolerances and initial damping of `least_squares`: ``rtol``, ``atol``, ``gtol`` and ``initial_damping``.

    Example:
        >>> import jax.numpy as jnp
        >>> loose = aj.solver.BoundedLevenbergMarquardt(rtol=1e-6, gtol=1e-6)
        >>> target = jnp.array([1.0, 3.0])
        >>> print(aj.least_squares(lambda y, target: y - target, jnp.zeros(2), target, upper=2.0, solver=loose).value)
        [1. 2.]
    """


def least_squares(
    fn: Callable[[PyTree, PyTree], PyTree],
    y0: PyTree[Array],
    args: PyTree = None,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    scale: PyTree = None,
    normal: Callable[[PyTree, PyTree], QuadraticModel] | None = None,
    solver: Rules = BoundedLevenbergMarquardt(),
    max_steps: int = 1000,
    throw: bool = True,
) -> optx.Solution:
    """Minimise 1/2 |fn(y, args)|^2 within lower <= y <= upper.

    Differentiable with respect to ``args`` and both bounds, forward and reverse.

    Args:
        fn: The residual, a PyTree of arrays.
        y0: The start, any PyTree of floats; it is clipped to the box.
        args: Passed to ``fn``.
        lower: Lower bounds: a PyTree like ``y0`` or a number for all unknowns; None, also as a leaf, is no bound.
        upper: Upper bounds, likewise.
        scale: The natural step of each unknown, likewise; None takes it from the columns of the Jacobian.
        normal: A global function of (y, args) that supplies cost, gradient and Gram matrix of ``fn`` where they can be
            had more cheaply than from its Jacobian.
        solver: Tolerances and initial damping.
        max_steps: The largest number of evaluations.
        throw: Whether a failure is an exception; otherwise it is only data (``result``), as a batch needs it.

    Returns:
        An `optimistix.Solution`; its ``stats`` hold the `Reason` why the solve ended (``reason``), ``num_steps``,
        ``num_accepted_steps``, ``cost``, ``gradient`` and ``optimality``.

    Raises:
        InputError: Where a lower bound is above its upper one, or bounds do not fit the start; with ``throw``, where
            the solve fails. Under jit that is a failure of JAX's, of several lines.

    Example:
        >>> import jax.numpy as jnp
        >>> solution = aj.least_squares(lambda y, target: y - target, jnp.zeros(2), jnp.array([1.0, 3.0]), upper=2.0)
        >>> print(solution.value)
        [1. 2.]
    """
    check_x64()
    y0 = jax.tree.map(lambda leaf: jnp.asarray(as_array(leaf, "the start")), y0)
    if not sum(leaf.size for leaf in jax.tree.leaves(y0)):
        raise InputError("the start contains no number, so there are no unknowns; give at least one number.")
    checked(max_steps, Count, "max_steps")
    steps = None if scale is None else _flat(y0, scale, 1.0, "scale")
    box = Box(_flat(y0, lower, -jnp.inf, "lower"), _flat(y0, upper, jnp.inf, "upper"), steps)
    if is_concrete(box.lower, box.upper):
        low, high = np.asarray(box.lower), np.asarray(box.upper)
        for i in np.flatnonzero(~(low <= high))[:1]:
            raise InputError(
                f"lower bound {low[i]:g} of unknown {i + 1} is above its upper bound {high[i]:g}; exchange or widen "
                "the bounds."
            )
    value, last = _minimum(fn, y0, args, box, normal, Rules(*solver), max_steps)
    failures = {STALLED: "nonlinear_divergence", NONFINITE: "nonfinite", MAX_STEPS: "nonlinear_max_steps_reached"}
    result = optx.RESULTS.successful
    for number, name in failures.items():
        result = optx.RESULTS.where(last.reason == number, getattr(optx.RESULTS, name), result)
    stats = {
        "reason": reasons(last.reason),
        "num_steps": last.steps,
        "num_accepted_steps": last.accepted,
        "cost": last.model.cost,
        "gradient": last.model.gradient,
        "optimality": last.optimality,
    }
    solution = optx.Solution(value=value, result=result, aux=None, stats=stats, state=None)
    if not throw:
        return solution
    failed = result != optx.RESULTS.successful
    if not is_concrete(failed):
        return result.error_if(solution, failed)
    if bool(failed):
        raise InputError(Reason[stats["reason"]])
    return solution


def _flat(y: PyTree[Array], given: PyTree, absent: float, what: str) -> Flat:
    """A bound or a scale as a vector: of a tree like ``y`` whose leaves broadcast, or of a number for all; None stands
    for ``absent``."""
    if given is None or (jax.tree_util.all_leaves([given]) and jnp.ndim(given) == 0):
        given = jax.tree.map(lambda _: given, y)

    def leaf_of(leaf: Array, value: Any) -> Array:
        return jnp.broadcast_to(jnp.asarray(absent if value is None else value, dtype=jnp.float64), leaf.shape)

    try:
        return ravel_pytree(jax.tree.map(leaf_of, y, given))[0]
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{what} does not match the start; give a number, or a PyTree like the start ({error})."
        ) from error


@eqx.filter_jit
def _minimum(
    fn: Callable, y0: PyTree[Array], args: PyTree, box: Box, normal: Callable | None, rules: Rules, max_steps: int
) -> tuple[PyTree[Array], Progress]:
    """The minimum with its derivatives, and the last state of the solve."""
    start, unravel = ravel_pytree(y0)

    def residual(point: Array, args: PyTree) -> Float[Array, " r"]:
        value = ravel_pytree(fn(unravel(point), args))[0]
        if not value.size or jnp.iscomplexobj(value):
            raise InputError(
                "the residual must consist of real numbers and contain at least one; check what the function returns."
            )
        return value

    # What the function closes over becomes an argument, so that derivatives by it pass too.
    inputs = (eqx.filter_closure_convert(residual, start, args), args, box)
    constant_residual, constant_args, still_box = stop_gradient(inputs)

    def model(point: Array, _: None) -> QuadraticModel:
        if normal is not None:
            return normal(unravel(point), constant_args)
        value = constant_residual(point, constant_args)
        jacobian = jax.jacfwd(constant_residual)(point, constant_args)
        return QuadraticModel(0.5 * jnp.dot(value, value), jacobian.T @ value, jacobian.T @ jacobian)

    last = minimise(model, stop_gradient(start), None, still_box, rules, max_steps)
    return unravel(_with_derivatives(last.y, inputs)), last


@eqx.filter_custom_jvp
def _with_derivatives(y: Array, inputs: PyTree) -> Array:
    """The minimum, whose derivatives by its inputs are those that keep it stationary."""
    del inputs
    return y


@_with_derivatives.def_jvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    (y, inputs), (_, change) = primals, tangents
    y = _with_derivatives(y, inputs)  # so that derivatives of any order pass
    _, slope = eqx.filter_jvp(lambda inputs: _stationarity(y, inputs), (inputs,), (change,))
    return y, -_solved(jax.jacfwd(lambda y: _stationarity(y, inputs))(y), slope)


def _stationarity(y: Array, inputs: PyTree) -> Array:
    """Zero at a bounded minimum: the gradient where an unknown is free, its distance from the bound where pinned."""
    residual, args, box = inputs

    def cost(point: Array) -> Array:
        value = residual(point, args)
        return 0.5 * jnp.dot(value, value)

    gradient = jax.grad(cost)(y)
    point, slope = jax.lax.stop_gradient((y, gradient))
    nearer_lower = point - box.lower <= box.upper - point
    # An absent bound is infinite; it is never the nearer one of a pinned unknown, but must not make NaN in the other
    # branch.
    lower, upper = (jnp.where(jnp.isfinite(bound), bound, 0.0) for bound in (box.lower, box.upper))
    return jnp.where(box.pinned(point, slope), y - jnp.where(nearer_lower, lower, upper), gradient)


@jax.custom_jvp
def _solved(matrix: Float[Array, "p p"], right: Float[Array, " p"]) -> Float[Array, " p"]:
    """The least solution by the pseudo-inverse of the matrix with its rows and columns first scaled to size 1, so that
    no choice of units makes a direction look undetermined."""

    def inverse(size: Array) -> Array:
        return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 1.0)

    row = inverse(jnp.max(jnp.abs(matrix), axis=1))
    column = inverse(jnp.max(jnp.abs(row[:, None] * matrix), axis=0))
    row = row * inverse(jnp.max(jnp.abs(row[:, None] * matrix * column[None, :]), axis=1))
    u, s, v = singular_values(row[:, None] * matrix * column[None, :])
    determined = s > _UNDETERMINED * s[0]
    return column * (v @ (jnp.where(determined, 1 / jnp.where(determined, s, 1.0), 0.0) * (u.T @ (row * right))))


@_solved.defjvp
def _(primals: Any, tangents: Any) -> tuple[Array, Array]:
    solution = _solved(*primals)
    return solution, _solved(primals[0], tangents[1] - tangents[0] @ solution)
