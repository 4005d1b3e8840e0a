"""The body of an arm as capsules that its frames carry, obstacles, and how far the body is from them and from itself.

A capsule is a segment with a radius, so that its distance from another is that of the segments less the radii. Its ends
may be in two frames: a link whose length changes with a joint keeps its ends. Distances are exact, for batches, and
under jit too; points are columns, ``(..., 3, N)`` for N configurations, as in `chain`.
"""

from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Positive, Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, in_chunks, namespace, to_numpy
from ..core.rotations import rotation_matrix
from .arm import Arm, JointLimits, with_chains
from .chain import Vectors, forward_pass, frame_axes, joint_motion
from .robots import ChainOf, chains_of

_SHORTEST = 1e-6  # mm: shorter links have no capsule
_NEAR = 2.0  # times the sum of the radii: capsules that less of the arm joins than this are neighbours
_RADIUS = Range(above=0, most=2000, unit="mm")
_PARALLEL = 1e-14  # squared sine of the angle between segments that count as parallel
_TINY = 1e-24  # mm^2: keeps derivatives of a square root finite
_ROWS = 1024  # of one call
_SAMPLES = 500
_MOSTLY = 0.5  # of random configurations: capsules that touch in so many overlap by their shapes

Vector = tuple[float, float, float]
Distances = Float[AnyArray, "... N"]


class Body(NamedTuple):
    """Capsules and the pairs of them that may not touch; lengths in mm.

    Frame 0 is the base, frame i the one after joint i.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0)
        >>> print(body.names[:3], body.radius[:3])
        ('offset d_1', 'link a_2', 'offset d_3') [40. 40. 40.]
    """

    names: tuple[str, ...]
    start_frame: Int[np.ndarray, " k"]
    start: Float[np.ndarray, "k 3"]  # in its frame
    end_frame: Int[np.ndarray, " k"]
    end: Float[np.ndarray, "k 3"]
    radius: Float[np.ndarray, " k"]
    pairs: Int[np.ndarray, "m 2"]


class HalfSpace(NamedTuple):
    """Everything behind a plane: a table, a wall, a floor.

    ``normal`` points to where the arm is, from the plane through ``point`` (mm); both in the base frame.

    Example:
        >>> wall = aj.kinematics.HalfSpace("wall", normal=(1, 0, 0), point=(-500, 0, 0))
        >>> print(wall.name)
        wall
    """

    name: str
    normal: Vector
    point: Vector


class Box(NamedTuple):
    """A solid box: its centre and whole edges, mm, and its rotation vector (rad), in the base frame.

    Example:
        >>> cabinet = aj.kinematics.Box("cabinet", centre=(800, 0, 300), size=(200, 400, 600))
        >>> print(cabinet.name, cabinet.rotation)
        cabinet (0.0, 0.0, 0.0)
    """

    name: str
    centre: Vector
    size: Vector
    rotation: Vector = (0.0, 0.0, 0.0)


class Post(NamedTuple):
    """A capsule: all within ``radius`` (mm) of the segment between two points of the base frame.

    Example:
        >>> pillar = aj.kinematics.Post("pillar", start=(500, 500, 0), end=(500, 500, 2000), radius=80.0)
        >>> print(pillar.radius, "mm")
        80.0 mm
    """

    name: str
    start: Vector
    end: Vector
    radius: float


Obstacle = HalfSpace | Box | Post


class Cell(NamedTuple):
    """What an arm may not touch: obstacles and itself.

    Example:
        >>> table = aj.kinematics.HalfSpace("table", normal=(0, 0, 1), point=(0, 0, -200))
        >>> cell = aj.kinematics.Cell(aj.kinematics.body_along_links(arm, 40.0), obstacles=(table,), clearance=20.0)
        >>> print(len(cell.obstacles), cell.clearance)
        1 20.0
    """

    body: Body
    obstacles: tuple[Obstacle, ...] = ()
    clearance: float = 0.0  # smallest distance that is allowed, mm
    unchecked: tuple[tuple[str, str], ...] = ()  # capsule and obstacle, or two capsules, that touch wherever the arm is


