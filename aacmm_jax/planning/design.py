"""Which poses to take, in which sockets, and where the reference length should stand: before the arm is touched."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.simulation import socket_point
from ..kinematics.arm import Arm, is_single, jacobian_at, joint_limits
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import configurations_at, lowest_point, total_link_length
from ..uncertainty.identifiability import observability
from ..uncertainty.volume import default_length, sample_lengths
from .fedorov_exchange import Candidates, Goal, covariance_of, exchange
from .placement import Place, Scene, beside, candidates_of, places, worth
from .pose_refinement import refined

Criterion = Literal["length", "A", "D", "E"]
CRITERIA = ("length", "A", "D", "E")
NOISE = Noise(encoder_arcsec=2.0, seating=0.005)  # of a small commercial arm
MORE = 10  # poses
_CHECKS, _CHECKED = 300, 400  # lengths that the criterion looks at; predictions look at others, and more
_PLACES, _TRIED_WELL, _MOVED, _AT_FIRST = 600, 10, 110, 1000
_POWER = 8.0  # nearly the largest
_RANDOM_SETS, _LOOSE_SETS = 50, 10
_LOOSE = math.radians(5)
_U = (1e-6, 100.0)  # mm
_LEAST = 2  # poses in a socket: one shows no scatter


class Prediction(NamedTuple):
    """Standard uncertainty that the calibration would add to lengths over the volume, mm: half of them stay below the median."""

    median: float
    largest: float


class Plan(NamedTuple):
    """Poses to take. Arrays are NumPy's: q in rad, positions in mm."""

    arm: Arm
    names: tuple[str, ...]  # free parameters
    sockets: dict[str, tuple[float, float, float]]
    q: Float[np.ndarray, "N n"]
    owner: Int[np.ndarray, " N"]  # which socket each pose is in
    lengths: tuple[ReferenceLength, ...]
    noise: Noise
    criterion: Criterion
    check_length: float  # of the lengths that predictions are of, mm
    predicted: Prediction
    random: Prediction  # median over sets of as many random poses in the same sockets
    loose: Prediction  # the same plan with its joints kept to 5 deg (standard deviation) only
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
    region: Mapping[str, tuple[float, float]] | None = None,
    space: Parameters | None = None,
    noise: Noise = NOISE,
    criterion: Criterion = "length",
    margin: float = math.radians(5),
    above: float = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    candidates: int = 3000,
    check_length: float | None = None,
    seed: int = 0,
    tell: Callable[[str, float], None] | None = None,
) -> Plan:
    """Poses that determine an arm best, for a joint calibration weighed by ``noise``.

    - ``sockets``: how many to place, two by two as the ends of the reference length; or name -> position (mm), then with
      ``lengths`` ``("A", "B")`` or ``("A", "B", u)`` between them.
    - ``poses``: how many in all, at least two in every socket.
    - ``length`` and ``u``: the reference length and its standard uncertainty, mm; a range (shortest, longest) lets it be chosen.
    - ``region``: where sockets may stand, mm: ranges of ``x``, ``y``, ``z`` and of the ``distance`` from the origin (default:
      in reach, and z at least 0).
    - ``criterion``: "length" (the largest uncertainty of a length over the volume), or A, D, E of the parameters' covariance in
      natural steps (1 mm, 1 mrad).
    - ``margin``: how far from their limits joints stay, rad. ``limits`` as in `simulate`.
    - ``above``: height in the base frame, mm, below which no joint and no tip comes (the table; ``-math.inf`` where there is none).
      Obstacles, the arm's own body and the side from which a socket can be entered are not looked at.
    - ``candidates``: poses to choose from. ``check_length``: mm; predictions are of such lengths (as in `over_volume`).
    - ``tell`` is called with what is being done and the share of it that is done.

    Candidate poses reach their sockets from random starts; some are chosen by exchange (Fedorov 1972) and then moved, their tips
    kept in place, by a gradient method. Raises `InputError` for what cannot be reached or cannot determine the parameters.
    """
    tell = tell or (lambda what, share: None)
    space = Parameters.free_of(arm) if space is None else space
    check_length = default_length(arm) if check_length is None else check_length
    scene = _scene(arm, space, noise, criterion, (margin, above), limits, check_length, seed)
    region = {"z": (0.0, np.inf)} if region is None else region
    names, choices = _choices(scene, sockets, poses, length, u, lengths, region)
    tell("Placing the sockets", 0.0)
    place, given = _chosen_place(scene, choices, poses, candidates, region, tell)
    rows = exchange(given.candidates, poses, scene.goal, least=_LEAST, tell=lambda share: tell("Choosing poses", share))
    q, owner = _sorted(*(part[rows] for part in (given.q, given.candidates.owner)))
    q = refined(scene, place, q, owner, lambda share: tell("Moving poses", share))
    ends = [(names[a], names[b]) for a, b in place.ends]
    sizes = [float(np.linalg.norm(place.points[b] - place.points[a])) for a, b in place.ends]
    found = Plan(
        arm=arm,
        names=space.names,
        sockets={name: (x, y, z) for name, (x, y, z) in zip(names, place.points.tolist(), strict=True)},
        q=q,
        owner=owner,
        lengths=tuple(ReferenceLength(*pair, size, u) for pair, size, u in zip(ends, sizes, place.u, strict=True)),
        noise=noise,
        criterion=criterion,
        check_length=check_length,
        **_predictions(scene, place, given, q, owner, check_length, np.asarray(joint_limits(arm, limits)), seed),
    )
    unseen = observability(arm, found.capture(), space)
    if unseen.rank < len(space.names):
        raise InputError(f"no {poses} poses in these sockets determine the parameters. {' '.join(unseen.sentences())}")
    return found


