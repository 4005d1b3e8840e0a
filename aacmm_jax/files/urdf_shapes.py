"""The body of an arm from the collision shapes of its URDF, each within one capsule."""

import math
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..kinematics.axes_to_dh import Transform, dh_frames, geometry_of, inverse
from ..kinematics.body import Body, body_along_links
from ..kinematics.parameters import ArmSpecification
from ..kinematics.segment_distances import segment_distance
from .mesh_vertices import mesh_path, mesh_vertices
from .urdf import UrdfChain, urdf_chain
from .urdf_text import UrdfShape, collision_shapes

_CENTRING = 60  # steps to the middle of the smallest circle


class UrdfBody(NamedTuple):
    """An arm's body, and what of it is not from the file's shapes, in sentences."""

    body: Body
    notes: tuple[str, ...]


class _Row(NamedTuple):
    """One capsule, as the columns of a `Body`."""

    name: str
    start_frame: int
    start: Float[np.ndarray, " 3"]
    end_frame: int
    end: Float[np.ndarray, " 3"]
    radius: float


def urdf_body(specification: ArmSpecification, folder: Path, radius: float) -> UrdfBody | None:
    """Capsules about the collision shapes of the links between base and tip; side branches at reading 0.

    Boxes, cylinders, spheres and the vertices of meshes (STL, OBJ) are each within one capsule. Links whose meshes are
    not at hand have capsules about the lengths of their D-H row instead, and so has a probe beyond the tip.

    Args:
        specification: The arm as `read_urdf` gave it.
        folder: The folder of the URDF, for its meshes.
        radius: Radius where shapes are missing, mm.

    Returns:
        The body; None where the URDF has no collision shapes on these links.

    Raises:
        InputError: The arm is not from a URDF, or a shape cannot be read.

    Example:
        >>> from pathlib import Path
        >>> robot = aj.files.load_specification("robot.urdf")
        >>> found = aj.files.urdf_body(robot, Path("."), 40.0)
        >>> print(found.body.names, found.body.radius.round(1), "mm")
        ('shoulder', 'upper_arm', 'forearm') [60.  56.6 42.4] mm
    """
    if specification.urdf is None:
        raise InputError("this arm was not read from a URDF, so it has no collision shapes; give radii of its links.")
    chain, shapes = urdf_chain(specification.urdf), collision_shapes(specification.urdf.text)
    frames = dh_frames(geometry_of(chain.arm), chain.base)
    rows: list[_Row] = []
    missing: dict[int, str] = {}
    for frame, link, at in _links(chain, specification.urdf.base):
        for number, shape in enumerate(shapes.get(link, ())):
            capsule = _capsule(shape, inverse(frames[frame]) @ at @ shape.origin, folder)
            if capsule is None:
                missing[frame] = link
                continue
            start, end, width = capsule
            name = f"{link}/{number + 1}" if len(shapes[link]) > 1 else link
            rows.append(_Row(name, frame, start, frame, end, width))
    if not rows and not missing:
        return None
    simple, known = body_along_links(specification.arm, radius), {row.end_frame for row in rows}
    tool = np.linalg.norm(np.asarray(specification.arm.probe) - np.asarray(chain.arm.probe)) > 0
    rows = [row for row in rows if not any(_holds(other, row) for other in rows)]
    for row in map(_Row._make, zip(*simple[:-1], strict=True)):
        if (row.name == "probe" and tool) or (row.end_frame in missing and row.end_frame not in known):
            rows.append(row)
    notes = tuple(
        f"meshes of {', '.join(links)} are not at hand as STL or OBJ; {instead}."
        for links, instead in (
            ([link for frame, link in missing.items() if frame not in known], "capsules about their D-H rows are used"),
            ([link for frame, link in missing.items() if frame in known], "their joints' other shapes are used alone"),
        )
        if links
    )
    rows.sort(key=lambda row: row.end_frame)
    start_frame, start, end_frame, end, width = (np.array(column) for column in list(zip(*rows, strict=True))[1:])
    # Links that follow each other touch at their joint; what carries no shape is left out of the count.
    rank = np.unique(end_frame, return_inverse=True)[1]
    names = tuple(row.name for row in rows)
    checked = {frozenset((simple.names[i], simple.names[j])) for i, j in simple.pairs}
    pairs = [
        (i, j)
        for i in range(len(rows))
        for j in range(i + 1, len(rows))
        if rank[j] - rank[i] > 1
        and (not {names[i], names[j]} <= set(simple.names) or frozenset((names[i], names[j])) in checked)
    ]
    return UrdfBody(
        Body(names, start_frame, start, end_frame, end, width, np.array(pairs, dtype=int).reshape(-1, 2)), notes
    )


