"""Which convention the rotations of a table are written in: all are tried against the arm."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.evaluation import evaluate
from ..core.numpy_or_jax import to_numpy
from ..core.rotation_conventions import conventions, is_of_angles, rotation_matrices
from ..core.rotations import rotation_matrix
from ..core.units import DEG
from ..data.capture import Capture
from ..data.observations.measured import MeasuredPoints
from ..kinematics.arm import Arm

_UNITS = {"deg": DEG, "rad": 1.0}
_TURN = 2 * np.pi * 1.02  # rad: angles that go further are in degrees
_AS_GOOD = 1.5, 0.2 * DEG  # the factor, and the angle, by which residuals of another convention must be larger
_SAME = 1e-6  # rad: the same rotations but for how the target is mounted
_EXPLAINED = 5 * DEG  # a larger residual is left by no nominal arm
_UNIT = 1e-3  # of a quaternion's length, or of a matrix's columns


class RotationFit(NamedTuple):
    """How well a convention fits."""

    convention: str
    unit: str  # "deg", "rad", or empty
    rms: float  # of the angle between the target and the last frame, from their best constant rotation, rad
    fits: bool  # as well as the best
    equivalent: bool  # and whether it is the same rotations as the best, but for the mounting of the target


def check_rotations(
    arm: Arm,
    q: Float[np.ndarray, "m n"],
    points: Float[np.ndarray, "m 3"],
    numbers: Float[np.ndarray, "m k"],
    unit: str | None = None,
) -> tuple[float, list[RotationFit]]:
    """The RMS residual of the positions (mm) by the nominal arm, and every convention, the best first.

    The frame of the instrument and the place of the target follow from the positions, so that they choose no
    convention; the orientation of the target in the last frame is the best for each.

    Args:
        arm: The nominal arm.
        q: Readings, rad.
        points: Measured positions of the target, mm.
        numbers: Of the rotations, as the table has them.
        unit: Of these numbers, where it is stated: "deg" or "rad".
    """
    seen = MeasuredPoints("points", q, points, u=0.01, target="target", station="instrument")
    observed = to_numpy(evaluate(arm, Capture({}, [], [seen]))).observed
    assert observed is not None
    frame = rotation_matrix(np.asarray(observed.geometry["frame of instrument"])[:3])
    # Takes directions in the frame of the instrument to the last frame.
    turned = np.asarray(to_numpy(arm).pose(q))[:, :3, :3].swapaxes(1, 2) @ frame
    fits, matrices = [], []
    for convention in conventions(numbers.shape[1]):
        stated = [unit] if unit else ["deg"] if np.abs(numbers).max() > _TURN else ["deg", "rad"]
        for name in stated if is_of_angles(convention) else [""]:
            scaled = numbers * _UNITS.get(name, 1.0)
            if numbers.shape[1] == 4 and np.abs(np.linalg.norm(numbers, axis=1) - 1).max() > _UNIT:
                continue
            measured = rotation_matrices(scaled, convention)
            if np.abs(measured.swapaxes(1, 2) @ measured - np.eye(3)).max() > 2 * _UNIT:
                continue
            mounted = turned @ measured
            u, _, v = np.linalg.svd(mounted.sum(axis=0))
            mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
            angles = _angles(mounted, mean)
            fits.append(RotationFit(convention, name, float(np.sqrt(np.mean(angles**2))), False, False))
            matrices.append(measured)
    order = np.argsort([fit.rms for fit in fits], kind="stable")
    fits, matrices = [fits[i] for i in order], [matrices[i] for i in order]
    for i, fit in enumerate(fits):
        good = fits[0].rms <= _EXPLAINED and fit.rms <= max(_AS_GOOD[0] * fits[0].rms, fits[0].rms + _AS_GOOD[1])
        between = matrices[0].swapaxes(1, 2) @ matrices[i]
        fits[i] = fit._replace(fits=good, equivalent=bool(good and _angles(between, between[0]).max() < _SAME))
    return float(np.asarray(observed.rms)[0]), fits


def _angles(rotations: Float[np.ndarray, "m 3 3"], from_one: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " m"]:
    """The angles of rotations from one of them; by the sine of the half, which is exact near 0."""
    size = np.linalg.norm(rotations - from_one, axis=(1, 2)) / np.sqrt(8)
    return 2 * np.arcsin(np.clip(size, 0.0, 1.0))
