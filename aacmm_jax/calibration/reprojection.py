"""Where a camera saw the corners of a target, where a calibration says that they are, and how far away they were."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.numpy_or_jax import AnyArray
from ..core.rotations import rotation_matrix
from ..data.observations.observation import Tips, offset_of
from ..data.observations.pixels import Pixels
from ..kinematics.arm import Arm


class Reprojection(NamedTuple):
    """The corners of an observation."""

    measured: Float[np.ndarray, "m c d"]  # px, or mm of a camera that measures points
    residual: Float[np.ndarray, "m c d"]  # measured less predicted; 0 where a corner is absent
    seen: Bool[np.ndarray, "m c"]
    distance: Float[np.ndarray, "m c"]  # of the corner from the camera, mm
    intrinsics: Float[np.ndarray, " k"]
    camera: Float[np.ndarray, "m 4 4"]  # its frame in the base frame
    board: Float[np.ndarray, "m 4 4"]

    @property
    def rms(self) -> float:
        """Root mean square of the distances of corners from their predicted places, px (mm of measured points)."""
        return float(np.sqrt(np.sum(self.residual**2) / self.seen.sum()))

    @property
    def rms_by_image(self) -> Float[np.ndarray, " m"]:
        """The same of each image."""
        return np.sqrt(np.sum(self.residual**2, axis=(1, 2)) / self.seen.sum(axis=1))

    @property
    def in_mm(self) -> Float[np.ndarray, "m c"]:
        """The same distances at the target, across the line of sight, mm."""
        sizes = np.linalg.norm(self.residual, axis=2)
        return sizes if not len(self.intrinsics) else sizes * self.distance / np.mean(self.intrinsics[:2])


def frame_of(numbers: Float[AnyArray, " 6"]) -> Float[np.ndarray, "4 4"]:
    """A frame as a matrix, from its rotation vector, rad, and origin, mm."""
    matrix, numbers = np.eye(4), np.asarray(numbers)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(numbers[:3]), numbers[3:]
    return matrix


def mount_of(observation: Pixels, geometry: Mapping[str, Float[AnyArray, " k"]]) -> Float[np.ndarray, "4 4"]:
    """The frame of what is on the arm, camera or target, in the last frame, mm."""
    parts = geometry[observation.orientation], geometry[offset_of(observation.target)]
    return frame_of(np.concatenate([np.asarray(part) for part in parts]))


def reprojection(arm: Arm, observation: Pixels, geometry: Mapping[str, Float[AnyArray, " k"]]) -> Reprojection:
    """The corners of an observation by an arm and the geometry of a calibration, mm and rad."""
    held = arm.replace(probe=np.asarray(geometry[offset_of(observation.target)]))
    last = np.asarray(held.pose(np.asarray(observation.q)))
    tips = Tips(last[:, :3, 3].T, (last[:, :3, 0].T, last[:, :3, 1].T, last[:, :3, 2].T))
    unknowns = {part: np.asarray(geometry[part])[:, None] for part in observation.unknowns}
    measured = np.asarray(observation.corners)
    values = np.asarray(observation.residual(tips, unknowns).values).T.reshape(measured.shape)
    moving = last.copy()
    moving[:, :3, :3] = last[:, :3, :3] @ mount_of(observation, geometry)[:3, :3]
    still = np.broadcast_to(frame_of(geometry[observation.frame]), last.shape)
    camera, board = (moving, still) if observation.on_arm else (still, moving)
    scale = float(np.asarray(geometry[observation.scale])[0]) if observation.scale in unknowns else 1.0
    points = scale * np.asarray(observation.points) @ board[:, :3, :3].swapaxes(1, 2) + board[:, None, :3, 3]
    distance = np.linalg.norm(points - camera[:, None, :3, 3], axis=2)
    intrinsics = observation.whole_intrinsics(unknowns)[:, 0]
    return Reprojection(
        measured, -values, np.asarray(observation.seen), distance, np.asarray(intrinsics), camera, board
    )
