"""Stage 1 for many problems at once (`identify_many`): the engine under every Monte Carlo study.

A chunk of problems is worked off by a fixed number of lanes. Every pass of the loop evaluates and advances all lanes; a
lane whose problem has ended writes its result and takes the next problem of the chunk, so no problem waits for another.
The number of lanes, not the chunk, fixes the arithmetic: results are the same to the bit whatever the chunk.
"""

import math
import os
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .arm import Arm, replace
from .arrays import Numbers, as_array
from .calibrate import SOLVER, converged
from .capture import Capture
from .chain import Geometry, Turns, turns_of, walk
from .checks import check_enough, check_fit, held_length
from .errors import InputError
from .metrics import repeatability
from .parameters import Parameters, placed
from .residuals import Measurement, model_of
from .scale import scale_of
from .steps import Box, Reason, advance, begin, choose, either, numbers_of, reasons

# Lanes per loop. On a CPU the columns of all lanes should fit the second-level cache (measured from 20 to 7,000 poses: five
# times slower where they do not); a GPU wants thousands.
_LANES_CPU, _POSES_IN_CACHE = 16, 2000
_LANES_ELSEWHERE = 4096
_ROUNDS = 64  # problems a lane of one chunk takes at most, one after the other


class ManyIdentifications(eqx.Module):
    """Results of stage 1, problem by problem, as NumPy arrays; ``parameters`` in the order of ``space.names``, mm and rad."""

    parameters: Float[np.ndarray, "b p"]
    de: Float[np.ndarray, " b"]  # mm
    deltam: Float[np.ndarray, " b"]  # mm
    k: Float[np.ndarray, " b"] | None  # measured / nominal, where the capture holds reference lengths
    steps: Int[np.ndarray, " b"]  # evaluations
    result: Reason  # why each ended
    active: Int[np.ndarray, "b p"]  # -1 on the lower bound, +1 on the upper, 0 inside or held
    space: Parameters
    hold: str | None = eqx.field(static=True)

    @property
    def converged(self) -> Bool[np.ndarray, " b"]:
        """Which problems ended at a minimum."""
        return np.asarray(converged(self.result))


class _Problems(NamedTuple):
    """What may differ from problem to problem; a leaf either has the batch axis first, or is shared by all."""

    start: Any  # (p,)
    lower: Any  # (p,)
    upper: Any  # (p,)
    geometry: Any  # `Geometry` with (n,) leaves
    q: Any  # (N, n)
    nominal: Any  # (l,)
    u: Any  # (l,)


class _Shape(NamedTuple):
    """What is the same for all problems and fixes the compiled program."""

    sizes: tuple[int, ...]
    ends: tuple[tuple[int, int], ...]
    entries: tuple[tuple[str, int], ...]
    kept: tuple[bool, ...]  # False for the length held in stage 1
    scale: tuple[float, ...]
    batched: _Problems  # booleans
    lanes: int
    max_steps: int


class _Ended(NamedTuple):
    """What one ended problem leaves."""

    parameters: Float[Array, "b p"]
    steps: Int[Array, " b"]
    reason: Reason


