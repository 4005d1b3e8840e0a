"""What a joint of a calibrated arm does besides its reading, as a function of its reading."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm, joint_limits
from ..kinematics.corrected_arm import function_values
from ..kinematics.corrections.kind import Term
from .record import CalibrationRecord, uncertainty_of

_POINTS = 400  # of a curve
_BEYOND = 0.15  # of its travel, on either side


class JointFunction(NamedTuple):
    """Corrections of one joint by its own reading, less their mean over the poses; rad, or mm of a prismatic joint."""

    reading: Float[np.ndarray, " points"]  # the travel of the poses and a little beyond, within the joint's limits
    value: Float[np.ndarray, " points"]
    expanded: Float[np.ndarray, " points"]  # expanded uncertainty, 95 %
    at_poses: Float[np.ndarray, " poses"]


def function_of_joint(
    record: CalibrationRecord, joint: int, q: Float[np.ndarray, "poses joints"], points: int = _POINTS
) -> JointFunction | None:
    """The functions of its own reading that correct a joint (harmonics, gear ratio), with their uncertainty.

    The mean over the poses is taken away: a zero offset takes it up.

    Args:
        record: A calibration.
        joint: Number of the joint, from 1.
        q: Readings of the poses, rad and mm.
        points: Number of readings, evenly spaced, at which the function is given.

    Returns:
        The function; None if the joint has no such corrections.
    """
    arm: Arm = to_numpy(record.calibrated.arm)
    if arm.corrections is None:
        return None
    each = arm.corrections.functions.terms
    chosen = [
        i for i, one in enumerate(each) if one.joint == joint and isinstance(one, Term) and one.kind.of_own_reading
    ]
    if not chosen:
        return None
    terms, coefficients = [each[i] for i in chosen], np.asarray(arm.coefficients)[chosen]
    travel = q[:, joint - 1]
    low, high = joint_limits(arm, None)[joint - 1] if arm.limits is not None or not arm.prismatic else (-np.inf, np.inf)
    beyond = _BEYOND * np.ptp(travel)
    at = np.linspace(max(travel.min() - beyond, low), min(travel.max() + beyond, high), points)
    rows = np.zeros((points, q.shape[1]))
    rows[:, joint - 1] = at
    gravity = np.asarray(arm.gravity)
    at_poses = function_values(arm.corrections.nominal, terms, q, gravity)
    mean = at_poses.mean(axis=1, keepdims=True)
    functions = function_values(arm.corrections.nominal, terms, rows, gravity) - mean
    names = [one.name for one in terms]
    free = [i for i, name in enumerate(names) if name in record.names]
    slopes = np.zeros((points, len(record.names)))
    slopes[:, [record.names.index(names[i]) for i in free]] = functions[free].T
    expanded = uncertainty_of(record).expanded_of(slopes)
    return JointFunction(at, coefficients @ functions, expanded, coefficients @ (at_poses - mean))
