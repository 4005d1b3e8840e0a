"""Box-bounded nonlinear least squares as an Optimistix solver, and `least_squares`, whose derivatives are exact.

The adjoint differentiates the stationarity of a box-bounded minimum, also where bounds are active.
"""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..core import _compat
from ..core.arguments import Count, checked
from ..core.arrays import as_array, is_concrete
from ..core.errors import InputError
from ..core.jax_setup import check_x64
from ..core.linear_algebra import singular_values
from .active_set import Box, Flat, QuadraticModel
from .levenberg_marquardt import Progress, Rules, advance, begin
from .reason import MAX_STEPS, NONFINITE, RUNNING, STALLED, Reason, reasons


def box_of(y: PyTree[Array], options: dict[str, Any]) -> Box:
    """The box that the options of a solve describe: trees like ``y`` whose leaves broadcast, numbers for all, or None.

    Raises `InputError` where one of them does not fit.
    """

    def flat(name: str, absent: float) -> Flat:
        given = options.get(name)
        if given is None or (jax.tree_util.all_leaves([given]) and jnp.ndim(given) == 0):
            given = jax.tree.map(lambda _: given, y)

        def leaf_of(leaf: Array, value: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(absent if value is None else value, dtype=jnp.float64), leaf.shape)

        try:
            return ravel_pytree(jax.tree.map(leaf_of, y, given))[0]
        except (TypeError, ValueError) as error:
            raise InputError(f"{name} does not fit the start; give a number, or a PyTree like it ({error}).") from error

    scale = None if options.get("scale") is None else flat("scale", 1.0)
    return Box(flat("lower", -jnp.inf), flat("upper", jnp.inf), scale)


class BoundedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within a box, as an Optimistix least-squares solver.

    The box is in ``options``: ``lower``, ``upper`` and ``scale`` as in `least_squares`, and ``normal``. ``stats`` of
    the solution holds ``reason``, ``num_accepted_steps``, ``cost``, ``gradient`` and ``optimality``.

    Use it through `least_squares`, which also brings the adjoint that takes the bounds into account.

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
    # Optimistix asks for a norm; every test here is written out, since it scales by unknowns.
    norm: Callable[[PyTree], Array] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        form = None
        if options.get("normal") is not None:
            form = jax.eval_shape(options["normal"], y, args).gram
            form = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        return begin(ravel_pytree(y)[0], box_of(y, options), form)

    def step(self, fn, y, args, options, state, tags):
        unravel: Callable = ravel_pytree(y)[1]

        def residual(point: Flat) -> tuple[Array, tuple[Array, PyTree]]:
            out, aux = fn(unravel(point), args)
            value = ravel_pytree(out)[0]
            if not value.size or jnp.iscomplexobj(value):
                raise InputError("the residual must be real numbers, at least one; look at what the function returns.")
            return value, (value, aux)

        trial, aux = state.step.trial, None
        if options.get("normal") is None:
            jacobian, (value, aux) = jax.jacfwd(residual, has_aux=True)(trial)
            evaluated = QuadraticModel(0.5 * jnp.dot(value, value), jacobian.T @ value, jacobian.T @ jacobian)
        else:
            evaluated = options["normal"](unravel(trial), args)
        rules = Rules(self.rtol, self.atol, self.gtol, self.initial_damping)
        state = advance(state, evaluated, box_of(y, options), rules)
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


class EquilibratedPseudoInverse(lx.AbstractLinearSolver):
    """Pseudo-inverse of a square operator whose rows and columns are first scaled to size 1.

    So no choice of units makes a direction look undetermined.
    """

    rcond: float = 1e-14

    def init(self, operator, options):
        def inverse(size: Array) -> Array:
            return jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 1.0)

        matrix = operator.as_matrix()
        row = inverse(jnp.max(jnp.abs(matrix), axis=1))
        column = inverse(jnp.max(jnp.abs(row[:, None] * matrix), axis=0))
        row = row * inverse(jnp.max(jnp.abs(row[:, None] * matrix * column[None, :]), axis=1))
        decomposed = singular_values(row[:, None] * matrix * column[None, :])
        return decomposed, row, column, _compat.Static((operator.in_structure(), operator.out_structure()))

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
        return _compat.implicit_jvp(primal_fn, inspect.unwrap(_stationarity), inputs, tags, self.linear_solver)


def _stationarity(y: PyTree[Array], solved: PyTree, inputs: PyTree) -> Flat:
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
        An `optimistix.Solution`; its ``stats["reason"]`` is the `Reason` why the solve ended.

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
        raise InputError("the start holds no number, so nothing is unknown; give at least one.")
    checked(max_steps, Count, "max_steps")
    given = {"lower": lower, "upper": upper, "scale": scale}
    box, unravel = box_of(y0, given), ravel_pytree(y0)[1]
    if is_concrete(box.lower, box.upper):
        low, high = np.asarray(box.lower), np.asarray(box.upper)
        for i in np.flatnonzero(~(low <= high))[:1]:
            raise InputError(
                f"lower bound {low[i]:g} of unknown {i + 1} is above its upper bound {high[i]:g}; exchange or widen "
                "them."
            )
    options = {name: None if tree is None else unravel(getattr(box, name)) for name, tree in given.items()}
    options["normal"] = normal
    steps = {"max_steps": max_steps, "adjoint": BoundedAdjoint(), "throw": False}
    solution = optx.least_squares(fn, solver, y0, args, options, **steps)
    if not throw:
        return solution
    failed = solution.result != optx.RESULTS.successful
    if not is_concrete(failed):
        return solution.result.error_if(solution, failed)
    if bool(failed):
        raise InputError(Reason[solution.stats["reason"]])
    return solution
