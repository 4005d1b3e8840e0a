"""Stage 2 of a calibration: the arm's scale from reference lengths, with fixed parameters as they are, within bounds.

Stage 1 leaves the scale to its anchor, a length kept at its start, and k = measured / nominal is its error. The result
of stage 2 is what stage 1 finds with the anchor at the value for which k = 1. Nearly always that is the arm divided by
k: if no bound acts on a length, repeatability does not change with the scale, and fixed lengths that free ones replace
exactly (d_n by a probe along the same axis) can stay. Otherwise (a length on a bound, or carried over it by the
division; a fixed length that has no such partner) stage 1 is repeated with the anchor adjusted until k = 1.

Where fixed lengths set the scale by themselves, nothing is changed and k only compares them with the reference lengths.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ..core._compat import member_numbers
from ..core.namespace import AnyArray, namespace, scan, set_at, stop_gradient, to_jax
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement
from ..model.scale import divide_free_lengths, divisible, replaced_lengths, scale_of
from ..solver.reason import MAX_STEPS, Reason, numbers_of, reasons
from .results import ManyIdentifications
from .scale_anchor import ScaleAnchor
from .task import Fit, Task, fit_repeatability

# Identifications with an adjusted anchor; the secant method ends at k = 1 to rounding after three or four.
_ROUNDS = 4
_SLOPES = (0.1, 2.0)  # of log k by the log of the anchor: 1 unless bounds or fixed lengths set part of the scale
LARGEST_LOG_K = 1e-7  # |log k| up to which k = 1 counts as reached
_ROUNDING = 1e-9  # mm: how far from a bound the division may leave a length by rounding


def can_scale(anchor: ScaleAnchor) -> bool:
    """Whether stage 2 changes the arm: not where fixed lengths set the scale, or no length is free."""
    return not anchor.set_by and anchor.adjusted is not None


def divided(
    anchor: ScaleAnchor,
    space: Parameters,
    parameters: Any,
    k: Any,
) -> Any:
    """The parameters of stage 1 divided by k; the base of ``space`` is the arm, or a batch of arms."""
    if not can_scale(anchor):
        return parameters
    return divide_free_lengths(space, parameters, k, replaced(anchor, space))


def replaced(anchor: ScaleAnchor, space: Parameters) -> Float[AnyArray, "... p"]:
    """Fixed lengths that the free ones replace in the division, mm."""
    return replaced_lengths(space, space.base, ((), ()) if anchor.partners is None else anchor.partners)


def within_bounds(
    space: Parameters,
    lower: Float[AnyArray, "... p"],
    upper: Float[AnyArray, "... p"],
    scaled: Float[AnyArray, "... p"],
) -> Float[AnyArray, "... p"]:
    """Divided lengths within their bounds, and on a bound that only rounding separates them from.

    So short a step would not bring a solve onto the bound, which then counts as inactive, in derivatives too.
    """
    xp = namespace(lower, upper, scaled)
    inside = xp.clip(scaled, lower, upper)
    inside = xp.where(inside - lower <= _ROUNDING, lower, xp.where(upper - inside <= _ROUNDING, upper, inside))
    return xp.where(np.broadcast_to(space.lengths, scaled.shape), inside, scaled)


def must_adjust(
    anchor: ScaleAnchor,
    bounds: Bounds,
    active: Int[AnyArray, "... p"],
    scaled: Float[AnyArray, "... p"],
) -> Bool[AnyArray, "..."]:
    """Whether the division is not the result of stage 2, given what was active in stage 1; see the module."""
    xp = namespace(anchor, bounds, active, scaled)
    lengths = np.broadcast_to(divisible(bounds.space), scaled.shape)
    concerned = (scaled < bounds.lower - _ROUNDING) | (scaled > bounds.upper + _ROUNDING)
    if anchor.hold is not None:  # without an anchor it is the active bounds that set the scale of stage 1
        concerned = concerned | (active != 0)
    if anchor.partners is None:
        concerned = xp.ones_like(concerned)
    needed = xp.any(concerned & lengths, axis=-1) & xp.all(xp.isfinite(scaled), axis=-1)
    return needed if can_scale(anchor) else xp.zeros_like(needed)


class Adjusted(NamedTuple):
    """The parameters for which k = 1."""

    parameters: Float[AnyArray, " p"]
    steps: Int[AnyArray, ""]
    result: Reason


def adjust_anchor(
    task: Task, measurement: Measurement, scaled: Float[AnyArray, " p"], sigma: Float[AnyArray, ""]
) -> Adjusted:
    """Stage 1 repeated with its anchor adjusted by the secant method until k = 1, from the divided parameters.

    The adjusted length is the root of log k, so its derivative is that of an implicit function, exact where k = 1 is
    reached; on a bound it follows the bound.
    """
    xp, bounds, name = namespace(task, scaled), task.bounds, task.anchor.adjusted
    assert name is not None
    i = task.space.index(name)
    lower, upper = bounds.lower[i], bounds.upper[i]

    def identify_again(x: Float[AnyArray, " p"], length: Float[AnyArray, ""]) -> tuple[Any, Fit]:
        again = set_at(xp.clip(x, bounds.lower, bounds.upper), i, length)
        found = fit_repeatability(task, measurement, again, name)
        tips = task.space.arm(found.parameters).position(measurement.q)
        return xp.log(scale_of(tips, measurement, sigma).value), found

    def one_round(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], Any]:
        x, length, last_length, last_log_k = carry
        log_k, found = identify_again(x, length)
        following = _secant(length, last_length, log_k, last_log_k, lower, upper)
        return (found.parameters, following, length, log_k), found.steps

    def solve(_: Any, length: Float[AnyArray, ""]) -> tuple[Any, tuple[Any, Any]]:
        first = (start, length, length, xp.zeros(()))
        (x, length, _, _), steps = scan(one_round, first, length=_ROUNDS - 1)
        # As a float: custom_root gives this a tangent of its own type, which an integer must not have.
        return length, (x, xp.sum(steps).astype(float))

    def difference(length: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
        """Zero at the adjusted length: log k, or the distance from the bound that the length is on."""
        log_k, _ = identify_again(start, length)
        bound = xp.where(length <= lower, lower, upper)
        return xp.where(_on_bound(length, lower, upper), length - xp.where(xp.isfinite(bound), bound, 0.0), log_k)

    def divide_by_slope(derivative: Callable, right: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
        slope = derivative(xp.ones(()))
        return right / xp.where(slope == 0, 1.0, slope)

    start = stop_gradient(scaled)
    first_length = xp.clip(start[i], *stop_gradient((lower, upper)))
    if xp is np:
        length, (x, steps) = solve(None, first_length)
    else:
        length, (x, steps) = jax.lax.custom_root(difference, first_length, solve, divide_by_slope, has_aux=True)
    log_k, found = identify_again(x, length)
    number = _number_of_reason(member_numbers(found.result), log_k, _on_bound(length, lower, upper))
    return Adjusted(found.parameters, steps.astype(int) + found.steps, reasons(number))


def _on_bound(length: Any, lower: Any, upper: Any) -> Any:
    return (length <= lower) | (length >= upper)


def _number_of_reason(numbers: Any, log_k: Any, on_bound: Any) -> Int[AnyArray, "..."]:
    """The reason of the last identification; not converged where k = 1 was not reached, unless a bound prevents it."""
    xp = namespace(numbers, log_k)
    return xp.where((xp.abs(log_k) > LARGEST_LOG_K) & ~on_bound, MAX_STEPS, numbers)


def second_stage_many(
    anchor: ScaleAnchor,
    stage1: ManyIdentifications,
    identify_again: Callable[[np.ndarray, np.ndarray], ManyIdentifications],
) -> dict[str, Any]:
    """Stage 2 of a batch: the fields of `ManyCalibrations` that it decides.

    ``identify_again(rows, start)`` repeats stage 1 for some of the problems and keeps the adjusted length.
    """
    space, sides = stage1.space, (stage1.bounds.lower, stage1.bounds.upper)
    assert stage1.k is not None
    lower, upper = (np.broadcast_to(side, stage1.parameters.shape) for side in sides)
    bounds = Bounds(space, lower, upper)
    scaled = np.array(divided(anchor, space, stage1.parameters, stage1.k))
    # Divided by k, the whole arm shrinks about the base, and so do the distances between its tips.
    factor = stage1.k if can_scale(anchor) else np.ones_like(stage1.k)
    de, deltam, steps, reason = stage1.de / factor, stage1.deltam / factor, stage1.steps, numbers_of(stage1.result)
    rows = np.flatnonzero(must_adjust(anchor, bounds, stage1.active, scaled))
    active = stage1.active
    if can_scale(anchor):
        # Rows are contiguous, so that what is summed over one is summed in the same order in every batch.
        scaled = np.array(within_bounds(space, lower, upper, scaled), order="C")
        active = np.asarray(bounds.active(scaled))
    if len(rows):
        found, found_reason, more = _adjust_many(
            anchor, space, scaled[rows], lower[rows], upper[rows], partial(identify_again, rows)
        )
        de, deltam, steps, reason, active = (np.array(column) for column in (de, deltam, steps, reason, active))
        scaled[rows], de[rows], deltam[rows], steps[rows] = found.parameters, found.de, found.deltam, steps[rows] + more
        reason[rows] = found_reason
        active[rows] = np.where(scaled[rows] <= lower[rows], -1, np.where(scaled[rows] >= upper[rows], 1, 0))
    result = to_jax(reasons(np.asarray(reason)))
    return {"parameters": scaled, "de": de, "deltam": deltam, "steps": steps, "result": result, "active": active}


def _adjust_many(
    anchor: ScaleAnchor,
    space: Parameters,
    scaled: Float[np.ndarray, "b p"],
    lower: Float[np.ndarray, "b p"],
    upper: Float[np.ndarray, "b p"],
    identify_again: Callable[[np.ndarray], ManyIdentifications],
) -> tuple[ManyIdentifications, Int[np.ndarray, " b"], Int[np.ndarray, " b"]]:
    """`adjust_anchor` for a batch: the last identifications, the numbers of their reasons, and all evaluations."""
    assert anchor.adjusted is not None
    i = space.index(anchor.adjusted)
    length = last_length = scaled[:, i]
    x, last_log_k, steps, found = scaled, np.zeros(len(scaled)), np.zeros(len(scaled), dtype=int), None
    for _ in range(_ROUNDS):
        start = np.array(x)
        start[:, i] = length
        found = identify_again(start)
        log_k, steps = np.log(found.k), steps + found.steps
        following = _secant(length, last_length, log_k, last_log_k, lower[:, i], upper[:, i])
        x, length, last_length, last_log_k = found.parameters, np.asarray(following), length, log_k
    assert found is not None
    on_bound = _on_bound(last_length, lower[:, i], upper[:, i])
    return found, np.asarray(_number_of_reason(numbers_of(found.result), last_log_k, on_bound)), steps


def rows_of(rows: np.ndarray, arm: Arm, capture: Capture, *boxes: np.ndarray) -> tuple[Any, ...]:
    """Some problems of a batch: of the arm, the capture and each side of the box, where these are a batch."""

    def chosen(single: int, leaf: Any) -> Any:
        return leaf[rows] if leaf.ndim > single else leaf

    arm = jax.tree.map(partial(chosen, 1), arm)
    lengths = jax.tree.map(partial(chosen, 0), capture.lengths)
    capture = eqx.tree_at(lambda c: (c.q, c.lengths), capture, (chosen(2, capture.q), lengths))
    return (arm, capture, *(chosen(1, box) for box in boxes))


def _secant(
    length: Any, last_length: Any, log_k: Any, last_log_k: Any, lower: Any, upper: Any
) -> Float[AnyArray, "..."]:
    """The next value of the adjusted length, within bounds: a secant step of log k towards 0, the first of slope 1."""
    xp = namespace(length, last_length, log_k, last_log_k, lower, upper)
    moved = length != last_length
    ratio = xp.log(xp.where(moved, length / xp.where(moved, last_length, 1.0), 2.0))
    slope = xp.where(moved, xp.clip((log_k - last_log_k) / ratio, *_SLOPES), 1.0)
    return xp.clip(length * xp.exp(-log_k / slope), lower, upper)
