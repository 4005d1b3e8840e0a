"""Box-bounded nonlinear least squares on Optimistix's extension points.

Minimises 1/2 |f(y)|^2 subject to lower <= y <= upper, for any residual function f and PyTree y.

Method: Levenberg-Marquardt with an active set. A parameter that sits on a bound while the gradient pushes it outwards is
left out of the damped step; the step is clipped to the box and judged by what the linear model predicts for the *clipped*
step (a clipped step can point uphill, and is then refused). f is never evaluated outside the box.
Sources: Marquardt 1963; More 1978 (scaling, tests); Nielsen 1999 (damping); Bertsekas 1982 (active set of a projection).
"""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree
from optimistix.internal import implicit_jvp

Flat = Float[Array, "*lanes p"]
Number = Float[Array, "*lanes"]
_EPSILON = float(jnp.finfo(jnp.float64).eps)


class Reason(eqx.Enumeration):
    """Why a solve ended."""

    running = "It has not ended."
    gradient = "Converged: the projected gradient is zero to the tolerance."
    step = "Converged: the last step is below the tolerance."
    rounding = "Converged: no step can lower the cost by more than rounding error."
    max_steps = "Not converged: the step limit was reached; allow more steps or start closer."
    stalled = "Not converged: no step lowers the cost although the gradient is not zero; is the residual smooth?"
    nonfinite = "Not converged: the residual or its derivative is not finite at the start; check the data and the start."


class Model(eqx.Module):
    """The quadratic model of the cost at one point: what one evaluation leaves for the step."""

    cost: Float[Array, "*lanes"]  # |f|^2 / 2
    gradient: Float[Array, "*lanes p"]  # J^T f
    gram: Float[Array, "*lanes p p"]  # J^T J

    def finite(self) -> Bool[Array, "*lanes"]:
        """Whether every number of it is finite."""
        sums = jnp.sum(self.gradient, axis=-1) + jnp.sum(self.gram, axis=(-2, -1))
        return jnp.isfinite(self.cost) & jnp.isfinite(sums)


class Box(eqx.Module):
    """The bounds as flat vectors, and the natural step of each unknown (None: the columns of J decide, as in MINPACK)."""

    lower: Flat
    upper: Flat
    scale: Flat | None

    def clip(self, y: Flat) -> Flat:
        """The nearest point of the box."""
        return jnp.clip(y, self.lower, self.upper)

    def pinned(self, y: Flat, gradient: Flat) -> Bool[Array, "*lanes p"]:
        """Unknowns on a bound with the gradient pushing outwards."""
        return ((y <= self.lower) & (gradient >= 0)) | ((y >= self.upper) & (gradient <= 0))


class Progress(eqx.Module):
    """State of one solve, or of many side by side in lanes, between two evaluations."""

    y: Flat  # accepted
    model: Model  # at y
    trial: Flat  # where the next evaluation happens
    predicted: Number  # decrease of the cost that the model promises for the trial
    reach: Number  # scaled length of the damped step before it was clipped to the box
    damping: Number
    growth: Number  # what the next refusal multiplies the damping by
    curvature: Flat  # running maximum of diag(J^T J)
    steps: Int[Array, "*lanes"]  # evaluations
    accepted: Int[Array, "*lanes"]
    reason: Reason


def begin(y: Flat, box: Box) -> Progress:
    """State before the first evaluation, which happens at the start clipped to the box."""
    y = box.clip(y)
    zero, none = jnp.zeros(y.shape[:-1]), jnp.zeros(y.shape[:-1], dtype=jnp.int64)
    return Progress(
        y=y,
        model=Model(zero + jnp.inf, jnp.zeros_like(y), jnp.zeros((*y.shape, y.shape[-1]))),
        trial=y,
        predicted=zero,
        reach=zero + jnp.inf,
        damping=zero,
        growth=zero + 2.0,
        curvature=jnp.zeros_like(y),
        steps=none,
        accepted=none,
        reason=Reason.where(zero == 0, Reason.running, Reason.running),
    )


def choose(pred: Bool[Array, "*lanes"], new: PyTree, old: PyTree) -> PyTree:
    """Lane by lane, the new tree or the old one."""

    def pick(one: Array, other: Array) -> Array:
        return jnp.where(pred.reshape(pred.shape + (1,) * (one.ndim - pred.ndim)), one, other)

    return jax.tree.map(pick, new, old)


