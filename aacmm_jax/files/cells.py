"""Cells and kits as TOML: the obstacles about an arm and the radii of its links, with the body of an arm from its file;
and artefacts and instruments at hand.

The collision shapes of a URDF are each within one capsule; of meshes, the vertices alone are read. Nothing depends on a
kind of artefact: the entries of `data.observations.Simulated...` say what may be stated, in mm and rad.
"""

import contextlib
import math
import os
import re
from collections.abc import Iterable, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from pydantic import Field, FiniteFloat, NonNegativeFloat, PositiveFloat

from ..core.errors import InputError, naming
from ..kinematics.arm import Arm
from ..kinematics.axes_to_dh import Transform, dh_frames, geometry_of, inverse
from ..kinematics.collisions import (
    Body,
    Box,
    Cell,
    HalfSpace,
    Post,
    body_along_links,
    body_of_chains,
    check_obstacle,
    segment_distance,
)
from ..kinematics.parameters import UrdfSource
from ..kinematics.robots import ChainOf
from ..kinematics.workspace import total_link_length
from .arms import load_specification, urdf_folder
from .inputs import InputFile
from .toml import Point, Strict, read_toml
from .urdf import urdf_chain
from .urdf_text import UrdfShape, collision_shapes

_CENTRING = 60  # steps to the middle of the smallest circle
_HEADER, _TRIANGLE = 84, 50  # bytes of a binary STL: before the triangles, and of each
_SLENDER = 0.05  # radius of a link where none is stated, of all links' length


class _HalfSpace(Strict):
    name: str
    normal: Point
    point: Point


class _Box(Strict):
    name: str
    centre: Point
    size: Point
    rotation: Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class _Capsule(Strict):
    name: str
    start: Point
    end: Point
    radius: PositiveFloat


class _Body(Strict):
    radius: PositiveFloat | list[FiniteFloat] | None = None
    tool_radius: PositiveFloat | None = None


class _CellFile(Strict):
    clearance: NonNegativeFloat = 0.0
    body: _Body = Field(default_factory=_Body)
    half_space: list[_HalfSpace] = Field(default_factory=list)
    box: list[_Box] = Field(default_factory=list)
    capsule: list[_Capsule] = Field(default_factory=list)


class LoadedCell(NamedTuple):
    """A cell, and what of the body is not what one might expect, in sentences."""

    cell: Cell
    notes: tuple[str, ...]


def load_cell(
    arm: str | os.PathLike,
    file: str | os.PathLike | None = None,
    *,
    base: str | None = None,
    tip: str | Sequence[str] | None = None,
    radius: float | None = None,
) -> LoadedCell:
    """What an arm may not touch: obstacles of a TOML file, and itself.

    The file has tables ``[[half_space]]`` (``normal``, which points to where the arm is, and ``point``), ``[[box]]``
    (``centre``, ``size``, and ``rotation``, a rotation vector) and ``[[capsule]]`` (``start``, ``end``, ``radius``),
    each with a ``name``; ``clearance``, the smallest distance allowed; and ``[body]`` with ``radius`` (of the links,
    one number or one a joint) and ``tool_radius``. All in mm and rad, in the frame in which the arm's positions are.

    The body is that of `body_along_links` where a radius is stated; else the collision shapes of the arm's URDF; else
    along the links again, with a radius of 5 % of their length.

    Args:
        arm: As of `load_arm`.
        file: The TOML file of the cell; by default no obstacles.
        base: As of `load_arm`.
        tip: As of `load_arm`.
        radius: Radius of the links, mm, in place of the file's.

    Example:
        >>> from pathlib import Path
        >>> table = '{ name = "table", normal = [0, 0, 1], point = [0, 0, 0] }'
        >>> _ = Path("cell.toml").write_text(f"clearance = 20.0\\nhalf_space = [{table}]")
        >>> cell = aj.files.load_cell("robot.urdf", "cell.toml").cell
        >>> print(cell.body.names, [obstacle.name for obstacle in cell.obstacles], cell.clearance)
        ('shoulder', 'upper_arm', 'forearm') ['table'] 20.0
    """
    content: Any = _CellFile() if file is None else read_toml(file, _CellFile)
    rows: Any = ((HalfSpace, content.half_space), (Box, content.box), (Post, content.capsule))
    obstacles: list[Any] = []
    for kind, tables in rows:
        for row in tables:
            obstacles.append(kind(**{key: tuple(value) if isinstance(value, list) else value for key, value in row}))
    radius = content.body.radius if radius is None else radius
    with contextlib.nullcontext() if file is None else naming(file):
        for obstacle in obstacles:
            check_obstacle(obstacle)
        specification, notes = load_specification(arm, base=base, tip=tip), ()
        slender, body = _SLENDER * total_link_length(specification.arm), None
        if radius is None and specification.urdf is not None:
            body, notes = _urdf_bodies(specification.arm, specification.urdf, urdf_folder(arm), slender)
        if body is None:
            if radius is None:
                notes = (
                    f"every link is assumed to be a capsule with a radius of {slender:.0f} mm (5 % of the total length "
                    "of the links); give the true radius.",
                )
            stated = slender if radius is None else radius
            body = body_along_links(specification.arm, stated, content.body.tool_radius)
    return LoadedCell(Cell(body, tuple(obstacles), content.clearance), notes)


