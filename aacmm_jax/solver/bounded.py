"""Box-bounded nonlinear least squares by Optimistix, with exact derivatives, also where bounds are active.

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
from .levenberg_marquardt import Progress, Rules, advance, begin
from .reason import MAX_STEPS, NONFINITE, RUNNING, STALLED, Reason, reasons

_UNDETERMINED = 1e-14  # of the largest singular value


class BoundedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within a box, as a least-squares solver of Optimistix.

    The box is in ``options``: ``lower``, ``upper`` and ``scale`` as in `least_squares`, and ``normal``. Use it through
    `least_squares`: `optimistix.least_squares` takes it too, but has no derivatives that hold on an active bound.

    Example:
        >>> import jax.numpy as jnp
        >>> loose = aj.solver.BoundedLevenbergMarquardt(rtol=1e-6, gtol=1e-6)
        >>> target = jnp.array([1.0, 3.0])
        >>> print(aj.least_squares(lambda y, target: y - target, jnp.zeros(2), target, upper=2.0, solver=loose).value)
        [1. 2.]
    """

    # As in `Rules`.
    rtol: float = Rules().rtol
    atol: float = Rules().atol
    gtol: float = Rules().gtol
    initial_damping: float | None = Rules().initial_damping
    # Optimistix asks for a norm; every test of the steps is written out, since it scales by unknowns.
    norm: Callable[[PyTree], Array] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        form = None
        if options.get("normal") is not None:
            form = jax.eval_shape(options["normal"], y, args).gram
            form = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        return begin(ravel_pytree(y)[0], _box(y, options), form)

    def step(self, fn, y, args, options, state, tags):
        unravel: Callable = ravel_pytree(y)[1]

        def residual(point: Array) -> tuple[Array, tuple[Array, PyTree]]:
            out, aux = fn(unravel(point), args)
            value = ravel_pytree(out)[0]
            return value, (value, aux)

        if options.get("normal") is None:
            jacobian, (value, aux) = jax.jacfwd(residual, has_aux=True)(state.step.trial)
            evaluated = QuadraticModel(0.5 * jnp.dot(value, value), jacobian.T @ value, jacobian.T @ jacobian)
        else:
            evaluated, aux = options["normal"](unravel(state.step.trial), args), None
        rules = Rules(self.rtol, self.atol, self.gtol, self.initial_damping)
        state = advance(state, evaluated, _box(y, options), rules)
        return unravel(state.y), state, aux

    def terminate(self, fn, y, args, options, state, tags):
        result = optx.RESULTS.where(state.reason == STALLED, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        result = optx.RESULTS.where(state.reason == NONFINITE, optx.RESULTS.nonfinite, result)
        return state.reason != RUNNING, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        # Optimistix itself stops, before any step, where y is not finite.
        unfinished = jnp.where(result == optx.RESULTS.nonfinite, NONFINITE, MAX_STEPS)
        stats = {
            "reason": reasons(jnp.where(state.reason == RUNNING, unfinished, state.reason)),
            "num_accepted_steps": state.accepted,
            "cost": state.model.cost,
            "gradient": state.model.gradient,
            "optimality": state.optimality,
        }
        return y, aux, stats


def least_squares(
    fn: Callable[[PyTree, PyTree], PyTree],
    y0: PyTree[Array],
    args: PyTree = None,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    scale: PyTree = None,
    normal: Callable[[PyTree, PyTree], QuadraticModel] | None = None,
    solver: BoundedLevenbergMarquardt = BoundedLevenbergMarquardt(),
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
    options = {"lower": lower, "upper": upper, "scale": scale}
    box = _box(y0, options)
    if is_concrete(box.lower, box.upper):
        low, high = np.asarray(box.lower), np.asarray(box.upper)
        for i in np.flatnonzero(~(low <= high))[:1]:
            raise InputError(
                f"lower bound {low[i]:g} of unknown {i + 1} is above its upper bound {high[i]:g}; exchange or widen "
                "the bounds."
            )
    solution = _minimum(fn, y0, args, box, normal, solver, max_steps)
    if not throw:
        return solution
    failed = solution.result != optx.RESULTS.successful
    if not is_concrete(failed):
        return solution.result.error_if(solution, failed)
    if bool(failed):
        raise InputError(Reason[solution.stats["reason"]])
    return solution


def _box(y: PyTree[Array], options: dict[str, Any]) -> Box:
    """The box that options state, with the unknowns as a vector."""
    scale = options.get("scale")
    return Box(
        _flat(y, options.get("lower"), -jnp.inf, "lower"),
        _flat(y, options.get("upper"), jnp.inf, "upper"),
        None if scale is None else _flat(y, scale, 1.0, "scale"),
    )


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
            f"{what} does not match the start; give a number, or a PyTree with the structure of the start ({error})."
        ) from error


@eqx.filter_jit
def _minimum(
    fn: Callable,
    y0: PyTree[Array],
    args: PyTree,
    box: Box,
    normal: Callable | None,
    solver: BoundedLevenbergMarquardt,
    max_steps: int,
) -> optx.Solution:
    """The minimum with its derivatives."""
    start, unravel = ravel_pytree(y0)

    def residual(point: Array, args: PyTree) -> Float[Array, " r"]:
        value = ravel_pytree(fn(unravel(point), args))[0]
        if not value.size or jnp.iscomplexobj(value):
            raise InputError(
                "the residual must contain only real numbers, and at least one number; check what the function returns."
            )
        return value

    # What the function closes over becomes an argument, so that derivatives by it pass too.
    inputs = (eqx.filter_closure_convert(residual, start, args), args, box)
    constant_residual, constant_args, still_box = stop_gradient(inputs)
    options = {"lower": still_box.lower, "upper": still_box.upper, "scale": still_box.scale}
    if normal is not None:
        options["normal"] = lambda point, args: normal(unravel(point), args)
    solution = optx.least_squares(
        constant_residual, solver, stop_gradient(start), constant_args, options, max_steps=max_steps, throw=False
    )
    return eqx.tree_at(lambda s: s.value, solution, unravel(_with_derivatives(solution.value, inputs)))


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
