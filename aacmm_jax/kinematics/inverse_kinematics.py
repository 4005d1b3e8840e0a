"""Inverse kinematics: configurations that put the tip at targets or give the arm poses, by damped least-norm steps.

With the Jacobian J of the tip by the readings and the gap g to the target, the smallest change of the readings that
closes the gap to first order is J^T (J J^T)^-1 g. It is damped by what vanishes with the gap, so that the last steps
are Newton's: dq = J^T (J J^T + 0.01 |g|^2)^-1 g (Levenberg's method; Chan and Lawrence 1988), at most 0.5 rad a joint,
within the limits. `readings_at_poses` and `workspace.into_cones` add the orientation to it; all use `repeated`.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core.arrays import Numbers, as_array
from ..core.errors import InputError
from ..core.linear_algebra import solve_positive_definite
from ..core.numpy_or_jax import AnyArray, compiled, in_chunks, namespace, numpy_if_known, to_numpy
from ..core.random_keys import random_numbers
from ..core.rotations import cross
from .arm import Arm, JointLimits, Limits, checked_limits, is_single
from .chain import (
    ByJoint,
    ForwardPass,
    Geometry,
    forward_pass,
    joint_motion,
    joint_motion_of_rows,
    of_joints,
    reading_units,
)
from .jacobian import reading_columns, reading_rotations

_BATCH = 256  # candidates per call: one compiled shape for every number of targets
ROWS = 2048  # of one call: fewer leave much of the time to Python, more do not fit into the processor's cache
_ROUNDS = 12
_STEPS = 60  # of one attempt; five of six random starts converge
_TOLERANCE, ARRIVED = 1e-9, 1e-6  # mm
LARGEST_STEP = 0.5  # rad, or m of a prismatic joint
EXACT = 1e-7  # mm: one more step closes a gap of this size to rounding
FULL_POSE = 6  # joints from which on the orientation can be reached as well
_LEVER = 500.0  # mm: a rotation counts as what it moves at this distance
_STILL = 1e-13  # rad, or m of a prismatic joint: a step of this size changes nothing
_ALIGNED = 1e-9  # rad

# The part of a capture that kinematics needs: readings ``q`` of the poses, socket after socket, with their number of
# ``columns``; the ``sizes`` of the sockets, the ``owner`` of each pose and the ``ends()`` of lengths, as indices of
# sockets; and other ``observations``, each with its ``q``, its ``target`` and whether it ``fixes_scale``.
SocketPoses = Any


def repeated(
    step: Callable[..., tuple[Any, Any]], q: Any, rows: Sequence[Any], steps: int, *, together: bool = False
) -> Any:
    """``q, more = step(q, *rows)`` at most so many times, each configuration (last axis) until it needs no more.

    NumPy leaves out those that are done, most of them after a dozen steps. In JAX they stay as they are, so that the
    result of one does not depend on the others; or they go on ``together`` until all are done, which brings those near
    a singularity closer and is what the random configurations of studies have been drawn by.
    """
    if namespace(q, rows) is np:
        q, under_way = q.copy(), np.arange(q.shape[-1])
        for _ in range(steps):
            q[..., under_way], more = step(q[..., under_way], *(row[..., under_way] for row in rows))
            under_way = under_way[more]
            if not len(under_way):
                break
        return q

    def body(state: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
        count, q, under_way = state
        new, more = step(q, *rows)
        return (count + 1, new, more) if together else (count + 1, jnp.where(under_way, new, q), under_way & more)

    start = (jnp.zeros((), dtype=np.int32), q, jnp.ones(q.shape[-1:], dtype=bool))
    return jax.lax.while_loop(lambda state: (state[0] < steps) & jnp.any(state[2]), body, start)[1]


@compiled(jit=partial(jax.jit, static_argnames=("steps",)))
def solve_to_targets(
    geometry: Geometry,
    q: Float[AnyArray, "c columns"],
    targets: Float[AnyArray, "c 3"],
    limits: Float[AnyArray, "n 2"],
    steps: int = _STEPS,
    moving: Float[AnyArray, "n c"] | None = None,
) -> tuple[Float[AnyArray, "c columns"], Float[AnyArray, " c"]]:
    """Damped least-norm steps to the targets, within the limits, of at most 0.5 rad a joint; for any jit, vmap or loop.

    Returned are the readings ``(c, columns)``, rad or mm, and the final distances from the targets ``(c,)``, mm. A
    slide of 1 mm counts as a rotation of 1 mrad (`JointKinds.units`). In NumPy a row does not depend on the others; in
    JAX all go on until the last has arrived.

    Args:
        geometry: The arm's ``geometry``.
        q: Joint readings to begin with ``(c, n)``, rad, or mm of prismatic joints; what was recorded beside them stays
            as it is.
        targets: Positions of the tip, one each ``(c, 3)``, mm.
        limits: Lowest and highest reading of each joint ``(n, 2)``, rad or mm.
        steps: Most steps.
        moving: 1 where a joint may move, 0 where it keeps its reading ``(n, c)``; by default all may.

    Example:
        >>> limits = np.tile([-np.pi, np.pi], (6, 1))
        >>> target = np.array([[100.0, 150.0, -100.0]])
        >>> readings, distance = aj.kinematics.solve_to_targets(true.geometry, q[None], target, limits)
        >>> print(true.position(readings).round(3), (distance < 1e-6).all())
        [[ 100.  150. -100.]] True
    """
    xp, low, high = namespace(geometry, q, targets), limits[:, 0, None, None], limits[:, 1, None, None]
    largest = LARGEST_STEP * xp.asarray(reading_units(geometry))[:, None, None]

    def step(q: Any, wanted: Any, *kept: Any) -> tuple[Any, Any]:
        forward = forward_pass(geometry, joint_motion_of_rows(geometry, q))
        gap = wanted - forward.tip
        inverse = weighted_inverse(forward, 1e-2 * xp.sum(gap**2, axis=0) + 1e-12, *kept)
        change = xp.sum(inverse * gap[None], axis=1, keepdims=True)
        joints = xp.clip(of_joints(geometry, q) + xp.clip(change, -largest, largest), low, high)
        q = joints if len(q) == len(joints) else xp.concatenate([joints, q[len(joints) :]])
        return q, xp.any(xp.abs(gap) > EXACT, axis=0)

    # The step after the gap was seen to be closed takes what Newton's method leaves to rounding.
    rows = [targets.T] if moving is None else [targets.T, moving]
    q = repeated(step, q.T[:, None, :], rows, steps, together=True)
    tip = forward_pass(geometry, joint_motion_of_rows(geometry, q)).tip
    return q[:, 0].T, xp.linalg.norm(targets.T - tip, axis=0)


def free_joints(geometry: Geometry, q: Float[AnyArray, "... columns"]) -> int:
    """How many joints an arm moves its tip with; of a robot, the chain that has fewest, of those in these poses."""
    return geometry.alpha.shape[-1] if geometry.kinds is None else geometry.kinds.fewest(q)


def least_norm_inverse(geometry: Geometry, q: Float[AnyArray, "N n"]) -> Float[AnyArray, "n 3 N"]:
    """Least change of every joint per mm that the tip moves along each axis: the pseudo-inverse of the Jacobian, with
    the readings in their units (`JointKinds.units`)."""
    return weighted_inverse(forward_pass(geometry, joint_motion(geometry, q)), np.zeros(q.shape[0]))


def weighted_inverse(
    forward: ForwardPass, damping: Float[AnyArray, "... N"], moving: Float[AnyArray, "n N"] | None = None
) -> ByJoint:
    """`damped_inverse` by the readings, whose squares are counted in their units; rad and mm per mm. Only joints that
    are ``moving`` (1, not 0) take part."""
    columns = reading_columns(forward)
    columns = columns if moving is None else columns * moving[:, None]
    if forward.kinds is None:
        return damped_inverse(columns, damping)
    units = namespace(columns).asarray(forward.kinds.units.reshape(-1, *(1,) * (columns.ndim - 1)))
    return units * damped_inverse(columns * units, damping)


def damped_inverse(columns: ByJoint, damping: Float[AnyArray, "... N"]) -> ByJoint:
    """J^T (J J^T + damping)^-1 for each configuration, from the derivatives of the tip by the joints, mm."""
    # Written out (adjugate over determinant): for matrices this small a library call costs ten times the arithmetic.
    x, y, z = columns[..., 0, :], columns[..., 1, :], columns[..., 2, :]
    xp = namespace(columns)
    xx, yy, zz = (xp.sum(c * c, axis=0) + damping for c in (x, y, z))
    xy, xz, yz = xp.sum(x * y, axis=0), xp.sum(x * z, axis=0), xp.sum(y * z, axis=0)
    adjugate = (
        (yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz),
        (yz * xz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
        (xy * yz - yy * xz, xy * xz - xx * yz, xx * yy - xy * xy),
    )
    # The matrix is [xx xy xz; xy yy yz; xz yz zz]; its determinant by the first row.
    determinant = xx * adjugate[0][0] + xy * adjugate[0][1] + xz * adjugate[0][2]
    rows = [[entry / determinant for entry in row] for row in adjugate]
    return xp.stack([x * row[0][None] + y * row[1][None] + z * row[2][None] for row in rows], axis=-2)


def random_configurations(
    arm: Arm,
    targets: Float[AnyArray, "m 3"],
    key: Array,
    limits: Float[AnyArray, "n 2"],
    labels: Sequence[str] | None = None,
    beside: Float[np.ndarray, "m k"] | None = None,
    held: Float[np.ndarray, "m n"] | None = None,
    enough: int | None = None,
) -> Float[AnyArray, "m n"]:
    """One random configuration for each target, within the limits, exact to 1e-9 mm, with these columns ``beside`` the
    joints, which a robot needs, and the readings that are ``held`` (NaN of joints that may move); `InputError`, with
    the target's label, if none is found. Where so many are ``enough``, others are NaN."""
    arm, targets, limits = to_numpy((arm, targets, limits))
    count = targets.shape[0]
    beside = np.zeros((count, 0)) if beside is None else beside
    q, missing = np.full((count, arm.joints), np.nan), np.arange(count)
    for round_number in range(_ROUNDS * (1 + count // _BATCH)):
        if count - len(missing) >= (count if enough is None else enough):
            return q
        # Every missing target is tried, several times at once if they are few; the first success counts.
        tried = np.resize(missing, _BATCH)
        key_of_round = jax.random.fold_in(key, round_number)
        start = limits[:, 0] + random_numbers("uniform", key_of_round, (_BATCH, arm.joints)) * np.ptp(limits, axis=1)
        moving = None
        if held is not None:
            moving = np.isnan(held[tried].T).astype(float)
            start = np.where(moving.T > 0, start, held[tried])
        start = np.hstack([start, beside[tried]])
        solved, distance = solve_to_targets(*to_numpy((arm.geometry, start, targets[tried], limits)), moving=moving)
        successes = np.flatnonzero(distance <= _TOLERANCE)[::-1]
        q[tried[successes]] = solved[successes, : arm.joints]
        missing = np.setdiff1d(missing, tried[successes])
    if not len(missing):
        return q
    links = float(np.abs(arm.a).sum() + np.abs(arm.d).sum() + np.linalg.norm(arm.probe))
    point = ", ".join(f"{round(float(x)):.6g}" for x in np.asarray(targets[missing[0]]))
    what = labels[missing[0]] if labels else "the target"
    raise InputError(
        f"{what} at ({point}) mm cannot be reached within the joint limits (total length of the links: "
        f"{round(links):.6g} mm); move {what} closer or widen the limits."
    )


def project_to_targets(
    arm: Arm,
    q: Float[np.ndarray, "N columns"],
    targets: Float[np.ndarray, "N 3"],
    limits: JointLimits | None = None,
    steps: int = _STEPS,
    kept: Bool[np.ndarray, "N n"] | None = None,
) -> tuple[Float[np.ndarray, "N columns"], Bool[np.ndarray, " N"]]:
    """Configurations ``(N, n)`` moved by least-norm steps until the tip is at its target, and whether it arrived.

    Args:
        arm: The arm.
        q: Joint readings to begin with ``(N, n)``, rad, or mm of prismatic joints; what was recorded beside them
            stays as it is.
        targets: Positions of the tip, one each ``(N, 3)``, mm.
        limits: Lowest and highest reading of each joint ``(n, 2)``, rad or mm; by default none.
        steps: Most steps of each configuration.
        kept: Joints that keep their reading ``(N, n)``; by default none.

    Example:
        >>> readings, arrived = aj.kinematics.project_to_targets(true, q[None], np.array([[100.0, 150.0, -100.0]]))
        >>> print(true.position(readings).round(3), arrived)
        [[ 100.  150. -100.]] [ True]
    """
    allowed = np.tile([-np.inf, np.inf], (arm.joints, 1)) if limits is None else np.asarray(limits)
    geometry, columns = to_numpy(arm.geometry), q.shape[1]
    moving = np.zeros((len(q), 0)) if kept is None else (~kept).astype(float)

    def moved(rows: np.ndarray) -> np.ndarray:
        readings, wanted, free = np.split(rows, [columns, columns + 3], axis=1)
        return np.column_stack(
            solve_to_targets(geometry, readings, wanted, allowed, steps, free.T if free.size else None)
        )

    solved = in_chunks(moved, np.hstack([q, targets, moving]), ROWS)
    return solved[:, :-1], solved[:, -1] <= ARRIVED


def project_to_centroids(
    arm: Arm, capture: SocketPoses, targets_of: Arm | None = None, kept: Bool[np.ndarray, "N n"] | None = None
) -> Float[np.ndarray, "N n"]:
    """The configurations of a capture moved by least-norm steps until each tip is at its socket's centroid, but for
    joints that are ``kept``.

    ``targets_of`` is the arm that the centroids come from; by default the same. Tips of a nominal arm that is some mm
    wrong scatter, which makes directions look determined that are not, such as a rotation about the base.
    """
    q, source = np.asarray(capture.q), arm if targets_of is None else targets_of
    tips = in_chunks(lambda rows: np.asarray(source.position(rows)), q)
    sums = np.stack([np.bincount(capture.owner, weights=tips[:, axis]) for axis in range(3)], axis=1)
    moved, arrived = project_to_targets(arm, q, (sums / np.asarray(capture.sizes)[:, None])[capture.owner], kept=kept)
    return np.where(arrived[:, None], moved, q)


class ReadingsAtPoses(NamedTuple):
    """Joint readings found for poses, and what remains between the arm's poses at them and those wanted."""

    q: Float[AnyArray, "... n"]  # rad
    distance: Float[AnyArray, "..."]  # of the tip, mm
    angle: Float[AnyArray, "..."]  # of the last frame, rad
    reached: Bool[AnyArray, "..."]  # within 1 nm and 1 nrad; with fewer than six joints within 1 nm


def corrected_readings(nominal: Arm, calibrated: Arm, q: Numbers, limits: Limits | None = None) -> ReadingsAtPoses:
    """Readings that put the calibrated arm where a controller with the nominal arm computes it to be at ``q``.

    What the controller means by the readings ``q`` is the pose ``nominal.pose(q)``; the readings found make
    ``calibrated.pose`` equal to it, in the base frame that both arms have in common (`readings_at_poses`). `InputError`
    where the arms have other numbers of joints, or one of them is a batch.

    Args:
        nominal: The arm that the controller has.
        calibrated: The calibrated arm.
        q: Commanded joint readings ``(..., n)``, rad; ``(..., n + 1)`` with the temperature of an arm that has a
            thermometer, C, which a controller does not use.
        limits: Lowest and highest reading of each joint, n pairs, rad; by default those of the nominal arm, if any.

    Example:
        >>> ur10e = aj.load_arm("ur10e")
        >>> as_built = ur10e.replace(theta_2=ur10e.theta[1] + 0.001)
        >>> corrected = aj.kinematics.corrected_readings(ur10e, as_built, q)
        >>> print(f"{(corrected.q - q)[1]:.4f} rad", bool(corrected.reached))
        -0.0010 rad True
    """
    if nominal.joints != calibrated.joints:
        raise InputError(
            f"the arms have {nominal.joints} and {calibrated.joints} joints; give arms with the same number of joints."
        )
    q = as_array(q, "q", like=calibrated.alpha)
    wanted = nominal.pose(q[..., : nominal.beside.own])
    return readings_at_poses(calibrated, q, wanted, nominal.limits if limits is None else limits)


@numpy_if_known
def readings_at_poses(
    arm: Arm, q: Numbers, poses: Float[AnyArray, "... 4 4"], limits: Limits | None = None
) -> ReadingsAtPoses:
    """Readings near ``q`` at which the arm has given poses.

    Six joints reach a pose exactly, on the branch of the start. More joints take the least-norm steps, which change
    the readings least; fewer reach the position alone, and ``angle`` says what remains. Works under jit, vmap and
    jacfwd. `InputError` where the arm is a batch, the limits are no pairs, or the shapes differ.

    Args:
        arm: One arm.
        q: Readings to begin with ``(..., n)``, rad, with what was recorded beside them, which stays as it is.
        poses: The pose wanted for each, with the tip (mm) as its origin, in the arm's base frame ``(..., 4, 4)``.
        limits: Lowest and highest reading of each joint, n pairs, rad; by default none.

    Example:
        >>> ur10e = aj.load_arm("ur10e")
        >>> pose = ur10e.pose(q)
        >>> solution = aj.kinematics.readings_at_poses(ur10e, q + 0.05, pose)
        >>> print(bool(solution.reached), np.abs(solution.q - q).max() < 1e-9)
        True True
    """
    if not is_single(arm):
        raise InputError("a single arm is needed, but this is a batch; use jax.vmap, or select one arm of the batch.")
    q, n = as_array(q, "q", like=arm.alpha), arm.joints
    if q.shape[-1] not in arm.possible_columns or poses.shape != (*q.shape[:-1], 4, 4):
        raise InputError(
            f"q has shape {q.shape}, poses has shape {poses.shape}, and the arm has {n} joints; give q as (..., n) "
            "and poses as (..., 4, 4), with one pose per configuration."
        )
    allowed = np.tile([-np.inf, np.inf], (n, 1))
    if limits is not None:
        allowed = np.asarray(checked_limits(limits, n, arm.prismatic, arm.fixed))
    shape, geometry, count = q.shape[:-1], arm.geometry, math.prod(q.shape[:-1])
    xp, columns = namespace(geometry, q, poses), q.shape[-1]

    def solved(rows: Any) -> Any:
        return _solve_to_poses(geometry, rows[:, :columns].T, rows[:, columns:].reshape(-1, 4, 4), allowed)

    both = xp.concatenate([q.reshape(count, columns), poses.reshape(count, 16)], axis=1)
    solution = in_chunks(solved, both, ROWS) if xp is np else solved(both)
    readings, distance, angle = solution[:, :n], solution[:, -2], solution[:, -1]
    reached = (distance <= ARRIVED) & ((angle <= _ALIGNED) | (free_joints(geometry, q) < FULL_POSE))
    return ReadingsAtPoses(readings.reshape(*shape, n), *(x.reshape(shape) for x in (distance, angle, reached)))


def _solve_to_poses(
    geometry: Geometry, q: Float[AnyArray, "columns c"], poses: Float[AnyArray, "c 4 4"], limits: JointLimits
) -> Float[AnyArray, "c others"]:
    """Readings by damped least-norm steps to the poses, and the distance (mm) and angle (rad) that remain."""
    xp, n = namespace(geometry, q, poses), len(limits)
    whole = free_joints(geometry, q.T) >= FULL_POSE
    low, high, units = limits[:, :1], limits[:, 1:], reading_units(geometry)[:, None]

    def step(q: Any, wanted: Any) -> tuple[Any, Any]:
        forward = forward_pass(geometry, joint_motion_of_rows(geometry, q[:, None]))
        gap, rotation = _remaining(forward, wanted)
        columns = reading_columns(forward)
        if whole:
            gap = xp.concatenate([gap, _LEVER * rotation])
            columns = xp.concatenate([columns, _LEVER * reading_rotations(forward)], axis=1)
        columns = columns * units[:, None]
        change, joints = _least_norm(columns, gap), q[:n]
        # A joint at its limit that a step would take beyond stays there, and the others do what they can.
        stays = ((joints <= low) & (change < 0)) | ((joints >= high) & (change > 0))
        if xp is not np or stays.any():
            change = _least_norm(xp.where(stays[:, None], 0.0, columns), gap)
        new = xp.clip(joints + units * xp.clip(change, -LARGEST_STEP, LARGEST_STEP), low, high)
        is_open, moves = xp.any(xp.abs(gap) > EXACT, axis=0), xp.any(xp.abs(new - joints) > _STILL * units, axis=0)
        return xp.concatenate([new, q[n:]]), is_open & moves

    # The step after the gap was seen to be closed takes what Newton's method leaves to rounding.
    wanted = xp.moveaxis(poses[:, :3], 0, -1)
    q = repeated(step, xp.concatenate([xp.clip(q[:n], low, high), q[n:]]), [wanted], _STEPS)
    shift, rotation = _remaining(forward_pass(geometry, joint_motion(geometry, q.T)), wanted)
    return xp.column_stack([q.T, xp.linalg.norm(shift, axis=0), xp.linalg.norm(rotation, axis=0)])


def _remaining(forward: ForwardPass, wanted: Float[AnyArray, "3 4 N"]) -> tuple[AnyArray, AnyArray]:
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
    xp, rows = namespace(columns, gap), columns.transpose(2, 1, 0)
    matrix, size = rows @ xp.swapaxes(rows, -1, -2), xp.sum(rows**2, axis=(-2, -1))
    damping = 1e-2 * xp.sum(gap**2, axis=0) + 1e-12 * size + 1e-12
    matrix = matrix + damping[:, None, None] * xp.asarray(np.eye(gap.shape[0]))[None]
    return (solve_positive_definite(matrix, gap.T)[:, None] @ rows)[:, 0].T


def least_motion(arm: Arm, q: Float[np.ndarray, "N n"]) -> Float[np.ndarray, " N"]:
    """The smallest movement of an arm whose readings change by 1 rad (1 m of a prismatic joint) in all, mm.

    A rotation of the last frame counts as what it moves at 500 mm, with six joints or more. It is 0 in a singular
    configuration, as where two axes of a wrist align: readings of a pose are not unique there, or poses near it have
    none.
    """
    geometry = to_numpy(arm.geometry)
    forward = forward_pass(geometry, joint_motion(geometry, q))
    columns = np.asarray(reading_columns(forward))
    if free_joints(geometry, q) >= FULL_POSE:
        columns = np.concatenate([columns, _LEVER * np.asarray(reading_rotations(forward))], axis=1)
    columns = columns * reading_units(geometry)[:, None, None]
    return np.linalg.svd(columns.transpose(2, 1, 0), compute_uv=False)[:, -1]
