"""The uncertainty of a calibrated arm over its working volume: of tips and of lengths."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, compiled, namespace, to_numpy
from ..core.random_keys import random_generator
from ..kinematics.arm import Arm, joint_limits, with_chains
from ..kinematics.inverse_kinematics import project_to_targets
from ..kinematics.workspace import total_link_length
from .arm_uncertainty import Uncertainty

_PAIRS = 20_000  # of poses that are drawn, to find those whose tips are about a length apart
_MOVED = 1 / 3  # of the length: by so much more or less may they be
_FEW = 50  # lengths: fewer do not show a median and a largest value
_LENGTH_MM = 300.0  # lengths of the map, where none is given: those of the paper's checks


class VolumetricUncertainty(NamedTuple):
    """Uncertainties over the working volume, standard and expanded ones, point by point, as NumPy arrays, mm.

    At each point: of a tip, and of a length that starts there, in random poses.

    Example:
        >>> volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=20)
        >>> print(volume.length, "mm:", np.median(volume.u_length).round(3), "mm")
        300.0 mm: 0.012 mm
    """

    length: float  # nominal size of the lengths
    q: Float[np.ndarray, "v n"]
    q_end: Float[np.ndarray, "v n"]
    start: Float[np.ndarray, "v 3"]
    end: Float[np.ndarray, "v 3"]
    u_tip: Float[np.ndarray, " v"]  # along the direction in which it is largest
    u_length: Float[np.ndarray, " v"]
    u_length_reading: Float[np.ndarray, " v"]  # with the noise of the readings at both ends
    expanded_tip: Float[np.ndarray, " v"]  # each with a coverage factor of its own
    expanded_length: Float[np.ndarray, " v"]
    expanded_length_reading: Float[np.ndarray, " v"]

    @property
    def summary(self) -> dict[str, float]:
        """Median, 95th percentile and largest uncertainty, standard and expanded, mm; the smallest and the
        largest coverage factor."""
        u, expanded = np.concatenate(self[5:8]), np.concatenate(self[8:])
        usable = np.isfinite(u) & (u > 0)
        factors = expanded[usable] / u[usable]
        numbers = {
            "length_mm": self.length,
            "coverage_factor_least": float(factors.min(initial=np.inf)),
            "coverage_factor_largest": float(factors.max(initial=-np.inf)),
        }
        for name, values in zip(self._fields[5:], self[5:], strict=True):
            numbers[f"{name}_median_mm"] = float(np.median(values))
            # No sum, so infinite ones are allowed.
            numbers[f"{name}_95_mm"] = float(np.quantile(values, 0.95, method="higher"))
            numbers[f"{name}_largest_mm"] = float(np.max(values))
        return numbers


@checked_arguments
def volumetric_uncertainty(
    uncertainty: Uncertainty,
    *,
    points: int = 400,
    length: float | None = None,
    limits: Any = None,
    near: Numbers | None = None,
    seed: int = 0,
) -> VolumetricUncertainty:
    """Uncertainty of tips and of lengths over the reachable volume, or near to some poses.

    Its points are the tips of random poses, or of some of these poses.

    Args:
        uncertainty: of a calibrated arm.
        points: number of points.
        length: size of the lengths, mm; by default 300, or half the sum of a small arm's links.
        limits: lowest and highest reading of each joint ``(n, 2)``, rad; by default the arm's own.
        near: poses ``(N, n)``, rad, such as those of a calibration, near which the lengths begin and end; by default
            these are anywhere within the limits.
        seed: of the random numbers.

    Returns:
        Uncertainties at every point, mm; near to poses, at as many points as there are such lengths.

    Raises:
        InputError: no length of this size can be placed within the joint limits, or near to the poses.

    Example:
        >>> volume = aj.volumetric_uncertainty(aj.uncertainty_of(result), points=20, length=300.0)
        >>> print(f"u of 300 mm: {np.median(volume.u_length):.3f} mm, at most {volume.u_length.max():.3f} mm")
        u of 300 mm: 0.012 mm, at most 0.031 mm
    """
    length = default_length(uncertainty.arm) if length is None else length
    if near is None:
        start, end = sample_lengths(uncertainty.arm, points, length=length, limits=limits, seed=seed)
    else:
        start, end = lengths_between(uncertainty.arm, near, points, length=length, limits=limits, seed=seed)
    tips, *parts = _volume(to_numpy(uncertainty), start, end)
    u = [np.sqrt(np.sum(np.asarray(part), axis=-1)) for part in parts]
    expanded = [uncertainty.expanded_by_parts(part) for part in parts]
    return VolumetricUncertainty(length, start, end, tips[0], tips[1], *u, *expanded)


@compiled(jit=eqx.filter_jit)
def _volume(uncertainty: Uncertainty, start: Float[AnyArray, "v n"], end: Float[AnyArray, "v n"]) -> tuple[Any, ...]:
    tips = namespace(uncertainty, start, end).stack([uncertainty.arm.position(q) for q in (start, end)])
    plain, read = (uncertainty.length_parts(start, end, reading=reading) for reading in (False, True))
    return tips, uncertainty.tip_parts(start), plain, read


def default_length(arm: Arm) -> float:
    """300 mm, or half of what a smaller arm's links add up to."""
    return min(_LENGTH_MM, 0.5 * total_link_length(arm))


