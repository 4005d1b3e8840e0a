"""Where a calibration was tried: how far poses are, in joint space, from those that it was made from.

What a model lacks depends on the readings, so a calibration has seen such errors only near its own poses. Elsewhere an
uncertainty that follows from the model alone says nothing of them.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.arguments import checked_arguments
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..kinematics.arm import Arm
from ..kinematics.chain import reading_units

_QUERIES = 500  # poses of a capture, evenly chosen, whose distance from their nearest neighbour is computed
_AT_ONCE = 64
_NEAR = 0.95  # of the capture's poses are as near to another one as what counts as tried


class TriedPoses(NamedTuple):
    """Distances in joint space: root mean square over the joints, each the shorter way round, rad (slides: m)."""

    spacing: float  # within which 95 % of the calibration's poses have another one
    distance: Float[np.ndarray, " v"]  # of each other pose from the nearest one of the calibration

    @property
    def tried(self) -> Bool[np.ndarray, " v"]:
        """Which poses are as near to one of the calibration as these are to one another."""
        return self.distance <= self.spacing


@checked_arguments
def tried_poses(arm: Arm, calibrated: Numbers, q: Numbers) -> TriedPoses:
    """How far poses are from those of a calibration, and these from one another.

    Args:
        arm: The arm.
        calibrated: Readings that it was calibrated with, ``(N, n)``, rad (slides: mm). A temperature after
            them is left out.
        q: Readings of other poses, ``(v, n)``.

    Returns:
        The distances.

    Raises:
        InputError: Fewer than two poses were calibrated with.
    """
    poses, others = (np.asarray(values, dtype=float)[:, : arm.joints] for values in (calibrated, q))
    if len(poses) < 2:
        raise InputError(
            f"{len(poses)} pose has no distance from another; give at least two that were calibrated with."
        )
    units = np.asarray(reading_units(arm.geometry))
    turns = np.array([joint + 1 not in arm.prismatic for joint in range(arm.joints)])
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _QUERIES)).round().astype(int))
    among = _nearest(poses / units, (poses / units)[chosen], turns, chosen)
    return TriedPoses(float(np.quantile(among, _NEAR)), _nearest(poses / units, others / units, turns))


def _nearest(
    poses: Float[np.ndarray, "N n"],
    q: Float[np.ndarray, "v n"],
    turns: Bool[np.ndarray, " n"],
    same: np.ndarray | None = None,
) -> Float[np.ndarray, " v"]:
    """Distance of each pose from the nearest of some ``poses``; ``same``: which of these each of them is itself."""
    nearest = np.empty(len(q))
    for start in range(0, len(q), _AT_ONCE):
        apart = q[start : start + _AT_ONCE, None] - poses[None]
        apart = np.where(turns, (apart + np.pi) % (2 * np.pi) - np.pi, apart)
        squares = np.mean(apart**2, axis=2)
        if same is not None:
            squares[np.arange(len(squares)), same[start : start + _AT_ONCE]] = np.inf
        nearest[start : start + _AT_ONCE] = np.sqrt(squares.min(axis=1))
    return nearest
