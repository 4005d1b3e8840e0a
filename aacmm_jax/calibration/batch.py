"""Thousands of calibrations at once (`identify_many`, `calibrate_many`), which every Monte Carlo study uses.

The batch is cut into chunks, which are distributed over devices and cores; `batch_kernel` solves a chunk.
"""

import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from queue import Empty, SimpleQueue
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments, items_of, shown, with_options
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..data.capture import Capture, check_sockets_only
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import check_joints
from ..solver.reason import reasons
from .batch_kernel import Problems, Shape, solve_chunk
from .checks import based_on, check_enough
from .results import ManyCalibrations, ManyIdentifications
from .scale_anchor import ScaleAnchor, scale_anchor
from .second_stage import divide_by_k, fix_scale_many, select_problems

# Slots per loop. On a CPU the Jacobian columns of all slots should fit the second-level cache (measured from 20 to
# 7,000 poses: five times slower where they do not); a GPU needs thousands.
_SLOTS_CPU, _POSES_IN_CACHE = 16, 2000
_SLOTS_ELSEWHERE = 4096
_ROUNDS = 64  # problems that a slot of one chunk takes at most, one after the other


class BatchOptions(NamedTuple):
    """The keyword arguments that `identify_many` and `calibrate_many` share; described there."""

    space: Parameters | None = None
    hold: str | None = "longest"
    noise: Noise | None = None
    max_steps: int = 300
    chunk: int | None = None
    slots: int | None = None
    devices: Sequence[Any] | None = None
    workers: int | None = None


@checked_arguments
@with_options(BatchOptions)
def identify_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    **options: Any,
) -> ManyIdentifications:
    """Stage 1 for a batch: what `identify` does, problem by problem, fast.

    Memory is bounded by ``chunk``. Failure is data (``result``).

    Args:
        arm: The nominal arm, or a batch of arms (every parameter ``(batch, n)``).
        capture: The readings, or a batch of them (see `stack_captures`).
        lower: `Bounds`, whose space is then used; or lower bounds, ``(batch, p)`` or ``(p,)``, mm and rad, in the order
            of ``space.names``.
        upper: Upper bounds, likewise; left out where ``lower`` is `Bounds`.
        start: Starts, likewise, clipped to the bounds, that of the scale anchor too; by default the arm.
        space: The free parameters where bounds are arrays; by default the paper's of ``arm``.
        hold: The scale anchor, as in `identify`.
        noise: Weights poses, as in `identify`.
        max_steps: The largest number of evaluations of one problem.
        chunk: Problems in one call of the compiled program.
        slots: Problems in work at the same time in one call.
        devices: The devices to use; by default all.
        workers: Threads; by default one for each device or, on a CPU, for each core.

    Returns:
        Parameters, metrics and reasons, problem by problem.

    Raises:
        InputError: For shapes that do not fit, a lower bound above its upper one, and too few poses.
    """
    return _batch_task("identify", arm, capture, lower, upper, start, BatchOptions(**options)).identify()


@checked_arguments
@with_options(BatchOptions)
def calibrate_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    *,
    method: Literal["two-stage", "joint"] = "two-stage",
    **options: Any,
) -> ManyCalibrations:
    """Both stages for a batch: what `calibrate` does, problem by problem, fast.

    Args:
        arm: As for `identify_many`, like all arguments that are not named here.
        capture: Readings and at least one reference length.
        method: "two-stage" or "joint", as in `calibrate`.

    Returns:
        Parameters, scale, metrics and reasons, problem by problem.

    Raises:
        InputError: As `identify_many`, and where the capture holds no reference length.
    """
    if not isinstance(method, str) or method not in ("two-stage", "joint"):
        raise InputError(f"method is {shown(method)}; it must be 'two-stage' or 'joint'.")
    if not capture.lengths:
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one, or use identify_many."
        )
    return _batch_task("calibrate", arm, capture, lower, upper, start, BatchOptions(**options)).calibrate(method)


def _batch_task(
    single: str,
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None,
    start: Numbers | None,
    options: BatchOptions,
) -> "BatchTask":
    """The task that a user's arguments state; ``single`` is the function that solves one problem."""
    # A batch is distributed over threads by its values, so that it cannot be traced.
    check_sockets_only(capture, "a batch")
    if not is_concrete(*jax.tree.leaves((arm, capture, lower, upper, start))):
        raise InputError(
            f"{single}_many needs known values, but is called inside jit, vmap or a derivative; call it outside, "
            f"or use jax.vmap of {single} there."
        )
    if isinstance(lower, Bounds):
        for what, given in (("upper bounds", upper), ("a space", options.space)):
            if given is not None:
                raise InputError(
                    f"Bounds are given, and {what} as well, which they hold already; leave one out (a start goes by "
                    "its name: start=...)."
                )
        bounds, space = (lower.lower, lower.upper), lower.space
    elif upper is None:
        raise InputError("lower bounds are given without upper ones; give both, or Bounds, which hold both.")
    else:
        bounds, space = (lower, upper), Parameters.free_of(arm) if options.space is None else options.space
    return BatchTask.of(arm, capture, bounds, start, space, options)


