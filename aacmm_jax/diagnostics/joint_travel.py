"""Joints that stand still, or nearly, over the poses of a capture: what that leaves open, and what to fix then."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.text import listed, pluralise
from ..core.units import DEG
from ..data.capture import Capture
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
from ..kinematics.parameters import ArmSpecification, Parameters
from ..uncertainty.identifiability import observability

# An error of 1 mm across a joint's axis changes by 0.02 mm while the joint turns by 1 degree, and one of 1 mrad in the
# direction of a slide by as much over 20 mm: no more than a tip is seated or seen to. Poses within that say nothing.
_TURN, _SLIDE = 1.0 * DEG, 20.0
_SIGMA = 0.05  # mm, of tips: what these determine no better than usual bounds counts as open
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


def standing_rows(arm: Arm, capture: Capture, nominal: ArmSpecification | None = None) -> list[dict[str, Any]]:
    """Joints that (nearly) stand still over all poses, with what they leave open, in one sentence each.

    Args:
        arm: One arm, nominal.
        capture: Poses of it.
        nominal: The arm with the free parameters that a calibration of the capture would take; None: there is none.
    """
    still = standing_joints(arm, np.asarray(capture.readings))
    joints = [standing.joint for standing in still]
    open_by = lost_by_standing(arm, capture, joints)
    remedy = "move it" if len(still) == 1 else "move them"
    if nominal is not None and still:
        added = _open_parameters(nominal.space(), capture, joints)
        held = {name for name in nominal.space().held if not name.startswith(("beta_", "gravity_"))} | added
        remedy += ", or calibrate "
        if added:
            remedy += f"with --held {','.join(name for name in parameter_names(nominal.space().base) if name in held)}"
        else:
            remedy += "as it is: the parameters that are free by default leave nothing open"
    rows = []
    for (joint, travel, poses), names in zip(still, open_by, strict=True):
        unit, size = ("mm", travel) if joint in arm.prismatic else ("deg", travel / DEG)
        says = f"Joint {joint} stands still ({size:.2g} {unit} over {pluralise(poses, 'pose')})"
        if names:
            says += f": {listed(names)} cannot be identified; {remedy}."
        else:
            says += ", which leaves nothing open that such poses could determine."
        rows.append({"joint": joint, f"range_{unit}": size, "poses": poses, "lost": list(names), "says": says})
    return rows


def _open_parameters(space: Parameters, capture: Capture, joints: Sequence[int]) -> set[str]:
    """Free parameters to fix: those lost by standing, and one of each combination that is (nearly) undetermined."""
    # First as if they stood exactly still, since it is little, and mostly noise, that a small movement says.
    fixed = {name for names in lost_by_standing(space.base, capture, joints, space.names) for name in names}
    while capture.lengths or any(one.fixes_scale for one in capture.observations):
        left = Parameters(space.base, tuple(name for name in space.names if name not in fixed))
        seen = observability(left.base, capture, left, sigma=_SIGMA)
        if seen.null.shape[1]:
            fixed.add(left.names[int(np.argmax(np.abs(seen.null[:, 0])))])
        elif seen.trade_offs:
            fixed.add(seen.trade_offs[0].names[0])
        else:
            break
    return fixed


def lost_by_standing(
    arm: Arm, capture: Capture, joints: Sequence[int], names: Sequence[str] = ()
) -> list[tuple[str, ...]]:
    """Parameters that the poses would determine if these joints (from 1) moved in them, and do not while they stand.

    Of what cannot be separated, those of these joints are named; what two of them leave open together, with the later.
    ``names`` are the parameters in question, by default all that data may determine.
    """
    if not joints:
        return []
    base = to_numpy(arm)
    if not names:
        space = Parameters.independent(base)
        base = to_numpy(space.base)
        # Also what sockets do not determine of the nominal arm, but points that were seen on a target may.
        parallel = nearly_parallel(base)
        without = {f"d_{i}" if i in parallel else f"beta_{i}" for i in range(1, base.joints + 1)}
        others = [name for name in parameter_names(without_corrections(base)) if name not in without]
        names = list(dict.fromkeys([*space.names, *others]))
    own = {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta", "beta") for joint in joints}
    order = sorted(names, key=own.__contains__)  # the last are lost first
    neighbour = neighbouring_arm(base, tuple(order))  # without the exact alignments of the nominal arm
    if any(one.target for one in capture.observations):  # whose place is unknown, and hardly on the last axis
        neighbour = with_arrays(neighbour, probe=np.asarray(neighbour.probe) + _TARGET)
    low, high = np.asarray(joint_limits(arm, None)).T
    standing = np.asarray(capture.readings)[0]
    random = np.random.default_rng(0)

    def determined(still: Sequence[int]) -> tuple[str, ...]:
        def changed(q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
            for i in (joint - 1 for joint in joints):
                q[:, i] = standing[i] if i + 1 in still else random.uniform(low[i], high[i], len(q))
            return q

        return determined_at(neighbour, capture, order, changed)

    left = [determined(joints[:count]) for count in range(len(joints) + 1)]
    return [tuple(x for x in before if x not in after) for before, after in itertools.pairwise(left)]
