"""The compiled part of a batch: a fixed number of lanes works off a chunk of problems.

Every pass of the loop evaluates and advances all lanes; a lane whose problem has ended writes its result and takes the next
problem of the chunk, so no problem waits for another. The number of lanes, not the chunk, fixes the arithmetic: results are
the same to the bit whatever the chunk.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import with_values
from ..kinematics.chain import Geometry, SinesCosines, forward_pass, sines_cosines
from ..model.measurement import LEAST_SIGMA, Measurement, length_covariance
from ..model.metrics import repeatability
from ..model.residuals import JointWeights, model_of
from ..model.scale import scale_of
from ..model.weights import Weights
from ..solver.levenberg_marquardt import Box, Reason, advance, begin, choose, either, numbers_of, reasons
from .task import SOLVER


class Problems(NamedTuple):
    """What may differ from problem to problem; a leaf either has the batch axis first, or is shared by all."""

    start: Any  # (p,)
    lower: Any  # (p,)
    upper: Any  # (p,)
    geometry: Any  # `Geometry` with (n,) leaves
    q: Any  # (N, n)
    nominal: Any  # (l,)
    u: Any  # (l,)


class Shape(NamedTuple):
    """What is the same for all problems and fixes the compiled program."""

    sizes: tuple[int, ...]
    ends: tuple[tuple[int, int], ...]
    entries: tuple[tuple[str, int], ...]
    kept: tuple[bool, ...]  # False for the length held in stage 1
    scale: tuple[float, ...]
    batched: Problems  # booleans
    lanes: int
    max_steps: int
    joint: bool = False  # poses and lengths in one least squares
    fitted: int = 0  # parameters that stage 1 took from the poses (joint)


class _Ended(NamedTuple):
    """What one ended problem leaves."""

    parameters: Float[Array, "b p"]
    steps: Int[Array, " b"]
    reason: Reason


@partial(jax.jit, static_argnames=("shape", "room"))
def solve_chunk(
    problems: Problems, count: Int[Array, ""], noise: Noise | None, shape: Shape, room: int
) -> tuple[Array, ...]:
    """Solve the first ``count`` of ``room`` problems: parameters, DE, Deltam, k, steps, reasons, active bounds."""
    batch = _Batch(problems, sines_cosines(problems.q), None, None)
    start = jnp.broadcast_to(problems.start, (room, len(shape.kept)))
    if noise is not None:
        batch = batch._replace(weights=_by_groups(partial(_weights, noise), batch, start, shape))
    if shape.joint:
        batch = batch._replace(joint_weights=_by_groups(_joint_weights, batch, start, shape))
    ended = _work_off(batch, shape, count, room)
    de, deltam, k, active = _by_groups(_figures, batch, ended.parameters, shape)
    return ended.parameters, de, deltam, k, ended.steps, numbers_of(ended.reason), active


class _Batch(NamedTuple):
    """A chunk, or a group of lanes taken from it."""

    problems: Problems
    sines_cosines: SinesCosines
    weights: Weights | None  # of poses, where the noise is given
    joint_weights: tuple[Array, Array] | None  # of a joint solve: sigma and whitening

    def taken(self, shape: Shape, index: Int[Array, " w"]) -> "_Batch":
        """The problems of an index, one a lane."""
        sines_cosines = (
            (self.sines_cosines[0][:, index], self.sines_cosines[1][:, index])
            if shape.batched.q
            else self.sines_cosines
        )
        rest = jax.tree.map(lambda leaf: leaf[index], (self.weights, self.joint_weights))
        return _Batch(_taken(self.problems, shape, index), sines_cosines, *rest)


def _taken(problems: Problems, shape: Shape, index: Int[Array, " w"]) -> Problems:
    """The problems of an index, one a lane; what is shared is repeated, but for q."""

    def lanes_of(leaf: Array, many: bool) -> Array:
        return leaf[index] if many else jnp.broadcast_to(leaf, (shape.lanes, *leaf.shape))

    q = problems.q[index] if shape.batched.q else problems.q
    return jax.tree.map(lanes_of, problems, shape.batched)._replace(q=q)


def _by_groups(work: Callable, batch: _Batch, parameters: Float[Array, "room p"], shape: Shape) -> Any:
    """``work(batch, parameters, shape)`` for all, as many at a time as there are lanes."""

    def group(row: Int[Array, ""]) -> Any:
        index = row * shape.lanes + jnp.arange(shape.lanes)
        return work(batch.taken(shape, index), parameters[index], shape)

    found = jax.lax.map(group, jnp.arange(parameters.shape[0] // shape.lanes))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def _work_off(batch: _Batch, shape: Shape, count: Int[Array, ""], room: int) -> _Ended:
    """The loop over lanes; every lane takes the next problem of the chunk when its own has ended."""
    kept = np.flatnonzero(shape.kept)
    entries = tuple(shape.entries[i] for i in kept)
    scale = jnp.asarray(np.asarray(shape.scale)[kept])

    def starts(index: Array) -> tuple[Array, Box]:
        part = _taken(batch.problems, shape, index)
        start = part.start[:, kept]
        return start, Box(part.lower[:, kept], part.upper[:, kept], jnp.broadcast_to(scale, start.shape))

    def evaluate(trial: Array, index: Array):
        part = batch.taken(shape, index)
        problems = part.problems
        geometry = _with_parameters(problems.geometry, problems.start.at[:, kept].set(trial), shape.entries)
        joint_weights = (
            None if part.joint_weights is None else JointWeights(shape.ends, problems.nominal, *part.joint_weights)
        )
        return model_of(geometry, part.sines_cosines, shape.sizes, entries, joint_weights, part.weights)

    def more(carry) -> Bool[Array, ""]:
        _, index, _, _ = carry
        return jnp.any(index < count)

    def once(carry):
        progress, index, following, ended = carry
        now = jnp.minimum(index, count - 1)  # a lane without work repeats the last problem; its result is dropped
        _, box = starts(now)
        progress = advance(progress, evaluate(progress.trial, now), box, SOLVER.rules)
        late = progress.steps >= shape.max_steps
        done = (progress.reason != Reason.running) | late
        reason = either(late & (progress.reason == Reason.running), Reason.max_steps, progress.reason)
        slot = jnp.where(done & (index < count), index, room)
        whole = _taken(batch.problems, shape, now).start.at[:, kept].set(progress.y)
        ended = _Ended(
            ended.parameters.at[slot].set(whole, mode="drop"),
            ended.steps.at[slot].set(progress.steps, mode="drop"),
            reasons(numbers_of(ended.reason).at[slot].set(numbers_of(reason), mode="drop")),
        )
        index = jnp.where(done, following + jnp.cumsum(done) - 1, index)
        following = following + jnp.sum(done)
        fresh = begin(*starts(jnp.minimum(index, count - 1)))
        return choose(done, fresh, progress), index, following, ended

    first = jnp.arange(shape.lanes)
    p = len(shape.kept)
    nothing = _Ended(jnp.zeros((room, p)), jnp.zeros(room, dtype=jnp.int64), reasons(jnp.zeros(room, dtype=jnp.int32)))
    carry = (begin(*starts(jnp.minimum(first, count - 1))), first, jnp.asarray(shape.lanes), nothing)
    return jax.lax.while_loop(more, once, carry)[3]


def _with_parameters(rows: Geometry, vector: Float[Array, "w p"], entries: tuple[tuple[str, int], ...]) -> Geometry:
    """Geometry of every lane ``(w, 1, n)`` with its free parameters from ``vector``; the axis of ones is for the poses."""
    return jax.tree.map(lambda leaf: leaf[:, None, :], rows._replace(**with_values(rows, vector, entries)))


def _tips(part: _Batch, parameters: Float[Array, "w p"], shape: Shape) -> Float[Array, "w N 3"]:
    geometry = _with_parameters(part.problems.geometry, parameters, shape.entries)
    return jnp.swapaxes(forward_pass(geometry, part.sines_cosines).tip, -1, -2)


def _measurement(
    nominal: Float[Array, " l"], u: Float[Array, " l"], weights: Weights | None, shape: Shape
) -> Measurement:
    """The lengths of one problem; its poses are known by their tips already."""
    empty = jnp.zeros((sum(shape.sizes), 1))
    return Measurement(empty, sines_cosines(empty), nominal, u, shape.sizes, shape.ends, weights)


def _figures(part: _Batch, parameters: Float[Array, "w p"], shape: Shape) -> tuple[Array, ...]:
    """DE, Deltam, k and active bounds of one group of lanes."""
    problems, tips = part.problems, _tips(part, parameters, shape)
    figures = jax.vmap(lambda t: repeatability(t, shape.sizes, fitted=sum(shape.kept)))(tips)
    k = jnp.ones(shape.lanes)
    if shape.ends:

        def scale(t: Array, value: Array, uncertainty: Array, sigma: Array, weights: Weights | None) -> Array:
            return scale_of(t, _measurement(value, uncertainty, weights, shape), sigma).value

        k = jax.vmap(scale)(tips, problems.nominal, problems.u, figures.sigma, part.weights)
    side = jnp.where(parameters <= problems.lower, -1, jnp.where(parameters >= problems.upper, 1, 0))
    return figures.de, figures.deltam, k, jnp.where(jnp.asarray(shape.kept)[None], side, 0)


def _weights(noise: Noise, part: _Batch, start: Float[Array, "w p"], shape: Shape) -> Weights:
    """Weights of poses by the noise, in the arm at the start of one group of lanes."""
    geometry = _with_parameters(part.problems.geometry, start, shape.entries)
    return Weights.of(tip_covariances(geometry, part.sines_cosines, noise), shape.sizes)


def _joint_weights(part: _Batch, start: Float[Array, "w p"], shape: Shape) -> tuple[Array, Array]:
    """What weighs poses and lengths in a joint solve, from the scatter at its start: sigma and whitening of every lane."""

    def joint_weights(t: Array, value: Array, uncertainty: Array, weights: Weights | None) -> tuple[Array, Array]:
        figures = repeatability(t, shape.sizes, fitted=shape.fitted)
        sigma = jnp.maximum(figures.sigma, LEAST_SIGMA)
        measurement = _measurement(value, uncertainty, weights, shape)
        covariance = length_covariance(measurement.centroids(t), measurement, sigma)
        counted = sigma if weights is None else jnp.ones_like(sigma)
        return counted, jnp.linalg.inv(jnp.linalg.cholesky(covariance))

    return jax.vmap(joint_weights)(_tips(part, start, shape), part.problems.nominal, part.problems.u, part.weights)
