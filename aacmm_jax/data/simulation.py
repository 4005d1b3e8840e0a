"""Recordings made up: poses of an arm that reach given points, with the noise of encoders and of the probe's seat."""

import math
from collections.abc import Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError, nearest
from ..core.units import ARCSEC
from ..kinematics.arm import Arm, is_single, joint_limits
from ..kinematics.inverse_kinematics import random_configurations
from .capture import Capture, ReferenceLength


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
    limits_array = joint_limits(arm, limits)
    points = {name: socket_point(name, point) for name, point in sockets.items()}
    counts = _counts(points, poses)
    key = jax.random.key(seed)
    reach_key, seat_key, encoder_key, length_key = jax.random.split(key, 4)
    owner = [name for name, count in counts.items() for _ in range(count)]
    exact = jnp.asarray(np.repeat(np.stack([np.asarray(point) for point in points.values()]), list(counts.values()), axis=0))
    targets = exact + seating * jax.random.normal(seat_key, exact.shape)
    references = _reference_lengths(points, lengths, length_key)
    angles = random_configurations(arm, targets, reach_key, limits_array, labels=[f"socket '{name}'" for name in owner])
    angles = angles + encoder_arcsec * ARCSEC * jax.random.normal(encoder_key, angles.shape)
    if resolution_arcsec > 0:
        angles = jnp.round(angles / (resolution_arcsec * ARCSEC)) * (resolution_arcsec * ARCSEC)
    ends = np.cumsum(list(counts.values()))
    readings = {name: angles[end - count : end] for (name, count), end in zip(counts.items(), ends, strict=True)}
    return Capture(readings, references)


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
