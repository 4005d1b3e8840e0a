"""Cells as TOML: the obstacles about an arm and the radii of its links; and the body of an arm from its file."""

import os
from typing import Annotated, Any, NamedTuple

from pydantic import Field, FiniteFloat, NonNegativeFloat, PositiveFloat

from ..core.errors import InputError
from ..kinematics.body import Body, body_along_links
from ..kinematics.collisions import Box, Cell, HalfSpace, Obstacle, Post, check_obstacle
from ..kinematics.workspace import total_link_length
from .arms import load_specification, urdf_folder
from .toml import Strict, read_toml
from .urdf_shapes import urdf_body

_SLENDER = 0.05  # radius of a link where none is stated, of all links' length

_Point = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class _HalfSpace(Strict):
    name: str
    normal: _Point
    point: _Point


class _Box(Strict):
    name: str
    centre: _Point
    size: _Point
    rotation: _Point = Field(default_factory=lambda: [0.0, 0.0, 0.0])


class _Capsule(Strict):
    name: str
    start: _Point
    end: _Point
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
    tip: str | None = None,
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

    Raises:
        InputError: Naming the file and the place in it.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("cell.toml").write_text('''clearance = 20.0
        ... [[half_space]]
        ... name = "table"
        ... normal = [0, 0, 1]
        ... point = [0, 0, 0]
        ... ''')
        >>> cell = aj.files.load_cell("robot.urdf", "cell.toml").cell
        >>> print(cell.body.names, [obstacle.name for obstacle in cell.obstacles], cell.clearance)
        ('shoulder', 'upper_arm', 'forearm') ['table'] 20.0
    """
    content = _CellFile() if file is None else read_toml(file, _CellFile)
    try:
        obstacles = _obstacles(content)
        stated = content.body.radius if radius is None else radius
        body, notes = _body(arm, base, tip, stated, content.body.tool_radius)
    except InputError as error:
        if file is None:
            raise
        raise InputError(f"{file}: {error}") from error
    return LoadedCell(Cell(body, obstacles, content.clearance), notes)


def _obstacles(content: Any) -> tuple[Obstacle, ...]:
    found: list[Obstacle] = [HalfSpace(row.name, tuple(row.normal), tuple(row.point)) for row in content.half_space]
    found += [Box(row.name, tuple(row.centre), tuple(row.size), tuple(row.rotation)) for row in content.box]
    found += [Post(row.name, tuple(row.start), tuple(row.end), row.radius) for row in content.capsule]
    for obstacle in found:
        check_obstacle(obstacle)
    return tuple(found)


def _body(
    source: str | os.PathLike, base: str | None, tip: str | None, radius: Any, tool_radius: float | None
) -> tuple[Body, tuple[str, ...]]:
    specification = load_specification(source, base=base, tip=tip)
    slender = _SLENDER * total_link_length(specification.arm)
    if radius is None and specification.urdf is not None:
        found = urdf_body(specification, urdf_folder(source), slender)
        if found is not None:
            return found
    notes = ()
    if radius is None:
        notes = (f"links are taken as {slender:.0f} mm in radius, 5 % of their length; state their radius.",)
    return body_along_links(specification.arm, slender if radius is None else radius, tool_radius), notes
