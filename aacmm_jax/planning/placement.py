"""Where to set up sockets and reference lengths: random placements, ranked by the poses that they allow, then moved."""

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from ..core.errors import InputError
from ..core.numpy_or_jax import in_chunks
from ..kinematics.workspace import reached, total_link_length
from .fedorov_exchange import relaxed_value
from .information import DesignProblem, Pool, candidates_of, pool_at, pool_of
from .options import LEAST_POSES, FixturePlacement, PlacementRegion, PlanOptions

# Random placements, those of them for which poses are chosen, tried neighbours of the best, and starts for each.
_PLACEMENTS, _DESIGNED, _NEIGHBOURS, _STARTS = 600, 10, 200, 1000
_BLOCK = 25  # placements scored together
_FEW_STARTS = 24  # in each socket for the first score
_REACHED = 0.25  # fraction of them that must arrive
_ROWS = 2048  # configurations computed at once
_ITERATIONS = 8  # of the relaxed design: as good a ranking as by a sweep of exchange, in a tenth of the time
_STEPS = 10  # of inverse kinematics, for a neighbour: enough for configurations that are moved along
_SHIFT, _ROTATION = 0.05, 0.4  # of a neighbour: relative to the sum of the links; rad

Layout = TypeVar("Layout")
Poses = TypeVar("Poses")


def best_layout(
    shortlist: Sequence[Layout],
    poses_in: Callable[[Layout, Layout | None, Poses | None], Poses | None],
    score: Callable[[Layout, Poses], float],
    neighbour: Callable[[Layout], Layout | None],
    tries: int,
    report: Callable[[float], None],
) -> Layout:
    """The layout with the lowest score among some good ones and, then, neighbours of the best so far.

    ``poses_in(layout, best, poses)`` are poses in a layout, which may reuse those in the best; None where it is not
    reached. ``report`` is called with the fraction done.
    """
    best, best_poses, best_score = None, None, np.inf
    for number in range(len(shortlist) + tries):
        report(0.4 + 0.6 * number / (len(shortlist) + tries))
        if number < len(shortlist):
            layout, poses = shortlist[number], poses_in(shortlist[number], None, None)
        elif best is None:
            break
        else:
            layout = neighbour(best)
            poses = None if layout is None else poses_in(layout, best, best_poses)
        value = np.inf if layout is None or poses is None else score(layout, poses)
        if value < best_score:
            best, best_poses, best_score = layout, poses, value
    report(1.0)
    return shortlist[0] if best is None else best


def best_placement(
    problem: DesignProblem,
    sockets: int,
    poses: int,
    length: tuple[float, float],
    u: float,
    ranges: PlacementRegion,
    options: PlanOptions,
) -> FixturePlacement:
    """The best placement found: random ones scored by random poses, the best few by chosen poses, then neighbours."""

    def report(fraction: float) -> None:
        options.report("Placing the sockets", fraction)

    report(0.0)
    placements = random_placements(problem, _PLACEMENTS, sockets, length, u, ranges)
    scores: list[float] = []
    while len(scores) < len(placements):
        scores += _random_scores(problem, placements[len(scores) : len(scores) + _BLOCK], poses)
        report(0.4 * len(scores) / len(placements))
    shortlist = [placements[i] for i in np.argsort(scores) if np.isfinite(scores[i])][:_DESIGNED]
    if not shortlist:
        limited = problem.region.cell is not None or (problem.region.cones is not None and problem.region.cones.any)
        wider = ", wider cones, or fewer obstacles" if limited else ""
        raise InputError(
            "no placement was found that can be reached well; give a region nearer to the arm, or a shorter "
            f"length{wider}."
        )
    starts = _STARTS // sockets

    def pool_in(placement: FixturePlacement, best: FixturePlacement | None, pool: Pool | None) -> Pool:
        if best is None or pool is None:
            return pool_at(problem, placement.points, starts)
        return _moved_pool(problem, pool, best, placement, starts)

    return best_layout(
        shortlist,
        pool_in,
        lambda placement, pool: _designed_score(problem, placement, pool, poses),
        lambda placement: _neighbour(problem, placement, ranges),
        _NEIGHBOURS,
        report,
    )