def body_along_links(arm: Arm, radius: float | Sequence[float], tool_radius: float | None = None) -> Body:
    """Capsules about an arm's offsets d, lengths a and its probe, as the D-H table has them.

    That is the body of an arm whose links are where its table's frames are; of a robot with links beside its axes, its
    URDF's shapes are nearer to the truth (`files.load_cell`). The tool's capsule ends two radii before the tip, so that
    it clears a surface that the tip is in up to a tilt of 60 deg. Capsules that little of the arm joins touch at their
    joint, and are no pair; those of different chains of a robot are. `InputError` where a radius is not positive, or
    not one for each joint.

    Args:
        arm: One arm.
        radius: Radius of every link, or one for each joint, mm.
        tool_radius: Radius of the probe, mm; by default a quarter of the last link's, 8 at most.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0, tool_radius=5.0)
        >>> print(len(body.names), body.radius.max(), "mm")
        7 40.0 mm
    """
    arm, n, base = to_numpy(arm), arm.joints, np.zeros(3)
    shapes = Float[np.ndarray, ""] | Float[np.ndarray, "joints"]
    radii = np.broadcast_to(checked(radius, Annotated[shapes, _RADIUS], "radius", {"joints": n}), (n,))
    if arm.chains:
        return body_of_chains(
            arm, lambda chain: body_along_links(chain.arm, radii[np.array(chain.frames[1:]) - 1].tolist(), tool_radius)
        )
    tool = float(min(radii[-1] / 4, 8.0) if tool_radius is None else tool_radius)
    checked(tool, Annotated[float, _RADIUS], "tool_radius")
    beta = np.zeros(n) if arm.beta is None else np.asarray(arm.beta)
    rows: list[tuple[str, int, np.ndarray, int, np.ndarray, float, float]] = []
    for i in range(n):
        a, d = float(arm.a[i]), float(arm.d[i])
        # The end of the offset, in the frame after the joint: a back along x, which beta turns about y.
        corner = np.array([-a * np.cos(beta[i]), 0.0, -a * np.sin(beta[i])])
        rows.append((f"offset d_{i + 1}", i, base, i + 1, corner, radii[i], abs(d)))
        rows.append((f"link a_{i + 1}", i + 1, corner, i + 1, base, radii[i], abs(a)))
    rows = [row for row in rows if row[-1] > _SHORTEST]
    probe = np.asarray(arm.probe, dtype=float)
    size = float(np.linalg.norm(probe))
    if size > 2 * tool + _SHORTEST:
        rows.append(("probe", n, base, n, probe * (1 - 2 * tool / size), tool, size))
    if not rows:
        raise InputError(
            "every link of the arm has the length 0, so there is no body to check; give the URDF of the arm."
        )
    names, *columns, lengths = zip(*rows, strict=True)
    start_frame, start, end_frame, end, widths = map(np.array, columns)
    first, second = np.triu_indices(len(rows), 1)
    until = np.concatenate([[0.0], np.cumsum(lengths)])  # how much of the arm is before each capsule
    apart = until[second] - until[first + 1] > _NEAR * (widths[first] + widths[second])
    return Body(names, start_frame, start, end_frame, end, widths, np.column_stack([first, second])[apart])


def body_of_chains(robot: Arm, body_of: Callable[[ChainOf], Body]) -> Body:
    """The body of a robot from that of each chain's arm, ``body_of`` it.

    Links of the same name are one. Capsules that are in no chain together are pairs; others are where they are in every
    chain that has both.
    """
    rows: dict[str, tuple] = {}
    pairs: dict[tuple[str, str], bool] = {}  # of one chain
    for chain_name, chain in chains_of(robot).items():
        body, frames, names = body_of(chain), np.array(chain.frames), []
        for name in body.names:  # "link a_3" by its row in the table of the robot
            kind, _, row = name.partition(" ")
            names.append(
                f"probe of {chain_name}"
                if name == "probe"
                else f"{kind} {chain.names[row]}"
                if row in chain.names
                else name
            )
        ends = (frames[body.start_frame], body.start, frames[body.end_frame], body.end, body.radius)
        for name, *row in zip(names, *ends, strict=True):
            rows.setdefault(name, tuple(row))
        checked_pairs = set(map(tuple, body.pairs.tolist()))
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
            pair = (names[i], names[j])
            pairs[pair] = pairs.get(pair, True) and (i, j) in checked_pairs
    every, number = list(rows), {name: i for i, name in enumerate(rows)}
    known = {frozenset(pair) for pair in pairs}
    chosen = [(number[a], number[b]) for (a, b), is_pair in pairs.items() if is_pair]
    chosen += [
        (i, j)
        for i, j in zip(*np.triu_indices(len(every), 1), strict=True)
        if frozenset((every[i], every[j])) not in known
    ]
    return Body(
        tuple(every), *map(np.array, zip(*rows.values(), strict=True)), pairs=np.array(chosen, int).reshape(-1, 2)
    )