def advance(progress: Progress, evaluated: Model, box: Box, solver: "BoundedLevenbergMarquardt") -> Progress:
    """Judge the trial from its evaluated model, test for convergence, and propose the next trial."""
    first = progress.steps == 0
    finite = evaluated.finite()
    accept = finite & (first | _improves(progress, evaluated, box))
    y, model = choose(accept, (progress.trial, evaluated), (progress.y, progress.model))
    curvature = jnp.maximum(progress.curvature, jnp.diagonal(model.gram, axis1=-2, axis2=-1))
    scale = _scale(box, curvature)

    damping, growth = _next_damping(progress, evaluated, accept)
    largest = jnp.max(scale**2 * curvature, axis=-1)
    damping = jnp.where(first, solver.initial_damping * largest, damping)
    # Below this floor rounding in the Gram matrix can make it indefinite.
    damping = jnp.maximum(damping, 1e3 * _EPSILON * largest)

    # Judged before clipping: a step that the box cuts to nothing says only that the damping is still too small.
    small_step = progress.reach <= solver.rtol * _norm(y / scale) + solver.atol
    hopeless = jnp.abs(progress.predicted) <= 4 * _EPSILON * progress.model.cost
    unclipped = _norm((progress.trial - progress.y) / scale) >= 0.5 * progress.reach
    reason = Reason.where(damping > 1e20 * jnp.maximum(largest, 1.0), Reason.stalled, Reason.running)
    reason = Reason.where(~first & ~accept & finite & hopeless & unclipped, Reason.rounding, reason)
    reason = Reason.where(~first & small_step, Reason.step, reason)
    reason = Reason.where(_optimality(y, model, box) <= solver.gtol, Reason.gradient, reason)
    reason = Reason.where(first & ~finite, Reason.nonfinite, reason)

    trial, predicted, reach = propose(y, model, box, scale, damping)
    return Progress(
        y=y,
        model=model,
        trial=trial,
        predicted=predicted,
        reach=reach,
        damping=damping,
        growth=growth,
        curvature=curvature,
        steps=progress.steps + 1,
        accepted=progress.accepted + jnp.where(accept, 1, 0),
        reason=reason,
    )


def propose(y: Flat, model: Model, box: Box, scale: Flat, damping: Number) -> tuple[Flat, Number, Number]:
    """The damped step on the unpinned unknowns, clipped to the box: next trial, predicted decrease of the cost, and the
    scaled length of the step before clipping.

    Solves (S J^T J S + damping I) z = -S J^T f with S = diag(scale) and y + S z as the unclipped trial. Unknowns that the
    step would carry through a bound are put on it and the rest solved again, once: without that, strongly coupled
    unknowns zigzag along a bound.
    """
    pinned = box.pinned(y, model.gradient)
    gram = scale[..., :, None] * model.gram * scale[..., None, :]
    identity = jnp.eye(y.shape[-1], dtype=bool).reshape((1,) * (y.ndim - 1) + (y.shape[-1],) * 2)

    def solve(fixed: Bool[Array, "*lanes p"], shift: Flat) -> Flat:
        rest = -scale * model.gradient - _times(gram, shift / scale)
        inside = ~fixed
        matrix = jnp.where(inside[..., :, None] & inside[..., None, :], gram, 0.0)
        matrix = matrix + jnp.where(identity, jnp.where(fixed, 1.0, damping[..., None])[..., None, :], 0.0)
        factor = jnp.linalg.cholesky(matrix, symmetrize_input=False)
        z = jsl.cho_solve((factor, True), jnp.where(fixed, 0.0, rest)[..., None])[..., 0]
        return jnp.where(fixed, shift, scale * z)

    def again(step: Flat) -> Flat:
        landed = box.clip(y + step)
        through = landed != y + step
        return solve(pinned | through, jnp.where(through, landed - y, 0.0))

    step = solve(pinned, jnp.zeros_like(y))
    reach = _norm(step / scale)
    # One test for all lanes: solving again changes nothing in a lane whose step stays inside.
    step = jax.lax.cond(jnp.any(box.clip(y + step) != y + step), again, lambda s: s, step)
    trial = box.clip(y + step)
    step = trial - y
    predicted = -jnp.sum(step * (model.gradient + 0.5 * _times(model.gram, step)), axis=-1)
    # A failed factorisation shows as NaN: stay, promise nothing, and let the damping grow.
    usable = jnp.isfinite(predicted)
    return choose(usable, (trial, predicted, reach), (y, jnp.zeros_like(predicted), jnp.full_like(reach, jnp.inf)))


def _improves(progress: Progress, evaluated: Model, box: Box) -> Bool[Array, "*lanes"]:
    actual = progress.model.cost - evaluated.cost
    decreases = actual > 1e-4 * progress.predicted
    # Close to the solution the decrease drowns in the rounding of the cost; the gradient still tells up from down.
    blurred = (progress.predicted < 1e4 * _EPSILON * progress.model.cost) & (
        jnp.abs(actual) < 1e4 * _EPSILON * progress.model.cost
    )
    nearer = _optimality(progress.trial, evaluated, box) < _optimality(progress.y, progress.model, box)
    return (progress.predicted > 0) & jnp.where(blurred, nearer, decreases)


def _next_damping(progress: Progress, evaluated: Model, accept: Bool[Array, "*lanes"]) -> tuple[Number, Number]:
    # Nielsen's rule: shrink smoothly with the gain ratio, grow ever faster while steps are refused.
    promised = jnp.where(progress.predicted > 0, progress.predicted, 1.0)
    gain = jnp.where(accept, (progress.model.cost - evaluated.cost) / promised, 0.0)
    gain = jnp.where(jnp.isfinite(gain), gain, 0.0)
    shrink = jnp.clip(1.0 - (2.0 * gain - 1.0) ** 3, 0.1, 2.0)
    damping = progress.damping * jnp.where(accept, shrink, progress.growth)
    return damping, jnp.where(accept, 2.0, 2.0 * progress.growth)


