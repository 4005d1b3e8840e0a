"""Cameras as plain dictionaries: images that were read, mounts, places of targets, intrinsics."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord
from ..calibration.reprojection import frame_of, mount_of, reprojection
from ..core.rotations import roll_pitch_yaw, rotation_and_derivative
from ..data.observations.observation import offset_of
from ..data.observations.pixels import Pixels
from ..data.recording import Recording
from .tables import plain


def image_rows(recording: Recording) -> list[dict[str, Any]]:
    """For each observation of a camera how many of its images are used, and why the others are not."""
    rows = []
    for name in dict.fromkeys(image.observation for image in recording.images):
        images = [image for image in recording.images if image.observation == name]
        counts = [image.corners for image in images if not image.refused]
        rows.append({
            "observation": name,
            "images": len(images),
            "used": len(counts),
            "fewest_corners": min(counts, default=0),
            "most_corners": max(counts, default=0),
            "refused": [{"image": image.image, "reason": image.refused} for image in images if image.refused],
        })  # fmt: skip
    return rows


def camera_rows(record: CalibrationRecord) -> list[dict[str, Any]]:
    """What each observation of a camera says: mount, place, intrinsics, reprojection; mm, rad and px, u with k = 1.

    Of an arm from a URDF, mounts are in the tip link and places in the base link.
    """
    rows, arm = [], record.calibrated.arm
    geometry, covariances = record.observed.geometry, record.observed.geometry_covariance
    (base, first), (last, in_last) = _links(record)
    for observation in record.recording.capture.observations:
        if not isinstance(observation, Pixels):
            continue
        seen = reprojection(arm, observation, geometry)
        moving, still = (observation.camera, observation.board)[:: 1 if observation.on_arm else -1]
        place = np.asarray(covariances[observation.frame])
        mount = _placed(
            in_last @ mount_of(observation, geometry),
            np.asarray(geometry[observation.orientation]),
            np.asarray(covariances[offset_of(observation.target)]),
            np.asarray(covariances[observation.orientation]),
        )
        frame = np.asarray(geometry[observation.frame])
        rows.append({
            "observation": observation.name,
            "camera": observation.camera,
            "target": observation.board,
            "camera_on_arm": observation.on_arm,
            "model": observation.model,
            "image_size_px": plain(observation.image_size),
            "images": len(observation.q),
            "corners": int(seen.seen.sum()),
            "unit": observation.camera_model.unit,
            "u_corner": float(np.sqrt(np.mean(np.asarray(observation.u)[seen.seen] ** 2))),
            "reprojection_rms": seen.rms,
            "reprojection_rms_mm": float(np.sqrt(np.mean(seen.in_mm[seen.seen] ** 2))),
            "distance_mm": float(np.median(seen.distance[seen.seen])),
            "mount": {"of": moving, "in": last, "defined_by": _held_of(record, arm.joints)} | mount,
            "place": {"of": still, "in": base, "defined_by": _held_of(record, 1)}
            | _placed(first @ frame_of(frame), frame[:3], place[3:, 3:], place[:3, :3]),
            "tip_seen": any(not part.target for part in record.recording.capture.parts),
            "intrinsics": _intrinsics(observation, seen.intrinsics, covariances),
        })  # fmt: skip
    return rows


def _held_of(record: CalibrationRecord, joint: int) -> list[str]:
    """The held parameters of the first or the last joint that move what is seen from there as a whole. None of an arm
    that is held altogether, whose errors U contains as far as residuals show them."""
    names = (f"theta_{joint}", f"d_{joint}")
    return [name for name in names if record.names and name not in record.names]


def _links(record: CalibrationRecord) -> tuple[tuple[str, np.ndarray], tuple[str, np.ndarray]]:
    """What places and mounts are given in, and what takes them there from the first and from the last frame."""
    nominal, to_link = record.recording.nominal, np.eye(4)
    source = nominal.urdf
    if source is None or not source.link:
        return ("base", np.eye(4)), ("last frame", to_link)
    moved = np.asarray(record.calibrated.arm.probe) - np.asarray(nominal.arm.probe)
    to_link[:3, 3] = -np.array(source.link) - (moved if source.follows else 0.0)
    return (source.base, np.array(source.first)), (source.tip, to_link)


def _placed(
    matrix: Float[np.ndarray, "4 4"],
    turn: Float[np.ndarray, " 3"],
    of_position: Float[np.ndarray, "3 3"],
    of_rotation: Float[np.ndarray, "3 3"],
) -> dict[str, Any]:
    """A frame with standard uncertainties of its position and rotation in the worst direction and about the worst
    axis."""
    by_turn = np.asarray(rotation_and_derivative(turn)[1])
    rotation = by_turn @ of_rotation @ by_turn.T
    return {
        "matrix_mm": matrix.tolist(),
        "position_mm": matrix[:3, 3].tolist(),
        "position_u_mm": plain(_worst(of_position)),
        "roll_pitch_yaw_rad": roll_pitch_yaw(matrix[:3, :3]).tolist(),
        "rotation_u_rad": plain(_worst(rotation)),
    }


def _worst(covariance: Float[np.ndarray, "3 3"]) -> float:
    if not np.all(np.isfinite(covariance)):
        return math.inf
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))


def _intrinsics(
    observation: Pixels, values: Float[np.ndarray, " k"], covariances: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """The intrinsics with their standard uncertainty: 0 of those that are taken as exact."""
    u = np.zeros(len(values))
    for part, places in observation.optical.items():
        u[list(places)] = np.sqrt(np.diag(np.asarray(covariances[part])))
    model = observation.camera_model
    return [
        {"name": name, "unit": unit, "value": float(value), "u": plain(float(own))}
        for name, unit, value, own in zip(model.names, model.units, values, u, strict=False)
    ]
