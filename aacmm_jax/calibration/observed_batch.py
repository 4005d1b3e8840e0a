"""Batches of calibrations from observations of all kinds: `identify_observed`, vectorised over a fixed number of slots.

One compiled program for each form of a capture solves as many problems as there are slots. The number of slots, not
the size of the batch, fixes the arithmetic.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..data.capture import Capture
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters, based_on
from ..kinematics.priors import Prior
from ..model.measurement import check_joints
from ..model.observed import Observed
from ..model.robust import Loss, check_loss
from ..solver.reason import numbers_of, reasons
from .checks import check_noise_model
from .chunks import default_workers, devices_of, run_chunks
from .observed import identify_observed
from .observed_state import NO_ANCHOR, ObservedTask, check_observed, configurations, unknown_parameters
from .results import ManyIdentifications
from .scale_anchor import ScaleAnchor, scale_anchor

# Of one program. On a CPU the derivatives of all slots should fit the second-level cache.
_SLOTS_CPU, _POSES_IN_CACHE = 32, 2000
_SLOTS_ELSEWHERE = 1024


class _Form(NamedTuple):
    """What is the same for all problems and fixes the compiled program."""

    names: tuple[str, ...]
    anchor: ScaleAnchor
    loss: Loss | None
    pose: tuple[int, ...]
    max_steps: int
    covariance: bool
    batched: tuple[Any, ...]  # axes of arm, capture, start, lower and upper bounds


def solve_observed(
    arm: Arm,
    capture: Capture,
    box: tuple[np.ndarray, np.ndarray, np.ndarray],
    size: int,
    space: Parameters,
    options: Any,
) -> ManyIdentifications:
    """All problems of a batch, problem by problem what `identify` does; ``box`` is start, lower and upper bounds."""
    robust, noise, prior = options.robust, options.noise, options.prior
    check_loss(robust)
    check_joints(capture, space)
    space = based_on(space, arm)
    arm, capture = to_numpy((space.base, capture))
    axes = (
        jax.tree.map(lambda leaf: 0 if leaf.ndim > 1 else None, arm),
        jax.tree.map(lambda leaf: 0, capture) if capture.q.ndim > 2 else None,
        *(0 if side.ndim > 1 else None for side in box),
    )
    given = (arm, capture, *box)
    first = _selected(given, axes, 0)
    first_space = Parameters(first[0], space.names)
    fixed = bool(capture.lengths) or any(observation.fixes_scale for observation in capture.observations)
    hold = None if fixed and options.hold == "longest" else options.hold
    anchor = scale_anchor(space, arm, hold, noise, first[1]) if not fixed or hold else NO_ANCHOR
    observed = Observed.of(first[1], first[0])
    check_observed(observed, first_space, first[2], unknown_parameters(first_space, anchor, prior, noise))
    form = _Form(
        names=space.names,
        anchor=anchor,
        loss=None if robust is None else Loss(robust),
        # Only covariances need to know which readings are one, and each answer is a program.
        pose=configurations(observed.q) if options.covariance else tuple(range(observed.q.shape[0])),
        max_steps=options.max_steps,
        covariance=options.covariance,
        batched=axes,
    )
    devices = devices_of(options.devices)
    slots = options.slots or _default_slots(devices[0].platform, len(form.pose))

    def run(chunk: range, device: Any) -> dict[str, Any]:
        rows = np.full(slots, chunk.start)
        rows[: len(chunk)] = chunk
        with jax.default_device(device):
            part, *shared = jax.device_put((_selected(given, axes, rows), noise, prior), device)
            found = _solve(form, part, *shared)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(chunk)], found)

    chunks = [range(i, min(i + slots, size)) for i in range(0, size, slots)]
    found = run_chunks(run, chunks, devices, options.workers or default_workers(devices))
    fields = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    return ManyIdentifications(
        k=None,
        result=reasons(jax.numpy.asarray(fields.pop("reason"))),
        bounds=Bounds(space, box[1], box[2]),
        anchor=anchor,
        **fields,
    )


def _default_slots(platform: str, poses: int) -> int:
    if platform != "cpu":
        return _SLOTS_ELSEWHERE
    return min(_SLOTS_CPU, 2 ** max(round(math.log2(_POSES_IN_CACHE / poses)), 0))


def _selected(given: tuple[Any, ...], axes: tuple[Any, ...], rows: Any) -> tuple[Any, ...]:
    """The problems of some rows; what all share stays as it is."""

    def pick(tree: Any, axis: Any) -> Any:
        if axis is None:
            return tree
        return jax.tree.map(lambda a, leaf: leaf if a is None else leaf[rows], axis, tree, is_leaf=lambda a: a is None)

    return tuple(pick(tree, axis) for tree, axis in zip(given, axes, strict=True))


@partial(eqx.filter_jit)
def _solve(form: _Form, part: tuple[Any, ...], noise: Noise | None, prior: Prior | None) -> dict[str, Any]:
    return jax.vmap(partial(_solve_one, form, noise, prior), in_axes=form.batched)(*part)


def _solve_one(
    form: _Form,
    noise: Noise | None,
    prior: Prior | None,
    arm: Arm,
    capture: Capture,
    start: Float[AnyArray, " p"],
    lower: Float[AnyArray, " p"],
    upper: Float[AnyArray, " p"],
) -> dict[str, Any]:
    """One problem, traced: the fields of `ManyIdentifications`."""
    bounds = Bounds(Parameters(arm, form.names), lower, upper)
    task = ObservedTask(
        observed=Observed.of(capture, arm),
        bounds=bounds,
        start=jax.numpy.clip(start, lower, upper),
        noise=noise,
        anchor=form.anchor,
        noise_model=check_noise_model(None, noise, arm.joints),
        max_steps=form.max_steps,
        loss=form.loss,
        pose=form.pose,
        differentiable=False,
        prior=prior,
    )
    found = identify_observed(task)
    metrics = found.observed
    assert metrics is not None
    fields = {
        "parameters": found.parameters,
        "de": found.de,
        "deltam": found.deltam,
        "sigma": found.after.sigma,
        "steps": found.steps,
        "reason": numbers_of(found.result),
        "active": found.active,
        "reduced_chi": metrics.reduced_chi_of_all,
        "prior": found.prior,
    }
    return fields | ({"covariance": found.covariance} if form.covariance else {})