def _frames(arm: Arm, q: Float[AnyArray, "N columns"]) -> tuple[AnyArray, AnyArray]:
    """Axes ``(n + 1, 3, 3, N)`` and origins of the base and of the frames after the joints; of a robot, the frames of
    every chain, whichever a pose is of."""
    forward = forward_pass(arm.geometry, joint_motion(arm.geometry, q))
    xp, (x, y, z) = namespace(forward), frame_axes(forward)
    base = xp.broadcast_to(xp.asarray(np.eye(3))[None, :, :, None], (1, 3, 3, z.shape[-1]))
    axes = xp.concatenate([base, xp.stack([x, y, z], axis=2)])
    return axes, xp.concatenate([xp.zeros_like(forward.origin[:1]), forward.origin])


def capsule_ends(body: Body, arm: Arm, q: Float[AnyArray, "N columns"]) -> tuple[Vectors, Vectors]:
    """Where the capsules' segments begin and end at N configurations, in the base frame, mm."""
    if arm.chains:
        xp, n = namespace(arm, q), arm.joints
        passes = [
            _frames(arm, xp.concatenate([q[:, :n], xp.full_like(q[:, n : n + 1], number), q[:, n + 1 :]], axis=1))
            for number in range(len(arm.chains))
        ]
        owner = [next((c for c, (_, joints) in enumerate(arm.chains) if i in joints), 0) for i in range(n + 1)]
        axes, origins = (xp.stack([passes[c][part][i] for i, c in enumerate(owner)]) for part in (0, 1))
    else:
        axes, origins = _frames(arm, q)
        xp = namespace(axes)

    def placed(frame: Int[np.ndarray, " k"], point: Float[np.ndarray, "k 3"]) -> AnyArray:
        columns = (axes[frame][:, :, i] * xp.asarray(point[:, i])[:, None, None] for i in range(3))
        return origins[frame] + sum(columns)

    return placed(body.start_frame, body.start), placed(body.end_frame, body.end)


def segment_distance(start: Vectors, end: Vectors, other_start: Vectors, other_end: Vectors) -> Distances:
    """Distance between two segments, mm; a segment may be a point.

    The point of one segment that is nearest to the line of the other, the point of the other that is nearest to that,
    and once more the first: with each kept on its segment, the third step is the minimum (Ericson 2005, 5.1.9).
    """
    xp = namespace(start, end, other_start, other_end)
    along, other_along, between = end - start, other_end - other_start, start - other_start
    aa, bb, ab = _dot(along, along), _dot(other_along, other_along), _dot(along, other_along)
    a_between, b_between = _dot(along, between), _dot(other_along, between)
    determinant = aa * bb - ab**2
    parallel = determinant <= _PARALLEL * aa * bb
    first = (ab * b_between - bb * a_between) / xp.where(parallel, 1.0, determinant)
    first = xp.where(parallel, 0.0, xp.clip(first, 0.0, 1.0))
    second = xp.clip((ab * first + b_between) / xp.where(bb > 0, bb, 1.0), 0.0, 1.0)
    first = xp.clip((ab * second - a_between) / xp.where(aa > 0, aa, 1.0), 0.0, 1.0)
    return _length(between + first[..., None, :] * along - second[..., None, :] * other_along)


