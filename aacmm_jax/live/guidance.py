"""What a capture shows so far, and what to measure next."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..kinematics.arm import Arm, joint_limits
from ..kinematics.inverse_kinematics import project_to_targets
from .places import Setup, TakenPose


class PoseResidual(NamedTuple):
    """The tip of a pose, its residual, mm, the size that the residual is expected to have, and whether it is an
    outlier."""

    tip: Float[np.ndarray, " 3"]
    residual: Float[np.ndarray, " 3"]
    expected: float
    outlier: bool


class Guidance(NamedTuple):
    """The calibration of the poses so far. U is the expanded uncertainty (95 %) of a length, mm."""

    arm: Arm  # as calibrated so far
    poses: Mapping[int, PoseResidual]  # by number
    positions: Mapping[str, Float[np.ndarray, " 3"]]  # of places, as found
    u_length: float | None
    u_after_ten: float | None
    limits: str  # what limits U, as a sentence
    stop: bool  # whether the target is met
    sentences: tuple[str, ...]  # findings


class NextPose(NamedTuple):
    """A pose to take: its place, the readings to go to, why, and how far the joints move, rad."""

    place: str
    q: Float[np.ndarray, " n"]
    why: str
    distance: float


def calibrated(setup: Setup, poses: Sequence[TakenPose], target: float | None = None) -> Guidance | None:
    """The calibration of the poses so far; None where they are too few."""
    return None


def next_pose(
    setup: Setup,
    poses: Sequence[TakenPose],
    guidance: Guidance | None,
    q: Float[np.ndarray, " n"] | None,
    place: str | None = None,
) -> NextPose | None:
    """The pose to take next, near the present readings ``q``; in ``place``, where that is given."""
    arm = setup.specification.arm
    limits = np.asarray(joint_limits(arm, None))
    random = np.random.default_rng(len(poses))
    counts = {p.name: sum(pose.place == p.name and not pose.excluded for pose in poses) for p in setup.places}
    chosen = min(setup.places, key=lambda p: counts[p.name] - (p.name == place) * 1000)
    starts = random.uniform(limits[:, 0], limits[:, 1], (40, arm.joints))
    if chosen.position is not None:
        starts, arrived = project_to_targets(arm, starts, np.tile(chosen.position, (40, 1)), limits)
        starts = starts[arrived]
    if not len(starts):
        return None
    here = limits.mean(axis=1) if q is None else q
    distances = np.abs(starts - here).max(axis=1)
    best = int(np.argmin(np.abs(distances - 0.7)))
    return NextPose(chosen.name, starts[best], "fewest poses so far", float(distances[best]))
