"""Obstacles, and how far an arm's body is from them and from itself."""

from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.arguments import Positive, Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, in_chunks, namespace, to_numpy
from ..core.rotations import rotation_matrix
from .arm import Arm
from .body import Body, capsule_ends, distance_from_box, frames_at, segment_distance

_ROWS = 1024  # of one call
_SAMPLES = 500
_MOSTLY = 0.5  # of random configurations: capsules that touch in so many overlap by their shapes


class HalfSpace(NamedTuple):
    """Everything behind a plane: a table, a wall, a floor.

    ``normal`` points to where the arm is, from the plane through ``point`` (mm); both in the base frame.

    Example:
        >>> wall = aj.kinematics.HalfSpace("wall", normal=(1, 0, 0), point=(-500, 0, 0))
        >>> print(wall.name)
        wall
    """

    name: str
    normal: tuple[float, float, float]
    point: tuple[float, float, float]


class Box(NamedTuple):
    """A solid box: its centre and whole edges, mm, and its rotation vector (rad), in the base frame.

    Example:
        >>> cabinet = aj.kinematics.Box("cabinet", centre=(800, 0, 300), size=(200, 400, 600))
        >>> print(cabinet.name, cabinet.rotation)
        cabinet (0.0, 0.0, 0.0)
    """

    name: str
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Post(NamedTuple):
    """A capsule: all within ``radius`` (mm) of the segment between two points of the base frame.

    Example:
        >>> pillar = aj.kinematics.Post("pillar", start=(500, 500, 0), end=(500, 500, 2000), radius=80.0)
        >>> print(pillar.radius, "mm")
        80.0 mm
    """

    name: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
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


def check_obstacle(obstacle: Obstacle) -> None:
    """Raise `InputError` for an obstacle without extent or direction."""
    numbers = {"radius": Positive, "size": Annotated[Float[np.ndarray, "3"], Range(above=0, unit="mm")]}
    for field, value in obstacle._asdict().items():
        if field != "name":
            checked(value, numbers.get(field, Float[np.ndarray, "3"]), f"{field} of obstacle '{obstacle.name}'")
    if isinstance(obstacle, HalfSpace) and not np.linalg.norm(obstacle.normal) > 0:
        raise InputError(f"the normal of obstacle '{obstacle.name}' has the length 0; give a direction.")


def checked_cell(arm: Arm, cell: Cell, limits: Float[np.ndarray, "n 2"]) -> Cell:
    """The cell without pairs that touch wherever the arm is, which are named in ``unchecked``.

    A body touches itself at its joints, and its foot touches what it stands on. Pairs of capsules that touch in half of
    random configurations, more than any arm does, and capsules that touch an obstacle in all of them, are left out.

    Raises `InputError` for an obstacle without extent, or two of one name.
    """
    names = [obstacle.name for obstacle in cell.obstacles]
    for obstacle in cell.obstacles:
        check_obstacle(obstacle)
        if names.count(obstacle.name) > 1:
            raise InputError(f"two obstacles have the name '{obstacle.name}'; give each one of its own.")
    checked(cell.clearance, Annotated[float, Range(least=0, unit="mm")], "the clearance")
    q = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (_SAMPLES, arm.joints))
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


def _distances(cell: Cell, arm: Arm, q: Float[AnyArray, "N n"]) -> tuple[list[tuple[str, str]], Float[AnyArray, "m N"]]:
    """The pairs of things that are checked, by name, and their distances: capsules, then capsules and obstacles."""
    body, xp = cell.body, namespace(arm, q)
    start, end = capsule_ends(body, frames_at(arm, q))
    first, second = body.pairs.T
    between = segment_distance(start[first], end[first], start[second], end[second])
    distances = [between - xp.asarray(body.radius[first] + body.radius[second])[:, None]]
    names = [(body.names[i], body.names[j]) for i, j in body.pairs]
    for obstacle in cell.obstacles:
        pairs = [(name, obstacle.name) for name in body.names]
        chosen = np.array([pair not in cell.unchecked for pair in pairs])
        part = body._replace(radius=body.radius[chosen])
        distances.append(_from_obstacle(obstacle, part, start[chosen], end[chosen]))
        names += [pair for pair in pairs if pair not in cell.unchecked]
    return names, xp.concatenate(distances)


def _from_obstacle(
    obstacle: Obstacle, body: Body, start: Float[AnyArray, "k 3 N"], end: Float[AnyArray, "k 3 N"]
) -> Float[AnyArray, "k N"]:
    xp = namespace(start, end)
    radius = xp.asarray(body.radius)[:, None]
    if isinstance(obstacle, HalfSpace):
        normal = np.asarray(obstacle.normal, dtype=float)
        normal = normal / np.linalg.norm(normal)
        heights = (xp.sum(part * xp.asarray(normal)[None, :, None], axis=1) for part in (start, end))
        return xp.minimum(*heights) - float(normal @ np.asarray(obstacle.point)) - radius
    if isinstance(obstacle, Box):
        rotation = xp.asarray(rotation_matrix(np.asarray(obstacle.rotation, dtype=float)).T)
        centre = xp.asarray(np.asarray(obstacle.centre, dtype=float))[None, :, None]
        first, last = (xp.einsum("cd,kdn->kcn", rotation, part - centre) for part in (start, end))
        half = xp.asarray(np.asarray(obstacle.size, dtype=float) / 2)[None, :, None]
        return distance_from_box(first, last, half) - radius
    first, last = (
        xp.broadcast_to(xp.asarray(np.asarray(point, dtype=float))[None, :, None], start.shape)
        for point in (obstacle.start, obstacle.end)
    )
    return segment_distance(start, end, first, last) - radius - obstacle.radius