class BatchTask(NamedTuple):
    """A batch of identifications, checked: the problems on the host, and how a chunk of them is run on a device."""

    arm: Arm
    capture: Capture
    problems: Problems
    shape: Shape
    chunks: list[range]
    capacity: int  # problems of one call of the compiled program
    devices: list[Any]
    workers: int
    space: Parameters
    anchor: ScaleAnchor
    options: BatchOptions

    @classmethod
    def of(
        cls,
        arm: Arm,
        capture: Capture,
        bounds: tuple[Numbers, Numbers],
        start: Numbers | None,
        space: Parameters,
        options: BatchOptions,
        anchor: ScaleAnchor | None = None,
        sigma: Float[np.ndarray, " b"] | None = None,
    ) -> "BatchTask":
        """Everything checked and laid out. ``anchor`` is one that is known; ``sigma`` is of a joint solve, see
        `Problems`."""
        problems, batched, size = _lay_out(arm, capture, bounds, start, space, sigma)
        anchor = scale_anchor(space, arm, options.hold, options.noise) if anchor is None else anchor
        check_joints(capture, space)
        if options.noise is not None:
            check_finite(noise=options.noise)
            options.noise.check(arm.joints)
        check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
        for what in ("max_steps", "chunk", "slots", "workers"):
            number = getattr(options, what)
            if number is not None and number < 1:
                raise InputError(f"{what} is {number}; give at least 1, or leave it out.")
        devices = jax.local_devices() if options.devices is None else items_of(options.devices, "devices")
        if not devices:
            raise InputError("devices is empty; name at least one, or leave it out.")
        slots = options.slots or _default_slots(devices, sum(capture.sizes))
        workers = options.workers or _default_workers(devices)
        chunks = _cut_into_chunks(size, slots, workers, options.chunk)
        shape = Shape(
            sizes=capture.sizes,
            ends=tuple((int(a), int(b)) for a, b in capture.ends()),
            indices=space.indices(),
            solved=tuple(name != anchor.hold for name in space.names),
            scale=tuple(np.asarray(space.scale).tolist()),
            batched=batched,
            slots=slots,
            max_steps=options.max_steps,
        )
        capacity = _round_up(max(map(len, chunks)), slots)
        space = based_on(space, arm)
        return cls(arm, capture, problems, shape, chunks, capacity, devices, workers, space, anchor, options)

    def identify(self) -> ManyIdentifications:
        """Stage 1 of all problems."""
        found = _run_chunks(self.run, self.chunks, self.devices, self.workers)
        parameters, de, deltam, sigma, k, steps, reason, active = (
            np.concatenate(column) for column in zip(*found, strict=True)
        )
        return ManyIdentifications(
            parameters=parameters,
            de=de,
            deltam=deltam,
            sigma=sigma,
            k=k if self.shape.ends else None,
            steps=steps,
            result=reasons(jnp.asarray(reason)),
            active=active,
            bounds=Bounds(self.space, self.problems.lower, self.problems.upper),
            anchor=self.anchor,
        )

    def calibrate(self, method: str) -> ManyCalibrations:
        """Both stages of all problems."""
        stage1 = self.identify()
        assert stage1.k is not None
        if method == "two-stage":
            found = fix_scale_many(self.anchor, stage1, self.identify_again)
            return ManyCalibrations(k=stage1.k, stage1=stage1, method=method, **found)
        scaled = divide_by_k(self.anchor, stage1.space, stage1.parameters, stage1.k)
        box = self.problems.lower, self.problems.upper
        joint = self.with_start(self.arm, self.capture, box, scaled, None, stage1.sigma / stage1.k).identify()
        return ManyCalibrations(
            parameters=joint.parameters,
            k=stage1.k,
            de=joint.de,
            deltam=joint.deltam,
            steps=stage1.steps + joint.steps,
            result=joint.result,
            active=joint.active,
            stage1=stage1,
            method=method,
        )

    def identify_again(self, rows: np.ndarray, start: np.ndarray, hold: str | None) -> ManyIdentifications:
        """Stage 1 of some of the problems, from another start and with another anchor."""
        problems = self.problems
        arm, capture, *box = select_problems(rows, self.arm, self.capture, problems.lower, problems.upper)
        again = self.with_start(arm, capture, (box[0], box[1]), start, hold)
        # Of the capacity of the whole batch, whatever the number of problems: one compiled program for all of them.
        return again._replace(capacity=max(again.capacity, self.capacity)).identify()

    def with_start(
        self,
        arm: Arm,
        capture: Capture,
        bounds: tuple[np.ndarray, np.ndarray],
        start: np.ndarray,
        hold: str | None,
        sigma: Float[np.ndarray, " b"] | None = None,
    ) -> "BatchTask":
        """The task for the same batch, or for a part of it, from another start and with another anchor."""
        anchor = self.anchor._replace(hold=hold)
        return BatchTask.of(arm, capture, bounds, start, self.space, self.options, anchor, sigma)

    def run(self, chunk: range, device: Any) -> tuple[np.ndarray, ...]:
        """Solve one chunk, filled up to the capacity with copies of its first problem, which are never begun."""
        rows = np.full(self.capacity, chunk.start)
        rows[: len(chunk)] = chunk
        part = jax.tree.map(lambda leaf, many: leaf[rows] if many else leaf, self.problems, self.shape.batched)
        with jax.default_device(device):
            given = jax.device_put((part, np.asarray(len(chunk)), self.options.noise), device)
            solved = solve_chunk(*given, self.shape, self.capacity)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chunk)], solved)


