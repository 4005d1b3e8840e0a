"""Recordings made up: poses of an arm that reach given points, with the noise of encoders and of the probe's seat."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError, nearest
from ..kinematics import chain
from ..kinematics.arm import Arm, checked_limits, is_single
from ..kinematics.parameters import Parameters
from .capture import Capture, ReferenceLength
from .noise import ARCSEC

_BATCH = 256  # candidates per call: one compiled shape for every number of poses
_ROUNDS = 12
_STEPS = 60  # of one attempt; five of six starts arrive
_TOLERANCE = 1e-9  # mm


def simulate(
    arm: Arm,
    sockets: Mapping[str, Numbers],
    *,
    poses: int | Mapping[str, int] = 70,
    lengths: Iterable[ReferenceLength | tuple] = (),
    encoder_arcsec: float = 0.0,
    resolution_arcsec: float = 0.0,
    seating: float = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    seed: int = 0,
) -> Capture:
    """Record a capture with a simulated arm; noise-free unless asked otherwise.

    - ``sockets``: socket name -> position (x, y, z) in mm, in the base frame.
    - ``poses``: how many poses hold each socket, or a number per socket.
    - ``lengths``: `ReferenceLength` objects as they are; or ``("A", "B")`` and ``("A", "B", u)``, whose certified value
      is the true distance, plus an error drawn with standard deviation u (mm).
    - ``encoder_arcsec``: standard deviation of a reading; ``resolution_arcsec``: readings are rounded to multiples of it.
    - ``seating``: standard deviation, a coordinate, of the tip's centre about the socket's, mm.
    - ``limits``: lowest and highest reading of each joint, rad; by default the arm's own, else half a turn each way.

    Poses start at random within the limits and are moved onto the point by least-norm steps, so they spread over the
    freedom that a redundant arm has left. The same seed gives the same capture.

    Raises `InputError` for a point out of reach and for noise that is negative.
    """
    for what, value in (("encoder_arcsec", encoder_arcsec), ("resolution_arcsec", resolution_arcsec), ("seating", seating)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"{what} is {value:g}; noise must be zero or positive.")
    if not is_single(arm):
        raise InputError("simulate takes one arm, not a batch; take one of it first.")
    if not sockets:
        raise InputError("simulate needs at least one socket with its position.")
    limits_array = limits_of(arm, limits)
    points = {name: socket_point(name, point) for name, point in sockets.items()}
    counts = _counts(points, poses)
    key = jax.random.key(seed)
    reach_key, seat_key, encoder_key, length_key = jax.random.split(key, 4)
    owner = [name for name, count in counts.items() for _ in range(count)]
    exact = jnp.asarray(np.repeat(np.stack([np.asarray(point) for point in points.values()]), list(counts.values()), axis=0))
    targets = exact + seating * jax.random.normal(seat_key, exact.shape)
    references = _reference_lengths(points, lengths, length_key)
    angles = reach(arm, targets, reach_key, limits_array, labels=[f"socket '{name}'" for name in owner])
    angles = angles + encoder_arcsec * ARCSEC * jax.random.normal(encoder_key, angles.shape)
    if resolution_arcsec > 0:
        angles = jnp.round(angles / (resolution_arcsec * ARCSEC)) * (resolution_arcsec * ARCSEC)
    ends = np.cumsum(list(counts.values()))
    readings = {name: angles[end - count : end] for (name, count), end in zip(counts.items(), ends, strict=True)}
    return Capture(readings, references)


def deviated(space: Parameters, *, length: float, angle: float, seed: int = 0) -> Arm:
    """An arm that differs from the space's base: free lengths by up to ``length`` mm, free angles by up to ``angle`` rad.

    Uniform and independent; what the maker's tolerances might have left.
    """
    for what, value in (("length", length), ("angle", angle)):
        if not (math.isfinite(value) and value >= 0):
            raise InputError(f"the deviation of a free {what} is {value:g}; it must be zero or positive.")
    width = jnp.where(jnp.asarray(space.lengths), length, angle)
    shift = jax.random.uniform(jax.random.key(seed), width.shape, minval=-1.0, maxval=1.0)
    return space.arm(space.vector() + width * shift)


def reach(
    arm: Arm, targets: Float[Array, "m 3"], key: Array, limits: Float[Array, "n 2"], labels: Sequence[str] | None = None
) -> Float[Array, "m n"]:
    """One random pose for each target, within the limits, exact to 1e-9 mm.

    Raises `InputError`, with the target's label, where no pose is found.
    """
    wanted = targets.shape[0]
    angles = np.zeros((wanted, arm.joints))
    missing = np.arange(wanted)
    for round_number in range(_ROUNDS * (1 + wanted // _BATCH)):
        # Every missing target is tried, several times at once where they are few; the first success counts.
        tried = np.resize(missing, _BATCH)
        start = jax.random.uniform(
            jax.random.fold_in(key, round_number),
            (_BATCH, arm.joints),
            minval=limits[None, :, 0],
            maxval=limits[None, :, 1],
        )
        solved, distance = (np.asarray(x) for x in approach(arm.geometry, start, targets[tried], limits))
        successes = np.flatnonzero(distance <= _TOLERANCE)[::-1]
        angles[tried[successes]] = solved[successes]
        missing = np.setdiff1d(missing, tried[successes])
        if not len(missing):
            return jnp.asarray(angles)
    links = float(jnp.sum(jnp.abs(arm.a)) + jnp.sum(jnp.abs(arm.d)) + jnp.linalg.norm(arm.probe))
    point = ", ".join(f"{x:.0f}" for x in np.asarray(targets[missing[0]]))
    what = labels[missing[0]] if labels else "the target"
    raise InputError(
        f"{what} at ({point}) mm cannot be reached within the joint limits (the links together measure {links:.0f} mm); "
        "move it closer or widen the limits."
    )


@partial(jax.jit, static_argnames=("steps",))
def approach(
    geometry: chain.Geometry,
    q: Float[Array, "c n"],
    targets: Float[Array, "c 3"],
    limits: Float[Array, "n 2"],
    steps: int = _STEPS,
) -> tuple[Float[Array, "c n"], Float[Array, " c"]]:
    """Damped least-norm steps (at most 0.5 rad a joint, within the limits) towards the targets; final distances."""
    low, high = limits[:, 0, None, None], limits[:, 1, None, None]
    wanted = targets.T

    def step(_, q):
        walked = chain.walk(geometry, (jnp.cos(q), jnp.sin(q)))
        gap = wanted - walked.tip
        # The damping fades with the distance, so that the last steps are Newton's.
        damping = 1e-2 * jnp.sum(gap**2, axis=0) + 1e-12
        moves = least_moves(chain.columns_of(walked)["theta"], damping)
        return jnp.clip(q + jnp.clip(jnp.sum(moves * gap[None], axis=1, keepdims=True), -0.5, 0.5), low, high)

    q = jax.lax.fori_loop(0, steps, step, q.T[:, None, :])
    tip = chain.walk(geometry, (jnp.cos(q), jnp.sin(q))).tip
    return q[:, 0].T, jnp.linalg.norm(wanted - tip, axis=0)


def least_moves(columns: Float[Array, "n 3 N"], damping: Float[Array, " N"]) -> Float[Array, "n 3 N"]:
    """Least change of every joint per mm that the tip shall move along each axis: J^T (J J^T + damping)^-1, pose by pose.

    ``columns`` are the derivatives of the tip by the joints, mm. The inverse is written out (adjugate over determinant):
    for matrices this small a call of a library costs ten times the arithmetic.
    """
    x, y, z = columns[:, 0], columns[:, 1], columns[:, 2]
    xx, yy, zz = (jnp.sum(c * c, axis=0) + damping for c in (x, y, z))
    xy, xz, yz = jnp.sum(x * y, axis=0), jnp.sum(x * z, axis=0), jnp.sum(y * z, axis=0)
    adjugate = (
        (yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz),
        (yz * xz - xy * zz, xx * zz - xz * xz, xy * xz - xx * yz),
        (xy * yz - yy * xz, xy * xz - xx * yz, xx * yy - xy * xy),
    )
    determinant = xx * adjugate[0][0] + xy * adjugate[0][1] + xz * adjugate[0][2]
    rows = [[entry / determinant for entry in row] for row in adjugate]
    return jnp.stack([x * row[0][None] + y * row[1][None] + z * row[2][None] for row in rows], axis=1)


def limits_of(arm: Arm, limits: Sequence[Sequence[float]] | None) -> Float[Array, "n 2"]:
    """Lowest and highest reading of each joint: those given, else the arm's own, else half a turn each way; rad."""
    rows = limits if limits is not None else arm.limits
    if rows is None:
        rows = [(-math.pi, math.pi)] * arm.joints
    return jnp.asarray(checked_limits(rows, arm.joints))


