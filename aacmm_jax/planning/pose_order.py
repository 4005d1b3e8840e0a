"""The order of poses in which the joints move little: nearest neighbours, improved by 2-opt and moves of short runs."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm

_LEAST_WEIGHT = 0.1
_BLOCKED = 1e4  # rad: what a move that hits something counts, more than any detour
_MOST, _MANY = 2000, 150  # poses: beyond the first only nearest neighbours; up to the second every start is tried
_IMPROVED, _SWEEPS = 6, 50  # starts that are improved, and how often
_RUN = 3  # poses that are moved together


def joint_weights(arm: Arm) -> Float[np.ndarray, " n"]:
    """What a radian of each joint counts: how much of the arm is beyond it, relative to the most; 0.1 at least."""
    arm = to_numpy(arm)
    lengths = np.abs(arm.a) + np.abs(arm.d)
    beyond = np.cumsum(lengths[::-1])[::-1] + np.linalg.norm(arm.probe)
    beyond = beyond - np.abs(arm.d)  # along its own axis a joint moves nothing
    return np.maximum(beyond / max(beyond.max(), 1e-9), _LEAST_WEIGHT)


def travel(q: Float[np.ndarray, "N n"], weights: Float[np.ndarray, " n"]) -> float:
    """Weighted sum of what the joints move from each configuration to the next, rad."""
    return float(np.abs(np.diff(q, axis=0) @ np.diag(weights)).sum())


def short_order(
    q: Float[np.ndarray, "N n"],
    groups: Int[np.ndarray, " N"],
    weights: Float[np.ndarray, " n"],
    blocked: Iterable[tuple[int, int]] = (),
) -> list[int]:
    """An order with little travel in which the poses of a group (a socket) follow each other.

    It is no longer than the given order, group after group. Poses are ordered by nearest neighbours from many starts;
    of the best, runs are reversed and moved, of poses within their group and of whole groups, until nothing becomes
    shorter.

    Args:
        q: The configurations between which the arm moves, rad.
        groups: The group of each.
        weights: What a radian of each joint counts.
        blocked: Pairs between which the arm cannot move directly; they are avoided where possible.
    """
    given = np.argsort(groups, kind="stable")
    if len(q) < 3:
        return given.tolist()
    scaled = q * weights
    if len(q) > _MOST:
        return min(
            (given, _nearest(lambda i, rows: np.abs(scaled[rows] - scaled[i]).sum(axis=1), groups, int(given[0]))),
            key=lambda order: float(np.abs(np.diff(scaled[order], axis=0)).sum()),
        ).tolist()
    cost = np.zeros((len(q) + 1, len(q) + 1))  # the last one stands for what is before the first and after the last
    for i in range(len(q)):
        cost[i, :-1] = np.abs(scaled - scaled[i]).sum(axis=1)
    for i, j in blocked:
        cost[i, j] += _BLOCKED
        cost[j, i] += _BLOCKED
    starts = range(len(q)) if len(q) <= _MANY else [int(np.argmin(np.abs(scaled).sum(axis=1)))]
    orders = [_nearest(lambda i, rows: cost[i, rows], groups, start) for start in starts]
    orders = [given, *sorted(orders, key=lambda order: _length(cost, order))[:_IMPROVED]]
    best = min((_improved(cost, order, groups) for order in orders), key=lambda order: _length(cost, order))
    return best.tolist()


def _length(cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"]) -> float:
    return float(cost[order[:-1], order[1:]].sum())


def _nearest(cost_from, groups: Int[np.ndarray, " N"], start: int) -> Int[np.ndarray, " N"]:
    """From pose to nearest pose; a group is left when none of it is left."""
    left = np.ones(len(groups), dtype=bool)
    order = [start]
    left[start] = False
    while left.any():
        of_group = left & (groups == groups[order[-1]])
        rows = np.flatnonzero(of_group if of_group.any() else left)
        order.append(int(rows[np.argmin(cost_from(order[-1], rows))]))
        left[order[-1]] = False
    return np.array(order)


def _improved(
    cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """The order after reversals and moves of runs, until none makes it shorter."""
    for _ in range(_SWEEPS):
        before = _length(cost, order)
        order = _moved(cost, _reversed(cost, order, groups), groups)
        if _length(cost, order) > before - 1e-9:
            break
    return order


def _reversed(
    cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """One sweep of 2-opt: for each place the best run from there is reversed, of one group or of whole groups."""
    none = len(order)
    for i in range(len(order) - 1):
        path = np.concatenate([[none], order, [none]])
        j = np.arange(i + 1, len(order))
        group = groups[order]
        begins = i == 0 or group[i - 1] != group[i]
        ends = np.append(group[1:] != group[:-1], True)[j]
        possible = (group[j] == group[i]) | (begins & ends)
        first, last = path[i + 1], path[j + 1]
        change = cost[path[i], last] + cost[first, path[j + 2]] - cost[path[i], first] - cost[last, path[j + 2]]
        change = np.where(possible, change, np.inf)
        best = int(np.argmin(change))
        if change[best] < -1e-9:
            end = int(j[best]) + 1
            order = np.concatenate([order[:i], order[i:end][::-1], order[end:]])
    return order


def _moved(
    cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """One sweep of or-opt: short runs of a group are put elsewhere in it, and whole groups between others."""
    none = len(order)
    for i in range(len(order)):
        group = groups[order]
        block = int(np.sum(group == group[i]))
        begins = i == 0 or group[i - 1] != group[i]
        for length in {*range(1, min(_RUN, block - 1) + 1), *((block,) if begins else ())}:
            run = order[i : i + length]
            if len(run) < length or np.any(groups[run] != groups[run[0]]):
                continue
            rest = np.concatenate([order[:i], order[i + length :]])
            path = np.concatenate([[none], rest, [none]])
            before, after = path[:-1], path[1:]  # the run goes between these
            around = np.append(groups, -1)
            if length == block:
                possible = (before == none) | (after == none) | (around[before] != around[after])
            else:
                possible = (around[before] == group[i]) | (around[after] == group[i])
            removed = cost[path[i], run[0]] + cost[run[-1], path[i + 1]] - cost[path[i], path[i + 1]]
            gaps = cost[before, after]
            ways = np.stack(
                [cost[before, run[0]] + cost[run[-1], after] - gaps, cost[before, run[-1]] + cost[run[0], after] - gaps]
            )
            ways = np.where(possible, ways, np.inf)
            way, place = np.unravel_index(int(np.argmin(ways)), ways.shape)
            if ways[way, place] - removed < -1e-9:
                order = np.concatenate([rest[:place], run if way == 0 else run[::-1], rest[place:]])
                break
    return order