def _random_scores(problem: DesignProblem, placements: Sequence[FixturePlacement], poses: int) -> list[float]:
    """The objective for so many random poses in each placement; infinite if a socket is hard to reach."""
    sockets = len(placements[0].points)
    pool = pool_at(problem, np.concatenate([placement.points for placement in placements]), _FEW_STARTS)
    scores = []
    for number, placement in enumerate(placements):
        part = pool.at(pool.owner // sockets == number)
        part = part._replace(owner=part.owner % sockets)
        enough = part.fewest(sockets) >= _REACHED * _FEW_STARTS
        scores.append(
            relaxed_value(candidates_of(problem, placement, part), poses, problem.objective, 0) if enough else np.inf
        )
    return scores


def _designed_score(problem: DesignProblem, placement: FixturePlacement, pool: Pool, poses: int) -> float:
    """The objective for nearly the best poses; infinite if a socket is not reached."""
    if pool.fewest(len(placement.points)) < LEAST_POSES:
        return np.inf
    return relaxed_value(candidates_of(problem, placement, pool), poses, problem.objective, _ITERATIONS)


def random_placements(
    problem: DesignProblem, count: int, sockets: int, length: tuple[float, float], u: float, ranges: PlacementRegion
) -> list[FixturePlacement]:
    """Random placements of sockets within ranges, two by two as the ends of the reference length."""
    random = problem.region.random
    placements: list[FixturePlacement] = []
    pairs = sockets // 2
    ends = tuple((2 * i, 2 * i + 1) for i in range(pairs))
    for _ in range(60):
        drawn = problem.region.draw(40 * count * (pairs + 1))
        middle = in_chunks(lambda q: np.asarray(problem.arm.position(q)), drawn, _ROWS)
        direction = random.normal(size=middle.shape)
        size = np.exp(random.uniform(math.log(length[0]), math.log(length[1]), len(middle)))[:, None]
        half = 0.5 * size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        both = np.stack([middle - half, middle + half], axis=1)
        both = both[ranges.contains(both).all(axis=1)]
        single = middle[ranges.contains(middle)]
        for i in range(min(len(both) // max(pairs, 1), len(single))):
            points = both[i * pairs : (i + 1) * pairs].reshape(-1, 3)
            points = np.concatenate([points, single[i : i + sockets % 2]])
            placements.append(FixturePlacement(points, ends, (u,) * pairs))
            if len(placements) == count:
                return placements
    raise InputError(
        "no placement of the sockets and the reference length was found in the region; widen it, or shorten the length."
    )


def _neighbour(problem: DesignProblem, placement: FixturePlacement, ranges: PlacementRegion) -> FixturePlacement | None:
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
    return placement._replace(points=points) if ranges.contains(points).all() else None


def _moved_pool(
    problem: DesignProblem, pool: Pool, before: FixturePlacement, after: FixturePlacement, count: int
) -> Pool:
    """The pool of a placement moved to another: what is in sockets that did not move stays; in the others the same
    configurations are moved along, and random ones take the place of those that cannot be."""
    changed = np.any(before.points != after.points, axis=1)
    kept = pool.at(~changed[pool.owner])
    starts, owner = [], []
    for socket in np.flatnonzero(changed):
        followed = pool.q[pool.owner == socket]
        new = problem.region.draw(max(count - len(followed), 0))
        starts += [followed, new]
        owner.append(np.full(len(followed) + len(new), socket))
    sockets = np.concatenate(owner)
    q, good = reached(problem.region, np.concatenate(starts), after.points[sockets], _STEPS, sockets=sockets)
    moved = pool_of(problem, q[good], sockets[good])
    return Pool(*(np.concatenate(parts) for parts in zip(kept, moved, strict=True)))
