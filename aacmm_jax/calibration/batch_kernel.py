"""The compiled part of a batch: a fixed number of batch slots solves a chunk of problems.

The steps are those of `solve`, one after the other for the whole chunk. In a least squares every pass of the loop
evaluates and advances all slots; a slot whose problem has ended writes its result and takes the next problem of the
chunk, so no problem waits for another. The number of slots, not the chunk, fixes the arithmetic: results are the same
to the bit whatever the chunk.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core.numpy_or_jax import AnyArray, set_at
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..kinematics.priors import Prior
from ..model.elimination import observed_model, own_covariances, with_linear_geometry
from ..model.observed import Observed
from ..model.read_once import ReadOnce
from ..model.robust import Loss
from ..model.rows import PointRows, Whitening
from ..model.scale import scale_and_weights
from ..solver import levenberg_marquardt
from ..solver.active_set import Box, choose
from ..solver.reason import MAX_STEPS, RUNNING, numbers_of, reasons
from ..uncertainty.covariance import NoiseModel
from .prior_fit import fitted_with_prior, weights
from .scale_anchor import ScaleAnchor
from .solve import concluded, repeatability_of
from .stages import ends_between
from .task import Fit, Task, args_of, begin, box_of, solves_of, state_after, whitening_at, without_lengths


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
    read_once: ReadOnce
    max_steps: int
    covariance: bool
    axes: Problems  # trees of the axes, 0 or None
    slots: int = 0
    capacity: int = 0  # problems of a chunk


class _Ended(NamedTuple):
    """A least squares that began at z with these weights and ended at y; its results besides."""

    z: Float[AnyArray, "*c z"]
    whitening: Whitening
    y: Float[AnyArray, "*c n"]
    steps: Int[AnyArray, "*c"]  # evaluations, of all so far
    reason: Int[AnyArray, "*c"]

    def unknowns(self, task: Task, loss: Loss | None, batch: bool | None = None) -> tuple[AnyArray, PointRows]:
        """All unknowns at its end, and the rows there."""
        args = args_of(task, self.whitening, loss, self.z)[0]
        return with_linear_geometry(self.y, args._replace(batch=batch))


class _Chunk(NamedTuple):
    """The problems of a chunk, with what is observed in each."""

    form: Form
    problems: Problems
    noise: Noise | None
    prior: Prior | None
    observed: Observed
    observed_axes: Any  # of its leaves; None where all problems share them

    @classmethod
    def of(cls, form: Form, problems: Problems, noise: Noise | None, prior: Prior | None) -> "_Chunk":
        """With what the poses do to the joints, which every evaluation needs and none changes."""
        axes, arm = form.axes, problems.arm

        def observed_of(arm: Arm, capture: Capture) -> Observed:
            capture = capture if form.with_lengths else without_lengths(capture)
            return Observed.of(capture, arm, read_once=form.read_once)

        if axes.capture is None and arm.corrections is None:
            # The arm's values do not matter.
            return cls(form, problems, noise, prior, observed_of(_pick(arm, axes.arm, 0), problems.capture), None)
        mapped = jax.vmap(observed_of, in_axes=(axes.arm, axes.capture), axis_size=form.capacity)
        observed = mapped(arm, problems.capture)
        # The joints before the problems, as the chain takes them.
        turned = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), observed.motion)
        zeros, ones = jax.tree.map(lambda _: 0, observed), jax.tree.map(lambda _: 1, turned)
        observed, observed_axes = (
            eqx.tree_at(lambda tree: tree.motion, *pair) for pair in ((observed, turned), (zeros, ones))
        )
        return cls(form, problems, noise, prior, observed, observed_axes)

    def task(self, problem: Problems, observed: Observed) -> Task:
        """One problem, traced."""
        form = self.form
        return Task(
            observed=observed,
            bounds=Bounds(Parameters(problem.arm, form.names), problem.lower, problem.upper),
            start=jnp.clip(problem.start, problem.lower, problem.upper),
            noise=self.noise,
            prior=self.prior,
            differentiable=False,
            **{name: getattr(form, name) for name in ("anchor", "noise_model", "max_steps", "loss", "pose")},
        )

    def selected(self, index: Any) -> tuple[Problems, Observed]:
        """The problems of an index."""
        problems = selected(self.problems, self.form.axes, index)
        return problems, _pick(self.observed, self.observed_axes, index)

    def by_slot(self, work: Callable, extra: int) -> Callable:
        """``work(problem, task, *extra)`` for a problem in each slot, by ``(index, *extra)``."""

        def of_slot(problem: Problems, observed: Observed, *extra: Any) -> Any:
            return work(problem, self.task(problem, observed), *extra)

        axes = (self.form.axes, self.observed_axes, *(0,) * extra)
        function = jax.vmap(of_slot, in_axes=axes, axis_size=self.form.slots)
        return lambda index, *extra: function(*self.selected(index), *extra)

    def in_groups(self, work: Callable, *extra: Any) -> Any:
        """``work(problem, task, *extra)`` for all problems, as many at a time as there are slots."""
        function, form = self.by_slot(work, len(extra)), self.form

        def group(row: Int[Array, ""]) -> Any:
            index = row * form.slots + jnp.arange(form.slots)
            return function(index, *jax.tree.map(lambda leaf: leaf[index], extra))

        results = jax.lax.map(group, jnp.arange(form.capacity // form.slots))
        return jax.tree.map(lambda leaf: leaf.reshape(form.capacity, *leaf.shape[2:]), results)


def _pick(tree: Any, axis: Any, index: Any) -> Any:
    """The problems of an index of a tree with such axes; what is shared stays as it is."""
    if axis is None:
        return tree

    def leaf_at(axis: int | None, leaf: Any) -> Any:
        return leaf if axis is None else leaf[index] if not axis else leaf[:, index]

    return jax.tree.map(leaf_at, axis, tree, is_leaf=lambda leaf: leaf is None)


def selected(problems: Problems, axes: Problems, index: Any) -> Problems:
    """The problems of an index."""
    return Problems(*(_pick(tree, axis, index) for tree, axis in zip(problems, axes, strict=True)))


@eqx.filter_jit
def solve_chunk(
    form: Form, problems: Problems, count: Int[Array, ""], noise: Noise | None, prior: Prior | None
) -> dict[str, Any]:
    """Solve the first ``count`` of the problems of a chunk: the fields of `ManyIdentifications`."""
    chunk = _Chunk.of(form, problems, noise, prior)
    first = chunk.task(*chunk.selected(jnp.asarray(0)))  # for what is the same for all
    solves = solves_of(first)
    losses = [loss for loss, _ in solves]
    # With a prior the last least squares is part of what follows the loop (`_fields`).
    solves = solves if first.free_prior is None else solves[:-1]
    z, whitening = chunk.in_groups(_beginning)
    ended = _Ended(z, whitening, z, *(jnp.zeros(form.capacity, dtype=kind) for kind in (jnp.int64, jnp.int32)))
    for number, (loss, rules) in enumerate(solves, 1):

        def again(_: Problems, task: Task, ended: _Ended, loss: Any = loss, number: int = number) -> Any:
            # Where the next least squares begins, and its weights.
            z, point = ended.unknowns(task, loss)
            begun = begin(task)
            return z, weights(task, begun, state_after(task, begun, z, point, False), losses[number])

        y, steps, reason = _solve_all(chunk, loss, rules, ended, count)
        ended = ended._replace(y=y, steps=ended.steps + steps, reason=reason)
        if number < len(solves):
            z, whitening = chunk.in_groups(again, ended)
            ended = ended._replace(z=z, whitening=whitening)
    return chunk.in_groups(lambda problem, task, ended: _fields(form, losses, problem, task, ended), ended)


def _beginning(problem: Problems, task: Task) -> tuple[Float[AnyArray, " z"], Whitening]:
    """Where a solve begins, and its first weights."""
    near = problem.near
    if task.needs_no_weights:
        # Positions of sockets are no unknowns of the solve, so any will do.
        start = task.start if near is None else jnp.clip(near, task.bounds.lower, task.bounds.upper)
        whitening = Whitening((None,) * len(task.observed.layout.groups), jnp.zeros(0), {})
        return jnp.concatenate([start[task.free], jnp.zeros(len(task.observed.steps))]), whitening
    begun = begin(task, near)
    return begun.z, weights(task, begun, begun.state, solves_of(task)[0][0])


def _fields(form: Form, losses: list[Loss | None], problem: Problems, task: Task, ended: _Ended) -> dict[str, Any]:
    """The fields of one problem after its last least squares; that with a prior is still to come."""
    begun, prior, of_prior, free = begin(task), task.free_prior, None, task.free
    if prior is not None:
        z, point = ended.unknowns(task, losses[-2])
        z, state, last, of_prior = fitted_with_prior(task, prior, begun, state_after(task, begun, z, point, False), z)
        last = last._replace(steps=ended.steps + last.steps)
    else:
        tips_alone = task.needs_no_weights and not form.covariance
        z, point = ended.unknowns(task, losses[-1], tips_alone or None)
        state = state_after(task, begun, z, point, True)
        last = Fit(z, ended.steps, reasons(ended.reason), jnp.zeros(()))
    # Residuals in standard deviations, and k where lengths do not take part.
    if task.needs_no_weights:
        roots, sigma = (None,) * len(task.observed.layout.groups), state.sigma
        whitening = Whitening(roots, jnp.zeros(0), {})
        white = [rows.values / sigma for rows in state.point.rows]
    else:
        whitening, sigma = whitening_at(task, state, of_prior and of_prior.rows), 1.0
        pairs = zip(whitening.roots, state.point.rows, strict=True)
        white = [jnp.einsum("mab,bm->am", root, rows.values) for root, rows in pairs if root is not None]
    redundancy = jnp.maximum(task.observed.equations - (z.shape[0] if of_prior is None else of_prior.effective), 1.0)
    k = None
    if problem.capture.lengths and not form.with_lengths:
        covariances = [sigma**2 * matrices for matrices in own_covariances(task.observed, state.point, whitening)]
        k = scale_and_weights(ends_between(task.observed, z[len(free) :], covariances, problem.capture))[0].value
    tips = repeatability_of(state, task.observed)
    side = Bounds(begun.space, *(side[: len(free)] for side in begun.box[:2])).active(z[: len(free)])
    fields = {
        "parameters": set_at(task.start, free, z[: len(free)]),
        "de": tips.de,
        "deltam": tips.deltam,
        "sigma": state.sigma,
        "steps": last.steps,
        "reason": numbers_of(last.result),
        "active": set_at(jnp.zeros(task.start.shape, dtype=side.dtype), free, side),
        "prior": of_prior and of_prior.metrics,
        "reduced_chi": jnp.sqrt(sum(jnp.sum(rows**2) for rows in white) / redundancy),
        "k": k,
    }
    if form.covariance:
        fields["covariance"] = concluded(task, begun, z, state, last, of_prior).identification.covariance
    return fields


def _solve_all(
    chunk: _Chunk, loss: Loss | None, rules: levenberg_marquardt.Rules, begun: _Ended, count: Int[Array, ""]
) -> tuple[Float[AnyArray, "c n"], Int[Array, " c"], Int[Array, " c"]]:
    """One least squares of every problem: its unknowns, evaluations, and numbers of the reasons."""
    capacity, slots, most = chunk.form.capacity, chunk.form.slots, chunk.form.max_steps

    def of_slot(work: Callable, extra: int) -> Callable:
        """``work(task, args, unknowns of the solve, *extra)`` for each slot, by the number of its problem."""

        def with_args(_: Problems, task: Task, z: AnyArray, whitening: Whitening, *extra: Any) -> Any:
            args, size = args_of(task, whitening, loss, z)
            return work(task, args._replace(batch=True), z[:size], *extra)

        function = chunk.by_slot(with_args, 2 + extra)
        begins = begun.z, begun.whitening
        return lambda index, *extra: function(index, *jax.tree.map(lambda leaf: leaf[index], begins), *extra)

    starts = of_slot(lambda task, _, first: (first, Box(*(side[: len(first)] for side in box_of(task)))), 0)
    evaluate = of_slot(lambda task, args, first, trial: observed_model(trial, args), 1)
    slot = jnp.arange(slots)
    shapes = jax.eval_shape(lambda index: evaluate(index, starts(index)[0]).gram, slot)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    def fresh(index: Int[Array, " w"]) -> Any:
        first, box = starts(jnp.minimum(index, count - 1))
        return levenberg_marquardt.begin(first, box, zeros)

    def once(carry: Any) -> Any:
        progress, index, upcoming, results = carry
        now = jnp.minimum(index, count - 1)  # a slot without a problem repeats the last problem; its result is dropped
        _, box = starts(now)
        progress = levenberg_marquardt.advance(progress, evaluate(now, progress.step.trial), box, rules)
        late = progress.steps >= most
        done = (progress.reason != RUNNING) | late
        ended = jnp.where(late & (progress.reason == RUNNING), MAX_STEPS, progress.reason)
        place = jnp.where(done & (index < count), index, capacity)
        columns = zip(results, (progress.y, progress.steps, ended), strict=True)
        results = tuple(column.at[place].set(values, mode="drop") for column, values in columns)
        index = jnp.where(done, upcoming + jnp.cumsum(done) - 1, index)
        upcoming = upcoming + jnp.sum(done)
        return choose(done, fresh(index), progress), index, upcoming, results

    progress = fresh(slot)
    numbers = (jnp.zeros(capacity, dtype=kind) for kind in (jnp.int64, jnp.int32))
    start = (progress, slot, jnp.asarray(slots), (jnp.zeros((capacity, progress.y.shape[-1])), *numbers))
    return jax.lax.while_loop(lambda carry: jnp.any(carry[1] < count), once, start)[3]
