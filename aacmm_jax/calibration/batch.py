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

from ..core.arguments import check_finite, checked_arguments, items_of
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import check_joints
from ..solver.reason import reasons
from .batch_kernel import Problems, Shape, solve_chunk
from .checks import based_on, check_enough
from .results import ManyCalibrations, ManyIdentifications
from .scale_anchor import ScaleAnchor, scale_anchor
from .second_stage import divide_by_k, rows_of, second_stage_many

# Slots per loop. On a CPU the Jacobian columns of all slots should fit the second-level cache (measured from 20 to
# 7,000 poses: five times slower where they do not); a GPU needs thousands.
_SLOTS_CPU, _POSES_IN_CACHE = 16, 2000
_SLOTS_ELSEWHERE = 4096
_ROUNDS = 64  # problems that a slot of one chunk takes at most, one after the other


@checked_arguments
def identify_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    *,
    space: Parameters | None = None,
    hold: str | None = "longest",
    noise: Noise | None = None,
    max_steps: int = 300,
    chunk: int | None = None,
    slots: int | None = None,
    devices: Sequence[Any] | None = None,
    workers: int | None = None,
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
    _check_known("identify", arm, capture, lower, upper, start)
    lower, upper, space = _bounds_and_space(arm, lower, upper, space)
    effort = Effort(max_steps, chunk, slots, devices, workers)
    return BatchTask.of(arm, capture, lower, upper, start, space, hold, noise, effort).identified()


@checked_arguments
def calibrate_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    *,
    method: Literal["two-stage", "joint"] = "two-stage",
    space: Parameters | None = None,
    hold: str | None = "longest",
    noise: Noise | None = None,
    max_steps: int = 300,
    chunk: int | None = None,
    slots: int | None = None,
    devices: Sequence[Any] | None = None,
    workers: int | None = None,
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
    if method not in ("two-stage", "joint"):
        raise InputError(f"method is '{method}'; it must be 'two-stage' or 'joint'.")
    if not capture.lengths:
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one, or use identify_many."
        )
    _check_known("calibrate", arm, capture, lower, upper, start)
    lower, upper, space = _bounds_and_space(arm, lower, upper, space)
    effort = Effort(max_steps, chunk, slots, devices, workers)
    return calibrated(BatchTask.of(arm, capture, lower, upper, start, space, hold, noise, effort), method)


def calibrated(task: "BatchTask", method: str) -> ManyCalibrations:
    """`calibrate_many` for a batch that is checked."""
    stage1 = task.identified()
    assert stage1.k is not None
    if method == "two-stage":
        found = second_stage_many(task.anchor, stage1, task.identified_again)
        return ManyCalibrations(k=stage1.k, stage1=stage1, method=method, **found)
    scaled = divide_by_k(task.anchor, stage1.space, stage1.parameters, stage1.k)
    joint = task.repeated(task.arm, task.capture, stage1.bounds, scaled, None, stage1.sigma / stage1.k).identified()
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


def _check_known(single: str, *trees: Any) -> None:
    """Raise `InputError` inside jit, vmap and derivatives: a batch is distributed over threads by its values."""
    if not is_concrete(*jax.tree.leaves(trees)):
        raise InputError(
            f"{single}_many needs known values, but is called inside jit, vmap or a derivative; call it outside, "
            f"or use jax.vmap of {single} there."
        )


def _bounds_and_space(
    arm: Arm, lower: Bounds | Numbers, upper: Numbers | None, space: Parameters | None
) -> tuple[Numbers, Numbers, Parameters]:
    """Bounds as arrays and the free parameters, from `Bounds` or from arrays."""
    if isinstance(lower, Bounds):
        for what, given in (("upper bounds", upper), ("a space", space)):
            if given is not None:
                raise InputError(
                    f"Bounds are given, and {what} as well, which they hold already; leave one out (a start goes by "
                    "its name: start=...)."
                )
        return lower.lower, lower.upper, lower.space
    if upper is None:
        raise InputError("lower bounds are given without upper ones; give both, or Bounds, which hold both.")
    return lower, upper, Parameters.free_of(arm) if space is None else space