def _optimality(y: Flat, model: Model, box: Box) -> Number:
    """Largest projected coordinate step as a cosine: sqrt(h) |y - clip(y - g / h)| / |f|, with h = diag(J^T J).

    Away from bounds it is MINPACK's cosine between the residual and a column of J; it does not depend on units.
    """
    h = jnp.diagonal(model.gram, axis1=-2, axis2=-1)
    safe = jnp.where(h > 0, h, 1.0)
    moved = jnp.where(h > 0, jnp.sqrt(safe) * jnp.abs(y - box.clip(y - model.gradient / safe)), 0.0)
    return jnp.max(moved, axis=-1) / jnp.sqrt(2 * jnp.maximum(model.cost, jnp.finfo(jnp.float64).tiny))


def _times(matrix: Float[Array, "*lanes p p"], vector: Flat) -> Flat:
    return (matrix @ vector[..., None])[..., 0]


def _scale(box: Box, curvature: Flat) -> Flat:
    if box.scale is not None:
        return box.scale
    return jnp.where(curvature > 0, 1.0 / jnp.sqrt(jnp.where(curvature > 0, curvature, 1.0)), 1.0)


def _norm(vector: Flat) -> Number:
    return jnp.sqrt(jnp.sum(vector**2, axis=-1))


def flat_box(y: PyTree[Array], lower: PyTree, upper: PyTree, scale: PyTree) -> Box:
    """Bounds and scale as flat vectors; None, scalars and leaves that broadcast against y's are spread over it."""

    def flat(tree: PyTree, fill: float) -> Flat:
        if tree is None or isinstance(tree, (int, float)):
            filled = fill if tree is None else float(tree)
            tree = jax.tree.map(lambda leaf: jnp.full(leaf.shape, filled), y)
        else:
            tree = jax.tree.map(lambda leaf, b: jnp.broadcast_to(jnp.asarray(b, dtype=jnp.float64), leaf.shape), y, tree)
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

    rtol: float = 1e-12  # on the step, relative to |y| (both scaled)
    atol: float = 1e-15  # on the step, scaled
    gtol: float = 1e-10  # on the projected gradient: cosine between the residual and a column of J
    initial_damping: float = 1e-3  # relative to the largest curvature
    # Optimistix asks for a norm; every test here is written out, since it scales by unknowns.
    norm: Callable[[PyTree], Array] = optx.max_norm

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
        state = advance(state, evaluated, _box(y, options), self)
        return unravel(state.y), state, aux

    def terminate(self, fn, y, args, options, state, tags):
        failed = optx.RESULTS.where(state.reason == Reason.stalled, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)
        failed = optx.RESULTS.where(state.reason == Reason.nonfinite, optx.RESULTS.nonfinite, failed)
        return state.reason != Reason.running, failed

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        box = _box(y, options)
        stats = {
            "reason": Reason.where(state.reason == Reason.running, Reason.max_steps, state.reason),
            "num_accepted_steps": state.accepted,
            "cost": state.model.cost,
            "gradient": state.model.gradient,
            "optimality": _optimality(state.y, state.model, box),
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


class BoundedAdjoint(optx.AbstractAdjoint):
    """Implicit differentiation of the stationarity of a box-bounded minimum: y = clip(y - gradient).

    Optimistix's own implicit adjoint takes the gradient to vanish, which is false on an active bound: there the solution
    follows the bound. Exact (full Hessian, not Gauss-Newton's), forward and reverse.
    """

    linear_solver: lx.AbstractLinearSolver = lx.SVD(rcond=1e-14)

    def apply(self, primal_fn, rewrite_fn, inputs, tags):
        del rewrite_fn
        inputs = (*inputs, _while_loop)
        # Optimistix wants a plain global function, not one that a run-time type checker has wrapped.
        return implicit_jvp(primal_fn, inspect.unwrap(_stationarity), inputs, tags, self.linear_solver)


def _while_loop(cond_fun, body_fun, init_val, *, max_steps):
    return eqx.internal.while_loop(cond_fun, body_fun, init_val, max_steps=max_steps, kind="lax")


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
    # Scaled rows keep mm and rad comparable for the singular values below which a direction counts as undetermined.
    scale = jnp.ones_like(flat) if box.scale is None else jax.lax.stop_gradient(box.scale)
    pinned = box.pinned(fixed_point, fixed_gradient)
    nearer_lower = fixed_point - box.lower <= box.upper - fixed_point
    # An absent bound is infinite; it is never the nearer one of a pinned unknown, but must not make NaN in the other branch.
    bound = jnp.where(
        nearer_lower, jnp.where(jnp.isfinite(box.lower), box.lower, 0.0), jnp.where(jnp.isfinite(box.upper), box.upper, 0.0)
    )
    return jnp.where(pinned, (flat - bound) / scale, scale * gradient)


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