def sample_lengths(
    arm: Arm, count: int, *, length: float | None, limits: Any = None, seed: int = 0
) -> tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]:
    """Lengths all over the working volume, as the poses at their two ends, where both ends can be reached.

    Args:
        arm: The arm that measures them.
        count: How many.
        length: Their length in random directions, mm; None for lengths between independent random poses.
        limits: Lowest and highest reading of each joint ``(n, 2)``, rad; by default the arm's.
        seed: Seed of the random poses.

    Returns:
        Poses where the lengths start, and where they end, ``(count, n)`` each, rad.

    Raises:
        InputError: The length does not fit into the volume, or no length is asked for.

    Example:
        >>> starts, ends = aj.uncertainty.sample_lengths(arm, 5, length=300.0)
        >>> print(np.linalg.norm(arm.position(ends) - arm.position(starts), axis=1).round(3))
        [300. 300. 300. 300. 300.]
    """
    if length is not None and not 0 < length < 2 * total_link_length(arm):
        raise InputError(f"a length of {length:g} mm does not fit into the volume of this arm; give a shorter length.")
    if count < 1:
        raise InputError(f"points is {count}; give at least one.")
    random = random_generator(seed)
    allowed = np.asarray(joint_limits(arm, None if limits is None else np.asarray(limits).tolist()))

    def draw(m: int) -> Float[np.ndarray, "m n"]:
        return with_chains(arm, random.uniform(allowed[:, 0], allowed[:, 1], (m, arm.joints)))

    if length is None:
        return draw(count), draw(count)
    starts, ends = [], []
    for _ in range(60):
        q = draw(2 * count)
        direction = random.normal(size=(2 * count, 3))
        targets = np.asarray(arm.position(q)) + length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        # Most ends of a long length are farther from the shoulder than the stretched arm reaches: not worth the steps.
        near = np.linalg.norm(targets - [0.0, 0.0, float(np.asarray(arm.d)[0])], axis=1) <= total_link_length(arm)
        other, arrived = project_to_targets(arm, draw(2 * count)[near], targets[near], allowed)
        starts.append(q[near][arrived])
        ends.append(other[arrived])
        if sum(map(len, starts)) >= count:
            return np.concatenate(starts)[:count], np.concatenate(ends)[:count]
    raise InputError(f"this arm cannot reach lengths of {length:g} mm within its joint limits; give a shorter length.")


def lengths_between(
    arm: Arm, poses: Numbers, count: int, *, length: float, limits: Any = None, seed: int = 0
) -> tuple[Float[np.ndarray, "v n"], Float[np.ndarray, "v n"]]:
    """Lengths that begin in one of these poses ``(N, n)``, rad, and end near to another, whose tip is moved along the
    line between both tips until they are so far apart, by at most a third of the length: at most ``count`` of them.
    `InputError` where hardly any two poses are that far apart."""
    q, random = np.asarray(poses, dtype=float)[:, : arm.beside.own], random_generator(seed)
    tips = np.asarray(arm.position(q))
    first, second = random.integers(len(q), size=(2, _PAIRS))
    between = tips[second] - tips[first]
    apart = np.linalg.norm(between, axis=1)
    chosen = np.flatnonzero(np.abs(apart - length) < length * _MOVED)[:count]
    first, second, direction = first[chosen], second[chosen], between[chosen] / apart[chosen, None]
    allowed = np.asarray(joint_limits(arm, None if limits is None else np.asarray(limits).tolist()))
    end, arrived = project_to_targets(arm, q[second], tips[first] + length * direction, allowed)
    if arrived.sum() < min(count, _FEW):
        raise InputError(
            f"hardly any two of these poses have tips about {length:g} mm apart; give poses all over the volume, or "
            "another length."
        )
    return q[first][arrived], end[arrived]
