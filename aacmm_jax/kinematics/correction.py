"""Readings with which a calibrated arm reaches poses, for controllers that know the nominal arm only."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..core.arrays import Numbers, as_array
from ..core.errors import InputError
from ..core.linear_algebra import solve_positive_definite
from ..core.numpy_or_jax import AnyArray, compiled, in_chunks, namespace, numpy_if_known, set_at, to_numpy
from ..core.rotations import cross
from .arm import Arm, checked_limits, is_single
from .chain import ForwardPass, Geometry, forward_pass, joint_motion, joint_motion_of_rows, length_scale, reading_units
from .inverse_kinematics import ARRIVED, EXACT, LARGEST_STEP, ROWS, repeated
from .jacobian import reading_columns, reading_rotations

FULL_POSE = 6  # joints from which on the orientation can be reached as well
_LEVER = 500.0  # mm: a rotation counts as what it moves at this distance
_STILL = 1e-13  # rad, or m of a prismatic joint: a step of this size changes nothing
_ALIGNED = 1e-9  # rad


class ReadingsAtPoses(NamedTuple):
    """Joint readings found for poses, and what remains between the arm's poses at them and those wanted."""

    q: Float[AnyArray, "... n"]  # rad
    distance: Float[AnyArray, "..."]  # of the tip, mm
    angle: Float[AnyArray, "..."]  # of the last frame, rad
    reached: Bool[AnyArray, "..."]  # within 1 nm and 1 nrad; with fewer than six joints within 1 nm


def corrected_readings(
    nominal: Arm, calibrated: Arm, q: Numbers, limits: Sequence[Sequence[float]] | None = None
) -> ReadingsAtPoses:
    """Readings that put the calibrated arm where a controller with the nominal arm believes it to be at ``q``.

    What the controller means by the readings ``q`` is the pose ``nominal.pose(q)``; the readings found make
    ``calibrated.pose`` equal to it, in the base frame that both arms have in common. See `readings_at_poses`.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Commanded joint readings ``(..., n)``, rad; ``(..., n + 1)`` with the temperature of an arm that has a
            thermometer, C, of which a controller knows nothing.
        limits: Lowest and highest reading of each joint, n pairs, rad; by default those of the nominal arm, if any.

    Raises:
        InputError: The arms have other numbers of joints, or one of them is a batch.

    Example:
        >>> ur10e = aj.load_arm("ur10e")
        >>> as_built = ur10e.replace(theta_2=ur10e.theta[1] + 0.001)
        >>> found = aj.kinematics.corrected_readings(ur10e, as_built, q)
        >>> change = found.q - q
        >>> print(f"{change[1]:.4f} rad", bool(found.reached))
        -0.0010 rad True
    """
    if nominal.joints != calibrated.joints:
        raise InputError(f"the arms have {nominal.joints} and {calibrated.joints} joints; give arms with as many.")
    q = as_array(q, "q", like=calibrated.alpha)
    wanted = nominal.pose(q[..., : nominal.joints])
    return readings_at_poses(calibrated, q, wanted, nominal.limits if limits is None else limits)