def _holds(one: _Row, other: _Row) -> bool:
    """Whether a capsule of a frame holds another one, as the cylinder of a capsule the balls at its ends."""
    if one is other or one.end_frame != other.end_frame or one.radius < other.radius:
        return False
    gaps = (
        segment_distance(one.start[:, None], one.end[:, None], end[:, None], end[:, None])[0]
        for end in (other.start, other.end)
    )
    return bool(max(gaps) + other.radius <= one.radius + 1e-6)


def _links(chain: UrdfChain, base: str) -> Iterator[tuple[int, str, Transform]]:
    """The links that each joint carries up to the next one: number of the joint, name, and frame in the base link."""
    stops = {joint.name for joint in chain.joints}
    frame = np.eye(4)
    starts = [(0, base, frame)]
    for number, (origin, joint) in enumerate(zip(chain.origins, chain.joints, strict=True), start=1):
        frame = frame @ origin
        starts.append((number, joint.child, frame))
    for number, link, at in starts:
        waiting = [(link, at)]
        while waiting:
            name, place = waiting.pop()
            yield number, name, place
            waiting += [
                (joint.child, place @ joint.origin)
                for joint in chain.robot.joints.values()
                if joint.parent == name and joint.name not in stops
            ]


def _capsule(shape: UrdfShape, frame: Transform, folder: Path) -> tuple[np.ndarray, np.ndarray, float] | None:
    """The capsule that holds a shape in a frame, mm; None for a mesh that is not at hand."""
    if shape.kind == "sphere":
        return frame[:3, 3], frame[:3, 3], shape.size[0]
    if shape.kind == "mesh":
        path = mesh_path(shape.file, folder)
        if path is None or path.suffix.lower() not in (".stl", ".obj"):
            return None
        points = mesh_vertices(path) * np.asarray(shape.size)
    elif shape.kind == "box":
        points = np.array(list(product((-0.5, 0.5), repeat=3))) * np.asarray(shape.size)
    else:
        radius, length = shape.size
        half = length / 2 * frame[:3, 2] if length > radius else np.zeros(3)  # a disc is better held by a ball
        return frame[:3, 3] - half, frame[:3, 3] + half, radius if length > radius else math.hypot(radius, length / 2)
    return bounding_capsule(points @ frame[:3, :3].T + frame[:3, 3])


def bounding_capsule(points: Float[np.ndarray, "m 3"]) -> tuple[np.ndarray, np.ndarray, float]:
    """A capsule of small volume that holds the points: ends of its segment, and its radius.

    Along each principal axis and each coordinate axis, the smallest circle that holds the points seen along it gives
    the radius, and the caps are put as far in as the points allow; the axis with the smallest volume is taken.
    """
    centred = points - points.mean(axis=0)
    axes = np.concatenate([np.linalg.eigh(centred.T @ centred)[1].T, np.eye(3)])
    found = (_capsule_along(points, axis) for axis in axes)
    return min(found, key=lambda one: one[2] ** 2 * (np.linalg.norm(one[1] - one[0]) + 4 / 3 * one[2]))


def _capsule_along(points: Float[np.ndarray, "m 3"], axis: Float[np.ndarray, " 3"]) -> tuple:
    along = points @ axis
    flat = points - along[:, None] * axis
    middle = (flat.min(axis=0) + flat.max(axis=0)) / 2
    middle = middle - (middle @ axis) * axis
    best, radius = middle, np.linalg.norm(flat - middle, axis=1).max()
    for step in range(_CENTRING):  # Badoiu and Clarkson 2003: towards the farthest point by 1 / (i + 2) of the way
        farthest = flat[np.argmax(np.sum((flat - middle) ** 2, axis=1))]
        middle = middle + (farthest - middle) / (step + 2)
        reach = np.linalg.norm(flat - middle, axis=1).max()
        if reach < radius:
            best, radius = middle, reach
    inside = np.sqrt(np.maximum(radius**2 - np.sum((flat - best) ** 2, axis=1), 0.0))
    low, high = np.min(along + inside), np.max(along - inside)
    if low > high:  # a ball holds them all
        low = high = (low + high) / 2
        radius = np.linalg.norm(points - (best + low * axis), axis=1).max()
    return best + low * axis, best + high * axis, float(radius)
