"""Box-bounded nonlinear least squares: the Optimistix solver, and `least_squares`, which adds the adjoint."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..core.arguments import Count, checked
from ..core.arrays import as_array, is_concrete
from ..core.errors import InputError
from ..core.jax_setup import check_x64
from .active_set import Box, Flat, QuadraticModel, expand
from .adjoint import BoundedAdjoint, box_of
from .levenberg_marquardt import Progress, Rules, advance, begin
from .reason import MAX_STEPS, NONFINITE, RUNNING, STALLED, Reason, reasons


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

    @property
    def rules(self) -> Rules:
        """Tolerances and damping, as the steps take them."""
        return Rules(self.rtol, self.atol, self.gtol, self.initial_damping)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Progress:
        form = None
        if options.get("normal") is not None:
            form = jax.eval_shape(options["normal"], y, args).gram
            form = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), form)
        return begin(ravel_pytree(y)[0], box_of(y, options), form)

    def step(self, fn, y, args, options, state, tags):
        unravel: Callable = ravel_pytree(y)[1]
        trial = state.step.trial
        if options.get("normal") is None:
            evaluated, aux = _evaluate(fn, unravel, trial, args)
        else:
            evaluated, aux = options["normal"](unravel(trial), args), None
        state = advance(state, evaluated, box_of(y, options), self.rules)
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


def _evaluate(fn: Callable, unravel: Callable, flat: Flat, args: PyTree) -> tuple[QuadraticModel, PyTree]:
    def residual(point: Flat) -> tuple[Array, tuple[Array, PyTree]]:
        out, aux = fn(unravel(point), args)
        value = ravel_pytree(out)[0]
        if not value.size or jnp.iscomplexobj(value):
            raise InputError("the residual must be real numbers, at least one; look at what the function returns.")
        return value, (value, aux)

    jacobian, (value, aux) = jax.jacfwd(residual, has_aux=True)(flat)
    return QuadraticModel(0.5 * jnp.dot(value, value), jacobian.T @ value, jacobian.T @ jacobian), aux


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
    options = {
        "lower": _expanded(y0, lower, -jnp.inf, "lower"),
        "upper": _expanded(y0, upper, jnp.inf, "upper"),
        "scale": _expanded(y0, scale, 1.0, "scale"),
    }
    _check_box(y0, options["lower"], options["upper"])
    options |= {"normal": normal}
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


def _expanded(y0: PyTree[Array], tree: PyTree, absent: float, what: str) -> PyTree[Array]:
    if tree is None:
        return None
    try:
        return expand(y0, tree, absent)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} does not fit the start; give a number, or a PyTree like it ({error}).") from error


def _check_box(y0: PyTree, lower: PyTree, upper: PyTree) -> None:
    """Refuse a lower bound above its upper one, where both can be looked at now."""
    if not is_concrete(*jax.tree.leaves((y0, lower, upper))):
        return
    with jax.ensure_compile_time_eval():
        box = Box.of(y0, lower, upper, None)
        wrong = np.flatnonzero(~(np.asarray(box.lower) <= np.asarray(box.upper)))
    if len(wrong):
        i = wrong[0]
        raise InputError(
            f"lower bound {float(box.lower[i]):g} of unknown {i + 1} is above its upper bound {float(box.upper[i]):g}; "
            "exchange or widen them."
        )
