"""Plans of calibrations: which poses to take in which sockets, and where to set up the reference length."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.simulation import socket_point
from ..kinematics.arm import Arm, is_single, jacobian_at, joint_limits
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import SearchRegion, reached, search_region, total_link_length
from ..uncertainty.identifiability import observability
from ..uncertainty.volume import default_length, sample_lengths
from .fedorov_exchange import Candidates, Kind, Objective, covariance_of, exchange
from .placement import (
    LEAST_POSES,
    DesignProblem,
    FixturePlacement,
    Pool,
    Ranges,
    candidates_of,
    check_region,
    designed_score,
    moved_pool,
    neighbour,
    pool_at,
    pool_of,
    random_placements,
    random_scores,
)
from .pose_refinement import refined

Criterion = Literal["length", "A", "D", "E"]
MORE = 10  # poses added in the prediction `Plan.more`
SMALL_ARM = Noise(encoder_arcsec=2.0, seating=0.005)  # a small commercial arm
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
_LEAST_CANDIDATES = 20  # in a socket
_RANDOM_SETS, _LOOSE_SETS = 50, 10
_LOOSE = math.radians(5)
_U_RANGE = (1e-6, 100.0)  # mm

Progress = Callable[[str, float], None]


class Prediction(NamedTuple):
    """Median and largest standard uncertainty that the calibration would add to lengths over the volume, mm."""

    median: float
    largest: float


class Plan(NamedTuple):
    """Poses to take. Arrays are of NumPy: q in rad, positions in mm."""

    arm: Arm
    names: tuple[str, ...]  # free parameters
    sockets: dict[str, tuple[float, float, float]]
    q: Float[np.ndarray, "N n"]
    owner: Int[np.ndarray, " N"]  # index of each pose's socket
    lengths: tuple[ReferenceLength, ...]
    noise: Noise
    criterion: Criterion
    check_length: float  # length that predictions are of, mm
    predicted: Prediction
    random: Prediction  # median over sets of as many random poses in the same sockets
    loose: Prediction  # the same plan with joints off by 5 deg (standard deviation)
    more: Prediction  # with ten more poses

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
    space: Parameters | None = None,
    noise: Noise = SMALL_ARM,
    criterion: Criterion = "length",
    margin: float = math.radians(5),
    above: float = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    candidates: int = 3000,
    check_length: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Choose the poses that determine an arm best in a joint calibration weighted by ``noise``.

    Candidate configurations reach the sockets from random starts; the best set is chosen by Fedorov's exchange (1972)
    and then refined by a gradient method with the tips kept in their sockets. Obstacles, the arm's own body and the
    side from which a socket can be entered are not considered.

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
        space: Free parameters (default: those of `Parameters.free_of`).
        noise: Noise of the readings, which weights them.
        criterion: "length" (largest uncertainty of a length over the volume); or "A", "D", "E" of the parameters'
            covariance in natural steps (1 mm, 1 mrad).
        margin: Distance of the joints from their limits, rad.
        above: Height in the base frame below which no joint and no tip comes (the table), mm; ``-math.inf`` for none.
        limits: Lowest and highest reading of each joint, rad (default: the arm's own).
        candidates: Number of candidate configurations.
        check_length: Length that predictions are of, mm (as in `volumetric_uncertainty`).
        seed: Seed of the search.
        progress: Called with the name of the stage and the fraction of it that is done.

    Returns:
        The plan, with predicted uncertainties.

    Raises:
        InputError: A socket cannot be reached, no poses determine the parameters, or an argument is out of range.
    """
    report = progress or (lambda stage, fraction: None)
    if not is_single(arm):
        raise InputError("plan takes one arm, not a batch; give one of its arms.")
    space = Parameters.free_of(arm) if space is None else space
    if arm.beta is None and space.base.beta is not None:  # free, and 0 so far
        arm = arm.replace(beta=np.zeros(arm.joints))
    check_length = default_length(arm) if check_length is None else check_length
    check_plannable(arm, criterion, noise)
    _check_counts(sockets, poses, len(space.names), u, lengths)
    ranges = {"z": (0.0, np.inf)} if region is None else region
    own = (length, length) if isinstance(length, int | float) else length
    if isinstance(sockets, Mapping):
        names, placement = _given_placement(sockets, u, lengths)
    else:
        names = [chr(ord("A") + i) if sockets <= 26 else f"S{i + 1}" for i in range(sockets)]
        placement = None
        _check_ranges(arm, own, lengths, ranges)
    problem, predicted_functions = design_problem(
        search_region(to_numpy(arm), limits, margin, above, seed),
        to_numpy(space),
        to_numpy(noise),
        criterion,
        dict(length=check_length, limits=joint_limits(arm, limits)),
        seed,
    )
    if placement is None:
        placement = _best_placement(problem, len(names), poses, own, u, ranges, report)
    pool = _pool(problem, placement, candidates)
    possible = candidates_of(problem, placement, pool)
    rows = exchange(
        possible, poses, problem.objective, least=LEAST_POSES, progress=lambda done: report("Choosing poses", done)
    )
    q, owner = _sorted(pool.q[rows], pool.owner[rows])
    q = refined(problem, placement, q, owner, lambda done: report("Moving poses", done))
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
        **_predictions(problem, placement, possible, q, owner, predicted_functions),
    )
    unseen = observability(arm, found.capture(), space)
    if unseen.rank < len(space.names):
        raise InputError(f"no {poses} poses in these sockets determine the parameters. {' '.join(unseen.sentences())}")
    return found


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


