"""Joints that stand still, or nearly, over the poses of a capture, and what such poses do not determine of the arm."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.units import DEG
from ..kinematics.arm import (
    Arm,
    by_joint,
    joint_limits,
    neighbouring_arm,
    parameter_names,
    with_arrays,
    without_corrections,
)
from ..kinematics.independence import determined_at, nearly_parallel
from ..kinematics.inverse_kinematics import SocketPoses
from ..kinematics.parameters import Parameters

# An error of 1 mm across a joint's axis changes by 0.02 mm while the joint turns by 1 degree, and one of 1 mrad in the
# direction of a slide by as much over 20 mm: no more than a tip is seated or seen to. Poses within that say nothing.
_TURN, _SLIDE = 1.0 * DEG, 20.0
_TARGET = np.array([100.0, 70.0, 50.0])  # mm


class StandingJoint(NamedTuple):
    """A joint that (nearly) stands still.

    Example:
        >>> q = np.array(capture.q)
        >>> q[:, 4] = 0.2
        >>> print([(one.joint, one.range) for one in aj.diagnostics.standing_joints(arm, q)])
        [(5, 0.0)]
    """

    joint: int  # from 1
    range: float  # between its least and its largest reading, rad, or mm of a prismatic joint
    poses: int


def standing_joints(arm: Arm, q: Float[AnyArray, "N n"]) -> tuple[StandingJoint, ...]:
    """Joints whose readings differ by less than 1 degree, or 20 mm; whole revolutions do not count.

    Args:
        arm: One arm, for which of its joints are prismatic.
        q: Readings of all poses, rad, and mm of prismatic joints.

    Example:
        >>> print(aj.diagnostics.standing_joints(arm, capture.q))
        ()
    """
    q = np.asarray(q)[:, : arm.joints]
    apart = q - q[:1]
    turned = apart - 2 * np.pi * np.round(apart / (2 * np.pi))
    ranges = np.ptp(np.where(by_joint(arm, False, True), apart, turned), axis=0)
    most = by_joint(arm, _TURN, _SLIDE)
    return tuple(StandingJoint(i + 1, float(x), len(q)) for i, x in enumerate(ranges) if x < most[i])


def lost_by_standing(
    arm: Arm, capture: SocketPoses, joints: Sequence[int], order: Sequence[str] = ()
) -> list[tuple[str, ...]]:
    """Parameters that the poses of a capture would determine if joints moved in them, and do not while they stand.

    Of what cannot be separated, those of these joints are named. What two of them leave open together is named with the
    later.

    Args:
        arm: One arm, nominal.
        capture: Its poses.
        joints: The joints that stand still, from 1.
        order: The parameters in question, of which the last are lost first; by default all that data may determine.

    Returns:
        The names for each joint.
    """
    base = to_numpy(arm)
    if not order:
        base, order = _usual_order(base, joints)
    # Without the exact alignments of the nominal arm.
    neighbour = neighbouring_arm(base, tuple(order))
    if any(one.target for one in capture.observations):  # whose place is unknown, and hardly on the last axis
        neighbour = with_arrays(neighbour, probe=np.asarray(neighbour.probe) + _TARGET)
    low, high = np.asarray(joint_limits(arm, None)).T
    standing = next(np.asarray(one.q)[0] for one in (capture, *capture.observations) if len(one.q))
    random = np.random.default_rng(0)

    def seen(still: Sequence[int]) -> tuple[str, ...]:
        def changed(q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
            for i in (joint - 1 for joint in joints):
                q[:, i] = standing[i] if i + 1 in still else random.uniform(low[i], high[i], len(q))
            return q

        return determined_at(neighbour, capture, order, changed)

    before, lost = seen(()), []
    for count in range(1, len(joints) + 1):
        left = seen(joints[:count])
        lost.append(tuple(name for name in before if name not in left))
        before = left
    return lost


def _usual_order(arm: Arm, joints: Sequence[int]) -> tuple[Arm, list[str]]:
    """All parameters that data may determine, those of these joints last, and the arm that has them."""
    space = Parameters.independent(arm)
    arm = to_numpy(space.base)
    own = {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta", "beta") for joint in joints}
    # Also what sockets do not determine of the nominal arm, but points that were seen on a target may.
    parallel = nearly_parallel(arm)
    without = {f"d_{i}" if i in parallel else f"beta_{i}" for i in range(1, arm.joints + 1)}
    others = (name for name in parameter_names(without_corrections(arm)) if name not in without)
    return arm, sorted(dict.fromkeys([*space.names, *others]), key=own.__contains__)
