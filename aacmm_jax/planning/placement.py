"""Placements of sockets and reference lengths, the information of configurations in them, and their scores."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from ..core.errors import InputError
from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import in_chunks, to_numpy
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, jacobian_at
from ..kinematics.chain import Geometry, joint_motion
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import SearchRegion, arm_reach, configurations_at, reached, total_link_length
from .fedorov_exchange import Candidates, Objective, relaxed_value

LEAST_POSES = 2  # in a socket: one shows no scatter
_STARTS = 24  # random starts in each socket for the first score
_REACHED = 0.25  # fraction of them that must arrive
_ROWS = 2048  # configurations computed at once
_ITERATIONS = 8  # of the relaxed design: as good a ranking as by a sweep of exchange, in a tenth of the time
_STEPS = 10  # of inverse kinematics, for a neighbour: enough for configurations that are moved along
_SHIFT, _ROTATION = 0.05, 0.4  # of a neighbour: relative to the sum of the links; rad
PRIOR = 1e-4  # parameters are known to 100 mm or 100 mrad in advance: makes the first information matrices invertible

Ranges = Mapping[str, tuple[float, float]]  # of x, y, z and the distance from the origin, mm
FARTHEST = 0.95  # part of the reach: beyond it an arm is stretched, and hardly any pose can be taken


class PlacementRegion(NamedTuple):
    """Where sockets and artefacts may be placed."""

    ranges: Ranges
    shoulder: Float[np.ndarray, " 3"]  # mm
    farthest: float  # from the shoulder, mm


class DesignProblem(NamedTuple):
    """What all designs for one arm have in common."""

    region: SearchRegion
    space: Parameters
    noise: Noise
    objective: Objective

    @property
    def arm(self) -> Arm:
        """The arm."""
        return self.region.arm


class FixturePlacement(NamedTuple):
    """Positions of sockets, and which of them are the ends of reference lengths, of what standard uncertainty; mm."""

    points: Float[np.ndarray, "s 3"]
    ends: tuple[tuple[int, int], ...]
    u: tuple[float, ...]


def in_order(placement: FixturePlacement, sockets: Int[np.ndarray, " s"]) -> FixturePlacement:
    """The same sockets in another order."""
    place = np.argsort(sockets).tolist()
    ends = tuple((place[start], place[end]) for start, end in placement.ends)
    return FixturePlacement(placement.points[sockets], ends, placement.u)


class Pool(NamedTuple):
    """Configurations in sockets, and what each measures of the parameters: derivatives of the tip, whitened."""

    q: Float[np.ndarray, "c n"]
    owner: Int[np.ndarray, " c"]  # index of each one's socket
    jacobian: Float[np.ndarray, "c 3 p"]  # by the parameters in natural steps, in standard deviations
    roots: Float[np.ndarray, "c 3 3"]  # that whiten the tips

    def at(self, rows: Any) -> "Pool":
        """Some of these configurations."""
        return Pool(*(part[rows] for part in self))

    def fewest(self, sockets: int) -> int:
        """The number of configurations in the socket that has the fewest."""
        return int(np.bincount(self.owner, minlength=sockets).min())


def pool_of(problem: DesignProblem, q: Float[np.ndarray, "c n"], owner: Int[np.ndarray, " c"]) -> Pool:
    """Configurations with their whitened derivatives."""
    geometry, noise = to_numpy((problem.arm.geometry, problem.noise))
    roots = in_chunks(lambda block: _whitening(geometry, block, noise), q)
    jacobian = jacobian_at(problem.arm, q, problem.space.names) * np.asarray(problem.space.scale)
    return Pool(q, owner, roots @ jacobian, roots)


def pool_at(problem: DesignProblem, points: Float[np.ndarray, "s 3"], each: int) -> Pool:
    """Configurations that reach the points from ``each`` random starts a point."""
    return pool_of(problem, *configurations_at(problem.region, points, each))


def candidates_of(problem: DesignProblem, placement: FixturePlacement, pool: Pool) -> Candidates:
    """The information that each configuration would add, and that of the lengths alone."""
    p, sockets = len(problem.space.names), len(placement.points)
    unknowns = p + 3 * sockets
    rows = np.zeros((len(pool.q), 3, unknowns))
    rows[:, :, :p] = pool.jacobian
    for axis in range(3):
        rows[np.arange(len(pool.q)), :, p + 3 * pool.owner + axis] = -pool.roots[:, :, axis]
    base = PRIOR * np.eye(unknowns)
    for (start, end), u in zip(placement.ends, placement.u, strict=True):
        between = placement.points[end] - placement.points[start]
        row = np.zeros(unknowns)
        direction = between / np.linalg.norm(between)
        row[p + 3 * end : p + 3 * end + 3], row[p + 3 * start : p + 3 * start + 3] = direction, -direction
        base += np.outer(row, row) / u**2
    return Candidates(rows, pool.owner, base, p)


def _whitening(geometry: Geometry, q: Float[np.ndarray, "c n"], noise: Noise) -> Float[np.ndarray, "c 3 3"]:
    covariances = tip_covariances(geometry, joint_motion(geometry, q), noise)
    return np.asarray(inverse_cholesky(np.moveaxis(np.asarray(covariances), -1, 0)))


def random_scores(problem: DesignProblem, placements: Sequence[FixturePlacement], poses: int) -> list[float]:
    """The objective for so many random poses in each placement; infinite if a socket is hard to reach."""
    sockets = len(placements[0].points)
    pool = pool_at(problem, np.concatenate([placement.points for placement in placements]), _STARTS)
    scores = []
    for number, placement in enumerate(placements):
        part = pool.at(pool.owner // sockets == number)
        part = part._replace(owner=part.owner % sockets)
        enough = part.fewest(sockets) >= _REACHED * _STARTS
        scores.append(
            relaxed_value(candidates_of(problem, placement, part), poses, problem.objective, 0) if enough else np.inf
        )
    return scores


def designed_score(problem: DesignProblem, placement: FixturePlacement, pool: Pool, poses: int) -> float:
    """The objective for nearly the best poses; infinite if a socket is not reached."""
    if pool.fewest(len(placement.points)) < LEAST_POSES:
        return np.inf
    return relaxed_value(candidates_of(problem, placement, pool), poses, problem.objective, _ITERATIONS)


def random_placements(
    problem: DesignProblem, count: int, sockets: int, length: tuple[float, float], u: float, ranges: PlacementRegion
) -> list[FixturePlacement]:
    """Random placements of sockets within ranges, two by two as the ends of the reference length."""
    random = problem.region.random
    found: list[FixturePlacement] = []
    pairs = sockets // 2
    ends = tuple((2 * i, 2 * i + 1) for i in range(pairs))
    for _ in range(60):
        drawn = problem.region.draw(40 * count * (pairs + 1))
        middle = in_chunks(lambda q: np.asarray(problem.arm.position(q)), drawn, _ROWS)
        direction = random.normal(size=middle.shape)
        size = np.exp(random.uniform(math.log(length[0]), math.log(length[1]), len(middle)))[:, None]
        half = 0.5 * size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        both = np.stack([middle - half, middle + half], axis=1)
        both = both[inside(both, ranges).all(axis=1)]
        single = middle[inside(middle, ranges)]
        for i in range(min(len(both) // max(pairs, 1), len(single))):
            points = both[i * pairs : (i + 1) * pairs].reshape(-1, 3)
            points = np.concatenate([points, single[i : i + sockets % 2]])
            found.append(FixturePlacement(points, ends, (u,) * pairs))
            if len(found) == count:
                return found
    raise InputError(
        "no placement of the sockets and the reference length was found in the region; widen it, or shorten the length."
    )


def neighbour(problem: DesignProblem, placement: FixturePlacement, ranges: PlacementRegion) -> FixturePlacement | None:
    """A placement with one length, or single socket, shifted and rotated a little; None if that leaves the ranges."""
    random = problem.region.random
    points = placement.points.copy()
    fixtures = [list(pair) for pair in placement.ends]
    fixtures += [[i] for i in range(len(points)) if not any(i in pair for pair in fixtures)]
    moved = fixtures[random.integers(len(fixtures))]
    middle = points[moved].mean(axis=0)
    shift = random.normal(size=3) * _SHIFT * total_link_length(problem.arm)
    rotation = Rotation.from_rotvec(random.normal(size=3) * _ROTATION)
    points[moved] = middle + shift + rotation.apply(points[moved] - middle)
    return placement._replace(points=points) if inside(points, ranges).all() else None


def moved_pool(
    problem: DesignProblem, pool: Pool, before: FixturePlacement, after: FixturePlacement, each: int
) -> Pool:
    """The pool of a placement moved to another: what is in sockets that did not move stays; in the others the same
    configurations are moved along, and random ones take the place of those that cannot be."""
    changed = np.any(before.points != after.points, axis=1)
    kept = pool.at(~changed[pool.owner])
    starts, owner = [], []
    for socket in np.flatnonzero(changed):
        followed = pool.q[pool.owner == socket]
        new = problem.region.draw(max(each - len(followed), 0))
        starts += [followed, new]
        owner.append(np.full(len(followed) + len(new), socket))
    of = np.concatenate(owner)
    q, good = reached(problem.region, np.concatenate(starts), after.points[of], _STEPS, sockets=of)
    moved = pool_of(problem, q[good], of[good])
    return Pool(*(np.concatenate(parts) for parts in zip(kept, moved, strict=True)))


def check_region(ranges: Ranges) -> None:
    """Raise `InputError` for ranges that are none, or of something else than x, y, z and the distance."""
    for axis, (low, high) in ranges.items():
        if not low < high:
            raise InputError(
                f"the region's {axis} is {low:g} to {high:g} mm, which is not a range; give the lower number first."
            )
    unknown = sorted(set(ranges) - {"x", "y", "z", "distance"})
    if unknown:
        raise InputError(f"the region has no '{unknown[0]}'; give ranges of x, y, z and distance, in mm.")


def placement_region(arm: Arm, ranges: Ranges | None, farthest: float) -> PlacementRegion:
    """The region with the given ranges (default: z at least 0), no farther than a part of the reach."""
    if not 0 < farthest <= 1:
        raise InputError(
            f"farthest is {farthest:g}; give a part of the reach, such as {FARTHEST:g}, or 1 for all of it."
        )
    reach = arm_reach(arm)
    return PlacementRegion({"z": (0.0, np.inf)} if ranges is None else ranges, reach.shoulder, farthest * reach.radius)


def inside(points: Float[np.ndarray, "... 3"], region: PlacementRegion) -> Bool[np.ndarray, "..."]:
    """Which points are within the region."""
    values = {"x": points[..., 0], "y": points[..., 1], "z": points[..., 2]}
    values["distance"] = np.linalg.norm(points, axis=-1)
    inside = np.linalg.norm(points - region.shoulder, axis=-1) <= region.farthest
    for key, (low, high) in region.ranges.items():
        inside &= (values[key] >= low) & (values[key] <= high)
    return inside