def socket_point(name: str, point: Numbers) -> Float[Array, " 3"]:
    """A socket's position, mm, or `InputError` that names the socket."""
    array = as_floats(point, f"position of socket '{name}'")
    if array.shape != (3,):
        raise InputError(f"position of socket '{name}' has shape {array.shape}; give its three coordinates (x, y, z) in mm.")
    return array


def _counts(points: Mapping[str, Array], poses: int | Mapping[str, int]) -> dict[str, int]:
    counts = {name: poses.get(name, 0) if isinstance(poses, Mapping) else poses for name in points}
    for name in poses if isinstance(poses, Mapping) else ():
        if name not in points:
            raise InputError(f"poses are given for the unknown socket '{name}'{nearest(name, points)}")
    for name, count in counts.items():
        if count < 1:
            raise InputError(f"socket '{name}' is given {count} poses; give at least one.")
    return counts


def _reference_lengths(points: Mapping[str, Array], lengths: Iterable, key: Array) -> list[ReferenceLength]:
    drawn = []
    for number, length in enumerate(lengths):
        if isinstance(length, ReferenceLength):
            drawn.append(length)
            continue
        if len(length) not in (2, 3) or any(end not in points for end in length[:2]):
            raise InputError(
                f"reference length {length} must be (socket, socket) or (socket, socket, u), of simulated sockets."
            )
        start, end = length[:2]
        u = float(length[2]) if len(length) == 3 else 0.0
        draw = jax.random.normal(jax.random.fold_in(key, number))
        true = jnp.linalg.norm(points[start] - points[end])
        drawn.append(ReferenceLength(start, end, true + u * draw, u))
    return drawn