@numpy_if_known
def readings_at_poses(
    arm: Arm, q: Numbers, poses: Float[AnyArray, "... 4 4"], limits: Sequence[Sequence[float]] | None = None
) -> ReadingsAtPoses:
    """Readings near ``q`` at which the arm has given poses.

    Six joints reach a pose exactly, on the branch of the start. More joints take the least-norm steps, which change
    the readings least; fewer reach the position alone, and ``angle`` says what remains. Works under jit, vmap and
    jacfwd.

    Args:
        arm: One arm.
        q: Readings to begin with ``(..., n)``, rad; ``(..., n + 1)`` with the temperature of an arm with a
            thermometer, C.
        poses: The pose wanted for each, with the tip (mm) as its origin, in the arm's base frame ``(..., 4, 4)``.
        limits: Lowest and highest reading of each joint, n pairs, rad; by default none.

    Raises:
        InputError: The arm is a batch, the limits are no pairs, or the shapes differ.

    Example:
        >>> ur10e = aj.load_arm("ur10e")
        >>> pose = ur10e.pose(q)
        >>> found = aj.kinematics.readings_at_poses(ur10e, q + 0.05, pose)
        >>> print(bool(found.reached), np.abs(found.q - q).max() < 1e-9)
        True True
    """
    if not is_single(arm):
        raise InputError("poses are reached by one arm, but this is a batch; use jax.vmap, or take one of it.")
    q = as_array(q, "q", like=arm.alpha)
    if q.shape[-1:] not in ((arm.joints,), (arm.columns,)) or poses.shape != (*q.shape[:-1], 4, 4):
        raise InputError(
            f"q has shape {q.shape}, poses {poses.shape} and the arm {arm.joints} joints; give (..., n) and "
            "(..., 4, 4) with a pose for each configuration."
        )
    allowed = np.tile([-np.inf, np.inf], (arm.joints, 1))
    if limits is not None:
        allowed = np.asarray(checked_limits(limits, arm.joints, arm.prismatic))
    count = math.prod(q.shape[:-1])
    rows, wanted = q.reshape(count, q.shape[-1]), poses.reshape(count, 4, 4)
    # An arm that has expanded reaches a position where the arm at 20 C reaches it divided by the scale of lengths.
    scale = length_scale(arm.geometry, rows)
    wanted = set_at(wanted, (slice(None), slice(3), 3), wanted[:, :3, 3] / scale[:, None])

    xp = namespace(arm.geometry, rows, wanted)

    def solved(rows: Any) -> Any:
        q, poses = rows[:, : arm.joints], rows[:, arm.joints :].reshape(-1, 4, 4)
        return xp.column_stack(solve_to_poses(arm.geometry, q, poses, allowed))

    both = xp.concatenate([rows[:, : arm.joints], wanted.reshape(count, 16)], axis=1)
    solution = in_chunks(solved, both, ROWS) if xp is np else solved(both)
    readings, distance, angle = solution[:, :-2], scale * solution[:, -2], solution[:, -1]
    reached = (distance <= ARRIVED) & ((angle <= _ALIGNED) | (arm.joints < FULL_POSE))
    shape = q.shape[:-1]
    return ReadingsAtPoses(
        readings.reshape(*shape, arm.joints), *(x.reshape(shape) for x in (distance, angle, reached))
    )


def least_motion(arm: Arm, q: Float[np.ndarray, "N n"]) -> Float[np.ndarray, " N"]:
    """The smallest movement of an arm whose readings change by 1 rad (1 m of a prismatic joint) in all, mm.

    A rotation of the last frame counts as what it moves at 500 mm, with six joints or more. It is 0 in a singular
    configuration, where two axes of a wrist align or an arm is stretched: readings of a pose are not unique there, or
    poses near it have none.
    """
    geometry = to_numpy(arm.geometry)
    forward = forward_pass(geometry, joint_motion(geometry, q))
    columns = np.asarray(reading_columns(forward))
    if arm.joints >= FULL_POSE:
        columns = np.concatenate([columns, _LEVER * np.asarray(reading_rotations(forward))], axis=1)
    columns = columns * np.asarray(reading_units(geometry))[:, None, None]
    return np.linalg.svd(columns.transpose(2, 1, 0), compute_uv=False)[:, -1]


