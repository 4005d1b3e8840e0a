"""Poses to command to a controller that takes nothing but poses, and computes readings with the nominal arm."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers
from .arm import Arm
from .inverse_kinematics import ARRIVED, FULL_POSE, ReadingsAtPoses, free_joints, readings_at_poses

_ROUNDS = 20  # each leaves about the relative error of the arm, some thousandths, of what was missing


class CorrectedTargets(NamedTuple):
    """Poses to command, and the readings that the controller then computes."""

    poses: Float[np.ndarray, "N 4 4"]  # in the base frame that both arms have in common, mm
    readings: ReadingsAtPoses


def corrected_targets(
    nominal: Arm, calibrated: Arm, q: Numbers, poses: Float[np.ndarray, "N 4 4"], *, oriented: bool = True
) -> CorrectedTargets:
    """Poses that bring the calibrated arm to ``poses`` where a controller computes readings with the nominal arm.

    With orientations, and with fewer than six joints, these are the nominal arm's poses at the readings that
    `readings_at_poses` gives for the calibrated arm. Without, the controller keeps the orientation of ``poses``, and
    only positions are corrected, by as much as the calibrated arm misses them, until it does not.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Readings that the search begins with ``(N, n)``, rad, with what is recorded beside them, as of
            `corrected_readings`.
        poses: Poses wanted, with the tip (mm) as their origin, in the base frame of both arms.
        oriented: Whether the orientations are wanted, too.

    Example:
        >>> ur10e = aj.load_arm("ur10e")
        >>> as_built = ur10e.replace(theta_2=ur10e.theta[1] + 0.001)
        >>> wanted = np.asarray(ur10e.pose(q[None]))
        >>> commanded = aj.kinematics.corrected_targets(ur10e, as_built, q[None], wanted)
        >>> print(np.abs(commanded.poses - ur10e.pose(q[None] - 0.001 * np.eye(6)[1])).max() < 1e-6)
        True
    """
    q, n, own = np.asarray(q, dtype=float), nominal.joints, nominal.beside.own
    if oriented or free_joints(nominal.geometry, q) < FULL_POSE:
        found = readings_at_poses(calibrated, q, poses, nominal.limits)
        return CorrectedTargets(np.asarray(nominal.pose(np.hstack([found.q, q[:, n:own]]))), found)
    commanded, moves = np.array(poses), np.full(len(poses), True)
    for _ in range(_ROUNDS):
        found = readings_at_poses(nominal, q[:, :own], commanded, nominal.limits)
        shift = poses[:, :3, 3] - np.asarray(calibrated.position(np.hstack([found.q, q[:, n:]])))
        distance = np.linalg.norm(shift, axis=1)
        moves = np.asarray(found.reached) & (distance > ARRIVED)
        if not moves.any():
            break
        commanded[moves, :3, 3] += shift[moves]
    # What was commanded is reached by the nominal arm; what was wanted by the calibrated one.
    return CorrectedTargets(commanded, found._replace(distance=distance, reached=found.reached & ~moves))
