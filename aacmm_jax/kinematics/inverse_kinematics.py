"""Inverse kinematics: configurations that put the tip at targets. The only implementation; all others call it.

* `random_configurations`: one at each target, from random starts; for simulation.
* `project_to_targets`: given ones moved to their targets by least-norm steps within limits, and which of them arrived.
* `project_to_centroids`: those of a capture moved until each socket's tips coincide.
* `solve_to_targets`, `least_norm_inverse`, `damped_inverse`: their parts, for callers with a jit of their own.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, in_chunks, namespace, to_numpy
from ..core.random_keys import random_numbers
from .arm import Arm
from .chain import ForwardPass, Geometry, forward_pass, joint_motion, joint_motion_of_rows, length_scale
from .jacobian import reading_columns

_BATCH = 256  # candidates per call: one compiled shape for every number of targets
_ROWS = 2048  # of one call: fewer leave much of the time to Python, more do not fit into the processor's cache
_ROUNDS = 12
_STEPS = 60  # of one attempt; five of six random starts converge
_TOLERANCE, _ARRIVED = 1e-9, 1e-6  # mm
_LARGEST_STEP = 0.5  # rad, or m of a prismatic joint
_EXACT = 1e-7  # mm: one more step closes a gap of this size to rounding


@runtime_checkable
class ObservedPoses(Protocol):
    """The part of an observation that kinematics needs."""

    @property
    def q(self) -> Float[AnyArray, "m n"]:
        """Joint readings, rad, or mm of prismatic joints."""
        ...

    @property
    def target(self) -> str:
        """Name of a tip at an unknown place in the last frame; empty for the arm's own probe."""
        ...

    @property
    def fixes_scale(self) -> bool:
        """Whether the observation determines the scale of the arm."""
        ...


@runtime_checkable
class SocketPoses(Protocol):
    """The part of a capture that kinematics needs: poses, socket after socket, lengths, and the rest."""

    @property
    def q(self) -> Float[AnyArray, "N n"]:
        """Joint readings, rad, or mm of prismatic joints."""
        ...

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of poses of each socket."""
        ...

    @property
    def columns(self) -> int:
        """Number of columns of the readings."""
        ...

    @property
    def owner(self) -> Int[np.ndarray, " N"]:
        """Index of the socket that each pose belongs to."""
        ...

    @property
    def observations(self) -> tuple[ObservedPoses, ...]:
        """What else was observed."""
        ...

    def ends(self) -> Int[np.ndarray, "l 2"]:
        """Socket indices of every length's two ends."""
        ...


@compiled(jit=partial(jax.jit, static_argnames=("steps",)))
def solve_to_targets(
    geometry: Geometry,
    q: Float[AnyArray, "c n"],
    targets: Float[AnyArray, "c 3"],
    limits: Float[AnyArray, "n 2"],
    steps: int = _STEPS,
) -> tuple[Float[AnyArray, "c n"], Float[AnyArray, " c"]]:
    """Damped least-norm steps to the targets, within the limits, of at most 0.5 rad a joint; for any jit, vmap or loop.

    A slide of 1 mm counts as a rotation of 1 mrad (`JointKinds.units`). The result of a row does not depend on the
    other rows. NumPy leaves out rows that have arrived, most of them after a dozen steps.

    Args:
        geometry: The arm's ``geometry``.
        q: Joint readings to begin with ``(c, n)``, rad, or mm of prismatic joints.
        targets: Positions of the tip, one each ``(c, 3)``, mm.
        limits: Lowest and highest reading of each joint ``(n, 2)``, rad or mm.
        steps: Most steps.

    Returns:
        The joint readings ``(c, n)``, rad or mm, and the final distances from the targets ``(c,)``, mm.

    Example:
        >>> limits = np.tile([-np.pi, np.pi], (6, 1))
        >>> target = np.array([[100.0, 150.0, -100.0]])
        >>> found, distance = aj.kinematics.solve_to_targets(true.geometry, q[None], target, limits)
        >>> print(true.position(found).round(3), (distance < 1e-6).all())
        [[ 100.  150. -100.]] True
    """
    xp, low, high = namespace(geometry, q, targets), limits[:, 0, None, None], limits[:, 1, None, None]
    largest = (
        _LARGEST_STEP if geometry.kinds is None else _LARGEST_STEP * xp.asarray(geometry.kinds.units)[:, None, None]
    )

    def step(q: Any, wanted: Any) -> tuple[Any, Any]:
        forward = forward_pass(geometry, joint_motion_of_rows(geometry, q))
        gap = wanted - forward.tip
        # The damping vanishes with the distance, so that the last steps are Newton's.
        damping = 1e-2 * xp.sum(gap**2, axis=0) + 1e-12
        inverse = weighted_inverse(forward, damping)
        change = xp.sum(inverse * gap[None], axis=1, keepdims=True)
        return xp.clip(q + xp.clip(change, -largest, largest), low, high), gap

    # A step after the gap was seen to be closed takes what Newton's method leaves to rounding.
    q, wanted = q.T[:, None, :], targets.T
    if xp is np:
        q, under_way = q.copy(), np.arange(q.shape[-1])
        for _ in range(steps):
            q[..., under_way], gap = step(q[..., under_way], wanted[:, under_way])
            under_way = under_way[np.any(np.abs(gap) > _EXACT, axis=0)]
            if not len(under_way):
                break
    else:
        _, q, _ = jax.lax.while_loop(
            lambda state: (state[0] < steps) & jnp.any(jnp.abs(state[2]) > _EXACT),
            lambda state: (state[0] + 1, *step(state[1], wanted)),
            (jnp.zeros((), dtype=np.int32), q, jnp.ones_like(wanted)),
        )
    tip = forward_pass(geometry, joint_motion_of_rows(geometry, q)).tip
    return q[:, 0].T, xp.linalg.norm(wanted - tip, axis=0)


