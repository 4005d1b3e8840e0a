"""How an arm gets from pose to pose: approach points, the order, whether a move hits anything."""

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.numpy_or_jax import to_numpy
from ..core.units import DEG
from ..kinematics.arm import Arm, by_joint, joint_limits
from ..kinematics.chain import reading_units
from ..kinematics.collisions import clearances, is_clear, nearest_contact
from ..kinematics.inverse_kinematics import project_to_targets, readings_at_poses
from ..kinematics.robots import chains_of
from ..kinematics.workspace import Cone, SearchRegion, cones_of, lowest_point, tilts

_STEP = np.radians(2.0)  # largest step of a joint between samples of a move
_ROUNDS = 25  # of ordering and checking
_LEAST_WEIGHT = 0.1
_BLOCKED = 1e4  # rad: what a move that hits something counts, more than any detour
_MANY = 150  # poses, up to which every start is tried
_IMPROVED = 6  # starts that are improved
_BACK, _BACK_LINEAR = 2 * DEG, 10.0  # rad, mm: motion before a pose, which must be larger than the play


class Motion(NamedTuple):
    """How the arm takes the poses of a plan, in their order. Arrays are of NumPy.

    Example:
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> print(planned.motion.travel < 0.8 * planned.motion.unordered)  # rad: 50 instead of 77
        True
    """

    approach: Float[np.ndarray, "N n"] | None  # configurations above the sockets, rad; None without approach points
    tilt: Float[np.ndarray, " N"]  # between the tool and the normal of its socket, rad
    clearance: Float[np.ndarray, " N"] | None  # from obstacles and of the arm from itself, mm; None where not checked
    travel: float  # of all joints from pose to pose, by way of the approach points; weighted, rad
    unordered: float  # likewise, socket after socket in the order in which the poses were chosen
    blocked: tuple[tuple[int, str, str], ...]  # moves to the pose of this index that hit something, and what touches


def approaches(
    region: SearchRegion, q: Float[np.ndarray, "N n"], normals: Float[np.ndarray, "N 3"], retract: float
) -> tuple[Float[np.ndarray, "N n"], Bool[np.ndarray, " N"]]:
    """Configurations with the tip ``retract`` (mm) along the normals, and the orientation kept where the joints allow;
    and which are possible: within the limits, above the table, and clear, as is the straight move of the joints there.
    """
    poses = np.asarray(region.arm.pose(q)).copy()
    poses[:, :3, 3] += retract * normals
    solution = readings_at_poses(region.arm, q, poses, region.limits.tolist())
    above, good = np.hstack([solution.q, q[:, region.arm.joints :]]), np.array(solution.reached)
    rows = np.flatnonzero(~good)
    if len(rows):
        above[rows], good[rows] = project_to_targets(region.arm, q[rows], poses[rows, :3, 3], region.limits)
    good &= lowest_point(region.arm, above) >= region.above
    rows = np.flatnonzero(good)
    good[rows] = [hit is None for hit in move_contacts(region, q[rows], above[rows])]
    return above, good


def move_contacts(
    region: SearchRegion, start: Float[np.ndarray, "m n"], end: Float[np.ndarray, "m n"]
) -> list[tuple[str, str] | None]:
    """For each straight move of the joints: what touches at the first sample that is not clear, or None."""
    if region.cell is None or not len(start):
        return [None] * len(start)
    n = region.arm.joints
    steps = np.abs(end - start)[:, :n] / reading_units(region.arm.geometry)
    counts = np.maximum(np.ceil(steps.max(axis=1) / _STEP).astype(int), 1) + 1
    move = np.repeat(np.arange(len(start)), counts)
    fraction = np.concatenate([np.linspace(0, 1, count) for count in counts])[:, None]
    samples = start[move] + fraction * (end - start)[move]
    clear = is_clear(region.cell, region.arm, samples)
    contacts: list[tuple[str, str] | None] = [None] * len(start)
    hit = np.flatnonzero(~clear)
    for which, first in zip(*np.unique(move[hit], return_index=True), strict=True):
        contacts[which] = nearest_contact(region.cell, region.arm, samples[hit[first]])
    return contacts


