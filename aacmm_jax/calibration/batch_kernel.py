"""The compiled part of a batch: a fixed number of batch slots solves a chunk of problems.

The steps are those of `solve`, one after the other for the whole chunk. In a least squares every pass of the loop
evaluates and advances all slots; a slot whose problem has ended writes its result and takes the next problem of the
chunk, so no problem waits for another. The number of slots, not the chunk, fixes the arithmetic: results are the same
to the bit whatever the chunk.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..core.numpy_or_jax import AnyArray, set_at
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..kinematics.priors import Prior
from ..model.elimination import observed_model, own_covariances, with_linear_geometry
from ..model.observed import Observed
from ..model.robust import Loss
from ..model.rows import PointRows, Whitening
from ..model.scale import scale_and_weights
from ..solver.active_set import Box, choose
from ..solver.levenberg_marquardt import Rules, advance
from ..solver.levenberg_marquardt import begin as begin_steps
from ..solver.reason import MAX_STEPS, RUNNING, numbers_of, reasons
from ..uncertainty.covariance import NoiseModel
from .bounded_fit import Fit
from .conclusion import concluded, repeatability_of
from .scale_anchor import ScaleAnchor
from .scale_fix import ends_between
from .solve import args_of, begin, box_of, fitted_with_prior, losses_of, prior_of, rules_of, state_after, weights
from .solve_state import whitening_at
from .task import Task


class Problems(NamedTuple):
    """What may differ from problem to problem; a leaf either has the batch axis first, or is shared by all."""

    arm: Arm  # with the fixed parameters
    capture: Capture
    start: Float[AnyArray, "*batch p"]
    lower: Float[AnyArray, "*batch p"]
    upper: Float[AnyArray, "*batch p"]
    near: Float[AnyArray, "*batch p"] | None  # parameters close to the solution


class Form(NamedTuple):
    """What is the same for all problems and fixes the compiled program."""

    names: tuple[str, ...]
    anchor: ScaleAnchor
    with_lengths: bool  # whether reference lengths take part in the least squares
    noise_model: NoiseModel
    loss: Loss | None
    pose: tuple[int, ...]
    max_steps: int
    covariance: bool
    slots: int
    capacity: int
    axes: Problems  # trees of the axes, 0 or None


class _Chunk(NamedTuple):
    """The problems of a chunk, prepared."""

    problems: Problems
    observed: Observed
    axes: "_Chunk"  # of both


@eqx.filter_jit
def solve_chunk(
    form: Form, problems: Problems, count: Int[Array, ""], noise: Noise | None, prior: Prior | None
) -> dict[str, Any]:
    """Solve the first ``count`` of the problems of a chunk: the fields of `ManyIdentifications`."""
    chunk = _prepared(form, problems)
    one = partial(_task, form, noise, prior)
    z, whitening = _in_groups(form, chunk, lambda *of: _first(one(*of), of[0].near))
    first = _of_first(form, chunk, one)
    steps, reason, losses = jnp.zeros(form.capacity, dtype=jnp.int64), None, losses_of(first)
    solved = (z, whitening, z)
    for number, loss in enumerate(losses, 1):
        last, rules = number == len(losses), rules_of(number, len(losses))
        if last and prior_of(first) is not None:
            break
        y, more, reason = _solve_all(form, chunk, one, loss, rules, z, whitening, count)
        steps, solved = steps + more, (z, whitening, y)
        if not last:
            z, whitening = _in_groups(form, chunk, partial(_again, one, losses[number - 1 :]), *solved)
    return _in_groups(form, chunk, partial(_concluded, form, one, losses[-1]), steps, reason, *solved)


def _prepared(form: Form, problems: Problems) -> _Chunk:
    """With what the poses do to the joints, which every evaluation needs and none changes."""
    axes = form.axes
    batched = axes.capture is not None

    def observed_of(arm: Arm, capture: Capture) -> Observed:
        return Observed.of(capture if form.with_lengths else without_lengths(capture), arm)

    arm = problems.arm
    if not batched and arm.corrections is None:
        # The arm's values do not matter.
        arm = jax.tree.map(lambda leaf, axis: leaf if axis is None else leaf[0], arm, axes.arm, is_leaf=_is_none)
        observed, of_observed = observed_of(arm, problems.capture), None
    else:
        observed = jax.vmap(observed_of, in_axes=(axes.arm, axes.capture), axis_size=form.capacity)(
            arm, problems.capture
        )
        # The joints before the problems, as the chain takes them.
        turned = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), observed.motion)
        of_observed: Any = eqx.tree_at(
            lambda one: one.motion, jax.tree.map(lambda _: 0, observed), jax.tree.map(lambda _: 1, turned)
        )
        observed = eqx.tree_at(lambda one: one.motion, observed, turned)
    return _Chunk(problems, observed, _Chunk(axes, of_observed, None))  # pyright: ignore[reportArgumentType]


def _is_none(leaf: object) -> bool:
    return leaf is None


def without_lengths(capture: Capture) -> Capture:
    """The capture without its reference lengths."""
    return eqx.tree_at(lambda c: c.lengths, capture, (), is_leaf=lambda leaf: isinstance(leaf, tuple))


def _task(form: Form, noise: Noise | None, prior: Prior | None, problem: Problems, observed: Observed) -> Task:
    """One problem, traced."""
    bounds = Bounds(Parameters(problem.arm, form.names), problem.lower, problem.upper)
    return Task(
        observed=observed,
        bounds=bounds,
        start=jnp.clip(problem.start, problem.lower, problem.upper),
        noise=noise,
        anchor=form.anchor,
        noise_model=form.noise_model,
        max_steps=form.max_steps,
        loss=form.loss,
        pose=form.pose,
        differentiable=False,
        prior=prior,
    )


def _of_first(form: Form, chunk: _Chunk, one: Callable) -> Task:
    """The task of the first problem, for what is the same for all."""
    return one(*_selected(form, chunk, jnp.asarray(0)))


def pick(tree: Any, axis: Any, index: Any) -> Any:
    """The problems of an index of a tree with such axes; what is shared stays as it is."""
    if axis is None:
        return tree

    def of(axis: int | None, leaf: Any) -> Any:
        return leaf if axis is None else leaf[index] if not axis else leaf[:, index]

    return jax.tree.map(of, axis, tree, is_leaf=_is_none)


def _selected(form: Form, chunk: _Chunk, index: Any) -> tuple[Problems, Observed]:
    parts = (pick(tree, axis, index) for tree, axis in zip(chunk.problems, form.axes, strict=True))
    return Problems(*parts), pick(chunk.observed, chunk.axes.observed, index)


def _vmapped(form: Form, chunk: _Chunk, work: Callable, extra: int) -> Callable:
    axes: Any = chunk.axes.observed
    return jax.vmap(work, in_axes=(form.axes, axes, *(0,) * extra), axis_size=form.slots)


def _in_groups(form: Form, chunk: _Chunk, work: Callable, *extra: Any) -> Any:
    """``work(problem, observed, *extra)`` for all problems, as many at a time as there are slots."""
    function = _vmapped(form, chunk, work, len(extra))

    def group(row: Int[Array, ""]) -> Any:
        index = row * form.slots + jnp.arange(form.slots)
        own = jax.tree.map(lambda leaf: leaf[index], extra)
        return function(*_selected(form, chunk, index), *own)

    found = jax.lax.map(group, jnp.arange(form.capacity // form.slots))
    return jax.tree.map(lambda leaf: leaf.reshape(form.capacity, *leaf.shape[2:]), found)


def _first(task: Task, near: Float[AnyArray, " p"] | None) -> tuple[Float[AnyArray, " z"], Whitening]:
    """Where a solve begins, and its first weights."""
    if task.needs_no_weights:
        # Positions of sockets are no unknowns of the solve, so any will do.
        start = task.start if near is None else jnp.clip(near, task.bounds.lower, task.bounds.upper)
        whitening = Whitening((None,) * len(task.observed.layout.groups), jnp.zeros(0), {})
        return jnp.concatenate([start[task.free], jnp.zeros(len(task.observed.steps))]), whitening
    begun = begin(task, near)
    return begun.z, weights(task, begun, begun.state, losses_of(task)[0])


def _whole(
    task: Task,
    loss: Loss | None,
    z: Float[AnyArray, " z"],
    whitening: Whitening,
    y: Float[AnyArray, " n"],
    batch: bool | None = None,
) -> tuple[Float[AnyArray, " z"], PointRows]:
    """All unknowns after a least squares that began at z and ended at y, and the rows there."""
    return with_linear_geometry(y, args_of(task, whitening, loss, z)[0]._replace(batch=batch))


def _again(
    one: Callable,
    losses: list[Loss | None],
    problem: Problems,
    observed: Observed,
    z: Float[AnyArray, " z"],
    whitening: Whitening,
    y: Float[AnyArray, " n"],
) -> tuple[Float[AnyArray, " z"], Whitening]:
    """Where the next least squares begins, and its weights; ``losses`` are that of the last, and those to come."""
    task = one(problem, observed)
    z, point = _whole(task, losses[0], z, whitening, y)
    begun = begin(task)
    return z, weights(task, begun, state_after(task, begun, z, point, False), losses[1])


def _concluded(
    form: Form,
    one: Callable,
    loss: Loss | None,
    problem: Problems,
    observed: Observed,
    steps: Int[AnyArray, ""],
    reason: Int[AnyArray, ""] | None,
    z: Float[AnyArray, " z"],
    whitening: Whitening,
    y: Float[AnyArray, " n"],
) -> dict[str, Any]:
    """The fields of one problem after its last least squares; that with a prior is still to come."""
    task = one(problem, observed)
    begun, prior, of_prior = begin(task), prior_of(task), None
    if prior is not None:
        state = begun.state
        if len(losses_of(task)) > 1:
            z, point = _whole(task, losses_of(task)[-2], z, whitening, y)
            state = state_after(task, begun, z, point, False)
        z, state, found, of_prior = fitted_with_prior(task, prior, begun, state, z)
        found = found._replace(steps=steps + found.steps)
    else:
        assert reason is not None
        tips_alone = task.needs_no_weights and not form.covariance
        z, point = _whole(task, loss, z, whitening, y, tips_alone or None)
        state, found = state_after(task, begun, z, point, True), Fit(z, steps, reasons(reason), jnp.zeros(()))
    free, spent = task.free, z.shape[0] if of_prior is None else of_prior.effective
    parameters, tips = set_at(task.start, free, z[: len(free)]), repeatability_of(state, task.observed)
    side = Bounds(begun.space, *(side[: len(free)] for side in begun.sides)).active(z[: len(free)])
    if task.needs_no_weights:
        whitening, sigma = weights(task, begun, state, None), state.sigma
        white = [rows.values / sigma for rows in state.point.rows]
    else:
        whitening, sigma = whitening_at(task, state, None if of_prior is None else of_prior.rows), 1.0
        each = zip(whitening.roots, state.point.rows, strict=True)
        white = [jnp.einsum("mab,bm->am", root, rows.values) for root, rows in each if root is not None]
    spare = jnp.maximum(task.observed.equations - spent, 1.0)
    fields = {
        "parameters": parameters,
        "de": tips.de,
        "deltam": tips.deltam,
        "sigma": state.sigma,
        "steps": found.steps,
        "reason": numbers_of(found.result),
        "active": set_at(jnp.zeros(parameters.shape, dtype=side.dtype), free, side),
        "reduced_chi": jnp.sqrt(sum(jnp.sum(one**2) for one in white) / spare),
        "prior": None if of_prior is None else of_prior.metrics,
        "k": None,
    }
    if problem.capture.lengths and not form.with_lengths:
        own = [sigma**2 * one for one in own_covariances(task.observed, state.point, whitening)]
        ends = ends_between(task.observed, z[len(free) :], own, problem.capture)
        fields["k"] = scale_and_weights(ends)[0].value
    if form.covariance:
        fields["covariance"] = concluded(task, begun, z, state, found, of_prior).identification.covariance
    return fields


def _solve_all(
    form: Form,
    chunk: _Chunk,
    one: Callable,
    loss: Loss | None,
    rules: Rules,
    z: Float[AnyArray, "c z"],
    whitening: Whitening,
    count: Int[Array, ""],
) -> tuple[Float[AnyArray, "c n"], Int[Array, " c"], Int[Array, " c"]]:
    """One least squares of every problem: its unknowns, evaluations, and numbers of the reasons."""
    capacity, slots = form.capacity, form.slots

    def of_slot(work: Callable) -> Callable:
        """``work(task, args, begun, unknowns of the solve)`` for each slot, by the number of its problem."""

        def each(problem: Problems, observed: Observed, z: AnyArray, whitening: Whitening, trial: Any) -> Any:
            task = one(problem, observed)
            args, size = args_of(task, whitening, loss, z)
            return work(task, args._replace(batch=True), z[:size], trial)

        function = _vmapped(form, chunk, each, 3)

        def call(index: Int[Array, " w"], trial: Any = None) -> Any:
            own = jax.tree.map(lambda leaf: leaf[index], (z, whitening))
            trial = jnp.zeros((slots, 0)) if trial is None else trial
            return function(*_selected(form, chunk, index), *own, trial)

        return call

    def start_and_box(task: Task, args: Any, first: AnyArray, _: Any) -> tuple[AnyArray, Box]:
        size = first.shape[0]
        return first, Box(*(side[:size] for side in box_of(task)))

    starts = of_slot(start_and_box)
    evaluate = of_slot(lambda task, args, first, trial: observed_model(trial, args))
    first = jnp.arange(slots)
    shapes = jax.eval_shape(lambda index: evaluate(index, starts(index)[0]).gram, first)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def fresh(index: Int[Array, " w"]) -> Any:
        first, box = starts(jnp.minimum(index, count - 1))
        return begin_steps(first, box, zeros)

    def more(carry: Any) -> Bool[Array, ""]:
        return jnp.any(carry[1] < count)

    def once(carry: Any) -> Any:
        progress, index, upcoming, (found, steps, reason) = carry
        now = jnp.minimum(index, count - 1)  # a slot without a problem repeats the last problem; its result is dropped
        _, box = starts(now)
        progress = advance(progress, evaluate(now, progress.step.trial), box, rules)
        late = progress.steps >= form.max_steps
        done = (progress.reason != RUNNING) | late
        ended = jnp.where(late & (progress.reason == RUNNING), MAX_STEPS, progress.reason)
        slot = jnp.where(done & (index < count), index, capacity)
        solutions = (
            found.at[slot].set(progress.y, mode="drop"),
            steps.at[slot].set(progress.steps, mode="drop"),
            reason.at[slot].set(ended, mode="drop"),
        )
        index = jnp.where(done, upcoming + jnp.cumsum(done) - 1, index)
        upcoming = upcoming + jnp.sum(done)
        return choose(done, fresh(index), progress), index, upcoming, solutions

    began = fresh(first)
    empty = (
        jnp.zeros((capacity, began.y.shape[-1])),
        jnp.zeros(capacity, dtype=jnp.int64),
        jnp.zeros(capacity, dtype=jnp.int32),
    )
    return jax.lax.while_loop(more, once, (began, first, jnp.asarray(slots), empty))[3]