def distance_from_box(start: Vectors, end: Vectors, half: Float[AnyArray, "... 3 1"]) -> Distances:
    """Distance of a segment from a solid box about the origin with half edges ``half`` along the axes, mm.

    The squared distance along the segment is convex, and its derivative is linear between the places where the segment
    crosses the planes of the six faces: the zero of the derivative is found between two of these.
    """
    xp, along = namespace(start, end, half), end - start

    def beyond(places: AnyArray) -> AnyArray:
        """From the box to the points at these places, one more axis in front."""
        points = start[None] + places[..., None, :] * along[None]
        return points - xp.clip(points, -half[None], half[None])

    still = xp.abs(along) < 1e-9
    safe = xp.where(still, 1.0, along)
    crossings = [xp.where(still, 0.0, xp.clip((face - start) / safe, 0.0, 1.0)) for face in (-half, half)]
    both = xp.concatenate(crossings, axis=-2)
    ends = xp.concatenate([xp.zeros_like(both[..., :1, :]), both, xp.ones_like(both[..., :1, :])], axis=-2)
    places = xp.moveaxis(xp.sort(ends, axis=-2), -2, 0)
    slopes = xp.sum(beyond(places) * along[None], axis=-2)
    # The last place where the distance still becomes smaller, and the one after it.
    last = xp.clip(xp.sum(slopes <= 0, axis=0) - 1, 0, len(places) - 2)[None]
    low, high = (xp.take_along_axis(places, last + i, axis=0)[0] for i in (0, 1))
    slope_low, slope_high = (xp.take_along_axis(slopes, last + i, axis=0)[0] for i in (0, 1))
    rise = slope_high - slope_low
    part = xp.clip(-slope_low / xp.where(rise > 0, rise, 1.0), 0.0, 1.0)
    # Without a rise the derivative is 0 all along, inside the box, or the segment is a point.
    place = low + xp.where(rise > 0, part, 0.0) * (high - low)
    return _length(beyond(place[None])[0])


def _dot(vector: AnyArray, other: AnyArray) -> AnyArray:
    return (vector * other).sum(axis=-2)


def _length(vector: AnyArray) -> AnyArray:
    xp, square = namespace(vector), _dot(vector, vector)
    return xp.where(square > _TINY, xp.sqrt(xp.maximum(square, _TINY)), 0.0)


def _from_obstacle(obstacle: Obstacle, start: Float[AnyArray, "k 3 N"], end: Float[AnyArray, "k 3 N"]) -> AnyArray:
    """Distances of segments from an obstacle, ``(k, N)``."""
    xp = namespace(start, end)
    points = {name: np.asarray(value, dtype=float) for name, value in obstacle._asdict().items() if name != "name"}

    def column(vector: Float[np.ndarray, " 3"]) -> AnyArray:
        return xp.asarray(vector)[None, :, None]

    if isinstance(obstacle, HalfSpace):
        normal = points["normal"] / np.linalg.norm(points["normal"])
        heights = (xp.sum(part * column(normal), axis=1) for part in (start, end))
        return xp.minimum(*heights) - float(normal @ points["point"])
    if isinstance(obstacle, Box):
        rotation = xp.asarray(rotation_matrix(points["rotation"]).T)
        first, last = (xp.einsum("cd,kdn->kcn", rotation, part - column(points["centre"])) for part in (start, end))
        return distance_from_box(first, last, column(points["size"] / 2))
    first, last = (xp.broadcast_to(column(points[name]), start.shape) for name in ("start", "end"))
    return segment_distance(start, end, first, last) - obstacle.radius


def _distances(cell: Cell, arm: Arm, q: Float[AnyArray, "N n"]) -> tuple[list[tuple[str, str]], Float[AnyArray, "m N"]]:
    """The pairs of things that are checked, by name, and their distances: capsules, then capsules and obstacles."""
    body, xp = cell.body, namespace(arm, q)
    start, end = capsule_ends(body, arm, q)
    first, second = body.pairs.T
    between = segment_distance(start[first], end[first], start[second], end[second])
    distances = [between - xp.asarray(body.radius[first] + body.radius[second])[:, None]]
    names = [(body.names[i], body.names[j]) for i, j in body.pairs]
    for obstacle in cell.obstacles:
        pairs = [(name, obstacle.name) for name in body.names]
        chosen = np.array([pair not in cell.unchecked for pair in pairs])
        gaps = _from_obstacle(obstacle, start[chosen], end[chosen])
        distances.append(gaps - xp.asarray(body.radius[chosen])[:, None])
        names += [pair for pair in pairs if pair not in cell.unchecked]
    return names, xp.concatenate(distances)