def _scene(
    arm: Arm,
    space: Parameters,
    noise: Noise,
    criterion: str,
    room: tuple[float, float],
    limits: Any,
    check_length: float,
    seed: int,
) -> Scene:
    margin, above = room
    if not is_single(arm):
        raise InputError("plan takes one arm, not a batch; take one of it first.")
    if arm.joints < 3 or total_link_length(arm) == 0:
        raise InputError("this arm reaches no volume (three joints and some link are the least), so there is nothing to plan.")
    if seed < 0:
        raise InputError(f"seed is {seed}; give zero or a positive number.")
    if criterion not in CRITERIA:
        raise InputError(f"criterion is '{criterion}'; it must be one of {', '.join(CRITERIA)}.")
    noise.check(arm.joints)
    allowed = np.asarray(joint_limits(arm, limits))
    if not (math.isfinite(margin) and 0 <= margin < np.min(allowed[:, 1] - allowed[:, 0]) / 2):
        raise InputError(
            f"a margin of {math.degrees(margin):g} deg leaves a joint no room within its limits; give a smaller one."
        )
    inner = allowed + margin * np.array([1.0, -1.0])
    functions = _functions(arm, space, _CHECKS, check_length, allowed, seed + 1)
    kind = {"length": "functions", "D": "determinant"}.get(criterion, "trace")
    goal = Goal(kind, functions, {"A": 0.0}.get(criterion, _POWER))  # pyright: ignore[reportArgumentType]
    return Scene(arm, space, noise, inner, goal, np.random.default_rng(seed), above)


def _functions(
    arm: Arm, space: Parameters, count: int, length: float, limits: np.ndarray, seed: int
) -> Float[np.ndarray, "v p"]:
    """Derivatives of lengths over the volume by the free parameters, in natural steps."""
    start, end = sample_lengths(arm, count, length=length, limits=limits, seed=seed)
    between = np.asarray(arm.position(end)) - np.asarray(arm.position(start))
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    slopes = jacobian_at(arm, end, space.names) - jacobian_at(arm, start, space.names)
    return np.einsum("vc,vcp->vp", direction, slopes) * np.asarray(space.scale)


