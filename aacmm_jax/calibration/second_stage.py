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
from ..core.numpy_or_jax import AnyArray, namespace, set_at, stop_gradient, to_jax, while_loop
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.parameters import Bounds, Parameters
from ..model.measurement import Measurement
from ..model.metrics import repeatability
from ..model.scale import divide_lengths, divisible, scale_of
from ..solver.reason import SCALE, numbers_of, reasons
from .bounded_fit import Fit
from .results import ManyIdentifications
from .scale_anchor import ScaleAnchor
from .task import Task, fit_repeatability

_ROUNDS = 80  # identifications of one search; nearly always it ends after three, and after 60 bisections at the latest
_SLOPES = (0.01, 2.0)  # of log k by the log of the anchor: 1 unless bounds or fixed lengths set part of the scale
_LARGEST_STEP = 0.7  # of the log of the anchor
_EXACT = 1e-12  # |log k| that no further step is worth
LARGEST_LOG_K = 1e-7  # |log k| up to which k = 1 counts as reached
_ROUNDING = 1e-9  # mm: how far from a bound the division may leave a length by rounding


def divide_by_k(anchor: ScaleAnchor, space: Parameters, parameters: Any, k: Any) -> Any:
    """The parameters of stage 1 divided by k; the base of ``space`` is the arm, or a batch of arms."""
    if not anchor.can_scale:
        return parameters
    return divide_lengths(space, parameters, k, anchor.partners)


