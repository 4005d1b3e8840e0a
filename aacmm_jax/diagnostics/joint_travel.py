"""Joints that stand still, or nearly, over the poses of a capture: what that leaves open, and what to fix then."""

from collections.abc import Callable, Sequence
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
    is_length,
    joint_limits,
    neighbouring_arm,
    parameter_names,
    value_of,
    with_arrays,
    without_corrections,
)
from ..kinematics.independence import determined_at, nearly_parallel
from ..kinematics.inverse_kinematics import SocketPoses
from ..kinematics.parameters import ArmSpecification, Bounds, Parameters
from ..uncertainty.identifiability import observability

# An error of 1 mm across a joint's axis changes by 0.02 mm while the joint turns by 1 degree, and one of 1 mrad in the
# direction of a slide by as much over 20 mm: no more than a tip is seated or seen to. Poses within that say nothing.
_TURN, _SLIDE = 1.0 * DEG, 20.0
_TARGET = np.array([100.0, 70.0, 50.0])  # mm
_SIGMA = 0.05  # mm; of tips where nothing better is known
_SHARE = 0.1  # of the largest component of a direction: a parameter with less does not stand for it
_ROUNDING = 1e-6


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


def standing_rows(
    arm: Arm, capture: Capture, nominal: ArmSpecification | None = None, sigma: float = _SIGMA
) -> list[dict[str, Any]]:
    """Joints that (nearly) stand still over all poses, with what they leave open, in one sentence each.

    Args:
        arm: One arm, nominal.
        capture: Poses of it.
        nominal: The arm with the free parameters that a calibration of the capture would take; None: there is none.
        sigma: Standard deviation of a tip coordinate, mm.
    """
    rows, still = [], standing_joints(arm, np.asarray(capture.readings))
    joints = [standing.joint for standing in still]
    open_by = lost_by_standing(arm, capture, joints) if still else []
    last = max((i for i, lost in enumerate(open_by) if lost), default=None)
    for i, (standing, lost) in enumerate(zip(still, open_by, strict=True)):
        joint, poses = standing.joint, standing.poses
        unit, size = ("mm", standing.range) if joint in arm.prismatic else ("deg", standing.range / DEG)
        says = f"Joint {joint} stands still ({size:.2g} {unit} over {pluralise(poses, 'pose')})"
        if lost:
            says += f": {listed(lost)} cannot be identified"
            says += f"; {_what_to_do(joints, capture, nominal, sigma)}." if i == last else "."
        else:
            says += ", which leaves nothing open that such poses could determine."
        rows.append({"joint": joint, f"range_{unit}": size, "poses": poses, "lost": list(lost), "says": says})
    return rows


def _what_to_do(joints: list[int], capture: Capture, nominal: ArmSpecification | None, sigma: float) -> str:
    move = "move it" if len(joints) == 1 else "move them"
    if nominal is None:
        return move
    bounds = nominal.bounds()
    fixed = fixed_parameters(bounds, capture, joints, sigma)
    if not set(fixed) & set(bounds.space.names):
        return f"{move}, or calibrate as it is: the parameters that are free by default leave nothing open"
    return f"{move}, or calibrate with --held {','.join(fixed)} (then nothing is said of these)"


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

    def known(still: Sequence[int]) -> tuple[str, ...]:
        def changed(q: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
            for i in (joint - 1 for joint in joints):
                q[:, i] = standing[i] if i + 1 in still else random.uniform(low[i], high[i], len(q))
            return q

        return determined_at(neighbour, capture, order, changed)

    before, lost = known(()), []
    for count in range(1, len(joints) + 1):
        left = known(joints[:count])
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


def fixed_parameters(bounds: Bounds, capture: Capture, joints: Sequence[int], sigma: float) -> tuple[str, ...]:
    """Parameters whose values should be fixed: those that are, and one of each combination that is not determined.

    Of what cannot be separated, angles and lengths that are nominally zero are fixed first, those of these joints
    before others: another length, fixed at its nominal value, would set the scale beside what was measured.

    Args:
        bounds: The free parameters as a calibration would take them, and their bounds.
        capture: The poses.
        joints: Joints, from 1, whose parameters are fixed rather than others'.
        sigma: Standard deviation of a tip coordinate, mm, by which combinations are hardly determined.

    Returns:
        The names of all fixed parameters, in the arm's order.
    """
    arm = bounds.space.base
    own = {f"{kind}_{joint}" for kind in ("alpha", "a", "d", "theta", "beta") for joint in joints}

    def rank(name: str) -> tuple[bool, bool]:
        return is_length(name) and abs(float(value_of(arm, name))) > _ROUNDING, name not in own

    # First as if they stood exactly still, since it is little, and mostly noise, that a small movement says.
    order = sorted(bounds.space.names, key=rank, reverse=True)
    lost = {name for part in lost_by_standing(arm, capture, joints, order) for name in part}
    names = [name for name in bounds.space.names if name not in lost]
    scaled = bool(capture.lengths) or any(one.fixes_scale for one in capture.observations)
    for _ in bounds.space.names:
        space = Parameters(arm, tuple(names))
        seen = observability(arm, capture, space, sigma=sigma, bounds=_of(bounds, space))
        null = seen.null if scaled else _without_scale(seen.null, space)
        if null.shape[1]:
            fixed = _leading(null, names, rank)
        elif seen.trade_offs:
            weak = seen.trade_offs[0]
            amounts = np.abs(weak.amounts)
            enough = [
                name for name, amount in zip(weak.names, amounts, strict=True) if amount >= _SHARE * amounts.max()
            ]
            fixed = [min(enough, key=rank)]
        else:
            break
        if len(fixed) == len(names):
            break
        names = [name for name in names if name not in fixed]
    added = {name for name in bounds.space.names if name not in names}
    usual = {name for name in bounds.space.held if not name.startswith(("beta_", "gravity_"))}
    return tuple(name for name in parameter_names(arm) if name in usual | added)


def _of(bounds: Bounds, space: Parameters) -> Bounds:
    rows = [bounds.space.names.index(name) for name in space.names]
    return Bounds(space, np.asarray(bounds.lower)[rows], np.asarray(bounds.upper)[rows])


def _leading(
    null: Float[np.ndarray, "p k"], names: Sequence[str], rank: Callable[[str], tuple[bool, bool]]
) -> list[str]:
    """As many parameters as there are directions, each in what those before it leave of them."""
    rest, leading = null.copy(), []
    for _ in range(null.shape[1]):
        sizes = np.linalg.norm(rest, axis=1)
        first = min(np.flatnonzero(sizes > _SHARE * sizes.max()).tolist(), key=lambda i: (*rank(names[i]), -sizes[i]))
        direction = rest[first] / sizes[first]
        rest = rest - np.outer(rest @ direction, direction)
        leading.append(names[first])
    return leading


def _without_scale(null: Float[np.ndarray, "p k"], space: Parameters) -> Float[np.ndarray, "p left"]:
    """Directions beside that of all lengths together, which nothing sets in such captures."""
    scale = np.where(space.lengths, np.asarray(space.vector(space.base)), 0.0)
    scale = scale / max(float(np.linalg.norm(scale)), _ROUNDING)
    basis, sizes, _ = np.linalg.svd(null - np.outer(scale, scale @ null), full_matrices=False)
    return basis[:, sizes > _ROUNDING]
