"""Plans of calibrations: which poses to take in which sockets, and where to set up the reference length."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import with_options
from ..core.arrays import Numbers
from ..core.blas_threads import one_blas_thread
from ..core.errors import InputError, nearest
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..kinematics.arm import Arm
from ..kinematics.collisions import Cell
from ..kinematics.workspace import Cone, Cones, cones_of, configurations_at, reached
from ..uncertainty.identifiability import observability
from .designs import Candidates
from .motion import Motion, approaches, hardly_reached, ordered_motion
from .placement import (
    LEAST_POSES,
    FixturePlacement,
    Pool,
    best_placement,
    candidates_of,
    check_counts,
    given_placement,
    pool_of,
)
from .problem import LOOSE, Criterion, DesignProblem, PlanOptions, Prediction, best_poses, prediction_of, predictions

_CANDIDATES = 3000
_LEAST_CANDIDATES, _ROUNDS = 20, 5  # in a socket, from so many rounds of random starts at most
_RANDOM_SETS, _LOOSE_SETS = 50, 10  # of poses, for predictions


class Plan(NamedTuple):
    """Poses to take, in their order. Arrays are of NumPy: q in rad, positions in mm.

    Example:
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> print(planned.q.shape, planned.owner.shape, sorted(planned.sockets))
        (12, 6) (12,) ['A', 'B', 'C', 'D']
    """

    arm: Arm
    names: tuple[str, ...]  # free parameters
    sockets: dict[str, tuple[float, float, float]]  # in the order in which the arm visits them
    q: Float[np.ndarray, "N n"]  # of a robot, of all joints, those of other chains at rest, and the number of the chain
    # Index of each pose's socket; the poses of a socket follow each other, of a robot those of each chain in it.
    owner: Int[np.ndarray, " N"]
    lengths: tuple[ReferenceLength, ...]
    noise: Noise
    criterion: Criterion
    check_length: float  # length that predictions are of, mm
    predicted: Prediction
    random: Prediction  # median over sets of as many random poses in the same sockets
    loose: Prediction  # the same plan with joints off by 5 deg (standard deviation)
    more: Prediction  # with ten more poses
    unconstrained: Prediction | None  # without limits of height and direction, obstacles and approach points
    heights: tuple[float, float] | None  # range of z in which sockets were placed, mm; None where they were given
    cones: Cones  # of approach, in the order of the sockets
    cell: Cell | None  # what the poses keep clear of
    retract: float  # distance of the approach points from the sockets, mm; 0 where there are none
    motion: Motion

    def capture(self) -> Capture:
        """The plan as a noise-free capture."""
        return Capture({name: self.q[self.owner == i] for i, name in enumerate(self.sockets)}, self.lengths)


@with_options(PlanOptions)
@one_blas_thread
def plan(
    arm: Arm,
    *,
    sockets: int | Mapping[str, Numbers] = 4,
    poses: int = 30,
    length: float | tuple[float, float] = 500.0,
    u: float = 0.002,
    lengths: Sequence[tuple] = (),
    cone: Cone | Mapping[str, Cone] | None = None,
    **options: Any,
) -> Plan:
    """Choose the poses that determine an arm best in a joint calibration weighted by ``noise``.

    Candidate configurations reach the sockets from random starts; the best set is chosen by Fedorov's exchange (1972)
    and again among poses near the chosen ones. Poses outside their cone of approach, or
    that touch an obstacle or the arm itself, are no candidates. The order is one of little joint travel, socket after
    socket, in which the straight moves of the joints between poses hit nothing where there is such an order.

    Args:
        arm: The arm, not a batch.
        sockets: Number of sockets to place, two by two as the ends of the reference length; or name -> position
            ``(3,)`` in mm.
        poses: Number of poses in all sockets, at least two in each.
        length: Reference length to place, mm; or a range (shortest, longest) to choose it from.
        u: Standard uncertainty of the reference length, mm.
        lengths: ``(start, end)`` or ``(start, end, u)`` for each length between given sockets.
        cone: Directions from which the tool may come to the sockets: one `Cone` for all or socket name -> `Cone`; by
            default all directions, with (0, 0, 1) as the normal.
        **options: Fields of `PlanOptions`, like all arguments that are not named here: ``noise``, ``region``,
            ``margin``, ``cell``, ``candidates``, ``seed`` and others.

    Returns:
        The plan, with predicted uncertainties.

    Raises:
        InputError: A socket cannot be reached, no poses determine the parameters, or an argument is out of range.

    Example:
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> print(f"u of {planned.check_length:.0f} mm: {planned.predicted.largest:.2f} mm")
        u of 300 mm: 0.04 mm
        >>> print(planned.random.largest > 2 * planned.predicted.largest)  # with random poses about 0.1 mm
        True
    """
    problem = DesignProblem.of(arm, PlanOptions(**options))
    chains = max(1, len(problem.region.chains))
    check_counts(sockets, poses, len(problem.space.names), u, lengths, chains)
    if isinstance(sockets, Mapping):
        names, placement = given_placement(sockets, u, lengths)
    else:
        names = [chr(ord("A") + i) if sockets <= 26 else f"S{i + 1}" for i in range(sockets)]
        placement = None
        if lengths:
            raise InputError(
                "lengths can be given only between sockets with given positions; use length and u if only the number "
                "of sockets is given."
            )
    problem = problem.within(cones=_cones(cone, names, problem.options.tool_axis))
    span = (length, length) if isinstance(length, int | float) else length
    if placement is None:
        placement = best_placement(problem, len(names), poses, span, u)
    pool, q, owner = _chosen(problem, placement, names, poses)
    cones = problem.region.cones
    assert cones is not None
    groups = problem.groups(q, owner)
    order, motion = ordered_motion(problem.region, q, groups, cones.normals[owner], problem.options.retract)
    # From here on sockets have the order in which the arm visits them.
    visited = np.array(list(dict.fromkeys(owner[order].tolist())))
    place = np.argsort(visited)
    q, owner = q[order], place[owner[order]]
    placement, cones, pool = placement.in_order(visited), cones.at(visited), pool._replace(owner=place[pool.owner])
    if isinstance(sockets, Mapping) or isinstance(cone, Mapping):  # otherwise names are given out in their order
        names = [names[i] for i in visited]
    problem = problem.within(cones=cones)
    distances = [float(np.linalg.norm(placement.points[b] - placement.points[a])) for a, b in placement.ends]
    rows = zip(placement.ends, distances, placement.u, strict=True)
    planned = Plan(
        arm=problem.arm,
        names=problem.space.names,
        sockets={name: (x, y, z) for name, (x, y, z) in zip(names, placement.points.tolist(), strict=True)},
        q=q,
        owner=owner,
        lengths=tuple(ReferenceLength(names[a], names[b], distance, u) for (a, b), distance, u in rows),
        noise=problem.noise,
        criterion=problem.options.criterion,
        check_length=problem.check_length,
        **_predictions(problem, placement, pool, q, owner),
        unconstrained=None,
        heights=None if isinstance(sockets, Mapping) else problem.options.ranges["z"],
        cones=cones,
        cell=problem.region.cell,
        retract=problem.options.retract,
        motion=motion,
    )
    unseen = observability(problem.arm, planned.capture(), problem.space)
    if unseen.rank < len(problem.space.names):
        raise InputError(
            f"{poses} poses in these sockets cannot determine all parameters. {' '.join(unseen.sentences())}"
        )
    if problem.options.unconstrained:
        free = problem.without_limits()
        if planned.heights:
            placement = best_placement(free, len(names), poses, span, u)
        _, q, owner = _chosen(free, placement, names, poses)
        anywhere = prediction_of(free, candidates_of(free, placement, pool_of(free, q, owner)))
        # Without limits, the plan itself is possible too: where the search finds nothing better, they cost nothing.
        best = min(anywhere, planned.predicted, key=lambda prediction: prediction.largest)
        planned = planned._replace(unconstrained=best)
    return planned


def _cones(
    cone: Cone | Mapping[str, Cone] | None, names: Sequence[str], tool_axis: tuple[float, float, float]
) -> Cones:
    """The cone of each socket; a socket without one has the normal (0, 0, 1) and every direction."""
    if isinstance(cone, Mapping):
        for name in cone:
            if name not in names:
                raise InputError(f"a cone is given for the unknown socket '{name}'{nearest(str(name), names)}")
    by_name = cone if isinstance(cone, Mapping) else dict.fromkeys(names, cone or Cone())
    return cones_of([by_name.get(name, Cone()) for name in names], tool_axis)


def _chosen(
    problem: DesignProblem, placement: FixturePlacement, names: Sequence[str], poses: int
) -> tuple[Pool, Float[np.ndarray, "N n"], Int[np.ndarray, " N"]]:
    """The candidates for a placement, and the best poses found."""
    region, retract = problem.region, problem.options.retract

    def possible(q: np.ndarray, owner: np.ndarray) -> Pool:
        """Those of the configurations that have an approach point."""
        if retract and region.cones is not None:
            _, good = approaches(region, q, region.cones.normals[owner], retract)
            q, owner = q[good], owner[good]
        return pool_of(problem, q, owner)

    def near(chosen: Pool) -> Pool:
        starts, which = problem.near(chosen.q)
        owner = chosen.owner[which]
        q, good = reached(region, starts, placement.points[owner], sockets=owner)
        return chosen.joined(possible(q[good], owner[good]))

    starts, chains = max((problem.options.candidates or _CANDIDATES) // len(names), 50), max(1, len(region.chains))
    pool = possible(*configurations_at(region, placement.points, starts * chains))
    for _ in range(1, _ROUNDS):
        counts = np.bincount(problem.groups(pool.q, pool.owner))
        if np.sum(counts >= _LEAST_CANDIDATES) == len(names) * chains:
            break
        pool = pool.joined(possible(*configurations_at(region, placement.points, starts * chains)))
    counts = np.bincount(problem.groups(pool.q, pool.owner), minlength=len(names) * max(1, len(problem.arm.chains)))
    # A chain takes no poses in sockets out of its reach.
    often = np.asarray(counts >= _LEAST_CANDIDATES)
    by_chain = often.reshape(len(names), -1)
    few = np.flatnonzero(~np.any(by_chain, axis=1))
    if len(few):
        raise InputError(hardly_reached(f"socket '{names[few[0]]}'", placement.points[few[0]]))
    reaching = np.atleast_1d(np.any(by_chain, axis=0))
    for number in region.chains:
        if not reaching[number]:
            raise InputError(
                f"chain '{problem.arm.chains[number][0]}' reaches none of the sockets in enough poses; move a socket, "
                "or leave out the chain (chains= or --chain)."
            )
    pool = pool.at(often[problem.groups(pool.q, pool.owner)])
    least = LEAST_POSES * often[: problem.groups(pool.q, pool.owner).max() + 1]
    chosen = best_poses(
        problem, pool, poses, least, lambda pool: candidates_of(problem, placement, pool), Pool.at, near
    )
    return pool, chosen.q, chosen.owner


def _predictions(
    problem: DesignProblem,
    placement: FixturePlacement,
    pool: Pool,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
) -> dict[str, Prediction]:
    """For the plan, random poses in its sockets, imprecise poses, and ten more poses."""
    planned = candidates_of(problem, placement, pool_of(problem, q, owner))

    def loose() -> Iterator[Candidates]:
        region, owners, many = problem.region, np.tile(owner, _LOOSE_SETS), np.tile(q, (_LOOSE_SETS, 1))
        starts = problem.moved(many, LOOSE)
        near, possible = reached(region, starts, placement.points[owners], sockets=owners)
        poses = pool_of(problem, np.where(possible[:, None], near, many), owners)
        for rows in np.split(candidates_of(problem, placement, poses).rows, _LOOSE_SETS):
            yield planned._replace(rows=rows)

    return predictions(problem, planned, candidates_of(problem, placement, pool), loose(), _RANDOM_SETS)
