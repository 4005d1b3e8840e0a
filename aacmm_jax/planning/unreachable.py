"""Why a socket, or a place of what is in a kit, cannot be reached in enough poses, as a sentence."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..kinematics.collisions import nearest_contact
from ..kinematics.workspace import SearchRegion, configurations_at
from .motion import approaches

_STARTS = 500


def explained(
    region: SearchRegion,
    names: Sequence[str],
    points: Float[np.ndarray, "s 3"],
    socket: int,
    share: float,
    retract: float,
) -> str:
    """Which constraint leaves too few of the poses in a socket.

    ``share`` is the part of the random starts that would be enough.
    """
    cones = None if region.cones is None else region.cones.at(np.array([socket]))
    return explained_place(region._replace(cones=cones), f"socket '{names[socket]}'", points[socket], share, retract)


def explained_place(own: SearchRegion, name: str, point: Float[np.ndarray, " 3"], share: float, retract: float) -> str:
    """Which constraint leaves too few poses of the tip in a point: obstacles, cone, approach point, or the reach.

    ``own`` is a region with one cone, that of the point.
    """
    enough = math.ceil(share * _STARTS)
    where = ", ".join(f"{round(float(x)):.6g}" for x in point)
    what = f"{name} at ({where}) mm cannot be reached in enough poses"
    cones, region = own.cones, own

    def reached(other: SearchRegion) -> Float[np.ndarray, "c n"]:
        return configurations_at(other, point[None], _STARTS)[0]

    found = reached(own)
    if len(found) >= enough and retract and cones is not None:
        normals = np.tile(cones.normals, (len(found), 1))
        if np.sum(approaches(own, found, normals, retract).possible) < enough:
            return (
                f"{what} by way of its approach point {retract:g} mm along its normal; give a shorter distance "
                "(retract), or move it."
            )
    if region.cell is not None and len(found) < enough:
        touching = reached(own._replace(cell=None))
        if len(touching) >= enough:
            one, other = nearest_contact(region.cell, region.arm, touching[0])
            return (
                f"{what} without touching an obstacle or the arm itself (such as {one} and {other}); move it or what "
                "is in the way, or give smaller radii."
            )
    if cones is not None and cones.any and len(reached(own._replace(cell=None, cones=None))) >= enough:
        angle, normal = math.degrees(float(cones.half_angles[0])), ", ".join(f"{x:.3g}" for x in cones.normals[0])
        return (
            f"{what} within its cone of {angle:.3g} deg about ({normal}); widen the cone, turn its normal, or move it."
        )
    return f"{what} within the joint limits and their margin; move it, or give more candidates."
