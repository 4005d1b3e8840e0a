"""Thousands of calibrations at once (`identify_many`, `calibrate_many`), which every Monte Carlo study uses.

The batch is cut into chunks, which are distributed over devices and cores; `batch_kernel` solves a chunk.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..core.arguments import check_finite, checked_arguments, with_options
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.loss_names import LossName
from ..model.measurement import check_joints
from ..solver.reason import reasons
from .batch_kernel import Problems, Shape, solve_chunk
from .checks import check_enough, check_method
from .chunks import cut_into_chunks, default_workers, devices_of, round_up, run_chunks
from .observed_batch import solve_observed
from .results import ManyCalibrations, ManyIdentifications
from .scale_anchor import ScaleAnchor, default_method, scale_anchor, scale_from_slides
from .second_stage import divide_by_k, fix_scale_many, select_problems

# Slots per loop. On a CPU the Jacobian columns of all slots should fit the second-level cache (measured from 20 to
# 7,000 poses: five times slower where they do not); a GPU needs thousands.
_SLOTS_CPU, _POSES_IN_CACHE = 16, 2000
_SLOTS_ELSEWHERE = 4096


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
    robust: LossName | None = None
    prior: Prior | None = None
    covariance: bool = False


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
            for no encoder that is noisier than the others and for no errors that poses share, as `calibrate` does.

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
    if capture.observations or given.robust is not None or given.prior is not None:
        return _solve_observed("identify", arm, capture, lower, upper, start, given)
    if given.covariance:
        raise InputError(
            "covariances of many identifications from sockets alone are not computed; use jax.vmap of identify, or "
            "calibrate_many with method='joint'."
        )
    return _batch_task("identify", arm, capture, lower, upper, start, given).identify()


@checked_arguments
@with_options(BatchOptions)
def calibrate_many(
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None = None,
    start: Numbers | None = None,
    *,
    method: Literal["two-stage", "joint"] | None = None,
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
    _, space = _checked_box("calibrate", arm, capture, lower, upper, start, given)
    by_slides = scale_from_slides(arm, capture, space, given.noise)
    general = bool(capture.observations) or any((given.robust, given.prior, given.covariance, by_slides))
    method = default_method(arm, general) if method is None else method
    check_method(method, general)
    if not capture.lengths and not by_slides and not any(one.fixes_scale for one in capture.observations):
        raise InputError(
            "the capture holds no reference length, so the scale cannot be fixed; add one, or use identify_many."
        )
    if general:
        found = _solve_observed("calibrate", arm, capture, lower, upper, start, given._replace(hold=None))
        fields = {name: getattr(found, name) for name in _SHARED}
        return ManyCalibrations(k=None, stage1=found, method="joint", **fields)
    return _batch_task("calibrate", arm, capture, lower, upper, start, given).calibrate(method)


_SHARED = ("parameters", "de", "deltam", "steps", "result", "active", "covariance", "reduced_chi", "prior")


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
    bounds, space = _checked_box(single, arm, capture, lower, upper, start, options)
    return BatchTask.of(arm, capture, bounds, start, space, options)


def _solve_observed(
    single: str,
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None,
    start: Numbers | None,
    options: BatchOptions,
) -> ManyIdentifications:
    """The same for captures with observations."""
    bounds, space = _checked_box(single, arm, capture, lower, upper, start, options)
    problems, _, size = _lay_out(arm, capture, bounds, start, space, None)
    _check_options(arm, options)
    given = problems.start, problems.lower, problems.upper
    return solve_observed(arm, capture, given, size, space, options)


def _checked_box(
    single: str,
    arm: Arm,
    capture: Capture,
    lower: Bounds | Numbers,
    upper: Numbers | None,
    start: Numbers | None,
    options: BatchOptions,
) -> tuple[tuple[Numbers, Numbers], Parameters]:
    """Lower and upper bounds, and the free parameters."""
    # A batch is distributed over threads by its values, so that it cannot be traced.
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
    return bounds, space


def _check_options(arm: Arm, options: BatchOptions) -> None:
    """Refuse options that mean nothing."""
    if options.noise is not None:
        check_finite(noise=options.noise)
        options.noise.check(arm.joints)
    for what in ("max_steps", "chunk", "slots", "workers"):
        number = getattr(options, what)
        if number is not None and number < 1:
            raise InputError(f"{what} is {number}; give at least 1, or leave it out.")


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
        anchor = scale_anchor(space, arm, options.hold, options.noise, capture) if anchor is None else anchor
        check_joints(capture, space)
        _check_options(arm, options)
        check_enough(capture.sizes, len(space.names) - int(space.lengths.any()))
        devices = devices_of(options.devices)
        slots = options.slots or _default_slots(devices, sum(capture.sizes))
        workers = options.workers or default_workers(devices)
        chunks = cut_into_chunks(size, slots, workers, options.chunk)
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
        capacity = round_up(max(map(len, chunks)), slots)
        space = based_on(space, arm)
        return cls(arm, capture, problems, shape, chunks, capacity, devices, workers, space, anchor, options)

    def identify(self) -> ManyIdentifications:
        """Stage 1 of all problems."""
        found = run_chunks(self.run, self.chunks, self.devices, self.workers)
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