def _choices(
    scene: Scene, sockets: Any, poses: int, length: Any, u: float, lengths: Sequence[tuple], region: Any
) -> tuple[list[str], list[Place]]:
    """Names of the sockets, and the places to choose from: one, where they are given."""
    for own in (u, *(float(pair[2]) for pair in lengths if len(pair) > 2)):
        if not _U[0] <= own <= _U[1]:
            raise InputError(
                f"u of a reference length is {own:g} mm; give its standard uncertainty, from {_U[0]:g} to {_U[1]:g} mm."
            )
    number = len(sockets) if isinstance(sockets, Mapping) else sockets
    if number < 1 or poses < _LEAST * number:
        raise InputError(f"{poses} poses are too few for {number} sockets: at least {_LEAST} in each, and one socket at least.")
    unknowns = len(scene.space.names) + 3 * number - (len(lengths) if isinstance(sockets, Mapping) else number // 2)
    if 3 * poses < unknowns:
        raise InputError(
            f"{poses} poses in {number} sockets give fewer equations than the {unknowns} unknowns; take {-(-unknowns // 3)} at least."
        )
    if isinstance(sockets, Mapping):
        points = {name: socket_point(name, point) for name, point in sockets.items()}
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
                if np.linalg.norm(np.asarray(points[one] - points[other])) < 1:
                    raise InputError(f"sockets '{other}' and '{one}' stand in one place; move one, or take them as one.")
        ends = tuple((names.index(pair[0]), names.index(pair[1])) for pair in lengths)
        own = tuple(float(pair[2]) if len(pair) > 2 else u for pair in lengths)
        return names, [Place(np.array([np.asarray(point) for point in points.values()]), ends, own)]
    if lengths:
        raise InputError("lengths are between sockets that are given; with a number of sockets, give length and u.")
    for axis, (least, most) in region.items():
        if not least < most:
            raise InputError(
                f"the region's {axis} is {least:g} to {most:g} mm, which is no range; give the lower number first."
            )
    low, high = (length, length) if isinstance(length, int | float) else length
    if not 0 < low <= high < 2 * total_link_length(scene.arm):
        raise InputError(
            f"a reference length of {low:g} to {high:g} mm does not fit this arm; give one shorter than its reach."
        )
    unknown = set(region) - {"x", "y", "z", "distance"}
    if unknown:
        raise InputError(f"the region has no '{sorted(unknown)[0]}'; give ranges of x, y, z and distance, in mm.")
    names = [chr(ord("A") + i) if number <= 26 else f"S{i + 1}" for i in range(number)]
    return names, places(scene, _PLACES, number, (low, high), u, region)


class _Given(NamedTuple):
    """Candidate poses in a place."""

    q: Float[np.ndarray, "c n"]
    candidates: Candidates


def _chosen_place(
    scene: Scene,
    choices: list[Place],
    poses: int,
    candidates: int,
    region: Mapping[str, tuple[float, float]],
    tell: Callable[[str, float], None],
) -> tuple[Place, _Given]:
    """The place that promises most: first with random poses, then the best few with poses chosen for them, then the best moved."""
    if len(choices) == 1:
        return choices[0], _candidates(scene, choices[0], candidates)
    what = "Placing the sockets"
    worths = []
    for i, place in enumerate(choices):
        worths.append(worth(scene, place, poses))
        tell(what, 0.4 * (i + 1) / len(choices))
    order = [i for i in np.argsort(worths) if np.isfinite(worths[i])][:_TRIED_WELL]
    if not order:
        raise InputError("no place that was tried can be reached well; give a region nearer to the arm, or a shorter length.")
    best, best_value = choices[order[0]], np.inf
    for number in range(len(order) + _MOVED):
        place = choices[order[number]] if number < len(order) else beside(scene, best, region)
        value = np.inf if place is None else _chosen_worth(scene, place, poses)
        if place is not None and value < best_value:
            best, best_value = place, value
        tell(what, 0.4 + 0.6 * (number + 1) / (len(order) + _MOVED))
    return best, _candidates(scene, best, candidates)


def _chosen_worth(scene: Scene, place: Place, poses: int) -> float:
    """The criterion for poses chosen, not too carefully, in a place."""
    q, owner = configurations_at(scene, place.points, _AT_FIRST // len(place.points))
    if np.bincount(owner, minlength=len(place.points)).min(initial=_AT_FIRST) < _LEAST:
        return np.inf
    given = candidates_of(scene, place, q, owner)
    rows = given.rows[exchange(given, poses, scene.goal, least=_LEAST, sweeps=1)]
    information = given.base + np.einsum("cki,ckj->ij", rows, rows)
    return float(scene.goal.value(covariance_of(information, given.parameters)))


def _candidates(scene: Scene, place: Place, count: int) -> _Given:
    q, owner = configurations_at(scene, place.points, max(count // len(place.points), 50))
    for i, point in enumerate(place.points):
        if np.sum(owner == i) < 20:
            where = ", ".join(f"{x:.0f}" for x in point)
            raise InputError(
                f"socket {i + 1} at ({where}) mm cannot be reached in enough poses within the joint limits and their margin; move it."
            )
    return _Given(q, candidates_of(scene, place, q, owner))


def _sorted(q: Float[np.ndarray, "N n"], owner: Int[np.ndarray, " N"]) -> tuple[np.ndarray, np.ndarray]:
    """Socket after socket, and in each from pose to nearest pose, so that the arm moves little."""
    order: list[int] = []
    for socket in range(owner.max() + 1):
        left = np.flatnonzero(owner == socket).tolist()
        here = min(left, key=lambda i: np.abs(q[i]).sum())
        while left:
            left.remove(here)
            order.append(here)
            if left:
                here = min(left, key=lambda i: np.abs(q[i] - q[here]).max())
    return q[order], owner[order]


def _predictions(
    scene: Scene,
    place: Place,
    given: _Given,
    q: np.ndarray,
    owner: np.ndarray,
    length: float,
    allowed: np.ndarray,
    seed: int,
) -> dict[str, Prediction]:
    """Of the plan, of random poses in its sockets, of the plan carried out loosely, and of ten poses more."""
    functions = _functions(scene.arm, scene.space, _CHECKED, length, allowed, seed + 2)

    def of(rows: np.ndarray) -> Prediction:
        information = given.candidates.base + np.einsum("cki,ckj->ij", rows, rows)
        matrix = covariance_of(information, given.candidates.parameters)
        u = np.sqrt(np.einsum("vp,pq,vq->v", functions, matrix, functions))
        return Prediction(float(np.median(u)), float(u.max()))

    def typical(sets: list[Prediction]) -> Prediction:
        return Prediction(*(float(np.median(column)) for column in zip(*sets, strict=True)))

    planned = candidates_of(scene, place, q, owner)
    counts = np.bincount(owner, minlength=len(place.points))
    pool = given.candidates
    random = [
        of(pool.rows[np.concatenate([scene.random.choice(np.flatnonzero(pool.owner == i), n) for i, n in enumerate(counts)])])
        for _ in range(_RANDOM_SETS)
    ]
    loose = []
    for _ in range(_LOOSE_SETS):
        near, arrived = project_to_targets(
            scene.arm, q + _LOOSE * scene.random.normal(size=q.shape), place.points[owner], scene.limits
        )
        near = np.where((arrived & (lowest_point(scene.arm, near) >= scene.above))[:, None], near, q)
        loose.append(of(candidates_of(scene, place, near, owner).rows))
    base = pool.base + np.einsum("cki,ckj->ij", planned.rows, planned.rows)
    added = exchange(pool._replace(base=base), MORE, scene.goal, least=0, sweeps=1)
    return {
        "predicted": of(planned.rows),
        "random": typical(random),
        "loose": typical(loose),
        "more": of(np.concatenate([planned.rows, pool.rows[added]])),
    }
