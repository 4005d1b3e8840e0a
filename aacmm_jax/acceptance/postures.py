"""How the arm was held at each pose: the side of its elbow, and the direction of its probe."""

import math

import numpy as np
from jaxtyping import Float

from ..data.recording import Recording
from ..kinematics.arm import Arm
from ..kinematics.workspace import Reach, skeleton
from .geometry import unit_rows
from .results import Postures

LEFT_OR_RIGHT = math.radians(15)  # of the elbow against the vertical: nearer it is neither left nor right


def postures_of(arm: Arm, recording: Recording, reach: Reach) -> Postures:
    """The postures of the poses in sockets and on spheres."""
    sockets = recording.capture.sockets
    q = [np.asarray(readings) for readings in sockets.values()]
    sides = elbow_sides(arm, np.concatenate(q), reach) if q else np.zeros(0)
    elbows = np.split(sides, np.cumsum([len(readings) for readings in q])[:-1]) if q else []
    probes = {
        (sphere.name, sphere.test): tuple(probe_directions(arm, np.asarray(group)) for group in sphere.groups)
        for sphere in recording.spheres
    }
    return Postures(dict(zip(sockets, elbows, strict=True)), probes)


def elbow_sides(arm: Arm, q: Float[np.ndarray, "m n"], reach: Reach) -> Float[np.ndarray, " m"]:
    """Angle of the elbow about the line from the shoulder to the tip, to the left of the vertical plane, rad.

    The elbow is the corner of the arm farthest from that line. An arm that is stretched, or whose tip is above the
    shoulder, has an elbow on neither side (0).
    """
    corners = skeleton(arm, q) - reach.shoulder
    line = unit_rows(corners[:, -1])
    off = corners - np.einsum("mcj,mj->mc", corners, line)[..., None] * line[:, None]
    off[:, 0] = 0.0  # the base is below the shoulder
    elbow = off[np.arange(len(q)), np.argmax(np.linalg.norm(off, axis=2), axis=1)]
    left = unit_rows(np.column_stack([-line[:, 1], line[:, 0], np.zeros(len(line))]))
    return np.arcsin(np.clip(np.sum(unit_rows(elbow) * left, axis=1), -1, 1))


def probe_directions(arm: Arm, q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m 3"]:
    """Directions of the probe, from the last frame's origin to the tip; where these coincide, of its z axis."""
    rotations = np.asarray(arm.pose(q))[:, :3, :3]
    probe = np.asarray(arm.probe)
    return unit_rows(rotations @ (probe if np.any(probe) else np.array([0.0, 0.0, 1.0])))