class Effort(NamedTuple):
    """How much is computed at a time, and where."""

    max_steps: int = 300
    chunk: int | None = None
    slots: int | None = None
    devices: Sequence[Any] | None = None
    workers: int | None = None


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
    noise: Noise | None
    effort: Effort

    @classmethod
    def of(
        cls,
        arm: Arm,
        capture: Capture,
        lower: Numbers,
        upper: Numbers,
        start: Numbers | None,
        space: Parameters,
        hold: str | ScaleAnchor | None,
        noise: Noise | None,
        effort: Effort,
        sigma: Float[np.ndarray, " b"] | None = None,
    ) -> "BatchTask":
        """Everything checked and laid out. ``hold`` may be an anchor that is known; ``sigma`` is of a joint solve, see
        `Problems`."""
        problems, batched, size = _problems(arm, capture, lower, upper, start, space, sigma)
        anchor = hold if isinstance(hold, ScaleAnchor) else scale_anchor(space, arm, hold, noise)
        check_joints(capture, space)
        if noise is not None:
            check_finite(noise=noise)
            noise.check(arm.joints)
        check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
        for what in ("max_steps", "chunk", "slots", "workers"):
            number = getattr(effort, what)
            if number is not None and number < 1:
                raise InputError(f"{what} is {number}; give at least 1, or leave it out.")
        devices = jax.local_devices() if effort.devices is None else items_of(effort.devices, "devices")
        if not devices:
            raise InputError("devices is empty; name at least one, or leave it out.")
        slots = effort.slots or _slots(devices, sum(capture.sizes))
        workers = effort.workers or _workers(devices)
        chunks = _chunks(size, slots, workers, effort.chunk)
        shape = Shape(
            sizes=capture.sizes,
            ends=tuple((int(a), int(b)) for a, b in capture.ends()),
            indices=space.indices(),
            solved=tuple(name != anchor.hold for name in space.names),
            scale=tuple(np.asarray(space.scale).tolist()),
            batched=batched,
            slots=slots,
            max_steps=effort.max_steps,
        )
        capacity = _capacity(max(map(len, chunks)), slots)
        space = based_on(space, arm)
        return cls(arm, capture, problems, shape, chunks, capacity, devices, workers, space, anchor, noise, effort)

    def repeated(
        self,
        arm: Arm,
        capture: Capture,
        bounds: Bounds,
        start: np.ndarray,
        hold: str | None,
        sigma: Float[np.ndarray, " b"] | None = None,
    ) -> "BatchTask":
        """Another solve of the same batch, or of a part of it, from another start and with another anchor."""
        anchor = self.anchor._replace(hold=hold)
        lower, upper = np.asarray(bounds.lower), np.asarray(bounds.upper)
        return BatchTask.of(arm, capture, lower, upper, start, self.space, anchor, self.noise, self.effort, sigma)

    def identified_again(self, rows: np.ndarray, start: np.ndarray, hold: str | None) -> ManyIdentifications:
        """Stage 1 of some of the problems, with another anchor."""
        problems = self.problems
        arm, capture, lower, upper = rows_of(rows, self.arm, self.capture, problems.lower, problems.upper)
        bounds = Bounds(self.space, lower, upper)
        again = self.repeated(arm, capture, bounds, start, hold)
        # Of the capacity of the whole batch, whatever the number of problems: one compiled program for all of them.
        return again._replace(capacity=max(again.capacity, self.capacity)).identified()

    def run(self, chunk: range, device: Any) -> tuple[np.ndarray, ...]:
        """Solve one chunk, filled up to the capacity with copies of its first problem, which are never begun."""
        rows = np.full(self.capacity, chunk.start)
        rows[: len(chunk)] = chunk
        part = jax.tree.map(lambda leaf, many: leaf[rows] if many else leaf, self.problems, self.shape.batched)
        with jax.default_device(device):
            given = jax.device_put((part, np.asarray(len(chunk)), self.noise), device)
            solved = solve_chunk(*given, self.shape, self.capacity)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chunk)], solved)

    def identified(self) -> ManyIdentifications:
        """All chunks solved."""
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


def _slots(devices: Sequence[Any], poses: int) -> int:
    if devices[0].platform != "cpu":
        return _SLOTS_ELSEWHERE
    return min(_SLOTS_CPU, 2 ** max(round(math.log2(_POSES_IN_CACHE / poses)), 0))


def _workers(devices: Sequence[Any]) -> int:
    """Chunks in work at the same time: one for each device; on a CPU, one for each core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return len(devices) if devices[0].platform != "cpu" else max(len(devices), cores)


def _chunks(size: int, slots: int, workers: int, chunk: int | None) -> list[range]:
    """The batch in chunks: of the given size, or as few as keep all workers busy, since slots idle at the end of
    each."""
    if chunk is None:
        rounds = -(-size // (slots * _ROUNDS))
        calls = min(-(-rounds // workers) * workers, -(-size // slots))
        chunk = -(-size // calls)
    return [range(first, min(first + chunk, size)) for first in range(0, size, chunk)]


def _capacity(count: int, slots: int) -> int:
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


def _problems(
    arm: Arm,
    capture: Capture,
    lower: Numbers,
    upper: Numbers,
    start: Numbers | None,
    space: Parameters,
    sigma: Float[np.ndarray, " b"] | None,
) -> tuple[Problems, Problems, int]:
    """The batch on the host, which leaves are batched, and its size. Raises `InputError` where shapes do not fit."""
    p = len(space.names)
    given = {"start": space.vector(arm) if start is None else start, "lower": lower, "upper": upper}
    boxes = {what: np.asarray(as_array(value, what)) for what, value in given.items()}
    for what, value in boxes.items():
        if value.ndim not in (1, 2) or value.shape[-1] != p:
            raise InputError(
                f"{what} has shape {value.shape}; give ({p},) or (batch, {p}), since {p} parameters are free."
            )
    if arm.beta is None and space.base.beta is not None:
        arm = arm.replace(beta=jnp.zeros_like(arm.alpha))
    lengths = [[np.asarray(getattr(r, key)) for r in capture.lengths] for key in ("value", "u")]
    nominal, u = (np.stack(values, axis=-1) if values else np.zeros(0) for values in lengths)
    geometry = jax.tree.map(np.asarray, arm.geometry)
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