def identify_many(
    arm: Arm,
    capture: Capture,
    lower: Numbers,
    upper: Numbers,
    start: Numbers | None = None,
    *,
    space: Parameters | None = None,
    hold: str | None = "longest",
    max_steps: int = 300,
    chunk: int | None = None,
    lanes: int | None = None,
    devices: Sequence[Any] | None = None,
) -> ManyIdentifications:
    """Stage 1 for a batch: what `identify` does, problem by problem, fast.

    ``lower``, ``upper`` and ``start`` are ``(batch, p)`` or ``(p,)``, in the order of ``space.names`` (default: the paper's
    parameters of ``arm``); ``start`` defaults to the arm. ``arm`` may be a batch (every parameter ``(batch, n)``), and so
    may the capture (see `stack_captures`).

    Work is spread over all devices and, on a CPU, all cores; memory is bounded by the ``chunk`` (problems per call of the
    compiled program). Failure is data (``result``);
    a start outside its box is clipped to it. Raises `InputError` for
    shapes that do not fit, a lower bound above its upper one, and too few poses.
    """
    if space is None:
        space = Parameters.free_of(arm)
    problems, batched, size = _problems(arm, capture, lower, upper, start, space)
    hold = held_length(space, arm, hold)
    check_fit(capture, space)
    check_enough(capture, len(space.names) - int(space.lengths.any()))
    for what, number in (("chunk", chunk), ("lanes", lanes)):
        if number is not None and number < 1:
            raise InputError(f"{what} is {number}; give at least 1, or leave it out.")
    devices = jax.local_devices() if devices is None else list(devices)
    lanes = lanes or _lanes(devices, sum(capture.sizes))
    workers = _workers(devices)
    pieces = _pieces(size, lanes, workers, chunk)
    shape = _Shape(
        sizes=capture.sizes,
        ends=tuple((int(a), int(b)) for a, b in capture.ends()),
        entries=space.entries(),
        kept=tuple(name != hold for name in space.names),
        scale=tuple(np.asarray(space.scale).tolist()),
        batched=batched,
        lanes=lanes,
        max_steps=max_steps,
    )
    work = _Work(problems, shape, _room(max(len(piece) for piece in pieces), lanes))
    return _assemble(_spread(work.run, pieces, devices, workers), space, hold, bool(capture.lengths))


def stack_captures(captures: Iterable[Capture]) -> Capture:
    """A batch of captures of the same shape (sockets, poses, lengths) for `identify_many`."""
    captures = list(captures)
    if len({(c.names, c.sizes, tuple((r.start, r.end) for r in c.lengths), c.joints) for c in captures}) != 1:
        raise InputError("captures of a batch must have the same sockets, numbers of poses, joints and lengths.")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *captures)


class _Work(NamedTuple):
    """The whole batch on the host, and how a chunk of it is run on a device."""

    problems: _Problems
    shape: _Shape
    room: int  # problems that the compiled program has room for

    def run(self, piece: range, device: Any) -> tuple[np.ndarray, ...]:
        """Solve one chunk. What room is left is filled with its first problem, which is never begun."""
        rows = np.full(self.room, piece.start)
        rows[: len(piece)] = piece
        part = jax.tree.map(lambda leaf, many: leaf[rows] if many else leaf, self.problems, self.shape.batched)
        with jax.default_device(device):
            solved = _solve_chunk(*jax.device_put((part, np.asarray(len(piece))), device), self.shape, self.room)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(piece)], solved)


def _lanes(devices: Sequence[Any], poses: int) -> int:
    if devices[0].platform != "cpu":
        return _LANES_ELSEWHERE
    return min(_LANES_CPU, 2 ** max(round(math.log2(_POSES_IN_CACHE / poses)), 0))


