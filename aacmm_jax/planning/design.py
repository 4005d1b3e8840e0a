"""Plans of calibrations: which poses to take in which sockets, and where to set up the reference length."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.arm_classes import small_arm_noise
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..kinematics.arm import Arm, is_single, jacobian_at, joint_limits
from ..kinematics.collisions import Cell
from ..kinematics.cones import TOOL_AXIS, Cone, Cones
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import SearchRegion, search_region, total_link_length
from ..uncertainty.identifiability import observability
from ..uncertainty.volume import default_length, sample_lengths
from .fedorov_exchange import Kind, Objective, exchange
from .motion import Motion, approaches, ordered_motion
from .placement import (
    FARTHEST,
    LEAST_POSES,
    DesignProblem,
    FixturePlacement,
    PlacementRegion,
    Pool,
    Ranges,
    candidates_of,
    designed_score,
    in_order,
    moved_pool,
    neighbour,
    placement_region,
    pool_at,
    pool_of,
    random_placements,
    random_scores,
)
from .plan_arguments import (
    check_counts,
    check_ranges,
    check_retract,
    checked_cones,
    given_placement,
    planned_parameters,
    with_table,
)
from .pose_refinement import refined
from .predictions import Prediction, prediction_of, predictions
from .unreachable import explained

Criterion = Literal["length", "A", "D", "E"]
OBJECTIVES: dict[Criterion, tuple[Kind, float]] = {
    "length": ("functions", 8.0),
    "A": ("trace", 0.0),
    "D": ("determinant", 8.0),
    "E": ("trace", 8.0),
}
_OBJECTIVE_LENGTHS, _PREDICTION_LENGTHS = 300, 400  # predictions use other lengths than the objective
# Random placements, those of them for which poses are chosen, tried neighbours of the best, and starts for each.
_PLACEMENTS, _DESIGNED, _NEIGHBOURS, _STARTS = 600, 10, 200, 1000
_BLOCK = 25  # placements scored together
_LEAST_CANDIDATES, _ROUNDS = 20, 5  # in a socket, from so many rounds of random starts at most

Progress = Callable[[str, float], None]


class Plan(NamedTuple):
    """Poses to take, in their order. Arrays are of NumPy: q in rad, positions in mm.

    Example:
        >>> planned = aj.planning.plan(arm, sockets=four, poses=12, lengths=bars, candidates=60)
        >>> print(planned.q.shape, planned.owner[:4], sorted(planned.sockets))
        (12, 6) [0 0 1 1] ['A', 'B', 'C', 'D']
    """

    arm: Arm
    names: tuple[str, ...]  # free parameters
    sockets: dict[str, tuple[float, float, float]]  # in the order in which the arm visits them
    q: Float[np.ndarray, "N n"]
    owner: Int[np.ndarray, " N"]  # index of each pose's socket; the poses of a socket follow each other
    lengths: tuple[ReferenceLength, ...]
    noise: Noise
    criterion: Criterion
    check_length: float  # length that predictions are of, mm
    predicted: Prediction
    random: Prediction  # median over sets of as many random poses in the same sockets
    loose: Prediction  # the same plan with joints off by 5 deg (standard deviation)
    more: Prediction  # with ten more poses
    unconstrained: Prediction | None  # for the same sockets without cones, obstacles and approach points
    cones: Cones  # of approach, in the order of the sockets
    cell: Cell | None  # what the poses keep clear of
    retract: float  # distance of the approach points from the sockets, mm; 0 where there are none
    motion: Motion

    def capture(self) -> Capture:
        """The plan as a noise-free capture."""
        return Capture({name: self.q[self.owner == i] for i, name in enumerate(self.sockets)}, self.lengths)


def plan(
    arm: Arm,
    *,
    sockets: int | Mapping[str, Numbers] = 4,
    poses: int = 30,
    length: float | tuple[float, float] = 500.0,
    u: float = 0.002,
    lengths: Sequence[tuple] = (),
    region: Ranges | None = None,
    farthest: float = FARTHEST,
    space: Parameters | None = None,
    noise: Noise | None = None,
    criterion: Criterion = "length",
    margin: float = math.radians(5),
    above: float = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    cone: Cone | Mapping[str, Cone] | None = None,
    tool_axis: tuple[float, float, float] = TOOL_AXIS,
    cell: Cell | None = None,
    retract: float = 0.0,
    unconstrained: bool = False,
    candidates: int = 3000,
    check_length: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Choose the poses that determine an arm best in a joint calibration weighted by ``noise``.

    Candidate configurations reach the sockets from random starts; the best set is chosen by Fedorov's exchange (1972)
    and then refined by a gradient method with the tips kept in their sockets. Poses outside their cone of approach, or
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
        region: Ranges of ``x``, ``y``, ``z`` and of the ``distance`` from the origin for placed sockets, mm (default:
            z at least 0).
        farthest: Largest distance of placed sockets from the shoulder, as a part of the reach.
        space: Free parameters (default: those of `Parameters.free_of`).
        noise: Noise of the readings, which weights them; by default that of a small measuring arm.
        criterion: "length" (largest uncertainty of a length over the volume); or "A", "D", "E" of the parameters'
            covariance in natural steps (1 mm, 1 mrad).
        margin: Distance of the joints from their limits, rad.
        above: Height in the base frame below which no joint and no tip comes (the table), mm; ``-math.inf`` for none.
            With a ``cell`` the body's capsules stay above it too.
        limits: Lowest and highest reading of each joint, rad (default: the arm's own).
        cone: Directions from which the tool may come to the sockets: one `Cone` for all or socket name -> `Cone`; by
            default all directions, with (0, 0, 1) as the normal.
        tool_axis: Axis of the last frame that points from the tool into a socket.
        cell: The arm's body and the obstacles that it may not touch; by default nothing is checked.
        retract: Distance along the normal from the socket to the approach point of each pose, mm; 0 for none.
        unconstrained: Whether to predict also what poses in the same sockets without cones, cell and approach points
            would give.
        candidates: Number of candidate configurations.
        check_length: Length that predictions are of, mm (as in `volumetric_uncertainty`).
        seed: Seed of the search.
        progress: Called with the name of the stage and the fraction of it that is done.

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
    report = progress or (lambda stage, fraction: None)
    if not is_single(arm):
        raise InputError("plan takes one arm, not a batch; give one of its arms.")
    space = planned_parameters(Parameters.free_of(arm) if space is None else space)
    if arm.beta is None and space.base.beta is not None:  # free, and 0 so far
        arm = arm.replace(beta=np.zeros(arm.joints))
    check_length = default_length(arm) if check_length is None else check_length
    noise = small_arm_noise() if noise is None else noise
    check_plannable(arm, criterion, noise)
    check_counts(sockets, poses, len(space.names), u, lengths)
    check_retract(retract)
    ranges = placement_region(to_numpy(arm), region, farthest)
    own = (length, length) if isinstance(length, int | float) else length
    if isinstance(sockets, Mapping):
        names, placement = given_placement(sockets, u, lengths)
    else:
        names = [chr(ord("A") + i) if sockets <= 26 else f"S{i + 1}" for i in range(sockets)]
        placement = None
        check_ranges(arm, own, lengths, ranges.ranges)
    cones = checked_cones(cone, names, tool_axis)
    problem, functions = design_problem(
        search_region(to_numpy(arm), limits, margin, above, seed, cones, with_table(cell, above)),
        to_numpy(space),
        to_numpy(noise),
        criterion,
        dict(length=check_length, limits=joint_limits(arm, limits)),
        seed,
    )
    if placement is None:
        placement = _best_placement(problem, len(names), poses, own, u, ranges, report)
    pool, q, owner = _chosen(problem, placement, names, poses, candidates, retract, report)
    order, motion = ordered_motion(problem.region, q, owner, cones.normals[owner], retract)
    visited = np.array(list(dict.fromkeys(owner[order].tolist())))
    q, owner = q[order], np.argsort(visited)[owner[order]]
    placement, cones = in_order(placement, visited), cones.at(visited)
    if isinstance(sockets, Mapping) or isinstance(cone, Mapping):  # otherwise names are given out in their order
        names = [names[i] for i in visited]
    problem = problem._replace(region=problem.region._replace(cones=cones))
    possible = candidates_of(problem, placement, pool._replace(owner=np.argsort(visited)[pool.owner]))
    found = Plan(
        arm=arm,
        names=space.names,
        sockets={name: (x, y, z) for name, (x, y, z) in zip(names, placement.points.tolist(), strict=True)},
        q=q,
        owner=owner,
        lengths=tuple(
            ReferenceLength(names[a], names[b], float(np.linalg.norm(placement.points[b] - placement.points[a])), u)
            for (a, b), u in zip(placement.ends, placement.u, strict=True)
        ),
        noise=noise,
        criterion=criterion,
        check_length=check_length,
        **predictions(problem, placement, possible, q, owner, functions),
        unconstrained=None,
        cones=cones,
        cell=problem.region.cell,
        retract=retract,
        motion=motion,
    )
    unseen = observability(arm, found.capture(), space)
    if unseen.rank < len(space.names):
        raise InputError(f"no {poses} poses in these sockets determine the parameters. {' '.join(unseen.sentences())}")
    if unconstrained:
        free = problem._replace(region=problem.region._replace(cones=None, cell=None))
        _, q, owner = _chosen(free, placement, names, poses, candidates, 0.0, report)
        at = candidates_of(free, placement, pool_of(free, q, owner))
        found = found._replace(unconstrained=prediction_of(at, at.rows, functions))
    return found


def _chosen(
    problem: DesignProblem,
    placement: FixturePlacement,
    names: Sequence[str],
    poses: int,
    count: int,
    retract: float,
    report: Progress,
) -> tuple[Pool, Float[np.ndarray, "N n"], Int[np.ndarray, " N"]]:
    """The candidates for a placement, and the best poses found."""
    region = problem.region

    def approachable(q: np.ndarray, owner: np.ndarray) -> Bool[np.ndarray, " c"]:
        if not retract or region.cones is None:
            return np.ones(len(q), dtype=bool)
        return approaches(region, q, region.cones.normals[owner], retract).possible

    each, pools = max(count // len(names), 50), []
    for _ in range(_ROUNDS):
        drawn = pool_at(problem, placement.points, each)
        pools.append(drawn.at(approachable(drawn.q, drawn.owner)))
        pool = Pool(*(np.concatenate(parts) for parts in zip(*pools, strict=True)))
        few = np.flatnonzero(np.bincount(pool.owner, minlength=len(names)) < _LEAST_CANDIDATES)
        if not len(few):
            break
    else:
        share = _LEAST_CANDIDATES / (_ROUNDS * each)
        raise InputError(explained(region, names, placement.points, int(few[0]), share, retract))
    possible = candidates_of(problem, placement, pool)
    rows = exchange(
        possible, poses, problem.objective, least=LEAST_POSES, progress=lambda done: report("Choosing poses", done)
    )
    owner = pool.owner[rows]
    q = refined(problem, placement, pool.q[rows], owner, lambda done: report("Moving poses", done), approachable)
    return pool, q, owner


def design_problem(
    region: SearchRegion, space: Parameters, noise: Noise, criterion: Criterion, sampling: dict[str, Any], seed: int
) -> tuple[DesignProblem, Float[np.ndarray, "v p"]]:
    """The problem, and derivatives of other lengths than those of its objective, for predictions."""
    of_objective, of_predictions = (
        _length_derivatives(region.arm, space, *sample_lengths(region.arm, count, **sampling, seed=seed + offset))
        for offset, count in ((1, _OBJECTIVE_LENGTHS), (2, _PREDICTION_LENGTHS))
    )
    kind, power = OBJECTIVES[criterion]
    return DesignProblem(region, space, noise, Objective(kind, of_objective, power)), of_predictions


def _length_derivatives(
    arm: Arm, space: Parameters, start: Float[np.ndarray, "v n"], end: Float[np.ndarray, "v n"]
) -> Float[np.ndarray, "v p"]:
    """Derivatives of the lengths between configurations by the free parameters, in natural steps."""
    between = np.asarray(arm.position(end)) - np.asarray(arm.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    jacobian = jacobian_at(arm, end, space.names) - jacobian_at(arm, start, space.names)
    return np.einsum("vc,vcp->vp", direction, jacobian) * np.asarray(space.scale)


def check_plannable(arm: Arm, criterion: str, noise: Noise) -> None:
    """Raise `InputError` where there is nothing to plan, or no such criterion."""
    if arm.joints < 3 or total_link_length(arm) == 0:
        raise InputError("this arm reaches no volume: it needs three joints and a link; there is nothing to plan.")
    if criterion not in OBJECTIVES:
        raise InputError(f"criterion is '{criterion}'; it must be one of {', '.join(OBJECTIVES)}.")
    noise.check(arm.joints)


def _best_placement(
    problem: DesignProblem,
    sockets: int,
    poses: int,
    length: tuple[float, float],
    u: float,
    ranges: PlacementRegion,
    report: Progress,
) -> FixturePlacement:
    """The best placement found: random ones scored by random poses, the best few by chosen poses, then neighbours."""
    stage = "Placing the sockets"
    report(stage, 0.0)
    placements = random_placements(problem, _PLACEMENTS, sockets, length, u, ranges)
    scores: list[float] = []
    while len(scores) < len(placements):
        scores += random_scores(problem, placements[len(scores) : len(scores) + _BLOCK], poses)
        report(stage, 0.4 * len(scores) / len(placements))
    order = [i for i in np.argsort(scores) if np.isfinite(scores[i])][:_DESIGNED]
    if not order:
        limited = problem.region.cell is not None or (problem.region.cones is not None and problem.region.cones.any)
        wider = ", wider cones, or fewer obstacles" if limited else ""
        raise InputError(
            "no placement was found that can be reached well; give a region nearer to the arm, or a shorter "
            f"length{wider}."
        )
    each = _STARTS // sockets
    best, best_pool, best_score = placements[order[0]], None, np.inf
    tries = len(order) + _NEIGHBOURS
    for number in range(tries):
        report(stage, 0.4 + 0.6 * number / tries)
        if best_pool is None or number < len(order):
            placement = placements[order[min(number, len(order) - 1)]]
            pool = pool_at(problem, placement.points, each)
        else:
            placement = neighbour(problem, best, ranges)
            if placement is None:
                continue
            pool = moved_pool(problem, best_pool, best, placement, each)
        score = designed_score(problem, placement, pool, poses)
        if score < best_score:
            best, best_pool, best_score = placement, pool, score
    report(stage, 1.0)
    return best