class _Row(NamedTuple):
    """One capsule, as the columns of a `Body`."""

    name: str
    start_frame: int
    start: Float[np.ndarray, " 3"]
    end_frame: int
    end: Float[np.ndarray, " 3"]
    radius: float


def _urdf_bodies(arm: Arm, urdf: UrdfSource, folder: Path, radius: float) -> tuple[Body | None, tuple[str, ...]]:
    """`_urdf_body` of an arm, or of all chains of a robot."""
    if not arm.chains:
        return _urdf_body(arm, urdf, folder, radius)
    sources = [urdf._replace(tips=(tip,)) for tip, _ in arm.chains]
    stops = {joint.name for source in sources for joint in urdf_chain(source, alone=False).joints}
    notes: dict[str, None] = {}

    def body_of(chain: ChainOf) -> Body:
        body, said = _urdf_body(chain.arm, sources[chain.number], folder, radius, stops)
        notes.update(dict.fromkeys(said))
        return body_along_links(chain.arm, radius) if body is None else body

    return body_of_chains(arm, body_of), tuple(notes)


def _urdf_body(
    arm: Arm, urdf: UrdfSource, folder: Path, radius: float, stops: Iterable[str] = ()
) -> tuple[Body | None, tuple[str, ...]]:
    """Capsules about the collision shapes of the links between base and tip, side branches at reading 0; and notes.

    Links whose meshes are not at hand have capsules of this ``radius``, mm, about the lengths of their D-H row instead,
    and so has a probe beyond the tip. Beyond joints of other chains, the ``stops``, no link is carried. No body
    where the URDF has no collision shapes on these links.
    """
    chain = urdf_chain(urdf, alone=not stops)
    shapes, frames = collision_shapes(chain.robot), dh_frames(geometry_of(chain.arm), chain.base)
    rows: list[_Row] = []
    missing: dict[int, str] = {}
    for number, link, link_frame in chain.carried_links(urdf.base, stops):
        for count, shape in enumerate(shapes.get(link, ()), start=1):
            capsule = _capsule(shape, inverse(frames[number]) @ link_frame @ shape.origin, folder)
            if capsule is None:
                missing[number] = link
                continue
            start, end, width = capsule
            name = f"{link}/{count}" if len(shapes[link]) > 1 else link
            rows.append(_Row(name, number, start, number, end, width))
    if not rows and not missing:
        return None, ()
    simple, with_shape = body_along_links(arm, radius), {row.end_frame for row in rows}
    tool = np.linalg.norm(np.asarray(arm.probe) - np.asarray(chain.arm.probe)) > 0
    rows = [row for row in rows if not any(_holds(other, row) for other in rows)]
    for row in map(_Row._make, zip(*simple[:-1], strict=True)):
        if (row.name == "probe" and tool) or (row.end_frame in missing and row.end_frame not in with_shape):
            rows.append(row)
    rows.sort(key=lambda row: row.end_frame)
    notes = []
    for partly, instead in (
        (False, "each of these links is modelled as capsules along its D-H lengths"),
        (True, "only the other collision shapes that move with the same joints are checked"),
    ):
        if links := [link for frame, link in missing.items() if (frame in with_shape) == partly]:
            notes.append(f"the meshes of {', '.join(links)} are not available as STL or OBJ files; {instead}.")
    # Not of one or successive links may they touch, of which those without a shape do not count.
    rank = np.unique([row.end_frame for row in rows], return_inverse=True)[1]
    checked = {frozenset((simple.names[i], simple.names[j])) for i, j in simple.pairs}
    pairs = []
    for i, j in combinations(range(len(rows)), 2):
        names = {rows[i].name, rows[j].name}
        if rank[j] - rank[i] > 1 and (not names <= set(simple.names) or names in checked):
            pairs.append((i, j))
    names, *columns = zip(*rows, strict=True)
    return Body(names, *map(np.array, columns), pairs=np.array(pairs, dtype=int).reshape(-1, 2)), tuple(notes)


