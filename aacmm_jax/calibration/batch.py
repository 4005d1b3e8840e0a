"""Thousands of calibrations at once (`identify_many`, `calibrate_many`), which every Monte Carlo study uses.

The batch is cut into chunks, which threads compute on the machine's cores or devices; `batch_kernel` solves a chunk.
"""

import dataclasses
import math
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import Count, check_finite, checked_arguments, items_of, with_options
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import to_jax, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm, check_columns
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.observed import Observed
from ..model.robust import Loss
from ..solver.reason import numbers_of, reasons
from .batch_kernel import Form, Problems, selected, solve_chunk
from .results import ManyCalibrations, ManyIdentifications
from .scale_anchor import Method, method_of
from .stages import divided
from .task import Solving, anchor_of, check_data, checked_noise_model, configurations, without_lengths

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
    max_steps: Count = 300
    chunk: Count | None = None
    slots: Count | None = None
    devices: Sequence[Any] | None = None
    workers: Count | None = None
    robust: LossName | None = None
    prior: Prior | None = None
    covariance: bool = False

    @property
    def solving(self) -> Solving:
        """How each problem is solved."""
        return Solving(**{name: value for name, value in self._asdict().items() if name in Solving._fields})


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
        robust: A robust loss, as in `identify`.
        prior: What is known of the parameters, as in `identify`; where no mean is given, that of each problem's arm.
        covariance: Whether the covariances of the parameters are computed too: of captures with observations besides
            sockets, and of robust or joint solves or those with a prior. They are by the noise alone: a batch looks
            for no encoder that is noisier than the others and for no shared errors, as `calibrate` does.

    Returns:
        Parameters, metrics and reasons, problem by problem.

    Raises:
        InputError: For shapes that do not fit, a lower bound above its upper one, and too few poses.

    Example:
        >>> boxes = [aj.Bounds.around(arm, space, length=half, angle=0.0175) for half in (2.0, 5.0, 10.0)]
        >>> many = aj.identify_many(arm, capture, [box.lower for box in boxes], [box.upper for box in boxes])
        >>> print(many.de.round(4), many.converged)
        [0.0124 0.0124 0.0124] [ True  True  True]
    """
    given = BatchOptions(**options)
    problems, space, size = _laid_out("identify", arm, capture, lower, upper, start, given)
    return _Batch(problems, _form(problems, space, given, False), size, space, given).identify()


@checked_arguments
@with_options(BatchOptions)
def calibrate_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    *,
    method: Method | None = None,
    **options: Any,
) -> ManyCalibrations:
    """Both stages for a batch: what `calibrate` does, problem by problem, fast.

    Args:
        arm: As for `identify_many`, like all arguments that are not named here.
        capture: Readings and at least one reference length, another observation that fixes the scale, or slides of
            prismatic joints that do.
        method: "two-stage" or "joint", as in `calibrate`; with ``covariance`` it is joint.

    Returns:
        Parameters, scale, metrics and reasons, problem by problem; mm and rad.

    Raises:
        InputError: As `identify_many`, and where nothing fixes the scale.

    Example:
        >>> drawn = [aj.simulate(true, four, poses=10, lengths=bars, noise=noise, seed=seed) for seed in (1, 2)]
        >>> many = aj.calibrate_many(arm, aj.stack_captures(drawn), bounds)
        >>> print(many.k.round(5), many.converged)
        [0.99924 0.99922] [ True  True]
    """
    given = BatchOptions(**options)
    problems, space, size = _laid_out("calibrate", arm, capture, lower, upper, start, given)
    at_once = given.covariance or given.solving.all_at_once
    method, at_once = method_of(arm, capture, space, given.noise, method, at_once)
    given = given._replace(hold=None) if at_once else given._replace(covariance=False)
    batch = _Batch(problems, _form(problems, space, given, at_once), size, space, given)
    stage1 = batch.identify()
    if at_once:
        return _of_joint(stage1, stage1, None)
    # Stage 1 divided by k, and solved at once where something stands against that, or all with "joint".
    assert stage1.k is not None
    anchor, shape = batch.form.anchor, stage1.parameters.shape
    bounds = Bounds(space, *(np.broadcast_to(side, shape) for side in (stage1.bounds.lower, stage1.bounds.upper)))
    parameters, against = divided(anchor, bounds, stage1.active, stage1.parameters, stage1.k)
    # Rows are contiguous, so that what is summed over one is summed in the same order in every batch.
    parameters = np.array(parameters, order="C")
    if method == "joint":
        joint = _of_joint(batch.jointly(np.arange(len(parameters)), parameters), stage1, stage1.k)
        return dataclasses.replace(joint, steps=stage1.steps + joint.steps)
    # Divided by k, the whole arm shrinks about the base, and so do the distances between its tips.
    factor = stage1.k if anchor.can_scale else np.ones_like(stage1.k)
    columns = {
        "parameters": parameters,
        "de": stage1.de / factor,
        "deltam": stage1.deltam / factor,
        "steps": np.array(stage1.steps),
        "active": np.array(bounds.active(parameters) if anchor.can_scale else stage1.active),
    }
    reason, rows = np.array(numbers_of(stage1.result)), np.flatnonzero(against)
    if len(rows):
        many = batch.jointly(rows, parameters[rows])
        for name in ("parameters", "de", "deltam", "active"):
            columns[name][rows] = getattr(many, name)
        columns["steps"][rows] += many.steps
        reason[rows] = numbers_of(many.result)
    result, is_divided = to_jax(reasons(reason)), ~np.asarray(against)
    return ManyCalibrations(k=stage1.k, result=result, stage1=stage1, method=method, divided=is_divided, **columns)


def _of_joint(
    many: ManyIdentifications, stage1: ManyIdentifications, k: Float[np.ndarray, " b"] | None
) -> ManyCalibrations:
    names = ("parameters", "de", "deltam", "steps", "result", "active", "covariance", "reduced_chi", "prior")
    fields = {name: getattr(many, name) for name in names}
    return ManyCalibrations(k=k, stage1=stage1, method="joint", divided=np.zeros(len(many.de), dtype=bool), **fields)


def _laid_out(
    single: str,
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None,
    start: Numbers | None,
    options: BatchOptions,
) -> tuple[Problems, Parameters, int]:
    """The problems, their free parameters and their number; checked. ``single`` solves one of them."""
    # A batch is distributed over threads by its values, so that it cannot be traced.
    if not is_concrete(*jax.tree.leaves((arm, capture, lower, upper, start))):
        raise InputError(
            f"{single}_many needs the values of its arguments, which are not known inside jit, vmap or a derivative; "
            f"call {single}_many outside of these, or use jax.vmap of {single} inside."
        )
    if isinstance(lower, Bounds):
        for what, given in (("upper bounds", upper), ("a space", options.space)):
            if given is not None:
                raise InputError(
                    f"a Bounds object and {what} are both given, but a Bounds object already contains {what}; omit "
                    "one of the two, and give a start by its name: start=..."
                )
        lower, upper, space = lower.lower, lower.upper, lower.space
    elif upper is None:
        raise InputError(
            "lower bounds are given without upper bounds; give both, or a Bounds object, which contains both."
        )
    else:
        space = Parameters.free_of(arm) if options.space is None else options.space
    check_finite(noise=options.noise)
    check_columns(arm, capture.columns)
    p = len(space.names)
    sides = {"start": space.vector(arm) if start is None else start, "lower": lower, "upper": upper}
    boxes = {what: np.asarray(as_array(value, what)) for what, value in sides.items()}
    for what, value in boxes.items():
        if value.ndim not in (1, 2) or value.shape[-1] != p:
            raise InputError(
                f"{what} has shape {value.shape}; give ({p},) or (batch, {p}), since {p} parameters are free."
            )
    sizes = {value.shape[0] for value in boxes.values() if value.ndim > 1}
    sizes |= {leaf.shape[0] for leaf in jax.tree.leaves(arm) if leaf.ndim > 1}
    sizes |= {capture.q.shape[0]} if capture.q.ndim > 2 else set()
    sizes |= {np.shape(length.value)[0] for length in capture.lengths if np.ndim(length.value)}
    if not sizes:
        raise InputError(
            "no argument is a batch; give start, lower or upper with shape (batch, p), or a batch of arms or "
            "captures; for a single problem, use identify."
        )
    if sizes == {0} or len(sizes) > 1:
        numbers = " and ".join(map(str, sorted(sizes)))
        several = f"batches of {numbers} problems cannot be combined; give every batch the same number of problems."
        raise InputError(several if len(sizes) > 1 else "the batch is empty; give at least one problem.")
    for row, i in np.argwhere(~(np.atleast_2d(boxes["lower"]) <= np.atleast_2d(boxes["upper"]))):
        raise InputError(
            f"lower bound of {space.names[i]} is above its upper bound in problem {row + 1}; exchange or widen the "
            "bounds."
        )
    space = based_on(space, arm)
    return Problems(*to_numpy((space.base, capture)), **boxes, near=None), space, sizes.pop()


class _Batch(NamedTuple):
    """A batch of identifications, checked: the problems on the host, and how a chunk of them is run on a device."""

    problems: Problems
    form: Form
    size: int
    space: Parameters
    options: BatchOptions

    def identify(self) -> ManyIdentifications:
        """All problems."""
        options = self.options
        devices = jax.local_devices() if options.devices is None else items_of(options.devices, "devices")
        if not devices:
            raise InputError("devices is empty; name at least one device, or omit devices.")
        slots, workers = _SLOTS_ELSEWHERE, len(devices)
        if devices[0].platform == "cpu":
            slots = min(_SLOTS_CPU, 2 ** max(round(math.log2(_POSES_IN_CACHE / len(self.form.pose))), 0))
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            workers = max(workers, cores)
        slots, workers = options.slots or slots, options.workers or workers
        # As few chunks as keep all workers busy, since slots idle at the end of each.
        calls = min(-(-self.size // (slots * _ROUNDS * workers)) * workers, -(-self.size // slots))
        chunk = options.chunk or -(-self.size // calls)
        chunks = [range(first, min(first + chunk, self.size)) for first in range(0, self.size, chunk)]
        # Whole rounds of the slots, their number a power of two: each size is compiled once, so there should be few.
        capacity = slots * 2 ** math.ceil(math.log2(-(-max(map(len, chunks)) // slots)))
        form = self.form._replace(slots=slots, capacity=capacity)

        def run(chunk: range, device: Any) -> dict[str, Any]:
            # Filled up to the capacity with copies of the first problem, which are never begun.
            rows = np.full(form.capacity, chunk.start)
            rows[: len(chunk)] = chunk
            with jax.default_device(device):
                part = selected(self.problems, form.axes, rows)
                given = jax.device_put((part, np.asarray(len(chunk)), options.noise, options.prior), device)
                fields = solve_chunk(form, *given)
            return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chunk)], fields)

        parts = _run(run, chunks, devices, workers)
        fields = jax.tree.map(lambda *columns: np.concatenate(columns), *parts)
        return ManyIdentifications(
            result=reasons(jnp.asarray(fields.pop("reason"))),
            bounds=Bounds(self.space, self.problems.lower, self.problems.upper),
            anchor=form.anchor,
            **fields,
        )

    def jointly(self, rows: np.ndarray, near: Float[np.ndarray, "b p"]) -> ManyIdentifications:
        """Some of the problems, with all that the capture holds in one least squares, from parameters near to it."""
        part = selected(self.problems, self.form.axes, rows)._replace(near=near)
        form = _form(part, self.space, self.options._replace(hold=None), with_lengths=True)
        return self._replace(problems=part, form=form, size=len(rows)).identify()


def _form(problems: Problems, space: Parameters, options: BatchOptions, with_lengths: bool) -> Form:
    """What is the same for all problems. Raises `InputError` where the data cannot determine the unknowns."""
    arm, capture, start, lower, upper, near = problems
    box: Any = (None if side is None or side.ndim == 1 else 0 for side in (start, lower, upper, near))
    of_arm = jax.tree.map(lambda leaf: 0 if leaf.ndim > 1 else None, arm)
    of_capture: Any = jax.tree.map(lambda leaf: 0, capture) if capture.q.ndim > 2 else None
    axes = Problems(of_arm, of_capture, *box)
    # What is checked of the first problem holds for all: captures of a batch have one form.
    first = selected(problems, axes, 0)
    solved = first.capture if with_lengths else without_lengths(first.capture)
    anchor = anchor_of(space, solved, first.capture, options.hold, options.noise)
    observed = Observed.of(solved, first.arm)
    of_first = Parameters(first.arm, space.names)
    check_data(solved, observed, of_first, np.asarray(first.start), anchor, options.solving)
    return Form(
        names=space.names,
        anchor=anchor,
        with_lengths=with_lengths,
        noise_model=checked_noise_model(None, options.noise, arm.joints),
        loss=None if options.robust is None else Loss(options.robust),
        # Only covariances need to know which readings are one, and each answer is a program.
        pose=configurations(observed.q) if options.covariance else tuple(range(observed.q.shape[0])),
        read_once=observed.read_once,
        max_steps=options.max_steps,
        covariance=options.covariance,
        axes=axes,
    )


def _run(run: Callable, chunks: Sequence[range], devices: Sequence[Any], workers: int) -> list:
    """Results of all chunks in their order, computed by threads: XLA releases the interpreter's lock meanwhile."""
    if len(chunks) == 1:  # needs no thread, which takes a millisecond to start
        return [run(chunks[0], devices[0])]
    failed = threading.Event()

    def work(i: int) -> Any:
        if failed.is_set():  # the failure is raised in the place of what is missing
            return None
        try:
            return run(chunks[i], devices[i % len(devices)])
        except BaseException:
            failed.set()
            raise

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, range(len(chunks))))