def check_obstacle(obstacle: Obstacle) -> None:
    """Raise `InputError` for an obstacle without extent or direction."""
    numbers = {"radius": Positive, "size": Annotated[Float[np.ndarray, "3"], Range(above=0, unit="mm")]}
    for field, value in obstacle._asdict().items():
        if field != "name":
            checked(value, numbers.get(field, Float[np.ndarray, "3"]), f"{field} of obstacle '{obstacle.name}'")
    if isinstance(obstacle, HalfSpace) and not np.linalg.norm(obstacle.normal) > 0:
        raise InputError(f"the normal of obstacle '{obstacle.name}' has the length 0; give a direction.")


def checked_cell(arm: Arm, cell: Cell, limits: JointLimits) -> Cell:
    """The cell without pairs that touch wherever the arm is, which are named in ``unchecked``.

    A body touches itself at its joints, and its foot touches what it stands on. Pairs of capsules that touch in half of
    random configurations, more than any arm does, and capsules that touch an obstacle in all of them, are left out.
    `InputError` for an obstacle without extent, or two of one name.
    """
    names = [obstacle.name for obstacle in cell.obstacles]
    for obstacle in cell.obstacles:
        check_obstacle(obstacle)
        if names.count(obstacle.name) > 1:
            raise InputError(f"two obstacles have the name '{obstacle.name}'; give them different names.")
    checked(cell.clearance, Annotated[float, Range(least=0, unit="mm")], "the clearance")
    q = with_chains(arm, np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_SAMPLES, arm.joints)))
    names, distances = _distances(cell._replace(unchecked=()), to_numpy(arm), q)
    share, pairs = np.mean(distances < cell.clearance, axis=1), len(cell.body.pairs)
    touching = share >= np.where(np.arange(len(names)) < pairs, _MOSTLY, 1.0)
    unchecked = tuple(name for name, left_out in zip(names, touching, strict=True) if left_out)
    return cell._replace(body=cell.body._replace(pairs=cell.body.pairs[~touching[:pairs]]), unchecked=unchecked)


def clearances(cell: Cell, arm: Arm, q: Float[AnyArray, "N n"]) -> Float[AnyArray, " N"]:
    """Smallest distance of the body from an obstacle or from itself at each configuration, mm; under jit too.

    Exact where nothing touches; negative where something does, though not by how much. Infinite where nothing is
    checked.

    Args:
        cell: The arm's body, and the obstacles.
        arm: The arm.
        q: Joint readings ``(N, n)``, rad, or mm of prismatic joints.

    Example:
        >>> table = aj.kinematics.HalfSpace("table", normal=(0, 0, 1), point=(0, 0, -1000))
        >>> cell = aj.kinematics.Cell(aj.kinematics.body_along_links(arm, 40.0), obstacles=(table,))
        >>> print(aj.kinematics.clearances(cell, arm, q[None]).round(1), "mm")
        [25.6] mm
    """
    return namespace(arm, q).min(_distances(cell, arm, q)[1], axis=0, initial=np.inf)


def is_clear(cell: Cell, arm: Arm, q: Float[np.ndarray, "N n"]) -> Bool[np.ndarray, " N"]:
    """Which configurations keep the clearance, by NumPy."""
    arm = to_numpy(arm)
    return in_chunks(lambda rows: np.asarray(clearances(cell, arm, rows)) >= cell.clearance, q, _ROWS)


def nearest_contact(cell: Cell, arm: Arm, q: Float[np.ndarray, " n"]) -> tuple[str, str]:
    """The two things that are nearest to each other at one configuration: capsules, or a capsule and an obstacle."""
    names, distances = _distances(cell, to_numpy(arm), q[None])
    return names[int(np.argmin(distances[:, 0]))]