def clip_to_bounds(
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


def must_adjust_anchor(
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
    return needed if anchor.can_scale else xp.zeros_like(needed)


def adjust_anchor(task: Task, measurement: Measurement, scaled: Float[AnyArray, " p"]) -> Fit:
    """Stage 1 repeated with its anchor adjusted until k = 1 (`ScaleSearch`), from the divided parameters.

    The search begins where all lengths are free, so that it does not depend on where stage 1 had its anchor: far from
    there bounds act on the other lengths, and k = 1 may have a second solution with large residuals.

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
        sigma = repeatability(tips, measurement.sizes, fitted=len(again) - 1).sigma
        return xp.log(scale_of(tips, measurement, sigma).value), found

    def one_round(state: tuple[Any, ...]) -> tuple[Any, ...]:
        search, x, best, steps = state
        log_k, found = identify_again(x, search.length)
        improved = xp.abs(log_k) < xp.abs(search.best_log_k)
        best = xp.where(improved, found.parameters, best)
        return search.advance(log_k), found.parameters, best, steps + found.steps

    def solve(_: Any, length: Float[AnyArray, ""]) -> tuple[Any, tuple[Any, Any]]:
        first = (ScaleSearch.of(length, *stop_gradient((lower, upper))), start, start, free.steps)
        search, _, best, steps = while_loop(lambda state: ~state[0].done, one_round, first)
        # As a float: custom_root gives this a tangent of its own type, which an integer must not have.
        return search.best, (best, xp.asarray(steps, dtype=float))

    def difference(length: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
        """Zero at the adjusted length: log k, or the distance from the bound that the length is on."""
        log_k, _ = identify_again(start, length)
        bound = xp.where(length <= lower, lower, upper)
        return xp.where(_on_bound(length, lower, upper), length - xp.where(xp.isfinite(bound), bound, 0.0), log_k)

    def divide_by_slope(derivative: Callable, right: Float[AnyArray, ""]) -> Float[AnyArray, ""]:
        slope = derivative(xp.ones(()))
        return right / xp.where(slope == 0, 1.0, slope)

    clipped = xp.clip(scaled, bounds.lower, bounds.upper)
    free = fit_repeatability(*stop_gradient((task, measurement, clipped)), None)
    start = stop_gradient(xp.where(xp.isfinite(free.parameters), free.parameters, clipped))
    if xp is np:
        length, (x, steps) = solve(None, start[i])
    else:
        length, (x, steps) = jax.lax.custom_root(difference, start[i], solve, divide_by_slope, has_aux=True)
    log_k, found = identify_again(x, length)
    number = _number_of_reason(member_numbers(found.result), log_k, _on_bound(length, lower, upper))
    return found._replace(steps=steps.astype(int) + found.steps, result=reasons(number))


class ScaleSearch(NamedTuple):
    """The search for the length at which log k = 0, of one problem or of many: secant steps inside a bracket.

    Where no bound acts, log k rises by as much as the log of the length, so that the first step, of slope 1, nearly
    ends the search. Where bounds act on other lengths, the slope is smaller, changes at every bound that begins or
    ceases to act, and can be negative. So the search looks for the point where log k passes from negative to positive:
    it goes up while log k is negative and down while it is positive, to the bound of the length if need be, until the
    point is between two lengths. From there on a step that leaves the bracket, or that follows one that did not halve
    log k, is replaced by a bisection.
    """

    length: Float[AnyArray, "..."]  # where k is found next
    low: Float[AnyArray, "..."]  # the largest length with log k < 0, at first the lower bound
    high: Float[AnyArray, "..."]  # the smallest length with log k > 0, at first the upper bound
    bracketed: Bool[AnyArray, "... 2"]  # which of both was found, and is not a bound
    last_length: Float[AnyArray, "..."]
    last_log_k: Float[AnyArray, "..."]
    best: Float[AnyArray, "..."]  # length with the smallest |log k| so far
    best_log_k: Float[AnyArray, "..."]
    rounds: Int[AnyArray, "..."]
    done: Bool[AnyArray, "..."]

    @classmethod
    def of(cls, length: Any, lower: Any, upper: Any) -> "ScaleSearch":
        """Before the first round, at a length within its bounds."""
        xp = namespace(length, lower, upper)
        length = xp.clip(length, lower, upper)
        known, none = xp.zeros((*length.shape, 2), dtype=bool), xp.full_like(length, np.inf)
        rounds, done = xp.zeros(length.shape, dtype=np.int32), xp.zeros(length.shape, dtype=bool)
        return cls(length, lower, upper, known, length, none, length, none, rounds, done)

    def advance(self, log_k: Any) -> "ScaleSearch":
        """After log k was found at the length."""
        xp, length = namespace(self, log_k), self.length
        size = xp.abs(log_k)
        # In terms of size, for lengths that are negative.
        rising = xp.where(length < 0, -log_k, log_k)
        low, high = xp.where(rising < 0, length, self.low), xp.where(rising > 0, length, self.high)
        bracketed = self.bracketed | xp.stack([rising < 0, rising > 0], axis=-1)
        both = xp.all(bracketed, axis=-1)
        moved = (length != self.last_length) & (length * self.last_length > 0)
        ratio = xp.log(xp.where(moved, length / xp.where(moved, self.last_length, 1.0), 2.0))
        change = log_k - xp.where(moved, self.last_log_k, 0.0)
        slope = xp.where(moved, xp.clip(change / ratio, *_SLOPES), 1.0)
        trial = length * xp.exp(xp.clip(-log_k / slope, -_LARGEST_STEP, _LARGEST_STEP))
        slow = size > 0.5 * xp.abs(self.last_log_k)
        middle = xp.where(both, low + 0.5 * (xp.where(both, high, 0.0) - xp.where(both, low, 0.0)), length)
        bisect = both & (slow | (trial <= low) | (trial >= high))
        trial = xp.where(bisect, middle, xp.clip(trial, low, high))
        improved = size < xp.abs(self.best_log_k)
        rounds = self.rounds + 1
        done = (size <= _EXACT) | (slow & (size <= LARGEST_LOG_K)) | (trial == length) | (trial == self.last_length)
        return ScaleSearch(
            length=trial,
            low=low,
            high=high,
            bracketed=bracketed,
            last_length=length,
            last_log_k=log_k,
            best=xp.where(improved, length, self.best),
            best_log_k=xp.where(improved, log_k, self.best_log_k),
            rounds=rounds,
            done=done | ~xp.isfinite(log_k) | (rounds >= _ROUNDS),
        )


def _on_bound(length: Any, lower: Any, upper: Any) -> Any:
    return (length <= lower) | (length >= upper)


def _number_of_reason(numbers: Any, log_k: Any, on_bound: Any) -> Int[AnyArray, "..."]:
    """The reason of the last identification; `Reason.scale` where k = 1 was not reached, unless the length is on a
    bound."""
    xp = namespace(numbers, log_k)
    return xp.where((xp.abs(log_k) > LARGEST_LOG_K) & ~on_bound, SCALE, numbers)


def fix_scale_many(
    anchor: ScaleAnchor,
    stage1: ManyIdentifications,
    identify_again: Callable[[np.ndarray, np.ndarray, str | None], ManyIdentifications],
) -> dict[str, Any]:
    """Stage 2 of a batch: the fields of `ManyCalibrations` that it decides.

    ``identify_again(rows, start, hold)`` repeats stage 1 for some of the problems with another anchor.
    """
    space, sides = stage1.space, (stage1.bounds.lower, stage1.bounds.upper)
    assert stage1.k is not None
    lower, upper = (np.broadcast_to(side, stage1.parameters.shape) for side in sides)
    bounds = Bounds(space, lower, upper)
    scaled = np.array(divide_by_k(anchor, space, stage1.parameters, stage1.k))
    # Divided by k, the whole arm shrinks about the base, and so do the distances between its tips.
    factor = stage1.k if anchor.can_scale else np.ones_like(stage1.k)
    de, deltam, steps, reason = stage1.de / factor, stage1.deltam / factor, stage1.steps, numbers_of(stage1.result)
    rows = np.flatnonzero(must_adjust_anchor(anchor, bounds, stage1.active, scaled))
    active = stage1.active
    if anchor.can_scale:
        # Rows are contiguous, so that what is summed over one is summed in the same order in every batch.
        scaled = np.array(clip_to_bounds(space, lower, upper, scaled), order="C")
        active = np.asarray(bounds.active(scaled))
    if len(rows):
        adjusted = _adjust_many(
            anchor,
            space,
            scaled[rows],
            lower[rows],
            upper[rows],
            lambda part, start, hold: identify_again(rows[part], start, hold),
        )
        adjusted["steps"] = adjusted["steps"] + steps[rows]
        de, deltam, steps, reason, active = (np.array(column) for column in (de, deltam, steps, reason, active))
        columns = {"parameters": scaled, "de": de, "deltam": deltam, "steps": steps, "reason": reason}
        for name, values in adjusted.items():
            columns[name][rows] = values
        active[rows] = np.where(scaled[rows] <= lower[rows], -1, np.where(scaled[rows] >= upper[rows], 1, 0))
    result = to_jax(reasons(np.asarray(reason)))
    return {"parameters": scaled, "de": de, "deltam": deltam, "steps": steps, "result": result, "active": active}


def _adjust_many(
    anchor: ScaleAnchor,
    space: Parameters,
    scaled: Float[np.ndarray, "b p"],
    lower: Float[np.ndarray, "b p"],
    upper: Float[np.ndarray, "b p"],
    identify_again: Callable[[np.ndarray, np.ndarray, str | None], ManyIdentifications],
) -> dict[str, np.ndarray]:
    """`adjust_anchor` for a batch: parameters, metrics and numbers of the reasons, and evaluations of all rounds."""
    assert anchor.adjusted is not None
    i = space.index(anchor.adjusted)
    everything = np.arange(len(scaled))
    free = identify_again(everything, np.clip(scaled, lower, upper), None)
    x = np.where(np.isfinite(free.parameters), free.parameters, np.clip(scaled, lower, upper))
    best, steps = x.copy(), np.array(free.steps)
    search = ScaleSearch.of(x[:, i], lower[:, i], upper[:, i])
    while not np.all(search.done):
        rows = np.flatnonzero(~search.done)
        part = ScaleSearch(*(np.asarray(column)[rows] for column in search))
        start = x[rows]
        start[:, i] = part.length
        found = identify_again(rows, start, anchor.adjusted)
        assert found.k is not None
        log_k = np.log(found.k)
        improved = np.abs(log_k) < np.abs(part.best_log_k)
        best[rows[improved]] = found.parameters[improved]
        x[rows], steps[rows] = found.parameters, steps[rows] + found.steps
        search = ScaleSearch(*(set_at(old, rows, new) for old, new in zip(search, part.advance(log_k), strict=True)))
    best[:, i] = search.best
    found = identify_again(everything, best, anchor.adjusted)
    assert found.k is not None
    on_bound = _on_bound(search.best, lower[:, i], upper[:, i])
    return {
        "parameters": found.parameters,
        "de": found.de,
        "deltam": found.deltam,
        "steps": steps + found.steps,
        "reason": np.asarray(_number_of_reason(np.asarray(numbers_of(found.result)), np.log(found.k), on_bound)),
    }


def select_problems(rows: np.ndarray, arm: Arm, capture: Capture, *boxes: np.ndarray) -> tuple[Any, ...]:
    """Some problems of a batch: of the arm, the capture and each side of the box, where these are a batch."""

    def chosen(single: int, leaf: Any) -> Any:
        return leaf[rows] if leaf.ndim > single else leaf

    arm = jax.tree.map(partial(chosen, 1), arm)
    lengths = jax.tree.map(partial(chosen, 0), capture.lengths)
    capture = eqx.tree_at(lambda c: (c.q, c.lengths), capture, (chosen(2, capture.q), lengths))
    return (arm, capture, *(chosen(1, box) for box in boxes))