def _holds(outer: _Row, inner: _Row) -> bool:
    """Whether a capsule of a frame holds another one, as the cylinder of a capsule the balls at its ends."""
    if outer is inner or outer.end_frame != inner.end_frame or outer.radius < inner.radius:
        return False
    start, end = outer.start[:, None], outer.end[:, None]
    gaps = [segment_distance(start, end, point[:, None], point[:, None])[0] for point in (inner.start, inner.end)]
    return bool(max(gaps) + inner.radius <= outer.radius + 1e-6)


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
    capsules = []
    for axis in np.concatenate([np.linalg.eigh(centred.T @ centred)[1].T, np.eye(3)]):
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
        start, end = best + low * axis, best + high * axis
        volume = radius**2 * (np.linalg.norm(end - start) + 4 / 3 * radius)
        capsules.append((volume, start, end, float(radius)))
    return min(capsules, key=lambda capsule: capsule[0])[1:]


def mesh_path(file: str, folder: Path) -> Path | None:
    """The file that a URDF in a folder names, or None where it is not at hand.

    ``package://NAME/...`` is looked for beside the folder and its parents, as packages are laid out.
    """
    if file.startswith("package://"):
        package, _, rest = file.removeprefix("package://").partition("/")
        whole = folder.absolute()
        tried = [place for parent in (whole, *whole.parents) for place in (parent / package / rest,)]
        tried += [parent / rest for parent in (whole, *whole.parents) if parent.name == package]
    else:
        # In a URL, a slash stands before the letter of a drive: file:///C:/arm.stl.
        tried = [folder / re.sub(r"^/(?=[A-Za-z]:)", "", file.removeprefix("file://"))]
    return next((path for path in tried if path.is_file()), None)


def mesh_vertices(path: Path) -> Float[np.ndarray, "m 3"]:
    """The vertices of an STL (binary or text) or OBJ file, in the file's own unit."""
    content, obj = InputFile(path).content, path.suffix.lower() == ".obj"
    count = int.from_bytes(content[_HEADER - 4 : _HEADER], "little")
    if not obj and len(content) == _HEADER + count * _TRIANGLE:  # its header may begin with "solid" as that of a text
        triangles = np.frombuffer(content, dtype=np.uint8, offset=_HEADER).reshape(count, _TRIANGLE)
        vertices = triangles[:, 12:48].copy().view("<f4").reshape(-1, 3).astype(float)
    else:
        word, rows = b"v" if obj else b"vertex", map(bytes.split, content.splitlines())
        try:
            numbers = [[float(x) for x in row[1:4]] for row in rows if row and row[0] == word]
            vertices = np.array(numbers).reshape(-1, 3)
        except ValueError as error:
            raise InputError(
                f"{path} has a vertex that does not consist of three numbers; export the mesh again."
            ) from error
    if not len(vertices) or not np.all(np.isfinite(vertices)):
        raise InputError(f"{path} has no vertices, or has vertices that are not finite; export the mesh again.")
    return np.unique(vertices, axis=0)