def least_norm_inverse(geometry: Geometry, q: Float[AnyArray, "N n"]) -> Float[AnyArray, "n 3 N"]:
    """Least change of every joint per mm that the tip moves along each axis: the pseudo-inverse of the Jacobian, with
    the readings in their units (`JointKinds.units`)."""
    return weighted_inverse(forward_pass(geometry, joint_motion(geometry, q)), np.zeros(q.shape[0]))


def weighted_inverse(forward: ForwardPass, damping: Float[AnyArray, "... N"]) -> Float[AnyArray, "n ... 3 N"]:
    """`damped_inverse` by the readings, whose squares are counted in their units; rad and mm per mm."""
    columns = reading_columns(forward)
    if forward.kinds is None:
        return damped_inverse(columns, damping)
    units = namespace(columns).asarray(forward.kinds.units.reshape(-1, *(1,) * (columns.ndim - 1)))
    return units * damped_inverse(columns * units, damping)


def damped_inverse(
    columns: Float[AnyArray, "n ... 3 N"], damping: Float[AnyArray, "... N"]
) -> Float[AnyArray, "n ... 3 N"]:
    """J^T (J J^T + damping)^-1 for each configuration, from ``columns``, the derivatives of the tip by the joints, mm.

    The inverse is written out (adjugate over determinant): for matrices this small a library call costs ten times the
    arithmetic.
    """
    x, y, z = columns[..., 0, :], columns[..., 1, :], columns[..., 2, :]
    xp = namespace(columns)
    xx, yy, zz = (xp.sum(c * c, axis=0) + damping for c in (x, y, z))
    xy, xz, yz = xp.sum(x * y, axis=0), xp.sum(x * z, axis=0), xp.sum(y * z, axis=0)
    adjugate = (
        (yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz),
        (yz * xz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
        (xy * yz - yy * xz, xy * xz - xx * yz, xx * yy - xy * xy),
    )
    determinant = xx * adjugate[0][0] + xy * adjugate[0][1] + xz * adjugate[0][2]
    rows = [[entry / determinant for entry in row] for row in adjugate]
    return xp.stack([x * row[0][None] + y * row[1][None] + z * row[2][None] for row in rows], axis=-2)


def random_configurations(
    arm: Arm,
    targets: Float[AnyArray, "m 3"],
    key: Array,
    limits: Float[AnyArray, "n 2"],
    labels: Sequence[str] | None = None,
) -> Float[AnyArray, "m n"]:
    """One random configuration for each target, within the limits, exact to 1e-9 mm.

    Raises `InputError`, with the target's label, if none is found.
    """
    arm, targets, limits = to_numpy((arm, targets, limits))
    wanted = targets.shape[0]
    angles = np.zeros((wanted, arm.joints))
    missing = np.arange(wanted)
    for round_number in range(_ROUNDS * (1 + wanted // _BATCH) if wanted else 0):
        # Every missing target is tried, several times at once if they are few; the first success counts.
        tried = np.resize(missing, _BATCH)
        key_of_round = jax.random.fold_in(key, round_number)
        start = limits[:, 0] + random_numbers("uniform", key_of_round, (_BATCH, arm.joints)) * np.ptp(limits, axis=1)
        solved, distance = solve_to_targets(*to_numpy((arm.geometry, start, targets[tried], limits)))
        successes = np.flatnonzero(distance <= _TOLERANCE)[::-1]
        angles[tried[successes]] = solved[successes]
        missing = np.setdiff1d(missing, tried[successes])
        if not len(missing):
            return angles
    if not wanted:
        return angles
    links = float(np.abs(arm.a).sum() + np.abs(arm.d).sum() + np.linalg.norm(arm.probe))
    point = ", ".join(f"{round(float(x)):.6g}" for x in np.asarray(targets[missing[0]]))
    what = labels[missing[0]] if labels else "the target"
    raise InputError(
        f"{what} at ({point}) mm cannot be reached within the joint limits (the links together measure "
        f"{round(links):.6g} mm); move it closer or widen the limits."
    )


def project_to_targets(
    arm: Arm,
    q: Float[np.ndarray, "N columns"],
    targets: Float[np.ndarray, "N 3"],
    limits: Float[np.ndarray, "n 2"] | None = None,
    steps: int = _STEPS,
) -> tuple[Float[np.ndarray, "N columns"], Bool[np.ndarray, " N"]]:
    """Configurations moved by least-norm steps until the tip is at its target.

    Args:
        arm: The arm.
        q: Joint readings to begin with ``(N, n)``, rad, or mm of prismatic joints; a thermometer's stay as they are.
        targets: Positions of the tip, one each ``(N, 3)``, mm.
        limits: Lowest and highest reading of each joint ``(n, 2)``, rad or mm; by default none.
        steps: Most steps of each configuration.

    Returns:
        The joint readings ``(N, n)``, rad or mm, and whether the tip arrived ``(N,)``.

    Example:
        >>> found, arrived = aj.kinematics.project_to_targets(true, q[None], np.array([[100.0, 150.0, -100.0]]))
        >>> print(true.position(found).round(3), arrived)
        [[ 100.  150. -100.]] [ True]
    """
    allowed = np.tile([-np.inf, np.inf], (arm.joints, 1)) if limits is None else np.asarray(limits)
    geometry = to_numpy(arm.geometry)

    def moved(rows: np.ndarray) -> np.ndarray:
        found, distance = solve_to_targets(geometry, rows[:, :-3], rows[:, -3:], allowed, steps)
        return np.hstack([found, distance[:, None]])

    # An arm that has expanded is at the target where the arm at 20 C is at the target divided by the scale of lengths.
    joints, temperature = q[:, : arm.joints], q[:, arm.joints :]
    found = in_chunks(moved, np.hstack([joints, targets / length_scale(geometry, q)[:, None]]), _ROWS)
    return np.hstack([found[:, :-1], temperature]), found[:, -1] <= _ARRIVED


def project_to_centroids(arm: Arm, capture: SocketPoses, targets_of: Arm | None = None) -> Float[np.ndarray, "N n"]:
    """The configurations of a capture moved by least-norm steps until each tip is at its socket's centroid.

    ``targets_of`` is the arm that the centroids come from; by default the same. With a nominal arm that is some mm
    wrong the tips scatter, and scattered tips make directions look determined that are not, such as a rotation about
    the base.
    """
    q = np.asarray(capture.q)
    owner = capture.owner
    source = arm if targets_of is None else targets_of
    tips = in_chunks(lambda rows: np.asarray(source.position(rows)), q)
    sizes = np.asarray(capture.sizes)
    sums = np.stack([np.bincount(owner, weights=tips[:, axis]) for axis in range(3)], axis=1)
    targets = (sums / sizes[:, None])[owner]
    moved, reached = project_to_targets(arm, q, targets)
    return np.where(reached[:, None], moved, q)