def ordered_motion(
    region: SearchRegion,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    normals: Float[np.ndarray, "N 3"],
    retract: float,
) -> tuple[list[int], Motion]:
    """The order in which to take poses, and how the arm moves then.

    Moves that hit something are found by samples of 2 deg of the joint that moves most, and avoided by another order
    where there is one.
    """
    weights = joint_weights(region.arm)
    weights = np.concatenate([weights, np.zeros(q.shape[1] - len(weights))])
    above = approaches(region, q, normals, retract)[0] if retract else None
    through = q if above is None else above
    contacts: dict[tuple[int, int], tuple[str, str] | None] = {}
    order: list[int] = []
    for _ in range(_ROUNDS):
        order = short_order(through, owner, weights, [pair for pair, contact in contacts.items() if contact])
        new = [pair for pair in _pairs(order) if pair not in contacts]
        if region.cell is None or not new:
            break
        first, last = np.array(new).T
        contacts |= dict(zip(new, move_contacts(region, through[first], through[last]), strict=True))
    visits = q[:, None] if above is None else np.stack([above, q, above], axis=1)
    hits = ((place + 1, contacts.get(pair)) for place, pair in enumerate(_pairs(order)))
    given = np.argsort(owner, kind="stable")
    tool = cones_of([Cone()]) if region.cones is None else region.cones
    return order, Motion(
        approach=None if above is None else above[order],
        tilt=tilts(region.arm, q[order], tool._replace(normals=normals[order])),
        clearance=None if region.cell is None else np.asarray(clearances(region.cell, region.arm, q[order])),
        travel=travel(visits[order].reshape(-1, q.shape[1]), weights),
        unordered=travel(visits[given].reshape(-1, q.shape[1]), weights),
        blocked=tuple((place, *hit) for place, hit in hits if hit is not None),
    )


def _pairs(order: list[int]) -> list[tuple[int, int]]:
    """Neighbours in an order, the smaller number first: a move and the way back are the same."""
    return [(min(i, j), max(i, j)) for i, j in pairwise(order)]


def hardly_reached(name: str, point: Float[np.ndarray, " 3"]) -> str:
    """Why nothing can be planned with a place."""
    where = ", ".join(f"{round(float(x)):.6g}" for x in point)
    return (
        f"{name} at ({where}) mm cannot be reached in enough poses within the joint limits, inside the cone and clear "
        "of obstacles; change the position, widen the cone, shorten retract, or give more candidates."
    )


def start_from(arm: Arm, q: Float[np.ndarray, " n"], sides: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Readings where the motion to a pose begins that each joint reaches with rising (1) or falling (-1) readings,
    within the limits of the joints."""
    lower, upper = np.asarray(joint_limits(arm, None)).T
    return np.clip(q - sides * np.array(by_joint(arm, _BACK, _BACK_LINEAR)), lower, upper)


def joint_weights(arm: Arm) -> Float[np.ndarray, " n"]:
    """What a radian of each joint counts: how much of the arm is beyond it, relative to the most; 0.1 at least. Of a
    robot, how much of a chain."""
    if arm.chains:
        whole = np.zeros(arm.joints)
        for chain in chains_of(arm).values():
            own = np.array(chain.joints) - 1
            whole[own] = np.maximum(whole[own], joint_weights(chain.arm))
        return whole
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
    of the best, runs are reversed, of poses within their group and of whole groups, until nothing becomes shorter.

    Args:
        q: The configurations between which the arm moves, rad.
        groups: The group of each.
        weights: What a radian of each joint counts.
        blocked: Pairs between which the arm cannot move directly; they are avoided where possible.
    """
    given = np.argsort(groups, kind="stable")
    scaled = q * weights
    cost = np.zeros((len(q) + 1, len(q) + 1))  # the last one stands for what is before the first and after the last
    for i in range(len(q)):
        cost[i, :-1] = np.abs(scaled - scaled[i]).sum(axis=1)
    for i, j in blocked:
        cost[i, j] += _BLOCKED
        cost[j, i] += _BLOCKED
    starts = range(len(q)) if len(q) <= _MANY else [int(np.argmin(np.abs(scaled).sum(axis=1)))]
    orders = [_nearest(cost, groups, start) for start in starts]
    orders = [given, *sorted(orders, key=lambda order: _length(cost, order))[:_IMPROVED]]
    best = min((_reversed(cost, order, groups) for order in orders), key=lambda order: _length(cost, order))
    return best.tolist()


def _length(cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"]) -> float:
    return float(cost[order[:-1], order[1:]].sum())


def _nearest(cost: Float[np.ndarray, "M M"], groups: Int[np.ndarray, " N"], start: int) -> Int[np.ndarray, " N"]:
    """From pose to nearest pose; a group is left when none of it is left."""
    left = np.ones(len(groups), dtype=bool)
    order = [start]
    left[start] = False
    while left.any():
        of_group = left & (groups == groups[order[-1]])
        rows = np.flatnonzero(of_group if of_group.any() else left)
        order.append(int(rows[np.argmin(cost[order[-1], rows])]))
        left[order[-1]] = False
    return np.array(order)


def _reversed(
    cost: Float[np.ndarray, "M M"], order: Int[np.ndarray, " N"], groups: Int[np.ndarray, " N"]
) -> Int[np.ndarray, " N"]:
    """2-opt: for each place the best run from there is reversed, of one group or of whole groups, until nothing becomes
    shorter."""
    none, before = len(order), np.inf
    while _length(cost, order) < before - 1e-9:
        before = _length(cost, order)
        for i in range(len(order) - 1):
            path, group, j = np.concatenate([[none], order, [none]]), groups[order], np.arange(i + 1, len(order))
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
