"""What a plan is asked for, checked: counts, sockets with their reference lengths and cones, the region."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..core.arrays import Numbers
from ..core.errors import InputError, nearest
from ..data.simulation import socket_point
from ..kinematics.arm import Arm
from ..kinematics.collisions import Cell, HalfSpace
from ..kinematics.cones import Cone, Cones, cones_of
from ..kinematics.corrections.expansion import Expansion
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import total_link_length
from .placement import LEAST_POSES, FixturePlacement, Ranges, check_region

_U_RANGE = (1e-6, 100.0)  # mm
_LARGEST_RETRACT = 1000.0  # mm
TABLE = "table"


def planned_parameters(space: Parameters) -> Parameters:
    """Those that a plan is made for: not thermal expansion, since plans are at 20 C."""
    return Parameters(space.base, tuple(name for name in space.names if name != Expansion.words[0]))


def check_counts(sockets: int | Mapping, poses: int, parameters: int, u: float, lengths: Sequence[tuple]) -> None:
    """Raise `InputError` where there are too few poses, or an uncertainty is none."""
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


def check_ranges(arm: Arm, length: tuple[float, float], lengths: Sequence[tuple], ranges: Ranges) -> None:
    """Raise `InputError` where the sockets cannot be placed."""
    if lengths:
        raise InputError("lengths are between sockets that are given; with a number of sockets, give length and u.")
    check_region(ranges)
    low, high = length
    if not 0 < low <= high < 2 * total_link_length(arm):
        raise InputError(
            f"a reference length of {low:g} to {high:g} mm does not fit this arm; give one shorter than its reach."
        )


def checked_cones(
    cone: Cone | Mapping[str, Cone] | None, names: Sequence[str], tool_axis: tuple[float, float, float]
) -> Cones:
    """The cone of each socket; a socket without one has the normal (0, 0, 1) and every direction."""
    if isinstance(cone, Mapping):
        for name in cone:
            if name not in names:
                raise InputError(f"a cone is given for the unknown socket '{name}'{nearest(str(name), names)}")
    by_name = cone if isinstance(cone, Mapping) else dict.fromkeys(names, cone or Cone())
    return cones_of([by_name.get(name, Cone()) for name in names], tool_axis)


def with_table(cell: Cell | None, above: float) -> Cell | None:
    """The cell with the table, where nothing in it has that name."""
    if cell is None or not np.isfinite(above) or any(obstacle.name == TABLE for obstacle in cell.obstacles):
        return cell
    return cell._replace(obstacles=(HalfSpace(TABLE, (0.0, 0.0, 1.0), (0.0, 0.0, above)), *cell.obstacles))


def check_retract(retract: float) -> None:
    """Raise `InputError` for a distance that is none."""
    if not 0 <= retract <= _LARGEST_RETRACT:
        raise InputError(
            f"approach points {retract:g} mm above the sockets cannot be planned; give 0, for none, to "
            f"{_LARGEST_RETRACT:g} mm."
        )
