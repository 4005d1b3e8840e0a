"""Cones of approach: from which directions a tool may come to a socket, and configurations that keep to them."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.arguments import Range, checked
from ..core.errors import InputError
from ..core.numpy_or_jax import in_chunks, to_numpy
from .arm import Arm
from .chain import ForwardPass, forward_pass, joint_motion, reading_units
from .inverse_kinematics import ARRIVED, EXACT, LARGEST_STEP, ROWS, damped_inverse, repeated
from .jacobian import reading_columns, reading_rotations

TOOL_AXIS = (0.0, 0.0, 1.0)
_LARGEST_TURN = 0.5  # rad, of the tool in a step
_INSIDE = 1e-4  # rad: what is brought into a cone ends this far inside it
_LEVER = 100.0  # mm: a rotation of the tool counts as what it moves at this distance


class Cone(NamedTuple):
    """Directions from which a tool may come to a socket: within ``half_angle`` (rad) of its ``normal``.

    The normal points out of the socket, in the base frame.

    Example:
        >>> upwards = aj.kinematics.Cone(half_angle=np.radians(45), normal=(0, 0, 1))
        >>> print(f"{upwards.half_angle:.3f} rad")
        0.785 rad
    """

    half_angle: float = math.pi
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)


class Cones(NamedTuple):
    """The cones of several sockets, and the axis of the last frame that points from the tool into a socket."""

    normals: Float[np.ndarray, "s 3"]
    half_angles: Float[np.ndarray, " s"]
    tool_axis: Float[np.ndarray, " 3"]

    @property
    def any(self) -> bool:
        """Whether some cone leaves out directions."""
        return bool(np.any(self.half_angles < math.pi))

    def at(self, sockets: Int[np.ndarray, " c"]) -> "Cones":
        """The cone of each of these sockets."""
        return self._replace(normals=self.normals[sockets], half_angles=self.half_angles[sockets])


def cones_of(cones: list[Cone], tool_axis: tuple[float, float, float] = TOOL_AXIS) -> Cones:
    """The cones with unit vectors.

    Raises:
        InputError: A direction has the length 0, or a half angle is not above 0.
    """
    directions = {f"normal of cone {i + 1}": cone.normal for i, cone in enumerate(cones)} | {"tool_axis": tool_axis}
    vectors = np.array([checked(value, Float[np.ndarray, "3"], what) for what, value in directions.items()])
    sizes = np.linalg.norm(vectors, axis=1, keepdims=True)
    if np.any(sizes == 0):
        raise InputError("a normal or the tool's axis has the length 0; give three numbers that are not all 0.")
    half_angles = np.degrees([cone.half_angle for cone in cones])
    checked(half_angles, Annotated[Float[np.ndarray, " cones"], Range(above=0, most=180, unit="deg")], "half_angle")
    unit = vectors / sizes
    return Cones(unit[:-1], np.array([cone.half_angle for cone in cones], dtype=float), unit[-1])


def tilts(arm: Arm, q: Float[np.ndarray, "c n"], cones: Cones) -> Float[np.ndarray, " c"]:
    """Angle between a tool and the normal of its socket, rad: 0 where it comes straight from above the socket.

    ``cones`` has a row for each configuration.
    """
    rotations = np.asarray(to_numpy(arm).pose(q))[..., :3, :3]
    return _angle(rotations @ cones.tool_axis, cones.normals)


def into_cones(
    arm: Arm,
    q: Float[np.ndarray, "c n"],
    targets: Float[np.ndarray, "c 3"],
    limits: Float[np.ndarray, "n 2"],
    cones: Cones,
    steps: int,
) -> tuple[Float[np.ndarray, "c n"], Bool[np.ndarray, " c"]]:
    """Configurations moved by least-norm steps until the tip is at its target and the tool in its cone.

    Each step closes the gap of the tip, as `solve_to_targets` does, and where the tool is outside its cone turns it
    there, with what moves the tip least first taken out: the least-norm solution of four equations by elimination.

    Args:
        arm: One arm.
        q: Configurations to begin with, rad.
        targets: Where each tip is to be, mm.
        limits: Lowest and highest angle of each joint, rad.
        cones: A cone for each configuration.
        steps: Most steps.
    """
    geometry = to_numpy(arm.geometry)
    low, high = limits[:, :1], limits[:, 1:]
    units = reading_units(geometry)[:, None]  # steps are in what counts alike: 1 rad, or 1 m

    # The first three equations move the tip: J dq = gap, solved by dq0 = J+ gap. The fourth turns the tool by r . dq =
    # turn. Along f = r - J+ J r, the part of r that moves no tip, dq = dq0 + f (turn - r . dq0) / (f . r) solves all.
    def step(
        q: np.ndarray, targets: np.ndarray, normals: np.ndarray, wanted: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        forward = forward_pass(geometry, joint_motion(geometry, q.T))
        gap = targets - forward.tip
        columns = units[..., None] * np.asarray(reading_columns(forward))
        inverse = damped_inverse(columns, 1e-2 * np.sum(gap**2, axis=0) + 1e-12)
        change = np.sum(inverse * gap[None], axis=1)
        tool = _directions(forward, cones.tool_axis)
        angle = _angle(tool.T, normals.T)
        outside = angle > wanted
        if outside.any():
            # d angle / dq = z . (tool x normal) / sin(angle): the cosine is -tool . normal.
            across = np.cross(tool, normals, axis=0) / np.maximum(np.sin(angle), 0.05)
            row = _LEVER * np.einsum("jcn,cn->jn", units[..., None] * reading_rotations(forward), across) * outside
            turn = _LEVER * np.clip(wanted - angle, -_LARGEST_TURN, 0.0) * outside
            free = row - np.sum(inverse * np.einsum("jn,jcn->cn", row, columns)[None], axis=1)
            size = np.sum(free * row, axis=0)
            change = change + free * ((turn - np.sum(row * change, axis=0)) / (size + 1e-2 * turn**2 + 1e-6))
        new = np.clip(q + units * np.clip(change, -LARGEST_STEP, LARGEST_STEP), low, high)
        return new, np.any(np.abs(gap) > EXACT, axis=0) | outside

    def moved(rows: np.ndarray) -> np.ndarray:
        start, targets, normals, half_angles = np.split(rows.T, [arm.joints, arm.joints + 3, arm.joints + 6])
        wanted = np.maximum(half_angles - _INSIDE, 0.0)[0]
        q = repeated(step, start, [targets, normals, wanted], steps)
        forward = forward_pass(geometry, joint_motion(geometry, q.T))
        arrived = np.linalg.norm(targets - forward.tip, axis=0) <= ARRIVED
        arrived &= _angle(_directions(forward, cones.tool_axis).T, normals.T) <= half_angles[0]
        return np.column_stack([q.T, arrived])

    with np.errstate(all="ignore"):
        solved = in_chunks(moved, np.hstack([q, targets, cones.normals, cones.half_angles[:, None]]), ROWS)
    return solved[:, :-1], solved[:, -1] > 0


def _directions(forward: ForwardPass, axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 N"]:
    """A direction of the last frame, in the base frame."""
    x, y, z = (np.asarray(part) for part in forward.frame)
    return axis[0] * x + axis[1] * y + axis[2] * z


def _angle(tool: Float[np.ndarray, "c 3"], normal: Float[np.ndarray, "c 3"]) -> Float[np.ndarray, " c"]:
    """Angle between the reversed tool and a normal; by its tangent, so that small ones are exact."""
    return np.arctan2(np.linalg.norm(np.cross(tool, normal), axis=-1), -np.sum(tool * normal, axis=-1))
