"""The compiled part of a batch: a fixed number of batch slots solves a chunk of problems.

Every pass of the loop evaluates and advances all slots; a slot whose problem has ended writes its result and takes the
next problem of the chunk, so no problem waits for another. The number of slots, not the chunk, fixes the arithmetic:
results are the same to the bit whatever the chunk.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core.numpy_or_jax import AnyArray
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import with_values
from ..kinematics.chain import Geometry, JointMotion, forward_pass, joint_motion
from ..kinematics.jacobian import tip_and_columns
from ..model.measurement import Measurement
from ..model.metrics import repeatability
from ..model.residuals import JointWeights, normal_equations
from ..model.scale import scale_of
from ..model.weights import Weights
from ..solver.active_set import Box, choose
from ..solver.levenberg_marquardt import advance, begin
from ..solver.reason import MAX_STEPS, RUNNING
from .bounded_fit import RULES


class Problems(NamedTuple):
    """What may differ from problem to problem; a leaf either has the batch axis first, or is shared by all."""

    start: Any  # (p,)
    lower: Any  # (p,)
    upper: Any  # (p,)
    geometry: Any  # `Geometry` with (n,) leaves
    q: Any  # (N, n)
    nominal: Any  # (l,)
    u: Any  # (l,)
    # (), of a joint solve only: standard deviation of a tip coordinate by stage 1, mm, in the arm divided by k.
    sigma: Any = None


class Shape(NamedTuple):
    """What is the same for all problems and fixes the compiled program."""

    sizes: tuple[int, ...]
    ends: tuple[tuple[int, int], ...]
    indices: tuple[tuple[str, int], ...]  # kind and joint of each parameter
    solved: tuple[bool, ...]  # False for the scale anchor of stage 1
    scale: tuple[float, ...]
    batched: Problems  # booleans
    slots: int
    max_steps: int


class _Solutions(NamedTuple):
    """Results of the solves of a chunk."""

    parameters: Float[AnyArray, "b p"]
    steps: Int[Array, " b"]
    reason: Int[Array, " b"]  # number of a `Reason`


@partial(jax.jit, static_argnames=("shape", "capacity"))
def solve_chunk(
    problems: Problems, count: Int[Array, ""], noise: Noise | None, shape: Shape, capacity: int
) -> tuple[Any, ...]:
    """Solve the first ``count`` of ``capacity`` problems; the fields of `ManyIdentifications` up to ``active``."""
    batch = _Batch(problems, joint_motion(problems.geometry, problems.q), None, None)
    start = jnp.broadcast_to(problems.start, (capacity, len(shape.solved)))
    if noise is not None:
        batch = batch._replace(weights=_in_groups(partial(_weights, noise), batch, start, shape))
    if problems.sigma is not None:
        batch = batch._replace(joint_weights=_in_groups(_joint_weights, batch, start, shape))
    solutions = _solve_all(batch, shape, count, capacity)
    de, deltam, sigma, k, active = _in_groups(_metrics, batch, solutions.parameters, shape)
    return solutions.parameters, de, deltam, sigma, k, solutions.steps, solutions.reason, active


class _Batch(NamedTuple):
    """A chunk, or a group of problems selected from it."""

    problems: Problems
    motion: JointMotion
    weights: Weights | None  # of poses, where the noise is given
    joint_weights: tuple[Any, Any] | None  # of a joint solve: sigma and whitening

    def selected(self, shape: Shape, index: Int[Array, " w"]) -> "_Batch":
        """The problems of an index, one a slot."""
        motion = self.motion
        if shape.batched.q:
            motion = jax.tree.map(lambda leaf: leaf[:, index], motion)
        rest = jax.tree.map(lambda leaf: leaf[index], (self.weights, self.joint_weights))
        return _Batch(_selected(self.problems, shape, index), motion, *rest)


def _selected(problems: Problems, shape: Shape, index: Int[Array, " w"]) -> Problems:
    """The problems of an index, one a slot; what is shared is repeated, but for q."""

    def slots_of(leaf: Array, many: bool) -> AnyArray:
        return leaf[index] if many else jnp.broadcast_to(leaf, (shape.slots, *leaf.shape))

    q = problems.q[index] if shape.batched.q else problems.q
    return jax.tree.map(slots_of, problems, shape.batched)._replace(q=q)


def _in_groups(work: Callable, batch: _Batch, parameters: Float[AnyArray, "capacity p"], shape: Shape) -> Any:
    """``work(batch, parameters, shape)`` for all, as many at a time as there are slots."""

    def group(row: Int[Array, ""]) -> Any:
        index = row * shape.slots + jnp.arange(shape.slots)
        return work(batch.selected(shape, index), parameters[index], shape)

    found = jax.lax.map(group, jnp.arange(parameters.shape[0] // shape.slots))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def _solve_all(batch: _Batch, shape: Shape, count: Int[Array, ""], capacity: int) -> _Solutions:
    """The loop over slots; every slot takes the next problem of the chunk when its own has ended."""
    solved = np.flatnonzero(shape.solved)
    indices = tuple(shape.indices[i] for i in solved)
    scale = jnp.asarray(np.asarray(shape.scale)[solved])

    def starts(index: Array) -> tuple[Array, Box]:
        part = _selected(batch.problems, shape, index)
        start = part.start[:, solved]
        return start, Box(part.lower[:, solved], part.upper[:, solved], jnp.broadcast_to(scale, start.shape))

    def evaluate(trial: Array, index: Array):
        part = batch.selected(shape, index)
        problems = part.problems
        geometry = _with_parameters(problems.geometry, problems.start.at[:, solved].set(trial), shape.indices)
        joint_weights = (
            None if part.joint_weights is None else JointWeights(shape.ends, problems.nominal, *part.joint_weights)
        )
        tip, columns = tip_and_columns(geometry, part.motion, indices)
        return normal_equations(tip, columns, shape.sizes, joint_weights, part.weights)

    def more(carry) -> Bool[Array, ""]:
        _, index, _, _ = carry
        return jnp.any(index < count)

    def once(carry):
        progress, index, upcoming, solutions = carry
        now = jnp.minimum(index, count - 1)  # a slot without a problem repeats the last problem; its result is dropped
        _, box = starts(now)
        progress = advance(progress, evaluate(progress.step.trial, now), box, RULES)
        late = progress.steps >= shape.max_steps
        done = (progress.reason != RUNNING) | late
        reason = jnp.where(late & (progress.reason == RUNNING), MAX_STEPS, progress.reason)
        slot = jnp.where(done & (index < count), index, capacity)
        whole = _selected(batch.problems, shape, now).start.at[:, solved].set(progress.y)
        solutions = _Solutions(
            solutions.parameters.at[slot].set(whole, mode="drop"),
            solutions.steps.at[slot].set(progress.steps, mode="drop"),
            solutions.reason.at[slot].set(reason, mode="drop"),
        )
        index = jnp.where(done, upcoming + jnp.cumsum(done) - 1, index)
        upcoming = upcoming + jnp.sum(done)
        fresh = begin(*starts(jnp.minimum(index, count - 1)))
        return choose(done, fresh, progress), index, upcoming, solutions

    first = jnp.arange(shape.slots)
    p = len(shape.solved)
    empty = _Solutions(
        jnp.zeros((capacity, p)), jnp.zeros(capacity, dtype=jnp.int64), jnp.zeros(capacity, dtype=jnp.int32)
    )
    carry = (begin(*starts(jnp.minimum(first, count - 1))), first, jnp.asarray(shape.slots), empty)
    return jax.lax.while_loop(more, once, carry)[3]


def _with_parameters(rows: Geometry, vector: Float[AnyArray, "w p"], indices: tuple[tuple[str, int], ...]) -> Geometry:
    """Geometry of every slot ``(w, 1, n)`` with its free parameters from ``vector``; the axis of ones is for the
    poses."""
    return jax.tree.map(lambda leaf: leaf[:, None, :], rows._replace(**with_values(rows, vector, indices)))


def _tips(part: _Batch, parameters: Float[AnyArray, "w p"], shape: Shape) -> Float[AnyArray, "w N 3"]:
    geometry = _with_parameters(part.problems.geometry, parameters, shape.indices)
    return jnp.swapaxes(forward_pass(geometry, part.motion).tip, -1, -2)


def _measurement(
    nominal: Float[AnyArray, " l"], u: Float[AnyArray, " l"], weights: Weights | None, shape: Shape
) -> Measurement:
    """The lengths of one problem; its poses are known by their tips already."""
    empty = jnp.zeros((sum(shape.sizes), 1))
    return Measurement(empty, JointMotion(empty, empty, None), nominal, u, shape.sizes, shape.ends, weights)


def _metrics(part: _Batch, parameters: Float[AnyArray, "w p"], shape: Shape) -> tuple[Any, ...]:
    """DE, Deltam, sigma, k and active bounds of one group."""
    problems, tips = part.problems, _tips(part, parameters, shape)
    metrics = jax.vmap(lambda t: repeatability(t, shape.sizes, fitted=sum(shape.solved)))(tips)
    k = jnp.ones(shape.slots)
    if shape.ends:

        def scale(t: AnyArray, value: Array, uncertainty: Array, sigma: AnyArray, weights: Weights | None) -> AnyArray:
            return scale_of(t, _measurement(value, uncertainty, weights, shape), sigma).value

        k = jax.vmap(scale)(tips, problems.nominal, problems.u, metrics.sigma, part.weights)
    side = jnp.where(parameters <= problems.lower, -1, jnp.where(parameters >= problems.upper, 1, 0))
    return metrics.de, metrics.deltam, metrics.sigma, k, jnp.where(jnp.asarray(shape.solved)[None], side, 0)


def _weights(noise: Noise, part: _Batch, start: Float[AnyArray, "w p"], shape: Shape) -> Weights:
    """Weights of poses by the noise, in the arm at the start of one group."""
    geometry = _with_parameters(part.problems.geometry, start, shape.indices)
    return Weights.of(tip_covariances(geometry, part.motion, noise), shape.sizes)


def _joint_weights(part: _Batch, start: Float[AnyArray, "w p"], shape: Shape) -> tuple[Any, Any]:
    """Sigma and whitening of every slot for a joint solve, in the arm at its start."""

    def joint_weights(
        t: AnyArray, value: Array, uncertainty: Array, sigma: AnyArray, weights: Weights | None
    ) -> tuple[Any, Any]:
        found = JointWeights.of(t, _measurement(value, uncertainty, weights, shape), sigma)
        return found.sigma, found.whitening

    problems = part.problems
    tips = _tips(part, start, shape)
    return jax.vmap(joint_weights)(tips, problems.nominal, problems.u, problems.sigma, part.weights)
