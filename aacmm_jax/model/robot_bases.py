"""Where the bases of a robot's chains are, from what two chains observed in common: a start for a calibration."""

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..core.rotations import rotation_matrix
from ..data.capture import Capture
from ..data.observations.observation import FRAME, POINT
from ..kinematics.arm import Arm
from ..kinematics.axes_to_dh import Transform
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.robots import ChainOf, chains_of, with_bases
from .observed import tips_of

_LEVER = 1000.0  # mm: of the axes of a frame, which count as points
_FEWEST = 3  # poses that fit a frame
_AS_STATED = 1e-10  # weight of the stated rotation, where points in common leave one undetermined
Points = dict[tuple[str, int], Float[np.ndarray, " 3"]]


def with_found_bases(robot: Arm, capture: Capture) -> Arm:
    """The robot with the bases of its chains where positions and frames that they observed in common put them.

    What points in common leave open, as two sockets do with the rotation about the line between them, stays as near to
    the robot's own as it can; without anything in common a base stays where it is.
    """
    if not robot.chains or robot.corrections is not None:
        return robot
    chains = chains_of(to_numpy(robot))
    seen = {name: _points(chain, capture) for name, chain in chains.items()}
    placed: Points = {}
    bases: dict[str, Transform] = {}
    for name, chain in chains.items():
        base, own = chain.base, seen[name]
        if chain.mount and (common := [key for key in own if key in placed]):
            base = _fitted(np.array([own[key] for key in common]), np.array([placed[key] for key in common]), base)
            bases[name] = base
        placed = {key: base[:3, :3] @ point + base[:3, 3] for key, point in own.items()} | placed
    return with_bases(robot, bases)


def _points(chain: ChainOf, capture: Capture) -> Points:
    """Positions, and points of frames, that a chain observed, in the frame of its own base."""
    points: Points = {}
    for observation in to_numpy(capture.parts):
        rows = np.flatnonzero(np.asarray(observation.q)[:, chain.robot_joints] == chain.number)
        framed = FRAME in observation.unknowns.values()
        if len(rows) < (_FEWEST if framed else 1):
            continue
        part, geometry = observation.select(rows), chain.arm.geometry
        tips = tips_of(forward_pass(geometry, joint_motion(geometry, chain.of_robot(part.q))), slice(None))
        for name, values in part.start(tips, np.asarray(chain.arm.probe)).items():
            units = observation.unknowns.get(name)
            if units == POINT:
                points[name, 0] = np.asarray(values)
            elif units == FRAME:
                turn, origin = np.asarray(rotation_matrix(values[:3])), np.asarray(values[3:])
                points |= {(name, i): origin + end for i, end in enumerate([0 * origin, *_LEVER * turn.T])}
    return {key: point for key, point in points.items() if np.all(np.isfinite(point))}


def _fitted(own: Float[np.ndarray, "m 3"], placed: Float[np.ndarray, "m 3"], stated: Transform) -> Transform:
    """The base in which points of these coordinates come closest to their places (Kabsch 1976)."""
    middle, target = own.mean(axis=0), placed.mean(axis=0)
    moments = (placed - target).T @ (own - middle)
    u, _, v = np.linalg.svd(moments + max(_AS_STATED * np.linalg.norm(moments), 1e-12) * stated[:3, :3])
    base = np.eye(4)
    base[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    base[:3, 3] = target - base[:3, :3] @ middle
    return base
