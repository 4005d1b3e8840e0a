"""Residuals of a calibration pose by pose, in mm and in standard deviations, with the weights of its last solve."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..calibration.evaluation import Evaluation
from ..calibration.record import CalibrationRecord
from ..calibration.reprojection import reprojection
from ..data.capture import Capture
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels
from ..uncertainty.linearisation import ObservationRows
from .equations import equations_of, linearisation_of

_LEAST_LEVER = 1e-6  # mm per rad: a joint whose axis the tip is on explains nothing


class ObservationResiduals(NamedTuple):
    """How far the poses of one observation are from its geometry."""

    observation: AbstractObservation
    distance: Float[np.ndarray, " m"]  # mm
    other: dict[str, Float[np.ndarray, " m"]]  # unit, rad or px -> size of the residuals that are measured in it
    # Root mean square over the pose's rows in standard deviations: about 1, whatever the kind.
    normalised: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]  # below 1 where a robust loss took weight from the pose
    u: dict[str, float]  # unit, mm, rad or px -> standard uncertainty of what was measured in it, RMS over the poses
    by_joint: Float[np.ndarray, "n m"]  # change of each reading that alone would explain most of the residual, rad
    lever: Float[np.ndarray, "n m"]  # what the tip moves with that reading, mm per rad; a slide: mm, mm per mm


def observation_residuals(record: CalibrationRecord) -> tuple[ObservationResiduals, ...]:
    """The residuals of a calibration from observations, or with a robust loss; sockets first, in the capture's order.

    Arm, geometry and the standard deviations of the rows are those of its last solve, so that the root mean square of
    ``normalised`` over an observation is its ``reduced_chi``.
    """
    residuals = []
    for part in linearisation_of(record, record.names, noise=record.given_noise).parts():
        observation, by_tip = part.observation, np.asarray(part.by_tip)
        position = observation.in_mm(np.asarray(part.values), by_tip)
        moved = observation.in_mm(np.asarray(part.by_readings), by_tip)
        variances = np.diagonal(np.asarray(part.measured), axis1=1, axis2=2)
        of_unit = {unit: np.array(observation.row_units) == unit for unit in dict.fromkeys(observation.row_units)}
        lever = np.linalg.norm(moved, axis=0)
        white = np.einsum("mab,bm->am", part.root, part.values)
        residuals.append(
            ObservationResiduals(
                observation=observation,
                distance=np.linalg.norm(position, axis=0),
                other={unit: _other_sizes(record, part) for unit in of_unit if unit != "mm"},
                normalised=np.sqrt(np.sum(white**2, axis=0) / observation.pose_equations),
                weight=np.asarray(part.weight),
                u={unit: float(np.sqrt(np.mean(variances[:, rows]))) for unit, rows in of_unit.items()},
                by_joint=-np.einsum("rm,rnm->nm", position, moved) / np.maximum(lever, _LEAST_LEVER) ** 2,
                lever=lever,
            )
        )
    return tuple(residuals)


def _other_sizes(record: CalibrationRecord, part: ObservationRows) -> Float[np.ndarray, " m"]:
    """Sizes of the residuals that are not in mm: of an image, the root mean square distance of its corners."""
    observation = part.observation
    if isinstance(observation, Pixels):
        return reprojection(record.calibrated.arm, observation, record.observed.geometry).rms_by_image
    return np.asarray(observation.other_sizes(np.asarray(part.values)))


def distances_of(capture: Capture, evaluation: Evaluation) -> tuple[Float[np.ndarray, " m"], ...]:
    """Distances of all poses from their geometry in an evaluation, mm: of each socket, then of each observation."""
    if evaluation.observed is not None:
        return tuple(map(np.asarray, evaluation.observed.distances))
    return tuple(np.split(np.asarray(evaluation.distances), np.cumsum(capture.sizes)[:-1]))


def rms(values: Sequence[float] | Float[np.ndarray, " m"]) -> float:
    """Root mean square; NaN of nothing."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


class SignedResiduals(NamedTuple):
    """The residuals of a calibration with their directions, for those poses that have one; N poses, n joints."""

    poses: Int[np.ndarray, " N"]  # their numbers among all poses: sockets first, then other observations
    vector: Float[np.ndarray, "N 3"]  # in the base frame, mm; of a distance or plane, along what it measures
    along_joint: Float[np.ndarray, "N n"]  # component along which each joint moves the tip, mm; NaN where it does not
    normalised: Float[np.ndarray, " k"]  # every row of every pose, in standard deviations


def signed_residuals(record: CalibrationRecord) -> SignedResiduals | None:
    """The residuals of a calibration with their directions; None where no pose has one.

    A joint whose angle is wrong moves the tip along its own direction alone, so that what the model lacks in one joint
    shows in ``along_joint`` against the reading of that joint.
    """
    rows, joints, parts = equations_of(record).rows, record.calibrated.arm.joints, []
    if not rows:
        return None
    for part in rows:
        in_mm = np.einsum("mcr,mr->mc", part.in_mm, part.residual)
        vector = np.einsum("mcr,mrx,mc->mx", part.in_mm, part.by_tip, in_mm)
        moves = part.in_mm @ part.extra[..., :joints]
        size = np.linalg.norm(moves, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            along = np.where(size > 1e-6 * size.max(), np.einsum("mc,mcn->mn", in_mm, moves) / size, np.nan)
        parts.append((part.poses, vector, along, part.residual.ravel()))
    poses, vector, along, normalised = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.argsort(poses, kind="stable")
    return SignedResiduals(poses[order], vector[order], along[order], normalised)