@compiled(jit=partial(jax.jit, static_argnames=("steps",)))
def solve_to_poses(
    geometry: Geometry,
    q: Float[AnyArray, "c n"],
    poses: Float[AnyArray, "c 4 4"],
    limits: Float[AnyArray, "n 2"],
    steps: int = 60,
) -> tuple[Float[AnyArray, "c n"], Float[AnyArray, " c"], Float[AnyArray, " c"]]:
    """Damped least-norm steps to the poses, within the limits; for any jit, vmap or loop. A row does not depend on the
    other rows.

    Returned are the readings, and the distances (mm) and angles (rad) that remain.
    """
    xp, whole = namespace(geometry, q, poses), q.shape[-1] >= FULL_POSE
    low, high = limits[:, :1], limits[:, 1:]
    units = reading_units(geometry)[:, None]

    def step(q: Any, wanted: Any) -> tuple[Any, Any]:
        forward = forward_pass(geometry, joint_motion_of_rows(geometry, q[:, None]))
        gap, rotation = _remaining(forward, wanted)
        columns = reading_columns(forward)
        if whole:
            gap = xp.concatenate([gap, _LEVER * rotation])
            columns = xp.concatenate([columns, _LEVER * reading_rotations(forward)], axis=1)
        columns = columns * units[:, None]
        change = _least_norm(columns, gap)
        # A joint at its limit that a step would take beyond stays there, and the others do what they can.
        stays = ((q <= low) & (change < 0)) | ((q >= high) & (change > 0))
        if xp is not np or stays.any():
            change = _least_norm(xp.where(stays[:, None], 0.0, columns), gap)
        new = xp.clip(q + units * xp.clip(change, -LARGEST_STEP, LARGEST_STEP), low, high)
        is_open, moves = xp.any(xp.abs(gap) > EXACT, axis=0), xp.any(xp.abs(new - q) > _STILL * units, axis=0)
        return new, is_open & moves

    # The step after the gap was seen to be closed takes what Newton's method leaves to rounding.
    wanted = xp.moveaxis(poses[:, :3], 0, -1)
    q = repeated(step, xp.clip(q.T, low, high), [wanted], steps)
    shift, rotation = _remaining(forward_pass(geometry, joint_motion(geometry, q.T)), wanted)
    return q.T, xp.linalg.norm(shift, axis=0), xp.linalg.norm(rotation, axis=0)


def _remaining(
    forward: ForwardPass, wanted: Float[AnyArray, "3 4 N"]
) -> tuple[Float[AnyArray, "3 N"], Float[AnyArray, "3 N"]]:
    """The shift (mm) and the rotation vector (rad) from poses to those wanted.

    With the axes r_k of a frame and w_k of the one wanted, the sum of r_k x w_k is twice the sine times the axis of the
    rotation between them, and that of r_k . w_k is 1 + 2 cos.
    """
    xp = namespace(forward, wanted)
    pairs = [(forward.frame[k], wanted[:, k]) for k in range(3)]
    sine = 0.5 * sum(cross(r, w) for r, w in pairs)
    cosine = 0.5 * (sum(xp.sum(r * w, axis=0) for r, w in pairs) - 1)
    square = xp.sum(sine**2, axis=0)
    small = (square < 1e-12) & (cosine > 0)  # there the angle is its sine to 1e-18
    size = xp.sqrt(xp.where(small, 1.0, square + 1e-300))
    rotation = sine * xp.where(small, 1.0, xp.arctan2(size, cosine) / size)[None]
    return wanted[:, 3] - forward.tip, rotation


def _least_norm(columns: Float[AnyArray, "n m N"], gap: Float[AnyArray, "m N"]) -> Float[AnyArray, "n N"]:
    """J^T (J J^T + damping)^-1 gap. The damping vanishes with the gap, so that the last steps are Newton's; what stays
    of it keeps the matrix positive definite where the arm is singular."""
    # Six equations at most: their matrix J J^T, not the joints' J^T J, which has no inverse with seven joints.
    xp = namespace(columns, gap)
    rows = xp.transpose(columns, (2, 1, 0))
    matrix = rows @ xp.swapaxes(rows, -1, -2)
    size = xp.sum(rows**2, axis=(-2, -1))
    damping = 1e-2 * xp.sum(gap**2, axis=0) + 1e-12 * size + 1e-12
    matrix = matrix + damping[:, None, None] * xp.asarray(np.eye(gap.shape[0]))[None]
    return (solve_positive_definite(matrix, gap.T)[:, None] @ rows)[:, 0].T