def _default_slots(devices: Sequence[Any], poses: int) -> int:
    if devices[0].platform != "cpu":
        return _SLOTS_ELSEWHERE
    return min(_SLOTS_CPU, 2 ** max(round(math.log2(_POSES_IN_CACHE / poses)), 0))


def _default_workers(devices: Sequence[Any]) -> int:
    """Chunks in work at the same time: one for each device; on a CPU, one for each core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return len(devices) if devices[0].platform != "cpu" else max(len(devices), cores)


def _cut_into_chunks(size: int, slots: int, workers: int, chunk: int | None) -> list[range]:
    """The batch in chunks: of the given size, or as few as keep all workers busy, since slots idle at the end of
    each."""
    if chunk is None:
        rounds = -(-size // (slots * _ROUNDS))
        calls = min(-(-rounds // workers) * workers, -(-size // slots))
        chunk = -(-size // calls)
    return [range(first, min(first + chunk, size)) for first in range(0, size, chunk)]


def _round_up(count: int, slots: int) -> int:
    """Whole rounds of the slots, their number a power of two: each size is compiled once, so there should be few."""
    return slots * 2 ** math.ceil(math.log2(-(-count // slots)))


def _run_chunks(run: Callable, chunks: Sequence[range], devices: Sequence[Any], workers: int) -> list:
    """Results of all chunks in their order, computed by threads: XLA releases the interpreter's lock while it computes.

    The calling thread is one of the workers, since a new one takes a millisecond to start. A worker keeps its device.
    """
    # A queue and not a shared iterator, which two threads may advance at once where Python runs without its lock.
    numbers: SimpleQueue[int] = SimpleQueue()
    for i in range(len(chunks)):
        numbers.put(i)
    failed = threading.Event()
    results: list[Any] = [None] * len(chunks)

    def work(worker: int) -> None:
        while not failed.is_set():
            try:
                i = numbers.get_nowait()
            except Empty:
                return
            try:
                results[i] = run(chunks[i], devices[worker % len(devices)])
            except BaseException:
                failed.set()
                raise

    with ThreadPoolExecutor(workers) as pool:
        others = [pool.submit(work, worker) for worker in range(1, min(workers, len(chunks)))]
        work(0)
        for other in others:
            other.result()
    return results


def _lay_out(
    arm: Arm,
    capture: Capture,
    bounds: tuple[Numbers, Numbers],
    start: Numbers | None,
    space: Parameters,
    sigma: Float[np.ndarray, " b"] | None,
) -> tuple[Problems, Problems, int]:
    """The batch on the host, which leaves are batched, and its size. Raises `InputError` where shapes do not fit."""
    p = len(space.names)
    given = {"start": space.vector(arm) if start is None else start, "lower": bounds[0], "upper": bounds[1]}
    boxes = {what: np.asarray(as_array(value, what)) for what, value in given.items()}
    for what, value in boxes.items():
        if value.ndim not in (1, 2) or value.shape[-1] != p:
            raise InputError(
                f"{what} has shape {value.shape}; give ({p},) or (batch, {p}), since {p} parameters are free."
            )
    lengths = [[np.asarray(getattr(r, key)) for r in capture.lengths] for key in ("value", "u")]
    nominal, u = (np.stack(values, axis=-1) if values else np.zeros(0) for values in lengths)
    geometry = jax.tree.map(np.asarray, based_on(space, arm).base.geometry)
    q = np.asarray(capture.q)
    problems = Problems(boxes["start"], boxes["lower"], boxes["upper"], geometry, q, nominal, u, sigma)
    ranks = Problems(1, 1, 1, jax.tree.map(lambda _: 1, geometry), 2, 1, 1, None if sigma is None else 0)
    batched = jax.tree.map(lambda leaf, rank: leaf.ndim > rank, problems, ranks)
    sizes = {
        leaf.shape[0] for leaf, many in zip(jax.tree.leaves(problems), jax.tree.leaves(batched), strict=True) if many
    }
    if not sizes:
        raise InputError(
            "nothing is a batch: give start, lower or upper as (batch, p), a batch of arms or of captures; or use "
            "identify."
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
    if sigma is None:  # the joint solve is weighted in the arm that it starts from, wherever that is
        start = np.clip(boxes["start"], boxes["lower"], boxes["upper"])
        problems, batched = problems._replace(start=start), batched._replace(start=start.ndim > 1)
    return problems, batched, sizes.pop()