def _check_counts(sockets: int | Mapping, poses: int, parameters: int, u: float, lengths: Sequence[tuple]) -> None:
    for own in (u, *(float(pair[2]) for pair in lengths if len(pair) > 2)):
        if not _U_RANGE[0] <= own <= _U_RANGE[1]:
            raise InputError(
                f"u of a reference length is {own:g} mm; give a standard uncertainty from {_U_RANGE[0]:g} to "
                f"{_U_RANGE[1]:g} mm."
            )
    number = len(sockets) if isinstance(sockets, Mapping) else sockets
    if number < 1 or poses < LEAST_POSES * number:
        raise InputError(
            f"{poses} poses are too few for {number} sockets; give one socket or more, and {LEAST_POSES} poses in each."
        )
    unknowns = parameters + 3 * number - (len(lengths) if isinstance(sockets, Mapping) else number // 2)
    if 3 * poses < unknowns:
        raise InputError(
            f"{poses} poses in {number} sockets give fewer equations than the {unknowns} unknowns; take "
            f"{-(-unknowns // 3)} at least."
        )


def _given_placement(
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
        raise InputError("a reference length is named twice; its certified value counts once, so name it once.")
    if any(len(set(pair[:2])) < 2 for pair in lengths):
        raise InputError("a reference length joins a socket to itself; name two different sockets.")
    for i, one in enumerate(names):
        for other in names[:i]:
            if np.linalg.norm(points[one] - points[other]) < 1:
                raise InputError(f"sockets '{other}' and '{one}' are in the same position; move one, or leave it out.")
    ends = tuple((names.index(pair[0]), names.index(pair[1])) for pair in lengths)
    own = tuple(float(pair[2]) if len(pair) > 2 else u for pair in lengths)
    return names, FixturePlacement(np.array(list(points.values())), ends, own)


def _check_ranges(arm: Arm, length: tuple[float, float], lengths: Sequence[tuple], ranges: Ranges) -> None:
    """Raise `InputError` where the sockets cannot be placed."""
    if lengths:
        raise InputError("lengths are between sockets that are given; with a number of sockets, give length and u.")
    check_region(ranges)
    low, high = length
    if not 0 < low <= high < 2 * total_link_length(arm):
        raise InputError(
            f"a reference length of {low:g} to {high:g} mm does not fit this arm; give one shorter than its reach."
        )


def _best_placement(
    problem: DesignProblem,
    sockets: int,
    poses: int,
    length: tuple[float, float],
    u: float,
    ranges: Ranges,
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
        raise InputError(
            "no placement was found that can be reached well; give a region nearer to the arm, or a shorter length."
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


def _pool(problem: DesignProblem, placement: FixturePlacement, count: int) -> Pool:
    """Configurations to choose from."""
    pool = pool_at(problem, placement.points, max(count // len(placement.points), 50))
    for i, point in enumerate(placement.points):
        if np.sum(pool.owner == i) < _LEAST_CANDIDATES:
            where = ", ".join(f"{round(float(x)):.6g}" for x in point)
            raise InputError(
                f"socket {i + 1} at ({where}) mm cannot be reached in enough poses within the joint limits and their "
                "margin; move it."
            )
    return pool


def _sorted(q: Float[np.ndarray, "N n"], owner: Int[np.ndarray, " N"]) -> tuple[np.ndarray, np.ndarray]:
    order = order_of(q, owner)
    return q[order], owner[order]


def order_of(q: Float[np.ndarray, "N n"], owner: Int[np.ndarray, " N"]) -> list[int]:
    """Socket after socket, and in each from pose to nearest pose, so that the arm moves little."""
    order: list[int] = []
    for socket in range(owner.max() + 1):
        left = np.flatnonzero(owner == socket).tolist()
        current = min(left, key=lambda i: np.abs(q[i]).sum())
        while left:
            left.remove(current)
            order.append(current)
            if left:
                current = min(left, key=lambda i: np.abs(q[i] - q[current]).max())
    return order


def _predictions(
    problem: DesignProblem,
    placement: FixturePlacement,
    pool: Candidates,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    functions: Float[np.ndarray, "v p"],
) -> dict[str, Prediction]:
    """Predictions for the plan, for random poses in its sockets, for imprecise poses, and for ten more poses."""
    region, random = problem.region, problem.region.random

    def predicted(rows: Float[np.ndarray, "m 3 P"]) -> Prediction:
        covariance = covariance_of(pool.information(rows), pool.parameters)
        u = np.sqrt(np.einsum("vp,pq,vq->v", functions, covariance, functions))
        return Prediction(float(np.median(u)), float(u.max()))

    def typical(sets: list[Prediction]) -> Prediction:
        return Prediction(*(float(np.median(column)) for column in zip(*sets, strict=True)))

    planned = candidates_of(problem, placement, pool_of(problem, q, owner))
    counts = np.bincount(owner, minlength=len(placement.points))
    random_sets = []
    for _ in range(_RANDOM_SETS):
        rows = [random.choice(np.flatnonzero(pool.owner == i), count) for i, count in enumerate(counts)]
        random_sets.append(predicted(pool.rows[np.concatenate(rows)]))
    starts = np.tile(q, (_LOOSE_SETS, 1)) + _LOOSE * random.normal(size=(_LOOSE_SETS * len(q), q.shape[1]))
    owners = np.tile(owner, _LOOSE_SETS)
    near, possible = reached(region, starts, placement.points[owners])
    near = np.where(possible[:, None], near, np.tile(q, (_LOOSE_SETS, 1)))
    loose = candidates_of(problem, placement, pool_of(problem, near, owners)).rows
    loose_sets = [predicted(rows) for rows in np.split(loose, _LOOSE_SETS)]
    base = planned.information(planned.rows)
    added = exchange(pool._replace(base=base), MORE, problem.objective, least=0, sweeps=1)
    return {
        "predicted": predicted(planned.rows),
        "random": typical(random_sets),
        "loose": typical(loose_sets),
        "more": predicted(np.concatenate([planned.rows, pool.rows[added]])),
    }