def _workers(devices: Sequence[Any]) -> int:
    """Chunks in work at a time: one a device; on a CPU, one a core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return len(devices) if devices[0].platform != "cpu" else max(len(devices), cores)


def _pieces(size: int, lanes: int, workers: int, chunk: int | None) -> list[range]:
    """The batch in chunks: of the given size; or as few as fill the workers evenly, since at the end of each some lanes idle."""
    if chunk is None:
        rounds = -(-size // (lanes * _ROUNDS))
        calls = min(-(-rounds // workers) * workers, -(-size // lanes))
        chunk = -(-size // calls)
    return [range(first, min(first + chunk, size)) for first in range(0, size, chunk)]


def _room(count: int, lanes: int) -> int:
    """Whole rounds of the lanes, their number a power of two: each size is compiled once, so there should be few."""
    return lanes * 2 ** math.ceil(math.log2(-(-count // lanes)))


def _spread(run: Callable, pieces: Sequence[range], devices: Sequence[Any], workers: int) -> list:
    """Chunks over devices and cores, in their order. XLA leaves the interpreter's lock while it computes, so threads are enough.

    The calling thread is one of the workers, since a new one takes a millisecond to start. A worker keeps its device.
    """
    following, failed, found = iter(range(len(pieces))), threading.Event(), {}

    def work(worker: int) -> None:
        try:
            for i in following:
                if failed.is_set():
                    return
                found[i] = run(pieces[i], devices[worker % len(devices)])
        except BaseException:
            failed.set()
            raise

    with ThreadPoolExecutor(workers) as pool:
        others = [pool.submit(work, worker) for worker in range(1, min(workers, len(pieces)))]
        work(0)
        for other in others:
            other.result()
    return [found[i] for i in range(len(pieces))]


@partial(jax.jit, static_argnames=("shape", "room"))
def _solve_chunk(problems: _Problems, count: Int[Array, ""], shape: _Shape, room: int) -> tuple[Array, ...]:
    ended = _work_off(problems, shape, count, room)
    rounds = room // shape.lanes

    def grouped(leaf: Array, many: bool) -> Array:
        return leaf.reshape(rounds, shape.lanes, *leaf.shape[1:]) if many else leaf

    groups = jax.tree.map(grouped, problems, shape.batched)
    parameters = ended.parameters.reshape(rounds, shape.lanes, -1)

    def figures(row: Int[Array, ""]) -> tuple[Array, ...]:
        part = jax.tree.map(lambda leaf, many: leaf[row] if many else leaf, groups, shape.batched)
        return _figures(part, parameters[row], shape)

    de, deltam, k, active = jax.lax.map(figures, jnp.arange(rounds))
    flat = [leaf.reshape(room, *leaf.shape[2:]) for leaf in (de, deltam, k, active)]
    return (ended.parameters, *flat[:3], ended.steps, numbers_of(ended.reason), flat[3])


def _work_off(problems: _Problems, shape: _Shape, count: Int[Array, ""], room: int) -> _Ended:
    """The loop over lanes; every lane takes the next problem of the chunk when its own has ended."""
    kept = np.flatnonzero(shape.kept)
    turns = turns_of(problems.q)
    scale = jnp.asarray(np.asarray(shape.scale)[kept])

    def lane_values(leaf: Array, many: bool, index: Array) -> Array:
        return leaf[index] if many else jnp.broadcast_to(leaf, (shape.lanes, *leaf.shape))

    def starts(index: Array) -> tuple[Array, Box]:
        start, lower, upper = (
            lane_values(leaf, many, index)[:, kept] for leaf, many in zip(problems[:3], shape.batched[:3], strict=True)
        )
        return start, Box(lower, upper, jnp.broadcast_to(scale, start.shape))

    def evaluate(trial: Array, index: Array):
        held = lane_values(problems.start, shape.batched.start, index)
        vector = held.at[:, kept].set(trial)
        rows = jax.tree.map(lambda leaf, many: lane_values(leaf, many, index), problems.geometry, shape.batched.geometry)
        lane_turns: Turns = (turns[0][:, index], turns[1][:, index]) if shape.batched.q else turns
        entries = tuple(shape.entries[i] for i in kept)
        return model_of(_with_parameters(rows, vector, shape.entries), lane_turns, shape.sizes, entries)

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
        whole = lane_values(problems.start, shape.batched.start, now).at[:, kept].set(progress.y)
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


def _figures(part: _Problems, parameters: Float[Array, "w p"], shape: _Shape) -> tuple[Array, ...]:
    """DE, Deltam, k and active bounds of one group of lanes."""

    def lanes_of(leaf: Array, many: bool) -> Array:
        return leaf if many else jnp.broadcast_to(leaf, (shape.lanes, *leaf.shape))

    boxes = jax.tree.map(lanes_of, part[:4], shape.batched[:4])
    part = part._replace(start=boxes[0], lower=boxes[1], upper=boxes[2], geometry=boxes[3])
    tips = walk(_with_parameters(part.geometry, parameters, shape.entries), turns_of(part.q)).tip
    tips = jnp.swapaxes(tips, -1, -2)
    figures = jax.vmap(lambda t: repeatability(t, shape.sizes, fitted=sum(shape.kept)))(tips)
    k = jnp.ones(shape.lanes)
    if shape.ends:
        nominal, u = (lanes_of(leaf, many) for leaf, many in zip(part[5:], shape.batched[5:], strict=True))

        def scale(t: Array, value: Array, uncertainty: Array, sigma: Array) -> Array:
            empty = jnp.zeros((t.shape[0], 1))
            measurement = Measurement(empty, turns_of(empty), value, uncertainty, shape.sizes, shape.ends)
            return scale_of(t, measurement, sigma).value

        k = jax.vmap(scale)(tips, nominal, u, figures.sigma)
    side = jnp.where(parameters <= part.lower, -1, jnp.where(parameters >= part.upper, 1, 0))
    return figures.de, figures.deltam, k, jnp.where(jnp.asarray(shape.kept)[None], side, 0)


def _problems(
    arm: Arm, capture: Capture, lower: Numbers, upper: Numbers, start: Numbers | None, space: Parameters
) -> tuple[_Problems, _Problems, int]:
    """The batch on the host, which leaves are batched, and its size. Raises `InputError` where shapes do not fit."""
    p = len(space.names)
    given = {"start": space.vector(arm) if start is None else start, "lower": lower, "upper": upper}
    boxes = {what: np.asarray(as_array(value, what)) for what, value in given.items()}
    for what, value in boxes.items():
        if value.ndim not in (1, 2) or value.shape[-1] != p:
            raise InputError(f"{what} has shape {value.shape}; give ({p},) or (batch, {p}), since {p} parameters are free.")
    if arm.beta is None and space.base.beta is not None:
        arm = replace(arm, beta=jnp.zeros_like(arm.alpha))
    lengths = [[np.asarray(getattr(r, key)) for r in capture.lengths] for key in ("value", "u")]
    nominal, u = (np.stack(values, axis=-1) if values else np.zeros(0) for values in lengths)
    geometry = jax.tree.map(np.asarray, arm.geometry)
    problems = _Problems(boxes["start"], boxes["lower"], boxes["upper"], geometry, np.asarray(capture.q), nominal, u)
    ranks = _Problems(1, 1, 1, jax.tree.map(lambda _: 1, geometry), 2, 1, 1)
    batched = jax.tree.map(lambda leaf, rank: leaf.ndim > rank, problems, ranks)
    sizes = {leaf.shape[0] for leaf, many in zip(jax.tree.leaves(problems), jax.tree.leaves(batched), strict=True) if many}
    if not sizes:
        raise InputError(
            "nothing is a batch: give start, lower or upper as (batch, p), a batch of arms or of captures; or use identify."
        )
    if sizes == {0}:
        raise InputError("the batch is empty; give at least one problem.")
    if len(sizes) > 1:
        numbers = " and ".join(map(str, sorted(sizes)))
        raise InputError(f"batches of {numbers} problems do not fit together; give each the same number.")
    crossed = np.argwhere(~(np.atleast_2d(boxes["lower"]) <= np.atleast_2d(boxes["upper"])))
    if len(crossed):
        row, i = crossed[0]
        raise InputError(
            f"lower bound of {space.names[i]} is above its upper bound in problem {row + 1}; exchange or widen them."
        )
    return problems, batched, sizes.pop()


def _assemble(pieces: list, space: Parameters, hold: str | None, has_lengths: bool) -> ManyIdentifications:
    parameters, de, deltam, k, steps, reason, active = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return ManyIdentifications(
        parameters, de, deltam, k if has_lengths else None, steps, reasons(jnp.asarray(reason)), active, space, hold
    )
