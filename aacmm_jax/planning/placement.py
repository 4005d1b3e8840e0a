"""Sockets and reference lengths: where to set them up, by the poses that they allow, and what these poses tell."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..core.linear_algebra import inverse_cholesky
from ..core.numpy_or_jax import in_chunks, to_numpy
from ..data.noise import tip_covariances
from ..data.simulation import socket_point
from ..kinematics.arm import jacobian_at
from ..kinematics.chain import joint_motion
from ..kinematics.workspace import configurations_at, reached, total_link_length
from .designs import Candidates, best_layout, relaxed_value
from .problem import PRIOR, DesignProblem

LEAST_POSES = 2  # in a socket: one shows no scatter
_U_RANGE = (1e-6, 100.0)  # mm
# Random placements, those of them for which poses are chosen, tried neighbours of the best, and starts for each.
_PLACEMENTS, _DESIGNED, _NEIGHBOURS, _STARTS = 600, 10, 200, 1000
_BLOCK = 25  # placements scored together
_FEW_STARTS = 24  # in each socket for the first score
_REACHED = 0.25  # fraction of them that must arrive
_ROWS = 2048  # configurations computed at once
_ITERATIONS = 8  # of the relaxed design: as good a ranking as by a sweep of exchange, in a tenth of the time
_STEPS = 10  # of inverse kinematics, for a neighbour: enough for configurations that are moved along
_SHIFT, _ROTATION = 0.05, 0.4  # of a neighbour: relative to the sum of the links; rad


class FixturePlacement(NamedTuple):
    """Positions of sockets, and which of them are the ends of reference lengths, of what standard uncertainty; mm."""

    points: Float[np.ndarray, "s 3"]
    ends: tuple[tuple[int, int], ...]
    u: tuple[float, ...]

    def in_order(self, sockets: Int[np.ndarray, " s"]) -> "FixturePlacement":
        """The same sockets in another order."""
        place = np.argsort(sockets).tolist()
        ends = tuple((place[start], place[end]) for start, end in self.ends)
        return FixturePlacement(self.points[sockets], ends, self.u)


def check_counts(
    sockets: int | Mapping, poses: int, parameters: int, u: float, lengths: Sequence[tuple], chains: int = 1
) -> None:
    """Raise `InputError` where there are too few poses, or an uncertainty is none."""
    for stated in (u, *(float(pair[2]) for pair in lengths if len(pair) > 2)):
        if not _U_RANGE[0] <= stated <= _U_RANGE[1]:
            raise InputError(
                f"u of a reference length is {stated:g} mm; give a standard uncertainty from {_U_RANGE[0]:g} to "
                f"{_U_RANGE[1]:g} mm."
            )
    number = len(sockets) if isinstance(sockets, Mapping) else sockets
    if number < 1 or poses < LEAST_POSES * number * chains:
        several = "" if chains == 1 else f" and {chains} chains"
        raise InputError(
            f"{poses} poses are too few for {number} sockets{several}; give at least one socket, and at least "
            f"{LEAST_POSES * chains} poses per socket."
        )
    unknowns = parameters + 3 * number - (len(lengths) if isinstance(sockets, Mapping) else number // 2)
    if 3 * poses < unknowns:
        raise InputError(
            f"{poses} poses in {number} sockets give fewer equations than the {unknowns} unknowns; plan at least "
            f"{-(-unknowns // 3)} poses."
        )


def given_placement(
    sockets: Mapping[str, Numbers], u: float, lengths: Sequence[tuple]
) -> tuple[list[str], FixturePlacement]:
    """Names and placement of sockets whose positions are given."""
    points = {name: np.asarray(socket_point(name, point)) for name, point in sockets.items()}
    names = list(points)
    for pair in lengths:
        for end in pair[:2]:
            if end not in names:
                raise InputError(
                    f"reference length {pair[0]}, {pair[1]} names the unknown socket '{end}'{nearest(end, names)}"
                )
    if len({frozenset(pair[:2]) for pair in lengths}) < len(lengths):
        raise InputError(
            "a reference length is given twice, but its certified value can be used only once; give each length once."
        )
    if any(len(set(pair[:2])) < 2 for pair in lengths):
        raise InputError("a reference length joins a socket to itself; give two different sockets.")
    for i, name in enumerate(names):
        for other in names[:i]:
            if np.linalg.norm(points[name] - points[other]) < 1:
                raise InputError(
                    f"sockets '{other}' and '{name}' are at the same position; move or remove one of the two."
                )
    ends = tuple((names.index(pair[0]), names.index(pair[1])) for pair in lengths)
    each_u = tuple(float(pair[2]) if len(pair) > 2 else u for pair in lengths)
    return names, FixturePlacement(np.array(list(points.values())), ends, each_u)


class Pool(NamedTuple):
    """Configurations in sockets, and what each measures of the parameters: derivatives of the tip, whitened."""

    q: Float[np.ndarray, "c n"]
    owner: Int[np.ndarray, " c"]  # index of each one's socket
    jacobian: Float[np.ndarray, "c 3 p"]  # by the parameters in natural steps, in standard deviations
    roots: Float[np.ndarray, "c 3 3"]  # that whiten the tips

    def at(self, rows: Any) -> "Pool":
        """Some of these configurations."""
        return Pool(*(part[rows] for part in self))

    def joined(self, other: "Pool") -> "Pool":
        """Both."""
        return Pool(*(np.concatenate(parts) for parts in zip(self, other, strict=True)))

    def fewest(self, problem: DesignProblem, sockets: int) -> int:
        """The number of configurations in the socket that has the fewest, of a robot by the chain that has."""
        chains = list(problem.region.chains) or [0]
        counts = np.bincount(problem.groups(self.q, self.owner), minlength=sockets * max(1, len(problem.arm.chains)))
        return int(counts.reshape(sockets, -1)[:, chains].min())


def pool_of(problem: DesignProblem, q: Float[np.ndarray, "c n"], owner: Int[np.ndarray, " c"]) -> Pool:
    """Configurations with their whitened derivatives."""
    geometry, noise = to_numpy((problem.arm.geometry, problem.noise))

    def whitening(rows: np.ndarray) -> np.ndarray:
        covariances = tip_covariances(geometry, joint_motion(geometry, rows), noise)
        return np.asarray(inverse_cholesky(np.moveaxis(np.asarray(covariances), -1, 0)))

    roots = in_chunks(whitening, q)
    jacobian = jacobian_at(problem.arm, q, problem.space.names) * np.asarray(problem.space.scale)
    return Pool(q, owner, roots @ jacobian, roots)


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
    return Candidates(rows, problem.groups(pool.q, pool.owner), base, p)


def best_placement(
    problem: DesignProblem, sockets: int, poses: int, length: tuple[float, float], u: float
) -> FixturePlacement:
    """The best placement found: random ones scored by random poses, the best few by chosen poses, then neighbours."""
    low, high = length
    if not 0 < low <= high < 2 * total_link_length(problem.arm):
        raise InputError(
            f"a reference length of {low:g} to {high:g} mm does not fit this arm; give a length shorter than the "
            "reach of the arm."
        )

    def report(fraction: float) -> None:
        problem.options.report("Placing the sockets", fraction)

    report(0.0)
    placements, scores = _random_placements(problem, sockets, length, u), []
    while len(scores) < len(placements):
        scores += _random_scores(problem, placements[len(scores) : len(scores) + _BLOCK], poses)
        report(0.4 * len(scores) / len(placements))
    shortlist = [placements[i] for i in np.argsort(scores) if np.isfinite(scores[i])][:_DESIGNED]
    if not shortlist:
        limited = problem.region.cell is not None or (problem.region.cones is not None and problem.region.cones.any)
        wider = ", wider cones, or fewer obstacles" if limited else ""
        raise InputError(
            "no placement was found in which the arm reaches all sockets in enough poses; give a region nearer to the "
            f"arm, or a shorter length{wider}."
        )
    starts = _STARTS // sockets * max(1, len(problem.region.chains))

    def pool_in(placement: FixturePlacement, best: FixturePlacement | None, pool: Pool | None) -> Pool:
        if best is None or pool is None:
            return pool_of(problem, *configurations_at(problem.region, placement.points, starts))
        return _moved_pool(problem, pool, best, placement, starts)

    def score(placement: FixturePlacement, pool: Pool) -> float:
        if pool.fewest(problem, sockets) < LEAST_POSES:
            return np.inf
        return relaxed_value(candidates_of(problem, placement, pool), poses, problem.objective, _ITERATIONS)

    return best_layout(shortlist, pool_in, score, lambda placement: _neighbour(problem, placement), _NEIGHBOURS, report)


def _random_placements(
    problem: DesignProblem, sockets: int, length: tuple[float, float], u: float
) -> list[FixturePlacement]:
    """Random placements of sockets within the region, two by two as the ends of the reference length."""
    random, pairs = problem.region.random, sockets // 2
    placements: list[FixturePlacement] = []
    ends = tuple((2 * i, 2 * i + 1) for i in range(pairs))
    for _ in range(60):
        drawn = problem.region.draw(40 * _PLACEMENTS * (pairs + 1))
        middle = in_chunks(lambda q: np.asarray(problem.arm.position(q)), drawn, _ROWS)
        direction = random.normal(size=middle.shape)
        size = np.exp(random.uniform(math.log(length[0]), math.log(length[1]), len(middle)))[:, None]
        half = 0.5 * size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        both = np.stack([middle - half, middle + half], axis=1)
        both = both[problem.contains(both).all(axis=1)]
        single = middle[problem.contains(middle)]
        for i in range(min(len(both) // max(pairs, 1), len(single))):
            points = np.concatenate([both[i * pairs : (i + 1) * pairs].reshape(-1, 3), single[i : i + sockets % 2]])
            placements.append(FixturePlacement(points, ends, (u,) * pairs))
            if len(placements) == _PLACEMENTS:
                return placements
    low, high = problem.options.ranges["z"]
    raise InputError(
        "no placement of the sockets and the reference length was found in the region "
        f"(z from {low:g} to {high:g} mm); widen the region, or shorten the length."
    )


def _random_scores(problem: DesignProblem, placements: Sequence[FixturePlacement], poses: int) -> list[float]:
    """The objective for so many random poses in each placement; infinite if a socket is hard to reach."""
    sockets = len(placements[0].points)
    points = np.concatenate([placement.points for placement in placements])
    starts = _FEW_STARTS * max(1, len(problem.region.chains))
    pool = pool_of(problem, *configurations_at(problem.region, points, starts))
    scores = []
    for number, placement in enumerate(placements):
        part = pool.at(pool.owner // sockets == number)
        part = part._replace(owner=part.owner % sockets)
        score = np.inf
        if part.fewest(problem, sockets) >= _REACHED * _FEW_STARTS:
            score = relaxed_value(candidates_of(problem, placement, part), poses, problem.objective, 0)
        scores.append(score)
    return scores


def _neighbour(problem: DesignProblem, placement: FixturePlacement) -> FixturePlacement | None:
    """A placement with one length, or single socket, shifted and rotated a little; None if that leaves the region."""
    random = problem.region.random
    points = placement.points.copy()
    fixtures = [list(pair) for pair in placement.ends]
    fixtures += [[i] for i in range(len(points)) if not any(i in pair for pair in fixtures)]
    moved = fixtures[random.integers(len(fixtures))]
    middle = points[moved].mean(axis=0)
    shift = random.normal(size=3) * _SHIFT * total_link_length(problem.arm)
    rotation = Rotation.from_rotvec(random.normal(size=3) * _ROTATION)
    points[moved] = middle + shift + rotation.apply(points[moved] - middle)
    return placement._replace(points=points) if problem.contains(points).all() else None


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
    return kept.joined(pool_of(problem, q[good], sockets[good]))
