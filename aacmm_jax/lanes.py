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

from .calibrate import SOLVER
from .chain import Geometry, Turns, turns_of, walk
from .covariance import LEAST_SIGMA, length_covariance
from .metrics import repeatability
from .parameters import placed
from .residuals import Measurement, Weighing, model_of
from .scale import scale_of
from .steps import Box, Reason, advance, begin, choose, either, numbers_of, reasons


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
def solve_chunk(problems: Problems, count: Int[Array, ""], shape: Shape, room: int) -> tuple[Array, ...]:
    """Solve the first ``count`` of ``room`` problems: parameters, DE, Deltam, k, steps, reasons, active bounds."""
    turns = turns_of(problems.q)
    weights = None
    if shape.joint:
        start = jnp.broadcast_to(problems.start, (room, len(shape.kept)))
        weights = _by_groups(_weights, problems, turns, start, shape)
    ended = _work_off(problems, turns, weights, shape, count, room)
    de, deltam, k, active = _by_groups(_figures, problems, turns, ended.parameters, shape)
    return ended.parameters, de, deltam, k, ended.steps, numbers_of(ended.reason), active


def _taken(problems: Problems, shape: Shape, index: Int[Array, " w"]) -> Problems:
    """The problems of an index, one a lane; what is shared is repeated, but for q."""

    def lanes_of(leaf: Array, many: bool) -> Array:
        return leaf[index] if many else jnp.broadcast_to(leaf, (shape.lanes, *leaf.shape))

    q = problems.q[index] if shape.batched.q else problems.q
    return jax.tree.map(lanes_of, problems, shape.batched)._replace(q=q)


def _turns_of(turns: Turns, shape: Shape, index: Int[Array, " w"]) -> Turns:
    return (turns[0][:, index], turns[1][:, index]) if shape.batched.q else turns


def _by_groups(
    work: Callable, problems: Problems, turns: Turns, parameters: Float[Array, "room p"], shape: Shape
) -> tuple[Array, ...]:
    """``work(problems, turns, parameters, shape)`` for all, as many at a time as there are lanes."""

    def group(row: Int[Array, ""]) -> tuple[Array, ...]:
        index = row * shape.lanes + jnp.arange(shape.lanes)
        return work(_taken(problems, shape, index), _turns_of(turns, shape, index), parameters[index], shape)

    found = jax.lax.map(group, jnp.arange(parameters.shape[0] // shape.lanes))
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), found)


def _work_off(
    problems: Problems, turns: Turns, weights: tuple[Array, ...] | None, shape: Shape, count: Int[Array, ""], room: int
) -> _Ended:
    """The loop over lanes; every lane takes the next problem of the chunk when its own has ended."""
    kept = np.flatnonzero(shape.kept)
    entries = tuple(shape.entries[i] for i in kept)
    scale = jnp.asarray(np.asarray(shape.scale)[kept])

    def starts(index: Array) -> tuple[Array, Box]:
        part = _taken(problems, shape, index)
        start = part.start[:, kept]
        return start, Box(part.lower[:, kept], part.upper[:, kept], jnp.broadcast_to(scale, start.shape))

    def evaluate(trial: Array, index: Array):
        part = _taken(problems, shape, index)
        geometry = _with_parameters(part.geometry, part.start.at[:, kept].set(trial), shape.entries)
        weighing = None if weights is None else Weighing(shape.ends, part.nominal, *(leaf[index] for leaf in weights))
        return model_of(geometry, _turns_of(turns, shape, index), shape.sizes, entries, weighing)

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
        whole = _taken(problems, shape, now).start.at[:, kept].set(progress.y)
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
    return jax.tree.map(lambda leaf: leaf[:, None, :], rows._replace(**placed(rows, vector, entries)))


def _tips(part: Problems, turns: Turns, parameters: Float[Array, "w p"], shape: Shape) -> Float[Array, "w N 3"]:
    return jnp.swapaxes(walk(_with_parameters(part.geometry, parameters, shape.entries), turns).tip, -1, -2)


def _measurement(nominal: Float[Array, " l"], u: Float[Array, " l"], shape: Shape) -> Measurement:
    """The lengths of one problem; its poses are known by their tips already."""
    empty = jnp.zeros((sum(shape.sizes), 1))
    return Measurement(empty, turns_of(empty), nominal, u, shape.sizes, shape.ends)


def _figures(part: Problems, turns: Turns, parameters: Float[Array, "w p"], shape: Shape) -> tuple[Array, ...]:
    """DE, Deltam, k and active bounds of one group of lanes."""
    tips = _tips(part, turns, parameters, shape)
    figures = jax.vmap(lambda t: repeatability(t, shape.sizes, fitted=sum(shape.kept)))(tips)
    k = jnp.ones(shape.lanes)
    if shape.ends:

        def scale(t: Array, value: Array, uncertainty: Array, sigma: Array) -> Array:
            return scale_of(t, _measurement(value, uncertainty, shape), sigma).value

        k = jax.vmap(scale)(tips, part.nominal, part.u, figures.sigma)
    side = jnp.where(parameters <= part.lower, -1, jnp.where(parameters >= part.upper, 1, 0))
    return figures.de, figures.deltam, k, jnp.where(jnp.asarray(shape.kept)[None], side, 0)


def _weights(part: Problems, turns: Turns, start: Float[Array, "w p"], shape: Shape) -> tuple[Array, ...]:
    """What weighs poses and lengths in a joint solve, from the scatter at its start: sigma and whitening of every lane."""

    def weights(t: Array, value: Array, uncertainty: Array) -> tuple[Array, Array]:
        figures = repeatability(t, shape.sizes, fitted=shape.fitted)
        sigma = jnp.maximum(figures.sigma, LEAST_SIGMA)
        spread = length_covariance(figures.centroids, _measurement(value, uncertainty, shape), sigma)
        return sigma, jnp.linalg.inv(jnp.linalg.cholesky(spread))

    return jax.vmap(weights)(_tips(part, turns, start, shape), part.nominal, part.u)
